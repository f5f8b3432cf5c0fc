"""Vehicles that leave, park, or replace others: proposals, labels, refusals."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

import drivesem as ds
from drivesem.attacks import changes
from drivesem.attacks.budgets import PRESETS
from drivesem.attacks.changes import (
    VehicleChange,
    VehicleChangeSettings,
    _with_moved_labels,
    count_affordable_proposals,
    load_vehicle_mesh,
    parse_vehicle_changes,
    proposal_passes,
    propose_scenes,
)
from drivesem.attacks.feasibility_check import check_exchange, check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Labeller, to_kitti_labels
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.synth.assets import meshes_in
from drivesem.synth.demo import demo_scene
from scene_ir.errors import FormatError
from scene_ir.exchange import CHANGE_KEY, Vehicle, add_roof_load, add_vehicle, remove_vehicle, replace_vehicle
from scene_ir.meshes.load import save_mesh
from scene_ir.meshes.templates import make_roof_load, template
from scene_ir.removal import remove_objects
from scene_ir.render.compositor import Compositor
from scene_ir.render.sources import photograph_scene
from scene_ir.types import Category, SceneIR

SIZE = torch.tensor([4.0, 1.5, 1.75])


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return ds.demo_scene(1).ir


def with_parked_car(scene: SceneIR, place: torch.Tensor) -> SceneIR:
    vehicle = Vehicle(template("suv"), Category.CAR, place, scene.objects.yaw[0], SIZE)
    return add_vehicle(scene, vehicle)


def labels_of(changed: SceneIR):
    compositor = Compositor(changed)
    labeller = Labeller(changed.origin, compositor.render(changed.origin))
    return labeller, labeller.moved(changed, compositor.render(changed))


@pytest.fixture(scope="module")
def proposed(scene: SceneIR) -> list[SceneIR]:
    return propose_scenes(scene, VehicleChangeSettings(tuple(VehicleChange)), 4, 7)


def test_kinds_take_turns_and_are_feasible(scene: SceneIR, proposed: list[SceneIR]) -> None:
    words = [made.provenance[CHANGE_KEY] for made in proposed]
    wanted = ("is gone", "parks as", "in the place of", "on the roof")
    assert all(word in text for word, text in zip(wanted, words, strict=True))
    for made in proposed:
        assert made.origin.photograph is scene.photograph
        assert check_exchange(made) == []
        assert check_scene(made.unperturbed(), made) == []
        labels = labels_of(made)[1]
        assert torch.equal(made.objects.box2d, labels.boxes_xyxy)
        assert torch.equal(made.objects.occlusion, labels.occlusion)


@pytest.mark.slow
def test_proposals_are_feasible(scene: SceneIR) -> None:
    found = propose_scenes(scene, VehicleChangeSettings((VehicleChange.PARK,)), 6, 3)
    assert found
    assert not [line for made in found for line in check_exchange(made)]


def test_the_same_seed_proposes_the_same(scene: SceneIR, proposed: list[SceneIR]) -> None:
    again = propose_scenes(scene, VehicleChangeSettings(tuple(VehicleChange)), 4, 7)
    for one, other in zip(proposed, again, strict=True):
        assert one.provenance == other.provenance
        assert torch.equal(one.objects.translation, other.objects.translation)


def test_labels_follow(scene: SceneIR) -> None:
    row = 6
    van = Vehicle(
        template("van"), Category.TRUCK, scene.objects.translation[row], scene.objects.yaw[row], 1.3 * SIZE
    )
    _, labels = labels_of(replace_vehicle(scene, row, van))
    assert int(labels.category[row]) == int(Category.TRUCK)
    higher = (labels.boxes_xyxy - scene.objects.box2d)[row]
    assert higher[1] < -5  # its roof is
    assert not labels.ignore[row]
    rest = [i for i in range(len(scene.objects)) if i != row]
    assert torch.equal(labels.boxes_xyxy[rest], scene.objects.box2d[rest])


def test_a_load_on_the_roof_is_part_of_its_cars_label(scene: SceneIR) -> None:
    row = 5
    car = scene.meshes[int(scene.objects.mesh_index[row])]
    loaded = add_roof_load(scene, row, make_roof_load("crate", car, scene.objects.size_lhw[row]))
    _, labels = labels_of(loaded)
    grown = (labels.boxes_xyxy - scene.objects.box2d)[row]
    assert grown[1] < -8
    assert grown[[0, 2, 3]].abs().max() < 1
    higher = to_kitti_labels(labels, loaded.origin, loaded).size_lhw[row, 1] - scene.objects.size_lhw[row, 1]
    assert 0.3 < float(higher) < 0.6
    assert check_exchange(loaded) == []


def test_a_removed_car_is_no_failure(scene: SceneIR) -> None:
    left = remove_vehicle(scene, 6)
    labeller, labels = labels_of(left)
    assert labels.ignore[6]
    assert not labels.out_of_sight.any()
    assert labels.in_view.tolist() == [True] * 6 + [False]
    assert len(to_kitti_labels(labels, left.origin, left).kind) == 6
    assert len(to_kitti_labels(labeller.paper(), left.origin, left).kind) == 7


def test_a_removed_vehicle_is_not_moved_and_violates_nothing(scene: SceneIR) -> None:
    space = ParameterSpace(remove_vehicle(scene, 6), ("translate", "rotate"), PRESETS["street"])
    for name in ("translate", "rotate"):
        upper = space.upper[space.blocks[Parameter(name)]].view(7, -1)
        assert (upper[6] == 0).all()
        assert (upper[:6] > 0).all()
    whole = ParameterSpace(scene, ("translate", "rotate"), PRESETS["street"])
    assert FeasibleSet(space).violated_at_start == FeasibleSet(whole).violated_at_start


def test_theta_is_converted_to_a_scene_with_an_added_vehicle(scene: SceneIR) -> None:
    params = ("color", "weather", "translate", "rotate")
    place = scene.objects.translation[5] + torch.tensor([6.0, 0.0, 0.0])
    less, more = (ParameterSpace(s, params, PRESETS["street"]) for s in (scene, with_parked_car(scene, place)))
    theta = torch.linspace(-0.1, 0.1, less.dim)
    here = more.convert_theta(less, theta)
    for parameter in map(Parameter, params):
        block = here[more.blocks[parameter]]
        combined = theta[less.blocks[parameter]]
        assert torch.equal(block[: len(combined)], combined)
        assert (block[len(combined) :] == 0).all()


def test_an_added_vehicle_is_ignored_and_has_a_label(scene: SceneIR) -> None:
    more = with_parked_car(scene, scene.objects.translation[5] + torch.tensor([6.0, 0.0, 0.0]))
    labeller, labels = labels_of(more)
    assert labels.ignore[-1]
    assert labels.in_view.all()
    written = to_kitti_labels(labels, more.origin, more)
    assert len(written.kind) == len(scene.objects) + 1
    x0, y0, x1, y1 = written.boxes_xyxy[-1].tolist()
    assert x1 - x0 > 40
    assert y1 - y0 > 20
    assert len(to_kitti_labels(labeller.paper(), more.origin, more).kind) == len(scene.objects)


@pytest.mark.parametrize(("column", "level"), [(0.0, 0), (1230.0, 0), (600.0, 2)])
def test_labels_of_an_added_vehicle_follow_its_visible_share(column: float, level: int) -> None:
    """Half of it beyond the border, or behind the only other car, which stands at 11 m in the middle."""
    scene = demo_scene(0, 0)
    scene = remove_objects(scene, range(1, len(scene.objects)))
    (across, _, middle, _), *_ = scene.camera.matrix.tolist()
    ground = scene.environment.ground.tolist()
    x, z = (column - middle) / across * 12, 12.0
    y = -(ground[3] + ground[0] * x + ground[2] * z) / ground[1]
    vehicle = Vehicle(template("sedan"), Category.CAR, torch.tensor([x, y, z]), torch.tensor(1.57), SIZE)
    made = _with_moved_labels(add_vehicle(scene, vehicle), None)
    expected = 0.0 if column == 600 else 0.57
    assert float(made.objects.truncation[-1]) == pytest.approx(expected, abs=0.03)
    assert int(made.objects.occlusion[-1]) == level


@pytest.mark.parametrize(("frame", "seed"), [(8, 0), pytest.param(1, 1, marks=pytest.mark.slow)])
def test_positions_outside_the_picture_are_skipped(frame: int, seed: int) -> None:
    made = propose_scenes(demo_scene(0, frame), VehicleChangeSettings((VehicleChange.PARK,)), 6, seed)
    assert made
    for one in made:
        x0, y0, x1, y1 = one.objects.box2d[-1].tolist()
        assert x1 > x0
        assert y1 > y0


def test_a_car_that_another_hides_is_not_counted(scene: SceneIR) -> None:
    target = scene.objects.translation[0]
    _, labels = labels_of(with_parked_car(scene, 0.5 * target + torch.tensor([0.0, 0.5 * float(target[1]), 0.0])))
    assert labels.became_ignored[0]


@pytest.mark.parametrize(
    ("shift", "message"), [((0.5, 0.0, 0.5), "collision"), ((16.0, 0.0, -4.0), "off the road")]
)
def test_invalid_changes_are_named(scene: SceneIR, shift: tuple[float, float, float], message: str) -> None:
    place = scene.objects.translation[3] + torch.tensor(shift)
    found = check_exchange(with_parked_car(scene, place))
    assert any(message in line for line in found)
    assert all(line.startswith("exchange: objects[") for line in found)
    changed = with_parked_car(scene, place)
    assert set(found) <= set(check_scene(changed.unperturbed(), changed))


def test_a_fraction_of_the_passes_goes_into_proposals() -> None:
    assert [count_affordable_proposals(passes) for passes in (24, 29, 30, 36, 90, 1000)] == [0, 0, 1, 2, 6, 6]
    for passes in range(24, 200):
        count = count_affordable_proposals(passes)
        assert passes - proposal_passes(count) >= 24
        assert proposal_passes(count) <= 0.25 * passes


@pytest.mark.parametrize("text", ["", "fly", "leave,leave", "leave,"])
def test_unknown_changes_are_named(text: str) -> None:
    with pytest.raises(
        FormatError, match="--changes: expected each at most once of leave, park, swap, load, emerge"
    ):
        parse_vehicle_changes(text)


def test_changes_are_parsed() -> None:
    assert parse_vehicle_changes("swap, leave") == (VehicleChange.LEAVE, VehicleChange.SWAP)


def test_a_users_mesh_parks_and_must_have_a_vehicles_size(scene: SceneIR, tmp_path: Path) -> None:
    small = template("sedan")
    save_mesh(small, tmp_path / "unit.glb")
    with pytest.raises(FormatError, match=r"unit.glb: length: expected a vehicle's in metres, 1.5 to 20, found 1"):
        load_vehicle_mesh(str(tmp_path / "unit.glb"))
    obj = tmp_path / "block.obj"
    corners = [(x, y, z) for x in (0, 4) for y in (0, 1.5) for z in (0, 1.8)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {' '.join(map(str, q))}" for q in quads]
    obj.write_text("\n".join(lines))
    own = load_vehicle_mesh(str(obj))
    made = propose_scenes(scene, VehicleChangeSettings((VehicleChange.PARK,), own), 1, 0)
    assert made[0].meshes[-1].name == "block"
    assert made[0].objects.size_lhw[-1].tolist() == pytest.approx([4.0, 1.5, 1.8])


def test_a_z_up_mesh_is_upright_and_as_the_generator_has_it(scene: SceneIR, tmp_path: Path) -> None:
    lines: list[str] = []
    for low, high in (((-0.9, -2.1, 0.2), (0.9, 2.1, 1.0)), ((-0.75, -0.8, 1.0), (0.75, 1.2, 1.6))):
        box = trimesh.creation.box(bounds=[low, high])
        lines += [f"v {x} {y} {z}" for x, y, z in box.vertices]
        lines += [f"f {' '.join(map(str, face - 8))}" for face in box.faces]
    (tmp_path / "zup.obj").write_text("\n".join(lines))
    own, (other,) = load_vehicle_mesh(str(tmp_path / "zup.obj")), meshes_in(tmp_path)
    assert own.size_lhw == pytest.approx((4.2, 1.4, 1.8))
    assert (own.up, other.up) == ("z", "z")
    assert torch.equal(own.mesh.vertices, other.mesh.vertices)
    assert torch.equal(own.mesh.faces, other.mesh.faces)
    roof = own.mesh.vertices[own.mesh.vertices[:, 1] < -0.99]
    assert roof[:, 0].unique().tolist() == pytest.approx([-1.2 / 4.2, 0.8 / 4.2])
    made = propose_scenes(scene, VehicleChangeSettings((VehicleChange.PARK,), own), 1, 0)
    assert made[0].objects.size_lhw[-1].tolist() == pytest.approx([4.2, 1.4, 1.8])


def test_a_person_who_emerges_is_half_hidden(
    street: Callable[..., SceneIR], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Feasible places where the car hides nobody, or all of the legs and chest, are passed over."""
    scene = street([(-4.0, 11.0), (0.0, 10.0)], yaw=0.0)
    person = {
        "category": torch.tensor([int(Category.PEDESTRIAN), int(Category.CAR)]),
        "size_lhw": torch.tensor([[0.8, 1.75, 0.6], [4.2, 1.5, 1.75]]),
    }
    scene = photograph_scene(replace(scene, objects=replace(scene.objects, **person)))
    places = (torch.tensor([x, 1.65, 12.0]) for x in (3.5, 0.0, 2.3))
    monkeypatch.setattr(changes, "_choose_place_behind", lambda *_: next(places))
    (made,) = propose_scenes(scene, VehicleChangeSettings((VehicleChange.EMERGE,)), 1, 0)
    assert made.objects.translation[0].tolist() == pytest.approx([2.3, 1.65, 12.0])
    assert made.objects.occlusion.tolist() == [1, 0]
