"""The search for the fewest parameters that are enough, beside looking at all subsets."""

from __future__ import annotations

import math
from itertools import combinations

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attack.methods.si_fgsm import SiFGSM
from drivesem.attack.methods.subsets import Subsets, raised

START = torch.zeros(6)


def names(world, theta):
    return [group.name for group in world.problem.moved(theta)]


@pytest.mark.parametrize(
    ("need", "together", "found"),
    [
        (2.0, (), ["code"]),  # 0.25 of it is enough, where near takes a third and wide more
        (2.0, ("near",), ["near"]),
        (6.0, ("near", "code"), ["near", "code"]),
        (6.0, ("near", "wide", "code"), ["near", "wide", "code"]),
        (12.0, (), ["near", "code"]),  # no single group raises the loss so far
    ],
)
def test_the_fewest_groups(slope, need, together, found):
    world = slope(need=need, together=together)
    result = Subsets()(world.problem, START)
    assert result.success_moved
    assert names(world, result.theta) == found


def test_the_smallest_of_equally_few_groups(slope):
    world = slope(need=2.0)
    result = Subsets()(world.problem, START)
    # The sixteenths of what si-FGSM did with the code, 4 steps: 1 step is not more than enough, 1.25 are.
    assert result.theta.tolist() == pytest.approx([0, 0, 0, 0, 0, 1.25 * 0.25])
    assert float(world.problem.size(result.theta)) == pytest.approx(1.25)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    need=st.floats(0.5, 20),
    fence=st.floats(0.05, 1),
    together=st.sets(st.sampled_from(["near", "wide", "code"])),
)
def test_no_smaller_subset_of_what_was_found_is_enough(slope, need, fence, together):
    world = slope(need=need, fence=fence, together=tuple(together))
    problem = world.problem
    result = Subsets()(problem, START)
    run = SiFGSM(10)(problem, START)
    assert result.success_moved == run.success_moved
    if not run.success_moved:
        return
    enough = []
    for count in (1, 2, 3):
        for subset in combinations(problem.groups, count):
            theta = torch.zeros(6)
            for group in subset:
                theta[group.where] = run.theta[group.where]
            if world.score(world.project(theta).theta).success:
                enough.append(count)
    assert len(names(world, result.theta)) == min(enough)


@pytest.mark.parametrize("queries", [2, 8, 12, 15, 64])
def test_queries_are_counted_and_kept_to(slope, queries):
    world = slope(need=6.0, together=("near", "code"))
    result = Subsets(queries=queries)(world.problem, START)
    assert result.queries <= queries
    assert len(world.gradients) == min(10, queries // 2)
    # Few queries find less, never something that is not enough.
    assert result.success_moved == (queries > 2)
    assert (names(world, result.theta) == ["near", "code"]) == (queries > 4)


def test_without_a_failure_it_is_si_fgsm(slope):
    world = slope(need=math.inf)
    result = Subsets()(world.problem, START)
    plain = SiFGSM(10)(world.problem, START)
    assert torch.equal(result.theta, plain.theta)
    assert result.queries == 10


def test_what_each_group_raised_adds_up_to_the_rise(slope):
    world = slope()
    thetas = (
        START,
        torch.tensor([0.1, 0.0, 0.02, -0.02, 0.0, 0.25]),
        torch.tensor([0.1, 0.2, 0.0, 0.0, 0.0, 0.5]),
    )
    gains = raised(world.problem.groups, thetas, [world.loss_and_grad(theta)[1] for theta in thetas[:-1]])
    assert gains == {"near": pytest.approx(1.4), "wide": pytest.approx(0.0, abs=1e-6), "code": pytest.approx(4.0)}
    assert sum(gains.values()) == pytest.approx(float(world.loss(thetas[-1])))
