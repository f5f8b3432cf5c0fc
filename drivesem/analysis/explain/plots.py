"""Contributions as pictures: a waterfall from the photograph's loss to the counterexample's; means over frames."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.analysis.explain.results import Contribution, Explanation
from drivesem.evaluation.resampling import Interval
from drivesem.report.plots import COLOURS, STYLE
from scene_ir import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAR_IN = 0.32
_MARGIN_IN = 1.5
_WIDTH_IN = 10.5
_DPI = 150
_UP, _DOWN, _TOTAL = COLOURS[1], COLOURS[0], "#777777"
_TITLES = {"parameter": "by parameter", "object": "by car"}


def write_waterfalls(path: Path, explanation: Explanation) -> None:
    """A panel for parameters and one for cars: how each takes the loss from the photograph's to the
    counterexample's, the largest first; in the margin, what it adds to failing, %.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = [max(len(explanation.of_kind(kind)), 1) + 2 for kind in _TITLES]
    height = _MARGIN_IN * len(rows) + _BAR_IN * sum(rows)
    with mpl.rc_context({**STYLE, "axes.grid.axis": "x"}):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(_WIDTH_IN, height), layout="constrained")
        panels = figure.subplots(len(rows), 1, height_ratios=rows, squeeze=False)[:, 0]
        for axes, (kind, title) in zip(panels, _TITLES.items(), strict=True):
            _waterfall(axes, explanation, explanation.of_kind(kind))
            axes.set_title(f"{explanation.identifier}, {title}", loc="left", fontsize=11)
    _write(path, figure)


def write_means(path: Path, loss: Sequence[Interval], fails: Sequence[Interval], frames: int) -> None:
    """Two panels, a bar each parameter with its interval: mean contribution to the loss, and to failing, %."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    height = _MARGIN_IN + _BAR_IN * (len(loss) + 1)
    with mpl.rc_context({**STYLE, "axes.grid.axis": "x"}):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(_WIDTH_IN, height), layout="constrained")
        panels = figure.subplots(1, 2, squeeze=False)[0]
        _bars(panels[0], loss, 1, "added to the loss")
        _bars(panels[1], fails, 100, "added to failing, %")
        figure.suptitle(f"Shapley values, mean over frames ({frames})", x=0.01, ha="left", fontsize=11)
    _write(path, figure)


def _waterfall(axes: Axes, explanation: Explanation, contributions: Sequence[Contribution]) -> None:
    ordered = sorted(contributions, key=lambda c: -c.loss)
    start, end = explanation.benign.loss, explanation.found.loss
    names = ["benign", *(c.name for c in ordered), "counterexample"]
    places = list(range(len(names)))
    axes.barh([0, places[-1]], [start, end], color=_TOTAL, height=0.62)
    level, tops = start, [start]
    for place, one in enumerate(ordered, start=1):
        colour = _UP if one.loss >= 0 else _DOWN
        error = None if one.loss_error is None else [one.loss_error]
        axes.barh([place], [one.loss], left=[level], color=colour, height=0.62)
        if error is not None:
            axes.errorbar([level + one.loss], [place], xerr=error, color="black", linewidth=1, capsize=2)
        axes.plot([level, level], [place - 1, place], color="#999999", linewidth=0.8)
        tops.append(max(level, level + one.loss) + (one.loss_error or 0.0))
        level += one.loss
    axes.plot([level, level], [places[-1] - 1, places[-1]], color="#999999", linewidth=0.8)
    tops.append(end)
    texts = [f"{start:.2f}", *(_contribution(c) for c in ordered), f"{end:.2f}"]
    for place, top, text in zip(places, tops, texts, strict=True):
        axes.annotate(text, (top, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlim(right=1.25 * max(tops))
    axes.set_xlabel("loss")


def _contribution(one: Contribution) -> str:
    return f"{one.loss:+.2f}   (failing {100 * one.fails:+.0f} %)"


def _bars(axes: Axes, intervals: Sequence[Interval], factor: float, label: str) -> None:
    for place, one in enumerate(intervals):
        if one.value is None:
            continue
        value = factor * one.value
        axes.barh([place], [value], color=_UP if value >= 0 else _DOWN, height=0.62)
        if one.low is not None and one.high is not None:
            # A mean may lie a rounding error outside of its interval, where all frames are alike.
            spread = [[max(value - factor * one.low, 0)], [max(factor * one.high - value, 0)]]
            axes.errorbar([value], [place], xerr=spread, color="black", linewidth=1, capsize=3)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(intervals)), [one.name for one in intervals])
    axes.invert_yaxis()
    axes.set_xlabel(label)


def _write(path: Path, figure: Figure) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())
