"""Text tables with a header line, as Virtual KITTI has them: rows by key, parsed when they are asked for."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from scene_ir import files
from scene_ir.errors import FormatError

T = TypeVar("T")

_LARGEST = 3.4028234e38
"""Of float32, which tensors have."""
_LARGEST_WHOLE = 2**31 - 1


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row: fields as text by column. where: file and line, for errors."""

    where: str
    fields: Mapping[str, str]

    def word(self, column: str, allowed: Sequence[str] = ()) -> str:
        """A field as it stands; FormatError unless it is one of `allowed`, where that is given."""
        text = self.fields[column]
        if allowed and text not in allowed:
            raise FormatError(f"{self.where}: {column}", f"one of {', '.join(allowed)}", repr(text))
        return text

    def number(self, column: str, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number in [low, high]. FormatError."""
        where, text = f"{self.where}: {column}", self.fields[column]
        try:
            value = float(text)
        except ValueError:
            raise FormatError(where, "a number", repr(text)) from None
        if not abs(value) <= _LARGEST:
            raise FormatError(where, "a finite number", text)
        if not low <= value <= high:
            limits = f"at least {low:g}" if math.isinf(high) else f"a number in [{low:g}, {high:g}]"
            raise FormatError(where, limits, text)
        return value

    def positive(self, column: str) -> float:
        """A finite number above 0. FormatError."""
        value = self.number(column)
        if value <= 0:
            raise FormatError(f"{self.where}: {column}", "more than 0", self.fields[column])
        return value

    def integer(self, column: str, low: int = 0) -> int:
        """A whole number, at least `low`. FormatError."""
        value = _integer(f"{self.where}: {column}", self.fields[column])
        if value < low:
            raise FormatError(f"{self.where}: {column}", f"at least {low}", value)
        if value > _LARGEST_WHOLE:
            raise FormatError(f"{self.where}: {column}", f"at most {_LARGEST_WHOLE}", value)
        return value


def _integer(where: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise FormatError(where, "a whole number", repr(text)) from None


class Table:
    """A table of space-separated fields under a header.

    path: the file. key: names of integer columns by whose values rows are found. columns: names that the header
    must have besides; their order and further columns are free. Opening reads keys only. FormatError naming file
    and line: an empty file, a missing column, a row whose key is no whole number.
    """

    def __init__(self, path: Path, key: Sequence[str], columns: Sequence[str]) -> None:
        self.path = path
        lines = files.read_text(path).splitlines()
        if not lines or not lines[0].strip():
            raise FormatError(f"{path}:1", f"a header '{' '.join([*key, *columns])}'", "none")
        self.header = tuple(lines[0].split())
        for name in (*key, *columns):
            if name not in self.header:
                raise FormatError(f"{path}:1: {name}", "a column of that name", " ".join(self.header))
        self._key = tuple(key)
        places = [self.header.index(name) for name in key]
        reach = max(places) + 1
        self._lines: dict[tuple[int, ...], list[tuple[int, str]]] = {}
        for number, line in enumerate(lines[1:], start=2):
            start = line.split(None, reach)
            if not start:
                continue
            if len(start) < reach:
                raise FormatError(f"{path}:{number}", f"{len(self.header)} fields", len(start))
            values = tuple(_integer(f"{path}:{number}: {self.header[i]}", start[i]) for i in places)
            self._lines.setdefault(values, []).append((number, line))

    def rows(self, *key: int) -> list[TableRow]:
        """The rows of one key, in file order. FormatError where a row has more or fewer fields than the header."""
        return [self._parsed(number, line) for number, line in self._lines.get(key, ())]

    def all_rows(self) -> list[TableRow]:
        """Every row, in file order. FormatError as `rows`."""
        lines = sorted(line for group in self._lines.values() for line in group)
        return [self._parsed(number, line) for number, line in lines]

    def _parsed(self, number: int, line: str) -> TableRow:
        where, fields = f"{self.path}:{number}", line.split()
        if len(fields) != len(self.header):
            raise FormatError(where, f"{len(self.header)} fields", len(fields))
        return TableRow(where, dict(zip(self.header, fields, strict=True)))

    def row(self, *key: int) -> TableRow:
        """The only row of one key. FormatError where there is none, or there are several."""
        rows = self.rows(*key)
        name = " ".join(f"{column} {value}" for column, value in zip(self._key, key, strict=True))
        if not rows:
            raise FormatError(str(self.path), f"a row of {name}", "none")
        if len(rows) > 1:
            raise FormatError(rows[1].where, f"one row of {name}", f"{len(rows)}")
        return rows[0]

    def unique(self, column: str, *key: int) -> dict[int, TableRow]:
        """The rows of one key by the whole number in `column`, in file order. FormatError for one twice."""
        found: dict[int, TableRow] = {}
        for row in self.rows(*key):
            value = row.integer(column)
            if value in found:
                raise FormatError(f"{row.where}: {column}", "each once in a frame", f"{value} twice")
            found[value] = row
        return found


class Recent(Generic[T]):
    """What was read from files last, by path; at most `count`."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._kept: OrderedDict[Path, T] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, path: Path, read: Callable[[Path], T]) -> T:
        """What `read` makes of a file, or made of it."""
        if path not in self._kept:
            self._kept[path] = read(path)
        self._kept.move_to_end(path)
        while len(self._kept) > self._count:
            self._kept.popitem(last=False)
        return self._kept[path]


def decimal(value: float) -> str:
    """A number with nine significant digits: all that float32 holds."""
    return f"{float(value) + 0.0:.9g}"


def text_of(header: str, lines: Sequence[str]) -> str:
    """The text of a table."""
    return "".join(f"{line}\n" for line in (header, *lines))


def one_word(text: str) -> str:
    """A name as one field of a table."""
    return "_".join(text.split()) or "none"
