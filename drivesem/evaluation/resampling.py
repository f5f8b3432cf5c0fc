"""Uncertainty of metrics: bootstrap over frames, and paired tests of two detectors on the same frames.

Frames are drawn instead of objects, as detections in one image are correlated. Intervals are percentiles (Efron 1979).
The paired test swaps the two detectors' detections in random frames, which would not matter if both were equal; p is
the share of swaps with at least the observed difference, including the observed one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivesem.evaluation.curves import ClassMatches, InterpolationRule, average_precision
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.kitti import KittiCurve

LEVEL = 0.95
"""Share of draws inside an interval."""
DRAWS = 200
"""Default number of bootstrap draws."""
_Z_95 = 1.959964
"""Two-sided 95 % quantile of the normal distribution."""


@dataclass(frozen=True, slots=True)
class WeightedAveragePrecision:
    """Average precision of one class under weights of the frames."""

    matches: ClassMatches
    """Matches of the class."""
    rule: InterpolationRule
    """How recall is sampled."""

    def value(self, weights: Floats | None) -> float | None:
        """The metric under weights (F,) of the frames; None where no object is drawn."""
        return average_precision(self.matches, self.rule, weights)

    def concatenate(self, other: WeightedAveragePrecision) -> WeightedAveragePrecision:
        """Join both detectors' frames: the other's follow this one's."""
        return replace(self, matches=_concatenate(self.matches, other.matches))


@dataclass(frozen=True, slots=True)
class WeightedKittiPrecision:
    """KITTI's R40 of one curve under weights of the frames."""

    curve: KittiCurve
    """Matches of one class at one difficulty."""

    def value(self, weights: Floats | None) -> float | None:
        """The metric under weights (F,) of the frames; None where no object is drawn."""
        return self.curve.r40(weights)

    def concatenate(self, other: WeightedKittiPrecision) -> WeightedKittiPrecision:
        """Join both detectors' frames: the other's follow this one's."""
        a, b = self.curve, other.curve
        frames = len(a.matches.objects)
        joined = replace(
            a,
            matches=_concatenate(a.matches, b.matches),
            collected_score=np.concatenate([a.collected_score, b.collected_score]),
            collected_frame=np.concatenate([a.collected_frame, b.collected_frame + frames]),
        )
        return WeightedKittiPrecision(joined)


@dataclass(frozen=True, slots=True)
class WeightedRecall:
    """Recall of one class with all detections under weights of the frames."""

    matches: ClassMatches
    """Matches of the class."""

    def value(self, weights: Floats | None) -> float | None:
        """The metric under weights (F,) of the frames; None where no object is drawn."""
        objects = self.matches.object_count(weights)
        if objects <= 0:
            return None
        hits, _ = self.matches.cumulative_counts(weights)
        return float(hits[-1]) / objects if len(hits) else 0.0

    def concatenate(self, other: WeightedRecall) -> WeightedRecall:
        """Join both detectors' frames: the other's follow this one's."""
        return WeightedRecall(_concatenate(self.matches, other.matches))


WeightedMetric = WeightedAveragePrecision | WeightedKittiPrecision | WeightedRecall


@dataclass(frozen=True, slots=True)
class NamedMetric:
    """A named metric: the mean over those of its parts that have objects."""

    name: str
    """Name of the metric."""
    parts: tuple[WeightedMetric, ...]
    """Metrics of classes."""

    def value(self, weights: Floats | None = None) -> float | None:
        """The metric under weights (F,) of the frames; None where no part has objects."""
        known = [v for part in self.parts if (v := part.value(weights)) is not None]
        return sum(known) / len(known) if known else None

    def concatenate(self, other: NamedMetric) -> NamedMetric:
        """Join both detectors' metrics over twice the frames."""
        pairs = zip(self.parts, other.parts, strict=True)
        return NamedMetric(self.name, tuple(a.concatenate(b) for a, b in pairs))  # pyright: ignore[reportArgumentType]


def ratio_metric(name: str, hits: Floats, totals: Floats) -> NamedMetric:
    """A ratio of sums over frames.

    Args:
        name: Name of the metric.
        hits: (F,) numerators.
        totals: (F,) denominators.
    """
    count = len(hits)
    matches = ClassMatches(np.ones(count), np.arange(count), hits, np.zeros(count), totals)
    return NamedMetric(name, (WeightedRecall(matches),))


def _concatenate(a: ClassMatches, b: ClassMatches) -> ClassMatches:
    score = np.concatenate([a.score, b.score])
    order = np.argsort(-score, kind="stable")
    return ClassMatches(
        score=score[order],
        frame=np.concatenate([a.frame, b.frame + len(a.objects)])[order],
        true_positives=np.concatenate([a.true_positives, b.true_positives])[order],
        false_positives=np.concatenate([a.false_positives, b.false_positives])[order],
        objects=np.concatenate([a.objects, b.objects]),
    )


@dataclass(frozen=True, slots=True)
class Interval:
    """A metric and the bounds that enclose `LEVEL` of the draws; None without objects."""

    name: str
    """Name of the metric."""
    value: float | None
    """Its value."""
    low: float | None
    """Lower bound."""
    high: float | None
    """Upper bound."""


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Difference of a metric between two detectors."""

    name: str
    """Name of the metric."""
    first: float | None
    """Value of the first detector."""
    second: float | None
    """Value of the second detector."""
    difference: float | None
    """Second minus first."""
    low: float | None
    """Lower bound of the paired bootstrap."""
    high: float | None
    """Upper bound of the paired bootstrap."""
    p: float | None
    """p value of the two-sided permutation test."""

    @property
    def interval(self) -> Interval:
        """The difference and its bounds."""
        return Interval(self.name, self.difference, self.low, self.high)


def bootstrap_intervals(
    metrics: Sequence[NamedMetric], frames: int, draws: int, generator: np.random.Generator
) -> list[Interval]:
    """Compute bootstrap intervals of metrics on the same frames and draws.

    Args:
        metrics: Metrics.
        frames: Number of frames.
        draws: Number of draws.
        generator: Source of random numbers.
    """
    weights = _draws(frames, draws, generator)
    found: list[Interval] = []
    for metric in metrics:
        low, high = _bounds([metric.value(w) for w in weights])
        found.append(Interval(metric.name, metric.value(), low, high))
    return found


def paired_differences(
    first: Sequence[NamedMetric],
    second: Sequence[NamedMetric],
    frames: int,
    draws: int,
    generator: np.random.Generator,
    test: bool = True,
) -> list[PairedDifference]:
    """Compute paired differences of two detectors on the same frames.

    Args:
        first: Metrics of the first detector.
        second: The same metrics of the second one.
        frames: Number of frames.
        draws: Number of draws.
        generator: Source of random numbers.
        test: Whether to add the permutation test, which doubles the time.
    """
    weights = _draws(frames, draws, generator)
    swaps = generator.random((draws if test else 0, frames)) < 0.5
    found: list[PairedDifference] = []
    for a, b in zip(first, second, strict=True):
        va, vb = a.value(), b.value()
        if va is None or vb is None:
            found.append(PairedDifference(a.name, va, vb, None, None, None, None))
            continue
        low, high = _bounds([_minus(b.value(w), a.value(w)) for w in weights])
        joined = a.concatenate(b) if test else a
        extreme = 0
        for swap in swaps.astype(np.float64):
            swapped = _minus(
                joined.value(np.concatenate([swap, 1 - swap])), joined.value(np.concatenate([1 - swap, swap]))
            )
            # tolerance: the same sum in another order must count as equal
            extreme += swapped is not None and abs(swapped) >= abs(vb - va) - 1e-12
        p = (1 + extreme) / (1 + len(swaps)) if len(swaps) else None
        found.append(PairedDifference(a.name, va, vb, vb - va, low, high, p))
    return found


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _draws(frames: int, draws: int, generator: np.random.Generator) -> list[Floats]:
    """Draw `frames` frames with replacement, `draws` times: how often each is drawn (F,). One frame varies in
    nothing, and has no interval.
    """
    if frames < 2:
        return []
    shares = np.full(frames, 1 / frames)
    return [generator.multinomial(frames, shares).astype(np.float64) for _ in range(draws)]


def _bounds(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    known = [v for v in values if v is not None]
    if not known:
        return None, None
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def holm(ps: Sequence[float | None]) -> list[float | None]:
    """Adjust the p values of one table for multiple testing (Holm 1979); None stays."""
    known = sorted((p, i) for i, p in enumerate(ps) if p is not None)
    found: list[float | None] = [None] * len(ps)
    least = 0.0
    for rank, (p, i) in enumerate(known):
        least = max(least, min(1.0, p * (len(known) - rank)))
        found[i] = least
    return found


def wilson(found: int, count: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson 1927). Raises ValueError unless 0 <= found <= count and count >= 1."""
    if count < 1 or not 0 <= found <= count:
        raise ValueError(f"share: expected 0 to all of at least one, found {found} of {count}")
    share, z2 = found / count, _Z_95 * _Z_95
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = _Z_95 / (1 + z2 / count) * math.sqrt(share * (1 - share) / count + z2 / (4 * count * count))
    return max(middle - half, 0.0), min(middle + half, 1.0)


@dataclass(frozen=True, slots=True)
class Proportion:
    """A count out of a number, with the 95 % Wilson interval of the share."""

    count: int
    """How many."""
    of: int
    """Out of how many."""
    low: float | None
    """Lower end of the interval, in [0, 1]; None out of none."""
    high: float | None
    """Upper end."""

    @classmethod
    def from_counts(cls, count: int, of: int) -> Proportion:
        """Add the interval."""
        return cls(count, of, *(wilson(count, of) if of else (None, None)))

    @property
    def percent(self) -> str:
        """The share and its interval, such as `38 % [14, 69]`; "" out of none."""
        if self.low is None or self.high is None:
            return ""
        return f"{100 * self.count / self.of:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"

    def format(self, noun: str = "") -> str:
        """Such as `3 of 8 cars (38 % [14, 69])`."""
        text = f"{self.count} of {self.of}{noun and f' {noun}'}"
        return f"{text} ({self.percent})" if self.of else text


@dataclass(frozen=True, slots=True)
class ClusteredShare:
    """A share of draws that fail, where draws of one frame fail together."""

    failing: int
    """Number of draws that fail."""
    draws: int
    """Number of draws."""
    frames: int
    """Number of frames with draws."""
    value: float
    """Their share, in [0, 1]."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end."""

    @classmethod
    def from_frames(cls, counts: Sequence[tuple[int, int]]) -> ClusteredShare | None:
        """Estimate the share from failing draws and draws of each frame; see `clustered_interval`. None for fewer than
        two frames with draws.
        """
        failing, draws = np.array([pair for pair in counts if pair[1]], np.float64).reshape(-1, 2).T
        frames, total = len(draws), float(draws.sum())
        if frames < 2:
            return None
        value = float(failing.sum()) / total
        low, high = clustered_interval(value, (failing - value * draws) / total, total)
        return cls(int(failing.sum()), int(total), frames, value, low, high)


def clustered_interval(value: float, influences: np.ndarray, draws: float) -> tuple[float, float]:
    """95 % interval of a share: that of Clopper and Pearson for the effective number of draws, as many independent ones
    as would vary like the share between frames, less for few frames (Korn and Graubard 1998). Where no draw or each one
    fails, frames are the draws.

    Args:
        value: The share, in [0, 1].
        influences: (F,), of each frame on the share; their sum is 0.
        draws: Number of draws.
    """
    from scipy.special import betaincinv, stdtrit  # imported on use: it takes a tenth of a second

    frames = len(influences)
    effective = float(frames)
    if 0 < value < 1:
        variance = frames / (frames - 1) * float((influences**2).sum())
        student = float(stdtrit(frames - 1, 0.5 + LEVEL / 2))
        effective = min(value * (1 - value) / max(variance, 1e-12), draws) * (_Z_95 / student) ** 2
    hits, tail = value * effective, (1 - LEVEL) / 2
    low = float(betaincinv(hits, effective - hits + 1, tail)) if hits > 0 else 0.0
    high = float(betaincinv(hits + 1, effective - hits, 1 - tail)) if value < 1 else 1.0
    return low, high


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> tuple[float, float]:
    """95 % interval of the difference between two independent proportions, second minus first (Newcombe 1998, method
    10). Each is a pair of successes and count; raises ValueError as `wilson` does.
    """
    (low, high), (lower, upper) = wilson(*first), wilson(*second)
    one, other = first[0] / first[1], second[0] / second[1]
    difference = other - one
    return (
        difference - math.hypot(other - lower, high - one),
        difference + math.hypot(upper - other, one - low),
    )
