"""Gradient ascent on the loss: si-FGSM, FGSM, SGD and Auto-PGD on semantic parameters, after the paper's equations."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.methods.base import Attack, Problem, Proposals, check_counts, check_rate
from scene_ir.errors import RangeError


@dataclass(frozen=True, slots=True)
class GradientAscent(Attack):
    """theta <- project(theta + rate * move(gradient)), `steps` times; a subclass defines `_move`.

    Raises RangeError for fewer than 1 step, a momentum outside [0, 1], or a rate that is not positive.
    """

    steps: int = 10
    """Number of gradients."""
    early_stop: bool = False
    """End at the first iterate that fails the network under `moved` labels (one more render a step)."""
    momentum: float = 0.0
    """Weight of the sum of earlier gradients, in [0, 1] (Dong et al. 2018: MI-FGSM has 1)."""
    rate: float = 1.0
    """Length of a step, in moves."""

    def __post_init__(self) -> None:
        check_counts(steps=self.steps)
        if not 0 <= self.momentum <= 1:
            raise RangeError("momentum", "a number in [0, 1]", self.momentum)
        check_rate(self.rate)

    @abstractmethod
    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        """The move (D,) at rate 1, from a gradient (D,) or a sum of several."""

    def _momentum_term(self, problem: Problem, gradient: Tensor) -> Tensor:
        """A gradient (D,) as momentum adds it up: divided by its L1 norm in each group, so that early and late
        gradients weigh the same.
        """
        normalised = gradient.clone()
        for group in problem.groups:
            block = normalised[group.where]
            if bool(block.any()):
                block /= block.abs().sum()
        return normalised

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        theta, active = start.theta, list(start.active)
        thetas: list[Tensor] = [theta]
        losses: list[float | None] = []
        velocity = torch.zeros_like(theta)
        for _ in range(self.steps):
            loss, gradient = problem.loss_and_grad(theta)
            losses.append(loss)
            if self.momentum:
                gradient = velocity = self.momentum * velocity + self._momentum_term(problem, gradient)
            projected = problem.project(problem.advance(theta, self.rate * self._move(problem, gradient)))
            theta = projected.theta
            thetas.append(theta)
            active.extend(projected.active)
            if self.early_stop and problem.score(theta).success:
                break
        return Proposals(tuple(thetas), (*losses, None), len(losses), tuple(active))


@dataclass(frozen=True, slots=True)
class SiFGSM(GradientAscent):
    """Iterative sign steps: the move is step * sign(gradient), with the paper's step alpha."""

    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        return problem.step * torch.sign(gradient)


@dataclass(frozen=True, slots=True)
class FGSM(Attack):
    """One sign step, as long as all of si-FGSM's: project(theta0 + steps * step * sign(gradient)).

    Raises RangeError for fewer than 1 step.
    """

    steps: int = 10
    """Length of the step, in steps alpha."""

    def __post_init__(self) -> None:
        check_counts(steps=self.steps)

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        loss, gradient = problem.loss_and_grad(start.theta)
        end = problem.project(start.theta + self.steps * problem.step * torch.sign(gradient))
        return Proposals((start.theta, end.theta), (loss, None), 1, (*start.active, *end.active))


SGDStepForm = Literal["raw", "l2", "unit"]
"""raw: the gradient times the step alpha, as in the paper's equation; l2: its direction only, by group; unit:
the same, but no longer than the step alpha, as in the paper's code for classifiers."""


@dataclass(frozen=True, slots=True)
class SGD(GradientAscent):
    """Gradient steps.

    raw: the move is step * gradient, so its length follows the scale of the loss; momentum is Polyak's heavy ball.
    l2: each group's gradient, in steps alpha, divided by its L2 norm and as long as a sign step (root mean square:
    one step alpha), so that all groups move equally far and a rate of 1 equals si-FGSM's. unit: each group's
    gradient, in theta's own units, divided by its L2 norm, times step: a thousand coordinates move a little each.
    """

    form: SGDStepForm = "l2"
    """Form of the step."""

    def _momentum_term(self, problem: Problem, gradient: Tensor) -> Tensor:
        return gradient if self.form == "raw" else GradientAscent._momentum_term(self, problem, gradient)

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


FORWARD = 0.75
"""Weight of the gradient in a move; the rest repeats the previous move (alpha of the paper)."""
RISING = 0.75
"""Minimum share of steps that raise the loss between two checkpoints (rho of the paper)."""
_FIRST_INTERVAL, _INTERVAL_DECREASE, _MIN_INTERVAL = 0.22, 0.03, 0.06
"""Intervals between checkpoints, as shares of all steps: the first, the decrease of each, and the minimum."""


@dataclass(frozen=True, slots=True)
class APGD(Attack):
    """theta <- project(theta + rate * step * sign(gradient)), with a rate that is halved adaptively.

    Raises RangeError for fewer than 1 step, or a rate that is not positive.
    """

    steps: int = 10
    """Number of gradients."""
    early_stop: bool = False
    """End at the first iterate that fails the network under `moved` labels (one more render a step)."""
    rate: float = 1.0
    """Length of the first steps, in steps alpha."""

    def __post_init__(self) -> None:
        check_counts(steps=self.steps)
        check_rate(self.rate)

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        active = list(start.active)

        def project(theta: Tensor) -> Tensor:
            projected = problem.project(theta)
            active.extend(projected.active)
            return projected.theta

        theta = previous = best = start.theta
        loss, gradient = problem.loss_and_grad(theta)
        best_loss, best_gradient = loss, gradient
        thetas, losses = [theta], [loss]
        rate, rises, checkpoint, halved, checkpoint_loss = self.rate, 0, 0, False, loss
        checkpoints = _checkpoints(self.steps)
        for k in range(1, self.steps):
            ahead = project(theta + rate * problem.step * torch.sign(gradient))
            if k > 1:  # there is a previous move
                ahead = project(theta + FORWARD * (ahead - theta) + (1 - FORWARD) * (theta - previous))
            previous, theta = theta, ahead
            new_loss, gradient = problem.loss_and_grad(theta)
            rises += new_loss > loss
            loss = new_loss
            thetas.append(theta)
            losses.append(loss)
            if self.early_stop and problem.score(theta).success:
                break
            if loss > best_loss:
                best, best_loss, best_gradient = theta, loss, gradient
            if k in checkpoints:
                stuck = not halved and best_loss <= checkpoint_loss
                halved = stuck or rises < RISING * (k - checkpoint)
                if halved:
                    rate /= 2
                    previous = theta = best
                    loss, gradient = best_loss, best_gradient
                rises, checkpoint, checkpoint_loss = 0, k, best_loss
        else:  # the last gradient gives one more proposal, as in the other gradient methods
            thetas.append(project(theta + rate * problem.step * torch.sign(gradient)))
        return Proposals(tuple(thetas), (*losses, None), len(losses), tuple(active))


def _checkpoints(steps: int) -> frozenset[int]:
    """Steps after which the rate may be halved."""
    shares = [0.0, _FIRST_INTERVAL]
    while shares[-1] < 1:
        shares.append(shares[-1] + max(shares[-1] - shares[-2] - _INTERVAL_DECREASE, _MIN_INTERVAL))
    return frozenset(math.ceil(share * steps) for share in shares[1:])
