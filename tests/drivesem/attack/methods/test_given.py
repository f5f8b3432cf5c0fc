"""A theta that is known: projected, judged, and handed back unless it cannot be."""

import torch

from drivesem.attack.methods.base import Problem, Score
from drivesem.attack.methods.placebo import FixedTheta
from drivesem.attack.theta import ProjectedTheta


def problem(violations: tuple[str, ...] = ()) -> Problem:
    def score(theta: torch.Tensor) -> Score:
        worse = float(theta.abs().sum())
        return Score(-worse, 0, 0, False, False, violations if worse else ())

    one = torch.ones(2)
    return Problem(
        loss_and_grad=lambda theta: (0.0, theta),
        project=lambda theta: ProjectedTheta(theta.clamp(-1, 1), ()),
        score=score,
        step=0.1 * one,
        lower=-one,
        upper=one,
    )


def test_it_stands_though_the_start_is_no_worse() -> None:
    theta = torch.tensor([0.5, -0.5])
    assert torch.equal(FixedTheta(theta)(problem(), torch.zeros(2)).theta, theta)


def test_what_cannot_be_gives_way_to_the_start() -> None:
    found = FixedTheta(torch.tensor([0.5, -0.5]))(problem(("objects[0]: visibility",)), torch.zeros(2))
    assert torch.equal(found.theta, torch.zeros(2))
