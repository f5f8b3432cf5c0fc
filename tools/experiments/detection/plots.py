"""The pictures of a study: bars of AP50 drops, success curves, counterexamples by label set, largest changes."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from drivesem.evaluation.resampling import Interval
from drivesem.failures.grades import Grade
from drivesem.reporting.drawing import MARGIN_PX, PAPER_COLOUR, TEXT_PX, paste, write_picture, write_text
from drivesem.reporting.plots import LINE_STYLES, PLOT_COLOURS, PLOT_STYLE
from drivesem.reporting.tables import format_count
from drivesem.run.folder import ARMS, FRAMES
from drivesem.run.results import FrameResult
from drivesem.run.run_report import PAPER_BENIGN
from scene_ir import files
from tools.experiments.detection.arms import ArmRun
from tools.experiments.detection.comparison import ArmComparison
from tools.experiments.detection.counts import change_size
from tools.experiments.detection.labels import OVERLAPS, LabelComparison
from tools.experiments.detection.outcomes import ArmGrades, SuccessCurve
from tools.experiments.detection.report import StudyResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HEIGHT_IN = 4.6
_MIN_WIDTH_IN, _GROUP_IN = 6.4, 1.3
_NAME_CHARACTERS = 13
"""Characters of a name that fit under a group of bars."""
_DPI = 150
_BLACK = "#000000"
_HATCHES = ("", "///", "...")
"""Hatches of bars for each round of colours."""
_GROUP_WIDTH = 0.8
"""Width of a group of bars, in units of the distance between groups."""
MAX_CHANGES = 10
PICTURE_WIDTH_PX = 800
_LINE_PX = TEXT_PX + 8


def write_figure(path: Path, size_in: tuple[float, float], draw: Callable[[Axes], object]) -> None:
    """Draw one plot as a PNG; equal plots give equal bytes.

    Args:
        path: File to write.
        size_in: Width and height, inches.
        draw: Draws into the axes.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure.add_subplot())
    buffer = io.BytesIO()
    # no date and no version in the file
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def write_plot(path: Path, results: StudyResults) -> None:
    """Draw the main result of a study."""
    grades = results.grades if results.study.name in ("grades", "searches") else ()
    groups = 0 if results.curves else len(grades or results.label_sets or results.rows)

    def draw(axes: Axes) -> None:
        if results.curves:
            _draw_success(axes, results.curves)
        elif results.label_sets:
            _draw_label_sets(axes, results.label_sets)
        elif grades:
            _draw_grades(axes, grades)
        else:
            _draw_drops(axes, results.rows)
        axes.figure.legend(loc="outside lower center", ncols=3, fontsize=9)  # pyright: ignore

    write_figure(path, (max(_MIN_WIDTH_IN, _GROUP_IN * groups), _HEIGHT_IN), draw)


def _draw_drops(axes: Axes, rows: Sequence[ArmComparison]) -> None:
    """Drops of AP50 by arm, in points, as bars; the paper's as marks."""
    series: dict[str, list[Interval | None]] = {
        "attack, benign labels": [row.drops["paper"]["ap50"] for row in rows],
        "attack, moved labels": [row.drops["moved"]["ap50"] for row in rows],
    }
    for name in dict.fromkeys(name for row in rows for name in row.controls):
        series[f"{name}, moved labels"] = [
            row.controls[name].drops["moved"]["ap50"] if name in row.controls else None for row in rows
        ]
    draw_bars(axes, series)
    paper = [(i, r.run.arm.reference) for i, r in enumerate(rows) if r.run.arm.reference is not None]
    if paper:
        drops = [100 * (PAPER_BENIGN - reference) for _, reference in paper]
        axes.plot([i for i, _ in paper], drops, "D", color=_BLACK, label="the paper", markersize=6, zorder=4)
    axes.axhline(0, color=_BLACK, linewidth=0.8)
    axes.set_xticks(range(len(rows)), [_wrap_name(row.name) for row in rows])
    axes.set_ylabel("drop of AP50, points")
    axes.set_title("Drop of AP50; lines: 95 % interval over frames", loc="left", fontsize=11)


def _draw_grades(axes: Axes, grades: Sequence[ArmGrades]) -> None:
    """Failures by arm and grade, as bars."""
    levels = (Grade.THRESHOLD, Grade.CERTAIN, Grade.CONFIRMED)
    draw_bars(axes, {str(grade): [one.rates[grade] for one in grades] for grade in levels})
    axes.set_xticks(range(len(grades)), [_wrap_name(one.name) for one in grades])
    axes.set_ylabel("failures, % of objects")
    axes.set_title("Failures by grade; lines: 95 % interval over frames", loc="left", fontsize=11)


def _wrap_name(name: str) -> str:
    """An arm's name in lines that fit under its bars."""
    return "\n".join(line for part in name.split(", ") for line in textwrap.wrap(part, _NAME_CHARACTERS))


def bar_position(group: int, series: int, count: int) -> float:
    """Position of a series' bar on the axis, in a group of `count` bars."""
    return group + (series - (count - 1) / 2) * _GROUP_WIDTH / count


def draw_bars(axes: Axes, series: Mapping[str, Sequence[Interval | None]]) -> None:
    """Draw bars in percent with intervals, side by side in each group; series: fractions by name, one a group."""
    width = _GROUP_WIDTH / len(series)
    for i, (name, values) in enumerate(series.items()):
        label: str | None = name
        colour, hatch = PLOT_COLOURS[i % len(PLOT_COLOURS)], _HATCHES[i // len(PLOT_COLOURS) % len(_HATCHES)]
        style: dict[str, Any] = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0}
        for group, one in enumerate(values):
            if one is None or one.value is None:
                continue
            position = bar_position(group, i, len(series))
            axes.bar(position, 100 * one.value, width * 0.92, label=label, **style)
            label = None
            if one.low is not None and one.high is not None:
                axes.plot([position] * 2, [100 * one.low, 100 * one.high], color=_BLACK, linewidth=1.1, zorder=3)


def _draw_success(axes: Axes, curves: Sequence[SuccessCurve]) -> None:
    """Shares of broken frames over queries; a band for the first arm only, to keep the others visible."""
    for i, curve in enumerate(curves):
        queries = range(1, curve.max_queries + 1)
        values = [100 * (one.value or 0.0) for one in curve.shares]
        colour, style = PLOT_COLOURS[i % len(PLOT_COLOURS)], LINE_STYLES[i // len(PLOT_COLOURS) % len(LINE_STYLES)]
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
    axes.set_title(f"Frames broken; band: 95 % interval, {curves[0].name}", loc="left", fontsize=11)


def _draw_label_sets(axes: Axes, sets: Sequence[LabelComparison]) -> None:
    """Shares of frames that fail, by label set and IoU."""
    series = [
        *((f"benign labels, {o:g}", [s.counts[o].paper for s in sets]) for o in OVERLAPS),
        *((f"benign only, {o:g}", [s.counts[o].only_unmoved for s in sets]) for o in OVERLAPS),
        *((f"moved labels, {o:g}", [s.counts[o].moved for s in sets]) for o in OVERLAPS),
    ]
    shares = {
        name: [Interval(name, n / max(one.frames, 1), None, None) for n, one in zip(counts, sets, strict=True)]
        for name, counts in series
    }
    draw_bars(axes, shares)
    axes.set_xticks(range(len(sets)), [one.name for one in sets])
    axes.set(ylabel="frames, %", ylim=(0, 102))
    axes.set_title("Frames that count as broken, by labels and IoU", loc="left", fontsize=11)


@dataclass(frozen=True, slots=True)
class LargeChange:
    """One frame of one arm, for inspection: is what counts as feasible also credible?"""

    arm: str
    """Name of the arm."""
    folder: Path
    """Folder of the frame."""
    result: FrameResult
    """Result of the frame."""
    size: float
    """Norm of theta, each coordinate in units of its range."""


def find_largest_changes(runs: Sequence[ArmRun], out: Path) -> list[LargeChange]:
    """The largest changes of arms that are no controls, at most one a frame, in the study's folder `out`."""
    largest: dict[str, LargeChange] = {}
    for run in runs:
        if run.arm.control is not None:
            continue
        for result in run.results:
            folder = out / ARMS / run.arm.folder / FRAMES / result.identifier
            change = LargeChange(run.arm.name, folder, result, change_size(result))
            known = largest.get(result.identifier)
            if change.size > 0 and (known is None or change.size > known.size):
                largest[result.identifier] = change
    return sorted(largest.values(), key=lambda c: (-c.size, c.result.identifier))[:MAX_CHANGES]


def write_largest_changes(path: Path, changes: Sequence[LargeChange]) -> None:
    """Draw photographs left and counterexamples right, one row for each change; no file without changes."""
    rows = [_draw_change(change) for change in changes]
    if not rows:
        return
    canvas = np.empty((sum(map(len, rows)) + (len(rows) + 1) * MARGIN_PX, rows[0].shape[1], 3), np.uint8)
    canvas[:] = PAPER_COLOUR
    y = MARGIN_PX
    for row in rows:
        paste(canvas, (0, y), row)
        y += len(row) + MARGIN_PX
    write_picture(path, canvas)


def _draw_change(change: LargeChange) -> np.ndarray:
    names = ("benign.png", "counterexample.png")
    pictures = [_fit_width(files.read_image(change.folder / name)) for name in names]
    height = max(map(len, pictures)) + _LINE_PX
    row = np.empty((height, 2 * PICTURE_WIDTH_PX + 3 * MARGIN_PX, 3), np.uint8)
    row[:] = PAPER_COLOUR
    result = change.result
    lost = sum(failure.kind == "lost" for failure in result.failures)
    text = f"{lost} lost, {format_count(len(result.failures) - lost, 'phantom')}"
    write_text(row, (MARGIN_PX, 0), f"{result.identifier}, {change.arm}: size {change.size:.2f}, {text}")
    for column, picture in enumerate(pictures):
        paste(row, (MARGIN_PX + column * (PICTURE_WIDTH_PX + MARGIN_PX), _LINE_PX), picture)
    return row


def _fit_width(picture: np.ndarray) -> np.ndarray:
    height = round(PICTURE_WIDTH_PX * picture.shape[0] / picture.shape[1])
    return cv2.resize(picture, (PICTURE_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
