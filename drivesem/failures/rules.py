"""Where something fails, in words: intervals of one or two features that tell failures from the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Where = dict[str, tuple[float, float]]
"""Intervals by feature."""

MOST = 2
"""Features of a rule: of three, no person keeps track."""
SUPPORT = 0.05
"""Of the samples around one failure, so large a share lies inside an interval and outside of it."""
_CUTS, _FEWEST = 48, 5
"""Ends of intervals that are tried, at most, half of them quantiles of the samples that fail; samples inside of an
interval and outside of it, at least."""
_FOLDS, _OBJECTS = 5, 3
"""Of a pooled rule: parts of the objects, at most, each of which is told by the rule of the others; objects, at
least, whose failures lie inside."""
_BEYOND_CHANCE = 1.0
"""Standard errors, over objects, by which such a rule tells failures of objects that it was not made of."""
_RULES = 8
"""Pooled rules, at most."""


@dataclass(frozen=True, slots=True)
class Rule:
    """where: intervals by feature; none where failures are told by nothing, or everything fails. fails, count: of
    the samples inside; fails_outside, count_outside: of the others.
    """

    where: Where
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


def fit(
    features: Mapping[str, Floats],
    fails: Flags,
    most: int = MOST,
    only: Sequence[str] | None = None,
    support: float = SUPPORT,
) -> Rule:
    """The rule with the shortest description, of two shares of failures, one inside and one outside. features:
    (n,) by name; fails: (n,). only: features that it may ask for; support: share of the samples inside, at least.

    An interval must be worth what it takes to write it down (minimum description length): half a logarithm of the
    samples for its share, the choice among the ends that are tried for each bound, and that among features. Each
    feature is tried as the first.
    """
    names = [name for name in (features if only is None else only) if float(np.ptp(features[name])) > 0]
    best: Where = {}
    least = description(best, features, fails)
    for first in names:
        where = _grown(features, fails, first, names, most, support)
        length = description(where, features, fails) + len(where) * math.log(len(names))
        if where and length < least:
            best, least = where, length
    return counted(best, features, fails)


def _grown(
    features: Mapping[str, Floats], fails: Flags, first: str, names: Sequence[str], most: int, support: float
) -> Where:
    """The best rule that begins with a feature; empty where none of its intervals tells anything."""
    everything = np.ones(len(fails), np.bool_)
    found = _best(features, fails, [first], everything, support)
    if found is None:
        return {}
    where: Where = dict([found])
    while len(where) < most:
        left = [name for name in names if name not in where]
        found = _best(features, fails, left, contains(where, features, len(fails)), support, len(names))
        if found is None:
            break
        where[found[0]] = found[1]
        rest = {name: where[name] for name in where if name != first}  # the first, in the light of the second
        again = _best(features, fails, [first], contains(rest, features, len(fails)), support)
        if again is not None:
            where[first] = again[1]
    return where


def description(
    where: Mapping[str, tuple[float, float]],
    features: Mapping[str, Floats],
    fails: Flags,
    bounds: int | None = None,
) -> float:
    """What it takes to say which samples fail, given a rule, and the rule's shares and bounds, in nats. bounds:
    how many there are to write, by default all but those at the ends of all samples.
    """
    rule, n = counted(where, features, fails), len(fails)
    inside, outside = (rule.fails, rule.count), (rule.fails_outside, rule.count_outside)
    told = sum(float(_likelihood(*side)) for side in (inside, outside))
    shares = 0.5 * sum(count > 0 for _, count in (inside, outside))
    if bounds is None:
        bounds = sum(
            int(low > features[name].min()) + int(high < features[name].max())
            for name, (low, high) in where.items()
        )
    return shares * math.log(max(n, 2)) + bounds * _bound(n) - told


def cover(features: Mapping[str, Floats], fails: Flags, objects: NDArray[np.int64]) -> list[Rule]:
    """Rules of samples of many objects, the one that tells most first; each is made of what those before it leave.

    objects: (n,), of which each sample is. A rule must cover failures of several objects, and tell those of
    objects that it was not made of better than no rule does: samples of one object are much alike, and by them
    alone anything may seem to tell.
    """
    left = np.ones(len(fails), np.bool_)
    rules: list[Rule] = []
    while len(rules) < _RULES and bool(fails[left].any()):
        some = {name: values[left] for name, values in features.items()}
        rule = fit(some, fails[left], support=0.0)
        inside = contains(rule.where, some, int(left.sum()))
        covered = len(np.unique(objects[left][inside & fails[left]]))
        if not rule.where or covered < _OBJECTS or not _tells_others(some, fails[left], objects[left]):
            break
        rules.append(rule)
        left &= ~contains(rule.where, features, len(fails))
    return rules


def _tells_others(features: Mapping[str, Floats], fails: Flags, objects: NDArray[np.int64]) -> bool:
    """Whether rules of some objects tell failures of the others, beyond chance."""
    known, numbers = np.unique(objects, return_inverse=True)
    folds = min(_FOLDS, len(known))
    parts = np.random.default_rng(len(known)).permutation(len(known)) % folds
    gains = np.zeros(len(known))
    for part in range(folds):
        held = parts[numbers] == part
        made = {name: values[~held] for name, values in features.items()}
        rule = fit(made, fails[~held], support=0.0)
        inside = contains(rule.where, features, len(fails))[held]
        share = np.where(
            inside,
            (rule.fails + 0.5) / (rule.count + 1),
            (rule.fails_outside + 0.5) / (rule.count_outside + 1),
        )
        plain = (rule.fails + rule.fails_outside + 0.5) / (len(made[next(iter(made))]) + 1)
        lost = fails[held]
        gain = np.where(lost, np.log(share / plain), np.log((1 - share) / (1 - plain)))
        np.add.at(gains, numbers[held], gain)
    error = float(gains.std(ddof=1)) * math.sqrt(len(gains)) if len(gains) > 1 else 0.0
    return float(gains.sum()) > _BEYOND_CHANCE * error


def counted(where: Mapping[str, tuple[float, float]], features: Mapping[str, Floats], fails: Flags) -> Rule:
    """A rule of known intervals, on samples."""
    inside = contains(where, features, len(fails))
    hits, others = fails & inside, fails & ~inside
    return Rule(dict(where), int(hits.sum()), int(inside.sum()), int(others.sum()), int((~inside).sum()))


def _best(
    features: Mapping[str, Floats],
    fails: Flags,
    names: Sequence[str],
    inside: Flags,
    support: float,
    among: int = 1,
) -> tuple[str, tuple[float, float]] | None:
    """The feature and interval that tell most among the samples inside; None where none is worth its numbers.
    among: so many features it is chosen of.
    """
    best: tuple[float, str, tuple[float, float]] | None = None
    for name in names:
        found = _interval(features[name][inside], fails[inside], support)
        if found is not None and (best is None or found[0] > best[0]):
            best = (found[0], name, found[1])
    if best is None or best[0] <= math.log(max(among, 1)):
        return None
    return best[1], best[2]


def _interval(values: Floats, fails: Flags, support: float) -> tuple[float, tuple[float, float]] | None:
    """What an interval gains in log-likelihood, less the price of its numbers; and the interval."""
    n, total = len(values), int(fails.sum())
    least = max(_FEWEST, math.ceil(support * n))
    if n < 2 * least or total in (0, n):
        return None
    order = np.argsort(values, kind="stable")
    ranked, failing = values[order], fails[order]
    hits = np.concatenate([[0], np.cumsum(failing)])
    # Places between two different values, where an interval may end; the ends of all are no bounds. Ends beside
    # samples that fail matter most, and may be few.
    between = np.flatnonzero(np.diff(ranked) > 0) + 1
    beside = between[failing[between] != failing[between - 1]]
    ends = np.unique(np.concatenate([[0], _spread(between), _spread(beside), [n]]))
    start, stop = np.meshgrid(ends, ends, indexing="ij")
    count = stop - start
    inner = hits[stop] - hits[start]
    usable = (count >= least) & (n - count >= least)
    usable &= inner * (n - count) > (total - inner) * count
    if not usable.any():
        return None
    gain = _likelihood(inner, count) + _likelihood(total - inner, n - count) - _likelihood(total, n)
    bounds = (start > 0).astype(int) + (stop < n)
    gain = np.where(usable, gain - 0.5 * math.log(n) - bounds * _bound(n), -np.inf)
    a, b = np.unravel_index(int(gain.argmax()), gain.shape)
    if not gain[a, b] > 0:
        return None
    return float(gain[a, b]), (_end(ranked, int(ends[a])), _end(ranked, int(ends[b])))


def _bound(n: int) -> float:
    """What it takes to write down a bound: which of the ends that are tried it is, of n samples."""
    return math.log(max(min(n, _CUTS), 2))


def _end(ranked: Floats, place: int) -> float:
    """Between the neighbours of a place; at the ends the outermost value."""
    if place in (0, len(ranked)):
        return float(ranked[min(place, len(ranked) - 1)])
    return float(ranked[place - 1] + ranked[place]) / 2


def _spread(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Half as many as `_CUTS` of them, evenly, at most."""
    if len(places) <= _CUTS // 2:
        return places
    return places[np.linspace(0, len(places) - 1, _CUTS // 2).round().astype(int)]


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
