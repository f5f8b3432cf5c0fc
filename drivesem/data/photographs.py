"""Photographs of which nothing is told but the file: their pixels, and a camera from EXIF or from a usual view."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.data.frames import pinhole
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame

DEFAULT_FOCAL = 0.58
"""Focal length in image widths where nothing tells it: KITTI's 721 px of 1242, a view 81 degrees wide."""
FILM_MM = 36.0
"""Width of the film that EXIF's "focal length in 35 mm film" speaks of; its longer side."""
_EXIF, _FOCAL, _FOCAL_35 = 0x8769, 0x920A, 0xA405
_PLANE_X, _PLANE_Y, _PLANE_UNIT, _ORIENTATION = 0xA20E, 0xA20F, 0xA210, 0x0112
"""Tags of EXIF 2.32: its own directory, focal length in mm and in 35 mm film, pixels a unit on the sensor."""
_UNIT_MM: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0}
_TURNED: dict[float, int] = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
"""EXIF's orientations, and quarter turns to the left that put them upright."""
_MIRRORED = (2, 4, 5, 7)
"""Of these orientations those that left and right are to be swapped in, after the turns."""
_OTHER_CHANNELS = ("1", "L", "LA", "P", "PA", "RGBA", "CMYK")
"""Pillow's modes of 8 bits that are not red, green and blue, but can be."""


def read_pixels(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """A photograph of 8 bits as (H, W, 3) RGB uint8: grey becomes three equal channels, and opacity is left out.

    FormatError where the file is missing, does not decode, has more bits, or is not of `size_hw`.
    """
    files.check_text(f"{path.parent}: name of a photograph", path.name)
    with files.opened_image(path, files.read_bytes(path)) as image:
        width, height = image.size
        if image.mode not in _OTHER_CHANNELS:
            return files.read_image(path, size_hw)
        pixels = np.array(image.convert("RGB"))
    if size_hw is not None and (height, width) != size_hw:
        raise FormatError(str(path), f"{size_hw[1]}x{size_hw[0]} px", f"{width}x{height} px")
    return pixels


@dataclass(frozen=True, slots=True)
class Focal:
    """A focal length, px, and where it is from: "given", "EXIF" or "default"."""

    length_px: float
    source: str

    def __str__(self) -> str:
        return f"{self.length_px:.1f} px, {self.source}"


def upright_pixels(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """As `read_pixels`, turned as EXIF says: as viewers show it, and OpenCV reads it. Where only the stored image
    is of `size_hw`, that is meant, and stays as it is.
    """
    told, _, _ = _header(path)
    pixels = np.rot90(read_pixels(path), _turns(told))
    if size_hw not in (None, pixels.shape[:2]):
        return read_pixels(path, size_hw)
    return np.ascontiguousarray(pixels[:, ::-1] if _positive(told.get(_ORIENTATION)) in _MIRRORED else pixels)


def upright_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as seen upright, from its header. FormatError."""
    return _header(path)[1:]


def camera_of(image_path: Path, focal_px: float | None = None) -> Camera:
    """The camera of a photograph: its axis through the middle, focal length as `focal_of` has it."""
    _, width, height = _header(image_path)
    return pinhole(height, width, focal_of(image_path, focal_px).length_px)


def focal_of(image_path: Path, focal_px: float | None = None) -> Focal:
    """The focal length of a photograph: `focal_px`, otherwise EXIF's, otherwise 0.58 of the image's longer side.

    RangeError for a focal_px that is no positive number, FormatError naming a file that is no image.
    """
    told, width, height = _header(image_path)
    if focal_px is not None:
        return Focal(_checked(focal_px), "given")
    longer = max(width, height)
    film = _positive(told.get(_FOCAL_35))
    if film:
        return Focal(film / FILM_MM * longer, "EXIF")
    unit = _UNIT_MM.get(_positive(told.get(_PLANE_UNIT, 2)))
    length, density = _positive(told.get(_FOCAL)), _positive(told.get(_PLANE_X)) or _positive(told.get(_PLANE_Y))
    if unit and length and density:
        return Focal(length / unit * density, "EXIF")
    return Focal(DEFAULT_FOCAL * longer, "default")


def camera_for(height: int, width: int, focal_px: float | None = None) -> Camera:
    """The camera of pixels that nothing is told of: 0.58 of the longer side where no focal length is given."""
    focal = DEFAULT_FOCAL * max(width, height) if focal_px is None else _checked(focal_px)
    return pinhole(height, width, focal)


def _checked(focal_px: float) -> float:
    if not (math.isfinite(focal_px) and focal_px > 0):
        raise RangeError("focal", "positive px", focal_px)
    return float(focal_px)


def _positive(value: Any) -> float:
    """A value of EXIF as a positive number; 0 where it is none: cameras write 0 for what they do not know."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0


def _header(path: Path) -> tuple[dict[int, Any], int, int]:
    """EXIF's values by tag, and width and height as seen upright. FormatError."""
    from PIL import Image

    with files.opened_image(path) as image:  # Pillow reads EXIF when it is asked for, and then says what is wrong
        exif = Image.Image.getexif(image)  # a PNG's own way decodes the pixels, behind which EXIF hardly ever is
        told = {_ORIENTATION: exif.get(_ORIENTATION), **exif.get_ifd(_EXIF)}
        width, height = image.size
    return (told, height, width) if _turns(told) % 2 else (told, width, height)


def _turns(told: Mapping[int, Any]) -> int:
    return _TURNED.get(_positive(told.get(_ORIENTATION)), 0)


def photograph(path: Path, focal_px: float | None = None) -> Frame:
    """A photograph, upright, with its camera, without labels. FormatError naming the file; RangeError."""
    focal = focal_of(path, focal_px)
    image = to_tensor(upright_pixels(path))
    provenance = {"dataset": "photograph", "image": path.name, "focal": str(focal)}
    return Frame(path.stem, image, pinhole(image.shape[1], image.shape[2], focal.length_px), provenance=provenance)
