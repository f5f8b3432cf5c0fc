"""Plots as PNG, in colours that colour-blind people can distinguish."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scene_ir import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLOT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette (jfly.uni-koeln.de/color) without yellow, which is too pale on white."""
LINE_STYLES = ("-", "--", "-.", ":")
"""Distinguish curves in greyscale, too."""
_SIZE_IN = (6.4, 4.4)
_DPI = 150
PLOT_STYLE: Mapping[str, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def write_curves(path: Path, title: str, curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> None:
    """Plot precision over recall.

    Args:
        path: PNG file.
        title: Title of the plot.
        curves: Recall and precision in [0, 1], by name.
    """
    figure, axes = _create_axes(title)
    for i, (name, (recall, precision)) in enumerate(curves.items()):
        axes.plot(
            [100 * r for r in recall],
            [100 * p for p in precision],
            LINE_STYLES[i // len(PLOT_COLOURS) % len(LINE_STYLES)]
            if len(curves) > len(PLOT_COLOURS)
            else LINE_STYLES[i % len(LINE_STYLES)],
            color=PLOT_COLOURS[i % len(PLOT_COLOURS)],
            label=name,
            linewidth=1.8,
            marker="o",
            markersize=4,
            markevery=[-1],  # where recall ends
        )
    axes.set(xlabel="recall, %", ylabel="precision, %", xlim=(0, 100), ylim=(0, 102))
    if curves:
        _add_legend(axes, len(curves))
    write_figure(path, figure)


def write_bars(
    path: Path, title: str, groups: Sequence[str], series: Mapping[str, Sequence[float | None]], x_label: str
) -> None:
    """Plot the recall of each series in each group as bars.

    Args:
        path: PNG file.
        title: Title of the plot.
        groups: Names of the groups.
        series: A recall in [0, 1] per group, by name; None if the group has no object.
        x_label: Label of the axis of groups.
    """
    figure, axes = _create_axes(title)
    width = 0.8 / max(len(series), 1)
    for i, (name, values) in enumerate(series.items()):
        places = [g + (i - (len(series) - 1) / 2) * width for g in range(len(groups))]
        heights = [0.0 if v is None else 100 * v for v in values]
        axes.bar(places, heights, width * 0.92, color=PLOT_COLOURS[i % len(PLOT_COLOURS)], label=name)
        for place, value in zip(places, values, strict=True):
            text = "none" if value is None else f"{100 * value:.0f}"
            axes.annotate(
                text, (place, 0.0 if value is None else 100 * value), ha="center", va="bottom", fontsize=7
            )
    axes.set_xticks(range(len(groups)), groups)
    axes.set(xlabel=x_label, ylabel="recall, %", ylim=(0, 108))
    if len(series) > 1:
        _add_legend(axes, len(series))
    write_figure(path, figure)


def write_intervals(
    path: Path,
    title: str,
    names: Sequence[str],
    values: Sequence[tuple[float, float | None, float | None]],
    x_label: str,
) -> None:
    """Plot fractions with their intervals, one below the other.

    Args:
        path: PNG file.
        title: Title of the plot.
        names: Names, from the top.
        values: Value and ends of its interval, in [0, 1]; None without an interval.
        x_label: Label of the axis of values.
    """
    figure, axes = _create_axes(title)
    figure.set_figheight(1.2 + 0.3 * len(names))
    for place, (value, low, high) in enumerate(values):
        ends = [0.0, 0.0] if low is None or high is None else [max(value - low, 0.0), max(high - value, 0.0)]
        spread = [[100 * ends[0]], [100 * ends[1]]]
        axes.errorbar(100 * value, place, xerr=spread, fmt="o", color=PLOT_COLOURS[0], capsize=3)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xlabel=x_label, xlim=(0, 100))
    write_figure(path, figure)


def _add_legend(axes: Axes, entries: int) -> None:
    """Put a legend below the axes, where it hides nothing."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=min(entries, 3), fontsize=9)


def write_scatter(
    path: Path, title: str, x: Sequence[float], y: Sequence[float], axis_labels: tuple[str, str]
) -> None:
    """Plot points of two measures in the same unit, and where they are equal.

    Args:
        path: PNG file.
        title: Title of the plot.
        x: First measure.
        y: Second measure of the same points.
        axis_labels: Labels of both axes.
    """
    figure, axes = _create_axes(title)
    end = 1.05 * max([*x, *y, 1e-9])
    axes.plot([0, end], [0, end], "--", color="#888888", linewidth=1)
    axes.plot(x, y, "o", color=PLOT_COLOURS[0], markersize=3.5, alpha=0.5)
    axes.set(xlabel=axis_labels[0], ylabel=axis_labels[1], xlim=(0, end), ylim=(0, end))
    write_figure(path, figure)


def _create_axes(title: str) -> tuple[Figure, Axes]:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=11)
    return figure, axes


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())
