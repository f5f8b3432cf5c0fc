"""Where a labelled car stands, by the sides of its 2D box: the label moved as little as the box asks for.

A hand-drawn 2D box is tight to a pixel or a few, a hand-drawn 3D box is off by decimetres and degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from scene_ir.derender.silhouette import LabelBoxes, Placement
from scene_ir.meshes.lod import detail
from scene_ir.types import Camera, Mesh

_STEPS = 6
_DELTA = 1e-3
"""Of the differences that stand for derivatives, in standard deviations."""
_DETAIL_PX = 90.0
"""Height for which a mesh's triangles count where a border cuts it: finer ones move no side by half a pixel."""
_NEAR_M = 0.5
"""What is nearer projects anywhere; such boxes are cut by the image's border anyway."""


@dataclass(frozen=True, slots=True)
class BoxAlignmentSettings:
    """Standard deviations of labels: shift_m along and across the view, lift_m, turn_rad, stretch of each size; of
    a box's side, side_px plus side_share of the box's height. robust: standard deviations from which on a side
    pulls no harder. reach: bounds of the change, in standard deviations.
    """

    shift_m: float = 0.15
    lift_m: float = 0.02
    turn_rad: float = 0.08
    stretch: float = 0.05
    side_px: float = 1.0
    side_share: float = 0.01
    robust: float = 4.0
    reach: float = 2.0


def align_to_boxes(
    placements: Sequence[Placement],
    boxes: LabelBoxes,
    camera: Camera,
    settings: BoxAlignmentSettings | None = None,
) -> tuple[list[Placement], NDArray[np.float64]]:
    """Each placement at the likeliest pose and size given its label and its box, and what that costs (N,), half a
    squared standard deviation as the unit.

    A robust Gauss-Newton of seven numbers with the four sides as data and the label as prior.
    """
    settings = settings or BoxAlignmentSettings()
    settled, costs = [], np.zeros(len(placements))
    shapes: dict[int, _Shape] = {}
    for i, (placement, box, trust) in enumerate(zip(placements, boxes.xyxy, boxes.trust, strict=True)):
        shape = shapes.get(id(placement.mesh)) or _Shape.of(placement.mesh)
        shapes[id(placement.mesh)] = shape
        sides = box.double().numpy(), trust.double().numpy()
        code, costs[i] = _solve(placement, shape, sides, camera, settings)
        settled.append(_moved(placement, code * _spread(settings)))
    return settled, costs


def _extent(
    clip: NDArray[np.float64], edges: NDArray[np.int64], camera: Camera, otherwise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Box xyxy (4,) px of what lies inside the image of a mesh with vertices (3, V) and edges (E, 2);
    `otherwise` where nothing does."""
    planes = _planes(clip, camera)
    if (planes >= 0).all():
        points = clip
    else:
        # What lies inside counts; of edges, those that cross a border, and none that is beyond one as a whole.
        beyond = (planes < 0).T @ (1 << np.arange(len(planes)))
        a, b = beyond[edges].T
        edges = edges[((a | b) > 0) & ((a & b) == 0)]
        # Liang and Barsky 1984: what every half-space leaves of each edge.
        first, second = planes[:, edges[:, 0]], planes[:, edges[:, 1]]
        across = second - first
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = np.where(across != 0, -first / across, 0.0)
        start = np.where(first < 0, np.where(across > 0, cut, 2.0), 0.0).max(0)
        end = np.where(second < 0, np.where(across < 0, cut, -1.0), 1.0).min(0)
        left = start <= end
        if not left.any() and beyond.all():
            return otherwise
        a, b = clip[:, edges[left, 0]], clip[:, edges[left, 1]]
        points = np.concatenate([clip[:, beyond == 0], a + start[left] * (b - a), a + end[left] * (b - a)], 1)
    return _bounds(points)


def _planes(clip: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """How far (5, V) points lie inside the near plane and the image's four sides; negative beyond."""
    right, low = camera.width - 1.0, camera.height - 1.0
    u, v, w = clip
    return np.stack([w - _NEAR_M, u, right * w - u, v, low * w - v])


def _bounds(clip: NDArray[np.float64]) -> NDArray[np.float64]:
    pixels = clip[:2] / clip[2]
    return np.concatenate([pixels.min(1), pixels.max(1)])


def _spread(s: BoxAlignmentSettings) -> NDArray[np.float64]:
    return np.array([s.shift_m, s.lift_m, s.shift_m, s.turn_rad, s.stretch, s.stretch, s.stretch])


def _moved(placement: Placement, change: NDArray[np.float64]) -> Placement:
    """The placement after a change of x, y, z (m), yaw (rad), and the logarithms of length, height, width."""
    step = torch.from_numpy(change).to(placement.yaw)
    return replace(
        placement,
        translation=placement.translation + step[:3],
        yaw=placement.yaw + step[3],
        size_lhw=placement.size_lhw * torch.exp(step[4:]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    """Of a mesh: vertices (V, 3) and edges (E, 2) of its triangles, some left out; the vertices of its hull
    (K, 3), a tenth of them, which tell how far a car reaches that lies inside the image."""

    vertices: NDArray[np.float64]
    edges: NDArray[np.int64]
    hull: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: Mesh) -> _Shape:
        vertices, light = mesh.vertices.double().numpy(), detail(mesh, _DETAIL_PX)
        faces = light.faces.numpy()
        edges = np.concatenate([faces[:, :2], faces[:, 1:]])
        return cls(light.vertices.double().numpy(), edges, vertices[ConvexHull(vertices).vertices])


def _solve(
    placement: Placement,
    shape: _Shape,
    sides: tuple[NDArray[np.float64], NDArray[np.float64]],
    camera: Camera,
    settings: BoxAlignmentSettings,
) -> tuple[NDArray[np.float64], float]:
    """sides: the box (4,) px, and the trust in each of its sides (4,)."""
    box, trust = sides
    matrix = camera.matrix.double().numpy()
    place, yaw = placement.translation.double().numpy(), float(placement.yaw)
    size = placement.size_lhw.double().numpy()
    spread = _spread(settings)
    sigma = settings.side_px + settings.side_share * (box[3] - box[1])

    def residual(code: NDArray[np.float64]) -> NDArray[np.float64]:
        change = code * spread
        cos, sin = np.cos(yaw + change[3]), np.sin(yaw + change[3])

        def clip(points: NDArray[np.float64]) -> NDArray[np.float64]:
            local = points * (size * np.exp(change[4:]))
            x = cos * local[:, 0] + sin * local[:, 2] + place[0] + change[0]
            z = cos * local[:, 2] - sin * local[:, 0] + place[2] + change[2]
            return matrix @ np.stack([x, local[:, 1] + place[1] + change[1], z, np.ones_like(x)])

        around = clip(shape.hull)
        if (_planes(around, camera) >= 0).all():
            found = _bounds(around)
        else:
            found = _extent(clip(shape.vertices), shape.edges, camera, box)
        return trust * (found - box) / sigma

    code = np.zeros(7)
    r = residual(code)
    for _ in range(_STEPS):
        slopes = np.stack([(residual(code + _DELTA * e) - r) / _DELTA for e in np.eye(7)], 1)
        weight = np.minimum(1.0, settings.robust / np.maximum(np.abs(r), 1e-9))
        normal = slopes.T @ (weight[:, None] * slopes) + np.eye(7)
        step = -np.linalg.solve(normal, slopes.T @ (weight * r) + code)
        code = np.clip(code + step, -settings.reach, settings.reach)
        r = residual(code)
    k = settings.robust
    size_r = np.abs(r)
    data = np.where(size_r < k, r * r, 2 * k * size_r - k * k).sum()
    return code, float((data + code @ code) / 2)
