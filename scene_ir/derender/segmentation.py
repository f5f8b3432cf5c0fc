"""What each pixel of a photograph shows: soft maps of sky, foliage, road, other ground, vehicles and people.

They come from a data set's classes where it has them, from a small network, or from a user's own segmenter.
Foliage is what turns with the seasons: leaves and grass.

The network is the one of `unet`, trained on generated streets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.derender import unet
from scene_ir.derender.unet import UNet, compute_elevation
from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Camera, Frame
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "segment.safetensors"
"""What the package ships; `tools/train_segmenter.py` makes it."""
_RARER_VEHICLES = 1.0
"""By how much vehicles' log odds are lowered: photographs have fewer than generated streets, and where shade told
nothing the network took walls and hedges for some."""


class StreetClass(IntEnum):
    """What the network tells apart. GROUND is neither road nor grass: paving, kerbs, gravel."""

    SKY = 0
    LEAVES = 1
    GRASS = 2
    ROAD = 3
    GROUND = 4
    OTHER = 5
    VEHICLE = 6
    PERSON = 7


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Soft maps (H, W) float32 in [0, 1]. foliage: leaves and grass; ground: all that is level, road and grass
    included; vehicle, person: also those that nobody labelled.
    """

    sky: Array
    foliage: Array
    road: Array
    ground: Array
    vehicle: Array
    person: Array

    def merge_inside(self, mask: NDArray[np.bool_], other: Segmentation) -> Segmentation:
        """These maps, and in a mask (H, W) the `other` ones."""
        return Segmentation(
            *(np.where(mask, getattr(other, f.name), getattr(self, f.name)) for f in fields(Segmentation))
        )


Segmenter = Callable[[Array], tuple[Array, tuple[str, ...]]]
"""A photograph (H, W, 3) RGB in [0, 1] to shares (C, h, w) in [0, 1], of any size, and the names of C classes."""
_MEANING = {
    "sky": ("sky",),
    "leaves": ("foliage",),
    "tree": ("foliage",),
    "vegetation": ("foliage",),
    "grass": ("foliage", "ground"),
    "terrain": ("foliage", "ground"),
    "road": ("road", "ground"),
    "ground": ("ground",),
    "sidewalk": ("ground",),
    "person": ("person",),
    "pedestrian": ("person",),
    "rider": ("person",),
    "cyclist": ("person",),
    **dict.fromkeys(
        ("vehicle", "car", "van", "truck", "bus", "train", "tram", "motorcycle", "bicycle"), ("vehicle",)
    ),
}
"""Which maps a class belongs to, by its name in the network's classes, Virtual KITTI's and Cityscapes'; to none
where it is not listed."""
_MIXED = "terrain"
"""Virtual KITTI's name of all ground that is no road: whether it is grass, the network has to tell."""
REQUIRED_MAPS = ("sky", "foliage", "road")
"""Maps that a segmenter's classes must fill."""
_GROUND_ENDS, _SKY_ENDS = 0.02, -0.012
"""Sines of the elevation above which no ground is, and below which no sky: between, there are hills and the
plane's own error."""
_ENDS_WITHIN = 0.006
_RADIUS, _FLATNESS = 0.011, 2e-4
"""Of the guided filter: radius in focal lengths, and the variance of colour below which a surface is one."""
_SUBSAMPLING = 0.5
"""Of the fast guided filter (He and Sun, 2015): half the time, and no worse on held-out frames."""
_LEVELS = 255
"""OpenCV's filter takes a guide in this range: the determinants of colours in [0, 1] vanish in float32, and it
becomes a plain blur."""
_LEAST, _MOST = 0.1, 0.9
"""Filtered shares that count as none and as all."""


class SegmentNet(UNet):
    """RGB (N, 3, h, w) in [0, 1] and `elevation` (N, 1, h, w), sides multiples of 16, to logits (N, 8, h/2, w/2)
    of `Class`."""

    def __init__(self) -> None:
        super().__init__(len(StreetClass))


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> SegmentNet:
    """The network of a weights file, in eval mode. Raises FormatError."""
    network = load_frozen(SegmentNet(), path)
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def predict_shares(image: Array, ground: Tensor, camera: Camera, network: SegmentNet | None = None) -> Array:
    """Shares (8, h, w) of each `Class` in a photograph (H, W, 3) RGB in [0, 1], coarser than it."""
    logits = (network or load_network()).predict(unet.prepare_input(image, ground, camera))
    logits[:, StreetClass.VEHICLE] -= _RARER_VEHICLES
    return logits.softmax(1)[0].numpy()


def segment_photograph(
    image: Array,
    ground: Tensor,
    camera: Camera,
    segmenter: Segmenter | None = None,
    shrink: int = 1,
    network: SegmentNet | None = None,
) -> Segmentation:
    """The maps of a photograph (H, W, 3) RGB float32 in [0, 1].

    ground: (4,) plane n.x + d = 0, n up: no sky lies below its horizon, no ground above. segmenter: instead of
    the shipped network; network: likewise. Borders are laid along the photograph's edges (guided filter, He et
    al., TPAMI 2013); shrink: with that at one over so much of the size. Raises RangeError for a segmenter without
    classes for sky, foliage or road, ShapeError for shares of another number.
    """
    if segmenter is None:
        shares, names = predict_shares(image, ground, camera, network), tuple(kind.name for kind in StreetClass)
    else:
        shares, names = segmenter(image)
        if shares.ndim != 3 or len(shares) != len(names):
            raise ShapeError("segmenter", f"shares ({len(names)}, h, w)", shares.shape)
        missing = [name for name in REQUIRED_MAPS if not _members(names, name)]
        if missing:
            raise RangeError("segmenter", f"a class for {missing[0]}", ", ".join(names)[:200])
    height, width = image.shape[:2]
    coarse = np.stack([shares[_members(names, f.name)].sum(0) for f in fields(Segmentation)], -1)
    large = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(_RADIUS * float(camera.intrinsics[0, 0])))
    soft = cv2.ximgproc.guidedFilter(
        image * _LEVELS, large, radius, _FLATNESS * _LEVELS**2, scale=_SUBSAMPLING / shrink
    )
    soft = np.clip((soft - _LEAST) / (_MOST - _LEAST), 0, 1)
    found = Segmentation(*(np.ascontiguousarray(m) for m in np.moveaxis(soft, -1, 0)))
    looks = compute_elevation(ground, camera, coarse.shape[:2])
    looks = cv2.resize(looks, (width, height), interpolation=cv2.INTER_LINEAR)
    below = np.clip((_GROUND_ENDS - looks) / _ENDS_WITHIN, 0, 1)
    above = np.clip((looks - _SKY_ENDS) / _ENDS_WITHIN, 0, 1)
    sky = found.sky * above
    return replace(
        found,
        sky=sky,
        foliage=np.minimum(found.foliage, 1 - sky),
        road=found.road * below,
        ground=found.ground * below,
    )


def apply_frame_classes(frame: Frame, estimated: Segmentation) -> Segmentation:
    """The maps as the frame's classes have them, all 0 or 1; as `estimated` where it has none.

    Terrain, which is grass or paving, is foliage as far as the estimate says so.
    """
    if frame.classes is None:
        return estimated
    classes, names = frame.classes.numpy(), frame.class_names
    maps = [np.isin(classes, _members(names, f.name)).astype(np.float32) for f in fields(Segmentation)]
    given = Segmentation(*maps)
    mixed = np.isin(classes, [i for i, name in enumerate(names) if name.lower() == _MIXED])
    return replace(given, foliage=np.where(mixed, estimated.foliage, given.foliage))


def _members(names: Sequence[str], field: str) -> list[int]:
    """Numbers of the classes that belong to a map."""
    return [i for i, name in enumerate(names) if field in _MEANING.get(name.strip().lower(), ())]
