"""A placebo: one random edit as large as a counterexample. What it breaks, any change of that size would."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from drivesem.attacks.base import Attack, Problem, Proposals, Score
from scene_ir.errors import ShapeError


@dataclass(frozen=True, slots=True)
class Placebo(Attack):
    """Another change's values, shuffled within each group and with random signs: as large as that change in every
    norm of every group, in a random direction. It is proposed once, and nothing is chosen.

    like: the other change's theta (D,). A sign that would lead out of the bounds is turned round. Where the edit
    is not feasible it is projected, and may be smaller then. ShapeError where `like` is not of this scene.
    """

    like: tuple[float, ...] = ()

    needs_gradient: ClassVar[bool] = False

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        if len(self.like) != len(theta0):
            raise ShapeError("like", f"({len(theta0)},)", (len(self.like),))
        change = torch.tensor(self.like, dtype=torch.float64).to(theta0) - theta0
        for group in problem.groups:
            block = change[group.where]
            change[group.where] = block[torch.randperm(len(block), generator=generator).to(block.device)]
        signs = 2 * torch.randint(2, change.shape, generator=generator).to(change) - 1
        change = signs * change.abs()
        outside = (theta0 + change < problem.lower) | (theta0 + change > problem.upper)
        edit = problem.project(theta0 + torch.where(outside, -change, change))
        return Proposals(thetas=(edit.theta,), losses=(None,), queries=1, active_constraints=edit.active)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        # The edit stands whatever it does: the better of it and none would be an attack.
        return (float(bool((theta != 0).any())),)
