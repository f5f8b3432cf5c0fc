"""An attack that looks around first: the paper's steps lead a short way, and detectors also fail farther out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score, check_counts
from drivesem.attack.methods.sampling import Sampling


@dataclass(frozen=True, slots=True)
class Scouted(Attack):
    """`inner`, begun at the best of `count` samples of a scrambled Halton sequence and theta0.

    The best is the one that ranks highest, as the attack's result does. steps: how far samples lie, as of
    `Sampling`; None: anywhere within the bounds. early_stop: end at the first sample that fails the detector.
    A sample costs a query. RangeError for fewer than 1 sample or step.
    """

    inner: Attack
    count: int
    steps: int | None = None
    early_stop: bool = False

    def __post_init__(self) -> None:
        check_counts(scouts=self.count, steps=self.steps)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return self.inner._rank(problem, theta, score)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        seen = self._run(Sampling(self.count, self.steps, self.early_stop, "halton"), problem, theta0, generator)
        starts = [problem.project(theta0).theta, *seen.thetas]
        scores = [problem.score(start) for start in starts]
        ranks = [self._order(problem, start, score) for start, score in zip(starts, scores, strict=True)]
        best = max(range(len(starts)), key=lambda i: (*ranks[i], -i))
        if self.early_stop and scores[best].success:
            return seen
        climb = self._run(self.inner, problem, starts[best], generator)
        return Proposals.joined((seen, climb))

    @staticmethod
    def _run(attack: Attack, problem: Problem, start: Tensor, generator: torch.Generator) -> Proposals:
        return attack._propose(problem, start, generator)
