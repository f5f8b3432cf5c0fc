"""Cut vehicles out of a photograph with a small network that sees it around the placed template.

`cut_out` returns one `Cutout` per vehicle: soft maps, in a rectangle of the photograph, of the vehicle's visible
part, of occluders in front of it (people, poles, nearer vehicles), and of shadow on the ground around it. They add
up to at most 1; the rest is behind the vehicle.

A first stage sees the whole vehicle in a crop of fixed size: its colours, and guide maps rendered from the
template. A second stage refines the borders at the photograph's own resolution. `tools/train_cutout.py` trained
both on generated streets.
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
from scene_ir.meshes.lod import level_of_detail
from scene_ir.raster import verbs
from scene_ir.types import Camera
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

WEIGHTS = Path(__file__).parent / "weights" / "cutout.safetensors"
"""The shipped weights, made by `tools/train_cutout.py`."""
CROP_HW = (96, 160)
_TARGET_HW = (60.0, 116.0)
"""Size of the template in the crop: the rest is margin for label errors and surroundings."""
_MAX_ZOOM, _MAX_STRETCH = 4.0, 1.6
"""Largest enlargement of crops, and largest ratio of their horizontal and vertical scales."""
GUIDE_CHANNELS = 7
"""Number of guide maps, see `render_guides`."""
CLASSES = ("visible", "front", "shadow", "behind")
_DETAIL_PX = 90.0
"""Height that selects a template's level of detail in crops."""
_GROUND_M = 2.0
"""Distance from the footprint at which nearness saturates."""
_MEAN, _SPREAD = 0.45, 0.27
"""Mean and standard deviation of photographs' values, about."""
TILE, HALO = 32, 8
"""Side of the second stage's tiles, and the margin that it sees around them, px."""
_CERTAIN = 0.02
"""A pixel with all shares this near to 0 or 1, and with such neighbours, is not refined."""
_SPECK = 0.03
"""Least area of a component, as a share of the largest one's."""
_POLE_OUTSIDE, _POLE_WIDTH = 0.2, 0.3
"""An unlabelled occluder is a pole: at least this share of its area is outside the outline, and it covers at most
this share of the vehicle's width. Otherwise it is a dark part of the vehicle."""
_NOTCH = 0.05
"""Half the width, in heights, of notches that are filled where the outline has none."""
_BATCH = 64
"""Tiles per batch: more take memory and save no time."""


@dataclass(frozen=True, slots=True)
class Cutout:
    """Soft maps of one vehicle in a rectangle of the photograph; 0 elsewhere.

    The rectangle is empty if no pixel of the template is in the photograph.
    """

    x0: int
    """Left column of the rectangle, px."""
    y0: int
    """Top row of the rectangle, px."""
    visible: Array
    """(h, w) in [0, 1], share of the vehicle in each pixel."""
    front: Array
    """(h, w) in [0, 1], share of occluders."""
    shadow: Array
    """(h, w) in [0, 1], share of shadow on the ground."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the rectangle in the photograph."""
        h, w = self.visible.shape
        return slice(self.y0, self.y0 + h), slice(self.x0, self.x0 + w)

    def full_map(self, name: str, shape: tuple[int, ...]) -> Array:
        """The map "visible", "front" or "shadow" over the whole photograph (H, W)."""
        out = np.zeros(shape[:2], np.float32)
        out[self.window] = getattr(self, name)
        return out


class _CropNet(nn.Module):
    """The first stage: a U-Net down to a sixteenth, (N, 10, 96, 160) -> logits (N, 4, 96, 160)."""

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
        skips = []
        for part in self.down:
            x = part(x)
            skips.append(x)
        x = self.bottom(x)
        for across, up, skip in zip(self.across, self.up, skips[-2::-1], strict=True):
            x = up(F.interpolate(across(x), scale_factor=2.0, mode="nearest") + skip)
        return F.pixel_shuffle(self.out(x), 2)


class CutoutNet(nn.Module):
    """Both stages. The first: crops (N, 3, 96, 160) RGB in [0, 1] and guides (N, 7, 96, 160) -> logits (N, 4, 96,
    160) of `CLASSES`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = _CropNet()
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
        """The second stage: log shares (N, 3, h, w) of visible, front and the rest.

        `tiles` (N, 3, h, w) are RGB in [0, 1] at the photograph's resolution, `shares` (N, 3, h, w) the first
        stage's visible, front and shadow.
        """
        x = torch.cat([(tiles - _MEAN) / _SPREAD, shares], 1)
        rest = 1 - shares[:, :1] - shares[:, 1:2]
        before = torch.cat([shares[:, :2], rest], 1).clamp(_CERTAIN, 1)
        return (before.log() + self.second(x)).log_softmax(1)


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> CutoutNet:
    """A network of shipped weights, in eval mode. Raises FormatError if they are missing or damaged."""
    return load_frozen(CutoutNet(), path)


def crop_rectangle(placement: Placement, camera: Camera) -> tuple[int, int, int, int] | None:
    """The rectangle x0, y0, x1, y1, px, half-open, that the first stage sees around the template.

    It may extend beyond the photograph's border. None if no part of the template is in the photograph.
    """
    clip = to_clip(_with_coarse_mesh(placement).vertices(), camera.matrix)
    clip = clip[clip[:, 2] > verbs.NEAR_M]
    if not len(clip):
        return None
    pixels = (clip[:, :2] / clip[:, 2:]).numpy()
    limit = np.array([camera.width, camera.height]) - 0.5
    low, high = pixels.min(0).clip(-0.5, limit), pixels.max(0).clip(-0.5, limit)
    side = high - low
    if not (side > 0).all():
        return None
    zoom_x, zoom_y = np.minimum(np.array(_TARGET_HW[::-1]) / np.maximum(side, 1), _MAX_ZOOM)
    zoom_x, zoom_y = min(zoom_x, _MAX_STRETCH * zoom_y), min(zoom_y, _MAX_STRETCH * zoom_x)
    wide, high_px = round(CROP_HW[1] / zoom_x), round(CROP_HW[0] / zoom_y)
    middle = (low + high) / 2
    x0, y0 = round(float(middle[0] - wide / 2 + 0.5)), round(float(middle[1] - high_px / 2 + 0.5))
    return x0, y0, x0 + wide, y0 + high_px


def crop_camera(camera: Camera, rect: tuple[int, int, int, int]) -> Camera:
    """The camera with a rectangle's crop as its picture."""
    x0, y0, x1, y1 = rect
    (height, width), sx, sy = CROP_HW, CROP_HW[1] / (x1 - x0), CROP_HW[0] / (y1 - y0)
    zoom = torch.tensor([[sx, 0.0, (0.5 - x0) * sx - 0.5], [0.0, sy, (0.5 - y0) * sy - 0.5], [0.0, 0.0, 1.0]])
    return Camera(zoom @ camera.intrinsics, height, width, zoom @ camera.matrix)


def inside_mask(rect: tuple[int, int, int, int], limit: tuple[int, int, int, int]) -> Array:
    """Mask (96, 160), 0 or 1, of the pixels of a rectangle's crop inside the rectangle `limit`, px."""
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
    """Render the guide maps of placed templates.

    The maps are: coverage by the template; the point on it in its unit box (x, y, z), 0 outside; nearness of the
    ground at the pixel to the footprint, from 1 in its middle to -1 far away; and `nearer_inside`.

    Args:
        placements: N placed templates.
        cameras: Of their crops, see `crop_camera`.
        ground: N planes (4,) n.x + d = 0.
        nearer_inside: Masks (N, 2, 96, 160) of nearer vehicles and of the photograph.
        backend: Of the rasteriser.

    Returns:
        (N, 7, 96, 160).
    """
    height, width = CROP_HW
    coarse = [_with_coarse_mesh(p) for p in placements]
    clip = torch.cat([to_clip(p.vertices(), c.matrix) for p, c in zip(coarse, cameras, strict=True)])
    first = np.cumsum([0, *(len(p.mesh.vertices) for p in coarse)]).tolist()
    faces = torch.cat([p.mesh.faces + start for p, start in zip(coarse, first[:-1], strict=True)])
    ends = torch.tensor([len(p.mesh.faces) for p in coarse]).cumsum(0)
    face_ranges = torch.stack([ends - torch.tensor([len(p.mesh.faces) for p in coarse]), ends], 1)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, width, height]] * len(coarse)))
    fragments = verbs.rasterize(clip, faces, face_ranges, layout, backend)
    cover = verbs.antialias(fragments, clip, faces, backend)
    points = verbs.interpolate(fragments, clip, faces, torch.cat([p.mesh.vertices for p in coarse]), backend)
    rendered = torch.cat([cover[:, None], 2 * points], 1).reshape(len(coarse), height, width, 4)
    nearness = [_footprint_nearness(p, g, c) for p, g, c in zip(coarse, ground, cameras, strict=True)]
    near = torch.from_numpy(np.stack(nearness)[:, None])
    return torch.cat([rendered.permute(0, 3, 1, 2), near, torch.from_numpy(nearer_inside)], 1)


def _with_coarse_mesh(placement: Placement) -> Placement:
    """The placement with the mesh's level of detail for crops."""
    return replace(placement, mesh=level_of_detail(placement.mesh, _DETAIL_PX))


def _footprint_nearness(placement: Placement, ground: Tensor, camera: Camera) -> Array:
    """Nearness (h, w) of the ground at each pixel to the footprint, see `render_guides`."""
    matrix = camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    foot, normal = placement.translation.double().numpy(), ground[:3].double().numpy()
    height = float(normal @ (foot + inverse @ matrix[:, 3]))
    columns, rows = np.arange(camera.width), np.arange(camera.height)[:, None]
    ray = [(inverse[i, 0] * columns + inverse[i, 1] * rows + inverse[i, 2]).astype(np.float32) for i in range(3)]
    slope = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    hit = slope * height > 0
    step = height / np.where(hit, slope, 1.0)
    centre = inverse @ matrix[:, 3] + foot
    x, z = step * ray[0] - centre[0], step * ray[2] - centre[2]
    cos, sin = math.cos(float(placement.yaw)), math.sin(float(placement.yaw))
    along = np.abs(cos * x - sin * z) - float(placement.size_lhw[0]) / 2
    across = np.abs(sin * x + cos * z) - float(placement.size_lhw[2]) / 2
    apart = np.hypot(np.maximum(along, 0), np.maximum(across, 0)) + np.minimum(np.maximum(along, across), 0)
    return np.where(hit, np.clip(-apart / _GROUND_M, -1, 1), -1).astype(np.float32)


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
    """Cut placed vehicles out of a photograph.

    Args:
        image: (H, W, 3) RGB.
        placements: N placed templates.
        nearer: For each, the known pixels (H, W) of nearer vehicles.
        ground: Plane (4,) n.x + d = 0.
        camera: The photograph's camera.
        backend: Of the rasteriser.
        refine_borders: Run the second stage, for borders accurate to parts of a pixel.
        network: In place of the shipped one.

    Returns:
        N cut-outs.
    """
    network = network or load_network()
    in_view = [(i, rect) for i, p in enumerate(placements) if (rect := crop_rectangle(p, camera)) is not None]
    cutouts = [Cutout(0, 0, *(np.zeros((0, 0), np.float32),) * 3) for _ in placements]
    if not in_view:
        return cutouts
    rects = np.array([rect for _, rect in in_view], np.float32) - 0.5
    cameras = [crop_camera(camera, rect) for _, rect in in_view]
    given = np.zeros((len(in_view), 2, *CROP_HW), np.float32)
    for row, (i, rect) in enumerate(in_view):
        others = nearer[i][..., None].astype(np.uint8) * 255
        given[row, 1] = inside_mask(rect, (0, 0, camera.width, camera.height))
        given[row, 0] = crop_boxes(others, rects[row : row + 1], CROP_HW, 1.0)[0, ..., 0] / 255 * given[row, 1]
    crops = torch.from_numpy(crop_boxes(image, rects, CROP_HW, 1.0).transpose(0, 3, 1, 2).astype(np.float32) / 255)
    guides = render_guides([placements[i] for i, _ in in_view], cameras, [ground] * len(in_view), given, backend)
    shares = network(crops, guides).softmax(1)[:, :3].numpy()
    for (i, rect), share in zip(in_view, shares, strict=True):
        cutouts[i] = _paste_shares(share, rect, image.shape)
    return refine_cutouts(image, cutouts, network) if refine_borders else cutouts


def _paste_shares(shares: Array, rect: tuple[int, int, int, int], shape: tuple[int, ...]) -> Cutout:
    """The cut-out of a crop's shares (3, 96, 160), inside the photograph."""
    x0, y0, x1, y1 = rect
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, shape[1]), min(y1, shape[0])
    parts = resize_shares(shares, (x1 - x0, y1 - y0))[:, top - y0 : bottom - y0, left - x0 : right - x0]
    return Cutout(left, top, *(np.ascontiguousarray(part) for part in parts))


def resize_shares(shares: Array, size_wh: tuple[int, int]) -> Array:
    """Shares (3, 96, 160) of a crop at the photograph's resolution, (3, h, w)."""
    smaller = size_wh[0] < CROP_HW[1] and size_wh[1] < CROP_HW[0]
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.stack([cv2.resize(share, size_wh, interpolation=how) for share in shares]).astype(np.float32)


@torch.no_grad()
def refine_cutouts(
    image: NDArray[np.uint8], cutouts: Sequence[Cutout], network: CutoutNet | None = None
) -> list[Cutout]:
    """Refine the borders of cut-outs by the second stage; shares elsewhere are rounded to 0 or 1.

    Args:
        image: (H, W, 3) RGB.
        cutouts: First-stage cut-outs.
        network: In place of the shipped one.

    Returns:
        The refined cut-outs.
    """
    network = network or load_network()
    padded, places = [], []
    uncertain = [find_uncertain_pixels(c) if c.visible.size else np.zeros((0, 0), bool) for c in cutouts]
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
        for y, x in zip(*np.nonzero(_tiles_with(uncertain[i])), strict=True):
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
                chosen = uncertain[i][y : y + TILE, x : x + TILE]
                target = values[y : y + TILE, x : x + TILE]
                target[chosen] = part[: target.shape[0], : target.shape[1]][chosen]
    return [
        replace(c, visible=visible, front=front, shadow=np.minimum(c.shadow, 1 - visible - front).clip(0))
        for c, (visible, front) in zip(cutouts, maps, strict=True)
    ]


def find_uncertain_pixels(cutout: Cutout) -> Mask:
    """Pixels (h, w) along borders, and where the first stage is undecided."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    out = np.zeros(cutout.visible.shape, bool)
    for share in (cutout.visible, cutout.front):
        low, high = cv2.erode(share, disc), cv2.dilate(share, disc)
        out |= (high - low > 0.5) | ((share > 2 * _CERTAIN) & (share < 1 - 2 * _CERTAIN))
    return out


def _tiles_with(wanted: NDArray[Any]) -> Mask:
    """Tiles (rows, columns) with a wanted pixel."""
    h, w = wanted.shape
    full = np.pad(wanted, ((0, -h % TILE), (0, -w % TILE)))
    parts = full.reshape(full.shape[0] // TILE, TILE, full.shape[1] // TILE, TILE)
    return np.asarray(parts.any((1, 3)))


def cutout_from_mask(
    image: NDArray[np.uint8], mask: Mask, nearer: Mask, network: CutoutNet | None = None
) -> Cutout:
    """The refined cut-out of a vehicle with a known mask.

    Args:
        image: (H, W, 3) RGB.
        mask: The vehicle's pixels (H, W), not empty.
        nearer: Nearer vehicles' pixels (H, W).
        network: In place of the shipped one.

    Returns:
        The cut-out.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    y0, y1 = max(int(rows[0]) - HALO, 0), min(int(rows[-1]) + 1 + HALO, mask.shape[0])
    x0, x1 = max(int(columns[0]) - HALO, 0), min(int(columns[-1]) + 1 + HALO, mask.shape[1])
    visible, front = (m[y0:y1, x0:x1].astype(np.float32) for m in (mask, nearer & ~mask))
    return refine_cutouts(image, [Cutout(x0, y0, visible, front, np.zeros_like(visible))], network)[0]


def clean_cutout(cutout: Cutout) -> Cutout:
    """The cut-out without specks and holes: windows and reflections are vehicle, and occluders do not float."""
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
    """Give unlikely occluders to the vehicle, and fill its notches.

    Args:
        cutout: The vehicle's cut-out.
        outline: Pixels (H, W) of the placed mesh.
        known: Pixels (H, W) of known nearer objects.

    Returns:
        The cleaned cut-out.
    """
    if not cutout.visible.size:
        return cutout
    inside, occluded = outline[cutout.window], known[cutout.window]
    columns, rows = np.flatnonzero(inside.any(0)), np.flatnonzero(inside.any(1))
    if not len(rows):
        return cutout
    front = cutout.front.copy()
    count, parts = cv2.connectedComponents((front >= 0.5).astype(np.uint8), connectivity=4)
    for part in (np.asarray(parts) == k for k in range(1, count)):
        over = part & inside
        width = np.count_nonzero(over.any(0)) / len(columns)
        pole = width <= _POLE_WIDTH and np.count_nonzero(over) <= (1 - _POLE_OUTSIDE) * np.count_nonzero(part)
        if not pole:
            front[
                cv2.dilate(part.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & inside & ~occluded
            ] = 0
    gone = cutout.front - front
    visible = cutout.visible + gone
    radius = max(round(_NOTCH * len(rows)), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    solid = np.pad((visible >= 0.5).astype(np.uint8), radius)
    closed = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius] > 0
    notch = closed & inside & ~occluded & (front < 0.5)
    visible = np.where(notch, np.maximum(visible, 1 - front), visible).clip(0, 1).astype(np.float32)
    front = np.minimum(front, 1 - visible)
    return replace(
        cutout, visible=visible, front=front, shadow=np.minimum(cutout.shadow, 1 - visible - front).clip(0)
    )
