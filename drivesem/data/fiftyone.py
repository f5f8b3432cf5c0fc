"""FiftyOne's own layout of detection data sets, written: `data/NAME.png` and `labels.json`.

Format: docs.voxel51.com, "FiftyOneImageDetectionDataset": `classes`, and under `labels` for each image's name
without suffix a list of `label` (a place among the classes), `bounding_box` (left, top, width, height as shares of
the image), `confidence` of detections, and `attributes`. Regions in which nothing is judged cannot be held.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivesem.data.label_table import REGION, LabelTable, Written, copy_images, known_pose
from scene_ir import files


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    """Write a table's objects. Truncation, occlusion, 3D boxes and further columns become attributes; what is told
    of a frame becomes attributes of each of its objects, as far as it is a number, a text or a truth.
    """
    table.need_sizes("fiftyone")
    table = table.in_edges("xywh")
    names, renamed = table.file_names()
    labels: dict[str, list[dict[str, Any]]] = {}
    for i, (name, rows) in enumerate(zip(names, table.by_frame(), strict=True)):
        kept = [row for row in rows if table.kind[row] != REGION and not table.ignore[row]]
        labels[name] = [_detection(table, row, i) for row in kept]
    content = {"classes": list(table.kinds), "labels": labels}
    files.write_text(out / "labels.json", json.dumps(content, allow_nan=False, indent=1) + "\n")
    places = {identifier: out / "data" / name for identifier, name in zip(table.frames, names, strict=True)}
    held = ("truncation", "occlusion", "alpha", "3D box", "score", *table.extra)
    return Written.of(1 + copy_images(places, images), table.lost(held, renamed))


def _detection(table: LabelTable, row: int, frame: int) -> dict[str, Any]:
    left, top, wide, high = table.boxes[row].tolist()
    width, height = table.sizes_wh[frame].tolist()
    told = table.told.get(frame, {})
    score, pose = float(table.score[row]), table.pose[row].tolist()
    attributes: dict[str, Any] = {
        "truncation": _known(float(table.truncation[row])),
        "occlusion": _known(int(table.occlusion[row])),
        **{name: values[row] for name, values in table.extra.items()},
        **{name: value for name, value in told.items() if isinstance(value, str | float | int)},
    }
    if known_pose(pose):
        places = ("length_m", "height_m", "width_m", "x_m", "y_m", "z_m", "yaw_rad")
        attributes |= dict(zip(places, pose, strict=True))
    detection = {
        "label": int(table.kind[row]),
        "bounding_box": [left / width, top / height, wide / width, high / height],
        "attributes": {name: value for name, value in attributes.items() if value is not None},
    }
    return detection | ({"confidence": score} if math.isfinite(score) else {})


def _known(value: float) -> float | None:
    """A value that is -1 where it is not known."""
    return None if value < 0 else value
