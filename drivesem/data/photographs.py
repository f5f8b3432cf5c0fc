"""Photographs and indices of frames: image files, pixels, cameras from EXIF, and checks against calibrations."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from drivesem.data.account import IMAGE_SUFFIXES
from drivesem.data.kitti_labels import NEAR_M
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, make_printable
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

T = TypeVar("T")

BOX_MARGIN = 0.1
"""How far a label's box may reach beyond the image, in image sizes; beyond it, labels and image do not belong together.
KITTI's never do (checked on all 7,481); other tools' may, since objects continue there."""
CENTRE_RANGE = (0.25, 0.75)
"""Range of the principal point, as a fraction of the image; KITTI's lie at 0.46 to 0.50. Beyond it, image and
calibration do not belong together."""
DEFAULT_FOCAL = 0.58
"""Default focal length in image widths: KITTI's 721 px of 1242, a field of view of 81 degrees."""
FILM_MM = 36.0
"""Longer side of the film to which EXIF's "focal length in 35 mm film" refers."""
_EXIF, _FOCAL, _FOCAL_35 = 0x8769, 0x920A, 0xA405
_PLANE_X, _PLANE_Y, _PLANE_UNIT, _ORIENTATION = 0xA20E, 0xA20F, 0xA210, 0x0112
"""Tags of EXIF 2.32: sub-directory, focal length in mm and in 35 mm film, sensor pixels per unit."""
_UNIT_MM: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0}
_QUARTER_TURNS: dict[float, int] = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
"""Quarter turns to the left that make an image of each EXIF orientation upright."""
_MIRRORED = (2, 4, 5, 7)
"""Orientations that are also mirrored left to right, after the turns."""
_CONVERTIBLE_MODES = ("1", "L", "LA", "P", "PA", "RGBA", "CMYK")
"""Pillow's 8-bit modes that convert to RGB."""


class FrameIndex(Generic[T]):
    """Entries of a data set's frames, known before their files are read, by identifier."""

    def __init__(self, name: object, entries: Mapping[str, T]) -> None:
        self._name = name  # of the data set, for errors
        self._entries = dict(entries)

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        return tuple(self._entries)

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split, where the data set has splits."""
        return {}

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that the data set states of a frame, such as weather and timeofday."""
        self._entry(identifier)
        return {}

    def __len__(self) -> int:
        return len(self._entries)

    def _entry(self, identifier: str) -> T:
        if identifier not in self._entries:
            raise RangeError(f"frame of {self._name}", f"one of {len(self)} identifiers", repr(identifier))
        return self._entries[identifier]


def list_images(folder: Path, recursive: bool = False) -> list[Path]:
    """List the images in a folder, sorted; with `recursive` also those in its subfolders.

    Hidden files and folders are left out. Raises FormatError if there is no such folder.
    """
    try:
        exists = folder.is_dir()
    except OSError as error:  # such as a name that is too long
        raise FormatError(make_printable(str(folder)), "a folder of images", f"{error.strerror}") from None
    if not exists:
        raise FormatError(str(folder), "a folder of images", "no such folder")
    images: list[Path] = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if recursive and name[0] != "."]
        images += [Path(place, n) for n in names if n[0] != "." and n.lower().endswith(IMAGE_SUFFIXES)]
    return sorted(images)


def name_by_path(images: Sequence[Path], root: Path) -> dict[str, Path]:
    """Return images by identifier, in order: their stems if these differ, else their paths below `root`.

    Raises FormatError for two images of one folder that differ in their suffix only.
    """
    named = {image.stem: image for image in images}
    if len(named) == len(images):
        return named
    named = {}
    for image in images:
        name = image.relative_to(root).with_suffix("").as_posix()
        if name in named:
            raise FormatError(str(image), "a unique name", f"the name of {named[name]}")
        named[name] = image
    return named


def pinhole_camera(height: int, width: int, focal_px: float) -> Camera:
    """Make a camera with a centred principal point.

    Args:
        height: Image height, px.
        width: Image width, px.
        focal_px: Focal length.

    Returns:
        The camera.
    """
    centre = [(width - 1) / 2, (height - 1) / 2]
    intrinsics = torch.tensor([[focal_px, 0.0, centre[0]], [0.0, focal_px, centre[1]], [0.0, 0.0, 1.0]])
    return Camera(intrinsics, height, width)


def check_focal(focal_px: float | None) -> None:
    """Raise RangeError unless a focal length is None or positive."""
    if focal_px is not None and not (math.isfinite(focal_px) and focal_px > 0):
        raise RangeError("focal_px", "positive px", focal_px)


def check_image_size(image_path: Path, camera: Camera, labels: Labels | None) -> None:
    """Check that an image's size fits its calibration and its labels.

    Args:
        image_path: The image, for errors.
        camera: Camera with the image's size.
        labels: Labels with boxes that the image must contain, if any.

    Raises:
        FormatError: The size contradicts the calibration or the labels.
    """
    size_text = f"{camera.width}x{camera.height} px"
    low, high = CENTRE_RANGE
    for axis, size in ((0, camera.width), (1, camera.height)):
        centre = float(camera.intrinsics[axis, 2])
        if not low * size <= centre <= high * size:
            name = ("wide", "high")[axis]
            expected = f"{centre / high:.0f} to {centre / low:.0f} px {name} (principal point of the calibration)"
            raise FormatError(str(image_path), expected, size_text)
    if labels is None:
        return
    boxes = torch.cat([labels.boxes_xyxy, labels.ignore_xyxy])
    size = torch.tensor([camera.width, camera.height], dtype=boxes.dtype)
    outside = ((boxes[:, 2:] > (1 + BOX_MARGIN) * size) | (boxes[:, :2] < -BOX_MARGIN * size)).any(dim=1)
    if bool(outside.any()):
        box = [round(v, 2) for v in boxes[outside][0].tolist()]
        raise FormatError(str(image_path), f"an image that holds the label's box {box}", size_text)


def is_in_front(z: float, length: float, width: float, yaw: float) -> bool:
    """Whether any part of a 3D box lies beyond the near plane.

    Args:
        z: Distance of the box's centre, m.
        length: Length, m.
        width: Width, m.
        yaw: Yaw, rad.

    Returns:
        False if no pixel can show the box.
    """
    return z + 0.5 * (length * abs(math.sin(yaw)) + width * abs(math.cos(yaw))) > NEAR_M


def match_images(folder: Path, frames: Sequence[str]) -> dict[str, Path]:
    """Find the image of each frame below a folder, by its identifier, or its last part; others are left out."""
    paths = list_images(folder, recursive=True)
    by_path = {path.relative_to(folder).with_suffix("").as_posix(): path for path in reversed(paths)}
    count = Counter(path.stem for path in by_path.values())
    by_stem = {path.stem: path for path in by_path.values() if count[path.stem] == 1}
    found = {name: by_path.get(name) or by_stem.get(name.rpartition("/")[2]) for name in frames}
    return {name: path for name, path in found.items() if path is not None}


def read_pixels(path: Path, size_hw: tuple[int, int] | None = None) -> np.ndarray:
    """Read an 8-bit photograph as (H, W, 3) RGB uint8; grey becomes three equal channels, opacity is dropped.

    Raises FormatError where the file is missing, does not decode, has more bits, or is not of `size_hw`.
    """
    files.check_utf8(f"{path.parent}: name of a photograph", path.name)
    with files.open_image(path, files.read_bytes(path)) as image:
        width, height = image.size
        if image.mode not in _CONVERTIBLE_MODES and not (image.format == "TIFF" and image.mode == "RGB"):
            return files.read_image(path, size_hw)
        pixels = np.array(image.convert("RGB"))
    if size_hw is not None and (height, width) != size_hw:
        raise FormatError(str(path), f"{size_hw[1]}x{size_hw[0]} px", f"{width}x{height} px")
    return pixels


@dataclass(frozen=True, slots=True)
class FocalLength:
    """A focal length and its source."""

    length_px: float
    """Focal length, px."""
    source: str
    """"given", "EXIF" or "default"."""

    def __str__(self) -> str:
        return f"{self.length_px:.1f} px, {self.source}"


def read_upright(path: Path) -> np.ndarray:
    """Read pixels as `read_pixels`, turned upright by EXIF, as viewers and OpenCV do."""
    orientation = _to_positive(_read_header(path)[0].get(_ORIENTATION))
    return turn_pixels(read_pixels(path), orientation)


def turn_pixels(pixels: np.ndarray, orientation: float) -> np.ndarray:
    """Turn a stored image or mask (H, W, ...) upright. orientation: EXIF's, 1 to 8; others change nothing."""
    pixels = np.rot90(pixels, _QUARTER_TURNS.get(orientation, 0))
    return np.ascontiguousarray(pixels[:, ::-1] if orientation in _MIRRORED else pixels)


def read_focal_length(image_path: Path, focal_px: float | None = None) -> FocalLength:
    """Return the focal length of a photograph: `focal_px`, else EXIF's, else 0.58 of the image's longer side.

    Raises RangeError unless focal_px is positive, FormatError naming a file that is no image.
    """
    tags, width, height = _read_header(image_path)
    if focal_px is not None:
        check_focal(focal_px)
        return FocalLength(float(focal_px), "given")
    longer = max(width, height)
    film = _to_positive(tags.get(_FOCAL_35))
    if film:
        return FocalLength(film / FILM_MM * longer, "EXIF")
    unit = _UNIT_MM.get(_to_positive(tags.get(_PLANE_UNIT, 2)))
    length = _to_positive(tags.get(_FOCAL))
    density = _to_positive(tags.get(_PLANE_X)) or _to_positive(tags.get(_PLANE_Y))
    if unit and length and density:
        return FocalLength(length / unit * density, "EXIF")
    return FocalLength(DEFAULT_FOCAL * longer, "default")


def default_camera(height: int, width: int, focal_px: float | None = None) -> Camera:
    """Make a camera for an image without metadata.

    Args:
        height: Image height, px.
        width: Image width, px.
        focal_px: Focal length; by default 0.58 of the longer side.

    Raises:
        RangeError: Unless focal_px is positive.
    """
    check_focal(focal_px)
    return pinhole_camera(height, width, DEFAULT_FOCAL * max(width, height) if focal_px is None else focal_px)


def _to_positive(value: Any) -> float:
    """Convert an EXIF value to a positive number; 0 if it is none. Cameras write 0 for unknown values."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0


def _read_header(path: Path) -> tuple[dict[int, Any], int, int]:
    """Read EXIF values by tag, and width and height of the upright image. Raises FormatError."""
    from PIL import Image

    with files.open_image(path) as image:  # Pillow reads EXIF on demand and raises then
        exif = Image.Image.getexif(image)  # PngImageFile's method would decode all pixels first
        tags = {_ORIENTATION: exif.get(_ORIENTATION), **exif.get_ifd(_EXIF)}
        if image.format == "TIFF":  # Pillow turns it
            tags[_ORIENTATION] = 1
        width, height = image.size
    return (tags, height, width) if _quarter_turns(tags) % 2 else (tags, width, height)


def _quarter_turns(tags: Mapping[int, Any]) -> int:
    return _QUARTER_TURNS.get(_to_positive(tags.get(_ORIENTATION)), 0)


def read_photograph(path: Path, focal_px: float | None = None) -> Frame:
    """Read an upright photograph with its camera, without labels. Raises FormatError or RangeError."""
    return read_labelled_photograph(path.stem, path, None, {"dataset": "photograph", "image": path.name}, focal_px)


def read_labelled_photograph(
    identifier: str, path: Path, labels: Labels | None, provenance: Mapping[str, str], focal_px: float | None
) -> Frame:
    """Read an upright photograph, with a camera that has a centred principal point.

    Args:
        identifier: Identifier of the frame.
        path: The image.
        labels: Labels in pixels of the upright image, if any.
        provenance: Data set and files; the focal length and its source are added.
        focal_px: Focal length; see `read_focal_length`.

    Raises:
        FormatError: A damaged image.
        RangeError: Unless focal_px is positive.
    """
    focal = read_focal_length(path, focal_px)
    image = to_tensor(read_upright(path))
    camera = pinhole_camera(image.shape[1], image.shape[2], focal.length_px)
    return Frame(identifier, image, camera, labels, provenance={**provenance, "focal": str(focal)})
