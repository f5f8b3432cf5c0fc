"""What attacks that climb the loss step by step have in common."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, check_counts, check_rate
from scene_ir.errors import RangeError


@dataclass(frozen=True, slots=True)
class GradientAscent(Attack):
    """theta <- project(theta + rate * move(gradient)), `steps` times; a subclass writes `_move`.

    early_stop: end at the first iterate that fails the detector under `moved` labels (one more render a step).
    momentum: what is left after a step of the gradients before it, which are added up (Dong et al. 2018, MI-FGSM,
    where it is 1); 0 forgets them. RangeError for fewer than 1 step, a momentum outside [0, 1], or a rate that is
    not positive.
    """

    steps: int = 10
    early_stop: bool = False
    momentum: float = 0.0
    rate: float = 1.0

    def __post_init__(self) -> None:
        check_counts(steps=self.steps)
        if not 0 <= self.momentum <= 1:
            raise RangeError("momentum", "a number in [0, 1]", self.momentum)
        check_rate(self.rate)

    @abstractmethod
    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        """How far to go (D,) at rate 1, by a gradient (D,) or what momentum made of several."""

    def _weighed(self, problem: Problem, gradient: Tensor) -> Tensor:
        """A gradient (D,) as momentum adds it up: in each group divided by its L1 norm, so that early and late
        gradients weigh the same, however steep the loss is there.
        """
        weighed = gradient.clone()
        for group in problem.groups:
            block = weighed[group.where]
            if bool(block.any()):
                block /= block.abs().sum()
        return weighed

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        theta, active = start.theta, list(start.active)
        thetas: list[Tensor] = [theta]
        losses: list[float | None] = []
        kept = torch.zeros_like(theta)
        for _ in range(self.steps):
            loss, gradient = problem.loss_and_grad(theta)
            losses.append(loss)
            if self.momentum:
                gradient = kept = self.momentum * kept + self._weighed(problem, gradient)
            step = problem.project(theta + self.rate * self._move(problem, gradient))
            theta = step.theta
            thetas.append(theta)
            active.extend(step.active)
            if self.early_stop and problem.score(theta).success:
                break
        return Proposals(
            thetas=tuple(thetas),
            losses=(*losses, None),
            queries=len(losses),
            active_constraints=tuple(active),
        )


@dataclass(frozen=True, slots=True)
class SiFGSM(GradientAscent):
    """theta <- project(theta + rate * step * sign(gradient)), `steps` times; step: the paper's alpha."""

    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        return problem.step * torch.sign(gradient)


Form = Literal["raw", "l2", "unit"]
"""raw: the gradient times the step alpha, as in the paper's equation; l2: its direction only, by group; unit:
the same, but no longer than the step alpha, as the paper's program has it for classifiers."""


@dataclass(frozen=True, slots=True)
class SGD(GradientAscent):
    """theta <- project(theta + rate * move), `steps` times.

    form raw: the move is step * gradient, so its length follows the loss's scale. Momentum adds up the gradients
    as they are (Polyak's heavy ball). form l2: the gradient of each group, in steps alpha, divided by its L2 norm
    and made as long as a sign step of that group (root mean square: one step), so that all groups go equally far
    and a rate of 1 goes as far as si-FGSM, but mostly where the loss is steep. form unit: the gradient of each
    group, in theta's own units, divided by its L2 norm, times step: of a thousand coordinates each moves a little.
    """

    form: Form = "l2"

    def _weighed(self, problem: Problem, gradient: Tensor) -> Tensor:
        return gradient if self.form == "raw" else GradientAscent._weighed(self, problem, gradient)

    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        if self.form == "raw":
            return problem.step * gradient
        unit = self.form == "unit"
        # In steps, theta = step * u, and so is the loss's gradient.
        move = torch.where(problem.step > 0, gradient, 0) if unit else problem.step * gradient
        for group in problem.groups:
            block = move[group.where]
            if not bool(block.any()):
                continue
            block = block / block.abs().max()  # first: squares of small gradients would leave float32
            length = 1.0 if unit else math.sqrt(len(block))
            move[group.where] = block / torch.linalg.vector_norm(block) * length
        return problem.step * move
