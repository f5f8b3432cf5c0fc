"""Ground plane, horizon, depth and sun by rule."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_ir.derender import depth as maps
from scene_ir.types import Camera, Labels

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])


def labels_at(points: list[list[float]]) -> Labels:
    n = len(points)
    return Labels(
        ("Car",) * n, torch.zeros(n, 4), torch.zeros(n), torch.zeros(n, dtype=torch.int64),
        torch.tensor(points).reshape(n, 3), torch.zeros(n), torch.ones(n, 3), torch.zeros(0, 4),
    )  # fmt: skip


def test_without_labels_the_ground_is_level_at_camera_height():
    assert maps.fit_ground(None, []) == pytest.approx(LEVEL, abs=1e-6)


def test_ground_follows_the_labels_and_not_the_one_that_is_wrong():
    slope = [[x, 1.7 + 0.01 * z, z] for z in (6.0, 9.0, 14.0, 20.0, 28.0) for x in (-4.0, 3.0)]
    plane = maps.fit_ground(labels_at([*slope, [2.0, 0.2, 12.0]]), list(range(11)))
    residual = torch.tensor(slope) @ plane[:3] + plane[3]
    assert float(residual.abs().max()) < 0.12
    assert float(plane[:3].norm()) == pytest.approx(1.0)
    assert plane[1] < 0


def test_horizon_and_plane_depth_of_a_level_camera():
    assert maps.horizon_row(LEVEL, CAMERA) == pytest.approx(88.0, abs=1e-4)
    depth = maps.compute_plane_depth(LEVEL, CAMERA)
    assert np.isinf(depth[:88]).all()
    assert depth[188, 100] == pytest.approx(380 * 1.65 / 100, rel=1e-4)


def test_walls_stand_on_the_end_of_the_ground_and_the_sky_is_endlessly_far():
    ground = maps.compute_plane_depth(LEVEL, CAMERA)
    road = np.zeros((200, 480), np.float32)
    road[120:] = 1
    sky = np.zeros_like(road)
    sky[:40] = 1
    depth = maps.compute_wall_depth(ground, road, np.zeros_like(road), sky, 88.0)
    assert depth[150] == pytest.approx(ground[150])
    assert depth[60, 200] == pytest.approx(ground[120, 200], rel=0.05)
    assert np.isinf(depth[:40]).all()
    assert depth[np.isfinite(depth)].max() <= maps.FAR_M


def test_where_a_car_stands_there_is_ground_and_no_wall_before_it():
    ground = maps.compute_plane_depth(LEVEL, CAMERA)
    road = np.zeros((200, 480), np.float32)
    road[150:] = 1  # rails or a verge that nobody took for ground
    labels = replace(
        labels_at([[0.0, 1.65, 20.0], [0.0, 1.65, 0.2]]), size_lhw=torch.tensor([[4.0, 1.5, 1.8]] * 2)
    )
    stood = maps.draw_footprints(labels, [0, 1], LEVEL, CAMERA)
    nothing = np.zeros_like(road)
    before, after = (maps.compute_wall_depth(ground, road, where, nothing, 88.0) for where in (nothing, stood))
    car = slice(240 - 17, 240 + 17)
    assert before[100, car].max() < 11
    assert after[100, car].min() > 20
    assert after[100, :100] == pytest.approx(before[100, :100], rel=0.01)
    assert set(np.unique(stood)) == {0.0, 1.0}
    assert not stood[:100].any()


def test_sun_is_a_unit_vector_that_points_up():
    sun = maps.default_sun()
    assert float(sun.norm()) == pytest.approx(1)
    assert sun[1] < -0.5
