"""3D-SDN's parametrisation of a car's place: exact geometry, its gradient, the way to the ground, both checks."""

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attacks.budgets import PRESETS, change_limits
from drivesem.attacks.feasibility_check import check_limits, check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import COMBOS, Budget, ParameterSpace, RegionsOfInterest
from scene_ir.errors import FormatError

NEAR = ((-2.0, 9.0), (2.4, 13.0), (0.4, 24.0))
ROI = change_limits(Budget(), "roi")


def _space(scene, params=("translate",), **settings) -> ParameterSpace:
    return ParameterSpace(scene, params, parametrisation="roi", **settings)


def _seen(scene) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels (N, 2) of the middles of cars' boxes, and their distances (N,) from the camera."""
    middle = scene.objects.translation - torch.nn.functional.pad(scene.objects.size_lhw[:, 1:2] / 2, (1, 1))
    matrix = scene.camera.matrix.to(middle)
    clip = middle @ matrix[:, :3].T + matrix[:, 3]
    eye = -torch.linalg.solve(matrix[:, :3], matrix[:, 3])
    return clip[:, :2] / clip[:, 2:], (middle - eye).norm(dim=1)


def test_a_step_moves_the_middle_by_that_share_of_the_box_and_the_distance_by_half_of_log_depth(street):
    scene = street(positions_xz=NEAR, dtype=torch.float64)
    space = _space(scene)
    theta = torch.tensor([0.1, 0, 0, 0, -0.2, 0, 0.05, 0.03, 0.25], dtype=torch.float64)
    box = scene.objects.box2d
    (before, far), (after, now) = _seen(scene), _seen(space.apply(scene, theta))
    shares = (after - before) / (box[:, 2:] - box[:, :2])
    assert shares.tolist() == [pytest.approx(row, abs=1e-9) for row in theta.reshape(3, 3)[:, :2].tolist()]
    assert (now / far).tolist() == pytest.approx([1.0, 1.0, math.exp(0.125)], abs=1e-12)


def test_nothing_moves_at_zero_and_codes_are_named_with_a_unit(street):
    scene = street(positions_xz=NEAR)
    space = _space(scene, COMBOS[2])
    assert torch.equal(space.apply(scene, space.theta0).objects.translation, scene.objects.translation)
    assert space.dim == 3 * (3 + 1 + 96)
    assert [space.name(i) for i in range(3)] == [
        f"objects[0].translate.{n}" for n in ("right", "down", "log_depth")
    ]
    assert (space.upper[:9] == 0.25).all()
    assert (space.step[:9] == 0.01).all()
    assert space.display(0, 0.1) == "10 %"
    assert space.display(2, 0.1) == f"{100 * math.expm1(0.05):.3g} %"


def test_gradient_is_that_of_central_differences(street):
    scene = street(positions_xz=NEAR, dtype=torch.float64)
    space = _space(scene)
    weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(theta):
        return (weights * space.apply(scene, theta).objects.translation).sum()

    theta = 0.1 * torch.randn(9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    leaf = theta.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    for i, step in enumerate(1e-6 * torch.eye(9, dtype=torch.float64)):
        assert float(gradient[i]) == pytest.approx(
            float(value(theta + step) - value(theta - step)) / 2e-6, rel=1e-6
        )


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31), scale=st.floats(0.1, 4.0))
def test_projected_cars_keep_their_height_and_both_checks_agree(street, seed, scale):
    scene = street(positions_xz=NEAR, road_edge_x_m=4.0)
    space = _space(scene, COMBOS[2])
    feasible = FeasibleSet(space)
    theta = torch.randn(space.dim, generator=torch.Generator().manual_seed(seed)) * 10 * scale * space.step
    once = feasible.project(theta)
    assert torch.equal(feasible.project(once.theta).theta, once.theta)
    assert feasible.violations(once.theta) == ()
    assert bool(((once.theta >= space.lower) & (once.theta <= space.upper)).all())
    moved = space.apply(scene, once.theta)
    plane = scene.environment.ground
    rise = (moved.objects.translation - scene.objects.translation) @ plane[:3]
    assert rise.abs().max() < 1e-4
    assert check_scene(scene, moved, limits=ROI) == []


def test_without_projection_a_car_may_leave_the_ground_and_the_check_reports_it(street):
    scene = street(positions_xz=NEAR)
    space = _space(scene)
    theta = space.theta0.clone()
    theta[1] = -0.2
    assert torch.equal(FeasibleSet(space, only_bounds=True).project(theta).theta, theta)
    moved = space.apply(scene, theta)
    assert any("off the ground" in line for line in check_scene(scene, moved, limits=ROI))
    held = FeasibleSet(space).project(theta)
    assert held.theta[1].abs() < 1e-4
    assert "objects[0]: ground" in held.active
    assert FeasibleSet(space).violations(theta)[0] == "objects[0]: ground"


def test_second_check_measures_in_the_picture(street):
    scene = street(positions_xz=NEAR)
    space = _space(scene, budget=Budget(translate=0.1))
    theta = space.theta0.clone()
    theta[8] = 0.1
    far = space.apply(scene, theta)
    metres = float((far.objects.translation - scene.objects.translation)[2].norm())
    assert metres > 0.25 * float(scene.objects.size_lhw[2, 0])  # more than ours allows
    assert check_limits(scene, far, change_limits(space.budget, "roi")) == []
    (line,) = check_limits(scene, far, change_limits(Budget(translate=0.05), "roi"))
    assert line.startswith("objects[2]: moved by ")
    assert line.endswith("of its box and 0.100 in log depth")


def test_a_gradient_on_the_ground_is_that_of_the_projected_way(street):
    scene = street(positions_xz=NEAR, dtype=torch.float64, road_edge_x_m=40.0)
    space = _space(scene)
    feasible = FeasibleSet(space)
    weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def value(theta):
        return (weights * space.apply(scene, theta).objects.translation).sum()

    theta = feasible.project(torch.tensor([0.02, 0, 0.03] * 3, dtype=torch.float64)).theta
    leaf = theta.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    along = feasible.project_gradient(theta, gradient)
    for i in (0, 2, 3, 5, 6, 8):
        step = torch.zeros_like(theta)
        step[i] = 1e-6
        there, back = (feasible.project(theta + sign * step).theta for sign in (1, -1))
        assert float(along[i]) == pytest.approx(float(value(there) - value(back)) / 2e-6, rel=1e-5, abs=1e-6)
    assert along[1::3].tolist() == [0, 0, 0]
    assert torch.equal(FeasibleSet(space, only_bounds=True).project_gradient(theta, gradient), gradient)


def test_a_way_to_the_ground_that_is_too_long_is_shortened(street):
    scene = street(positions_xz=NEAR, dtype=torch.float64)
    regions = RegionsOfInterest.from_scene(scene)
    far = torch.tensor([[0.0, 0.0, 2.0]] * 3, dtype=torch.float64)
    most = torch.tensor([0.02, 1e-9, 10.0], dtype=torch.float64)
    found = regions.project_to_ground(far, most)
    assert 0 < float(found[0, 2]) < 2.0
    assert found[1].tolist() == [0, 0, 0]
    assert float(found[2, 2]) == 2.0
    assert bool((found[:, 1].abs() <= most).all())
    assert (regions.shift(found) @ regions.ground_normal).abs().max() < 1e-9


@pytest.mark.parametrize("name", ["parking", "street"])
def test_budgets_with_metres_are_refused(street, name):
    with pytest.raises(FormatError, match=r"budget: expected a budget without metres.*parametrisation roi"):
        _space(street(positions_xz=NEAR), budget=PRESETS[name])
