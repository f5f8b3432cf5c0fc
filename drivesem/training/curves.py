"""What a run's log and evaluations look like: one picture, drawn anew as the run goes on."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivesem.report.plots import COLOURS, LINES, STYLE
from scene_ir import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_IN, _DPI = (7.0, 7.4), 130
_SMOOTHED_OVER = 0.02
"""Share of the run over which the thick line averages."""
_FACTS = ("step", "seconds", "rate", "norm")
"""Columns of the log that are no terms of the loss."""
_MOST_DIGITS = 2
EVALUATED = ("car_ap50", "car_recall", "ap50", "f1")
"""Columns of evaluations that are drawn."""


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """A CSV of numbers by column, float64; empty fields are NaN. Nothing where there is no such file."""
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0]) if rows else []
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}


def smoothed(values: Sequence[float] | np.ndarray, over: int) -> np.ndarray:
    """Means over `over` values around each; fewer at the ends."""
    sums = np.cumsum(np.concatenate([[0.0], np.asarray(values, np.float64)]))
    place = np.arange(len(sums) - 1)
    first, last = np.maximum(place - over // 2, 0), np.minimum(place + (over - over // 2), len(place))
    return (sums[last] - sums[first]) / (last - first)


def draw(log: Path, evaluations: Path, out: Path, title: str) -> None:
    """Terms of the loss, evaluations and the rate over steps, as PNG; nothing where the log has no step yet."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    steps, judged = read_columns(log), read_columns(evaluations)
    if not steps:
        return
    with mpl.rc_context(dict(STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        heights = (3, 2.2, 1) if judged else (3, 1)
        panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        loss, rate = panels[0], panels[-1]
        over = max(round(len(steps["step"]) * _SMOOTHED_OVER), 1)
        terms = [name for name in steps if name not in _FACTS]
        for i, name in enumerate(terms):
            colour = COLOURS[i % len(COLOURS)]
            loss.plot(steps["step"], steps[name], color=colour, linewidth=0.6, alpha=0.25)
            loss.plot(
                steps["step"],
                smoothed(steps[name], over),
                LINES[i % len(LINES)],
                color=colour,
                label=name,
                linewidth=1.8,
            )
        loss.set(ylabel="loss", yscale="log")
        loss.set_title(title, loc="left", fontsize=11)
        loss.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=max(len(terms), 1))
        if judged:
            _draw_marks(panels[1], judged)
        rate.plot(steps["step"], steps["rate"], color=COLOURS[0], linewidth=1.5)
        rate.set(ylabel="rate", xlabel="steps", ylim=(0, None))
        rate.ticklabel_format(axis="y", style="sci", scilimits=(-_MOST_DIGITS, _MOST_DIGITS))
        buffer = io.BytesIO()
        # no date and no version in the file: equal figures give equal bytes
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(out, buffer.getvalue())


def _draw_marks(axes: Axes, judged: Mapping[str, np.ndarray]) -> None:
    for i, name in enumerate(name for name in EVALUATED if name in judged):
        axes.plot(
            judged["step"],
            100 * judged[name],
            LINES[i % len(LINES)],
            color=COLOURS[i],
            label=name.replace("_", " ").replace("ap50", "AP50").replace("car", "Car").replace("f1", "F1"),
            linewidth=1.8,
            marker="o",
            markersize=4,
        )
    axes.set(ylabel="held out, %", ylim=(0, 102))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(EVALUATED))
