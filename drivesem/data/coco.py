"""COCO's `annotations/instances_*.json`: written with all that it can hold of a frame, and read from anywhere.

Boxes in the file are COCO's: x, y, width, height, where pixel column j spans [j, j + 1]. Here it spans
[j - 0.5, j + 0.5] (scene_ir/conventions.md), so x is left + 0.5. Masks are run-length encoded and exact.
Format: cocodataset.org/#format-data; pycocotools is the definition. A label table takes whatever truncation,
occlusion or pose another project means by these names; a scene takes this project's only, and refuses others.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pycocotools import mask as run_length

from drivesem.data.classes import ClassMap
from drivesem.data.frames import PNG_COMPRESSION, Frames, as_photograph, check_focal, images_by_place, pinhole
from drivesem.data.label_table import (
    REGION,
    LabelTable,
    Written,
    camera_entry,
    copy_images,
    known_pose,
    shortest,
    to_coco,
)
from drivesem.data.truth import Exposure, Place, TrackedObject
from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from scene_ir.types import Camera, Frame, Labels

CATEGORIES = {
    **dict.fromkeys(("Car", "Van", "Truck"), "vehicle"),
    **dict.fromkeys(("Pedestrian", "Cyclist", "Person_sitting"), "person"),
    **dict.fromkeys(("Tram", "Misc"), "other"),
}
"""KITTI's types and their supercategory; ids are counted from 1, in this order."""
CATEGORY_IDS = {name: i + 1 for i, name in enumerate(CATEGORIES)}
COCO_ROAD_USERS = ClassMap(
    classes={"car": "Car", "truck": "Truck", "person": "Pedestrian"},
    ignored={"bus": None, "train": None, "bicycle": "Cyclist", "motorcycle": "Cyclist"},
)
"""The classes of COCO 2017 that are on the road. A KITTI cyclist includes the bicycle, so that a bicycle alone is
neither; buses and trains look like nothing the detectors know."""
_MOST_FLAG = 2**31
"""Above occlusions and sides of images."""
_SHOWN = 3
"""Ids that an error names."""


def _encode(mask: np.ndarray) -> dict[str, Any]:
    """A mask (H, W) bool as COCO's compressed run lengths."""
    return {"size": list(mask.shape), "counts": _counts(run_length.encode(np.asfortranarray(mask, np.uint8)))}


def _counts(encoded: Any) -> str:
    """pycocotools' run lengths as text: it gives bytes, whatever its types say."""
    return encoded["counts"].decode("ascii")


def _rectangle(box_xyxy: Sequence[float], height: int, width: int) -> np.ndarray:
    """The pixels (H, W) bool whose centres lie in a box."""
    left, top, right, bottom = box_xyxy
    rows, columns = np.arange(height), np.arange(width)
    return np.outer((rows >= top) & (rows <= bottom), (columns >= left) & (columns <= right))


def _kinds_of_region(box_xyxy: Sequence[float], objects: Iterable[TrackedObject]) -> tuple[str, ...]:
    """The type of the object without a label that a region covers most of; all types where it covers none."""
    left, top, right, bottom = box_xyxy

    def shared(thing: TrackedObject) -> float:
        x0, y0, x1, y1 = thing.box_ltrb
        wide, high = min(right, x1) - max(left, x0) + 1, min(bottom, y1) - max(top, y0) + 1
        union = (right - left + 1) * (bottom - top + 1) + (x1 - x0 + 1) * (y1 - y0 + 1) - wide * high
        return wide * high / union if min(wide, high) > 0 else 0.0

    best = max((o for o in objects if not o.labelled), key=shared, default=None)
    return tuple(CATEGORIES) if best is None or shared(best) == 0 else (best.kind,)


class CocoWriter:
    """Writes `images/{part}/%06d.png` and `annotations/instances_{part}.json` under `root`.

    Besides COCO's own keys an image has "camera" (fx, fy, cx, cy and projection, 3x4 row-major, px) and an
    annotation has "truncation", "visible", "occlusion", "track" and "pose" (translation m, yaw rad, size_lhw m),
    as in `Labels` and `TrackedObject`. "area" and "segmentation" are of what is visible, "bbox" is the label's
    box. A region to ignore is a crowd (iscrowd 1) of the type of the object there, or of every type where there is
    none, so that COCO's evaluation ignores it. What COCO cannot hold: depth, semantic classes, extrinsics.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def _image(self, place: Place) -> Path:
        return self.root / "images" / place.part / f"{place.number:06d}.png"

    def exists(self, place: Place) -> bool:
        """Whether the frame's image is there."""
        return self._image(place).exists()

    def write(self, place: Place, exposure: Exposure) -> dict[str, object]:
        """Write one frame's image. The entry holds its record and its annotations, whose ids `finish` gives."""
        camera = exposure.camera
        record = {
            "id": place.number + 1,
            "file_name": self._image(place).name,
            "height": camera.height,
            "width": camera.width,
            "camera": camera_entry(camera.matrix),
        }
        annotations = [*_objects(exposure), *_regions(exposure)]
        files.write_png(self._image(place), exposure.image, PNG_COMPRESSION)
        return {"number": place.number, "part": place.part, "image": record, "annotations": annotations}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write the annotations of every part that has frames, one image or annotation a line."""
        for part in sorted({entry["part"] for entry in entries}):
            chosen = [entry for entry in entries if entry["part"] == part]
            annotations = [
                {"id": i + 1, "image_id": image_id, **annotation}
                for i, (image_id, annotation) in enumerate(
                    (entry["image"]["id"], annotation) for entry in chosen for annotation in entry["annotations"]
                )
            ]
            images = [entry["image"] for entry in chosen]
            text = _text(images, annotations, CATEGORY_IDS.items(), _HEAD, "")
            files.write_text(self.root / "annotations" / f"instances_{part}.json", text)


_HEAD = '"info": {"description": "drivesem synth"},\n"licenses": [],\n'


def _text(
    images: Sequence[Any],
    annotations: Sequence[Any],
    categories: Iterable[tuple[str, int]],
    start: str = "\n",
    end: str = "\n",
) -> str:
    """A data set's file, one image or annotation a line. categories: names and ids."""
    named = [
        {"id": number, "name": name, "supercategory": CATEGORIES.get(name, "object")}
        for name, number in categories
    ]
    tables = {"images": images, "annotations": annotations, "categories": named}
    lines = {
        name: ",\n".join(_entry_text(name, i, row) for i, row in enumerate(rows)) for name, rows in tables.items()
    }
    return "{" + start + ",\n".join(f'"{name}": [\n{text}\n]' for name, text in lines.items()) + end + "}\n"


def _entry_text(table: str, place: int, row: Any) -> str:
    """An entry as JSON. FormatError for NaN and infinity, which JSON has not, in keys of another project."""
    try:
        return json.dumps(row, allow_nan=False)
    except ValueError as error:
        raise FormatError(f"{table}[{place}]", "finite numbers", "NaN or infinity") from error


def _objects(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Annotations of the labelled objects, without ids."""
    labels = exposure.labels
    for i, thing in enumerate(o for o in exposure.objects if o.labelled):
        mask = exposure.instances == thing.track + 1
        yield {
            "category_id": CATEGORY_IDS[labels.kind[i]],
            "bbox": to_coco(labels.boxes_xyxy[i].double().numpy()).tolist(),
            "area": int(mask.sum()),
            "segmentation": _encode(mask),
            "iscrowd": 0,
            "truncation": shortest(labels.truncation[i])[0],
            "visible": thing.visible,
            "occlusion": int(labels.occlusion[i]),
            "track": thing.track,
            "pose": _pose_entry(
                shortest(labels.size_lhw[i]), shortest(labels.translation[i]), *shortest(labels.yaw[i])
            ),
        }


def _regions(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Annotations of the regions to ignore, without ids."""
    for box in exposure.labels.ignore_xyxy.tolist():
        mask = _rectangle(box, exposure.camera.height, exposure.camera.width)
        region = {"bbox": to_coco(np.array(box)).tolist(), "area": int(mask.sum())}
        region |= {"segmentation": _encode(mask), "iscrowd": 1}
        for kind in _kinds_of_region(box, exposure.objects):
            yield {"category_id": CATEGORY_IDS[kind], **region}


def _pose_entry(size_lhw: Sequence[float], translation: Sequence[float], yaw: float) -> dict[str, Any]:
    return {"translation": translation, "yaw": yaw, "size_lhw": size_lhw}


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    """Write a table to a .json file, or to `annotations/instances_all.json` in a folder, with all that it holds.

    A region is a crowd of every class with "dontcare", which `read_table` makes one region again.
    """
    table.need_sizes("coco")
    table = table.in_edges("xywh")
    names, renamed = table.file_names()
    if table.kind_ids is not None:
        categories = list(zip(table.kinds, table.kind_ids.tolist(), strict=True))
        numbers = table.kind_ids.tolist()
    else:
        fixed = set(table.kinds) <= set(CATEGORIES)
        categories = [(kind, i + 1) for i, kind in enumerate(CATEGORIES if fixed else table.kinds)]
        numbers = [dict(categories)[kind] for kind in table.kinds]
    image_ids = (np.arange(1, len(names) + 1) if table.image_ids is None else table.image_ids).tolist()
    records: list[dict[str, Any]] = []
    for i, (name, identifier) in enumerate(zip(names, table.frames, strict=True)):
        suffix = images[identifier].suffix.lower() if identifier in images else ".png"
        width, height = table.sizes_wh[i].tolist()
        record = {"id": image_ids[i], "file_name": f"{name}{suffix}", "width": width, "height": height}
        records.append(record | ({"camera": table.cameras[i]} if i in table.cameras else {}))
    annotations: list[dict[str, Any]] = []
    own = [] if table.box_ids is None else table.box_ids.tolist()
    free = max(own, default=0) + 1
    for row, kind in enumerate(table.kind.tolist()):
        entry = _row_entry(table, row)
        for label in [number for _, number in categories] if kind == REGION else [numbers[kind]]:
            number = free
            if own and kind != REGION:
                number = own[row]
            else:
                free += 1
            whole = {"id": number, "image_id": image_ids[table.frame[row]], "category_id": label, **entry}
            annotations.append(whole | ({"dontcare": True} if kind == REGION else {}))
    path = out if out.suffix.lower() == ".json" else out / "annotations" / "instances_all.json"
    files.write_text(path, _text(records, annotations, categories))
    folder = (path.parent if path == out else out) / "images"
    places = {identifier: folder / name for identifier, name in zip(table.frames, names, strict=True)}
    return Written.of(1 + copy_images(places, images), renamed)


def _row_entry(table: LabelTable, row: int) -> dict[str, Any]:
    """The annotation of a row but for its ids; what is not known is left out."""
    box, area, pose = table.boxes[row].tolist(), float(table.area[row]), table.pose[row].tolist()
    area = area if math.isfinite(area) else box[2] * box[3]
    score, alpha = float(table.score[row]), float(table.alpha[row])
    truncation, occlusion = float(table.truncation[row]), int(table.occlusion[row])
    entry = {
        "bbox": box,
        "area": int(area) if area.is_integer() else area,
        "iscrowd": int(table.ignore[row]),
        "score": score if math.isfinite(score) else None,
        "truncation": truncation if truncation >= 0 else None,
        "occlusion": occlusion if occlusion >= 0 else None,
        "alpha": alpha if math.isfinite(alpha) else None,
        "pose": _pose_entry(pose[:3], pose[3:6], pose[6]) if known_pose(pose) else None,
        **{name: values[row] for name, values in table.extra.items()},
    }
    return {name: value for name, value in entry.items() if value is not None}


def _numbers(where: str, value: Any, count: int) -> list[float]:
    """`count` finite numbers. FormatError."""
    good = isinstance(value, list) and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    if not good or len(value) != count:
        raise FormatError(where, f"{count} finite numbers", json.dumps(value)[:60])
    return [float(v) for v in value]


@dataclass(frozen=True, slots=True)
class _Rows:
    """Entries of a list in the file. where: the list, for errors; numbers: the place of each in it."""

    where: str
    rows: Sequence[Mapping[str, Any]]
    numbers: Sequence[int]

    @classmethod
    def of(cls, where: str, rows: Any) -> _Rows:
        """All entries of a list. FormatError where it is none, or one of them no object."""
        if not isinstance(rows, list):
            raise FormatError(where, "a list", "none" if rows is None else type(rows).__name__)
        if not set(map(type, rows)) <= {dict}:
            i, row = next((i, r) for i, r in enumerate(rows) if not isinstance(r, dict))
            raise FormatError(f"{where}[{i}]", "an object", type(row).__name__)
        return cls(where, rows, range(len(rows)))

    def __len__(self) -> int:
        return len(self.rows)

    def some(self, chosen: Sequence[int]) -> _Rows:
        """Some of the entries."""
        return _Rows(self.where, [self.rows[i] for i in chosen], [self.numbers[i] for i in chosen])

    def at(self, i: int, key: str) -> str:
        """Where a field stands, for errors."""
        return f"{self.where}[{self.numbers[i]}].{key}"

    def whole(self, key: str) -> NDArray[np.int64]:
        """Whole numbers (N,) under a key. FormatError naming the first row without one."""
        values = [row.get(key) for row in self.rows]
        if not set(map(type, values)) <= {int}:
            i, value = next((i, v) for i, v in enumerate(values) if type(v) is not int)
            raise FormatError(self.at(i, key), "a whole number", json.dumps(value))
        return np.array(values, np.int64)

    def texts(self, key: str) -> None:
        """FormatError naming the first row whose value under a key is no text; a row may have none."""
        for i, row in enumerate(self.rows):
            if not isinstance(row.get(key, ""), str):
                raise FormatError(self.at(i, key), "text", json.dumps(row[key])[:60])

    def own(self, key: str) -> NDArray[np.int64]:
        """As `whole`, each once."""
        ids = self.whole(key)
        seen: set[int] = set()
        for i, value in enumerate(ids.tolist()):
            if value in seen:
                raise FormatError(self.at(i, key), "an id of its own", value)
            seen.add(value)
        return ids

    def column(self, key: str, missing: float | None) -> NDArray[np.float64]:
        """Finite numbers (N,) under a key, `missing` where a row has none; None: each must have one."""
        values = [row.get(key, missing) for row in self.rows]
        if not set(map(type, values)) <= {int, float}:
            values = [missing if value is None else value for value in values]
            for i, value in enumerate(values):
                if type(value) not in (int, float):
                    raise FormatError(self.at(i, key), "a finite number", json.dumps(value))
        found = np.array(values, np.float64)
        for i in np.flatnonzero(~np.isfinite(found)).tolist():
            if missing is None or self.rows[i].get(key) is not None:
                raise FormatError(self.at(i, key), "a finite number", json.dumps(values[i]))
        return found

    def flags(self, key: str, missing: int) -> NDArray[np.int64]:
        """Numbers (N,) under a key as whole ones, `missing` where a row has none. FormatError for a huge one."""
        found = self.column(key, float(missing))
        for i in np.flatnonzero(np.abs(found) >= _MOST_FLAG)[:1].tolist():
            raise FormatError(self.at(i, key), f"less than {_MOST_FLAG:,}", f"{found[i]:g}")
        return found.astype(np.int64)

    def boxes(self) -> NDArray[np.float64]:
        """Left, top, width, height (N, 4). FormatError naming the first row that has no such box."""
        values = [row.get("bbox") for row in self.rows]
        try:
            told = np.array(values).reshape(len(values), 4)
            boxes = told.astype(np.float64)
            if told.dtype.kind in "iuf" and np.isfinite(boxes).all() and (boxes[:, 2:] >= 0).all():
                return boxes
        except (ValueError, TypeError):
            pass  # one of them is no box: found below
        for i, value in enumerate(values):
            if not (isinstance(value, list) and len(value) == 4 and all(type(v) in (int, float) for v in value)):
                raise FormatError(self.at(i, "bbox"), "x, y, width, height", json.dumps(value)[:60])
            if not all(map(math.isfinite, value)) or value[2] < 0 or value[3] < 0:
                expected = "finite numbers, width and height of at least 0"
                raise FormatError(self.at(i, "bbox"), expected, json.dumps(value)[:60])
        return np.array(values, dtype=np.float64).reshape(len(values), 4)

    def places(self, key: str, ids: NDArray[np.int64], what: str) -> NDArray[np.int64]:
        """The place of each row's number under a key among `ids`. FormatError naming one that is not there."""
        values = self.whole(key)
        order = np.argsort(ids)
        found = values * 0
        other = np.ones(len(values), np.bool_)
        if len(ids):
            found = order[np.searchsorted(ids[order], values).clip(0, len(ids) - 1)]
            other = ids[found] != values
        if other.any():
            unknown = np.unique(values[other])
            shown = ", ".join(map(str, unknown[:_SHOWN])) + (", ..." if len(unknown) > _SHOWN else "")
            where = self.at(int(np.flatnonzero(other)[0]), key)
            raise FormatError(where, f"ids of the {len(ids)} {what}", f"{len(unknown)} others ({shown})")
        return found

    def pose(self, i: int) -> list[float]:
        """Length, height, width, x, y, z, yaw; NaN where the row has none. FormatError for another project's."""
        pose, where = self.rows[i].get("pose"), self.at(i, "pose")
        if pose is None:
            return [math.nan] * 7
        if not isinstance(pose, dict):
            raise FormatError(where, "translation, yaw and size_lhw", json.dumps(pose)[:60])
        translation = _numbers(f"{where}.translation", pose.get("translation"), 3)
        yaw = _numbers(f"{where}.yaw", [pose.get("yaw")], 1)
        size_lhw = _numbers(f"{where}.size_lhw", pose.get("size_lhw"), 3)
        if min(size_lhw) <= 0:
            raise FormatError(f"{where}.size_lhw", "positive metres", size_lhw)
        return [*size_lhw, *translation, *yaw]

    def pose_or_unknown(self, i: int) -> list[float]:
        """As `pose`; another project's is NaN."""
        try:
            return self.pose(i)
        except FormatError:
            return [math.nan] * 7

    def table(
        self,
        frames: Sequence[str],
        kinds: Sequence[str],
        kind_ids: NDArray[np.int64],
        frame: NDArray[np.int64],
        kind: NDArray[np.int64],
        scored: bool,
    ) -> LabelTable:
        """The annotations, or results where `scored`, in columns, in the list's order."""
        keys = set().union(*self.rows)

        def column(key: str, missing: float = math.nan) -> NDArray[np.float64]:
            return self.column(key, missing) if key in keys else np.full(len(self), missing)

        boxes = self.boxes()
        area = np.full(len(self), np.nan) if scored else column("area")
        numbers = [row.get("id") for row in self.rows] if "id" in keys else []
        names = [] if scored else sorted(keys - _OWN_COLUMNS)
        pose = np.full((len(self), 7), np.nan)
        if "pose" in keys:
            pose[:] = [self.pose_or_unknown(i) for i in range(len(self))]
        return LabelTable.of(
            frames,
            kinds,
            frame,
            kind,
            boxes,
            "xywh",
            ignore=np.array([bool(row.get("iscrowd")) for row in self.rows], np.bool_),
            score=self.column("score", None) if scored else np.full(len(self), np.nan),
            truncation=column("truncation", -1.0),
            occlusion=self.flags("occlusion", -1),
            alpha=column("alpha"),
            pose=pose,
            area=np.where(np.isnan(area), boxes[:, 2] * boxes[:, 3], area),
            box_ids=np.array(numbers, np.int64) if numbers and set(map(type, numbers)) == {int} else None,
            kind_ids=kind_ids,
            extra={name: [row.get(name) for row in self.rows] for name in names},
        )

    def check_scene(self) -> None:
        """FormatError for what a scene cannot use: a truncation, an occlusion or a pose of another project."""
        for i, row in enumerate(self.rows):
            truncation, occlusion = row.get("truncation"), row.get("occlusion")
            if truncation is not None and not 0 <= _numbers(self.at(i, "truncation"), [truncation], 1)[0] <= 1:
                raise FormatError(self.at(i, "truncation"), "[0, 1]", truncation)
            if occlusion is not None and (type(occlusion) is not int or not 0 <= occlusion <= 3):
                raise FormatError(self.at(i, "occlusion"), "0, 1, 2 or 3", json.dumps(occlusion))
            self.pose(i)


_OWN_COLUMNS = {
    *("truncation", "occlusion", "alpha", "pose", "score", "area", "bbox", "iscrowd"),
    *("image_id", "category_id", "id"),
}
"""What a column of a table holds: the others are extra."""


class _File:
    """A data set's file, whose annotations belong to images and categories that are there. FormatError.

    images, categories: by id; image_ids, category_ids; frame, kind (N,): of the annotations, places in these.
    """

    def __init__(self, path: Path, content: Any) -> None:
        if not isinstance(content, dict):
            found = "a list (of results?)" if isinstance(content, list) else type(content).__name__
            raise FormatError(str(path), "images, annotations and categories", found)
        self.path = path
        tables = {n: _Rows.of(f"{path}: {n}", content.get(n)) for n in ("images", "categories", "annotations")}
        self.images, self.image_ids = _by_id(tables["images"])
        self.categories, self.category_ids = _by_id(tables["categories"])
        self.kinds = [str(row.get("name", row["id"])) for row in self.categories.rows]
        self.annotations = tables["annotations"]
        self.images.texts("file_name")
        self.categories.texts("name")
        self.frame = self.annotations.places("image_id", self.image_ids, "images")
        self.kind = self.annotations.places("category_id", self.category_ids, "categories")


def _by_id(rows: _Rows) -> tuple[_Rows, NDArray[np.int64]]:
    ids = rows.own("id")
    order = np.argsort(ids, kind="stable")
    return rows.some(order.tolist()), ids[order]


def _files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted((path / "annotations").glob("instances_*.json"))


def read_table(path: Path, scored: bool, truth: LabelTable | None) -> LabelTable:
    """The labels of a data set's file or of the folder that holds one; detections where `scored`: a data set whose
    annotations have scores, or a list of results beside `truth`. FormatError.
    """
    paths = _files_of(path)
    if len(paths) != 1:
        raise FormatError(str(path), "one COCO file (name it)", ", ".join(p.name for p in paths) or "none")
    path = paths[0]
    if not files.read_bytes(path).strip():
        raise FormatError(str(path), "COCO annotations or results", "an empty file")
    content = files.read_json(path)
    if isinstance(content, list) and scored:
        return _results(path, content, truth)
    told = _File(path, content)
    frames = [_identifier(row) for row in told.images.rows]
    if len(set(frames)) != len(frames):
        frames = [str(i) for i in told.image_ids.tolist()]
    sizes_wh = np.stack([told.images.flags(key, 0) for key in ("width", "height")], axis=1)
    table = told.annotations.table(frames, told.kinds, told.category_ids, told.frame, told.kind, scored)
    return replace(
        _merged_regions(table.rows(np.argsort(table.frame, kind="stable"))),
        sizes_wh=sizes_wh,
        image_ids=told.image_ids,
        cameras={i: row["camera"] for i, row in enumerate(told.images.rows) if "camera" in row},
    )


def _merged_regions(table: LabelTable) -> LabelTable:
    """Crowds of every class that are one region in which nothing is judged ("dontcare") become that region."""
    marks = table.extra.get("dontcare")
    if marks is None:
        return table
    marked = np.array([bool(mark) for mark in marks], np.bool_)
    extra = {name: values for name, values in table.extra.items() if name != "dontcare"}
    places = enumerate(zip(table.frame.tolist(), table.boxes.tolist(), marked, strict=True))
    first = _firsts([(frame, *box) if mark else i for i, (frame, box, mark) in places])
    return replace(table, kind=np.where(marked, REGION, table.kind), extra=extra).rows(first)


def _firsts(keys: Iterable[Any]) -> NDArray[np.int64]:
    """The first place of each key, ascending."""
    seen: dict[Any, int] = {}
    for i, key in enumerate(keys):
        seen.setdefault(key, i)
    return np.array(list(seen.values()), np.int64)


def _results(path: Path, content: list[Any], truth: LabelTable | None) -> LabelTable:
    """A list of results, whose ids are those of the labels' file, or frames named by numbers."""
    if truth is None:
        raise FormatError(str(path), "labels beside a list of results", "none")
    if truth.kind_ids is None:
        raise FormatError(str(path), "categories (a COCO data set), as the labels are no COCO file", "a list")
    image_ids = truth.image_ids
    if image_ids is None:
        image_ids = np.array([int(name) if name.isdecimal() else -1 for name in truth.frames], np.int64)
    rows = _Rows.of(str(path), content)
    frame = rows.places("image_id", image_ids, "images")
    kind = rows.places("category_id", truth.kind_ids, "categories")
    table = rows.table(truth.frames, truth.kinds, truth.kind_ids, frame, kind, True)
    return replace(table.rows(np.argsort(table.frame, kind="stable")), image_ids=truth.image_ids)


def _identifier(row: Mapping[str, Any]) -> str:
    name = row.get("file_name")
    return "_".join(Path(str(name)).with_suffix("").parts) if name else str(row["id"])


def images_beside(path: Path, frames: Sequence[str]) -> dict[str, Path]:
    """The images of a file, where they are in COCO's own places."""
    return images_by_place((path.parent / "images", path.parent.parent / "images", path / "images"), frames)


@dataclass(frozen=True, slots=True)
class _Image:
    """An image of one of a data set's files. number: its place among the images; rows: its annotations' places."""

    told: _File
    path: Path
    record: Mapping[str, Any]
    rows: list[int]


class CocoDataset(Frames[_Image]):
    """The frames of a COCO data set.

    root: the folder that holds `annotations/instances_*.json`, all of which are read, or one JSON file. images:
    where the images lie; by default `images/PART`, `PART`, `images`, `PART` with its year ("val2017") beside
    `annotations`, or the JSON's own folder, whichever is there first. focal_px: the focal length of images without
    "camera". kinds: categories that are objects here, the others are background; None: all.

    A frame's identifier is its file name without suffix, folders joined by "_". `kind` is the category's name as
    written; `COCO_ROAD_USERS` reads COCO's own. Unknown truncation and 3D boxes are NaN, unknown occlusion 3, as
    in KITTI; crowds are regions to ignore. Raises FormatError naming file and field; a frame's own faults are
    raised by `labels` and `frame`, so that the other frames can be used.
    """

    def __init__(
        self,
        root: Path,
        images: Path | None = None,
        focal_px: float | None = None,
        kinds: Collection[str] | None = None,
    ) -> None:
        root = Path(root)
        check_focal(focal_px)
        self.focal_px = focal_px
        self._kinds = kinds
        paths = _files_of(root)
        if not paths:
            raise FormatError(str(root / "annotations"), "instances_*.json", "none")
        entries: dict[str, _Image] = {}
        for path in paths:
            told = _File(path, files.read_json(path))
            folder = _images_of(path) if images is None else Path(images)
            by_image: list[list[int]] = [[] for _ in told.images.rows]
            for row, frame in enumerate(told.frame.tolist()):
                by_image[frame].append(row)
            for i, record in enumerate(told.images.rows):
                for key in ("height", "width"):
                    if type(record.get(key)) is not int or record[key] < 1:
                        found = json.dumps(record.get(key))
                        raise FormatError(told.images.at(i, key), "a positive integer", found)
                if "file_name" not in record:
                    raise FormatError(told.images.at(i, "file_name"), "a value", "none")
                name = Path(str(record["file_name"]))
                if name.is_absolute() or ".." in name.parts:
                    raise FormatError(told.images.at(i, "file_name"), f"a file in {folder}", repr(str(name)))
                identifier = _identifier(record)
                if identifier in entries:
                    found = f"{name}, twice: open one file alone"
                    raise FormatError(told.images.at(i, "file_name"), "a name of its own", found)
                entries[identifier] = _Image(told, folder / name, record, by_image[i])
        super().__init__("the COCO file", dict(sorted(entries.items())))

    def _things(self, identifier: str) -> tuple[_Rows, LabelTable, NDArray[np.int64]]:
        """A frame's annotations of the chosen kinds, these in columns, and the rows that are objects."""
        image = self._entry(identifier)
        told = image.told
        chosen = [r for r in image.rows if self._kinds is None or told.kinds[told.kind[r]] in self._kinds]
        rows = told.annotations.some(chosen)
        frame = np.zeros(len(rows), np.int64)
        table = rows.table((identifier,), told.kinds, told.category_ids, frame, told.kind[chosen], False)
        ignore = np.array([bool(row.get("iscrowd") or row.get("ignore")) for row in rows.rows], np.bool_)
        return rows, replace(table, ignore=ignore), np.flatnonzero(~ignore)

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame. FormatError naming the annotation and its field."""
        rows, table, objects = self._things(identifier)
        rows.some(objects.tolist()).check_scene()
        places = enumerate(zip(table.boxes.tolist(), table.ignore.tolist(), strict=True))
        return table.rows(_firsts(tuple(box) if ignored else i for i, (box, ignored) in places)).labels()

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph, camera, labels, and masks (M, H, W) where every object has a segmentation.

        Raises FormatError naming the file and field: an image that is missing or of another size; an image without
        "camera" where no focal_px was given; a segmentation that does not decode.
        """
        entry = self._entry(identifier)
        path, record = entry.told.path, entry.record
        camera = self._camera(f"{path}: {record['file_name']}", record)
        labels = self.labels(identifier)
        image = files.read_image(entry.path, (camera.height, camera.width))
        rows, _, objects = self._things(identifier)
        rows = rows.some(objects.tolist())
        masks = None
        if all(row.get("segmentation") for row in rows.rows):
            masks = torch.zeros(len(rows), camera.height, camera.width)
            for i, row in enumerate(rows.rows):
                mask = _decode(rows.at(i, "segmentation"), row["segmentation"], masks[i].shape)
                masks[i] = torch.from_numpy(mask)
        return Frame(
            identifier=identifier,
            photograph=as_photograph(image),
            camera=camera,
            labels=labels,
            masks=masks,
            provenance={"dataset": "coco", "image": str(record["file_name"]), "folder": path.name},
        )

    def _camera(self, where: str, record: Mapping[str, Any]) -> Camera:
        height, width = record["height"], record["width"]
        if "camera" not in record:
            if self.focal_px is None:
                raise FormatError(f"{where}: camera", "intrinsics, or a focal length (focal_px)", "neither")
            return pinhole(height, width, self.focal_px)
        camera = record["camera"] if isinstance(record["camera"], dict) else {}
        if "projection" in camera:
            values = _numbers(f"{where}: camera.projection", camera["projection"], 12)
            projection = torch.tensor(values).reshape(3, 4)
            intrinsics = projection[:, :3].clone()
        else:
            fx, fy, cx, cy = _numbers(
                f"{where}: camera fx, fy, cx, cy", [camera.get(k) for k in ("fx", "fy", "cx", "cy")], 4
            )
            projection, intrinsics = None, torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            return Camera(intrinsics, height, width, projection)
        except SceneError as error:
            raise FormatError(f"{where}: {error.field}", error.expected, error.actual) from error


def _images_of(path: Path) -> Path:
    """Where the images of an annotation file lie; see `CocoDataset`."""
    part = path.stem.removeprefix("instances_")
    root = path.parent.parent if path.parent.name == "annotations" else path.parent
    candidates = (root / "images" / part, root / part, root / "images")
    return next((folder for folder in candidates if folder.is_dir()), path.parent)


def _runs(counts: str) -> list[int]:
    """COCO's compressed run lengths: 6 bits a character, 5 of them value, the sixth "more follows"; from the third
    on, differences to the run before last (pycocotools, rleFrString). ValueError where the text ends too early.
    """
    runs: list[int] = []
    value = shift = 0
    for character in counts.encode("ascii"):
        bits = character - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("a number that is cut off")
    return runs


def _decode(where: str, segmentation: Any, size_hw: Sequence[int]) -> np.ndarray:
    """A mask (H, W) uint8 of run lengths, compressed or not, or of polygons. FormatError."""
    height, width = size_hw
    counts: Any = None
    if isinstance(segmentation, list):
        for i, polygon in enumerate(segmentation):
            corners = _numbers(f"{where}[{i}]", polygon, len(polygon) if isinstance(polygon, list) else 6)
            if len(corners) < 6 or len(corners) % 2 or max(map(abs, corners)) > 2 * max(height, width):
                raise FormatError(f"{where}[{i}]", "x and y of three or more corners", json.dumps(polygon)[:60])
        counts = _counts(run_length.merge(run_length.frPyObjects(segmentation, height, width)))
    elif isinstance(segmentation, dict) and segmentation.get("size") == [height, width]:
        counts = segmentation.get("counts")
    else:
        raise FormatError(where, f"polygons, or run lengths of {width}x{height} px", json.dumps(segmentation)[:60])
    try:
        runs = np.array(_runs(counts) if isinstance(counts, str) else counts, dtype=np.int64)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(f"{where}.counts", "run lengths", error) from error
    # checked and laid out here: pycocotools leaves memory as it was where runs do not fill the image
    if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
        raise FormatError(f"{where}.counts", f"runs that fill {height * width} px", f"{runs.sum()} px")
    return np.repeat(np.arange(len(runs)) % 2, runs).reshape(width, height).T.astype(np.uint8)
