"""A car's mesh brought to the laser's points on it: iterative closest points, to planes (Chen and Medioni 1991).

Open3D's registration moves rigid bodies in all six directions; a car on its wheels turns in one, its size is not
known to the centimetre, and its label says where to look. A k-d tree and a least-squares step of eight numbers do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from scene_ir.derender.silhouette import Placement
from scene_ir.types import Camera, Mesh

_SAMPLES = 4000
"""Points on a mesh that a laser's point may belong to: 8 cm apart on a car."""
_STEPS = 15
_CONVERGED = 1e-4
"""Of a step, in standard deviations, at which nothing more happens."""
_GROUND_M = 0.2
"""Height above the label's ground up to which points are the road's."""
_FEW = 25
"""With fewer points a car's sides cannot be told."""


@dataclass(frozen=True, slots=True)
class IcpSettings:
    """grow_m: how far around the label's box points may be the car's. Standard deviations of the label: shift_m on
    the ground, lift_m, turn_rad, stretch of each size; of a point from the mesh: point_m. Points farther than
    reach_m from the mesh, which falls to point_m * 3 while it comes near, belong to something else. independent:
    neighbouring points err alike; how many at most count as one opinion each. bound: of the change, in standard
    deviations.
    """

    grow_m: float = 0.35
    shift_m: float = 0.3
    lift_m: float = 0.05
    turn_rad: float = 0.1
    stretch: float = 0.05
    point_m: float = 0.06
    reach_m: float = 0.5
    independent: int = 80
    bound: float = 2.0


def points_near_box(
    placement: Placement, points: Tensor, settings: IcpSettings | None = None
) -> NDArray[np.float64]:
    """Of points (P, 3) m those in the placement's box, grown, and above the ground it stands on, (K, 3)."""
    settings = settings or IcpSettings()
    cloud = points.double().cpu().numpy() - placement.translation.double().numpy()
    length, height, width = placement.size_lhw.double().tolist()
    cos, sin = np.cos(float(placement.yaw)), np.sin(float(placement.yaw))
    along, across = cos * cloud[:, 0] - sin * cloud[:, 2], sin * cloud[:, 0] + cos * cloud[:, 2]
    kept = (np.abs(along) < length / 2 + settings.grow_m) & (np.abs(across) < width / 2 + settings.grow_m)
    kept &= (cloud[:, 1] < -_GROUND_M) & (cloud[:, 1] > -height - settings.grow_m)
    return points.double().cpu().numpy()[kept]


def align_to_points(
    placement: Placement, points: Tensor, camera: Camera, settings: IcpSettings | None = None
) -> Placement | None:
    """The placement moved, turned and stretched so that its surface meets the laser's points (P, 3) m inside its
    box; None where there are too few."""
    settings = settings or IcpSettings()
    cloud = points_near_box(placement, points, settings)
    if len(cloud) < _FEW:
        return None
    unit, normal = _surface(placement.mesh)
    matrix = camera.matrix.double().numpy()
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    place, yaw = placement.translation.double().numpy(), float(placement.yaw)
    size = placement.size_lhw.double().numpy()
    s = settings
    spread = np.array([s.shift_m, s.lift_m, s.shift_m, s.turn_rad, s.stretch, s.stretch, s.stretch])
    code = np.zeros(7)
    for step in range(_STEPS):
        change = code * spread
        stretched = size * np.exp(change[4:])
        turn = _turn(yaw + change[3])
        surface = unit * stretched @ turn.T + place + change[:3]
        facing = normal / stretched @ turn.T
        facing /= np.linalg.norm(facing, axis=1, keepdims=True)
        shown = np.nonzero(((surface - eye) * facing).sum(1) < 0)[0]
        if not len(shown):
            return None
        distance, index = KDTree(surface[shown]).query(cloud)
        far, nearest = np.asarray(distance), np.asarray(index)
        reach = max(settings.reach_m * 0.75**step, 3 * settings.point_m)
        near = far < reach
        if np.count_nonzero(near) < _FEW:
            return None
        at = shown[nearest[near]]
        plane = facing[at]
        residual = ((surface[at] - cloud[near]) * plane).sum(1)
        local = unit[at] * stretched
        slopes = np.empty((len(at), 7))
        slopes[:, :3] = plane
        slopes[:, 3] = (local @ _turned(yaw + change[3]).T * plane).sum(1)
        slopes[:, 4:] = (plane @ turn) * local
        slopes *= spread
        # Huber's weights; what is left of a wrong match pulls, but not with all its length
        weight = settings.point_m / np.maximum(np.abs(residual), settings.point_m)
        weight *= min(1.0, settings.independent / len(at)) / settings.point_m**2
        precision = (slopes * weight[:, None]).T @ slopes + np.eye(7)
        move = -np.linalg.solve(precision, (slopes * weight[:, None]).T @ residual + code)
        code = np.clip(code + move, -settings.bound, settings.bound)
        if np.abs(move).max() < _CONVERGED and reach <= 3 * settings.point_m:
            break
    found = torch.from_numpy(code * spread).to(placement.yaw)
    return replace(
        placement,
        translation=placement.translation + found[:3],
        yaw=placement.yaw + found[3],
        size_lhw=placement.size_lhw * torch.exp(found[4:]),
    )


def _surface(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (S, 3) spread over a mesh in its unit box, and the normals there, of any length."""
    corners = mesh.vertices.double().numpy()[mesh.faces.numpy()]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    reached = np.cumsum(area)
    rng = np.random.default_rng(0)
    face = np.searchsorted(reached, (np.arange(_SAMPLES) + 0.5) / _SAMPLES * reached[-1])
    first, second = rng.random((2, _SAMPLES, 1))
    flip = first + second > 1
    first, second = np.where(flip, 1 - first, first), np.where(flip, 1 - second, second)
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + first * (b - a) + second * (c - a), normal[face] / np.maximum(area[face, None], 1e-12)


def _turn(yaw: float) -> NDArray[np.float64]:
    """Rotation (3, 3) about the camera's y axis."""
    return np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])


def _turned(yaw: float) -> NDArray[np.float64]:
    """The derivative (3, 3) of `_turn` by the yaw."""
    return np.array([[-np.sin(yaw), 0, np.cos(yaw)], [0, 0, 0], [-np.cos(yaw), 0, -np.sin(yaw)]])
