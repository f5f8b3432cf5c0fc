import ast
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import drivesem.attacks.feasibility_check
from drivesem.attacks.budgets import PRESETS, change_limits
from drivesem.attacks.feasibility_check import (
    PAPER_LIMITS,
    ChangeLimits,
    _collisions,
    _MeasuredCar,
    _OutlineCheck,
    available_check_method,
    check_limits,
    check_scene,
    overlap_area,
)
from drivesem.attacks.feasible.constraints import FeasibilityLimits, footprint_gaps, footprint_overlaps
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.feasible.vehicles import VehicleBoxes
from drivesem.attacks.space import COMBOS, Budget, ParameterSpace, ground_axes
from scene_ir import ffd
from scene_ir.errors import RangeError, ShapeError

AHEAD = -math.pi / 2
"""Yaw of a car that points away from the camera."""
CROWDED = ((-2.2, 8.0), (-2.2, 12.9), (0.2, 8.3), (2.4, 10.0), (2.4, 15.2), (0.1, 14.0))


def _names(lines) -> set[str]:
    return {line.split(": ")[1] for line in lines}


def _feasible(scene, *params, **settings_) -> FeasibleSet:
    return FeasibleSet(ParameterSpace(scene, params), **settings_)


def _random_theta(space, seed, scale):
    return torch.randn(space.dim, generator=torch.Generator().manual_seed(seed)) * scale


def _pair_and_hidden(street):
    """Two cars, and the same with the second behind the first, which is taller than the camera stands."""
    pair = street(positions_xz=((0.0, 6.0), (13.0, 40.0)), yaw=AHEAD)
    pair = pair.with_objects(size_lhw=torch.tensor([[4.2, 2.6, 1.9], [4.2, 1.5, 1.75]]))
    return pair, pair.with_objects(translation=pair.objects.translation - torch.tensor([[0.0, 0, 0], [13, 0, 0]]))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31), scale=st.floats(0.1, 3.0), number=st.sampled_from(sorted(COMBOS)))
def test_projection_is_inside_idempotent_and_confirmed_by_the_check(street, seed, scale, number):
    scene = street(positions_xz=CROWDED, road_edge_x_m=4.0)
    space = ParameterSpace(scene, COMBOS[number])
    feasible = FeasibleSet(space)
    theta = _random_theta(space, seed, 10 * scale * space.step)
    once = feasible.project(theta)
    assert torch.equal(FeasibleSet(space).project(theta).theta, once.theta)
    assert feasible.violations(once.theta) == ()
    assert bool((once.theta >= space.lower).all())
    assert bool((once.theta <= space.upper).all())
    twice = feasible.project(once.theta)
    assert torch.equal(twice.theta, once.theta)
    assert twice.active == ()
    assert check_scene(scene, space.apply(scene, once.theta)) == []


def test_theta0_is_feasible_even_where_labels_overlap_and_meshes_are_strained(street):
    scene = street(positions_xz=((0.0, 10.0), (0.5, 11.0), (0.2, 10.5), (-9.0, 9.0)), road_edge_x_m=1.0)
    strained = torch.randn(4, 64, 3, generator=torch.Generator().manual_seed(2)) * 0.2
    scene = scene.with_objects(ffd=strained)
    space = ParameterSpace(scene, COMBOS[2])
    result = FeasibleSet(space).project(space.theta0)
    assert torch.equal(result.theta, space.theta0)
    assert result.active == ()
    assert FeasibleSet(space).violations(space.theta0) == ()
    assert check_scene(scene, space.apply(scene, space.theta0)) == []


def test_violations_at_the_start_stay_and_are_named(street):
    def named(**street_words):
        space = ParameterSpace(street(**street_words), COMBOS[2])
        feasible = FeasibleSet(space)
        assert feasible.violations(space.theta0) == ()
        assert torch.equal(feasible.project(space.theta0).theta, space.theta0)
        return set(feasible.violated_at_start)

    assert named() == set()
    overlapping = {"positions_xz": ((0.0, 10.0), (1.0, 13.0), (6.0, 20.0)), "yaw": AHEAD}
    assert {"objects[0]: collision", "objects[1]: collision"} <= named(**overlapping)
    assert not any(name.startswith("objects[2]") for name in named(**overlapping))
    # Footprints 2 cm apart: less than the clearance.
    assert named(positions_xz=((0.0, 10.0), (0.0, 14.22)), yaw=AHEAD) >= {"objects[0]: collision"}
    assert named(positions_xz=((0.0, 10.0), (6.0, 14.0)), road_edge_x_m=2.0) == {"objects[1]: road"}
    assert "objects[0]: frame" in named(positions_xz=((9.5, 9.0),), yaw=0.0)
    assert "objects[1]: visibility" in named(positions_xz=((0.0, 10.0), (0.5, 11.5)))


def test_a_mesh_that_is_strained_at_the_start_is_named(street):
    scene = street()
    offsets = scene.objects.ffd.clone()
    offsets[2] = 0.5 * _stretch(scene.objects)[2]
    space = ParameterSpace(scene.with_objects(ffd=offsets), COMBOS[2])
    assert FeasibleSet(space).violated_at_start == ("objects[2]: strain",)


def test_a_feasible_theta_is_returned_to_the_bit(street):
    feasible = _feasible(street(), "translate", "rotate")
    theta = 3 * feasible.space.step
    assert torch.equal(feasible.project(theta).theta, theta)


def test_bounds_are_named(street):
    feasible, theta = _feasible(street(), "rotate"), torch.tensor([0.0, 0.0, 1.0, 0.0])
    result = feasible.project(theta)
    assert float(result.theta[2]) == pytest.approx(0.35)
    assert result.active == feasible.violations(theta) == ("objects[2].yaw: bounds",)


def test_strain_and_the_lowest_layer(street):
    feasible = _feasible(street(), "mesh")
    result = feasible.project(_random_theta(feasible.space, 4, 0.15))
    offsets = ffd.from_symmetric(result.theta.reshape(4, 96)).double()
    assert float(offsets.reshape(4, 4, 4, 4, 3)[:, :, -1, :, 1].abs().max()) == 0
    axis = torch.linspace(0, 1, 9, dtype=torch.float64)
    points = torch.cartesian_prod(axis - 0.5, axis - 1, axis - 0.5)
    strain = torch.linalg.svdvals(ffd.jacobian(points, offsets))
    assert float(strain.min()) > 0.69
    assert float(strain.max()) < 1.41
    # Scaled back no further than needed: each car's strain is at its bound, to the bisection's resolution.
    per_car = torch.maximum((1 - strain.amin(dim=(1, 2))) / 0.3, (strain.amax(dim=(1, 2)) - 1) / 0.4)
    assert float(per_car.min()) > 0.8
    assert {f"objects[{i}]: strain" for i in range(4)} <= set(result.active)


def test_cars_that_would_collide_stop_short_of_each_other(street):
    scene = street(positions_xz=((0.0, 10.0), (0.0, 15.0), (6.0, 14.0)), yaw=AHEAD)
    space = ParameterSpace(scene, ("translate",))
    theta = space.theta0.clone()
    theta[0], theta[2], theta[4] = 0.25, -0.25, 0.2  # 1.05 m each, with 0.8 m between them; the third is free
    assert _names(FeasibleSet(space).violations(theta)) == {"collision"}
    result = FeasibleSet(space).project(theta)
    moved = space.apply(scene, result.theta).objects.translation
    gap = float(moved[1, 2] - moved[0, 2]) - 4.2
    assert 0.04 < gap < 0.4
    assert float(result.theta[4]) == pytest.approx(0.2)
    assert set(result.active) == {"objects[0]: collision", "objects[1]: collision"}
    # With the bounds alone, as in the paper, they do collide.
    assert torch.equal(FeasibleSet(space, only_bounds=True).project(theta).theta, theta)


def test_a_kerb_stops_the_car_across_but_not_along(street):
    scene = street(positions_xz=((0.0, 10.0),), yaw=AHEAD, road_edge_x_m=0.9)
    result = _feasible(scene, "translate").project(torch.tensor([0.2, 0.25]))
    assert result.active == ("objects[0]: road",)
    assert float(result.theta[0]) == pytest.approx(0.2)
    assert 0 < float(result.theta[1]) < 0.12


def test_a_car_off_the_road_may_move_anywhere(street):
    scene = street(positions_xz=((8.0, 14.0),), road_edge_x_m=3.0)
    assert _feasible(scene, "translate").project(torch.tensor([0.25, 0.25])).active == ()


def test_a_car_stays_in_the_picture(street):
    scene = street(positions_xz=((6.9, 9.0),), yaw=0.0)
    feasible, theta = _feasible(scene, "translate"), torch.tensor([0.25, 0.0])
    assert _names(feasible.violations(theta)) == {"frame"}
    assert check_scene(scene, feasible.space.apply(scene, theta)) != []
    result = feasible.project(theta)
    assert 0 < float(result.theta[0]) < 0.25
    assert feasible.violations(result.theta) == ()


def test_a_car_is_not_hidden_by_another(street):
    # The far car looks out on one side of the near one and would go behind it.
    feasible = _feasible(street(positions_xz=((0.0, 7.0), (3.0, 13.0)), yaw=AHEAD), "translate")
    theta = torch.tensor([0.0, -0.2, 0.0, 0.25])  # across is towards -x: both move to one another in the picture
    assert "visibility" in _names(feasible.violations(theta))
    result = feasible.project(theta)
    assert feasible.violations(result.theta) == ()
    assert "visibility" in _names(result.active)
    assert float(result.theta.abs().max()) > 0.02


def test_a_growing_mesh_does_not_reach_into_a_neighbour(street):
    scene = street(positions_xz=((0.0, 10.0), (1.9, 10.0)), yaw=AHEAD)
    space = ParameterSpace(scene, ("mesh",))
    wide = torch.zeros(2, 4, 4, 2, 3)
    wide[..., 2] = -0.09  # the half at z < 0 goes outwards, and the other with it
    theta = wide.reshape(-1)
    assert _names(FeasibleSet(space).violations(theta)) == {"collision"}
    result = FeasibleSet(space).project(theta)
    assert check_scene(scene, space.apply(scene, result.theta)) == []
    assert float(result.theta.abs().max()) > 0.005


def test_invalid_thetas_are_named(street):
    feasible = _feasible(street(), "rotate")
    with pytest.raises(ShapeError, match="theta"):
        feasible.project(torch.zeros(3))
    with pytest.raises(RangeError, match=r"objects\[1\]\.yaw: expected a finite value"):
        feasible.project(torch.tensor([0.0, math.inf, 0.0, 0.0]))


def test_a_scene_without_cars_is_projected_onto_its_bounds(street):
    scene = street(positions_xz=())
    feasible = _feasible(scene, "weather", "translate")
    result = feasible.project(torch.tensor([2.0, -1.0, 0.5, 0.0]))
    assert result.theta.tolist() == [1.0, 0.0, 0.5, 0.0]
    assert check_scene(scene, feasible.space.apply(scene, result.theta)) == []


def test_limits_are_settings(street):
    loose, tight = (
        _feasible(street(), "mesh", limits=FeasibilityLimits(strain=strain))
        for strain in ((0.5, 2.0), (0.95, 1.05))
    )
    sizes = [float(each.project(_random_theta(each.space, 4, 0.1)).theta.norm()) for each in (loose, tight)]
    assert sizes[1] < 0.5 * sizes[0]


# The independent check.


def test_the_check_shares_no_code():
    tree = ast.parse(Path(drivesem.attacks.feasibility_check.__file__).read_text(encoding="utf-8"))
    imported = {
        n.module if isinstance(n, ast.ImportFrom) else a.name
        for n in ast.walk(tree)
        if isinstance(n, ast.Import | ast.ImportFrom)
        for a in n.names
    }
    assert imported <= {
        *("__future__", "collections.abc", "dataclasses", "functools", "importlib", "math", "typing"),
        *("cv2", "numpy", "numpy.typing", "scene_ir.types"),
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o: {"translation": o.translation + torch.tensor([0.0, 0.1, 0.0])}, "off the ground"),
        (lambda o: {"translation": o.translation + torch.tensor([0.0, 0.0, 1.2])}, "own lengths"),
        (lambda o: {"yaw": o.yaw + 0.5}, "turned by 0.500 rad"),
        (lambda o: {"size_lhw": o.size_lhw * 1.1}, "size changed by 10.0 %"),
        (lambda o: {"texture_code": o.texture_code + 2}, "objects.texture_code: outside"),
        (lambda o: {"ffd": o.ffd + 0.3 * torch.randn(o.ffd.shape, generator=torch.Generator())}, "strain in"),
        (lambda o: {"ffd": o.ffd + torch.tensor([0.0, 0.05, 0.0])}, "lowest lattice layer"),
        (lambda o: {"ffd": -2 * _stretch(o)}, "mesh inverted"),
        (lambda o: {"ffd": o.ffd + torch.tensor([0.0, 0.0, 0.05])}, "mesh not symmetric"),
        (lambda o: {"ffd": o.ffd + 0.6 * _stretch(o)}, "lattice bent by 0.300 unit boxes"),
    ],
)
def test_the_check_finds_what_is_wrong(street, change, message):
    scene = street()
    found = check_scene(scene, scene.with_objects(**change(scene.objects)))
    assert any(message in line for line in found), found


def _stretch(objects):
    """Offsets that double the length."""
    along = torch.linspace(-0.5, 0.5, 4).reshape(4, 1, 1).expand(4, 4, 4).reshape(64)
    offsets = torch.zeros_like(objects.ffd)
    offsets[..., 0] = along
    return offsets


def test_the_check_finds_collisions_roads_and_hiding(street):
    scene = street(positions_xz=((0.0, 10.0), (0.0, 15.0)), yaw=AHEAD)
    near = scene.with_objects(translation=scene.objects.translation - torch.tensor([[0.0, 0, 0], [0, 0, 1.0]]))
    assert any("collision with objects[0]" in line for line in check_scene(scene, near))
    narrow = street(positions_xz=((0.0, 10.0),), yaw=AHEAD, road_edge_x_m=0.9)
    left = narrow.with_objects(translation=narrow.objects.translation + torch.tensor([0.9, 0.0, 0.0]))
    assert any("left the road" in line for line in check_scene(narrow, left))
    pair, hidden = _pair_and_hidden(street)
    assert any("objects[1]: hidden" in line for line in check_scene(pair, hidden))


STREET = change_limits(PRESETS["street"])


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ((1.1, 1.1, 1.1), []),
        ((0.9, 0.9, 0.9), []),
        ((1.11, 1.11, 1.11), ["objects[0]: size changed by 11.0 %"]),
        ((0.88, 0.88, 0.88), ["objects[0]: size changed by -12.0 %"]),
        ((1.1, 1.0, 1.0), ["objects[0]: size changed, and not alike in length, height and width"]),
    ],
)
def test_the_check_bounds_sizes_by_the_budget(street, factors, message):
    scene = street(positions_xz=((0.0, 12.0),))
    grown = scene.with_objects(size_lhw=scene.objects.size_lhw * torch.tensor(factors))
    assert check_scene(scene, grown, limits=STREET) == message


def test_the_check_bounds_the_sun_by_the_budget(street):
    scene = street()
    moved = scene.with_environment(light=torch.tensor([1.0, -1.0, 0.5]))
    assert check_scene(scene, moved, limits=STREET) == []
    assert check_scene(scene, moved) == ["environment.light: outside [-0, 0]"]
    assert check_scene(scene, moved, limits=change_limits(Budget(sun=0.6))) == [
        "environment.light: outside [-0.6, 0.6]"
    ]
    other = scene.with_environment(sun=torch.tensor([0.6, -0.8, 0.0]))
    assert check_scene(scene, other, limits=STREET) == ["sun: changed"]


def test_a_car_grows_until_it_meets_another(street):
    # They stand 0.3 m apart, side by side, each 1.75 m wide.
    scene = street(positions_xz=((-1.025, 12.0), (1.025, 12.0)), yaw=AHEAD)
    budget = Budget(size=0.4)
    feasible = FeasibleSet(ParameterSpace(scene, ("size",), budget))
    once = feasible.project(torch.tensor([0.35, 0.35]))
    assert {"objects[0]: collision", "objects[1]: collision"} == set(once.active)
    assert feasible.violations(torch.tensor([0.35, 0.35]))
    assert feasible.violations(once.theta) == ()
    assert float(once.theta.max()) < 0.3
    grown = feasible.space.apply(scene, once.theta)
    assert check_scene(scene, grown, limits=change_limits(budget)) == []
    assert feasible.project(torch.tensor([0.1, 0.1])).theta.tolist() == pytest.approx([0.1, 0.1])


def _moved(scene, along=0.0, across=0.0):
    """The first car moved by metres."""
    shift = ground_axes(scene.objects.yaw, torch.ones(len(scene.objects)), scene.environment.ground)[0]
    by = torch.zeros_like(scene.objects.translation)
    by[0] = along * shift[0] + across * shift[1]
    return scene.with_objects(translation=scene.objects.translation + by)


def test_the_check_follows_the_budget(street):
    scene = street(positions_xz=((0.0, 14.0), (3.0, 30.0)), yaw=AHEAD)
    for along in (3.0, -3.0):
        far = _moved(scene, along)
        (line,) = check_scene(scene, far)
        assert line.startswith("objects[0]: moved by")
        assert "own lengths" in line
        assert check_scene(scene, far, limits=STREET) == []
    for limits in (PAPER_LIMITS, STREET):
        (line,) = check_scene(scene, _moved(scene, across=1.2), limits=limits)
        assert "moved by" in line
    assert check_scene(scene, _moved(scene, across=0.99), limits=STREET) == []
    assert "moved by 4.100" in check_scene(scene, _moved(scene, 4.1), limits=STREET)[0]
    # Of its distance from the camera, a car goes no more than a share.
    near = street(positions_xz=((0.0, 10.0), (3.0, 30.0)), yaw=AHEAD)
    assert check_scene(near, _moved(near, 3.0), limits=STREET) == []
    assert "moved by 3.100" in check_scene(near, _moved(near, 3.1), limits=STREET)[0]


@pytest.mark.parametrize("partly", [{"occlusion": torch.tensor([1, 0])}, {"truncation": torch.tensor([0.2, 0])}])
def test_the_check_limits_partly_visible_cars_to_the_papers_bounds(street, partly):
    scene = street(positions_xz=((0.0, 14.0), (3.0, 30.0)), yaw=AHEAD).with_objects(**partly)
    (line,) = check_scene(scene, _moved(scene, 2.0), limits=STREET)
    assert line.startswith("objects[0]: moved by")
    assert check_scene(scene, _moved(scene, 1.0), limits=STREET) == []


@pytest.mark.parametrize("limits", [PAPER_LIMITS, STREET])
def test_no_budget_lets_a_car_into_another_or_off_the_road(street, limits):
    row = street(positions_xz=((0.0, 10.0), (0.0, 15.0)), yaw=AHEAD)
    assert any("collision with objects[0]" in line for line in check_scene(row, _moved(row, 3.0), limits=limits))
    narrow = street(positions_xz=((0.0, 10.0),), yaw=AHEAD, road_edge_x_m=0.9)
    left = check_scene(narrow, _moved(narrow, across=0.9), limits=limits)
    assert any("left the road" in line for line in left)


def test_the_projection_keeps_a_street_s_cars_apart(street):
    scene = street(positions_xz=((0.0, 14.0), (0.0, 21.0)), yaw=AHEAD)
    # The far one is higher, so that it stays in sight.
    scene = scene.with_objects(size_lhw=torch.tensor([[4.2, 1.5, 1.75], [4.2, 2.6, 1.75]]))
    space = ParameterSpace(scene, COMBOS[1], PRESETS["street"])
    far = FeasibleSet(space).project(space.upper * torch.tensor([1.0, 0, 0, 0, 0, 0]))
    moved = space.apply(scene, far.theta)
    metres = (moved.objects.translation - scene.objects.translation).norm(dim=1)
    assert 2.6 < float(metres[0]) < 2.8
    assert check_scene(scene, moved, limits=STREET) == []
    assert "objects[0]: collision" in far.active


def test_a_car_may_grow_by_a_tenth_through_its_lattice(street):
    scene = street(positions_xz=((0.0, 14.0),))
    points = torch.stack(torch.meshgrid(*(torch.linspace(0, 1, 4),) * 3, indexing="ij"), dim=-1).reshape(64, 3)
    for tenth in (0.1, -0.1):
        code = ffd.to_symmetric(tenth * (points - torch.tensor([0.5, 1.0, 0.5])))
        space = ParameterSpace(scene, ("mesh",))
        projected = FeasibleSet(space).project(code)
        assert projected.active == ()
        grown = space.apply(scene, projected.theta)
        old, new = (np.ptp(_MeasuredCar(s, 0).deformed, axis=0) for s in (scene, grown))
        assert new.tolist() == pytest.approx((old * (1 + tenth)).tolist(), rel=1e-3)
        assert check_scene(scene, grown) == []


def test_codes_beyond_the_budget_from_the_start_may_stay(street):
    foggy = street().with_environment(weather=torch.tensor([0.4, 0.0, 0.0, 0.0]))
    limits = ChangeLimits(weather=0.2)
    assert check_limits(foggy, foggy, limits) == []
    thicker = foggy.with_environment(weather=torch.tensor([0.5, 0.0, 0.0, 0.0]))
    assert check_limits(foggy, thicker, limits) == ["environment.weather: outside [0, 0.2]"]


def test_the_check_compares_meshes_where_boxes_overlap_already(street):
    scene = street(positions_xz=((0.0, 10.0), (1.8, 10.0)), yaw=0.0)
    scene = scene.with_objects(yaw=torch.tensor([0.0, math.pi / 2]))
    before, after = [_MeasuredCar(scene, i) for i in range(2)], [_MeasuredCar(scene, i) for i in range(2)]
    shared = overlap_area(before[0].outline, before[1].outline)
    assert overlap_area(before[0].footprint, before[1].footprint) > shared > 1
    # The same rectangles, and a mesh that was a spindle in one of them.
    before[1].vertices = _spindle(before[1])
    less = overlap_area(before[0].outline, before[1].outline)
    assert less < shared - 0.2
    found = _collisions(dict(enumerate(before)), dict(enumerate(after)), _OutlineCheck())
    assert found == [f"objects[1]: mesh runs into that of objects[0], {shared:.2f} m2 ({less:.2f} before)"]
    assert _collisions(dict(enumerate(after)), dict(enumerate(before)), _OutlineCheck()) == []
    assert _collisions(dict(enumerate(after)), dict(enumerate(after)), _OutlineCheck()) == []


def _spindle(car):
    """The vertices of a car's mesh, the narrower the further they are from its middle."""
    local = (car.vertices - car.position) @ car.axes.T
    local[:, 2] *= 1 - np.abs(local[:, 0]) / (car.high[0] - car.low[0]) * 1.8
    return local @ car.axes + car.position


@pytest.fixture
def rays():
    """The check by Open3D."""
    pytest.importorskip("open3d", reason="Open3D or its libusb is not installed", exc_type=ImportError)
    return drivesem.attacks.feasibility_check._visibility_check(None)


def test_rays_and_outlines_agree_on_visibility(street, rays):
    for places in (CROWDED, ((0.0, 6.0), (0.0, 12.0)), ((7.5, 9.0), (0.0, 3.0)), ()):
        scene = street(positions_xz=places)
        cars = [_MeasuredCar(scene, i) for i in range(len(places))]
        (visible, whole), (pixels, all_pixels) = rays.visible(scene, cars), _OutlineCheck().visible(scene, cars)
        shares = [a / b for a, b in zip(visible, whole, strict=True)]
        assert shares == pytest.approx([a / b for a, b in zip(pixels, all_pixels, strict=True)], abs=0.1)


def test_rays_measure_the_ground_that_two_meshes_share(street, rays):
    scene = street(positions_xz=((0.0, 10.0), (1.0, 12.0)), yaw=0.3)
    cars = [_MeasuredCar(scene, i) for i in range(2)]
    shared = overlap_area(cars[0].outline, cars[1].outline)
    assert rays.shared_m2(*cars) == pytest.approx(shared, abs=0.05)
    assert rays.shared_m2(cars[0], cars[0]) == pytest.approx(overlap_area(*(cars[0].outline,) * 2), rel=0.02)
    apart = [_MeasuredCar(street(positions_xz=((0.0, 10.0), (0.0, 20.0))), i) for i in range(2)]
    assert rays.shared_m2(*apart) == 0
    # One mesh above the other: their outlines overlap, and they do not meet.
    cars[1].vertices = cars[1].vertices - [0.0, 5.0, 0.0]
    assert rays.shared_m2(*cars) == 0


def test_rays_find_a_mesh_in_another_and_a_car_behind_another(street, rays):
    scene = street(positions_xz=((0.0, 10.0), (1.8, 10.0)), yaw=0.0)
    scene = scene.with_objects(yaw=torch.tensor([0.0, math.pi / 2]))
    before, after = [_MeasuredCar(scene, i) for i in range(2)], [_MeasuredCar(scene, i) for i in range(2)]
    before[1].vertices = _spindle(before[1])
    (line,) = _collisions(dict(enumerate(before)), dict(enumerate(after)), rays)
    assert line.startswith("objects[1]: mesh runs into that of objects[0]")
    pair, hidden = _pair_and_hidden(street)
    assert "objects[1]: hidden" in check_scene(pair, hidden, "open3d")


@pytest.mark.parametrize("method", [None, "open3d", "outlines"])
def test_without_open3d_outlines_are_used(street, monkeypatch, method):
    monkeypatch.setitem(sys.modules, "open3d", None)
    drivesem.attacks.feasibility_check._open3d.cache_clear()
    try:
        assert available_check_method() == "outlines"
        pair, hidden = _pair_and_hidden(street)
        assert "objects[1]: hidden" in check_scene(pair, hidden, method)
        assert check_scene(pair, pair, method) == []
    finally:
        drivesem.attacks.feasibility_check._open3d.cache_clear()


def test_overlap_area_of_known_shapes():
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    assert overlap_area(square, square + 1) == pytest.approx(1.0)
    assert overlap_area(square, square + 3) == 0.0
    assert overlap_area(square, square) == pytest.approx(4.0)
    diamond = np.array([[1.0, -1], [3, 1], [1, 3], [-1, 1]])
    assert overlap_area(square, diamond) == pytest.approx(4.0)
    assert overlap_area(square, diamond + 1) == pytest.approx(2.0)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_projection_and_check_agree_on_gap_and_overlap(seed):
    draw = np.random.default_rng(seed)
    yaw = draw.uniform(-3, 3, 2)
    cos, sin = np.cos(yaw), np.sin(yaw)
    low, size, at = draw.uniform(-3, 0, (2, 3)), draw.uniform(1, 5, (2, 3)), draw.uniform(-2.5, 2.5, (2, 3))
    cars = VehicleBoxes.from_poses(low, low + size, yaw, at)
    corners = np.array([[1, 0], [1, 1], [0, 1], [0, 0]]) * size[:, None, ::2] + low[:, None, ::2]
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], axis=1)
    footprints = corners @ rotation + at[:, None, ::2]
    gap, area = footprint_gaps(cars, np.arange(2)), footprint_overlaps(cars, np.array([0, 1]), np.array([1, 0]))

    def ccw(p):
        x, z = p.T
        return p if x @ np.roll(z, -1) - z @ np.roll(x, -1) > 0 else p[::-1]

    expected = overlap_area(ccw(footprints[0]), ccw(footprints[1]))
    assert area == pytest.approx([expected] * 2, abs=1e-9)
    assert (gap[0, 1] < 0) == (expected > 0)
    assert gap[0, 1] == pytest.approx(gap[1, 0], abs=1e-12)
