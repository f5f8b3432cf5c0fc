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
    if not isfile(path):
        return 1
    if str(path).lower().endswith((".jpg", ".jpeg", ".png")):  # faster than to parse the header
        with open(path, "rb") as stream:
            head = stream.read(_HEAD_BYTES)
        if b"Exif\0\0" not in head and b"eXIf" not in head:
            return 1
    return read_stored_header(path)[0]


def read_upright_size(path: str | Path) -> tuple[int, int]:
    """Read width and height of the upright image from its header. Raises FormatError."""
    orientation, width, height = read_stored_header(path)
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
