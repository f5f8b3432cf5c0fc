"""Images whose pixels are numbers: depth in centimetres, class colours, instance numbers in an indexed PNG."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from drivesem.data.tables import Table
from drivesem.data.truth import SKY_CM
from scene_ir import files
from scene_ir.errors import FormatError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _INDEXED = 0, 3
"""Colour types of the PNG specification, 11.2.2."""


def read_depth_m(path: Path, size_hw: tuple[int, int]) -> np.ndarray:
    """Depth (H, W) float32 m from a uint16 PNG in centimetres; inf in the sky (65535). FormatError."""
    depth = _decode(path, files.read_bytes(path), size_hw)
    if depth.dtype != np.uint16:
        raise FormatError(str(path), "16 bits and 1 channel", f"{depth.dtype.itemsize * 8} bits and 1")
    metres = depth.astype(np.float32) / np.float32(100)
    metres[depth == SKY_CM] = np.inf
    return metres


def read_indices(path: Path, size_hw: tuple[int, int]) -> np.ndarray:
    """Numbers (H, W) uint16 from an indexed PNG (its palette is ignored), or from a grey one. FormatError."""
    data = files.read_bytes(path)
    bits = 8
    if data.startswith(_SIGNATURE):
        chunks = list(_chunks(path, data))
        size, header = chunks[0]
        if size == b"IHDR" and len(header) == 13 and header[9] == _INDEXED:
            # Decoders turn indices into the palette's colours. As a grey image of as many bits they are kept.
            bits = header[8]
            grey = header[:9] + bytes([_GREY]) + header[10:]
            kept = [(name, body) for name, body in chunks[1:] if name not in (b"PLTE", b"tRNS")]
            data = _assemble([(b"IHDR", grey), *kept])
    values = _decode(path, data, size_hw)
    # Grey of fewer than 8 bits is stretched to 0..255 by decoders.
    return values.astype(np.uint16) // (255 // ((1 << bits) - 1) if bits < 8 else 1)


def write_indices(path: Path, indices: np.ndarray) -> None:
    """Write numbers (H, W) below 256 as an indexed PNG of 8 bits, atomically."""
    if indices.max(initial=0) > 255:
        raise FormatError(str(path), "numbers that 8 bits hold", int(indices.max()))
    _, encoded = cv2.imencode(".png", indices.astype(np.uint8))
    (_, header), *rest = _chunks(path, encoded.tobytes())
    indexed = header[:9] + bytes([_INDEXED]) + header[10:]
    files.write_bytes(path, _assemble([(b"IHDR", indexed), (b"PLTE", _palette()), *rest]))


def _palette() -> bytes:
    """256 colours that differ clearly where their numbers are near: bits dealt out to the channels from the top
    (Pascal VOC's palette)."""
    channel = np.zeros((256, 3), np.int64)
    left = np.arange(256)
    for bit in range(7, -1, -1):
        for c in range(3):
            channel[:, c] |= ((left >> c) & 1) << bit
        left = left >> 3
    return channel.astype(np.uint8).tobytes()


def _chunks(path: Path, data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Names and bodies of a PNG's chunks. FormatError where it is cut short."""
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


def _assemble(chunks: Sequence[tuple[bytes, bytes]]) -> bytes:
    parts = [
        struct.pack(">I4s", len(body), name) + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    ]
    return _SIGNATURE + b"".join(parts)


def _decode(path: Path, data: bytes, size_hw: tuple[int, int]) -> np.ndarray:
    """A PNG of one channel as it is stored, 8 or 16 bits."""
    if not data.startswith(_SIGNATURE):
        raise FormatError(str(path), "a PNG", f"{len(data)} bytes of another kind")
    for _ in _chunks(path, data):  # the decoder fills what is missing with zeros, without a word
        pass
    files.check_pixels(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FormatError(str(path), "a PNG", f"what does not decode ({error.err})") from error
    if image is None:
        raise FormatError(str(path), "a PNG", f"{len(data)} bytes that do not decode")
    if image.ndim != 2:
        raise FormatError(str(path), "1 channel", image.shape[2])
    if image.shape != size_hw:
        raise FormatError(str(path), f"{size_hw[1]}x{size_hw[0]} px", f"{image.shape[1]}x{image.shape[0]} px")
    return image


class Colours:
    """Names of colours, read from a table `<name column> r g b`: what the pixels of a class image mean.

    names: one a row, in file order. rgb (N, 3) uint8. FormatError naming file, line and field: no row, a value
    that is no byte, a colour or a name that occurs twice.
    """

    def __init__(self, path: Path, name_column: str) -> None:
        self.path = path
        table = Table(path, ("r", "g", "b"), (name_column,))
        self.names: tuple[str, ...] = ()
        rgb: list[tuple[int, ...]] = []
        for row in table.all_rows():
            name = row.word(name_column)
            colour = tuple(int(row.number(c, 0, 255)) for c in ("r", "g", "b"))
            if name in self.names:
                raise FormatError(f"{row.where}: {name_column}", "each once", f"{name} twice")
            if colour in rgb:
                raise FormatError(f"{row.where}: r g b", f"a colour of its own for {name}", colour)
            self.names += (name,)
            rgb.append(colour)
        if not rgb:
            raise FormatError(str(path), "at least one colour", "none")
        self.rgb = np.array(rgb, np.uint8)
        codes = _codes(self.rgb)
        self._order = np.argsort(codes)
        self._sorted = codes[self._order]

    def read(self, path: Path, size_hw: tuple[int, int]) -> np.ndarray:
        """Rows (H, W) int64 into `names` of an image's pixels. FormatError naming a pixel of another colour."""
        image = files.read_image(path, size_hw)
        codes = _codes(image)
        places = np.minimum(np.searchsorted(self._sorted, codes), len(self._sorted) - 1)
        unknown = self._sorted[places] != codes
        if unknown.any():
            y, x = np.argwhere(unknown)[0]
            found = " ".join(str(v) for v in image[y, x])
            raise FormatError(f"{path}: pixel ({x}, {y})", f"a colour of {self.path.name}", found)
        return self._order[places]


def _codes(rgb: np.ndarray) -> np.ndarray:
    """Colours (..., 3) uint8 as numbers (...) int32."""
    wide = rgb.astype(np.int32)
    return wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]
