"""A placebo: one random edit as large as a counterexample. What it breaks, any change of that size would."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score
from scene_ir.errors import ShapeError

if TYPE_CHECKING:
    from drivesem.attack.theta import ProjectedTheta

_DRAWS = 8
"""At most; after that nothing is changed."""


@dataclass(frozen=True, slots=True)
class Placebo(Attack):
    """Another change's values, shuffled within each group and with random signs: as large as that change in every
    norm of every group, in a random direction. It is drawn once, and nothing is chosen by what the detector finds.

    like: the other change's theta (D,). A sign that would lead out of the bounds is turned round. Where the edit
    is not feasible it is projected, and may be smaller then; where its render shows that it is not, another is
    drawn. ShapeError where `like` is not of this scene.
    """

    like: tuple[float, ...] = ()

    needs_gradient: ClassVar[bool] = False

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        if len(self.like) != len(theta0):
            raise ShapeError("like", f"({len(theta0)},)", (len(self.like),))
        like = torch.tensor(self.like, dtype=torch.float64).to(theta0) - theta0
        edit = self._edit(problem, theta0, like, generator)
        draws = 1
        while draws < _DRAWS and problem.score(edit.theta).violations:
            edit = self._edit(problem, theta0, like, generator)
            draws += 1
        return Proposals(thetas=(edit.theta,), losses=(None,), queries=draws, active_constraints=edit.active)

    def _edit(self, problem: Problem, theta0: Tensor, like: Tensor, generator: torch.Generator) -> ProjectedTheta:
        change = like.clone()
        for group in problem.groups:
            block = change[group.where]
            change[group.where] = block[torch.randperm(len(block), generator=generator).to(block.device)]
        signs = 2 * torch.randint(2, change.shape, generator=generator).to(change) - 1
        change = signs * change.abs()
        outside = (theta0 + change < problem.lower) | (theta0 + change > problem.upper)
        return problem.project(theta0 + torch.where(outside, -change, change))

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        # The edit stands whatever it does: the better of it and none would be an attack.
        return (float(bool((theta != 0).any())),)


@dataclass(frozen=True, slots=True)
class FixedTheta(Attack):
    """theta: (D,)."""

    theta: Tensor

    needs_gradient: ClassVar[bool] = False

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        return Proposals((self.theta,), (None,), 0)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        # It stands, unless it cannot be.
        return (float(torch.equal(theta, self.theta)),)
