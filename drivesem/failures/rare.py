"""How often an object is lost around a failure: by plain samples, or where that is rare by subset simulation.

Subset simulation (Au and Beck 2001) makes a rare event of a few that are not: margins below the lowest quarter of
all, of those below the lowest quarter of them, and so on down to 0. States of each level are Markov chains that
begin at the lowest of the level before (Papaioannou et al. 2015, conditional sampling).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from drivesem.evaluation.resampling import wilson
from drivesem.failures.rules import Floats

Margin = Callable[[Floats, int], float | None]
"""Of a place (d,) in the unit cube, in a draw by its number: below 0 where the object is lost, None where it does
not count."""

RARE = 0.05
"""Share of lost samples below which plain samples say too little."""
PASSED = 0.25
"""Share of a level's states that the next one begins with."""
LEVELS = 5
"""At most: a quarter to the power of five is one in a thousand."""
REMEMBERED = 0.7
"""Correlation of a proposed place with the one before, in normal scores."""
_DEVIATIONS = 1.96
_EDGE = 1e-9


@dataclass(frozen=True, slots=True)
class State:
    """place: (d,) in the unit cube."""

    place: Floats
    draw: int
    margin: float


@dataclass(frozen=True, slots=True)
class Share:
    """Share of a neighbourhood in which the object is lost, with a 95 % interval. by: "samples" or "subset
    simulation"; asked: states that the latter took besides.
    """

    probability: float
    low: float
    high: float
    by: str
    asked: int


def share_lost(states: Sequence[State], margin: Margin, rng: np.random.Generator) -> Share:
    """How often the object is lost. states: samples of the whole cube, in which it counts."""
    lost, count = sum(state.margin < 0 for state in states), len(states)
    low, high = wilson(lost, count) if count else (0.0, 1.0)
    if lost >= RARE * count:
        return Share(lost / count if count else 0.0, low, high, "samples", 0)
    return _by_levels(states, margin, rng)


def _by_levels(states: Sequence[State], margin: Margin, rng: np.random.Generator) -> Share:
    chains = np.array([[state.margin] for state in states])  # independent ones, at first
    level, share, variance, asked = list(states), 1.0, 0.0, 0
    for depth in range(LEVELS):
        limit = _limit(chains)
        passed = chains <= limit if limit > 0 else chains < 0
        part = float(passed.mean())
        share *= part
        variance += _variance(passed) if part else 0.0
        if limit <= 0:
            break
        starts = [state for state in level if state.margin <= limit]
        if depth == LEVELS - 1 or len(starts) == len(level):  # nothing is lost, or no state is worse than another
            spread = math.exp(_DEVIATIONS * math.sqrt(math.log1p(variance)))
            return Share(0.0, 0.0, min(share * spread, 1.0), "subset simulation", asked)
        length = max(round(len(states) / len(starts)), 2)
        walked = [_walk(start, length, limit, margin, rng) for start in starts]
        asked += len(starts) * (length - 1)
        level = [state for chain in walked for state in chain]
        chains = np.array([[state.margin for state in chain] for chain in walked])
    spread = math.exp(_DEVIATIONS * math.sqrt(math.log1p(variance)))
    return Share(share, share / spread, min(share * spread, 1.0), "subset simulation", asked)


def _limit(chains: Floats) -> float:
    """The margin below which the next level lies; at most 0 where enough is lost already."""
    ordered = np.sort(chains, axis=None)
    return float(ordered[max(math.ceil(PASSED * ordered.size), 1) - 1]) if ordered.size else 0.0


def _walk(start: State, length: int, limit: float, margin: Margin, rng: np.random.Generator) -> list[State]:
    """A Markov chain within a level, whose distribution it keeps: a proposal above the limit is refused."""
    chain = [start]
    while len(chain) < length:
        last = chain[-1]
        scores = ndtri(np.clip(last.place, _EDGE, 1 - _EDGE))
        moved = REMEMBERED * scores + math.sqrt(1 - REMEMBERED**2) * rng.standard_normal(len(scores))
        draw = int(rng.integers(2**31)) if rng.random() < 1 - REMEMBERED else last.draw
        found = margin(ndtr(moved), draw)
        chain.append(State(ndtr(moved), draw, found) if found is not None and found <= limit else last)
    return chain


def _variance(passed: NDArray[np.bool_]) -> float:
    """Square of the relative deviation of a level's share; (chains, length), whose states hang together."""
    part, length = float(passed.mean()), passed.shape[1]
    if part in (0.0, 1.0):
        return 0.0
    hits = passed.astype(float)
    together = 0.0
    for lag in range(1, length):
        along = float((hits[:, :-lag] * hits[:, lag:]).mean()) - part**2
        together += 2 * (1 - lag / length) * along / (part * (1 - part))
    return (1 - part) / (part * passed.size) * max(1 + together, 1.0)
