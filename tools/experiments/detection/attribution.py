"""How many points of AP50 each choice of the paper's protocol accounts for, one factor at a time.

An arm is a set of factors set as in the paper; all others are ours. Its value is the drop of AP50 by the labels
that count there. Of the many orders in which the factors can be switched, two are measured: their order and its
reverse. A factor's points are the mean of what it adds in both, so that the points of all factors sum to the
difference between the protocols (two of the orders that a Shapley value averages). The points that each factor adds
to ours alone are reported too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivesem.analysis.transfer import format_interval
from drivesem.attacks.targets import HEADLINE
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig
from drivesem.evaluation.resampling import Interval, NamedMetric, holm, paired_differences
from drivesem.reporting.plots import PLOT_COLOURS
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_percent
from drivesem.run.run_report import PAPER_BENIGN, PAPER_COMBOS, PROTOCOL
from tools.experiments.detection.arms import PAPER_PROTOCOL, AttackArm, base_attack, bootstrap_draws
from tools.experiments.detection.comparison import ArmMetrics, feasible_fraction
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.plots import write_figure
from tools.experiments.detection.report import (
    build_study_report,
    describe_intervals,
    describe_skipped,
    study_facts,
)
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import interval_columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COUNTED_LABELS, TARGETED_LABELS = "labels that count", "labels aimed at"
"""The first is a factor that no attack sees: the same pictures, evaluated by other labels."""
OURS = "ours"
_SETTINGS = {
    TARGETED_LABELS: "objective_labels",
    "loss": "objective",
    "final iterate": "keep",
    "projection": "project",
    "parametrisation": "parametrisation",
}
_DETECTOR = "detector"
_Factors = frozenset[str]
"""The factors that are set as in the paper."""


@dataclass(frozen=True, slots=True)
class AttributionPlan:
    """The factors in order, and the attack for each set of them."""

    factors: tuple[str, ...]
    """Names of the factors."""
    ours: AttackConfig
    """The attack without any of them."""
    other_detector: str | None
    """Detector that counts as the paper's, as one more factor."""

    @classmethod
    def from_study(cls, study: StudyConfig) -> AttributionPlan:
        """Start from the study's attack, with our defaults for all settings that are factors."""
        default = AttackConfig()
        own = {name: getattr(default, name) for name in _SETTINGS.values()}
        ours = replace(base_attack(study), combo=DEFAULT_COMBO, method="si-fgsm", grade=False, **own)
        factors = (COUNTED_LABELS, *_SETTINGS, *([_DETECTOR] if study.other_detector else []))
        return cls(factors, ours, study.other_detector)

    def config(self, papers: _Factors) -> AttackConfig:
        """The attack with these factors as in the paper."""
        changes: dict[str, Any] = {name: PROTOCOL[name] for f, name in _SETTINGS.items() if f in papers}
        if _DETECTOR in papers:
            changes["detector"] = self.other_detector
        return replace(self.ours, **changes)

    def paths(self) -> list[list[_Factors]]:
        """From none to all factors, in their order and in the reverse."""
        orders = (self.factors, self.factors[::-1])
        return [[frozenset(order[:k]) for k in range(len(order) + 1)] for order in orders]

    def arms(self) -> list[AttackArm]:
        """Each attack once: those on both paths, and each factor alone."""
        first, second = self.paths()
        sets = [first[0], first[-1], *first[1:-1], *second[1:-1], *(frozenset([f]) for f in self.factors)]
        named = {self.arm_name(papers): papers for papers in sets}
        return [
            AttackArm(name, re.sub(r"[^a-z0-9]+", "-", name), self.config(papers))
            for name, papers in named.items()
        ]

    def arm_name(self, papers: _Factors) -> str:
        """Name of the arm with this attack; the labels that count make no other."""
        changed = [f for f in self.factors[1:] if f in papers]
        if len(changed) in (0, len(self.factors) - 1):
            return PAPER_PROTOCOL if changed else OURS
        return ", ".join(changed)


@dataclass(frozen=True, slots=True)
class FactorShare:
    """The points of one factor, or of some together, as fractions of 1."""

    name: str
    """Name of the factor."""
    alone: Interval
    """What it adds to ours alone."""
    points: Interval
    """Mean of what it adds on both paths."""
    path_points: tuple[float | None, float | None]
    """What it adds on each path."""
    p: float | None = None
    """Holm-adjusted p value of `points`; None if not tested."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        row = {
            "name": self.name,
            **interval_columns("alone", self.alone),
            **interval_columns("points", self.points),
        }
        return row | {"in_order": self.path_points[0], "in_reverse": self.path_points[1], "p": self.p}


@dataclass(frozen=True, slots=True)
class Attribution:
    """The result of the study `attribution`."""

    study: StudyConfig
    """Settings of the study."""
    draws: int
    """Bootstrap draws of frames."""
    counts: StudyCounts
    """Counts of all arms."""
    drops: Mapping[str, Mapping[str, Interval]]
    """Drop of AP50 by arm and label mode."""
    ours: float | None
    """Drop where the paths begin."""
    papers: float | None
    """Drop where they end."""
    shares: Sequence[FactorShare]
    """The factors, then both kinds of labels together, then all."""

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        return study_facts(self.study, self.draws, self.counts) | {
            "ours": self.ours,
            "papers": self.papers,
            "rows": [share.to_row() for share in self.shares],
            "arms": self.arm_rows(),
        }

    def arm_rows(self) -> list[dict[str, Any]]:
        """Drops of each arm."""
        rows: list[dict[str, Any]] = []
        for run in self.counts.arms:
            row: dict[str, Any] = {"name": run.arm.name, "feasible_fraction": feasible_fraction(run.frames)}
            for mode, drop in self.drops[run.arm.name].items():
                row |= interval_columns(f"drop_{mode}", drop)
            rows.append(row)
        return rows


class _DropMeasurements:
    """Drops of AP50 of all arms and their differences, over the same draws of frames."""

    def __init__(self, plan: AttributionPlan, counts: StudyCounts, draws: int, seed: int) -> None:
        self._plan, self._draws, self._seed = plan, draws, seed
        self._metrics = {run.arm.name: ArmMetrics.from_runs(run).ap50_only() for run in counts.arms}
        self._detector = {run.arm.name: run.arm.config.detector for run in counts.arms}

    def drops(self, name: str) -> dict[str, Interval]:
        """Drops of an arm by label mode."""
        return {m: self._metrics[name].drops(m, self._draws, self._seed)["ap50"] for m in ("moved", "paper")}

    def drop(self, papers: _Factors) -> float | None:
        """The drop with these factors as in the paper."""
        metrics = self._metrics[self._plan.arm_name(papers)]
        before, after = metrics.before[0].value(), self._after(papers).value()
        return None if before is None or after is None else before - after

    def step(self, first: _Factors, second: _Factors) -> float | None:
        """The second drop less the first."""
        before, after = self.drop(first), self.drop(second)
        return None if before is None or after is None else after - before

    def mean_step(self, steps: Sequence[tuple[_Factors, _Factors]], test: bool) -> tuple[Interval, float | None]:
        """Mean over steps of the second drop less the first, and its p value with `test`.

        A metric is the mean of its parts. Where the detector differs, so does the AP50 before the attack, and each
        step has two parts a side.
        """
        less: list[NamedMetric] = []
        more: list[NamedMetric] = []
        for first, second in steps:
            more.append(self._after(first))
            less.append(self._after(second))
            names = [self._plan.arm_name(papers) for papers in (first, second)]
            if len({self._detector[name] for name in names}) > 1:
                befores = [self._metrics[name].before[0] for name in names]
                less.append(befores[0])
                more.append(befores[1])
        lower, higher = (NamedMetric("ap50", tuple(p for one in side for p in one.parts)) for side in (less, more))
        frames, rng = self._metrics[OURS].frames, np.random.default_rng(self._seed)
        (mean,) = paired_differences([lower], [higher], frames, self._draws, rng, test)
        factor = len(less) / len(steps)
        values = (mean.difference, mean.low, mean.high)
        return Interval("ap50", *(None if value is None else factor * value for value in values)), mean.p

    def _after(self, papers: _Factors) -> NamedMetric:
        mode = "paper" if COUNTED_LABELS in papers else "moved"
        return self._metrics[self._plan.arm_name(papers)].after[mode][0]


def attribute_drop(study: StudyConfig, counts: StudyCounts) -> Attribution:
    """Attribute the difference between the protocols to factors, from the counts of the plan's arms."""
    plan, draws = AttributionPlan.from_study(study), bootstrap_draws(study)
    measurements, paths = _DropMeasurements(plan, counts, draws, study.seed), plan.paths()
    none, everything = paths[0][0], paths[0][-1]

    def share(name: str, factors: Sequence[str], test: bool = False) -> FactorShare:
        size = len(factors)
        steps = [
            next(
                (path[k], path[k + size])
                for k in range(len(path) - size)
                if path[k + size] - path[k] == {*factors}
            )
            for path in paths
        ]
        points, p = measurements.mean_step(steps, test)
        alone, _ = measurements.mean_step([(none, frozenset(factors))], test=False)
        in_order, in_reverse = (measurements.step(*step) for step in steps)
        return FactorShare(name, alone, points, (in_order, in_reverse), p)

    tested = [share(factor, [factor], test=True) for factor in plan.factors]
    shares = [replace(one, p=p) for one, p in zip(tested, holm([one.p for one in tested]), strict=True)]
    labels = replace(share("labels, both", (COUNTED_LABELS, TARGETED_LABELS)), p=None)
    return Attribution(
        study=study,
        draws=draws,
        counts=counts,
        drops={run.arm.name: measurements.drops(run.arm.name) for run in counts.arms},
        ours=measurements.drop(none),
        papers=measurements.drop(everything),
        shares=[*shares, labels, replace(share("all", plan.factors), p=None)],
    )


def attribution_report(found: Attribution, out: Path) -> AnalysisReport:
    """The report of the study `attribution`."""
    shares = _share_table(found)
    return build_study_report(
        found.study,
        out,
        found.to_json(),
        {"study": [one.to_row() for one in found.shares], "arms": found.arm_rows()},
        [shares, _arm_table(found)],
        [shares],
        notes=_build_notes(found),
        text_columns=("factor", "the paper's"),
        picture=partial(write_waterfall, found=found),
    )


def _share_table(found: Attribution) -> ReportTable:
    lines = []
    for one in found.shares:
        points = ("-" if value is None else f"{100 * value:.1f}" for value in one.path_points)
        p = "-" if one.p is None else f"{one.p:.3f}"
        lines.append((one.name, format_interval(one.alone), format_interval(one.points), *points, p))
    columns = ("factor", "added to ours alone", "points", "in this order", "in the reverse", "p")
    ends = f"from {format_percent(found.ours)}, ours, to {format_percent(found.papers)}, the {PAPER_PROTOCOL}"
    return ReportTable(f"Drop of {HEADLINE} AP50, points: {ends}", columns, tuple(lines))


def _arm_table(found: Attribution) -> ReportTable:
    lines = []
    for run in found.counts.arms:
        drops = found.drops[run.arm.name]
        feasible = format_percent(feasible_fraction(run.frames))
        lines.append((run.arm.name, format_interval(drops["moved"]), format_interval(drops["paper"]), feasible))
    columns = ("the paper's", "drop, moved labels", "drop, benign labels", "feasible, %")
    return ReportTable("Arms, by what is set as in the paper", columns, tuple(lines))


def _build_notes(found: Attribution) -> list[str]:
    return [
        f"Combination {DEFAULT_COMBO}, ten steps of si-FGSM. Points: how much further AP50 drops with the paper's "
        "choice than with ours, the mean of two paths from ours to the paper's, in this order and in the reverse; "
        f"they sum to the difference.{describe_intervals(found.draws)} p: permutation of frames, Holm-adjusted "
        "over the factors.",
        "Labels that count: the same pictures, evaluated by labels that do not move. Labels aimed at: the attack "
        "raises its loss on them. The best iterate is always chosen by moved labels.",
        f"The paper's SqueezeDet dropped by {100 * (PAPER_BENIGN - PAPER_COMBOS[DEFAULT_COMBO]):.1f} points on "
        "Virtual KITTI.",
        *describe_skipped(found.counts.without_vehicles, found.counts.failed),
    ]


def write_waterfall(path: Path, found: Attribution) -> None:
    """Draw the way from ours to the paper's protocol, one step for each factor."""
    factors = found.shares[:-2]
    write_figure(path, (1.6 + 1.15 * (len(factors) + 2), 4.6), partial(_draw, found=found, factors=factors))


def _draw(axes: Axes, found: Attribution, factors: Sequence[FactorShare]) -> None:
    level = 100 * (found.ours or 0.0)
    axes.bar(0, level, color=PLOT_COLOURS[0])
    axes.text(0, level, f" {level:.1f}", ha="center", va="bottom")
    for place, one in enumerate(factors, start=1):
        points = 100 * (one.points.value or 0.0)
        axes.bar(place, points, bottom=level, color=PLOT_COLOURS[1] if points > 0 else PLOT_COLOURS[2])
        axes.plot([place - 1, place], [level, level], color=PLOT_COLOURS[6], linewidth=0.8)
        top = max(level, level + points)
        if one.points.low is not None and one.points.high is not None:
            bounds = [level + 100 * one.points.low, level + 100 * one.points.high]
            axes.plot([place, place], bounds, color=PLOT_COLOURS[6], linewidth=1.2, zorder=3)
            top = max(top, *bounds)
        axes.text(place, top, f"{points:+.1f}", ha="center", va="bottom")
        level += points
    last = len(factors) + 1
    axes.plot([last - 1, last], [level, level], color=PLOT_COLOURS[6], linewidth=0.8)
    axes.bar(last, level, color=PLOT_COLOURS[0])
    axes.text(last, level, f"{level:.1f}", ha="center", va="bottom")
    axes.axhline(0, color=PLOT_COLOURS[6], linewidth=0.8)
    names = [OURS, *(share.name for share in factors), PAPER_PROTOCOL]
    axes.set_xticks(range(last + 1), [name.replace(" ", "\n") for name in names])
    axes.set_ylabel("drop of AP50, points")
    axes.set_title("From ours to the paper's protocol; lines: 95 % interval over frames", loc="left", fontsize=11)
