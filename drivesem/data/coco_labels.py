"""COCO's annotation files and lists of results as columns: read without torch or pycocotools."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivesem.data.label_table import REGION, LabelTable
from scene_ir import files
from scene_ir.errors import FormatError

_IN_FOLDERS = re.compile(r"[/\\:]|^\.")
"""In names of files, what makes them more than a stem and a suffix."""
Ids: TypeAlias = "NDArray[np.int64] | NDArray[np.str_]"
_MOST_FLAG = 2**31
"""Above occlusions, boxes and sides of images."""
_SHOWN = 3
"""Ids that an error names."""


def numbers_of(where: str, value: Any, count: int) -> list[float]:
    """`count` finite numbers. FormatError."""
    good = isinstance(value, list) and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    if not good or len(value) != count:
        raise FormatError(where, f"{count} finite numbers", json.dumps(value)[:60])
    return [float(v) for v in value]


@dataclass(frozen=True, slots=True)
class Rows:
    """Entries of a list in the file. where: the list, for errors; numbers: the place of each in it."""

    where: str
    rows: Sequence[Mapping[str, Any]]
    numbers: Sequence[int]

    @classmethod
    def of(cls, where: str, rows: Any) -> Rows:
        """All entries of a list. FormatError where it is none, or one of them no object."""
        if not isinstance(rows, list):
            raise FormatError(where, "a list", "none" if rows is None else type(rows).__name__)
        if not set(map(type, rows)) <= {dict}:
            i, row = next((i, r) for i, r in enumerate(rows) if not isinstance(r, dict))
            raise FormatError(f"{where}[{i}]", "an object", type(row).__name__)
        return cls(where, rows, range(len(rows)))

    def __len__(self) -> int:
        return len(self.rows)

    def some(self, chosen: Sequence[int]) -> Rows:
        """Some of the entries."""
        return Rows(self.where, [self.rows[i] for i in chosen], [self.numbers[i] for i in chosen])

    def at(self, i: int, key: str) -> str:
        """Where a field stands, for errors."""
        return f"{self.where}[{self.numbers[i]}].{key}"

    def values(self, key: str, missing: Any = None) -> list[Any]:
        """What the entries (N,) have under a key."""
        try:
            return list(map(itemgetter(key), self.rows))
        except KeyError:
            return [row.get(key, missing) for row in self.rows]

    def whole(self, key: str) -> NDArray[np.int64]:
        """Whole numbers (N,) under a key. FormatError naming the first row without one."""
        values = self.values(key)
        if not set(map(type, values)) <= {int}:
            i, value = next((i, v) for i, v in enumerate(values) if type(v) is not int)
            raise FormatError(self.at(i, key), "a whole number", json.dumps(value))
        return np.array(values, np.int64)

    def texts(self, key: str) -> None:
        """FormatError naming the first row whose value under a key is no text; a row may have none."""
        for i, row in enumerate(self.rows):
            if not isinstance(row.get(key, ""), str):
                raise FormatError(self.at(i, key), "text", json.dumps(row[key])[:60])

    def ids(self, key: str) -> Ids:
        """Whole numbers (N,), or texts where all are, under a key. FormatError naming a row with neither."""
        values = self.values(key)
        return np.array(values, np.str_) if values and set(map(type, values)) == {str} else self.whole(key)

    def own(self, key: str) -> Ids:
        """As `ids`, each once."""
        ids = self.ids(key)
        seen: set[int | str] = set()
        for i, value in enumerate(ids.tolist()):
            if value in seen:
                raise FormatError(self.at(i, key), "an id of its own", value)
            seen.add(value)
        return ids

    def column(self, key: str, missing: float | None) -> NDArray[np.float64]:
        """Finite numbers (N,) under a key, `missing` where a row has none; None: each must have one."""
        values = self.values(key, missing)
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
        values = self.values("bbox")
        try:
            told = np.array(values).reshape(len(values), 4)
            boxes = told.astype(np.float64)
            if told.dtype.kind in "iuf" and (np.abs(boxes) < _MOST_FLAG).all() and (boxes[:, 2:] >= 0).all():
                return boxes
        except (ValueError, TypeError):
            pass  # one of them is no box: found below
        for i, value in enumerate(values):
            if not (isinstance(value, list) and len(value) == 4 and all(type(v) in (int, float) for v in value)):
                raise FormatError(self.at(i, "bbox"), "x, y, width, height", json.dumps(value)[:60])
            if not all(abs(v) < _MOST_FLAG for v in value) or value[2] < 0 or value[3] < 0:
                expected = f"numbers below {_MOST_FLAG:,}, width and height of at least 0"
                raise FormatError(self.at(i, "bbox"), expected, json.dumps(value)[:60])
        return np.array(values, dtype=np.float64).reshape(len(values), 4)

    def places(self, key: str, ids: Ids, what: str) -> NDArray[np.int64]:
        """The place of each row's id under a key among `ids`. FormatError naming one that is not there."""
        values = self.ids(key)
        if len(values) and len(ids) and values.dtype.kind != ids.dtype.kind:
            expected = f"{'texts' if ids.dtype.kind == 'U' else 'whole numbers'}, as the ids of the {what} are"
            raise FormatError(self.at(0, key), expected, json.dumps(values[0].item()))
        order = np.argsort(ids)
        found = np.zeros(len(values), np.int64)
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
        translation = numbers_of(f"{where}.translation", pose.get("translation"), 3)
        yaw = numbers_of(f"{where}.yaw", [pose.get("yaw")], 1)
        size_lhw = numbers_of(f"{where}.size_lhw", pose.get("size_lhw"), 3)
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
        numbers = self.values("id") if "id" in keys else []
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
            ignore=np.array(list(map(bool, self.values("iscrowd"))), np.bool_)
            if "iscrowd" in keys
            else np.zeros(len(self), np.bool_),
            score=self.column("score", None) if scored else np.full(len(self), np.nan),
            truncation=column("truncation", -1.0),
            occlusion=self.flags("occlusion", -1) if "occlusion" in keys else np.full(len(self), -1),
            alpha=column("alpha"),
            pose=pose,
            area=np.where(np.isnan(area), boxes[:, 2] * boxes[:, 3], area),
            box_ids=np.array(numbers, np.int64) if numbers and set(map(type, numbers)) == {int} else None,
            kind_ids=kind_ids,
            extra={name: self.values(name) for name in names},
        )

    def check_scene(self) -> None:
        """FormatError for what a scene cannot use: a truncation, an occlusion or a pose of another project."""
        for i, row in enumerate(self.rows):
            truncation, occlusion = row.get("truncation"), row.get("occlusion")
            if truncation is not None and not 0 <= numbers_of(self.at(i, "truncation"), [truncation], 1)[0] <= 1:
                raise FormatError(self.at(i, "truncation"), "[0, 1]", truncation)
            if occlusion is not None and (type(occlusion) is not int or not 0 <= occlusion <= 3):
                raise FormatError(self.at(i, "occlusion"), "0, 1, 2 or 3", json.dumps(occlusion))
            self.pose(i)


_OWN_COLUMNS = {
    *("truncation", "occlusion", "alpha", "pose", "score", "area", "bbox", "iscrowd"),
    *("image_id", "category_id", "id"),
}
"""What a column of a table holds: the others are extra."""


class AnnotationFile:
    """A data set's file, whose annotations belong to images and categories that are there. FormatError.

    images, categories: by id; image_ids, category_ids; frame, kind (N,): of the annotations, places in these.
    """

    def __init__(self, path: Path, content: Any) -> None:
        if not isinstance(content, dict):
            found = "a list (of results?)" if isinstance(content, list) else type(content).__name__
            raise FormatError(str(path), "images, annotations and categories", found)
        self.path = path
        tables = {n: Rows.of(f"{path}: {n}", content.get(n)) for n in ("images", "categories", "annotations")}
        self.images, self.image_ids = _by_id(tables["images"], tables["images"].own("id"))
        tables["categories"].own("id")
        self.categories, self.category_ids = _by_id(tables["categories"], tables["categories"].whole("id"))
        self.kinds = [str(row.get("name", row["id"])) for row in self.categories.rows]
        self.annotations = tables["annotations"]
        self.images.texts("file_name")
        for i, name in enumerate(self.images.values("file_name")):
            if name and name[-1] in "./" and not Path(name).name:
                raise FormatError(self.images.at(i, "file_name"), "the name of a file", json.dumps(name))
        self.categories.texts("name")
        self.frame = self.annotations.places("image_id", self.image_ids, "images")
        self.kind = self.annotations.places("category_id", self.category_ids, "categories")

    def frames(self) -> list[str]:
        """What a table calls the images: as their files, or as their ids where two files are called alike."""
        names = [identifier_of(row) for row in self.images.rows]
        return names if len(set(names)) == len(names) else [str(i) for i in self.image_ids.tolist()]

    def file_names(self) -> dict[int, str]:
        """The images' files by the image's place; an image may have none."""
        return {i: name for i, name in enumerate(self.images.values("file_name")) if name}


def _by_id(rows: Rows, ids: Ids) -> tuple[Rows, Any]:
    order = np.argsort(ids, kind="stable")
    return rows.some(order.tolist()), ids[order]


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted((path / "annotations").glob("instances_*.json"))


def read_table(path: Path, scored: bool, truth: LabelTable | None) -> LabelTable:
    """The labels of a data set's file or of the folder that holds one; detections where `scored`: a data set whose
    annotations have scores, or a list of results beside `truth`. FormatError.
    """
    paths = files_of(path)
    if len(paths) != 1:
        raise FormatError(str(path), "one COCO file (name it)", ", ".join(p.name for p in paths) or "none")
    path = paths[0]
    if not files.read_bytes(path).strip():
        raise FormatError(str(path), "COCO annotations or results", "an empty file")
    content = files.read_json(path)
    if isinstance(content, list) and scored:
        return _results(path, content, truth)
    told = AnnotationFile(path, content)
    frames = told.frames()
    sizes_wh = np.stack([told.images.flags(key, 0) for key in ("width", "height")], axis=1)
    table = told.annotations.table(frames, told.kinds, told.category_ids, told.frame, told.kind, scored)
    return replace(
        _merged_regions(table.rows(np.argsort(table.frame, kind="stable"))),
        sizes_wh=sizes_wh,
        image_ids=told.image_ids,
        cameras={i: row["camera"] for i, row in enumerate(told.images.rows) if "camera" in row},
        image_files=told.file_names(),
    )


def _merged_regions(table: LabelTable) -> LabelTable:
    """Crowds of every class that are one region in which nothing is judged ("dontcare") become that region."""
    marks = table.extra.get("dontcare")
    if marks is None:
        return table
    marked = np.array([bool(mark) for mark in marks], np.bool_)
    extra = {name: values for name, values in table.extra.items() if name != "dontcare"}
    places = enumerate(zip(table.frame.tolist(), table.boxes.tolist(), marked, strict=True))
    first = firsts([(frame, *box) if mark else i for i, (frame, box, mark) in places])
    return replace(table, kind=np.where(marked, REGION, table.kind), extra=extra).rows(first)


def firsts(keys: Iterable[Any]) -> NDArray[np.int64]:
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
    image_ids: Ids | None = truth.image_ids
    if image_ids is None:
        image_ids = np.array([int(name) if name.isdecimal() else -1 for name in truth.frames], np.int64)
    rows = Rows.of(str(path), content)
    frame = rows.places("image_id", image_ids, "images")
    kind = rows.places("category_id", truth.kind_ids, "categories")
    table = rows.table(truth.frames, truth.kinds, truth.kind_ids, frame, kind, True)
    return replace(table.rows(np.argsort(table.frame, kind="stable")), image_ids=truth.image_ids)


def identifier_of(row: Mapping[str, Any]) -> str:
    name = row.get("file_name")
    if name and not _IN_FOLDERS.search(name):
        stem, _, suffix = name.rpartition(".")
        return stem if stem and suffix else name
    return "_".join(Path(str(name)).with_suffix("").parts) if name else str(row["id"])
