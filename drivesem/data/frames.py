"""What readers of frames share: frames by identifier, photographs, folders of images, cameras and their checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from scene_ir import files
from scene_ir.errors import FormatError, RangeError, shown
from scene_ir.types import Camera, Labels

T = TypeVar("T")

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
PNG_COMPRESSION = 1
"""zlib's level for images: several times as fast as its best."""
BOX_MARGIN_PX = 2.0
"""How far a label's box may lie outside the image: KITTI's never do (checked on all 7,481), rounding may."""
CENTRE_RANGE = (0.25, 0.75)
"""Where the principal point may lie, as a fraction of the image: KITTI's lie at 0.46 to 0.50. Elsewhere, image and
calibration do not belong together."""
NEAR_M = 0.1
"""The near plane of projected boxes: what lies wholly before it has no image."""


class Frames(Generic[T]):
    """What is known of each frame before its files are read, by identifier. what: the data set, for errors."""

    def __init__(self, what: object, entries: Mapping[str, T]) -> None:
        self._what = what
        self._entries = dict(entries)

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        return tuple(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def _entry(self, identifier: str) -> T:
        if identifier not in self._entries:
            raise RangeError(f"frame of {self._what}", f"one of {len(self)} identifiers", repr(identifier))
        return self._entries[identifier]


def images_of(folder: Path) -> list[Path]:
    """The images in a folder, sorted. FormatError where there is no such folder."""
    try:
        there = folder.is_dir()
    except OSError as error:  # such as a name that is too long
        raise FormatError(shown(str(folder)), "a folder of images", f"{error.strerror}") from None
    if not there:
        raise FormatError(str(folder), "a folder of images", "no such folder")
    return [p for p in sorted(folder.iterdir()) if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "."]


def size_of_image(path: Path) -> tuple[int, int]:
    """Width and height of an image, from its header. FormatError."""
    with files.opened_image(path) as image:
        return image.size


def as_photograph(image: np.ndarray) -> Tensor:
    """A photograph (3, H, W) float32 in [0, 1] of an image (H, W, 3) uint8."""
    return torch.from_numpy(image).permute(2, 0, 1).contiguous().to(torch.float32) / 255


def pinhole(height: int, width: int, focal_px: float) -> Camera:
    """A camera of which only the focal length is known: its axis goes through the middle of the image."""
    centre = [(width - 1) / 2, (height - 1) / 2]
    intrinsics = torch.tensor([[focal_px, 0.0, centre[0]], [0.0, focal_px, centre[1]], [0.0, 0.0, 1.0]])
    return Camera(intrinsics, height, width)


def check_focal(focal_px: float | None) -> None:
    """RangeError for a focal length that is none."""
    if focal_px is not None and not (math.isfinite(focal_px) and focal_px > 0):
        raise RangeError("focal_px", "positive px", focal_px)


def check_size(image_path: Path, camera: Camera, labels: Labels | None) -> None:
    """Refuse an image whose size contradicts its calibration or its labels."""
    found = f"{camera.width}x{camera.height} px"
    low, high = CENTRE_RANGE
    for axis, size in ((0, camera.width), (1, camera.height)):
        centre = float(camera.intrinsics[axis, 2])
        if not low * size <= centre <= high * size:
            name = ("wide", "high")[axis]
            expected = f"{centre / high:.0f} to {centre / low:.0f} px {name} (principal point of the calibration)"
            raise FormatError(str(image_path), expected, found)
    if labels is None:
        return
    boxes = torch.cat([labels.boxes_xyxy, labels.ignore_xyxy])
    limit = torch.tensor([camera.width, camera.height], dtype=boxes.dtype) - 1 + BOX_MARGIN_PX
    outside = ((boxes[:, 2:] > limit) | (boxes[:, :2] < -BOX_MARGIN_PX)).any(dim=1)
    if bool(outside.any()):
        box = [round(v, 2) for v in boxes[outside][0].tolist()]
        raise FormatError(str(image_path), f"an image that holds the label's box {box}", found)


def in_front(z: float, length: float, width: float, yaw: float) -> bool:
    """Whether any part of a 3D box lies before the camera; else no pixel can show it."""
    return z + 0.5 * (length * abs(math.sin(yaw)) + width * abs(math.cos(yaw))) > NEAR_M


def images_in(folders: Sequence[Path], frames: Sequence[str]) -> dict[str, Path]:
    """The image of each frame that has one in one of the folders."""
    there = {p.stem: p for folder in reversed(folders) for p in images_of(folder)}
    return {name: there[name] for name in frames if name in there}


def images_by_place(places: Sequence[Path], frames: Sequence[str]) -> dict[str, Path]:
    """As `images_in`: in the places that are there, and in the folders right below them."""
    there = [place for place in places if place.is_dir()]
    return images_in([f for p in there for f in (p, *sorted(c for c in p.iterdir() if c.is_dir()))], frames)
