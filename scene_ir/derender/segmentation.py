"""Segment a photograph into soft maps of sky, foliage, road, other ground, vehicles and people.

The maps come from a data set's classes if it has them, from a small network (`unet`) trained on generated streets,
or from a user's segmenter. Foliage is what changes with the seasons: leaves and grass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.derender import unet
from scene_ir.derender.unet import UNet, compute_elevation
from scene_ir.errors import RangeError, ShapeError
from scene_ir.render.model import LUMA
from scene_ir.types import Camera, Frame
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "segment.safetensors"
"""The shipped weights, made by `tools/train_segmenter.py`."""
_VEHICLE_PENALTY = 1.0
"""Subtracted from the log odds of vehicles: they are rarer in photographs than in generated streets, and without
shading cues the network took walls and hedges for some."""


class StreetClass(IntEnum):
    """The network's classes. GROUND is neither road nor grass: paving, kerbs, gravel."""

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
    """Soft maps of a photograph."""

    sky: Array
    """(H, W) float32 in [0, 1], share of sky."""
    foliage: Array
    """(H, W), share of leaves and grass."""
    road: Array
    """(H, W), share of road."""
    ground: Array
    """(H, W), share of all level ground, with road and grass."""
    vehicle: Array
    """(H, W), share of vehicles, labelled or not."""
    person: Array
    """(H, W), share of people, labelled or not."""

    def merge_inside(self, mask: NDArray[np.bool_], other: Segmentation) -> Segmentation:
        """These maps with the `other` ones inside a mask (H, W)."""
        return Segmentation(
            *(np.where(mask, getattr(other, f.name), getattr(self, f.name)) for f in fields(Segmentation))
        )

    def outside(self, opacity: Array) -> Segmentation:
        """These maps without what is in front, of an opacity (H, W)."""
        return Segmentation(*(getattr(self, f.name) * (1 - opacity) for f in fields(Segmentation)))


Segmenter = Callable[[Array], tuple[Array, tuple[str, ...]]]
"""A photograph (H, W, 3) RGB in [0, 1] -> shares (C, h, w) in [0, 1] of any size, and the names of the C
classes."""
_MAPS_BY_CLASS = {
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
"""Maps of each class, by its name in the network's classes, Virtual KITTI's and Cityscapes'; unlisted classes
belong to no map."""
_TERRAIN = "terrain"
"""Virtual KITTI's name of all ground except roads: the network decides whether it is grass."""
REQUIRED_MAPS = ("sky", "foliage", "road")
"""Maps that a segmenter's classes must fill."""
_SURE_SKY, _UNSURE_SKY, _SKY_AROUND, _SKY_DARKER = 0.9, 0.12, 0.1, (-0.15, -0.06)
_CLOUD_DARKER, _CLOUD_DETAIL, _BLUE_DIFFERS, _BLUE = (-0.5, -0.4), (-0.12, -0.06), (-0.35, -0.25), (0.1, 0.2)
"""Share from which a pixel is sky for certain, and from which one may be; the least share of such sky around it; how
much darker than it sky may be; the same of smooth clouds, and their differences within 5 px; how much a blue sky
differs from that around it, and its blue less its red.
"""
_GROUND_ENDS, _SKY_ENDS = 0.02, -0.012
"""Sines of the elevation above which there is no ground, and below which there is no sky. Hills and the plane's
error lie between."""
_END_WIDTH = 0.006
"""Width of the transition at both, in sines."""
_RADIUS, _FLATNESS = 0.011, 2e-4
"""Guided filter: radius in focal lengths, and the variance of colour below which a surface is uniform."""
_SUBSAMPLING = 0.5
"""Of the fast guided filter (He and Sun, 2015): half the time, and no worse on held-out frames."""
_GUIDE_RANGE = 255
"""Range of the filter's guide: with colours in [0, 1] determinants vanish in float32, and the filter becomes a
blur."""
_MIN_SHARE, _MAX_SHARE = 0.1, 0.9
"""Filtered shares that count as 0 and as 1."""


class SegmentNet(UNet):
    """RGB (N, 3, h, w) in [0, 1] and elevation (N, 1, h, w), sides multiples of 16 -> logits (N, 8, h/2, w/2) of
    `StreetClass`.
    """

    def __init__(self) -> None:
        super().__init__(len(StreetClass))


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> SegmentNet:
    """The network of a weights file, in eval mode. Raises FormatError."""
    network = load_frozen(SegmentNet(), path)
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def predict_shares(image: Array, ground: Tensor, camera: Camera, network: SegmentNet | None = None) -> Array:
    """Run the network on a photograph.

    Args:
        image: (H, W, 3) RGB in [0, 1].
        ground: Plane (4,) n.x + d = 0 with n up.
        camera: The photograph's camera.
        network: In place of the shipped one.

    Returns:
        Shares (8, h, w) of each `StreetClass`, at a lower resolution.
    """
    logits = (network or load_network()).predict(unet.prepare_input(image, ground, camera))
    logits[:, StreetClass.VEHICLE] -= _VEHICLE_PENALTY
    return logits.softmax(1)[0].numpy()


def segment_photograph(
    image: Array,
    ground: Tensor,
    camera: Camera,
    segmenter: Segmenter | None = None,
    shrink: int = 1,
    network: SegmentNet | None = None,
) -> Segmentation:
    """Compute the maps of a photograph, with borders along its edges (guided filter, He et al., TPAMI 2013).

    Args:
        image: (H, W, 3) RGB float32 in [0, 1].
        ground: Plane (4,) n.x + d = 0 with n up: there is no sky below its horizon, and no ground above.
        camera: The photograph's camera.
        segmenter: In place of the network.
        shrink: Filter at one over this size.
        network: In place of the shipped one.

    Returns:
        The maps.

    Raises:
        RangeError: The segmenter lacks a class for sky, foliage or road.
        ShapeError: It returns another number of shares than of classes.
    """
    if segmenter is None:
        shares, names = predict_shares(image, ground, camera, network), tuple(kind.name for kind in StreetClass)
    else:
        shares, names = segmenter(image)
        if shares.ndim != 3 or len(shares) != len(names):
            raise ShapeError("segmenter", f"shares ({len(names)}, h, w)", shares.shape)
        missing = [name for name in REQUIRED_MAPS if not _classes_in_map(names, name)]
        if missing:
            raise RangeError("segmenter", f"a class for {missing[0]}", ", ".join(names)[:200])
    height, width = image.shape[:2]
    coarse = np.stack([shares[_classes_in_map(names, f.name)].sum(0) for f in fields(Segmentation)], -1)
    large = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(_RADIUS * float(camera.intrinsics[0, 0])))
    soft = cv2.ximgproc.guidedFilter(
        image * _GUIDE_RANGE, large, radius, _FLATNESS * _GUIDE_RANGE**2, scale=_SUBSAMPLING / shrink
    )
    soft = np.clip((soft - _MIN_SHARE) / (_MAX_SHARE - _MIN_SHARE), 0, 1)
    maps = Segmentation(*(np.ascontiguousarray(m) for m in np.moveaxis(soft, -1, 0)))
    elevation = compute_elevation(ground, camera, coarse.shape[:2])
    elevation = cv2.resize(elevation, (width, height), interpolation=cv2.INTER_LINEAR)
    below = np.clip((_GROUND_ENDS - elevation) / _END_WIDTH, 0, 1)
    above = np.clip((elevation - _SKY_ENDS) / _END_WIDTH, 0, 1)
    end = int(np.flatnonzero(above.any(1)).max(initial=0)) + 1  # there is no sky below
    sky = np.zeros_like(maps.sky)
    sky[:end] = _complete_sky(maps.sky[:end], image[:end], max(3, height // 4)) * above[:end]
    return replace(
        maps,
        sky=sky,
        foliage=np.minimum(maps.foliage, 1 - sky),
        road=maps.road * below,
        ground=maps.ground * below,
    )


def _complete_sky(sky: Array, image: Array, reach: int) -> Array:
    """The map (H, W) of the sky with its gaps filled, by the sky within `reach` px: the network is unsure of clouds
    around a pole, while what stands before a sky is darker than it or has edges; and it misses a blue sky behind bare
    branches.
    """
    luma = image @ np.array(LUMA, np.float32)
    sure = (sky > _SURE_SKY).astype(np.float32)
    weight = cv2.blur(sure, (reach, reach))
    around = cv2.blur(image * sure[..., None], (reach, reach)) / np.maximum(weight, 1e-3)[..., None]
    darker = luma - around @ np.array(LUMA, np.float32)
    detail = cv2.morphologyEx(cv2.blur(luma, (3, 3)), cv2.MORPH_GRADIENT, np.ones((5, 5)))
    clouds = np.maximum(_rise(darker, _SKY_DARKER), _rise(darker, _CLOUD_DARKER) * _rise(-detail, _CLOUD_DETAIL))
    blue = np.minimum(around[..., 2] - around[..., 0], image[..., 2] - image[..., 0])
    gaps = _rise(-np.abs(image - around).max(-1), _BLUE_DIFFERS) * _rise(blue, _BLUE)
    possible = np.maximum(np.clip(sky / _UNSURE_SKY, 0, 1) * clouds, gaps)
    return np.maximum(sky, (weight > _SKY_AROUND) * possible)


def _rise(values: NDArray[Any], ends: tuple[float, float]) -> NDArray[Any]:
    """0 up to the lower end, 1 from the upper one."""
    return np.clip((values - ends[0]) / (ends[1] - ends[0]), 0, 1)


def apply_frame_classes(frame: Frame, estimated: Segmentation) -> Segmentation:
    """The maps of the frame's classes, all 0 or 1; the `estimated` maps if the frame has none.

    Terrain, which is grass or paving, is foliage by the estimate's share.
    """
    if frame.classes is None:
        return estimated
    classes, names = frame.classes.numpy(), frame.class_names
    maps = [np.isin(classes, _classes_in_map(names, f.name)).astype(np.float32) for f in fields(Segmentation)]
    given = Segmentation(*maps)
    mixed = np.isin(classes, [i for i, name in enumerate(names) if name.lower() == _TERRAIN])
    return replace(given, foliage=np.where(mixed, estimated.foliage, given.foliage))


def _classes_in_map(names: Sequence[str], field: str) -> list[int]:
    """Indices of the classes that belong to a map."""
    return [i for i, name in enumerate(names) if field in _MAPS_BY_CLASS.get(name.strip().lower(), ())]
