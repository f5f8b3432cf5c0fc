"""Which part of the protocol takes how many points: what lies between ours and the paper's, one factor at a time.

An arm is a set of factors that are the paper's; all others are ours. Its value is how far AP50 falls, by the
labels that count there. From none to all of them there are many ways; two are walked, the factors in their order
and in the reverse, and each factor's points are the mean of what it adds on both: on each way, and so here, they
sum to the difference (two of the orders that Shapley's value averages over). Beside them stands what each adds to
ours alone.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivesem.analysis.transfer.report import bounded
from drivesem.attack.targets import HEADLINE
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig
from drivesem.evaluation.resampling import Figure, Interval, differences, holm
from drivesem.report.paper import PAPER_BENIGN, PAPER_COMBOS
from drivesem.report.plots import COLOURS, STYLE
from drivesem.report.tables import ReportTable, format_count, format_percent
from drivesem.run.protocol import PROTOCOL
from scene_ir import files
from tools.experiments.detection.arms import PAPER_PROTOCOL, AttackArm
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.report import StudyText, heading
from tools.experiments.detection.rows import ArmMetrics, feasible_fraction
from tools.experiments.settings import StudyConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COUNTED = "labels that count"
"""The factor that no attack knows of: the same pictures, counted by other labels."""
LABELS = (COUNTED, "labels aimed at")
_SETTINGS = {
    LABELS[1]: "objective_labels",
    "loss": "objective",
    "iterate kept": "keep",
    "projection": "project",
    "parametrisation": "parametrisation",
}
_DETECTOR = "detector"
OURS = "ours"
_FACTOR = "factor"
_Arms = frozenset[str]
"""The factors that are the paper's."""


@dataclass(frozen=True, slots=True)
class AttributionPlan:
    """Factors in their order, and the attack of each set of them."""

    factors: tuple[str, ...]
    ours: AttackConfig
    other_detector: str | None

    @classmethod
    def from_study(cls, study: StudyConfig, base: AttackConfig) -> AttributionPlan:
        """base: what the study gives all arms; its settings that are factors are ours and the paper's here."""
        default = AttackConfig()
        own = {name: getattr(default, name) for name in _SETTINGS.values()}
        ours = replace(base, combo=DEFAULT_COMBO, method="si-fgsm", grade=False, **own)
        factors = (COUNTED, *_SETTINGS, *([_DETECTOR] if study.other_detector else []))
        return cls(factors, ours, study.other_detector)

    def config(self, papers: _Arms) -> AttackConfig:
        """The attack where so many factors are the paper's."""
        changes: dict[str, Any] = {name: PROTOCOL[name] for f, name in _SETTINGS.items() if f in papers}
        if _DETECTOR in papers:
            changes["detector"] = self.other_detector
        return replace(self.ours, **changes)

    def paths(self) -> list[list[_Arms]]:
        """From none to all, in the factors' order and in the reverse."""
        orders = (self.factors, self.factors[::-1])
        return [[frozenset(order[:k]) for k in range(len(order) + 1)] for order in orders]

    def arms(self) -> list[AttackArm]:
        """Each attack once: of both ways, and of each factor alone."""
        first, second = self.paths()
        asked = [first[0], first[-1], *first[1:-1], *second[1:-1], *(frozenset([f]) for f in self.factors)]
        named = {self.arm_name(papers): papers for papers in asked}
        folders = {name: re.sub(r"[^a-z0-9]+", "-", name) for name in named}
        return [AttackArm(name, folders[name], self.config(papers)) for name, papers in named.items()]

    def arm_name(self, papers: _Arms) -> str:
        """Of the arm whose attack this is: labels that count make no other."""
        changed = [f for f in self.factors[1:] if f in papers]
        if len(changed) in (0, len(self.factors) - 1):
            return PAPER_PROTOCOL if changed else OURS
        return ", ".join(changed)


@dataclass(frozen=True, slots=True)
class FactorShare:
    """One factor, or some together, fractions of 1. alone: points that it adds to ours; points: its mean on both
    ways, of which `ways` are the two; p: of the permutation test of `points`, Holm's, None where it is not tested.
    """

    name: str
    alone: Interval
    points: Interval
    path_points: tuple[float | None, float | None]
    p: float | None = None

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        found: dict[str, Any] = {"name": self.name}
        for key, one in (("alone", self.alone), ("points", self.points)):
            found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found | {"in_order": self.path_points[0], "in_reverse": self.path_points[1], "p": self.p}


@dataclass(frozen=True, slots=True)
class Attribution:
    """What was found. falls: of each arm by its name, by labels that moved and by benign ones; ours, papers: where
    the ways begin and end; shares: of the factors in their order; labels: of both kinds together; total: of all.
    """

    study: StudyConfig
    draws: int
    counts: StudyCounts
    drops: Mapping[str, Mapping[str, Interval]]
    ours: float | None
    papers: float | None
    shares: Sequence[FactorShare]
    labels: FactorShare
    total: FactorShare

    def rows(self) -> list[FactorShare]:
        """As they are told."""
        return [*self.shares, self.labels, self.total]

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        return heading(self.study, self.draws, self.counts) | {
            "ours": self.ours,
            "papers": self.papers,
            "rows": [share.to_row() for share in self.rows()],
            "arms": self.arm_rows(),
        }

    def arm_rows(self) -> list[dict[str, Any]]:
        """The falls of each arm."""
        found: list[dict[str, Any]] = []
        for run in self.counts.arms:
            line: dict[str, Any] = {"name": run.arm.name, "feasible_fraction": feasible_fraction(run.frames)}
            for mode, one in self.drops[run.arm.name].items():
                line |= {f"drop_{mode}": one.value, f"drop_{mode}_low": one.low, f"drop_{mode}_high": one.high}
            found.append(line)
        return found


class _DropMeasurements:
    """Falls of AP50 of all arms, and what they differ by: all of the same draws of frames."""

    def __init__(self, plan: AttributionPlan, counts: StudyCounts, draws: int, seed: int) -> None:
        self._plan, self._draws, self._seed = plan, draws, seed
        self._figures = {run.arm.name: ArmMetrics.from_runs(run).ap50_only() for run in counts.arms}
        self._detector = {run.arm.name: run.arm.config.detector for run in counts.arms}

    def falls(self, name: str) -> dict[str, Interval]:
        """Of an arm, by the labels that count."""
        return {m: self._figures[name].drops(m, self._draws, self._seed)["ap50"] for m in ("moved", "paper")}

    def fall(self, papers: _Arms) -> float | None:
        """At one stop on a way."""
        figures = self._figures[self._plan.arm_name(papers)]
        before, after = figures.before[0].value(), self._after(papers).value()
        return None if before is None or after is None else before - after

    def step(self, one: _Arms, other: _Arms) -> float | None:
        """How much further AP50 falls at the second stop than at the first."""
        before, after = self.fall(one), self.fall(other)
        return None if before is None or after is None else after - before

    def more(self, steps: Sequence[tuple[_Arms, _Arms]], test: bool) -> tuple[Interval, float | None]:
        """How much further AP50 falls at the second stop of each pair than at the first: the mean, and p, where a
        test is asked for.

        A figure is the mean of its parts. Where the detector differs, so does what its AP50 falls from, and each
        pair has two parts a side.
        """
        less: list[Figure] = []
        more: list[Figure] = []
        for one, other in steps:
            more.append(self._after(one))
            less.append(self._after(other))
            names = [self._plan.arm_name(papers) for papers in (one, other)]
            if len({self._detector[name] for name in names}) > 1:
                befores = [self._figures[name].before[0] for name in names]
                less.append(befores[0])
                more.append(befores[1])
        first, second = (Figure("ap50", tuple(p for one in side for p in one.parts)) for side in (less, more))
        frames, rng = self._figures[OURS].frames, np.random.default_rng(self._seed)
        (found,) = differences([first], [second], frames, self._draws, rng, test)
        times = len(less) / len(steps)
        values = (found.difference, found.low, found.high)
        return Interval("ap50", *(None if value is None else times * value for value in values)), found.p

    def _after(self, papers: _Arms) -> Figure:
        mode = "paper" if COUNTED in papers else "moved"
        return self._figures[self._plan.arm_name(papers)].after[mode][0]


def attribute_drop(study: StudyConfig, plan: AttributionPlan, counts: StudyCounts, draws: int) -> Attribution:
    """What each factor takes, of the arms of a plan."""
    measures, ways = _DropMeasurements(plan, counts, draws, study.seed), plan.paths()
    none, everything = ways[0][0], ways[0][-1]

    def share(name: str, factors: Sequence[str], test: bool = False) -> tuple[FactorShare, float | None]:
        size = len(factors)
        steps = [
            next((way[k], way[k + size]) for k in range(len(way) - size) if way[k + size] - way[k] == {*factors})
            for way in ways
        ]
        points, p = measures.more(steps, test)
        alone, _ = measures.more([(none, frozenset(factors))], test=False)
        in_order, in_reverse = (measures.step(*step) for step in steps)
        return FactorShare(name, alone, points, (in_order, in_reverse)), p

    found = [share(factor, [factor], test=True) for factor in plan.factors]
    adjusted = holm([p for _, p in found])
    return Attribution(
        study=study,
        draws=draws,
        counts=counts,
        drops={run.arm.name: measures.falls(run.arm.name) for run in counts.arms},
        ours=measures.fall(none),
        papers=measures.fall(everything),
        shares=[replace(one, p=p) for (one, _), p in zip(found, adjusted, strict=True)],
        labels=share("labels, both", LABELS)[0],
        total=share("all", plan.factors)[0],
    )


def attribution_text(found: Attribution) -> StudyText:
    """The study as text."""
    tables = {"study": [one.to_row() for one in found.rows()], "arms": found.arm_rows()}
    sheets = [_shares(found), _arms(found)]
    return StudyText(found.study.name, sheets, sheets[:1], notes(found), tables, (_FACTOR, "the paper's"))


def _shares(found: Attribution) -> ReportTable:
    lines = []
    for one in found.rows():
        ways = ("-" if value is None else f"{100 * value:.1f}" for value in one.path_points)
        p = "-" if one.p is None else f"{one.p:.3f}"
        lines.append((one.name, bounded(one.alone), bounded(one.points), *ways, p))
    columns = (_FACTOR, "added to ours alone", "points", "in this order", "in the reverse", "p")
    ends = f"from {format_percent(found.ours)}, ours, to {format_percent(found.papers)}, the {PAPER_PROTOCOL}"
    return ReportTable(f"How far {HEADLINE} AP50 falls, points: {ends}", columns, tuple(lines))


def _arms(found: Attribution) -> ReportTable:
    lines = []
    for run in found.counts.arms:
        falls = found.drops[run.arm.name]
        share = format_percent(feasible_fraction(run.frames))
        lines.append((run.arm.name, bounded(falls["moved"]), bounded(falls["paper"]), share))
    columns = ("the paper's", "falls, moved labels", "falls, benign labels", "feasible, %")
    return ReportTable("Arms, by what in them is the paper's", columns, tuple(lines))


def notes(found: Attribution) -> list[str]:
    """What the columns mean."""
    spread = f" In brackets: 95 % of {found.draws} draws of frames, paired." if found.draws else ""
    lines = [
        f"Combination {DEFAULT_COMBO} by ten steps of si-FGSM. Points: how much further AP50 falls with the "
        "paper's choice than with ours, the mean of two ways from ours to the paper's, in this order and in the "
        f"reverse; they sum to the difference.{spread} p: permutation of frames, Holm's over the factors.",
        "Labels that count: the same pictures by labels that stay. Labels aimed at: the attack raises its loss by "
        "them. Which iterate is the best is always decided by labels that moved.",
        f"There the paper's SqueezeDet fell by {100 * (PAPER_BENIGN - PAPER_COMBOS[DEFAULT_COMBO]):.1f} points on "
        "Virtual KITTI.",
    ]
    if found.counts.without_vehicles:
        lines.append(f"{format_count(found.counts.without_vehicles, 'frame')} without vehicles passed over.")
    return lines + [f"Frame {name} could not be used: {reason}" for name, reason in found.counts.failed.items()]


def write_waterfall(path: Path, found: Attribution) -> None:
    """From ours to the paper's protocol, a step for each factor, as a PNG."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    with mpl.rc_context(dict(STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Canvas(figsize=(1.6 + 1.15 * (len(found.shares) + 2), 4.6), layout="constrained")
        _draw(figure.add_subplot(), found)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def _draw(axes: Axes, found: Attribution) -> None:
    at = 100 * (found.ours or 0.0)
    axes.bar(0, at, color=COLOURS[0])
    axes.text(0, at, f" {at:.1f}", ha="center", va="bottom")
    for place, one in enumerate(found.shares, start=1):
        points = 100 * (one.points.value or 0.0)
        axes.bar(place, points, bottom=at, color=COLOURS[1] if points > 0 else COLOURS[2])
        axes.plot([place - 1, place], [at, at], color=COLOURS[6], linewidth=0.8)
        top = max(at, at + points)
        if one.points.low is not None and one.points.high is not None:
            bounds = [at + 100 * one.points.low, at + 100 * one.points.high]
            axes.plot([place, place], bounds, color=COLOURS[6], linewidth=1.2, zorder=3)
            top = max(top, *bounds)
        axes.text(place, top, f"{points:+.1f}", ha="center", va="bottom")
        at += points
    last = len(found.shares) + 1
    axes.plot([last - 1, last], [at, at], color=COLOURS[6], linewidth=0.8)
    axes.bar(last, at, color=COLOURS[0])
    axes.text(last, at, f"{at:.1f}", ha="center", va="bottom")
    axes.axhline(0, color=COLOURS[6], linewidth=0.8)
    names = [OURS, *(share.name for share in found.shares), PAPER_PROTOCOL]
    axes.set_xticks(range(last + 1), [name.replace(" ", "\n") for name in names])
    axes.set_ylabel("fall of AP50, points")
    axes.set_title("From ours to the paper's protocol; lines: 95 % of draws of frames", loc="left", fontsize=11)
