"""si-FGSM: the iterated fast gradient sign method on semantic parameters (the paper, its equation for si-FGSM)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attacks.base import Attack, Problem, Proposals
from scene_ir.errors import RangeError


@dataclass(frozen=True, slots=True)
class SiFGSM(Attack):
    """theta <- project(theta + step * sign(gradient)), `steps` times; the step is the paper's alpha by parameter.

    early_stop: end at the first iterate that fails the detector under `moved` labels (one more render a step).
    """

    steps: int = 10
    early_stop: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise RangeError("steps", "at least 1", self.steps)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        theta, active = start.theta, list(start.active)
        thetas: list[Tensor] = [theta]
        losses: list[float | None] = []
        for _ in range(self.steps):
            loss, gradient = problem.loss_and_grad(theta)
            losses.append(loss)
            step = problem.project(theta + problem.step * torch.sign(gradient))
            theta = step.theta
            thetas.append(theta)
            active.extend(step.active)
            if self.early_stop and problem.score(theta).success:
                break
        return Proposals(
            thetas=tuple(thetas),
            losses=(*losses, None),
            queries=len(losses),
            active_constraints=tuple(dict.fromkeys(active)),
        )
