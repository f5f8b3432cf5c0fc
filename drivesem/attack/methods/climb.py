"""A search for failures that hold: it lowers the expected margin of each object, not the loss of one picture.

What a camera does between two frames turns a margin by a good part of a logit, and a point gradient of a car's
place is mostly the phase of its edges in the pixels. So margins are seen in draws (`Views`), first at corners and
samples of all of the bounds, the best of each object put together; then downhill, by gradients where these tell
what a wide step does, and by wide two-sided differences where they do not. Objects are nearly independent: one
pass tries another change of each.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Views, check_counts
from drivesem.attack.methods.unit_box import UnitBox
from scene_ir.errors import RangeError

LEAST_PASSES = 24
"""With fewer there is nothing left to climb after a look around."""
_OTHERWISE = 4
"""Passes that the benign pictures and the judging of what is found take."""
_SCOUTS = 0.3
"""Share of the passes that look around."""
_FINAL_DRAWS = 4
"""Draws in which the last candidates are compared."""
_POOL = 8
"""Draws that the search goes round in."""
_REACH = 0.2
"""Half the width of differences, as a share of the bounds."""
_STEP = 0.15
"""First step, as a share of the bounds; the last is a fifth of it."""
_SMOOTHING = 0.05
"""Standard deviation of theta in gradients, as a share of the bounds."""
_KEPT = 0.5
"""Of a slope, what stays after each further estimate."""
_SURE = -2.0
"""Margin from which an object is lost for sure, and the others matter more."""
_FAR = 4.0
"""Margin above which an object counts as no harder to lose."""


@dataclass(frozen=True, slots=True)
class Climb(Attack):
    """passes: of the detector in all, a gradient counted as 3. gradient: whether to ask for gradients at all; a
    detector without one is searched by differences alone. RangeError for fewer than LEAST_PASSES, and for a
    problem without views.
    """

    passes: int = 90
    gradient: bool = True

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(LEAST_PASSES, passes=self.passes)

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        if problem.views is None:
            raise RangeError("problem", "one with views of its objects", "none")
        if not bool(problem.views.judged.any()):
            return Proposals((), (), 0)
        search = _Search(problem, problem.views, UnitBox(problem, theta0), generator, self.passes - _OTHERWISE)
        place = search.look_around(max(int(_SCOUTS * self.passes), 1))
        place = search.descend(place, self.gradient and problem.views.differentiable)
        theta, active = search.theta(place)
        return Proposals((theta,), (None,), search.spent, active)


@dataclass
class _Search:
    """What all stages share. limit: passes in all."""

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

    @property
    def spent(self) -> int:
        return self.views.passes - self._spent_before

    @property
    def left(self) -> int:
        return self.limit - self.spent

    def theta(self, place: Tensor) -> tuple[Tensor, tuple[str, ...]]:
        """The feasible theta (D,) nearest to that of u (K,), and what held it back on the way there and before."""
        feasible = self.problem.project(self.at.theta(place))
        self._active.extend(feasible.active)
        return feasible.theta, tuple(dict.fromkeys(self._active))

    def look_around(self, count: int) -> Tensor:
        """Where to begin, u (K,): of `count` places, and of what the best of each object make together, the one
        with the lowest margins.
        """
        places = self._scouts(count)
        seen = torch.stack([self._margins(place) for place in places])
        values = [self._value(margins) for margins in seen]
        order = sorted(range(count), key=values.__getitem__)
        starts = [places[order[0]]]
        for scene in order[:2]:
            starts.append(self._together(places, seen, scene))
        number = self._number()
        tried = [self._value(self.views.margins(self.theta(place)[0], number)) for place in starts]
        return starts[min(range(len(starts)), key=tried.__getitem__)]

    def descend(self, place: Tensor, gradient: bool) -> Tensor:
        """From u (K,) downhill until the passes are used up; the last place, or where the search was on average
        late on, or where it began: what has the lowest margins in draws of its own.
        """
        start, wide = place, self.at.wide if gradient else torch.ones_like(self.at.wide)
        cost = (3 if bool((~wide).any()) else 0) + (2 if bool(wide.any()) else 0)
        steps = max((self.left - 3 * _FINAL_DRAWS) // cost, 0)
        slope = torch.zeros_like(place)
        track: list[Tensor] = []
        margins = torch.full((len(self.views.judged),), _FAR)
        for step in range(steps):
            number, part = self._number(), torch.zeros_like(place)
            if bool((~wide).any()):
                seen, found = self._gradient(place, number, self._weights(margins))
                part = torch.where(wide, part, found)
                margins = _KEPT * margins + (1 - _KEPT) * seen.clamp(-_FAR, _FAR)
            if bool(wide.any()):
                part = torch.where(wide, self._differences(place, number, wide, margins), part)
            slope = _KEPT * slope + (1 - _KEPT) * self._levelled(part)
            rate = _STEP * (1 - 0.8 * step / max(steps - 1, 1))
            place = (place - rate * slope.sign() * slope.abs().clamp_max(1)).clamp(0, 1)
            track.append(place)
        late = torch.stack(track[len(track) // 2 :]).mean(dim=0) if track else start
        return self._best([place, late, start])

    def _scouts(self, count: int) -> Tensor:
        """Places (count, K): corners and a scrambled Halton sequence in turn; of the first, all the scene's
        coordinates at their upper end.
        """
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=self.generator)))
        places = torch.from_numpy(qmc.Halton(len(self.at.owner), scramble=True, rng=rng).random(count))
        places[::2] = places[::2].round()
        places[0, self.at.owner < 0] = 1.0
        return places.to(self.at.start)

    def _together(self, places: Tensor, seen: Tensor, scene: int) -> Tensor:
        """The scene's coordinates of one place, and each object's own of where it did worst, for the scene's
        sake: less what all the objects did there.
        """
        held = seen.clamp(-_FAR, _FAR)
        if bool((self.at.owner < 0).any()) and held.shape[1] > 1:
            held = held - held.mean(dim=1, keepdim=True)
        best = held.argmin(dim=0)
        row = torch.where(self.at.owner < 0, scene, best.to(self.at.owner.device)[self.at.owner.clamp_min(0)])
        return places.gather(0, row[None].to(places.device))[0]

    def _gradient(self, place: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.randn(len(place), generator=self.generator).to(place)
        theta, _ = self.theta((place + _SMOOTHING * noise).clamp(0, 1))
        margins, gradient = self.views.margins_and_grad(theta, number, weights)
        return margins, self.at.slope(gradient)

    def _differences(self, place: Tensor, number: int, wide: Tensor, margins: Tensor) -> Tensor:
        """Slopes (K,) of each object's margin to its own coordinates, and of all to the scene's, by one step
        either way in all of them at once: others' steps hardly matter to an object, and average out.
        """
        way = (torch.randint(0, 2, (len(place),), generator=self.generator) * 2.0 - 1).to(place) * wide.to(place)
        ahead, back = (place + sign * _REACH * way for sign in (1, -1))
        ahead, back = ahead.clamp(0, 1), back.clamp(0, 1)
        one, two = (self.views.margins(self.theta(p)[0], number).clamp(-_FAR, _FAR) for p in (ahead, back))
        own = (one - two).to(place)
        of_all = (own * self._weights(margins).to(own)).sum()
        change = torch.where(self.at.owner < 0, of_all, own[self.at.owner.clamp_min(0)])
        between = ahead - back
        return torch.where(between != 0, change / between, 0)

    def _levelled(self, slope: Tensor) -> Tensor:
        """A slope (K,), the largest of each object's, of either kind, made 1: objects move at one pace."""
        levelled = torch.zeros_like(slope)
        for owner in self.at.owner.unique():
            for kind in (False, True):
                where = (self.at.owner == owner) & (self.at.wide == kind)
                if bool(where.any()):
                    levelled[where] = slope[where] / slope[where].abs().max().clamp_min(1e-9)
        return levelled

    def _weights(self, margins: Tensor) -> Tensor:
        """(N,): how much objects matter to what they share: those that are nearly lost most, those that are lost
        for sure not.
        """
        held = margins.nan_to_num(_FAR, _FAR, -_FAR)
        return torch.sigmoid(2 * (held - _SURE)) * torch.exp(-held.clamp_min(0) / 2)

    def _margins(self, place: Tensor) -> Tensor:
        return self.views.margins(self.theta(place)[0], self._number())

    def _number(self) -> int:
        self._next += 1
        return self._next % _POOL

    def _value(self, margins: Tensor) -> float:
        """What is to be low: a step a lost object, and beyond that the margins themselves."""
        known = margins[self.views.judged.to(margins.device)].clamp(_SURE, _FAR)
        return float(torch.tanh(2 * known).sum() + 0.1 * known.sum())

    def _best(self, places: list[Tensor]) -> Tensor:
        """The place with the lowest mean value in _FINAL_DRAWS draws, the same for all."""
        draws = min(_FINAL_DRAWS, self.left // len(places))
        values = []
        for place in places:
            theta, _ = self.theta(place)
            values.append(sum(self._value(self.views.margins(theta, _POOL + k)) for k in range(draws)))
        return places[min(range(len(places)), key=values.__getitem__)]
