"""Every search method on a known loss: proposals are projected, scored again and ranked; settings are checked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import get_args, get_type_hints

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from drivesem.attacks.methods.base import MAX_RESCORED, Attack, Problem, Proposals, Score
from drivesem.attacks.methods.gradient_ascent import APGD, FGSM, SGD, SiFGSM
from drivesem.attacks.methods.gradient_free import CMAES, Placebo, Sampling
from drivesem.attacks.methods.margin_search import MIN_PASSES, Climb, Corners, MarginSearch
from drivesem.attacks.methods.scw import SCW
from drivesem.attacks.theta import ProjectedTheta
from drivesem.config import commands
from drivesem.config.commands import QUERY_METHODS, AttackConfig
from drivesem.run.attack import build_attack
from scene_ir.errors import RangeError
from tests.drivesem.attacks.methods.problems import START, Quadratic, Slope, make_problem, propose, score_of

LIKE = (0.1, -0.3, 0.02, 0.0, 0.5, 0.25)
"""Change whose size a placebo takes."""


def method_named(name: str) -> Attack:
    if name == "placebo":
        return Placebo(LIKE)
    queries = 12 if name in QUERY_METHODS else None
    return build_attack(AttackConfig(method=name, steps=4, queries=queries))  # pyright: ignore


METHODS: dict[str, Attack] = {
    **{name: method_named(name) for name in get_args(get_type_hints(AttackConfig)["method"])},
    "momentum": SiFGSM(momentum=1.0),
    "sgd raw": SGD(form="raw", rate=0.2, momentum=0.5),
    "scw norm 1": SCW(queries=15, steps=5, norm=1),
}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
@settings(max_examples=6, deadline=None)
@given(need=st.floats(0.5, 20), fence=st.floats(0.05, 1), sight=st.floats(0.5, 40), seed=st.integers(0, 1000))
def test_the_best_feasible_proposal_is_returned(
    method: Attack, need: float, fence: float, sight: float, seed: int
) -> None:
    world = Slope(need, fence, sight)
    proposals = propose(method, world.problem, START, seed)
    proposal_gradients, proposal_scores = len(world.gradients), len(world.scored)
    result = method(world.problem, START, seed=seed)
    # Feasible, and a new evaluation of theta gives the reported score.
    for theta in (*world.gradients, *world.scored, result.theta):
        assert torch.equal(world.project(theta).theta, theta)
    assert result.score == world.score(result.theta)
    assert result.score.violations == ()
    assert (result.score.success, result.score.success_paper) == (result.success_moved, result.success_paper)
    assert result.loss_trace[-1] == result.score.loss
    # Neither the start nor a feasible proposal ranks above it.
    assert len(proposals.thetas) == len(proposals.losses) > 0
    best = method._rank(world.problem, result.theta, result.score)
    for theta in (START, *proposals.thetas):
        feasible = world.project(theta).theta
        score = world.score(feasible)
        if score.violations:
            assert set(score.violations) <= set(result.active_constraints)
        else:
            assert best >= method._rank(world.problem, feasible, score)
    if not isinstance(method, MarginSearch):  # they count passes
        assert proposal_gradients <= result.queries == proposals.queries <= proposal_gradients + proposal_scores
    again = method(Slope(need, fence, sight).problem, START, seed=seed)
    assert torch.equal(again.theta, result.theta)
    assert again.loss_trace == result.loss_trace
    assert again.seed == seed


def test_size_is_in_sign_steps_for_any_group() -> None:
    problem = Slope().problem
    theta = torch.zeros(6)
    theta[2:5] = torch.tensor([0.06, -0.06, 0.06])
    assert [float(problem.size(theta, p)) for p in (2, 1)] == pytest.approx([3, 3])
    theta[5] = 1.0
    assert [float(problem.size(theta, p)) for p in (2, 1)] == pytest.approx([5, 7])


def test_size_has_a_gradient_at_0_and_ignores_fixed_coordinates() -> None:
    problem = make_problem(torch.sum, (0.1, 0.0), 1.0)
    for p in (1, 2):
        theta = torch.zeros(2, requires_grad=True)
        (gradient,) = torch.autograd.grad(problem.size(theta, p), theta)
        assert gradient.tolist() == [0.0, 0.0]
    assert float(problem.size(torch.tensor([0.2, 5.0]))) == pytest.approx(2 / math.sqrt(2))


class GivenProposals(Attack):
    """Proposes given thetas with given losses."""

    def __init__(self, thetas: list[list[float]], losses: list[float | None] | None = None) -> None:
        self.thetas, self.losses = thetas, losses or [None] * len(thetas)

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        return Proposals(tuple(map(torch.tensor, self.thetas)), tuple(self.losses), queries=len(self.thetas))


class SmallestFirst(GivenProposals):
    """Ranks smaller changes first."""

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return (score.success, -float(theta.abs().sum()))


def test_a_subclass_may_change_the_rank_but_not_the_score() -> None:
    problem = make_problem(
        torch.sum, (1.0, 1.0), 1.0, score=lambda theta: score_of(float(theta[0]), round(float(theta[0]) * 5))
    )
    result = SmallestFirst([[0.4, 0.0], [0.2, 0.0]])(problem, torch.zeros(2))
    assert result.theta.tolist() == pytest.approx([0.2, 0.0])
    assert result.score.lost == 1


def quadratic() -> Quadratic:
    """In the box [-0.5, 0.5]; something is lost where theta[0] > 0.25."""
    limit = torch.full((3,), 0.5)

    def project(theta: Tensor) -> ProjectedTheta:
        inside = theta.clamp(-0.5, 0.5)
        return ProjectedTheta(inside, tuple(f"{i}: bounds" for i in (inside != theta).nonzero()[:, 0].tolist()))

    goal, step = torch.tensor([0.38, -10.0, 0.0]), torch.tensor([0.1, 0.2, 0.3])
    return Quadratic(goal, step, (-limit, limit), project, lambda theta: theta[0] > 0.25)


def test_claims_that_a_new_render_does_not_confirm_are_ignored() -> None:
    world = quadratic()
    attack = GivenProposals([[9.0, 9.0, 9.0], [0.1, 0.0, 0.0]], [1e9, 0.0])
    result = attack(world.problem, torch.zeros(3))
    assert result.theta.tolist() == pytest.approx([0.5, 0.5, 0.5])
    assert result.score.loss == pytest.approx(float(world.loss(torch.full((3,), 0.5))))
    assert result.active_constraints == ("0: bounds", "1: bounds", "2: bounds")
    assert all(bool((theta.abs() <= 0.5).all()) for theta in world.scored)


def test_lost_objects_rank_before_the_loss_and_theta0_before_harm() -> None:
    # The first has the higher loss and loses nothing, the last loses an object.
    result = GivenProposals([[0.2, -0.5, 0.0], [0.5, 0.5, 0.5]])(quadratic().problem, torch.zeros(3))
    assert result.theta.tolist() == pytest.approx([0.5, 0.5, 0.5])
    assert result.success_moved
    result = GivenProposals([[-0.4, 0.5, 0.5]])(quadratic().problem, torch.zeros(3))
    assert torch.equal(result.theta, torch.zeros(3))
    assert not result.success_moved


def test_equal_candidates_are_scored_once() -> None:
    world = quadratic()
    GivenProposals([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])(world.problem, torch.zeros(3))
    assert len(world.scored) == 1


def test_the_last_iterate_is_returned_on_request() -> None:
    world, start = quadratic(), torch.tensor([0.38, 0.5, 0.0])  # the first step of theta[0] leaves its goal
    best, last = (SiFGSM(steps=2)(replace(world.problem, keep_last=keep), start) for keep in (False, True))
    assert last.theta.tolist() == pytest.approx([0.38, 0.1, 0.0])
    assert last.score.loss <= best.score.loss or torch.equal(last.theta, best.theta)
    for keep_last, expected in ((True, 0.2), (False, 0.3)):
        downhill = replace(world.problem, keep_last=keep_last, loss_and_grad=lambda theta: (0.0, -torch.ones(3)))
        assert SiFGSM(steps=1)(downhill, torch.full((3,), 0.3)).theta[0] == pytest.approx(expected)


def test_only_the_most_promising_previews_are_scored() -> None:
    scored: list[float] = []

    def score(theta: Tensor) -> Score:
        scored.append(float(theta))
        return score_of(float(theta))

    def preview(theta: Tensor) -> Score | None:
        # The last iterate has no preview. The 4th promises a lost object, later ones a slightly higher loss.
        k = round(float(theta))
        return None if k == 20 else score_of(20 + k / 100, int(k == 4))

    result = SiFGSM(steps=20)(make_problem(torch.sum, (1.0,), score=score, preview=preview), torch.zeros(1))
    assert scored == [0, 20, 4, 19, 18, 17, 16]
    assert len(scored) == MAX_RESCORED + 2
    assert float(result.theta) == 20


def test_previews_that_cannot_win_are_not_scored() -> None:
    """The 10th and the 9th promise a lost object: the first turns out to have none, and the second has one."""
    scored: list[float] = []

    def score(theta: Tensor) -> Score:
        scored.append(float(theta))
        return score_of(float(theta), int(theta == 9))

    def preview(theta: Tensor) -> Score:
        return score_of(float(theta), int(theta >= 8 if theta <= 10 else 0))

    result = SiFGSM(steps=20)(make_problem(torch.sum, (1.0,), score=score, preview=preview), torch.zeros(1))
    assert scored == [0, 10, 9]  # the 8th has a lower loss, by more than a preview's error
    assert float(result.theta) == 9


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *(
            (lambda kind=kind: kind(steps=0), "steps: expected at least 1")
            for kind in (SiFGSM, SGD, APGD, SCW, FGSM)
        ),
        *((lambda kind=kind: kind(steps=0), "steps: expected at least 1") for kind in (Sampling, CMAES)),
        *((lambda kind=kind: kind(queries=0), "queries: expected at least 1") for kind in (SCW, Sampling, CMAES)),
        *((lambda kind=kind: kind(MIN_PASSES - 1), "passes: expected at least 24") for kind in (Climb, Corners)),
        *(
            (lambda kind=kind: kind(rate=0.0), "rate: expected a positive number, found 0.0")
            for kind in (SGD, APGD)
        ),
        (lambda: SCW(rate=math.nan), "rate: expected a positive number, found nan"),
        (lambda: SiFGSM(momentum=1.5), r"momentum: expected a number in \[0, 1\], found 1.5"),
        (lambda: SCW(norm=3), "norm: expected 1 or 2, found 3"),  # pyright: ignore
    ],
)
def test_invalid_settings_are_named(make: Callable[[], Attack], message: str) -> None:
    with pytest.raises(RangeError, match=message):
        make()


def test_the_minimum_of_passes_equals_the_command_lines() -> None:
    """Written twice: options load no torch, and searches know no options."""
    assert commands.MIN_PASSES == MIN_PASSES
