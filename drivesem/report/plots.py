"""Curves and bars of an evaluation as PNG, in colours that people with colour-blindness tell apart."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scene_ir import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette (jfly.uni-koeln.de/color), the yellow left out: too pale on white."""
LINES = ("-", "--", "-.", ":")
"""A second sign beside colour, so that curves are told apart in grey too."""
_SIZE_IN = (6.4, 4.4)
_DPI = 150
STYLE: Mapping[str, Any] = {
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
    """Precision over recall. curves: name -> recall and precision, fractions."""
    figure, axes = _empty(title)
    for i, (name, (recall, precision)) in enumerate(curves.items()):
        axes.plot(
            [100 * r for r in recall],
            [100 * p for p in precision],
            LINES[i // len(COLOURS) % len(LINES)] if len(curves) > len(COLOURS) else LINES[i % len(LINES)],
            color=COLOURS[i % len(COLOURS)],
            label=name,
            linewidth=1.8,
            marker="o",
            markersize=4,
            markevery=[-1],  # where recall ends
        )
    axes.set(xlabel="recall, %", ylabel="precision, %", xlim=(0, 100), ylim=(0, 102))
    if curves:
        _legend(axes, len(curves))
    _write(path, figure)


def write_bars(
    path: Path, title: str, groups: Sequence[str], series: Mapping[str, Sequence[float | None]], x_label: str
) -> None:
    """Recall of each series in each group. series: name -> a fraction a group, None where there is no object."""
    figure, axes = _empty(title)
    width = 0.8 / max(len(series), 1)
    for i, (name, values) in enumerate(series.items()):
        places = [g + (i - (len(series) - 1) / 2) * width for g in range(len(groups))]
        heights = [0.0 if v is None else 100 * v for v in values]
        axes.bar(places, heights, width * 0.92, color=COLOURS[i % len(COLOURS)], label=name)
        for place, value in zip(places, values, strict=True):
            text = "none" if value is None else f"{100 * value:.0f}"
            axes.annotate(
                text, (place, 0.0 if value is None else 100 * value), ha="center", va="bottom", fontsize=7
            )
    axes.set_xticks(range(len(groups)), groups)
    axes.set(xlabel=x_label, ylabel="recall, %", ylim=(0, 108))
    if len(series) > 1:
        _legend(axes, len(series))
    _write(path, figure)


def _legend(axes: Axes, entries: int) -> None:
    """Below the axes, where it hides nothing."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=min(entries, 3), fontsize=9)


def _empty(title: str) -> tuple[Figure, Axes]:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(dict(STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=11)
    return figure, axes


def _write(path: Path, figure: Figure) -> None:
    buffer = io.BytesIO()
    # no date and no version in the file: equal figures give equal bytes
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())
