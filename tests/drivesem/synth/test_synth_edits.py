"""Edits of generated scenes: read from files, applied to plans, rendered by the generator itself."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from drivesem.synth.edits import ALL, FrameEdit, ObjectEdit, apply_edit, apply_edits, draw_night, read_edits
from drivesem.synth.frames import Plan, SynthFrame, SynthSettings, plan_frame, render_frame
from drivesem.synth.lamps import beam_share
from drivesem.synth.layout import LayoutSettings, clearance, footprint
from drivesem.synth.render import with_flakes
from scene_ir.errors import FormatError, RangeError
from scene_ir.ffd import SYMMETRIC_DIM
from scene_ir.geometry import yaw_matrix
from scene_ir.meshes.templates import template
from scene_ir.render.environment import apply_weather, sky_colour
from scene_ir.render.lamps import find_lamp_places
from scene_ir.types import Weather

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
    foggy = render_frame(apply_edit(plan, FrameEdit(weather=weather(fog=1.0))))
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
    weather = (0.0, 0.0, time, 0.0, 0.0, 0.0)
    plain, drawn = render_frame(plan), render_frame(apply_edit(plan, FrameEdit(weather=weather)))
    assert plain is not None
    assert drawn is not None
    picture = torch.from_numpy(plain.image).permute(2, 0, 1).double() / 255
    inverse = torch.from_numpy(1.0 / np.maximum(plain.depth_m, 1.0)).double()
    environment = replace(plain.environment, weather=torch.tensor(weather, dtype=torch.float64))
    composed = apply_weather(picture, inverse, environment, sky_colour(picture, environment.sky.double()))
    expected = drawn.image.reshape(-1, 3).mean(axis=0) / 255
    assert composed.flatten(1).mean(dim=1).numpy() == pytest.approx(expected, rel=0.2)


def weather(**codes: float) -> tuple[float, ...]:
    return tuple(codes.get(code.name.lower(), 0.0) for code in Weather)


def render_edit(plan: Plan, **edit: Any) -> SynthFrame:
    frame = render_frame(apply_edit(plan, FrameEdit(**edit)))
    assert frame is not None
    return frame


NIGHT = weather(night=1.0)


def test_night_leaves_the_labels_and_gives_the_same_bytes_again(plan):
    day, night, again = render_edit(plan), *(render_edit(plan, weather=NIGHT) for _ in range(2))
    assert torch.equal(day.labels.boxes_xyxy, night.labels.boxes_xyxy)
    assert np.array_equal(day.depth_m, night.depth_m)
    assert np.array_equal(day.instance, night.instance)
    assert np.array_equal(day.semantic, night.semantic)
    assert night.image.tobytes() == again.image.tobytes()


def test_daylight_falls_with_the_code_of_night(plan):
    frames = [render_edit(plan, weather=weather(night=code)) for code in (0.0, 0.01, 0.25, 0.5, 0.75, 1.0)]
    sky = frames[0].environment.sky.numpy() > 0.9
    levels = [float(frame.image[sky].mean()) for frame in frames]
    assert levels == sorted(levels, reverse=True)
    assert levels[0] - levels[1] < 4
    assert frames[-1].image.mean() < 0.5 * frames[0].image.mean()


def test_lamps_by_day_leave_the_picture_unless_they_brake(plan):
    day, off, brake = (render_edit(plan, objects={ALL: ObjectEdit(lamps=code)}) for code in (0.0, -1.0, 1.0))
    assert day.image.tobytes() == off.image.tobytes()
    redder = brake.image[..., 0].astype(int) - day.image[..., 0]
    assert redder.max() > 40
    assert (redder[day.instance == 0] > 40).mean() < 1e-3


def lamps_in_picture(frame: SynthFrame, mirrored: bool) -> list[tuple[int, int]]:
    """Pixels (x, y) of the template's lamps that face the camera, or of their mirror images below the road."""
    view, found = frame.setting.view, []
    for truth in frame.truths:
        places = find_lamp_places(template(truth.actor.kind, truth.actor.variant)).numpy() * truth.actor.size_lhw
        turn = yaw_matrix(torch.tensor(truth.yaw, dtype=torch.float64)).numpy()
        points = places @ turn.T + truth.translation
        axes = np.array([turn[:, 0] * sign for sign in (1, 1, -1, -1)])
        points = points[(points * axes).sum(axis=1) < 0]
        if mirrored:
            points = points - 2 * (points @ view.up + view.height_m)[:, None] * view.up
        clip = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ view.camera.matrix.double().numpy().T
        found += [(int(x), int(y)) for x, y in np.rint(clip[:, :2] / clip[:, 2:])]
    return found


@pytest.fixture(scope="module")
def two_cars(plan):
    """One car ahead, seen from behind, and one that comes towards the camera."""
    car = replace(plan.actors[0], parked=False, lane_ds=None)
    away = replace(car, position_xz=(1.0, 12.0), yaw=-math.pi / 2)
    coming = replace(car, position_xz=(-3.5, 15.0), yaw=math.pi / 2, track=1)
    return replace(plan, actors=(away, coming))


def test_lamps_shine_where_vehicles_have_them(two_cars):
    lit, off = (render_edit(two_cars, weather=NIGHT, objects={ALL: ObjectEdit(lamps=c)}) for c in (0.0, -1.0))
    change = lit.image.astype(int) - off.image
    places = lamps_in_picture(lit, mirrored=False)
    assert len(places) == 4
    for x, y in places:
        assert change[y - 2 : y + 3, x - 2 : x + 3, 0].max() > 60
    rear, front = (
        [change[y - 2 : y + 3, x - 2 : x + 3].max(axis=(0, 1)) for x, y in p] for p in (places[:2], places[2:])
    )
    assert min(colour[0] - colour[2] for colour in rear) > 30
    assert min(colour[2] for colour in front) > 60


def test_a_wet_road_mirrors_tail_lamps(two_cars):
    red = {}
    for rain in (0.0, 1.0):
        codes = weather(night=1.0, rain=rain)
        on, off = (render_edit(two_cars, weather=codes, objects={0: ObjectEdit(lamps=c)}) for c in (1.0, -1.0))
        change = on.image.astype(int) - off.image
        places = lamps_in_picture(on, mirrored=True)[:2]
        red[rain] = [(change[y - 3 : y + 4, x - 3 : x + 4] @ [1, 0, -1]).max() for x, y in places]
    assert min(red[1.0]) > 25
    assert min(red[1.0]) > 2 * max(red[0.0])


def test_a_parked_car_is_dark_by_night(plan):
    parked = replace(plan, actors=tuple(replace(a, parked=True) for a in plan.actors))
    auto, off = (
        render_edit(parked, weather=NIGHT, objects={ALL: ObjectEdit(lamps=code)}).image for code in (0.0, -1.0)
    )
    assert auto.tobytes() == off.tobytes()


def test_headlamps_light_what_is_near_and_below_their_cut_off():
    axis, up = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
    degrees = np.deg2rad([-6.0, -2.0, 2.0, 10.0])
    rise = beam_share(np.stack([0 * degrees, -np.sin(degrees), np.cos(degrees)], axis=1), axis, up)
    assert rise[1] > rise[0] > 10 * rise[2]
    assert rise[2] == pytest.approx(rise[3], rel=0.05)
    turn = np.deg2rad([0.0, 15.0, 40.0, 89.0, 120.0])
    down = np.sin(0.04)
    aside = beam_share(np.stack([np.sin(turn), np.full(5, down), np.cos(turn)], axis=1), axis, up)
    assert (np.diff(aside[:4]) < 0).all()
    assert aside[4] == 0


def test_snow_falls_from_a_closed_sky_and_pales_the_ground(plan):
    clouds, snow, again = (
        render_edit(plan, weather=codes) for codes in (weather(overcast=1.0), weather(snow=1.0), weather(snow=1.0))
    )
    assert snow.image.tobytes() == again.image.tobytes()
    assert torch.equal(clouds.labels.boxes_xyxy, snow.labels.boxes_xyxy)
    assert np.array_equal(clouds.depth_m, snow.depth_m)
    road = (clouds.environment.road.numpy() > 0.9) & (clouds.depth_m < 15)
    assert road.sum() > 1000
    assert snow.image[road].mean() > 1.1 * clouds.image[road].mean()


def test_flakes_are_before_what_is_seen_and_bright_in_the_beam_by_night(plan):
    height, width = plan.setting.view.camera.height, plan.setting.view.camera.width
    grey = np.full((height, width, 3), 0.1, np.float32)
    day, night = (
        apply_edit(plan, FrameEdit(weather=weather(snow=1.0, night=code))).setting for code in (0.0, 1.0)
    )
    assert with_flakes(grey, np.full((height, width), np.inf), plan.setting) is grey
    assert np.array_equal(with_flakes(grey, np.full((height, width), 0.8), day), grey)
    shares = [(with_flakes(grey, np.full((height, width), d), day) > 0.15).mean() for d in (4.0, 200.0)]
    assert 0 < shares[0] < shares[1] < 0.1
    lit = with_flakes(grey, np.full((height, width), np.inf), night) - grey
    assert lit[height // 2 + 100 :].mean() > 2 * lit[: height // 2].mean() > 0


def test_nights_are_drawn_for_a_share_of_streets():
    plans = [draw_night(plan_frame(3, i, settings=SETTINGS), 0.5) for i in range(40)]
    nights = [plan for plan in plans if plan.setting.light.night > 0]
    assert 10 < len(nights) < 30
    assert 0 < sum(plan.setting.light.wet > 0 for plan in nights) < len(nights)
    assert {a.lamps < 0 for plan in nights for a in plan.actors} == {True, False}
    plain = plan_frame(3, 0, settings=SETTINGS)
    assert draw_night(plain, 0.0) is plain


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
    assert edits[ALL] == FrameEdit(weather=(0.5, 0, 0, 0, 0, 0), foliage=(-0.5, 0, 0))
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
