"""sCW where the smallest change that fails is known."""

from __future__ import annotations

import math

import pytest
import torch

from drivesem.attack.methods.base import Problem, Score
from drivesem.attack.methods.gradient_ascent import SiFGSM
from drivesem.attack.methods.scw import SCW
from drivesem.attack.theta import ProjectedTheta

START = torch.zeros(6)


@pytest.mark.parametrize(
    ("norm", "best", "slack"),
    [
        # min size2 with SLOPE . steps = need: need / sqrt(sum of n * slope^2 over coordinates of groups of n)
        (2, 6 / math.sqrt(2 * 1.04 + 3 * 0.19 + 4), 1.08),
        # min size1: all of it where n * slope is largest, which is 2
        (1, 3.0, 1.15),
    ],
)
def test_the_smallest_change_is_found(slope, norm, best, slack):
    world = slope(need=6.0)
    result = SCW(queries=64, norm=norm)(world.problem, START)
    assert result.success_moved
    assert result.queries == 64
    assert best < float(world.problem.size(result.theta, norm)) < slack * best
    sign = SiFGSM(steps=10, early_stop=True)(world.problem, START)
    assert float(world.problem.size(sign.theta, norm)) > 1.15 * slack * best


def test_norm_1_leaves_out_what_norm_2_uses(slope):
    plain, sparse = (SCW(queries=64, norm=norm)(slope(need=6.0).problem, START) for norm in (2, 1))
    share = [float(r.theta[2:5].abs().sum() / 0.02 / slope().problem.size(r.theta, 1)) for r in (plain, sparse)]
    assert share[1] < 0.3 * share[0]


def test_it_prefers_the_smaller_of_two_that_fail_to_the_one_that_fails_more(slope):
    result = SCW(queries=40)(slope(need=2.0).problem, START)
    every = SCW(queries=40)._propose(slope(need=2.0).problem, START, torch.Generator())
    problem = slope(need=2.0).problem
    failing = [theta for theta in every.thetas if problem.score(theta).success]
    assert len(failing) > 1
    assert float(problem.size(result.theta)) == min(float(problem.size(theta)) for theta in failing)
    assert result.score.loss < max(problem.score(theta).loss for theta in failing)


def test_without_a_failure_the_highest_loss_is_kept(slope):
    world = slope(need=math.inf)
    result = SCW(queries=30)(world.problem, START)
    assert not result.success_moved
    assert result.queries == len(world.gradients) == 30
    assert result.score.loss == max(float(world.loss(theta)) for theta in world.scored)


def test_the_search_ends_where_nothing_fails_at_any_price(slope):
    world = slope(need=math.inf)
    proposals = SCW(queries=400, steps=2)._propose(world.problem, START, torch.Generator())
    assert all(bool(theta.isfinite().all()) for theta in proposals.thetas)
    assert proposals.queries < 40


def test_a_gradient_is_taken_only_where_nothing_fails_yet(slope):
    world = slope(need=4.0)
    result = SCW(queries=30)(world.problem, START)
    assert all(not world.score(theta).success for theta in world.gradients)
    assert 0 < len(world.gradients) < result.queries == 30


def test_early_stop_ends_at_the_first_failure(slope):
    world = slope(need=6.0)
    proposals = SCW(early_stop=True)._propose(world.problem, START, torch.Generator())
    failed = [world.score(theta).success for theta in proposals.thetas]
    assert failed.index(True) == len(failed) - 1 < 20


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_detectors_scale_does_not_matter(slope, scale):
    plain, scaled = slope(need=6.0), slope(need=6.0)
    base = scaled.loss_and_grad
    scaled.loss_and_grad = lambda theta: tuple(scale * part for part in base(theta))
    one, two = (SCW(queries=30)(world.problem, START) for world in (plain, scaled))
    assert two.theta.tolist() == pytest.approx(one.theta.tolist(), abs=1e-4)


def test_what_cannot_move_stays_and_a_flat_loss_is_no_error():
    step, upper = torch.tensor([0.1, 0.0, 0.1]), torch.tensor([0.5, 0.5, 0.0])
    problem = Problem(
        lambda theta: (0.0, torch.zeros(3)),
        lambda theta: ProjectedTheta(theta, ()),
        lambda theta: Score(0.0, 0, 0, False, False),
        step,
        -upper,
        upper,
    )
    proposals = SCW(queries=12, steps=6)._propose(problem, torch.tensor([0.2, 0.3, 0.0]), torch.Generator())
    found = torch.stack(proposals.thetas)
    assert bool(torch.isfinite(found).all())
    assert found[:, 1:].tolist() == [[pytest.approx(0.3), 0.0]] * 12
    # Only the norm pulls, towards the photograph, by about a step each time.
    assert found[:3, 0].tolist() == [pytest.approx(x, abs=0.05) for x in (0.2, 0.1, 0.0)]
