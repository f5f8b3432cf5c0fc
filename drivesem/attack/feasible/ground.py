"""The ground: how much of a footprint lies on the road."""

from __future__ import annotations

import numpy as np

from drivesem.attack.feasible.cars import Array, Indices, array, cell_centres
from drivesem.attack.feasible.picture import NEAR_M, CarViews
from scene_ir.types import SceneIR

_FOOTPRINT_GRID = (10, 16)
"""Cells along and across a footprint in whose centres the road map is read."""
_FOOTPRINT = cell_centres(*_FOOTPRINT_GRID)
"""Points of a footprint (2, P) between a car's bounds, along and across."""


class RoadMap:
    """Where the road is in a scene's picture."""

    def __init__(self, scene: SceneIR) -> None:
        self._road = array(scene.environment.road).reshape(-1)
        self._width = scene.camera.width
        self._limit = np.array([scene.camera.width - 1.0, scene.camera.height - 1.0])

    def share(self, view: CarViews, of: Indices | slice = slice(None)) -> Array:
        """Mean of the road map (M,) under the footprints of the views `of`; 1 where fewer than a quarter of a
        footprint's points are in the image.
        """
        clip = view.corner[of][:, :, None] + view.edges[of] @ _FOOTPRINT
        depth = clip[:, 2]
        exact = clip[:, :2] / np.maximum(depth, NEAR_M)[:, None]
        pixels = np.minimum(np.maximum(exact, 0), self._limit[:, None])
        inside = (exact == pixels).all(axis=1) & (depth > NEAR_M)
        cell = np.minimum(pixels, self._limit[:, None] - 1).astype(np.int64)
        across, down = (pixels - cell).swapaxes(0, 1)
        index = cell[:, 1] * self._width + cell[:, 0]
        top, bottom = self._road[index], self._road[index + self._width]
        top = top + across * (self._road[index + 1] - top)
        bottom = bottom + across * (self._road[index + self._width + 1] - bottom)
        count = inside.sum(axis=1)
        share = ((top + down * (bottom - top)) * inside).sum(axis=1) / np.maximum(count, 1)
        return np.where(count * 4 >= inside.shape[1], share, 1.0)
