"""Sizes and EXIF orientation of image files, and upright copies, without torch."""

from __future__ import annotations

import shutil
from io import BytesIO
from os.path import isfile
from pathlib import Path
from typing import TYPE_CHECKING

from scene_ir import files

if TYPE_CHECKING:
    from PIL import Image

_HEAD_BYTES = 1 << 16
_ORIENTATION = 0x0112
"""EXIF's tag of the orientation."""
_JPEG_QUALITY = 95
"""JPEG quality of copies that are turned upright."""


def read_orientation(path: str | Path) -> int:
    """Read EXIF's orientation of an image, 1 to 8; 1 if there is none, or no file."""
    return read_header(path)[0] if isfile(path) else 1


def read_header(path: str | Path) -> tuple[int, int, int]:
    """Read an image's orientation, width and height, as stored, as `read_stored_header` does, but faster."""
    with open(path, "rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if b"Exif\0\0" not in head and b"eXIf" not in head and (size_wh := _find_size(head)) is not None:
        return (1, *size_wh)
    return read_stored_header(path)


def _find_size(head: bytes) -> tuple[int, int] | None:
    """Return width and height in the first bytes of a PNG or JPEG; None for other formats and longer headers."""
    if head.startswith(b"\x89PNG") and len(head) >= 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    place = 2 if head.startswith(b"\xff\xd8") else len(head)
    while place + 9 <= len(head) and head[place] == 0xFF:
        marker = head[place + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame header
            height, width = head[place + 5 : place + 7], head[place + 7 : place + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        place += 2 + int.from_bytes(head[place + 2 : place + 4], "big")
    return None


def read_upright_size(path: str | Path) -> tuple[int, int]:
    """Read width and height of the upright image from its header. Raises FormatError."""
    orientation, width, height = read_header(path)
    return (height, width) if orientation > 4 else (width, height)


def read_stored_header(path: str | Path) -> tuple[int, int, int]:
    """Read an image's orientation, width and height, as stored. Raises FormatError.

    TIFF files are upright, since Pillow turns them.
    """
    with files.open_image(Path(path)) as image:
        return (1 if image.format == "TIFF" else _orientation(image), *image.size)


def _orientation(image: Image.Image) -> int:
    from PIL import Image

    orientation = Image.Image.getexif(image).get(_ORIENTATION)  # PNG's own method would decode all pixels
    return orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1


def copy_upright(source: Path, target: Path) -> None:
    """Copy an image unchanged; with an EXIF orientation, turned upright, without that tag, in the same file format.

    Raises FormatError for a damaged image.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    is_tiff = source.suffix.lower() in (".tif", ".tiff")
    if not is_tiff and read_orientation(source) == 1:
        shutil.copyfile(source, target)
        return
    from PIL import ImageOps

    with files.open_image(source) as image:
        if is_tiff and _orientation(image) == 1:
            shutil.copyfile(source, target)
            return
        image.load()  # turns TIFF
        upright = ImageOps.exif_transpose(image)  # without the tag
        data = BytesIO()
        options = {"quality": _JPEG_QUALITY, "subsampling": 0} if image.format == "JPEG" else {"lossless": True}
        profile = image.info.get("icc_profile")
        upright.save(data, image.format, exif=upright.getexif().tobytes(), icc_profile=profile, **options)
    files.write_bytes(target, data.getvalue())
