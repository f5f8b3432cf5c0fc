"""Banded maps against the whole matrices that they are made of: values, shapes, gradients."""

from __future__ import annotations

import numpy as np
import torch

from drivesem.failures.jpeg import BandedMatrix, Matrix, SeparableMap


def random_band(outputs: int, inputs: int, seed: int) -> Matrix:
    """A few neighbours each, and one input that many outputs share, as at a picture's border."""
    generator = np.random.default_rng(seed)
    matrix = np.zeros((outputs, inputs))
    for row in range(outputs):
        first = min(row * inputs // outputs, inputs - 3)
        matrix[row, first : first + 3] = generator.random(3)
    matrix[: outputs // 2, 0] += 0.5
    return matrix


def test_values_and_shapes() -> None:
    image = torch.rand(2, 70, 45, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows, columns = random_band(50, 70, 1), random_band(90, 45, 2)
    expected = torch.from_numpy(rows) @ image @ torch.from_numpy(columns).T
    mapped = SeparableMap.from_dense(rows, columns, image)(image)
    assert mapped.shape == (2, 50, 90)
    torch.testing.assert_close(mapped, expected)
    # What does not lie row by row in memory is read alike.
    turned = image.transpose(1, 2).contiguous().transpose(1, 2)
    torch.testing.assert_close(SeparableMap.from_dense(rows, columns, image)(turned), expected)


def test_blocks_are_small() -> None:
    banded = BandedMatrix.from_dense(random_band(1242, 1242, 0)[621:], torch.empty(0))
    assert sum(matrix.numel() for _, _, matrix in banded.blocks) < 0.1 * 621 * 1242


def test_an_output_of_nothing_is_zero() -> None:
    matrix = random_band(80, 40, 3)
    matrix[32:64] = 0
    mapped = BandedMatrix.from_dense(matrix, torch.empty(0)).map_columns(torch.ones(1, 40, 3))
    assert bool((mapped[:, 32:64] == 0).all())
    assert bool((mapped[:, 64:] > 0).all())


def test_gradients() -> None:
    by = SeparableMap.from_dense(
        random_band(40, 35, 4), random_band(37, 39, 5), torch.empty(0, dtype=torch.float64)
    )
    image = torch.rand(1, 35, 39, dtype=torch.float64).requires_grad_(True)
    assert torch.autograd.gradcheck(by, (image,))
