"""What each pixel of a photograph shows: soft maps of sky, foliage, road, other ground, vehicles and people.

They come from a data set's classes where it has them, from a small network, or from a user's own segmenter.
Foliage is what turns with the seasons: leaves and grass.

The network is a U-Net of residual convolutions that sees the picture at 0.4 of KITTI's size, and how far each
pixel looks above the horizon. Half of the channels of its first stages are normalised over the picture itself and
not over the training set (IBN-Net, Pan et al., ECCV 2018): it has seen generated pictures only, and that is what
lets it take a photograph's light and colours as they come.
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
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Camera, Frame
from scene_ir.weights import load_into, read_weights

Array = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "segment.safetensors"
"""What the package ships; `tools/train_segmenter.py` makes it."""
INPUT_FOCAL_PX = 288.0
"""Focal length that pictures are resized to: 0.4 of KITTI's 721 px."""
_RARER_VEHICLES = 1.0
"""By how much vehicles' log odds are lowered: photographs have fewer than generated streets, and where shade told
nothing the network took walls and hedges for some."""
_MOST_PX = 250_000
"""Larger pictures are resized to fewer: three times KITTI's."""
STRIDE = 16
"""Sides of the network's input are multiples of it."""
_MEAN, _SPREAD = 0.42, 0.27
"""Of the photograph's values, about."""


class Class(IntEnum):
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

    def within(self, mask: NDArray[np.bool_], other: Segmentation) -> Segmentation:
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
NEEDED = ("sky", "foliage", "road")
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


def elevation(ground: Tensor, camera: Camera, size_hw: tuple[int, int]) -> Array:
    """The sine (h, w) of the angle by which each pixel of the resized photograph looks above the ground's horizon.

    ground: (4,) plane n.x + d = 0, n up.
    """
    height, width = size_hw
    v = (np.arange(height) + 0.5) * (camera.height / height) - 0.5
    u = (np.arange(width) + 0.5) * (camera.width / width) - 0.5
    inverse = np.linalg.inv(camera.intrinsics.double().numpy())
    ray = np.einsum("ij,jhw->ihw", inverse, np.stack([*np.meshgrid(u, v), np.ones((height, width))]))
    up = ground[:3].double().numpy()
    return (np.einsum("i,ihw->hw", up, ray) / np.linalg.norm(ray, axis=0)).astype(np.float32)


class _Norm(nn.Module):
    """Normalisation: the first half of the channels over the picture itself, the others as in training."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.own = nn.InstanceNorm2d(channels // 2, affine=True)
        self.shared = nn.BatchNorm2d(channels - channels // 2)

    def forward(self, x: Tensor) -> Tensor:
        own, shared = x.chunk(2, 1)
        return torch.cat([self.own(own), self.shared(shared)], 1)


class _Block(nn.Module):
    """3x3 convolution, normalisation, ReLU; added to its input where that has the same shape."""

    def __init__(self, channels: int, out: int, stride: int = 1, own: bool = False) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, out, 3, stride=stride, padding=1, bias=False)
        self.norm = _Norm(out) if own else nn.BatchNorm2d(out)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm(self.convolution(x)))
        return x + y if self.residual else y


class _Wide(nn.Module):
    """A 5x5 depthwise convolution, dilated, and a pointwise one; added to its input."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(
            channels, channels, 5, padding=2 * dilation, dilation=dilation, groups=channels, bias=False
        )
        self.inner = nn.BatchNorm2d(channels)
        self.pointwise = nn.Conv2d(channels, channels, 1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + F.relu(self.norm(self.pointwise(F.relu(self.inner(self.depthwise(x))))))


class _Up(nn.Module):
    """What was seen coarsely, twice as large, joined with what was seen finely."""

    def __init__(self, coarse: int, fine: int, out: int) -> None:
        super().__init__()
        self.coarse = nn.Conv2d(coarse, out, 1, bias=False)
        self.fine = nn.Conv2d(fine, out, 1, bias=False)
        self.norm = nn.BatchNorm2d(out)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        large = F.interpolate(self.coarse(coarse), scale_factor=2.0, mode="bilinear", align_corners=False)
        return F.relu(self.norm(large + self.fine(fine)))


class SegmentNet(nn.Module):
    """RGB (N, 3, h, w) in [0, 1] and `elevation` (N, 1, h, w), sides multiples of 16, to logits (N, 8, h/2, w/2)
    of `Class`."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = _Block(4, 16, 2, own=True)
        self.middle = nn.Sequential(_Block(16, 48, 2, own=True), _Block(48, 48, own=True), _Block(48, 48))
        self.coarse = nn.Sequential(_Block(48, 88, 2, own=True), _Block(88, 88), _Block(88, 88))
        self.whole = nn.Sequential(_Block(88, 112, 2), _Wide(112, 1), _Wide(112, 2), _Wide(112, 3))
        self.to_coarse = _Up(112, 88, 64)
        self.to_middle = _Up(64, 48, 48)
        self.joined = _Block(48, 48)
        self.to_fine = _Up(48, 16, 24)
        self.out = nn.Conv2d(24, len(Class), 3, padding=1)

    def forward(self, image: Tensor, elevation: Tensor) -> Tensor:
        x = torch.cat([(image - _MEAN) / _SPREAD, 3.0 * elevation], 1)
        fine = self.fine(x.contiguous(memory_format=torch.channels_last))
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        x = self.joined(self.to_middle(self.to_coarse(self.whole(coarse), coarse), middle))
        return self.out(self.to_fine(x, fine))


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> SegmentNet:
    """The network of a weights file, in eval mode. FormatError naming file and key."""
    network = SegmentNet()
    load_into(network, read_weights(path)[1], path)
    network.requires_grad_(False)
    return network.eval().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def from_network(image: Array, ground: Tensor, camera: Camera, network: SegmentNet | None = None) -> Array:
    """Shares (8, h, w) of each `Class` in a photograph (H, W, 3) RGB in [0, 1], coarser than it."""
    height, width = image.shape[:2]
    scale = INPUT_FOCAL_PX / float(camera.intrinsics[0, 0])
    scale *= min(1.0, (_MOST_PX / (height * width * scale**2)) ** 0.5)
    h, w = (max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (height, width))
    small = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)
    looks = elevation(ground, camera, (h, w))
    with torch.no_grad():
        logits = (network or load_network())(
            torch.from_numpy(small).permute(2, 0, 1)[None], torch.from_numpy(looks)[None, None]
        )
    logits[:, Class.VEHICLE] -= _RARER_VEHICLES
    return logits.softmax(1)[0].numpy()


def segment(
    image: Array,
    ground: Tensor,
    camera: Camera,
    segmenter: Segmenter | None = None,
    network: SegmentNet | None = None,
) -> Segmentation:
    """The maps of a photograph (H, W, 3) RGB float32 in [0, 1].

    ground: (4,) plane n.x + d = 0, n up: no sky lies below its horizon, no ground above. segmenter: instead of
    the shipped network; network: likewise. Borders are laid along the photograph's edges (guided filter, He et
    al., TPAMI 2013). Raises RangeError for a segmenter without classes for sky, foliage or road, ShapeError for
    shares of another number.
    """
    if segmenter is None:
        shares, names = from_network(image, ground, camera, network), tuple(kind.name for kind in Class)
    else:
        shares, names = segmenter(image)
        if shares.ndim != 3 or len(shares) != len(names):
            raise ShapeError("segmenter", f"shares ({len(names)}, h, w)", shares.shape)
        missing = [name for name in NEEDED if not _members(names, name)]
        if missing:
            raise RangeError("segmenter", f"a class for {missing[0]}", ", ".join(names)[:200])
    height, width = image.shape[:2]
    coarse = np.stack([shares[_members(names, f.name)].sum(0) for f in fields(Segmentation)], -1)
    large = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(_RADIUS * float(camera.intrinsics[0, 0])))
    soft = cv2.ximgproc.guidedFilter(image * _LEVELS, large, radius, _FLATNESS * _LEVELS**2, scale=_SUBSAMPLING)
    soft = np.clip((soft - _LEAST) / (_MOST - _LEAST), 0, 1)
    found = Segmentation(*(np.ascontiguousarray(m) for m in np.moveaxis(soft, -1, 0)))
    looks = elevation(ground, camera, coarse.shape[:2])
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


def of_frame(frame: Frame, estimated: Segmentation) -> Segmentation:
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
