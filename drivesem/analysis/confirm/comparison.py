"""Compares failures and objects in the pictures of two renderers, each by its own labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.targets import EvaluatedClasses
from drivesem.evaluation import failures
from drivesem.failures.second_renderer.base import SecondRender
from drivesem.run.results import BoxRecord, FrameResult


@dataclass(frozen=True, slots=True)
class RendererFailure:
    """A failure in one of the two pictures."""

    kind: str
    """"lost" or "phantom"."""
    label: str
    """Class."""
    xyxy: tuple[float, float, float, float]
    """True box of a lost object, detected box of a phantom, px."""
    index: int | None
    """Number of the lost object; None for a phantom."""
    score: float | None
    """Score of a phantom, in [0, 1]."""
    survives: bool
    """Whether the other picture has it too: the same vehicle lost, or a phantom of the class at IoU >= 0.5."""


@dataclass(frozen=True, slots=True)
class ObjectComparison:
    """One of the scene's objects in both pictures."""

    index: int
    """Number of the object."""
    judged: bool
    """Whether it counts in the second renderer's picture of the change."""
    iou_benign: float | None
    """IoU of its two labels before the change; None if it is not visible."""
    iou: float | None
    """IoU of its two labels after the change; None if it is not visible."""


@dataclass(frozen=True, slots=True)
class ConfirmedFrame:
    """One frame, re-rendered with a second renderer."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    renderer: str
    """Name of the second renderer."""
    compositor: tuple[RendererFailure, ...]
    """Failures in the compositor's picture."""
    second: tuple[RendererFailure, ...]
    """Failures in the second renderer's picture."""
    objects: tuple[ObjectComparison, ...]
    """The scene's objects in both pictures."""
    targets_benign: tuple[BoxRecord, ...]
    """True boxes in the second renderer's picture before the change."""
    targets_changed: tuple[BoxRecord, ...]
    """True boxes in its picture after the change."""
    detections_benign: tuple[BoxRecord, ...]
    """Detections in its picture before the change."""
    detections_changed: tuple[BoxRecord, ...]
    """Detections in its picture after the change."""
    not_carried: tuple[str, ...]
    """Parts of the change that the second renderer cannot render."""
    seconds: float
    """Run time; the only field that may differ between two calls."""


@dataclass(frozen=True, slots=True)
class RendererTargets:
    """A second renderer's labels before and after the change, row by row: objects, then regions of both pictures.
    What is ignored in one picture is ignored in both.
    """

    benign: Targets
    """Before the change."""
    changed: Targets
    """After the change."""


def pair_targets(before: SecondRender, after: SecondRender, count: int) -> RendererTargets:
    """Align the labels of two renders of a scene.

    Args:
        before: Render before the change.
        after: Render after it.
        count: Number of objects.
    """
    first, second = before.targets, after.targets
    ignore = first.ignore[:count] | second.ignore[:count]
    regions = [targets.boxes_xyxy[count:] for targets in (first, second)]
    labels = [targets.labels[count:] for targets in (first, second)]

    def append_regions(own: Targets) -> Targets:
        all_regions = torch.cat(regions)
        return Targets(
            torch.cat([own.boxes_xyxy[:count], all_regions]),
            torch.cat([own.labels[:count], *labels]),
            torch.cat([ignore, torch.ones(len(all_regions), dtype=torch.bool)]),
        )

    return RendererTargets(append_regions(first), append_regions(second))


def compare_failures(
    result: FrameResult,
    targets: RendererTargets,
    detections: Sequence[Detections],
    classes: EvaluatedClasses,
    t_star: float,
) -> tuple[tuple[RendererFailure, ...], tuple[RendererFailure, ...]]:
    """Compare the failures in both renderers' pictures.

    Args:
        result: The run's result.
        targets: Labels of the second renderer.
        detections: Detections in its pictures, before and after the change.
        classes: The detector's evaluated classes.
        t_star: Score from which a detection counts.

    Returns:
        Failures in the compositor's picture, from the result, and in the second renderer's picture.
    """
    benign, changed = classes.map_targets(targets.benign), classes.map_targets(targets.changed)
    before, after = detections
    found = failures.find_failures(benign, before, changed, after, t_star)
    second = []
    for i in found.lost:
        label = CLASSES[int(targets.changed.labels[i])]
        second.append(RendererFailure("lost", label, _xyxy(changed.boxes_xyxy[i]), i, None, False))
    for i in found.phantoms:
        label, score = classes.names[int(after.labels[i])], float(after.scores[i])
        second.append(RendererFailure("phantom", label, _xyxy(after.boxes_xyxy[i]), None, score, False))
    compositor = [
        RendererFailure(f.kind, f.label, f.xyxy, f.index if f.kind == "lost" else None, f.score, False)
        for f in result.failures
    ]
    return _with_survival(compositor, second), _with_survival(second, compositor)


def _with_survival(
    own: Sequence[RendererFailure], others: Sequence[RendererFailure]
) -> tuple[RendererFailure, ...]:
    return tuple(
        dataclasses.replace(one, survives=any(_is_same_failure(one, other) for other in others)) for one in own
    )


def _is_same_failure(one: RendererFailure, other: RendererFailure) -> bool:
    if one.kind != other.kind:
        return False
    if one.kind == "lost":
        return one.index is not None and one.index == other.index
    return one.label == other.label and _iou(one.xyxy, other.xyxy) >= failures.MATCH_IOU


def compare_objects(result: FrameResult, targets: RendererTargets, count: int) -> tuple[ObjectComparison, ...]:
    """Compare the objects' boxes in both renderers' pictures.

    Args:
        result: The run's result.
        targets: Labels of the second renderer.
        count: Number of objects.
    """
    benign = {t.index: t.xyxy for t in result.targets_benign if t.index is not None}
    moved = {t.index: t.xyxy for t in result.targets_moved if t.index is not None}

    def label_iou(box: Sequence[float], others: Targets, i: int) -> float | None:
        other = others.boxes_xyxy[i]
        return _iou(box, _xyxy(other)) if float(boxes.area(other[None])) > 0 else None

    return tuple(
        ObjectComparison(
            i,
            not bool(targets.changed.ignore[i]),
            label_iou(benign[i], targets.benign, i),
            label_iou(moved[i], targets.changed, i),
        )
        for i in range(count)
    )


def _iou(one: Sequence[float], two: Sequence[float]) -> float:
    return float(boxes.iou_matrix(torch.tensor([one]), torch.tensor([two]))[0, 0])


def _xyxy(box: Tensor) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box.tolist()
    return x0, y0, x1, y1
