"""Figures of pictures that are classified rightly or not: by class, overall, with intervals over objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivesem.evaluation.resampling import Interval, bootstrap_intervals, ratio_metric
from tools.experiments.worth.measures import Floats, Integers


@dataclass(frozen=True, slots=True)
class RatioBootstrap:
    """How intervals are drawn."""

    draws: int
    seed: int

    def ratio(self, hits: Floats, of: Floats, unit: Integers) -> Interval:
        """sum hits / sum of, both (M,), and its interval: what is drawn are units (M,), such as objects."""
        places, inverse = np.unique(unit, return_inverse=True)
        sums = [np.bincount(inverse, values, len(places)).astype(np.float64) for values in (hits, of)]
        rng = np.random.default_rng(self.seed)
        return bootstrap_intervals([ratio_metric("ratio", *sums)], len(places), self.draws, rng)[0]


@dataclass(frozen=True, slots=True)
class Predictions:
    """What a network made of pictures. right (M,) bool; label (M,): a class's place; unit (M,): which object."""

    correct: np.ndarray
    label: Integers
    object_id: Integers

    def by_class(self, count: int) -> list[float | None]:
        """Accuracy within each class; None of a class without pictures."""
        own = [self.correct[self.label == place] for place in range(count)]
        return [float(right.mean()) if len(right) else None for right in own]

    def overall(self, drawing: RatioBootstrap, sizes: Sequence[int] | None = None) -> Interval:
        """The mean of the classes' accuracies weighed by their sizes; sizes: by default those of these pictures,
        which is the share of all pictures. Classes without pictures count for nothing.
        """
        weights = np.ones(len(self.label))
        if sizes is not None:
            counts = np.bincount(self.label, minlength=len(sizes))
            weights = (np.asarray(sizes) / np.maximum(counts, 1))[self.label]
        return drawing.ratio(self.correct * weights, weights, self.object_id)

    def accuracy_drop(self, other: Predictions, drawing: RatioBootstrap) -> Interval:
        """By how much the overall accuracy is below the other's on the same pictures, paired."""
        return drawing.ratio(other.correct.astype(np.float64) - self.correct, np.ones(len(self.correct)), self.object_id)


def sample_stratified(labels: Sequence[int], size: int, generator: np.random.Generator) -> list[int]:
    """Places of `size` of these at random, so that classes keep their shares: of each class its share of `size`
    rounded down, and one more of those that lose most by that. All where there are not more than that.
    """
    whole = np.asarray(labels, np.int64)
    if size >= len(whole):
        return list(range(len(whole)))
    counts = np.bincount(whole)
    wanted = counts * size / len(whole)
    taken = np.floor(wanted).astype(np.int64)
    more = np.argsort(taken - wanted, kind="stable")[: size - int(taken.sum())]
    taken[more] += 1
    drawn = [generator.permutation(np.flatnonzero(whole == label))[:n] for label, n in enumerate(taken)]
    return sorted(int(place) for places in drawn for place in places)


def judge_order(theirs: float, ours: Interval) -> str:
    """Whether the order of two figures is the paper's. theirs, ours: by how much the first is below the second;
    undecided: the interval has 0 inside.
    """
    if ours.value is None or ours.low is None or ours.high is None or ours.low <= 0 <= ours.high:
        return "undecided"
    return "holds" if math.copysign(1, theirs) == math.copysign(1, ours.value) else "reversed"
