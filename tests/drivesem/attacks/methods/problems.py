"""Problems with known solutions: a loss with a constant slope, a quadratic loss, and cars with known margins."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from drivesem.attacks.methods.base import Attack, ParameterGroup, Problem, Proposals, Score
from drivesem.attacks.theta import ProjectedTheta

Loss = Callable[[Tensor], Tensor]


def score_of(loss: float, lost: int = 0, violations: tuple[str, ...] = ()) -> Score:
    return Score(loss, lost, 0, bool(lost) and not violations, False, violations)


def value_and_grad(loss: Loss, theta: Tensor) -> tuple[float, Tensor]:
    leaf = theta.clone().requires_grad_(True)
    value = loss(leaf)
    return float(value.detach()), torch.autograd.grad(value, leaf)[0]


def make_problem(
    loss: Loss, step: Sequence[float] | Tensor, limit: float | Tensor = 100.0, **fields: Any
) -> Problem:
    """All thetas are feasible, within bounds of `limit` either way, and nothing fails; `fields` replace others."""
    step = torch.as_tensor(step)
    upper = torch.as_tensor(limit).expand(step.shape)
    defaults: dict[str, Any] = {
        "loss_and_grad": lambda theta: value_and_grad(loss, theta),
        "project": lambda theta: ProjectedTheta(theta.clone(), ()),
        "score": lambda theta: score_of(float(loss(theta))),
        "lower": -upper,
        "upper": upper,
    }
    return Problem(step=step, **{**defaults, **fields})


def propose(method: Attack, problem: Problem, start: Tensor | None = None, seed: int = 0) -> Proposals:
    start = torch.zeros_like(problem.step) if start is None else start
    return method.propose(problem, start, torch.Generator().manual_seed(seed))


class Quadratic:
    """Loss -|theta - goal|^2; `projected` maps theta to the feasible set, `lost` is whether an object is lost."""

    def __init__(
        self,
        goal: Tensor,
        step: Tensor,
        bounds: tuple[Tensor, Tensor],
        projected: Callable[[Tensor], ProjectedTheta],
        lost: Callable[[Tensor], Tensor],
        scale: float = 1.0,
    ) -> None:
        self.goal, self.lost, self.scale = goal, lost, scale
        self.gradients = 0
        self.scored: list[Tensor] = []
        fields = {"project": projected, "loss_and_grad": self.loss_and_grad, "score": self.score}
        self.problem = make_problem(self.loss, step, lower=bounds[0], upper=bounds[1], **fields)

    def loss(self, theta: Tensor) -> Tensor:
        return -self.scale * ((theta - self.goal) ** 2).sum()

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        self.gradients += 1
        return value_and_grad(self.loss, theta)

    def score(self, theta: Tensor) -> Score:
        self.scored.append(theta)
        return score_of(float(self.loss(theta)), int(self.lost(theta)))


GROUPS = (
    ParameterGroup("near", slice(0, 2)),
    ParameterGroup("wide", slice(2, 5)),
    ParameterGroup("code", slice(5, 6)),
)
STEP = torch.tensor([0.1, 0.1, 0.02, 0.02, 0.02, 0.25])
LOWER = torch.tensor([-0.5, -0.5, -1.0, -1.0, -1.0, 0.0])
UPPER = torch.tensor([0.5, 0.5, 1.0, 1.0, 1.0, 1.0])
SLOPE = torch.tensor([1.0, 0.2, 0.3, -0.3, 0.1, 2.0])
"""Slope of the loss, for each step."""
START = torch.zeros(6)


class Slope:
    """Loss SLOPE . theta / STEP; the bounds are feasible, and a sum of the first two coordinates of at most `fence`;
    something is lost where the loss is above `need`. Above a loss of `sight` the render is not feasible.
    """

    def __init__(self, need: float = 6.0, fence: float = 10.0, sight: float = 1e6) -> None:
        self.need, self.fence, self.sight = need, fence, sight
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
        loss = float(self.loss(theta))
        return score_of(loss, int(loss > self.need), ("objects[0]: visibility",) if loss > self.sight else ())

    @property
    def problem(self) -> Problem:
        oracle = SlopeMargins(self)
        return Problem(
            self.loss_and_grad, self.project, self.score, STEP, LOWER, UPPER, GROUPS, margin_oracle=oracle
        )


class SlopeMargins:
    """One object; its margin falls as the loss rises, and differs a little between nuisance samples."""

    def __init__(self, world: Slope) -> None:
        self.world = world
        self.counted_objects, self.differentiable, self.passes = torch.tensor([True]), True, 0

    def margins(self, thetas: Sequence[Tensor], numbers: Sequence[int], random: Collection[int] = ()) -> Tensor:
        self.passes += len(thetas)
        needs = (self.world.need - torch.stack([self.world.loss(theta) for theta in thetas])) / 10
        return (needs + 0.01 * torch.tensor(numbers))[:, None]

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        (margins,) = self.margins([theta], [number])
        self.passes += 2
        return margins, -weights[0] * SLOPE / STEP / 10


CARS = 4
POSITION, PAINT, WEATHER = slice(0, 2 * CARS), slice(2 * CARS, 3 * CARS), slice(3 * CARS, 3 * CARS + 2)
DIM = 3 * CARS + 2
LOST_AT = torch.tensor([[-0.8, 0.6], [0.7, 0.7], [-0.6, -0.9], [0.9, -0.5]])
"""Position at which each car is lost, with bounds of -1 and 1."""


@dataclass
class Street:
    """Cars that are lost near a position each, more so dark and in fog; also their margin oracle.

    ripple: amplitude of a car's margin as a function of position, many periods within the bounds, as the phase of
    edges in pixels causes; it makes gradients useless.
    """

    ripple: float = 0.0
    counted_objects: Tensor = field(default_factory=lambda: torch.ones(CARS, dtype=torch.bool))
    differentiable: bool = True
    passes: int = 0
    thetas: list[Tensor] = field(default_factory=list)
    random: list[Tensor] = field(default_factory=list)

    def known_margins(self, theta: Tensor, number: int) -> Tensor:
        position, paint, weather = theta[POSITION].reshape(CARS, 2), theta[PAINT], theta[WEATHER]
        distance = ((position - LOST_AT) ** 2).sum(dim=1)
        wave = self.ripple * torch.sin(40 * position + number).sum(dim=1)
        return 3 * distance - 1.0 + 0.5 * paint - 0.3 * weather[0] + wave + 0.05 * (number % 3)

    def margins(self, thetas: Sequence[Tensor], numbers: Sequence[int], random: Collection[int] = ()) -> Tensor:
        self.passes += len(thetas)
        self.random.extend(thetas[i] for i in random)
        self.thetas.extend(thetas)
        return torch.stack([self.known_margins(*state) for state in zip(thetas, numbers, strict=True)])

    def describe(self, theta: Tensor, number: int) -> tuple[Tensor, Tensor, list[tuple[int, ...]]]:
        rows = self.counted_objects.nonzero()[:, 0]
        features = torch.cat([theta[POSITION].reshape(CARS, 2) - LOST_AT, theta[PAINT][:, None]], 1)[rows]
        return rows, features, [(int(dark > 0.5),) for dark in theta[WEATHER][:1].expand(len(rows))]

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        self.passes += 3
        self.thetas.append(theta)
        leaf = theta.clone().requires_grad_(True)
        margins = self.known_margins(leaf, number)
        (gradient,) = torch.autograd.grad((weights * margins).sum(), leaf)
        return margins.detach(), gradient

    def problem(self, smooth_position: bool = False) -> Problem:
        upper = torch.ones(DIM)
        lower = -upper
        lower[WEATHER] = 0.0
        return make_problem(
            lambda theta: 0 * theta.sum(),
            torch.full((DIM,), 0.1),
            project=lambda theta: ProjectedTheta(theta.clamp(lower, upper), ()),
            score=lambda theta: score_of(0.0, int((self.known_margins(theta, 0) < 0).sum())),
            lower=lower,
            upper=upper,
            groups=(
                ParameterGroup("position", POSITION, CARS, None, smooth_position),
                ParameterGroup("paint", PAINT, CARS),
                ParameterGroup("weather", WEATHER),
            ),
            margin_oracle=self,
        )
