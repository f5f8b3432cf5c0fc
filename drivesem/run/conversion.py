"""Converts labels between layouts, and makes training data of a run's counterexamples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesem.config.errors import UsageError
from drivesem.data.account import DataAccount
from drivesem.data.coco_labels import turn_upright
from drivesem.data.image_headers import read_upright_size
from drivesem.data.kitti import read_calibration
from drivesem.data.kitti_labels import TYPES, find_label_folder, read_label_files
from drivesem.data.label_table import REGION, LabelTable, WriteSummary, make_camera_entry, shortest_decimals
from drivesem.data.photographs import match_images
from drivesem.data.registry import write_table
from drivesem.failures.grades import Grade
from drivesem.run.labels import RESULT, detect_labels_layout, list_frames, read_labels
from drivesem.run.results import FrameResult, load_frame
from scene_ir.errors import FormatError
from scene_ir.io import load_camera, load_other_labels

COUNTEREXAMPLE, MOVED_LABELS = "counterexample.png", "labels_moved.txt"
"""Files of a frame that are training data."""
_ROUNDING_PX = 0.002
"""Label files have three decimals."""


@dataclass(frozen=True, slots=True)
class ConversionSettings:
    """Settings of a conversion between label layouts."""

    to_format: str
    """Layout to write."""
    from_format: str | None = None
    """Layout to read; detected if None."""
    scores: bool = False
    """Convert detections instead of labels."""
    size_wh: tuple[int, int] | None = None
    """Size of all images in px; read from the images if None."""
    images: Path | None = None
    """Folder of the images, if not where the source has them."""
    copy_images: bool = False
    """Copy the images into the new layout."""
    mapping: Mapping[str, str | None] = field(default_factory=dict)
    """New names of classes; None drops a class."""
    frames: Sequence[str] | None = None
    """Frames of a run; all if None."""


def convert_labels(
    source: Path, out: Path, settings: ConversionSettings
) -> tuple[WriteSummary, DataAccount | None]:
    """Write the labels or detections of `source` to `out` in another layout.

    Args:
        source: A run, or labels in a known layout.
        out: Folder of the new layout.
        settings: Layouts, classes and images.

    Returns:
        What was written, lost and assumed, and the account of `source`, if it is no run.

    Raises:
        FormatError: `source` cannot be read, or lacks what the new layout needs.
        UsageError: An image to copy is missing.
    """
    layout = settings.from_format or detect_labels_layout(source)
    if layout == "run" and not settings.scores:
        table = read_training_labels(source, settings.frames)
    else:
        table = read_labels(source, layout, scored=settings.scores, size_wh=settings.size_wh)
    (odd,) = np.nonzero((table.truncation > 1) | ((table.truncation < 0) & (table.truncation != -1)))
    if len(odd):
        where = f"{source}: frame {table.frames[table.frame[odd[0]]]}: truncation"
        raise FormatError(where, "[0, 1], or -1 where unknown", f"{table.truncation[odd[0]]:g}")
    if settings.mapping:
        table = rename_classes(table, settings.mapping)
    if layout == "run":
        table = _turn_unsupported_into_regions(table, settings)
    table = _with_images(table, source, layout, settings.images)
    if layout == "coco":
        table = turn_upright(table)
    table = _with_sizes(table, settings)
    if layout == "kitti":
        table = replace(table, cameras=_read_cameras(source, table))
    images = {table.frames[i]: path for i, path in table.image_paths.items()} if settings.copy_images else {}
    if settings.copy_images and len(images) < len(table.frames):
        raise UsageError("--copy-images", f"an image of each of {len(table.frames)} frames", len(images))
    return write_table(table, out, settings.to_format, images), table.account


def _with_images(table: LabelTable, source: Path, layout: str, folder: Path | None) -> LabelTable:
    """Return the table with the images of a folder, if there is one, and those of a run; others are known."""
    if folder is None and layout != "run":
        return table
    find = find_counterexamples if folder is None else match_images
    found = find(source if folder is None else folder, table.frames)
    paths = {i: found[name] for i, name in enumerate(table.frames) if name in found}
    names = {i: f"{table.frames[i]}{path.suffix}" for i, path in paths.items()}
    return replace(table, image_paths=paths, image_files=names | dict(table.image_files))


def _with_sizes(table: LabelTable, settings: ConversionSettings) -> LabelTable:
    """Return the table with the size of all images that is given, or unknown ones read, if the layout needs them."""
    if settings.size_wh is not None:
        return replace(table, sizes_wh=np.tile(np.array(settings.size_wh, np.int64), (len(table.frames), 1)))
    if settings.to_format not in ("coco", "yolo", "fiftyone"):
        return table
    sizes = table.sizes_wh.copy()
    for i in np.flatnonzero((sizes <= 0).any(axis=1)).tolist():
        if i in table.image_paths:
            sizes[i] = read_upright_size(table.image_paths[i])
    return replace(table, sizes_wh=sizes)


def rename_classes(table: LabelTable, mapping: Mapping[str, str | None]) -> LabelTable:
    """Rename classes, and drop the boxes of those that map to None. Raises UsageError for an unknown class."""
    unknown = sorted(set(mapping) - set(table.kinds))
    if unknown:
        raise UsageError("--map", f"some of {', '.join(table.kinds)}", unknown[0])
    names = [mapping.get(kind, kind) for kind in table.kinds]
    kinds = list(dict.fromkeys(name for name in names if name is not None))
    dropped = len(kinds)
    places = np.array([*(dropped if n is None else kinds.index(n) for n in names), REGION], np.int64)
    kind = places[table.kind]
    table = replace(table, kinds=tuple(kinds), kind=kind, kind_ids=None)
    return table.select(kind != dropped)


def _turn_unsupported_into_regions(table: LabelTable, how: ConversionSettings) -> LabelTable:
    """Turn a run's unchanged objects that the layout cannot hold into ignored regions: other types than KITTI's,
    and for Virtual KITTI also boxes without a 3D box.
    """
    if how.to_format not in ("kitti", "vkitti1", "vkitti2"):
        return table
    supported = {name.lower() for name in (*TYPES, *(name or "" for name in how.mapping.values()))}
    region = np.array([*(name.lower() not in supported for name in table.kinds), True], np.bool_)[table.kind]
    if how.to_format != "kitti":
        region |= ~np.isfinite(table.pose).all(axis=1)
    return replace(table, kind=np.where(region, REGION, table.kind), ignore=table.ignore | region)


def _read_cameras(source: Path, table: LabelTable) -> dict[int, dict[str, Any]]:
    """Return COCO's "camera" entries, by frame, from the calibrations next to KITTI's labels, if there are any."""
    folder = find_label_folder(source)
    cameras: dict[int, dict[str, Any]] = {}
    if folder is None or folder.name != "label_2":
        return cameras
    for i, name in enumerate(table.frames):
        path = folder.parent / "calib" / f"{name}.txt"
        if path.is_file():
            cameras[i] = make_camera_entry(read_calibration(path).projection)
    return cameras


def find_counterexamples(run: Path, frames: Sequence[str]) -> dict[str, Path]:
    """Return the existing counterexample pictures of a run, by frame."""
    paths = {name: run / "frames" / name / COUNTEREXAMPLE for name in frames}
    return {name: path for name, path in paths.items() if path.is_file()}


def read_training_labels(run: Path, frames: Sequence[str] | None = None) -> LabelTable:
    """Read a run's counterexamples as training data: moved labels with 3D boxes, cameras, and picture sizes and
    names. Unchanged objects, such as people, keep their labels. The extra column "failure" holds the grade of each
    lost object.

    Args:
        run: Folder of the run.
        frames: Frames to read; all by default.

    Raises:
        FormatError: A file is damaged.
    """
    names = list_frames(run) if frames is None else list(frames)
    if not names:
        raise FormatError(str(run / "frames"), f"frames with {RESULT}", "none")
    folders = [run / "frames" / name for name in names]
    table = read_label_files(
        {name: str(folder / MOVED_LABELS) for name, folder in zip(names, folders, strict=True)}
    )
    table = _with_unchanged_objects(table, folders)
    results = [load_frame(folder / RESULT) for folder in folders]
    sizes = [read_upright_size(folder / COUNTEREXAMPLE) for folder in folders]
    failure: list[str | None] = [None] * len(table)
    for result, rows in zip(results, table.rows_by_frame(), strict=True):
        for lost in (one for one in result.failures if one.kind == "lost"):
            near = [row for row in rows if np.abs(table.boxes[row] - lost.xyxy).max() < _ROUNDING_PX]
            if near:
                failure[near[0]] = lost.grade or Grade.THRESHOLD
    return replace(
        table,
        sizes_wh=np.array(sizes, np.int64).reshape(-1, 2),
        extra={**table.extra, "failure": failure},
        cameras={i: make_camera_entry(load_camera(folder / "scene").matrix) for i, folder in enumerate(folders)},
        image_files={i: f"{name}/{COUNTEREXAMPLE}" for i, name in enumerate(names)},
        frame_attributes={i: {"drivesem": provenance(run, result)} for i, result in enumerate(results)},
    )


def _with_unchanged_objects(table: LabelTable, folders: Sequence[Path]) -> LabelTable:
    """Add the labels of objects that the scenes leave unchanged. A run's label files list them as regions, last in
    each frame. Raises FormatError if there are fewer.
    """
    labels = [load_other_labels(folder / "scene") for folder in folders]
    kinds = sorted({*table.kinds, *(kind for others in labels if others is not None for kind in others.kind)})
    names = ("ignore", "truncation", "occlusion", "pose")
    columns = {name: getattr(table, name).copy() for name in names}
    kind = np.array([*map(kinds.index, table.kinds), REGION], np.int64)[table.kind]
    for folder, others, rows in zip(folders, labels, table.rows_by_frame(), strict=True):
        if others is None:
            continue
        count = len(others.kind)
        own = slice(rows.stop - count, rows.stop)
        if count > len(rows) or (table.kind[own] != REGION).any():
            raise FormatError(
                str(folder / MOVED_LABELS), f"at its end {count} DontCare, as the scene has", "others"
            )
        kind[own] = [kinds.index(name) for name in others.kind]
        columns["ignore"][own] = False
        columns["truncation"][own] = np.nan_to_num(shortest_decimals(others.truncation), nan=-1)
        columns["occlusion"][own] = others.occlusion.numpy()
        pose = torch.cat([others.size_lhw, others.translation, others.yaw[:, None]], dim=1)
        columns["pose"][own] = np.reshape(shortest_decimals(pose), (count, 7))
    return replace(table, kinds=tuple(kinds), kind=kind, **columns)


def provenance(run: Path, result: FrameResult) -> dict[str, Any]:
    """Describe a picture of a run: its run and frame, the highest grade of its failures, and theta."""
    grades = [Grade(failure.grade or Grade.THRESHOLD) for failure in result.failures]
    return {
        "run": run.resolve().name,
        "frame": result.identifier,
        "failures": len(result.failures),
        "grade": max(grades, key=list(Grade).index, default=None),
        "feasible": result.feasible,
        "theta": {coordinate.name: coordinate.value for coordinate in result.theta},
    }
