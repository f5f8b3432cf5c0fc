"""Maps of the surroundings by simple, documented rules: ground plane, depth, sky, foliage, road, sun.

A first method without any learned part: colour, texture, position against the horizon, and a guided filter that
lays the soft borders along the photograph's edges.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.types import Camera, Labels

Array = NDArray[np.float32]

CAMERA_HEIGHT = 1.65
"""m, of KITTI's cameras above the road (Geiger et al., IJRR 2013)."""
FAR = 80.0
"""m, where upright surfaces without a visible foot are put."""
DEFAULT_SUN = (-0.35, -0.85, -0.39)
"""Towards the sun where nothing is known: high, a little to the left and behind the camera."""


def fit_ground(labels: Labels | None, rows: list[int]) -> torch.Tensor:
    """Plane (4,) n.x + d = 0 with n up, from the bottom centres of the labels `rows` and a prior of a level road.

    y = a x + b z + c by iterated least squares with Huber weights; a point's error is 0.1 m and grows with
    distance.
    """
    points = labels.translation[rows].double().numpy() if labels is not None and rows else np.zeros((0, 3))
    prior = np.diag([1 / 0.03, 1 / 0.015, 1 / 0.15])
    target = np.array([0.0, 0.0, CAMERA_HEIGHT / 0.15])
    sigma = 0.1 + 0.01 * points[:, 2]
    design = np.stack([points[:, 0], points[:, 2], np.ones(len(points))], 1) / sigma[:, None]
    goal = points[:, 1] / sigma
    weight = np.ones(len(points))
    plane = np.array([0.0, 0.0, CAMERA_HEIGHT])
    for _ in range(10):
        root = np.sqrt(weight)
        rows_all = np.concatenate([design * root[:, None], prior])
        plane = np.linalg.lstsq(rows_all, np.concatenate([goal * root, target]), rcond=None)[0]
        residual = np.abs(design @ plane - goal)
        weight = np.minimum(1.0, 1.5 / np.maximum(residual, 1e-9))
    normal = np.array([plane[0], -1.0, plane[1], plane[2]])
    return torch.from_numpy((normal / np.linalg.norm(normal[:3])).astype(np.float32))


def plane_depth(ground: torch.Tensor, camera: Camera) -> Array:
    """Depth z (H, W) m at which each pixel's ray meets the ground plane; inf where it does not."""
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
    """Row, px, of the horizon in the image's middle column: where rays run parallel to the ground."""
    inverse = np.linalg.inv(camera.intrinsics.double().numpy())
    across = ground[:3].double().numpy() @ inverse
    return float(-(across[0] * (camera.width - 1) / 2 + across[2]) / across[1])


def _soft(mask: NDArray[np.bool_] | Array, guide: Array, radius: int) -> Array:
    """The mask laid along the edges of the photograph (guided filter of He et al., TPAMI 2013), in [0, 1]."""
    filtered = cv2.ximgproc.guidedFilter(guide, mask.astype(np.float32), radius, 1e-4)
    return np.clip((filtered - 0.1) / 0.8, 0, 1).astype(np.float32)


def sky_map(image: Array, horizon: float, vehicles: NDArray[np.bool_]) -> Array:
    """(H, W) in [0, 1]. Sky is bright, not warmer than neutral, smooth, above the horizon and joined to the
    top."""
    blurred = cv2.GaussianBlur(image, (5, 5), 0)
    red, blue = blurred[..., 0], blurred[..., 2]
    value = blurred.max(-1)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    spread = np.sqrt(np.maximum(cv2.blur(grey * grey, (7, 7)) - cv2.blur(grey, (7, 7)) ** 2, 0))
    rows = np.arange(image.shape[0])[:, None]
    sure = (value > 0.97) & (blue > 0.93)
    likely = (value > 0.6) & (blue > red - 0.02) & (spread < 0.035)
    candidate = (sure | likely) & (rows < horizon) & ~vehicles
    count, parts, stats, _ = cv2.connectedComponentsWithStats(candidate.astype(np.uint8), connectivity=8)
    keep = np.zeros(count, bool)
    for part in range(1, count):
        _left, top, width, height, area = stats[part]
        # A white or bluish wall may touch the border too; the sky fills its box, is wide, and starts at the top.
        touches = top <= 1 and area > 30
        bright = float(blurred[parts == part].mean()) > 0.93 if area > 8 else True
        keep[part] = touches or (bright and width * height < 60 * image.shape[0])
    soft = _soft(keep[parts] & candidate, image, 6)
    return np.where(vehicles | (rows > horizon + 4), 0, soft).astype(np.float32)


def foliage_map(image: Array, sky: Array, road: Array, vehicles: NDArray[np.bool_]) -> Array:
    """(H, W) in [0, 1]. Foliage has more green than red and blue (excess green, Woebbecke 1995) or is dark and
    ragged."""
    blurred = cv2.GaussianBlur(image, (0, 0), 2.0)
    total = blurred.sum(-1) + 0.03
    excess = (2 * blurred[..., 1] - blurred[..., 0] - blurred[..., 2]) / total
    warm = (blurred[..., 0] - blurred[..., 2]) / total
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    mean = cv2.blur(grey, (9, 9))
    ragged = np.sqrt(np.maximum(cv2.blur(grey * grey, (9, 9)) - mean**2, 0)) / (mean + 0.05)
    green = 1 / (1 + np.exp(-(excess - 0.035) / 0.012))
    dense = 1 / (1 + np.exp(-(ragged - 0.4) / 0.06)) / (1 + np.exp(-(excess + warm - 0.02) / 0.01))
    score = np.maximum(green, dense)
    score = cv2.GaussianBlur(score.astype(np.float32), (0, 0), 3.0)
    soft = _soft(np.clip((score - 0.3) / 0.4, 0, 1).astype(np.float32), image, 8)
    return np.where(vehicles, 0, soft * (1 - sky) * (1 - road)).astype(np.float32)


def road_map(image: Array, horizon: float, vehicles: NDArray[np.bool_]) -> Array:
    """(H, W) in [0, 1]. Road has the colour of the lower middle, in light or shade, and is joined to it."""
    height, width = image.shape[:2]
    lab = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 2.0), cv2.COLOR_RGB2LAB)
    rows, columns = np.mgrid[0:height, 0:width]
    below = rows > horizon + 3
    share = (rows - horizon) / max(height - horizon, 1)
    seed = below & (share > 0.45) & (np.abs(columns - width / 2) < 0.22 * width * share) & ~vehicles
    if not seed.any():
        return np.zeros((height, width), np.float32)
    low, high = np.percentile(lab[seed][:, 0], (2, 98))
    middle = np.median(lab[seed][:, 1:], axis=0)
    chroma = np.hypot(lab[..., 1] - middle[0], lab[..., 2] - middle[1])
    similar = below & (chroma < 9) & (lab[..., 0] > 0.3 * low) & (lab[..., 0] < high + 25) & ~vehicles
    similar = cv2.morphologyEx(similar.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, parts = cv2.connectedComponents(similar, connectivity=4)
    joined = np.isin(parts, np.unique(parts[seed & (similar > 0)])) & (similar > 0)
    closed = cv2.morphologyEx(joined.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0
    return np.where(below, _soft(closed, image, 8), 0).astype(np.float32)


def depth_map(ground_depth: Array, road: Array, sky: Array, horizon: float) -> Array:
    """(H, W) m of the background: the ground plane where it is road, upright walls on its upper end, inf in the
    sky.

    Each column's wall stands where its lowest stretch of ground ends, at most `FAR` away.
    """
    height, width = road.shape
    ground = cv2.morphologyEx((road > 0.5).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8)) > 0
    rows = np.arange(height)[:, None]
    below = rows > horizon + 2
    top = np.where(ground.any(0), np.argmax(ground & below, axis=0), height - 1)
    # Columns without road (verges, yards): the foot of what stands there is interpolated from the neighbours.
    known = ground.any(0)
    if known.any():
        top = np.interp(np.arange(width), np.nonzero(known)[0], top[known])
    else:
        top = np.full(width, horizon + 0.25 * (height - horizon))
    window = max(3, width // 40) | 1
    top = cv2.blur(top.astype(np.float32)[None], (window, 1))[0]
    foot = np.clip(np.rint(top).astype(int), 0, height - 1)
    wall = np.minimum(ground_depth[foot, np.arange(width)], FAR)
    depth = np.minimum(ground_depth, wall[None])
    depth = np.where(rows >= foot[None], np.minimum(ground_depth, FAR), depth)
    return np.where(sky > 0.5, np.inf, depth).astype(np.float32)


def sun_direction() -> torch.Tensor:
    """(3,) unit vector towards the sun: the documented constant (a photograph alone rarely tells)."""
    sun = torch.tensor(DEFAULT_SUN)
    return sun / sun.norm()
