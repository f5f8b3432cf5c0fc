"""The free-form deformation lattice."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from scene_ir import ffd
from scene_ir.types import LATTICE, LATTICE_POINTS

SEEDS = st.integers(0, 2**31)


def unit_points(seed: int, count: int = 20) -> torch.Tensor:
    """Random points of the unit box (count, 3), float64."""
    g = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=g, dtype=torch.float64) - torch.tensor(
        [0.5, 1.0, 0.5], dtype=torch.float64
    )


def offsets(seed: int, scale: float = 0.1) -> torch.Tensor:
    """Random lattice offsets (64, 3), float64."""
    g = torch.Generator().manual_seed(seed)
    return torch.randn(LATTICE_POINTS, 3, generator=g, dtype=torch.float64) * scale


def lattice() -> torch.Tensor:
    """Where the control points stand, (64, 3): length-major, then height from the roof, then width."""
    axes = [torch.linspace(0, 1, n, dtype=torch.float64) for n in LATTICE]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    return grid.reshape(-1, 3) - torch.tensor([0.5, 1.0, 0.5], dtype=torch.float64)


@given(SEEDS)
def test_weights_are_a_partition_of_unity(seed: int) -> None:
    weights = ffd.lattice_weights(unit_points(seed))
    assert weights.shape == (20, LATTICE_POINTS)
    assert float(weights.min()) >= 0
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(20, dtype=torch.float64))


@given(SEEDS)
def test_linear_precision(seed: int) -> None:
    """Bernstein weights of the control points' own places give the point back."""
    unit = unit_points(seed)
    torch.testing.assert_close(ffd.lattice_weights(unit) @ lattice(), unit)


@given(SEEDS)
def test_an_affine_map_of_the_lattice_is_that_map_of_the_box(seed: int) -> None:
    unit, matrix = unit_points(seed), offsets(seed + 1)[:3]
    moved = ffd.deform(unit, ffd.lattice_weights(unit), lattice() @ matrix.T)
    torch.testing.assert_close(moved, unit + unit @ matrix.T)


def test_no_offset_changes_no_bit() -> None:
    unit = unit_points(0)
    weights = ffd.lattice_weights(unit)
    assert torch.equal(ffd.deform(unit, weights, torch.zeros(LATTICE_POINTS, 3, dtype=torch.float64)), unit)


def test_corners_of_the_box_follow_the_corners_of_the_lattice() -> None:
    unit = torch.tensor([[0.5, -1, -0.5], [-0.5, 0, 0.5]], dtype=torch.float64)
    move = offsets(3)
    grid = move.reshape(*LATTICE, 3)
    moved = ffd.deform(unit, ffd.lattice_weights(unit), move) - unit
    torch.testing.assert_close(moved, torch.stack([grid[3, 0, 0], grid[0, 3, 3]]))


def test_deform_takes_a_batch_of_offsets() -> None:
    unit = unit_points(0)
    batch = torch.stack([offsets(1), offsets(2)])
    weights = ffd.lattice_weights(unit)
    assert torch.equal(ffd.deform(unit, weights, batch)[1], ffd.deform(unit, weights, batch[1]))


@given(SEEDS)
def test_symmetric_code_round_trips(seed: int) -> None:
    code = offsets(seed).reshape(-1)[: ffd.SYMMETRIC_DIM]
    full = ffd.from_symmetric(code)
    assert ffd.SYMMETRIC_DIM == 96
    assert torch.equal(ffd.to_symmetric(full), code)
    assert torch.equal(ffd.symmetrise(full), full)


@given(SEEDS)
def test_symmetrise_is_an_idempotent_projection(seed: int) -> None:
    move = offsets(seed)
    nearest = ffd.symmetrise(move)
    torch.testing.assert_close(ffd.symmetrise(nearest), nearest)
    residual, direction = move - nearest, ffd.symmetrise(offsets(seed + 1))
    assert float((residual * direction).sum()) == pytest.approx(0, abs=1e-12)


@given(SEEDS)
def test_symmetric_offsets_move_both_sides_alike(seed: int) -> None:
    unit, flip = unit_points(seed), torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    move = ffd.from_symmetric(offsets(seed).reshape(-1)[: ffd.SYMMETRIC_DIM])
    one = ffd.deform(unit, ffd.lattice_weights(unit), move)
    other = ffd.deform(unit * flip, ffd.lattice_weights(unit * flip), move)
    torch.testing.assert_close(one * flip, other)


@given(SEEDS)
def test_jacobian_meets_central_differences(seed: int) -> None:
    unit, move, step = unit_points(seed, 5), offsets(seed), 1e-5
    columns = []
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        ends = [ffd.deform(u, ffd.lattice_weights(u), move) for u in (unit + shift, unit - shift)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    torch.testing.assert_close(ffd.jacobian(unit, move), torch.stack(columns, dim=-1), atol=1e-7, rtol=1e-6)


def test_jacobian_without_offsets_is_the_identity() -> None:
    eye = torch.eye(3, dtype=torch.float64).expand(20, 3, 3)
    assert torch.equal(ffd.jacobian(unit_points(0), torch.zeros(LATTICE_POINTS, 3, dtype=torch.float64)), eye)


def test_a_mirrored_lattice_is_inverted() -> None:
    """Offsets that mirror the box through its length have a negative determinant everywhere."""
    move = torch.zeros(LATTICE_POINTS, 3, dtype=torch.float64)
    move[:, 0] = -2 * lattice()[:, 0]
    determinant = torch.linalg.det(ffd.jacobian(unit_points(0), move))
    torch.testing.assert_close(determinant, -torch.ones(20, dtype=torch.float64))


def test_gradients_reach_offsets_and_vertices() -> None:
    unit, move = unit_points(0, 4).requires_grad_(), offsets(1).requires_grad_()
    assert torch.autograd.gradcheck(lambda u, m: ffd.deform(u, ffd.lattice_weights(u), m), (unit, move))


def test_gradient_at_the_faces_of_the_box_is_finite() -> None:
    unit = torch.tensor([[0.5, 0.0, -0.5], [-0.5, -1.0, 0.5]], dtype=torch.float64, requires_grad=True)
    ffd.deform(unit, ffd.lattice_weights(unit), offsets(1)).sum().backward()
    assert unit.grad is not None
    assert all(math.isfinite(v) for v in unit.grad.flatten().tolist())
