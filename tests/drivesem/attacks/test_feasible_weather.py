"""Weather codes: what goes together, how far back it goes where cars fade, and what the second check says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, minimize

from drivesem.attacks.feasibility_check import ChangeLimits, check_scene
from drivesem.attacks.feasible.constraints import CODE_SUM_LIMITS, CODE_SUMS, FeasibilityLimits
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import Budget, ParameterSpace
from scene_ir.types import WEATHER_DIM

EXACT = 2e-3
"""Of codes: how near the general minimiser comes to the nearest point."""
ROUNDING = 2e-6
POINT = st.lists(st.floats(-0.5, 2.0), min_size=WEATHER_DIM, max_size=WEATHER_DIM)
CODE = st.lists(st.floats(0, 1), min_size=WEATHER_DIM, max_size=WEATHER_DIM)
LIMITS = ChangeLimits(night=1.0, snow=1.0)
lenient = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _space(street, start=(0.0,) * WEATHER_DIM, **budget) -> ParameterSpace:
    scene = street(positions_xz=()).with_environment(weather=torch.tensor(start, dtype=torch.float32))
    return ParameterSpace(scene, ("weather",), Budget(**{"night": 1.0, "snow": 1.0} | budget))


def _projected(street, theta, start=(0.0,) * WEATHER_DIM, **budget) -> np.ndarray:
    space = _space(street, start, **budget)
    return FeasibleSet(space).project(torch.tensor(theta, dtype=torch.float32)).theta.double().numpy()


@lenient
@given(point=POINT)
@example(point=[1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
@example(point=[0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
@example(point=[2.0, 2.0, -0.5, -0.5, 0.0, 0.5])
def test_the_projection_is_the_nearest_point(street, point):
    found, requested = _projected(street, point), np.array(point)
    assert (CODE_SUMS @ found <= CODE_SUM_LIMITS + ROUNDING).all()
    assert ((found >= 0) & (found <= 1)).all()
    least = minimize(
        lambda code: ((code - requested) ** 2).sum(),
        np.full(WEATHER_DIM, 0.1),
        jac=lambda code: 2 * (code - requested),
        bounds=[(0, 1)] * WEATHER_DIM,
        constraints=LinearConstraint(CODE_SUMS, -np.inf, CODE_SUM_LIMITS),
        method="SLSQP",
    )
    assert least.success
    assert np.abs(found - least.x).max() < EXACT


@lenient
@given(point=POINT, other=CODE)
def test_no_point_of_the_set_is_nearer(street, point, other):
    # Of the nearest point of a convex set: all of the set lies beyond the plane through it.
    found, inside = _projected(street, point), _projected(street, other)
    assert (np.array(point) - found) @ (inside - found) <= ROUNDING * 20


@lenient
@given(code=CODE)
def test_what_goes_together_stays_to_the_bit(street, code):
    feasible = FeasibleSet(_space(street))
    inside = feasible.project(torch.tensor(code)).theta
    again = feasible.project(inside)
    assert torch.equal(again.theta, inside)
    assert again.active == ()
    assert feasible.violations(inside) == ()


@pytest.mark.parametrize(
    "code",
    [
        *torch.eye(WEATHER_DIM)[[0, 2, 3, 4, 5]].tolist(),
        [0, 1, 0, 0.5, 1, 0],
        [0.25, 0.5, 0, 0, 0, 0.25],
        [0] * WEATHER_DIM,
    ],
)
def test_each_code_reaches_its_end(street, code):
    assert _projected(street, code) == pytest.approx(np.array(code), abs=0)


@pytest.mark.parametrize(
    ("code", "names"),
    [
        ([1.0, 1.0, 0.0, 1.0, 0.0, 0.0], ("weather: fog in rain or snow",)),
        ([0.0, 0.6, 0.0, 0.6, 0.0, 0.6], ("weather: fog in rain or snow",)),
        ([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], ("weather: rain without cover",)),
        ([0.0, 0.0, 1.0, 1.0, 0.0, 0.0], ("weather: dark",)),
        ([0.0, 0.0, 0.6, 0.0, 0.6, 0.0], ("weather: dusk at night",)),
        (
            [1.0, 1.0, 1.0, 0.2, 0.0, 0.0],
            ("weather: fog in rain or snow", "weather: rain without cover", "weather: dark"),
        ),
    ],
)
def test_what_holds_back_is_named(street, code, names):
    feasible = FeasibleSet(_space(street))
    assert feasible.project(torch.tensor(code)).active == names
    assert feasible.violations(torch.tensor(code)) == names


def test_a_code_beyond_its_budget_is_named_as_before(street):
    space = _space(street, weather=0.4)
    found = FeasibleSet(space).project(torch.tensor([0.6, 0.1, 0.0, 0.0, 0.0, 0.0]))
    assert found.active == ("weather.fog: bounds",)
    assert found.theta.tolist() == pytest.approx([0.4, 0.1, 0.0, 0.0, 0.0, 0.0])


@lenient
@given(start=CODE, change=POINT)
def test_a_scene_that_has_such_weather_already_may_keep_it(street, start, change):
    space = _space(street, start)
    feasible = FeasibleSet(space)
    assert feasible.project(space.theta0).active == ()
    assert torch.equal(feasible.project(space.theta0).theta, space.theta0)
    once = feasible.project(torch.tensor(change))
    changed = space.apply(space.scene, once.theta)
    before, after = (CODE_SUMS @ s.environment.weather.double().numpy() for s in (space.scene, changed))
    assert (after <= np.maximum(CODE_SUM_LIMITS, before) + ROUNDING).all()
    assert check_scene(space.scene, changed, "outlines", limits=LIMITS) == []


@lenient
@given(code=CODE)
def test_projection_and_check_agree_on_weather(street, code):
    space = _space(street)
    theta = torch.tensor(code, dtype=torch.float32)
    beyond = (CODE_SUMS @ np.array(code) - CODE_SUM_LIMITS).max()
    found = check_scene(space.scene, space.apply(space.scene, theta), "outlines", limits=LIMITS)
    if beyond > 0.03:
        assert FeasibleSet(space).violations(theta)
        assert found
    elif beyond < 0:
        assert not FeasibleSet(space).violations(theta)
        assert not found


def test_bounding_together_is_a_limit(street):
    space, everything = _space(street), torch.ones(WEATHER_DIM)
    free = FeasibleSet(space, FeasibilityLimits(joint_weather=False)).project(everything)
    assert torch.equal(free.theta, everything)
    assert free.active == ()
    changed = space.apply(space.scene, everything)
    assert check_scene(space.scene, changed, joint_weather=False, limits=LIMITS) == []
    assert len(check_scene(space.scene, changed, joint_weather=True, limits=LIMITS)) == 3


def _invisible_beyond(limit: float):
    """Object 1 of 2 becomes invisible where fog and dusk sum to more than `limit`."""
    return lambda weather: np.array([False, weather[0] + weather[2] > limit])


@lenient
@given(code=CODE, limit=st.floats(0.0, 1.5))
def test_weather_is_scaled_back_where_a_car_becomes_invisible(street, code, limit):
    space = _space(street)
    together = FeasibleSet(space).project(torch.tensor(code)).theta
    feasible = FeasibleSet(space, find_invisible=_invisible_beyond(limit))
    found = feasible.project(torch.tensor(code))
    assert feasible.violations(found.theta) == ()
    assert torch.equal(feasible.project(found.theta).theta, found.theta)
    total = float(together[0] + together[2])
    if total <= limit:
        assert torch.equal(found.theta, together)
    else:
        assert found.active[-1] == "objects[1]: contrast"
        scale = float((found.theta * together).sum() / (together**2).sum())
        assert torch.allclose(found.theta, scale * together, atol=1e-6)
        assert limit / total - 1 / 32 - 1e-6 <= scale <= limit / total + 1e-6


def test_the_check_names_invisible_cars(street):
    scene = street(positions_xz=((0.0, 60.0),))
    x0, y0, x1, y1 = (round(v) for v in scene.objects.box2d[0].tolist())
    photograph = scene.photograph.clone()
    photograph[:, y0 : (y0 + y1) // 2, x0:x1] -= 0.1
    lower = scene.objects.box2d.clone()
    lower[:, 3] = lower[:, 1] + 40
    scene = replace(scene, photograph=photograph).with_objects(box2d=lower)
    thick = scene.with_environment(weather=torch.tensor([1.0, 0.0, 0.0, 0.0]))
    found = check_scene(scene, thick, "outlines")
    assert len(found) == 1
    assert found[0].startswith("objects[0]: out of sight, contrast 0.0")
    thin = scene.with_environment(weather=torch.tensor([0.1, 0.0, 0.0, 0.0]))
    assert check_scene(scene, thin, "outlines") == []
