"""Sight: what is seen of cars, and which car hides which, by rays through their image boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.attack.feasible.cars import Array, Cars, Flags, Indices, array, cell_centres
from scene_ir.types import Camera

_RAY_ROWS, _RAY_COLUMNS = 10, 6
"""Rows and columns of an image box through which rays are sent to see what hides a car."""
_RAYS = cell_centres(_RAY_ROWS, _RAY_COLUMNS)[::-1].copy()
"""Where in an image box its rays pass, (2, R), as shares of width and height, row by row."""
_AXES = np.array(
    [[[1, 0, 0], [0, 0, 0], [0, 0, 1]], [[0, 0, -1], [0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 0]]],
    dtype=np.float64,
)
"""Rows: where a car's axes point in camera space, by the cosine of its yaw, by its sine, and always."""


@dataclass(frozen=True, slots=True)
class CarSights:
    """What is seen of some cars. rows (R,): which; height (R,) px visible; area (R,): visible share;
    covers (R, N): car j hides a part of the car.
    """

    rows: Indices
    height: Array
    area: Array
    covers: Flags


class LinesOfSight:
    """Rays from a camera to cars, which here are boxes."""

    def __init__(self, camera: Camera) -> None:
        matrix = array(camera.matrix)
        self._inverse = np.linalg.inv(matrix[:, :3])
        self._centre = -self._inverse @ matrix[:, 3]

    def of(self, cars: Cars, rows: Indices) -> CarSights:
        """What is seen of the cars `rows`, and of those that one of them may hide, by rays through their boxes."""
        box, count = cars.box, len(cars.turn)
        starts = (box[:, None, 0] <= box[:, 2]) & (box[:, None, 1] <= box[:, 3])
        # Only a car whose image box meets box i, and that begins before car i ends, can be in the way.
        near = starts & starts.T & (cars.near <= cars.far[:, None])
        seen = np.flatnonzero(near[:, rows].any(axis=1))
        i, j = np.nonzero(near[seen])
        rays = np.empty((len(seen), 3, _RAYS.shape[1]))
        rays[:, :2] = box[seen, :2, None] + _RAYS * (box[seen, 2:] - box[seen, :2])[:, :, None]
        rays[:, 2] = 1
        directions = self._inverse @ rays
        enter = np.full((len(seen), count, _RAYS.shape[1]), np.inf)
        enter[i, j] = _entered(cars, self._centre, directions[i], j)
        own = enter[np.arange(len(seen)), seen]
        met = np.isfinite(own)
        before = enter < np.where(met, own, -np.inf)[:, None]
        shown = met & ~before.any(axis=1)
        rows_shown = shown.reshape(len(seen), _RAY_ROWS, _RAY_COLUMNS).any(axis=2).sum(axis=1)
        return CarSights(
            rows=seen,
            height=rows_shown / _RAY_ROWS * (box[seen, 3] - box[seen, 1]),
            area=shown.sum(axis=1) / np.maximum(met.sum(axis=1), 1),
            covers=np.logical_or.reduce(before, axis=2),
        )


def _entered(cars: Cars, centre: Array, directions: Array, j: Indices) -> Array:
    """Distance (K, R) at which rays (K, 3, R) from `centre` enter the boxes of cars j (K,); inf for a miss."""
    axes = cars.turn.real[:, None, None] * _AXES[0] + cars.turn.imag[:, None, None] * _AXES[1] + _AXES[2]
    origin = (axes @ (centre - cars.translation)[:, :, None])[:, :, 0]
    # The sum is the ray's own slope, unless that is 0.
    slowness = 1 / (axes[j] @ directions + 1e-30)
    one, other = (cars.low - origin)[j, :, None] * slowness, (cars.high - origin)[j, :, None] * slowness
    nearest, furthest = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((nearest <= furthest) & (furthest > 0), nearest, np.inf)
