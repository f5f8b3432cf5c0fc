"""Frames of any data set for training, decoded once, and the labels to train on and to evaluate by."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from detectors.anchors import fit_anchors, target_sizes
from detectors.squeezedet import ANCHOR_SIZES_WH
from detectors.training import Sample
from detectors.types import CLASSES, Targets
from drivesem.attack.labels import Difficulty
from drivesem.data.classes import CLASS_OF_TYPE, IGNORED_TYPES, select_road_users
from drivesem.data.registry import Dataset
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8
from scene_ir.types import Labels

PIXELS, INDEX = "pixels.u8", "index.json"
_COMPARED_FRAMES = 5
"""Number of frames, up to twice as many, that are compared to check a cache."""


class FrameStore(Sequence[Sample]):
    """Frames with their labels; the decoded pixels lie in one memory-mapped file.

    New frames of a data set are appended to the file; a data set with other images is decoded again.
    """

    def __init__(
        self,
        dataset: Dataset,
        names: Iterable[str],
        cache: Path,
        classes: Sequence[str],
        done: Callable[[], object] | None = None,
    ) -> None:
        """Decode frames that are not in the cache.

        Args:
            dataset: The data set.
            names: Frames to use.
            cache: Folder of the decoded pixels.
            classes: Names of the classes.
            done: Called after each frame.

        Raises:
            FormatError: A frame cannot be read or has no labels.
            WriteError: The cache cannot be written.
        """
        chosen = list(names)
        index = _known(cache, dataset, chosen)
        end = sum(height * width * 3 for _, height, width in index.values())
        with files.name_write_errors(cache / PIXELS):
            cache.mkdir(parents=True, exist_ok=True)
            with (cache / PIXELS).open("r+b" if (cache / PIXELS).is_file() else "w+b") as file:
                file.truncate(end)
                file.seek(end)
                for name in chosen:
                    if name not in index:
                        image = to_uint8(dataset.frame(name).photograph)
                        file.write(image.tobytes())
                        index[name] = (end, image.shape[0], image.shape[1])
                        end += image.size
                    if done is not None:
                        done()
        rows = [(name, *place) for name, place in index.items()]
        files.write_text(cache / INDEX, json.dumps(rows))
        self.dataset, self.classes = dataset, tuple(classes)
        self.names = tuple(chosen)
        self._places = [index[name] for name in chosen]
        self._pixels = np.memmap(cache / PIXELS, np.uint8, "r", shape=(max(end, 1),)) if end else np.zeros(0, "u1")
        self.labels = [_labels(dataset, name) for name in chosen]
        trained = adapt_limits(TRAINING_LIMITS, self.labels)
        self._targets = [training_targets(labels, trained, self.classes) for labels in self.labels]

    def __len__(self) -> int:
        return len(self.names)

    def image(self, index: int) -> np.ndarray:
        """Pixels (H, W, 3) uint8 RGB."""
        start, height, width = self._places[index]
        return self._pixels[start : start + height * width * 3].reshape(height, width, 3)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.image(index), self._targets[index]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all pixels, hexadecimal."""
        known = hashlib.sha256()
        for index in range(len(self)):
            known.update(self.image(index).tobytes())
        return known.hexdigest()

    def object_count(self) -> int:
        """Number of objects to train on."""
        return sum(int((~targets.ignore).sum()) for targets in self._targets)

    def fit_anchors(self, seed: int) -> tuple[tuple[float, float], ...]:
        """Fit as many anchors as SqueezeDet's published ones to the objects' sizes by k-means. Raises ValueError
        for too few different sizes.
        """
        sizes = np.concatenate([target_sizes(targets) for targets in self._targets])
        return fit_anchors(sizes, len(ANCHOR_SIZES_WH), seed).sizes_wh

    def evaluation_targets(self, difficulty: Difficulty) -> list[Targets]:
        """Labels to evaluate by, for each frame."""
        limits = adapt_limits(difficulty, self.labels)
        return [evaluation_targets(labels, limits, self.classes) for labels in self.labels]


def _known(cache: Path, dataset: Dataset, names: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Offset, height and width of each frame in a cache. Empty where its pixels are not the data set's: another
    folder's frames may have the same names.
    """
    if not (cache / INDEX).is_file() or not (cache / PIXELS).is_file():
        return {}
    index = {name: (start, height, width) for name, start, height, width in files.read_json(cache / INDEX)}
    shared = [name for name in names if name in index]
    # From the last one backwards: inserting or removing a numbered frame shifts all later names.
    for name in shared[:: -max(len(shared) // _COMPARED_FRAMES, 1)]:
        start, height, width = index[name]
        image = to_uint8(dataset.frame(name).photograph)
        cached = np.fromfile(cache / PIXELS, np.uint8, image.size, offset=start)
        if image.shape[:2] != (height, width) or not np.array_equal(cached, image.reshape(-1)):
            with files.name_write_errors(cache / INDEX):
                (cache / INDEX).unlink()  # before its pixels: the process may be killed in between
            return {}
    return index


def _labels(dataset: Dataset, name: str) -> Labels:
    labels = dataset.labels(name)
    if labels is None:
        raise FormatError(f"frame {name}", "labels", "none")
    return labels


OCCLUSION_UNKNOWN = 3
"""KITTI's code of an unknown occlusion."""

TRAINING_LIMITS = Difficulty(min_height_px=12.0, max_occlusion=OCCLUSION_UNKNOWN - 1, max_truncation=1.0)
"""Limits of training objects: high enough for a 16 px grid, and not known to be fully occluded."""


def adapt_limits(difficulty: Difficulty, labels: Iterable[Labels]) -> Difficulty:
    """Drop the limit on occlusion where a data set never states it."""
    if any(bool((one.occlusion != OCCLUSION_UNKNOWN).any()) for one in labels):
        return difficulty
    return replace(difficulty, max_occlusion=OCCLUSION_UNKNOWN)


def training_targets(labels: Labels, difficulty: Difficulty, classes: Sequence[str]) -> Targets:
    """Convert labels to training targets. Too hard objects and regions are ignored; objects of other classes, and
    types that are no road users, are background.

    Args:
        labels: Labels of a frame.
        difficulty: Limits of the objects.
        classes: Names of the classes.
    """
    labels = select_road_users(labels)
    targets = make_targets(labels)
    ignore = targets.ignore.clone()
    ignore[: len(labels.kind)] |= _too_hard(labels, difficulty)
    own = _places(classes)[targets.labels]
    chosen = (own >= 0) | ignore
    return Targets(targets.boxes_xyxy[chosen], own[chosen].clamp_min(0), ignore[chosen])


def evaluation_targets(labels: Labels, difficulty: Difficulty, classes: Sequence[str]) -> Targets:
    """Convert labels to evaluation targets. Too hard objects, objects of other classes, and regions are ignored for
    every class; types that are no road users are background.

    Args:
        labels: Labels of a frame.
        difficulty: Limits of the objects.
        classes: Names of the classes.
    """
    labels = select_road_users(labels)
    named = make_targets(labels)
    ignore = named.ignore.clone()
    ignore[: len(labels.kind)] |= _too_hard(labels, difficulty)
    own = _places(classes)[named.labels]
    # too hard objects, neighbours of a class, and regions are ignored for every class
    every = ignore | (own < 0)
    rows = torch.cat([torch.arange(len(ignore))[~every], torch.arange(len(ignore))[every].repeat(len(classes))])
    label = torch.cat([own[~every], torch.arange(len(classes)).repeat_interleave(int(every.sum()))])
    left_out = torch.ones(int(every.sum()) * len(classes), dtype=torch.bool)
    return Targets(named.boxes_xyxy[rows], label, torch.cat([ignore[~every], left_out]))


def make_targets(labels: Labels) -> Targets:
    """Return the targets of road users (see `select_road_users`) in file order, then of DontCare regions.

    Targets that are ignored for every class have the label 0. Objects with boxes without area are ignored, since no
    detection can match them.
    """
    names = [CLASS_OF_TYPE.get(kind) or IGNORED_TYPES[kind] for kind in labels.kind]
    index = [0 if name is None else CLASSES.index(name) for name in names]
    regions = labels.ignore_xyxy.shape[0]
    flat = (labels.boxes_xyxy[:, 2:] <= labels.boxes_xyxy[:, :2]).any(dim=1).tolist()
    ignored = [kind in IGNORED_TYPES or thin for kind, thin in zip(labels.kind, flat, strict=True)]
    return Targets(
        boxes_xyxy=torch.cat([labels.boxes_xyxy, labels.ignore_xyxy]),
        labels=torch.tensor([*index, *[0] * regions], dtype=torch.int64),
        ignore=torch.tensor([*ignored, *[True] * regions], dtype=torch.bool),
    )


def _too_hard(labels: Labels, difficulty: Difficulty) -> torch.Tensor:
    """(N,) bool. An unknown truncation (NaN) does not exclude an object."""
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    return (
        (height < difficulty.min_height_px)
        | (labels.occlusion > difficulty.max_occlusion)
        | (labels.truncation > difficulty.max_truncation)
    )


def _places(classes: Sequence[str]) -> torch.Tensor:
    """Index of each of `CLASSES` in `classes`; -1 where it is missing."""
    return torch.tensor([classes.index(name) if name in classes else -1 for name in CLASSES])
