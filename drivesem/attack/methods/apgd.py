"""Auto-PGD (Croce and Hein 2020, arXiv:2003.01690) on semantic parameters: sign steps with adaptive length.

A detector's loss is rough at the length of the paper's steps: a gradient does not hold along one of them, and the
iterates of si-FGSM wander. Here steps start as long as the paper's, and are halved where the loss has stopped
rising; the search then continues from the best point so far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, check_counts, check_rate

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

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
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
