"""Objects whose margins are known: cars that are lost at a place of their own, dark and in fog."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from drivesem.attack.methods.base import ParameterGroup, Problem, Score
from drivesem.attack.theta import ProjectedTheta

CARS = 4
PLACE, PAINT, WEATHER = slice(0, 2 * CARS), slice(2 * CARS, 3 * CARS), slice(3 * CARS, 3 * CARS + 2)
DIM = 3 * CARS + 2
BLIND_AT = torch.tensor([[-0.8, 0.6], [0.7, 0.7], [-0.6, -0.9], [0.9, -0.5]])
"""Where each car is to stand, of bounds from -1 to 1, to be lost."""


@dataclass
class Street:
    """Cars that are lost near a place of their own, the more so dark and in fog. ripple: how much a car's margin
    goes up and down with the place, many times within the bounds, as the phase of edges in pixels does; its
    gradient is then of no use.
    """

    ripple: float = 0.0
    counted_objects: Tensor = field(default_factory=lambda: torch.ones(CARS, dtype=torch.bool))
    differentiable: bool = True
    passes: int = 0

    def known_margins(self, theta: Tensor, number: int) -> Tensor:
        place, paint, weather = theta[PLACE].reshape(CARS, 2), theta[PAINT], theta[WEATHER]
        away = ((place - BLIND_AT) ** 2).sum(dim=1)
        wave = self.ripple * torch.sin(40 * place + number).sum(dim=1)
        return 3 * away - 1.0 + 0.5 * paint - 0.3 * weather[0] + wave + 0.05 * (number % 3)

    def margins(self, theta: Tensor, number: int) -> Tensor:
        self.passes += 1
        return self.known_margins(theta, number)

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        self.passes += 3
        leaf = theta.clone().requires_grad_(True)
        margins = self.known_margins(leaf, number)
        (gradient,) = torch.autograd.grad((weights * margins).sum(), leaf)
        return margins.detach(), gradient

    def problem(self, smooth_place: bool = False) -> Problem:
        upper = torch.ones(DIM)
        lower = -upper
        lower[WEATHER] = 0.0

        def score(theta: Tensor) -> Score:
            lost = int((self.known_margins(theta, 0) < 0).sum())
            return Score(0.0, lost, 0, lost > 0, False)

        return Problem(
            loss_and_grad=lambda theta: (0.0, torch.zeros_like(theta)),
            project=lambda theta: ProjectedTheta(theta.clamp(lower, upper), ()),
            score=score,
            step=torch.full((DIM,), 0.1),
            lower=lower,
            upper=upper,
            groups=(
                ParameterGroup("place", PLACE, CARS, None, smooth_place),
                ParameterGroup("paint", PAINT, CARS),
                ParameterGroup("weather", WEATHER),
            ),
            margin_oracle=self,
        )
