"""COCO's annotation files and lists of results as columns, without torch or pycocotools."""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from os.path import isfile  # False for names that are too long or have a NUL
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from drivesem.data import fiftyone
from drivesem.data.account import IMAGE_SUFFIXES, DataAccount, account_for_files
from drivesem.data.image_headers import read_header, read_upright_size
from drivesem.data.json_columns import BoxRowColumns
from drivesem.data.label_table import REGION, LabelTable, join_tables, repeat_value
from scene_ir import files
from scene_ir.errors import FormatError

_UNUSUAL_NAME = re.compile(r"[\\:]|^/|(^|/)\.\.?(/|$)")
"""Matches file names that are no plain relative paths: URLs, absolute ones, with backslashes, or with ".."."""
_OTHER_TASKS = ("person_keypoints_", "captions_", "stuff_", "panoptic_", "image_info_")
"""Beginnings of the names of COCO's annotation files without boxes of all objects."""
_HEAD_BYTES = 1 << 16
_DATASET_START = re.compile(rb'"(images|annotations|categories)"\s*:\s*\[|"labels"\s*:\s*\{')
"""Matches the first keys of a data set's file; results are a list."""
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
        if isinstance(rows, BoxRowColumns):
            return cls(where, rows, range(len(rows)))
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
        if isinstance(self.rows, BoxRowColumns):
            return self.rows.column(key, missing)
        try:
            return list(map(itemgetter(key), self.rows))
        except KeyError:
            return [row.get(key, missing) for row in self.rows]

    def key_names(self) -> set[str]:
        """Return the keys that occur."""
        return self.rows.key_names() if isinstance(self.rows, BoxRowColumns) else set().union(*self.rows)

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

    def drop_repeated(self, repairs: Counter[str]) -> JsonRows:
        """Drop entries that the list has twice, and count them.

        Raises FormatError naming two different entries with one id.
        """
        first: dict[int | str, int] = {}
        for i, value in enumerate(self.ids("id").tolist()):
            if self.rows[first.setdefault(value, i)] != self.rows[i]:
                found = f"{value}, as {self.locate(first[value], 'id')}"
                raise FormatError(self.locate(i, "id"), "a unique id", found)
        if len(first) == len(self):
            return self
        repairs["entries that are given twice"] += len(self) - len(first)
        return self.select(list(first.values()))

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
        values = self.rows.boxes() if isinstance(self.rows, BoxRowColumns) else self.values("bbox")
        try:
            array = np.array(values).reshape(len(values), 4)
            boxes = array.astype(np.float64)
            if array.dtype.kind in "iuf" and (np.abs(boxes) < _MAX_VALUE).all() and (boxes[:, 2:] >= 0).all():
                return boxes
        except (ValueError, TypeError):
            pass  # the row is found below
        values = self.values("bbox")
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
        """Return length, height, width, x, y, z, yaw; NaN if missing, or of another form."""
        pose = self.rows[i].get("pose")
        if not isinstance(pose, dict):
            return [math.nan] * 7
        where = self.locate(i, "pose")
        try:
            size_lhw = parse_numbers(where, pose.get("size_lhw"), 3)
            position = parse_numbers(where, pose.get("translation"), 3)
            values = [*size_lhw, *position, *parse_numbers(where, [pose.get("yaw")], 1)]
        except FormatError:
            return [math.nan] * 7
        return values if min(values[:3]) > 0 else [math.nan] * 7

    def is_numeric(self, key: str) -> bool:
        """Whether a key has numbers only; it may be missing."""
        return set(map(type, self.values(key))) <= {int, float, type(None)}

    def regions(self) -> NDArray[np.bool_]:
        """Return which rows (N,) are crowds or regions to ignore.

        pycocotools overwrites "ignore" by "iscrowd"; here both are regions.
        """
        flags = np.zeros(len(self), np.bool_)
        for key in self.key_names() & {"iscrowd", "ignore"}:
            flags |= np.array(list(map(bool, self.values(key))), np.bool_)
        return flags

    def count_unusable(self) -> dict[str, int]:
        """Count the values that a scene cannot use, and which it takes for unknown."""
        keys = self.key_names()
        counts: dict[str, int] = {}
        if "truncation" in keys:
            counts["truncations outside [0, 1]"] = sum(
                v not in (None, -1) and not (type(v) in (int, float) and 0 <= v <= 1)
                for v in self.values("truncation")
            )
        if "occlusion" in keys:
            wrong = (value not in (None, -1, 0, 1, 2, 3) for value in self.values("occlusion"))
            counts["occlusions other than 0 to 3"] = sum(wrong)
        if "pose" in keys:
            given = (i for i, value in enumerate(self.values("pose")) if value is not None)
            counts["3D boxes that cannot be used"] = sum(math.isnan(self.pose(i)[0]) for i in given)
        return {name: count for name, count in counts.items() if count}

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
        keys = self.key_names()

        def column(key: str, missing: float = math.nan) -> NDArray[np.float64]:
            return self.column(key, missing) if key in keys else repeat_value(missing, len(self))

        boxes = self.boxes()
        area = repeat_value(np.nan, len(self)) if scored else column("area")
        numbers = self.values("id") if "id" in keys else []
        texts = {key for key in ("truncation", "occlusion", "alpha") if not self.is_numeric(key)}
        names = [] if scored else sorted((keys - _TABLE_COLUMNS) | texts)
        keys -= texts
        pose = repeat_value(math.nan, len(self), 7)
        if "pose" in keys:
            pose = np.array([self.pose(i) for i in range(len(self))], np.float64).reshape(-1, 7)
        return LabelTable.from_columns(
            frames,
            kinds,
            frame,
            kind,
            boxes,
            "xywh",
            ignore=self.regions() if keys & {"iscrowd", "ignore"} else np.zeros(len(self), np.bool_),
            score=self.column("score", None) if scored else repeat_value(np.nan, len(self)),
            truncation=column("truncation", -1.0),
            occlusion=self.flags("occlusion", -1) if "occlusion" in keys else repeat_value(-1, len(self)),
            alpha=column("alpha"),
            pose=pose,
            area=np.where(np.isnan(area), boxes[:, 2] * boxes[:, 3], area),
            box_ids=np.array(numbers, np.int64) if numbers and set(map(type, numbers)) == {int} else None,
            kind_ids=kind_ids,
            extra={name: self.values(name) for name in names},
        )


_TABLE_COLUMNS = {
    *("truncation", "occlusion", "alpha", "pose", "score", "area", "bbox", "iscrowd"),
    *("image_id", "category_id", "id"),
}
"""Keys with a column in LabelTable; others go to `extra`."""


class AnnotationFile:
    """A data set's file: images and categories sorted by id, annotations in file order, each with both.

    Repeated ids of annotations are numbered anew, and categories of one name are one class; `repairs` counts them.

    Args:
        path: The file.
        content: Its content.
        split: Name of the split, by which its images are found; by default the file's, without "instances_".

    Raises:
        FormatError: Not of this form; two entries with one id, or images with one file name, that differ.
    """

    def __init__(self, path: Path, content: Any, split: str | None = None) -> None:
        if not isinstance(content, dict):
            found = "a list (of results?)" if isinstance(content, list) else type(content).__name__
            raise FormatError(str(path), "images, annotations and categories", found)
        self.path = path
        self.split = path.stem.removeprefix("instances_") if split is None else split
        self.repairs: Counter[str] = Counter()
        tables = {
            n: JsonRows.from_list(f"{path}: {n}", content.get(n)) for n in ("images", "categories", "annotations")
        }
        self.images, self.image_ids = _sort_by_id(tables["images"].drop_repeated(self.repairs))
        tables["categories"].integers("id")
        categories, _ = _sort_by_id(tables["categories"].drop_repeated(self.repairs))
        category_ids = categories.integers("id")
        categories.check_texts("name")
        self.annotations = self._number_anew(tables["annotations"])
        self._check_file_names()
        self.annotation_image = self.annotations.indices("image_id", self.image_ids, "images")
        category = self.annotations.indices("category_id", category_ids, "categories")
        self._merge_categories(
            [str(row.get("name", row["id"])) for row in categories.rows], category_ids, category
        )
        self._find_images()

    def _number_anew(self, rows: JsonRows) -> JsonRows:
        """Give annotations whole numbers that no other one has, where they repeat one."""
        numbers = [number for number in rows.values("id") if type(number) is int]
        if len(set(numbers)) == len(numbers):
            return rows
        following, seen, renewed = max(numbers) + 1, set[int](), list(rows.rows)
        for i, row in enumerate(renewed):
            number = row.get("id")
            if type(number) is int and number in seen:
                renewed[i] = {**row, "id": following}
                following += 1
                self.repairs["annotation ids numbered anew"] += 1
            elif type(number) is int:
                seen.add(number)
        return replace(rows, rows=renewed)

    def _merge_categories(self, names: Sequence[str], ids: NDArray[np.int64], category: NDArray[np.int64]) -> None:
        """Make one class of the categories of one name; its id is the first one with annotations."""
        used = set(category.tolist())
        chosen: dict[str, int] = {}
        for i in sorted(range(len(names)), key=lambda i: (i not in used, i)):
            chosen.setdefault(names[i], i)
        order = sorted(chosen.values())
        place = {names[i]: k for k, i in enumerate(order)}
        self.kinds, self.category_ids = [names[i] for i in order], ids[order]
        self.annotation_category = np.array([place[name] for name in names], np.int64)[category]
        others = sorted(set(range(len(names))) - set(order))
        self.merged_ids = {int(ids[i]): place[names[i]] for i in others}
        """Index of the class by the id of a category that was merged into it."""
        if others:
            self.repairs["categories merged into another of their name"] += len(others)

    def _check_file_names(self) -> None:
        self.images.check_texts("file_name")
        first: dict[str, int] = {}
        for i, name in enumerate(self.images.values("file_name")):
            if name and name[-1] in "./" and not Path(name).name:
                raise FormatError(self.images.locate(i, "file_name"), "the name of a file", json.dumps(name))
            if name and first.setdefault(name, i) != i:
                found = f"{name!r}, as {self.images.locate(first[name], 'file_name')}"
                raise FormatError(self.images.locate(i, "file_name"), "a unique name", found)

    def _find_images(self) -> None:
        """Find the folder of the images, and each image in it."""
        base = self.path.parent.parent if self.path.parent.name == "annotations" else self.path.parent
        places = (base / "images" / self.split, base / self.split, base / "images", base / "data", base)
        folders = [folder for folder in places if folder.is_dir()]
        names = [name or "" for name in self.images.values("file_name")]

        def has_images(folder: Path) -> bool:
            return any(isfile(found) for name in names if (found := _resolve_name(name, folder, base)))

        self.folder = next(filter(has_images, folders), folders[0])
        """Folder of the images."""
        self.paths = [_resolve_name(name, self.folder, base) for name in names]
        """Path of each image, which may be missing; None without a name, or where it leads out of the data set."""
        found = zip(names, self.paths, strict=True)
        changed = sum(path is not None and path != os.path.join(self.folder, name) for name, path in found)
        if changed:
            self.repairs["file names found by their ending, or with backslashes"] += changed
        first: dict[str, int] = {}
        for i, path in enumerate(self.paths):
            if path is not None and first.setdefault(path, i) != i:
                found = f"{path}, as {self.images.locate(first[path], 'file_name')}"
                raise FormatError(self.images.locate(i, "file_name"), "another image", found)

    def _existing_images(self, frames: Sequence[str]) -> dict[int, str]:
        """Return the existing images: those that the file names, else those named after the frames, in their folder."""
        existing = {i: path for i, path in enumerate(self.paths) if path is not None and isfile(path)}
        if len(existing) < len(self.paths):
            names = (name for name in os.listdir(self.folder) if name.lower().endswith(IMAGE_SUFFIXES))
            by_stem = {os.path.splitext(name)[0]: os.path.join(self.folder, name) for name in names}
            existing |= {i: by_stem[n] for i, n in enumerate(frames) if i not in existing and n in by_stem}
        return existing

    def relative_names(self) -> list[str]:
        """Return the images' paths below their folder, with "/"; "" without a file name."""
        relative = [name or "" for name in self.images.values("file_name")]
        for i, (name, path) in enumerate(zip(relative, self.paths, strict=True)):
            if path is None:
                relative[i] = (_split_name(name) or [""])[-1]
            elif path != os.path.join(self.folder, name):
                inside = os.path.relpath(path, self.folder)
                relative[i] = os.path.basename(path) if inside.startswith("..") else inside.replace(os.sep, "/")
        return relative

    def sizes_wh(self) -> NDArray[np.int64]:
        """Return the sizes of the images (F, 2) px: those of the file, else of the upright images, else 0."""
        sizes = np.stack([self.images.flags(key, 0) for key in ("width", "height")], axis=1)
        for i in np.flatnonzero((sizes <= 0).any(axis=1)).tolist():
            path = self.paths[i]
            sizes[i] = read_upright_size(path) if path is not None and isfile(path) else 0
        return sizes

    def attributes(self, i: int) -> dict[str, Any]:
        """Return the attributes of an image."""
        values = self.images.rows[i].get("attributes")
        return values if isinstance(values, dict) else {}

    def to_table(self, frames: Sequence[str], scored: bool) -> LabelTable:
        """Convert the annotations to columns, sorted by frame. frames: Names of the images."""
        rows, images = self.annotations, self.images.rows
        table = rows.to_table(
            frames, self.kinds, self.category_ids, self.annotation_image, self.annotation_category, scored
        )
        exported = {i: {"drivesem": row["drivesem"]} for i, row in enumerate(images) if "drivesem" in row}
        attributes = {i: self.attributes(i) for i in range(len(images))}
        if (np.diff(table.frame) < 0).any():
            table = table.select(np.argsort(table.frame, kind="stable"))
        return replace(
            _merge_regions(table),
            sizes_wh=self.sizes_wh(),
            image_ids=self.image_ids,
            merged_kind_ids=self.merged_ids,
            cameras={i: row["camera"] for i, row in enumerate(images) if "camera" in row},
            image_files={i: name for i, name in enumerate(self.relative_names()) if name},
            image_paths={i: Path(path) for i, path in self._existing_images(frames).items()},
            frame_attributes={i: a | exported.get(i, {}) for i, a in attributes.items() if a or i in exported},
        )


def _split_name(name: str) -> list[str]:
    """Split a file name, absolute or not, or a URL into folders and name."""
    if "://" in name:
        name = unquote(urlsplit(name).path)
    return [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]


def _resolve_name(name: str, folder: Path, base: Path) -> str | None:
    """Find the image that a file names.

    Args:
        name: Its "file_name": a path, or a URL, of which the last part counts. "\\" separates folders where no such
            file exists.
        folder: Folder of the images.
        base: Folder of the data set; nothing outside is found.

    Returns:
        The path, of a file that may be missing; None if there is no name, or it leads out of the data set.
    """
    if not name or "\0" in name:
        return None
    path = os.path.join(folder, name)
    if not _UNUSUAL_NAME.search(name) or (not os.path.isabs(name) and ".." not in name and isfile(path)):
        return path
    parts = _split_name(name)
    if not parts:
        return None
    if "://" in name:
        return os.path.join(folder, parts[-1]) if parts[-1] != ".." else None
    absolute = re.match(r"[/\\]|[A-Za-z]:[/\\]", name) is not None
    if absolute or ".." in parts:
        inside = os.path.abspath(name if absolute else os.path.join(folder, *parts))
        if Path(inside).is_relative_to(base.absolute()) and isfile(inside):
            return os.path.normpath(os.path.join(folder, os.path.relpath(inside, folder)))
    if ".." in parts:
        return None
    endings = [os.path.join(folder, *parts[k:]) for k in range(len(parts) if absolute else 1)]
    return next((path for path in endings if isfile(path)), None if absolute else endings[0])


def _sort_by_id(rows: JsonRows) -> tuple[JsonRows, Any]:
    ids = rows.ids("id")
    order = np.argsort(ids, kind="stable")
    return rows.select(order.tolist()), ids[order]


def is_dataset_file(path: Path) -> bool:
    """Whether a JSON file begins as a data set: an object with images, annotations, categories or labels."""
    if not isfile(path):
        return False
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    return head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{") and _DATASET_START.search(head) is not None


def find_annotation_files(path: Path) -> dict[Path, str]:
    """Find the annotation files of a data set, and their splits; a file is one itself.

    They are annotations/instances_SPLIT.json, else annotations/SPLIT.json, else SPLIT.json, or one in each folder
    SPLIT (such as train/_annotations.coco.json).
    """
    if path.is_file():
        return {path: path.stem.removeprefix("instances_")}
    files_there = sorted(file for file in (path / "annotations").glob("[!.]*.json") if file.is_file())
    instances = [file for file in files_there if file.name.startswith("instances_")]
    if instances:
        return {file: file.stem.removeprefix("instances_") for file in instances}
    for found in (files_there, sorted(path.glob("[!.]*.json"))):
        others = [file for file in found if not file.name.startswith(_OTHER_TASKS) and is_dataset_file(file)]
        if others:
            return {file: file.stem for file in others}
    found = sorted(path.glob("[!.]*/[!.]*.json"))
    return {
        file: file.parent.name for file in found if file.parent.name != "annotations" and is_dataset_file(file)
    }


class CocoFiles:
    """The annotation files of a data set.

    A frame's identifier is its file name without suffix; if some are alike, its path below the folders of the images.

    Args:
        root: Folder, see `find_annotation_files`, or one file.

    Raises:
        FormatError: There is no such file; as `AnnotationFile`.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        found = find_annotation_files(root)
        if not found:
            expected = "a COCO folder, with annotations/instances_*.json, or such a file (--root FILE.json)"
            raise FormatError(str(root), expected, "neither")
        self.parts = [AnnotationFile(path, _read_content(path), split) for path, split in found.items()]
        self.names = self._name_frames()
        """Identifiers of the images of each file."""

    def _name_frames(self) -> list[list[str]]:
        common = os.path.commonpath([os.path.abspath(part.folder) for part in self.parts])
        starts = [os.path.relpath(os.path.abspath(part.folder), common) for part in self.parts]
        paths: list[list[str]] = []
        for part, start in zip(self.parts, starts, strict=True):
            start = "" if start == "." else f"{start.replace(os.sep, '/')}/"
            ids = map(str, part.image_ids.tolist())
            relative = part.relative_names()
            paths.append([start + name if name else number for name, number in zip(relative, ids, strict=True)])
        stems = [[os.path.splitext(name.rpartition("/")[2])[0] for name in names] for names in paths]
        for names in (stems, [[os.path.splitext(name)[0] for name in part] for part in paths], paths):
            alike = [name for name, count in Counter(name for part in names for name in part).items() if count > 1]
            if not alike:
                return names
        where = next(f"{part.path}" for part, names in zip(self.parts, paths, strict=True) if alike[0] in names)
        raise FormatError(where, "images that differ in their names", f"{alike[0]!r} twice")

    def splits(self) -> dict[str, tuple[str, ...]]:
        """Identifiers by split, if there are several files."""
        joined: dict[str, tuple[str, ...]] = {}
        for part, names in zip(self.parts, self.names, strict=True) if len(self.parts) > 1 else ():
            joined[part.split] = (*joined.get(part.split, ()), *names)
        return joined

    def account(self, repairs: Mapping[str, int] | None = None) -> DataAccount:
        """Account for all files and annotations. repairs: Further ones."""
        existing = [os.path.abspath(path) for part in self.parts for path in part.paths if path and isfile(path)]
        counted = Counter(repairs or {})
        classes: Counter[str] = Counter()
        regions = unlabelled = 0
        for part in self.parts:
            counted.update(part.repairs)
            counted.update(part.annotations.count_unusable())
            ignored = part.annotations.regions()
            counts = np.bincount(part.annotation_category[~ignored], minlength=len(part.kinds)).tolist()
            classes.update({name: count for name, count in zip(part.kinds, counts, strict=True) if count})
            regions += int(ignored.sum())
            unlabelled += len(part.images) - len(np.unique(part.annotation_image))
        count, skipped = 1, {}
        if self.root.is_dir() or existing:
            root = Path(os.path.abspath(self.root if self.root.is_dir() else self.parts[0].folder))
            read = [*existing, *(os.path.abspath(part.path) for part in self.parts)]
            reasons = {
                f"{path}": "annotations of another task, or not named instances_*"
                for path in (root / "annotations").glob("*.json")
            }
            count, skipped = account_for_files(root, read, reasons)
        splits = self.splits()
        frames = sum(map(len, self.names))
        return DataAccount(
            "coco",
            frames,
            count,
            skipped,
            dict(classes),
            regions,
            unlabelled,
            frames - len(existing),
            {name: len(names) for name, names in splits.items()},
            repairs=dict(counted),
        )

    def to_table(self, scored: bool) -> LabelTable:
        """Convert all files to one table."""
        tables = [part.to_table(names, scored) for part, names in zip(self.parts, self.names, strict=True)]
        table = tables[0] if len(tables) == 1 else join_tables(tables)
        position = {name: i for i, name in enumerate(table.frames)}
        splits = {name: [position[frame] for frame in frames] for name, frames in self.splits().items()}
        return replace(table, splits=splits, account=self.account())


def _read_content(path: Path) -> Any:
    """Read a data set's file, its annotations by column; FiftyOne's own form is converted."""
    text = files.read_text(path)
    if not text or text.isspace():
        raise FormatError(str(path), "COCO annotations or results", "an empty file")
    columns = BoxRowColumns()
    content = files.parse_json(text, str(path), columns.store)
    if isinstance(content, dict) and columns.holds(content.get("annotations")):
        return {**content, "annotations": columns}
    content = files.parse_json(text, str(path))
    if isinstance(content, dict) and isinstance(content.get("labels"), dict) and "annotations" not in content:
        return fiftyone.to_coco(path, content, read_upright_size)
    return content


def read_turn(path: str | Path | None, size_wh: Sequence[int]) -> int:
    """Return the orientation by which an image's labels must be turned, 5 to 8; 1 if they are upright.

    Args:
        path: The image; None or no file: labels are upright.
        size_wh: Its size in the annotation file; 0 where unknown. Labels are of stored pixels where only the stored
            image has this size; where both have it, they are of the upright image.

    Raises:
        FormatError: Neither the stored nor the upright image has this size, or the file is no image.
    """
    if path is None or not size_wh[0] or not isfile(path):
        return 1
    orientation, width, height = read_header(path)
    upright = (height, width) if orientation > 4 else (width, height)
    if upright == tuple(size_wh):
        return 1
    if (width, height) != tuple(size_wh):
        found = f"{upright[0]}x{upright[1]} px"
        raise FormatError(str(path), f"{size_wh[0]}x{size_wh[1]} px, as its annotation states", found)
    return orientation


def turn_points(points: NDArray[np.float64], orientation: int, size_wh: Sequence[int]) -> NDArray[np.float64]:
    """Turn points (..., 2) of COCO's pixels upright.

    Args:
        points: Points of the stored image.
        orientation: EXIF's, 5 to 8; 1 changes nothing.
        size_wh: Size of the stored image.
    """
    x, y, (width, height) = points[..., 0], points[..., 1], size_wh
    turned = {5: (y, x), 6: (height - y, x), 7: (height - y, width - x), 8: (y, width - x)}
    return np.stack(turned.get(orientation, (x, y)), axis=-1)


def turn_boxes(boxes: NDArray[np.float64], orientation: int, size_wh: Sequence[int]) -> NDArray[np.float64]:
    """Turn boxes (N, 4), left, top, width, height, upright; see `turn_points`."""
    corners = np.stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
    corners = turn_points(corners, orientation, size_wh)
    low = corners.min(axis=1)
    return np.concatenate([low, corners.max(axis=1) - low], axis=1)


def turn_upright(table: LabelTable) -> LabelTable:
    """Turn the boxes, outlines and sizes of those frames that refer to the stored pixels of a turned image.

    Outlines that are run lengths, cameras and keypoints of turned frames are dropped.
    """
    boxes, sizes_wh, cameras = table.boxes.copy(), table.sizes_wh.copy(), dict(table.cameras)
    extra = {name: list(values) for name, values in table.extra.items()}
    for i, rows in enumerate(table.rows_by_frame()):
        size_wh = sizes_wh[i].tolist()
        orientation = read_turn(table.image_paths.get(i), size_wh)
        if orientation == 1:
            continue
        boxes[rows.start : rows.stop] = turn_boxes(boxes[rows.start : rows.stop], orientation, size_wh)
        sizes_wh[i] = size_wh[::-1]
        cameras.pop(i, None)
        for row in rows:
            for name in ("segmentation", "keypoints"):
                if name in extra:
                    extra[name][row] = _turn_outline(extra[name][row], orientation, size_wh)
    return replace(table, boxes=boxes, sizes_wh=sizes_wh, cameras=cameras, extra=extra)


def _turn_outline(polygons: Any, orientation: int, size_wh: Sequence[int]) -> Any:
    """Turn polygons; None for other outlines."""
    try:
        flat = [np.array(polygon, np.float64).reshape(-1, 2) for polygon in polygons]
        return [turn_points(points, orientation, size_wh).ravel().tolist() for points in flat] or None
    except (ValueError, TypeError):
        return None


def read_table(path: Path, scored: bool, truth: LabelTable | None) -> LabelTable:
    """Read labels or detections of a data set, in the pixels of its files; see `turn_upright`.

    Args:
        path: File or folder.
        scored: Read detections: a data set with scores, or a list of results.
        truth: Labels with the ids to which a list of results refers.

    Returns:
        The labels or detections.

    Raises:
        FormatError: Names the file and the entry.
    """
    if scored and path.is_file() and files.read_bytes(path).lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"[":
        return _read_results(path, files.read_json(path), truth)
    return CocoFiles(path).to_table(scored)


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
        raise FormatError(
            str(path), "labels of one COCO file, to which the ids of a list of results refer", "others"
        )
    if not content:
        raise FormatError(str(path), "at least one detection", "an empty list")
    image_ids: Ids | None = truth.image_ids
    if image_ids is None:
        image_ids = np.array([int(name) if name.isdecimal() else -1 for name in truth.frames], np.int64)
    rows = JsonRows.from_list(str(path), content)
    frame = rows.indices("image_id", image_ids, "images")
    merged = truth.merged_kind_ids
    ids = np.concatenate([truth.kind_ids, np.array(list(merged), np.int64)])
    classes = np.array([*range(len(truth.kinds)), *merged.values()], np.int64)
    kind = classes[rows.indices("category_id", ids, "categories")]
    table = rows.to_table(truth.frames, truth.kinds, truth.kind_ids, frame, kind, True)
    return replace(table.select(np.argsort(table.frame, kind="stable")), image_ids=truth.image_ids)
