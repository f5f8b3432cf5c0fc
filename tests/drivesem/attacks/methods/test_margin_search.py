"""Searches on margins, on cars with known margins: pass budgets, corners, differences, noise, modes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from drivesem.attacks.methods.base import ParameterGroup
from drivesem.attacks.methods.gradient_free import Sampling
from drivesem.attacks.methods.margin_search import MIN_PASSES, Climb, Corners, MarginSearch, balanced_corners
from drivesem.attacks.theta import ProjectedTheta
from scene_ir.errors import RangeError
from tests.drivesem.attacks.methods.problems import CARS, DIM, LOST_AT, PAINT, POSITION, WEATHER, Street

OWNER = torch.tensor([0, 0, 0, -1, -1, -1, -1, 1, 1, 1])
START = torch.zeros(DIM)


def corners(count: int, seed: int = 0) -> Tensor:
    return balanced_corners(OWNER, count, torch.Generator().manual_seed(seed))


def climbed_margins(street: Street, seed: int = 0) -> Tensor:
    """Margins (CARS,) at the result of a climb, without ripples."""
    return replace(street, ripple=0.0).known_margins(Climb()(street.problem(), START, seed).theta, 0)


def test_pairs_of_coordinates_of_one_owner_take_all_combinations() -> None:
    ends = corners(16).double()
    assert set(ends.unique().tolist()) == {0.0, 1.0}
    for i in range(len(OWNER)):
        assert ends[:, i].mean() == 0.5
        for j in range(i):
            if OWNER[i] == OWNER[j]:
                assert (ends[:, i] * ends[:, j]).mean() == 0.25


def test_the_first_corner_has_the_scene_at_its_upper_end_and_random_objects() -> None:
    firsts = [corners(8, seed)[0] for seed in range(8)]
    assert all(bool(first[OWNER < 0].all()) for first in firsts)
    assert len({tuple(first[OWNER >= 0].tolist()) for first in firsts}) > 1


def test_corners_are_distinct_and_follow_the_seed() -> None:
    assert torch.equal(corners(24, 3), corners(24, 3))
    assert not torch.equal(corners(24, 3), corners(24, 4))
    assert len(corners(24).unique(dim=0)) == 24


@pytest.mark.parametrize("passes", [MIN_PASSES, 41, 90, 200])
@pytest.mark.parametrize("make", [Corners, Climb, lambda passes: Climb(passes, False)])
def test_passes_are_used_up_and_not_exceeded(passes: int, make: type[MarginSearch]) -> None:
    street, method = Street(), make(passes)
    spent = method(street.problem(), START).queries
    assert spent == street.passes
    least = passes - 4 if isinstance(method, Corners) else 0.8 * passes - 4
    assert least <= spent <= passes - 4


@pytest.mark.parametrize("method", [Corners(), Climb()])
def test_without_counted_objects_nothing_is_searched(method: MarginSearch) -> None:
    street = Street(counted_objects=torch.zeros(CARS, dtype=torch.bool))
    assert not bool(method(street.problem(), START).theta.any())
    assert street.passes == 0
    with pytest.raises(RangeError, match="margins"):
        method(replace(street.problem(), margin_oracle=None), START)


@pytest.mark.parametrize("seed", range(5))
def test_each_car_gets_its_own_worst_corner(seed: int) -> None:
    """The corner nearest to where it is lost, dark, in fog: a joint corner that was never evaluated as a whole."""
    theta = Corners()(Street().problem(), START, seed).theta
    assert theta[WEATHER][0] == 1
    assert torch.equal(theta[POSITION].reshape(CARS, 2), LOST_AT.sign())
    assert bool((theta[PAINT] == -1).all())


def test_corners_beat_samples_where_failures_are_at_corners() -> None:
    street = Street()
    lowest = [
        sum(float(street.known_margins(attack(street.problem(), START, s).theta, 0).mean()) for s in range(5))
        for attack in (Corners(), Sampling(86, kind="halton"))
    ]
    assert lowest[0] < lowest[1]


def test_corners_are_projected() -> None:
    """Two codes that are bounded together, like fog and rain: no sample is of an infeasible scene."""
    street = Street()
    base = street.problem()

    def project(theta: Tensor) -> ProjectedTheta:
        inside = base.project(theta).theta
        excess = float(inside[WEATHER].sum()) - 1.0
        if excess > 1e-6:
            inside[WEATHER] -= excess / 2
        return ProjectedTheta(inside, ("weather",) if excess > 1e-6 else ())

    result = Corners()(replace(base, project=project), START)
    assert len(street.thetas) == street.passes
    assert max(float(theta[WEATHER].sum()) for theta in street.thetas) <= 1 + 1e-6
    assert "weather" in result.active_constraints


@pytest.mark.parametrize(
    ("ripple", "limit", "least"),
    [
        (0.0, 0.0, CARS),
        (0.3, 0.3, CARS - 1),  # a gradient at a point is 40 times the slope here, of either sign
    ],
)
@pytest.mark.parametrize("seed", range(5))
def test_climb_brings_each_car_to_its_own_position(ripple: float, limit: float, least: int, seed: int) -> None:
    margins = climbed_margins(Street(ripple=ripple), seed)
    assert (margins < limit).sum() >= least, margins


def test_climb_uses_differences_where_gradients_are_noise() -> None:
    """Compared with the same search that trusts the gradient of positions, on the same street."""
    street, gradients = Street(ripple=0.5), []
    for seed in range(8):
        result = Climb()(street.problem(smooth_position=True), START, seed)
        gradients.append(replace(street, ripple=0.0).known_margins(result.theta, 0))
    differences = [climbed_margins(street, seed) for seed in range(8)]
    assert torch.cat(differences).mean() < torch.cat(gradients).mean()


@pytest.mark.parametrize("gradient", [True, False])
def test_climb_ends_lower_than_its_first_samples(gradient: bool) -> None:
    """By a good part of a logit a car, mean over 5 seeds."""
    gains = []
    for seed in range(5):
        street = Street()
        result = Climb(gradient=gradient)(street.problem(), START, seed)
        first = min(float(street.known_margins(theta, 0).mean()) for theta in street.thetas[:30])
        gains.append(first - float(street.known_margins(result.theta, 0).mean()))
    assert sum(gains) / len(gains) > 0.3, gains


def test_random_points_of_a_start_are_uniform_and_do_not_depend_on_margins() -> None:
    streets = [Street(), Street(ripple=5.0)]
    for street in streets:
        Climb(passes=200)(street.problem(), START, 3)
    assert len(streets[0].random) == 40
    assert all(torch.equal(*pair) for pair in zip(streets[0].random, streets[1].random, strict=True))
    free = torch.stack(streets[0].random)[:, : POSITION.stop]
    assert float(free.mean(0).abs().max()) < 0.1
    assert float(free.std(0).min()) > 0.5


def test_climb_without_a_gradient() -> None:
    street = Street(differentiable=False)
    street.margins_and_grad = None  # pyright: ignore[reportAttributeAccessIssue]
    margins = street.known_margins(Climb()(street.problem(), START).theta, 0)
    assert (margins < 0).sum() >= CARS - 1, margins


def test_climb_ignores_objects_that_do_not_count() -> None:
    """Infinite margins, as of objects that become hidden, change nothing for others."""

    class Hidden(Street):
        def known_margins(self, theta: Tensor, number: int) -> Tensor:
            margins = super().known_margins(theta, number)
            return torch.where(torch.arange(CARS) == 1, torch.inf, margins)

    street = Hidden(counted_objects=torch.tensor([True, False, True, True]))
    result = Climb()(street.problem(), START)
    assert bool(torch.isfinite(result.theta).all())
    assert (street.known_margins(result.theta, 0)[[0, 2, 3]] < 0).all()


def test_climb_moves_a_group_along_its_modes_only() -> None:
    modes = torch.tensor([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    groups = (ParameterGroup("bent", slice(0, 8), 2, modes), ParameterGroup("rest", slice(8, DIM)))
    bent = Climb()(replace(Street().problem(), groups=groups), START).theta[:8].reshape(2, 4)
    assert bool(bent.any())
    torch.testing.assert_close(bent[:, 0], bent[:, 1])
    torch.testing.assert_close(bent[:, 2], -bent[:, 3])
