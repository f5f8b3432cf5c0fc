"""Channels taken one by one give NumPy's own numbers, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from scene_ir.image_filters import channel_max, channel_mean, channel_square_sum


@pytest.mark.parametrize("shape", [(0, 4, 3), (1, 3), (37, 53, 3)])
def test_as_numpy_has_them(shape: tuple[int, ...]) -> None:
    colours = np.random.default_rng(7).normal(size=shape).astype(np.float32)
    for found, expected in (
        (channel_max(colours), colours.max(-1)),
        (channel_mean(colours), colours.mean(-1)),
        (channel_square_sum(colours), (colours**2).sum(-1)),
    ):
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, expected)
