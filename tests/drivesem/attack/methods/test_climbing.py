"""Gradient attacks on a loss known in full, and what all attacks share."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attack.methods.apgd import APGD
from drivesem.attack.methods.base import MAX_RESCORED, Attack, ParameterGroup, Problem, Proposals, Score
from drivesem.attack.methods.gradient_ascent import SGD, SiFGSM
from drivesem.attack.methods.scw import SCW
from drivesem.attack.theta import ProjectedTheta
from scene_ir.errors import RangeError

START = torch.zeros(6)
METHODS = {
    "si-fgsm": SiFGSM(),
    "momentum": SiFGSM(momentum=1.0),
    "apgd": APGD(),
    "sgd": SGD(),
    "sgd raw": SGD(form="raw", rate=0.2, momentum=0.5),
    "scw": SCW(queries=15, steps=5),
    "scw 1": SCW(queries=15, steps=5, norm=1),
}


BOTH = (ParameterGroup("both", slice(0, 2)),)


class Hill:
    """Loss of two coordinates, a function of theta; all is feasible, nothing ever fails."""

    def __init__(self, loss, groups=BOTH, step=(0.1, 0.1)) -> None:
        self.loss, self.groups, self.step = loss, groups, torch.tensor(step)
        self.seen: list[list[float]] = []

    def loss_and_grad(self, theta):
        leaf = theta.clone().requires_grad_(True)
        loss = self.loss(leaf)
        self.seen.append(theta.tolist())
        return float(loss.detach()), torch.autograd.grad(loss, leaf)[0]

    @property
    def problem(self):
        limit = torch.full((len(self.step),), 100.0)
        return Problem(
            self.loss_and_grad,
            lambda theta: ProjectedTheta(theta.clone(), ()),
            lambda theta: Score(float(self.loss(theta)), 0, 0, False, False),
            self.step,
            -limit,
            limit,
            self.groups,
        )


def test_a_raw_step_is_the_papers_equation():
    hill = Hill(lambda theta: -((theta - 3) ** 2).sum() / 2, step=(0.1, 0.2))
    proposals = SGD(steps=2, form="raw", rate=0.5)._propose(hill.problem, torch.zeros(2), torch.Generator())
    # theta + 0.5 * alpha * (3 - theta)
    assert proposals.thetas[1].tolist() == pytest.approx([0.15, 0.3])
    assert proposals.thetas[2].tolist() == pytest.approx([0.15 + 0.05 * 2.85, 0.3 + 0.1 * 2.7])
    assert proposals.losses == (-9.0, pytest.approx(-(2.85**2 + 2.7**2) / 2), None)


def test_an_l2_step_takes_every_group_as_far_as_a_sign_step(slope):
    problem = slope(need=math.inf).problem
    sign = SiFGSM(steps=1)._propose(problem, START, torch.Generator()).thetas[1]
    move = SGD(steps=1)._propose(problem, START, torch.Generator()).thetas[1]
    for group in problem.groups:
        lengths = [float(torch.linalg.vector_norm(t[group.where])) for t in (sign, move)]
        assert lengths[0] == pytest.approx(lengths[1])
    # along the gradient in steps: 0.3, -0.3, 0.1 in the second group
    assert (move / problem.step)[2:5].tolist() == pytest.approx([1.192079, -1.192079, 0.397360], rel=1e-5)


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_an_l2_step_does_not_know_the_losss_scale(scale):
    flat, steep = (Hill(lambda theta, k=k: k * (2 * theta[0] + theta[1])) for k in (1.0, scale))
    one, two = (SGD(steps=3, momentum=1.0)(hill.problem, torch.zeros(2)) for hill in (flat, steep))
    assert two.theta.tolist() == pytest.approx(one.theta.tolist(), rel=1e-5)


def test_sgd_ends_at_the_top_that_can_be_reached():
    hill = Hill(lambda theta: -((theta - torch.tensor([0.3, -0.7])) ** 2).sum())
    result = SGD(steps=60, form="raw", rate=2.0)(hill.problem, torch.zeros(2))
    assert result.theta.tolist() == pytest.approx([0.3, -0.7], abs=1e-3)


def test_momentum_adds_up_gradients_of_one_size():
    # The second coordinate's slope turns a little at theta[0] = 0.15; what came before outweighs it.
    hill = Hill(lambda theta: 10 * theta[0] + torch.where(theta[0] > 0.15, -0.1, 5.0) * theta[1])
    plain = SiFGSM(steps=3)._propose(hill.problem, torch.zeros(2), torch.Generator())
    kept = SiFGSM(steps=3, momentum=1.0)._propose(hill.problem, torch.zeros(2), torch.Generator())
    assert plain.thetas[-1].tolist() == pytest.approx([0.3, 0.1])
    assert kept.thetas[-1].tolist() == pytest.approx([0.3, 0.3])


def test_momentum_of_each_group_by_itself():
    # First both slopes are steep, then that of the second coordinate is gentle and turned: within one group the
    # first step outweighs it (1/2 against 1/100), by itself both weigh the same.
    def loss(theta):
        return (
            torch.where(theta[0] < 0.05, 10.0, 1.0) * theta[0]
            + torch.where(theta[0] < 0.05, 10.0, -0.01) * theta[1]
        )

    together = Hill(loss)
    apart = Hill(loss, groups=(ParameterGroup("one", slice(0, 1)), ParameterGroup("two", slice(1, 2))))
    ends = [
        SiFGSM(steps=3, momentum=1.0)._propose(hill.problem, torch.zeros(2), torch.Generator()).thetas[-1].tolist()
        for hill in (together, apart)
    ]
    # 1, then 1 - 1 = 0, then -1
    assert ends == [pytest.approx([0.3, 0.3]), pytest.approx([0.3, 0.0])]


def test_raw_momentum_is_a_heavy_ball():
    hill = Hill(lambda theta: 3 * theta[0])
    proposals = SGD(steps=3, form="raw", rate=1.0, momentum=0.5)._propose(
        hill.problem, torch.zeros(2), torch.Generator()
    )
    # 0.1 * 3 * (1, 1.5, 1.75), added up
    assert [float(t[0]) for t in proposals.thetas] == pytest.approx([0.0, 0.3, 0.75, 1.275])


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(need=st.floats(0.5, 20), fence=st.floats(0.05, 1), seed=st.integers(0, 1000))
def test_whatever_the_method(slope, method: Attack, need, fence, seed):
    world = slope(need=need, fence=fence)
    proposals = method._propose(world.problem, START, torch.Generator().manual_seed(seed))
    judged = len(world.scored)
    assert len(proposals.thetas) == len(proposals.losses)
    result = method(world.problem, START, seed=seed)
    # Feasible, and inside the bounds.
    for theta in (*world.gradients, *world.scored, result.theta):
        assert torch.equal(world.project(theta).theta, theta)
    # What is reported is what a new look shows, and no proposal ranks above it.
    assert result.score == world.score(result.theta)
    assert result.success_moved == result.score.success
    assert result.loss_trace[-1] == result.score.loss
    ranks = [method._rank(world.problem, theta, world.score(theta)) for theta in proposals.thetas]
    assert method._rank(world.problem, result.theta, result.score) >= max(ranks)
    # Every gradient is counted.
    gradients = len(world.gradients) // 2
    assert gradients <= result.queries == proposals.queries <= gradients + judged
    # The seed decides.
    again = method(slope(need=need, fence=fence).problem, START, seed=seed)
    assert torch.equal(again.theta, result.theta)
    assert again.loss_trace == result.loss_trace


def test_size_is_in_sign_steps_whatever_the_group(slope):
    problem = slope().problem
    theta = torch.zeros(6)
    theta[2:5] = torch.tensor([0.06, -0.06, 0.06])
    assert float(problem.size(theta)) == pytest.approx(3)
    assert float(problem.size(theta, 1)) == pytest.approx(3)
    theta[5] = 1.0
    assert float(problem.size(theta)) == pytest.approx(5)
    assert float(problem.size(theta, 1)) == pytest.approx(7)


def test_size_has_a_gradient_everywhere_and_leaves_out_what_is_held():
    step = torch.tensor([0.1, 0.0])
    limit = torch.ones(2)
    problem = Problem(lambda t: (0.0, t), lambda t: ProjectedTheta(t, ()), lambda t: None, step, -limit, limit)
    for p in (1, 2):
        theta = torch.zeros(2, requires_grad=True)
        (gradient,) = torch.autograd.grad(problem.size(theta, p), theta)
        assert gradient.tolist() == [0.0, 0.0]
    assert float(problem.size(torch.tensor([0.2, 5.0]))) == pytest.approx(2 / math.sqrt(2))


class Sizes(Attack):
    """Proposes two thetas that fail, the larger with more failures, and ranks the smaller first."""

    def _rank(self, problem, theta, score):
        return (score.success, -float(theta.abs().sum()))

    def _propose(self, problem, theta0, generator):
        return Proposals((torch.tensor([0.4, 0.0]), torch.tensor([0.2, 0.0])), (None, None), 0)


def test_an_attack_may_rank_otherwise_but_not_judge():
    limit = torch.ones(2)
    problem = Problem(
        lambda theta: (0.0, theta),
        lambda theta: ProjectedTheta(theta, ()),
        lambda theta: Score(float(theta[0]), round(float(theta[0]) * 5), 0, float(theta[0]) > 0.1, False),
        limit,
        -limit,
        limit,
    )
    result = Sizes()(problem, torch.zeros(2))
    assert result.theta.tolist() == pytest.approx([0.2, 0.0])
    assert result.score.lost == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SGD(steps=0), "steps: expected at least 1, found 0"),
        (lambda: SGD(rate=0.0), "rate: expected a positive number, found 0.0"),
        (lambda: SiFGSM(momentum=1.5), r"momentum: expected a number in \[0, 1\], found 1.5"),
        (lambda: SCW(queries=0), "queries: expected at least 1, found 0"),
        (lambda: SCW(steps=0), "steps: expected at least 1, found 0"),
        (lambda: SCW(norm=3), "norm: expected 1 or 2, found 3"),
        (lambda: SCW(rate=math.nan), "rate: expected a positive number, found nan"),
    ],
)
def test_settings_that_cannot_be(make, message):
    with pytest.raises(RangeError, match=message):
        make()


def test_apgd_begins_with_the_papers_step_and_halves_it_on_rough_ground():
    # A maximum within half a step: sign steps pass over it, and over it again.
    hill = Hill(lambda theta: -(theta - 0.03).abs().sum())
    proposals = APGD(steps=20)._propose(hill.problem, torch.zeros(2), torch.Generator())
    assert proposals.thetas[1].tolist() == pytest.approx([0.1, 0.1])
    assert proposals.queries == 20
    wandering = SiFGSM(steps=20)._propose(hill.problem, torch.zeros(2), torch.Generator())
    assert max(loss for loss in wandering.losses if loss is not None) == pytest.approx(-0.06, abs=1e-6)
    assert max(loss for loss in proposals.losses if loss is not None) > -0.03
    # In the end a step is at most an eighth of the first: halved at three of the checkpoints or more.
    assert float((proposals.thetas[-1] - proposals.thetas[-2]).abs().max()) <= 0.1 / 8 + 1e-6


def test_apgd_keeps_its_step_while_the_loss_rises():
    hill = Hill(lambda theta: theta.sum())
    proposals = APGD(steps=10, rate=0.5)._propose(hill.problem, torch.zeros(2), torch.Generator())
    assert proposals.thetas[1].tolist() == pytest.approx([0.05, 0.05])
    gone = torch.stack(proposals.thetas)[:, 0]
    # With momentum each move is 0.75 of a step and a quarter of the move before, in the end one step again.
    assert float(gone[-1] - gone[-2]) == pytest.approx(0.05, rel=1e-3)


def test_apgd_stops_at_its_first_success(slope):
    result = APGD(steps=40, early_stop=True)(slope(need=3).problem, START)
    assert result.success_moved
    assert result.queries < 40


@pytest.mark.parametrize(("settings_", "named"), [({"steps": 0}, "steps"), ({"rate": 0.0}, "rate")])
def test_apgd_refuses_what_cannot_be(settings_, named):
    with pytest.raises(RangeError, match=named):
        APGD(**settings_)


def test_of_what_was_seen_only_the_most_promising_is_judged():
    judged: list[float] = []
    step, limit = torch.ones(1), torch.full((1,), 100.0)

    def score(theta: torch.Tensor) -> Score:
        judged.append(float(theta))
        return Score(float(theta), 0, 0, False, False)

    def preview(theta: torch.Tensor) -> Score | None:
        # The last iterate was never seen. The 4th promises a lost object, later ones a higher loss.
        k = round(float(theta))
        return None if k == 20 else Score(float(k), int(k == 4), 0, k == 4, False)

    problem = Problem(
        lambda t: (0.0, torch.ones(1)),
        lambda t: ProjectedTheta(t, ()),
        score,
        step,
        -limit,
        limit,
        preview=preview,
    )
    result = SiFGSM(steps=20)(problem, torch.zeros(1))
    assert sorted(judged) == [0, 4, 16, 17, 18, 19, 20]
    assert len(judged) == MAX_RESCORED + 2
    assert float(result.theta) == 20
