"""FiftyOne's layout of detection data sets, `data/NAME.png` and `labels.json`: writer of label tables.

Format: docs.voxel51.com, "FiftyOneImageDetectionDataset": `classes`, and under `labels` for each image's name
without suffix a list of `label` (an index into the classes), `bounding_box` (left, top, width, height as shares of
the image), `confidence` of detections, and `attributes`. It cannot hold DontCare regions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivesem.data.label_table import REGION, LabelTable, WriteSummary, copy_images, is_known_pose
from scene_ir import files


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
    supported = ("truncation", "occlusion", "alpha", "3D box", "score", *table.extra)
    return WriteSummary.from_counts(1 + copy_images(targets, images), table.count_lost(supported, renamed))


def _detection(table: LabelTable, row: int, frame: int) -> dict[str, Any]:
    left, top, wide, high = table.boxes[row].tolist()
    width, height = table.sizes_wh[frame].tolist()
    frame_attributes = table.frame_attributes.get(frame, {})
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
