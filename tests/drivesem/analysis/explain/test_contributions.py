"""A hand-made problem: shares of parameters and cars, what each does alone, and how large a change is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from drivesem.analysis.explain.attribution import ThetaPart
from drivesem.analysis.explain.run import PartialChangeEvaluator, compute_contributions
from drivesem.attacks.methods.base import ParameterGroup, Problem, Score
from drivesem.attacks.theta import ProjectedTheta

THETA = torch.tensor([0.2, 0.4, 0.1, 0.3])


class Counter:
    """Loss 1 + t0 + 10 t1 t2, failing from 1.5 on; t3 is held to 0.1 unless t0 moves too."""

    def __init__(self):
        self.evaluations = 0

    def problem(self):
        return Problem(
            loss_and_grad=lambda _: pytest.fail("no gradient is asked for"),
            project=self.project,
            score=self.score,
            step=torch.full((4,), 0.1),
            lower=-torch.ones(4),
            upper=torch.ones(4),
            groups=(ParameterGroup("a", slice(0, 2)), ParameterGroup("b", slice(2, 4))),
        )

    def project(self, theta):
        held = theta.clone()
        if not bool(theta[0]):
            held[3] = held[3].clamp(max=0.1)
        return ProjectedTheta(held, ())

    def score(self, theta):
        self.evaluations += 1
        loss = 1 + float(theta[0] + 10 * theta[1] * theta[2])
        fails = loss > 1.5
        return Score(loss, int(fails), 0, fails, fails)


class Failing:
    """A failure that occurs from a loss of 1.5 on."""

    def occurs(self, theta):
        return 1 + float(theta[0] + 10 * theta[1] * theta[2]) > 1.5


def evaluator(counter):
    found = PartialChangeEvaluator(counter.problem(), lambda theta: theta, None)
    found.tracked = [Failing()]
    return found


def player(name, *indices):
    mask = torch.zeros(4, dtype=torch.bool)
    mask[list(indices)] = True
    return ThetaPart("parameter", name, mask)


TEAM = [player("a", 0, 1), player("b", 2, 3)]


def test_what_each_adds():
    counter = Counter()
    judge = evaluator(counter)
    slope = torch.tensor([0.2, -0.1, 0.0, 0.1])
    a, b = compute_contributions(TEAM, THETA, judge, slope, 2, np.random.default_rng(0))
    # by hand: nothing 1.0, a alone 1.2, b alone 1.0, both 1.6
    assert (a.loss, b.loss) == (pytest.approx(0.4), pytest.approx(0.2))
    assert a.loss + b.loss == pytest.approx(0.6)
    assert (a.fails, b.fails) == ((0.5,), (0.5,))
    assert (a.loss_error, a.fails_error) == (None, None)
    assert (a.alone.loss, a.without.loss) == (pytest.approx(1.2), pytest.approx(1.0))
    assert not a.alone.success
    assert (a.alone.occurs, b.without.occurs) == ((False,), (False,))
    assert (a.gradient, b.gradient) == (pytest.approx(0.1), pytest.approx(0.1))
    assert (a.gradient_share, b.gradient_share) == (pytest.approx(0.75), pytest.approx(0.25))
    assert (a.alone.held_back, b.alone.held_back) == (False, True)
    assert counter.evaluations == judge.renders == 4


def test_drawn_orders_carry_errors_and_no_gradient_is_no_share():
    team = [player(str(i), i % 4) for i in range(7)]  # some stand for the same coordinate
    found = compute_contributions(team, THETA, evaluator(Counter()), None, 8, np.random.default_rng(0))
    assert sum(c.loss for c in found) == pytest.approx(0.6, abs=1e-6)
    assert all(c.loss_error is not None and c.gradient is None and c.gradient_share is None for c in found)


def test_sizes_are_in_steps_of_each_group():
    judge = evaluator(Counter())
    assert judge.size(torch.tensor([0.3, 0.3, 0.0, 0.0])) == pytest.approx(3)
    assert judge.size(torch.tensor([0.3, 0.3, 0.4, -0.4])) == pytest.approx(5)
