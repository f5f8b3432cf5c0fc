"""What searches without a gradient have in common: they try thetas one by one and see how each is judged.

One by one, because several at once are not faster on a CPU: renders take the same time, and the detector's working
set leaves the cache (measured: 97 ms for an image by itself, 123 ms in a batch of eight).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score, check_counts


@dataclass(frozen=True, slots=True)
class Search(Attack):
    """An attack that projects and judges `queries` thetas; the detector's gradient is not asked for.

    steps: thetas lie within so many steps of theta0, or anywhere within the bounds where it is None. early_stop:
    end at the first that fails the detector under `moved` labels. RangeError for fewer than 1 query or step.
    """

    queries: int = 64
    steps: int | None = None
    early_stop: bool = False

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(queries=self.queries, steps=self.steps)


@dataclass(slots=True)
class QueryBudget:
    """At most `queries` thetas, projected and judged. early_stop: end at the first that fails the detector."""

    problem: Problem
    queries: int
    early_stop: bool = False
    _thetas: list[Tensor] = field(default_factory=list)
    _losses: list[float | None] = field(default_factory=list)
    _active: list[str] = field(default_factory=list)
    _failed: bool = False

    @property
    def left(self) -> int:
        """How many thetas may still be tried."""
        return 0 if self.early_stop and self._failed else self.queries - len(self._thetas)

    def judge(self, theta: Tensor) -> Score:
        """What comes of the feasible theta (D,) nearest to this one. Costs a query."""
        feasible = self.problem.project(theta)
        score = self.problem.score(feasible.theta)
        self._thetas.append(feasible.theta)
        self._losses.append(score.loss)
        self._active.extend(feasible.active)
        self._failed |= score.success
        return score

    def proposals(self) -> Proposals:
        """All that was tried, in order."""
        return Proposals(
            thetas=tuple(self._thetas),
            losses=tuple(self._losses),
            queries=len(self._thetas),
            active_constraints=tuple(self._active),
        )


Kind = Literal["random", "halton"]
"""random: independent and uniform; halton: a low-discrepancy sequence, scrambled (Owen 2017, as in
scipy.stats.qmc)."""


@dataclass(frozen=True, slots=True)
class Sampling(Search):
    """Thetas that do not depend on what was found before."""

    kind: Kind = "random"

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        lower, upper = problem.box(theta0, self.steps)
        trials = QueryBudget(problem, self.queries, self.early_stop)
        for place in self._places(len(theta0), generator).to(theta0):
            if not trials.left:
                break
            trials.judge(lower + place * (upper - lower))
        return trials.proposals()

    def _places(self, dimensions: int, generator: torch.Generator) -> Tensor:
        """Where in the unit box to look: (queries, dimensions) float64."""
        if self.kind == "random":
            return torch.rand(self.queries, dimensions, generator=generator, dtype=torch.float64)
        from scipy.stats import qmc  # on use: it takes a third of a second to load

        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        return torch.from_numpy(qmc.Halton(dimensions, scramble=True, rng=rng).random(self.queries))


_SIGMA = 0.25
"""First standard deviation, as a share of the box: the library's advice is a quarter of a search interval."""
_GENERATIONS = 4
"""At least so many generations, smaller ones where queries are few: one alone is a random sample."""
_FEWEST = 4
"""Smallest population in which the better half still says something (Hansen 2016, arXiv:1604.00772, its table 1
for 1 dimension)."""
_FULL_COVARIANCE = 64
"""Dimensions up to which the whole covariance is learned: it has D (D + 1) / 2 numbers, which some hundred queries
tell nothing about. Above, its diagonal (Ros and Hansen 2008)."""
_FEWEST_DIMENSIONS = 2
"""The library refuses to scale a single coordinate; a second one, which nothing follows, stands beside it."""


@dataclass(frozen=True, slots=True)
class CMAES(Search):
    """Starts at theta0. The library sees the sample, and the loss of its projection."""

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        lower, upper = problem.box(theta0, self.steps)
        size = upper - lower
        start = ((theta0 - lower) / size.clamp_min(torch.finfo(theta0.dtype).tiny)).detach().cpu().double().numpy()
        coordinates = len(start)
        start = np.pad(start, (0, max(_FEWEST_DIMENSIONS - coordinates, 0)), constant_values=0.5)
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        trials = QueryBudget(problem, self.queries, self.early_stop)
        strategy = self._strategy(start, rng)
        while trials.left:
            if strategy.stop():  # it has converged; what is left looks elsewhere
                strategy = self._strategy(rng.random(len(start)), rng)
            places = strategy.ask()
            losses: list[float] = []
            for place in places:
                if trials.left:
                    theta = lower + torch.from_numpy(np.asarray(place)[:coordinates]).to(theta0) * size
                    losses.append(trials.judge(theta).loss)
            if len(losses) == len(places):
                strategy.tell(places, [-loss for loss in losses])
        return trials.proposals()

    def _strategy(self, start: np.ndarray, rng: np.random.Generator) -> Any:
        import cma  # it loads matplotlib's pyplot: two seconds

        dimensions = len(start)
        usual = 4 + int(3 * math.log(dimensions))
        options = {
            "bounds": [0.0, 1.0],
            "popsize": min(usual, max(self.queries // _GENERATIONS, _FEWEST)),
            "CMA_diagonal": dimensions > _FULL_COVARIANCE,
            # A generator of our own instead of numpy's global one, which then stays as it is.
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": math.nan,
            "verbose": -9,
            "verb_log": 0,
        }
        return cma.CMAEvolutionStrategy(start, _SIGMA, options)
