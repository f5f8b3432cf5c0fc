"""What searches on margins have in common: they see objects in draws (`Views`), and keep of each what did worst.

Objects are nearly independent, so that the worst place of each can be put together with the others'.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from scipy.linalg import hadamard
from torch import Tensor

from drivesem.attack.methods.base import Attack, MarginOracle, Problem, Proposals, check_counts
from scene_ir.errors import RangeError

LEAST_PASSES = 24
"""With fewer there is nothing left to try after the last comparison."""
FAR = 4.0
"""Margin above which an object counts as no harder to lose."""
SURE = -2.0
"""Margin from which an object is lost for sure, and the others matter more."""
_FINAL_DRAWS = 4
"""Draws in which the last candidates are compared."""
FINAL_PASSES = 3 * _FINAL_DRAWS
"""What comparing three candidates takes."""
_OTHERWISE = 4
"""Passes that the benign pictures and the judging of what is found take."""
_POOL = 8
"""Draws that the search goes round in."""
FIRST_HELD_OUT_SAMPLE = _POOL + _FINAL_DRAWS
"""The first draw that no search looks at."""


def margin_objective(margins: Tensor, judged: Tensor) -> float:
    """What a search lowers, of margins (N,) of objects of which judged (N,) count."""
    known = margins[judged.to(margins.device)].clamp(SURE, FAR)
    return float(torch.tanh(2 * known).sum() + 0.1 * known.sum())


@dataclass
class MarginSearchState:
    """A search of the unit box within a number of passes. limit: passes in all."""

    problem: Problem
    views: MarginOracle
    at: UnitBox
    generator: torch.Generator
    limit: int
    _active: list[str] = field(default_factory=list)
    _spent_before: int = field(init=False)
    _next: int = 0

    def __post_init__(self) -> None:
        self._spent_before = self.views.passes

    @classmethod
    def of(
        cls, problem: Problem, theta0: Tensor, generator: torch.Generator, passes: int
    ) -> MarginSearchState | None:
        """Within so many passes, the benign pictures and the final judgement included; None where there is nothing
        to lose. RangeError for a problem without views.
        """
        if problem.margin_oracle is None:
            raise RangeError("problem", "one with views of its objects", "none")
        if not bool(problem.margin_oracle.counted_objects.any()):
            return None
        return cls(problem, problem.margin_oracle, UnitBox(problem, theta0), generator, passes - _OTHERWISE)

    @property
    def spent(self) -> int:
        """Passes so far."""
        return self.views.passes - self._spent_before

    @property
    def left(self) -> int:
        """Passes that may still be taken."""
        return self.limit - self.spent

    def theta(self, place: Tensor) -> tuple[Tensor, tuple[str, ...]]:
        """The feasible theta (D,) nearest to that of u (K,), and what held it back on the way there and before."""
        feasible = self.problem.project(self.at.theta(place))
        self._active.extend(feasible.active)
        return feasible.theta, tuple(dict.fromkeys(self._active))

    def number(self) -> int:
        """Of the next draw."""
        self._next += 1
        return self._next % _POOL

    def margins(self, place: Tensor, number: int) -> Tensor:
        """(N,) of the objects at u (K,), in a draw."""
        return self.views.margins(self.theta(place)[0], number)

    def value(self, margins: Tensor) -> float:
        """What is to be low: a step a lost object, and beyond that the margins themselves."""
        return margin_objective(margins, self.views.counted_objects)

    def candidates(self, places: Tensor) -> list[Tensor]:
        """Of places (C, K), each seen in another draw: the best, and what the best of each object make together,
        in the scenes of the best and of the second best. Costs C passes.
        """
        seen = torch.stack([self.margins(place, self.number()) for place in places])
        values = [self.value(margins) for margins in seen]
        order = sorted(range(len(places)), key=values.__getitem__)
        return [places[order[0]], *(self._together(places, seen, scene) for scene in order[:2])]

    def best(self, places: list[Tensor]) -> Tensor:
        """The place with the lowest mean value in a few draws, the same for all and not seen before."""
        draws = min(_FINAL_DRAWS, self.left // len(places))
        values = []
        for place in places:
            theta, _ = self.theta(place)
            values.append(sum(self.value(self.views.margins(theta, _POOL + draw)) for draw in range(draws)))
        return places[min(range(len(places)), key=values.__getitem__)]

    def _together(self, places: Tensor, seen: Tensor, scene: int) -> Tensor:
        """The scene's coordinates of one place, and each object's own of where it did worst, for the scene's
        sake: less what all the objects did there.
        """
        held = seen.clamp(-FAR, FAR)
        if bool((self.at.owner < 0).any()) and held.shape[1] > 1:
            held = held - held.mean(dim=1, keepdim=True)
        best = held.argmin(dim=0)
        row = torch.where(self.at.owner < 0, scene, best.to(self.at.owner.device)[self.at.owner.clamp_min(0)])
        return places.gather(0, row[None].to(places.device))[0]


@dataclass(frozen=True, slots=True)
class MarginSearch(Attack):
    """A search on margins, which proposes one place. passes: of the detector in all, a gradient counted as 3.
    RangeError for fewer than LEAST_PASSES, and for a problem without views.
    """

    passes: int = 90

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(LEAST_PASSES, passes=self.passes)

    @abstractmethod
    def _found(self, search: MarginSearchState) -> Tensor:
        """The place u (K,) that is proposed; the last comparison (`MarginSearchState.best`) takes FINAL_PASSES."""

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        search = MarginSearchState.of(problem, theta0, generator, self.passes)
        if search is None:
            return Proposals((), (), 0)
        theta, active = search.theta(self._found(search))
        return Proposals((theta,), (None,), search.spent, active)


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


@dataclass(frozen=True, slots=True)
class Corners(MarginSearch):
    """Sees objects at corners of the bounds, each in another draw, and puts the worst corner of each together.

    Proposed is the best of these and of the best corner, in draws of their own. What is not feasible is projected,
    as everything is.
    """

    def _found(self, search: MarginSearchState) -> Tensor:
        places = balanced_corners(search.at.owner, search.left - FINAL_PASSES, search.generator).to(
            search.at.start
        )
        return search.best(search.candidates(places))


def balanced_corners(owner: Tensor, count: int, generator: torch.Generator) -> Tensor:
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
