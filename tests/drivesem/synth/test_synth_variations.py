"""One street in all of Virtual KITTI's variations, and as a drive."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from drivesem.synth.exposure import CLASS_NAMES, expose, paint_name
from drivesem.synth.frames import (
    BASELINE_M,
    SynthSettings,
    apply_variation,
    plan_frame,
    render_frame,
    second_camera,
)
from drivesem.synth.layout import LayoutSettings
from drivesem.synth.variations import VARIATIONS, parse_variations
from scene_ir.errors import RangeError
from scene_ir.geometry import yaw_matrix

SETTINGS = SynthSettings(LayoutSettings(people=False), sunny=True, camera="vkitti2")


@pytest.fixture(scope="module")
def plan():
    return plan_frame(5, 3, settings=SETTINGS)


@pytest.fixture(scope="module")
def exposure(plan):
    frame = render_frame(plan)
    assert frame is not None
    return expose(frame, 50)


@pytest.mark.parametrize("name", VARIATIONS)
def test_a_variation_keeps_the_world(plan, name):
    varied = apply_variation(plan, name)
    assert varied.actors == plan.actors
    assert varied.variation == name
    assert varied.setting.view.origin == pytest.approx(plan.setting.view.origin)
    sun = [p.setting.light.up @ p.setting.view.rotation for p in (plan, varied)]
    assert sun[0] == pytest.approx(sun[1])
    assert apply_variation(plan, name).setting.light.haze_per_m == varied.setting.light.haze_per_m


@pytest.mark.parametrize(("name", "degrees"), [("15-deg-left", -15), ("30-deg-right", 30)])
def test_a_turned_camera_sees_the_same_places_elsewhere(plan, name, degrees):
    turned = apply_variation(plan, name).setting.view
    point = np.array([3.0, -1.0, 20.0])
    straight, other = plan.setting.view.to_camera(point), turned.to_camera(point)
    assert np.linalg.norm(straight) == pytest.approx(np.linalg.norm(other))
    angle = np.arctan2(straight[0], straight[2]) - np.arctan2(other[0], other[2])
    assert np.rad2deg(angle) == pytest.approx(degrees, abs=0.4)
    assert turned.to_world(other) == pytest.approx(point)


def test_weathers_differ_as_they_should(plan):
    light = {name: apply_variation(plan, name).setting.light for name in VARIATIONS}
    height = {name: float(entry.sun @ entry.up) for name, entry in light.items()}
    assert height["sunset"] < height["morning"] < height["clone"]
    assert light["fog"].haze_per_m > 5 * light["clone"].haze_per_m
    assert light["rain"].wet > 0.5
    assert light["overcast"].sun_colour.max() == 0
    assert apply_variation(plan, "rain").setting.response.streaks > 0


@pytest.mark.parametrize("text", ["night", "clone,,fog", ""])
def test_unknown_variations_are_errors(text):
    with pytest.raises(RangeError, match="variations: expected all, or names among mixed, clone"):
        parse_variations(text)


def test_all_means_all_in_order():
    assert parse_variations("all") == VARIATIONS
    assert parse_variations("fog, clone,fog") == ("fog", "clone")


def test_frames_of_a_drive_share_the_street_and_move_on():
    settings = SynthSettings(LayoutSettings(people=False, vehicles=(8, 12)), sunny=True, sequence=5)
    drive = [plan_frame(1, index, settings=settings) for index in (5, 6, 9)]
    assert drive[0].origin == drive[1].origin == drive[2].origin
    assert [p.time_s for p in drive] == pytest.approx([0.0, 0.1, 0.4])
    assert plan_frame(1, 10, settings=settings).origin != drive[0].origin
    way = [np.hypot(*p.setting.view.position_xz) for p in drive]
    assert way[2] == pytest.approx(4 * way[1], rel=1e-3)
    tracks = [[a.track for a in p.actors] for p in drive]
    assert tracks[0] == tracks[1] == tracks[2]
    for before, after in zip(drive[0].actors, drive[2].actors, strict=True):
        moved = np.hypot(*np.subtract(after.position_xz, before.position_xz))
        assert moved == pytest.approx(abs(before.speed_mps) * 0.4, rel=0.05, abs=1e-9)
        # A car heads where it drives: its way is along its length.
        if before.speed_mps:
            heading = np.array([np.cos(before.yaw), -np.sin(before.yaw)])
            way_xz = np.subtract(after.position_xz, before.position_xz)
            assert way_xz @ heading == pytest.approx(moved, rel=0.02)


def test_the_second_camera_stands_to_the_right(plan):
    right = second_camera(plan).setting.view
    point = np.array([1.0, -1.0, 15.0])
    shift = plan.setting.view.to_camera(point) - right.to_camera(point)
    assert shift == pytest.approx([BASELINE_M, 0, 0], abs=1e-12)


def test_exposure_matches_the_frame(plan, exposure):
    assert exposure.class_names == CLASS_NAMES
    assert (exposure.depth_cm == 65535).mean() == pytest.approx(
        (exposure.classes == CLASS_NAMES.index("Sky")).mean(), abs=1e-6
    )
    vehicle = np.isin(exposure.classes, [CLASS_NAMES.index(name) for name in ("Car", "Van", "Truck")])
    assert np.array_equal(vehicle, exposure.instances > 0)
    for found in exposure.objects:
        mask = exposure.instances == found.track + 1
        assert mask.sum() == found.pixels
        if found.pixels:
            rows, columns = np.nonzero(mask)
            left, top, right, bottom = found.box_ltrb
            assert columns.min() >= left
            assert columns.max() <= right
            assert rows.min() >= top
            assert rows.max() <= bottom
            if found.visible > 0.999:
                assert (columns.min(), rows.min()) == (left, top)
    assert sum(o.labelled for o in exposure.objects) == len(exposure.labels.kind)
    assert {o.track for o in exposure.objects} <= {a.track + 50 for a in plan.actors}


def test_poses_in_camera_and_world_agree_by_the_extrinsic(exposure):
    assert exposure.objects
    for found in exposure.objects:
        world = np.array([*found.world, 1.0])
        assert (exposure.extrinsic @ world)[:3] == pytest.approx(found.translation, abs=1e-9)
        assert found.world[1] == pytest.approx(0, abs=1e-9)
        y, x, z = found.world_yxz
        about = {
            "y": yaw_matrix(torch.tensor(y, dtype=torch.float64)).numpy(),
            "x": np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]),
            "z": np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]),
        }
        rotation = exposure.extrinsic[:3, :3] @ about["y"] @ about["x"] @ about["z"]
        expected = yaw_matrix(torch.tensor(found.yaw, dtype=torch.float64)).numpy()
        assert rotation == pytest.approx(expected, abs=1e-9)


def test_paints_have_the_names_people_use():
    assert paint_name((0.8, 0.78, 0.79)) == "White"
    assert paint_name((0.3, 0.02, 0.02)) == "Red"
    assert paint_name((0.015, 0.02, 0.018)) == "Black"
