"""Lost objects and phantoms: what a detector gets wrong only after a change.

Both need a threshold t*, the detector's score of best F1 on benign frames. Lost: an object that is detected at IoU 0.5
and score t* in the benign re-render, but not afterwards. Phantom: a new false positive above t*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.types import Detections, Targets

MATCH_IOU = 0.5


@dataclass(frozen=True, slots=True)
class FrameMatches:
    """Detections of one image, matched at one threshold."""

    detected: Tensor
    """(M,) bool, targets that a detection matches."""
    false_positive: Tensor
    """(D,) bool, detections of at least the threshold on no target and no ignored one."""


@dataclass(frozen=True, slots=True)
class FrameFailures:
    """What a change makes a detector get wrong in one frame."""

    lost: tuple[int, ...]
    """Indices of lost targets, ascending."""
    phantoms: tuple[int, ...]
    """Indices of phantoms among the attacked image's detections, ascending."""

    @property
    def success(self) -> bool:
        """Whether the change is a counterexample: an object is lost or a phantom appears."""
        return bool(self.lost or self.phantoms)


def match_detections(
    targets: Targets, detections: Detections, threshold: float, iou: float = MATCH_IOU
) -> FrameMatches:
    """Match detections to targets of their class, by descending score (COCO's greedy matching).

    An unmatched detection is excused where at least the share `iou` of it lies on an ignored target of its class.

    Args:
        targets: Labels.
        detections: Detections.
        threshold: Minimum score.
        iou: Minimum IoU of a match.
    """
    overlap = boxes.iou_matrix(detections.boxes_xyxy, targets.boxes_xyxy.to(detections.boxes_xyxy))
    share = boxes.ioa_matrix(detections.boxes_xyxy, targets.boxes_xyxy.to(detections.boxes_xyxy))
    same = detections.labels[:, None] == targets.labels.to(detections.labels)[None]
    ignore = targets.ignore.to(detections.labels.device)
    candidates = torch.where(same & ~ignore, overlap, torch.zeros_like(overlap))
    excused = (same & ignore & (share >= iou)).any(dim=1)
    found = [False] * len(targets)
    false_positive = [False] * len(detections)
    order = torch.argsort(detections.scores, descending=True, stable=True).tolist()
    rows, excuse, scores = candidates.tolist(), excused.tolist(), detections.scores.tolist()
    for d in order:
        if scores[d] < threshold:
            break
        free = [(rows[d][t], -t) for t in range(len(found)) if not found[t] and rows[d][t] >= iou]
        if free:
            found[-max(free)[1]] = True
        else:
            false_positive[d] = not excuse[d]
    return FrameMatches(
        detected=torch.tensor(found, dtype=torch.bool),
        false_positive=torch.tensor(false_positive, dtype=torch.bool),
    )


def find_failures(
    benign_targets: Targets,
    benign_detections: Detections,
    targets: Targets,
    detections: Detections,
    threshold: float,
    iou: float = MATCH_IOU,
) -> FrameFailures:
    """Find what is right in the benign re-render and wrong now.

    Objects that are ignored now are not lost. A false positive is a phantom unless it overlaps (IoU over 0.5) a false
    positive of its class in the benign re-render.

    Args:
        benign_targets: Labels of the benign re-render.
        benign_detections: Detections in it.
        targets: Labels now; the i-th is the same object as the i-th benign one.
        detections: Detections now.
        threshold: Minimum score.
        iou: Minimum IoU of a match.

    Raises:
        ValueError: The targets do not correspond.
    """
    if len(benign_targets) != len(targets) or not torch.equal(benign_targets.labels, targets.labels):
        raise ValueError(f"targets: expected the {len(benign_targets)} benign objects, found {len(targets)}")
    before = match_detections(benign_targets, benign_detections, threshold, iou)
    after = match_detections(targets, detections, threshold, iou)
    lost = before.detected & ~after.detected & ~targets.ignore.cpu()
    old = before.false_positive.to(benign_detections.labels.device)
    repeated = boxes.iou_matrix(detections.boxes_xyxy, benign_detections.boxes_xyxy[old]) > MATCH_IOU
    repeated &= detections.labels[:, None] == benign_detections.labels[old][None]
    # A box without an area, clipped at the border, overlaps nothing, not even itself.
    visible = boxes.area(detections.boxes_xyxy) > 0
    phantoms = after.false_positive & (visible & ~repeated.any(dim=1)).cpu()
    return FrameFailures(
        lost=tuple(lost.nonzero()[:, 0].tolist()), phantoms=tuple(phantoms.nonzero()[:, 0].tolist())
    )


def count_by_class(indices: Sequence[int], labels: Tensor, classes: Sequence[str]) -> dict[str, int]:
    """Count indices by class.

    Args:
        indices: Indices into `labels`.
        labels: (M,) index of the class.
        classes: Names of the classes.
    """
    counts = dict.fromkeys(classes, 0)
    for index in indices:
        counts[classes[int(labels[index])]] += 1
    return counts
