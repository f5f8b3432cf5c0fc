"""A search for failures that hold: it lowers the expected margin of each object, not the loss of one picture.

What a camera does between two frames turns a margin by a good part of a logit, and a point gradient of a car's
place is mostly the phase of its edges in the pixels. So margins are seen in draws (`Views`), first at corners and
samples of all of the bounds, the best of each object put together; then downhill, by gradients where these tell
what a wide step does, and by wide two-sided differences where they do not. Objects are nearly independent: one
pass tries another change of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.methods.margin_search import (
    FAR,
    FINAL_PASSES,
    SURE,
    MarginSearch,
    MarginSearchState,
    balanced_corners,
)

_SCOUTS = 0.4
"""Share of the passes that look around."""
_REACH = 0.2
"""Half the width of differences, as a share of the bounds."""
_STEP = 0.15
"""First step, as a share of the bounds; the last is a fifth of it."""
_SMOOTHING = 0.05
"""Standard deviation of theta in gradients, as a share of the bounds."""
_KEPT = 0.5
"""Of a slope, what stays after each further estimate."""


@dataclass(frozen=True, slots=True)
class Climb(MarginSearch):
    """gradient: whether to ask for gradients at all; a detector without one is searched by differences alone."""

    gradient: bool = True

    def _found(self, search: MarginSearchState) -> Tensor:
        place = _look_around(search, max(int(_SCOUTS * self.passes), 1))
        return _Descent(search, self.gradient and search.views.differentiable).descend(place)


def _look_around(search: MarginSearchState, count: int) -> Tensor:
    """Where to begin, u (K,): of `count` places, and of what the best of each object make together, the one with
    the lowest margins.
    """
    starts = search.candidates(_scouts(search, count))
    number = search.number()
    tried = [search.value(search.margins(place, number)) for place in starts]
    return starts[min(range(len(starts)), key=tried.__getitem__)]


def _scouts(search: MarginSearchState, count: int) -> Tensor:
    """Places (count, K): balanced corners and a scrambled Halton sequence in turn."""
    from scipy.stats import qmc  # on use: it takes a third of a second to load

    at = search.at
    rng = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
    places = torch.from_numpy(qmc.Halton(len(at.owner), scramble=True, rng=rng).random(count))
    places[::2] = balanced_corners(at.owner, (count + 1) // 2, search.generator)
    return places.to(at.start)


@dataclass(frozen=True, slots=True)
class _Descent:
    """The way downhill. gradient: whether to ask for gradients."""

    search: MarginSearchState
    gradient: bool

    def descend(self, place: Tensor) -> Tensor:
        """From u (K,) downhill until the passes are used up; the last place, or where the search was on average
        late on, or where it began: what has the lowest margins in draws of its own.
        """
        search, at = self.search, self.search.at
        start, wide = place, at.wide if self.gradient else torch.ones_like(at.wide)
        cost = (3 if bool((~wide).any()) else 0) + (2 if bool(wide.any()) else 0)
        steps = max((search.left - FINAL_PASSES) // cost, 0)
        slope = torch.zeros_like(place)
        track: list[Tensor] = []
        margins = torch.full((len(search.views.counted_objects),), FAR, device=place.device)
        for step in range(steps):
            number, part = search.number(), torch.zeros_like(place)
            if bool((~wide).any()):
                seen, found = self._gradient(place, number, self._weights(margins))
                part = torch.where(wide, part, found)
                margins = _KEPT * margins + (1 - _KEPT) * seen.clamp(-FAR, FAR)
            if bool(wide.any()):
                part = torch.where(wide, self._differences(place, number, wide, margins), part)
            slope = _KEPT * slope + (1 - _KEPT) * self._levelled(part)
            rate = _STEP * (1 - 0.8 * step / max(steps - 1, 1))
            place = (place - rate * slope.sign() * slope.abs().clamp_max(1)).clamp(0, 1)
            track.append(place)
        late = torch.stack(track[len(track) // 2 :]).mean(dim=0) if track else start
        return search.best([place, late, start])

    def _gradient(self, place: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.randn(len(place), generator=self.search.generator).to(place)
        theta, _ = self.search.theta((place + _SMOOTHING * noise).clamp(0, 1))
        margins, gradient = self.search.views.margins_and_grad(theta, number, weights)
        return margins, self.search.at.slope(gradient)

    def _differences(self, place: Tensor, number: int, wide: Tensor, margins: Tensor) -> Tensor:
        """Slopes (K,) of each object's margin to its own coordinates, and of all to the scene's, by one step
        either way in all of them at once: others' steps hardly matter to an object, and average out.
        """
        way = (torch.randint(0, 2, (len(place),), generator=self.search.generator) * 2.0 - 1).to(place) * wide.to(
            place
        )
        ahead, back = (place + sign * _REACH * way for sign in (1, -1))
        ahead, back = ahead.clamp(0, 1), back.clamp(0, 1)
        one, two = (
            self.search.views.margins(self.search.theta(p)[0], number).clamp(-FAR, FAR) for p in (ahead, back)
        )
        own = (one - two).to(place)
        of_all = (own * self._weights(margins).to(own)).sum()
        change = torch.where(self.search.at.owner < 0, of_all, own[self.search.at.owner.clamp_min(0)])
        between = ahead - back
        return torch.where(between != 0, change / between, 0)

    def _levelled(self, slope: Tensor) -> Tensor:
        """A slope (K,), the largest of each object's, of either kind, made 1: objects move at one pace."""
        levelled = torch.zeros_like(slope)
        for owner in self.search.at.owner.unique():
            for kind in (False, True):
                where = (self.search.at.owner == owner) & (self.search.at.wide == kind)
                if bool(where.any()):
                    levelled[where] = slope[where] / slope[where].abs().max().clamp_min(1e-9)
        return levelled

    def _weights(self, margins: Tensor) -> Tensor:
        """(N,): how much objects matter to what they share: those that are nearly lost most, those that are lost
        for sure not.
        """
        held = margins.nan_to_num(FAR, FAR, -FAR)
        return torch.sigmoid(2 * (held - SURE)) * torch.exp(-held.clamp_min(0) / 2)
