"""Smooth filling."""

from __future__ import annotations

import numpy as np
import pytest

from scene_ir.image_filters import push_pull

SHAPE = (72, 120)


def known() -> np.ndarray:
    mask = np.ones(SHAPE, np.float32)
    mask[25:50, 45:80] = 0
    return mask


def test_known_pixels_are_kept_and_a_constant_goes_on() -> None:
    image = np.full((*SHAPE, 2), 0.4, np.float32)
    image[known() == 0] = 9
    assert push_pull(image, known()) == pytest.approx(np.full((*SHAPE, 2), 0.4), abs=1e-5)


def test_between_two_colours_it_is_in_between() -> None:
    image = np.zeros((*SHAPE, 1), np.float32)
    image[:, 60:] = 1
    row = push_pull(image, known())[37, 45:80, 0]
    assert row[0] < 0.3 < row[17] < 0.7 < row[-1]
