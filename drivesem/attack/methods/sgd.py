"""sGD: projected gradient steps on semantic parameters (the paper, its equation for sGD)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.methods.ascent import Ascent
from drivesem.attack.methods.base import Problem

Form = Literal["raw", "l2", "unit"]
"""raw: the gradient times the step alpha, as in the paper's equation; l2: its direction only, by group; unit:
the same, but no longer than the step alpha, as the paper's program has it for classifiers."""


@dataclass(frozen=True, slots=True)
class SGD(Ascent):
    """theta <- project(theta + rate * move), `steps` times.

    form raw: the move is step * gradient, so its length follows the loss's scale. Momentum adds up the gradients
    as they are (Polyak's heavy ball). form l2: the gradient of each group, in steps alpha, divided by its L2 norm
    and made as long as a sign step of that group (root mean square: one step), so that all groups go equally far
    and a rate of 1 goes as far as si-FGSM, but mostly where the loss is steep. form unit: the gradient of each
    group, in theta's own units, divided by its L2 norm, times step: of a thousand coordinates each moves a little.
    """

    form: Form = "l2"

    def _weighed(self, problem: Problem, gradient: Tensor) -> Tensor:
        return gradient if self.form == "raw" else Ascent._weighed(self, problem, gradient)

    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        if self.form == "raw":
            return problem.step * gradient
        unit = self.form == "unit"
        # In steps, theta = step * u, and so is the loss's gradient.
        move = torch.where(problem.step > 0, gradient, 0) if unit else problem.step * gradient
        for group in problem.groups:
            block = move[group.where]
            if not bool(block.any()):
                continue
            block = block / block.abs().max()  # first: squares of small gradients would leave float32
            length = 1.0 if unit else math.sqrt(len(block))
            move[group.where] = block / torch.linalg.vector_norm(block) * length
        return problem.step * move
