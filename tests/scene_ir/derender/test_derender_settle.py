"""Cars moved until they fill their 2D boxes, as little as that asks for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scene_ir.derender import silhouette
from scene_ir.derender.settle import SettleSettings, settle
from scene_ir.derender.silhouette import Boxes, Placement
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)


def car(x: float, z: float, yaw: float, size: tuple[float, float, float] = (4.0, 1.5, 1.7)) -> Placement:
    return silhouette.placed("sedan", torch.tensor([x, 1.65, z]), torch.tensor(yaw), torch.tensor(size))


def seen(placement: Placement) -> np.ndarray:
    return silhouette.silhouettes([placement], CAMERA)[0]


def box_of(mask: np.ndarray) -> list[float]:
    x0, y0, x1, y1 = silhouette.extent(mask)
    return [x0 - 0.5, y0 - 0.5, x1 - 0.5, y1 - 0.5]


def settled(start: Placement, box: list[float], trust: tuple[float, ...]) -> Placement:
    return settle([start], Boxes(torch.tensor([box]), torch.tensor([trust])), CAMERA)[0][0]


def test_a_label_that_is_off_comes_to_fill_its_box():
    truth, start = car(0.5, 11.0, 0.6), car(0.66, 10.9, 0.52, (4.2, 1.43, 1.78))
    target = seen(truth)
    found = settled(start, box_of(target), (1.0, 1.0, 1.0, 1.0))
    assert silhouette.iou(seen(start), target) < 0.9
    assert silhouette.iou(seen(found), target) > 0.95
    assert np.abs(np.array(box_of(seen(found))) - box_of(target)).max() <= 1.5


def test_a_car_that_the_image_cuts_fills_what_is_left_of_its_box():
    truth, start = car(-3.2, 5.2, 0.3), car(-3.05, 5.3, 0.36, (4.15, 1.43, 1.75))
    target = seen(truth)
    assert target[:, 0].any()
    found = settled(start, box_of(target), (0.0, 1.0, 1.0, 1.0))
    assert silhouette.iou(seen(found), target) > silhouette.iou(seen(start), target) + 0.02


@pytest.mark.parametrize("trust", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0)])
def test_without_trust_or_need_nothing_moves(trust):
    start = car(0.5, 11.0, 0.6)
    found = settled(start, box_of(seen(start)), trust)
    assert float((found.translation - start.translation).abs().max()) < 0.03
    assert abs(float(found.yaw - start.yaw)) < 0.02


def test_no_box_moves_a_car_beyond_its_label():
    start, settings = car(0.5, 11.0, 0.6), SettleSettings()
    found = settled(start, [20.0, 20.0, 60.0, 50.0], (1.0, 1.0, 1.0, 1.0))
    limit = settings.reach * settings.shift_m + 1e-5
    assert float((found.translation - start.translation).abs().max()) <= limit
    assert float((found.size_lhw / start.size_lhw).log().abs().max()) <= settings.reach * settings.stretch + 1e-5


def test_a_car_out_of_sight_stays():
    start = car(60.0, 11.0, 0.6)
    found = settled(start, [10.0, 80.0, 60.0, 110.0], (1.0, 1.0, 1.0, 1.0))
    assert torch.allclose(found.translation, start.translation)


def test_cost_tells_how_far_the_box_is_from_the_label():
    truth, start = car(0.5, 11.0, 0.6), car(0.75, 11.0, 0.6)
    boxes = Boxes(torch.tensor([box_of(seen(truth))]).expand(2, 4), torch.ones(2, 4))
    _, costs = settle([truth, start], boxes, CAMERA)
    assert costs[0] < 0.2
    assert costs[1] > costs[0] + 0.5
