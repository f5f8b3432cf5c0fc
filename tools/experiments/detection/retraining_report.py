"""The tables, notes and plot of the study `retrain`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.analysis.transfer import AP50, BROKEN, LOST, format_interval
from drivesem.attacks.targets import HEADLINE
from drivesem.evaluation.resampling import Interval
from drivesem.reporting.plots import PLOT_COLOURS
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count, format_percent
from tools.experiments.detection.arms import feasible_share
from tools.experiments.detection.comparison import METRIC_NAMES, MODES
from tools.experiments.detection.plots import bar_position, draw_bars, write_figure
from tools.experiments.detection.report import (
    FEASIBLE,
    LABEL_MODES,
    OWN_PROTOCOL,
    build_study_report,
    describe_intervals,
    describe_skipped,
)
from tools.experiments.detection.retraining_arms import BENIGN
from tools.experiments.detection.retraining_results import DetectorResult, RetrainingResults
from tools.experiments.detection.robustness import (
    ANYWHERE,
    AROUND,
    CONTROLS,
    GOAL,
    REDRAWN,
    RobustnessRow,
    redrawn_count,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DETECTOR, _LABELS, _PICTURES, _MIX, _WINDOW = "detector", "labels", "pictures", "mix", "window"
_GOAL = "missed goals"
_TEXT_COLUMNS = (_DETECTOR, _LABELS, _PICTURES, _MIX, _WINDOW, _GOAL)
_PICTURE_NAMES = {
    "benign": "photographs",
    "rerender": "re-rendered",
    "counterexample": "counterexamples",
    "random": "random edits",
    "generator": "random edits, by the generator",
    "around": "certain failures, resampled",
}
_SIZE_IN = (9.6, 4.8)
_STATES = {
    ANYWHERE: "states anywhere",
    REDRAWN: "some of them,\nsecond renderer",
    AROUND: "states around\ncertain failures",
}
_GROUPS = {
    "benign": "benign frames",
    "known": "counterexamples\nof the benign detector",
    "fresh": "fresh counterexamples",
}
_MAX_IN_THREE_COLUMNS = 6
"""Detectors in a legend of three columns: without seeds, their names are short."""


def retraining_report(results: RetrainingResults, out: Path) -> AnalysisReport:
    """The report of the study `retrain`."""
    tables = [_robustness_table(results)] if results.robustness else []
    tables += [_benign_table(results.rows), _known_table(results.rows)]
    if _attacked_again(results.rows):
        tables.append(_fresh_table(results.rows))
    csv_tables = {"study": [row.to_row() for row in results.rows]}
    if results.robustness:
        csv_tables["robust"] = [row.to_row() for row in results.robustness]
    return build_study_report(
        results.study,
        out,
        results.to_json(),
        csv_tables,
        [*tables, _metric_table(results.rows), _training_table(results)],
        tables,
        notes=_build_notes(results),
        text_columns=_TEXT_COLUMNS,
        picture=partial(write_retraining_plot, results=results),
    )


def _attacked_again(rows: Sequence[DetectorResult]) -> bool:
    """Whether the retrained detectors were attacked too."""
    return any(row.fresh is not None for row in rows[1:])


def _robustness_table(results: RetrainingResults) -> ReportTable:
    lines = []
    for row in results.robustness:
        cells = [row.title.partition(", seed ")[0], format_interval(row.failures[ANYWHERE])]
        cells += [_format_reduction(row, ANYWHERE, arm) for arm in CONTROLS]
        for kind in (REDRAWN, AROUND):
            cells += [format_interval(row.failures[kind]), _format_reduction(row, kind, CONTROLS[0])]
        drop = "-" if row.title == BENIGN else format_percent(row.ap50_drop)
        goal = "-" if row.short_of is None else ", ".join(row.short_of) or "none"
        lines.append((*cells, format_interval(row.phantoms), drop, goal))
    columns = (
        *(_DETECTOR, "anywhere", "fewer than benign", "fewer than random", "second renderer", "fewer than benign"),
        *("around failures", "fewer than benign", "phantoms", "AP50 drop", _GOAL),
    )
    frames, states = len(results.counts.states), results.study.states
    return ReportTable(
        f"Failures per car, {frames} held-out frames, {states} states each, %", columns, tuple(lines)
    )


def _format_reduction(row: RobustnessRow, kind: str, arm: str) -> str:
    return format_interval(row.fewer[kind, arm]) if (kind, arm) in row.fewer else "-"


def _benign_table(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        drops = ["-" if row.name == BENIGN else format_interval(row.drops[key]) for key in (AP50, "recall")]
        metrics = (format_percent(row.benign.ap50), drops[0], format_percent(row.benign.recall), drops[1])
        lines.append((row.name, *metrics, *_paper_cells(rows, row, 1)))
    columns = (_DETECTOR, "AP50", "drop", "recall", "recall drop", *_paper_columns(rows))
    return ReportTable(f"{rows[0].benign_frames} held-out benign frames, {HEADLINE}, %", columns, tuple(lines))


def _known_table(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        gains = ["-" if row.name == BENIGN else format_interval(row.gains["known"][mode]) for mode in MODES]
        metrics = [format_percent(getattr(row.known, mode).headline.ap50) for mode in MODES]
        recall = format_percent(row.known.moved.headline.recall)
        lines.append((row.name, *metrics, *gains, recall, *_paper_cells(rows, row, 0)))
    columns = (_DETECTOR, *MODES, *(f"gain, {mode}" for mode in MODES), "recall, moved", *_paper_columns(rows))
    title = f"Counterexamples of the {BENIGN}, {rows[0].known.frames} held-out frames, AP50, %"
    return ReportTable(title, columns, tuple(lines))


def _paper_columns(rows: Sequence[DetectorResult]) -> tuple[str, ...]:
    return ("paper's mAP",) if any(row.reference is not None for row in rows) else ()


def _paper_cells(rows: Sequence[DetectorResult], row: DetectorResult, which: int) -> tuple[str, ...]:
    """The paper's number, if the table has it: on counterexamples (0) or on benign frames (1)."""
    return tuple(format_percent(row.reference[which] if row.reference else None) for _ in _paper_columns(rows))


def _fresh_table(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        if row.fresh is None:
            continue
        gains = ["-" if row.name == BENIGN else format_interval(row.gains["fresh"][mode]) for mode in MODES]
        metrics = [format_percent(getattr(row.fresh, mode).ap50) for mode in MODES]
        lines.append((row.name, *metrics, *gains, format_percent(row.to_row()["fresh_broken_rate"])))
    columns = (_DETECTOR, *MODES, *(f"gain, {mode}" for mode in MODES), "frames broken")
    title = "Fresh counterexamples, against each detector on the same frames, AP50, %"
    return ReportTable(title, columns, tuple(lines))


def _metric_table(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        known = row.known
        scores = {
            "benign frames": row.benign,
            "photographs of the attacked frames": known.benign.headline,
            "known counterexamples, paper": known.paper.headline,
            "known counterexamples, moved": known.moved.headline,
        }
        if row.fresh is not None:
            scores |= {f"fresh counterexamples, {mode}": getattr(row.fresh, mode) for mode in MODES}
        lost, found = known.counts[LOST]
        broken = f"{format_percent(known.shares[BROKEN].value)}; {lost} of {found} lost"
        for name, one in scores.items():
            metrics = (format_percent(getattr(one, key)) for key in METRIC_NAMES)
            lines.append((row.name, name, *metrics, broken if name.startswith("known") else "-"))
    columns = (_DETECTOR, _PICTURES, *METRIC_NAMES.values(), "frames broken, %")
    return ReportTable(f"{HEADLINE}, further metrics, %", columns, tuple(lines))


def _training_table(results: RetrainingResults) -> ReportTable:
    lines = []
    for arm in results.arms:
        config = arm.config
        pictures = f"{results.counts.counterexamples[arm.name]} {_PICTURE_NAMES[arm.pictures]}"
        mix = f"{config.fraction:g}, {config.mix}"
        settings = (str(config.steps), str(config.batch), f"{config.rate:g}", config.loss)
        lines.append((arm.name, pictures, arm.labels, mix, config.window, *settings))
    columns = (_DETECTOR, _PICTURES, _LABELS, _MIX, _WINDOW, "steps", "batch", "rate", "loss")
    return ReportTable("Training", columns, tuple(lines))


def _build_notes(results: RetrainingResults) -> list[str]:
    rows, counts = results.rows, results.counts
    training, test = counts.training_attacks, counts.test_attacks
    thresholds = "; ".join(f"{row.name} {row.t_star:.3f}" for row in rows)
    chosen_on = "the frames of --validation" if results.study.validation else "the benign test frames"
    notes = [
        f"Training: {format_count(training.frames, 'frame')} attacked by {counts.attack} and "
        f"{format_count(counts.benign_training_frames, 'benign frame')}. Test: {rows[0].known.frames} other "
        "frames, which no detector was trained on.",
        f"{LABEL_MODES}{describe_intervals(results.draws)}",
        "Gain: over the original detector, on the same pictures; for fresh counterexamples, over what the attack on "
        "the original one leaves. Only fresh counterexamples show whether a detector became robust: the known ones "
        "were made for weights that it no longer has.",
        "Retrained on benign re-rendered images: the same frames and steps as ours without any change, which shows "
        "the effect of further training alone.",
        "Paper's mAP: by the same attack. Its original detector had been trained on re-rendered images, hence the "
        "row for those; its retrained one had a quarter of the frames replaced by counterexamples, with the benign "
        "labels. Its recall was 92.97 on counterexamples and 93.70 on benign frames."
        if _paper_columns(rows)
        else OWN_PROTOCOL,
        "Frames broken: by a lost object or a phantom, moved labels, from each detector's t*: "
        f"{thresholds}. A retrained detector's t* was chosen on {chosen_on}.",
    ]
    if results.robustness:
        notes.append(_describe_robustness(results))
    notes += [f"Left out: {name}: {reason}." for name, reason in counts.left_out.items()]
    notes.append(FEASIBLE.format(format_percent(feasible_share(training, test))))
    skipped = training.without_vehicles + test.without_vehicles
    return notes + describe_skipped(skipped, {**training.failed, **test.failed})


def _describe_robustness(results: RetrainingResults) -> str:
    states = results.study.states
    text = (
        "Failures: share of the cars found by the benign detector in the photograph that a detector misses in "
        f"{states} states of each frame, anywhere within the attack's bounds; all detectors see the same pictures. "
        f"Second renderer: {redrawn_count(states)} of these states, rendered by it. Around failures: cars that the "
        "attack made the benign detector lose with certainty, in states around that failure. Fewer: reduction of "
        "that arm's failures, paired over frames. Phantoms: share of pictures with any, in states anywhere. Seeds "
        "count together."
    )
    if any(row.short_of is not None for row in results.robustness):
        text += f" Goals: {'; '.join(f'{name}: {goal}' for name, goal in GOAL.items())}."
    return text


def write_retraining_plot(path: Path, results: RetrainingResults) -> None:
    """Draw how likely each arm misses a car, if states were tested, or else AP50 of each detector by pictures."""

    def draw(axes: Axes) -> None:
        count = _draw_failures(axes, results) if results.robustness else _draw_ap50(axes, results.rows)
        columns = 3 if count <= _MAX_IN_THREE_COLUMNS else 2
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=columns, fontsize=9)

    write_figure(path, _SIZE_IN, draw)


def _draw_failures(axes: Axes, results: RetrainingResults) -> int:
    """Draw cars missed and pictures with phantoms by arm as bars; the number of arms."""
    series: dict[str, list[Interval | None]] = {
        row.title: [*(row.failures[kind] for kind in _STATES), row.phantoms] for row in results.robustness
    }
    draw_bars(axes, series)
    axes.set_xticks(range(len(_STATES) + 1), [*_STATES.values(), "phantoms"])
    axes.set(ylabel="cars missed; pictures with phantoms, %", ylim=(0, None))
    title = f"{len(results.counts.states)} held-out frames, {results.study.states} states each"
    axes.set_title(f"{title}; lines: 95 % interval over frames", loc="left", fontsize=11)
    return len(series)


def _draw_ap50(axes: Axes, rows: Sequence[DetectorResult]) -> int:
    """Draw AP50 by pictures as bars, the paper's as marks; the number of detectors."""
    groups = {name: label for name, label in _GROUPS.items() if name != "fresh" or _attacked_again(rows)}
    series: dict[str, list[Interval | None]] = {
        row.name: [row.spread.get(group) for group in groups] for row in rows
    }
    draw_bars(axes, series)
    label: str | None = "the paper, mAP"
    for i, row in enumerate(rows):
        if row.reference is None:
            continue
        known, benign = row.reference
        places = [bar_position(group, i, len(series)) for group in (0, 1)]
        style = {"color": PLOT_COLOURS[-1], "markersize": 5, "zorder": 4}
        axes.plot(places, [100 * benign, 100 * known], "D", label=label, **style)  # pyright: ignore
        label = None
    axes.set_xticks(range(len(groups)), list(groups.values()))
    axes.set(ylabel=f"{HEADLINE} AP50, %", ylim=(0, 104))
    axes.set_title("Moved labels; lines: 95 % interval over frames", loc="left", fontsize=11)
    return len(series)
