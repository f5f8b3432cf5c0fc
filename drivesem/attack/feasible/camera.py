"""Vehicles in the camera: image boxes, distances, footprints, and which vehicle hides which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.attack.feasible.vehicles import Array, Flags, Indices, VehicleBoxes, cell_centres, to_float64_array
from scene_ir.types import Camera

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
