"""COCO's annotation files and lists of results as columns, without torch or pycocotools."""

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

_FOLDER_OR_HIDDEN = re.compile(r"[/\\:]|^\.")
"""Matches file names that are more than a stem and a suffix."""
Ids: TypeAlias = "NDArray[np.int64] | NDArray[np.str_]"
_MAX_VALUE = 2**31
"""Exclusive limit of occlusions, box coordinates and image sides."""
_MAX_EXAMPLES = 3
"""Number of unknown ids that an error names."""


def parse_numbers(where: str, value: Any, count: int) -> list[float]:
    """Check a list of numbers.

    Args:
        where: Field, for errors.
        value: JSON value.
        count: Required length.

    Returns:
        The numbers.

    Raises:
        FormatError: Unless the value is a list of `count` finite numbers.
    """
    good = isinstance(value, list) and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    if not good or len(value) != count:
        raise FormatError(where, f"{count} finite numbers", json.dumps(value)[:60])
    return [float(v) for v in value]


@dataclass(frozen=True, slots=True)
class JsonRows:
    """Entries of a JSON list of objects, read by column."""

    where: str
    """File and name of the list, for errors."""
    rows: Sequence[Mapping[str, Any]]
    """The entries (N,)."""
    numbers: Sequence[int]
    """Index of each entry in the list."""

    @classmethod
    def from_list(cls, where: str, rows: Any) -> JsonRows:
        """Wrap all entries of a list. Raises FormatError if it is not a list of objects."""
        if not isinstance(rows, list):
            raise FormatError(where, "a list", "none" if rows is None else type(rows).__name__)
        if not set(map(type, rows)) <= {dict}:
            i, row = next((i, r) for i, r in enumerate(rows) if not isinstance(r, dict))
            raise FormatError(f"{where}[{i}]", "an object", type(row).__name__)
        return cls(where, rows, range(len(rows)))

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, chosen: Sequence[int]) -> JsonRows:
        """Select entries by index."""
        return JsonRows(self.where, [self.rows[i] for i in chosen], [self.numbers[i] for i in chosen])

    def locate(self, i: int, key: str) -> str:
        """Return the path of a field, for errors."""
        return f"{self.where}[{self.numbers[i]}].{key}"

    def values(self, key: str, missing: Any = None) -> list[Any]:
        """Return the values (N,) of a key."""
        try:
            return list(map(itemgetter(key), self.rows))
        except KeyError:
            return [row.get(key, missing) for row in self.rows]

    def integers(self, key: str) -> NDArray[np.int64]:
        """Return the integers (N,) of a key. Raises FormatError naming the first row without one."""
        values = self.values(key)
        if not set(map(type, values)) <= {int}:
            i, value = next((i, v) for i, v in enumerate(values) if type(v) is not int)
            raise FormatError(self.locate(i, key), "a whole number", json.dumps(value))
        return np.array(values, np.int64)

    def check_texts(self, key: str) -> None:
        """Raise FormatError naming the first row with a value of a key that is not text; it may be missing."""
        for i, row in enumerate(self.rows):
            if not isinstance(row.get(key, ""), str):
                raise FormatError(self.locate(i, key), "text", json.dumps(row[key])[:60])

    def ids(self, key: str) -> Ids:
        """Return the ids (N,) of a key: texts if all are, else integers. Raises FormatError naming a wrong row."""
        values = self.values(key)
        return np.array(values, np.str_) if values and set(map(type, values)) == {str} else self.integers(key)

    def unique_ids(self, key: str) -> Ids:
        """Return ids as `ids`, each unique."""
        ids = self.ids(key)
        seen: set[int | str] = set()
        for i, value in enumerate(ids.tolist()):
            if value in seen:
                raise FormatError(self.locate(i, key), "a unique id", value)
            seen.add(value)
        return ids

    def column(self, key: str, missing: float | None) -> NDArray[np.float64]:
        """Return finite numbers (N,) of a key, `missing` if a row has none; None: each row must have one."""
        values = self.values(key, missing)
        if not set(map(type, values)) <= {int, float}:
            values = [missing if value is None else value for value in values]
            for i, value in enumerate(values):
                if type(value) not in (int, float):
                    raise FormatError(self.locate(i, key), "a finite number", json.dumps(value))
        numbers = np.array(values, np.float64)
        for i in np.flatnonzero(~np.isfinite(numbers)).tolist():
            if missing is None or self.rows[i].get(key) is not None:
                raise FormatError(self.locate(i, key), "a finite number", json.dumps(values[i]))
        return numbers

    def flags(self, key: str, missing: int) -> NDArray[np.int64]:
        """Return numbers (N,) of a key as integers, `missing` if a row has none. Raises FormatError for a huge one."""
        numbers = self.column(key, float(missing))
        for i in np.flatnonzero(np.abs(numbers) >= _MAX_VALUE)[:1].tolist():
            raise FormatError(self.locate(i, key), f"less than {_MAX_VALUE:,}", f"{numbers[i]:g}")
        return numbers.astype(np.int64)

    def boxes(self) -> NDArray[np.float64]:
        """Return left, top, width, height (N, 4). Raises FormatError naming the first row without such a box."""
        values = self.values("bbox")
        try:
            array = np.array(values).reshape(len(values), 4)
            boxes = array.astype(np.float64)
            if array.dtype.kind in "iuf" and (np.abs(boxes) < _MAX_VALUE).all() and (boxes[:, 2:] >= 0).all():
                return boxes
        except (ValueError, TypeError):
            pass  # the row is found below
        for i, value in enumerate(values):
            if not (isinstance(value, list) and len(value) == 4 and all(type(v) in (int, float) for v in value)):
                raise FormatError(self.locate(i, "bbox"), "x, y, width, height", json.dumps(value)[:60])
            if not all(abs(v) < _MAX_VALUE for v in value) or value[2] < 0 or value[3] < 0:
                expected = f"numbers below {_MAX_VALUE:,}, width and height of at least 0"
                raise FormatError(self.locate(i, "bbox"), expected, json.dumps(value)[:60])
        return np.array(values, dtype=np.float64).reshape(len(values), 4)

    def indices(self, key: str, ids: Ids, what: str) -> NDArray[np.int64]:
        """Find the index of each row's id.

        Args:
            key: Key of the rows' ids.
            ids: All ids.
            what: What these are the ids of, for errors.

        Returns:
            Index (N,) into `ids`.

        Raises:
            FormatError: Names an id that is not among `ids`.
        """
        values = self.ids(key)
        if len(values) and len(ids) and values.dtype.kind != ids.dtype.kind:
            expected = f"{'texts' if ids.dtype.kind == 'U' else 'whole numbers'}, as the ids of the {what} are"
            raise FormatError(self.locate(0, key), expected, json.dumps(values[0].item()))
        order = np.argsort(ids)
        index = np.zeros(len(values), np.int64)
        missing = np.ones(len(values), np.bool_)
        if len(ids):
            index = order[np.searchsorted(ids[order], values).clip(0, len(ids) - 1)]
            missing = ids[index] != values
        if missing.any():
            unknown = np.unique(values[missing])
            examples = ", ".join(map(str, unknown[:_MAX_EXAMPLES])) + (
                ", ..." if len(unknown) > _MAX_EXAMPLES else ""
            )
            where = self.locate(int(np.flatnonzero(missing)[0]), key)
            raise FormatError(where, f"ids of the {len(ids)} {what}", f"{len(unknown)} others ({examples})")
        return index

    def pose(self, i: int) -> list[float]:
        """Return length, height, width, x, y, z, yaw; NaN if missing. Raises FormatError for another project's pose."""
        pose, where = self.rows[i].get("pose"), self.locate(i, "pose")
        if pose is None:
            return [math.nan] * 7
        if not isinstance(pose, dict):
            raise FormatError(where, "translation, yaw and size_lhw", json.dumps(pose)[:60])
        translation = parse_numbers(f"{where}.translation", pose.get("translation"), 3)
        yaw = parse_numbers(f"{where}.yaw", [pose.get("yaw")], 1)
        size_lhw = parse_numbers(f"{where}.size_lhw", pose.get("size_lhw"), 3)
        if min(size_lhw) <= 0:
            raise FormatError(f"{where}.size_lhw", "positive metres", size_lhw)
        return [*size_lhw, *translation, *yaw]

    def pose_or_nan(self, i: int) -> list[float]:
        """Return the pose; NaN for another project's."""
        try:
            return self.pose(i)
        except FormatError:
            return [math.nan] * 7

    def to_table(
        self,
        frames: Sequence[str],
        kinds: Sequence[str],
        kind_ids: NDArray[np.int64],
        frame: NDArray[np.int64],
        kind: NDArray[np.int64],
        scored: bool,
    ) -> LabelTable:
        """Convert annotations, or results if `scored`, to columns, in the list's order.

        Args:
            frames: Names of the images.
            kinds: Names of the categories.
            kind_ids: Ids of the categories.
            frame: Image index of each row (N,).
            kind: Category index of each row (N,).
            scored: Whether the rows are results with scores.

        Returns:
            The table.
        """
        keys = set().union(*self.rows)

        def column(key: str, missing: float = math.nan) -> NDArray[np.float64]:
            return self.column(key, missing) if key in keys else np.full(len(self), missing)

        boxes = self.boxes()
        area = np.full(len(self), np.nan) if scored else column("area")
        numbers = self.values("id") if "id" in keys else []
        names = [] if scored else sorted(keys - _TABLE_COLUMNS)
        pose = np.full((len(self), 7), np.nan)
        if "pose" in keys:
            pose[:] = [self.pose_or_nan(i) for i in range(len(self))]
        return LabelTable.from_columns(
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
        """Raise FormatError for a truncation, an occlusion or a pose that a scene cannot use."""
        for i, row in enumerate(self.rows):
            truncation, occlusion = row.get("truncation"), row.get("occlusion")
            if (
                truncation is not None
                and not 0 <= parse_numbers(self.locate(i, "truncation"), [truncation], 1)[0] <= 1
            ):
                raise FormatError(self.locate(i, "truncation"), "[0, 1]", truncation)
            if occlusion is not None and (type(occlusion) is not int or not 0 <= occlusion <= 3):
                raise FormatError(self.locate(i, "occlusion"), "0, 1, 2 or 3", json.dumps(occlusion))
            self.pose(i)


_TABLE_COLUMNS = {
    *("truncation", "occlusion", "alpha", "pose", "score", "area", "bbox", "iscrowd"),
    *("image_id", "category_id", "id"),
}
"""Keys with a column in LabelTable; others go to `extra`."""


class AnnotationFile:
    """A data set's file: images and categories sorted by id, annotations in file order, each with both.

    Raises FormatError for a file that is not of this form.
    """

    def __init__(self, path: Path, content: Any) -> None:
        if not isinstance(content, dict):
            found = "a list (of results?)" if isinstance(content, list) else type(content).__name__
            raise FormatError(str(path), "images, annotations and categories", found)
        self.path = path
        tables = {
            n: JsonRows.from_list(f"{path}: {n}", content.get(n)) for n in ("images", "categories", "annotations")
        }
        self.images, self.image_ids = _sort_by_id(tables["images"], tables["images"].unique_ids("id"))
        tables["categories"].unique_ids("id")
        self.categories, self.category_ids = _sort_by_id(tables["categories"], tables["categories"].integers("id"))
        self.kinds = [str(row.get("name", row["id"])) for row in self.categories.rows]
        self.annotations = tables["annotations"]
        self.images.check_texts("file_name")
        for i, name in enumerate(self.images.values("file_name")):
            if name and name[-1] in "./" and not Path(name).name:
                raise FormatError(self.images.locate(i, "file_name"), "the name of a file", json.dumps(name))
        self.categories.check_texts("name")
        self.annotation_image = self.annotations.indices("image_id", self.image_ids, "images")
        self.annotation_category = self.annotations.indices("category_id", self.category_ids, "categories")

    def frame_names(self) -> list[str]:
        """Return the images' names in a table: those of their files, or their ids if file names are not unique."""
        names = [frame_identifier(row) for row in self.images.rows]
        return names if len(set(names)) == len(names) else [str(i) for i in self.image_ids.tolist()]

    def file_names(self) -> dict[int, str]:
        """Return the images' file names by index; an image may have none."""
        return {i: name for i, name in enumerate(self.images.values("file_name")) if name}


def _sort_by_id(rows: JsonRows, ids: Ids) -> tuple[JsonRows, Any]:
    order = np.argsort(ids, kind="stable")
    return rows.select(order.tolist()), ids[order]


def list_annotation_files(path: Path) -> list[Path]:
    """List the annotation files of a folder, or the file itself."""
    return [path] if path.is_file() else sorted((path / "annotations").glob("instances_*.json"))


def read_table(path: Path, scored: bool, truth: LabelTable | None) -> LabelTable:
    """Read labels or detections of a data set's file, or of the folder with one.

    Args:
        path: File or folder.
        scored: Read detections: a data set with scores, or a list of results.
        truth: Labels with the ids to which a list of results refers.

    Returns:
        The labels or detections.

    Raises:
        FormatError: Names the file and the entry.
    """
    paths = list_annotation_files(path)
    if len(paths) != 1:
        raise FormatError(str(path), "one COCO file (name it)", ", ".join(p.name for p in paths) or "none")
    path = paths[0]
    if not files.read_bytes(path).strip():
        raise FormatError(str(path), "COCO annotations or results", "an empty file")
    content = files.read_json(path)
    if isinstance(content, list) and scored:
        return _read_results(path, content, truth)
    data = AnnotationFile(path, content)
    frames = data.frame_names()
    sizes_wh = np.stack([data.images.flags(key, 0) for key in ("width", "height")], axis=1)
    table = data.annotations.to_table(
        frames, data.kinds, data.category_ids, data.annotation_image, data.annotation_category, scored
    )
    return replace(
        _merge_regions(table.select(np.argsort(table.frame, kind="stable"))),
        sizes_wh=sizes_wh,
        image_ids=data.image_ids,
        cameras={i: row["camera"] for i, row in enumerate(data.images.rows) if "camera" in row},
        image_files=data.file_names(),
    )


def _merge_regions(table: LabelTable) -> LabelTable:
    """Merge the crowds of all classes that mark one DontCare region ("dontcare") into that region."""
    marks = table.extra.get("dontcare")
    if marks is None:
        return table
    marked = np.array([bool(mark) for mark in marks], np.bool_)
    extra = {name: values for name, values in table.extra.items() if name != "dontcare"}
    rows = enumerate(zip(table.frame.tolist(), table.boxes.tolist(), marked, strict=True))
    first = first_occurrences([(frame, *box) if mark else i for i, (frame, box, mark) in rows])
    return replace(table, kind=np.where(marked, REGION, table.kind), extra=extra).select(first)


def first_occurrences(keys: Iterable[Any]) -> NDArray[np.int64]:
    """Return the index of each key's first occurrence, ascending."""
    seen: dict[Any, int] = {}
    for i, key in enumerate(keys):
        seen.setdefault(key, i)
    return np.array(list(seen.values()), np.int64)


def _read_results(path: Path, content: list[Any], truth: LabelTable | None) -> LabelTable:
    """Read a list of results with the ids of the labels' file, or with the numbers that name the frames."""
    if truth is None:
        raise FormatError(str(path), "labels for a list of results", "none")
    if truth.kind_ids is None:
        raise FormatError(str(path), "categories (a COCO data set), as the labels are no COCO file", "a list")
    image_ids: Ids | None = truth.image_ids
    if image_ids is None:
        image_ids = np.array([int(name) if name.isdecimal() else -1 for name in truth.frames], np.int64)
    rows = JsonRows.from_list(str(path), content)
    frame = rows.indices("image_id", image_ids, "images")
    kind = rows.indices("category_id", truth.kind_ids, "categories")
    table = rows.to_table(truth.frames, truth.kinds, truth.kind_ids, frame, kind, True)
    return replace(table.select(np.argsort(table.frame, kind="stable")), image_ids=truth.image_ids)


def frame_identifier(row: Mapping[str, Any]) -> str:
    """Return an image's name: its file name without suffix, folders joined by "_", or its id."""
    name = row.get("file_name")
    if name and not _FOLDER_OR_HIDDEN.search(name):
        stem, _, suffix = name.rpartition(".")
        return stem if stem and suffix else name
    return "_".join(Path(str(name)).with_suffix("").parts) if name else str(row["id"])
