"""Geometry of the surroundings by simple rules: ground plane, horizon, footprints, walls at the end of the ground,
sun.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.geometry import box_corners, to_clip
from scene_ir.types import Camera, Labels

Array = NDArray[np.float32]

CAMERA_HEIGHT_M = 1.65
"""Height of KITTI's cameras above the road, m (Geiger et al., IJRR 2013)."""
FAR_M = 80.0
"""Depth of upright surfaces without a visible foot, m."""
_WALL_BLUR = 0.02
"""Blur of walls' depths along the street, as a fraction of the image's width."""
_FOOTPRINT_SIDE = 0.03
"""Extension of footprints to their sides, as a fraction of the image's width: most of the wall blur."""
_NEAR_M = 0.5
"""Boxes nearer to the camera are ignored."""
_MAX_PX = 10_000
"""Bound of coordinates: far outside any image, and within OpenCV's integers."""
DEFAULT_SUN = (-0.35, -0.85, -0.39)
"""Direction towards the sun if nothing is known: high, a little to the left and behind the camera."""


def fit_ground(labels: Labels | None, rows: list[int]) -> torch.Tensor:
    """Fit the ground plane (4,) n.x + d = 0, n up, to the bottom centres of the labels `rows` and a level-road
    prior.

    y = a x + b z + c by iterated least squares with Huber weights. A point's error is 0.1 m plus 1 % of its distance.
    """
    points = labels.translation[rows].double().numpy() if labels is not None and rows else np.zeros((0, 3))
    prior = np.diag([1 / 0.03, 1 / 0.015, 1 / 0.15])
    target = np.array([0.0, 0.0, CAMERA_HEIGHT_M / 0.15])
    sigma = 0.1 + 0.01 * points[:, 2]
    design = np.stack([points[:, 0], points[:, 2], np.ones(len(points))], 1) / sigma[:, None]
    goal = points[:, 1] / sigma
    weight = np.ones(len(points))
    plane = np.array([0.0, 0.0, CAMERA_HEIGHT_M])
    for _ in range(10):
        root = np.sqrt(weight)
        rows_all = np.concatenate([design * root[:, None], prior])
        plane = np.linalg.lstsq(rows_all, np.concatenate([goal * root, target]), rcond=None)[0]
        residual = np.abs(design @ plane - goal)
        weight = np.minimum(1.0, 1.5 / np.maximum(residual, 1e-9))
    normal = np.array([plane[0], -1.0, plane[1], plane[2]])
    return torch.from_numpy((normal / np.linalg.norm(normal[:3])).astype(np.float32))


def compute_plane_depth(ground: torch.Tensor, camera: Camera) -> Array:
    """Depth z (H, W) m of the ground plane on each pixel's ray; inf where there is none."""
    matrix = camera.matrix.double().numpy()
    normal = ground.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    centre = -inverse @ matrix[:, 3]
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = np.einsum("ij,jhw->ihw", inverse, np.stack([u, v, np.ones_like(u)]).astype(np.float64))
    slope = np.einsum("i,ihw->hw", normal[:3], ray)
    height = normal[:3] @ centre + normal[3]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = -height / slope
        depth = np.where(step > 0, centre[2] + step * ray[2], np.inf)
    return np.where(depth > 0, depth, np.inf).astype(np.float32)


def horizon_row(ground: torch.Tensor, camera: Camera) -> float:
    """Row, px, of the horizon in the image's middle column."""
    inverse = np.linalg.inv(camera.intrinsics.double().numpy())
    across = ground[:3].double().numpy() @ inverse
    return float(-(across[0] * (camera.width - 1) / 2 + across[2]) / across[1])


def draw_footprints(labels: Labels, rows: list[int], ground: torch.Tensor, camera: Camera) -> Array:
    """Draw the footprints of labelled objects: there is ground, regardless of the pixels.

    Args:
        labels: A frame's labels.
        rows: Labels to draw.
        ground: Plane (4,) n.x + d = 0.
        camera: The frame's camera.

    Returns:
        (H, W), 1 inside a footprint, else 0.
    """
    corners = box_corners(labels.size_lhw[rows], labels.yaw[rows], labels.translation[rows])[:, :4].double()
    normal = ground.double()
    y = -(corners[..., 0] * normal[0] + corners[..., 2] * normal[2] + normal[3]) / normal[1]
    clip = to_clip(torch.stack([corners[..., 0], y, corners[..., 2]], dim=-1), camera.matrix.double())
    in_view = (clip[..., 2] > _NEAR_M).all(dim=1)
    stands = np.zeros((camera.height, camera.width), np.float32)
    for polygon in (clip[in_view, :, :2] / clip[in_view, :, 2:]).numpy():
        cv2.fillConvexPoly(stands, np.rint(polygon.clip(-_MAX_PX, _MAX_PX)).astype(np.int32), 1)
    return stands


def compute_wall_depth(ground_depth: Array, flat: Array, stood: Array, sky: Array, horizon: float) -> Array:
    """Depth by rule: the ground's, and upright walls at the end of each column's lowest stretch of ground.

    Args:
        ground_depth: Depth (H, W) m of the ground plane.
        flat: Share of ground (H, W).
        stood: Footprints (H, W) from `draw_footprints`, which are ground; pixels around them are no nearer.
        sky: Share of sky (H, W).
        horizon: Its row, px.

    Returns:
        Depth (H, W) m; at most `FAR_M` for walls, inf in the sky.
    """
    height, width = flat.shape
    side = 2 * round(_FOOTPRINT_SIDE * width) + 1
    flat = np.where(cv2.dilate(stood, np.ones((1, side), np.uint8)) > 0, np.float32(1), flat)
    ground = cv2.morphologyEx((flat > 0.5).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8)) > 0
    rows = np.arange(height)[:, None]
    below = rows > horizon + 2
    top = np.where(ground.any(0), np.argmax(ground & below, axis=0), height - 1)
    # The foot of columns without ground is interpolated from their neighbours.
    known = ground.any(0)
    if known.any():
        top = np.interp(np.arange(width), np.nonzero(known)[0], top[known])
    else:
        top = np.full(width, horizon + 0.25 * (height - horizon))
    window = max(3, width // 40) | 1
    top = cv2.blur(top.astype(np.float32)[None], (window, 1))[0]
    foot = np.clip(np.rint(top).astype(int), 0, height - 1)
    wall = np.minimum(ground_depth[foot, np.arange(width)], FAR_M)
    # Blur the inverse of depth: fog would show a step between columns as a seam.
    wall = 1 / cv2.GaussianBlur(1 / wall[None], (0, 0), _WALL_BLUR * width)[0]
    depth = np.minimum(ground_depth, wall[None])
    depth = np.where(rows >= foot[None], np.minimum(ground_depth, FAR_M), depth)
    return np.where(sky > 0.5, np.inf, depth).astype(np.float32)


def default_sun() -> torch.Tensor:
    """Unit vector (3,) towards the default sun: a photograph alone rarely determines it."""
    sun = torch.tensor(DEFAULT_SUN)
    return sun / sun.norm()
