"""Layouts by name: who reads and writes their data sets, and who writes their labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from drivesem.data import coco, fiftyone, kitti, vkitti1, vkitti2, yolo
from drivesem.data.label_table import LabelTable, Written
from drivesem.data.layouts import LAYOUTS, layout_of
from drivesem.data.truth import Exposure, Place
from drivesem.data.virtual import VirtualDataset
from drivesem.store import place
from scene_ir.errors import FormatError, RangeError
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
    "coco": coco.CocoDataset,
    "kitti": kitti.KittiDataset,
    "vkitti1": vkitti1.Vkitti1Dataset,
    "vkitti2": vkitti2.Vkitti2Dataset,
    "yolo": yolo.YoloDataset,
}
"""Readers by the name that the command line takes."""
WRITERS: dict[str, Callable[[Path], Writer]] = {
    "vkitti2": vkitti2.Vkitti2Writer,
    "vkitti1": vkitti1.Vkitti1Writer,
    "kitti": kitti.KittiWriter,
    "coco": coco.CocoWriter,
    "yolo": yolo.YoloWriter,
}
"""Writers by the name of their layout."""


_TABLE_WRITERS: dict[str, Callable[[LabelTable, Path, Mapping[str, Path]], Written]] = {
    "kitti": kitti.write_table,
    "coco": coco.write_table,
    "yolo": yolo.write_table,
    "vkitti1": vkitti1.write_table,
    "vkitti2": vkitti2.write_table,
}
_WRITTEN_ONLY: dict[str, Callable[[LabelTable, Path, Mapping[str, Path]], Written]] = {
    "fiftyone": fiftyone.write_table
}


def open_dataset(name: str, root: Path | str, with_points: bool = False, focal_px: float | None = None) -> Dataset:
    """The data set `name` under `root`, a folder or its URL. with_points: read laser points too, which only KITTI
    has. focal_px: of photographs in COCO's and YOLO's layouts that tell no camera.

    RangeError for an unknown name, or one without points; FormatError for a bad folder; UsageError for a URL that
    cannot be read.
    """
    if name not in DATASETS:
        raise RangeError("dataset", f"one of {', '.join(sorted(DATASETS))}", name)
    if with_points:
        if name != "kitti":
            raise RangeError("dataset with points", "kitti", name)
        return kitti.KittiDataset(place(root), with_points=True)
    folder = place(root)
    if not folder.exists():
        raise FormatError(str(root), f"the folder of a data set ({name}: {_HOLDS[name]})", "nothing there")
    try:
        if name in ("coco", "yolo"):
            return (coco.CocoDataset if name == "coco" else yolo.YoloDataset)(folder, focal_px=focal_px)
        return DATASETS[name](folder)
    except FormatError as error:
        other = _looks_like(folder)
        if other in (None, name):
            raise
        found = f"{error.actual}; it looks like {other} (--dataset {other})"
        raise FormatError(error.field, error.expected, found) from error


_HOLDS = {
    "coco": "annotations/instances_*.json, or such a file itself",
    "kitti": "training/image_2, label_2 and calib",
    "vkitti1": "vkitti_1.3.1_rgb and its kin",
    "vkitti2": "Scene01 and its kin",
    "yolo": "data.yaml, or such a file itself",
}
"""What lies in a data set's folder."""


def _looks_like(folder: Path) -> str | None:
    try:
        return layout_of(folder)
    except FormatError:
        return None


def write_table(table: LabelTable, out: Path, layout: str, images: Mapping[str, Path]) -> Written:
    """Write labels, or detections where they have scores. images: identifier -> file to copy; empty: none.

    out: a folder, or a .json file for COCO. Numbers are written so that they read back as they were; sums of
    decimals are rounded to 1e-9 px. FormatError for what the layout cannot do without.
    """
    return (_TABLE_WRITERS | _WRITTEN_ONLY)[layout](table, out, images)


def images_beside(path: Path, layout: str, frames: Sequence[str]) -> dict[str, Path]:
    """The images of labels, where they are in their layout's own place; those of a run lie elsewhere."""
    if layout not in LAYOUTS:
        return {}
    if layout in ("kitti", "coco"):
        return (kitti if layout == "kitti" else coco).images_beside(path, frames)
    dataset = DATASETS[layout](path)
    assert isinstance(dataset, (VirtualDataset, yolo.YoloDataset))
    return {name: dataset.image_path(name) for name in frames}
