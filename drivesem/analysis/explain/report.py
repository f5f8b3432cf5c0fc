"""Reports explanations over all frames: tables, JSON, CSV, Markdown, and plots of contributions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich import box

from drivesem.analysis.explain.attribution import (
    ChangeSize,
    Contribution,
    Explanation,
    FailureExplanation,
    MinimalChange,
    PartOutcome,
)
from drivesem.evaluation.resampling import Interval, NamedMetric, bootstrap_intervals, ratio_metric
from drivesem.reporting.plots import PLOT_COLOURS, PLOT_STYLE, write_figure
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.report.page import format_grade, grade_rank, name_failure
from drivesem.run.results import Failure

_NEEDED = "needs"
_TEXT_COLUMNS = ("parameter", "frame", "failure", "grade", _NEEDED, "changes", "holds")
"""Columns of text; the others hold numbers."""
_RICH_OPTIONS: dict[str, Any] = {
    "unbroken": ("parameter", "frame", "changes"),
    "box": box.SIMPLE_HEAD,
    "padding": (0, 1, 0, 0),
}


_ROUNDED = 0.005
"""Shares that are printed as 0."""


def minimal_picture(number: int) -> str:
    """Name the picture of the minimal change of a frame's failure of that number, from 0."""
    return f"minimal_{number + 1}"


def sort_failures(failures: Sequence[Failure]) -> list[Failure]:
    """Sort failures, the highest grade first."""
    return sorted(failures, key=lambda failure: -grade_rank(failure))


@dataclass(frozen=True, slots=True)
class ParameterSummary:
    """One parameter over all frames."""

    name: str
    """The parameter."""
    loss: Interval
    """Mean Shapley value of the loss, with a bootstrap interval over frames."""
    fails: Interval
    """Mean Shapley value over failures of whether they occur, with a bootstrap interval over frames."""
    gradient_share: float | None
    """Mean share of the gradient; None without a gradient."""
    failures: int
    """Number of failures."""
    alone: int
    """Those that this parameter alone causes."""
    without: int
    """Those that occur without it."""
    needed: int
    """Those with a minimal change that contains it."""
    found: float
    """Median over frames of the largest change of an object, in `unit`."""
    least: float | None
    """The same in the minimal changes that contain it; None if none does."""
    unit: str
    """m, deg or code."""

    def to_json(self) -> dict[str, Any]:
        """Return a flat JSON object."""
        data = asdict(self)
        for name in ("loss", "fails"):
            one: Interval = getattr(self, name)
            data |= {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
        return data


def summarise_parameters(explanations: Sequence[Explanation], draws: int, seed: int) -> list[ParameterSummary]:
    """Summarise each parameter that any frame changes, in the order of theta.

    Args:
        explanations: Explanations of all frames.
        draws: Bootstrap draws.
        seed: Seed of the bootstrap.
    """
    names = list(dict.fromkeys(c.name for e in explanations for c in e.of_kind("parameter")))
    tables = [{c.name: c for c in e.of_kind("parameter")} for e in explanations]
    ones, failures = np.ones(len(tables)), np.array([len(e.failures) for e in explanations], np.float64)

    def metric(name: str, value: Callable[[Contribution], float], totals: NDArray[np.float64]) -> NamedMetric:
        return ratio_metric(name, np.array([value(t[name]) if name in t else 0.0 for t in tables]), totals)

    metrics = [metric(name, lambda c: c.loss, ones) for name in names]
    metrics += [metric(name, lambda c: sum(c.fails), failures) for name in names]
    intervals = bootstrap_intervals(metrics, len(tables), draws, np.random.default_rng(seed))
    loss, fails = intervals[: len(names)], intervals[len(names) :]
    return [_summarise_parameter(name, loss[i], fails[i], tables, explanations) for i, name in enumerate(names)]


def build_explain_tables(
    explanations: Sequence[Explanation], rows: Sequence[ParameterSummary]
) -> list[ReportTable]:
    """Build the table of failures and their minimal changes, and that of parameters over all frames."""
    by_parameter = tuple(
        (
            row.name,
            _format_interval(row.loss, 1, 2),
            _format_interval(row.fails, 100, 0) + (" against" if (row.fails.value or 0) < -_ROUNDED else ""),
            "-" if row.gradient_share is None else f"{100 * row.gradient_share:.0f}",
            *(f"{count} of {row.failures}" for count in (row.alone, row.without, row.needed)),
            _format_size(row.found, row.unit),
            "-" if row.least is None else _format_size(row.least, row.unit),
        )
        for row in rows
    )
    by_failure = tuple(_failure_row(e, one) for e in explanations for one in e.failures)
    failures = format_count(sum(len(e.failures) for e in explanations), "failure")
    return [
        ReportTable(
            "smallest change that keeps each failure",
            ("frame", "failure", "grade", _NEEDED, "changes", "size, %", "holds"),
            by_failure,
            _RICH_OPTIONS,
        ),
        ReportTable(
            f"by parameter: {failures} in {format_count(len(explanations), 'frame')}",
            (
                *("parameter", "adds to loss", "of failing, %", "of gradient, %", "alone suffices"),
                *("occurs without it", "need it", "largest change", "sufficient"),
            ),
            by_parameter,
            _RICH_OPTIONS,
        ),
    ]


def build_frame_table(explanation: Explanation) -> ReportTable:
    """Build the table of one frame: each part's contribution, and the results of it alone and of all others."""
    rows: list[tuple[str, ...]] = [
        ("no change", "", "", "", *_format_outcome(explanation.benign), "", ""),
        ("whole change", "", "", "", *_format_outcome(explanation.found), "", ""),
    ]
    for one in explanation.contributions:
        loss, fails = f"{one.loss:+.2f}", _format_fails(one)
        if one.loss_error is not None:
            loss = f"{loss} ± {one.loss_error:.2f}"
        share = "-" if one.gradient_share is None else f"{100 * one.gradient_share:.0f}"
        rows.append((one.name, loss, fails, share, *_format_outcome(one.alone), *_format_outcome(one.without)))
    columns = (
        *("part", "adds to loss", "of failing, %", "of gradient, %"),
        *("alone: loss", "alone: failures", "without: loss", "without: failures"),
    )
    return ReportTable(explanation.identifier, columns, tuple(rows))


def build_explain_notes(draws: int) -> list[str]:
    """Explain the columns. draws: bootstrap draws."""
    interval = (
        f"; in brackets, from two frames on: 95 % interval of {draws} bootstrap draws of frames" if draws else ""
    )
    return [
        f"{_NEEDED.capitalize()}, changes: the parameters and objects of the smallest change found that keeps the "
        "same object failing in the same kind. Size: relative to the whole change, in sign steps. Holds: draws "
        "that show the failure after it, the first of those of its certificate; from certain on, as large a share "
        "as a certificate needs. For a failure by threshold, only the picture counts.",
        f"Adds to loss: mean Shapley value over frames; of failing: the same of whether a failure occurs, over "
        f"failures{interval}. Against: at its full size, the part works against the failure, though a smaller "
        "amount may be needed. Of "
        "gradient: share of |gradient x change| at the photograph. Alone suffices, occurs without it: failures "
        "that occur after this parameter's part of the change only, and after all other parts. Largest change, "
        "sufficient: largest change of an object in the counterexample, and in the smallest changes that contain "
        "the parameter; medians.",
    ]


def exchange_note(names: Sequence[str]) -> str:
    """Name the frames that cannot be explained."""
    return f"frames that fail by the exchange of objects alone: {', '.join(names)}"


def build_explain_report(
    out: Path,
    explanations: Sequence[Explanation],
    rows: Sequence[ParameterSummary],
    draws: int,
    facts: Mapping[str, Any],
) -> AnalysisReport:
    """Build the report.

    Args:
        out: Output folder.
        explanations: Explanations of all frames.
        rows: Summary of each parameter.
        draws: Bootstrap draws.
        facts: First entries of the JSON.
    """
    appendix: list[str] = []
    for e in explanations:
        table = build_frame_table(e)
        appendix += [*table.to_markdown(table.columns), ""]
        pictures = {"shapley": "", **({"sensitivity": ""} if e.sensitivity else {})}
        pictures |= {
            f"{minimal_picture(number)}_overlay": f"Smallest change that keeps: {name_failure(one.failure)}"
            for number, one in enumerate(e.failures)
            if one.least is not None
        }
        appendix += [f"![{text}](frames/{e.identifier}/{name}.png)\n" for name, text in pictures.items()]
    tables = build_explain_tables(explanations, rows)
    left_out: Sequence[str] = facts["frames_by_exchange"]
    return AnalysisReport(
        out=out,
        name="explain",
        heading="Explanations",
        data={
            **facts,
            "rows": [_json_row(e, one) for e in explanations for one in e.failures],
            "parameters": [row.to_json() for row in rows],
            "explained": [_json_frame(e) for e in explanations],
        },
        csv_tables={
            "explain": [line for e in explanations for line in _csv_rows(e)],
            "explain_failures": [_flat_row(e, one) for e in explanations for one in e.failures],
        },
        tables=tables,
        notes=[
            *build_explain_notes(draws),
            *([f"Left out: {exchange_note(left_out)}."] if left_out else []),
        ],
        text_columns=[name for table in tables for name in table.columns],
        printed_text_columns=_TEXT_COLUMNS,
        appendix=appendix,
        picture=partial(
            plot_means,
            loss=[row.loss for row in rows],
            fails=[row.fails for row in rows],
            frames=len(explanations),
        ),
        failed={f"frame {name}": reason for name, reason in facts["frames_failed"].items()},
        failure_text="could not be explained",
    )


def _json_row(explanation: Explanation, one: FailureExplanation) -> dict[str, Any]:
    """Summarise a failure."""
    failure, least = one.failure, one.least
    row: dict[str, Any] = {
        "frame": explanation.identifier,
        "object": failure.index,
        "kind": failure.error,
        "by_threshold": failure.kind,
        "label": failure.label,
        "grade": failure.grade,
        "fidelity": failure.fidelity and failure.fidelity.score,
        "box": list(failure.xyxy),
        "reason": one.reason or None,
    }
    if least is None:
        return {**row, "least": {"holds": False, "draws": 0, "of": 0}}
    row["least"] = {
        **{name: getattr(least, name) for name in ("holds", "draws", "of", "is_whole", "left", "sign_changes")},
        "size": least.norm,
        "size_found": least.norm_found,
        "parameters": list(least.parameters),
        "objects": list(least.objects),
        "feasible": not least.violations,
    }
    return row


def _flat_row(explanation: Explanation, one: FailureExplanation) -> dict[str, Any]:
    """Summarise a failure for CSV."""
    row = _json_row(explanation, one)
    least, box_xyxy = row.pop("least"), row.pop("box")
    row |= dict(zip(("x0", "y0", "x1", "y1"), box_xyxy, strict=True))
    for name, value in least.items():
        row[name] = "; ".join(map(str, value)) if isinstance(value, list) else value
    return row


def _json_frame(explanation: Explanation) -> dict[str, Any]:
    """Summarise a frame; its own folder has the rest."""
    return {
        "frame": explanation.identifier,
        "failures": len(explanation.failures),
        "loss_benign": explanation.benign.loss,
        "loss_found": explanation.found.loss,
        "renders": explanation.renders,
    }


def _csv_rows(explanation: Explanation) -> list[dict[str, Any]]:
    """Return a row per parameter and per object."""
    rows: list[dict[str, Any]] = []
    for one in explanation.contributions:
        before = _part_sizes(one, explanation.sizes)
        # an object's change has no single unit: metres and degrees do not add up
        physical = one.kind == "parameter"
        rows.append(
            {
                "frame": explanation.identifier,
                "kind": one.kind,
                "name": one.name,
                "exact": one.kind in explanation.exact,
                **{name: getattr(one, name) for name in ("loss", "loss_error")},
                "fails": fmean(one.fails),
                "gradient": one.gradient,
                "gradient_share": one.gradient_share,
                **{f"alone_{key}": value for key, value in _outcome_row(one.alone).items()},
                **{f"without_{key}": value for key, value in _outcome_row(one.without).items()},
                "unit": before[0].unit if physical else None,
                "found": max(s.value for s in before) if physical else None,
                "found_steps": max(s.steps for s in before),
            }
        )
    return rows


def _outcome_row(outcome: PartOutcome) -> dict[str, Any]:
    """Return an outcome with the number of explained failures that occur."""
    return {**asdict(outcome), "occurs": sum(outcome.occurs)}


def _part_sizes(one: Contribution, sizes: Sequence[ChangeSize]) -> list[ChangeSize]:
    """Select the sizes that belong to a parameter or an object."""
    return [size for size in sizes if one.name in (size.parameter, size.owner)]


def _summarise_parameter(
    name: str,
    loss: Interval,
    fails: Interval,
    tables: Sequence[dict[str, Contribution]],
    explanations: Sequence[Explanation],
) -> ParameterSummary:
    known = [table[name] for table in tables if name in table]
    shares = [c.gradient_share for c in known if c.gradient_share is not None]
    found = [_largest_size(name, e.sizes) for e in explanations]
    least = [_largest_size(name, one.least.sizes) for e in explanations for one in e.failures if one.least]
    moved, needed = [s for s in found if s is not None], [s for s in least if s is not None]
    # a frame that does not change it fails without it
    unchanged = sum(len(e.failures) for e, table in zip(explanations, tables, strict=True) if name not in table)
    return ParameterSummary(
        name=name,
        loss=loss,
        fails=fails,
        gradient_share=fmean(shares) if shares else None,
        failures=sum(len(e.failures) for e in explanations),
        alone=sum(sum(c.alone.occurs) for c in known),
        without=sum(sum(c.without.occurs) for c in known) + unchanged,
        needed=len(needed),
        found=median(s.value for s in moved),
        least=median(s.value for s in needed) if needed else None,
        unit=moved[0].unit,
    )


def _largest_size(name: str, sizes: Sequence[ChangeSize]) -> ChangeSize | None:
    own = [size for size in sizes if size.parameter == name]
    return max(own, key=lambda size: size.value) if own else None


def _failure_row(explanation: Explanation, one: FailureExplanation) -> tuple[str, ...]:
    least, head = one.least, (explanation.identifier, name_failure(one.failure), format_grade(one.failure))
    if least is None:
        return (*head, "-", "-", "-", one.reason)
    changed = [f"object {index}" for index in least.objects]
    changed += ["scene"] if any(size.object is None for size in least.sizes) else []
    return (
        *head,
        ", ".join(least.parameters),
        ", ".join(changed),
        f"{100 * least.left:.0f}",
        _format_holds(one, least),
    )


def _format_holds(one: FailureExplanation, least: MinimalChange) -> str:
    """Format whether the failure holds after its minimal change."""
    text = f"{least.draws} of {least.of} draws" if least.of else "in the picture, no kind to test in draws"
    if least.of and not least.holds:
        text = f"no: {text}, in the picture only"
    return f"{text}; no smaller change keeps it" if least.is_whole else text


def _format_fails(one: Contribution) -> str:
    """Format the Shapley value of failing, averaged over failures, percent."""
    text = f"{100 * fmean(one.fails):+.0f}"
    return text if one.fails_error is None else f"{text} ± {100 * fmean(one.fails_error):.0f}"


def _format_outcome(outcome: PartOutcome) -> tuple[str, str]:
    """Format the loss, and lost objects + phantoms."""
    return f"{outcome.loss:.2f}", f"{outcome.lost} + {outcome.phantoms}"


def _format_interval(one: Interval, factor: float, digits: int) -> str:
    if one.value is None:
        return "-"
    text = f"{factor * one.value:+.{digits}f}"
    if one.low is None or one.high is None:
        return text
    return f"{text} [{factor * one.low:+.{digits}f}, {factor * one.high:+.{digits}f}]"


def _format_size(value: float, unit: str) -> str:
    return f"{value:.3g}" if unit == "code" else f"{value:.3g} {unit}"


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BAR_IN = 0.32
_MARGIN_IN = 1.5
_WIDTH_IN = 10.5
_UP, _DOWN, _TOTAL = PLOT_COLOURS[1], PLOT_COLOURS[0], "#777777"
_TITLES = {"parameter": "by parameter", "object": "by object"}


def plot_waterfalls(path: Path, explanation: Explanation) -> None:
    """Plot the contributions of parameters and of objects as waterfalls from the photograph's loss to the
    counterexample's, the largest first, with the contribution to failing, %.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = [max(len(explanation.of_kind(kind)), 1) + 2 for kind in _TITLES]
    height = _MARGIN_IN * len(rows) + _BAR_IN * sum(rows)
    with mpl.rc_context({**PLOT_STYLE, "axes.grid.axis": "x"}):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(_WIDTH_IN, height), layout="constrained")
        panels = figure.subplots(len(rows), 1, height_ratios=rows, squeeze=False)[:, 0]
        for axes, (kind, title) in zip(panels, _TITLES.items(), strict=True):
            _plot_waterfall(axes, explanation, explanation.of_kind(kind))
            axes.set_title(f"{explanation.identifier}, {title}", loc="left", fontsize=11)
    write_figure(path, figure)


def plot_means(path: Path, loss: Sequence[Interval], fails: Sequence[Interval], frames: int) -> None:
    """Plot the mean contribution of each parameter to the loss and to failing as bars with intervals.

    Args:
        path: PNG file.
        loss: Contributions to the loss.
        fails: Contributions to failing, fractions.
        frames: Number of frames.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    height = _MARGIN_IN + _BAR_IN * (len(loss) + 1)
    with mpl.rc_context({**PLOT_STYLE, "axes.grid.axis": "x"}):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(_WIDTH_IN, height), layout="constrained")
        panels = figure.subplots(1, 2, squeeze=False)[0]
        _plot_bars(panels[0], loss, 1, "added to the loss")
        _plot_bars(panels[1], fails, 100, "added to failing, %")
        figure.suptitle(f"Shapley values, mean over frames ({frames})", x=0.01, ha="left", fontsize=11)
    write_figure(path, figure)


def _plot_waterfall(axes: Axes, explanation: Explanation, contributions: Sequence[Contribution]) -> None:
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
    texts = [f"{start:.2f}", *(_format_contribution(c) for c in ordered), f"{end:.2f}"]
    for place, top, text in zip(places, tops, texts, strict=True):
        axes.annotate(text, (top, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlim(right=1.25 * max(tops))
    axes.set_xlabel("loss")


def _format_contribution(one: Contribution) -> str:
    return f"{one.loss:+.2f}   (failing {_format_fails(one)} %)"


def _plot_bars(axes: Axes, intervals: Sequence[Interval], factor: float, label: str) -> None:
    for place, one in enumerate(intervals):
        if one.value is None:
            continue
        value = factor * one.value
        axes.barh([place], [value], color=_UP if value >= 0 else _DOWN, height=0.62)
        if one.low is not None and one.high is not None:
            # if all frames are equal, a mean may lie a rounding error outside its interval
            spread = [[max(value - factor * one.low, 0)], [max(factor * one.high - value, 0)]]
            axes.errorbar([value], [place], xerr=spread, color="black", linewidth=1, capsize=3)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(intervals)), [one.name for one in intervals])
    axes.invert_yaxis()
    axes.set_xlabel(label)
