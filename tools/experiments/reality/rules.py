"""Failure rules found by attacks on dry days, and how much more often detectors miss what lies inside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivesem.evaluation.resampling import Interval
from drivesem.failures.rules import Floats, Intervals, contains, description_length, fit_rule, fit_rule_list
from tools.experiments.reality.features import FEATURES, ObjectFeatures
from tools.experiments.reality.losses import HEIGHTS_PX, to_interval
from tools.experiments.reality.observations import ADVERSE, REAL, Observation, frame_numbers, missed_flags
from tools.experiments.reality.samples import TABLE, RuleSample, read_samples

RULE_FEATURES = tuple(name for name in FEATURES if name != "height_px")
"""Features of rules. Objects are compared at equal heights, where a rule of height alone says nothing."""


@dataclass(frozen=True, slots=True)
class TransferRule:
    """A rule found by attacking a detector on dry days, and its placebo."""

    detector: str
    """Name of the attacked detector."""
    where: Intervals
    """Interval of each feature."""
    objects: int
    """Sampled objects that are missed inside it."""
    placebo: Intervals
    """A random box of the same size in the space of features."""

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        parts = {"where": self.where, "placebo": self.placebo}
        boxes = {key: {name: list(ends) for name, ends in box.items()} for key, box in parts.items()}
        return {"detector": self.detector, "objects": self.objects, **boxes}


def feature_columns(features: Sequence[ObjectFeatures]) -> dict[str, Floats]:
    """Values (N,) of each feature."""
    return {name: np.array([getattr(one, name) for one in features], np.float64) for name in FEATURES}


def choose_rules(samples: Sequence[RuleSample], detector: str, count: int, seed: int) -> list[TransferRule]:
    """Fit rules to the samples of an attacked detector, with the fit that `drivesem holes` uses for several failures.

    First comes the list of rules that predict misses of held-out objects. Then, for each feature that none of them
    has, comes its best interval, those with the shortest description of the misses first.

    Args:
        samples: All samples.
        detector: Name of the attacked detector.
        count: Largest number of rules.
        seed: Seed of the placebos.
    """
    own = [row for row in samples if row[0].detector == detector]
    columns = feature_columns([features for _, features in own])
    fitted = {name: columns[name] for name in RULE_FEATURES}
    missed = np.array([one.missed for one, _ in own], bool)
    keys = [(one.frame, one.number) for one, _ in own]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    objects = np.array([numbers[key] for key in keys], np.int64)
    if not missed.any():
        return []
    found = [rule.intervals for rule in fit_rule_list(fitted, missed, objects)]
    unused = [name for name in RULE_FEATURES if not any(name in where for where in found)]
    single = [fit_rule(fitted, missed, most=1, only=[name]).intervals for name in unused]
    found += sorted(filter(None, single), key=lambda where: description_length(where, fitted, missed))
    generator = np.random.default_rng([seed, len(own)])
    rules = []
    for where in found[:count]:
        inside = contains(where, columns, len(own)) & missed
        placebo = random_box(where, columns, generator)
        rules.append(TransferRule(detector, _round(where), len(np.unique(objects[inside])), _round(placebo)))
    return rules


def fit_stored_rules(folder: Path, count: int, seed: int) -> list[TransferRule]:
    """Rules of all detectors with samples in a folder, at most `count` of each."""
    rules = []
    for path in sorted(folder.glob(TABLE.format("*"))):
        samples = read_samples(path)
        for name in dict.fromkeys(one.detector for one, _ in samples):
            rules += choose_rules(samples, name, count, seed)
    return rules


def _round(where: Intervals) -> Intervals:
    return {name: (round(low, 4), round(high, 4)) for name, (low, high) in where.items()}


def random_box(where: Intervals, columns: Mapping[str, Floats], generator: np.random.Generator) -> Intervals:
    """A box of as many random features, each interval of which holds as large a share of the samples as the rule's.

    Args:
        where: The rule.
        columns: Values (N,) of each feature in the samples.
        generator: Source of random numbers.
    """
    chosen = generator.choice(len(RULE_FEATURES), size=len(where), replace=False)
    box: Intervals = {}
    for index, (name, (low, high)) in zip(chosen, where.items(), strict=True):
        values = columns[name]
        share = float(((values >= low) & (values <= high)).mean())
        start = generator.uniform(0, max(1 - share, 0.0))
        ends = np.quantile(columns[RULE_FEATURES[index]], [start, min(start + share, 1.0)])
        box[RULE_FEATURES[index]] = (float(ends[0]), float(ends[1]))
    return box


@dataclass(frozen=True, slots=True)
class RuleLift:
    """How often a detector misses real objects inside a rule, and matched objects outside."""

    inside: tuple[int, int]
    """Missed and all objects inside, in strata with objects on both sides."""
    rate: Interval
    """Share of missed objects inside."""
    outside: Interval
    """The same of objects outside, at the strata of those inside."""
    lift: Interval
    """Ratio of both (Mantel and Haenszel)."""

    @property
    def above(self) -> bool:
        """Whether the lift's interval lies above 1."""
        return self.lift.low is not None and self.lift.low > 1

    @property
    def apart(self) -> bool:
        """Whether the lift is above 1 and the intervals of both shares are apart."""
        return (
            self.rate.low is not None
            and self.outside.high is not None
            and self.lift.value is not None
            and self.lift.value > 1
            and self.rate.low > self.outside.high
        )


def adverse_rows(rows: Sequence[Observation]) -> list[Observation]:
    """Observations in real frames of adverse conditions."""
    return [row for row in rows if row[0].source == REAL and row[0].condition in ADVERSE]


def strata(rows: Sequence[Observation], by_condition: bool) -> NDArray[np.int64]:
    """Stratum (N,) of each object: its height bin, whether it is hidden, and if wanted its condition."""
    heights = np.digitize([features.height_px for _, features in rows], HEIGHTS_PX[1:-1])
    keys = [
        (int(height), one.hidden, one.condition if by_condition else "")
        for height, (one, _) in zip(heights, rows, strict=True)
    ]
    numbers = {key: i for i, key in enumerate(sorted(set(keys)))}
    return np.array([numbers[key] for key in keys], np.int64)


def measure_lift(
    inside: NDArray[np.bool_],
    missed: NDArray[np.bool_],
    stratum: NDArray[np.int64],
    frame: NDArray[np.int64],
    weights: Floats,
) -> RuleLift:
    """Compare misses inside and outside a rule within strata; intervals by bootstrap over frames.

    Args:
        inside: (N,) objects inside the rule.
        missed: (N,) objects that are missed.
        stratum: (N,) stratum of each object.
        frame: (N,) frame of each object.
        weights: (1 + D, F) how often each frame counts; the first row is all ones.
    """
    count = int(stratum.max()) + 1

    def table(chosen: NDArray[np.bool_]) -> Floats:
        values = np.zeros((weights.shape[1], count))
        np.add.at(values, (frame, stratum), chosen)
        return weights @ values

    n1, m1, n0, m0 = (table(part) for part in (inside, inside & missed, ~inside, ~inside & missed))
    total = np.maximum(n1 + n0, 1e-9)
    usable = (n1 > 0) & (n0 > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        lift = (m1 * n0 / total).sum(1) / (m0 * n1 / total).sum(1)
        rate = (m1 * usable).sum(1) / (n1 * usable).sum(1)
        share = np.where(usable, m0 / n0, 0.0)
        outside = (share * n1 * usable).sum(1) / (n1 * usable).sum(1)
    counts = int((m1 * usable)[0].sum()), int((n1 * usable)[0].sum())
    return RuleLift(
        counts, to_interval("inside", rate), to_interval("outside", outside), to_interval("lift", lift)
    )


def measure_rules(
    boxes: Sequence[Intervals],
    rows: Sequence[Observation],
    detector: str,
    weights: Floats,
    by_condition: bool = False,
) -> list[RuleLift]:
    """Measure the lift of each box for a detector's misses on real adverse frames.

    Args:
        boxes: Rules or placebos.
        rows: From `adverse_rows`.
        detector: Name of the detector.
        weights: (1 + D, F) how often each frame counts.
        by_condition: Compare objects of the same condition only.
    """
    columns = feature_columns([features for _, features in rows])
    missed, frame, stratum = missed_flags(rows, detector), frame_numbers(rows), strata(rows, by_condition)
    return [measure_lift(contains(box, columns, len(rows)), missed, stratum, frame, weights) for box in boxes]
