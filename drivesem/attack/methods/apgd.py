"""Auto-PGD (Croce and Hein 2020, arXiv:2003.01690) on semantic parameters: sign steps that halve by themselves.

A detector's loss is rough at the length of the paper's steps: along one of them it is no longer what the gradient
said, and the iterates of si-FGSM wander. Here a step begins as long as the paper's, and is halved where the loss
has not kept rising; the search then goes on from the best point so far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, check_counts, check_rate

FORWARD = 0.75
"""Of a move, what the gradient says; the rest goes on as the move before (alpha of the paper)."""
RISING = 0.75
"""Share of steps that must raise the loss between two checkpoints (rho of the paper)."""
_FIRST, _SHORTER, _SHORTEST = 0.22, 0.03, 0.06
"""Checkpoints, as shares of all steps: the first, by how much each interval is shorter, and the least of them."""


@dataclass(frozen=True, slots=True)
class APGD(Attack):
    """theta <- project(theta + rate * step * sign(gradient)), `steps` gradients; rate halves by itself.

    rate: of the first steps, in steps alpha. early_stop: end at the first iterate that fails the detector under
    `moved` labels (one more render a step). RangeError for fewer than 1 step, or a rate that is not positive.
    """

    steps: int = 10
    early_stop: bool = False
    rate: float = 1.0

    def __post_init__(self) -> None:
        check_counts(steps=self.steps)
        check_rate(self.rate)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        start = problem.project(theta0.detach())
        active = list(start.active)

        def projected(theta: Tensor) -> Tensor:
            found = problem.project(theta)
            active.extend(found.active)
            return found.theta

        theta = before = best = start.theta
        loss, gradient = problem.loss_and_grad(theta)
        best_loss, best_gradient = loss, gradient
        thetas, losses = [theta], [loss]
        rate, risen, last, halved, best_then = self.rate, 0, 0, False, loss
        checkpoints = _checkpoints(self.steps)
        for k in range(1, self.steps):
            ahead = projected(theta + rate * problem.step * torch.sign(gradient))
            if k > 1:  # there is a move before
                ahead = projected(theta + FORWARD * (ahead - theta) + (1 - FORWARD) * (theta - before))
            before, theta = theta, ahead
            found, gradient = problem.loss_and_grad(theta)
            risen += found > loss
            loss = found
            thetas.append(theta)
            losses.append(loss)
            if self.early_stop and problem.score(theta).success:
                break
            if loss > best_loss:
                best, best_loss, best_gradient = theta, loss, gradient
            if k in checkpoints:
                stuck = not halved and best_loss <= best_then
                halved = stuck or risen < RISING * (k - last)
                if halved:
                    rate /= 2
                    before = theta = best
                    loss, gradient = best_loss, best_gradient
                risen, last, best_then = 0, k, best_loss
        else:  # where the last gradient points is one more proposal, as of every attack that climbs
            thetas.append(projected(theta + rate * problem.step * torch.sign(gradient)))
        return Proposals(
            thetas=tuple(thetas),
            losses=(*losses, None),
            queries=len(losses),
            active_constraints=tuple(active),
        )


def _checkpoints(steps: int) -> frozenset[int]:
    """Steps after which the rate may be halved."""
    shares = [0.0, _FIRST]
    while shares[-1] < 1:
        shares.append(shares[-1] + max(shares[-1] - shares[-2] - _SHORTER, _SHORTEST))
    return frozenset(math.ceil(share * steps) for share in shares[1:])
