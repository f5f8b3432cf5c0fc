"""What can be moved, in which units, and the command that draws a state."""

from __future__ import annotations

import re
import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem import viewer
from drivesem.attacks.budgets import PRESETS, parse_budget
from drivesem.attacks.scene_edits import apply_changes
from drivesem.attacks.space import Parameter
from drivesem.config.commands import EditConfig, RenderConfig
from drivesem.config.edits import merge_edits, parse_frame_edit, parse_setting
from drivesem.config.parsing import parse
from drivesem.viewer.sliders import PICTURE, SceneSliders
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.exchange import remove_vehicle
from scene_ir.io import load_scene
from scene_ir.types import SceneIR

STREET = PRESETS["street"]


@pytest.fixture(scope="module")
def scene_sliders(still: Path) -> SceneSliders:
    return SceneSliders(load_scene(still), STREET)


@pytest.fixture(scope="module")
def bent(still: Path) -> SceneIR:
    """The scene with vehicle 1 in another shape and paint, vehicle 0 elsewhere, in fog."""
    scene = load_scene(still)
    edit = parse_frame_edit("edit", {"objects": {0: {"translate": ["1.25m", "-0.5m"], "rotate": "-7.5deg"}}})
    scene = apply_changes(scene, edit)
    offsets, paint = scene.objects.ffd.clone(), scene.objects.texture_code.clone()
    offsets[1] += ffd.from_symmetric(0.05 * ffd.low_order_modes()[2])
    paint[1, 0] = -0.5
    scene = scene.with_objects(ffd=offsets, texture_code=paint)
    return scene.with_environment(weather=torch.tensor([0.25, 0.0, 0.0, 0.0]))


def drawn_by(command: str, scene: SceneIR) -> SceneIR:
    """The scene that a command draws, by what it says alone."""
    config = parse(shlex.split(command)[1:])
    if isinstance(config, RenderConfig):
        return scene
    assert isinstance(config, EditConfig)
    changes: dict[Any, Any] = {}
    for text in config.set:
        changes = merge_edits(changes, parse_setting(text))
    edit = parse_frame_edit("edit", changes)
    return apply_changes(scene.unperturbed(), edit, scene) if config.photographed else apply_changes(scene, edit)


def assert_alike(one: SceneIR, other: SceneIR) -> None:
    for name in ("translation", "yaw", "size_lhw", "ffd", "texture_code"):
        torch.testing.assert_close(getattr(one.objects, name), getattr(other.objects, name), atol=2e-6, rtol=0)
    for name in ("weather", "foliage", "light"):
        mine, theirs = getattr(one.environment, name), getattr(other.environment, name)
        torch.testing.assert_close(mine, theirs, atol=2e-6, rtol=0)


def test_sliders_are_coordinates_of_theta_in_physical_units(scene_sliders: SceneSliders) -> None:
    space = scene_sliders.space
    assert set(space.params) == set(Parameter) - {Parameter.MESH}
    for i in range(space.dim):
        factor, unit = space.physical(i, 1.0) or (1.0, "")
        low, high = float(space.lower[i]) * factor, float(space.upper[i]) * factor
        if low == high:
            assert space.name(i) not in scene_sliders.sliders, "nothing to move"
            continue
        slider = scene_sliders.sliders[space.name(i)]
        assert slider.unit == unit
        assert low - 1e-4 <= slider.low < slider.high <= high + 1e-4
        assert (high - slider.high, slider.low - low) == pytest.approx((0, 0), abs=slider.step)
    assert {slider.unit for slider in scene_sliders.sliders.values()} == {"m", "deg", "%", ""}


def test_the_page_has_a_heading_for_each_group(scene_sliders: SceneSliders) -> None:
    """A group without one ends the page before its first picture."""
    script = (Path(viewer.__file__).parent / "page.js").read_text()
    (table,) = re.findall(r"const GROUPS = \{(.*?)\};", script, re.DOTALL)
    (order,) = re.findall(r"const ORDER = \[(.*?)\];", script, re.DOTALL)
    headings = dict(re.findall(r'(\w+): "([^"]+)"', table))
    assert {slider.group for slider in scene_sliders.sliders.values()} <= headings.keys()
    assert set(headings.values()) == set(re.findall(r'"([^"]+)"', order))


def test_as_photographed_nothing_is_found_and_all_is_drawn_by_render(
    scene_sliders: SceneSliders, still: Path
) -> None:
    assert scene_sliders.found == {}
    assert_alike(scene_sliders.apply({}), load_scene(still))
    assert scene_sliders.command(still, {}) == shlex.join(["drivesem", "render", str(still), "--out", PICTURE])


def test_what_a_scene_holds_is_found(bent: SceneIR) -> None:
    scene_sliders = SceneSliders(bent, STREET)
    found = scene_sliders.found
    expected = {
        "objects[0].translate.along": 1.25,
        "objects[0].translate.across": -0.5,
        "objects[0].yaw": -7.5,
        "objects[1].paint.lightness": -0.5,
        "objects[1].shape": 100.0,
        "weather.fog": 0.25,
    }
    assert found == pytest.approx(expected, abs=1e-4)
    assert_alike(scene_sliders.apply(found), bent)


def test_a_shape_goes_by_its_share(bent: SceneIR, still: Path) -> None:
    scene_sliders, rest = SceneSliders(bent, STREET), load_scene(still).objects.ffd
    half = scene_sliders.apply(scene_sliders.state({"objects[1].shape": 50.0})).objects.ffd
    torch.testing.assert_close(half, rest + 0.5 * (bent.objects.ffd - rest))
    command = scene_sliders.command(Path("S"), {"objects[1].shape": 50.0})
    assert command == "drivesem edit S --photographed --set 'objects[1].mesh=50%' --out view.png"
    assert_alike(drawn_by(command, bent), scene_sliders.apply({"objects[1].shape": 50.0}))


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_the_command_reproduces_the_state(data: st.DataObject, scene_sliders: SceneSliders, bent: SceneIR) -> None:
    mine = data.draw(st.sampled_from([scene_sliders, SceneSliders(bent, STREET)]))
    names = data.draw(st.lists(st.sampled_from(sorted(mine.sliders)), max_size=6, unique=True))
    values = {}
    for name in names:
        slider = mine.sliders[name]
        values[name] = round(data.draw(st.floats(slider.low, slider.high)), 5)
        values[name] = min(max(values[name], slider.low), slider.high)
    state = mine.state(values)
    assert_alike(drawn_by(mine.command(Path("a b"), state), mine.scene), mine.apply(state))


def test_a_narrow_budget_reaches_what_is_there(bent: SceneIR) -> None:
    scene_sliders = SceneSliders(bent, parse_budget("translate=0.5m,color=0.1,weather=0.1"))
    along = scene_sliders.sliders["objects[0].translate.along"]
    assert (along.low, along.high) == pytest.approx((-0.5, 1.25), abs=1e-4)
    assert scene_sliders.sliders["objects[1].paint.lightness"].low == -0.5
    held = ("size", "sun")
    assert not any(slider.group in held for slider in scene_sliders.sliders.values()), "by the paper's budget"
    assert_alike(scene_sliders.apply(scene_sliders.found), bent)


def test_what_is_not_there_cannot_be_moved(still: Path) -> None:
    scene = load_scene(still)
    scene_sliders = SceneSliders(remove_vehicle(scene, 0), STREET)
    assert {slider.car for slider in scene_sliders.sliders.values()} == {None, *range(1, len(scene.objects))}
    objects = scene.objects
    nobody = {entry.name: getattr(objects, entry.name)[:0] for entry in fields(objects)}
    empty = SceneSliders(replace(scene, objects=replace(objects, **nobody)), STREET)
    assert {slider.car for slider in empty.sliders.values()} == {None}
    assert float(empty.apply({"weather.rain": 0.5}).environment.weather[1]) == 0.5


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"objects[0].wheels": 1.0},
            r"objects\[0\]\.wheels: expected a parameter of this scene, found",
        ),
        ({"objects[99].yaw": 1.0}, "an unknown name"),
        ({"objects[0].yaw": 20.1}, r"objects\[0\]\.yaw: expected -20 to 20 deg, found 20.1"),
        ({"weather.fog": -0.1}, "weather.fog: expected 0 to 1, found -0.1"),
        ({"weather.fog": float("nan")}, "weather.fog: expected 0 to 1, found nan"),
    ],
)
def test_values_that_are_none(values: dict[str, float], message: str, scene_sliders: SceneSliders) -> None:
    with pytest.raises(RangeError, match=message):
        scene_sliders.state(values)


def test_meshes_alone_are_refused(street: Any) -> None:
    with pytest.raises(RangeError):
        SceneSliders(street(), STREET)
