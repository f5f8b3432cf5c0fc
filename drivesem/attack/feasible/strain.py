"""Strain of a deformed mesh: stretch and compression, inversion, and its lowest point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.feasible.vehicles import TOLERANCE, Array, Flags, Indices, Values
from scene_ir import ffd
from scene_ir.types import LATTICE

_STRAIN_GRID = (5, 5, 5)
"""Grid points of the unit box at which strain is bounded; the independent check uses a finer grid."""


class StrainBound:
    """Bounds on the deformation of N vehicles: singular values, determinant of its Jacobian, nothing below y = 0.

    All is measured at P points of the unit box. A bound that a vehicle violates at theta = 0 is widened to its
    value there; `violated_at_start` (N,) lists those vehicles.
    """

    def __init__(self, source: Array, strain: tuple[float, float]) -> None:
        axes = [np.linspace(0, 1, n) for n in _STRAIN_GRID]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) - [0.5, 1.0, 0.5]
        mirrored = source.reshape(-1, *LATTICE, 3)[:, :, :, ::-1] * [1.0, 1.0, -1.0]
        if np.array_equal(mirrored.reshape(source.shape), source):
            grid = grid[grid[:, 2] <= 0]  # codes are symmetric: left and right are strained equally
        unit, start = torch.from_numpy(grid), torch.from_numpy(source)
        # Jacobian and height are linear in the codes: one matrix (96, 10 P).
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
        # A Jacobian that changes by less, in the Frobenius norm, stays within the bounds (Weyl's inequality).
        self._room = np.minimum(self._smallest - self._low[:, None], self._high[:, None] - largest)

    def change(self, mesh: Values) -> Array:
        """Change (N, 10, P) of Jacobian and height under mesh codes (N, 96)."""
        return (mesh @ self._linear).reshape(len(mesh), 10, -1)

    def path(self, change: Array, cars: Flags, slack: float = 0.0) -> _StrainPath:
        """The straight path from theta = 0 to a strain change.

        Args:
            change: (N, 10, P), as `change` returns it.
            cars: (N,), the vehicles in question.
            slack: by how much the bounds are tightened.
        """
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
    """Strain of N vehicles on the straight path from theta = 0 to a mesh code, at the K points that could violate
    it.
    """

    owner: Indices
    """(K,), the vehicle of each point."""
    start: Array
    """(9, K), Jacobian at theta = 0."""
    slope: Array
    """(9, K), change of the Jacobian along the path."""
    bounds: Array
    """(2, 1, K), smallest and largest square of a singular value."""
    flips: Indices
    """Points that could turn inside out."""
    height: Array
    """(N, P), height of all points at theta = 0, in unit boxes, y down."""
    rise: Array
    """(N, P), change of the height along the path."""
    floor: Array
    """(N,), largest allowed height."""

    def violated_at(self, scale: Array) -> Flags:
        """(N,), which vehicles are out of bounds at scales (N,) of the path.

        Singular values lie in [low, high] where J J' - low^2 is positive definite and J J' - high^2 negative
        definite. Leading minors decide that (Sylvester) at a tenth of the cost of a singular value decomposition.
        """
        wrong: Flags = (self.height + scale[:, None] * self.rise).max(axis=1) > self.floor
        jacobian = (self.start + scale[self.owner] * self.slope).reshape(3, 3, -1)
        # Dot products of the rows: 0 0, 1 1, 2 2, and 0 1, 1 2, 2 0.
        squares, (g01, g12, g20) = (jacobian**2).sum(axis=1), (jacobian * jacobian[[1, 2, 0]]).sum(axis=1)
        diagonal = squares - self.bounds
        d0, d1, d2 = diagonal[:, 0], diagonal[:, 1], diagonal[:, 2]
        minor01, minor02, mixed = d0 * d1 - g01 * g01, d0 * d2 - g20 * g20, d0 * g12 - g01 * g20
        # The determinant times d0, which has its sign where the matrix is definite.
        determinant = minor01 * minor02 - mixed * mixed
        good = ((minor01 > 0) & (determinant > 0)).all(axis=0) & (d0[0] > 0) & (d0[1] < 0)
        wrong[self.owner[~good]] = True
        if len(self.flips):
            flipped = np.linalg.det(jacobian[:, :, self.flips].transpose(2, 0, 1)) <= 0
            wrong[self.owner[self.flips[flipped]]] = True
        return wrong


def _jacobian_and_height(jacobian: Tensor, height: Tensor) -> Array:
    """Jacobian (N, P, 3, 3) and height (N, P) as (N, 10, P)."""
    parts = [jacobian.flatten(2), height[..., None]]
    return np.ascontiguousarray(torch.cat(parts, dim=2).transpose(1, 2).numpy())
