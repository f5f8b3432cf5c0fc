"""The projection and its two judges on streets drawn at random: any number of cars, parameters, and budgets."""

from __future__ import annotations

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attacks.budgets import PRESETS, change_limits
from drivesem.attacks.feasibility_check import check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import COMBOS, Parameter, ParameterSpace


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 6),
    names=st.sets(st.sampled_from(list(Parameter)), min_size=1),
    budget=st.sampled_from(sorted(PRESETS)),
    scale=st.floats(0.1, 3),
    edge=st.floats(2, 20),
)
def test_projection_is_idempotent_inside_and_feasible(street, seed, count, names, budget, scale, edge):
    generator = torch.Generator().manual_seed(seed)
    # Some of them overlap, stand off the road, or reach out of the picture from the start.
    places = torch.rand(count, 2, generator=generator) * torch.tensor([16.0, 30.0]) + torch.tensor([-8.0, 6.0])
    scene = street(positions_xz=places.tolist(), road_edge_x_m=edge)
    scene = scene.with_objects(yaw=(torch.rand(count, generator=generator) - 0.5) * 6)
    scene = scene.with_objects(occlusion=torch.randint(0, 2, (count,), generator=generator))
    allowed = tuple(name for name in names if getattr(PRESETS[budget], name.value) > 0) or (Parameter.MESH,)
    space = ParameterSpace(scene, allowed, PRESETS[budget])
    feasible = FeasibleSet(space)
    far = torch.maximum(10 * space.step, space.upper / 2)
    theta = torch.randn(space.dim, generator=generator) * scale * far
    once = feasible.project(theta)
    assert bool(((once.theta >= space.lower) & (once.theta <= space.upper)).all())
    assert feasible.violations(once.theta) == ()
    twice = feasible.project(once.theta)
    assert torch.equal(twice.theta, once.theta)
    assert twice.active == ()
    changed = space.apply(scene, once.theta)
    assert check_scene(scene, changed, limits=change_limits(PRESETS[budget])) == []


@pytest.mark.parametrize(
    ("seed", "count", "reach_xz", "edge", "combo", "scale"),
    [
        (157, 5, (16.0, 12.0), 4.890942814168205, 1, 11.132784560701829),
        (312, 6, (8.0, 30.0), 2.583124408770884, 2, 10.482662590501672),
    ],
)
def test_a_car_that_falls_back_takes_along_whom_it_would_meet(street, seed, count, reach_xz, edge, combo, scale):
    # One that was well as far as it wanted to go, as long as the other had made way.
    generator = torch.Generator().manual_seed(seed)
    wide, deep = reach_xz
    places = torch.rand(count, 2, generator=generator) * torch.tensor([wide, deep]) + torch.tensor([-wide / 2, 6])
    scene = street(positions_xz=places.tolist(), road_edge_x_m=edge)
    scene = scene.with_objects(yaw=(torch.rand(count, generator=generator) - 0.5) * 6)
    space = ParameterSpace(scene, COMBOS[combo])
    feasible = FeasibleSet(space)
    once = feasible.project(torch.randn(space.dim, generator=generator) * scale * space.step)
    assert feasible.violations(once.theta) == ()
    assert torch.equal(feasible.project(once.theta).theta, once.theta)
