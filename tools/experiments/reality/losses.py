"""Losses of recall under drawn weather against those in real weather, by detector, box height and condition.

A loss is the recall on days without the condition, minus the recall in it. Recalls are averaged over fine bins of box
height with the shares of real dry days, so that both sides have equal heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from drivesem.evaluation.conditions import HEIGHT_BINS_PX, average_recalls
from drivesem.evaluation.resampling import Interval
from tools.bench.conditions import DAY, UNDRAWN
from tools.experiments.reality.observations import (
    DRAWN,
    PLACEBO,
    PLAIN,
    PREDICTED,
    REAL,
    Observation,
    frame_numbers,
    missed_flags,
)

Floats = NDArray[np.float64]
HEIGHTS_PX = (30.0, 48.0, 96.0, np.inf)
"""Edges of the height bins whose losses are compared; all are edges of HEIGHT_BINS_PX, or its lowest height."""
LEAST_OBJECTS = 10
"""Objects, real and drawn, below which a point is left out."""


@dataclass(frozen=True, slots=True)
class LossPoint:
    """Losses of recall of one detector in one condition, at one range of box heights."""

    detector: str
    """Name of the detector."""
    condition: str
    """Name of the condition."""
    heights_px: tuple[float, float]
    """Range of box heights."""
    objects: tuple[int, int]
    """Objects in real frames and in drawn ones."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Losses at P points, and in D bootstrap draws of frames."""

    points: tuple[LossPoint, ...]
    """The points."""
    real: Floats
    """(1 + D, P) losses in real frames; the first row is the estimate."""
    drawn: Floats
    """(1 + D, P) losses under drawn weather."""
    placebo: Floats
    """(1 + D, P) losses under the placebo."""


@dataclass(frozen=True, slots=True)
class _Counts:
    """Objects and hits of one set of frames in fine bins of height."""

    objects: Floats
    """(1 + D, B) objects, with the weights of each draw."""
    hits: dict[str, Floats]
    """(1 + D, B) hits by detector."""


def compute_losses(
    rows: Sequence[Observation], detectors: Sequence[str], draws: int, generator: np.random.Generator
) -> Losses:
    """Compute losses at all points with at least `LEAST_OBJECTS` objects on either side.

    Draws of frames are independent between sets of real frames. Undrawn, drawn and placebo pictures show the same
    frames, so they share draws.

    Args:
        rows: Observations of one half.
        detectors: Names of the detectors.
        draws: Number of bootstrap draws.
        generator: Source of random numbers.
    """
    plain_rows = [row for row in rows if row[0].source == PLAIN]
    names = list(dict.fromkeys(one.frame for one, _ in plain_rows))
    weights = draw_weights(len(names), draws, generator)
    plain = _count(plain_rows, detectors, weights)
    with_placebo = {one.frame for one, _ in rows if one.source == PLACEBO}
    # placebos are those of the first days
    plain_of_placebos = _count([row for row in plain_rows if row[0].frame in with_placebo], detectors, weights)
    day = _count_real(rows, DAY, detectors, draws, generator)
    shares = day.objects[0]
    points: list[LossPoint] = []
    columns: dict[str, list[Floats]] = {source: [] for source in (REAL, DRAWN, PLACEBO)}
    observed = {one.condition for one, _ in rows}
    for condition in (name for name in PREDICTED if name in observed):
        real = _count_real(rows, condition, detectors, draws, generator)
        changed = {
            source: _count(_select(rows, condition, source), detectors, weights) for source in (DRAWN, PLACEBO)
        }
        for low, high in pairwise(HEIGHTS_PX):
            inside = np.array([low <= max(edge, HEIGHTS_PX[0]) < high for edge in HEIGHT_BINS_PX[:-1]])
            objects = int(real.objects[0, inside].sum()), int(changed[DRAWN].objects[0, inside].sum())
            if min(objects) < LEAST_OBJECTS:
                continue
            for detector in detectors:
                points.append(LossPoint(detector, condition, (low, high), objects))
                pairs = (
                    (REAL, day, real),
                    (DRAWN, plain, changed[DRAWN]),
                    (PLACEBO, plain_of_placebos, changed[PLACEBO]),
                )
                for source, before, after in pairs:
                    recalls = (
                        average_recalls(c.hits[detector], c.objects, np.where(inside, shares, 0.0))[1]
                        for c in (before, after)
                    )
                    columns[source].append(np.subtract(*recalls))
    real_losses, drawn, placebo = (np.array(columns[source]).T for source in (REAL, DRAWN, PLACEBO))
    return Losses(tuple(points), real_losses, drawn, placebo)


def _select(rows: Sequence[Observation], condition: str, source: str) -> list[Observation]:
    return [row for row in rows if row[0].source == source and row[0].condition in (condition, UNDRAWN)]


def _count_real(
    rows: Sequence[Observation],
    condition: str,
    detectors: Sequence[str],
    draws: int,
    generator: np.random.Generator,
) -> _Counts:
    chosen = _select(rows, condition, REAL)
    frames = len({one.frame for one, _ in chosen})
    return _count(chosen, detectors, draw_weights(frames, draws, generator))


def draw_weights(frames: int, draws: int, generator: np.random.Generator) -> Floats:
    """How often each frame counts (1 + D, F): once, and in each draw."""
    drawn = generator.multinomial(frames, np.full(frames, 1 / max(frames, 1)), size=draws)
    return np.concatenate([np.ones((1, frames)), drawn.astype(np.float64)])


def _count(rows: Sequence[Observation], detectors: Sequence[str], weights: Floats) -> _Counts:
    frame, bins = frame_numbers(rows), len(HEIGHT_BINS_PX) - 1
    place = np.digitize([features.height_px for _, features in rows], HEIGHT_BINS_PX[1:-1])

    def table(values: NDArray[np.bool_]) -> Floats:
        counts = np.zeros((weights.shape[1], bins))
        np.add.at(counts, (frame, place), values)
        return weights @ counts

    hits = {name: table(~missed_flags(rows, name)) for name in detectors}
    return _Counts(table(np.ones(len(rows), bool)), hits)


@dataclass(frozen=True, slots=True)
class Agreement:
    """How well one set of losses predicts another, with 95 % bootstrap intervals."""

    rank_correlation: Interval
    """Spearman's."""
    same_sign: Interval
    """Share of points at which both losses have the same sign."""
    slope: Interval
    """Slope of real losses over predicted ones, by least squares with an intercept; 1 is calibrated."""
    error: Interval
    """Mean absolute difference, in recall."""
    bias: Interval
    """Mean of the predicted losses minus the real ones, in recall."""


def compare_losses(predicted: Floats, real: Floats) -> Agreement:
    """Compare predicted and real losses.

    Args:
        predicted: (1 + D, P); the first row is the estimate.
        real: (1 + D, P).
    """
    measures = {
        "rank_correlation": _rank_correlation,
        "same_sign": lambda a, b: float((a * b > 0).mean()),
        "slope": _slope,
        "error": lambda a, b: float(np.abs(a - b).mean()),
        "bias": lambda a, b: float((a - b).mean()),
    }
    intervals = {}
    for name, measure in measures.items():
        values = []
        for one, other in zip(predicted, real, strict=True):
            known = np.isfinite(one) & np.isfinite(other)
            values.append(measure(one[known], other[known]))
        intervals[name] = to_interval(name, np.array(values))
    return Agreement(**intervals)


def to_interval(name: str, values: Floats) -> Interval:
    """The first value as the estimate, and the 95 % percentile interval of the others, without what is not finite."""
    drawn = values[1:][np.isfinite(values[1:])]
    low, high = np.quantile(drawn, [0.025, 0.975]).tolist() if len(drawn) else (None, None)
    return Interval(name, float(values[0]) if np.isfinite(values[0]) else None, low, high)


def _rank_correlation(one: Floats, other: Floats) -> float:
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return float("nan")
    return float(np.corrcoef(rankdata(one), rankdata(other))[0, 1])


def _slope(predicted: Floats, real: Floats) -> float:
    spread = float(predicted.var())
    if spread == 0:
        return float("nan")
    return float(((predicted - predicted.mean()) * (real - real.mean())).mean() / spread)
