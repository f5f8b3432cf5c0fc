"""A study as a picture: falls of AP50 with the controls', curves of success, counterexamples by label set."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.evaluation.resampling import Interval
from drivesem.failures.grades import Grade
from drivesem.report.paper import PAPER_BENIGN
from drivesem.report.plots import COLOURS, LINES, STYLE
from scene_ir import files
from tools.experiments.detection.grades import ArmGrades
from tools.experiments.detection.labels import OVERLAPS, LabelComparison
from tools.experiments.detection.report import StudyResults
from tools.experiments.detection.rows import ArmComparison
from tools.experiments.detection.success import SuccessCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HEIGHT_IN = 4.6
_LEAST_WIDTH_IN, _GROUP_IN = 6.4, 1.3
_NAME_CHARACTERS = 13
"""As many fit under a group of bars."""
DPI = 150
"""Of a study's picture."""
_BLACK = "#000000"
_HATCHES = ("", "///", "...")
"""Of bars, where colours begin anew."""
_GROUP_WIDTH = 0.8
"""Of the bars of a group, in units of the distance from group to group."""


def write_plot(path: Path, found: StudyResults) -> None:
    """The study's own question as a PNG."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    sure = found.grades if found.study.name in ("grades", "searches") else ()
    groups = 0 if found.curves else len(sure or found.label_sets or found.rows)
    width = max(_LEAST_WIDTH_IN, _GROUP_IN * groups)
    with mpl.rc_context(dict(STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(width, _HEIGHT_IN), layout="constrained")
        axes = figure.add_subplot()
        if found.curves:
            _success(axes, found.curves)
        elif found.label_sets:
            _label_sets(axes, found.label_sets)
        elif sure:
            _grades(axes, sure)
        else:
            _falls(axes, found.rows)
        figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    buffer = io.BytesIO()
    # no date and no version in the file: equal figures give equal bytes
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def _falls(axes: Axes, rows: Sequence[ArmComparison]) -> None:
    """Bars of points of AP50 by arm; the paper's as marks."""
    series: dict[str, list[Interval | None]] = {
        "attack, benign labels": [row.drops["paper"]["ap50"] for row in rows],
        "attack, moved labels": [row.drops["moved"]["ap50"] for row in rows],
    }
    for name in dict.fromkeys(name for row in rows for name in row.controls):
        series[f"{name}, moved labels"] = [
            row.controls[name].drops["moved"]["ap50"] if name in row.controls else None for row in rows
        ]
    bars(axes, series)
    paper = [(i, r.run.arm.reference) for i, r in enumerate(rows) if r.run.arm.reference is not None]
    if paper:
        falls = [100 * (PAPER_BENIGN - reference) for _, reference in paper]
        axes.plot([i for i, _ in paper], falls, "D", color=_BLACK, label="the paper", markersize=6, zorder=4)
    axes.axhline(0, color=_BLACK, linewidth=0.8)
    axes.set_xticks(range(len(rows)), [_broken(row.name) for row in rows])
    axes.set_ylabel("fall of AP50, points")
    axes.set_title("What the attack takes from AP50; lines: 95 % of draws of frames", loc="left", fontsize=11)


def _grades(axes: Axes, grades: Sequence[ArmGrades]) -> None:
    """Bars of failures by arm and grade."""
    shown = (Grade.THRESHOLD, Grade.CERTAIN, Grade.CONFIRMED)
    bars(axes, {str(grade): [one.rates[grade] for one in grades] for grade in shown})
    axes.set_xticks(range(len(grades)), [_broken(one.name) for one in grades])
    axes.set_ylabel("failures, % of objects")
    axes.set_title("Failures by grade; lines: 95 % of draws of frames", loc="left", fontsize=11)


def _broken(name: str) -> str:
    """An arm's name in lines that fit under its bars."""
    return "\n".join(line for part in name.split(", ") for line in textwrap.wrap(part, _NAME_CHARACTERS))


def place_of(group: int, series: int, count: int) -> float:
    """Where the bar of a series stands in a group."""
    return group + (series - (count - 1) / 2) * _GROUP_WIDTH / count


def bars(axes: Axes, series: Mapping[str, Sequence[Interval | None]]) -> None:
    """Bars, %, side by side in each group, with their bounds; series by name."""
    width = _GROUP_WIDTH / len(series)
    for i, (name, values) in enumerate(series.items()):
        for group, one in enumerate(values):
            if one is None or one.value is None:
                continue
            place = place_of(group, i, len(series))
            label = name if group == next(g for g, v in enumerate(values) if v and v.value is not None) else None
            colour, hatch = COLOURS[i % len(COLOURS)], _HATCHES[i // len(COLOURS) % len(_HATCHES)]
            axes.bar(
                place,
                100 * one.value,
                width * 0.92,
                color=colour,
                hatch=hatch,
                edgecolor="white",
                linewidth=0,
                label=label,
            )
            if one.low is not None and one.high is not None:
                axes.plot([place] * 2, [100 * one.low, 100 * one.high], color=_BLACK, linewidth=1.1, zorder=3)


def _success(axes: Axes, curves: Sequence[SuccessCurve]) -> None:
    """Shares of broken frames over queries; a band for the first arm only, lest they cover each other."""
    for i, curve in enumerate(curves):
        queries = range(1, curve.max_queries + 1)
        values = [100 * (one.value or 0.0) for one in curve.shares]
        colour, style = COLOURS[i % len(COLOURS)], LINES[i // len(COLOURS) % len(LINES)]
        marker = "o" if curve.max_queries == 1 else None
        axes.step(
            queries, values, style, where="post", color=colour, label=curve.name, linewidth=1.8, marker=marker
        )
        low, high = ([one.low for one in curve.shares], [one.high for one in curve.shares])
        if i == 0 and None not in low and None not in high:
            bottom, top = ([100 * (v or 0.0) for v in side] for side in (low, high))
            axes.fill_between(queries, bottom, top, step="post", color=colour, alpha=0.15, linewidth=0)
    most = max(curve.max_queries for curve in curves)
    axes.set_xscale("log", base=2)
    ticks = [2**k for k in range(most.bit_length()) if 2**k <= most]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set(xlabel="queries", ylabel="frames broken, %", ylim=(0, 102), xlim=(0.93, most * 1.06))
    axes.set_title(f"Frames broken; band: 95 % of draws, {curves[0].name}", loc="left", fontsize=11)


def _label_sets(axes: Axes, sets: Sequence[LabelComparison]) -> None:
    """Shares of frames that fail, by label set and IoU."""
    series = [
        *((f"benign labels, {o:g}", [s.counts[o].paper for s in sets]) for o in OVERLAPS),
        *((f"benign only, {o:g}", [s.counts[o].only_unmoved for s in sets]) for o in OVERLAPS),
        *((f"moved labels, {o:g}", [s.counts[o].moved for s in sets]) for o in OVERLAPS),
    ]
    width = _GROUP_WIDTH / len(series)
    for i, (name, counts) in enumerate(series):
        places = [place_of(g, i, len(series)) for g in range(len(sets))]
        shares = [100 * count / max(one.frames, 1) for count, one in zip(counts, sets, strict=True)]
        axes.bar(places, shares, width * 0.92, color=COLOURS[i], label=name)
    axes.set_xticks(range(len(sets)), [one.name for one in sets])
    axes.set(ylabel="frames, %", ylim=(0, 102))
    axes.set_title("Frames that count as broken, by labels and IoU", loc="left", fontsize=11)
