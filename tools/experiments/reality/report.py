"""Tables and plots of the experiment `reality`, computed from its stored tables alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.evaluation.curves import ClassMatches
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import (
    Interval,
    NamedMetric,
    WeightedAveragePrecision,
    bootstrap_intervals,
    paired_differences,
)
from drivesem.failures.rules import Intervals, format_rule
from drivesem.reporting.tables import AnalysisReport, ReportTable
from scene_ir import files
from tools.experiments.reality import retraining
from tools.experiments.reality.losses import (
    Agreement,
    Losses,
    compare_losses,
    compute_losses,
    draw_weights,
    to_interval,
)
from tools.experiments.reality.observations import ADVERSE, TABLE, read_observations
from tools.experiments.reality.plots import plot_lifts, plot_losses, plot_retraining
from tools.experiments.reality.rules import RuleLift, adverse_rows, measure_rules
from tools.experiments.tables import METADATA

DRAWS = 1000
"""Default number of bootstrap draws."""
LEAST_PRECISION = 0.8
"""Precision at which the recalls of retrained detectors are compared."""


@dataclass(frozen=True, slots=True)
class StoredRule:
    """A fixed rule and its placebo."""

    detector: str
    """Name of the attacked detector."""
    where: Intervals
    """The rule."""
    placebo: Intervals
    """Its placebo."""

    @classmethod
    def read(cls, folder: Path) -> list[StoredRule]:
        """Read the rules of a folder of stored tables."""

        def box(data: dict[str, Any]) -> Intervals:
            return {name: (float(low), float(high)) for name, (low, high) in data.items()}

        rows = files.read_json(folder / "rules.json")
        return [cls(row["detector"], box(row["where"]), box(row["placebo"])) for row in rows]


@dataclass(frozen=True, slots=True)
class RealityResults:
    """Everything that the tables and plots show."""

    record: Mapping[str, Any]
    """The study's record."""
    detectors: tuple[str, ...]
    """Names of the observed detectors."""
    losses: Losses
    """Losses of recall."""
    agreements: Mapping[str, Agreement]
    """How well each kind of prediction agrees with real losses."""
    rules: Sequence[StoredRule]
    """The rules."""
    lifts: Mapping[str, Sequence[RuleLift]]
    """Lifts of rules, placebos, and rules within conditions, for the attacked detector's misses."""
    transfer: Mapping[tuple[str, str], Sequence[RuleLift]]
    """Lifts by attacked detector, and detector that misses."""
    retrained: Sequence[RetrainedArms]
    """Metrics of the arms by detector; empty without retraining."""


@dataclass(frozen=True, slots=True)
class RetrainedArms:
    """A metric of the arms of one retrained detector."""

    detector: str
    """Name of the detector."""
    metric: str
    """AP50 or RECALL."""
    arms: Mapping[str, Mapping[str, Interval]]
    """Values of each arm by set of frames."""
    differences: Mapping[str, Mapping[str, Interval]]
    """Differences of an arm to the usual augmentation, by set of frames."""


AP50, RECALL = "AP50", f"recall at a precision of {LEAST_PRECISION:.0%}"


@dataclass(frozen=True, slots=True)
class RecallAtPrecision(WeightedAveragePrecision):
    """Largest recall of one class at which the precision is at least LEAST_PRECISION, under weights of the frames."""

    def value(self, weights: Floats | None) -> float | None:
        """The metric under weights (F,) of the frames; None where no object is drawn."""
        objects = self.matches.object_count(weights)
        if objects <= 0:
            return None
        hits, alarms = self.matches.cumulative_counts(weights)
        precise = (hits > 0) & (hits >= LEAST_PRECISION * (hits + alarms))
        return float(hits[precise].max(initial=0.0)) / objects


METRICS = {AP50: WeightedAveragePrecision, RECALL: RecallAtPrecision}
"""Metrics of retrained detectors."""
RULES, PLACEBOS, WITHIN = "rules", "placebos", "rules, within conditions"


def load_results(folder: Path, draws: int, seed: int) -> RealityResults:
    """Compute all results from stored tables.

    Args:
        folder: Folder of the tables.
        draws: Bootstrap draws.
        seed: Seed of the draws.
    """
    rows = read_observations(folder / TABLE.format("B"))
    detectors = tuple(sorted({name for one, _ in rows for name in one.missed_by.split()}))
    losses = compute_losses(rows, detectors, draws, np.random.default_rng([seed, 1]))
    agreements = {
        "drawn weather": compare_losses(losses.drawn, losses.real),
        "placebo": compare_losses(losses.placebo, losses.real),
    }
    rules = StoredRule.read(folder)
    adverse = adverse_rows(rows)
    frames = len({one.frame for one, _ in adverse})
    weights = draw_weights(frames, draws, np.random.default_rng([seed, 2]))

    def lifts(kind: str, by_condition: bool = False) -> list[RuleLift]:
        return [
            measure_rules([getattr(rule, kind)], adverse, rule.detector, weights, by_condition)[0]
            for rule in rules
        ]

    transfer = {
        (attacked, missing): measure_rules(
            [rule.where for rule in rules if rule.detector == attacked], adverse, missing, weights
        )
        for attacked in dict.fromkeys(rule.detector for rule in rules)
        for missing in detectors
    }
    retrained = [
        _evaluate_arms(folder, name, metric, draws, seed)
        for name in retraining.retrained_detectors(folder)
        for metric in METRICS
    ]
    return RealityResults(
        record=files.read_json(folder / METADATA),
        detectors=detectors,
        losses=losses,
        agreements=agreements,
        rules=rules,
        lifts={RULES: lifts("where"), PLACEBOS: lifts("placebo"), WITHIN: lifts("where", True)},
        transfer=transfer,
        retrained=retrained,
    )


def _evaluate_arms(folder: Path, detector: str, metric: str, draws: int, seed: int) -> RetrainedArms:
    """A metric of each arm by condition, and its difference to the usual augmentation; means over seeds."""
    matches, frames = retraining.read_matches(folder, detector)
    condition = np.array([frame.condition for frame in frames])
    sets = {name: (name,) for name in dict.fromkeys(condition)} | {MEAN: ADVERSE}
    metrics: dict[str, list[NamedMetric]] = {}
    for arm in dict.fromkeys(key[0] for key in matches):
        of_arm = [one for (name, _), one in matches.items() if name == arm]
        metrics[arm] = [
            NamedMetric(
                title,
                tuple(
                    METRICS[metric](_restrict(one, condition == name), "coco")
                    for one in of_arm
                    for name in names
                    if (condition == name).any()
                ),
            )
            for title, names in sets.items()
        ]
    rng = np.random.default_rng([seed, 3])
    arms = {
        arm: {one.name: one for one in bootstrap_intervals(own, len(frames), draws, rng)}
        for arm, own in metrics.items()
    }
    differences = {
        arm: {
            one.name: one.interval
            for one in paired_differences(metrics["usual"], own, len(frames), draws, rng, test=False)
        }
        for arm, own in metrics.items()
        if arm != "usual" and "usual" in metrics
    }
    return RetrainedArms(detector, metric, arms, differences)


MEAN = "mean of adverse"


def _restrict(matches: ClassMatches, wanted: np.ndarray) -> ClassMatches:
    """The matches in some of the frames (F,) bool; the others have no objects."""
    rows = wanted[matches.frame]
    return ClassMatches(
        matches.score[rows],
        matches.frame[rows],
        matches.true_positives[rows],
        matches.false_positives[rows],
        np.where(wanted, matches.objects, 0.0),
    )


def build_report(results: RealityResults, out: Path) -> AnalysisReport:
    """Build the report of the results in the folder `out`."""
    tables = [
        _agreement_table(results),
        _condition_table(results),
        _rule_table(results),
        _count_table(results),
        _transfer_table(results),
    ]
    for one in results.retrained:
        tables += [_arm_table(one), _difference_table(one)]
    data = {
        **results.record,
        "agreement": {name: _to_values(one) for name, one in results.agreements.items()},
        "lifts": {
            kind: [{"lift": one.lift.value, "low": one.lift.low, "high": one.lift.high} for one in lifts]
            for kind, lifts in results.lifts.items()
        },
        "retrained": [
            {
                "detector": one.detector,
                "metric": one.metric,
                **{
                    key: {arm: {k: [v.value, v.low, v.high] for k, v in row.items()} for arm, row in part.items()}
                    for key, part in (("arms", one.arms), ("differences", one.differences))
                },
            }
            for one in results.retrained
        ],
    }
    return AnalysisReport(
        out=out,
        name="study",
        heading="Held against reality",
        data=data,
        csv_tables={},
        tables=tables,
        notes=(),
        text_columns=("predicted by", "detector", "condition", "rule", "attacked", "boxes", "arm"),
        json_only=True,
    )


def write_plots(results: RealityResults, out: Path) -> None:
    """Write losses.png, lifts.png and, with retraining, retraining.png."""
    plot_losses(out / "losses.png", results.losses)
    names = [f"{rule.detector}: {format_rule(rule.where)}" for rule in results.rules]
    plot_lifts(out / "lifts.png", names, results.lifts[RULES], results.lifts[PLACEBOS])
    if results.retrained:
        panels = {one.detector: one.arms for one in results.retrained if one.metric == AP50}
        plot_retraining(out / "retraining.png", panels, retraining.ARM_TITLES)


def _to_values(agreement: Agreement) -> dict[str, list[float | None]]:
    intervals = (getattr(agreement, name) for name in AGREEMENT)
    return {one.name: [one.value, one.low, one.high] for one in intervals}


AGREEMENT = {
    "rank_correlation": "rank correlation",
    "same_sign": "same sign, %",
    "slope": "slope",
    "error": "mean error, points",
    "bias": "predicted less real, points",
}


def format_interval(interval: Interval, scale: float = 1.0, digits: int = 2) -> str:
    """Such as `0.61 [0.42, 0.75]`."""
    if interval.value is None:
        return "-"
    text = f"{scale * interval.value:.{digits}f}"
    if interval.low is None or interval.high is None:
        return text
    return f"{text} [{scale * interval.low:.{digits}f}, {scale * interval.high:.{digits}f}]"


def _agreement_table(results: RealityResults) -> ReportTable:
    percent = ("same_sign", "error", "bias")
    rows = []
    for name, one in results.agreements.items():
        cells = (
            format_interval(getattr(one, key), 100, 1) if key in percent else format_interval(getattr(one, key))
            for key in AGREEMENT
        )
        rows.append((name, *cells))
    points = len(results.losses.points)
    title = f"Losses of recall, predicted and real, at {points} points (detector, condition, height)"
    return ReportTable(title, ("predicted by", *AGREEMENT.values()), tuple(rows))


def _condition_table(results: RealityResults) -> ReportTable:
    """Mean losses over heights, by detector and condition."""
    points, losses = results.losses.points, results.losses
    rows = []
    for key in dict.fromkeys((point.detector, point.condition) for point in points):
        chosen = [i for i, point in enumerate(points) if (point.detector, point.condition) == key]
        cells = []
        for values in (losses.real, losses.drawn, losses.placebo):
            cells.append(format_interval(to_interval("loss", np.nanmean(values[:, chosen], axis=1)), 100, 1))
        rows.append((*key, str(len(chosen)), *cells))
    columns = ("detector", "condition", "heights", "real loss", "drawn loss", "placebo loss")
    return ReportTable("Loss of recall, points, mean over heights", columns, tuple(rows))


def _rule_table(results: RealityResults) -> ReportTable:
    rows = []
    lifts = (results.lifts[kind] for kind in (RULES, WITHIN, PLACEBOS))
    for rule, one, within, placebo in zip(results.rules, *lifts, strict=True):
        missed, count = one.inside
        rows.append(
            (
                rule.detector,
                format_rule(rule.where),
                f"{missed} of {count}",
                format_interval(one.rate, 100, 1),
                format_interval(one.outside, 100, 1),
                format_interval(one.lift),
                format_interval(within.lift),
                format_interval(placebo.lift),
            )
        )
    columns = (
        "attacked",
        "rule",
        "missed",
        "inside, %",
        "outside, %",
        "lift",
        "within conditions",
        "placebo's lift",
    )
    return ReportTable("Rules found on dry days, on real adverse frames", columns, tuple(rows))


def _count_table(results: RealityResults) -> ReportTable:
    rows = tuple(
        (
            kind,
            str(len(lifts)),
            str(sum((one.lift.value or 0) > 1 for one in lifts)),
            str(sum(one.above for one in lifts)),
            str(sum(one.apart for one in lifts)),
        )
        for kind, lifts in results.lifts.items()
    )
    columns = ("boxes", "number", "lift above 1", "interval above 1", "intervals of shares apart")
    return ReportTable("How many rules hold", columns, rows)


def _transfer_table(results: RealityResults) -> ReportTable:
    """For each attacked detector, how many of its rules hold for another detector's misses."""
    rows = []
    for attacked in dict.fromkeys(key[0] for key in results.transfer):
        for missing in results.detectors:
            lifts = results.transfer[attacked, missing]
            middle = float(np.median([one.lift.value or 0 for one in lifts]))
            above, apart = sum(one.above for one in lifts), sum(one.apart for one in lifts)
            rows.append((attacked, missing, str(len(lifts)), f"{middle:.2f}", str(above), str(apart)))
    columns = ("attacked", "detector", "rules", "median lift", "interval above 1", "intervals of shares apart")
    return ReportTable("Rules of one detector, misses of others", columns, tuple(rows))


def _arm_table(one: RetrainedArms) -> ReportTable:
    return _table_of_arms(f"{one.detector}: {one.metric} of cars on real frames, %", one.arms)


def _difference_table(one: RetrainedArms) -> ReportTable:
    title = f"{one.detector}: {one.metric}, points, less that of the usual augmentation"
    return _table_of_arms(title, one.differences)


def _table_of_arms(title: str, arms: Mapping[str, Mapping[str, Interval]]) -> ReportTable:
    sets = list(next(iter(arms.values())))
    rows = tuple(
        (retraining.ARM_TITLES[arm], *(format_interval(values[name], 100, 1) for name in sets))
        for arm, values in arms.items()
    )
    return ReportTable(title, ("arm", *sets), rows)
