"""The same attack again from other starts."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score, check_counts

_PART = 0.25
"""Share of the box in which further starts lie. The steps then still lead most of the way; far out, a start would
be a random sample that the gradient mends a little."""


@dataclass(frozen=True, slots=True)
class Restarted(Attack):
    """`inner` from theta0, then from `count` feasible places near it, one after the other; what all of them
    propose is proposed.

    steps: starts are uniform in a quarter of the box that so many steps of si-FGSM around theta0 reach; None: a
    quarter of the bounds. early_stop: no further start after a run in which something failed the detector under
    `moved` labels. RangeError for fewer than 1 start or step.
    """

    inner: Attack
    count: int
    steps: int | None = 10
    early_stop: bool = False

    def __post_init__(self) -> None:
        check_counts(restarts=self.count, steps=self.steps)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return self.inner._rank(problem, theta, score)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        lower, upper = problem.box(theta0, self.steps)
        runs = [self.inner._propose(problem, theta0, generator)]
        while len(runs) <= self.count and not (self.early_stop and self._failed(problem, runs[-1])):
            place = torch.rand(len(theta0), generator=generator, dtype=torch.float64).to(theta0)
            start = theta0 + _PART * (lower + place * (upper - lower) - theta0)
            runs.append(self.inner._propose(problem, problem.project(start).theta, generator))
        return Proposals.joined(runs)

    @staticmethod
    def _failed(problem: Problem, run: Proposals) -> bool:
        """Whether anything of a run fails the detector."""
        return any(problem.score(problem.project(theta).theta).success for theta in run.thetas)
