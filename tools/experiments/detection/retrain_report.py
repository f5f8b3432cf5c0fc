"""`drivesem study retrain` for people: tables, what they mean, and a picture."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.analysis.transfer.matrix import AP50, BROKEN, LOST
from drivesem.analysis.transfer.report import bounded
from drivesem.attack.targets import HEADLINE
from drivesem.evaluation.resampling import Interval
from drivesem.report.plots import COLOURS, STYLE
from drivesem.report.tables import ReportTable, format_count, format_percent
from scene_ir import files
from tools.experiments.detection.lessons import BENIGN
from tools.experiments.detection.plots import DPI, bars, place_of
from tools.experiments.detection.report import OWN_PROTOCOL, StudyText
from tools.experiments.detection.robust import ANYWHERE, AROUND, CONTROLS, GOAL, REDRAWN, redrawn_count
from tools.experiments.detection.rows import METRIC_NAMES, MODES
from tools.experiments.detection.running import feasible_share
from tools.experiments.detection.taught import DetectorResult, RetrainingResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DETECTOR, _LABELS, _PICTURES, _MIX, _WINDOW = "detector", "labels", "pictures", "mix", "window"
_GOAL = "short of the goal"
_WORDS = (_DETECTOR, _LABELS, _PICTURES, _MIX, _WINDOW, _GOAL)
_SHOWN = {
    "benign": "photographs",
    "rerender": "re-rendered",
    "counterexample": "counterexamples",
    "random": "random edits",
    "generator": "random edits, by the generator",
    "around": "certain failures, drawn anew",
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


def retraining_text(found: RetrainingResults) -> StudyText:
    """The study as text."""
    short = [_robust(found)] if found.robustness else []
    short += [_benign(found.rows), _known(found.rows)]
    short += [_fresh(found.rows)] if _attacked_again(found.rows) else []
    whole = [*short, _further(found.rows), _training(found)]
    tables = {"study": [row.to_row() for row in found.rows]}
    tables |= {"robust": [row.to_row() for row in found.robustness]} if found.robustness else {}
    return StudyText(found.study.name, whole, short, notes(found), tables, _WORDS)


def _attacked_again(rows: Sequence[DetectorResult]) -> bool:
    """Whether the retrained detectors were attacked too."""
    return any(row.fresh is not None for row in rows[1:])


def _robust(found: RetrainingResults) -> ReportTable:
    """How likely each arm fails a car."""
    lines = []
    for row in found.robustness:
        cells = [row.title.partition(", seed ")[0], bounded(row.failures[ANYWHERE])]
        cells += [bounded(row.fewer[ANYWHERE, arm]) if (ANYWHERE, arm) in row.fewer else "-" for arm in CONTROLS]
        for kind in (REDRAWN, AROUND):
            beside = row.fewer.get((kind, CONTROLS[0]))
            cells += [bounded(row.failures[kind]), "-" if beside is None else bounded(beside)]
        falls = "-" if row.title == BENIGN else format_percent(row.ap50_falls)
        goal = "-" if row.short_of is None else ", ".join(row.short_of) or "met"
        lines.append((*cells, bounded(row.phantoms), falls, goal))
    columns = (
        *(_DETECTOR, "anywhere", "fewer than benign", "fewer than random", "second renderer", "fewer than benign"),
        *("around failures", "fewer than benign", "phantoms", "AP50 falls", _GOAL),
    )
    title = f"Failures a car, {len(found.counts.states)} held-out frames, {found.study.states} states each, %"
    return ReportTable(title, columns, tuple(lines))


def _benign(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        falls = ("-", "-") if row.name == BENIGN else (bounded(row.drops[AP50]), bounded(row.drops["recall"]))
        figures = (format_percent(row.benign.ap50), *falls[:1], format_percent(row.benign.recall), *falls[1:])
        lines.append((row.name, *figures, *_there(rows, row, 1)))
    columns = (_DETECTOR, "AP50", "falls", "recall", "recall falls", *_there_told(rows))
    return ReportTable(f"{rows[0].benign_frames} held-out benign frames, {HEADLINE}, %", columns, tuple(lines))


def _known(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        gains = ["-" if row.name == BENIGN else bounded(row.gains["known"][mode]) for mode in MODES]
        figures = [format_percent(getattr(row.known, mode).headline.ap50) for mode in MODES]
        recall = format_percent(row.known.moved.headline.recall)
        lines.append((row.name, *figures, *gains, recall, *_there(rows, row, 0)))
    columns = (_DETECTOR, *MODES, *(f"gain, {mode}" for mode in MODES), "recall, moved", *_there_told(rows))
    frames = rows[0].known.frames
    return ReportTable(
        f"Counterexamples of the {BENIGN}, {frames} held-out frames, AP50, %", columns, tuple(lines)
    )


def _there_told(rows: Sequence[DetectorResult]) -> tuple[str, ...]:
    """The column of the paper's figures, where there is one."""
    return ("mAP there",) if any(row.reference is not None for row in rows) else ()


def _there(rows: Sequence[DetectorResult], row: DetectorResult, which: int) -> tuple[str, ...]:
    """Its cell: on counterexamples (0) or on benign frames (1)."""
    return tuple(format_percent(row.reference[which] if row.reference else None) for _ in _there_told(rows))


def _fresh(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        if row.fresh is None:
            continue
        gains = ["-" if row.name == BENIGN else bounded(row.gains["fresh"][mode]) for mode in MODES]
        flat = row.to_row()
        figures = [format_percent(getattr(row.fresh, mode).ap50) for mode in MODES]
        lines.append((row.name, *figures, *gains, format_percent(flat["fresh_broken_rate"])))
    columns = (_DETECTOR, *MODES, *(f"gain, {mode}" for mode in MODES), "frames broken")
    return ReportTable(
        "Fresh counterexamples, against each detector on the same frames, AP50, %", columns, tuple(lines)
    )


def _further(rows: Sequence[DetectorResult]) -> ReportTable:
    lines = []
    for row in rows:
        known, shares = row.known, row.known.shares
        lost, of = known.counts[LOST]
        scores = {
            "benign frames": row.benign,
            "photographs of the attacked frames": known.benign.headline,
            "known counterexamples, paper": known.paper.headline,
            "known counterexamples, moved": known.moved.headline,
        }
        if row.fresh is not None:
            fresh = {f"fresh counterexamples, {mode}": getattr(row.fresh, mode) for mode in MODES}
            scores |= fresh
        for name, one in scores.items():
            seen = (
                f"{format_percent(shares[BROKEN].value)}; {lost} of {of} lost" if name.startswith("known") else "-"
            )
            lines.append((row.name, name, *(format_percent(getattr(one, key)) for key in METRIC_NAMES), seen))
    columns = (_DETECTOR, _PICTURES, *METRIC_NAMES.values(), "frames broken, %")
    return ReportTable(f"{HEADLINE}, further figures, %", columns, tuple(lines))


def _training(found: RetrainingResults) -> ReportTable:
    lines = []
    for lesson in found.arms:
        config = lesson.config
        pictures = f"{found.counts.counterexamples[lesson.name]} {_SHOWN[lesson.pictures]}"
        lines.append(
            (
                *(lesson.name, pictures, lesson.labels, f"{config.fraction:g}, {config.mix}", config.window),
                *(str(config.steps), str(config.batch), f"{config.rate:g}", config.loss),
            )
        )
    columns = (_DETECTOR, _PICTURES, _LABELS, _MIX, _WINDOW, "steps", "batch", "rate", "loss")
    return ReportTable("How they were trained", columns, tuple(lines))


def notes(found: RetrainingResults) -> list[str]:
    """What the columns mean."""
    spread = f" In brackets: 95 % of {found.draws} draws of frames, paired." if found.draws else ""
    rows = found.rows
    learned, judged = found.attacks
    lines = [
        f"{format_count(learned.frames, 'frame')} attacked by {found.counts.attack} to train on, beside "
        f"{format_count(found.counts.benign_training_frames, 'benign frame')}; "
        f"{rows[0].known.frames} others, which no detector was trained on, to judge by.",
        f"Paper: by the benign labels, as in the paper; moved: by labels that moved with the cars.{spread}",
        "Gain: over the detector as it was, on the same pictures, and for fresh ones over what the attack on it "
        "leaves. Only fresh counterexamples say whether a detector became robust: the known ones were made for "
        "weights that it no longer has.",
        "Retrained on benign re-rendered images: the same frames and steps as ours, without any change in them: "
        "what further training alone does.",
        "There: in the paper, mAP; ours by the same attack. Its benign detector had been trained on re-rendered "
        "images, hence their row; its retrained one had a quarter of the frames replaced by counterexamples, with "
        "the benign labels. Its recall on counterexamples was 92.97, on benign frames 93.70."
        if _there_told(rows)
        else OWN_PROTOCOL,
        "Frames broken: by a lost object or a phantom, moved labels, from each detector's t* on: "
        + "; ".join(f"{row.name} {row.t_star:.3f}" for row in rows)
        + ". A retrained detector's t* was chosen on "
        + ("the frames of --validation." if found.study.validation else "the benign frames that judge it."),
    ]
    if found.robustness:
        lines.append(_of_robust(found))
    lines += [f"Left out: {name}: {reason}." for name, reason in found.counts.left_out.items()]
    share = format_percent(feasible_share(learned, judged))
    lines.append(f"Feasible by the independent check: {share} % of all attacked frames.")
    passed = learned.without_vehicles + judged.without_vehicles
    if passed:
        lines.append(f"{format_count(passed, 'frame')} without vehicles passed over.")
    failed = {**learned.failed, **judged.failed}
    lines += [f"Frame {name} could not be used: {reason}" for name, reason in failed.items()]
    return lines


def _of_robust(found: RetrainingResults) -> str:
    states = found.study.states
    text = (
        "Failures: share of the cars that the benign detector finds in the photograph which a detector does not "
        f"find in {states} states of each frame, anywhere that the attack was allowed to go; all see the "
        f"same states in the same draws. Second renderer: {redrawn_count(states)} of these states, drawn by it. "
        "Around failures: the cars that the attack on the benign detector lost for certain, in states around that "
        "failure. Fewer: the share of that arm's failures that a detector is without, paired over frames. "
        "Phantoms: pictures with any, of states anywhere. Seeds count together."
    )
    if any(row.short_of is not None for row in found.robustness):
        goal = "; ".join(f"{name}: {what}" for name, what in GOAL.items())
        text += f" The goal: {goal}. The last column says what is not so."
    return text


_MOST_IN_THREE = 6
"""Detectors whose names fit side by side in a legend of three columns: without seeds, they are short."""


def write_plot(path: Path, found: RetrainingResults) -> None:
    """How likely each arm fails a car, where states were shown; else AP50 of each detector by pictures."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(dict(STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        axes = figure.add_subplot()
        count = _failures(axes, found) if found.robustness else _ap50(axes, found.rows)
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3 if count <= _MOST_IN_THREE else 2, fontsize=9
        )
    buffer = io.BytesIO()
    # no date and no version in the file: equal figures give equal bytes
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def _failures(axes: Axes, found: RetrainingResults) -> int:
    """Bars of cars that are not found and pictures with phantoms, by arm; how many arms there are."""
    series: dict[str, list[Interval | None]] = {
        row.title: [*(row.failures[kind] for kind in _STATES), row.phantoms] for row in found.robustness
    }
    bars(axes, series)
    axes.set_xticks(range(len(_STATES) + 1), [*_STATES.values(), "phantoms"])
    axes.set(ylabel="cars not found; pictures with phantoms, %", ylim=(0, None))
    title = f"{len(found.counts.states)} held-out frames, {found.study.states} states each"
    axes.set_title(f"{title}; lines: 95 % of draws of frames", loc="left", fontsize=11)
    return len(series)


def _ap50(axes: Axes, rows: Sequence[DetectorResult]) -> int:
    """Bars of AP50 on benign frames, known and fresh counterexamples, the paper's as marks; how many detectors."""
    groups = {name: told for name, told in _GROUPS.items() if name != "fresh" or _attacked_again(rows)}
    series: dict[str, list[Interval | None]] = {
        row.name: [row.spread.get(group) for group in groups] for row in rows
    }
    bars(axes, series)
    label: str | None = "the paper, mAP"
    for i, row in enumerate(rows):
        if row.reference is None:
            continue
        known, benign = row.reference
        places = [place_of(group, i, len(series)) for group in (0, 1)]
        axes.plot(places, [100 * benign, 100 * known], "D", color=COLOURS[-1], markersize=5, zorder=4, label=label)
        label = None
    axes.set_xticks(range(len(groups)), list(groups.values()))
    axes.set(ylabel=f"{HEADLINE} AP50, %", ylim=(0, 104))
    axes.set_title("Moved labels; lines: 95 % of draws of frames", loc="left", fontsize=11)
    return len(series)
