"""What counts as a failure in either renderer's picture, by labels that the generator's geometry gives."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from detectors import boxes
from detectors.types import CLASSES, Detections
from drivesem.attack.judging import JudgedClasses
from drivesem.evaluation import failures
from drivesem.run.results import FrameResult
from drivesem.synth.frames import SynthFrame
from drivesem.truth.redraw.exact import Exact


@dataclass(frozen=True, slots=True)
class RendererFailure:
    """A failure in one of the two pictures. track: of the lost vehicle in the generator's plan; None for a
    phantom, and where the plan has no counterpart. survives: whether it is a failure in the other picture too: the
    same vehicle lost, or a phantom of the same class at an IoU of at least 0.5.
    """

    kind: str
    label: str
    xyxy: tuple[float, float, float, float]
    track: int | None
    score: float | None
    survives: bool


@dataclass(frozen=True, slots=True)
class Stand:
    """One of the scene's objects in both pictures. iou: of its moved label with the generator's box; iou_benign:
    of the boxes before the change; None where it cannot be seen. judged: whether its exact label counts, now.
    """

    index: int
    track: int
    judged: bool
    iou_benign: float | None
    iou: float | None


def findings(
    result: FrameResult,
    tracks: Sequence[int | None],
    exact: Exact,
    seen: Sequence[Detections],
    judged: JudgedClasses,
    t_star: float,
) -> tuple[tuple[RendererFailure, ...], tuple[RendererFailure, ...]]:
    """Failures in the compositor's picture, as the run has them, and in the generator's. seen: detections before
    and after the change; tracks: of the scene's objects."""
    benign, changed = judged.targets(exact.benign), judged.targets(exact.changed)
    found = failures.find(benign, seen[0], changed, seen[1], t_star)
    after = seen[1]
    theirs = []
    for i in found.lost:
        label = CLASSES[int(exact.changed.labels[i])]
        theirs.append(RendererFailure("lost", label, _xyxy(changed.boxes_xyxy[i]), exact.tracks[i], None, False))
    for i in found.phantoms:
        label, score = judged.names[int(after.labels[i])], float(after.scores[i])
        theirs.append(RendererFailure("phantom", label, _xyxy(after.boxes_xyxy[i]), None, score, False))
    ours = [
        RendererFailure(f.kind, f.label, f.xyxy, None if f.index is None else tracks[f.index], f.score, False)
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
        return one.track is not None and one.track == other.track
    return one.label == other.label and _iou(one.xyxy, other.xyxy) >= failures.IOU


def stands(
    result: FrameResult, tracks: Sequence[int | None], exact: Exact, before: SynthFrame, after: SynthFrame
) -> tuple[Stand, ...]:
    """Where the scene's objects stand in both pictures, those that have a counterpart."""
    first, then = ({t.actor.track: _xyxy(t.box_xyxy) for t in frame.truths} for frame in (before, after))
    ignored = dict(zip(exact.tracks, exact.changed.ignore.tolist(), strict=False))
    ours = {t.index: t.xyxy for t in result.targets_benign if t.index is not None}
    moved = {t.index: t.xyxy for t in result.targets_moved if t.index is not None}
    return tuple(
        Stand(
            index=i,
            track=track,
            judged=not ignored.get(track, True),
            iou_benign=_iou(ours[i], first[track]) if track in first else None,
            iou=_iou(moved[i], then[track]) if track in then else None,
        )
        for i, track in enumerate(tracks)
        if track is not None
    )


def _iou(one: Sequence[float], two: Sequence[float]) -> float:
    return float(boxes.iou_matrix(torch.tensor([one]), torch.tensor([two]))[0, 0])


def _xyxy(box: Tensor | np.ndarray) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box.tolist()
    return x0, y0, x1, y1
