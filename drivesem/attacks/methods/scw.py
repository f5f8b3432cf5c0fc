"""sCW: a search for the smallest change that fails, after Carlini and Wagner (the paper's equation for sCW)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.methods.base import Attack, Problem, Proposals, QueryLog, Score, check_counts, check_rate
from scene_ir.errors import RangeError

_FIRST_C = 10.0
"""First c; at 1 a step that raises the loss is not worth its size, here it is."""
_FACTOR = 10.0
"""Factor on c until it is bracketed, as in Carlini and Wagner's search."""
_MAX_C = 1e12
"""Limit on c and 1 / c, far from where Adam's moments overflow."""
_INSIDE = 0.9
"""Maximum distance of a start from the centre, in half widths: at a bound, where weather starts, tanh is flat."""


@dataclass(frozen=True, slots=True)
class SCW(Attack):
    """Minimises size(theta) + c * f(theta) by Adam for several c, and prefers the smallest theta that fails.

    theta = centre + half width * tanh(.) lies within its bounds; its projection is rendered, and the gradient is
    taken there. size is `Problem.size`, the norm in sign steps.

    f is a hinge on failure: 0 where theta loses an object or makes a phantom under `moved` labels, otherwise how
    far the loss lies below an unreachable target, so that only its slope matters. The paper's hinge, on class
    scores, is 0 exactly where a classifier is wrong. No detector loss has such a value, so a hinge on the loss would
    give up too early on one frame and too late on the next. f is in sign steps too: 1 is what the gradient at the
    start promises for one sign step of everything, so c weighs steps of change against a step's worth of loss
    for any detector.

    c is searched on a logarithmic scale: down after a failure, up after none. Raises RangeError for settings out of
    range.
    """

    queries: int = 64
    """Maximum number of iterates in all."""
    steps: int = 10
    """Adam steps for each c."""
    norm: Literal[1, 2] = 2
    """Order of the norm: 2 as in the paper's settings, or 1 as in its equation."""
    rate: float = 1.0
    """Adam's learning rate, in steps alpha."""
    early_stop: bool = False
    """End at the first failure."""
    constant: float | None = None
    """A fixed c, as in the paper for classifiers: Adam runs once, size is the norm of theta in its own units, and f
    is the negated loss, which must be 0 where the classifier is wrong. None: search c.
    """

    def __post_init__(self) -> None:
        check_counts(queries=self.queries, steps=self.steps)
        if self.constant is not None:
            check_rate(self.constant, "constant")
        if self.norm not in (1, 2):
            raise RangeError("norm", "1 or 2", self.norm)
        check_rate(self.rate)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return (1.0, -float(self.size(problem, theta))) if score.success else (0.0, score.loss)

    def size(self, problem: Problem, theta: Tensor) -> Tensor:
        """The norm () of theta (D,) to minimise; differentiable except at 0."""
        if self.constant is None:
            return problem.size(theta, self.norm)
        return torch.linalg.vector_norm(theta, self.norm)

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        search = _AdamSearch(self, problem, theta0, QueryLog(self.queries, self.early_stop))
        if self.constant is not None:
            search.minimise(self.constant)
            return search.log.proposals()
        c, low, high = _FIRST_C, 0.0, math.inf
        while search.log.left:
            if search.minimise(c):
                high = c
            else:
                low = c
            if low == 0:
                c = high / _FACTOR
            elif high == math.inf:
                c = low * _FACTOR
            else:
                c = math.sqrt(low * high)
            if not 1 / _MAX_C < c < _MAX_C:
                break  # nothing fails at any price, or everything does for none
        return search.log.proposals()


@dataclass(slots=True)
class _AdamSearch:
    """Adam's variable, its mapping to theta, and the iterates for all values of c."""

    attack: SCW
    problem: Problem
    theta0: Tensor
    log: QueryLog
    _promise: float | None = None

    def minimise(self, c: float) -> bool:
        """Run Adam from the start at this c. Returns whether any iterate failed."""
        change = torch.zeros_like(self.theta0).requires_grad_(True)
        optimiser = torch.optim.Adam([change], lr=self.attack.rate)
        failed = False
        for _ in range(min(self.attack.steps, self.log.left)):
            theta = self._theta(change)
            ascent = self._evaluate(theta.detach())
            failed |= ascent is None
            if ascent is None and self.attack.early_stop:
                break
            objective = self.attack.size(self.problem, theta)
            if ascent is not None:
                objective = objective - c * (ascent * theta).sum()
            (change.grad,) = torch.autograd.grad(objective, change)
            optimiser.step()
        return failed

    def _theta(self, change: Tensor) -> Tensor:
        """theta (D,) within its bounds, from Adam's variable: 1 is about a step alpha from the start."""
        lower, upper = self.problem.lower, self.problem.upper
        centre, half = (lower + upper) / 2, (upper - lower) / 2
        wide = half > 0
        width = torch.where(wide, half, 1)
        start = ((self.theta0 - centre) / width).clamp(-_INSIDE, _INSIDE)
        moved = torch.tanh(torch.atanh(start) + self.problem.step / width * change)
        return torch.where(wide & (self.problem.step > 0), centre + half * moved, self.theta0)

    def _evaluate(self, theta: Tensor) -> Tensor | None:
        """The gradient (D,) of -f at the projection of theta (D,); None where the network fails there."""
        projected = self.problem.project(theta)
        score = self.problem.score(projected.theta)
        if score.success:
            self.log.add(projected, score.loss, failed=True)
            return None
        loss, gradient = self.problem.loss_and_grad(projected.theta)
        self.log.add(projected, loss, failed=False)
        if self.attack.constant is not None:
            return gradient
        if self._promise is None:
            self._promise = float((gradient * self.problem.step).abs().sum()) or 1.0
        return gradient / self._promise
