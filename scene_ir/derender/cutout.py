"""Which pixels show a vehicle: a small network that sees the photograph around the placed template.

`cut_out` gives one `Cutout` a vehicle: soft maps, in a rectangle of the photograph, of the vehicle's visible part,
of what stands in front of it (people, poles, nearer vehicles), and of shadow on the ground around it. They add up
to at most 1; what is left is behind the vehicle.

The network looks twice. First at the whole vehicle, in a crop whose size does not depend on the vehicle's:
colours, and what the placed template says of each pixel. Then at the photograph's own pixels along the borders
that it found, where it says how much of each pixel is whose. `tools/train_cutout.py` trained it on generated
streets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from scene_ir.derender.pose import PoseBlock, crop_boxes
from scene_ir.derender.silhouette import Placement
from scene_ir.geometry import to_clip
from scene_ir.meshes.lod import detail
from scene_ir.raster import verbs
from scene_ir.types import Camera
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

WEIGHTS = Path(__file__).parent / "weights" / "cutout.safetensors"
"""What the package ships; `tools/train_cutout.py` makes it."""
CROP_HW = (96, 160)
_TARGET_HW = (60.0, 116.0)
"""Size of the template in the crop: the rest is room for labels that are off, and for what stands around."""
_MOST_ZOOM, _MOST_STRETCH = 4.0, 1.6
"""Of crops: how much larger than in the photograph, and how much wider than high."""
GUIDE_CHANNELS = 7
"""Channels that the placed template gives, see `guides`."""
CLASSES = ("visible", "front", "shadow", "behind")
_DETAIL_PX = 90.0
"""Height for which templates are drawn in crops."""
_GROUND_M = 2.0
"""Distance from the footprint at which ground is as far as any."""
_MEAN, _SPREAD = 0.45, 0.27
"""Of the photograph's values, about."""
TILE, HALO = 32, 8
"""Side of the tiles for the second look, and what is seen around them, px."""
_SURE = 0.02
"""A pixel at least that sure after the first look, and with such neighbours, is not looked at again."""
_SPECK = 0.03
"""Parts of a vehicle are at least that large, as a share of its largest part."""
_BESIDE, _NARROW = 0.2, 0.3
"""What stands in front and no label tells of lies at least that much beside the outline, as a share of its area,
and covers at most that much of the vehicle's width: a pole. Else it is a dark part of the vehicle, as photographs
showed."""
_NOTCH = 0.05
"""Notches in a vehicle up to twice as wide, in its heights, are filled where the outline has none."""
_BATCH = 64
"""Tiles at a time: more take memory and no less time."""


@dataclass(frozen=True, slots=True)
class Cutout:
    """One vehicle's pixels. x0, y0: the rectangle's first pixel in the photograph; visible, front, shadow (h, w)
    float32 in [0, 1]: how much of each pixel is the vehicle, something in front of it, shadow on the ground.
    Beyond the rectangle all are 0; without any pixel of its template in the photograph the rectangle is empty.
    """

    x0: int
    y0: int
    visible: Array
    front: Array
    shadow: Array

    @property
    def window(self) -> tuple[slice, slice]:
        """Where the rectangle lies in arrays (H, W)."""
        h, w = self.visible.shape
        return slice(self.y0, self.y0 + h), slice(self.x0, self.x0 + w)

    def full_map(self, name: str, shape: tuple[int, ...]) -> Array:
        """One of the maps, "visible", "front" or "shadow", over the whole photograph (H, W)."""
        out = np.zeros(shape[:2], np.float32)
        out[self.window] = getattr(self, name)
        return out


class _First(nn.Module):
    """The first look: an encoder to a sixteenth and back, (N, 10, 96, 160) to logits (N, 4, 96, 160)."""

    def __init__(self) -> None:
        super().__init__()
        widths = (32, 64, 96, 128)
        down, across, up, channels = [], [], [], 3 + GUIDE_CHANNELS
        for out in widths:
            down.append(nn.Sequential(PoseBlock(channels, out, 2), PoseBlock(out, out)))
            channels = out
        for out in widths[-2::-1]:
            across.append(nn.Conv2d(channels, out, 1))
            up.append(PoseBlock(out, out))
            channels = out
        self.down, self.across, self.up = nn.ModuleList(down), nn.ModuleList(across), nn.ModuleList(up)
        self.bottom = PoseBlock(widths[-1], widths[-1])
        self.out = nn.Conv2d(channels, 4 * len(CLASSES), 1)

    def forward(self, x: Tensor) -> Tensor:
        kept = []
        for part in self.down:
            x = part(x)
            kept.append(x)
        x = self.bottom(x)
        for across, up, skip in zip(self.across, self.up, kept[-2::-1], strict=True):
            x = up(F.interpolate(across(x), scale_factor=2.0, mode="nearest") + skip)
        return F.pixel_shuffle(self.out(x), 2)


class CutoutNet(nn.Module):
    """Both looks. forward: crops (N, 3, 96, 160) RGB in [0, 1] and guides (N, 7, 96, 160) to the logits (N, 4, 96,
    160) of `CLASSES`."""

    def __init__(self) -> None:
        super().__init__()
        self.first = _First()
        width = 16
        self.second = nn.Sequential(
            *(nn.Conv2d(6, width, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(width, width, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(width, width, 3, padding=2, dilation=2), nn.ReLU()),
            *(nn.Conv2d(width, width, 3, padding=2, dilation=2), nn.ReLU()),
            nn.Conv2d(width, 3, 3, padding=1),
        )

    def forward(self, crops: Tensor, guides: Tensor) -> Tensor:
        x = torch.cat([(crops - _MEAN) / _SPREAD, guides], 1)
        return self.first(x.contiguous(memory_format=torch.channels_last))

    def refine(self, tiles: Tensor, shares: Tensor) -> Tensor:
        """Log shares (N, 3, h, w) of visible, front, rest. tiles (N, 3, h, w) RGB in [0, 1] in the photograph's
        own pixels; shares (N, 3, h, w): visible, front and shadow, as first seen."""
        x = torch.cat([(tiles - _MEAN) / _SPREAD, shares], 1)
        rest = 1 - shares[:, :1] - shares[:, 1:2]
        before = torch.cat([shares[:, :2], rest], 1).clamp(_SURE, 1)
        return (before.log() + self.second(x)).log_softmax(1)


@lru_cache(maxsize=1)
def load_network() -> CutoutNet:
    """The shipped network, in eval mode. Raises FormatError if its weights are missing or damaged."""
    return load_frozen(CutoutNet(), WEIGHTS)


def crop_rectangle(placement: Placement, camera: Camera) -> tuple[int, int, int, int] | None:
    """The part of the photograph, px, half-open, that the first look sees: about the template, beyond the
    photograph's border where that is near. None where no part of the template shows."""
    clip = to_clip(_light(placement).vertices(), camera.matrix)
    clip = clip[clip[:, 2] > verbs.NEAR_M]
    if not len(clip):
        return None
    pixels = (clip[:, :2] / clip[:, 2:]).numpy()
    limit = np.array([camera.width, camera.height]) - 0.5
    low, high = pixels.min(0).clip(-0.5, limit), pixels.max(0).clip(-0.5, limit)
    side = high - low
    if not (side > 0).all():
        return None
    zoom_x, zoom_y = np.minimum(np.array(_TARGET_HW[::-1]) / np.maximum(side, 1), _MOST_ZOOM)
    zoom_x, zoom_y = min(zoom_x, _MOST_STRETCH * zoom_y), min(zoom_y, _MOST_STRETCH * zoom_x)
    wide, high_px = round(CROP_HW[1] / zoom_x), round(CROP_HW[0] / zoom_y)
    middle = (low + high) / 2
    x0, y0 = round(float(middle[0] - wide / 2 + 0.5)), round(float(middle[1] - high_px / 2 + 0.5))
    return x0, y0, x0 + wide, y0 + high_px


def crop_camera(camera: Camera, rect: tuple[int, int, int, int]) -> Camera:
    """The camera whose picture is the crop of a rectangle."""
    x0, y0, x1, y1 = rect
    (height, width), sx, sy = CROP_HW, CROP_HW[1] / (x1 - x0), CROP_HW[0] / (y1 - y0)
    zoom = torch.tensor([[sx, 0.0, (0.5 - x0) * sx - 0.5], [0.0, sy, (0.5 - y0) * sy - 0.5], [0.0, 0.0, 1.0]])
    return Camera(zoom @ camera.intrinsics, height, width, zoom @ camera.matrix)


def inside_mask(rect: tuple[int, int, int, int], limit: tuple[int, int, int, int]) -> Array:
    """Which pixels (96, 160) of a rectangle's crop show what lies inside `limit`, also a rectangle, px: 0 or 1."""
    (height, width), (x0, y0, x1, y1) = CROP_HW, rect
    columns = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    rows = y0 + (np.arange(height) + 0.5) * (y1 - y0) / height
    across = (columns >= limit[0]) & (columns <= limit[2])
    return ((rows >= limit[1]) & (rows <= limit[3]))[:, None] * across[None].astype(np.float32)


def render_guides(
    placements: Sequence[Placement],
    cameras: Sequence[Camera],
    ground: Sequence[Tensor],
    nearer_inside: Array,
    backend: verbs.Backend = "warp",
) -> Tensor:
    """What the placed templates say of each pixel of their crops, (N, 7, 96, 160): coverage by the template; where
    on it, in its unit box (x, y, z), 0 beside it; nearness to its footprint of the ground that the pixel shows, 1
    in its middle, -1 far off; and as given, nearer vehicles and the photograph itself (N, 2, 96, 160).

    cameras: of the crops, see `zoomed`; ground: planes (4,), one each.
    """
    height, width = CROP_HW
    coarse = [_light(p) for p in placements]
    clip = torch.cat([to_clip(p.vertices(), c.matrix) for p, c in zip(coarse, cameras, strict=True)])
    first = np.cumsum([0, *(len(p.mesh.vertices) for p in coarse)]).tolist()
    faces = torch.cat([p.mesh.faces + start for p, start in zip(coarse, first[:-1], strict=True)])
    ends = torch.tensor([len(p.mesh.faces) for p in coarse]).cumsum(0)
    face_ranges = torch.stack([ends - torch.tensor([len(p.mesh.faces) for p in coarse]), ends], 1)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, width, height]] * len(coarse)))
    fragments = verbs.rasterize(clip, faces, face_ranges, layout, backend)
    cover = verbs.antialias(fragments, clip, faces, backend)
    spots = verbs.interpolate(fragments, clip, faces, torch.cat([p.mesh.vertices for p in coarse]), backend)
    drawn = torch.cat([cover[:, None], 2 * spots], 1).reshape(len(coarse), height, width, 4)
    nearness = [_nearness(p, g, c) for p, g, c in zip(coarse, ground, cameras, strict=True)]
    near = torch.from_numpy(np.stack(nearness)[:, None])
    return torch.cat([drawn.permute(0, 3, 1, 2), near, torch.from_numpy(nearer_inside)], 1)


def _light(placement: Placement) -> Placement:
    """With no more triangles than crops show."""
    return replace(placement, mesh=detail(placement.mesh, _DETAIL_PX))


def _nearness(placement: Placement, ground: Tensor, camera: Camera) -> Array:
    """How near (h, w) to its footprint the ground lies that a pixel shows, as `guides` says it."""
    matrix = camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    foot, normal = placement.translation.double().numpy(), ground[:3].double().numpy()
    height = float(normal @ (foot + inverse @ matrix[:, 3]))
    columns, rows = np.arange(camera.width), np.arange(camera.height)[:, None]
    ray = [(inverse[i, 0] * columns + inverse[i, 1] * rows + inverse[i, 2]).astype(np.float32) for i in range(3)]
    slope = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    seen = slope * height > 0
    step = height / np.where(seen, slope, 1.0)
    centre = inverse @ matrix[:, 3] + foot
    x, z = step * ray[0] - centre[0], step * ray[2] - centre[2]
    cos, sin = math.cos(float(placement.yaw)), math.sin(float(placement.yaw))
    along = np.abs(cos * x - sin * z) - float(placement.size_lhw[0]) / 2
    across = np.abs(sin * x + cos * z) - float(placement.size_lhw[2]) / 2
    apart = np.hypot(np.maximum(along, 0), np.maximum(across, 0)) + np.minimum(np.maximum(along, across), 0)
    return np.where(seen, np.clip(-apart / _GROUND_M, -1, 1), -1).astype(np.float32)


@torch.no_grad()
def cut_out(
    image: NDArray[np.uint8],
    placements: Sequence[Placement],
    nearer: Sequence[Mask],
    ground: Tensor,
    camera: Camera,
    backend: verbs.Backend = "warp",
    refine_borders: bool = True,
    network: CutoutNet | None = None,
) -> list[Cutout]:
    """Each placed vehicle's pixels. image (H, W, 3) RGB; nearer: for each vehicle the pixels (H, W) of nearer
    ones, as far as they are known; ground (4,): plane n.x + d = 0; network: another than the shipped
    one; again: whether to look again at the borders, which then are right to parts of a pixel."""
    network = network or load_network()
    shown = [(i, rect) for i, p in enumerate(placements) if (rect := crop_rectangle(p, camera)) is not None]
    found = [Cutout(0, 0, *(np.zeros((0, 0), np.float32),) * 3) for _ in placements]
    if not shown:
        return found
    rects = np.array([rect for _, rect in shown], np.float32) - 0.5
    cameras = [crop_camera(camera, rect) for _, rect in shown]
    given = np.zeros((len(shown), 2, *CROP_HW), np.float32)
    for row, (i, rect) in enumerate(shown):
        others = np.repeat(nearer[i][..., None].astype(np.uint8) * 255, 3, axis=2)
        given[row, 1] = inside_mask(rect, (0, 0, camera.width, camera.height))
        given[row, 0] = crop_boxes(others, rects[row : row + 1], CROP_HW, 1.0)[0, ..., 0] / 255 * given[row, 1]
    crops = torch.from_numpy(crop_boxes(image, rects, CROP_HW, 1.0).transpose(0, 3, 1, 2).astype(np.float32) / 255)
    said = render_guides([placements[i] for i, _ in shown], cameras, [ground] * len(shown), given, backend)
    shares = network(crops, said).softmax(1)[:, :3].numpy()
    for (i, rect), share in zip(shown, shares, strict=True):
        found[i] = _in_photograph(share, rect, image.shape)
    return refine_cutouts(image, found, network) if refine_borders else found


def _in_photograph(shares: Array, rect: tuple[int, int, int, int], shape: tuple[int, ...]) -> Cutout:
    """Shares (3, 96, 160) of a crop in the photograph's pixels, as far as they lie inside."""
    x0, y0, x1, y1 = rect
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, shape[1]), min(y1, shape[0])
    parts = resize_shares(shares, (x1 - x0, y1 - y0))[:, top - y0 : bottom - y0, left - x0 : right - x0]
    return Cutout(left, top, *(np.ascontiguousarray(part) for part in parts))


def resize_shares(shares: Array, size_wh: tuple[int, int]) -> Array:
    """Shares (3, 96, 160) of a crop with as many pixels as the photograph has there, (3, h, w)."""
    smaller = size_wh[0] < CROP_HW[1] and size_wh[1] < CROP_HW[0]
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.stack([cv2.resize(share, size_wh, interpolation=how) for share in shares]).astype(np.float32)


@torch.no_grad()
def refine_cutouts(
    image: NDArray[np.uint8], cutouts: Sequence[Cutout], network: CutoutNet | None = None
) -> list[Cutout]:
    """The cut-outs after a look at the photograph's own pixels along their borders; elsewhere pixels are wholly
    one or the other. image (H, W, 3) RGB."""
    network = network or load_network()
    padded, places = [], []
    looked = [find_uncertain_pixels(c) if c.visible.size else np.zeros((0, 0), bool) for c in cutouts]
    for i, cutout in enumerate(cutouts):
        if not cutout.visible.size:
            padded.append(np.zeros((0, 0, 6), np.float32))
            continue
        own = np.dstack(
            [image[cutout.window].astype(np.float32) / 255, cutout.visible, cutout.front, cutout.shadow]
        )
        h, w = cutout.visible.shape
        padded.append(
            np.pad(own, ((HALO, HALO + -h % TILE), (HALO, HALO + -w % TILE), (0, 0)), mode="edge").astype(
                np.float32
            )
        )
        for y, x in zip(*np.nonzero(_tiles(looked[i])), strict=True):
            places.append((i, int(y) * TILE, int(x) * TILE))
    maps = [[np.rint(c.visible), np.rint(c.front)] for c in cutouts]
    side = TILE + 2 * HALO
    for start in range(0, len(places), _BATCH):
        some = places[start : start + _BATCH]
        tiles = np.stack([padded[i][y : y + side, x : x + side] for i, y, x in some]).transpose(0, 3, 1, 2)
        both = torch.from_numpy(np.ascontiguousarray(tiles)).contiguous(memory_format=torch.channels_last)
        shares = network.refine(both[:, :3], both[:, 3:]).exp()[:, :2, HALO:-HALO, HALO:-HALO].numpy()
        for (i, y, x), share in zip(some, shares, strict=True):
            for values, part in zip(maps[i], share, strict=True):
                chosen = looked[i][y : y + TILE, x : x + TILE]
                target = values[y : y + TILE, x : x + TILE]
                target[chosen] = part[: target.shape[0], : target.shape[1]][chosen]
    return [
        replace(c, visible=visible, front=front, shadow=np.minimum(c.shadow, 1 - visible - front).clip(0))
        for c, (visible, front) in zip(cutouts, maps, strict=True)
    ]


def find_uncertain_pixels(cutout: Cutout) -> Mask:
    """Pixels (h, w) that may be of several things: along borders, and where the first look could not tell."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    out = np.zeros(cutout.visible.shape, bool)
    for share in (cutout.visible, cutout.front):
        low, high = cv2.erode(share, disc), cv2.dilate(share, disc)
        out |= (high - low > 0.5) | ((share > 2 * _SURE) & (share < 1 - 2 * _SURE))
    return out


def _tiles(wanted: NDArray[Any]) -> Mask:
    """Which tiles (rows, columns) hold a wanted pixel."""
    h, w = wanted.shape
    full = np.pad(wanted, ((0, -h % TILE), (0, -w % TILE)))
    parts = full.reshape(full.shape[0] // TILE, TILE, full.shape[1] // TILE, TILE)
    return np.asarray(parts.any((1, 3)))


def cutout_from_mask(
    image: NDArray[np.uint8], mask: Mask, nearer: Mask, network: CutoutNet | None = None
) -> Cutout:
    """The cut-out of a vehicle whose pixels are known: borders to parts of a pixel. image (H, W, 3) RGB; mask
    (H, W), not empty; nearer (H, W): nearer vehicles' pixels."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    y0, y1 = max(int(rows[0]) - HALO, 0), min(int(rows[-1]) + 1 + HALO, mask.shape[0])
    x0, x1 = max(int(columns[0]) - HALO, 0), min(int(columns[-1]) + 1 + HALO, mask.shape[1])
    visible, front = (m[y0:y1, x0:x1].astype(np.float32) for m in (mask, nearer & ~mask))
    return refine_cutouts(image, [Cutout(x0, y0, visible, front, np.zeros_like(visible))], network)[0]


def clean_cutout(cutout: Cutout) -> Cutout:
    """Without specks, and without holes: windows and reflections are car, and what stands in front of one does not
    float in its middle."""
    solid = (cutout.visible >= 0.5).astype(np.uint8)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(solid, connectivity=4)
    keep = np.zeros(count, np.float32)
    areas = stats[1:, cv2.CC_STAT_AREA]
    keep[1:] = areas >= _SPECK * areas.max(initial=0)
    visible = cutout.visible * cv2.dilate(keep[np.asarray(parts, np.int64)], np.ones((5, 5), np.uint8))
    around = np.pad((visible < 0.5).astype(np.uint8), 1, constant_values=1)
    _, regions = cv2.connectedComponents(around, connectivity=4)
    enclosed = ((regions != regions[0, 0]) & (around > 0))[1:-1, 1:-1]
    hole = cv2.dilate(enclosed.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    visible = np.where(enclosed | (hole & (visible >= 0.5)), 1, visible).astype(np.float32)
    front = np.minimum(cutout.front, 1 - visible)
    shadow = np.minimum(cutout.shadow, 1 - visible - front).clip(0)
    return replace(cutout, visible=visible, front=front, shadow=shadow)


def remove_unlikely_occluders(cutout: Cutout, outline: Mask, known: Mask) -> Cutout:
    """The cut-out without what is unlikely in front of a placed vehicle, and with its notches filled.

    outline (H, W): of the placed mesh; known (H, W): pixels of nearer things that are known to be there.
    """
    if not cutout.visible.size:
        return cutout
    inside, told = outline[cutout.window], known[cutout.window]
    columns, rows = np.flatnonzero(inside.any(0)), np.flatnonzero(inside.any(1))
    if not len(rows):
        return cutout
    front = cutout.front.copy()
    count, parts = cv2.connectedComponents((front >= 0.5).astype(np.uint8), connectivity=4)
    for part in (np.asarray(parts) == k for k in range(1, count)):
        over = part & inside
        width = np.count_nonzero(over.any(0)) / len(columns)
        pole = width <= _NARROW and np.count_nonzero(over) <= (1 - _BESIDE) * np.count_nonzero(part)
        if not pole:
            front[cv2.dilate(part.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & inside & ~told] = 0
    gone = cutout.front - front
    visible = cutout.visible + gone
    radius = max(round(_NOTCH * len(rows)), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    solid = np.pad((visible >= 0.5).astype(np.uint8), radius)
    closed = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius] > 0
    notch = closed & inside & ~told & (front < 0.5)
    visible = np.where(notch, np.maximum(visible, 1 - front), visible).clip(0, 1).astype(np.float32)
    front = np.minimum(front, 1 - visible)
    return replace(
        cutout, visible=visible, front=front, shadow=np.minimum(cutout.shadow, 1 - visible - front).clip(0)
    )
