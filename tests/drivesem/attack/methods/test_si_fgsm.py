import dataclasses

import pytest
import torch

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score
from drivesem.attack.methods.gradient_ascent import SiFGSM
from drivesem.attack.theta import ProjectedTheta
from scene_ir.errors import RangeError

STEP = torch.tensor([0.1, 0.2, 0.3])
LIMIT = torch.full((3,), 0.5)
GOAL = torch.tensor([0.38, -10.0, 0.0])


class Analytic:
    """Loss -|theta - GOAL|^2 in the box [-0.5, 0.5]; something is lost where theta[0] > 0.25."""

    def __init__(self) -> None:
        self.gradients = 0
        self.scored: list[torch.Tensor] = []

    def loss(self, theta):
        return -((theta - GOAL) ** 2).sum()

    def loss_and_grad(self, theta):
        self.gradients += 1
        leaf = theta.clone().requires_grad_(True)
        loss = self.loss(leaf)
        return float(loss.detach()), torch.autograd.grad(loss, leaf)[0]

    def project(self, theta):
        inside = theta.clamp(-0.5, 0.5)
        return ProjectedTheta(inside, tuple(f"{i}: bounds" for i in (inside != theta).nonzero()[:, 0].tolist()))

    def score(self, theta):
        self.scored.append(theta)
        lost = int(theta[0] > 0.25)
        return Score(float(self.loss(theta)), lost, 0, bool(lost), False)

    @property
    def problem(self):
        return Problem(self.loss_and_grad, self.project, self.score, STEP, lower=-LIMIT, upper=LIMIT)


def test_steps_follow_the_sign_and_stay_feasible():
    world = Analytic()
    result = SiFGSM(steps=4)(world.problem, torch.zeros(3))
    # theta[0]: 0.1, 0.2, 0.3, 0.4 (beyond 0.38 only after the step); theta[1] reaches its bound; the gradient of
    # theta[2] is zero at its goal.
    assert result.theta.tolist() == pytest.approx([0.4, -0.5, 0.0])
    assert result.queries == world.gradients == 4
    assert len(result.loss_trace) == 5
    assert result.loss_trace[0] == pytest.approx(float(world.loss(torch.zeros(3))))
    assert result.loss_trace[-1] == pytest.approx(float(world.loss(result.theta)))
    assert result.active_constraints == ("1: bounds",)
    assert result.success_moved
    assert not result.success_paper


def test_the_last_iterate_is_kept_on_request_whatever_it_does():
    world = Analytic()
    start = torch.tensor([0.38, 0.5, 0.0])  # the first step of theta[0] leads away from its goal
    best, last = (
        SiFGSM(steps=2)(dataclasses.replace(world.problem, keep_last=keep), start) for keep in (False, True)
    )
    assert last.theta.tolist() == pytest.approx([0.38, 0.1, 0.0])
    assert last.score.loss <= best.score.loss or torch.equal(last.theta, best.theta)
    away = dataclasses.replace(world.problem, keep_last=True, loss_and_grad=lambda theta: (0.0, -torch.ones(3)))
    assert SiFGSM(steps=1)(away, torch.full((3,), 0.3)).theta[0] == pytest.approx(0.2)
    kept = dataclasses.replace(away, keep_last=False)
    assert SiFGSM(steps=1)(kept, torch.full((3,), 0.3)).theta[0] == pytest.approx(0.3)


def test_early_stop_ends_at_the_first_success():
    world = Analytic()
    result = SiFGSM(steps=10, early_stop=True)(world.problem, torch.zeros(3))
    assert result.queries == 3
    assert float(result.theta[0]) == pytest.approx(0.3)
    assert result.success_moved


def test_same_seed_same_result():
    one, two = (SiFGSM()(Analytic().problem, torch.zeros(3), seed=7) for _ in range(2))
    assert torch.equal(one.theta, two.theta)
    assert one.loss_trace == two.loss_trace
    assert one.seed == 7


class Liar(Attack):
    """Proposes given thetas with given losses."""

    def __init__(self, thetas, losses):
        self.thetas, self.losses = thetas, losses

    def _propose(self, problem, theta0, generator):
        return Proposals(tuple(map(torch.tensor, self.thetas)), tuple(self.losses), queries=len(self.thetas))


def test_an_attack_cannot_claim_what_a_new_render_does_not_show():
    world = Analytic()
    # A point far outside with a splendid claimed loss is projected and scored anew.
    result = Liar([[9.0, 9.0, 9.0], [0.1, 0.0, 0.0]], [1e9, 0.0])(world.problem, torch.zeros(3))
    assert result.theta.tolist() == pytest.approx([0.5, 0.5, 0.5])
    assert result.score.loss == pytest.approx(float(world.loss(torch.full((3,), 0.5))))
    assert result.active_constraints == ("0: bounds", "1: bounds", "2: bounds")
    assert all(bool((t.abs() <= 0.5).all()) for t in world.scored)


def test_lost_objects_come_before_the_loss():
    world = Analytic()
    # The first has the higher loss and loses nothing, the last loses an object.
    result = Liar([[0.2, -0.5, 0.0], [0.5, 0.5, 0.5]], [5.0, 1.0])(world.problem, torch.zeros(3))
    assert result.theta.tolist() == pytest.approx([0.5, 0.5, 0.5])
    assert result.success_moved


def test_a_harmful_proposal_loses_against_theta0():
    world = Analytic()
    result = Liar([[-0.4, 0.5, 0.5]], [None])(world.problem, torch.zeros(3))
    assert torch.equal(result.theta, torch.zeros(3))
    assert not result.success_moved


def test_equal_candidates_are_scored_once():
    world = Analytic()
    Liar([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [0.0, None])(world.problem, torch.zeros(3))
    assert len(world.scored) == 1


def test_steps_must_be_positive():
    with pytest.raises(RangeError, match="steps: expected at least 1, found 0"):
        SiFGSM(steps=0)
