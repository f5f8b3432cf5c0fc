"""Whole frames: the same from the same arguments, with labels that fit what is seen."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from drivesem.synth.frames import SynthFrame, SynthSettings, actor_soups, generate_frame, plan_frame, render_frame
from drivesem.synth.view import View, blocks
from drivesem.synth.world import POOLS, surroundings
from scene_ir.errors import RangeError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.types import Camera


@pytest.fixture(scope="module")
def frame() -> SynthFrame:
    return generate_frame(1, 2, with_background=True)


def test_the_same_arguments_give_the_same_bytes(frame):
    again = generate_frame(1, 2)
    assert np.array_equal(again.image, frame.image)
    assert torch.equal(again.labels.boxes_xyxy, frame.labels.boxes_xyxy)
    assert again.manifest == frame.manifest


def test_other_indices_seeds_and_splits_give_other_streets():
    plans = [plan_frame(1, 2), plan_frame(1, 1), plan_frame(2, 0), plan_frame(1, 2, "heldout")]
    cameras = {round(float(p.setting.view.height_m), 9) for p in plans}
    assert len(cameras) == len(plans)


def test_labels_fit_the_projected_boxes(frame):
    labels, camera = frame.labels, frame.camera
    assert len(labels.kind) > 2
    vehicles = [i for i, kind in enumerate(labels.kind) if kind in ("Car", "Van", "Truck")]
    full = project_boxes(labels.size_lhw, labels.yaw, labels.translation, camera.matrix)
    cut = clip_boxes(full, camera.height, camera.width)[vehicles]
    assert (labels.boxes_xyxy[vehicles] - cut)[:, :2].min() > -1.5
    assert (cut - labels.boxes_xyxy[vehicles])[:, 2:].min() > -1.5
    area = (labels.boxes_xyxy[vehicles, 2:] - labels.boxes_xyxy[vehicles, :2]).prod(dim=1)
    assert (area / (cut[:, 2:] - cut[:, :2]).prod(dim=1)).min() > 0.6


def test_occlusion_follows_from_the_visible_share(frame):
    for truth in frame.truths:
        expected = 0 if truth.visible > 0.9 else 1 if truth.visible > 0.5 else 2 if truth.visible > 0.1 else 3
        assert truth.occlusion == expected
        assert 0 <= truth.visible <= 1
        assert 0 <= truth.truncation <= 1


def test_silhouettes_lie_in_their_boxes(frame):
    for truth in frame.truths:
        alpha = truth.opacity.values[0].numpy()
        rows, columns = np.nonzero(alpha > 0)
        x0, y0, x1, y1 = truth.box_xyxy
        assert columns.min() + truth.opacity.x0 >= x0 - 0.5
        assert columns.max() + truth.opacity.x0 <= x1 + 0.5
        assert rows.min() + truth.opacity.y0 >= y0 - 0.5
        assert rows.max() + truth.opacity.y0 <= y1 + 0.5


def test_far_from_actors_and_shadows_the_background_is_the_photograph(frame):
    touched = np.any([b > 0 for b in blocks(frame.owner)], axis=0)
    different = (frame.image != frame.background).any(axis=2)
    assert different[touched].mean() > 0.9
    assert different[:100].sum() <= touched[:110].sum() * 3
    assert different.mean() < 0.5


def test_vehicles_darken_the_ground_and_brighten_nothing(frame):
    touched = np.any([b > 0 for b in blocks(frame.owner)], axis=0)
    grown = np.zeros_like(touched)
    for dy in range(-3, 4):
        for dx in range(-3, 4):
            grown |= np.roll(touched, (dy, dx), (0, 1))
    rise = frame.image.astype(int) - frame.background.astype(int)
    assert rise[~grown].max() <= 2


def test_depth_and_maps_agree_about_the_sky(frame):
    sky = frame.environment.sky.numpy()
    assert np.isinf(frame.background_depth_m[sky == 1]).all()
    assert np.isfinite(frame.background_depth_m[sky == 0]).all()
    assert (frame.environment.sky + frame.environment.road + frame.environment.foliage_map).max() <= 1 + 1e-6


def test_the_ground_plane_holds_every_vehicle(frame):
    plane = frame.environment.ground.double().numpy()
    for truth in frame.truths:
        assert truth.translation @ plane[:3] + plane[3] == pytest.approx(0.0, abs=1e-5)


def test_manifest_names_shapes_of_the_splits_own_pools(frame):
    other = generate_frame(1, 2, "heldout")
    for kind in ("building", "tree", "bush", "surface"):
        assert all(i < 10_000 for i in frame.manifest[kind])
        assert all(i >= 10_000 for i in other.manifest[kind])
    assert all(int(name.split("-")[1]) < 100 for name in frame.manifest["vehicles"])
    assert all(int(name.split("-")[1]) >= 100 for name in other.manifest["vehicles"])


def test_an_unknown_split_is_an_error():
    with pytest.raises(RangeError, match="synth split: expected train or heldout, found test"):
        generate_frame(0, 0, "test")


def test_without_actors_background_and_image_are_equal():
    plan = plan_frame(3, 0, settings=SynthSettings(camera=1))
    found = render_frame(replace(plan, actors=()), with_background=True)
    assert found is not None
    assert np.array_equal(found.image, found.background)
    assert found.labels.kind == ()


def test_surroundings_leave_crossings_free():
    for index in range(12):
        plan = plan_frame(5, index)
        road = plan.setting.road
        if road.crossing is None:
            continue
        soup, _ = surroundings(road, POOLS["train"], np.random.default_rng(index))
        tall = soup.corners[(-soup.corners[..., 1]).max(axis=1) > 0.3]
        middle = tall.mean(axis=1)
        c0, c1 = road.crossing
        low = (-tall[..., 1]).min(axis=1) < 0.2
        inside = (middle[:, 2] > c0 + 1) & (middle[:, 2] < c1 - 1) & (np.abs(middle[:, 0]) < 30) & low
        assert not inside.any()


def test_actors_reach_the_ground_in_camera_axes():
    plan = plan_frame(1, 2)
    view = plan.setting.view
    for soup in actor_soups(plan):
        world = view.to_world(soup.corners + view.centre)
        assert abs(float(world[..., 1].max())) < 0.12


def test_view_turns_back_and_forth():
    rng = np.random.default_rng(0)
    angle = 0.05
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    k = torch.tensor([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    view = View(Camera(k, 375, 1242), turn, 1.65)
    points = rng.normal(0, 10, (20, 3))
    assert view.to_world(view.to_camera(points)) == pytest.approx(points)
    assert view.to_camera(np.zeros(3)) @ view.up == pytest.approx(-1.65)


def test_a_turned_down_frame_is_not_rendered():
    assert render_frame(plan_frame(1, 2), accept=lambda truths: False) is None


def test_shading_only_what_actors_touch_equals_shading_all(frame):
    plan = plan_frame(1, 2)
    empty = render_frame(replace(plan, actors=()))
    assert empty is not None
    assert np.abs(empty.image.astype(int) - frame.background.astype(int)).max() <= 1
