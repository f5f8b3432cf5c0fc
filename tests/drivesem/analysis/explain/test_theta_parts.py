"""Theta in parts: which coordinates a parameter and a car have, and how far they go in metres and degrees."""

from __future__ import annotations

import math

import pytest
import torch

from drivesem.analysis.explain.attribution import (
    list_object_parameters,
    measure_change,
    split_by_object,
    split_by_parameter,
)
from drivesem.attacks.space import Budget, ParameterSpace

TWO = ((-2.5, 9.0), (2.5, 12.0))


@pytest.fixture
def space(street):
    return ParameterSpace(street(positions_xz=TWO), ("color", "weather", "translate", "rotate", "mesh"))


def test_cells_cover_theta_once(space):
    covered = [i for cell in list_object_parameters(space) for i in range(cell.where.start, cell.where.stop)]
    assert covered == list(range(space.dim))
    names = [cell.name for cell in list_object_parameters(space)]
    assert names[:3] == ["objects[0].color", "objects[1].color", "weather"]
    for cell in list_object_parameters(space):
        first = space.name(cell.where.start)
        assert first.startswith("weather." if cell.object is None else f"objects[{cell.object}].")


def test_players_are_what_moves_and_cover_it_once(space):
    theta = torch.zeros(space.dim)
    assert split_by_parameter(space, theta) == split_by_object(space, theta) == []
    weather, rotate = space.blocks.get("weather"), space.blocks.get("rotate")
    theta[weather.start] = 0.5
    theta[rotate.start + 1] = 0.1
    assert [(p.kind, p.name) for p in split_by_parameter(space, theta)] == [
        ("parameter", "weather"),
        ("parameter", "rotate"),
    ]
    assert [(p.kind, p.name) for p in split_by_object(space, theta)] == [
        ("object", "objects[1]"),
        ("object", "surroundings"),
    ]
    for team in (split_by_parameter(space, theta), split_by_object(space, theta)):
        count = torch.stack([p.mask for p in team]).sum(dim=0)
        assert int(count.max()) == 1
        assert bool((count[theta != 0] == 1).all())
    assert space.name(int(split_by_object(space, theta)[0].mask.nonzero()[0])) == "objects[1].yaw"


def test_sizes_in_metres_and_degrees(space):
    theta = torch.zeros(space.dim)
    translate, rotate, mesh = (space.blocks.get(name) for name in ("translate", "rotate", "mesh"))
    theta[translate.start + 2 : translate.start + 4] = torch.tensor([0.03, 0.04])
    theta[rotate.start + 1] = -0.1
    # two lattice points of car 0: the second goes farther, across all three sides of its box
    theta[mesh.start : mesh.start + 3] = torch.tensor([0.01, 0.0, 0.0])
    theta[mesh.start + 6 : mesh.start + 9] = torch.tensor([0.1, 0.1, 0.1])
    theta[space.blocks.get("color").start + 1] = -0.2
    found = {(s.parameter, s.object): s for s in measure_change(space, theta)}
    assert set(found) == {("color", 0), ("translate", 1), ("rotate", 1), ("mesh", 0)}
    length, height, width = 4.2, 1.5, 1.75
    assert found["translate", 1].value == pytest.approx(0.05 * length)
    assert found["translate", 1].unit == "m"
    assert found["translate", 1].steps == pytest.approx(4)
    assert found["rotate", 1].value == pytest.approx(math.degrees(0.1))
    assert found["rotate", 1].unit == "deg"
    assert found["mesh", 0].value == pytest.approx(0.1 * math.hypot(length, height, width), rel=1e-5)
    assert found["mesh", 0].steps == pytest.approx(4)
    assert (found["color", 0].value, found["color", 0].unit) == (pytest.approx(0.2), "code")
    assert found["color", 0].owner == "objects[0]"


def test_sizes_of_cars_are_in_percent(street):
    space = ParameterSpace(street(), ("size",), Budget(size=0.1))
    (grown,) = measure_change(space, torch.tensor([0.0, -0.04, 0.0, 0.0]))
    assert (grown.parameter, grown.object, grown.unit) == ("size", 1, "%")
    assert (grown.value, grown.steps) == (pytest.approx(4), pytest.approx(4))
