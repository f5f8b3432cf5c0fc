"""Data sets by name: who reads them, and who writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from drivesem.data.coco import CocoDataset, CocoWriter
from drivesem.data.kitti import KittiDataset, KittiWriter
from drivesem.data.truth import Exposure, Place
from drivesem.data.vkitti1 import Vkitti1Dataset, Vkitti1Writer
from drivesem.data.vkitti2 import Vkitti2Dataset, Vkitti2Writer
from drivesem.data.yolo import YoloDataset, YoloWriter
from scene_ir.errors import RangeError
from scene_ir.types import Frame, Labels


class Dataset(Protocol):
    """What every reader offers: frames by identifier, in a fixed order."""

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        ...

    def labels(self, identifier: str) -> Labels | None:
        """The labels of one frame, without decoding its image; None where the data set has none."""
        ...

    def frame(self, identifier: str) -> Frame:
        """One frame. FormatError naming the file where something is wrong with it."""
        ...


class Writer(Protocol):
    """What every writer offers. Made in every worker process; between frames it knows nothing."""

    def exists(self, place: Place) -> bool:
        """Whether the frame's own files are there, whole."""
        ...

    def write(self, place: Place, exposure: Exposure) -> dict[str, object]:
        """Write the frame's own files, each atomically, its image last; the entry, as JSON, is for `finish`."""
        ...

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write what frames share, from the entries of all frames in the order of `Place.number`."""
        ...


DATASETS: dict[str, Callable[[Path], Dataset]] = {
    "coco": CocoDataset,
    "kitti": KittiDataset,
    "vkitti1": Vkitti1Dataset,
    "vkitti2": Vkitti2Dataset,
    "yolo": YoloDataset,
}
"""Readers by the name that the command line takes."""
WRITERS: dict[str, Callable[[Path], Writer]] = {
    "vkitti2": Vkitti2Writer,
    "vkitti1": Vkitti1Writer,
    "kitti": KittiWriter,
    "coco": CocoWriter,
    "yolo": YoloWriter,
}
"""Writers by the name of their layout."""


def open_dataset(name: str, root: Path | str, with_points: bool = False) -> Dataset:
    """The data set `name` under `root`. with_points: read laser points too, which only KITTI has.

    RangeError for an unknown name, or one without points; FormatError for a bad folder.
    """
    if name not in DATASETS:
        raise RangeError("dataset", f"one of {', '.join(sorted(DATASETS))}", name)
    if with_points:
        if name != "kitti":
            raise RangeError("dataset with points", "kitti", name)
        return KittiDataset(Path(root), with_points=True)
    return DATASETS[name](Path(root))
