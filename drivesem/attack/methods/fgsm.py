"""FGSM: one sign step on semantic parameters (the paper, its equation for sFGSM)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals
from scene_ir.errors import RangeError


@dataclass(frozen=True, slots=True)
class FGSM(Attack):
    """theta <- project(theta0 + steps * step * sign(gradient)): as far as si-FGSM may go with so many steps."""

    steps: int = 10

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise RangeError("steps", "at least 1", self.steps)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        loss, gradient = problem.loss_and_grad(start.theta)
        end = problem.project(start.theta + self.steps * problem.step * torch.sign(gradient))
        return Proposals(
            thetas=(start.theta, end.theta),
            losses=(loss, None),
            queries=1,
            active_constraints=tuple(dict.fromkeys((*start.active, *end.active))),
        )
