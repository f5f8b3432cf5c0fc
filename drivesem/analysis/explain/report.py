"""Reports explanations over all frames: tables, JSON, CSV, Markdown, and plots of contributions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box

from drivesem.analysis.explain.attribution import ChangeSize, Contribution, Explanation, PartOutcome
from drivesem.evaluation.curves import ClassMatches
from drivesem.evaluation.resampling import Interval, NamedMetric, WeightedRecall, bootstrap_intervals
from drivesem.report.plots import PLOT_COLOURS, PLOT_STYLE, write_figure
from drivesem.report.tables import AnalysisReport, ReportTable

_NEEDED = "needs"
_TEXT_COLUMNS = ("parameter", "frame", _NEEDED)
"""Columns of text; the others hold numbers."""
_RICH_OPTIONS: dict[str, Any] = {"unbroken": _TEXT_COLUMNS, "box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0)}


@dataclass(frozen=True, slots=True)
class ParameterSummary:
    """One parameter over all frames."""

    name: str
    """The parameter."""
    loss: Interval
    """Mean Shapley value of the loss, with a bootstrap interval over frames."""
    fails: Interval
    """Mean Shapley value of failing, with a bootstrap interval over frames."""
    gradient_share: float | None
    """Mean share of the gradient; None without a gradient."""
    alone: int
    """Frames that fail by this parameter alone."""
    without: int
    """Frames that fail without it."""
    needed: int
    """Frames in which the minimal change contains it."""
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
    loss = _mean_intervals(names, [[_shapley_value(t, n, "loss") for t in tables] for n in names], draws, seed)
    fails = _mean_intervals(names, [[_shapley_value(t, n, "fails") for t in tables] for n in names], draws, seed)
    return [_summarise_parameter(name, loss[i], fails[i], tables, explanations) for i, name in enumerate(names)]


def build_explain_tables(
    explanations: Sequence[Explanation], rows: Sequence[ParameterSummary]
) -> list[ReportTable]:
    """Build the table of parameters over all frames, and that of minimal changes by frame."""
    by_parameter = tuple(
        (
            row.name,
            _format_interval(row.loss, 1, 2),
            _format_interval(row.fails, 100, 0),
            "-" if row.gradient_share is None else f"{100 * row.gradient_share:.0f}",
            str(row.alone),
            str(row.without),
            str(row.needed),
            _format_size(row.found, row.unit),
            "-" if row.least is None else _format_size(row.least, row.unit),
        )
        for row in rows
    )
    by_frame = tuple(_frame_row(e) for e in explanations)
    return [
        ReportTable(
            f"by parameter, frames: {len(explanations)}",
            (
                *("parameter", "adds to loss", "of failing, %", "of gradient, %", "fail by it alone"),
                *("fail without it", "need it", "largest change", "sufficient"),
            ),
            by_parameter,
            _RICH_OPTIONS,
        ),
        ReportTable(
            "minimal change",
            (
                *("frame", "loss", "failures", "flips", "size, steps", "minimal, steps", "minimal, %"),
                *(_NEEDED, "objects", "failures left", "most loss by"),
            ),
            by_frame,
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
        loss, fails = f"{one.loss:+.2f}", f"{100 * one.fails:+.0f}"
        if one.loss_error is not None and one.fails_error is not None:
            loss, fails = f"{loss} ± {one.loss_error:.2f}", f"{fails} ± {100 * one.fails_error:.0f}"
        share = "-" if one.gradient_share is None else f"{100 * one.gradient_share:.0f}"
        rows.append((one.name, loss, fails, share, *_format_outcome(one.alone), *_format_outcome(one.without)))
    columns = (
        *("part", "adds to loss", "of failing, %", "of gradient, %"),
        *("alone: loss", "alone: failures", "without: loss", "without: failures"),
    )
    return ReportTable(explanation.identifier, columns, tuple(rows))


def build_explain_notes(draws: int) -> list[str]:
    """Explain the columns. draws: bootstrap draws."""
    interval = f"; in brackets: 95 % interval of {draws} bootstrap draws of frames" if draws else ""
    return [
        f"Adds to loss, of failing: mean Shapley values, which add up to the rise of the loss and to 100 "
        f"%{interval}. "
        "Of gradient: share of |gradient x change| at the photograph. Fail by it alone, without it: frames that "
        "fail by this parameter's part of the change only, and by all other parts. Need it: frames in which the "
        "minimal change contains it. Largest change, sufficient: largest change of an object in the "
        "counterexample, and in the minimal change if it contains the parameter; medians over frames.",
        "Failures: lost objects + phantoms. Flips: how often failing starts or stops between photograph and "
        "counterexample. Size: of the change, in sign steps; minimal: of the smallest change found that still "
        "fails, "
        f"and its share; {_NEEDED}, objects: what it changes; failures left: its failures. Most loss by: the "
        f"object "
        "with the largest contribution to the loss.",
    ]


def exchange_note(names: Sequence[str]) -> str:
    """Name the frames that cannot be explained."""
    return f"frames that fail by the exchange of vehicles alone: {', '.join(names)}"


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
        pictures = ("shapley", *(("sensitivity",) if e.sensitivity else ()), "minimal_overlay")
        appendix += [f"![](frames/{e.identifier}/{name}.png)\n" for name in pictures]
    tables = build_explain_tables(explanations, rows)
    left_out: Sequence[str] = facts["frames_by_exchange"]
    return AnalysisReport(
        out=out,
        name="explain",
        heading="Explanations",
        data={**facts, "rows": [row.to_json() for row in rows], "explained": [_json_row(e) for e in explanations]},
        csv_tables={"explain": [line for e in explanations for line in _csv_rows(e)]},
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


def _json_row(explanation: Explanation) -> dict[str, Any]:
    """Summarise a frame; its own folder has the rest."""
    least = explanation.least
    return {
        "frame": explanation.identifier,
        "loss_benign": explanation.benign.loss,
        "loss_found": explanation.found.loss,
        "sign_changes": least.sign_changes,
        "size_found": least.norm_found,
        "size_least": least.norm,
        "left": least.left,
        "parameters": list(least.parameters),
        "objects": list(least.objects),
        "feasible": not least.violations,
        "renders": explanation.renders,
    }


def _csv_rows(explanation: Explanation) -> list[dict[str, Any]]:
    """Return a row per parameter and per object."""
    rows: list[dict[str, Any]] = []
    for one in explanation.contributions:
        before, after = _part_sizes(one, explanation.sizes), _part_sizes(one, explanation.least.sizes)
        # an object's change has no single unit: metres and degrees do not add up
        physical = one.kind == "parameter"
        rows.append(
            {
                "frame": explanation.identifier,
                "kind": one.kind,
                "name": one.name,
                "exact": one.kind in explanation.exact,
                **{name: getattr(one, name) for name in ("loss", "loss_error", "fails", "fails_error")},
                "gradient": one.gradient,
                "gradient_share": one.gradient_share,
                **{f"alone_{key}": value for key, value in asdict(one.alone).items()},
                **{f"without_{key}": value for key, value in asdict(one.without).items()},
                "unit": before[0].unit if physical else None,
                "found": max(s.value for s in before) if physical else None,
                "least": max((s.value for s in after), default=0.0) if physical else None,
                "found_steps": max(s.steps for s in before),
                "least_steps": max((s.steps for s in after), default=0.0),
            }
        )
    return rows


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
    least = [_largest_size(name, e.least.sizes) for e in explanations]
    moved, needed = [s for s in found if s is not None], [s for s in least if s is not None]
    return ParameterSummary(
        name=name,
        loss=loss,
        fails=fails,
        gradient_share=fmean(shares) if shares else None,
        alone=sum(c.alone.success for c in known),
        # a frame that does not change it fails without it
        without=sum(c.without.success for c in known) + len(tables) - len(known),
        needed=len(needed),
        found=median(s.value for s in moved),
        least=median(s.value for s in needed) if needed else None,
        unit=moved[0].unit,
    )


def _largest_size(name: str, sizes: Sequence[ChangeSize]) -> ChangeSize | None:
    own = [size for size in sizes if size.parameter == name]
    return max(own, key=lambda size: size.value) if own else None


def _shapley_value(table: dict[str, Contribution], name: str, field: str) -> float:
    return float(getattr(table[name], field)) if name in table else 0.0


def _mean_intervals(
    names: Sequence[str], values: Sequence[Sequence[float]], draws: int, seed: int
) -> list[Interval]:
    """Return means over frames with bootstrap intervals. values: per name and frame."""
    frames = len(values[0])
    ones, order = np.ones(frames), np.arange(frames)
    metrics = [
        NamedMetric(name, (WeightedRecall(ClassMatches(ones, order, np.asarray(row), np.zeros(frames), ones)),))
        for name, row in zip(names, values, strict=True)
    ]
    return bootstrap_intervals(metrics, frames, draws, np.random.default_rng(seed))


def _frame_row(explanation: Explanation) -> tuple[str, ...]:
    least = explanation.least
    most = max(explanation.of_kind("object"), key=lambda c: c.loss)
    benign_loss, _ = _format_outcome(explanation.benign)
    found_loss, fails = _format_outcome(explanation.found)
    return (
        explanation.identifier,
        f"{benign_loss} to {found_loss}",
        fails,
        str(least.sign_changes),
        f"{least.norm_found:.2f}",
        f"{least.norm:.2f}",
        f"{100 * least.left:.1f}",
        ", ".join(least.parameters),
        f"{', '.join(map(str, least.objects)) or 'none'} of {explanation.objects}",
        _format_outcome(least.outcome)[1],
        f"{most.name.removeprefix('objects')} {most.loss:+.2f}",
    )


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
    return f"{one.loss:+.2f}   (failing {100 * one.fails:+.0f} %)"


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
