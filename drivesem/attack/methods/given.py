"""A theta that is known, to be projected and judged as any proposal is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score


@dataclass(frozen=True, slots=True)
class Given(Attack):
    """theta: (D,)."""

    theta: Tensor

    needs_gradient: ClassVar[bool] = False

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        return Proposals((self.theta,), (None,), 0)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        # It stands, unless it cannot be.
        return (float(torch.equal(theta, self.theta)),)
