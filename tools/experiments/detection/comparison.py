"""Metrics of each arm before and after its attack, their drop, and the drop beyond that of its controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivesem.evaluation.coco import IOU_50, IOU_70, IOU_THRESHOLDS
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.evaluation.resampling import (
    Interval,
    NamedMetric,
    PairedDifference,
    WeightedAveragePrecision,
    WeightedRecall,
    holm,
    paired_differences,
    wilson,
)
from drivesem.run.run_report import PAPER_BENIGN
from tools.experiments.detection.arms import matching_control
from tools.experiments.detection.counts import ArmCounts, FrameCounts
from tools.experiments.tables import interval_columns

METRIC_NAMES = {"ap50": "AP50", "ap70": "AP70", "ap": "AP50:95", "recall": "recall"}
"""Fields of `HeadlineScores` and their names in tables."""
MODES = ("paper", "moved")
"""Label modes."""
_SINGLE_OVERLAPS = {"ap50": IOU_50, "ap70": IOU_70}


@dataclass(frozen=True, slots=True)
class HeadlineScores:
    """Metrics of the class HEADLINE, fractions of 1; None without objects or where not computed."""

    ap50: float | None
    """AP at IoU 0.5."""
    ap70: float | None = None
    """AP at IoU 0.7."""
    ap: float | None = None
    """Mean AP over IoU 0.5 to 0.95."""
    recall: float | None = None
    """Recall at the lowest score."""

    @classmethod
    def from_metrics(cls, metrics: Sequence[NamedMetric]) -> HeadlineScores:
        """The values of some of the metrics."""
        return cls(**{metric.name: metric.value() for metric in metrics})


@dataclass(frozen=True, slots=True)
class ArmComparison:
    """One arm, or one control by its seeds. Over several seeds, metrics and counts are means; the rest is the
    first seed's.
    """

    runs: Sequence[ArmCounts]
    """Counts of each seed."""
    benign: HeadlineScores
    """Metrics in the photographs."""
    paper: HeadlineScores
    """Metrics after the attack, by the benign labels."""
    moved: HeadlineScores
    """Metrics after the attack, by the moved labels."""
    drops: dict[str, dict[str, Interval]]
    """Drop from benign to attacked, by label mode and metric."""
    effects: dict[str, dict[str, PairedDifference]]
    """Drop of AP50 beyond a control's, by control and label mode."""
    controls: dict[str, ArmComparison]
    """The arm's controls by kind."""
    size: float | None = None
    """Size of a control's edits, in units of the arm's."""
    p: float | None = None
    """Holm-adjusted p value of the effect beyond the matching control, by moved labels."""

    @property
    def run(self) -> ArmCounts:
        """The first seed."""
        return self.runs[0]

    @property
    def name(self) -> str:
        """Name of the arm."""
        return self.run.arm.name

    @property
    def matching_control(self) -> str | None:
        """Kind of the control with as many chances, if it was run."""
        kind = matching_control(self.run.arm.config)
        return kind if kind in self.controls else None

    def mean_broken_frames(self, mode: str) -> float:
        """Frames that fail by a label mode, a mean over seeds."""
        broken = [getattr(frame, f"success_{mode}") for run in self.runs for frame in run.frames]
        return sum(broken) / len(self.runs)

    def broken_share(self, mode: str) -> Interval:
        """Share of the first seed's frames that fail, with Wilson's 95 % interval, which holds for few frames too."""
        broken = [getattr(frame, f"success_{mode}") for frame in self.run.frames]
        if not broken:
            return Interval("broken", None, None, None)
        return Interval("broken", sum(broken) / len(broken), *wilson(sum(broken), len(broken)))

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        arm, frames = self.run.arm, self.run.frames
        row: dict[str, Any] = {
            "name": arm.name,
            "benign_ap50": self.benign.ap50,
            "paper_ap50": self.paper.ap50,
            "moved_ap50": self.moved.ap50,
            "drop_paper": self.drops["paper"]["ap50"].value,
            "drop_moved": self.drops["moved"]["ap50"].value,
            "recall_paper": self.paper.recall,
            "recall_moved": self.moved.recall,
            "reference": arm.reference,
            "reference_drop": None if arm.reference is None else PAPER_BENIGN - arm.reference,
            "frames": len(frames),
            "objects": int(self.run.before.objects.sum()),
            "successes_paper": sum(f.success_paper for f in frames),
            "successes_moved": sum(f.success_moved for f in frames),
            "control": self.matching_control,
            "p": self.p,
            "queries": sum(f.queries for f in frames),
            "feasible_fraction": feasible_fraction(frames),
        }
        for key in ("ap70", "ap", "recall"):
            row[f"benign_{key}"] = getattr(self.benign, key)
            row |= {f"{mode}_{key}": getattr(getattr(self, mode), key) for mode in MODES}
        for mode, drops in self.drops.items():
            row |= interval_columns(f"broken_{mode}", self.broken_share(mode))
            for key, drop in drops.items():
                row |= interval_columns(f"drop_{mode}" if key == "ap50" else f"drop_{mode}_{key}", drop)
        for name, control in self.controls.items():
            row |= {f"{name}_{mode}_ap50": getattr(control, mode).ap50 for mode in MODES}
            row |= {f"{name}_successes_moved": control.mean_broken_frames("moved")}
            row |= {f"{name}_seeds": len(control.runs), f"{name}_size": control.size}
            for mode in MODES:
                row |= interval_columns(f"{name}_drop_{mode}", control.drops[mode]["ap50"])
                row |= interval_columns(f"over_{name}_{mode}", self.effects[name][mode].interval)
        return row


def compare_arms(runs: Sequence[ArmCounts], draws: int, seed: int) -> list[ArmComparison]:
    """Compare each arm with its controls.

    Args:
        runs: All arms, on the same frames.
        draws: Bootstrap draws of frames, the same for all arms.
        seed: Seed of the draws.

    Returns:
        One comparison for each arm that is no control.
    """
    comparisons = []
    for run in runs:
        if run.arm.control is not None:
            continue
        controls: dict[str, list[ArmCounts]] = {}
        for other in runs:
            if other.arm.control and other.arm.control_of == run.arm.name:
                controls.setdefault(other.arm.control, []).append(other)
        comparisons.append(_compare_arm(run, controls, draws, seed))
    tested = [None if one.matching_control is None else one.effects[one.matching_control] for one in comparisons]
    adjusted = holm([None if effects is None else effects["moved"].p for effects in tested])
    return [replace(one, p=p) for one, p in zip(comparisons, adjusted, strict=True)]


def feasible_fraction(frames: Sequence[FrameCounts]) -> float | None:
    """Share of frames that pass the independent feasibility check; None without frames."""
    return sum(frame.feasible for frame in frames) / len(frames) if frames else None


def _compare_arm(
    run: ArmCounts, controls: Mapping[str, Sequence[ArmCounts]], draws: int, seed: int
) -> ArmComparison:
    metrics = ArmMetrics.from_runs(run)
    rows, effects = {}, {}
    for name, others in controls.items():
        control = ArmMetrics.from_runs(*others).ap50_only()
        sizes = [relative_size(other.frames, run.frames) for other in others]
        known = [size for size in sizes if size is not None]
        size = float(np.mean(known)) if known else None
        rows[name] = replace(_measure_arm(others, control, draws, seed), size=size)
        effects[name] = {mode: metrics.drop_beyond(control, mode, draws, seed) for mode in MODES}
    return replace(_measure_arm([run], metrics, draws, seed), controls=rows, effects=effects)


def _measure_arm(runs: Sequence[ArmCounts], metrics: ArmMetrics, draws: int, seed: int) -> ArmComparison:
    """The arm's own metrics, without controls."""
    return ArmComparison(
        runs=runs,
        benign=HeadlineScores.from_metrics(metrics.before),
        paper=HeadlineScores.from_metrics(metrics.after["paper"]),
        moved=HeadlineScores.from_metrics(metrics.after["moved"]),
        drops={mode: metrics.drops(mode, draws, seed) for mode in MODES},
        effects={},
        controls={},
    )


@dataclass(frozen=True, slots=True)
class ArmMetrics:
    """Metrics of an arm that can be reweighted by frame."""

    before: list[NamedMetric]
    """In the photographs."""
    after: dict[str, list[NamedMetric]]
    """In the attacked pictures, by label mode."""
    frames: int
    """Number of frames."""

    @classmethod
    def from_runs(cls, *runs: ArmCounts) -> ArmMetrics:
        """Metrics of one run, or means over several, such as seeds."""
        before = _pool_runs([_compute_metrics(run.before) for run in runs])
        after = {mode: _pool_runs([_compute_metrics(run.after[mode]) for run in runs]) for mode in MODES}
        return cls(before, after, len(runs[0].frames))

    def ap50_only(self) -> ArmMetrics:
        """AP50 alone, which is all that tables state of a control."""
        return ArmMetrics(self.before[:1], {mode: own[:1] for mode, own in self.after.items()}, self.frames)

    def drops(self, mode: str, draws: int, seed: int) -> dict[str, Interval]:
        """Drop of each metric by name, with intervals paired over frames.

        Args:
            mode: Label mode.
            draws: Bootstrap draws of frames.
            seed: Seed of the draws.
        """
        rng = np.random.default_rng(seed)
        drops = paired_differences(self.after[mode], self.before, self.frames, draws, rng, test=False)
        return {drop.name: drop.interval for drop in drops}

    def drop_beyond(self, control: ArmMetrics, mode: str, draws: int, seed: int) -> PairedDifference:
        """How much lower AP50 is than the control's, paired over frames.

        Args:
            control: Metrics of the control.
            mode: Label mode.
            draws: Bootstrap draws of frames.
            seed: Seed of the draws.
        """
        own, other = self.after[mode][0], control.after[mode][0]
        # the same attack is paired with each seed of the control
        own = replace(own, parts=own.parts * (len(other.parts) // len(own.parts)))
        (drop,) = paired_differences([own], [other], self.frames, draws, np.random.default_rng(seed))
        return drop


def _pool_runs(metrics: Sequence[Sequence[NamedMetric]]) -> list[NamedMetric]:
    """The same metrics of several runs, each as one mean."""
    return [
        replace(same[0], parts=tuple(part for one in same for part in one.parts))
        for same in zip(*metrics, strict=True)
    ]


def _compute_metrics(matches: ThresholdMatches) -> list[NamedMetric]:
    """In the order of METRIC_NAMES."""
    tallies = [matches.class_matches(place) for place in range(len(IOU_THRESHOLDS))]
    single = [
        NamedMetric(key, (WeightedAveragePrecision(tallies[place], "coco"),))
        for key, place in _SINGLE_OVERLAPS.items()
    ]
    mean = NamedMetric("ap", tuple(WeightedAveragePrecision(tally, "coco") for tally in tallies))
    return [*single, mean, NamedMetric("recall", (WeightedRecall(tallies[0]),))]


def relative_size(control: Sequence[FrameCounts], attack: Sequence[FrameCounts]) -> float | None:
    """Mean ratio over frames of the size of a control's edits to the attack's; None if the attack edits nothing."""
    ratios = [
        edited.size / attacked.size for edited, attacked in zip(control, attack, strict=True) if attacked.size > 0
    ]
    return float(np.mean(ratios)) if ratios else None
