"""Find objects in front of vehicles that are no vehicles: people, trunks, poles, fences.

Labelled people and the like are cut out in their boxes, or by the data set's masks; other objects come from its
depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import silhouette
from scene_ir.derender.matte import compute_matte
from scene_ir.geometry import to_clip
from scene_ir.types import Camera, Crop, Frame, Labels, Occluder

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MIN_PX = 12
"""Fewer pixels are noise."""
_INSIDE, _OUTSIDE_LOW, _OUTSIDE_HIGH = 0.22, 0.05, 0.22
"""Search range of the border of a labelled object, in its widths: inside the ellipse in its box, outside it near
the ground, and outside it higher up."""
_FILLED = (0.15, 0.72)
"""Share of its box that a person's mask may fill; otherwise colours have misled, and the ellipse is the mask."""
_GAP_M = 0.2
"""An object in front is at least this much nearer than the vehicle's nearest corner."""
_RAISED_M = 0.2
"""Height above the ground from which near pixels are an object."""
_SLICE = 1.2
"""Ratio of far to near depth within one object of a depth map."""
_AROUND = 1.0
"""Range to the sides of a vehicle in which a depth map's objects count, in its widths: it may move there."""


@dataclass(frozen=True, slots=True, eq=False)
class OccluderMask:
    """An object in front of vehicles, as a mask."""

    mask: Mask
    """(H, W), its pixels."""
    depth_m: float
    """Depth along the optical axis, m."""


def find_labelled_occluders(
    image: NDArray[np.uint8], frame: Frame, vehicles: Sequence[int], others: Sequence[int]
) -> list[OccluderMask]:
    """Labelled objects that are nearer than the farthest vehicle, nearest first.

    Args:
        image: The photograph (H, W, 3) RGB.
        frame: Its labels and, if there are any, masks; otherwise GrabCut finds the border in the 2D box.
        vehicles: Rows of the labels that become objects.
        others: Rows of other labels with a 3D box.

    Returns:
        Occluders with disjoint masks.
    """
    labels, camera = frame.labels, frame.camera
    if labels is None or not vehicles:
        return []
    depth = to_clip(labels.translation, camera.matrix.to(labels.translation))[:, 2].tolist()
    farthest = max(depth[row] for row in vehicles)
    occluders: list[OccluderMask] = []
    nearer = np.zeros(image.shape[:2], bool)
    for row in sorted((i for i in others if 0 < depth[i] < farthest), key=lambda i: depth[i]):
        mask = (
            _segment_in_box(image, labels, row, nearer)
            if frame.masks is None
            else (frame.masks[row] > 0.5).numpy()
        )
        mask = mask & ~nearer
        if np.count_nonzero(mask) >= _MIN_PX:
            occluders.append(OccluderMask(mask, depth[row]))
            nearer = nearer | mask
    return occluders


def _segment_in_box(image: NDArray[np.uint8], labels: Labels, row: int, nearer: Mask) -> Mask:
    """Pixels (H, W) of a labelled object: those in its box with colours unlike the surroundings'."""
    x0, y0, x1, y1 = labels.boxes_xyxy[row].tolist()
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    across, down = (2 * u - x0 - x1) / max(x1 - x0, 1), (2 * v - y0 - y1) / max(y1 - y0, 1)
    ellipse = across**2 + down**2 <= 1
    if not ellipse.any():
        return ellipse
    width = x1 - x0
    band = (_INSIDE * width + 1, _OUTSIDE_LOW * width + 1, _OUTSIDE_HIGH * width + 1)
    in_box = (np.abs(across) <= 1) & (np.abs(down) <= 1)
    mask = silhouette.grabcut_mask(image, ellipse, nearer, band) & in_box
    filled = np.count_nonzero(mask) / max(np.count_nonzero(in_box), 1)
    return mask if _FILLED[0] <= filled <= _FILLED[1] else ellipse & ~nearer


def find_measured_occluders(
    depth_m: Array, height_m: Array, vehicles: Mask, boxes: Sequence[tuple[Mask, float]]
) -> list[OccluderMask]:
    """Objects in front of vehicles by a depth map.

    Args:
        depth_m: Depth (H, W) m.
        height_m: Height (H, W) m of each pixel's point above the ground.
        vehicles: Pixels (H, W) of vehicles and known occluders.
        boxes: For each vehicle its outline (H, W) and the depth of its nearest corner, m.

    Returns:
        Connected occluders.
    """
    near = np.zeros(depth_m.shape, bool)
    for outline, nearest in boxes:
        if outline.any():
            x0, y0, x1, y1 = silhouette.mask_bounds(outline)
            side = round(_AROUND * (x1 - x0))
            window = (slice(y0, y1), slice(max(x0 - side, 0), x1 + side))
            near[window] |= depth_m[window] < nearest - _GAP_M
    near &= (height_m > _RAISED_M) & ~vehicles
    occluders = []
    while near.any():
        start = float(depth_m[near].min())
        layer = near & (depth_m <= _SLICE * start)
        near = near & ~layer
        occluders += [OccluderMask(part, float(np.median(depth_m[part]))) for part in _split_components(layer)]
    return occluders


def _split_components(mask: Mask) -> list[Mask]:
    """The connected components of a mask, without specks."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return [parts == k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= _MIN_PX]


def nearest_corner_depth(placement: silhouette.Placement, camera: Camera) -> float:
    """Depth, m, of the nearest corner of a vehicle's box along the optical axis; at least 0.3."""
    half = placement.size_lhw.detach()[[0, 2]].norm() / 2
    middle = to_clip(placement.translation.detach()[None], camera.matrix.to(placement.translation))[0, 2]
    return max(float(middle - half), 0.3)


def mask_nearer_occluders(occluders: Sequence[OccluderMask], depth_m: float, shape: tuple[int, int]) -> Mask:
    """Pixels of occluders in front of a depth, which no vehicle at that depth can own.

    Args:
        occluders: The occluders.
        depth_m: The depth, m.
        shape: Height and width, px.

    Returns:
        Mask (H, W).
    """
    return np.logical_or.reduce([np.zeros(shape, bool), *(o.mask for o in occluders if o.depth_m < depth_m)])


def compute_opacities(image: Array, occluders: Sequence[OccluderMask]) -> list[Array]:
    """Opacities (H, W) of occluders, nearest first, that add up to at most 1; image (H, W, 3) in [0, 1]."""
    opacities: list[Array] = []
    for occluder in sorted(occluders, key=lambda o: o.depth_m):
        opacity = compute_matte(image, occluder.mask)
        for nearer in opacities:
            opacity = np.where(nearer > 0, np.minimum(opacity, 1 - nearer), opacity)
        opacities.append(opacity.astype(np.float32))
    return opacities


def make_occluder(opacity: Array, depth_m: float) -> Occluder:
    """The scene's occluder with an opacity (H, W), its colours not yet solved."""
    x0, y0, x1, y1 = silhouette.mask_bounds(opacity > 0)
    part = torch.from_numpy(np.ascontiguousarray(opacity[y0:y1, x0:x1]))
    return Occluder(Crop(torch.cat([torch.zeros(3, *part.shape), part[None]]), x0, y0), depth_m)
