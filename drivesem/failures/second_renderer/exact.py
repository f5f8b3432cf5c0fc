"""Labels of two pictures of one street, before and after a change, by the generator's own geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from detectors.types import CLASSES, Targets
from drivesem.attack.labels import Difficulty
from drivesem.data.classes import VEHICLES
from drivesem.synth.frames import SynthFrame, Truth, table


@dataclass(frozen=True, slots=True)
class Exact:
    """The generator's labels before and after the change; row i of both is the same object. tracks: of the first
    rows; the others are regions in which no detection counts."""

    benign: Targets
    changed: Targets
    tracks: tuple[int, ...]


def exact_labels(before: SynthFrame, after: SynthFrame, difficulty: Difficulty | None = None) -> Exact:
    """Labels of the vehicles that are labelled before the change, by geometry.

    Ignored are those too hard before or after it. Regions, of both pictures: what the generator ignores, people,
    and vehicles that only the change brought into view.
    """
    difficulty = difficulty or Difficulty()
    first = {t.actor.track: t for t in before.truths if t.labelled and t.actor.label in VEHICLES}
    then = {t.actor.track: t for t in after.truths if t.actor.label in VEHICLES}
    regions = torch.cat(
        [
            *(_regions(frame) for frame in (before, after)),
            _boxes([t for track, t in then.items() if track not in first and t.labelled]),
        ]
    )
    ignore = [_too_hard(t, difficulty) or _too_hard(then.get(track), difficulty) for track, t in first.items()]
    count = len(CLASSES)
    labels = torch.cat(
        [
            torch.tensor([int(VEHICLES[t.actor.label]) for t in first.values()], dtype=torch.int64),
            torch.arange(count).repeat(len(regions)),
        ]
    )
    ignored = torch.tensor([*ignore, *[True] * (count * len(regions))], dtype=torch.bool)
    around = regions.repeat_interleave(count, dim=0)
    # What left the picture has no box, and is ignored.
    moved = [then[track].box_xyxy if track in then else np.zeros(4) for track in first]
    return Exact(
        Targets(torch.cat([_boxes(list(first.values())), around]), labels, ignored),
        Targets(torch.cat([table(moved, 4), around]), labels, ignored),
        tuple(first),
    )


def _boxes(truths: Sequence[Truth]) -> Tensor:
    return table([t.box_xyxy for t in truths], 4)


def _regions(frame: SynthFrame) -> Tensor:
    people = [t for t in frame.truths if t.labelled and t.actor.label not in VEHICLES]
    return torch.cat([frame.labels.ignore_xyxy, _boxes(people)])


def _too_hard(truth: Truth | None, difficulty: Difficulty) -> bool:
    if truth is None or not truth.labelled:
        return True
    height = truth.box_xyxy[3] - truth.box_xyxy[1]
    return bool(
        height < difficulty.min_height_px
        or truth.occlusion > difficulty.max_occlusion
        or truth.truncation > difficulty.max_truncation
    )
