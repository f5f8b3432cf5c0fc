import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attacks.space import (
    COMBOS,
    PAPER_PARAMETERS,
    Budget,
    Parameter,
    ParameterSpace,
    Perturbation,
    combo_parameters,
    parse_params,
)
from scene_ir.errors import FormatError, RangeError, ShapeError

ALL = tuple(Parameter)
WIDE = Budget(size=0.1, sun=1.0, night=1.0, snow=1.0, lamps=1.0)


def test_parsed_parameters_are_in_thetas_order():
    assert parse_params("mesh, translate,rotate") == COMBOS[2]
    assert [p.value for p in parse_params("rotate")] == ["rotate"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "translate,spin",
            "expected names among color, weather, foliage, translate, rotate, mesh, size, sun, lamps, found 'spin'",
        ),
        ("", "at least one of color"),
        ("mesh,mesh", "expected each parameter once"),
    ],
)
def test_parse_params_names_what_is_wrong(text, message):
    with pytest.raises(FormatError, match="params") as caught:
        parse_params(text)
    assert message in str(caught.value)


def test_unknown_combo_and_budget():
    with pytest.raises(RangeError, match="combo: expected one of 1, 2, 3, 4, found 5"):
        combo_parameters(5)
    with pytest.raises(RangeError, match=r"budget\.rotate"):
        Budget(rotate=0.0)
    with pytest.raises(RangeError, match=r"budget\.mesh"):
        Budget(mesh=math.nan)


def test_cardinality_bounds_and_steps(street):
    space = ParameterSpace(street(), ALL, WIDE)
    assert space.dim == 4 * 5 + 6 + 3 + 4 * 2 + 4 * 1 + 4 * 96 + 4 * 1 + 3 + 4 * 1
    for tensor in (space.theta0, space.lower, space.upper, space.step):
        assert tuple(tensor.shape) == (space.dim,)
    assert bool((space.lower <= 0).all())
    assert bool((space.upper >= 0).all())
    weather = space.blocks.get(Parameter.WEATHER)
    assert space.lower[weather].tolist() == [0.0] * 6
    assert space.upper[weather].tolist() == [1.0] * 6
    steps = {p.value: float(space.step[space.blocks.get(p)][0]) for p in ALL}
    assert steps == pytest.approx(
        {"color": 0.05, "weather": 0.25, "foliage": 0.1, "translate": 0.01, "rotate": 0.01, "mesh": 0.025}
        | {"size": 0.01, "sun": 0.1, "lamps": 0.25}
    )


def test_codes_end_at_the_same_value_wherever_they_start(street):
    scene = street()
    scene = scene.with_environment(weather=torch.tensor([0.25, 0.0, 1.0, 0.5]))
    scene = scene.with_objects(texture_code=torch.full((4, 5), -0.5))
    space = ParameterSpace(scene, ("color", "weather"))
    assert space.upper[:20].tolist() == [1.5] * 20
    assert space.lower[:20].tolist() == [-0.5] * 20
    assert space.upper[20:].tolist() == [0.75, 1.0, 0.0, 0.5]
    assert space.lower[20:].tolist() == [-0.25, 0.0, -1.0, -0.5]
    moved = space.apply(scene, space.upper)
    assert moved.objects.texture_code.tolist() == [[1.0] * 5] * 4
    assert moved.environment.weather.tolist() == [1.0] * 4 + [0.0, 0.0]


def test_night_is_a_fifth_code_where_the_budget_has_one(street):
    scene = street().with_environment(weather=torch.tensor([0.0, 0.0, 0.0, 0.0, 0.25]))
    papers, wider = (ParameterSpace(scene, ("weather",), Budget(night=n, weather=0.8)) for n in (0.0, 0.5))
    assert (papers.dim, wider.dim, wider.name(4)) == (4, 5, "weather.night")
    assert wider.upper.tolist() == pytest.approx([0.8] * 4 + [0.25])
    assert ParameterSpace(scene, ("weather",), Budget(night=1.0, weather=0.8)).upper[4] == pytest.approx(0.55)
    assert papers.apply(scene, papers.upper).environment.weather.tolist() == pytest.approx([0.8] * 4 + [0.25, 0.0])
    assert wider.apply(scene, wider.upper).environment.weather.tolist() == pytest.approx([0.8] * 4 + [0.5, 0.0])


def test_snow_is_a_sixth_code_where_the_budget_has_one(street):
    scene = street()
    both, alone = (ParameterSpace(scene, ("weather",), Budget(night=n, snow=0.6)) for n in (1.0, 0.0))
    assert (both.dim, alone.dim, both.name(5)) == (6, 6, "weather.snow")
    assert both.upper.tolist() == pytest.approx([1.0] * 5 + [0.6])
    assert alone.upper.tolist() == pytest.approx([1.0] * 4 + [0.0, 0.6])
    assert alone.apply(scene, alone.upper).environment.weather.tolist() == pytest.approx([1.0] * 4 + [0.0, 0.6])


def test_every_coordinate_has_a_name_a_unit_and_bounds(street):
    space = ParameterSpace(street(), ALL, WIDE)
    names = [space.name(i) for i in range(space.dim)]
    assert len(set(names)) == space.dim
    yaw3 = space.blocks.get(Parameter.ROTATE).start + 3
    assert space.describe(yaw3) == "objects[3].yaw, rad, [-0.35, 0.35]"
    assert space.describe(20) == "weather.fog, code, [0, 1]"
    with pytest.raises(RangeError, match="theta coordinate"):
        space.describe(space.dim)


def test_theta_by_name_speaks_metres_and_degrees(street):
    space = ParameterSpace(street(), COMBOS[2])
    theta = space.theta0.clone()
    theta[0], theta[8] = 0.1, math.radians(10)
    named = space.theta_by_name(theta)
    assert named["objects[0].translate.along"]["display"] == "0.42 m"
    assert named["objects[0].yaw"]["display"] == "10 deg"
    assert named["objects[0].yaw"]["unit"] == "rad"
    assert len(named) == space.dim


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**31),
    names=st.sets(st.sampled_from(list(Parameter)), min_size=1),
    count=st.integers(0, 5),
)
def test_flatten_is_the_inverse_of_unflatten(street, seed, names, count):
    space = ParameterSpace(
        street(positions_xz=[(2.0 * i - 5, 8.0 + 5 * i) for i in range(count)]), tuple(names), WIDE
    )
    theta = torch.randn(space.dim, generator=torch.Generator().manual_seed(seed))
    parts = space.unflatten(theta)
    assert torch.equal(space.flatten(parts), theta)
    again = space.unflatten(space.flatten(parts))
    for parameter in Parameter:
        one, other = getattr(parts, parameter.value), getattr(again, parameter.value)
        assert (one is None) == (other is None) == (parameter not in names)
        assert one is None or (one.shape == other.shape and torch.equal(one, other))
    # What a name says of a coordinate is where unflatten puts it.
    for parameter, where in space.blocks.items():
        block = getattr(parts, parameter.value).reshape(-1)
        assert torch.equal(theta[where], block)
        owners = [space.name(i).split(".")[0] for i in range(where.start, where.stop)]
        size = len(block) // max(count, 1)
        known = (Parameter.WEATHER, Parameter.FOLIAGE, Parameter.SUN)
        expected = [parameter.value if parameter in known else f"objects[{i // size}]" for i in range(len(block))]
        assert owners == expected


def test_flatten_rejects_what_does_not_fit(street):
    space = ParameterSpace(street(), ("rotate",))
    with pytest.raises(ShapeError, match=r"perturbation\.rotate"):
        space.flatten(Perturbation())
    with pytest.raises(ShapeError, match=r"perturbation\.mesh.*fixed"):
        space.flatten(Perturbation(rotate=torch.zeros(4, 1), mesh=torch.zeros(4, 96)))
    with pytest.raises(ShapeError, match="theta"):
        space.unflatten(torch.zeros(5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_theta0_gives_the_same_scene_to_the_bit(street, dtype):
    generator = torch.Generator().manual_seed(3)
    scene = street(dtype=dtype, tilt=0.02)
    scene = scene.with_objects(
        ffd=torch.randn(4, 64, 3, generator=generator, dtype=dtype) * 0.01,
        texture_code=torch.rand(4, 5, generator=generator, dtype=dtype) - 0.5,
    )
    scene = scene.with_environment(weather=torch.rand(4, generator=generator, dtype=dtype))
    space = ParameterSpace(scene, ALL, WIDE)
    same = space.apply(scene, space.theta0)
    for name in ("translation", "yaw", "ffd", "size_lhw", "texture_code"):
        assert torch.equal(getattr(same.objects, name), getattr(scene.objects, name)), name
    assert torch.equal(same.objects.lamps, scene.objects.lamps)
    assert torch.equal(same.environment.weather, scene.environment.weather)
    assert torch.equal(same.environment.foliage, scene.environment.foliage)
    assert torch.equal(same.environment.light, scene.environment.light.to(dtype))


def test_translation_goes_along_the_heading_by_own_lengths(street):
    scene = street(yaw=-math.pi / 2, dtype=torch.float64)  # the front looks along +z, away from the camera
    space = ParameterSpace(scene, ("translate",))
    theta = space.theta0.clone()
    theta[0], theta[3] = 0.25, 0.1  # car 0 along, car 1 across
    moved = space.apply(scene, theta).objects.translation - scene.objects.translation
    assert moved[0].tolist() == pytest.approx([0, 0, 0.25 * 4.2], abs=1e-12)
    assert moved[1].tolist() == pytest.approx([-0.1 * 4.2, 0, 0], abs=1e-12)
    assert float(moved[2:].abs().max()) == 0


def test_cars_keep_their_height_above_a_tilted_ground(street):
    scene = street(tilt=0.05, dtype=torch.float64)
    scene = scene.with_objects(translation=scene.objects.translation + torch.tensor([0.0, -0.1, 0.0]))
    space = ParameterSpace(scene, ("translate", "rotate"))
    moved = space.apply(scene, 0.7 * space.upper)
    plane = scene.environment.ground

    def above(s):
        return s.objects.translation @ plane[:3] + plane[3]

    assert torch.allclose(above(moved), above(scene), atol=1e-12)
    assert float((moved.objects.translation[:, 1] - scene.objects.translation[:, 1]).abs().max()) > 0.01


def test_mesh_offsets_are_symmetric_and_added_to_the_sources(street):
    scene = street(dtype=torch.float64)
    scene = scene.with_objects(ffd=torch.full((4, 64, 3), 0.01, dtype=torch.float64))
    space = ParameterSpace(scene, ("mesh",))
    theta = torch.randn(space.dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.01
    change = (space.apply(scene, theta).objects.ffd - scene.objects.ffd).reshape(4, 4, 4, 4, 3)
    mirrored = change.flip(-2) * torch.tensor([1.0, 1.0, -1.0])
    assert torch.allclose(change, mirrored, atol=1e-15)
    assert float(change.abs().max()) > 0.01


def test_apply_has_the_gradient_of_its_differences(street):
    scene = street(positions_xz=((0.0, 12.0),), dtype=torch.float64, tilt=0.03)
    space = ParameterSpace(scene, ALL, WIDE)
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(n, generator=generator, dtype=torch.float64) for n in (3, 1, 192, 3, 5, 6, 3, 3, 1)]

    def functional(theta):
        s = space.apply(scene, theta)
        fields = (s.objects.translation, s.objects.yaw, s.objects.ffd, s.objects.size_lhw)
        fields = (
            *fields,
            s.objects.texture_code,
            s.environment.weather,
            s.environment.foliage,
            s.environment.light,
            s.objects.lamps,
        )
        return sum((w * f.reshape(-1).sin()).sum() for w, f in zip(weights, fields, strict=True))

    theta = torch.rand(space.dim, generator=generator, dtype=torch.float64) * 0.2 * space.upper
    assert torch.autograd.gradcheck(functional, theta.requires_grad_(True))


def test_a_size_is_a_share_of_its_own_and_displayed_in_percent(street):
    scene = street(dtype=torch.float64)
    space = ParameterSpace(scene, ("size",), WIDE)
    theta = torch.tensor([0.1, -0.05, 0.0, 0.0], dtype=torch.float64)
    after = space.apply(scene, theta).objects
    grown = after.size_lhw / scene.objects.size_lhw
    assert grown.T.tolist() == [pytest.approx([1.1, 0.95, 1.0, 1.0])] * 3
    # It stands where it stood: y = 0 of its own frame is the ground.
    assert torch.equal(after.translation, scene.objects.translation)
    assert space.theta_by_name(theta)["objects[1].size"]["display"] == "-5 %"
    assert space.describe(0) == "objects[0].size, share of its own, [-0.1, 0.1]"


def test_the_sun_is_the_scenes_and_ends_at_its_codes(street):
    scene = street().with_environment(light=torch.tensor([0.5, 0.0, -1.0]))
    space = ParameterSpace(scene, ("sun",), WIDE)
    assert [space.name(i) for i in range(3)] == ["sun.azimuth", "sun.elevation", "sun.strength"]
    assert space.upper.tolist() == [0.5, 1.0, 2.0]
    assert space.lower.tolist() == [-1.5, -1.0, 0.0]
    assert space.apply(scene, space.upper).environment.light.tolist() == [1.0, 1.0, 1.0]
    assert space.apply(scene, 3 * space.lower).environment.light.tolist() == [-1.0, -1.0, -1.0]


def test_what_a_budget_holds_is_refused(street):
    with pytest.raises(FormatError, match="params: size: expected a budget in which size may change"):
        ParameterSpace(street(), ("rotate", "size"))
    with pytest.raises(FormatError, match="params: sun: expected a budget in which sun may change"):
        ParameterSpace(street(), ("sun",))
    assert Parameter.SIZE not in PAPER_PARAMETERS
    assert Parameter.SUN not in PAPER_PARAMETERS
    assert len(PAPER_PARAMETERS) == 6


def test_gradient_passes_at_a_bound(street):
    scene = street()
    space = ParameterSpace(scene, ("weather",))
    theta = space.theta0.clone().requires_grad_(True)
    space.apply(scene, theta).environment.weather.sum().backward()
    assert theta.grad.tolist() == [1.0] * 4


def test_a_coordinate_that_is_not_finite_is_named(street):
    scene = street()
    space = ParameterSpace(scene, ("translate", "rotate"))
    theta = space.theta0.clone()
    theta[9] = math.nan
    with pytest.raises(RangeError, match=r"objects\[1\]\.yaw: expected a finite value, found nan"):
        space.apply(scene, theta)


def test_a_scene_without_cars_has_an_empty_theta(street):
    scene = street(positions_xz=())
    space = ParameterSpace(scene, COMBOS[2])
    assert space.dim == 0
    assert len(space.apply(scene, space.theta0).objects) == 0


def test_scenes_are_left_as_they_were(street):
    scene = street()
    before = replace(scene.objects)
    space = ParameterSpace(scene, ALL, WIDE)
    space.apply(scene, 0.5 * space.upper)
    assert torch.equal(scene.objects.translation, before.translation)
    assert not torch.equal(space.apply(scene, 0.5 * space.upper).objects.translation, before.translation)
