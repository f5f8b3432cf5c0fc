"""Labels from one layout into another, of data sets and of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.config.errors import UsageError
from drivesem.data.frames import images_in, size_of_image
from drivesem.data.kitti import read_calib
from drivesem.data.kitti_labels import TYPES, label_folder
from drivesem.data.label_table import REGION, LabelTable, Written, camera_entry
from drivesem.data.registry import images_beside, write_table
from drivesem.run.labels import layout_of, read
from drivesem.run.training_data import labels_of_run, pictures
from scene_ir.errors import FormatError


@dataclass(frozen=True, slots=True)
class Conversion:
    """to_format, from_format: layouts, None to look; scores: of detections, not labels. size_wh: of all images,
    px, instead of a look at them in `images` or where the source has them; copy_images: into the new layout.
    mapping: classes by name, None leaves one out. frames: of a run, these only.
    """

    to_format: str
    from_format: str | None = None
    scores: bool = False
    size_wh: tuple[int, int] | None = None
    images: Path | None = None
    copy_images: bool = False
    mapping: Mapping[str, str | None] = field(default_factory=dict)
    frames: Sequence[str] | None = None


def convert(source: Path, out: Path, how: Conversion) -> Written:
    """Write the labels or detections of `source` to `out` in another layout.

    FormatError for what cannot be read, and for what the new layout cannot do without; UsageError where images are
    to be copied and are not there.
    """
    layout = how.from_format or layout_of(source)
    if layout == "run" and not how.scores:
        table = labels_of_run(source, how.frames)
    else:
        table = read(source, layout, scored=how.scores)
    (odd,) = np.nonzero((table.truncation > 1) | ((table.truncation < 0) & (table.truncation != -1)))
    if len(odd):
        where = f"{source}: frame {table.frames[table.frame[odd[0]]]}: truncation"
        raise FormatError(where, "[0, 1], or -1 where unknown", f"{table.truncation[odd[0]]:g}")
    if how.mapping:
        table = renamed(table, how.mapping)
    if layout == "run":
        table = _as_far_as_held(table, how)
    found = images_in([how.images], table.frames) if how.images is not None else {}
    if how.images is None and (how.copy_images or (not table.sizes_wh.all() and how.size_wh is None)):
        beside = pictures if layout == "run" else partial(images_beside, layout=layout)
        found = beside(source, frames=table.frames)
    if how.size_wh is not None:
        table = replace(table, sizes_wh=np.tile(np.array(how.size_wh, np.int64), (len(table.frames), 1)))
    elif not table.sizes_wh.all() and how.to_format in ("coco", "yolo", "fiftyone"):
        sizes = table.sizes_wh.copy()
        for i, name in enumerate(table.frames):
            if not sizes[i].all() and name in found:
                sizes[i] = size_of_image(found[name])
        table = replace(table, sizes_wh=sizes)
    names = {i: "_".join(name.split("/")) for i, name in enumerate(table.frames) if name in found}
    looked_at = {i: f"{name}{found[table.frames[i]].suffix}" for i, name in names.items()}
    table = replace(table, image_files=looked_at | dict(table.image_files))
    if layout == "kitti":
        table = replace(table, cameras=_calibrations(source, table))
    if how.copy_images and len(found) < len(table.frames):
        raise UsageError("--copy-images", f"an image of each of {len(table.frames)} frames", len(found))
    return write_table(table, out, how.to_format, found if how.copy_images else {})


def renamed(table: LabelTable, mapping: Mapping[str, str | None]) -> LabelTable:
    """Other names of classes; boxes of those that map to None are left out. UsageError for a name that is not
    there.
    """
    unknown = sorted(set(mapping) - set(table.kinds))
    if unknown:
        raise UsageError("--map", f"some of {', '.join(table.kinds)}", unknown[0])
    names = [mapping.get(kind, kind) for kind in table.kinds]
    kinds = list(dict.fromkeys(name for name in names if name is not None))
    left_out = len(kinds)
    places = np.array([*(left_out if n is None else kinds.index(n) for n in names), REGION], np.int64)
    kind = places[table.kind]
    table = replace(table, kinds=tuple(kinds), kind=kind, kind_ids=None)
    return table.rows(kind != left_out)


def _as_far_as_held(table: LabelTable, how: Conversion) -> LabelTable:
    """What a run leaves as it is, as regions where the layout has no place for it: types that KITTI does not have,
    and in Virtual KITTI also what has no 3D box.
    """
    if how.to_format not in ("kitti", "vkitti1", "vkitti2"):
        return table
    held = {name.lower() for name in (*TYPES, *(name or "" for name in how.mapping.values()))}
    region = np.array([*(name.lower() not in held for name in table.kinds), True], np.bool_)[table.kind]
    if how.to_format != "kitti":
        region |= ~np.isfinite(table.pose).all(axis=1)
    return replace(table, kind=np.where(region, REGION, table.kind), ignore=table.ignore | region)


def _calibrations(source: Path, table: LabelTable) -> dict[int, dict[str, Any]]:
    """COCO's "camera" entries of the calibrations beside KITTI's labels, where there are any."""
    folder = label_folder(source)
    cameras: dict[int, dict[str, Any]] = {}
    if folder is None or folder.name != "label_2":
        return cameras
    for i, name in enumerate(table.frames):
        path = folder.parent / "calib" / f"{name}.txt"
        if path.is_file():
            cameras[i] = camera_entry(read_calib(path).projection)
    return cameras
