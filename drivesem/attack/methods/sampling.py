"""Samples of a box in theta's space: uniform, or from a scrambled Halton or Sobol sequence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.methods.base import Problem, Proposals
from drivesem.attack.methods.trials import Search, Trials

Kind = Literal["random", "halton", "sobol"]
"""random: independent and uniform; halton, sobol: low-discrepancy sequences, scrambled (Owen 2017, Matousek 1998,
as scipy.stats.qmc has them)."""


@dataclass(frozen=True, slots=True)
class Sampling(Search):
    """Thetas that do not depend on what was found before."""

    kind: Kind = "random"

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        lower, upper = problem.box(theta0, self.steps)
        trials = Trials(problem, self.queries, self.early_stop)
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
        if self.kind == "halton":
            return torch.from_numpy(qmc.Halton(dimensions, scramble=True, rng=rng).random(self.queries))
        # A Sobol sequence is balanced in powers of two; fewer are taken from its beginning.
        points = qmc.Sobol(dimensions, scramble=True, rng=rng).random_base2(math.ceil(math.log2(self.queries)))
        return torch.from_numpy(points[: self.queries])
