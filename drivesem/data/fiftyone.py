"""FiftyOne's layout of detection data sets, `data/NAME.png` and `labels.json`: reader, and writer of label tables.

Format: docs.voxel51.com, "FiftyOneImageDetectionDataset": `classes`, and under `labels` for each image's name
without suffix a list of `label` (an index into the classes), `bounding_box` (left, top, width, height as shares of
the image), `confidence` of detections, and `attributes`. It cannot hold DontCare regions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from drivesem.data.account import IMAGE_SUFFIXES
from drivesem.data.label_table import REGION, LabelTable, WriteSummary, copy_images, is_known_pose
from scene_ir import files
from scene_ir.errors import FormatError


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table's objects.

    Truncation, occlusion, 3D boxes, further columns, and the frame's attributes that are numbers, texts or truth
    values become attributes of each object.

    Args:
        table: Labels or detections.
        out: Output folder.
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files and lost values.

    Raises:
        FormatError: The size of an image is unknown.
    """
    table.require_sizes("fiftyone")
    table = table.with_box_format("xywh")
    names, renamed = table.file_names()
    labels: dict[str, list[dict[str, Any]]] = {}
    for i, (name, rows) in enumerate(zip(names, table.rows_by_frame(), strict=True)):
        objects = [row for row in rows if table.kind[row] != REGION and not table.ignore[row]]
        labels[name] = [_detection(table, row, i) for row in objects]
    content = {"classes": list(table.kinds), "labels": labels}
    files.write_text(out / "labels.json", json.dumps(content, allow_nan=False, indent=1) + "\n")
    targets = {identifier: out / "data" / name for identifier, name in zip(table.frames, names, strict=True)}
    supported = ("truncation", "occlusion", "alpha", "3D box", "score", "attributes of frames", *table.extra)
    return WriteSummary.from_counts(1 + copy_images(targets, images), table.count_lost(supported, renamed))


def _detection(table: LabelTable, row: int, frame: int) -> dict[str, Any]:
    left, top, wide, high = table.boxes[row].tolist()
    width, height = table.sizes_wh[frame].tolist()
    frame_attributes = dict(table.frame_attributes.get(frame, {}))
    frame_attributes |= frame_attributes.pop("drivesem", {})
    score, pose = float(table.score[row]), table.pose[row].tolist()
    attributes: dict[str, Any] = {
        "truncation": _none_if_unknown(float(table.truncation[row])),
        "occlusion": _none_if_unknown(int(table.occlusion[row])),
        **{name: values[row] for name, values in table.extra.items()},
        **{name: value for name, value in frame_attributes.items() if isinstance(value, str | float | int)},
    }
    if is_known_pose(pose):
        names = ("length_m", "height_m", "width_m", "x_m", "y_m", "z_m", "yaw_rad")
        attributes |= dict(zip(names, pose, strict=True))
    detection = {
        "label": int(table.kind[row]),
        "bounding_box": [left / width, top / height, wide / width, high / height],
        "attributes": {name: value for name, value in attributes.items() if value is not None},
    }
    return detection | ({"confidence": score} if math.isfinite(score) else {})


def _none_if_unknown(value: float) -> float | None:
    """Return None for -1, the mark of unknown values."""
    return None if value < 0 else value


def to_coco(
    path: Path, content: Mapping[str, Any], read_size: Callable[[Path], tuple[int, int]]
) -> dict[str, Any]:
    """Convert the content of a `labels.json` to COCO's form; boxes become px of the images in `data`.

    Args:
        path: The file.
        content: Its content, with "labels".
        read_size: Reads width and height of an image.

    Returns:
        The content of a COCO file.

    Raises:
        FormatError: Another form, or a labelled image that is missing.
    """
    classes = content.get("classes")
    if not isinstance(classes, list):
        raise FormatError(f"{path}: classes", "a list of names", type(classes).__name__)
    there = (file for file in (path.parent / "data").rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    paths = {file.relative_to(path.parent / "data").with_suffix("").as_posix(): file for file in there}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for name, objects in content["labels"].items():
        where = f"{path}: labels.{name}"
        if name not in paths:
            raise FormatError(where, f"an image in {path.parent / 'data'}", "none")
        width, height = read_size(paths[name])
        file_name = paths[name].relative_to(path.parent / "data").as_posix()
        images.append({"id": len(images) + 1, "file_name": file_name, "width": width, "height": height})
        for row in objects or []:
            try:
                left, top, wide, high = map(float, row["bounding_box"])
                label = range(len(classes))[row["label"]]
            except (TypeError, ValueError, KeyError, IndexError) as error:
                raise FormatError(
                    where, "label, a class number, and bounding_box, 4 shares", str(error)
                ) from error
            box = [left * width, top * height, wide * width, high * height]
            entry = {"image_id": len(images), "category_id": label, "bbox": box, **(row.get("attributes") or {})}
            entry |= {"score": row["confidence"]} if "confidence" in row else {}
            annotations.append({"id": len(annotations) + 1, **entry})
    categories = [{"id": i, "name": str(name)} for i, name in enumerate(classes)]
    return {"images": images, "annotations": annotations, "categories": categories}
