"""Detection of a path's layout, and reading of its labels; without torch, except YOLO's and Virtual KITTI's."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

from drivesem.data import bdd100k, coco_labels, kitti_labels, voc, yolo_labels
from drivesem.data.image_index import iterate_files
from drivesem.data.label_table import LabelTable
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

_VKITTI2 = re.compile("Scene[0-9]|vkitti_2")
"""Beginnings of the names of Virtual KITTI 2's folders."""
LAYOUTS = ("kitti", "coco", "yolo", "vkitti1", "vkitti2", "voc", "bdd100k")


def detect_layout(path: Path) -> str | None:
    """Return a path's layout; None for a folder of none. Raises FormatError for other files and missing paths."""
    if path.is_file():
        if path.suffix.lower() == ".json":
            return "bdd100k" if bdd100k.is_label_file(path) else "coco"
        if path.suffix.lower() in (".yaml", ".yml"):
            return "yolo"
        raise FormatError(str(path), "a .json or .yaml file, or a folder of labels", f"a {path.suffix or 'file'}")
    if not path.is_dir():
        raise FormatError(str(path), "a file or folder of labels", "nothing there")
    has_kitti_labels = (path / "label_2").is_dir() or (path / "training" / "label_2").is_dir()
    if not has_kitti_labels and yolo_labels.find_description(path) is not None:
        return "yolo"
    annotations = coco_labels.find_annotation_files(path)
    if annotations:
        return "bdd100k" if all(map(bdd100k.is_label_file, annotations)) else "coco"
    if (path / "vkitti_1.3.1_rgb").is_dir():
        return "vkitti1"
    with os.scandir(path) as entries:
        if any(_VKITTI2.match(entry.name) and entry.is_dir() for entry in entries):
            return "vkitti2"
    if not has_kitti_labels and any(map(bdd100k.is_label_file, iterate_files(path, ".json"))):
        return "bdd100k"
    if not has_kitti_labels and any(map(voc.is_annotation, iterate_files(path, ".xml"))):
        return "voc"
    folder = kitti_labels.find_label_folder(path) or path / "labels"
    if not folder.is_dir():
        return None
    # YOLO's lines begin with a class number, KITTI's with a name
    names = (name for name in kitti_labels.list_files(folder) if yolo_labels.is_label_file(os.path.basename(name)))
    starts = (files.read_text(folder / name).split(None, 1)[:1] for name in names)
    first = next((words[0] for words in starts if words), None)
    if first is None and folder == path / "labels":
        return None
    return "yolo" if first is not None and first.replace(".", "", 1).isdecimal() else "kitti"


def read_table(
    path: Path,
    layout: str,
    scored: bool = False,
    truth: LabelTable | None = None,
    size_wh: tuple[int, int] | None = None,
) -> LabelTable:
    """Read labels or detections.

    Args:
        path: File or folder.
        layout: One of LAYOUTS.
        scored: Read detections with scores.
        truth: Labels of the same frames, which give detections COCO's ids, YOLO's classes and image sizes.
        size_wh: Size of all images, px; by default YOLO's images are opened, to scale its labels.

    Returns:
        The labels or detections.

    Raises:
        FormatError: Names file, line or entry, and field.
        RangeError: Unknown layout.
    """
    if not path.exists():
        raise FormatError(str(path), "a file or folder of labels", "nothing there")
    if layout == "kitti":
        return kitti_labels.read_table(path, scored)
    if layout == "coco":
        return coco_labels.read_table(path, scored, truth)
    if layout == "yolo":
        from drivesem.data import yolo

        return yolo.read_table(path, scored, truth, size_wh)
    if layout not in LAYOUTS:
        raise RangeError("layout", f"one of {', '.join(LAYOUTS)}", layout)
    if scored:
        raise FormatError(str(path), "detections with scores", f"{layout}, of which only labels are read")
    if layout in ("voc", "bdd100k"):
        return (voc.VocFiles if layout == "voc" else bdd100k.BddFiles)(path).read_table()
    from drivesem.data import vkitti1, vkitti2

    dataset = (vkitti1.Vkitti1Dataset if layout == "vkitti1" else vkitti2.Vkitti2Dataset)(path)
    table = dataset.table()
    images = {i: dataset.image_path(name) for i, name in enumerate(table.frames)}
    names = {i: f"{table.frames[i]}{path.suffix}" for i, path in images.items()}
    return replace(table, image_files=names, image_paths=images, account=dataset.account())
