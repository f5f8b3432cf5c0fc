"""Files of Virtual KITTI: PNGs of depth, class colours and instance numbers, and text tables with a header."""

from __future__ import annotations

import math
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np

from drivesem.data.ground_truth import SKY_CM
from scene_ir import files
from scene_ir.errors import FormatError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _INDEXED = 0, 3
"""Colour types of the PNG specification, 11.2.2."""


def read_depth_m(path: Path, size_hw: tuple[int, int]) -> np.ndarray:
    """Read depth (H, W) float32 m from a uint16 PNG in centimetres; inf in the sky (65535). Raises FormatError."""
    depth = _decode_grey(path, files.read_bytes(path), size_hw)
    if depth.dtype != np.uint16:
        raise FormatError(str(path), "16 bits and 1 channel", f"{depth.dtype.itemsize * 8} bits and 1")
    metres = depth.astype(np.float32) / np.float32(100)
    metres[depth == SKY_CM] = np.inf
    return metres


def read_indices(path: Path, size_hw: tuple[int, int]) -> np.ndarray:
    """Read numbers (H, W) uint16 from an indexed PNG, ignoring its palette, or a grey one. Raises FormatError."""
    data = files.read_bytes(path)
    bits = 8
    if data.startswith(_SIGNATURE):
        chunks = list(_read_chunks(path, data))
        size, header = chunks[0]
        if size == b"IHDR" and len(header) == 13 and header[9] == _INDEXED:
            # Decoders map indices to the palette's colours, but not if the header declares a grey image.
            bits = header[8]
            grey = header[:9] + bytes([_GREY]) + header[10:]
            others = [(name, body) for name, body in chunks[1:] if name not in (b"PLTE", b"tRNS")]
            data = _join_chunks([(b"IHDR", grey), *others])
    values = _decode_grey(path, data, size_hw)
    # Grey of fewer than 8 bits is stretched to 0..255 by decoders.
    return values.astype(np.uint16) // (255 // ((1 << bits) - 1) if bits < 8 else 1)


def write_indices(path: Path, indices: np.ndarray) -> None:
    """Write numbers (H, W) below 256 as an 8-bit indexed PNG, atomically."""
    if indices.max(initial=0) > 255:
        raise FormatError(str(path), "numbers below 256", int(indices.max()))
    _, encoded = cv2.imencode(".png", indices.astype(np.uint8))
    (_, header), *rest = _read_chunks(path, encoded.tobytes())
    indexed = header[:9] + bytes([_INDEXED]) + header[10:]
    files.write_bytes(path, _join_chunks([(b"IHDR", indexed), (b"PLTE", _palette()), *rest]))


def _palette() -> bytes:
    """Return 256 colours, distinct for near numbers (Pascal VOC's palette): bits go to the channels from the top."""
    channel = np.zeros((256, 3), np.int64)
    left = np.arange(256)
    for bit in range(7, -1, -1):
        for c in range(3):
            channel[:, c] |= ((left >> c) & 1) << bit
        left = left >> 3
    return channel.astype(np.uint8).tobytes()


def _read_chunks(path: Path, data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield names and bodies of a PNG's chunks. Raises FormatError if it is cut short."""
    at = len(_SIGNATURE)
    while True:
        if at + 8 > len(data):
            raise FormatError(str(path), "a whole PNG", f"{len(data)} bytes, without an end")
        length, name = struct.unpack(">I4s", data[at : at + 8])
        if at + 12 + length > len(data):
            raise FormatError(str(path), "a whole PNG", f"{len(data)} bytes, cut in {name!r}")
        yield name, data[at + 8 : at + 8 + length]
        at += 12 + length
        if name == b"IEND":
            return


def _join_chunks(chunks: Sequence[tuple[bytes, bytes]]) -> bytes:
    parts = [
        struct.pack(">I4s", len(body), name) + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    ]
    return _SIGNATURE + b"".join(parts)


def _decode_grey(path: Path, data: bytes, size_hw: tuple[int, int]) -> np.ndarray:
    """Decode a PNG of one channel, 8 or 16 bits, as stored."""
    if not data.startswith(_SIGNATURE):
        raise FormatError(str(path), "a PNG", f"{len(data)} bytes of another format")
    for _ in _read_chunks(path, data):  # OpenCV silently fills missing data with zeros
        pass
    files.read_image_size(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FormatError(str(path), "a PNG", f"a file that does not decode ({error.err})") from error
    if image is None:
        raise FormatError(str(path), "a PNG", f"{len(data)} bytes that do not decode")
    if image.ndim != 2:
        raise FormatError(str(path), "1 channel", image.shape[2])
    if image.shape != size_hw:
        raise FormatError(str(path), f"{size_hw[1]}x{size_hw[0]} px", f"{image.shape[1]}x{image.shape[0]} px")
    return image


class ColourTable:
    """Names and colours of the classes in a class image, read from a table `<name column> r g b`.

    `names` and `rgb` (N, 3) uint8 are in file order. Raises FormatError naming file, line and field: no row, a value
    that is not a byte, a repeated colour or name.
    """

    def __init__(self, path: Path, name_column: str) -> None:
        self.path = path
        table = TextTable(path, ("r", "g", "b"), (name_column,))
        self.names: tuple[str, ...] = ()
        rgb: list[tuple[int, ...]] = []
        for row in table.all_rows():
            name = row.word(name_column)
            colour = tuple(int(row.number(c, 0, 255)) for c in ("r", "g", "b"))
            if name in self.names:
                raise FormatError(f"{row.where}: {name_column}", "each once", f"{name} twice")
            if colour in rgb:
                raise FormatError(f"{row.where}: r g b", f"a unique colour for {name}", colour)
            self.names += (name,)
            rgb.append(colour)
        if not rgb:
            raise FormatError(str(path), "at least one colour", "none")
        self.rgb = np.array(rgb, np.uint8)
        codes = _pack_rgb(self.rgb)
        self._order = np.argsort(codes)
        self._sorted = codes[self._order]

    def read(self, path: Path, size_hw: tuple[int, int]) -> np.ndarray:
        """Read indices (H, W) int64 into `names` of an image. Raises FormatError naming a pixel of another colour."""
        image = files.read_image(path, size_hw)
        codes = _pack_rgb(image)
        index = np.minimum(np.searchsorted(self._sorted, codes), len(self._sorted) - 1)
        unknown = self._sorted[index] != codes
        if unknown.any():
            y, x = np.argwhere(unknown)[0]
            colour = " ".join(str(v) for v in image[y, x])
            raise FormatError(f"{path}: pixel ({x}, {y})", f"a colour of {self.path.name}", colour)
        return self._order[index]


def _pack_rgb(rgb: np.ndarray) -> np.ndarray:
    """Pack colours (..., 3) uint8 into numbers (...) int32."""
    wide = rgb.astype(np.int32)
    return wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]


T = TypeVar("T")

_MAX_FLOAT32 = 3.4028234e38
"""Largest float32, the type of tensors."""
_MAX_INTEGER = 2**31 - 1


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of a table."""

    where: str
    """File and line, for errors."""
    fields: Mapping[str, str]
    """Fields as text, by column."""

    def word(self, column: str, allowed: Sequence[str] = ()) -> str:
        """Return a field. Raises FormatError unless it is one of `allowed`, if given."""
        text = self.fields[column]
        if allowed and text not in allowed:
            raise FormatError(f"{self.where}: {column}", f"one of {', '.join(allowed)}", repr(text))
        return text

    def number(self, column: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Parse a finite number in [low, high].

        Args:
            column: Column.
            low: Minimum.
            high: Maximum.

        Returns:
            The number.

        Raises:
            FormatError: Names file, line and column.
        """
        where, text = f"{self.where}: {column}", self.fields[column]
        try:
            value = float(text)
        except ValueError:
            raise FormatError(where, "a number", repr(text)) from None
        if not abs(value) <= _MAX_FLOAT32:
            raise FormatError(where, "a finite number", text)
        if not low <= value <= high:
            limits = f"at least {low:g}" if math.isinf(high) else f"a number in [{low:g}, {high:g}]"
            raise FormatError(where, limits, text)
        return value

    def positive(self, column: str) -> float:
        """Parse a finite number above 0. Raises FormatError."""
        value = self.number(column)
        if value <= 0:
            raise FormatError(f"{self.where}: {column}", "more than 0", self.fields[column])
        return value

    def integer(self, column: str, low: int = 0) -> int:
        """Parse an integer of at least `low`. Raises FormatError."""
        value = _parse_integer(f"{self.where}: {column}", self.fields[column])
        if value < low:
            raise FormatError(f"{self.where}: {column}", f"at least {low}", value)
        if value > _MAX_INTEGER:
            raise FormatError(f"{self.where}: {column}", f"at most {_MAX_INTEGER}", value)
        return value


def _parse_integer(where: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise FormatError(where, "a whole number", repr(text)) from None


class TextTable:
    """A table of space-separated fields under a header; opening reads the key columns only.

    Args:
        path: The file.
        key: Integer columns by which rows are found.
        columns: Other columns that the header must have, in any order.

    Raises:
        FormatError: Names file and line: an empty file, a missing column, a key that is not an integer.
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
        key_columns = [self.header.index(name) for name in key]
        reach = max(key_columns) + 1
        self._lines: dict[tuple[int, ...], list[tuple[int, str]]] = {}
        for number, line in enumerate(lines[1:], start=2):
            start = line.split(None, reach)
            if not start:
                continue
            if len(start) < reach:
                raise FormatError(f"{path}:{number}", f"{len(self.header)} fields", len(start))
            values = tuple(_parse_integer(f"{path}:{number}: {self.header[i]}", start[i]) for i in key_columns)
            self._lines.setdefault(values, []).append((number, line))

    def rows(self, *key: int) -> list[TableRow]:
        """Return the rows of a key, in file order. Raises FormatError if a row's fields do not fit the header."""
        return [self._parse_row(number, line) for number, line in self._lines.get(key, ())]

    def all_rows(self) -> list[TableRow]:
        """Return all rows, in file order. Raises FormatError as `rows`."""
        lines = sorted(line for group in self._lines.values() for line in group)
        return [self._parse_row(number, line) for number, line in lines]

    def _parse_row(self, number: int, line: str) -> TableRow:
        where, fields = f"{self.path}:{number}", line.split()
        if len(fields) != len(self.header):
            raise FormatError(where, f"{len(self.header)} fields", len(fields))
        return TableRow(where, dict(zip(self.header, fields, strict=True)))

    def row(self, *key: int) -> TableRow:
        """Return the only row of a key. Raises FormatError if there is none or more than one."""
        rows = self.rows(*key)
        name = " ".join(f"{column} {value}" for column, value in zip(self._key, key, strict=True))
        if not rows:
            raise FormatError(str(self.path), f"a row of {name}", "none")
        if len(rows) > 1:
            raise FormatError(rows[1].where, f"one row of {name}", f"{len(rows)}")
        return rows[0]

    def rows_by(self, column: str, *key: int) -> dict[int, TableRow]:
        """Return the rows of a key by the integer in `column`, in file order. Raises FormatError for duplicates."""
        by_value: dict[int, TableRow] = {}
        for row in self.rows(*key):
            value = row.integer(column)
            if value in by_value:
                raise FormatError(f"{row.where}: {column}", "each once in a frame", f"{value} twice")
            by_value[value] = row
        return by_value


class FileCache(Generic[T]):
    """Contents of the `count` most recently used files, by path."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._contents: OrderedDict[Path, T] = OrderedDict()

    def __len__(self) -> int:
        return len(self._contents)

    def get(self, path: Path, read: Callable[[Path], T]) -> T:
        """Return the cached content of a file, or read it."""
        if path not in self._contents:
            self._contents[path] = read(path)
        self._contents.move_to_end(path)
        while len(self._contents) > self._count:
            self._contents.popitem(last=False)
        return self._contents[path]


def format_decimal(value: float) -> str:
    """Format a number with nine significant digits, the precision of float32."""
    return f"{float(value) + 0.0:.9g}"


def format_table(header: str, lines: Sequence[str]) -> str:
    """Format the text of a table."""
    return "".join(f"{line}\n" for line in (header, *lines))


def to_word(text: str) -> str:
    """Convert a name to one field of a table."""
    return "_".join(text.split()) or "none"
