"""Cars as the constraints see them: boxes around deformed meshes, that stand and are turned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Values = NDArray[np.floating[Any]]
"""Of theta's own dtype, float32 or float64."""
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
Turns = NDArray[np.complex128]
TOLERANCE = 1e-6
"""Slack of every comparison (m, m2, shares, strain), far above rounding and far below what matters."""


@dataclass(slots=True)
class Cars:
    """N cars as they stand, changed in place. low, high (N, 3) m: bounds of the deformed car in its own frame;
    turn (N,): cos(yaw) + i sin(yaw); translation (N, 3) m. Found by `CameraView.of`: box (N, 4) px, clipped;
    near, far (N,) m: least and largest distance of the bounds from the camera plane.
    """

    low: Array
    high: Array
    turn: Turns
    translation: Array
    box: Array
    near: Array
    far: Array

    @classmethod
    def of(cls, low: Array, high: Array, yaw: Array, translation: Array) -> Cars:
        n = len(yaw)
        return cls(low, high, turn_of(yaw), translation, np.zeros((n, 4)), np.zeros(n), np.zeros(n))


def turn_of(yaw: Array) -> Turns:
    """cos(yaw) + i sin(yaw): times x + i z it turns camera axes into a car's own, and its conjugate back."""
    return np.cos(yaw) + 1j * np.sin(yaw)


def centres(cars: Cars) -> Turns:
    """Middles of the footprints, x + i z (N,) m."""
    middle = 0.5 * (cars.low + cars.high)
    place = cars.translation[:, 0] + 1j * cars.translation[:, 2]
    return place + cars.turn.conj() * (middle[:, 0] + 1j * middle[:, 2])


def cell_centres(along: int, across: int) -> Array:
    """Centres (2, along * across) of the cells of a unit square, `across` fastest."""
    first, second = (np.arange(along) + 0.5) / along, (np.arange(across) + 0.5) / across
    return np.stack([a.reshape(-1) for a in np.meshgrid(first, second, indexing="ij")])


def array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().double().numpy()
