"""Reports holes as a table, JSON, CSV, Markdown and a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.holes.rules import Hole, RuleRecheck
from drivesem.report.plots import PLOT_COLOURS, PLOT_STYLE, write_figure
from drivesem.report.tables import AnalysisReport, ReportTable, format_count

_NO_FAILURES = "These runs have no certain failure of an object: nothing to sample around."
_NOTES = (
    "Lost: share of fresh samples inside the rule in which the object is missed, with its 95 % Wilson interval. "
    "Elsewhere: the same for samples outside the rule. Size: share of the whole neighbourhood, that is of what "
    "the run could change, in which the object is lost, inside the rule or not, with a 95 % interval; by subset "
    "simulation if losses are rare. In the neighbourhood of an object, all others stay as found.",
    "Features: height_px, aspect (width over height) and across (0 left, 1 right) of the labelled box; lightness "
    "and contrast of the picture inside it; distance_m; yaw_deg; codes of paint, weather and foliage. A rule "
    "names what separates failures best; the cause may be something that goes along with it.",
)
_RECHECK_NOTE = (
    "Again: the same share among draws with new seeds, independent of the rule and its failure rate. A hole holds "
    "if chance alone may explain the difference of the two shares: its 95 % Newcombe interval contains 0. One in "
    "twenty does not hold although its rate is right. {hold} of {count} hold."
)
_MAX_PLOTTED = 12
"""Holes in the plot; the table has all."""


def build_holes_report(
    out: Path, holes: Sequence[Hole], facts: Mapping[str, Any], failed: Mapping[str, str]
) -> AnalysisReport:
    """Build the report of all frames.

    Args:
        out: Output folder.
        holes: The holes.
        facts: First entries of the JSON.
        failed: Reasons by frame without samples.
    """
    rechecks = [hole.recheck for hole in holes if hole.recheck is not None]
    lines = tuple(
        (
            hole.rule_text,
            hole.label,
            "-" if hole.probability is None else _format_rate(hole.probability, hole.low, hole.high),
            "-" if hole.outside is None else f"{100 * hole.outside:.0f}",
            f"{100 * hole.lost.probability:.2g} [{100 * hole.lost.low:.2g}, {100 * hole.lost.high:.2g}]",
            str(len(hole.failures)),
            str(len(hole.frames)),
            *((_format_recheck(hole.recheck),) if rechecks else ()),
        )
        for hole in holes
    )
    columns = ("where", "class", "lost, %", "elsewhere, %", "size, %", "failures", "frames")
    columns += ("again, %",) if rechecks else ()
    hold = sum(recheck.holds for recheck in rechecks)
    recheck_notes = (_RECHECK_NOTE.format(hold=hold, count=len(rechecks)),) if rechecks else ()
    title = f"Holes of {facts['detector']}, within {facts['params']}"
    return AnalysisReport(
        out=out,
        name="holes",
        heading="Holes",
        data={**facts, "rechecked": len(rechecks), "hold": hold, "holes": [hole.to_json() for hole in holes]},
        csv_tables={"holes": [_csv_row(hole) for hole in holes]} if holes else {},
        tables=[ReportTable(title, columns, lines)],
        notes=(*_NOTES, *recheck_notes) if holes else (_NO_FAILURES,),
        text_columns=("where", "class"),
        picture=partial(plot_holes, holes=holes) if holes else None,
        failed=failed,
    )


def _format_rate(rate: float, low: float | None, high: float | None) -> str:
    ends = ("-" if value is None else f"{100 * value:.0f}" for value in (low, high))
    return f"{100 * rate:.0f} [{', '.join(ends)}]"


def _format_recheck(recheck: RuleRecheck | None) -> str:
    if recheck is None:
        return "-"
    verdict = "holds" if recheck.holds else "does not hold"
    return f"{_format_rate(recheck.probability, *recheck.interval)} {verdict}"


def _csv_row(hole: Hole) -> dict[str, Any]:
    recheck = hole.recheck
    return {
        "where": hole.rule_text,
        "class": hole.label,
        "probability": hole.probability,
        "low": hole.low,
        "high": hole.high,
        "samples": hole.count,
        "again": None if recheck is None else recheck.probability,
        "again_draws": None if recheck is None else recheck.again[1],
        "holds": None if recheck is None else recheck.holds,
        "outside": hole.outside,
        "size": hole.lost.probability,
        "size_low": hole.lost.low,
        "size_high": hole.lost.high,
        "failures": "; ".join(hole.failures),
    }


def plot_holes(path: Path, holes: Sequence[Hole]) -> None:
    """Plot the failure rates of the largest holes as bars with intervals, and marks for the rates elsewhere."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    plotted = holes[:_MAX_PLOTTED]
    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(8.0, 1.9 + 0.5 * len(plotted)), layout="constrained")
        axes = figure.add_subplot()
        inside, elsewhere = "fresh samples inside the rule, 95 % interval", "elsewhere in the neighbourhood"
        for i, hole in enumerate(plotted):
            if hole.probability is not None:
                axes.barh([i], [100 * hole.probability], color=PLOT_COLOURS[1], height=0.6, label=inside)
                inside = None  # one entry in the legend
                ends = [100 * (hole.low or 0), 100 * (hole.high or 0)]
                axes.plot(ends, [i] * 2, color="black", linewidth=1.2)
            if hole.outside is not None:
                rate = 100 * hole.outside
                axes.plot([rate], [i], "D", color=PLOT_COLOURS[0], markersize=6, label=elsewhere, zorder=3)
                elsewhere = None
        labels = [f"{hole.rule_text}\n{format_count(len(hole.failures), 'failure')}" for hole in plotted]
        axes.set_yticks(range(len(plotted)), labels)
        axes.invert_yaxis()
        axes.set(xlim=(0, 102), xlabel="lost, %")
        axes.set_title("Holes, largest first", loc="left", fontsize=11)
        figure.legend(loc="outside lower center", fontsize=9)
        write_figure(path, figure)
