"""Kinds of failure, as TIDE names them (Bolya et al. 2020, "TIDE: A General Toolbox for Identifying Object
Detection Errors"), and what is none.

An object is found where a detection of its class meets its label or the box of what shows of it, at an IoU of 0.5:
nobody can frame what stands behind a van. What is found before a change and not after it is one failure, whatever
else is reported in its place. A phantom lies on nothing at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.types import Detections, Targets
from drivesem.failures.grades import Kind

MEETS = 0.5
"""IoU from which a detection meets an object, and share of it on an ignored region that excuses it."""
TOUCHES = 0.1
"""IoU up to which a detection lies on nothing (TIDE's background threshold)."""
SAME_PLACE = 0.3
"""IoU from which two detections are about the same place."""
HALF = 0.5
"""Share of t* from which a benign detection tells that a place was suspect before the change."""


OF_OBJECTS = (Kind.MISSED, Kind.CLASS, Kind.PLACED)
"""Kinds of failure in which an object is not found."""


@dataclass(frozen=True, slots=True)
class View:
    """One picture: what is there, and what a detector reports. targets, detections: labels among the same names;
    shown_xyxy: (M, 4) px, the box of what shows of each target; zeros where it is not known.
    """

    targets: Targets
    shown_xyxy: Tensor
    detections: Detections


@dataclass(frozen=True, slots=True)
class Judged:
    """A view by one threshold. found: (M,) bool; instead: for targets that are not found, the kind and the
    detection that stands for it, if there is one; twice: by target that is found, the first detection that reports
    it again; background: detections on nothing, best first, one a place.
    """

    found: Tensor
    instead: dict[int, tuple[Kind, int]]
    twice: dict[int, int]
    background: tuple[int, ...]

    def kind_of(self, target: int) -> Kind:
        """Of a target that is not found."""
        return self.instead.get(target, (Kind.MISSED, -1))[0]


@dataclass(frozen=True, slots=True)
class Fault:
    """A failure of one kind. target: index of the object, -1 of background; detection: index in the changed view
    of what is reported wrongly, -1 where nothing is.
    """

    kind: Kind
    target: int
    detection: int


def meets(view: View) -> Tensor:
    """How well each detection meets each target, (D, M): the better IoU of its label and of what shows."""
    at = view.detections.boxes_xyxy
    label = boxes.iou_matrix(at, view.targets.boxes_xyxy.to(at))
    return torch.maximum(label, boxes.iou_matrix(at, view.shown_xyxy.to(at)))


def judge(view: View, threshold: float) -> Judged:
    """Match detections from that score on to the targets of their class, best score first, each to the free target
    that it meets best; then say what the others are.
    """
    detections, targets = view.detections, view.targets
    overlap = meets(view)
    same = detections.labels[:, None] == targets.labels.to(detections.labels)[None]
    counts = ~targets.ignore.to(detections.labels.device)
    order = [
        d for d in torch.argsort(detections.scores, descending=True, stable=True).tolist()
        if float(detections.scores[d]) >= threshold
    ]  # fmt: skip
    rows, own, counted = overlap.tolist(), same.tolist(), counts.tolist()
    found = [False] * len(targets)
    left = []
    for d in order:
        free = [
            (rows[d][t], -t)
            for t in range(len(found))
            if counted[t] and own[d][t] and not found[t] and rows[d][t] >= MEETS
        ]
        if free:
            found[-max(free)[1]] = True
        else:
            left.append(d)
    excused = _excused(view, overlap, counts)
    instead: dict[int, tuple[Kind, int]] = {}
    twice: dict[int, int] = {}
    nothing: list[int] = []
    on_something = _share_on(view, counts)
    for d in left:
        if excused[d]:
            continue
        candidates = [(rows[d][t], -t) for t in range(len(found)) if counted[t]]
        best, place = max(candidates, default=(0.0, 0))
        target = -place
        if best < TOUCHES:
            if not on_something[d]:
                nothing.append(d)
        elif best >= MEETS and found[target]:
            twice.setdefault(target, d)
        elif best >= MEETS:
            # Its own class would have found it.
            instead[target] = (Kind.CLASS, d) if target not in instead else _better(instead[target], Kind.CLASS, d)
        elif own[d][target] and not found[target]:
            instead.setdefault(target, (Kind.PLACED, d))
    return Judged(
        torch.tensor(found, dtype=torch.bool), instead, twice, tuple(_one_a_place(detections.boxes_xyxy, nothing))
    )


def find(benign: View, changed: View, threshold: float, seen_xyxy: Tensor | None = None) -> tuple[Fault, ...]:
    """What was right in the benign view and is wrong in the changed one: objects first, then background.

    The i-th targets of both are the same object. Objects that are ignored now are no failures. No background is
    where the benign view has a detection of any class at half the threshold, or where somebody else sees an object
    in the photograph. seen_xyxy: (K, 4) px, what else is seen there. Raises ValueError where the targets do not
    correspond.
    """
    if len(benign.targets) != len(changed.targets):
        raise ValueError(
            f"targets: expected the {len(benign.targets)} benign objects, found {len(changed.targets)}"
        )
    before, after = judge(benign, threshold), judge(changed, threshold)
    faults: list[Fault] = []
    for target in range(len(changed.targets)):
        if bool(changed.targets.ignore[target]) or not bool(before.found[target]):
            continue
        if not bool(after.found[target]):
            kind, detection = after.instead.get(target, (Kind.MISSED, -1))
            faults.append(Fault(kind, target, detection))
        elif target in after.twice and target not in before.twice:
            faults.append(Fault(Kind.TWICE, target, after.twice[target]))
    known = benign.detections.boxes_xyxy[benign.detections.scores >= HALF * threshold]
    if seen_xyxy is not None:
        known = torch.cat([known, seen_xyxy.to(known)])
    at = changed.detections.boxes_xyxy
    new = ~(boxes.iou_matrix(at, known) >= SAME_PLACE).any(dim=1)
    faults += [Fault(Kind.BACKGROUND, -1, d) for d in after.background if bool(new[d])]
    return tuple(faults)


def _better(known: tuple[Kind, int], kind: Kind, detection: int) -> tuple[Kind, int]:
    """Another class says more than a bad frame; of two of a kind the first, which has the better score."""
    return known if known[0] is kind else (kind, detection)


def _excused(view: View, overlap: Tensor, counts: Tensor) -> list[bool]:
    """(D,): detections on what is ignored, of whatever class: nobody knows whether they are right."""
    at, around = view.detections.boxes_xyxy, view.targets.boxes_xyxy.to(view.detections.boxes_xyxy)
    on = boxes.ioa_matrix(at, around) >= MEETS
    return ((on | (overlap >= TOUCHES)) & ~counts[None]).any(dim=1).tolist()


def _share_on(view: View, counts: Tensor) -> list[bool]:
    """(D,): detections that lie on an object for the most part, however little of it they frame."""
    at, around = view.detections.boxes_xyxy, view.targets.boxes_xyxy.to(view.detections.boxes_xyxy)
    return ((boxes.ioa_matrix(at, around) >= MEETS) & counts[None]).any(dim=1).tolist()


def _one_a_place(boxes_xyxy: Tensor, order: list[int]) -> Iterator[int]:
    """Of detections, best first, those that no better one lies on; boxes without an area lie nowhere."""
    kept: list[int] = []
    for d in order:
        here = boxes_xyxy[d : d + 1]
        if float(boxes.area(here)) > 0 and not bool(
            (boxes.iou_matrix(here, boxes_xyxy[kept]) >= SAME_PLACE).any()
        ):
            kept.append(d)
            yield d
