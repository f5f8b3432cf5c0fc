"""The placebo: as large as another change, in a direction of its own, and never chosen against doing nothing."""

from dataclasses import replace

import pytest
import torch

from drivesem.attack.methods.base import ParameterGroup, Problem, Score
from drivesem.attack.methods.placebo import Placebo
from drivesem.attack.theta import ProjectedTheta
from scene_ir.errors import ShapeError

START = torch.zeros(6)
LOWER = torch.tensor([-1.0, -1.0, -1.0, -1.0, 0.0, 0.0])
UPPER = torch.ones(6)
GROUPS = (
    ParameterGroup("rotate", slice(0, 2)),
    ParameterGroup("mesh", slice(2, 4)),
    ParameterGroup("weather", slice(4, 6)),
)
LIKE = (0.1, -0.3, 0.02, 0.0, 0.5, 0.25)


def problem(limit: float = 1.0) -> Problem:
    """Every change lowers the loss and breaks nothing; coordinates of more than `limit` are not feasible."""
    return Problem(
        loss_and_grad=lambda theta: pytest.fail("a placebo takes no gradient"),
        project=lambda theta: ProjectedTheta(
            theta.clamp(-limit, limit), ("limit",) if theta.abs().max() > limit else ()
        ),
        score=lambda theta: Score(-float(theta.abs().sum()), 0, 0, False, False),
        step=torch.full((6,), 0.01),
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
    found = [tuple(Placebo(LIKE)(problem(), START, seed).theta.tolist()) for seed in (0, 0, 1, 2, 3, 4)]
    assert found[0] == found[1]
    assert len(set(found)) > 3
    assert any(theta[0] < 0 for theta in found)
    assert any(theta[1] > 0 for theta in found)


def test_the_edit_stands_although_doing_nothing_would_score_higher() -> None:
    result = Placebo(LIKE)(problem(), START)
    assert bool((result.theta != 0).any())
    assert result.score.loss < 0


def test_what_is_not_feasible_is_projected_and_told() -> None:
    result = Placebo(LIKE)(problem(limit=0.2), START)
    assert float(result.theta.abs().max()) == pytest.approx(0.2)
    assert result.active_constraints == ("limit",)


def test_an_edit_that_hides_a_car_is_drawn_again() -> None:
    seen = []

    def score(theta: torch.Tensor) -> Score:
        hides = bool(theta[0] != 0) and len(seen) < 2
        seen.append(theta)
        return Score(0.0, 0, 0, False, False, ("objects[0]: visibility",) if hides else ())

    result = Placebo(LIKE)(replace(problem(), score=score), START)
    assert result.queries == 3
    assert torch.equal(result.theta, seen[2])
    assert not torch.equal(result.theta, seen[0])
    assert sorted(result.theta.abs().tolist()) == pytest.approx(sorted(map(abs, LIKE)))


def test_where_every_edit_hides_a_car_nothing_is_changed() -> None:
    hidden = Score(0.0, 0, 0, False, False, ("objects[0]: visibility",))
    plain = Score(0.0, 0, 0, False, False)
    world = replace(problem(), score=lambda theta: hidden if bool(theta.any()) else plain)
    result = Placebo(LIKE)(world, START)
    assert not bool(result.theta.any())
    assert result.queries == 8
    assert result.active_constraints == ("objects[0]: visibility",)


def test_another_scene_s_change_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"like: expected \(6,\), found \(2,\)"):
        Placebo((0.1, 0.2))(problem(), START)


def test_nothing_moved_gives_nothing() -> None:
    assert not bool(Placebo((0.0,) * 6)(problem(), START).theta.any())
