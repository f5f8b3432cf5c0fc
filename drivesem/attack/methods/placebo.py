"""Attacks that do not search: a random edit as large as a counterexample (placebo), and a fixed theta."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score
from scene_ir.errors import ShapeError

if TYPE_CHECKING:
    from drivesem.attack.theta import ProjectedTheta

_MAX_DRAWS = 8
"""Maximum number of random edits; if all are infeasible, nothing is changed."""


@dataclass(frozen=True, slots=True)
class Placebo(Attack):
    """A control: the values of another change, shuffled within each group and with random signs. The edit is as
    large in every norm of every group, and does not depend on the detector.

    Signs that would leave the bounds are flipped. The edit is projected, which may shrink it; if its render is not
    feasible, another is drawn. Raises ShapeError where `like` belongs to another scene.
    """

    like: tuple[float, ...] = ()
    """theta (D,) of the other change."""

    needs_gradient: ClassVar[bool] = False

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        if len(self.like) != len(theta0):
            raise ShapeError("like", f"({len(theta0)},)", (len(self.like),))
        like = torch.tensor(self.like, dtype=torch.float64).to(theta0) - theta0
        edit = self._random_edit(problem, theta0, like, generator)
        draws = 1
        while draws < _MAX_DRAWS and problem.score(edit.theta).violations:
            edit = self._random_edit(problem, theta0, like, generator)
            draws += 1
        return Proposals(thetas=(edit.theta,), losses=(None,), queries=draws, active_constraints=edit.active)

    def _random_edit(
        self, problem: Problem, theta0: Tensor, like: Tensor, generator: torch.Generator
    ) -> ProjectedTheta:
        change = like.clone()
        for group in problem.groups:
            block = change[group.where]
            change[group.where] = block[torch.randperm(len(block), generator=generator).to(block.device)]
        signs = 2 * torch.randint(2, change.shape, generator=generator).to(change) - 1
        change = signs * change.abs()
        outside = (theta0 + change < problem.lower) | (theta0 + change > problem.upper)
        return problem.project(theta0 + torch.where(outside, -change, change))

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        # The edit wins over theta0 regardless of its effect: choosing the better of the two would be an attack.
        return (float(bool((theta != 0).any())),)


@dataclass(frozen=True, slots=True)
class FixedTheta(Attack):
    """Proposes a given theta, which wins wherever it is feasible."""

    theta: Tensor
    """(D,)."""

    needs_gradient: ClassVar[bool] = False

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        return Proposals((self.theta,), (None,), 0)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return (float(torch.equal(theta, self.theta)),)
