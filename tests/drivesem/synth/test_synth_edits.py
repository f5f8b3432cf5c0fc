"""Edits of generated scenes: read from files, applied to plans, rendered by the generator itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from drivesem.synth.edits import ALL, FrameEdit, ObjectEdit, apply_edit, apply_edits, read_edits
from drivesem.synth.frames import SynthSettings, plan_frame, render_frame
from drivesem.synth.layout import LayoutSettings, clearance, footprint
from scene_ir.errors import FormatError, RangeError
from scene_ir.ffd import SYMMETRIC_DIM
from scene_ir.render.environment import apply_weather, sky_colour

SETTINGS = SynthSettings(LayoutSettings(people=False, vehicles=(6, 8)), sunny=True)


@pytest.fixture(scope="module")
def plan():
    return plan_frame(9, 2, settings=SETTINGS)


def write(tmp_path, text):
    path = tmp_path / "edits.yaml"
    path.write_text(text)
    return path


def test_an_empty_edit_returns_the_plan(plan):
    assert apply_edit(plan, FrameEdit(objects={ALL: ObjectEdit()})) == plan


def test_translate_is_along_the_length_and_across_to_the_left(plan):
    actor = plan.actors[0]
    edit = FrameEdit(objects={actor.track: ObjectEdit(translate=(0.1, 0.0), translate_m=(0.5, 0.25))})
    moved = apply_edit(plan, edit).actors[0]
    shift = np.subtract(moved.position_xz, actor.position_xz)
    front = np.array([np.cos(actor.yaw), -np.sin(actor.yaw)])
    left = np.array([np.sin(actor.yaw), np.cos(actor.yaw)])
    assert shift @ front == pytest.approx(0.1 * actor.size_lhw[0] + 0.5)
    assert shift @ left == pytest.approx(0.25)


def test_a_size_is_of_all_three_sides(plan):
    actor = plan.actors[0]
    grown = apply_edit(plan, FrameEdit(objects={actor.track: ObjectEdit(size=0.1)})).actors[0]
    assert grown.size_lhw == pytest.approx([1.1 * side for side in actor.size_lhw])
    assert grown.position_xz == actor.position_xz


def test_a_share_of_a_shape_is_refused(plan):
    edit = FrameEdit(objects={ALL: ObjectEdit(mesh_fraction=0.5)})
    with pytest.raises(RangeError, match=r"mesh: expected lattice offsets; .* found 50%"):
        apply_edit(plan, edit)


def test_the_sun_moves_about_the_vertical_and_shines_stronger(plan):
    light = plan.setting.light
    moved = apply_edit(plan, FrameEdit(sun=(1.0, 0.5, 1.0))).setting.light
    rise = math.degrees(math.asin(moved.sun @ light.up) - math.asin(light.sun @ light.up))
    assert rise == pytest.approx(3.75, abs=0.01)
    flat = [sun - (sun @ light.up) * light.up for sun in (light.sun, moved.sun)]
    flat = [way / np.linalg.norm(way) for way in flat]
    assert math.degrees(math.acos(flat[0] @ flat[1])) == pytest.approx(15, abs=0.01)
    # To the right: x is right, z ahead.
    assert np.cross(flat[0], flat[1]) @ light.up < 0
    assert moved.sun_colour == pytest.approx(1.2 * light.sun_colour)
    assert np.linalg.norm(moved.sun) == pytest.approx(1)


def test_it_moves_as_the_compositor_moves_it(plan):
    from drivesem.attacks.space import ground_axes

    actor = plan.actors[1]
    view = plan.setting.view
    ground = torch.tensor([*view.up, view.height_m])
    yaw = torch.tensor([actor.yaw - view.heading], dtype=torch.float64)
    axes = ground_axes(yaw, torch.tensor([actor.size_lhw[0]], dtype=torch.float64), ground)[0].numpy()
    moved = apply_edit(plan, FrameEdit(objects={actor.track: ObjectEdit(translate=(0.2, -0.1))})).actors[1]
    stand = [view.to_camera(np.array([a.position_xz[0], 0.0, a.position_xz[1]])) for a in (actor, moved)]
    assert stand[1] - stand[0] == pytest.approx(0.2 * axes[0] - 0.1 * axes[1], abs=2e-3)


def test_what_was_removed_is_gone_and_tracks_stay(plan):
    gone = plan.actors[1].track
    edited = apply_edit(plan, FrameEdit(objects={gone: ObjectEdit(remove=True)}))
    assert [a.track for a in edited.actors] == [a.track for a in plan.actors if a.track != gone]
    frame = render_frame(edited)
    assert frame is not None
    assert gone + 1 not in np.unique(frame.instance)


def test_paint_mesh_and_pose_show_in_the_picture_and_in_the_truth(plan):
    before = render_frame(plan)
    assert before is not None
    truth = max(before.truths, key=lambda t: t.opacity.values.sum() * t.visible)
    track = truth.actor.track
    mesh = [0.0] * SYMMETRIC_DIM
    mesh[1::3] = [-0.05] * len(mesh[1::3])
    edit = ObjectEdit(rotate=0.2, color=(0.6, 0.8, 0.0, 0.0, 0.0), mesh=tuple(mesh))
    after = render_frame(apply_edit(plan, FrameEdit(objects={track: edit})))
    assert after is not None
    changed = next(t for t in after.truths if t.actor.track == track)
    assert changed.yaw == pytest.approx((truth.yaw + 0.2 + np.pi) % (2 * np.pi) - np.pi)
    assert changed.actor.paint != truth.actor.paint
    region = before.instance == track + 1
    assert (before.image[region] != after.image[region]).any(axis=1).mean() > 0.5
    far = ~(region | (after.instance == track + 1))
    assert (before.image[far] != after.image[far]).any(axis=1).mean() < 0.4


def test_a_turned_deformed_mesh_rises_with_its_lattice(plan):
    track = plan.actors[0].track
    mesh = [0.0] * SYMMETRIC_DIM
    mesh[1::3] = [-0.1] * len(mesh[1::3])
    from drivesem.synth.frames import actor_soups

    bent = apply_edit(plan, FrameEdit(objects={track: ObjectEdit(mesh=tuple(mesh))}))
    low, high = actor_soups(plan)[0].corners[..., 1].min(), actor_soups(bent)[0].corners[..., 1].min()
    assert low - high == pytest.approx(0.1 * plan.actors[0].size_lhw[1], abs=1e-3)


def test_weather_and_foliage_codes_change_the_whole_street(plan):
    plain = render_frame(plan)
    foggy = render_frame(apply_edit(plan, FrameEdit(weather=(1.0, 0.0, 0.0, 0.0, 0.0))))
    autumn = render_frame(apply_edit(plan, FrameEdit(foliage=(1.0, 0.0, 0.0))))
    assert plain is not None
    assert foggy is not None
    assert autumn is not None
    assert np.array_equal(plain.instance, foggy.instance)
    land = np.isfinite(plain.depth_m) & (plain.depth_m > 60)
    assert foggy.image[land].std() < 0.7 * plain.image[land].std()
    leaf = plain.environment.foliage_map.numpy() > 0.9
    redder = autumn.image[leaf].astype(float) - plain.image[leaf].astype(float)
    assert redder[:, 0].mean() > redder[:, 1].mean() + 3


@pytest.mark.parametrize("time", [0.5, 1.0])
def test_sunset_and_twilight_are_the_compositors(plan, time):
    weather = (0.0, 0.0, time, 0.0, 0.0)
    plain, drawn = render_frame(plan), render_frame(apply_edit(plan, FrameEdit(weather=weather)))
    assert plain is not None
    assert drawn is not None
    picture = torch.from_numpy(plain.image).permute(2, 0, 1).double() / 255
    inverse = torch.from_numpy(1.0 / np.maximum(plain.depth_m, 1.0)).double()
    environment = replace(plain.environment, weather=torch.tensor(weather, dtype=torch.float64))
    composed = apply_weather(picture, inverse, environment, sky_colour(picture, environment.sky.double()))
    expected = drawn.image.reshape(-1, 3).mean(axis=0) / 255
    assert composed.flatten(1).mean(dim=1).numpy() == pytest.approx(expected, rel=0.2)


def test_bare_trees_have_fewer_leaves_and_dense_ones_no_fewer(plan):
    from drivesem.synth.seasons import leaved
    from drivesem.synth.soup import Material
    from drivesem.synth.world import POOLS, surroundings

    street, _ = surroundings(plan.setting.road, POOLS["train"], np.random.default_rng(1))
    leaves = [int((leaved(street, (0.0, 0.0, d)).material == Material.LEAF).sum()) for d in (-1.0, -0.5, 0.0, 1.0)]
    assert leaves[0] < leaves[1] < leaves[2] == leaves[3]
    assert leaved(street, (0.0, 0.0, 0.0)) is street


def test_edits_for_all_frames_come_before_those_of_one(plan):
    track = plan.actors[0].track
    edits = {
        ALL: FrameEdit(objects={track: ObjectEdit(translate_m=(1.0, 0.0))}),
        2: FrameEdit(objects={track: ObjectEdit(translate_m=(1.0, 0.0))}),
    }
    way = [
        np.hypot(*np.subtract(apply_edits(plan, edits, frame).actors[0].position_xz, plan.actors[0].position_xz))
        for frame in (1, 2)
    ]
    assert way == pytest.approx([1.0, 2.0])


def test_file_in_physical_units(tmp_path):
    path = write(
        tmp_path,
        "frames:\n  all: {weather: {fog: 0.5}, foliage: {hue: -0.5}}\n"
        "  3:\n    objects:\n      2: {translate: [0.5m, -0.1], rotate: 10deg}\n"
        "      all: {color: [0.1, 0, 0, 0, 0]}\n",
    )
    edits = read_edits(path)
    assert edits[ALL] == FrameEdit(weather=(0.5, 0, 0, 0, 0), foliage=(-0.5, 0, 0))
    assert edits[3].objects[2] == ObjectEdit(
        translate=(0.0, -0.1), translate_m=(0.5, 0.0), rotate=pytest.approx(np.deg2rad(10))
    )
    assert edits[3].objects[ALL].color[0] == 0.1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frames: [1]", "frames: expected a mapping, found list"),
        ("frame: {}", "frame: expected one of frames, found an unknown key"),
        ("frames: {1: {weather: {fog: 2}}}", r"frame 1: weather.fog: expected a code in \[0, 1\], found 2.0"),
        ("frames: {-1: {}}", "frames: expected a number from 0, or all, found -1"),
        (
            "frames: {1: {objects: {2: {rotate: fast}}}}",
            "object 2: rotate: expected a finite number, found 'fast'",
        ),
        ("frames: {1: {objects: {2: {translate: 3}}}}", "object 2: translate: expected a list of 2, found 3"),
        ("frames: {1: {objects: {2: {color: [2, 0, 0, 0, 0]}}}}", r"object 2: expected 5 codes in \[-1, 1\]"),
        ("frames: {1: {objects: {2: {remove: 1}}}}", "object 2: remove: expected true or false, found 1"),
        ("frames: {1: {objects: {2: {turn: 1}}}}", "object 2: turn: expected one of translate, rotate"),
        ("frames: {", "expected YAML"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, text, message):
    with pytest.raises(FormatError, match=message) as error:
        read_edits(write(tmp_path, text))
    assert "\n" not in str(error.value)


def test_an_unknown_track_is_named(plan):
    with pytest.raises(RangeError, match="frame 2: object 99: expected a track among"):
        apply_edits(plan, {2: FrameEdit(objects={99: ObjectEdit(remove=True)})}, 2)


def test_actors_do_not_overlap_before_edits(plan):
    outlines = [footprint(a.position_xz, a.yaw, a.size_lhw) for a in plan.actors]
    assert min(clearance(a, b) for i, a in enumerate(outlines) for b in outlines[:i]) > 0


def test_the_plan_is_untouched_by_edits(plan):
    copy = replace(plan)
    apply_edit(plan, FrameEdit(objects={ALL: ObjectEdit(remove=True)}))
    assert plan == copy
