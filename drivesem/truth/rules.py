"""Where something fails, in words: intervals of one or two features that tell failures from the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

MOST = 2
"""Features of a rule: of three, no person keeps track."""
_CUTS = 48
"""Ends of intervals that are tried, at most: quantiles of the samples."""
_SUPPORT, _FEWEST = 0.05, 5
"""Of the samples, so large a share, and so many, lie inside an interval and outside of it."""


@dataclass(frozen=True, slots=True)
class Rule:
    """where: intervals by feature; none where failures are told by nothing, or everything fails. fails, count: of
    the samples inside; fails_outside, count_outside: of the others.
    """

    where: dict[str, tuple[float, float]]
    fails: int
    count: int
    fails_outside: int = 0
    count_outside: int = 0


def contains(where: Mapping[str, tuple[float, float]], features: Mapping[str, Floats], count: int) -> Flags:
    """Which of `count` samples, features (count,) by name, lie in all intervals."""
    inside = np.ones(count, np.bool_)
    for name, (low, high) in where.items():
        inside &= (features[name] >= low) & (features[name] <= high)
    return inside


def in_words(where: Mapping[str, tuple[float, float]]) -> str:
    """A rule for people."""
    return ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, (low, high) in where.items()) or "anywhere"


def fit(features: Mapping[str, Floats], fails: Flags, most: int = MOST, only: Sequence[str] | None = None) -> Rule:
    """The rule with the highest likelihood, of two shares of failures, one inside and one outside. features: (n,)
    by name; fails: (n,). only: features that it may ask for.

    An interval must be worth what it takes to write it down (minimum description length): half a logarithm of the
    samples for its share, one for each bound, which may lie at any of them, and the choice among features.
    """
    names = [name for name in (features if only is None else only) if float(np.ptp(features[name])) > 0]
    where: dict[str, tuple[float, float]] = {}
    while len(where) < most:
        inside = contains(where, features, len(fails))
        left = [name for name in names if name not in where]
        found = _best(features, fails, left, inside)
        if found is None:
            break
        where[found[0]] = found[1]
        if len(where) > 1:  # the first, in the light of the second
            first = next(iter(where))
            rest = {name: where[name] for name in where if name != first}
            again = _best(features, fails, [first], contains(rest, features, len(fails)))
            if again is not None:
                where[first] = again[1]
    return counted(where, features, fails)


def counted(where: Mapping[str, tuple[float, float]], features: Mapping[str, Floats], fails: Flags) -> Rule:
    """A rule of known intervals, on samples."""
    inside = contains(where, features, len(fails))
    hits, others = fails & inside, fails & ~inside
    return Rule(dict(where), int(hits.sum()), int(inside.sum()), int(others.sum()), int((~inside).sum()))


def _best(
    features: Mapping[str, Floats], fails: Flags, names: Sequence[str], inside: Flags
) -> tuple[str, tuple[float, float]] | None:
    """The feature and interval that tell most among the samples inside; None where none is worth its numbers."""
    best: tuple[float, str, tuple[float, float]] | None = None
    for name in names:
        found = _interval(features[name][inside], fails[inside])
        if found is not None and (best is None or found[0] > best[0]):
            best = (found[0], name, found[1])
    if best is None or best[0] <= math.log(max(len(names), 1)):
        return None
    return best[1], best[2]


def _interval(values: Floats, fails: Flags) -> tuple[float, tuple[float, float]] | None:
    """What an interval gains in log-likelihood, less the price of its numbers; and the interval."""
    n, total = len(values), int(fails.sum())
    least = max(_FEWEST, math.ceil(_SUPPORT * n))
    if n < 2 * least or total in (0, n):
        return None
    order = np.argsort(values, kind="stable")
    ranked, hits = values[order], np.concatenate([[0], np.cumsum(fails[order])])
    # Places between two different values, where an interval may end; the ends of all are no bounds.
    between = np.flatnonzero(np.diff(ranked) > 0) + 1
    if len(between) > _CUTS:
        between = between[np.linspace(0, len(between) - 1, _CUTS).round().astype(int)]
    ends = np.concatenate([[0], between, [n]])
    start, stop = np.meshgrid(ends, ends, indexing="ij")
    count = stop - start
    inner = hits[stop] - hits[start]
    usable = (count >= least) & (n - count >= least)
    usable &= inner * (n - count) > (total - inner) * count
    if not usable.any():
        return None
    gain = _likelihood(inner, count) + _likelihood(total - inner, n - count) - _likelihood(total, n)
    bounds = (start > 0).astype(int) + (stop < n)
    gain = np.where(usable, gain - (0.5 + bounds) * math.log(n), -np.inf)
    a, b = np.unravel_index(int(gain.argmax()), gain.shape)
    if not gain[a, b] > 0:
        return None
    return float(gain[a, b]), (_end(ranked, int(ends[a])), _end(ranked, int(ends[b])))


def _end(ranked: Floats, place: int) -> float:
    """Between the neighbours of a place; at the ends the outermost value."""
    if place in (0, len(ranked)):
        return float(ranked[min(place, len(ranked) - 1)])
    return float(ranked[place - 1] + ranked[place]) / 2


def _likelihood(hits: NDArray[np.int64] | int, count: NDArray[np.int64] | int) -> Floats:
    """Logarithm of that of so many failures among so many samples, at their own share."""
    k, n = np.asarray(hits, np.float64), np.asarray(count, np.float64)
    share = np.divide(k, n, out=np.zeros_like(k + n), where=n > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(k * np.log(share), nan=0.0) + np.nan_to_num((n - k) * np.log1p(-share), nan=0.0)


def overlap(one: Mapping[str, tuple[float, float]], two: Mapping[str, tuple[float, float]]) -> float:
    """How much two rules of the same features are one: the least share of the intervals' hulls that both cover."""
    shares = []
    for name, (low, high) in one.items():
        lower, upper = two[name]
        hull = max(high, upper) - min(low, lower)
        shares.append(max(min(high, upper) - max(low, lower), 0.0) / hull if hull > 0 else 1.0)
    return min(shares, default=1.0)
