"""How sure a figure is: bootstrap over frames, and paired tests of two detectors on the same frames.

Frames, not objects, are drawn: what a detector finds in one image hangs together. Intervals are percentiles (Efron
1979). The paired test swaps the two detectors' detections in random frames: if both were alike, no swap would
matter; p is the share of swaps whose difference is at least the observed one, the observed one included.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivesem.evaluation.curves import Rule, Tally, average_precision
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.kitti import Curve

LEVEL = 0.95
"""Share of draws inside an interval."""
DRAWS = 200
"""Bootstrap draws by default."""
_Z_95 = 1.959964
"""Of the normal distribution, two-sided 95 %."""


@dataclass(frozen=True, slots=True)
class Averaged:
    """Average precision of one tally by one rule, at weights of frames."""

    tally: Tally
    rule: Rule

    def value(self, weights: Floats | None) -> float | None:
        """None where no object is drawn."""
        return average_precision(self.tally, self.rule, weights)

    def beside(self, other: Averaged) -> Averaged:
        """Both at once: the other's frames are counted on from this one's."""
        return replace(self, tally=_beside(self.tally, other.tally))


@dataclass(frozen=True, slots=True)
class Sampled:
    """KITTI's R40 of one curve, at weights of frames."""

    curve: Curve

    def value(self, weights: Floats | None) -> float | None:
        """None where no object is drawn."""
        return self.curve.r40(weights)

    def beside(self, other: Sampled) -> Sampled:
        """Both at once: the other's frames are counted on from this one's."""
        a, b = self.curve, other.curve
        frames = len(a.tally.objects)
        joined = replace(
            a,
            tally=_beside(a.tally, b.tally),
            collected_score=np.concatenate([a.collected_score, b.collected_score]),
            collected_frame=np.concatenate([a.collected_frame, b.collected_frame + frames]),
        )
        return Sampled(joined)


@dataclass(frozen=True, slots=True)
class Recalled:
    """Recall of one tally with all its detections, at weights of frames."""

    tally: Tally

    def value(self, weights: Floats | None) -> float | None:
        """None where no object is drawn."""
        objects = self.tally.count(weights)
        if objects <= 0:
            return None
        hits, _ = self.tally.curve(weights)
        return float(hits[-1]) / objects if len(hits) else 0.0

    def beside(self, other: Recalled) -> Recalled:
        """Both at once: the other's frames are counted on from this one's."""
        return Recalled(_beside(self.tally, other.tally))


Part = Averaged | Sampled | Recalled


@dataclass(frozen=True, slots=True)
class Figure:
    """A named figure: the mean of its parts that have objects."""

    name: str
    parts: tuple[Part, ...]

    def value(self, weights: Floats | None = None) -> float | None:
        """At weights (F,) of the frames; None where no part has objects."""
        known = [v for part in self.parts if (v := part.value(weights)) is not None]
        return sum(known) / len(known) if known else None

    def beside(self, other: Figure) -> Figure:
        """Both detectors' figures in one, over twice the frames."""
        pairs = zip(self.parts, other.parts, strict=True)
        return Figure(self.name, tuple(a.beside(b) for a, b in pairs))  # pyright: ignore[reportArgumentType]


def rate(name: str, hits: Floats, of: Floats) -> Figure:
    """So many `hits` (F,) a frame of so many (F,): a share, or another ratio of sums over frames."""
    count = len(hits)
    return Figure(name, (Recalled(Tally(np.ones(count), np.arange(count), hits, np.zeros(count), of)),))


def _beside(a: Tally, b: Tally) -> Tally:
    score = np.concatenate([a.score, b.score])
    order = np.argsort(-score, kind="stable")
    return Tally(
        score=score[order],
        frame=np.concatenate([a.frame, b.frame + len(a.objects)])[order],
        hits=np.concatenate([a.hits, b.hits])[order],
        misfires=np.concatenate([a.misfires, b.misfires])[order],
        objects=np.concatenate([a.objects, b.objects]),
    )


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure and the bounds within which LEVEL of the draws lie; None where it has no objects."""

    name: str
    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Difference:
    """Second detector minus first. low, high: of the paired bootstrap; p: of the permutation test, two-sided."""

    name: str
    first: float | None
    second: float | None
    difference: float | None
    low: float | None
    high: float | None
    p: float | None

    @property
    def interval(self) -> Interval:
        """The difference and its bounds."""
        return Interval(self.name, self.difference, self.low, self.high)


def intervals(
    figures: Sequence[Figure], frames: int, draws: int, generator: np.random.Generator
) -> list[Interval]:
    """Bootstrap intervals of figures that share frames; all see the same draws."""
    weights = _draws(frames, draws, generator)
    found: list[Interval] = []
    for figure in figures:
        low, high = _bounds([figure.value(w) for w in weights])
        found.append(Interval(figure.name, figure.value(), low, high))
    return found


def differences(
    first: Sequence[Figure],
    second: Sequence[Figure],
    frames: int,
    draws: int,
    generator: np.random.Generator,
    test: bool = True,
) -> list[Difference]:
    """Paired differences of the same figures of two detectors on the same frames. test: with the permutation test,
    which takes as long again.
    """
    weights = _draws(frames, draws, generator)
    swaps = generator.random((draws if test else 0, frames)) < 0.5
    found: list[Difference] = []
    for a, b in zip(first, second, strict=True):
        va, vb = a.value(), b.value()
        if va is None or vb is None:
            found.append(Difference(a.name, va, vb, None, None, None, None))
            continue
        low, high = _bounds([_minus(b.value(w), a.value(w)) for w in weights])
        both = a.beside(b)
        extreme = 0
        for swap in swaps.astype(np.float64):
            swapped = _minus(
                both.value(np.concatenate([swap, 1 - swap])), both.value(np.concatenate([1 - swap, swap]))
            )
            # a hair's breadth: the same sum in another order must count as equal
            extreme += swapped is not None and abs(swapped) >= abs(vb - va) - 1e-12
        p = (1 + extreme) / (1 + len(swaps)) if len(swaps) else None
        found.append(Difference(a.name, va, vb, vb - va, low, high, p))
    return found


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _draws(frames: int, draws: int, generator: np.random.Generator) -> list[Floats]:
    """How often each frame is drawn, `frames` times with replacement."""
    if not frames:
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
    """p values of one table, each as small as may be said when all are looked at (Holm 1979); None stays."""
    known = sorted((p, i) for i, p in enumerate(ps) if p is not None)
    found: list[float | None] = [None] * len(ps)
    least = 0.0
    for rank, (p, i) in enumerate(known):
        least = max(least, min(1.0, p * (len(known) - rank)))
        found[i] = least
    return found


def wilson(found: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share, after Wilson (1927). ValueError unless 0 <= found <= count and count >= 1."""
    if count < 1 or not 0 <= found <= count:
        raise ValueError(f"share: expected 0 to all of at least one, found {found} of {count}")
    share, z2 = found / count, _Z_95 * _Z_95
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = _Z_95 / (1 + z2 / count) * math.sqrt(share * (1 - share) / count + z2 / (4 * count * count))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> tuple[float, float]:
    """The 95 % interval of how much larger the second of two independent shares is, each so many found of a count:
    of both shares' `wilson` intervals, after Newcombe (1998), method 10. ValueError as of `wilson`.
    """
    (low, high), (lower, upper) = wilson(*first), wilson(*second)
    one, other = first[0] / first[1], second[0] / second[1]
    difference = other - one
    return (
        difference - math.hypot(other - lower, high - one),
        difference + math.hypot(upper - other, one - low),
    )
