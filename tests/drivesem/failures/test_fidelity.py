"""Fidelity of edited objects: its evidence in an exact scene, its score, and the failures that it concerns."""

import math
from dataclasses import fields, replace

import pytest
import torch

from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.failures.fidelity import (
    ERROR_WEIGHTS,
    EditedRegion,
    ObjectFidelity,
    find_edited,
    find_untrusted,
    lowest_fidelity,
    measure_fidelity,
)
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR

CAR = 0
"""A car of the scene that nothing hides."""
NOTHING = dict.fromkeys(ERROR_WEIGHTS, 0.0)


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


@pytest.fixture(scope="module")
def compositor(scene: SceneIR) -> Compositor:
    return Compositor(scene)


def edited(scene: SceneIR, **changes: float) -> SceneIR:
    """The scene with one car changed: x in m, yaw in rad, paint, or a growth of the lattice's offsets."""
    objects = scene.objects
    translation, yaw, ffd, paint = (
        value.clone() for value in (objects.translation, objects.yaw, objects.ffd, objects.texture_code)
    )
    translation[CAR, 0] += changes.get("x", 0.0)
    yaw[CAR] += changes.get("yaw", 0.0)
    ffd[CAR] += changes.get("bend", 0.0)
    paint[CAR, 0] += changes.get("paint", 0.0)
    return scene.with_objects(translation=translation, yaw=yaw, ffd=ffd, texture_code=paint)


def fidelity(compositor: Compositor, changed: SceneIR) -> ObjectFidelity:
    (region,) = measure_fidelity(compositor, changed)
    return region.fidelity


def cut_off(scene: SceneIR, share: float) -> SceneIR:
    """The scene with the lower `share` of the car missing in the photograph, as behind a bonnet."""
    source = scene.objects.source[CAR]
    values = source.foreground.values.clone()
    values[:, round((1 - share) * values.shape[1]) :] = 0
    cut = replace(source, foreground=replace(source.foreground, values=values))
    return replace(scene, objects=replace(scene.objects, source=(cut, *scene.objects.source[1:])))


def test_only_edited_objects_are_measured(scene: SceneIR, compositor: Compositor) -> None:
    assert find_edited(scene.objects) == []
    assert measure_fidelity(compositor, scene) == ()
    assert find_edited(edited(scene, paint=0.1).objects) == [CAR]


def test_small_move_is_trusted(scene: SceneIR, compositor: Compositor) -> None:
    found = fidelity(compositor, edited(scene, x=0.2))
    assert found.is_trusted
    assert found.completed < 0.01
    assert found.mismatched < 0.05
    assert 0.01 < found.disturbed < 0.2


def test_other_side_is_not_in_the_photograph(scene: SceneIR, compositor: Compositor) -> None:
    found = fidelity(compositor, edited(scene, yaw=math.pi))
    assert found.completed > 0.9
    assert found.distorted == pytest.approx(math.pi, abs=0.1)
    assert not found.is_trusted


def test_car_that_enters_the_picture_is_completed(scene: SceneIR) -> None:
    """What the border cut off is not in the photograph: the car is moved as far as half of it was outside."""
    objects = scene.objects
    outside = objects.translation.clone()
    outside[CAR, 0] -= float(outside[CAR, 2]) * (scene.camera.width / 2) / float(scene.camera.intrinsics[0, 0])
    outside[CAR, 0] -= float(objects.translation[CAR, 0])
    source = replace(objects.source[CAR], translation=outside[CAR])
    blank = replace(source.foreground, values=torch.zeros_like(source.foreground.values))
    cut = scene.with_objects(translation=outside)
    cut = replace(
        cut, objects=replace(cut.objects, source=(replace(source, foreground=blank), *objects.source[1:]))
    )
    found = fidelity(Compositor(cut), edited(cut, x=1.5))
    assert found.completed > 0.2


@pytest.mark.parametrize(("share", "trusted"), [(0.0, True), (0.6, False)])
def test_car_behind_the_own_car_is_held(scene: SceneIR, share: float, trusted: bool) -> None:
    cut = cut_off(scene, share)
    held = find_untrusted(Compositor(cut))
    assert held == ([] if trusted else [CAR])
    found = fidelity(Compositor(cut), edited(cut, x=0.05))
    assert found.is_trusted == trusted
    assert (found.unsupported > 0.9) != trusted


def test_held_objects_stay(scene: SceneIR) -> None:
    space = ParameterSpace(scene, ("translate", "rotate", "weather"))
    feasible = FeasibleSet(space, held=[CAR])
    theta = feasible.project(space.theta0 + 0.1).theta
    translate, rotate = (space.block(theta, parameter) for parameter in (Parameter.TRANSLATE, Parameter.ROTATE))
    assert translate is not None
    assert rotate is not None
    assert not translate[CAR].any()
    assert not rotate[CAR].any()
    assert translate[CAR + 1].any()
    assert f"objects[{CAR}]: fidelity" in feasible.violated_at_start


def test_uncertain_depth_counts_by_the_distance_moved(scene: SceneIR) -> None:
    label = {f"objects[{CAR}].label": "4", "labels[4].depth_sigma": "0.100"}
    uncertain = Compositor(replace(scene, provenance={**scene.provenance, **label}))
    near, far = (fidelity(uncertain, edited(scene, x=x)).displaced for x in (0.2, 0.4))
    assert near > 0
    assert far == pytest.approx(2 * near, rel=0.05)


@pytest.mark.parametrize("name", ERROR_WEIGHTS)
def test_score_falls_with_each_piece_of_evidence(name: str) -> None:
    scores = [ObjectFidelity.from_evidence(0, **NOTHING | {name: value}).score for value in (0.0, 0.5, 1.0)]
    assert 1 >= scores[0] > scores[1] > scores[2] >= 0


def test_evidence_is_all_fields() -> None:
    assert {field.name for field in fields(ObjectFidelity)} == {"index", "score", *ERROR_WEIGHTS}


def test_reason_is_the_strongest_evidence() -> None:
    found = ObjectFidelity.from_evidence(3, **NOTHING | {"completed": 1.0, "distorted": 1.0, "mismatched": 0.01})
    assert not found.is_trusted
    assert found.describe() == (
        f"picture not trusted: fidelity {found.score:.2f} of object 3; 100% of it is not in the photograph"
    )


@pytest.mark.parametrize(
    ("box_xyxy", "index"),
    [
        ((0, 0, 10, 10), 1),  # the worst of those that are there
        ((20, 0, 30, 10), 0),  # where it stands now
        ((9.5, 0, 19.5, 10), None),  # covered by 5 % only
        ((100, 100, 110, 110), None),
    ],
)
def test_failure_has_the_lowest_fidelity_in_its_box(
    box_xyxy: tuple[float, float, float, float], index: int | None
) -> None:
    good, bad = (ObjectFidelity.from_evidence(i, **NOTHING | {"completed": float(i)}) for i in (0, 1))
    regions = [
        EditedRegion(good, ((0, 0, 10, 10), (20, 0, 30, 10))),
        EditedRegion(bad, ((0, 0, 10, 10), (0, 0, 10, 10))),
    ]
    found = lowest_fidelity(regions, box_xyxy)
    assert (None if found is None else found.index) == index
