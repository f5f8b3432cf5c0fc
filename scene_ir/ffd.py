"""Free-form deformation on a 4x4x4 Bernstein lattice over the unit box (Sederberg and Parry 1986; 3D-SDN)."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from scene_ir.types import LATTICE, LATTICE_POINTS

SYMMETRIC_DIM = LATTICE_POINTS * 3 // 2
"""Number of independent offsets of a left-right symmetric lattice: 96."""


def _bernstein(t: Tensor, degree: int) -> Tensor:
    """Bernstein polynomials (..., degree + 1) at t (...,)."""
    k = torch.arange(degree + 1, device=t.device)
    binomial = torch.tensor([math.comb(degree, int(i)) for i in k], dtype=t.dtype, device=t.device)
    return binomial * t[..., None] ** k * (1 - t[..., None]) ** (degree - k)


def lattice_weights(unit: Tensor) -> Tensor:
    """Weights (V, 64) of the lattice points at unit-box vertices (V, 3).

    Lattice points are ordered by length, then height (roof, y = -1, to ground, y = 0), then width.
    """
    bx = _bernstein(unit[:, 0] + 0.5, LATTICE[0] - 1)
    by = _bernstein(unit[:, 1] + 1.0, LATTICE[1] - 1)
    bz = _bernstein(unit[:, 2] + 0.5, LATTICE[2] - 1)
    return torch.einsum("vi,vj,vk->vijk", bx, by, bz).reshape(unit.shape[0], LATTICE_POINTS)


def deform(unit: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
    """Move vertices by lattice offsets.

    Args:
        unit: Unit-box vertices (V, 3).
        weights: Weights (V, 64) from `lattice_weights`.
        offsets: Lattice offsets (..., 64, 3), fractions of the unit box.

    Returns:
        Deformed vertices (..., V, 3).
    """
    return unit + weights @ offsets


def symmetrise(offsets: Tensor) -> Tensor:
    """The nearest left-right symmetric (z to -z) offsets (..., 64, 3)."""
    grid = offsets.reshape(*offsets.shape[:-2], *LATTICE, 3)
    mirror = grid.flip(-2) * grid.new_tensor([1.0, 1.0, -1.0])
    return (0.5 * (grid + mirror)).reshape(offsets.shape)


def from_symmetric(code: Tensor) -> Tensor:
    """Symmetric offsets (..., 64, 3) from the 96 independent numbers (..., 96) of the half with z < 0."""
    half = code.reshape(*code.shape[:-1], LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)
    mirror = half.flip(-2) * _mirror_signs(code.dtype, code.device)
    return torch.cat([half, mirror], dim=-2).reshape(*code.shape[:-1], LATTICE_POINTS, 3)


@cache
def _mirror_signs(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor([1.0, 1.0, -1.0], dtype=dtype, device=device)


def to_symmetric(offsets: Tensor) -> Tensor:
    """The inverse of `from_symmetric` for symmetric offsets: (..., 64, 3) -> (..., 96)."""
    grid = symmetrise(offsets).reshape(*offsets.shape[:-2], *LATTICE, 3)
    return grid[..., : LATTICE[2] // 2, :].reshape(*offsets.shape[:-2], SYMMETRIC_DIM)


def low_order_modes() -> Tensor:
    """Symmetric offsets (15, 96), at most 1, that deform a vehicle smoothly.

    Offsets along the length and height are x, y, x^2, xy, y^2 of the lattice point's position; offsets along the
    width are z times 1, x, y, x^2, y^2. No mode is a translation.
    """
    x, y, z = (torch.linspace(-1, 1, n) for n in LATTICE)
    x, y, z = (axis.reshape(-1) for axis in torch.meshgrid(x, y, z, indexing="ij"))
    along_and_up = (x, y, x * x, x * y, y * y)
    across = (z, z * x, z * y, z * x * x, z * y * y)  # odd in z
    modes = []
    for axis, terms in enumerate((along_and_up, along_and_up, across)):
        for term in terms:
            offsets = torch.zeros(LATTICE_POINTS, 3)
            offsets[:, axis] = term
            modes.append(to_symmetric(offsets))
    return torch.stack(modes)


def jacobian(unit: Tensor, offsets: Tensor) -> Tensor:
    """Jacobian (..., V, 3, 3) of the deformation by offsets (..., 64, 3) at unit-box points (V, 3).

    Its singular values are the local strain; where its determinant is positive, the mesh is not inverted.
    """
    t = unit + unit.new_tensor([0.5, 1.0, 0.5])
    values = [_bernstein(t[:, axis], LATTICE[axis] - 1) for axis in range(3)]
    slopes = [_bernstein_slope(t[:, axis], LATTICE[axis] - 1) for axis in range(3)]
    columns = []
    for axis in range(3):
        factors = [slopes[i] if i == axis else values[i] for i in range(3)]
        weights = torch.einsum("vi,vj,vk->vijk", *factors).reshape(unit.shape[0], LATTICE_POINTS)
        columns.append(weights @ offsets)
    return torch.eye(3, dtype=unit.dtype, device=unit.device) + torch.stack(columns, dim=-1)


def _bernstein_slope(t: Tensor, degree: int) -> Tensor:
    """Derivatives (..., degree + 1) of the Bernstein polynomials: degree * (b[k-1] - b[k]) of the next lower
    degree.
    """
    lower = _bernstein(t, degree - 1)
    return degree * (torch.nn.functional.pad(lower, (1, 0)) - torch.nn.functional.pad(lower, (0, 1)))
