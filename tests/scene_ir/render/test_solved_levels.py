"""Order in which the sources of vehicles are solved."""

from __future__ import annotations

import torch

from scene_ir.render.sources import _layer_levels
from scene_ir.types import Crop


def test_vehicles_that_touch_are_solved_one_after_the_other() -> None:
    rects = [[0, 0, 10, 10], [8, 0, 18, 10], [40, 0, 50, 10], [16, 0, 30, 10]]
    mattes = [Crop(torch.ones(1, y1 - y0, x1 - x0), x0, y0) for x0, y0, x1, y1 in rects]
    assert _layer_levels([0, 1, 2, 3], rects, mattes) == [[0, 2], [1], [3]]
    assert _layer_levels([3, 2, 1, 0], rects, mattes) == [[3, 2], [1], [0]]


def test_mattes_beyond_their_rectangles_touch() -> None:
    rects = [[0, 0, 10, 10], [20, 0, 30, 10]]
    mattes = [Crop(torch.ones(1, 10, 10), 0, 0), Crop(torch.ones(1, 10, 20), 9, 0)]
    assert _layer_levels([0, 1], rects, mattes) == [[0], [1]]
