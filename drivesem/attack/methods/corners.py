"""A baseline of searches on margins: corners of the bounds, where much of what fails a detector stands."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.linalg import hadamard
from torch import Tensor

from drivesem.attack.methods.margin_search import FINAL_PASSES, MarginSearch, OfMargins


@dataclass(frozen=True, slots=True)
class Corners(OfMargins):
    """Sees objects at corners of the bounds, each in another draw, and puts the worst corner of each together.

    Proposed is the best of these and of the best corner, in draws of their own. What is not feasible is projected,
    as everything is.
    """

    def _found(self, search: MarginSearch) -> Tensor:
        places = corners(search.at.owner, search.left - FINAL_PASSES, search.generator).to(search.at.start)
        return search.best(search.candidates(places))


def corners(owner: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Corners (count, K) of the unit box: rows of a Hadamard matrix, the first of which has all the scene's
    coordinates at their upper end.

    owner (K,): the object of each coordinate, -1 for the scene. Over all rows any two coordinates of one owner
    stand at each of their four ends equally often; of `count` rows, drawn at random, nearly so.
    """
    owners = owner.unique().tolist()
    most = max(int((owner == one).sum()) for one in owners)
    size = 1 << max(count - 1, most).bit_length()
    matrix = torch.from_numpy(hadamard(size) > 0)
    ends = torch.empty(size, len(owner), dtype=torch.bool)
    for one in owners:
        own = (owner == one).cpu().nonzero()[:, 0]
        columns = 1 + torch.randperm(size - 1, generator=generator)[: len(own)]  # the first is constant
        turned = torch.randint(2, (len(own),), generator=generator).bool() & (one >= 0)
        ends[:, own] = matrix[:, columns] ^ turned
    rows = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(size - 1, generator=generator)])
    return ends[rows[:count]].to(owner.device)
