"""Lost objects and phantoms: what the detector got wrong only after the change.

Both need a threshold t*, the detector's score of best F1 on benign frames. Lost: found at IoU 0.5 and score t* in
the benign re-render, not found against its label afterwards. Phantom: a new false positive above t*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.types import Detections, Targets

IOU = 0.5


@dataclass(frozen=True, slots=True)
class Judgement:
    """One image at one threshold. found (M,) bool: targets that a detection met; false_positive (D,) bool:
    detections at or above the threshold that no target and no ignored one explains.
    """

    found: Tensor
    false_positive: Tensor


@dataclass(frozen=True, slots=True)
class Failures:
    """lost: indices of targets; phantoms: indices of the attacked image's detections; both ascending."""

    lost: tuple[int, ...]
    phantoms: tuple[int, ...]

    @property
    def success(self) -> bool:
        """Whether the change is a counterexample: something is lost or a phantom appeared."""
        return bool(self.lost or self.phantoms)


def judge(targets: Targets, detections: Detections, threshold: float, iou: float = IOU) -> Judgement:
    """Match detections to targets of their class from that IoU on, best score first (COCO's greedy matching).

    A detection without a target is excused where at least that share of it lies on an ignored one of its class.
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
    return Judgement(
        found=torch.tensor(found, dtype=torch.bool), false_positive=torch.tensor(false_positive, dtype=torch.bool)
    )


def find(
    benign_targets: Targets,
    benign_detections: Detections,
    targets: Targets,
    detections: Detections,
    threshold: float,
    iou: float = IOU,
) -> Failures:
    """What was right on the benign re-render and is wrong now. The i-th targets of both are the same object.

    iou: from which a detection meets a target. Objects that are ignored now are not lost. A false positive is a
    phantom unless it overlaps (IoU over 0.5) a false positive of its class in the benign re-render. Raises
    ValueError where the targets do not correspond.
    """
    if len(benign_targets) != len(targets) or not torch.equal(benign_targets.labels, targets.labels):
        raise ValueError(f"targets: expected the {len(benign_targets)} benign objects, found {len(targets)}")
    before = judge(benign_targets, benign_detections, threshold, iou)
    after = judge(targets, detections, threshold, iou)
    lost = before.found & ~after.found & ~targets.ignore.cpu()
    old = before.false_positive.to(benign_detections.labels.device)
    repeated = boxes.iou_matrix(detections.boxes_xyxy, benign_detections.boxes_xyxy[old]) > IOU
    repeated &= detections.labels[:, None] == benign_detections.labels[old][None]
    # A box without an area, cut off at the border, overlaps nothing, not even itself.
    visible = boxes.area(detections.boxes_xyxy) > 0
    phantoms = after.false_positive & (visible & ~repeated.any(dim=1)).cpu()
    return Failures(lost=tuple(lost.nonzero()[:, 0].tolist()), phantoms=tuple(phantoms.nonzero()[:, 0].tolist()))


def by_class(indices: Sequence[int], labels: Tensor, classes: Sequence[str]) -> dict[str, int]:
    """How many of `indices` carry each label; labels (M,) of what they index."""
    counts = dict.fromkeys(classes, 0)
    for index in indices:
        counts[classes[int(labels[index])]] += 1
    return counts
