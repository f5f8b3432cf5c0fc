"""The placebo: as large as another change, in a random direction, and never compared with doing nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from drivesem.attacks.methods.base import ParameterGroup, Problem, Score
from drivesem.attacks.methods.gradient_free import FixedTheta, Placebo
from drivesem.attacks.theta import ProjectedTheta
from scene_ir.errors import ShapeError
from tests.drivesem.attacks.methods.problems import START, make_problem, score_of

LOWER = torch.tensor([-1.0, -1.0, -1.0, -1.0, 0.0, 0.0])
UPPER = torch.ones(6)
GROUPS = (
    ParameterGroup("rotate", slice(0, 2)),
    ParameterGroup("mesh", slice(2, 4)),
    ParameterGroup("weather", slice(4, 6)),
)
LIKE = (0.1, -0.3, 0.02, 0.0, 0.5, 0.25)
HIDDEN = score_of(0.0, violations=("objects[0]: visibility",))


def problem(limit: float = 1.0) -> Problem:
    """Every change lowers the loss and breaks nothing; coordinates of more than `limit` are not feasible."""
    return make_problem(
        lambda theta: -theta.abs().sum(),
        torch.full((6,), 0.01),
        project=lambda theta: ProjectedTheta(
            theta.clamp(-limit, limit), ("limit",) if theta.abs().max() > limit else ()
        ),
        loss_and_grad=lambda theta: pytest.fail("a placebo takes no gradient"),
        lower=LOWER,
        upper=UPPER,
        groups=GROUPS,
    )


@pytest.mark.parametrize("seed", range(8))
def test_it_is_as_large_in_every_group(seed: int) -> None:
    result = Placebo(LIKE)(problem(), START, seed)
    for group in GROUPS:
        sizes = [sorted(values[group.where].abs().tolist()) for values in (result.theta, torch.tensor(LIKE))]
        assert sizes[0] == pytest.approx(sizes[1])
    assert bool(((result.theta >= LOWER) & (result.theta <= UPPER)).all())
    assert result.queries == 1


def test_directions_differ_and_follow_the_seed() -> None:
    thetas = [tuple(Placebo(LIKE)(problem(), START, seed).theta.tolist()) for seed in (0, 0, 1, 2, 3, 4)]
    assert thetas[0] == thetas[1]
    assert len(set(thetas)) > 3
    assert any(theta[0] < 0 for theta in thetas)
    assert any(theta[1] > 0 for theta in thetas)


def test_the_edit_wins_although_doing_nothing_would_score_higher() -> None:
    result = Placebo(LIKE)(problem(), START)
    assert bool((result.theta != 0).any())
    assert result.score.loss < 0


def test_an_infeasible_edit_is_projected_and_the_constraint_named() -> None:
    result = Placebo(LIKE)(problem(limit=0.2), START)
    assert float(result.theta.abs().max()) == pytest.approx(0.2)
    assert result.active_constraints == ("limit",)


def test_an_edit_that_hides_a_car_is_drawn_again() -> None:
    thetas = []

    def score(theta: Tensor) -> Score:
        thetas.append(theta)
        return HIDDEN if bool(theta[0] != 0) and len(thetas) <= 2 else score_of(0.0)

    result = Placebo(LIKE)(replace(problem(), score=score), START)
    assert result.queries == 3
    assert torch.equal(result.theta, thetas[2])
    assert not torch.equal(result.theta, thetas[0])
    assert sorted(result.theta.abs().tolist()) == pytest.approx(sorted(map(abs, LIKE)))


def test_if_every_edit_hides_a_car_nothing_is_changed() -> None:
    world = replace(problem(), score=lambda theta: HIDDEN if bool(theta.any()) else score_of(0.0))
    result = Placebo(LIKE)(world, START)
    assert not bool(result.theta.any())
    assert result.queries == 8
    assert result.active_constraints == ("objects[0]: visibility",)


def test_the_change_of_another_scene_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"like: expected \(6,\), found \(2,\)"):
        Placebo((0.1, 0.2))(problem(), START)


def test_no_change_gives_no_change() -> None:
    assert not bool(Placebo((0.0,) * 6)(problem(), START).theta.any())


@pytest.mark.parametrize(("hidden", "wins"), [(False, True), (True, False)])
def test_a_fixed_theta_wins_unless_it_is_infeasible(hidden: bool, wins: bool) -> None:
    world = problem()
    if hidden:
        world = replace(world, score=lambda theta: HIDDEN if bool(theta.any()) else score_of(0.0))
    theta = torch.full((6,), 0.5)
    assert torch.equal(FixedTheta(theta)(world, START).theta, theta if wins else START)
