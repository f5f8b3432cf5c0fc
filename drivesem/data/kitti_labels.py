"""KITTI's label files as columns, many at once, without torch.

The format is the object development kit's (Geiger et al. 2012): `type truncated occluded alpha left top right
bottom h w l x y z ry`; results have the score as a 16th field. A label table takes any type and any finite number;
a scene needs more, see `drivesem.data.kitti.read_labels`. Errors name the file, the line and the field.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivesem.data.account import IMAGE_SUFFIXES, DataAccount, account_for_files
from drivesem.data.label_table import REGION, LabelTable, join_tables, repeat_value
from scene_ir import files
from scene_ir.errors import FormatError

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""KITTI's object types."""
FIELDS = (
    *("type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom"),
    *("height", "width", "length", "x", "y", "z", "rotation_y", "score"),
)
UNKNOWN_SIZE, UNKNOWN_POSITION, UNKNOWN_ANGLE = -1.0, -1000.0, -10.0
"""Values that the development kit writes for unknown ones."""
UNKNOWN_POSE = ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
_NUMBERS_BEFORE_POSE = FIELDS.index("height") - 1
"""Number of values of a line before its 3D box."""

SPLITS = ("train", "val", "test")
"""Splits of the lists in ImageSets."""
WITHOUT_LABELS = "image without a label file"
_FILES_PER_CHUNK = 4096
_MAX_FLAG = 2**31
MAX_YAW = 2 * math.pi + 0.01
"""Largest yaw, rad; more than a turn means another unit."""
NEAR_M = 0.1
"""Near plane of projected boxes; nothing nearer is visible."""


def finite_number(where: str, text: str) -> float:
    """Parse a finite number. Raises FormatError at `where`."""
    try:
        value = float(text)
    except ValueError:
        raise FormatError(where, "a number", repr(text)) from None
    if not math.isfinite(value):
        raise FormatError(where, "a finite number", text)
    return value


class KittiLabelLines:
    """Label lines of files, in columns.

    Raises FormatError naming file, line and field: a wrong number of fields, a value that is not a finite number, a
    box that ends before it begins.

    Args:
        names: Names of the files.
        texts: Contents of the files.
        scored: Whether each line must have a score.
    """

    kinds: list[str]
    """Types (N,) as written."""
    values: NDArray[np.float64]
    """Other fields (N, 14), or (N, 15) with scores."""
    counts: NDArray[np.int64]
    """Number of lines of each file."""

    def __init__(self, names: Sequence[str], texts: Sequence[str], scored: bool) -> None:
        self._names, self._texts = names, texts
        file_lines = [text.splitlines() for text in texts]
        fields = 16 if scored else 15
        columns = _parse_uniform(list(chain.from_iterable(file_lines)), fields)
        if columns is None:
            file_lines = [[line for line in lines if line and not line.isspace()] for lines in file_lines]
        self.counts = np.array(list(map(len, file_lines)), np.int64)
        if columns is None:
            split_lines = [line.split() for lines in file_lines for line in lines]
            columns = [parts[0] for parts in split_lines], self._parse_each(split_lines, fields)
        self.kinds, self.values = columns
        for low, high in ((3, 5), (4, 6)):
            for row in np.flatnonzero(self.values[:, high] < self.values[:, low])[:1].tolist():
                first, last = self.values[row, [low, high]].tolist()
                raise FormatError(self.locate(row, FIELDS[high + 1]), f"at least {first:g}", f"{last:g}")
        for row in np.flatnonzero(np.abs(self.values[:, 1]) >= _MAX_FLAG)[:1].tolist():
            raise FormatError(self.locate(row, "occluded"), "a flag, such as 0 to 3", f"{self.values[row, 1]:g}")

    def locate(self, row: int, field: str = "") -> str:
        """Return file, line (blank lines count) and field of a row, for errors."""
        ends = np.cumsum(self.counts)
        i = int(np.searchsorted(ends, row, side="right"))
        numbers = [n for n, line in enumerate(self._texts[i].splitlines(), start=1) if line.strip()]
        line = f"{self._names[i]}:{numbers[row - int(ends[i] - self.counts[i])]}"
        return f"{line}: {field}" if field else line

    def _parse_each(self, lines: Sequence[Sequence[str]], fields: int) -> NDArray[np.float64]:
        """Parse the values of lines of which only some have a score, or of which one is wrong."""
        rows: list[list[float]] = []
        for row, parts in enumerate(lines):
            if len(parts) not in {fields, 16}:
                expected = "16 fields (with a score)" if fields == 16 else "15 or 16 fields"
                raise FormatError(self.locate(row), expected, len(parts))
            named = zip(FIELDS[1:], parts[1:], strict=False)
            rows.append([finite_number(self.locate(row, name), part) for name, part in named][: fields - 1])
        return np.array(rows, np.float64).reshape(-1, fields - 1)

    def drop_unusable(self) -> dict[str, int]:
        """Make values unknown that a scene cannot use, and count them by field.

        A 3D box needs positive sizes, a yaw of at most a turn and a part in front of the camera; sizes of 0 and marks
        of unknown values do not count. Truncation is in [0, 1], occlusion 0 to 3.
        """
        values = self.values
        objects = np.array([kind.lower() != "dontcare" for kind in self.kinds], np.bool_)
        width, length, z, yaw = values[:, 8], values[:, 9], values[:, 12], values[:, 13]
        sizes = values[:, 7:10]
        unknown = (sizes <= 0).all(axis=1) | (values[:, 10:13] == UNKNOWN_POSITION).all(axis=1)
        reach = 0.5 * (length * np.abs(np.sin(yaw)) + width * np.abs(np.cos(yaw)))
        fits = (sizes > 0).all(axis=1) & (np.abs(yaw) <= MAX_YAW) & (z + reach > NEAR_M)
        bad_pose, bad_truncation = (
            objects & ~unknown & ~fits,
            objects & ((values[:, 0] > 1) | ((values[:, 0] < 0) & (values[:, 0] != -1))),
        )
        bad_occlusion = objects & ~np.isin(values[:, 1], (-1, 0, 1, 2, 3))
        values[bad_pose | (objects & unknown), 7:14] = [float(text) for text in UNKNOWN_POSE]
        values[bad_truncation, 0] = -1
        values[bad_occlusion, 1] = -1
        counts = {
            "3D boxes that cannot be used": bad_pose,
            "truncations outside [0, 1]": bad_truncation,
            "occlusions other than 0 to 3": bad_occlusion,
        }
        return {name: int(rows.sum()) for name, rows in counts.items() if rows.any()}

    def count_rows(self) -> tuple[dict[str, int], int]:
        """Count the objects by type, as written, and the DontCare regions."""
        counts = Counter(self.kinds)
        regions = sum(counts.pop(name) for name in list(counts) if name.lower() == "dontcare")
        return dict(counts), regions

    def check_sizes(self) -> None:
        """Raise FormatError for a negative size other than the mark of unknown ones."""
        for column in (7, 8, 9):
            sizes = self.values[:, column]
            for row in np.flatnonzero((sizes < 0) & (sizes != UNKNOWN_SIZE))[:1].tolist():
                raise FormatError(self.locate(row, FIELDS[column + 1]), "metres, or -1", f"{sizes[row]:g}")

    def to_table(self, frames: Sequence[str], scored: bool) -> LabelTable:
        """Convert to a table of `frames`, one for each file. Unknown 3D boxes are NaN."""
        values = self.values
        names = set(self.kinds)
        kinds = sorted(name for name in names if name.lower() != "dontcare")
        index = dict.fromkeys(names, REGION) | {name: i for i, name in enumerate(kinds)}
        size, position = values[:, [9, 7, 8]], values[:, 10:14]
        known = (size > 0).all(axis=1) & (position[:, :3] != UNKNOWN_POSITION).any(axis=1)
        return LabelTable.from_columns(
            frames,
            kinds,
            np.repeat(np.arange(len(frames)), self.counts),
            np.fromiter(map(index.__getitem__, self.kinds), np.int64, len(self.kinds)),
            values[:, 3:7].copy(),
            "xyxy",
            score=values[:, 14].copy() if scored else repeat_value(np.nan, len(values)),
            truncation=values[:, 0].copy(),
            occlusion=values[:, 1].astype(np.int64),
            alpha=np.where(values[:, 2] == UNKNOWN_ANGLE, np.nan, values[:, 2]),
            pose=np.where(known[:, None], np.concatenate([size, position], axis=1), np.nan)
            if known.any()
            else repeat_value(np.nan, len(values), 7),
        )


def _parse_uniform(lines: Sequence[str], fields: int) -> tuple[list[str], NDArray[np.float64]] | None:
    """Parse types and values (N, 14 or 15) of lines with equal numbers of fields, separated by single spaces.

    None if the lines must be parsed one by one, for example because of blank ones.
    """
    split = [line.partition(" ") for line in lines]
    kinds, rests = [part[0] for part in split], [part[2] for part in split]
    spaces = {rest.count(" ") for rest in rests}
    if len(spaces) != 1 or not spaces <= {fields - 2, 14}:
        return None
    if any(kind.split() != [kind] for kind in set(kinds)):
        return None
    count = spaces.pop() + 1
    flat = _strip_unknown_poses(rests)
    text = " ".join(rests if flat is None else flat)
    if "  " in text:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # raised for text that is not a number
            values = np.fromstring(text, np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    # spaces are single, so a field that parsed as two numbers would give one value too many
    width = count if flat is None else count - len(UNKNOWN_POSE)
    if values.size != len(lines) * width or not np.isfinite(values).all():
        return None
    values = values.reshape(len(lines), width)
    if flat is not None:
        pose = np.tile(np.array(UNKNOWN_POSE, np.float64), (len(lines), 1))
        values = np.concatenate([values[:, :_NUMBERS_BEFORE_POSE], pose, values[:, _NUMBERS_BEFORE_POSE:]], axis=1)
    return kinds, values[:, : fields - 1]  # drop scores of labels


def _strip_unknown_poses(rests: Sequence[str]) -> list[str] | None:
    """Remove the 3D boxes of lines that all have unknown ones, as 2D detectors write; parsing them takes long.

    None if a line has a 3D box.
    """
    mark = " " + " ".join(UNKNOWN_POSE)
    if mark not in rests[0]:
        return None
    parts = [rest.partition(mark) for rest in rests]
    if {before.count(" ") for before, _, _ in parts} != {_NUMBERS_BEFORE_POSE - 1}:
        return None
    if not {after[:1] for _, _, after in parts} <= {"", " "}:
        return None
    return [before + after for before, _, after in parts]


def find_label_folder(path: Path) -> Path | None:
    """Find the folder of label files: the path, or `label_2`, `training/label_2` or `data` below it."""
    for folder in (path / "training" / "label_2", path / "label_2", path / "data", path):
        pattern = "**/[!.]*.txt" if folder.name == "label_2" else "[!.]*.txt"
        if folder.is_dir() and any(folder.glob(pattern)):
            return folder
    return None


def list_files(folder: Path, suffixes: tuple[str, ...] = (".txt",)) -> list[str]:
    """List a folder's files of some suffixes, in subfolders too, by their paths below it, sorted.

    Path objects of tens of thousands would take seconds.
    """
    names: list[str] = []
    for place, folders, found in os.walk(folder):
        folders[:] = [name for name in folders if name[0] != "."]
        start = "" if place == str(folder) else f"{os.path.relpath(place, folder)}{os.sep}"
        names += [f"{start}{name}" for name in found if name.lower().endswith(suffixes) and name[0] != "."]
    return sorted(names)


def read_splits(root: Path, identifiers: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return identifiers by split, of the lists `ImageSets/{train,val,test}.txt` below a folder."""
    lists = {name: root / "ImageSets" / f"{name}.txt" for name in SPLITS}
    names = {name: set(files.read_text(path).split()) for name, path in lists.items() if path.is_file()}
    splits = {name: tuple(i for i in identifiers if i in chosen) for name, chosen in names.items()}
    return {name: chosen for name, chosen in splits.items() if chosen}


def read_table(path: Path, scored: bool) -> LabelTable:
    """Read the labels, or detections if `scored`, of a folder. Raises FormatError as `KittiLabelLines`."""
    folder = find_label_folder(path) if path.is_dir() else None
    if folder is None:
        raise FormatError(str(path), "a folder of KITTI label files (NNNNNN.txt)", "none")
    paths = {os.path.splitext(name)[0]: f"{folder}{os.sep}{name}" for name in list_files(folder)}
    table = read_label_files(paths, scored)
    if scored and not len(table):
        raise FormatError(str(folder), "at least one detection", f"{len(paths)} empty files")
    places = (parent / "image_2" for parent in (folder.parent, path.parent))
    image_folder = next((place for place in places if place.is_dir()), None)
    found = [] if image_folder is None else list_files(image_folder, IMAGE_SUFFIXES)
    image_of = {os.path.splitext(name)[0]: name for name in found}
    image_files = {i: image_of[name] for i, name in enumerate(table.frames) if name in image_of}
    image_paths = {i: Path(f"{image_folder}{os.sep}{name}") for i, name in image_files.items()}
    splits = read_splits(path, table.frames)
    unlabelled = (f"{image_folder}{os.sep}{image_of[name]}" for name in image_of.keys() - paths.keys())
    read = [*paths.values(), *map(str, image_paths.values()), *(f"{path / 'ImageSets' / s}.txt" for s in splits)]
    if folder.name == "label_2":
        read += [f"{folder.parent}{os.sep}calib{os.sep}{name}.txt" for name in paths]
    count, skipped = account_for_files(path, read, dict.fromkeys(unlabelled, WITHOUT_LABELS))
    counts = np.bincount(table.kind[table.kind >= 0], minlength=len(table.kinds)).tolist()
    account = DataAccount(
        "kitti",
        len(paths),
        count,
        skipped,
        dict(zip(table.kinds, counts, strict=True)),
        int((table.kind < 0).sum()),
        without_image=len(paths) - len(image_paths) if found else 0,
        splits={name: len(chosen) for name, chosen in splits.items()},
    )
    position = {name: i for i, name in enumerate(table.frames)}
    return replace(
        table,
        image_files=image_files,
        image_paths=image_paths,
        splits={name: [position[frame] for frame in chosen] for name, chosen in splits.items()},
        account=account,
    )


def read_label_files(paths: Mapping[str, str], scored: bool = False) -> LabelTable:
    """Read the labels, or detections if `scored`, of files by frame. Raises FormatError as `KittiLabelLines`."""
    frames = list(paths)
    tables: list[LabelTable] = []
    for lines in iterate_label_lines(list(paths.values()), scored):
        if not scored:
            lines.check_sizes()
        start = sum(len(table.frames) for table in tables)
        tables.append(lines.to_table(frames[start : start + len(lines.counts)], scored))
    if len(tables) == 1:
        return tables[0]
    table = join_tables(tables)
    kinds = sorted(table.kinds)
    places = np.array([*map(kinds.index, table.kinds), REGION], np.int64)
    return replace(table, kinds=tuple(kinds), kind=places[table.kind])


def iterate_label_lines(paths: Sequence[str], scored: bool = False) -> Iterator[KittiLabelLines]:
    """Yield the lines of some files at a time, which bounds the memory of their text."""
    for start in range(0, max(len(paths), 1), _FILES_PER_CHUNK):
        chunk = paths[start : start + _FILES_PER_CHUNK]
        yield KittiLabelLines(chunk, [files.read_text(path) for path in chunk], scored)
