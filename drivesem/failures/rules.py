"""Interval rules: intervals of one or two features that separate failures from the other samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivesem.evaluation.resampling import wilson

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Intervals = dict[str, tuple[float, float]]
"""Intervals by feature."""

MAX_FEATURES = 2
"""Maximum number of features in a rule; nobody keeps track of three."""
MIN_SUPPORT = 0.05
"""Minimum share of the samples around one failure that lie inside an interval, and outside of it."""
_MAX_CUTS, _MIN_SAMPLES = 48, 5
"""Maximum number of interval ends that are tried, half of them next to failures; minimum number of samples inside
an interval and outside of it."""
_MAX_FOLDS, _MIN_OBJECTS = 5, 3
"""Of a pooled rule: maximum number of cross-validation folds of the objects; minimum number of objects with
failures inside."""
_MIN_STANDARD_ERRORS = 1.0
"""Minimum gain of such a rule on held-out objects, in standard errors over objects."""
_MAX_RULES = 8
"""Maximum number of pooled rules."""


@dataclass(frozen=True, slots=True)
class IntervalRule:
    """Intervals of features, and how many samples fail inside and outside of them."""

    intervals: Intervals
    """Intervals by feature; empty where no feature separates failures, or everything fails."""
    failures: int
    """Failures inside."""
    count: int
    """Samples inside."""
    failures_outside: int = 0
    """Failures outside."""
    count_outside: int = 0
    """Samples outside."""


def contains(where: Mapping[str, tuple[float, float]], features: Mapping[str, Floats], count: int) -> Flags:
    """Find the samples that lie in all intervals.

    Args:
        where: Intervals by feature.
        features: Values (n,) by feature.
        count: Number of samples n.

    Returns:
        (n,) bool.
    """
    inside = np.ones(count, np.bool_)
    for name, (low, high) in where.items():
        inside &= (features[name] >= low) & (features[name] <= high)
    return inside


def format_rule(where: Mapping[str, tuple[float, float]]) -> str:
    """Format a rule as text."""
    return ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, (low, high) in where.items()) or "anywhere"


def rates_differ(inside: tuple[int, int], outside: tuple[int, int]) -> bool:
    """Whether failure rates inside and outside a rule differ beyond their 95 % Wilson intervals. Each is a pair of
    failures and samples; without samples on either side nothing speaks against the rule.
    """
    return not (inside[1] and outside[1]) or wilson(*inside)[0] > wilson(*outside)[1]


def fit_rule(
    features: Mapping[str, Floats],
    fails: Flags,
    most: int = MAX_FEATURES,
    only: Sequence[str] | None = None,
    support: float = MIN_SUPPORT,
) -> IntervalRule:
    """Fit the rule with the minimum description length: one failure rate inside and one outside.

    An interval must gain more than it costs: half the logarithm of the samples for its failure rate, plus the
    choice among interval ends for each bound and among features. Each feature is tried as the first.

    Args:
        features: Values (n,) by feature.
        fails: (n,) bool, samples that fail.
        most: Maximum number of features.
        only: Features that the rule may use; all by default.
        support: Minimum share of the samples inside.
    """
    names = [name for name in (features if only is None else only) if float(np.ptp(features[name])) > 0]
    best: Intervals = {}
    least = description_length(best, features, fails)
    for first in names:
        where = _grow_rule(features, fails, first, names, most, support)
        length = description_length(where, features, fails) + len(where) * math.log(len(names))
        if where and length < least:
            best, least = where, length
    return count_rule(best, features, fails)


def _grow_rule(
    features: Mapping[str, Floats], fails: Flags, first: str, names: Sequence[str], most: int, support: float
) -> Intervals:
    """Grow the best rule that starts with a feature; empty where no interval of it gains anything."""
    everything = np.ones(len(fails), np.bool_)
    found = _best_interval(features, fails, [first], everything, support)
    if found is None:
        return {}
    where: Intervals = dict([found])
    while len(where) < most:
        unused = [name for name in names if name not in where]
        found = _best_interval(features, fails, unused, contains(where, features, len(fails)), support, len(names))
        if found is None:
            break
        where[found[0]] = found[1]
        rest = {name: where[name] for name in where if name != first}  # refit the first, given the second
        again = _best_interval(features, fails, [first], contains(rest, features, len(fails)), support)
        if again is not None:
            where[first] = again[1]
    return where


def description_length(
    where: Mapping[str, tuple[float, float]],
    features: Mapping[str, Floats],
    fails: Flags,
    bounds: int | None = None,
) -> float:
    """Compute the description length of the failures under a rule, including the rule.

    Args:
        where: Intervals by feature.
        features: Values (n,) by feature.
        fails: (n,) bool.
        bounds: Number of interval ends to encode; by default those inside the range of all samples.

    Returns:
        Nats.
    """
    rule, n = count_rule(where, features, fails), len(fails)
    inside, outside = (rule.failures, rule.count), (rule.failures_outside, rule.count_outside)
    log_likelihood = sum(float(_log_likelihood(*side)) for side in (inside, outside))
    shares = 0.5 * sum(count > 0 for _, count in (inside, outside))
    if bounds is None:
        bounds = sum(
            int(low > features[name].min()) + int(high < features[name].max())
            for name, (low, high) in where.items()
        )
    return shares * math.log(max(n, 2)) + bounds * _bound_cost(n) - log_likelihood


def fit_rule_list(features: Mapping[str, Floats], fails: Flags, objects: NDArray[np.int64]) -> list[IntervalRule]:
    """Fit rules to samples of many objects, the best first, each to the samples that earlier ones do not cover.

    A rule must cover failures of several objects and predict failures of held-out objects better than no rule
    does: samples of one object are so similar that any feature may seem to separate them.

    Args:
        features: Values (n,) by feature.
        fails: (n,) bool, samples that fail.
        objects: (n,) object of each sample.
    """
    left = np.ones(len(fails), np.bool_)
    rules: list[IntervalRule] = []
    while len(rules) < _MAX_RULES and bool(fails[left].any()):
        some = {name: values[left] for name, values in features.items()}
        rule = fit_rule(some, fails[left], support=0.0)
        inside = contains(rule.intervals, some, int(left.sum()))
        covered = len(np.unique(objects[left][inside & fails[left]]))
        if not rule.intervals or covered < _MIN_OBJECTS or not _generalises(some, fails[left], objects[left]):
            break
        rules.append(rule)
        left &= ~contains(rule.intervals, features, len(fails))
    return rules


def _generalises(features: Mapping[str, Floats], fails: Flags, objects: NDArray[np.int64]) -> bool:
    """Whether rules fitted to some objects predict failures of the others beyond chance."""
    known, numbers = np.unique(objects, return_inverse=True)
    folds = min(_MAX_FOLDS, len(known))
    parts = np.random.default_rng(len(known)).permutation(len(known)) % folds
    gains = np.zeros(len(known))
    for part in range(folds):
        held = parts[numbers] == part
        training = {name: values[~held] for name, values in features.items()}
        rule = fit_rule(training, fails[~held], support=0.0)
        inside = contains(rule.intervals, features, len(fails))[held]
        share = np.where(
            inside,
            (rule.failures + 0.5) / (rule.count + 1),
            (rule.failures_outside + 0.5) / (rule.count_outside + 1),
        )
        plain = (rule.failures + rule.failures_outside + 0.5) / (int((~held).sum()) + 1)
        gain = np.where(fails[held], np.log(share / plain), np.log((1 - share) / (1 - plain)))
        np.add.at(gains, numbers[held], gain)
    error = float(gains.std(ddof=1)) * math.sqrt(len(gains)) if len(gains) > 1 else 0.0
    return float(gains.sum()) > _MIN_STANDARD_ERRORS * error


def count_rule(
    where: Mapping[str, tuple[float, float]], features: Mapping[str, Floats], fails: Flags
) -> IntervalRule:
    """Count the failures of samples inside and outside of given intervals.

    Args:
        where: Intervals by feature.
        features: Values (n,) by feature.
        fails: (n,) bool.
    """
    inside = contains(where, features, len(fails))
    hits, others = fails & inside, fails & ~inside
    return IntervalRule(dict(where), int(hits.sum()), int(inside.sum()), int(others.sum()), int((~inside).sum()))


def _best_interval(
    features: Mapping[str, Floats],
    fails: Flags,
    names: Sequence[str],
    inside: Flags,
    support: float,
    among: int = 1,
) -> tuple[str, tuple[float, float]] | None:
    """The feature and interval with the largest gain among the samples inside; None where none is worth its cost.
    among: number of features to choose from.
    """
    best: tuple[float, str, tuple[float, float]] | None = None
    for name in names:
        found = _best_cut(features[name][inside], fails[inside], support)
        if found is not None and (best is None or found[0] > best[0]):
            best = (found[0], name, found[1])
    if best is None or best[0] <= math.log(max(among, 1)):
        return None
    return best[1], best[2]


def _best_cut(values: Floats, fails: Flags, support: float) -> tuple[float, tuple[float, float]] | None:
    """The largest gain of an interval in log-likelihood, minus its cost; and the interval."""
    n, total = len(values), int(fails.sum())
    least = max(_MIN_SAMPLES, math.ceil(support * n))
    if n < 2 * least or total in (0, n):
        return None
    order = np.argsort(values, kind="stable")
    ranked, failing = values[order], fails[order]
    hits = np.concatenate([[0], np.cumsum(failing)])
    # An interval may end between two different values. Ends next to failures matter most, and may be few.
    between = np.flatnonzero(np.diff(ranked) > 0) + 1
    at_failures = between[failing[between] != failing[between - 1]]
    ends = np.unique(np.concatenate([[0], _thin_out(between), _thin_out(at_failures), [n]]))
    start, stop = np.meshgrid(ends, ends, indexing="ij")
    count = stop - start
    inner = hits[stop] - hits[start]
    usable = (count >= least) & (n - count >= least)
    usable &= inner * (n - count) > (total - inner) * count
    if not usable.any():
        return None
    gain = _log_likelihood(inner, count) + _log_likelihood(total - inner, n - count) - _log_likelihood(total, n)
    bounds = (start > 0).astype(int) + (stop < n)
    gain = np.where(usable, gain - 0.5 * math.log(n) - bounds * _bound_cost(n), -np.inf)
    a, b = np.unravel_index(int(gain.argmax()), gain.shape)
    if not gain[a, b] > 0:
        return None
    return float(gain[a, b]), (_cut_value(ranked, int(ends[a])), _cut_value(ranked, int(ends[b])))


def _bound_cost(n: int) -> float:
    """Nats that encode one bound: the choice among the ends that are tried for n samples."""
    return math.log(max(min(n, _MAX_CUTS), 2))


def _cut_value(ranked: Floats, place: int) -> float:
    """The value midway between the neighbours of an end; the outermost value at either end."""
    if place in (0, len(ranked)):
        return float(ranked[min(place, len(ranked) - 1)])
    return float(ranked[place - 1] + ranked[place]) / 2


def _thin_out(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Half as many as `_CUTS` of them, evenly, at most."""
    if len(places) <= _MAX_CUTS // 2:
        return places
    return places[np.linspace(0, len(places) - 1, _MAX_CUTS // 2).round().astype(int)]


def _log_likelihood(hits: NDArray[np.int64] | int, count: NDArray[np.int64] | int) -> Floats:
    """Maximum log-likelihood of `hits` failures among `count` samples."""
    k, n = np.asarray(hits, np.float64), np.asarray(count, np.float64)
    share = np.divide(k, n, out=np.zeros_like(k + n), where=n > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(k * np.log(share), nan=0.0) + np.nan_to_num((n - k) * np.log1p(-share), nan=0.0)


def overlap(one: Mapping[str, tuple[float, float]], two: Mapping[str, tuple[float, float]]) -> float:
    """Overlap in [0, 1] of two rules of the same features: the smallest IoU of their intervals."""
    shares = []
    for name, (low, high) in one.items():
        lower, upper = two[name]
        hull = max(high, upper) - min(low, lower)
        shares.append(max(min(high, upper) - max(low, lower), 0.0) / hull if hull > 0 else 1.0)
    return min(shares, default=1.0)
