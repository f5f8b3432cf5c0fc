"""Align labelled vehicles with the sides of their 2D boxes, moving each label as little as its box requires.

A hand-drawn 2D box is tight to a few pixels; a hand-drawn 3D box is off by decimetres and degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree
from torch import Tensor

from scene_ir.derender.silhouette import LabelBoxes, Mask, Placement, measure_edge_distances, render_silhouettes
from scene_ir.meshes.lod import SameMesh, level_of_detail
from scene_ir.raster import verbs
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
    boxes: LabelBoxes | None,
    camera: Camera,
    settings: BoxAlignmentSettings | None = None,
) -> list[Placement]:
    """Move each placement to the likeliest pose and size given its label and its 2D box.

    A robust Gauss-Newton method over seven numbers, with the four sides as data and the label as prior.

    Args:
        placements: N meshes at their labels.
        boxes: The N labels' 2D boxes; None if their sides cannot be trusted, which moves nothing.
        camera: The photograph's camera.
        settings: Standard deviations and bounds.

    Returns:
        N placements.
    """
    settings = settings or BoxAlignmentSettings()
    if boxes is None:
        return list(placements)
    aligned = []
    for placement, box, trust in zip(placements, boxes.xyxy, boxes.trust, strict=True):
        shape = _mesh_shape(SameMesh(placement.mesh))
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


@lru_cache(maxsize=64)
def _mesh_shape(key: SameMesh) -> _MeshShape:
    mesh = key.mesh
    vertices, light = mesh.vertices.double().numpy(), level_of_detail(mesh, _DETAIL_PX)
    faces = light.faces.numpy()
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    return _MeshShape(light.vertices.double().numpy(), edges, vertices[ConvexHull(vertices).vertices])


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

    def residuals(codes: Array) -> Array:
        """Of K codes (K, 7): (K, 4)."""
        change = codes * sigmas
        cos, sin = np.cos(yaw + change[:, 3:4]), np.sin(yaw + change[:, 3:4])

        def project(points: Array) -> Array:
            """Points (V, 3) to (K, 3, V)."""
            stretch = size * np.exp(change[:, 4:])
            local = [points[:, axis] * stretch[:, axis : axis + 1] for axis in range(3)]
            x = cos * local[0] + sin * local[2] + place[0] + change[:, :1]
            z = cos * local[2] - sin * local[0] + place[2] + change[:, 2:3]
            y = local[1] + place[1] + change[:, 1:2]
            return matrix[:, :3] @ np.stack([x, y, z], 1) + matrix[:, 3:]

        hull = project(shape.hull)
        inside = (_frustum_distances(hull, camera) >= 0).all((1, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            extents = _pixel_bounds(hull)
        if not inside.all():
            whole = project(shape.vertices)
            for k in np.flatnonzero(~inside):
                extents[k] = _clipped_bounds(whole[k], shape.edges, camera, box)
        return trust * (extents - box) / sigma

    code = np.zeros(7)
    for _ in range(_STEPS):
        r, *moved = residuals(code + _DELTA * np.eye(8, 7, -1))
        slopes = (np.stack(moved, 1) - r[:, None]) / _DELTA
        weight = np.minimum(1.0, settings.robust / np.maximum(np.abs(r), 1e-9))
        normal = slopes.T @ (weight[:, None] * slopes) + np.eye(7)
        step = -np.linalg.solve(normal, slopes.T @ (weight * r) + code)
        code = np.clip(code + step, -settings.reach, settings.reach)
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
    """Distances (..., 5, V) of points (..., 3, V) inside the near plane and the image's four sides; negative
    outside.
    """
    right, low = camera.width - 1.0, camera.height - 1.0
    u, v, w = np.moveaxis(clip, -2, 0)
    return np.stack([w - _NEAR_M, u, right * w - u, v, low * w - v], -2)


def _pixel_bounds(clip: Array) -> Array:
    """Box xyxy (..., 4) px of points (..., 3, V)."""
    pixels = clip[..., :2, :] / clip[..., 2:, :]
    return np.concatenate([pixels.min(-1), pixels.max(-1)], -1)


_TRIED_TURNS_RAD = (-0.1, -0.05, 0.05, 0.1)
"""Turns from the label's heading that are tried: labels are off by some 5 degrees; the fit corrects 2."""
_LABEL_TURN_RAD = 0.08
"""Standard deviation of a label's heading, rad."""
_TURN_COST = 0.005
"""Cost, in edge distance, of a turn by that deviation, twice: half its square counts."""
MIN_VISIBLE_SHARE = 0.5
"""Share of a car that must be visible for its edges to outweigh its label."""
_RANK_COST = 0.004
"""Cost, in edge distance, of each rank of a template by its proportions."""
_PICKUP_COST = 0.04
"""Cost, in edge distance, of a pickup: seen from its ends it looks like other cars, and on Europe's roads one car
in fifty is one."""
_FIXED_HEADING = BoxAlignmentSettings(turn_rad=0.01)
"""A tried heading may be moved to fill the box, but not turned back."""
_FIXED_POSE = BoxAlignmentSettings(shift_m=0.05, lift_m=0.02, turn_rad=0.01, stretch=0.02)
"""For a car that a laser measured."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPhotograph:
    """A photograph as evidence about one object."""

    picture: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    hidden: Mask
    """(H, W), pixels of nearer objects."""
    camera: Camera
    """The photograph's camera."""
    backend: verbs.Backend = "warp"
    """Of the rasteriser."""

    def visible_share(self, placement: Placement) -> float:
        """Share of a placed mesh's pixels that nothing nearer hides; 0 if it has none."""
        outline = render_silhouettes([placement], self.camera, self.backend)[0]
        total = np.count_nonzero(outline)
        return np.count_nonzero(outline & ~self.hidden) / total if total else 0.0

    def edge_distances(self, placements: Sequence[Placement]) -> NDArray[np.float64]:
        """Distances (N,) of each placed mesh's edges from the photograph's."""
        return np.array(measure_edge_distances(placements, self.hidden, self.picture, self.camera, self.backend))


def choose_pose(
    options: Sequence[Placement], box: LabelBoxes | None, photograph: ObjectPhotograph, measured: bool = False
) -> tuple[list[Placement], NDArray[np.float64]]:
    """Align each option with the label's 2D box and rate it; try other headings for the best one.

    Args:
        options: N meshes at the label, the likeliest by its proportions first.
        box: The label's 2D box (one row) if its sides can be trusted.
        photograph: The photograph, for its edges.
        measured: Whether a laser measured the pose. Then, and where little is visible, no other heading is tried.

    Returns:
        The N placements, and their edge distances (N,) plus penalties: the likeliest has the least.
    """

    def align(placements: list[Placement], settings: BoxAlignmentSettings | None) -> list[Placement]:
        count = len(placements)
        boxes = None if box is None else LabelBoxes(box.xyxy.expand(count, 4), box.trust.expand(count, 4))
        return align_to_boxes(placements, boxes, photograph.camera, settings)

    aligned = align(list(options), _FIXED_POSE if measured else None)
    penalties = [_RANK_COST * i + _PICKUP_COST * o.mesh.name.startswith("pickup-") for i, o in enumerate(options)]
    costs = photograph.edge_distances(aligned) + np.array(penalties)
    best = int(np.argmin(costs))
    if measured or photograph.visible_share(aligned[best]) < MIN_VISIBLE_SHARE:
        return aligned, costs
    start = options[best] if box is not None else aligned[best]
    yaw = aligned[best].yaw
    tried = [aligned[best], *align([replace(start, yaw=yaw + turn) for turn in _TRIED_TURNS_RAD], _FIXED_HEADING)]
    # in one call: distances compare only within one window
    distances = photograph.edge_distances(tried)
    label_yaw = float(options[best].yaw)
    turns = [math.remainder(float(p.yaw) - label_yaw, 2 * math.pi) / _LABEL_TURN_RAD for p in tried]
    chosen = int(np.argmin(distances + np.array([_TURN_COST * turn**2 / 2 for turn in turns])))
    aligned[best] = tried[chosen]
    costs[best] += min(distances[chosen] - distances[0], 0.0)
    return aligned, costs


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
_ICP_STEPS = 15
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
    for step in range(_ICP_STEPS):
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
