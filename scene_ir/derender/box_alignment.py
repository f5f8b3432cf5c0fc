"""Align labelled vehicles with the sides of their 2D boxes, moving each label as little as its box requires.

A hand-drawn 2D box is tight to a few pixels; a hand-drawn 3D box is off by decimetres and degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from scene_ir.derender.silhouette import LabelBoxes, Placement
from scene_ir.meshes.lod import level_of_detail
from scene_ir.types import Camera, Mesh

Array = NDArray[np.float64]

_STEPS = 6
_DELTA = 1e-3
"""Step of the finite differences, in standard deviations."""
_DETAIL_PX = 90.0
"""Height that selects a mesh's level of detail if a border cuts it: finer triangles move no side by half a
pixel."""
_NEAR_M = 0.5
"""Near plane. Nearer points project anywhere; the image's border cuts such boxes anyway."""


@dataclass(frozen=True, slots=True)
class BoxAlignmentSettings:
    """Standard deviations of labels and box sides, and bounds of the change."""

    shift_m: float = 0.15
    """Of the position along and across the view, m."""
    lift_m: float = 0.02
    """Of the height, m."""
    turn_rad: float = 0.08
    """Of the yaw, rad."""
    stretch: float = 0.05
    """Of the logarithm of each size."""
    side_px: float = 1.0
    """Of a box's side, px, plus `side_share` of the box's height."""
    side_share: float = 0.01
    """See `side_px`."""
    robust: float = 4.0
    """Standard deviations beyond which a side pulls no harder."""
    reach: float = 2.0
    """Largest change, in standard deviations."""

    def label_sigmas(self) -> Array:
        """Standard deviations (7,) of x, y, z, yaw and the logarithms of length, height, width."""
        shift, stretch = self.shift_m, self.stretch
        return np.array([shift, self.lift_m, shift, self.turn_rad, stretch, stretch, stretch])


def align_to_boxes(
    placements: Sequence[Placement],
    boxes: LabelBoxes,
    camera: Camera,
    settings: BoxAlignmentSettings | None = None,
) -> list[Placement]:
    """Move each placement to the likeliest pose and size given its label and its 2D box.

    A robust Gauss-Newton method over seven numbers, with the four sides as data and the label as prior.

    Args:
        placements: N meshes at their labels.
        boxes: The N labels' 2D boxes.
        camera: The photograph's camera.
        settings: Standard deviations and bounds.

    Returns:
        N placements.
    """
    settings = settings or BoxAlignmentSettings()
    aligned = []
    shapes: dict[int, _MeshShape] = {}
    for placement, box, trust in zip(placements, boxes.xyxy, boxes.trust, strict=True):
        shape = shapes.get(id(placement.mesh)) or _MeshShape.from_mesh(placement.mesh)
        shapes[id(placement.mesh)] = shape
        code = _solve_pose(placement, shape, (box.double().numpy(), trust.double().numpy()), camera, settings)
        aligned.append(placement.adjusted(torch.from_numpy(code * settings.label_sigmas())))
    return aligned


@dataclass(frozen=True, slots=True, eq=False)
class _MeshShape:
    """The parts of a mesh that determine its extent in the image."""

    vertices: Array
    """(V, 3), with few triangles."""
    edges: NDArray[np.int64]
    """(E, 2), two of each triangle's three."""
    hull: Array
    """(K, 3) vertices of the full mesh's convex hull, a tenth of them: enough for a car inside the image."""

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> _MeshShape:
        vertices, light = mesh.vertices.double().numpy(), level_of_detail(mesh, _DETAIL_PX)
        faces = light.faces.numpy()
        edges = np.concatenate([faces[:, :2], faces[:, 1:]])
        return cls(light.vertices.double().numpy(), edges, vertices[ConvexHull(vertices).vertices])


def _solve_pose(
    placement: Placement,
    shape: _MeshShape,
    sides: tuple[Array, Array],
    camera: Camera,
    settings: BoxAlignmentSettings,
) -> Array:
    """The change (7,), in standard deviations. sides: the box (4,) px, and the trust in each of its sides (4,)."""
    box, trust = sides
    matrix = camera.matrix.double().numpy()
    place, yaw = placement.translation.double().numpy(), float(placement.yaw)
    size = placement.size_lhw.double().numpy()
    sigmas = settings.label_sigmas()
    sigma = settings.side_px + settings.side_share * (box[3] - box[1])

    def residual(code: Array) -> Array:
        change = code * sigmas
        cos, sin = np.cos(yaw + change[3]), np.sin(yaw + change[3])

        def project(points: Array) -> Array:
            local = points * (size * np.exp(change[4:]))
            x = cos * local[:, 0] + sin * local[:, 2] + place[0] + change[0]
            z = cos * local[:, 2] - sin * local[:, 0] + place[2] + change[2]
            return matrix @ np.stack([x, local[:, 1] + place[1] + change[1], z, np.ones_like(x)])

        hull = project(shape.hull)
        if (_frustum_distances(hull, camera) >= 0).all():
            extent = _pixel_bounds(hull)
        else:
            extent = _clipped_bounds(project(shape.vertices), shape.edges, camera, box)
        return trust * (extent - box) / sigma

    code = np.zeros(7)
    r = residual(code)
    for _ in range(_STEPS):
        slopes = np.stack([(residual(code + _DELTA * e) - r) / _DELTA for e in np.eye(7)], 1)
        weight = np.minimum(1.0, settings.robust / np.maximum(np.abs(r), 1e-9))
        normal = slopes.T @ (weight[:, None] * slopes) + np.eye(7)
        step = -np.linalg.solve(normal, slopes.T @ (weight * r) + code)
        code = np.clip(code + step, -settings.reach, settings.reach)
        r = residual(code)
    return code


def _clipped_bounds(clip: Array, edges: NDArray[np.int64], camera: Camera, default: Array) -> Array:
    """Box xyxy (4,) px of the part inside the image of a mesh, vertices (3, V) and edges (E, 2), or `default`."""
    planes = _frustum_distances(clip, camera)
    if (planes >= 0).all():
        return _pixel_bounds(clip)
    # Only edges that cross a border, and are not wholly beyond one, contribute besides the vertices inside.
    beyond = (planes < 0).T @ (1 << np.arange(len(planes)))
    a, b = beyond[edges].T
    edges = edges[((a | b) > 0) & ((a & b) == 0)]
    # Liang and Barsky 1984: the part of each edge inside every half-space.
    first, second = planes[:, edges[:, 0]], planes[:, edges[:, 1]]
    across = second - first
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.where(across != 0, -first / across, 0.0)
    start = np.where(first < 0, np.where(across > 0, cut, 2.0), 0.0).max(0)
    end = np.where(second < 0, np.where(across < 0, cut, -1.0), 1.0).min(0)
    inside = start <= end
    if not inside.any() and beyond.all():
        return default
    a, b = clip[:, edges[inside, 0]], clip[:, edges[inside, 1]]
    ends = a + start[inside] * (b - a), a + end[inside] * (b - a)
    return _pixel_bounds(np.concatenate([clip[:, beyond == 0], *ends], 1))


def _frustum_distances(clip: Array, camera: Camera) -> Array:
    """Distances (5, V) of points inside the near plane and the image's four sides; negative outside."""
    right, low = camera.width - 1.0, camera.height - 1.0
    u, v, w = clip
    return np.stack([w - _NEAR_M, u, right * w - u, v, low * w - v])


def _pixel_bounds(clip: Array) -> Array:
    pixels = clip[:2] / clip[2]
    return np.concatenate([pixels.min(1), pixels.max(1)])
