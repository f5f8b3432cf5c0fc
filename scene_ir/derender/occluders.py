"""What stands in front of vehicles and is none: people, trunks, poles, fences. Its pixels, and how far away it is.

It comes from labels of people and the like, whose pixels are cut out in their boxes, and from a data set's masks
and depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import silhouette
from scene_ir.derender.matte import MatteSettings, compute_matte
from scene_ir.geometry import to_clip
from scene_ir.types import Camera, Crop, Frame, Labels, Occluder

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LEAST_PX = 12
"""Pixels of a thing: fewer are noise."""
_SURE, _NEAR, _FAR = 0.22, 0.05, 0.22
"""Of a labelled thing's width: how far inside of the ellipse in its box, outside of it near the ground, and higher
up, its border is looked for."""
_FILLED = (0.15, 0.72)
"""Share of its box that a cut-out of a person may fill; beyond, colours have misled, and the ellipse stands."""
_GAP_M = 0.2
"""A thing in front of a vehicle is at least so much nearer than the vehicle's nearest corner."""
_RAISED_M = 0.2
"""Height above the ground from which on what is near stands, and is no ground."""
_SLICE = 1.2
"""Ratio of the depths, far to near, of what is taken as one thing in a depth map."""
_AROUND = 1.0
"""How far beside a vehicle a depth map's things are kept, as a fraction of its width: it may move there."""
_TIGHT = MatteSettings(generous_px=0.2)
"""Things in front never move: a rim of vehicle left around them would stay when the vehicle goes."""


@dataclass(frozen=True, slots=True, eq=False)
class OccluderMask:
    """One thing in front. mask (H, W): its pixels; depth_m: along the optical axis, to where it stands."""

    mask: Mask
    depth_m: float


def find_labelled_occluders(
    image: NDArray[np.uint8], frame: Frame, vehicles: Sequence[int], others: Sequence[int]
) -> list[OccluderMask]:
    """Labelled things that are no vehicles and nearer than the farthest of those, nearest first.

    image (H, W, 3) RGB; vehicles: the labels' rows that become objects; others: rows with a 3D box that may be
    things. A mask of the frame is used where there is one; otherwise GrabCut looks for the border in the 2D box.
    """
    labels, camera = frame.labels, frame.camera
    if labels is None or not vehicles:
        return []
    depth = to_clip(labels.translation, camera.matrix.to(labels.translation))[:, 2].tolist()
    farthest = max(depth[row] for row in vehicles)
    found: list[OccluderMask] = []
    nearer = np.zeros(image.shape[:2], bool)
    for row in sorted((i for i in others if 0 < depth[i] < farthest), key=lambda i: depth[i]):
        mask = (
            _segment_in_box(image, labels, row, nearer)
            if frame.masks is None
            else (frame.masks[row] > 0.5).numpy()
        )
        mask = mask & ~nearer
        if np.count_nonzero(mask) >= _LEAST_PX:
            found.append(OccluderMask(mask, depth[row]))
            nearer = nearer | mask
    return found


def _segment_in_box(image: NDArray[np.uint8], labels: Labels, row: int, nearer: Mask) -> Mask:
    """The pixels (H, W) of a labelled thing: those in its box that look unlike what surrounds it."""
    x0, y0, x1, y1 = labels.boxes_xyxy[row].tolist()
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    across, down = (2 * u - x0 - x1) / max(x1 - x0, 1), (2 * v - y0 - y1) / max(y1 - y0, 1)
    ellipse = across**2 + down**2 <= 1
    if not ellipse.any():
        return ellipse
    width = x1 - x0
    band = (_SURE * width + 1, _NEAR * width + 1, _FAR * width + 1)
    mask = silhouette.grabcut_mask(image, ellipse, nearer, band)
    mask &= (np.abs(across) <= 1) & (np.abs(down) <= 1)
    filled = np.count_nonzero(mask) / max(np.count_nonzero((np.abs(across) <= 1) & (np.abs(down) <= 1)), 1)
    return mask if _FILLED[0] <= filled <= _FILLED[1] else ellipse & ~nearer


def find_measured_occluders(
    depth_m: Array, height_m: Array, vehicles: Mask, boxes: Sequence[tuple[Mask, float]]
) -> list[OccluderMask]:
    """Things in front by a depth map. depth_m (H, W); height_m (H, W): of each pixel's point above the ground;
    vehicles (H, W): pixels of all vehicles, or of things known already; boxes: for each vehicle its outline (H, W)
    and the depth of its nearest corner."""
    near = np.zeros(depth_m.shape, bool)
    for outline, nearest in boxes:
        if outline.any():
            x0, y0, x1, y1 = silhouette.mask_bounds(outline)
            side = round(_AROUND * (x1 - x0))
            window = (slice(y0, y1), slice(max(x0 - side, 0), x1 + side))
            near[window] |= depth_m[window] < nearest - _GAP_M
    near &= (height_m > _RAISED_M) & ~vehicles
    found = []
    while near.any():
        start = float(depth_m[near].min())
        layer = near & (depth_m <= _SLICE * start)
        near = near & ~layer
        found += [OccluderMask(part, float(np.median(depth_m[part]))) for part in _split_components(layer)]
    return found


def _split_components(mask: Mask) -> list[Mask]:
    """The pieces of a mask that hang together, without specks."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return [parts == k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= _LEAST_PX]


def nearest_corner_depth(placement: silhouette.Placement, camera: Camera) -> float:
    """Depth, m, of the nearest corner of a vehicle's box along the optical axis; at least 0.3."""
    half = placement.size_lhw.detach()[[0, 2]].norm() / 2
    middle = to_clip(placement.translation.detach()[None], camera.matrix.to(placement.translation))[0, 2]
    return max(float(middle - half), 0.3)


def mask_nearer_occluders(things: Sequence[OccluderMask], depth_m: float, shape: tuple[int, int]) -> Mask:
    """Pixels (H, W) of the things that are nearer than `depth_m`: a vehicle there cannot own them."""
    mask = np.zeros(shape, bool)
    for thing in things:
        if thing.depth_m < depth_m:
            mask |= thing.mask
    return mask


def compute_opacities(image: Array, things: Sequence[OccluderMask]) -> list[Array]:
    """How much (H, W) of each pixel shows each thing, in [0, 1]. image (H, W, 3)."""
    found = []
    nothing = np.zeros(image.shape[:2], bool)
    for thing in sorted(things, key=lambda t: t.depth_m):
        opacity = compute_matte(image, thing.mask, nothing, nothing, _TIGHT)
        for other in found:
            opacity = np.where(other > 0, np.minimum(opacity, 1 - other), opacity)
        found.append(opacity.astype(np.float32))
    return found


def make_occluder(opacity: Array, depth_m: float) -> Occluder:
    """A thing as the scene keeps it, its colours not yet solved. opacity (H, W)."""
    x0, y0, x1, y1 = silhouette.mask_bounds(opacity > 0)
    part = torch.from_numpy(np.ascontiguousarray(opacity[y0:y1, x0:x1]))
    return Occluder(Crop(torch.cat([torch.zeros(3, *part.shape), part[None]]), x0, y0), depth_m)
