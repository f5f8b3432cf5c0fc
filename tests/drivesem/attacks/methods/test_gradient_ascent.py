"""si-FGSM, FGSM and SGD on known losses: steps by hand, momentum, early stop."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from drivesem.attacks.methods.base import ParameterGroup, Problem
from drivesem.attacks.methods.gradient_ascent import FGSM, SGD, SiFGSM
from tests.drivesem.attacks.methods.problems import Loss, Slope, make_problem, propose
from tests.drivesem.attacks.methods.test_base import quadratic

JOINT = (ParameterGroup("both", slice(0, 2)),)
SEPARATE = (ParameterGroup("one", slice(0, 1)), ParameterGroup("two", slice(1, 2)))


def hill(
    loss: Loss, groups: tuple[ParameterGroup, ...] = JOINT, step: tuple[float, float] = (0.1, 0.1)
) -> Problem:
    return make_problem(loss, step, groups=groups)


def test_sign_steps_stay_feasible() -> None:
    world = quadratic()
    result = SiFGSM(steps=4)(world.problem, torch.zeros(3))
    # theta[0]: 0.1, 0.2, 0.3, 0.4 (beyond 0.38 only after the step); theta[1] reaches its bound; the gradient of
    # theta[2] is zero at its goal.
    assert result.theta.tolist() == pytest.approx([0.4, -0.5, 0.0])
    assert result.queries == world.gradients == 4
    assert len(result.loss_trace) == 5
    assert result.loss_trace[0] == pytest.approx(float(world.loss(torch.zeros(3))))
    assert result.loss_trace[-1] == pytest.approx(float(world.loss(result.theta)))
    assert result.active_constraints == ("1: bounds",)
    assert (result.success_moved, result.success_paper) == (True, False)


def test_early_stop_ends_at_the_first_success() -> None:
    result = SiFGSM(steps=10, early_stop=True)(quadratic().problem, torch.zeros(3))
    assert result.queries == 3
    assert float(result.theta[0]) == pytest.approx(0.3)
    assert result.success_moved


def test_fgsm_takes_one_gradient_and_moves_all_steps_at_once() -> None:
    world = quadratic()
    result = FGSM(steps=2)(world.problem, torch.zeros(3))
    assert result.theta.tolist() == pytest.approx([0.2, -0.4, 0.0])
    assert result.queries == world.gradients == 1
    assert result.loss_trace == pytest.approx((float(world.loss(torch.zeros(3))), float(world.loss(result.theta))))


def test_a_raw_step_is_the_papers_equation() -> None:
    problem = hill(lambda theta: -((theta - 3) ** 2).sum() / 2, step=(0.1, 0.2))
    proposals = propose(SGD(steps=2, form="raw", rate=0.5), problem)
    # theta + 0.5 * alpha * (3 - theta)
    assert proposals.thetas[1].tolist() == pytest.approx([0.15, 0.3])
    assert proposals.thetas[2].tolist() == pytest.approx([0.15 + 0.05 * 2.85, 0.3 + 0.1 * 2.7])
    assert proposals.losses == (-9.0, pytest.approx(-(2.85**2 + 2.7**2) / 2), None)


def test_an_l2_step_moves_each_group_as_far_as_a_sign_step() -> None:
    problem = Slope(need=math.inf).problem
    sign, move = (propose(kind(steps=1), problem).thetas[1] for kind in (SiFGSM, SGD))
    for group in problem.groups:
        lengths = [float(torch.linalg.vector_norm(theta[group.where])) for theta in (sign, move)]
        assert lengths[0] == pytest.approx(lengths[1])
    # along the gradient in steps: 0.3, -0.3, 0.1 in the second group
    assert (move / problem.step)[2:5].tolist() == pytest.approx([1.192079, -1.192079, 0.397360], rel=1e-5)


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_an_l2_step_is_independent_of_the_scale_of_the_loss(scale: float) -> None:
    problems = (hill(lambda theta, k=k: k * (2 * theta[0] + theta[1])) for k in (1.0, scale))
    flat, steep = (SGD(steps=3, momentum=1.0)(problem, torch.zeros(2)).theta for problem in problems)
    assert steep.tolist() == pytest.approx(flat.tolist(), rel=1e-5)


def test_sgd_converges() -> None:
    problem = hill(lambda theta: -((theta - torch.tensor([0.3, -0.7])) ** 2).sum())
    result = SGD(steps=60, form="raw", rate=2.0)(problem, torch.zeros(2))
    assert result.theta.tolist() == pytest.approx([0.3, -0.7], abs=1e-3)


def test_momentum_sums_normalised_gradients() -> None:
    # The second coordinate's slope changes sign at theta[0] = 0.15; earlier gradients outweigh it.
    problem = hill(lambda theta: 10 * theta[0] + torch.where(theta[0] > 0.15, -0.1, 5.0) * theta[1])
    ends = [propose(SiFGSM(steps=3, momentum=m), problem).thetas[-1].tolist() for m in (0.0, 1.0)]
    assert ends == [pytest.approx([0.3, 0.1]), pytest.approx([0.3, 0.3])]


def test_momentum_normalises_each_group() -> None:
    # First both slopes are steep, then that of the second coordinate is gentle and negative: within one group the
    # first step outweighs it (1/2 against 1/100), in its own group both weigh the same.
    def loss(theta: Tensor) -> Tensor:
        first, second = (torch.where(theta[0] < 0.05, 10.0, slope) for slope in (1.0, -0.01))
        return first * theta[0] + second * theta[1]

    method = SiFGSM(steps=3, momentum=1.0)
    ends = [propose(method, hill(loss, groups)).thetas[-1].tolist() for groups in (JOINT, SEPARATE)]
    # 1, then 1 - 1 = 0, then -1
    assert ends == [pytest.approx([0.3, 0.3]), pytest.approx([0.3, 0.0])]


def test_raw_momentum_is_a_heavy_ball() -> None:
    proposals = propose(SGD(steps=3, form="raw", rate=1.0, momentum=0.5), hill(lambda theta: 3 * theta[0]))
    # 0.1 * 3 * (1, 1.5, 1.75), added up
    assert [float(theta[0]) for theta in proposals.thetas] == pytest.approx([0.0, 0.3, 0.75, 1.275])
