"""Theta as a place in the unit box, of few coordinates: what searches and samples of the whole bounds move in."""

from __future__ import annotations

import torch
from torch import Tensor

from drivesem.attack.methods.base import Problem


class UnitBox:
    """Places u (K,) in the unit box as thetas (D,): the bounds of each coordinate, or, in groups with modes, how
    much of each mode. owner: (K,) the object that each belongs to, -1 for the scene; holder: (D,) the same of
    theta's coordinates; wide: (K,) bool, where a gradient at a point says little; start: (K,) theta0's place.
    """

    def __init__(self, problem: Problem, theta0: Tensor) -> None:
        self._problem = problem
        blocks: list[Tensor] = []
        owners: list[Tensor] = []
        holders: list[Tensor] = []
        wide: list[Tensor] = []
        start: list[Tensor] = []
        span = problem.upper - problem.lower
        for group in problem.groups:
            lower, width = problem.lower[group.where], span[group.where]
            size, count = len(width), max(group.owners, 1)
            if group.modes is None:
                block = torch.diag(width)
                at = (theta0[group.where] - lower) / width.clamp_min(1e-12)
            else:
                half = 0.5 * width.reshape(count, -1)
                block = torch.block_diag(*(2 * group.modes.to(half) * row for row in half))
                at = torch.full((len(block),), 0.5).to(block)
            first = torch.zeros(len(block), len(theta0)).to(block)
            first[:, group.where] = block
            blocks.append(first)
            start.append(at)
            own = (torch.arange(count) if group.owners else torch.tensor([-1])).to(block.device)
            owners.append(own.repeat_interleave(len(block) // count))
            holders.append(own.repeat_interleave(size // count))
            wide.append(torch.full((len(block),), not group.smooth, device=block.device))
        self._matrix = torch.cat(blocks)
        self.start = torch.cat(start)
        self._offset = theta0 - self.start @ self._matrix
        self.owner, self.holder, self.wide = torch.cat(owners), torch.cat(holders), torch.cat(wide)

    def theta(self, place: Tensor) -> Tensor:
        """theta (D,) at u (K,), within the bounds; feasible or not."""
        theta = self._offset + place @ self._matrix
        return torch.minimum(torch.maximum(theta, self._problem.lower), self._problem.upper)

    def slope(self, gradient: Tensor) -> Tensor:
        """Of a gradient (D,) to theta, that to u (K,)."""
        return self._matrix @ gradient
