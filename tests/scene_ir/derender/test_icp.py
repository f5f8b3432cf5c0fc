"""Meshes brought to the laser's points on them."""

import numpy as np
import pytest
import torch

from scene_ir.derender import silhouette
from scene_ir.derender.alignment import BOUND, LABEL_SIGMAS, align_to_points, points_near_box
from scene_ir.derender.silhouette import Placement
from scene_ir.geometry import to_clip
from scene_ir.raster import verbs
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
TRUE_SIZE = (4.0, 1.5, 1.7)


def car(x: float, z: float, yaw: float, size: tuple[float, float, float] = TRUE_SIZE) -> Placement:
    return silhouette.place_mesh("hatchback", torch.tensor([x, 1.65, z]), torch.tensor(yaw), torch.tensor(size))


def swept(placement: Placement, noise_m: float = 0.01) -> torch.Tensor:
    """Points (P, 3) m where rays through every third pixel meet the car, and the road below and a wall behind."""
    clip = to_clip(placement.vertices(), CAMERA.matrix)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, CAMERA.width, CAMERA.height]]))
    faces = placement.mesh.faces
    hits = verbs.rasterize(clip, faces, torch.tensor([[0, len(faces)]]), layout)
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    road = np.where(v > 90, 1.65 * 380 / np.maximum(v - 88.0, 1), np.inf)
    far = np.minimum(road, 20.0)
    depth = np.where((hits.face >= 0).numpy(), hits.depth.numpy(), far.reshape(-1)).reshape(v.shape)[::3, ::3]
    u, v = u[::3, ::3], v[::3, ::3]
    points = np.stack([(u - 239.5) / 380 * depth, (v - 88.0) / 380 * depth, depth], 2).reshape(-1, 3)
    noise = np.random.default_rng(0).normal(0, noise_m, points.shape)
    return torch.from_numpy((points + noise).astype(np.float32))


def errors(placement: Placement, truth: Placement) -> tuple[float, float, float]:
    """m on the ground, rad, largest of log sizes."""
    apart = (placement.translation - truth.translation)[[0, 2]].norm()
    stretch = (placement.size_lhw / truth.size_lhw).log().abs().max()
    return float(apart), abs(float(placement.yaw - truth.yaw)), float(stretch)


@pytest.mark.parametrize(("x", "z", "yaw"), [(0.5, 9.0, 0.6), (-2.0, 11.0, -1.2), (1.5, 7.0, 2.4)])
def test_points_correct_place_yaw_and_size(x: float, z: float, yaw: float):
    truth = car(x, z, yaw)
    start = car(x + 0.14, z - 0.14, yaw + 0.087, (4.2, 1.43, 1.78))
    found = align_to_points(start, swept(truth), CAMERA)
    assert found is not None
    before, after = errors(start, truth), errors(found, truth)
    assert after[0] < 0.5 * before[0]
    assert after[1] < 0.3 * before[1]
    assert after[2] < before[2]
    assert found.mesh is start.mesh


def test_points_of_road_walls_and_neighbours_are_excluded():
    truth = car(0.5, 9.0, 0.6)
    points = swept(truth)
    inside = points_near_box(truth, points)
    assert len(inside) > 100
    assert inside[:, 1].max() < 1.65 - 0.15
    assert np.linalg.norm(inside[:, [0, 2]] - [0.5, 9.0], axis=1).max() < 2.9
    neighbour = torch.tensor([[0.5, 1.0, 12.5]]).repeat(300, 1)
    alone, with_neighbour = (align_to_points(truth, p, CAMERA) for p in (points, torch.cat([points, neighbour])))
    assert alone is not None
    assert with_neighbour is not None
    assert torch.equal(alone.translation, with_neighbour.translation)


def test_some_wrong_points_inside_the_box_do_not_spoil_it():
    truth, start = car(0.5, 9.0, 0.6), car(0.64, 8.86, 0.68)
    points = swept(truth)
    count = len(points_near_box(truth, points)) // 6
    rng = np.random.default_rng(1)
    stray = torch.from_numpy(rng.uniform([-0.8, 0.3, 8.0], [1.8, 1.3, 10.0], (count, 3)).astype(np.float32))
    found = align_to_points(start, torch.cat([points, stray]), CAMERA)
    assert found is not None
    assert errors(found, truth)[0] < 0.6 * errors(start, truth)[0]
    assert errors(found, truth)[1] < 0.4 * errors(start, truth)[1]


def test_too_few_points_fit_nothing():
    truth = car(0.5, 9.0, 0.6)
    on_it = torch.from_numpy(points_near_box(truth, swept(truth))).float()
    assert align_to_points(truth, on_it[:20], CAMERA) is None
    assert align_to_points(truth, torch.zeros(0, 3), CAMERA) is None


def test_no_points_move_a_car_beyond_its_label():
    truth, start = car(0.5, 9.0, 0.6), car(1.6, 9.6, 1.3)
    found = align_to_points(start, swept(truth), CAMERA)
    assert found is not None
    limits = BOUND * LABEL_SIGMAS + 1e-5
    assert ((found.translation - start.translation).abs().numpy() <= limits[:3]).all()
    assert abs(float(found.yaw - start.yaw)) <= limits[3]
