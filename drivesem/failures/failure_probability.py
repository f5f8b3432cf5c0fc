"""How often an object is missed around a failure: by plain samples, or by subset simulation if that is rare.

Subset simulation (Au and Beck 2001) splits a rare event into a few frequent ones: margins in the lowest quarter of
all, of these in the lowest quarter again, and so on down to 0. The states of a level are Markov chains that start
at the lowest states of the previous one (Papaioannou et al. 2015, conditional sampling).
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

MarginFunction = Callable[[Floats, int], float | None]
"""Point (d,) of the unit cube, number of a nuisance sample -> margin, negative where the object is missed; None
where it does not count."""

RARE_SHARE = 0.05
"""Share of misses below which plain samples are too inexact."""
LEVEL_SHARE = 0.25
"""Share of a level's states from which the next one starts."""
MAX_LEVELS = 5
"""Maximum number of levels: a quarter to the power of five is one in a thousand."""
CORRELATION = 0.7
"""Correlation of a proposed point with the previous one, in normal scores."""
_DEVIATIONS = 1.96
_EDGE = 1e-9


@dataclass(frozen=True, slots=True)
class UnitCubePoint:
    """One sampled state."""

    point: Floats
    """(d,) point of the unit cube."""
    draw: int
    """Number of the nuisance sample."""
    margin: float
    """Margin in logits."""


@dataclass(frozen=True, slots=True)
class FailureProbability:
    """Share of a neighbourhood in which the object is missed, with a 95 % interval."""

    probability: float
    """Estimate in [0, 1]."""
    low: float
    """Lower bound."""
    high: float
    """Upper bound."""
    by: str
    """Method: "samples" or "subset simulation"."""
    extra_samples: int
    """Further states that subset simulation evaluated."""


def estimate_failure_probability(
    states: Sequence[UnitCubePoint], margin: MarginFunction, rng: np.random.Generator
) -> FailureProbability:
    """Estimate how often the object is missed.

    Args:
        states: Samples of the whole cube in which the object counts.
        margin: Evaluates further states.
        rng: Random numbers of the Markov chains.
    """
    missed, count = sum(state.margin < 0 for state in states), len(states)
    low, high = wilson(missed, count) if count else (0.0, 1.0)
    if missed >= RARE_SHARE * count:
        return FailureProbability(missed / count if count else 0.0, low, high, "samples", 0)
    return _simulate_subsets(states, margin, rng)


def _simulate_subsets(
    states: Sequence[UnitCubePoint], margin: MarginFunction, rng: np.random.Generator
) -> FailureProbability:
    chains = np.array([[state.margin] for state in states])  # the first level's states are independent
    level, share, variance, extra_samples, reached = list(states), 1.0, 0.0, 0, True
    for depth in range(MAX_LEVELS):
        limit = _level_limit(chains)
        passed = chains <= limit if limit > 0 else chains < 0
        part = float(passed.mean())
        share *= part
        variance += _squared_variation(passed) if part else 0.0
        if limit <= 0:
            break
        starts = [state for state in level if state.margin <= limit]
        if depth == MAX_LEVELS - 1 or len(starts) == len(level):  # nothing is missed, or all margins are equal
            reached = False
            break
        length = max(round(len(states) / len(starts)), 2)
        next_chains = [_sample_chain(start, length, limit, margin, rng) for start in starts]
        extra_samples += len(starts) * (length - 1)
        level = [state for chain in next_chains for state in chain]
        chains = np.array([[state.margin for state in chain] for chain in next_chains])
    spread = math.exp(_DEVIATIONS * math.sqrt(math.log1p(variance)))
    estimate, high = share if reached else 0.0, min(share * spread, 1.0)
    return FailureProbability(estimate, estimate / spread, high, "subset simulation", extra_samples)


def _level_limit(chains: Floats) -> float:
    """The margin below which the next level lies; at most 0 where enough states are misses already."""
    ordered = np.sort(chains, axis=None)
    return float(ordered[max(math.ceil(LEVEL_SHARE * ordered.size), 1) - 1]) if ordered.size else 0.0


def _sample_chain(
    start: UnitCubePoint, length: int, limit: float, margin: MarginFunction, rng: np.random.Generator
) -> list[UnitCubePoint]:
    """Run a Markov chain that preserves a level's distribution: proposals above the limit are rejected."""
    chain = [start]
    while len(chain) < length:
        last = chain[-1]
        scores = ndtri(np.clip(last.point, _EDGE, 1 - _EDGE))
        proposal = ndtr(CORRELATION * scores + math.sqrt(1 - CORRELATION**2) * rng.standard_normal(len(scores)))
        draw = int(rng.integers(2**31)) if rng.random() < 1 - CORRELATION else last.draw
        value = margin(proposal, draw)
        chain.append(UnitCubePoint(proposal, draw, value) if value is not None and value <= limit else last)
    return chain


def _squared_variation(passed: NDArray[np.bool_]) -> float:
    """Squared coefficient of variation of a level's share; states of a chain (chains, length) are correlated."""
    part, length = float(passed.mean()), passed.shape[1]
    if part in (0.0, 1.0):
        return 0.0
    hits = passed.astype(float)
    correlation = 0.0
    for lag in range(1, length):
        covariance = float((hits[:, :-lag] * hits[:, lag:]).mean()) - part**2
        correlation += 2 * (1 - lag / length) * covariance / (part * (1 - part))
    return (1 - part) / (part * passed.size) * max(1 + correlation, 1.0)
