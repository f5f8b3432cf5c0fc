"""Estimate vehicles' poses and sizes from a photograph and 2D boxes, with a small network and the ground plane.

The network sees the photograph around a box and the box's features. It predicts what the head of 3D-SDN does (Yao
et al., NeurIPS 2018, section 3.1): viewing angle as cosine and sine, offset of the projected centre, log sizes,
log depth, template. Two differences: the angle is relative to one of twelve bins (Mousavian et al., CVPR 2017), so
that "front or back?" is a choice and not an average, and the depth has an uncertainty. There is no deformation
code: labels have none, the silhouette fit finds its own, and shapes within a kind differ by less than a pixel of
the input.

The network's depths and those of the ground plane, estimated from all vehicles of the frame, are combined by their
variances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from scene_ir.derender.depth import CAMERA_HEIGHT_M
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.meshes.outlines import KINDS
from scene_ir.types import Camera, check_shape
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]

WEIGHTS = Path(__file__).parent / "weights" / "pose.safetensors"
"""The shipped weights, made by `tools/train_pose.py`."""
CROP_HW = (64, 96)
CONTEXT = 1.5
"""Side of the crop over side of the box."""
BINS = 12
"""Number of bins of the viewing angle, 30 degrees each, centred at multiples of 30 degrees."""
BOX_FEATURES = 9
"""Number of box features, see `box_features`."""
MEAN_LHW = {"Car": (4.07, 1.62, 1.68), "Truck": (9.97, 3.30, 2.55)}
"""Mean sizes, m, of cars with vans and of trucks with buses in generated streets; KITTI's are within 6 %."""
_SIZE_CLASS = {"Car": "Car", "Van": "Car", "Truck": "Truck"}
BORDER_PX = 2.0
"""A box this near to the image's border is cut by it."""
_MEAN, _SPREAD = 0.45, 0.27
"""Mean and standard deviation of photographs' values, about."""
LEVEL_SIZE = (-2.0, -2.6)
"""Typical log(width / focal) and log(height / focal)."""

_PRIOR = (0.02, 0.015, 0.15)
"""Standard deviations of the road's slope sideways and ahead, and of the camera's height, m."""
_KNOWN_PRIOR = (0.004, 0.003, 0.03)
"""The same for a plane that the caller knows."""
_MIN_SIGMA = 0.03
"""Least standard deviation of the network's log depth: it was trained on generated images only."""
_FOOT_PX, _FOOT_SHARE = 1.0, 0.02
"""Error of the row of a vehicle's foot: px, and share of its height in the image."""
_HUBER = 1.5
"""Standard deviations beyond which a vehicle pulls at the plane, or the plane at a vehicle, no harder."""


class PoseBlock(nn.Module):
    """3x3 convolution, normalisation, ReLU; residual if input and output have the same shape."""

    def __init__(self, channels: int, out: int, stride: int = 1) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, out, 3, stride=stride, padding=1, bias=False)
        self.normalisation = nn.BatchNorm2d(out)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.normalisation(self.convolution(x)))
        return x + y if self.residual else y


@dataclass(frozen=True, slots=True)
class PosePrediction:
    """The network's output for N boxes."""

    bins: Tensor
    """(N, 12), logits of the viewing angle's bins."""
    turn: Tensor
    """(N, 12, 2), unnormalised cosine and sine of the angle from each bin's centre."""
    offset: Tensor
    """(N, 2), projected 3D centre from the box's centre, in box sides."""
    size: Tensor
    """(N, 3), log length, height, width over the class's means."""
    depth: Tensor
    """(N,), log of the centre's depth over that of a vehicle of mean height."""
    log_sigma: Tensor
    """(N,), log of its standard deviation."""
    kind: Tensor
    """(N, 8), logits of `KINDS`."""


_HEAD_WIDTHS = (BINS, 2 * BINS, 2, 3, 1, 1, len(KINDS))


class PoseNet(nn.Module):
    """Crops (N, 3, 64, 96) RGB in [0, 1] and box features (N, 9) -> `PosePrediction`."""

    def __init__(self) -> None:
        super().__init__()
        layers = ((3, 16, 2), (16, 32, 2), (32, 32, 1), (32, 64, 2), (64, 64, 1), (64, 128, 2), (128, 128, 1))
        self.blocks = nn.Sequential(*(PoseBlock(*layer) for layer in layers))
        self.squeeze = nn.Conv2d(128, 40, 1)
        cells = 40 * (CROP_HW[0] // 16) * (CROP_HW[1] // 16)
        self.hidden = nn.Linear(cells + BOX_FEATURES, 160)
        self.out = nn.Linear(160 + BOX_FEATURES, sum(_HEAD_WIDTHS))

    def forward(self, crops: Tensor, numbers: Tensor) -> PosePrediction:
        x = ((crops - _MEAN) / _SPREAD).contiguous(memory_format=torch.channels_last)
        x = F.relu(self.squeeze(self.blocks(x))).flatten(1)
        x = F.relu(self.hidden(torch.cat([x, numbers], 1)))
        bins, turn, offset, size, depth, log_sigma, kind = self.out(torch.cat([x, numbers], 1)).split(
            _HEAD_WIDTHS, 1
        )
        return PosePrediction(
            bins, turn.reshape(-1, BINS, 2), offset, size, depth[:, 0], log_sigma[:, 0].clamp(-4.5, 0.5), kind
        )


@dataclass(frozen=True, slots=True)
class VehiclePoses:
    """N vehicles in camera axes, one per box."""

    translation: Tensor
    """(N, 3) m, bottom-face centre."""
    yaw: Tensor
    """(N,) rad in [-pi, pi)."""
    size_lhw: Tensor
    """(N, 3) m, length, height, width."""
    kind: tuple[str, ...]
    """N of `KINDS`."""
    log_depth_sigma: Tensor
    """(N,), standard deviation of the logarithm of the depth."""
    facing: Tensor
    """(N,) in [0.5, 1], probability that the front is not the rear."""
    ground: Tensor
    """(4,), plane n.x + d = 0 with n up."""


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> PoseNet:
    """The network of a weights file, in eval mode. Raises FormatError."""
    return load_frozen(PoseNet(), path)


def box_features(boxes_xyxy: Tensor, trucks: Tensor, cameras: Tensor) -> Tensor:
    """Compute the network's features of boxes.

    They are: centre from the principal point over focal length (2); log width and height over focal length, about
    their means (2); whether the image's border cuts the box left, above, right, below (4); whether it is a truck.

    Args:
        boxes_xyxy: (N, 4) px.
        trucks: (N,) bool.
        cameras: (N or 1, 6) from `camera_features`.

    Returns:
        (N, 9).
    """
    focal, principal, limit = cameras[:, :2], cameras[:, 2:4], cameras[:, 4:] - 1
    centre = ((boxes_xyxy[:, :2] + boxes_xyxy[:, 2:]) / 2 - principal) / focal
    size = torch.log((boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]) / focal) - boxes_xyxy.new_tensor(LEVEL_SIZE)
    cut = torch.cat([boxes_xyxy[:, :2] <= BORDER_PX, boxes_xyxy[:, 2:] >= limit - BORDER_PX], 1)
    return torch.cat([centre, size, cut.to(centre), trucks.to(centre)[:, None]], 1)


def camera_features(camera: Camera) -> Tensor:
    """Focal lengths, principal point, width and height of a camera, (1, 6) px."""
    k = camera.intrinsics.float()
    size = k.new_tensor([camera.width, camera.height])
    return torch.cat([k.diagonal()[:2], k[:2, 2], size])[None]


def is_truck(kinds: Sequence[str]) -> Tensor:
    """Whether each vehicle is a truck or bus, (N,) bool."""
    return torch.tensor([_SIZE_CLASS[kind] == "Truck" for kind in kinds], dtype=torch.bool)


def crop_boxes(
    image: NDArray[Any], boxes_xyxy: Array, size_hw: tuple[int, int] = CROP_HW, context: float = CONTEXT
) -> NDArray[Any]:
    """Crop and resize the image around boxes.

    Small crops of large boxes are taken from a halved (quartered, ...) image, so that no pixel is skipped.

    Args:
        image: (H, W, C) float32 or uint8; grey beyond its border.
        boxes_xyxy: (N, 4) px.
        size_hw: Height and width of the crops.
        context: Side of a crop over side of its box.

    Returns:
        (N, h, w, C).
    """
    height, width = size_hw
    halves = [image]
    out = np.zeros((len(boxes_xyxy), height, width, image.shape[2]), image.dtype)
    grey = 0.5 if image.dtype.kind == "f" else 128
    for i, (x0, y0, x1, y1) in enumerate(boxes_xyxy.astype(np.float64)):
        wide, high = context * (x1 - x0), context * (y1 - y0)
        level = max(int(math.log2(max(min(wide / width, high / height), 1.0))), 0)
        while len(halves) <= level and min(halves[-1].shape[:2]) >= 2:
            last = halves[-1]
            even = last[: last.shape[0] // 2 * 2, : last.shape[1] // 2 * 2]
            halves.append(cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA))
        level = min(level, len(halves) - 1)
        scale = 0.5**level
        # pixel centres are at integers: crop column j is image column left + (j + 1/2) * step
        step = np.array([wide / width, high / height])
        left = np.array([(x0 + x1 - wide) / 2, (y0 + y1 - high) / 2])
        start = (left + 0.5 * step + 0.5) * scale - 0.5
        to_image = np.array([[step[0] * scale, 0, start[0]], [0, step[1] * scale, start[1]]])
        crop = cv2.warpAffine(
            halves[level],
            to_image,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(grey, grey, grey),
        )
        out[i] = crop.reshape(out.shape[1:])
    return out


def mean_sizes(kinds: Sequence[str]) -> Tensor:
    """Mean length, height, width (N, 3) m of the vehicles' classes."""
    return torch.tensor([MEAN_LHW[_SIZE_CLASS[kind]] for kind in kinds], dtype=torch.float32).reshape(-1, 3)


def mean_depth(boxes_xyxy: Tensor, kinds: Sequence[str], camera: Camera) -> Tensor:
    """Depth at which a vehicle of mean height is as high as its box.

    Args:
        boxes_xyxy: (N, 4) px.
        kinds: N label types.
        camera: The photograph's camera.

    Returns:
        (N,) m.
    """
    return camera.intrinsics[1, 1] * mean_sizes(kinds)[:, 1] / (boxes_xyxy[:, 3] - boxes_xyxy[:, 1])


def mirror_features(numbers: Tensor) -> Tensor:
    """The features (N, 9) of boxes in the mirrored image."""
    turned = numbers[:, [0, 1, 2, 3, 6, 5, 4, 7, 8]].clone()
    turned[:, 0] = -turned[:, 0]
    return turned


def unmirror_prediction(prediction: PosePrediction) -> PosePrediction:
    """A prediction for mirrored images, converted to the original ones: angle a becomes pi - a."""
    bins = (BINS // 2 - torch.arange(BINS)) % BINS
    return PosePrediction(
        prediction.bins[:, bins],
        prediction.turn[:, bins] * prediction.turn.new_tensor([1.0, -1.0]),
        prediction.offset * prediction.offset.new_tensor([-1.0, 1.0]),
        prediction.size,
        prediction.depth,
        prediction.log_sigma,
        prediction.kind,
    )


def decode_viewing_angle(prediction: PosePrediction) -> tuple[Tensor, Tensor]:
    """The viewing angle alpha (N,) rad, and the confidence (N,) in [0.5, 1] in its direction.

    The likeliest bin and its neighbours, weighted by their probabilities; the confidence compares them with the
    bins half a turn away.
    """
    chance = prediction.bins.softmax(1)
    centre = torch.arange(BINS) * (2 * math.pi / BINS)
    angle = centre + torch.atan2(prediction.turn[..., 1], prediction.turn[..., 0])
    along = torch.arange(-1, 2)
    around = chance + chance.roll(1, 1) + chance.roll(-1, 1)
    best = around.argmax(1)
    near = (best[:, None] + along) % BINS
    weight = chance.gather(1, near)
    chosen = angle.gather(1, near)
    alpha = torch.atan2((weight * chosen.sin()).sum(1), (weight * chosen.cos()).sum(1))
    ahead = around.gather(1, best[:, None])[:, 0]
    behind = around.gather(1, ((best + BINS // 2) % BINS)[:, None])[:, 0]
    return alpha, ahead / (ahead + behind).clamp(min=1e-9)


def _predict_with_flip(network: PoseNet, crops: Tensor, numbers: Tensor) -> PosePrediction:
    """Mean prediction for boxes and their mirror images."""
    one = network(crops, numbers)
    other = unmirror_prediction(network(crops.flip(3), mirror_features(numbers)))
    return PosePrediction(
        torch.log(0.5 * (one.bins.softmax(1) + other.bins.softmax(1)) + 1e-9),
        F.normalize(one.turn, dim=-1) + F.normalize(other.turn, dim=-1),
        0.5 * (one.offset + other.offset),
        0.5 * (one.size + other.size),
        0.5 * (one.depth + other.depth),
        0.5 * (one.log_sigma + other.log_sigma),
        0.5 * (one.kind + other.kind),
    )


@torch.no_grad()
def estimate_poses(
    photograph: Tensor,
    boxes_xyxy: Tensor,
    kinds: Sequence[str],
    camera: Camera,
    ground: Tensor | None = None,
    network: PoseNet | None = None,
    rounds: int = 1,
) -> VehiclePoses:
    """Estimate poses and sizes of the vehicles in 2D boxes.

    Args:
        photograph: (3, H, W) RGB in [0, 1].
        boxes_xyxy: (N, 4) px.
        kinds: N of "Car", "Van", "Truck".
        camera: The photograph's camera.
        ground: Plane (4,) n.x + d = 0 with n up if known; otherwise estimated from the vehicles and a camera 1.65 m
            above a level road.
        network: In place of the shipped one.
        rounds: 1, or more for boxes that are not tight, such as a detector's: each further round uses the
            projected boxes of the previous one.

    Returns:
        N poses.

    Raises:
        ShapeError: An input has the wrong shape.
        RangeError: An unknown kind, a box without area, a plane that does not point up, or no rounds.
    """
    check_shape("photograph", photograph, 3, camera.height, camera.width)
    check_shape("boxes_xyxy", boxes_xyxy, None, 4)
    if len(kinds) != len(boxes_xyxy):
        raise ShapeError("kinds", f"{len(boxes_xyxy)}, one a box", len(kinds))
    for i, kind in enumerate(kinds):
        if kind not in _SIZE_CLASS:
            raise RangeError(f"kinds[{i}]", " or ".join(_SIZE_CLASS), repr(kind))
    boxes = boxes_xyxy.detach().cpu().float()
    if rounds < 1:
        raise RangeError("looks", "at least 1", rounds)
    for i, box in enumerate(boxes):
        if not bool(torch.isfinite(box).all() and (box[2:] > box[:2]).all()):
            raise RangeError(f"boxes_xyxy[{i}]", "finite, with an area", box.tolist())
    if ground is not None:
        check_shape("ground", ground, 4)
        if not bool(torch.isfinite(ground).all()) or float(ground[1]) >= 0:
            raise RangeError("ground", "a finite plane with n up", ground.tolist())
    if not len(boxes):
        plane, _ = fit_plane(np.zeros((0, 3)), np.zeros(0), *_ground_prior(ground))
        nothing = torch.zeros(0)
        return VehiclePoses(
            torch.zeros(0, 3), nothing, torch.zeros(0, 3), (), nothing, nothing, _plane_from_slopes(plane)
        )
    image = np.ascontiguousarray(photograph.detach().cpu().float().numpy().transpose(1, 2, 0))
    network = network or load_network()
    poses = _estimate_once(network, image, boxes, kinds, camera, ground)
    for _ in range(rounds - 1):
        found = project_boxes(poses.size_lhw, poses.yaw, poses.translation, camera.matrix.float())
        found = clip_boxes(found, camera.height, camera.width)
        tight = (found[:, 2:] - found[:, :2] >= 0.5 * (boxes[:, 2:] - boxes[:, :2])).all(1)
        boxes = torch.where(tight[:, None], found, boxes)
        poses = _estimate_once(network, image, boxes, kinds, camera, ground)
    return poses


def _estimate_once(
    network: PoseNet, image: Array, boxes: Tensor, kinds: Sequence[str], camera: Camera, ground: Tensor | None
) -> VehiclePoses:
    """Poses from boxes (N, 4) px as they are; image (H, W, 3)."""
    crops = torch.from_numpy(crop_boxes(image, boxes.numpy())).permute(0, 3, 1, 2)
    prediction = _predict_with_flip(network, crops, box_features(boxes, is_truck(kinds), camera_features(camera)))
    alpha, facing = decode_viewing_angle(prediction)
    size = mean_sizes(kinds) * prediction.size.exp()
    depth = mean_depth(boxes, kinds, camera) * prediction.depth.exp()
    sigma = prediction.log_sigma.exp().clamp(min=_MIN_SIGMA)
    centre_px = (boxes[:, :2] + boxes[:, 2:]) / 2 + prediction.offset * (boxes[:, 2:] - boxes[:, :2])
    centre = back_project(centre_px, depth, camera)
    foot = centre + size[:, 1:2] * torch.tensor([0.0, 0.5, 0.0])
    scale, sigma, plane = _scale_onto_ground(foot, size, sigma, camera, ground)
    translation = foot * scale[:, None]
    yaw = alpha + torch.atan2(translation[:, 0], translation[:, 2])
    return VehiclePoses(
        translation,
        (yaw + math.pi) % (2 * math.pi) - math.pi,
        size * scale[:, None],
        tuple(KINDS[int(i)] for i in prediction.kind.argmax(1)),
        sigma,
        facing,
        plane,
    )


def back_project(pixels: Tensor, depth: Tensor, camera: Camera) -> Tensor:
    """Points in camera axes at pixels with known depth.

    Args:
        pixels: (N, 2).
        depth: z (N,) m.
        camera: The photograph's camera.

    Returns:
        (N, 3) m.
    """
    p = camera.matrix.to(pixels)
    w = depth * p[2, 2] + p[2, 3]
    y = (pixels[:, 1] * w - p[1, 2] * depth - p[1, 3]) / p[1, 1]
    x = (pixels[:, 0] * w - p[0, 2] * depth - p[0, 3] - p[0, 1] * y) / p[0, 0]
    return torch.stack([x, y, depth], 1)


def _ground_prior(ground: Tensor | None) -> tuple[np.ndarray, np.ndarray]:
    """Expected slopes and height (3,) of the plane, and their standard deviations (3,)."""
    if ground is None:
        return np.array([0.0, 0.0, CAMERA_HEIGHT_M]), np.array(_PRIOR)
    n = ground.double().cpu().numpy()
    return -n[[0, 2, 3]] / n[1], np.array(_KNOWN_PRIOR)


def _plane_from_slopes(plane: np.ndarray) -> Tensor:
    """Plane (4,) n.x + d = 0 of slopes and height (3,)."""
    normal = np.array([plane[0], -1.0, plane[1], plane[2]])
    return torch.from_numpy((normal / np.linalg.norm(normal[:3])).astype(np.float32))


def fit_plane(
    points: np.ndarray, sigma: np.ndarray, expected: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the plane y = a x + b z + c by iterated least squares with Huber weights.

    Args:
        points: (N, 3) m.
        sigma: Standard deviation (N,) m of each point's height above the plane.
        expected: Prior a, b, c (3,).
        spread: Its standard deviations (3,).

    Returns:
        a, b, c (3,) and their covariance (3, 3).
    """
    design = np.stack([points[:, 0], points[:, 2], np.ones(len(points))], 1) / sigma[:, None]
    goal = points[:, 1] / sigma
    prior = np.diag(1 / spread)
    plane = expected.copy()
    weight = np.ones(len(points))
    precision = prior**2
    for _ in range(8):
        weight = _HUBER / np.maximum(np.abs(design @ plane - goal), _HUBER)
        precision = (design * weight[:, None]).T @ design + prior**2
        plane = np.linalg.solve(precision, (design * weight[:, None]).T @ goal + prior**2 @ expected)
    return plane, np.linalg.inv(precision)


def _scale_onto_ground(
    foot: Tensor, size: Tensor, sigma: Tensor, camera: Camera, ground: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Scale each vehicle's distance and size, which keeps its image, so that it stands on the ground.

    Each vehicle is compared with the plane of the others, so that no estimate counts twice.

    Returns the scales (N,), the standard deviation (N,) of the log depth afterwards, and the plane (4,). `foot` is
    (N, 3) m.
    """
    points, spread = foot.double().numpy(), sigma.double().numpy()
    known = _ground_prior(ground)
    above = np.maximum(np.abs(points[:, 1]), 0.5) * spread
    rows = _FOOT_PX + _FOOT_SHARE * float(camera.intrinsics[1, 1]) * size[:, 1].numpy() / points[:, 2]
    foot_m = rows * points[:, 2] / float(camera.intrinsics[1, 1])
    scale, left = np.ones(len(points)), spread.copy()
    for i, point in enumerate(points):
        others = np.arange(len(points)) != i
        plane, covariance = fit_plane(points[others], np.hypot(above, foot_m)[others], *known)
        at = np.array([point[0], point[2], 1.0])
        slope = point[1] - plane[0] * point[0] - plane[1] * point[2]
        if slope <= 0.1:
            continue  # above the horizon: not on this plane
        farther = math.log(plane[2] / slope)
        doubt = math.sqrt(at @ covariance @ at + foot_m[i] ** 2) / max(plane[2], 0.5)
        # a contradiction larger than both errors is a kerb, a hill or a cut box
        trust = min(1.0, _HUBER / max(abs(farther) / math.hypot(doubt, spread[i]), 1e-9)) ** 4
        own, its = 1 / spread[i] ** 2, trust / doubt**2
        scale[i] = math.exp(farther * its / (own + its))
        left[i] = (own + its) ** -0.5
    plane, _ = fit_plane(points * scale[:, None], np.hypot(above, foot_m), *known)
    return torch.from_numpy(scale).float(), torch.from_numpy(left).float(), _plane_from_slopes(plane)
