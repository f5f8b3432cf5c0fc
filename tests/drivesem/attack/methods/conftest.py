"""Problems known in full: a loss that rises along one direction, of parameters in three groups."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from drivesem.attack.methods.base import ParameterGroup, Problem, Score
from drivesem.attack.theta import ProjectedTheta

GROUPS = (
    ParameterGroup("near", slice(0, 2)),
    ParameterGroup("wide", slice(2, 5)),
    ParameterGroup("code", slice(5, 6)),
)
STEP = torch.tensor([0.1, 0.1, 0.02, 0.02, 0.02, 0.25])
LOWER = torch.tensor([-0.5, -0.5, -1.0, -1.0, -1.0, 0.0])
UPPER = torch.tensor([0.5, 0.5, 1.0, 1.0, 1.0, 1.0])
SLOPE = torch.tensor([1.0, 0.2, 0.3, -0.3, 0.1, 2.0])
"""Of the loss, for each step."""


class Slope:
    """Loss SLOPE . theta / STEP; feasible is the box, and a sum of the first two coordinates of at most `fence`;
    something is lost where the loss is above `need` and all groups named in `together` are moved. Beyond a loss of
    `sight` the render shows what may not be.
    """

    def __init__(
        self, need: float = 6.0, fence: float = 10.0, together: tuple[str, ...] = (), sight: float = 1e6
    ) -> None:
        self.need, self.fence, self.together, self.sight = need, fence, together, sight
        self.gradients: list[Tensor] = []
        self.scored: list[Tensor] = []

    def loss(self, theta: Tensor) -> Tensor:
        return (SLOPE * theta / STEP).sum()

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        self.gradients.append(theta.clone())
        return float(self.loss(theta)), SLOPE / STEP

    def project(self, theta: Tensor) -> ProjectedTheta:
        inside = torch.minimum(torch.maximum(theta, LOWER), UPPER)
        active = () if torch.equal(inside, theta) else ("bounds",)
        if float(inside[:2].sum()) > self.fence + 1e-6:
            inside[:2] *= self.fence / inside[:2].sum()
            active = (*active, "fence")
        return ProjectedTheta(inside, active)

    def score(self, theta: Tensor) -> Score:
        self.scored.append(theta.clone())
        moved = {group.name for group in GROUPS if bool((theta[group.where] != 0).any())}
        lost = int(float(self.loss(theta)) > self.need and moved.issuperset(self.together))
        violations = ("objects[0]: visibility",) if float(self.loss(theta)) > self.sight else ()
        return Score(float(self.loss(theta)), lost, 0, bool(lost) and not violations, False, violations)

    @property
    def problem(self) -> Problem:
        views = SlopeViews(self)
        return Problem(
            self.loss_and_grad, self.project, self.score, STEP, LOWER, UPPER, GROUPS, margin_oracle=views
        )


class SlopeViews:
    """One object, whose margin falls as the loss rises, a little more in some views than in others."""

    def __init__(self, world: Slope) -> None:
        self.world = world
        self.counted_objects, self.differentiable, self.passes = torch.tensor([True]), True, 0

    def margins(self, theta: Tensor, number: int) -> Tensor:
        self.passes += 1
        return ((self.world.need - self.world.loss(theta)) / 10 + 0.01 * number)[None]

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        margins = self.margins(theta, number)
        self.passes += 2
        return margins, -weights[0] * SLOPE / STEP / 10


@pytest.fixture
def slope() -> Callable[..., Slope]:
    """The factory of such problems."""
    return Slope
