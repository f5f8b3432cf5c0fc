"""What holds of every method that can be typed, on a loss known in full."""

from __future__ import annotations

from typing import get_args, get_type_hints

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attack.methods.base import Attack
from drivesem.attack.methods.placebo import Placebo
from drivesem.config.commands import QUERY_METHODS
from drivesem.config.commands import AttackConfig as Config
from drivesem.run.attack import build_attack

START = torch.zeros(6)
LIKE = (0.1, -0.3, 0.02, 0.0, 0.5, 0.25)
"""What a placebo is as large as."""


def method_of(name: str) -> Attack:
    queries = 12 if name in QUERY_METHODS else None
    if name == "placebo":
        return Placebo(LIKE)
    return build_attack(Config(method=name, steps=4, queries=queries))  # pyright: ignore


NAMES = get_args(get_type_hints(Config)["method"])
METHODS = {name: method_of(name) for name in NAMES}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(need=st.floats(0.5, 20), fence=st.floats(0.05, 1), sight=st.floats(0.5, 40), seed=st.integers(0, 1000))
def test_no_worse_point_than_is_reported(
    slope, method: Attack, need: float, fence: float, sight: float, seed: int
) -> None:
    world = slope(need=need, fence=fence, sight=sight)
    result = method(world.problem, START, seed=seed)
    # Feasible, and what a new look at theta shows is what is said of it.
    assert torch.equal(world.project(result.theta).theta, result.theta)
    fresh = slope(need=need, fence=fence, sight=sight).score(result.theta)
    assert fresh == result.score
    assert fresh.violations == ()
    assert (fresh.success, fresh.success_paper) == (result.success_moved, result.success_paper)
    assert result.loss_trace[-1] == fresh.loss
    # Neither the photograph nor anything that was proposed, and may be, ranks above it.
    proposed = method._propose(world.problem, START, torch.Generator().manual_seed(seed)).thetas
    assert proposed
    best = method._rank(world.problem, result.theta, result.score)
    for theta in (START, *proposed):
        feasible = world.project(theta).theta
        score = world.score(feasible)
        if score.violations:
            assert set(score.violations) <= set(result.active_constraints)
        else:
            assert best >= method._rank(world.problem, feasible, score)
