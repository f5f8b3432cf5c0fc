"""A change of a scene as an edit of the generator's plan: the same way, turn and bend, whatever the fit did."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from drivesem.failures.second_renderer.generator import PlanMatch, transfer_edit
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import Plan, SynthSettings, plan_frame, yaw_in_camera
from drivesem.synth.layout import Actor, LayoutSettings
from scene_ir import ffd
from scene_ir.geometry import yaw_matrix
from scene_ir.types import LATTICE, SceneIR

COUNT = 3
TURNED_RAD = 0.2
"""Of the camera, so that its axes are not the world's."""


@pytest.fixture(scope="module")
def plan() -> Plan:
    from drivesem.synth.variations import kept_in_world, turned

    settings = SynthSettings(LayoutSettings(people=False, vehicles=(6, 8)), sunny=True)
    found = plan_frame(9, 2, settings=settings)
    view = turned(found.setting.view, TURNED_RAD)
    light = kept_in_world(found.setting.light, found.setting.view, view)
    from dataclasses import replace

    return replace(found, setting=replace(found.setting, view=view, light=light))


def spot(plan: Plan, actor: Actor) -> np.ndarray:
    x, z = actor.position_xz
    return plan.setting.view.to_camera(np.array([x, 0.0, z]))


@pytest.fixture
def scene(plan: Plan, street: Callable[..., SceneIR]) -> SceneIR:
    """The plan's first vehicles as a scene of a street has them."""
    actors = plan.actors[:COUNT]
    poses = torch.tensor(np.stack([spot(plan, a) for a in actors]), dtype=torch.float64)
    yaws = torch.tensor([yaw_in_camera(a, plan.setting.view) for a in actors], dtype=torch.float64)
    found = street([(0.0, 9.0 + 6 * i) for i in range(COUNT)], dtype=torch.float64)
    return found.with_objects(translation=poses, yaw=yaws)


def planned(plan: Plan, *tracks: int | None) -> PlanMatch:
    return PlanMatch(plan, tracks)


def tracks_of(plan: Plan) -> list[int]:
    return [a.track for a in plan.actors[:COUNT]]


def test_vehicles_go_the_same_way(plan: Plan, scene: SceneIR) -> None:
    ways = plan.setting.view.rotation @ np.array([[0.5, 0.0, -0.3], [-0.2, 0.0, 0.9], [0.0, 0.0, 0.0]]).T
    turns = torch.tensor([0.1, -0.25, 0.0], dtype=torch.float64)
    changed = scene.with_objects(
        translation=scene.objects.translation + torch.from_numpy(ways.T.copy()), yaw=scene.objects.yaw + turns
    )
    found = transfer_edit(scene, changed, planned(plan, *tracks_of(plan)))
    assert found.missing == ()
    after = apply_edit(plan, found.edit)
    for i, actor in enumerate(after.actors[:COUNT]):
        assert spot(after, actor) == pytest.approx(changed.objects.translation[i].numpy(), abs=1e-6)
        apart = yaw_in_camera(actor, plan.setting.view) - float(changed.objects.yaw[i])
        assert math.remainder(apart, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    assert after.actors[COUNT:] == plan.actors[COUNT:]


def test_the_sun_is_carried(plan: Plan, scene: SceneIR) -> None:
    changed = scene.with_environment(light=torch.tensor([0.5, -1.0, 0.25]))
    found = transfer_edit(scene, changed, planned(plan, *tracks_of(plan)))
    assert (found.edit.sun, found.missing) == ((0.5, -1.0, 0.25), ())


def test_vehicles_grow_by_the_same_share(plan: Plan, scene: SceneIR) -> None:
    factors = torch.tensor([1.1, 0.95, 1.0], dtype=torch.float64)
    changed = scene.with_objects(size_lhw=scene.objects.size_lhw * factors[:, None])
    after = apply_edit(plan, transfer_edit(scene, changed, planned(plan, *tracks_of(plan))).edit)
    for old, new, factor in zip(plan.actors, after.actors, factors.tolist(), strict=False):
        assert new.size_lhw == pytest.approx([factor * side for side in old.size_lhw])
    assert transfer_edit(scene, changed, planned(plan, None, None, None)).missing == tuple(
        f"objects[{i}]: the generator's plan has no such vehicle" for i in (0, 1)
    )


@pytest.mark.parametrize("behind", [False, True])
def test_the_same_metal_is_bent_whichever_way_a_fit_turned_the_car(
    behind: bool, plan: Plan, scene: SceneIR
) -> None:
    actor = plan.actors[0]
    if behind:
        scene = scene.with_objects(yaw=scene.objects.yaw + math.pi)
    code = torch.linspace(-0.05, 0.08, ffd.SYMMETRIC_DIM, dtype=torch.float64)
    offsets = scene.objects.ffd.clone()
    offsets[0] += ffd.from_symmetric(code)
    found = transfer_edit(scene, scene.with_objects(ffd=offsets), planned(plan, *tracks_of(plan)))
    theirs = ffd.from_symmetric(torch.tensor(found.edit.objects[actor.track].mesh, dtype=torch.float64))
    size = torch.tensor(actor.size_lhw, dtype=torch.float64)
    yaw = torch.tensor(yaw_in_camera(actor, plan.setting.view), dtype=torch.float64)
    ours = (offsets[0] - scene.objects.ffd[0]) * size @ yaw_matrix(scene.objects.yaw[0]).T
    theirs = theirs * size @ yaw_matrix(yaw).T
    if behind:
        ours = ours.reshape(*LATTICE, 3).flip(0, 2).reshape(-1, 3)
    torch.testing.assert_close(theirs, ours, atol=1e-9, rtol=0)
    assert found.edit.objects[plan.actors[1].track].mesh == ()


def test_paint_weather_and_foliage(plan: Plan, scene: SceneIR) -> None:
    paint = scene.objects.texture_code.clone()
    paint[1, 0] = -0.4
    changed = scene.with_objects(texture_code=paint).with_environment(
        weather=torch.tensor([0.3, 0.0, 0.5, 0.0]), foliage=torch.tensor([-0.2, 0.0, 0.1])
    )
    edit = transfer_edit(scene, changed, planned(plan, *tracks_of(plan))).edit
    assert edit.objects[plan.actors[1].track].color == pytest.approx((-0.4, 0, 0, 0, 0))
    assert edit.weather == pytest.approx((0.3, 0, 0.5, 0))
    assert edit.foliage == pytest.approx((-0.2, 0, 0.1))


def test_what_has_no_counterpart_is_named_where_it_was_changed(plan: Plan, scene: SceneIR) -> None:
    turns = torch.tensor([0.1, 0.1, 0.0], dtype=torch.float64)
    changed = scene.with_objects(yaw=scene.objects.yaw + turns)
    found = transfer_edit(scene, changed, planned(plan, None, tracks_of(plan)[1], None))
    assert found.missing == ("objects[0]: the generator's plan has no such vehicle",)
    assert list(found.edit.objects) == [tracks_of(plan)[1]]
