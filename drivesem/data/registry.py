"""Data set layouts by name: their readers, writers, and writers of label tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from drivesem.data import bdd100k, coco, fiftyone, kitti, vkitti1, vkitti2, voc, yolo
from drivesem.data.account import DataAccount
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.label_table import LabelTable, WriteSummary
from drivesem.data.layouts import detect_layout
from drivesem.data.photograph_dataset import PhotographDataset
from drivesem.store import local_copy
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Frame, Labels


class Dataset(Protocol):
    """Interface of all readers: frames by identifier, in a fixed order."""

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        ...

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split, where the data set has splits."""
        ...

    def account(self) -> DataAccount:
        """Account for all files and label rows; reads all labels."""
        ...

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that the data set states of a frame, such as weather and timeofday."""
        ...

    def labels(self, identifier: str) -> Labels | None:
        """Read the labels of one frame without decoding its image; None where the data set has none."""
        ...

    def frame(self, identifier: str) -> Frame:
        """Read one frame. Raises FormatError naming a damaged file."""
        ...


class DatasetWriter(Protocol):
    """Interface of all writers. Each worker process makes one; it holds no state between frames."""

    def exists(self, location: FrameLocation) -> bool:
        """Whether the frame's own files exist, complete."""
        ...

    def write(self, location: FrameLocation, exposure: Exposure) -> dict[str, object]:
        """Write the frame's own files, each atomically, its image last. Returns its JSON entry for `finish`."""
        ...

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write the shared files from the entries of all frames in the order of `FrameLocation.number`."""
        ...


def _open_voc(root: Path, focal_px: float | None = None) -> Dataset:
    return PhotographDataset(voc.VocFiles(root), focal_px)


def _open_bdd100k(root: Path, focal_px: float | None = None) -> Dataset:
    return PhotographDataset(bdd100k.BddFiles(root), focal_px)


_PHOTOGRAPH_DATASETS: dict[str, Callable[[Path, float | None], Dataset]] = {
    "bdd100k": _open_bdd100k,
    "coco": coco.CocoDataset,
    "voc": _open_voc,
    "yolo": yolo.YoloDataset,
}
"""Readers of layouts without cameras."""
DATASETS: dict[str, Callable[[Path], Dataset]] = {
    "bdd100k": _open_bdd100k,
    "coco": coco.CocoDataset,
    "kitti": kitti.KittiDataset,
    "vkitti1": vkitti1.Vkitti1Dataset,
    "vkitti2": vkitti2.Vkitti2Dataset,
    "voc": _open_voc,
    "yolo": yolo.YoloDataset,
}
"""Readers by layout."""
WRITERS: dict[str, Callable[[Path], DatasetWriter]] = {
    "vkitti2": vkitti2.Vkitti2Writer,
    "vkitti1": vkitti1.Vkitti1Writer,
    "kitti": kitti.KittiWriter,
    "coco": coco.CocoWriter,
    "yolo": yolo.YoloWriter,
}
"""Writers of generated frames by layout."""


_TABLE_WRITERS: dict[str, Callable[[LabelTable, Path, Mapping[str, Path]], WriteSummary]] = {
    "kitti": kitti.write_table,
    "coco": coco.write_table,
    "yolo": yolo.write_table,
    "vkitti1": vkitti1.write_table,
    "vkitti2": vkitti2.write_table,
    "fiftyone": fiftyone.write_table,
}


def open_dataset(name: str, root: Path | str, with_points: bool = False, focal_px: float | None = None) -> Dataset:
    """Open a data set.

    Args:
        name: Layout, a key of DATASETS.
        root: Folder or URL.
        with_points: Read laser points, which only KITTI has.
        focal_px: Focal length of photographs without a camera, in layouts without cameras.

    Returns:
        The reader.

    Raises:
        RangeError: Unknown name, or a layout without points.
        FormatError: The folder is not of this layout.
        UsageError: The URL cannot be read.
    """
    if name not in DATASETS:
        raise RangeError("dataset", f"one of {', '.join(sorted(DATASETS))}", name)
    if with_points:
        if name != "kitti":
            raise RangeError("dataset with points", "kitti", name)
        return kitti.KittiDataset(local_copy(root), with_points=True)
    folder = local_copy(root)
    if not folder.exists():
        raise FormatError(str(root), f"the folder of a data set ({name}: {_CONTENTS[name]})", "nothing there")
    try:
        if name in _PHOTOGRAPH_DATASETS:
            return _PHOTOGRAPH_DATASETS[name](folder, focal_px)
        return DATASETS[name](folder)
    except FormatError as error:
        other = _guess_layout(folder)
        if other in (None, name):
            raise
        found = f"{error.actual}; it looks like {other} (--dataset {other})"
        raise FormatError(error.field, error.expected, found) from error


_CONTENTS = {
    "bdd100k": "labels/det_20/det_*.json, bdd100k_labels_images_*.json or one JSON file per image, and images/100k",
    "coco": "annotations/instances_*.json, one JSON file with images or in each split's folder, or such a file itself",
    "kitti": "training/image_2, label_2 and calib",
    "vkitti1": "vkitti_1.3.1_rgb and similar folders",
    "vkitti2": "Scene01 and similar folders",
    "voc": "Annotations/*.xml and JPEGImages, or XML files next to their images",
    "yolo": "data.yaml, or such a file itself",
}
"""What the folder of a data set contains."""


def _guess_layout(folder: Path) -> str | None:
    try:
        return detect_layout(folder)
    except FormatError:
        return None


def write_table(table: LabelTable, out: Path, layout: str, images: Mapping[str, Path]) -> WriteSummary:
    """Write labels, or detections if all have scores.

    Numbers read back unchanged; sums of decimals are rounded to 1e-9 px.

    Args:
        table: Labels or detections.
        out: Output folder, or a .json file for COCO.
        layout: Layout to write.
        images: Images to copy, by frame identifier; may be empty.

    Returns:
        Counts of files, lost and assumed values.

    Raises:
        FormatError: The table lacks something that the layout requires.
    """
    return _TABLE_WRITERS[layout](table, out, images)
