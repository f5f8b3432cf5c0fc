"""How far away a photograph's surroundings are: a small network, tied to the ground and to the labelled vehicles.

All is said in *nearness*: the camera's height above the ground over the depth. It is 0 in the sky and, on level
ground, about the tangent of the angle below the horizon. Nothing lies below the ground, so no pixel is less near
than the ground its ray meets. The network (`unet`) says by how much a pixel is nearer than that: not at all on the
ground itself, little at the foot of a wall, more towards its top. That is smooth wherever the surroundings are.
Walls by rule, upright on the end of the ground, tell well how far things are, and badly where they begin: they are
smoothed along the picture's edges, and averaged with what the network says. Nearness is smoothed and not what is
added to the ground's: it is the same all the way down a wall.
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

from scene_ir.derender import ground_geometry as maps
from scene_ir.derender import unet
from scene_ir.derender.unet import UNet
from scene_ir.types import Camera
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "depth.safetensors"
"""What the package ships; `tools/train_depth.py` makes it."""
_AT_ZERO = -4.0
"""What is added to the network's number before softplus: an excess of 0.018, what a wall 90 m away has at the
horizon."""
_LEAST = 1e-5
"""Added before logarithms are taken."""
_ENDLESS = 5e-4
"""Nearness below which a pixel counts as endlessly far: 3 km."""
_SCALE = 1.15
"""The network's excess is multiplied by: trained on logarithms, it errs to the far side."""
_FAR_OFF = 0.005
"""Nearness added before that by network and by rule are averaged: 330 m, beyond which neither knows anything."""
_TO_EDGES, _RELAXED = (200.0, 8.0), (3000.0, 10.0)
"""How much nearness by the network and by rule is smoothed; see `Outlook.smoothed`."""
_FOCAL_PX = 721.5
"""KITTI's."""
_BLURRED = 0.008
"""Of the focal length: over how much the ground under vehicles passes into what stands beside them."""
_AROUND = 0.03
"""Of the width: how far around a vehicle what stands behind it goes on."""


class DepthNet(UNet):
    """RGB (N, 3, h, w) in [0, 1] and `elevation` (N, 1, h, w), sides multiples of 16, to a number (N, 1, h/2, w/2)
    that `excess` reads."""

    def __init__(self) -> None:
        super().__init__(1)


def nearness_excess(numbers: Tensor) -> Tensor:
    """By how much each pixel is nearer than the ground (...), at least 0, of the network's numbers (...)."""
    return F.softplus(numbers + _AT_ZERO)


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> DepthNet:
    """The network of a weights file, in eval mode. Raises FormatError."""
    network = load_frozen(DepthNet(), path)
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


@dataclass(frozen=True, slots=True)
class DepthConstraints:
    """What is known of the surroundings, each (H, W). sky, flat in [0, 1]: where sky is seen, and where ground;
    stood, 0 or 1: where something labelled stands, and so ground is; behind_m: what is seen there once the
    labelled vehicles are gone is no nearer, 0 where nothing tells."""

    sky: Array
    flat: Array
    footprint: Array
    behind_m: Array


@dataclass(frozen=True, slots=True)
class GroundFrame:
    """A picture (H, W, 3) RGB float32 in [0, 1] without vehicles, its camera, and the ground: plane (4,) n.x + d =
    0, n up, and its depth plane_m (H, W), inf above the horizon."""

    image: Array
    ground: Tensor
    camera: Camera
    plane_m: Array

    @staticmethod
    def from_image(image: Array, ground: Tensor, camera: Camera) -> GroundFrame:
        """The outlook of a picture over a plane."""
        return GroundFrame(image, ground, camera, maps.compute_plane_depth(ground, camera))

    def nearness(self, depth_m: Array) -> Array:
        """Of depth (H, W) m."""
        return np.asarray(float(self.ground[3]) / depth_m, np.float32)

    def depth_m(self, nearness: Array) -> Array:
        """Of nearness (H, W); inf where that is hardly any."""
        endless = nearness < _ENDLESS
        return np.where(endless, np.inf, float(self.ground[3]) / np.where(endless, 1, nearness)).astype(np.float32)

    def smooth(self, values: Array, how: tuple[float, float]) -> Array:
        """Values (H, W) smoothed where the picture has no edge (Min et al., Fast Global Image Smoothing, 2014).
        how: how much at KITTI's focal length, and the difference of 8-bit colours that is an edge."""
        guide = np.clip(np.rint(self.image * 255), 0, 255).astype(np.uint8)
        more = (float(self.camera.intrinsics[0, 0]) / _FOCAL_PX) ** 2
        smooth = cv2.ximgproc.fastGlobalSmootherFilter(
            guide, np.asarray(values, np.float32), how[0] * more, how[1]
        )
        return np.asarray(smooth, np.float32)


def predict_excess(outlook: GroundFrame, network: DepthNet | None = None) -> Array:
    """By how much each pixel (h, w) of a picture, coarser than it, is nearer than the ground."""
    camera = outlook.camera
    view = unet.prepare_input(outlook.image, outlook.ground, camera)
    # In a picture of another focal length all is as near as it seems.
    zoom = float(camera.intrinsics[1, 1]) * view.image.shape[0] / (camera.height * unet.INPUT_FOCAL_PX)
    view = replace(view, elevation=view.elevation * np.float32(zoom))
    return np.asarray(nearness_excess((network or load_network()).predict(view))[0, 0].numpy() / zoom, np.float32)


def nearness_by_network(outlook: GroundFrame, flat: Array, network: DepthNet | None = None) -> Array:
    """Nearness (H, W) as the network has it. flat (H, W) in [0, 1]: where ground is seen; borders of what stands
    there are laid along the picture's edges."""
    size = outlook.image.shape[1::-1]
    level = outlook.nearness(outlook.plane_m)
    large = cv2.resize(np.log(predict_excess(outlook, network) + _LEAST), size, interpolation=cv2.INTER_LINEAR)
    told = level + _SCALE * np.exp(np.asarray(large, np.float32))
    standing = np.exp(outlook.smooth(np.log(told + _FAR_OFF), _TO_EDGES)) - _FAR_OFF
    return np.maximum(flat * told + (1 - flat) * standing, level)


def nearness_by_rule(outlook: GroundFrame, ties: DepthConstraints) -> Array:
    """Nearness (H, W) of ground and of walls on its end, smoothed where the picture has no edge."""
    horizon = maps.horizon_row(outlook.ground, outlook.camera)
    walls = outlook.nearness(
        maps.compute_wall_depth(outlook.plane_m, ties.flat, ties.footprint, ties.sky, horizon)
    )
    known = (walls > 0).astype(np.float32)
    total, weight = (outlook.smooth(m, _RELAXED) for m in (walls, known))
    standing = total / np.maximum(weight, _LEAST)
    return np.maximum(ties.flat * walls + (1 - ties.flat) * standing, outlook.nearness(outlook.plane_m))


def estimate_depth(
    image: Array, ground: Tensor, camera: Camera, ties: DepthConstraints, network: DepthNet | None = None
) -> Array:
    """Depth (H, W) m along the optical axis of what a picture without vehicles shows, inf in the sky.

    image (H, W, 3) RGB float32 in [0, 1]; ground (4,): plane n.x + d = 0, n up. network: instead of the shipped
    one. The network sees what stands where, the end of the ground tells how far that is: nearness by both is
    averaged, in logarithms. Nothing is farther than the ground that its ray meets.
    """
    outlook = GroundFrame.from_image(image, ground, camera)
    told, ruled = nearness_by_network(outlook, ties.flat, network), nearness_by_rule(outlook, ties)
    both = np.sqrt((told + _FAR_OFF) * (ruled + _FAR_OFF)) - _FAR_OFF
    level = outlook.nearness(outlook.plane_m)
    stood = cv2.GaussianBlur(ties.footprint, (0, 0), max(_BLURRED * float(camera.intrinsics[0, 0]), 0.5))
    nearness = level + np.maximum(both - level, 0) * (1 - ties.sky) * (1 - stood)
    behind = outlook.nearness(np.where(ties.behind_m > 0, ties.behind_m, np.float32(1e-3)))
    return outlook.depth_m(np.maximum(_no_nearer(nearness, behind), level))


def _no_nearer(nearness: Array, most: Array) -> Array:
    """Nearness (H, W), at most `most`; what is lowered lowers what is seen around it, or its border would show."""
    share = np.minimum(most / np.maximum(nearness, _LEAST), 1).astype(np.float32)
    if share.min() < 1:
        side = round(_AROUND * nearness.shape[1])
        least = cv2.erode(share, np.ones((2 * side + 1, 2 * side + 1), np.uint8))
        nearness = nearness * cv2.GaussianBlur(least, (0, 0), max(side / 3, 0.5))
    return np.minimum(nearness, most)
