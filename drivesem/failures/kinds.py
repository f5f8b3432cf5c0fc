"""Kinds of detection failure, after TIDE (Bolya et al. 2020, "TIDE: A General Toolbox for Identifying Object
Detection Errors"), and what does not count as one.

An object is detected where a detection of its class overlaps its label, or the box of its visible part, with an
IoU of at least 0.5: no detector can frame what stands behind a van. An object that is detected before a change and
not after it is one failure, even if something else is reported in its place. A phantom lies on nothing at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.types import Detections, Targets
from drivesem.failures.grades import Kind

MATCH_IOU = 0.5
"""Minimum IoU of a detection and its object; minimum share of a detection on an ignored region that excuses it."""
BACKGROUND_IOU = 0.1
"""Maximum IoU of a detection that lies on nothing (TIDE's background threshold)."""
SAME_PLACE_IOU = 0.3
"""Minimum IoU of two detections of about the same place."""
SUSPECT_SCORE_SHARE = 0.5
"""Share of t* from which a benign detection makes a place suspect before the change."""

OBJECT_KINDS = (Kind.MISSED, Kind.CLASS, Kind.PLACED)
"""Kinds of failure in which an object is not detected."""


@dataclass(frozen=True, slots=True)
class LabelledDetections:
    """Labels and detections of one image, with class indices into the same list."""

    targets: Targets
    """Labels of the M objects and ignored regions."""
    visible_xyxy: Tensor
    """(M, 4) px, box of the visible part of each target; zeros where unknown."""
    detections: Detections
    """What the detector reports."""


@dataclass(frozen=True, slots=True)
class DetectionOutcome:
    """Labelled detections, matched at one score threshold."""

    detected: Tensor
    """(M,) bool, targets that are detected."""
    misreports: dict[int, tuple[Kind, int]]
    """By undetected target: the kind of failure and the detection that explains it, if there is one."""
    duplicates: dict[int, int]
    """By detected target: the first detection that reports it again."""
    background: tuple[int, ...]
    """Detections on nothing, by descending score, one per place."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One failure of one kind."""

    kind: Kind
    """What went wrong."""
    target: int
    """Index of the object; -1 for background."""
    detection: int
    """Index of the wrong detection in the changed image; -1 where there is none."""


def match_ious(labelled: LabelledDetections) -> Tensor:
    """(D, M) in [0, 1]: the larger IoU of each detection with each target's label and with its visible part."""
    detected_xyxy = labelled.detections.boxes_xyxy
    label_ious = boxes.iou_matrix(detected_xyxy, labelled.targets.boxes_xyxy.to(detected_xyxy))
    return torch.maximum(label_ious, boxes.iou_matrix(detected_xyxy, labelled.visible_xyxy.to(detected_xyxy)))


def match_detections(labelled: LabelledDetections, threshold: float) -> DetectionOutcome:
    """Match detections of at least that score to targets of their class, then classify the unmatched ones.

    Detections match by descending score, each to the free target with the largest IoU.
    """
    detections, targets = labelled.detections, labelled.targets
    ious = match_ious(labelled)
    same_class = detections.labels[:, None] == targets.labels.to(detections.labels)[None]
    counts = ~targets.ignore.to(detections.labels.device)
    order = [
        d for d in torch.argsort(detections.scores, descending=True, stable=True).tolist()
        if float(detections.scores[d]) >= threshold
    ]  # fmt: skip
    rows, own_class, counted = ious.tolist(), same_class.tolist(), counts.tolist()
    detected = [False] * len(targets)
    unmatched = []
    for d in order:
        free = [
            (rows[d][t], -t)
            for t in range(len(detected))
            if counted[t] and own_class[d][t] and not detected[t] and rows[d][t] >= MATCH_IOU
        ]
        if free:
            detected[-max(free)[1]] = True
        else:
            unmatched.append(d)
    excused = _lies_on_ignored(labelled, ious, counts)
    on_object = _lies_on_object(labelled, counts)
    misreports: dict[int, tuple[Kind, int]] = {}
    duplicates: dict[int, int] = {}
    background: list[int] = []
    for d in unmatched:
        if excused[d]:
            continue
        candidates = [(rows[d][t], -t) for t in range(len(detected)) if counted[t]]
        best, negative_target = max(candidates, default=(0.0, 0))
        target = -negative_target
        if best < BACKGROUND_IOU:
            if not on_object[d]:
                background.append(d)
        elif best >= MATCH_IOU and detected[target]:
            duplicates.setdefault(target, d)
        elif best >= MATCH_IOU:
            # A detection of the target's own class would have matched. Another class explains more than a bad box;
            # of two detections of a kind, the first has the higher score.
            if target not in misreports or misreports[target][0] is not Kind.CLASS:
                misreports[target] = Kind.CLASS, d
        elif own_class[d][target] and not detected[target]:
            misreports.setdefault(target, (Kind.PLACED, d))
    places = tuple(_suppress_same_place(detections.boxes_xyxy, background))
    return DetectionOutcome(torch.tensor(detected, dtype=torch.bool), misreports, duplicates, places)


def find_faults(
    benign: LabelledDetections, changed: LabelledDetections, threshold: float, reference_xyxy: Tensor | None = None
) -> tuple[Fault, ...]:
    """List what was right in the benign image and is wrong in the changed one: objects first, then background.

    Objects that are ignored after the change are no failures. A detection is no background fault where the benign
    image has a detection of any class at half the threshold, or where a reference detector sees an object.

    Args:
        benign: Image before the change.
        changed: Image after it; its i-th target is the same object as the i-th benign one.
        threshold: Minimum score of a detection.
        reference_xyxy: (K, 4) px, objects that a reference detector sees in the photograph.

    Raises:
        ValueError: The numbers of targets differ.
    """
    if len(benign.targets) != len(changed.targets):
        raise ValueError(
            f"targets: expected the {len(benign.targets)} benign objects, found {len(changed.targets)}"
        )
    before, after = match_detections(benign, threshold), match_detections(changed, threshold)
    faults: list[Fault] = []
    for target in range(len(changed.targets)):
        if bool(changed.targets.ignore[target]) or not bool(before.detected[target]):
            continue
        if not bool(after.detected[target]):
            kind, detection = after.misreports.get(target, (Kind.MISSED, -1))
            faults.append(Fault(kind, target, detection))
        elif target in after.duplicates and target not in before.duplicates:
            faults.append(Fault(Kind.TWICE, target, after.duplicates[target]))
    known = benign.detections.boxes_xyxy[benign.detections.scores >= SUSPECT_SCORE_SHARE * threshold]
    if reference_xyxy is not None:
        known = torch.cat([known, reference_xyxy.to(known)])
    is_new = ~(boxes.iou_matrix(changed.detections.boxes_xyxy, known) >= SAME_PLACE_IOU).any(dim=1)
    faults += [Fault(Kind.BACKGROUND, -1, d) for d in after.background if bool(is_new[d])]
    return tuple(faults)


def find_same_fault(
    faults: Sequence[Fault], fault: Fault, place_xyxy: Tensor, detections: Detections
) -> Fault | None:
    """Find the fault of the same object and kind; on background, of the same place.

    Args:
        faults: Faults of another image.
        fault: The fault to look for.
        place_xyxy: (4,) px, its place; used on background.
        detections: Detections of the other image.
    """
    for other in faults:
        if (other.kind, other.target) != (fault.kind, fault.target):
            continue
        box = detections.boxes_xyxy[other.detection]
        if fault.kind is not Kind.BACKGROUND or float(boxes.iou_matrix(place_xyxy[None].to(box), box[None])) >= (
            SAME_PLACE_IOU
        ):
            return other
    return None


def _lies_on_ignored(labelled: LabelledDetections, ious: Tensor, counts: Tensor) -> list[bool]:
    """(D,): detections of any class on ignored targets, which may be right or wrong."""
    detected_xyxy = labelled.detections.boxes_xyxy
    inside = boxes.ioa_matrix(detected_xyxy, labelled.targets.boxes_xyxy.to(detected_xyxy)) >= MATCH_IOU
    return ((inside | (ious >= BACKGROUND_IOU)) & ~counts[None]).any(dim=1).tolist()


def _lies_on_object(labelled: LabelledDetections, counts: Tensor) -> list[bool]:
    """(D,): detections that lie mostly on an object, even if they frame only a small part of it."""
    detected_xyxy = labelled.detections.boxes_xyxy
    inside = boxes.ioa_matrix(detected_xyxy, labelled.targets.boxes_xyxy.to(detected_xyxy)) >= MATCH_IOU
    return (inside & counts[None]).any(dim=1).tolist()


def _suppress_same_place(boxes_xyxy: Tensor, order: list[int]) -> Iterator[int]:
    """Yield those of the ordered detections that no earlier one overlaps; boxes without an area are skipped."""
    chosen: list[int] = []
    for d in order:
        box = boxes_xyxy[d : d + 1]
        if float(boxes.area(box)) > 0 and not bool(
            (boxes.iou_matrix(box, boxes_xyxy[chosen]) >= SAME_PLACE_IOU).any()
        ):
            chosen.append(d)
            yield d
