"""The matrix as a picture: sources down, targets across."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drivesem.analysis.transfer.matrix import TRANSFER, TransferRow
from drivesem.report.plots import STYLE
from scene_ir import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELL_IN = (1.5, 0.75)
_MARGIN_IN = (2.2, 1.9)
_DPI = 150
_DARK = 0.55
"""Share of the colour scale from which text is white."""
_LONGEST = 24
"""Characters of a name beside the picture: what is longer loses its beginning."""


def write_heatmap(path: Path, rows: Sequence[TransferRow]) -> None:
    """Two panels, %: how far AP50 falls by moved labels, and which share of the source's failures transfers."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    sources = list(dict.fromkeys(row.source.name for row in rows))
    targets = list(dict.fromkeys(row.target.name for row in rows))
    panels: list[tuple[str, Callable[[TransferRow], float | None]]] = [
        ("drop of AP50, moved labels, %", lambda row: row.flat()["drop_moved"]),
        ("transferred failures, %", lambda row: row.shares[TRANSFER].value),
    ]
    width = _MARGIN_IN[0] + _CELL_IN[0] * len(targets)
    height = _MARGIN_IN[1] + _CELL_IN[1] * len(sources)
    style = {**STYLE, "axes.grid": False}
    with mpl.rc_context(style):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(len(panels) * width, height), layout="constrained")
        for place, (title, value) in enumerate(panels, start=1):
            axes = figure.add_subplot(1, len(panels), place)
            table = {(row.source.name, row.target.name): value(row) for row in rows}
            _panel(axes, [[table[s, t] for t in targets] for s in sources])
            axes.set_title(title, loc="left", fontsize=11)
            axes.set_xticks(range(len(targets)), [_short(t) for t in targets], rotation=20, ha="right")
            axes.set_yticks(range(len(sources)), [_short(s) for s in sources])
            axes.set(xlabel="target", ylabel="source (run)")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def _panel(axes: Axes, values: Sequence[Sequence[float | None]]) -> None:
    """Cells coloured from 0 to 1, and their numbers; a figure below 0, where the attack helped, is white."""
    nothing = float("nan")
    axes.imshow(
        [[nothing if v is None else v for v in line] for line in values],
        cmap="Blues",
        vmin=0,
        vmax=1,
        aspect="auto",
    )
    for y, line in enumerate(values):
        for x, value in enumerate(line):
            text = "none" if value is None else f"{100 * value:.1f}"
            dark = value is not None and value > _DARK
            axes.text(x, y, text, ha="center", va="center", color="white" if dark else "black")
    for side in axes.spines.values():
        side.set_visible(False)
    axes.tick_params(length=0)


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST else f"...{name[3 - _LONGEST :]}"
