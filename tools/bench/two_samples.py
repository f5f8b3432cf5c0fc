"""Do two sets of pictures differ? Distances of distributions, and a linear probe that separates them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata, wasserstein_distance

Floats = NDArray[np.float64]

_LEVEL = 0.95
_FOLDS, _REPEATS = 5, 4
"""Parts of the cross-validation, and random partitions that are averaged."""
_PENALTY = 0.1
"""Weight of half the squared weights in the loss, which is a mean over frames; for standardised features."""


@dataclass(frozen=True, slots=True)
class DistributionComparison:
    """One measure of real frames and of drawn ones."""

    real: tuple[float, float, float]
    """Quartiles of the real frames."""
    drawn: tuple[float, float, float]
    """Quartiles of the drawn frames."""
    distance: float | None
    """Wasserstein distance as a share of the real interquartile range; None where that is 0."""
    low: float | None
    """Lower end of its 95 % bootstrap interval over frames."""
    high: float | None
    """Upper end."""

    @property
    def inside(self) -> bool:
        """Whether the median of the drawn frames lies within the real quartiles."""
        return self.real[0] <= self.drawn[1] <= self.real[2]


def compare_distributions(
    real: Floats, drawn: Floats, draws: int, generator: np.random.Generator
) -> DistributionComparison:
    """Compare the values of frames (N,) and (M,), each with at least one.

    Args:
        real: Values of real frames; their interquartile range is the unit of the distance.
        drawn: Values of drawn frames.
        draws: Number of bootstrap draws, in which both sets are drawn anew; 0 for no interval.
        generator: Source of random numbers.
    """
    quartiles, others = (np.quantile(values, [0.25, 0.5, 0.75]) for values in (real, drawn))
    unit = float(quartiles[2] - quartiles[0])
    distance, low, high = None, None, None
    if unit > 0:
        distance = float(wasserstein_distance(real, drawn)) / unit
        again = [
            wasserstein_distance(generator.choice(real, len(real)), generator.choice(drawn, len(drawn))) / unit
            for _ in range(draws)
        ]
        low, high = _interval(np.array(again)) if draws else (None, None)
    first, second, third = (float(value) for value in quartiles)
    return DistributionComparison(
        (first, second, third), (float(others[0]), float(others[1]), float(others[2])), distance, low, high
    )


@dataclass(frozen=True, slots=True)
class ProbeResult:
    """How well a probe separates two sets of frames."""

    auc: float
    """Area under the ROC curve of held-out frames: 0.5 if nothing separates the sets, 1 if all is recognised."""
    low: float
    """Lower end of its 95 % bootstrap interval over frames; probes are not trained anew."""
    high: float
    """Upper end."""
    frames: tuple[int, int]
    """Frames of both sets."""


def probe_sets(first: Floats, second: Floats, draws: int, generator: np.random.Generator) -> ProbeResult | None:
    """Train logistic regressions to separate two sets of frames, cross-validated by frame.

    Each frame's score is the mean over four random partitions into five parts, from probes that were not trained on
    it. Both sets count alike in the loss.

    Args:
        first: Features (N, D) of the frames of one set.
        second: Features (M, D) of the other.
        draws: Number of bootstrap draws.
        generator: Source of random numbers.

    Returns:
        The result; None for sets with fewer frames than parts.
    """
    if min(len(first), len(second)) < _FOLDS:
        return None
    features = np.concatenate([first, second])
    is_second = np.repeat([False, True], [len(first), len(second)])
    scores = np.zeros(len(features))
    for _ in range(_REPEATS):
        part = np.empty(len(features), np.int64)
        for group in (is_second, ~is_second):
            part[group] = generator.permutation(int(group.sum())) % _FOLDS
        for fold in range(_FOLDS):
            held_out = part == fold
            scores[held_out] += _train_and_score(features, is_second, held_out)
    again = []
    for _ in range(draws):
        drawn = [generator.choice(np.flatnonzero(group), int(group.sum())) for group in (~is_second, is_second)]
        again.append(roc_area(scores[drawn[0]], scores[drawn[1]]))
    low, high = _interval(np.array(again))
    return ProbeResult(roc_area(scores[~is_second], scores[is_second]), low, high, (len(first), len(second)))


def roc_area(lower: Floats, higher: Floats) -> float:
    """Share of pairs in which the second set's score is higher; ties count half."""
    ranks = rankdata(np.concatenate([lower, higher]))[len(lower) :]
    return float((ranks.sum() - len(higher) * (len(higher) + 1) / 2) / (len(lower) * len(higher)))


def _train_and_score(features: Floats, is_second: NDArray[np.bool_], held_out: NDArray[np.bool_]) -> Floats:
    """Logits of the held-out frames by a probe trained on the others."""
    train, target = features[~held_out], is_second[~held_out]
    mean, deviation = train.mean(axis=0), train.std(axis=0)
    scale = np.where(deviation > 0, deviation, 1.0)
    inputs = np.column_stack([(train - mean) / scale, np.ones(len(train))])
    sign = np.where(target, 1.0, -1.0)
    weight = np.where(target, 0.5 / target.sum(), 0.5 / (~target).sum())

    def loss(w: Floats) -> tuple[float, Floats]:
        margin = sign * (inputs @ w)
        gradient = -inputs.T @ (weight * sign * expit(-margin))
        gradient[:-1] += _PENALTY * w[:-1]
        value = weight @ np.logaddexp(0, -margin) + _PENALTY / 2 * (w[:-1] @ w[:-1])
        return float(value), gradient

    best = minimize(loss, np.zeros(inputs.shape[1]), jac=True, method="L-BFGS-B").x
    return (features[held_out] - mean) / scale @ best[:-1] + best[-1]


def _interval(values: Floats) -> tuple[float, float]:
    low, high = np.quantile(values, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return float(low), float(high)
