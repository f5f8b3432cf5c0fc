"""What searches on margins have in common: they see objects in draws (`Views`), and keep of each what did worst.

Objects are nearly independent, so that the worst place of each can be put together with the others'.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Views, check_counts
from drivesem.attack.methods.unit_box import UnitBox
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
FRESH = _POOL + _FINAL_DRAWS
"""The first draw that no search looks at."""


def value_of(margins: Tensor, judged: Tensor) -> float:
    """What a search lowers, of margins (N,) of objects of which judged (N,) count."""
    known = margins[judged.to(margins.device)].clamp(SURE, FAR)
    return float(torch.tanh(2 * known).sum() + 0.1 * known.sum())


@dataclass
class MarginSearch:
    """A search of the unit box within a number of passes. limit: passes in all."""

    problem: Problem
    views: Views
    at: UnitBox
    generator: torch.Generator
    limit: int
    _active: list[str] = field(default_factory=list)
    _spent_before: int = field(init=False)
    _next: int = 0

    def __post_init__(self) -> None:
        self._spent_before = self.views.passes

    @classmethod
    def of(cls, problem: Problem, theta0: Tensor, generator: torch.Generator, passes: int) -> MarginSearch | None:
        """Within so many passes, the benign pictures and the final judgement included; None where there is nothing
        to lose. RangeError for a problem without views.
        """
        if problem.views is None:
            raise RangeError("problem", "one with views of its objects", "none")
        if not bool(problem.views.judged.any()):
            return None
        return cls(problem, problem.views, UnitBox(problem, theta0), generator, passes - _OTHERWISE)

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
        return value_of(margins, self.views.judged)

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
class OfMargins(Attack):
    """A search on margins, which proposes one place. passes: of the detector in all, a gradient counted as 3.
    RangeError for fewer than LEAST_PASSES, and for a problem without views.
    """

    passes: int = 90

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(LEAST_PASSES, passes=self.passes)

    @abstractmethod
    def _found(self, search: MarginSearch) -> Tensor:
        """The place u (K,) that is proposed; the last comparison (`MarginSearch.best`) takes FINAL_PASSES."""

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        search = MarginSearch.of(problem, theta0, generator, self.passes)
        if search is None:
            return Proposals((), (), 0)
        theta, active = search.theta(self._found(search))
        return Proposals((theta,), (None,), search.spent, active)
