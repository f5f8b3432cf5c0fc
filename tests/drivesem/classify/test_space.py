"""theta of an object: blocks, names, bounds, and its effect."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.classify.space import (
    WIDEST_BOUNDS,
    ClassifyParameter,
    ObjectSpace,
    ParameterAmounts,
    parse_parameters,
)
from scene_ir.errors import FormatError, RangeError, ShapeError

TRIANGLE = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0]])
STEPS = ParameterAmounts(0.002, 0.15, 0.2)


def test_blocks_names_bounds_and_steps():
    space = ObjectSpace(
        TRIANGLE, parse_parameters("lighting,pose,vertex"), STEPS, ParameterAmounts(0.05, 1.0, math.inf)
    )
    assert list(space.blocks) == [ClassifyParameter.VERTEX, ClassifyParameter.POSE, ClassifyParameter.LIGHTING]
    assert space.dim == 9 + 3 + 5
    assert space.describe(4) == "vertices[1].y, object sizes, [-0.05, 0.05]"
    assert space.describe(10) == "pose.yaw, rad, [-1, 1]"
    assert space.describe(12) == "light.strength, share, [-0.9, 0.9]"
    assert space.step[:9].unique().tolist() == pytest.approx([0.002])
    assert space.step[9:12].unique().tolist() == pytest.approx([0.15])
    assert space.step[12:].unique().tolist() == pytest.approx([0.2])
    assert (space.display(10, math.pi / 2), space.display(13, 0.5), space.display(14, 0.5)) == (
        "90 deg",
        "50 %",
        "0.5",
    )


def test_the_change_of_theta():
    space = ObjectSpace(TRIANGLE, parse_parameters("vertex,pose"), STEPS)
    theta = torch.arange(12.0)
    change = space.change(theta)
    assert change.light is None
    assert torch.equal(change.angles, theta[9:])
    # places are counted in the order of their coordinates
    assert torch.equal(change.offsets, theta[:9].reshape(3, 3)[[0, 2, 1]])
    assert space.max_changes(theta) == pytest.approx({"vertex": math.hypot(6, 7, 8), "pose": 11.0}, abs=1e-5)
    assert list(space.format_scalars(theta)) == ["pose.pitch", "pose.yaw", "pose.roll"]
    with pytest.raises(ShapeError, match="theta"):
        space.change(theta[1:])
    theta[10] = math.nan
    with pytest.raises(RangeError, match=r"pose\.yaw"):
        space.change(theta)


def test_vertices_at_one_place_move_as_one():
    doubled = torch.cat([TRIANGLE, TRIANGLE[:1] + 1e-9])
    space = ObjectSpace(doubled, parse_parameters("vertex"), STEPS)
    assert space.dim == 9
    offsets = space.change(torch.randn(9)).offsets
    assert torch.equal(offsets[0], offsets[3])
    assert len(offsets.unique(dim=0)) == 3


def test_smooth_changes_move_neighbours_alike():
    line = torch.stack([torch.linspace(-0.5, 0.5, 50)] * 3, dim=1)
    space = ObjectSpace(line, parse_parameters("vertex"), STEPS, motion="smooth")
    assert space.dim == 192
    assert space.name(0) == "lattice[0,0,0].x"
    offsets = space.change(torch.ones(192)).offsets
    torch.testing.assert_close(offsets, torch.ones(50, 3))
    assert space.max_changes(torch.ones(192))["vertex"] == pytest.approx(math.sqrt(3), abs=1e-5)
    rough = space.change(torch.randn(192, generator=torch.Generator().manual_seed(0))).offsets
    assert float(rough.diff(dim=0).abs().max()) < 0.5


@given(st.lists(st.floats(-9, 9), min_size=12, max_size=12))
def test_projection_keeps_to_the_bounds_and_is_idempotent(values):
    space = ObjectSpace(TRIANGLE, parse_parameters("vertex,pose"), STEPS, ParameterAmounts(0.05, 1.0, 1.0))
    theta = torch.tensor(values, dtype=torch.float32)
    once = space.project(theta)
    assert bool((once.theta >= space.lower).all() and (once.theta <= space.upper).all())
    assert torch.equal(space.project(once.theta).theta, once.theta)
    assert space.project(once.theta).active == ()
    beyond = {"vertex": bool((theta[:9].abs() > space.upper[0]).any()), "pose": bool((theta[9:].abs() > 1).any())}
    assert once.active == tuple(f"{name}: bounds" for name, is_so in beyond.items() if is_so)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at least one of vertex, pose, lighting, found none"),
        ("pose,pose", "each parameter once, found pose,pose"),
        ("pose,colour", "names among vertex, pose, lighting, found 'colour'"),
        ("yaw", "names among vertex, pose, lighting, found 'yaw'"),
    ],
)
def test_invalid_parameters(text, message):
    with pytest.raises(FormatError, match=message):
        parse_parameters(text)


def test_amounts_are_positive():
    with pytest.raises(RangeError, match="pose"):
        ParameterAmounts(0.1, 0.0, 0.1)
    assert WIDEST_BOUNDS.pose == pytest.approx(math.pi)
