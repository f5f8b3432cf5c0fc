"""Smooth hole filling, and reductions over colour channels."""

import numpy as np
import pytest

from scene_ir.image_filters import channel_max, channel_mean, channel_square_sum, push_pull

SHAPE = (72, 120)


def known() -> np.ndarray:
    mask = np.ones(SHAPE, np.float32)
    mask[25:50, 45:80] = 0
    return mask


def test_constant_continues_into_unknown_pixels() -> None:
    image = np.full((*SHAPE, 2), 0.4, np.float32)
    image[known() == 0] = 9
    assert push_pull(image, known()) == pytest.approx(np.full((*SHAPE, 2), 0.4), abs=1e-5)


def test_fill_between_two_colours_is_in_between() -> None:
    image = np.zeros((*SHAPE, 1), np.float32)
    image[:, 60:] = 1
    row = push_pull(image, known())[37, 45:80, 0]
    assert row[0] < 0.3 < row[17] < 0.7 < row[-1]


@pytest.mark.parametrize("shape", [(0, 4, 3), (1, 3), (37, 53, 3)])
def test_channel_reductions_equal_numpys(shape: tuple[int, ...]) -> None:
    colours = np.random.default_rng(7).normal(size=shape).astype(np.float32)
    for reduced, expected in (
        (channel_max(colours), colours.max(-1)),
        (channel_mean(colours), colours.mean(-1)),
        (channel_square_sum(colours), (colours**2).sum(-1)),
    ):
        assert reduced.dtype == np.float32
        np.testing.assert_array_equal(reduced, expected)
