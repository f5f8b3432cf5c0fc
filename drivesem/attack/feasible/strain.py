"""Strain: how far a mesh is stretched and pressed, whether it is turned inside out, how low it reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.feasible.cars import TOLERANCE, Array, Flags, Indices, Values
from scene_ir import ffd
from scene_ir.types import LATTICE

_STRAIN_GRID = (5, 5, 5)
"""Points of the unit box at which the strain is bounded; the independent check uses a finer grid."""


class StrainBound:
    """Bounds on the deformation of N cars: singular values, determinant of its Jacobian, nothing below y = 0.

    A bound that a car violates at theta = 0 is widened to what it has there; violated_at_start (N,) says who does.
    All is measured at P points of the unit box.
    """

    def __init__(self, source: Array, strain: tuple[float, float]) -> None:
        axes = [np.linspace(0, 1, n) for n in _STRAIN_GRID]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) - [0.5, 1.0, 0.5]
        mirrored = source.reshape(-1, *LATTICE, 3)[:, :, :, ::-1] * [1.0, 1.0, -1.0]
        if np.array_equal(mirrored.reshape(source.shape), source):
            grid = grid[grid[:, 2] <= 0]  # codes are symmetric, so that left and right are strained alike
        unit, start = torch.from_numpy(grid), torch.from_numpy(source)
        # Jacobian and height are linear in the codes: one matrix (96, 10 P) instead of tensor expressions.
        basis = ffd.from_symmetric(torch.eye(ffd.SYMMETRIC_DIM, dtype=torch.float64))
        weights, rest = ffd.lattice_weights(unit), torch.eye(3, dtype=torch.float64)
        self._linear = _jacobian_and_height(ffd.jacobian(unit, basis) - rest, (weights @ basis)[..., 1])
        self._linear = self._linear.reshape(ffd.SYMMETRIC_DIM, -1)
        jacobian, height = ffd.jacobian(unit, start), unit[:, 1] + (weights @ start)[..., 1]
        self._start = _jacobian_and_height(jacobian, height)
        values = np.linalg.svd(jacobian.numpy(), compute_uv=False)
        self._smallest, largest = values.min(axis=2), values.max(axis=2)
        self._inverted = (np.linalg.det(jacobian.numpy()) <= 0).any(axis=1)
        deepest = height.numpy().max(axis=1)
        self.violated_at_start: Flags = (
            (self._smallest.min(axis=1) < strain[0] - TOLERANCE)
            | (largest.max(axis=1) > strain[1] + TOLERANCE)
            | (deepest > TOLERANCE)
            | self._inverted
        )
        self._low = np.minimum(strain[0], self._smallest.min(axis=1)) - TOLERANCE
        self._high = np.maximum(strain[1], largest.max(axis=1)) + TOLERANCE
        self._floor = np.maximum(0.0, deepest) + TOLERANCE
        # A Jacobian that changes by less, in Frobenius' norm, stays within the bounds (Weyl's inequality).
        self._room = np.minimum(self._smallest - self._low[:, None], self._high[:, None] - largest)

    def change(self, mesh: Values) -> Array:
        """By how much mesh codes (N, 96) change Jacobian and height: (N, 10, P)."""
        return (mesh @ self._linear).reshape(len(mesh), 10, -1)

    def path(self, change: Array, cars: Flags, slack: float = 0.0) -> _StrainPath:
        """The way of `cars` (N,) from theta = 0 to a change (N, 10, P), the bounds tighter by `slack`."""
        slopes = change[:, :9]
        norm = np.sqrt(np.einsum("ncp,ncp->np", slopes, slopes))
        owner, point = np.nonzero((norm >= self._room - slack) & cars[:, None])
        low, high = self._low[owner] + slack, self._high[owner] - slack
        # Only beyond the smallest singular value can a point turn inside out.
        flips = (norm[owner, point] >= self._smallest[owner, point]) & ~self._inverted[owner]
        return _StrainPath(
            owner=owner,
            start=self._start[owner, :9, point].T.copy(),
            slope=slopes[owner, :, point].T.copy(),
            bounds=np.stack([low * np.abs(low), high * high])[:, None],
            flips=np.flatnonzero(flips),
            height=self._start[:, 9],
            rise=change[:, 9] * cars[:, None],
            floor=self._floor - slack,
        )


@dataclass(frozen=True, slots=True)
class _StrainPath:
    """The strain of N cars on the straight way from theta = 0 to a mesh code, at the K points in question.

    owner (K,): their cars; start, slope (9, K): of the Jacobian; bounds (2, 1, K): least and greatest square of a
    singular value; flips: points that might turn inside out; height, rise (N, P): of all points; floor (N,).
    """

    owner: Indices
    start: Array
    slope: Array
    bounds: Array
    flips: Indices
    height: Array
    rise: Array
    floor: Array

    def wrong_at(self, scale: Array) -> Flags:
        """Which cars (N,) are out of bounds at scales (N,) of the way.

        Singular values lie in [low, high] where J J' - low^2 is positive definite and J J' - high^2 negative
        definite: leading minors tell (Sylvester), at a tenth of the cost of a singular value decomposition.
        """
        wrong: Flags = (self.height + scale[:, None] * self.rise).max(axis=1) > self.floor
        jacobian = (self.start + scale[self.owner] * self.slope).reshape(3, 3, -1)
        # Products of the rows: 0 0, 1 1, 2 2, and 0 1, 1 2, 2 0.
        squares, (g01, g12, g20) = (jacobian**2).sum(axis=1), (jacobian * jacobian[[1, 2, 0]]).sum(axis=1)
        left = squares - self.bounds
        d0, d1, d2 = left[:, 0], left[:, 1], left[:, 2]
        minor, other, mixed = d0 * d1 - g01 * g01, d0 * d2 - g20 * g20, d0 * g12 - g01 * g20
        # The determinant, times d0, which has its sign where the matrix is definite.
        last = minor * other - mixed * mixed
        good = ((minor > 0) & (last > 0)).all(axis=0) & (d0[0] > 0) & (d0[1] < 0)
        wrong[self.owner[~good]] = True
        if len(self.flips):
            flipped = np.linalg.det(jacobian[:, :, self.flips].transpose(2, 0, 1)) <= 0
            wrong[self.owner[self.flips[flipped]]] = True
        return wrong


def _jacobian_and_height(jacobian: Tensor, height: Tensor) -> Array:
    """(N, 10, P) of (N, P, 3, 3) and (N, P)."""
    parts = [jacobian.flatten(2), height[..., None]]
    return np.ascontiguousarray(torch.cat(parts, dim=2).transpose(1, 2).numpy())
