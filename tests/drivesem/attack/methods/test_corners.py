"""Corners of the bounds: their order, passes, what the worst corner of each car makes together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from drivesem.attack.methods.gradient_free import Sampling
from drivesem.attack.methods.margin_search import LEAST_PASSES, Corners, balanced_corners
from drivesem.attack.theta import ProjectedTheta
from scene_ir.errors import RangeError
from tests.drivesem.attack.methods.street import BLIND_AT, CARS, DIM, PAINT, PLACE, WEATHER, Street

OWNER = torch.tensor([0, 0, 0, -1, -1, -1, -1, 1, 1, 1])


def drawn(count: int, seed: int = 0) -> Tensor:
    return balanced_corners(OWNER, count, torch.Generator().manual_seed(seed))


def test_any_two_coordinates_of_one_owner_meet_at_all_of_their_ends() -> None:
    ends = drawn(16).double()
    assert set(ends.unique().tolist()) == {0.0, 1.0}
    for i in range(len(OWNER)):
        assert ends[:, i].mean() == 0.5
        for j in range(i):
            if OWNER[i] == OWNER[j]:
                assert (ends[:, i] * ends[:, j]).mean() == 0.25


@pytest.mark.parametrize("seed", range(4))
def test_the_first_corner_has_the_scene_at_its_upper_end_and_cars_anywhere(seed: int) -> None:
    first = drawn(8, seed)[0]
    assert bool(first[OWNER < 0].all())
    assert len({tuple(drawn(8, other)[0][OWNER >= 0].tolist()) for other in range(8)}) > 1


def test_the_seed_decides_and_no_corner_comes_twice() -> None:
    assert torch.equal(drawn(24, 3), drawn(24, 3))
    assert not torch.equal(drawn(24, 3), drawn(24, 4))
    assert len(drawn(24).unique(dim=0)) == 24


@pytest.mark.parametrize("passes", [LEAST_PASSES, 41, 90, 200])
def test_passes_are_kept_to_and_used(passes: int) -> None:
    street = Street()
    result = Corners(passes)(street.problem(), torch.zeros(DIM), 0)
    assert result.queries == street.passes == passes - 4


@pytest.mark.parametrize("seed", range(5))
def test_each_car_gets_the_corner_it_does_worst_at(seed: int) -> None:
    """The corner nearest to where it is blind, dark, in fog: a joint corner that was never seen as a whole."""
    theta = Corners()(Street().problem(), torch.zeros(DIM), seed).theta
    assert theta[WEATHER][0] == 1
    assert torch.equal(theta[PLACE].reshape(CARS, 2), BLIND_AT.sign())
    assert bool((theta[PAINT] == -1).all())


def test_it_beats_as_many_samples_where_failures_stand_at_corners() -> None:
    street = Street()
    lowest = {
        name: sum(
            float(street.known_margins(attack(street.problem(), torch.zeros(DIM), s).theta, 0).mean())
            for s in range(5)
        )
        for name, attack in (("corners", Corners()), ("samples", Sampling(86, kind="halton")))
    }
    assert lowest["corners"] < lowest["samples"]


def test_corners_are_projected_like_all_that_is_proposed() -> None:
    """Two codes that are bounded together, as fog and rain are: no view is of a scene that may not be."""
    street = Street()
    base = street.problem()

    def project(theta: Tensor) -> ProjectedTheta:
        inside = base.project(theta).theta
        over = float(inside[WEATHER].sum()) - 1.0
        if over > 1e-6:
            inside[WEATHER] -= over / 2
        return ProjectedTheta(inside, ("weather",) if over > 1e-6 else ())

    seen: list[Tensor] = []
    known = street.margins
    street.margins = lambda theta, number: (seen.append(theta), known(theta, number))[1]  # pyright: ignore
    result = Corners()(replace(base, project=project), torch.zeros(DIM), 0)
    assert len(seen) == street.passes
    assert max(float(theta[WEATHER].sum()) for theta in seen) <= 1 + 1e-6
    assert "weather" in result.active_constraints


def test_nothing_to_lose() -> None:
    street = Street(counted_objects=torch.zeros(CARS, dtype=torch.bool))
    result = Corners()(street.problem(), torch.zeros(DIM), 0)
    assert street.passes == 0
    assert not bool(result.theta.any())


def test_what_cannot_be() -> None:
    with pytest.raises(RangeError, match="passes"):
        Corners(LEAST_PASSES - 1)
    with pytest.raises(RangeError, match="views"):
        Corners()(replace(Street().problem(), margin_oracle=None), torch.zeros(DIM), 0)
