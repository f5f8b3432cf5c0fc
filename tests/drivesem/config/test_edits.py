"""What people write to change a scene, and what it does to one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from drivesem.attacks.feasibility_check import check_places
from drivesem.attacks.scene_edits import apply_changes, apply_edit
from drivesem.attacks.space import Budget, ParameterSpace, Perturbation
from drivesem.config.edits import (
    ALL,
    WEATHER_CODES,
    WEATHER_PRESETS,
    FrameEdit,
    ObjectEdit,
    merge_edits,
    parse_frame_edit,
    parse_setting,
    read_frame_edit,
)
from drivesem.synth.demo import demo_scene
from scene_ir.errors import FormatError, RangeError
from scene_ir.ffd import SYMMETRIC_DIM
from scene_ir.types import SceneIR

Street = Callable[..., SceneIR]


def edit_of(*settings: str) -> FrameEdit:
    changes: dict[Any, Any] = {}
    for text in settings:
        changes = merge_edits(changes, parse_setting(text))
    return parse_frame_edit("edit", changes)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("objects[2].translate=0.5m,0m", {2: ObjectEdit(translate_m=(0.5, 0.0))}),
        ("objects[2].translate = -0.5m , 0", {2: ObjectEdit(translate_m=(-0.5, 0.0))}),
        ("objects[0].rotate=10deg", {0: ObjectEdit(rotate=math.radians(10))}),
        ("objects[0].rotate=-0.1rad", {0: ObjectEdit(rotate=-0.1)}),
        ("objects[1].color=0.3,0,0,0,0", {1: ObjectEdit(color=(0.3, 0, 0, 0, 0))}),
        ("objects[all].rotate=0", {ALL: ObjectEdit()}),
        ("objects[3].size=-5%", {3: ObjectEdit(size=-0.05)}),
        ("objects[12].remove=true", {12: ObjectEdit(remove=True)}),
        ("objects[1].mesh=60%", {1: ObjectEdit(mesh_fraction=0.6)}),
        (f"objects[1].mesh={','.join(['0.1'] * SYMMETRIC_DIM)}", {1: ObjectEdit(mesh=(0.1,) * SYMMETRIC_DIM)}),
    ],
)
def test_settings_of_objects(text: str, expected: dict[int | str, ObjectEdit]) -> None:
    assert edit_of(text) == FrameEdit(objects=expected)


def test_settings_of_the_scene() -> None:
    assert edit_of("weather.rain=0.4", "foliage.hue=-0.5") == FrameEdit(
        weather=(0.0, 0.4, 0.0, 0.0, 0.0, 0.0), foliage=(-0.5, 0.0, 0.0)
    )
    assert edit_of("weather=fog=0.6,night=1").weather == (0.6, 0.0, 0.0, 0.0, 1.0, 0.0)
    assert edit_of("weather=snow").weather == (0.0, 0.0, 0.0, 0.0, 0.0, 0.6)
    assert edit_of("weather.rain=0.4", "weather=fog=0.6").weather == (0.6, 0.0, 0.0, 0.0, 0.0, 0.0)
    for name, codes in WEATHER_PRESETS.items():
        assert edit_of(f"weather={name}").weather == tuple(codes.get(code, 0.0) for code in WEATHER_CODES)


def test_a_fraction_of_a_deformation_needs_one(street: Street) -> None:
    scene = street()
    offsets = torch.zeros_like(scene.objects.ffd)
    offsets[2, 5] = torch.tensor([0.1, -0.05, 0.02])
    bent = scene.with_objects(ffd=scene.objects.ffd + offsets)
    edit = edit_of("objects[2].mesh=25%")
    torch.testing.assert_close(apply_changes(scene, edit, bent).objects.ffd, 0.25 * offsets)
    both = edit_of("objects[all].mesh=25%", "objects[2].mesh=50%")
    torch.testing.assert_close(apply_changes(scene, both, bent).objects.ffd, 0.75 * offsets)
    message = r"objects\[2\]\.mesh: expected lattice offsets; shares need .* --photographed, found 25%"
    with pytest.raises(RangeError, match=message):
        apply_changes(scene, edit)
    for text in ("101%", "-1%"):
        with pytest.raises(FormatError, match="expected a fraction from 0% to 100%"):
            edit_of(f"objects[2].mesh={text}")
    with pytest.raises(FormatError, match=r"expected a unit: 0\.5%"):
        parse_frame_edit("edit", {"objects": {2: {"mesh": "0.5"}}})


def test_the_sun_is_a_code_of_the_scene(street: Street) -> None:
    edit = edit_of("sun.azimuth=-0.5", "sun.strength=1")
    assert edit == FrameEdit(sun=(-0.5, 0.0, 1.0))
    assert apply_edit(street(), edit).scene.environment.light.tolist() == [-0.5, 0.0, 1.0]
    with pytest.raises(FormatError, match=r"sun: height: expected one of azimuth, elevation, strength"):
        edit_of("sun.height=1")
    with pytest.raises(FormatError, match=r"sun.azimuth: expected a code in \[-1, 1\], found 2.0"):
        edit_of("sun.azimuth=2")


def test_lamps_by_name_or_code(street: Street) -> None:
    scene = street()
    for text, code in (("off", -1.0), ("auto", 0.0), ("brake", 1.0), ("0.5", 0.5)):
        after = apply_changes(scene, edit_of(f"objects[1].lamps={text}"))
        assert after.objects.lamps.tolist() == [0.0, code, 0.0, 0.0]
    assert parse_frame_edit("edit", {"objects": {1: {"lamps": False}}}).objects[1].lamps == -1.0
    for text in ("blink", "2"):
        with pytest.raises(FormatError, match=r"lamps?: expected off, auto, brake, or a code|expected off, auto"):
            edit_of(f"objects[1].lamps={text}")


def test_night_on_a_photograph_by_night_has_a_note(street: Street) -> None:
    scene = street(positions_xz=())
    edit = edit_of("weather=night")
    note = "weather.night: the photograph is taken by night, so the code changes little"
    assert note in apply_edit(replace(scene, photograph=torch.full_like(scene.photograph, 0.1)), edit).notes
    assert note not in apply_edit(replace(scene, photograph=torch.full_like(scene.photograph, 0.5)), edit).notes


def test_later_settings_of_the_same_parameter_win() -> None:
    assert edit_of("objects[1].rotate=1deg", "objects[1].rotate=2deg").objects[1].rotate == math.radians(2)
    both = edit_of("objects[1].rotate=1deg", "objects[1].translate=1m,0m").objects[1]
    assert both == ObjectEdit(translate_m=(1.0, 0.0), rotate=math.radians(1))
    assert edit_of("weather.rain=0.4", "weather=sunset").weather == edit_of("weather=sunset").weather
    fog = WEATHER_PRESETS["fog"]["fog"]
    assert edit_of("weather=fog", "weather.rain=0.4").weather[:2] == (fog, 0.4)


def test_a_file_and_the_command_line_give_the_same_edit(tmp_path: Path) -> None:
    path = tmp_path / "edit.yaml"
    path.write_text(
        "weather: fog\nobjects:\n  2: {translate: [0.5m, 0m], rotate: 10deg}\n  all: {color: [0.1, 0, 0, 0, 0]}\n"
    )
    written = edit_of(
        "weather=fog", "objects[2].translate=0.5m,0m", "objects[2].rotate=10deg", "objects[all].color=0.1,0,0,0,0"
    )
    assert parse_frame_edit("edit", read_frame_edit(path)) == written
    path.write_text("")
    assert read_frame_edit(path) == {}


def test_bare_numbers_of_a_file_are_in_units_of_theta() -> None:
    entry = {"objects": {0: {"translate": [0.1, "1m"], "rotate": 0.2}}}
    assert parse_frame_edit("edit", entry).objects[0] == ObjectEdit(
        translate=(0.1, 0.0), translate_m=(0.0, 1.0), rotate=0.2
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("objects[2].rotate=10", "object 2: rotate: expected a unit: 10deg or 10rad, found '10'"),
        ("objects[2].translate=1,0", "object 2: translate: expected a unit: 1m, found '1'"),
        ("objects[2].translate=1m", "object 2: translate: expected a list of 2"),
        ("objects[2].translate=1m,inf m", "expected a finite number, found 'inf '"),
        ("objects[2].rotate=fastdeg", "expected a finite number, found 'fast'"),
        (
            "objects[2].wheels=4",
            "object 2: wheels: expected one of translate, rotate, color, mesh, size, lamps, remove",
        ),
        ("objects[2].color=3,0,0,0,0", "expected 5 codes in"),
        ("objects[2].color=0,0", "color: expected a list of 5"),
        ("objects[2].remove=yes", "remove: expected true or false, found 'yes'"),
        ("objects[-1].rotate=1deg", "objects: expected a number from 0, or all, found '-1'"),
        ("objects[two].rotate=1deg", "objects: expected a number from 0, or all, found 'two'"),
        (
            "weather=hail",
            "weather: expected codes such as fog=0.6,night=1, or one of fog, rain, sunset, overcast, twilight, night, "
            "snow, found 'hail'",
        ),
        ("weather=hail=1", "weather: hail: expected one of fog, rain, time, overcast, night, snow"),
        ("weather=night=2", r"weather.night: expected a code in \[0, 1\], found 2.0"),
        ("weather=fog=0.5,night", "weather: expected codes such as"),
        ("weather.hail=1", "weather: hail: expected one of fog, rain, time, overcast"),
        ("weather.fog=2", r"weather.fog: expected a code in \[0, 1\], found 2.0"),
        ("foliage=autumn", "an unknown parameter"),
        ("objects.rotate=1deg", "an unknown parameter"),
        ("wheels=4", "an unknown parameter"),
        ("weather=", "no value"),
        ("weather", "no value"),
    ],
)
def test_a_bad_setting_is_one_line_that_repeats_it(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message) as error:
        parse_setting(text)
    assert str(error.value).startswith(f"--set {text}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("objects: [1]", "objects: expected a mapping, found list"),
        ("frames: {}", "frames: expected one of objects, weather, foliage, sun, drops, found an unknown key"),
        ("objects: {1: {rotate: '10'}}", "object 1: rotate: expected a unit"),
        ("- 1", "expected a mapping, found list"),
        ("{", "expected YAML"),
    ],
)
def test_a_bad_file_is_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "edit.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=message) as error:
        read_frame_edit(path)
    assert str(error.value).startswith(str(path))


def test_metres_along_the_heading_and_to_the_left(street: Street) -> None:
    scene = street(yaw=0.3, tilt=0.02)
    after = apply_changes(scene, edit_of("objects[1].translate=0.5m,0.25m", "objects[1].rotate=10deg"))
    shift = after.objects.translation - scene.objects.translation
    assert not shift[[0, 2, 3]].any()
    front = torch.tensor([math.cos(0.3), 0.0, -math.sin(0.3)])
    left = torch.tensor([math.sin(0.3), 0.0, math.cos(0.3)])
    assert float(shift[1] @ front) == pytest.approx(0.5, abs=1e-6)
    assert float(shift[1] @ left) == pytest.approx(0.25, abs=1e-6)
    plane = scene.environment.ground
    assert float(plane[:3] @ shift[1]) == pytest.approx(0.0, abs=1e-6)
    assert float(after.objects.yaw[1] - scene.objects.yaw[1]) == pytest.approx(math.radians(10), abs=1e-6)


def test_it_moves_as_theta_does(street: Street) -> None:
    scene = street()
    generator = torch.Generator().manual_seed(0)
    count = len(scene.objects)

    def rows(*shape: int) -> torch.Tensor:
        return 0.1 * torch.randn(*shape, generator=generator)

    change = Perturbation(
        color=rows(count, 5), translate=rows(count, 2), rotate=rows(count, 1), mesh=rows(count, SYMMETRIC_DIM),
        weather=rows(6).abs(), foliage=rows(3),
    )  # fmt: skip
    params = ["color", "weather", "foliage", "translate", "rotate", "mesh"]
    space = ParameterSpace(scene, params, Budget(night=1.0, snow=1.0))
    expected = space.apply(scene, space.flatten(change))
    assert change.translate is not None
    assert change.rotate is not None
    assert change.color is not None
    assert change.mesh is not None
    assert change.weather is not None
    assert change.foliage is not None
    objects = {}
    for i in range(count):
        along, across = change.translate[i].tolist()
        objects[i] = ObjectEdit(
            translate=(along, across),
            rotate=float(change.rotate[i, 0]),
            color=tuple(change.color[i].tolist()),
            mesh=tuple(change.mesh[i].tolist()),
        )
    edit = FrameEdit(objects, tuple(change.weather.tolist()), tuple(change.foliage.tolist()))
    found = apply_changes(scene, edit)
    for name in ("translation", "yaw", "ffd", "texture_code"):
        torch.testing.assert_close(getattr(found.objects, name), getattr(expected.objects, name))
    torch.testing.assert_close(found.environment.weather, expected.environment.weather)
    torch.testing.assert_close(found.environment.foliage, expected.environment.foliage)


def test_all_and_one_add_up_and_codes_end_at_their_bounds(street: Street) -> None:
    scene = street()
    after = apply_changes(scene, edit_of("objects[all].rotate=1deg", "objects[2].rotate=2deg"))
    turned = torch.rad2deg(after.objects.yaw - scene.objects.yaw)
    torch.testing.assert_close(turned, torch.tensor([1.0, 1.0, 3.0, 1.0]), atol=1e-4, rtol=0)
    foggy = apply_changes(apply_changes(scene, edit_of("weather.fog=0.8")), edit_of("weather.fog=0.8"))
    assert foggy.environment.weather.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_no_change_keeps_every_bit(street: Street) -> None:
    scene = street()
    after = apply_changes(scene, edit_of("objects[all].rotate=0deg"))
    assert torch.equal(after.objects.translation, scene.objects.translation)
    assert torch.equal(after.objects.yaw, scene.objects.yaw)
    assert (
        apply_changes(street(positions_xz=()), FrameEdit(weather=(1.0, 0, 0, 0, 0, 0))).environment.weather[0] == 1
    )


def test_removal_names_rows(street: Street) -> None:
    scene = street()
    assert apply_edit(scene, edit_of("objects[2].remove=true")).removed == (2,)
    assert apply_edit(scene, edit_of("objects[all].remove=true")).removed == (0, 1, 2, 3)
    with pytest.raises(RangeError, match=r"objects\[4\]: expected a row from 0 to 3, found 4"):
        apply_edit(scene, edit_of("objects[4].remove=true"))


def test_places_that_vehicles_should_not_have(street: Street) -> None:
    scene = street(positions_xz=((-2.5, 12.0), (2.5, 12.0)), yaw=-math.pi / 2, road_edge_x_m=6.0)
    rows = range(2)
    assert check_places(scene, scene, rows) == []
    # the heading is away from the camera; its left is the camera's left
    into = apply_changes(scene, edit_of("objects[0].translate=0m,-4.5m"))
    assert [line.partition(",")[0] for line in check_places(scene, into, rows)] == [
        "objects[1]: collision with objects[0]"
    ]
    assert check_places(scene, into, [1]) == []
    off = apply_changes(scene, edit_of("objects[1].translate=0m,-5m"))
    assert [line.partition(",")[0] for line in check_places(scene, off, rows)] == ["objects[1]: left the road"]
    raised = scene.with_objects(translation=scene.objects.translation - torch.tensor([0.0, 0.3, 0.0]))
    assert check_places(scene, raised, rows)[0] == "objects[0]: off the ground by 0.300 m"
    far = apply_changes(scene, edit_of("objects[1].translate=2m,0m"))
    assert check_places(scene, far, rows) == []


@pytest.mark.parametrize(
    ("move", "expected"),
    [
        ("3m,0m", []),
        ("6m,0m", ["moved by 6.00 m along, 0.00 m across: more than any budget allows"]),
        ("50m,0m", ["moved by", "8.9 px high"]),
        ("0m,3m", ["moved by 0.00 m along, 3.00 m across: more than any budget allows"]),
        ("0m,50m", ["moved by", "left the picture", "on ground that the picture does not show"]),
        ("-50m,0m", ["moved by", "behind the camera"]),
        ("-12m,0m", ["moved by", "reaches behind the camera"]),
    ],
)
def test_moves_off_the_map_have_notes(street: Street, move: str, expected: list[str]) -> None:
    scene = street(positions_xz=((0.0, 12.0),), yaw=-math.pi / 2, road_edge_x_m=60.0)
    notes = apply_edit(scene, edit_of(f"objects[0].translate={move}")).notes
    assert all(note.startswith(f"objects[0]: {words}") for note, words in zip(notes, expected, strict=True)), notes


def test_moves_of_several_edits_add_up() -> None:
    scene = demo_scene(0, 0)
    once = apply_edit(scene, edit_of("objects[5].translate=3m,0m"))
    twice = apply_edit(once.scene, edit_of("objects[5].translate=3m,0m"))
    assert once.notes == ()
    assert twice.notes == ("objects[5]: moved by 6.00 m along, 0.00 m across: more than any budget allows",)
