"""What counts as a failure in either renderer's picture, by the labels that each gives."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.judging import JudgedClasses
from drivesem.evaluation import failures
from drivesem.failures.second_renderer.base import Redrawn
from drivesem.run.results import FrameResult


@dataclass(frozen=True, slots=True)
class RendererFailure:
    """A failure in one of the two pictures. index: of the lost object in the scene; None for a phantom. survives:
    whether it is a failure in the other picture too: the same vehicle lost, or a phantom of the same class at an
    IoU of at least 0.5.
    """

    kind: str
    label: str
    xyxy: tuple[float, float, float, float]
    index: int | None
    score: float | None
    survives: bool


@dataclass(frozen=True, slots=True)
class Stand:
    """One of the scene's objects in both pictures. iou: of its moved label with the second renderer's; iou_benign:
    of the labels before the change; None where it cannot be seen. judged: whether it counts there, now.
    """

    index: int
    judged: bool
    iou_benign: float | None
    iou: float | None


@dataclass(frozen=True, slots=True)
class Rows:
    """A second renderer's labels before and after the change: the scene's objects in order, then regions of both
    pictures. What does not count in either picture is ignored in both.
    """

    benign: Targets
    changed: Targets


def rows_of(before: Redrawn, after: Redrawn, count: int) -> Rows:
    """The labels of two states of one scene with `count` objects, row by row."""
    first, then = before.targets, after.targets
    ignore = first.ignore[:count] | then.ignore[:count]
    regions = [targets.boxes_xyxy[count:] for targets in (first, then)]
    labels = [targets.labels[count:] for targets in (first, then)]

    def joined(own: Targets) -> Targets:
        around = torch.cat(regions)
        return Targets(
            torch.cat([own.boxes_xyxy[:count], around]),
            torch.cat([own.labels[:count], *labels]),
            torch.cat([ignore, torch.ones(len(around), dtype=torch.bool)]),
        )

    return Rows(joined(first), joined(then))


def findings(
    result: FrameResult, rows: Rows, seen: Sequence[Detections], judged: JudgedClasses, t_star: float
) -> tuple[tuple[RendererFailure, ...], tuple[RendererFailure, ...]]:
    """Failures in the compositor's picture, as the run has them, and in the second renderer's. seen: detections in
    the latter, before and after the change."""
    benign, changed = judged.targets(rows.benign), judged.targets(rows.changed)
    found = failures.find(benign, seen[0], changed, seen[1], t_star)
    after = seen[1]
    theirs = []
    for i in found.lost:
        label = CLASSES[int(rows.changed.labels[i])]
        theirs.append(RendererFailure("lost", label, _xyxy(changed.boxes_xyxy[i]), i, None, False))
    for i in found.phantoms:
        label, score = judged.names[int(after.labels[i])], float(after.scores[i])
        theirs.append(RendererFailure("phantom", label, _xyxy(after.boxes_xyxy[i]), None, score, False))
    ours = [
        RendererFailure(f.kind, f.label, f.xyxy, f.index if f.kind == "lost" else None, f.score, False)
        for f in result.failures
    ]
    return _with_survival(ours, theirs), _with_survival(theirs, ours)


def _with_survival(
    these: Sequence[RendererFailure], others: Sequence[RendererFailure]
) -> tuple[RendererFailure, ...]:
    return tuple(dataclasses.replace(one, survives=any(_same(one, other) for other in others)) for one in these)


def _same(one: RendererFailure, other: RendererFailure) -> bool:
    if one.kind != other.kind:
        return False
    if one.kind == "lost":
        return one.index is not None and one.index == other.index
    return one.label == other.label and _iou(one.xyxy, other.xyxy) >= failures.IOU


def stands(result: FrameResult, rows: Rows, count: int) -> tuple[Stand, ...]:
    """Where the scene's `count` objects stand in both pictures."""
    ours = {t.index: t.xyxy for t in result.targets_benign if t.index is not None}
    moved = {t.index: t.xyxy for t in result.targets_moved if t.index is not None}

    def iou(box: Sequence[float], targets: Targets, i: int) -> float | None:
        other = targets.boxes_xyxy[i]
        return _iou(box, _xyxy(other)) if float(boxes.area(other[None])) > 0 else None

    return tuple(
        Stand(i, not bool(rows.changed.ignore[i]), iou(ours[i], rows.benign, i), iou(moved[i], rows.changed, i))
        for i in range(count)
    )


def _iou(one: Sequence[float], two: Sequence[float]) -> float:
    return float(boxes.iou_matrix(torch.tensor([one]), torch.tensor([two]))[0, 0])


def _xyxy(box: Tensor) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box.tolist()
    return x0, y0, x1, y1
