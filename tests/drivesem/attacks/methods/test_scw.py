"""sCW on losses with a known smallest change that fails."""

from __future__ import annotations

import math

import pytest
import torch

from drivesem.attacks.methods.gradient_ascent import SiFGSM
from drivesem.attacks.methods.scw import SCW
from tests.drivesem.attacks.methods.problems import START, Slope, make_problem, propose


@pytest.mark.parametrize(
    ("norm", "best", "slack"),
    [
        # min size2 with SLOPE . steps = need: need / sqrt(sum of n * slope^2 over coordinates of groups of n)
        (2, 6 / math.sqrt(2 * 1.04 + 3 * 0.19 + 4), 1.08),
        # min size1: all of it where n * slope is largest, which is 2
        (1, 3.0, 1.15),
    ],
)
def test_the_smallest_change_is_found(norm, best, slack):
    world = Slope(need=6.0)
    result = SCW(queries=64, norm=norm)(world.problem, START)
    assert result.success_moved
    assert result.queries == 64
    assert best < float(world.problem.size(result.theta, norm)) < slack * best
    sign = SiFGSM(steps=10, early_stop=True)(world.problem, START)
    assert float(world.problem.size(sign.theta, norm)) > 1.15 * slack * best


def test_norm_1_is_sparse():
    plain, sparse = (SCW(queries=64, norm=norm)(Slope(need=6.0).problem, START) for norm in (2, 1))
    share = [float(r.theta[2:5].abs().sum() / 0.02 / Slope().problem.size(r.theta, 1)) for r in (plain, sparse)]
    assert share[1] < 0.3 * share[0]


def test_the_smallest_failing_change_wins_over_more_failures():
    result = SCW(queries=40)(Slope(need=2.0).problem, START)
    problem = Slope(need=2.0).problem
    every = propose(SCW(queries=40), problem)
    failing = [theta for theta in every.thetas if problem.score(theta).success]
    assert len(failing) > 1
    assert float(problem.size(result.theta)) == min(float(problem.size(theta)) for theta in failing)
    assert result.score.loss < max(problem.score(theta).loss for theta in failing)


def test_without_a_failure_the_highest_loss_wins():
    world = Slope(need=math.inf)
    result = SCW(queries=30)(world.problem, START)
    assert not result.success_moved
    assert result.queries == len(world.gradients) == 30
    assert result.score.loss == max(float(world.loss(theta)) for theta in world.scored)


def test_the_search_ends_where_nothing_fails_at_any_c():
    world = Slope(need=math.inf)
    proposals = propose(SCW(queries=400, steps=2), world.problem)
    assert all(bool(theta.isfinite().all()) for theta in proposals.thetas)
    assert proposals.queries < 40


def test_gradients_are_taken_only_before_a_failure():
    world = Slope(need=4.0)
    result = SCW(queries=30)(world.problem, START)
    assert all(not world.score(theta).success for theta in world.gradients)
    assert 0 < len(world.gradients) < result.queries == 30


def test_early_stop_ends_at_the_first_failure():
    world = Slope(need=6.0)
    proposals = propose(SCW(early_stop=True), world.problem)
    failed = [world.score(theta).success for theta in proposals.thetas]
    assert failed.index(True) == len(failed) - 1 < 20


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_detectors_scale_does_not_matter(scale):
    plain, scaled = Slope(need=6.0), Slope(need=6.0)
    base = scaled.loss_and_grad
    scaled.loss_and_grad = lambda theta: tuple(scale * part for part in base(theta))
    one, two = (SCW(queries=30)(world.problem, START) for world in (plain, scaled))
    assert two.theta.tolist() == pytest.approx(one.theta.tolist(), abs=1e-4)


def test_fixed_coordinates_stay_and_a_flat_loss_is_valid():
    step, upper = torch.tensor([0.1, 0.0, 0.1]), torch.tensor([0.5, 0.5, 0.0])
    problem = make_problem(torch.sum, step, upper, loss_and_grad=lambda theta: (0.0, torch.zeros(3)))
    proposals = propose(SCW(queries=12, steps=6), problem, torch.tensor([0.2, 0.3, 0.0]))
    thetas = torch.stack(proposals.thetas)
    assert bool(torch.isfinite(thetas).all())
    assert thetas[:, 1:].tolist() == [[pytest.approx(0.3), 0.0]] * 12
    # Only the norm pulls, towards the photograph, by about a step each time.
    assert thetas[:3, 0].tolist() == [pytest.approx(x, abs=0.05) for x in (0.2, 0.1, 0.0)]
