"""How far people and cyclists may move, by the parameter space, the projection and the independent check."""

import math
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from drivesem.attacks.budgets import PRESETS, change_limits, parse_budget
from drivesem.attacks.feasibility_check import check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.scene_edits import apply_changes
from drivesem.attacks.space import ParameterSpace
from drivesem.config.commands import AttackConfig
from drivesem.config.edits import merge_edits, parse_frame_edit, parse_setting
from drivesem.config.options import SceneOptions
from drivesem.failures.nuisances import Nuisances
from drivesem.viewer.sliders import SceneSliders
from scene_ir.errors import RangeError
from scene_ir.types import CLOTHES_DIM, Category, Crop, SceneIR, Source

STREET = PRESETS["street"]
LIMITS = change_limits(STREET)


@pytest.fixture
def walk(street) -> SceneIR:
    """A person 4 m left of the camera's path, off the road, which ends at 3 m; a car ahead; a wall from 5.5 m to the
    left on, 7 m away.
    """
    scene = street(((-4.0, 9.0), (0.0, 14.0)), road_edge_x_m=3.0)
    objects = replace(
        scene.objects,
        category=torch.tensor([int(Category.PEDESTRIAN), int(Category.CAR)]),
        size_lhw=torch.tensor([[0.8, 1.75, 0.6], [4.2, 1.5, 1.75]]),
    )
    v, u = torch.meshgrid(torch.arange(188.0), torch.arange(621.0), indexing="ij")
    depth = 1.65 / ((v - 94) / 360).clamp(min=1e-6)
    wall = (u - 310) / 360 < -5.5 / 9
    return replace(scene, objects=objects, depth=torch.where(wall, depth.clamp(max=5.0), depth.clamp(max=80.0)))


def move(space: ParameterSpace, along: float, across: float) -> torch.Tensor:
    """theta that moves the person, in m; its yaw points away from the camera."""
    theta = space.theta0.clone()
    theta[:2] = torch.tensor([along, across]) / 0.8
    return theta


def test_people_walk_two_metres_each_way_with_street_and_their_own_length_with_paper(walk):
    theta_m = (
        ParameterSpace(walk, ("translate",), STREET).upper * walk.objects.size_lhw[:, :1].expand(2, 2).flatten()
    )
    assert theta_m.tolist() == pytest.approx([2.0, 2.0, 4.0, 1.0])
    assert ParameterSpace(walk, ("translate",)).upper.tolist() == pytest.approx([0.25] * 4)
    narrow = ParameterSpace(walk, ("translate",), parse_budget("street,translate=1m")).upper[:2] * 0.8
    assert narrow.tolist() == pytest.approx([1.0, 1.0])
    own = ParameterSpace(walk, ("translate",), parse_budget("street,translate=0.5")).upper[:2]
    assert own.tolist() == pytest.approx([0.5, 0.5])


def test_people_hardly_turn_and_grow_and_have_no_lattice_and_no_lamps(walk):
    limits = {"rotate": [math.radians(5)], "size": [0.05], "lamps": [0.0], "mesh": [0.0] * 96}
    limits["color"] = [0.5, 0.5, 0.5, 0.0, 0.0]
    for name, most in limits.items():
        space = ParameterSpace(walk, (name,), STREET)
        person, car = space.upper.reshape(2, -1).unbind()
        assert person.tolist() == pytest.approx(most)
        assert torch.equal(space.lower.reshape(2, -1)[0], -person)
        assert bool((car > person).all())


def with_parts(scene: SceneIR, category: Category = Category.PEDESTRIAN) -> SceneIR:
    """The scene with codes of their own for clothes below the waist, and its person of a category."""
    categories = torch.tensor([int(category), int(Category.CAR)])
    return scene.with_objects(texture_code=torch.zeros(2, CLOTHES_DIM), category=categories)


@pytest.mark.parametrize(
    ("category", "lower"), [(Category.PEDESTRIAN, 0.5), (Category.CYCLIST, 0.0), (Category.TRUCK, 0.0)]
)
def test_only_clothes_of_pedestrians_change_below_the_waist(walk, category, lower):
    scene = with_parts(walk, category)
    space = ParameterSpace(scene, ("color",), STREET)
    assert space.upper.reshape(2, 8)[:, 5:].tolist() == [[lower] * 3, [0.0] * 3]
    assert space.name(5) == "objects[0].paint.lower_lightness"
    widest = space.apply(scene, space.upper)
    assert check_scene(scene, widest, "outlines", limits=LIMITS) == []
    for row, parts in ((0, lower > 0), (1, False)):
        code = torch.zeros(2, 8)
        code[row, 6] = 0.4
        found = check_scene(scene, scene.with_objects(texture_code=code), "outlines", limits=LIMITS)
        assert (found == []) == parts
        code[row, 6] = 0.6
        found = check_scene(scene, scene.with_objects(texture_code=code), "outlines", limits=LIMITS)
        assert any(f"objects[{row}]: " in line and "recoloured" in line for line in found)


def test_sliders_and_their_commands_colour_both_parts(walk):
    scene = with_parts(walk)
    poses = zip(*(getattr(scene.objects, name) for name in ("translation", "yaw", "size_lhw", "ffd")), strict=True)
    empty = Crop(torch.zeros(4, 0, 0), 0, 0)
    sources = tuple(Source(*pose, empty, None, 0.0, torch.zeros(3), 1.0) for pose in poses)
    sliders = SceneSliders(replace(scene, objects=replace(scene.objects, source=sources)), STREET)
    lower = [name for name in sliders.sliders if ".lower_" in name]
    assert lower == [f"objects[0].paint.lower_{n}" for n in ("lightness", "a", "b")]
    assert sliders.sliders[lower[0]].title == "lower lightness"
    state = {lower[1]: 0.25, "objects[1].paint.a": 0.5}
    person, car = [w for w in shlex.split(sliders.command(Path("s"), state)) if w.startswith("objects")]
    assert person == "objects[0].color=0,0,0,0,0,0,0.25,0"
    edits = merge_edits(parse_setting(person), parse_setting(car))
    found = apply_changes(scene, parse_frame_edit("edit", edits))
    assert torch.equal(found.objects.texture_code, sliders.apply(state).objects.texture_code)


def test_edits_of_clothes_are_alike_or_apart(walk):
    scene = with_parts(walk)

    def edited(color: str, row: int = 0, scene: SceneIR = scene) -> list[float]:
        edit = parse_frame_edit("edit", parse_setting(f"objects[{row}].color={color}"))
        return apply_changes(scene, edit).objects.texture_code[row].tolist()

    assert edited("0.5,0,0.25,0,0") == [0.5, 0.0, 0.25, 0.0, 0.0, 0.5, 0.0, 0.25]
    assert edited("0.5,0,0,0,0,0,0,0.25") == [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25]
    assert edited("0.5,0,0,0,0", 1) == [0.5, *[0.0] * 7]
    assert edited("0.5,0,0,0,0", 0, walk) == [0.5, *[0.0] * 4]
    for row, other in ((1, scene), (0, walk)):
        with pytest.raises(RangeError, match=rf"objects\[{row}\].color: expected 5 codes; .* found 8 codes"):
            edited("0.5,0,0,0,0,0,0,0.25", row, other)


def test_clothes_vary_alike_from_sample_to_sample(walk):
    scene = with_parts(walk)
    code = torch.zeros(2, 8)
    code[0, [0, 5]] = 0.25
    scene = scene.with_objects(texture_code=code)
    found = Nuisances().sample("clothes", 0, scene).perturb_scene(scene).objects.texture_code
    assert float(found[0, 0]) == float(found[0, 5]) != 0.25
    assert bool((found[code == 0] == 0).all())


@pytest.mark.parametrize(("along", "across", "blocked"), [(1.0, 0.0, False), (0.0, 2.0, True), (0.0, -2.0, True)])
def test_people_stay_on_level_ground_off_the_road(walk, along, across, blocked):
    """The road and the wall are across; along there is more pavement."""
    space = ParameterSpace(walk, ("translate",), STREET)
    feasible = FeasibleSet(space)
    theta = move(space, along, across)
    assert bool(feasible.violations(theta)) == blocked
    assert bool(check_scene(walk, space.apply(walk, theta), "outlines", limits=LIMITS)) == blocked
    projected = feasible.project(theta).theta
    assert torch.equal(projected, theta) != blocked
    assert check_scene(walk, space.apply(walk, projected), "outlines", limits=LIMITS) == []


@pytest.mark.parametrize("on_grass", [False, True])
def test_people_stay_out_of_bushes_unless_they_stand_on_grass(walk, on_grass):
    columns = torch.arange(621).expand(188, 621)
    green = ((columns < 310 - 360 * 3.5 / 9) if on_grass else (columns < 310 - 360 * 4.4 / 9)).float()
    scene = walk.with_environment(foliage_map=green)
    space = ParameterSpace(scene, ("translate",), STREET)
    theta = move(space, 0.0, 0.8)
    assert bool(FeasibleSet(space).violations(theta)) != on_grass
    assert bool(check_scene(scene, space.apply(scene, theta), "outlines", limits=LIMITS)) != on_grass


def test_people_do_not_walk_into_cars(walk):
    translation = walk.objects.translation.clone()
    translation[0] = torch.tensor([0.0, 1.65, 11.0])
    near = walk.with_objects(translation=translation)
    space = ParameterSpace(near, ("translate",), STREET)
    theta = move(space, 1.9, 0.0)
    assert any("collision" in line for line in FeasibleSet(space).violations(theta))
    projected = FeasibleSet(space).project(theta).theta
    assert FeasibleSet(space).violations(projected) == ()


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("turned by", {"yaw": [0.1, 0.0]}),
        ("lattice bent", {"ffd": 0.01}),
        ("size changed", {"size_lhw": 0.08}),
        ("lamps of a person", {"lamps": [0.5, 0.0]}),
        ("clothes recoloured", {"texture_code": [[0.0, 0.7, 0.0, 0.0, 0.0], [0.0] * 5]}),
        ("moved by", {"translation": [[0.0, 0.0, 2.2], [0.0, 0.0, 0.0]]}),
    ],
)
def test_the_independent_check_knows_the_limits_of_people(walk, message, changes):
    ((name, change),) = changes.items()
    value = getattr(walk.objects, name)
    if isinstance(change, float):
        shape = [2] + [1] * (value.ndim - 1)
        change = torch.tensor([change, 0.0]).reshape(shape) * (value if name == "size_lhw" else 1)
    changed = walk.with_objects(**{name: value + torch.as_tensor(change)})
    assert any(f"objects[0]: {message}" in line for line in check_scene(walk, changed, "outlines", limits=LIMITS))
    car = walk.with_objects(category=torch.zeros(2, dtype=torch.int64))
    car_changed = changed.with_objects(category=torch.zeros(2, dtype=torch.int64))
    limits = replace(LIMITS, translate=9.0)
    assert not any(message in line for line in check_scene(car, car_changed, "outlines", limits=limits))


def test_target_classes_of_people_make_objects_of_them():
    assert not AttackConfig().moves_people
    assert not AttackConfig(target_classes="Car,Truck").moves_people
    assert AttackConfig(target_classes="Car, Cyclist").moves_people
    assert AttackConfig(people=True).moves_people
    assert SceneOptions(people=True).moves_people
