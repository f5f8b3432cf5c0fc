"""Auto-PGD on known losses: when its steps are halved."""

from __future__ import annotations

import pytest
import torch

from drivesem.attacks.methods.base import Proposals
from drivesem.attacks.methods.gradient_ascent import APGD, SiFGSM
from tests.drivesem.attacks.methods.problems import START, Slope, make_problem, propose


def best_loss(proposals: Proposals) -> float:
    return max(loss for loss in proposals.losses if loss is not None)


def test_steps_are_halved_on_a_rough_loss() -> None:
    # A maximum within half a step: sign steps pass over it again and again.
    problem = make_problem(lambda theta: -(theta - 0.03).abs().sum(), (0.1, 0.1))
    adaptive, fixed = propose(APGD(steps=20), problem), propose(SiFGSM(steps=20), problem)
    assert adaptive.thetas[1].tolist() == pytest.approx([0.1, 0.1])
    assert adaptive.queries == 20
    assert best_loss(fixed) == pytest.approx(-0.06, abs=1e-6)
    assert best_loss(adaptive) > -0.03
    # In the end a step is at most an eighth of the first: halved at three of the checkpoints or more.
    assert float((adaptive.thetas[-1] - adaptive.thetas[-2]).abs().max()) <= 0.1 / 8 + 1e-6


def test_steps_stay_while_the_loss_rises() -> None:
    proposals = propose(APGD(steps=10, rate=0.5), make_problem(torch.sum, (0.1, 0.1)))
    assert proposals.thetas[1].tolist() == pytest.approx([0.05, 0.05])
    # With momentum each move is 0.75 of a step and a quarter of the previous move, in the end one step again.
    assert float((proposals.thetas[-1] - proposals.thetas[-2])[0]) == pytest.approx(0.05, rel=1e-3)


def test_early_stop_ends_at_the_first_success() -> None:
    result = APGD(steps=40, early_stop=True)(Slope(need=3).problem, START)
    assert result.success_moved
    assert result.queries < 40
