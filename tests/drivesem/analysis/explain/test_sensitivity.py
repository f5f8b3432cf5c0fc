"""Maps of |d loss / d pixel|: whose pixels they fall on, and how they are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from drivesem.analysis.explain.sensitivity import (
    draw_heatmap,
    draw_object_numbers,
    draw_sensitivity_sheet,
    gradient_shares,
)

SIZE = (60, 90)


def test_shares_by_object():
    ids = np.zeros((2, 4), np.int64)
    ids[:, 1], ids[0, 2] = 1, 3
    gradient = np.array([[1.0, 2, 4, 0], [1, 2, 0, 0]])
    assert gradient_shares(gradient, ids, 3) == pytest.approx((0.4, 0, 0.4, 0.2))
    assert gradient_shares(np.zeros((2, 4)), ids, 3) == (0, 0, 0, 0)


def test_heat_is_where_the_gradient_is():
    gradient = np.zeros(SIZE, np.float32)
    gradient[20:30, 40:60] = 1
    picture = draw_heatmap(np.full((*SIZE, 3), 200, np.uint8), gradient, 1.0)
    cold = picture[5, 5]
    assert cold[0] == cold[1] == cold[2]
    hot = picture[25, 50].astype(int)
    assert hot[0] > hot[2] + 30  # the bright end of the scale is yellow
    assert (
        draw_heatmap(picture, np.zeros(SIZE, np.float32), 0.0)[..., 0] == picture[..., 0] // 4 + 128
    ).mean() > 0.5


def test_a_sheet_shows_both_on_one_scale():
    rng = np.random.default_rng(0)
    image, weak = rng.integers(0, 255, (*SIZE, 3), dtype=np.uint8), rng.random(SIZE, dtype=np.float32)
    boxes = np.array([[10.0, 10, 50, 40], [-20, -20, 3, 3]])
    page = draw_sensitivity_sheet([("benign", image, boxes, weak), ("counterexample", image, boxes, 100 * weak)])
    height, width = page.shape[:2]
    assert width > 2 * SIZE[1]
    upper, lower = (page[y : y + height // 2, width // 2 :].astype(int) for y in (0, height // 2))
    spread = [np.abs(part[..., 0] - part[..., 2]).mean() for part in (upper, lower)]
    assert spread[1] > 5 * spread[0]  # weak beside strong is nearly grey


def test_numbers_stand_in_the_boxes():
    image = np.zeros((*SIZE, 3), np.uint8)
    drawn = draw_object_numbers(image, np.array([[10.0, 10, 50, 40]]))
    changed = np.argwhere((drawn != image).any(axis=2))
    assert changed.min(axis=0).tolist() >= [10, 10]
    assert changed.max(axis=0)[0] <= 40
    assert changed.max(axis=0)[1] <= 50
    assert not image.any()
    assert (draw_object_numbers(image, np.zeros((0, 4))) == image).all()
