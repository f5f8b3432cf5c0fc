"""Rows of YOLO's label files, many files at once, without torch.

A row is `class cx cy w h`: 0-based class, box centre and size as shares of the upright image's width and height
(docs.ultralytics.com/datasets/detect). Also read: a polygon `class x1 y1 x2 y2 x3 y3 ...`, as its bounding box;
keypoints after the box; a sixth column. Detections have a score in the sixth column, and a track in the seventh.
Errors name file, line and field.
"""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from scene_ir import files
from scene_ir.errors import FormatError

EDGE = 1e-4
"""How far a share may reach beyond the image, because of rounding."""
MAX_OVERHANG = 0.05
"""How far a share may reach beyond the image; such boxes are clipped."""
_NAME_LISTS = ("classes.txt", "obj.names", "labels/classes.txt")
DESCRIPTIONS = ("data.yaml", "data.yml", "dataset.yaml", "dataset.yml", "obj.data", *_NAME_LISTS)
"""Descriptions, the first that exists is read."""
_NO_LABELS = re.compile(r"readme.*\.txt|classes\.txt|notes\.txt", re.IGNORECASE)
"""Text files in folders of labels that are no labels."""
_FILES_PER_CHUNK = 4096
_FIELDS = ("class", "cx", "cy", "w", "h", "score", "track")
_TRIANGLE = 7
"""Fields of the smallest polygon."""


def find_description(folder: Path) -> Path | None:
    """Return a folder's description; None if there is none."""
    return next((path for name in DESCRIPTIONS if (path := folder / name).is_file()), None)


def is_label_file(name: str) -> bool:
    """Whether a file in a folder of labels holds labels, by its name."""
    return name.endswith(".txt") and name[0] != "." and not _NO_LABELS.fullmatch(name)


@dataclass(frozen=True, slots=True)
class YoloRows:
    """Rows of label files, in columns."""

    file: NDArray[np.int64]
    """Index of each row's file (N,), ascending."""
    kind: NDArray[np.int64]
    """Class numbers (N,)."""
    shares: NDArray[np.float64]
    """Box centre and size (N, 4) as shares of the image."""
    score: NDArray[np.float64]
    """Scores (N,); NaN for labels."""
    track: NDArray[np.float64]
    """Track ids (N,); NaN where there is none."""
    repairs: Counter[str]
    """Values that were not read as written, by what was done."""


class _RowParser:
    """Parses the rows of a chunk of files to numbers; their range is checked afterwards for all rows at once."""

    def __init__(self, paths: Sequence[str], scored: bool, keypoints: int, repairs: Counter[str]) -> None:
        self._paths, self._scored, self._keypoints, self._repairs = paths, scored, keypoints, repairs
        self._box_fields = 5 + keypoints
        self.places: list[tuple[int, int]] = []  # file and line of each row
        self.rows: list[list[float]] = []  # class, cx, cy, w, h, score or sixth column, track
        self.whole_scores = 0

    def parse(self, file: int, text: str) -> None:
        """Parse the text of a file."""
        box_fields, rows, places = self._box_fields, self.rows, self.places
        plain = not (self._scored or self._keypoints)
        for line, words in enumerate(map(str.split, text.splitlines()), start=1):
            if not words:
                continue
            try:
                values = list(map(float, words))
            except ValueError:
                self._refuse_word(file, line, words)
            if not words[0].isdecimal() and values[0].is_integer():
                self._repairs["class numbers written as decimals"] += 1
            if plain and len(words) == box_fields:
                values += (math.nan, math.nan)
            else:
                values = self._split_fields(file, line, words, values)
            rows.append(values)
            places.append((file, line))

    def locate(self, row: int, field: str) -> str:
        """Return file, line and field of a row, for errors."""
        file, line = self.places[row]
        return f"{self._paths[file]}:{line}: {field}"

    def _refuse_word(self, file: int, line: int, words: Sequence[str]) -> NoReturn:
        for i, word in enumerate(words):
            try:
                float(word)
            except ValueError:
                field = _FIELDS[i] if len(words) <= len(_FIELDS) and i < len(_FIELDS) else f"field {i + 1}"
                expected = "a share of the image in [0, 1]" if field in _FIELDS[1:5] else "a number"
                raise FormatError(f"{self._paths[file]}:{line}: {field}", expected, repr(word[:60])) from None
        raise AssertionError(words)

    def _split_fields(self, file: int, line: int, words: Sequence[str], values: list[float]) -> list[float]:
        """Return class, box, score or sixth column, and track of a row that is not `class cx cy w h`."""
        count, box_fields, scored = len(values), self._box_fields, self._scored
        box, rest = values[:5], values[box_fields:]
        if scored and box_fields < count <= box_fields + 2:
            self.whole_scores += words[box_fields].isdecimal()
        elif scored and count > _TRIANGLE and count % 2 == 0:
            box, rest = self._bound_polygon(file, line, values[:-1]), values[-1:]
            self.whole_scores += words[-1].isdecimal()
        elif not scored and count >= _TRIANGLE and count % 2 and count != box_fields:
            box, rest = self._bound_polygon(file, line, values), []
        elif scored or not box_fields <= count <= box_fields + 1:
            expected = "6 fields: class cx cy w h score" if scored else "5 fields: class cx cy w h, or a polygon"
            raise FormatError(f"{self._paths[file]}:{line}", expected, count)
        if self._keypoints and count >= box_fields:
            self._repairs["keypoints not used"] += 1
        return [*box, *rest, math.nan, math.nan][:7]

    def _bound_polygon(self, file: int, line: int, values: list[float]) -> list[float]:
        low, high = -MAX_OVERHANG, 1 + MAX_OVERHANG
        for i, value in enumerate(values[1:]):
            if not low <= value <= high:
                where = f"{self._paths[file]}:{line}: {'xy'[i % 2]}{i // 2 + 1}"
                raise FormatError(where, "a share of the image in [0, 1]", repr(f"{value:g}"))
        self._repairs["polygons (their bounding boxes)"] += 1
        left, right, top, bottom = min(values[1::2]), max(values[1::2]), min(values[2::2]), max(values[2::2])
        if min(left, top) < -EDGE or max(right, bottom) > 1 + EDGE:
            self._repairs[_CLIPPED] += 1
            left, right, top, bottom = (min(max(value, 0.0), 1.0) for value in (left, right, top, bottom))
        return [values[0], (left + right) / 2, (top + bottom) / 2, right - left, bottom - top]


_CLIPPED = "boxes clipped to the image"


def read_rows(paths: Sequence[str], classes: int, scored: bool, keypoints: int = 0) -> YoloRows:
    """Read label files, or detections.

    Boxes that reach slightly beyond the image are clipped. Repeated rows of labels are dropped. A sixth column of
    labels is a track id, if all are whole numbers and one exceeds 1; otherwise it is not used.

    Args:
        paths: Files.
        classes: Number of classes.
        scored: Read detections; their rows have scores.
        keypoints: Numbers after a box that belong to its keypoints.

    Returns:
        The rows, in file order.

    Raises:
        FormatError: Names file, line and field.
    """
    repairs: Counter[str] = Counter()
    chunks: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
    for places, rows in _read_chunks(paths, classes, scored, keypoints, repairs):
        first = np.ones(len(rows), np.bool_) if scored else _first_of_equal_rows(places, rows)
        repairs.update({"repeated rows (dropped)": repeated} if (repeated := int((~first).sum())) else {})
        chunks.append((places[first], rows[first]))
    file = np.concatenate([np.zeros(0, np.int64), *(places for places, _ in chunks)])
    values = np.concatenate([np.zeros((0, 7)), *(rows for _, rows in chunks)])
    if not scored:
        sixth = values[:, 5].copy()
        known = np.isfinite(sixth)
        values[:, 5:] = np.nan
        if known.any():
            if (
                np.all(sixth[known] == np.floor(sixth[known]))
                and sixth[known].min() >= 0
                and sixth[known].max() > 1
            ):
                values[:, 6] = sixth
            else:
                repairs["values of a sixth column (not used)"] += int(known.sum())
    return YoloRows(file, values[:, 0].astype(np.int64), values[:, 1:5], values[:, 5], values[:, 6], repairs)


def _read_chunks(
    paths: Sequence[str], classes: int, scored: bool, keypoints: int, repairs: Counter[str]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield file indices (n,) and values (n, 7) of some files at a time, which bounds the memory of their text."""
    rows = whole_scores = 0
    first = ""
    for start in range(0, len(paths), _FILES_PER_CHUNK):
        chunk = paths[start : start + _FILES_PER_CHUNK]
        texts = [files.read_text(path) for path in chunk]
        plain = None if scored or keypoints else _parse_plain(texts, classes)
        if plain is not None:
            yield plain[0] + start, plain[1]
            continue
        parser = _RowParser(chunk, scored, keypoints, repairs)
        for i, text in enumerate(texts):
            parser.parse(i, text)
        values = np.array(parser.rows, np.float64).reshape(-1, 7)
        _check_values(parser, values, classes, scored)
        repairs.update({_CLIPPED: clipped} if (clipped := _clip_overhang(values)) else {})
        rows, whole_scores = rows + len(values), whole_scores + parser.whole_scores
        first = first or (parser.locate(0, "score") if len(values) else "")
        yield np.array([file for file, _ in parser.places], np.int64) + start, values
    if scored and rows and whole_scores == rows:
        raise FormatError(first, "scores in [0, 1]", "whole numbers in all rows, such as track ids")


def _parse_plain(texts: Sequence[str], classes: int) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Parse rows `class cx cy w h` that need no repair, many times as fast as `_RowParser`.

    Returns file indices (n,) and values (n, 7); None if a row is anything else.
    """
    split = [text.splitlines() for text in texts]
    lines = [line for rows in split for line in rows]
    plain = all(line.count(" ") == 4 and line[: line.find(" ")].isdecimal() for line in lines)
    text = " ".join(lines)
    if not plain or "  " in text or "\t" in text:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # raised for text that is not a number
            numbers = np.fromstring(text, np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    # spaces are single, so every row has five values if all together have as many
    if numbers.size != 5 * len(lines):
        return None
    numbers = numbers.reshape(-1, 5)
    if not (numbers[:, 0] < classes).all() or not ((numbers[:, 1:] >= 0) & (numbers[:, 1:] <= 1)).all():
        return None
    return np.repeat(np.arange(len(texts)), [*map(len, split)]), np.pad(
        numbers, ((0, 0), (0, 2)), constant_values=np.nan
    )


def _check_values(parser: _RowParser, values: NDArray[np.float64], classes: int, scored: bool) -> None:
    """Raise FormatError for the first row with an unknown class, or a share or score out of range."""
    kind, shares = values[:, 0], values[:, 1:5]
    lowest = np.array([-MAX_OVERHANG, -MAX_OVERHANG, 0, 0])
    good = np.empty((len(values), 6), np.bool_)
    good[:, 0] = (kind >= 0) & (kind < classes) & (kind == np.floor(kind))
    good[:, 1:5] = (shares >= lowest) & (shares <= 1 + MAX_OVERHANG)
    good[:, 5] = ((values[:, 5] >= 0) & (values[:, 5] <= 1)) if scored else True
    for row in np.flatnonzero(~good.all(axis=1))[:1].tolist():
        column = int(np.argmin(good[row]))
        expected = ("a share of the image in [0, 1]", f"one of the {classes} in names", "a score in [0, 1]")
        text = expected[1 if column == 0 else 2 if column == 5 else 0]
        raise FormatError(parser.locate(row, _FIELDS[column]), text, repr(f"{values[row, column]:g}"))


def _clip_overhang(values: NDArray[np.float64]) -> int:
    """Clip boxes, in place, of which a share reaches beyond the image by more than rounding. Returns their number."""
    shares = values[:, 1:5]
    rows = np.flatnonzero((shares.max(axis=1, initial=0) > 1 + EDGE) | (shares.min(axis=1, initial=0) < -EDGE))
    low = np.clip(shares[rows, :2] - shares[rows, 2:] / 2, 0, 1)
    high = np.clip(shares[rows, :2] + shares[rows, 2:] / 2, 0, 1)
    shares[rows] = np.concatenate([(low + high) / 2, high - low], axis=1)
    return len(rows)


def _first_of_equal_rows(file: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which rows (N,) do not repeat an earlier row of their file."""
    columns = np.column_stack([file.astype(np.float64), np.nan_to_num(values[:, :6], nan=-1.0)])
    key = np.zeros(len(columns), np.uint64)
    for column in columns.T.copy().view(np.uint64):  # a hash of each row; sorting whole rows would take seconds
        key = (key ^ column) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    _, index, inverse = np.unique(key, return_index=True, return_inverse=True)
    first = index[inverse]
    return (first == np.arange(len(columns))) | (columns != columns[first]).any(axis=1)
