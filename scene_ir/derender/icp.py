"""Fit a vehicle's mesh to laser points: iterative closest points with point-to-plane errors (Chen and Medioni
1991).

Open3D's registration moves rigid bodies in all six directions. A car on its wheels turns about one axis, its size
is not known to the centimetre, and its label gives a prior: a k-d tree and a least-squares step of seven numbers
do.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from scene_ir.derender.silhouette import Placement
from scene_ir.types import Camera, Mesh

Array = NDArray[np.float64]

LABEL_SIGMAS = np.array([0.3, 0.05, 0.3, 0.1, 0.05, 0.05, 0.05])
"""Standard deviations of a label: x, y, z in m, yaw in rad, logarithms of length, height, width."""
BOUND = 2.0
"""Largest change, in these standard deviations."""
_MARGIN_M = 0.35
"""Points this far outside the label's box may be the car's."""
_POINT_M = 0.06
"""Standard deviation of a point's distance from the mesh."""
_REACH_M = 0.5
"""Points farther than this from the mesh belong to something else; shrinks to 3 `_POINT_M` while the fit
converges."""
_INDEPENDENT = 80
"""Neighbouring points have correlated errors: all points together weigh at most as much as this many."""
_SAMPLES = 4000
"""Points sampled on the mesh: 8 cm apart on a car."""
_STEPS = 15
_CONVERGED = 1e-4
"""Step, in standard deviations, below which the fit stops."""
_GROUND_M = 0.2
"""Points below this height above the label's ground are the road's."""
_MIN_POINTS = 25
"""Fewer points do not determine a car's sides."""


def points_near_box(placement: Placement, points: Tensor) -> Array:
    """The points (K, 3) m, of (P, 3), inside the placement's box with a margin and above its ground."""
    cloud = points.double().cpu().numpy() - placement.translation.double().numpy()
    length, height, width = placement.size_lhw.double().tolist()
    cos, sin = np.cos(float(placement.yaw)), np.sin(float(placement.yaw))
    along, across = cos * cloud[:, 0] - sin * cloud[:, 2], sin * cloud[:, 0] + cos * cloud[:, 2]
    inside = (np.abs(along) < length / 2 + _MARGIN_M) & (np.abs(across) < width / 2 + _MARGIN_M)
    inside &= (cloud[:, 1] < -_GROUND_M) & (cloud[:, 1] > -height - _MARGIN_M)
    return points.double().cpu().numpy()[inside]


def align_to_points(placement: Placement, points: Tensor, camera: Camera) -> Placement | None:
    """Move, turn and stretch a placement until its surface meets the laser points in its box.

    Args:
        placement: The mesh at its label.
        points: Laser points (P, 3) m in camera axes.
        camera: Points are matched only with surface that faces it.

    Returns:
        The fitted placement; None if there are too few points.
    """
    cloud = points_near_box(placement, points)
    if len(cloud) < _MIN_POINTS:
        return None
    unit, normal = _sample_surface(placement.mesh)
    matrix = camera.matrix.double().numpy()
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    place, yaw = placement.translation.double().numpy(), float(placement.yaw)
    size = placement.size_lhw.double().numpy()
    code = np.zeros(7)
    for step in range(_STEPS):
        change = code * LABEL_SIGMAS
        stretched = size * np.exp(change[4:])
        rotation, derivative = _yaw_rotation(yaw + change[3])
        surface = unit * stretched @ rotation.T + place + change[:3]
        facing = normal / stretched @ rotation.T
        facing /= np.linalg.norm(facing, axis=1, keepdims=True)
        visible = np.nonzero(((surface - eye) * facing).sum(1) < 0)[0]
        if not len(visible):
            return None
        distance, nearest = (np.asarray(found) for found in KDTree(surface[visible]).query(cloud))
        reach = max(_REACH_M * 0.75**step, 3 * _POINT_M)
        near = distance < reach
        if np.count_nonzero(near) < _MIN_POINTS:
            return None
        matched = visible[nearest[near]]
        plane = facing[matched]
        residual = ((surface[matched] - cloud[near]) * plane).sum(1)
        local = unit[matched] * stretched
        slopes = np.empty((len(matched), 7))
        slopes[:, :3] = plane
        slopes[:, 3] = (local @ derivative.T * plane).sum(1)
        slopes[:, 4:] = (plane @ rotation) * local
        slopes *= LABEL_SIGMAS
        # Huber's weights: a wrong match pulls, but not with its full distance
        weight = _POINT_M / np.maximum(np.abs(residual), _POINT_M)
        weight *= min(1.0, _INDEPENDENT / len(matched)) / _POINT_M**2
        precision = (slopes * weight[:, None]).T @ slopes + np.eye(7)
        move = -np.linalg.solve(precision, (slopes * weight[:, None]).T @ residual + code)
        code = np.clip(code + move, -BOUND, BOUND)
        if np.abs(move).max() < _CONVERGED and reach <= 3 * _POINT_M:
            break
    return placement.adjusted(torch.from_numpy(code * LABEL_SIGMAS))


def _sample_surface(mesh: Mesh) -> tuple[Array, Array]:
    """Points (S, 3) spread over a mesh in its unit box, and the unnormalised normals (S, 3) there."""
    corners = mesh.vertices.double().numpy()[mesh.faces.numpy()]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    total = np.cumsum(area)
    rng = np.random.default_rng(0)
    face = np.searchsorted(total, (np.arange(_SAMPLES) + 0.5) / _SAMPLES * total[-1])
    first, second = rng.random((2, _SAMPLES, 1))
    flip = first + second > 1
    first, second = np.where(flip, 1 - first, first), np.where(flip, 1 - second, second)
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + first * (b - a) + second * (c - a), normal[face] / np.maximum(area[face, None], 1e-12)


def _yaw_rotation(yaw: float) -> tuple[Array, Array]:
    """Rotation (3, 3) about the camera's y axis, and its derivative (3, 3) by the yaw."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return rotation, np.array([[-sin, 0, cos], [0, 0, 0], [-cos, 0, -sin]])
