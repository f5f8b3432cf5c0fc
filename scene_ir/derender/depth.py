"""Estimate the depth of a photograph's surroundings with a small network, constrained by the ground and the
labels.

Everything is computed as *nearness*: the camera's height above the ground over the depth. It is 0 in the sky and,
on level ground, about the tangent of the angle below the horizon. Nothing lies below the ground, so each pixel is
at least as near as the ground on its ray. The network (`unet`) estimates the excess: 0 on the ground, small at the
foot of a wall, larger towards its top, and smooth where the surroundings are. Walls by rule, upright at the end of
the ground, have accurate depths and inaccurate borders: they are smoothed along the photograph's edges and
averaged with the network's estimate. Nearness is smoothed rather than the excess because it is constant down a
wall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.derender import depth as maps
from scene_ir.derender import unet
from scene_ir.derender.unet import UNet
from scene_ir.geometry import box_corners, to_clip
from scene_ir.types import Camera, Labels
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "depth.safetensors"
"""The shipped weights, made by `tools/train_depth.py`."""
_OFFSET = -4.0
"""Added to the network's output before softplus: an excess of 0.018, that of a wall 90 m away at the horizon."""
_EPSILON = 1e-5
"""Added before logarithms."""
_MIN_NEARNESS = 5e-4
"""Nearness below which a pixel is infinitely far: 3 km."""
_SCALE = 1.15
"""Factor on the network's excess: trained on logarithms, the network errs to the far side."""
_AVERAGE_OFFSET = 0.005
"""Nearness added before both estimates are averaged: 330 m, beyond which neither is informative."""
_NETWORK_SMOOTHING, _RULE_SMOOTHING = (200.0, 8.0), (3000.0, 10.0)
"""Smoothing of the network's and the rule's nearness, see `GroundFrame.smooth`."""
_FOCAL_PX = 721.5
"""KITTI's focal length, px."""
_FOOTPRINT_BLUR = 0.008
"""Blur of footprints, as a fraction of the focal length."""
_BEHIND_MARGIN = 0.03
"""Margin around a vehicle in which its background's depth limit applies, as a fraction of the width."""


class DepthNet(UNet):
    """RGB (N, 3, h, w) in [0, 1] and elevation (N, 1, h, w), sides multiples of 16 -> (N, 1, h/2, w/2), see
    `nearness_excess`.
    """

    def __init__(self) -> None:
        super().__init__(1)


def nearness_excess(numbers: Tensor) -> Tensor:
    """Excess nearness (...) >= 0 of each pixel over the ground's, from the network's output (...)."""
    return F.softplus(numbers + _OFFSET)


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> DepthNet:
    """The network of a weights file, in eval mode. Raises FormatError."""
    network = load_frozen(DepthNet(), path)
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


@dataclass(frozen=True, slots=True)
class DepthConstraints:
    """What is known about the background."""

    sky: Array
    """(H, W) in [0, 1], share of sky."""
    flat: Array
    """(H, W) in [0, 1], share of ground."""
    footprint: Array
    """(H, W), 1 where a labelled object stands on the ground, else 0."""
    behind_m: Array
    """(H, W) m, least depth of the background behind labelled vehicles, 0 elsewhere."""


@dataclass(frozen=True, slots=True)
class GroundFrame:
    """A photograph without vehicles, its camera and the ground. Nearness is camera height over depth."""

    image: Array
    """(H, W, 3) RGB float32 in [0, 1]."""
    ground: Tensor
    """(4,), plane n.x + d = 0 with n up."""
    camera: Camera
    """The photograph's camera."""
    plane_m: Array
    """(H, W) m, depth of the ground; inf above the horizon."""

    @staticmethod
    def from_image(image: Array, ground: Tensor, camera: Camera) -> GroundFrame:
        """Compute the ground's depth.

        Args:
            image: (H, W, 3) RGB float32 in [0, 1].
            ground: Plane (4,) n.x + d = 0 with n up.
            camera: The photograph's camera.

        Returns:
            The frame.
        """
        return GroundFrame(image, ground, camera, maps.compute_plane_depth(ground, camera))

    def nearness(self, depth_m: Array) -> Array:
        """Nearness (H, W) of a depth (H, W) m."""
        return np.asarray(float(self.ground[3]) / depth_m, np.float32)

    def depth_m(self, nearness: Array) -> Array:
        """Depth (H, W) m of a nearness (H, W); inf where that is nearly 0."""
        endless = nearness < _MIN_NEARNESS
        return np.where(endless, np.inf, float(self.ground[3]) / np.where(endless, 1, nearness)).astype(np.float32)

    def smooth(self, values: Array, how: tuple[float, float]) -> Array:
        """Smooth values (H, W) except across the photograph's edges (Min et al., Fast Global Image Smoothing,
        2014).

        `how` is the smoothing at KITTI's focal length, and the difference of 8-bit colours that is an edge.
        """
        guide = np.clip(np.rint(self.image * 255), 0, 255).astype(np.uint8)
        more = (float(self.camera.intrinsics[0, 0]) / _FOCAL_PX) ** 2
        smooth = cv2.ximgproc.fastGlobalSmootherFilter(
            guide, np.asarray(values, np.float32), how[0] * more, how[1]
        )
        return np.asarray(smooth, np.float32)


def predict_excess(frame: GroundFrame, network: DepthNet | None = None) -> Array:
    """The network's excess nearness (h, w) over the ground's, at a lower resolution."""
    camera = frame.camera
    view = unet.prepare_input(frame.image, frame.ground, camera)
    # In a picture of another focal length all is as near as it seems.
    zoom = float(camera.intrinsics[1, 1]) * view.image.shape[0] / (camera.height * unet.INPUT_FOCAL_PX)
    view = replace(view, elevation=view.elevation * np.float32(zoom))
    return np.asarray(nearness_excess((network or load_network()).predict(view))[0, 0].numpy() / zoom, np.float32)


def nearness_by_network(frame: GroundFrame, flat: Array, network: DepthNet | None = None) -> Array:
    """Nearness by the network, with borders of objects aligned with the photograph's edges.

    Args:
        frame: The photograph and its ground.
        flat: Share of ground (H, W).
        network: In place of the shipped one.

    Returns:
        Nearness (H, W).
    """
    size = frame.image.shape[1::-1]
    level = frame.nearness(frame.plane_m)
    large = cv2.resize(np.log(predict_excess(frame, network) + _EPSILON), size, interpolation=cv2.INTER_LINEAR)
    by_network = level + _SCALE * np.exp(np.asarray(large, np.float32))
    standing = np.exp(frame.smooth(np.log(by_network + _AVERAGE_OFFSET), _NETWORK_SMOOTHING)) - _AVERAGE_OFFSET
    return np.maximum(flat * by_network + (1 - flat) * standing, level)


def nearness_by_rule(frame: GroundFrame, constraints: DepthConstraints) -> Array:
    """Nearness (H, W) of the ground and of walls at its end, smoothed except across the photograph's edges."""
    horizon = maps.horizon_row(frame.ground, frame.camera)
    walls = frame.nearness(
        maps.compute_wall_depth(frame.plane_m, constraints.flat, constraints.footprint, constraints.sky, horizon)
    )
    known = (walls > 0).astype(np.float32)
    total, weight = (frame.smooth(m, _RULE_SMOOTHING) for m in (walls, known))
    standing = total / np.maximum(weight, _EPSILON)
    return np.maximum(constraints.flat * walls + (1 - constraints.flat) * standing, frame.nearness(frame.plane_m))


def estimate_depth(
    image: Array, ground: Tensor, camera: Camera, constraints: DepthConstraints, network: DepthNet | None = None
) -> Array:
    """Estimate the depth of a photograph without vehicles.

    The geometric mean of two estimates of nearness: the network's, which sees what stands where, and the rule's,
    by the end of the ground. Nothing is farther than the ground on its ray.

    Args:
        image: (H, W, 3) RGB float32 in [0, 1].
        ground: Plane (4,) n.x + d = 0 with n up.
        camera: The photograph's camera.
        constraints: What is known about the background.
        network: In place of the shipped one.

    Returns:
        Depth (H, W) m along the optical axis; inf in the sky.
    """
    frame = GroundFrame.from_image(image, ground, camera)
    by_network, by_rule = (
        nearness_by_network(frame, constraints.flat, network),
        nearness_by_rule(frame, constraints),
    )
    both = np.sqrt((by_network + _AVERAGE_OFFSET) * (by_rule + _AVERAGE_OFFSET)) - _AVERAGE_OFFSET
    level = frame.nearness(frame.plane_m)
    stood = cv2.GaussianBlur(
        constraints.footprint, (0, 0), max(_FOOTPRINT_BLUR * float(camera.intrinsics[0, 0]), 0.5)
    )
    nearness = level + np.maximum(both - level, 0) * (1 - constraints.sky) * (1 - stood)
    behind = frame.nearness(np.where(constraints.behind_m > 0, constraints.behind_m, np.float32(1e-3)))
    return frame.depth_m(np.maximum(_limit_nearness(nearness, behind), level))


def _limit_nearness(nearness: Array, most: Array) -> Array:
    """Nearness (H, W), at most `most`. The surroundings of lowered pixels are lowered too, to hide the border."""
    share = np.minimum(most / np.maximum(nearness, _EPSILON), 1).astype(np.float32)
    if share.min() < 1:
        side = round(_BEHIND_MARGIN * nearness.shape[1])
        least = cv2.erode(share, np.ones((2 * side + 1, 2 * side + 1), np.uint8))
        nearness = nearness * cv2.GaussianBlur(least, (0, 0), max(side / 3, 0.5))
    return np.minimum(nearness, most)


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
