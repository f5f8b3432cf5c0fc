"""Cars in the picture: their image boxes, how near they are, and where their footprints lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.attack.feasible.cars import Array, Cars, Indices, array
from scene_ir.types import Camera

NEAR_M = 0.1
"""Points nearer to the camera plane are projected as if they lay there."""

_CORNERS = np.array(
    [[1, 1, 1], [1, 1, 0], [0, 1, 0], [0, 1, 1], [1, 0, 1], [1, 0, 0], [0, 0, 0], [0, 0, 1]], dtype=np.float64
).T.copy()
"""Corners (3, 8) of a box between its bounds; the first four run around the bottom."""


@dataclass(frozen=True, slots=True)
class CarViews:
    """How the M cars `rows` lie in the picture. in_frame (M,): share of the image box inside; size (M, 2) px of
    the clipped box; near (M,) m; corner (M, 3), edges (M, 3, 2): of the footprint, in clip space.
    """

    rows: Indices
    in_frame: Array
    size: Array
    near: Array
    corner: Array
    edges: Array


class CameraView:
    """How a camera sees cars."""

    def __init__(self, camera: Camera) -> None:
        matrix = array(camera.matrix)
        x, y, z = matrix[:, :3].T
        zero = np.zeros(3)
        # Clip-space directions of a car's axes, columns, are even + cos * by_cos + sin * by_sin.
        self._even = np.stack([zero, y, zero], axis=1)
        self._by_cos = np.stack([x, zero, z], axis=1)
        self._by_sin = np.stack([-z, zero, x], axis=1)
        self._matrix = matrix
        self._limit = np.array([camera.width - 1.0, camera.height - 1.0])

    def of(self, cars: Cars, rows: Indices) -> CarViews:
        """The cars `rows` in the picture; brings their boxes and distances up to date."""
        low, extent, turn = cars.low[rows], cars.high[rows] - cars.low[rows], cars.turn[rows]
        axes = self._even + turn.real[:, None, None] * self._by_cos + turn.imag[:, None, None] * self._by_sin
        base = cars.translation[rows] @ self._matrix[:, :3].T + self._matrix[:, 3]
        ground = base + axes[:, :, 0] * low[:, :1] + axes[:, :, 2] * low[:, 2:]
        edges = axes * extent[:, None]
        corners = (ground + axes[:, :, 1] * low[:, 1:2])[:, :, None] + edges @ _CORNERS
        depth = corners[:, 2]
        near = depth.min(axis=1)
        cars.near[rows], cars.far[rows] = near, depth.max(axis=1)
        # A corner behind the camera lands far out on its own side: enough for a box that is clipped anyway.
        pixels = corners[:, :2] / np.maximum(depth, NEAR_M)[:, None]
        first, last = pixels.min(axis=2), pixels.max(axis=2)
        whole = last - first
        first, last = (np.minimum(np.maximum(p, 0), self._limit) for p in (first, last))
        size = last - first
        cars.box[rows, :2], cars.box[rows, 2:] = first, last
        in_frame = size[:, 0] * size[:, 1] / np.maximum(whole[:, 0] * whole[:, 1], 1e-9)
        return CarViews(rows, in_frame, size, near, ground, edges[:, :, ::2])
