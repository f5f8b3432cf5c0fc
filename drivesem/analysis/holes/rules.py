"""Fits rules to samples around certain failures, and merges similar rules into holes.

Samples around one car leave open what others would settle, as it stands at one height and place. So rules are
fitted to the samples of all failures of a class (`failures.rules.fit_rule_list`). A shared rule is used if its
description is shorter than those of its failures' own rules: its bounds are written once, theirs once per failure.
Failures that no shared rule explains keep their own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from drivesem.evaluation.resampling import newcombe, wilson
from drivesem.failures.failure_probability import FailureProbability
from drivesem.failures.grades import Kind
from drivesem.failures.rules import (
    Flags,
    Floats,
    Intervals,
    contains,
    count_rule,
    description_length,
    fit_rule,
    fit_rule_list,
    overlap,
    rates_differ,
)
from drivesem.run.report.page import KINDS
from drivesem.synth.compare import QUANTITIES, reference

if TYPE_CHECKING:
    from rich.progress import Progress

_MIN_OVERLAP = 0.5
"""Overlap from which two rules of the same features are one hole."""
_MIN_COVERED = 0.5
"""Share of a failure's lost samples that a rule must contain to explain it."""
_KITTI_QUANTITIES = {
    "distance_m": ("depth_m", 1.0),
    "height_px": ("box_height_px", 1.0),
    "yaw_deg": ("yaw_rad", np.pi / 180),
}
"""Features with a known distribution in KITTI: its name there, and the factor into its unit."""

FEATURE_TEXT = {
    "height_px": "height in the picture {} px",
    "aspect": "width over height {}",
    "across": "place in the picture, 0 left to 1 right: {}",
    "lightness": "in the picture, 0 dark to 1 light: {}",
    "contrast": "contrast in the picture, 0 flat to 0.5: {}",
    "distance_m": "nearer to further: {} m",
    "yaw_deg": "heading {} deg",
    "moved_m": "moved by {} m",
    "grown_percent": "grown by {} %",
    "paint.lightness": "paint, -1 darker to 1 lighter: {}",
    "paint.a": "paint, -1 greener to 1 redder: {}",
    "paint.b": "paint, -1 bluer to 1 yellower: {}",
    "paint.gloss": "paint, -1 matt to 1 glossy: {}",
    "paint.dirt": "paint, -1 clean to 1 dirty: {}",
    "paint.lower_lightness": "clothes below the waist, -1 darker to 1 lighter: {}",
    "paint.lower_a": "clothes below the waist, -1 greener to 1 redder: {}",
    "paint.lower_b": "clothes below the waist, -1 bluer to 1 yellower: {}",
    "weather.fog": "fog, 0 none to 1 dense: {}",
    "weather.rain": "rain, 0 none to 1 strong: {}",
    "weather.time_of_day": "time, 0 as photographed to 1 twilight: {}",
    "weather.overcast": "sky, 0 as photographed to 1 overcast: {}",
    "weather.snow": "snow, 0 none to 1 dense: {}",
    "weather.night": "night, 0 as photographed to 1 street lamps only: {}",
    "lamps": "lamps, -1 off, 0 as the weather has them, 1 braking: {}",
    "foliage.hue": "leaves, hue from -1 to 1: {}",
    "foliage.lightness": "leaves, -1 darker to 1 lighter: {}",
    "foliage.density": "leaves, -1 sparser to 1 denser: {}",
    "sun.azimuth": "direction of the sun, -1 to 1: {}",
    "sun.elevation": "sun, -1 lower to 1 higher: {}",
    "sun.strength": "sun, -1 weaker to 1 stronger: {}",
}
"""Features for people; {} is an interval."""

FailureKey = tuple[str, int]
"""Name of a frame, and number of an object."""


@dataclass(frozen=True, slots=True)
class FeatureSamples:
    """Samples of one or several objects, described by features."""

    names: tuple[str, ...]
    """Names of the features."""
    values: tuple[tuple[float, ...], ...]
    """Features of each sample."""
    margins: tuple[float, ...]
    """Margin of each sample, logits relative to t*; negative if the object is lost."""

    def columns(self) -> dict[str, Floats]:
        """Return the values (n,) of each feature."""
        table = np.array(self.values, np.float64).reshape(len(self.values), len(self.names))
        return {name: table[:, i] for i, name in enumerate(self.names)}

    @property
    def failing(self) -> Flags:
        """Whether the object is lost (n,)."""
        return np.array(self.margins, np.float64) < 0


def join_samples(parts: Sequence[FeatureSamples]) -> FeatureSamples:
    """Concatenate samples of the same features."""
    parts = [part for part in parts if part.margins]
    names = parts[0].names if parts else ()
    values = tuple(row for part in parts for row in part.values)
    return FeatureSamples(names, values, tuple(margin for part in parts for margin in part.margins))


@dataclass(frozen=True, slots=True)
class FailureSamples:
    """Samples around one certain failure."""

    index: int
    """Number of the object."""
    label: str
    """Class of the object."""
    error: str
    """Kind of the failure."""
    grade: str
    """Grade of the failure."""
    samples: FeatureSamples
    """Samples of the whole neighbourhood."""
    near: FeatureSamples
    """Samples close to the failure, as a hole may be small."""
    lost: FailureProbability
    """Share of the neighbourhood in which the object is lost."""

    def all_samples(self) -> FeatureSamples:
        """Return the samples of the whole neighbourhood and those close to the failure."""
        return join_samples((self.samples, self.near))


@dataclass(frozen=True, slots=True)
class ContrastSamples:
    """Samples of all objects of a class, anywhere within the bounds, lost or not."""

    label: str
    """The class."""
    objects: tuple[int, ...]
    """Number of the object, per sample."""
    samples: FeatureSamples
    """The samples."""

    def by_object(self) -> dict[int, FeatureSamples]:
        """Return the samples of each object."""
        samples_by_object: dict[int, FeatureSamples] = {}
        for index in dict.fromkeys(self.objects):
            rows = [row for row, number in enumerate(self.objects) if number == index]
            values, margins = self.samples.values, self.samples.margins
            samples_by_object[index] = FeatureSamples(
                self.samples.names, tuple(values[row] for row in rows), tuple(margins[row] for row in rows)
            )
        return samples_by_object


@dataclass(frozen=True, slots=True)
class FrameHoles:
    """Samples of one frame."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    around: tuple[FailureSamples, ...]
    """Samples around each certain failure."""
    contrast: tuple[ContrastSamples, ...]
    """Samples of all objects, by class."""
    passes: int
    """Passes of the detector."""
    seconds: float
    """Run time; the only field that may differ between two calls."""


@dataclass(frozen=True, slots=True)
class FrameRuleSamples:
    """Further samples inside the rules of a frame's failures."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    indices: tuple[int, ...]
    """Number of each failure's object."""
    inside: tuple[FeatureSamples, ...]
    """Samples inside each failure's rule."""
    passes: int
    """Passes of the detector."""
    seconds: float
    """Run time; the only field that may differ between two calls."""


@dataclass(frozen=True, slots=True)
class FailureRule:
    """The rule that explains a failure."""

    where: Intervals
    """Interval of each feature of the rule."""
    pooled: bool
    """Whether several failures share the rule."""


@dataclass(frozen=True, slots=True)
class FailureWithRule:
    """A failure, its rule, and independent samples that test the rule."""

    failure: FailureSamples
    """The failure."""
    rule: FailureRule
    """Its rule."""
    fresh: FeatureSamples
    """Further samples inside the rule."""
    cell: str | None = None
    """Cell of the map; None without a record of the search."""


@dataclass(frozen=True, slots=True)
class RuleRecheck:
    """A hole's failure rate compared with that of new draws."""

    stated: tuple[int, int]
    """Failures and samples behind the hole's failure rate."""
    again: tuple[int, int]
    """Failures and samples among the new draws."""

    @property
    def probability(self) -> float:
        """Share of failures among the new draws."""
        return self.again[0] / self.again[1]

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % Wilson interval."""
        return wilson(*self.again)

    @property
    def difference(self) -> tuple[float, float]:
        """95 % Newcombe interval of the new failure rate minus the stated one."""
        return newcombe(self.stated, self.again)

    @property
    def holds(self) -> bool:
        """Whether chance alone may explain the difference."""
        low, high = self.difference
        return low <= 0 <= high

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        return {
            "draws": self.again[1],
            "failures": self.again[0],
            "probability": self.probability,
            "interval": list(self.interval),
            "difference": list(self.difference),
            "holds": self.holds,
        }


@dataclass(frozen=True, slots=True)
class HoleFailure:
    """A certain failure, by name."""

    frame: str
    """Its frame."""
    object: int
    """Number of its object."""
    label: str
    """Class of its object."""
    kind: str
    """Its kind."""
    grade: str
    """Its grade."""
    cell: str | None
    """Its cell of the map; None without a record of the search."""

    @property
    def text(self) -> str:
        """Name it for people: `demo-000: Car missed, object 2 (certain)`."""
        return f"{self.frame}: {self.label} {KINDS[Kind(self.kind)]}, object {self.object} ({self.grade})"


@dataclass(frozen=True, slots=True)
class Hole:
    """A region of features in which the detector loses objects."""

    where: Intervals
    """The rule; empty if none separates the failures, and the whole neighbourhood is meant. A rule separates them where
    the failure rates inside and outside differ beyond their intervals.
    """
    label: str
    """Class of the objects."""
    probability: float | None
    """Failure rate of fresh samples inside the rule."""
    low: float | None
    """Lower end of its 95 % Wilson interval."""
    high: float | None
    """Upper end."""
    count: int
    """Number of fresh samples."""
    outside: float | None
    """Failure rate outside the rule."""
    lost: FailureProbability
    """Size: share of the neighbourhoods in which the object is lost."""
    kitti: dict[str, float]
    """Share of KITTI's vehicles inside the interval, by feature."""
    failures: tuple[HoleFailure, ...]
    """Failures that led to the hole."""
    frames: tuple[str, ...]
    """Their frames."""
    pooled: bool
    """Whether the rule was fitted to samples of several failures."""
    recheck: RuleRecheck | None = None
    """Test of the failure rate; None without --recheck, or without fresh samples."""

    @property
    def cells(self) -> list[str]:
        """Cells of the map that its failures lie in."""
        return list(dict.fromkeys(failure.cell for failure in self.failures if failure.cell is not None))

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        return {
            "parameters": list(self.where),
            "where": {name: list(bounds) for name, bounds in self.where.items()},
            "class": self.label,
            "pooled": self.pooled,
            "probability": self.probability,
            "interval": [self.low, self.high],
            "samples": self.count,
            "recheck": None if self.recheck is None else self.recheck.to_json(),
            "outside": self.outside,
            "size": {
                "probability": self.lost.probability,
                "interval": [self.lost.low, self.lost.high],
                "by": self.lost.by,
            },
            "kitti": self.kitti,
            "failures": [asdict(failure) for failure in self.failures],
            "cells": self.cells,
            "frames": list(self.frames),
        }

    @property
    def rule_text(self) -> str:
        """The rule for people."""
        if not self.where:
            return f"no rule found; {100 * self.lost.low:.2g} to {100 * self.lost.high:.2g} % everywhere"
        return describe_rule(self.where)


def describe_rule(where: Intervals) -> str:
    """Describe a rule for people: what each feature is, which way it goes, and its interval."""
    texts = [FEATURE_TEXT[name].format(f"{low:.3g} to {high:.3g}") for name, (low, high) in where.items()]
    return "; ".join(texts)


def fit_rules(frames: Mapping[str, FrameHoles], progress: Progress | None = None) -> dict[FailureKey, FailureRule]:
    """Fit a rule to each failure.

    Args:
        frames: Samples by frame.
        progress: Shows how many failures and classes are done.
    """
    failures = {(name, one.index): one for name, frame in frames.items() for one in frame.around}
    labels = list(dict.fromkeys(one.label for one in failures.values()))
    task = None if progress is None else progress.add_task("fitting rules", total=len(failures) + len(labels))

    def advance() -> None:
        if progress is not None and task is not None:
            progress.advance(task)

    rules: dict[FailureKey, FailureRule] = {}
    for key, one in failures.items():
        rules[key] = FailureRule(fit_failure_rule(one), False)
        advance()
    for label in labels:
        failures_of_class = {key: one for key, one in failures.items() if one.label == label}
        rules |= _fit_shared_rules(label, failures_of_class, rules, frames)
        advance()
    return rules


def fit_failure_rule(failure: FailureSamples) -> Intervals:
    """Fit a rule to the samples around one failure."""
    samples = failure.all_samples()
    return fit_rule(samples.columns(), samples.failing).intervals if samples.margins else {}


def _fit_shared_rules(
    label: str,
    failures: Mapping[FailureKey, FailureSamples],
    own_rules: Mapping[FailureKey, FailureRule],
    frames: Mapping[str, FrameHoles],
) -> dict[FailureKey, FailureRule]:
    """Fit rules to the samples of all failures and contrast objects of a class.

    Args:
        label: The class.
        failures: Its failures.
        own_rules: The rule of each failure by itself.
        frames: Samples by frame.

    Returns:
        The failures that share a rule, with that rule.
    """
    parts: list[tuple[FailureKey, FeatureSamples]] = [(key, one.all_samples()) for key, one in failures.items()]
    samples_by_failure = {key: samples for key, samples in parts if samples.margins}
    if len(samples_by_failure) < 2:
        return {}
    for name, frame in frames.items():
        for contrast in frame.contrast:
            if contrast.label == label:
                parts += [((name, index), samples) for index, samples in contrast.by_object().items()]
    parts = [part for part in parts if part[1].margins]
    # runs with different parameters may have different features
    names = [name for name in parts[0][1].names if all(name in samples.names for _, samples in parts)]
    columns = {name: np.concatenate([samples.columns()[name] for _, samples in parts]) for name in names}
    fails = np.concatenate([samples.failing for _, samples in parts])
    numbers = {key: number for number, key in enumerate(dict.fromkeys(key for key, _ in parts))}
    objects = np.concatenate([np.full(len(samples.margins), numbers[key]) for key, samples in parts])
    shared: dict[FailureKey, FailureRule] = {}
    for rule in fit_rule_list(columns, fails, objects):
        members = {
            key: samples
            for key, samples in samples_by_failure.items()
            if key not in shared and _explains(rule.intervals, samples)
        }
        if len(members) > 1 and _is_shorter(rule.intervals, members, own_rules):
            shared |= dict.fromkeys(members, FailureRule(rule.intervals, True))
    return shared


def _explains(where: Intervals, samples: FeatureSamples) -> bool:
    failing = samples.failing
    inside = contains(where, samples.columns(), len(failing))
    return bool(failing.any()) and float(inside[failing].mean()) >= _MIN_COVERED


def _is_shorter(
    where: Intervals,
    samples_by_failure: Mapping[FailureKey, FeatureSamples],
    own_rules: Mapping[FailureKey, FailureRule],
) -> bool:
    """Whether one rule with each failure's rates inside and outside is shorter than all failures' own rules."""
    pooled = separate = 0.0
    count = sum(len(samples.margins) for samples in samples_by_failure.values())
    choice = math.log(len(next(iter(samples_by_failure.values())).names))  # among features
    for key, samples in samples_by_failure.items():
        columns, failing = samples.columns(), samples.failing
        own = own_rules[key].where
        separate += description_length(own, columns, failing) + len(own) * choice
        pooled += description_length(where, columns, failing, bounds=0)
    return pooled + len(where) * (2 * math.log(count) + choice) <= separate


def merge_holes(
    failures: Mapping[FailureKey, FailureWithRule], rechecks: Mapping[FailureKey, FeatureSamples] | None = None
) -> list[Hole]:
    """Merge failures with similar rules into holes.

    Args:
        failures: Failures and their rules.
        rechecks: New samples inside the rule of each failure.

    Returns:
        Holes, the largest first; a hole with the features of a larger one is listed after all others.
    """
    tested = {
        key: one if _separates(group) else replace(one, rule=FailureRule({}, False), fresh=_NO_SAMPLES)
        for group in _group_by_rule(failures)
        for key, one in group
    }
    groups = _group_by_rule(tested)
    holes = sorted((_build_hole(group, rechecks or {}) for group in groups), key=lambda h: -h.lost.probability)
    feature_sets: set[tuple[str, ...]] = set()
    first: list[Hole] = []
    repeated: list[Hole] = []
    for hole in holes:
        features = (hole.label, *sorted(hole.where))
        (repeated if features in feature_sets else first).append(hole)
        feature_sets.add(features)
    return first + repeated


_Group = list[tuple[FailureKey, FailureWithRule]]
_NO_SAMPLES = FeatureSamples((), (), ())


def _group_by_rule(failures: Mapping[FailureKey, FailureWithRule]) -> list[_Group]:
    """Group failures with similar rules."""
    groups: list[_Group] = []
    # Shared rules first: similar ones join them.
    for key, one in sorted(failures.items(), key=lambda item: not item[1].rule.pooled):
        group = next((group for group in groups if _is_same_hole(group[0][1], one)), None)
        if group is None:
            groups.append([(key, one)])
        else:
            group.append((key, one))
    return groups


def _separates(group: _Group) -> bool:
    """Whether failure rates inside a group's rule, of fresh samples, and outside of it differ."""
    members = [one for _, one in group]
    where = _median_rule(members)
    inside, outside = _count_inside(where, [one.fresh for one in members]), _count_outside(where, members)
    return rates_differ(inside, outside)


def _median_rule(members: Sequence[FailureWithRule]) -> Intervals:
    """Return the rule of a group: its shared one, or the median bounds."""
    rule = members[0].rule
    if rule.pooled:
        return rule.where
    return {
        name: (
            float(np.median([one.rule.where[name][0] for one in members])),
            float(np.median([one.rule.where[name][1] for one in members])),
        )
        for name in rule.where
    }


def _is_same_hole(one: FailureWithRule, other: FailureWithRule) -> bool:
    same = one.failure.label == other.failure.label and set(one.rule.where) == set(other.rule.where)
    return same and overlap(one.rule.where, other.rule.where) >= _MIN_OVERLAP


def _build_hole(
    group: Sequence[tuple[FailureKey, FailureWithRule]], rechecks: Mapping[FailureKey, FeatureSamples]
) -> Hole:
    members = [one for _, one in group]
    where = _median_rule(members)
    outside = _count_outside(where, members)
    fails, count = _count_inside(where, [one.fresh for one in members])
    rechecked = _count_inside(where, [rechecks[key] for key, _ in group if key in rechecks])
    low, high = wilson(fails, count) if count else (None, None)
    return Hole(
        where=where,
        label=members[0].failure.label,
        probability=fails / count if count else None,
        low=low,
        high=high,
        count=count,
        outside=outside[0] / outside[1] if outside[1] else None,
        lost=_mean_probability([one.failure.lost for one in members]),
        kitti=kitti_shares(where),
        failures=tuple(
            HoleFailure(frame, index, one.failure.label, one.failure.error, one.failure.grade, one.cell)
            for (frame, index), one in group
        ),
        frames=tuple(dict.fromkeys(frame for (frame, _), _ in group)),
        pooled=members[0].rule.pooled,
        recheck=RuleRecheck((fails, count), rechecked) if count and rechecked[1] else None,
    )


def _count_inside(where: Intervals, samples: Sequence[FeatureSamples]) -> tuple[int, int]:
    """Count failures and samples inside a rule."""
    counts = [count_rule(where, some.columns(), some.failing) for some in samples if some.margins]
    return sum(one.failures for one in counts), sum(one.count for one in counts)


def _mean_probability(probabilities: Sequence[FailureProbability]) -> FailureProbability:
    """Average over neighbourhoods; the mean ends of the intervals are conservative."""
    by = " and ".join(sorted({one.by for one in probabilities}))
    ends = [(one.probability, one.low, one.high) for one in probabilities]
    probability, low, high = np.mean(ends, axis=0).tolist()
    return FailureProbability(probability, low, high, by, sum(one.extra_samples for one in probabilities))


def _count_outside(where: Intervals, members: Sequence[FailureWithRule]) -> tuple[int, int]:
    """Count failures and samples of the neighbourhoods outside a rule."""
    samples = [one.failure.samples for one in members if one.failure.samples.margins]
    counts = [count_rule(where, some.columns(), some.failing) for some in samples]
    return sum(one.failures_outside for one in counts), sum(one.count_outside for one in counts)


def kitti_shares(where: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Return the share of KITTI's labelled vehicles in each interval of a feature with a known distribution."""
    shares: dict[str, float] = {}
    for name, (low, high) in where.items():
        if name in _KITTI_QUANTITIES:
            quantity, unit = _KITTI_QUANTITIES[name]
            shares[name] = round(_share_below(quantity, high * unit) - _share_below(quantity, low * unit), 4)
    return shares


def _share_below(name: str, value: float) -> float:
    """Share of KITTI's vehicles below a value; for an angle, plus one per full turn."""
    quantity = QUANTITIES[name]
    edges = np.asarray(quantity.edges, float)
    below = np.concatenate([[0.0], np.cumsum(reference().shares[name])])
    turns, rest = divmod(value - edges[0], 2 * np.pi) if quantity.angle else (0.0, value - edges[0])
    return float(turns + np.interp(edges[0] + rest, edges, below / below[-1]))
