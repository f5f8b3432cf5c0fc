"""Which labelled objects a detector is trained on, and which it is judged by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch

from detectors.types import CLASSES, Targets
from drivesem.attack.labels import Difficulty
from drivesem.data.classes import ROAD_USERS
from scene_ir.types import Labels

OCCLUSION_UNKNOWN = 3
"""KITTI's code for it."""

TRAINED = Difficulty(min_height_px=12.0, max_occlusion=OCCLUSION_UNKNOWN - 1, max_truncation=1.0)
"""What is trained on: all that is high enough for a 16 px grid and not known to be hidden altogether."""


def suited(difficulty: Difficulty, labels: Iterable[Labels]) -> Difficulty:
    """The difficulty without its limit on occlusion where a data set never says how occluded an object is."""
    if any(bool((one.occlusion != OCCLUSION_UNKNOWN).any()) for one in labels):
        return difficulty
    return replace(difficulty, max_occlusion=OCCLUSION_UNKNOWN)


def training_targets(labels: Labels, difficulty: Difficulty, classes: Sequence[str]) -> Targets:
    """Targets among `classes`; too hard objects and regions are ignored, objects of other classes left out.
    So are types that are no road users: they are background.
    """
    labels = ROAD_USERS.known(labels)
    targets = ROAD_USERS.targets(labels)
    ignore = targets.ignore.clone()
    ignore[: len(labels.kind)] |= _too_hard(labels, difficulty)
    own = _places(classes)[targets.labels]
    kept = (own >= 0) | ignore
    return Targets(targets.boxes_xyxy[kept], own[kept].clamp_min(0), ignore[kept])


def judged_targets(labels: Labels, difficulty: Difficulty, classes: Sequence[str]) -> Targets:
    """What is judged, with labels among `classes`. Too hard objects, those of other classes, and regions are
    ignored, for each of the classes. Types that are no road users are background.
    """
    labels = ROAD_USERS.known(labels)
    named = ROAD_USERS.targets(labels)
    ignore = named.ignore.clone()
    ignore[: len(labels.kind)] |= _too_hard(labels, difficulty)
    own = _places(classes)[named.labels]
    # an object of its own class that is not judged, a neighbour of a class, or a region: said for every class
    every = ignore | (own < 0)
    rows = torch.cat([torch.arange(len(ignore))[~every], torch.arange(len(ignore))[every].repeat(len(classes))])
    label = torch.cat([own[~every], torch.arange(len(classes)).repeat_interleave(int(every.sum()))])
    left_out = torch.ones(int(every.sum()) * len(classes), dtype=torch.bool)
    return Targets(named.boxes_xyxy[rows], label, torch.cat([ignore[~every], left_out]))


def _too_hard(labels: Labels, difficulty: Difficulty) -> torch.Tensor:
    """(N,) bool. An unknown truncation (NaN) is no reason to leave an object out."""
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    return (
        (height < difficulty.min_height_px)
        | (labels.occlusion > difficulty.max_occlusion)
        | (labels.truncation > difficulty.max_truncation)
    )


def _places(classes: Sequence[str]) -> torch.Tensor:
    """Where each of CLASSES stands among `classes`; -1 where it does not."""
    return torch.tensor([classes.index(name) if name in classes else -1 for name in CLASSES])
