"""si-FGSM: the iterated fast gradient sign method on semantic parameters (the paper, its equation for si-FGSM)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from drivesem.attack.methods.ascent import Ascent
from drivesem.attack.methods.base import Problem


@dataclass(frozen=True, slots=True)
class SiFGSM(Ascent):
    """theta <- project(theta + rate * step * sign(gradient)), `steps` times; step: the paper's alpha."""

    def _move(self, problem: Problem, gradient: Tensor) -> Tensor:
        return problem.step * torch.sign(gradient)
