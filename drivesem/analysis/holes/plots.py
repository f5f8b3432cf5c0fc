"""Holes as a picture: how often what lies inside of each rule is lost, and what lies outside of it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from drivesem.analysis.holes.merged import Hole
from drivesem.report.plots import COLOURS, STYLE
from drivesem.report.tables import number_of
from scene_ir import files

_MOST = 12
"""Holes shown; the table has all."""
_DPI = 150


def _count(hole: Hole) -> str:
    return number_of(len(hole.failures), "failure")


def write_holes(path: Path, holes: Sequence[Hole]) -> None:
    """Bars of the largest, with intervals; marks for elsewhere."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    shown = holes[:_MOST]
    with mpl.rc_context(dict(STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(8.0, 1.9 + 0.5 * len(shown)), layout="constrained")
        axes = figure.add_subplot()
        inside, elsewhere = "fresh samples inside of the rule, 95 % interval", "elsewhere in the neighbourhood"
        for place, hole in enumerate(shown):
            if hole.probability is not None:
                axes.barh([place], [100 * hole.probability], color=COLOURS[1], height=0.6, label=inside)
                inside = None  # the legend names each sign once
                axes.plot(
                    [100 * (hole.low or 0), 100 * (hole.high or 0)], [place] * 2, color="black", linewidth=1.2
                )
            if hole.outside is not None:
                axes.plot(
                    [100 * hole.outside], [place], "D", color=COLOURS[0], markersize=6, label=elsewhere, zorder=3
                )
                elsewhere = None
        axes.set_yticks(range(len(shown)), [f"{hole.words}\n{_count(hole)}" for hole in shown])
        axes.invert_yaxis()
        axes.set(xlim=(0, 102), xlabel="lost, %")
        axes.set_title("Holes, largest first", loc="left", fontsize=11)
        figure.legend(loc="outside lower center", fontsize=9)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())
