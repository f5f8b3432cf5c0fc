"""A data set as MAITE's `FieldwiseDataset`, with the objects that `drivesem eval` evaluates.

```pycon
>>> import drivesem as ds
>>> data = ds.MaiteDataset(ds.open_dataset("kitti", "PATH_TO_KITTI"))
>>> image, target, metadata = data[0]
>>> image.dtype, image.shape[0], target.boxes.shape[1], sorted(metadata)
(dtype('uint8'), 3, 4, ['id', 'ignored_boxes'])

```
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from detectors.adapters.maite import MaiteTarget
from detectors.types import CLASSES, Targets
from drivesem.attacks.labels import Difficulty
from drivesem.config.commands import EvalConfig
from drivesem.scenes.scene import Frames
from drivesem.training.frames import adapt_limits, evaluation_targets
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8
from scene_ir.types import Labels

Metadata: TypeAlias = dict[str, Any]
"""Metadata of an image: `id`, and what else is known."""
IGNORED_BOXES = "ignored_boxes"
"""Key of the boxes [x0, y0, x1, y1] px in which no detection counts: objects that are too hard, and regions."""


class MaiteDataset:
    """The frames of a data set as MAITE's images, targets and metadata.

    `metadata` has `id` and `index2label`, the classes Car, Truck, Pedestrian and Cyclist.
    """

    def __init__(
        self,
        frames: Frames,
        *,
        min_height: float = EvalConfig.min_height,
        max_occlusion: int = EvalConfig.max_occlusion,
        max_truncation: float = EvalConfig.max_truncation,
        name: str = "drivesem",
    ) -> None:
        """Wrap a data set.

        Args:
            frames: The data set, from `ds.open_dataset`.
            min_height: Lowest height of an object that counts, px; as of `drivesem eval`.
            max_occlusion: Highest occlusion level of KITTI that counts, 0 to 3.
            max_truncation: Largest share outside of the picture that counts, in [0, 1].
            name: The `id` of the data set.

        Raises:
            FormatError: A frame has no labels.
        """
        self.frames = frames
        self.metadata: Metadata = {"id": name, "index2label": dict(enumerate(CLASSES))}
        limits = Difficulty(min_height, max_occlusion, max_truncation)
        self._limits = adapt_limits(limits, map(self._labels, range(len(frames))))

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int, /) -> tuple[NDArray[np.uint8], MaiteTarget, Metadata]:
        """Image, target and metadata of a frame. Raises IndexError beyond the last one."""
        return self.get_input(index), self.get_target(index), self.get_metadata(index)

    def get_input(self, index: int, /) -> NDArray[np.uint8]:
        """The image (3, H, W), RGB."""
        return np.ascontiguousarray(to_uint8(self.frames[self.frames.names[index]].photograph).transpose(2, 0, 1))

    def get_target(self, index: int, /) -> MaiteTarget:
        """The objects that count, with a score of 1."""
        targets = self._targets(index)
        counted = ~targets.ignore.numpy()
        labels = targets.labels.numpy()[counted]
        return MaiteTarget(targets.boxes_xyxy.numpy()[counted], labels, np.ones(len(labels), np.float32))

    def get_metadata(self, index: int, /) -> Metadata:
        """The frame's `id`, what the data set states of it (weather, ...), and `IGNORED_BOXES`."""
        name, targets = self.frames.names[index], self._targets(index)
        ignored = targets.boxes_xyxy[targets.ignore & (targets.labels == 0)]  # each has a row for every class
        return {**self.frames.dataset.attributes(name), "id": name, IGNORED_BOXES: ignored.tolist()}

    def _targets(self, index: int) -> Targets:
        return evaluation_targets(self._labels(index), self._limits, CLASSES)

    def _labels(self, index: int) -> Labels:
        name = self.frames.names[index]
        labels = self.frames.dataset.labels(name)
        if labels is None:
            raise FormatError(f"frame {name}", "labels", "none")
        return labels
