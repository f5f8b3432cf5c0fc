"""Files that appear whole or not at all, and are read with errors that name them. Light: needs no torch."""

from __future__ import annotations

import filecmp
import hashlib
import io
import json
import os
import secrets
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scene_ir.errors import FormatError, ShapeError

_NPZ_LEVEL = 1
"""zlib level: float maps shrink hardly further at higher ones, and take several times as long."""


def _sibling(path: Path) -> Path:
    """A free hidden name beside `path`, on the same file system, so that a rename is atomic."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` so that a reader sees the old file or the new one, never a part. Makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def share_alike(folder: Path, other: Path) -> None:
    """Let files below `folder` that equal those of the same name below `other` take no room of their own: hard
    links, where the file system has them. Files of this project are replaced and never written into, so that a
    change of one stays away from the other.
    """
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        twin = other / path.relative_to(folder)
        if not twin.is_file() or path.samefile(twin) or not filecmp.cmp(path, twin, shallow=False):
            continue
        temporary = _sibling(path)
        try:
            os.link(twin, temporary)
            os.replace(temporary, path)
        except OSError:  # another file system, or one without links: two copies are as good
            return
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically. Floats round trip; ValueError where one is not finite."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_png(path: Path, image: np.ndarray, compression: int | None = None) -> None:
    """Write an image as PNG, atomically. image: (H, W, 3) RGB or (H, W), uint8 or uint16. compression: zlib's
    level, 0 to 9, None for OpenCV's choice; 1 is several times as fast as 9 and about 15 % larger.
    """
    import cv2

    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise ShapeError(str(path), "(H, W, 3) or (H, W) of uint8 or uint16", f"{image.shape} of {image.dtype}")
    options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    ok, encoded = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image, options)
    if not ok:
        raise FormatError(str(path), "an image that PNG can hold", f"{image.shape} of {image.dtype}")
    write_bytes(path, encoded.tobytes())


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as a compressed NPZ, atomically; equal arrays give equal bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=_NPZ_LEVEL) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array).reshape(array.shape), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980, so that bytes do not depend on the clock
            archive.writestr(entry, member.getvalue(), zipfile.ZIP_DEFLATED, _NPZ_LEVEL)
    write_bytes(path, buffer.getvalue())


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder beside `folder` that takes its name and place when the block ends without error."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(folder)
    temporary.mkdir()
    try:
        yield temporary
        if folder.exists():
            old = _sibling(folder)
            os.replace(folder, old)
            os.replace(temporary, folder)
            shutil.rmtree(old)
        else:
            os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal. FormatError where it is missing or cannot be read."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def read_bytes(path: Path) -> bytes:
    """The bytes of a file. FormatError where it is missing or cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise FormatError(str(path), "a readable file", (error.strerror or str(error)).lower()) from error


def read_text(path: Path) -> str:
    """The text of a UTF-8 file. FormatError where it is missing, cannot be read or is no text."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(
            str(path), "UTF-8 text", f"byte 0x{error.object[error.start]:02x} at {error.start}"
        ) from error


def read_json(path: Path) -> Any:
    """The value in a JSON file. FormatError naming line and column where it is none."""
    text = read_text(path)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise FormatError(f"{path}:{error.lineno}:{error.colno}", "JSON", error.msg) from error


def _decode(path: Path) -> np.ndarray:
    """The values of an image file as OpenCV has them, unchanged. FormatError where it is missing or no image."""
    import cv2

    data = read_bytes(path)
    whole = not (data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]) and not (
        data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-64:]
    )  # the decoder fills what is missing with grey, without a word
    image = None
    if data and whole:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise FormatError(str(path), "an image", f"what does not decode ({error.err})") from error
    if image is None:
        raise FormatError(str(path), "an image", f"{len(data)} bytes that do not decode")
    return image


def _check_size(path: Path, image: np.ndarray, size_hw: tuple[int, int] | None) -> None:
    if size_hw is not None and image.shape[:2] != size_hw:
        raise FormatError(str(path), f"{size_hw[1]}x{size_hw[0]} px", f"{image.shape[1]}x{image.shape[0]} px")


def read_image(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """An 8-bit colour image as (H, W, 3) RGB uint8.

    FormatError where the file is missing, is cut short, does not decode, is not 8-bit with three channels, or is
    not of `size_hw` (height, width) where that is given.
    """
    image = _decode(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        channels = image.shape[2] if image.ndim == 3 else 1
        raise FormatError(str(path), "8 bits and 3 channels", f"{image.dtype.itemsize * 8} bits and {channels}")
    _check_size(path, image, size_hw)
    return np.ascontiguousarray(image[..., ::-1])


def read_uint16(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """A 16-bit image of one channel as (H, W) uint16. FormatError as `read_image`."""
    image = _decode(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = image.shape[2] if image.ndim == 3 else 1
        raise FormatError(str(path), "16 bits and 1 channel", f"{image.dtype.itemsize * 8} bits and {channels}")
    _check_size(path, image, size_hw)
    return image


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an NPZ. FormatError where it is none, or holds pickled objects."""
    data = read_bytes(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise FormatError(str(path), "an NPZ archive of arrays", "a single array")
            return {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError, KeyError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(str(path), "an NPZ archive of arrays", str(error).splitlines()[0]) from error
