"""Vehicles as the constraints see them: posed boxes around deformed meshes, and the mesh points that span them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from scene_ir import ffd
from scene_ir.types import LATTICE, LATTICE_POINTS, Camera, Mesh, SceneIR

Array = NDArray[np.float64]
Values = NDArray[np.floating[Any]]
"""In theta's own dtype, float32 or float64."""
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
Turns = NDArray[np.complex128]
TOLERANCE = 1e-6
"""Slack of every comparison (m, m2, shares, strain): far above rounding, far below what matters."""


@dataclass(slots=True)
class VehicleBoxes:
    """Posed boxes of N vehicles, changed in place. `CameraProjection.project` fills the last three fields."""

    low: Array
    """(N, 3) m, lower bounds of the deformed mesh in the vehicle's frame."""
    high: Array
    """(N, 3) m, upper bounds."""
    turn: Turns
    """(N,), cos(yaw) + i sin(yaw)."""
    translation: Array
    """(N, 3) m."""
    box: Array
    """(N, 4) px, image box, clipped to the picture."""
    near: Array
    """(N,) m, smallest distance of a corner from the camera plane."""
    far: Array
    """(N,) m, largest distance of a corner from the camera plane."""

    @classmethod
    def from_poses(cls, low: Array, high: Array, yaw: Array, translation: Array) -> VehicleBoxes:
        """Boxes of vehicles, not yet projected into a picture.

        Args:
            low: (N, 3) m, lower bounds in vehicle axes.
            high: (N, 3) m, upper bounds.
            yaw: (N,) rad.
            translation: (N, 3) m.
        """
        n = len(yaw)
        return cls(low, high, unit_complex(yaw), translation, np.zeros((n, 4)), np.zeros(n), np.zeros(n))


def unit_complex(yaw: Array) -> Turns:
    """cos(yaw) + i sin(yaw): multiplying x + i z by it turns camera axes into vehicle axes, its conjugate back."""
    return np.cos(yaw) + 1j * np.sin(yaw)


def footprint_centres(cars: VehicleBoxes) -> Turns:
    """Centres of the footprints, x + i z (N,) m."""
    middle = 0.5 * (cars.low + cars.high)
    place = cars.translation[:, 0] + 1j * cars.translation[:, 2]
    return place + cars.turn.conj() * (middle[:, 0] + 1j * middle[:, 2])


def cell_centres(along: int, across: int) -> Array:
    """Centres (2, along * across) of the cells of a unit square, `across` fastest."""
    first, second = (np.arange(along) + 0.5) / along, (np.arange(across) + 0.5) / across
    return np.stack([a.reshape(-1) for a in np.meshgrid(first, second, indexing="ij")])


def to_float64_array(tensor: Tensor) -> Array:
    """A tensor as a float64 array, without its gradient."""
    return tensor.detach().cpu().double().numpy()


_SURFACE_POINTS = 160
"""Maximum number of mesh vertices, besides those of the convex hull, that span a mesh."""
_SLICE = LATTICE[1] * LATTICE[2]
"""Lattice points in a slice across the length."""


class VehicleSurfaces:
    """Points on N vehicles' meshes that span their extents, in metres of each vehicle's frame.

    Attributes:
        offsets: (N, 64, 3), lattice offsets of the photographed scene, in unit boxes.
        rest: (N, 3, K) m, the points at these offsets.
    """

    def __init__(self, scene: SceneIR) -> None:
        points_by_mesh = {
            index: extreme_points(scene.meshes[index]) for index in set(scene.objects.mesh_index.tolist())
        }
        point_count = max(len(points) for points in points_by_mesh.values())
        unit_points: dict[int, Array] = {}
        along: dict[int, Array] = {}
        across: dict[int, Array] = {}
        for index, points in points_by_mesh.items():
            # Padded to one length with the last point, which changes no extents.
            padded = np.concatenate([points, np.repeat(points[-1:], point_count - len(points), axis=0)])
            weights = (
                ffd.lattice_weights(torch.from_numpy(padded)).numpy().reshape(point_count, LATTICE[0], _SLICE)
            )
            # Each factor of the weights sums to 1. Stored separately they take a third of the memory and time.
            unit_points[index], along[index], across[index] = (
                padded.T,
                weights.sum(axis=2).T,
                weights.sum(axis=1).T,
            )
        owners = scene.objects.mesh_index.tolist()
        # `stack` keeps the transposed order, with which the products take three times as long.
        self._unit, self._along, self._across = (
            np.ascontiguousarray(np.stack([part[i] for i in owners])) for part in (unit_points, along, across)
        )
        self._size = to_float64_array(scene.objects.size_lhw)[:, :, None]
        self.offsets = to_float64_array(scene.objects.ffd)
        self.rest = self._apply_offsets(self.offsets, slice(None))

    def deform(self, mesh: Values, rows: Indices | slice = slice(None)) -> Array:
        """The points (M, 3, K) m of vehicles `rows` under mesh codes (M, 96)."""
        return self._apply_offsets(self.offsets[rows] + _offsets(mesh), rows)

    def _apply_offsets(self, offsets: Array, rows: Indices | slice) -> Array:
        slices = offsets.swapaxes(1, 2).reshape(len(offsets), -1, _SLICE) @ self._across[rows]
        slices = slices.reshape(len(offsets), 3, LATTICE[0], -1)
        shift = np.einsum("ncik,nik->nck", slices, self._along[rows])
        return (self._unit[rows] + shift) * self._size[rows]


def extreme_points(mesh: Mesh) -> Array:
    """Vertices (K, 3), in unit boxes, that span a mesh's extents."""
    vertices = mesh.vertices.detach().cpu().double().numpy()
    try:
        hull = set(ConvexHull(vertices).vertices.tolist())
    except QhullError:  # a flat mesh has no hull with a volume
        hull = set()
    stride = max(1, -(-len(vertices) // _SURFACE_POINTS))
    return vertices[sorted(hull | set(range(0, len(vertices), stride)))]


def extents(surface: Array) -> tuple[Array, Array]:
    """Lower and upper bounds (N, 3) of points (N, 3, K)."""
    return surface.min(axis=2), surface.max(axis=2)


def _offsets(mesh: Values) -> Array:
    """Lattice offsets (N, 64, 3) from symmetric codes (N, 96): `ffd.from_symmetric` in numpy."""
    half = mesh.astype(np.float64).reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)
    mirror = half[:, :, :, ::-1] * [1.0, 1.0, -1.0]
    return np.concatenate([half, mirror], axis=3).reshape(len(mesh), LATTICE_POINTS, 3)


def lowest_layer_heights(mesh: Values) -> Values:
    """Vertical offsets (N, 4, 2) of the lowest lattice layer, a view into symmetric codes (N, 96)."""
    return mesh.reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)[:, :, -1, :, 1]


NEAR_M = 0.1
"""Points nearer to the camera plane are projected as if at this distance."""

_CORNERS = np.array(
    [[1, 1, 1], [1, 1, 0], [0, 1, 0], [0, 1, 1], [1, 0, 1], [1, 0, 0], [0, 0, 0], [0, 0, 1]], dtype=np.float64
).T.copy()
"""Corners (3, 8) of a box, as shares of its bounds; the first four run around the bottom."""


@dataclass(frozen=True, slots=True)
class VehicleProjections:
    """M vehicles as the camera projects them."""

    rows: Indices
    """(M,), which vehicles."""
    in_frame: Array
    """(M,), share of the image box inside the picture, in [0, 1]."""
    size: Array
    """(M, 2) px, width and height of the clipped image box."""
    near: Array
    """(M,) m, smallest distance from the camera plane."""
    corner: Array
    """(M, 3), one corner of the footprint, in clip space."""
    edges: Array
    """(M, 3, 2), the footprint's edges from that corner, in clip space."""


class CameraProjection:
    """Projects vehicles into a camera's picture."""

    def __init__(self, camera: Camera) -> None:
        matrix = to_float64_array(camera.matrix)
        x, y, z = matrix[:, :3].T
        zero = np.zeros(3)
        # Clip-space directions of a vehicle's axes (columns) are even + cos * by_cos + sin * by_sin.
        self._even = np.stack([zero, y, zero], axis=1)
        self._by_cos = np.stack([x, zero, z], axis=1)
        self._by_sin = np.stack([-z, zero, x], axis=1)
        self._matrix = matrix
        self._limit = np.array([camera.width - 1.0, camera.height - 1.0])

    def project(self, cars: VehicleBoxes, rows: Indices) -> VehicleProjections:
        """Project the vehicles `rows`, and update their boxes and distances in `cars`."""
        low, extent, turn = cars.low[rows], cars.high[rows] - cars.low[rows], cars.turn[rows]
        axes = self._even + turn.real[:, None, None] * self._by_cos + turn.imag[:, None, None] * self._by_sin
        base = cars.translation[rows] @ self._matrix[:, :3].T + self._matrix[:, 3]
        ground = base + axes[:, :, 0] * low[:, :1] + axes[:, :, 2] * low[:, 2:]
        edges = axes * extent[:, None]
        corners = (ground + axes[:, :, 1] * low[:, 1:2])[:, :, None] + edges @ _CORNERS
        depth = corners[:, 2]
        near = depth.min(axis=1)
        cars.near[rows], cars.far[rows] = near, depth.max(axis=1)
        # A corner behind the camera lands far out on its own side, which suffices for a clipped box.
        pixels = corners[:, :2] / np.maximum(depth, NEAR_M)[:, None]
        first, last = pixels.min(axis=2), pixels.max(axis=2)
        whole = last - first
        first, last = (np.minimum(np.maximum(p, 0), self._limit) for p in (first, last))
        size = last - first
        cars.box[rows, :2], cars.box[rows, 2:] = first, last
        in_frame = size[:, 0] * size[:, 1] / np.maximum(whole[:, 0] * whole[:, 1], 1e-9)
        return VehicleProjections(rows, in_frame, size, near, ground, edges[:, :, ::2])


_RAY_ROWS, _RAY_COLUMNS = 10, 6
"""Rows and columns of rays through an image box, which test what hides a vehicle."""
_RAYS = cell_centres(_RAY_ROWS, _RAY_COLUMNS)[::-1].copy()
"""Where rays pass through an image box, (2, R), as shares of width and height, row by row."""
_AXES = np.array(
    [[[1, 0, 0], [0, 0, 0], [0, 0, 1]], [[0, 0, -1], [0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 0]]],
    dtype=np.float64,
)
"""A vehicle's axes in camera space (rows): factors of its yaw's cosine and sine, and the constant part."""


@dataclass(frozen=True, slots=True)
class VehicleVisibility:
    """How much of R vehicles is visible."""

    rows: Indices
    """(R,), which vehicles."""
    height: Array
    """(R,) px, visible height."""
    area: Array
    """(R,), visible share of the area, in [0, 1]."""
    covers: Flags
    """(R, N), whether vehicle j hides a part of the vehicle."""


class VisibilityRays:
    """Casts rays from a camera at vehicles, which are boxes here."""

    def __init__(self, camera: Camera) -> None:
        matrix = to_float64_array(camera.matrix)
        self._inverse = np.linalg.inv(matrix[:, :3])
        self._centre = -self._inverse @ matrix[:, 3]

    def measure(self, cars: VehicleBoxes, rows: Indices) -> VehicleVisibility:
        """Visibility of the vehicles `rows` and of those that one of them may hide."""
        box, count = cars.box, len(cars.turn)
        starts = (box[:, None, 0] <= box[:, 2]) & (box[:, None, 1] <= box[:, 3])
        # Only a vehicle that meets image box i, and that begins before vehicle i ends, can hide it.
        near = starts & starts.T & (cars.near <= cars.far[:, None])
        seen = np.flatnonzero(near[:, rows].any(axis=1))
        i, j = np.nonzero(near[seen])
        rays = np.empty((len(seen), 3, _RAYS.shape[1]))
        rays[:, :2] = box[seen, :2, None] + _RAYS * (box[seen, 2:] - box[seen, :2])[:, :, None]
        rays[:, 2] = 1
        directions = self._inverse @ rays
        enter = np.full((len(seen), count, _RAYS.shape[1]), np.inf)
        enter[i, j] = _entry_distances(cars, self._centre, directions[i], j)
        own = enter[np.arange(len(seen)), seen]
        met = np.isfinite(own)
        before = enter < np.where(met, own, -np.inf)[:, None]
        visible = met & ~before.any(axis=1)
        visible_rows = visible.reshape(len(seen), _RAY_ROWS, _RAY_COLUMNS).any(axis=2).sum(axis=1)
        return VehicleVisibility(
            rows=seen,
            height=visible_rows / _RAY_ROWS * (box[seen, 3] - box[seen, 1]),
            area=visible.sum(axis=1) / np.maximum(met.sum(axis=1), 1),
            covers=np.logical_or.reduce(before, axis=2),
        )


def _entry_distances(cars: VehicleBoxes, centre: Array, directions: Array, j: Indices) -> Array:
    """Distances (K, R) at which rays (K, 3, R) from `centre` enter the boxes of vehicles j (K,), inf if missed."""
    axes = cars.turn.real[:, None, None] * _AXES[0] + cars.turn.imag[:, None, None] * _AXES[1] + _AXES[2]
    origin = (axes @ (centre - cars.translation)[:, :, None])[:, :, 0]
    # The term keeps a slope of 0 invertible.
    slowness = 1 / (axes[j] @ directions + 1e-30)
    first, second = (cars.low - origin)[j, :, None] * slowness, (cars.high - origin)[j, :, None] * slowness
    nearest, furthest = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
    return np.where((nearest <= furthest) & (furthest > 0), nearest, np.inf)
