"""sCW: the smallest change that fails, after Carlini and Wagner (the paper, its equation for sCW)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score, check_counts, check_rate
from scene_ir.errors import RangeError

Norm = Literal[1, 2]
_FIRST_C = 10.0
"""At 1, a step that raises the loss is not worth its size; the search begins where it surely is."""
_FACTOR = 10.0
"""c goes up or down by it until it is bracketed, as in Carlini and Wagner's search."""
_MOST_C = 1e12
"""Far from where Adam's moments overflow."""
_INSIDE = 0.9
"""A start at a bound is moved inwards, to so many half widths from the centre: at a bound tanh has no slope.
Weather starts there."""


@dataclass(frozen=True, slots=True)
class SCW(Attack):
    """Minimises size(theta) + c * f(theta) by Adam, for several c, and prefers the smallest theta that fails.

    theta = centre + half width * tanh(.) lies within its bounds; what is rendered is its projection, and the
    gradient there is used. size is `Problem.size`, the norm in sign steps (p = 2, or 1 as in the paper's
    construction; 2 is what its settings say).

    f is a hinge on failure as it is judged: 0 where theta loses an object or makes a phantom under `moved` labels,
    else how far the loss lies below a target that is out of reach, so that only its slope counts. The paper's
    hinge, on class scores, is 0 exactly where a classifier is wrong; no loss of a detector has a value of which
    that is true, so a hinge on the loss, such as the benign one and a margin, would give up too early on one frame
    and too late on the next. f is in sign steps as well: 1 is what the gradient at the start promises for one sign
    step of everything. So c says how many steps of change a step's worth of loss may cost, whatever the detector.

    constant: None, or a fixed c, as the paper has it for classifiers: Adam runs once, size is the norm of theta in
    its own units, and f is the negated loss itself, which is to be a hinge, 0 where the classifier is wrong.

    c is searched on a logarithmic scale: down from where something failed, up from where nothing did. steps: of
    Adam for each c; queries: in all, one for each iterate, whether its gradient was taken or it failed already.
    rate: of Adam, in steps alpha. early_stop: end at the first failure. RangeError for what cannot be.
    """

    queries: int = 64
    steps: int = 10
    norm: Norm = 2
    rate: float = 1.0
    early_stop: bool = False
    constant: float | None = None

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
        """What is kept small: a norm () of theta (D,), differentiable but for the p-norm's corner at 0."""
        if self.constant is None:
            return problem.size(theta, self.norm)
        return torch.linalg.vector_norm(theta, self.norm)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        search = _Search(self, problem, theta0)
        if self.constant is not None:
            search.minimise(self.constant)
            return search.proposals()
        c, low, high = _FIRST_C, 0.0, math.inf
        while search.left:
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
            if not 1 / _MOST_C < c < _MOST_C:
                break  # nothing fails at any price, or all does for none
        return search.proposals()


@dataclass(slots=True)
class _Search:
    """What all values of c share: the way from Adam's variable to theta, and what was tried."""

    attack: SCW
    problem: Problem
    theta0: Tensor
    thetas: list[Tensor] = field(default_factory=list)
    losses: list[float | None] = field(default_factory=list)
    active: list[str] = field(default_factory=list)
    _stopped: bool = False
    _promise: float | None = None

    @property
    def left(self) -> int:
        """How many iterates there may still be."""
        return 0 if self._stopped else self.attack.queries - len(self.thetas)

    def proposals(self) -> Proposals:
        """All that was tried, in order."""
        return Proposals(tuple(self.thetas), tuple(self.losses), len(self.thetas), tuple(self.active))

    def minimise(self, c: float) -> bool:
        """Adam from the start at this c; whether any iterate failed."""
        change = torch.zeros_like(self.theta0).requires_grad_(True)
        optimiser = torch.optim.Adam([change], lr=self.attack.rate)
        failed = False
        for _ in range(min(self.attack.steps, self.left)):
            theta = self._theta(change)
            uphill = self._try(theta.detach())
            failed |= uphill is None
            if uphill is None and self.attack.early_stop:
                self._stopped = True
                break
            objective = self.attack.size(self.problem, theta)
            if uphill is not None:
                objective = objective - c * (uphill * theta).sum()
            (change.grad,) = torch.autograd.grad(objective, change)
            optimiser.step()
        return failed

    def _theta(self, change: Tensor) -> Tensor:
        """theta (D,) within its bounds, from what Adam moves: about a step alpha from the start for each 1."""
        lower, upper = self.problem.lower, self.problem.upper
        centre, half = (lower + upper) / 2, (upper - lower) / 2
        wide = half > 0
        width = torch.where(wide, half, 1)
        start = ((self.theta0 - centre) / width).clamp(-_INSIDE, _INSIDE)
        moved = torch.tanh(torch.atanh(start) + self.problem.step / width * change)
        return torch.where(wide & (self.problem.step > 0), centre + half * moved, self.theta0)

    def _try(self, theta: Tensor) -> Tensor | None:
        """The gradient (D,) of -f at the projection of theta (D,), or None where that fails the detector."""
        feasible = self.problem.project(theta)
        score = self.problem.score(feasible.theta)
        self.thetas.append(feasible.theta)
        self.active.extend(feasible.active)
        if score.success:
            self.losses.append(score.loss)
            return None
        loss, gradient = self.problem.loss_and_grad(feasible.theta)
        self.losses.append(loss)
        if self.attack.constant is not None:
            return gradient
        if self._promise is None:
            self._promise = float((gradient * self.problem.step).abs().sum()) or 1.0
        return gradient / self._promise
