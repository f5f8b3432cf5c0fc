"""CMA-ES: a search without gradient whose samples follow what was found (Hansen's library `cma`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.methods.base import Problem, Proposals
from drivesem.attack.methods.trials import Search, Trials

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
        trials = Trials(problem, self.queries, self.early_stop)
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
