"""Reports transfer between runs and detectors: tables, Markdown, CSV, and a heatmap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivesem.analysis.transfer.matrix import AP50, CERTAIN, FRAMES, LOST, THRESHOLD, TRANSFER, TransferRow
from drivesem.attack.targets import HEADLINE
from drivesem.evaluation.resampling import Interval
from drivesem.report.plots import PLOT_STYLE, write_figure
from drivesem.report.tables import AnalysisReport, ReportTable, format_percent

_SHARES = {
    TRANSFER: "transfer rate",
    CERTAIN: "of certain",
    THRESHOLD: "of others",
    LOST: "all lost",
    FRAMES: "frames",
}
_SIDES = ("source", "target")
_LABELS = "labels"
"""Column of the evaluation: photographs (benign), or counterexamples by label mode."""


def build_transfer_tables(rows: Sequence[TransferRow]) -> list[ReportTable]:
    """Build the tables of precision and recall, and of drops and shares that transfer, %."""
    scores_rows: list[tuple[str, ...]] = []
    share_rows: list[tuple[str, ...]] = []
    for row in rows:
        sides = (row.source.name, row.target.name)
        for name in ("benign", "paper", "moved"):
            scores = getattr(row, name)
            own = scores.headline
            values = (own.ap50, own.ap70, own.ap, scores.overall.ap50, own.recall, own.recall_at_t_star)
            scores_rows.append((*sides, name, *map(format_percent, values)))
        drop = {mode: next(one for one in row.drops[mode] if one.name == AP50) for mode in row.drops}
        counted = [f"{format_interval(row.shares[n])}\n{row.counts[n][0]} of {row.counts[n][1]}" for n in _SHARES]
        share_rows.append((*sides, format_interval(drop["paper"]), format_interval(drop["moved"]), *counted))
    score_columns = ("AP50", "AP70", "AP50:95", "mAP50", "recall", "recall at t*")
    drop_columns = ("AP50 drop, paper", "AP50 drop, moved")
    return [
        ReportTable(f"{HEADLINE}, %", (*_SIDES, _LABELS, *score_columns), tuple(scores_rows)),
        ReportTable("transfer, %", (*_SIDES, *drop_columns, *_SHARES.values()), tuple(share_rows)),
    ]


def build_transfer_notes(rows: Sequence[TransferRow], draws: int) -> list[str]:
    """Explain the columns. draws: bootstrap draws."""
    interval = f" In brackets: 95 % interval of {draws} bootstrap draws of frames." if draws else ""
    thresholds = "; ".join(dict.fromkeys(f"{r.target.name}: t* {r.target.t_star:.3f}" for r in rows))
    return [
        "Labels: benign stands for the photographs, paper and moved for the counterexamples by label mode.",
        f"mAP50: mean over the target's classes; AP50 drop: benign minus attacked.{interval}",
        "Transfer rate: of the objects that the source lost and the target detected in the photograph, those that "
        "the target loses, too; of certain, of others: the same for objects that the source lost for certain, and "
        "by threshold only. All lost: of all objects that the target detected in the photograph, those it loses. "
        "Frames: of those that fail the source, those that fail the target. All with moved labels.",
        f"{thresholds}.",
    ]


def build_transfer_report(
    out: Path, rows: Sequence[TransferRow], draws: int, failed: Mapping[str, str], data: Mapping[str, Any]
) -> AnalysisReport:
    """Build the report.

    Args:
        out: Output folder.
        rows: A row per run and detector.
        draws: Bootstrap draws.
        failed: Reasons by picture that could not be used.
        data: Contents of the JSON.
    """
    scores, shares = build_transfer_tables(rows)
    return AnalysisReport(
        out=out,
        name="transfer",
        heading="Transfer",
        data=data,
        csv_tables={"transfer": [row.to_row() for row in rows]},
        tables=[scores, replace(shares, rich_options={"show_lines": True})],
        notes=build_transfer_notes(rows, draws),
        text_columns=(*_SIDES, _LABELS),
        picture=partial(write_heatmap, rows=rows),
        failed=failed,
    )


def format_interval(interval: Interval) -> str:
    """Format a fraction and its interval as percentages."""
    if interval.value is None or interval.low is None or interval.high is None:
        return format_percent(interval.value)
    return f"{100 * interval.value:.1f} [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELL_IN = (1.5, 0.75)
_MARGIN_IN = (2.2, 1.9)
_DARK = 0.55
"""Position on the colour scale from which text is white."""
_MAX_LABEL = 24
"""Longest label of an axis, characters; longer names lose their beginning."""


def write_heatmap(path: Path, rows: Sequence[TransferRow]) -> None:
    """Plot a heatmap of the AP50 drop with moved labels, and of the share of failures that transfer, %."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    sources = list(dict.fromkeys(row.source.name for row in rows))
    targets = list(dict.fromkeys(row.target.name for row in rows))
    panels: list[tuple[str, Callable[[TransferRow], float | None]]] = [
        ("AP50 drop, moved labels, %", lambda row: row.to_row()["drop_moved"]),
        ("transferred failures, %", lambda row: row.shares[TRANSFER].value),
    ]
    width = _MARGIN_IN[0] + _CELL_IN[0] * len(targets)
    height = _MARGIN_IN[1] + _CELL_IN[1] * len(sources)
    style = {**PLOT_STYLE, "axes.grid": False}
    with mpl.rc_context(style):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(len(panels) * width, height), layout="constrained")
        for place, (title, value) in enumerate(panels, start=1):
            axes = figure.add_subplot(1, len(panels), place)
            table = {(row.source.name, row.target.name): value(row) for row in rows}
            _plot_panel(axes, [[table[s, t] for t in targets] for s in sources])
            axes.set_title(title, loc="left", fontsize=11)
            axes.set_xticks(range(len(targets)), [_shorten(t) for t in targets], rotation=20, ha="right")
            axes.set_yticks(range(len(sources)), [_shorten(s) for s in sources])
            axes.set(xlabel="target", ylabel="source (run)")
    write_figure(path, figure)


def _plot_panel(axes: Axes, values: Sequence[Sequence[float | None]]) -> None:
    """Draw cells coloured from 0 to 1, with their values; negative values, where the attack helped, are white."""
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


def _shorten(name: str) -> str:
    return name if len(name) <= _MAX_LABEL else f"...{name[3 - _MAX_LABEL :]}"
