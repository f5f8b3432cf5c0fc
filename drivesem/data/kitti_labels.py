"""KITTI's label files as columns: read without torch, many at once.

The format is the object development kit's (Geiger et al. 2012): `type truncated occluded alpha left top right
bottom h w l x y z ry`; results have the score as a 16th field. A label table takes any type and any finite number;
a scene needs more, which `drivesem.data.kitti.read_labels` says. Errors name the file, the line and the field.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivesem.data.label_table import REGION, LabelTable
from scene_ir import files
from scene_ir.errors import FormatError

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""What KITTI labels."""
FIELDS = (
    *("type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom"),
    *("height", "width", "length", "x", "y", "z", "rotation_y", "score"),
)
UNKNOWN_SIZE, UNKNOWN_POSITION, UNKNOWN_ANGLE = -1.0, -1000.0, -10.0
"""What the development kit writes where a value is not known."""
UNKNOWN_POSE = ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
_BEFORE_POSE = FIELDS.index("height") - 1
"""Numbers of a line before its 3D box."""

_MOST_FLAG = 2**31


def finite_number(where: str, text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        raise FormatError(where, "a number", repr(text)) from None
    if not math.isfinite(value):
        raise FormatError(where, "a finite number", text)
    return value


class Lines:
    """The label lines of files, in columns. kinds (N,): types as written; values (N, 14), with a score 15: the
    other fields; counts: lines of each file.

    names, texts: of the files; scored: whether a line must have a score. FormatError naming file, line and field:
    a wrong field count, a value that is no finite number, a box that ends before it begins.
    """

    def __init__(self, names: Sequence[str], texts: Sequence[str], scored: bool) -> None:
        self._names, self._texts = names, texts
        of_files = [text.splitlines() for text in texts]
        fields = 16 if scored else 15
        plain = _plain_columns(list(chain.from_iterable(of_files)), fields)
        if plain is None:
            of_files = [[line for line in lines if line and not line.isspace()] for lines in of_files]
        self.counts = np.array(list(map(len, of_files)), np.int64)
        if plain is None:
            words = [line.split() for lines in of_files for line in lines]
            plain = [parts[0] for parts in words], self._one_by_one(words, fields)
        self.kinds, self.values = plain
        for low, high in ((3, 5), (4, 6)):
            for row in np.flatnonzero(self.values[:, high] < self.values[:, low])[:1].tolist():
                first, last = self.values[row, [low, high]].tolist()
                raise FormatError(self.where(row, FIELDS[high + 1]), f"at least {first:g}", f"{last:g}")
        for row in np.flatnonzero(np.abs(self.values[:, 1]) >= _MOST_FLAG)[:1].tolist():
            raise FormatError(self.where(row, "occluded"), "a flag, such as 0 to 3", f"{self.values[row, 1]:g}")

    def where(self, row: int, field: str = "") -> str:
        """File and line of a row, and the field; blank lines are counted too."""
        ends = np.cumsum(self.counts)
        i = int(np.searchsorted(ends, row, side="right"))
        numbers = [n for n, line in enumerate(self._texts[i].splitlines(), start=1) if line.strip()]
        line = f"{self._names[i]}:{numbers[row - int(ends[i] - self.counts[i])]}"
        return f"{line}: {field}" if field else line

    def _one_by_one(self, words: Sequence[Sequence[str]], fields: int) -> NDArray[np.float64]:
        """The numbers of lines of which some have a score and some have none, or of which one is wrong."""
        rows: list[list[float]] = []
        for row, parts in enumerate(words):
            if len(parts) not in {fields, 16}:
                expected = "16 fields (with a score)" if fields == 16 else "15 or 16 fields"
                raise FormatError(self.where(row), expected, len(parts))
            named = zip(FIELDS[1:], parts[1:], strict=False)
            rows.append([finite_number(self.where(row, name), part) for name, part in named][: fields - 1])
        return np.array(rows, np.float64).reshape(-1, fields - 1)

    def check_sizes(self) -> None:
        """FormatError for a size below 0 that is not the mark of what is unknown."""
        for column in (7, 8, 9):
            sizes = self.values[:, column]
            for row in np.flatnonzero((sizes < 0) & (sizes != UNKNOWN_SIZE))[:1].tolist():
                raise FormatError(self.where(row, FIELDS[column + 1]), "metres, or -1", f"{sizes[row]:g}")

    def table(self, frames: Sequence[str], scored: bool) -> LabelTable:
        """The lines as a table of `frames`, one a file. A 3D box that is marked as unknown is NaN."""
        values = self.values
        names = set(self.kinds)
        kinds = sorted(name for name in names if name.lower() != "dontcare")
        number = dict.fromkeys(names, REGION) | {name: i for i, name in enumerate(kinds)}
        size, position = values[:, [9, 7, 8]], values[:, 10:14]
        known = (size > 0).all(axis=1) & (position[:, :3] != UNKNOWN_POSITION).any(axis=1)
        return LabelTable.of(
            frames,
            kinds,
            np.repeat(np.arange(len(frames)), self.counts),
            np.fromiter(map(number.__getitem__, self.kinds), np.int64, len(self.kinds)),
            values[:, 3:7].copy(),
            "xyxy",
            score=values[:, 14].copy() if scored else np.full(len(values), np.nan),
            truncation=values[:, 0].copy(),
            occlusion=values[:, 1].astype(np.int64),
            alpha=np.where(values[:, 2] == UNKNOWN_ANGLE, np.nan, values[:, 2]),
            pose=np.where(known[:, None], np.concatenate([size, position], axis=1), np.nan),
        )


def _plain_columns(lines: Sequence[str], fields: int) -> tuple[list[str], NDArray[np.float64]] | None:
    """Types, and the numbers (N, 14 or 15), of lines that all have one number of fields, each a space apart; None
    where a look at each is needed, such as for blank lines.
    """
    split = [line.partition(" ") for line in lines]
    kinds, rests = [part[0] for part in split], [part[2] for part in split]
    spaces = {rest.count(" ") for rest in rests}
    if len(spaces) != 1 or not spaces <= {fields - 2, 14}:
        return None
    if any(kind.split() != [kind] for kind in set(kinds)):
        return None
    count = spaces.pop() + 1
    flat = _without_pose(rests)
    text = " ".join(rests if flat is None else flat)
    if "  " in text:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # of what is no number
            values = np.fromstring(text, np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    # no two spaces meet, so a field that was read as two numbers would be one too many
    told = count if flat is None else count - len(UNKNOWN_POSE)
    if values.size != len(lines) * told or not np.isfinite(values).all():
        return None
    values = values.reshape(len(lines), told)
    if flat is not None:
        pose = np.tile(np.array(UNKNOWN_POSE, np.float64), (len(lines), 1))
        values = np.concatenate([values[:, :_BEFORE_POSE], pose, values[:, _BEFORE_POSE:]], axis=1)
    return kinds, values[:, : fields - 1]  # without scores that nobody asked for


def _without_pose(rests: Sequence[str]) -> list[str] | None:
    """The numbers of lines without their 3D boxes, which none of them has, as 2D detectors write: they need not be
    read half a million times. None where a line is not so.
    """
    mark = " " + " ".join(UNKNOWN_POSE)
    if mark not in rests[0]:
        return None
    parts = [rest.partition(mark) for rest in rests]
    if {before.count(" ") for before, _, _ in parts} != {_BEFORE_POSE - 1}:
        return None
    if not {after[:1] for _, _, after in parts} <= {"", " "}:
        return None
    return [before + after for before, _, after in parts]


def label_folder(path: Path) -> Path | None:
    """The folder of label files that a path means: itself, or `label_2`, `training/label_2`, `data` below it."""
    for folder in (path / "training" / "label_2", path / "label_2", path / "data", path):
        if folder.is_dir() and any(folder.glob("[!.]*.txt")):
            return folder
    return None


def text_files(folder: Path) -> list[str]:
    """The names of the text files of a folder, sorted: of tens of thousands, paths would take seconds."""
    return [name for name in sorted(os.listdir(folder)) if name.endswith(".txt") and name[0] != "."]


def read_table(path: Path, scored: bool) -> LabelTable:
    """The labels, or detections where `scored`, of a folder: see `label_folder`. FormatError as `Lines`."""
    folder = label_folder(path) if path.is_dir() else None
    if folder is None:
        raise FormatError(str(path), "a folder of KITTI label files (NNNNNN.txt)", "none")
    paths = {name.removesuffix(".txt"): f"{folder}{os.sep}{name}" for name in text_files(folder)}
    table = table_of(paths, scored)
    if scored and not len(table):
        raise FormatError(str(folder), "at least one detection", f"{len(paths)} empty files")
    return table


def table_of(paths: Mapping[str, str], scored: bool = False) -> LabelTable:
    """The labels, or detections where `scored`, of label files by their frames. FormatError as `Lines`."""
    lines = Lines(list(paths.values()), [files.read_text(file) for file in paths.values()], scored)
    if not scored:
        lines.check_sizes()
    return lines.table(list(paths), scored)
