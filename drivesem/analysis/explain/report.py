"""What is said of all frames: tables on the terminal and in Markdown, CSV, JSON, a plot of means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
from rich import box

from drivesem.analysis.explain.players import Size
from drivesem.analysis.explain.plots import write_means
from drivesem.analysis.explain.results import Contribution, Explanation, PartOutcome
from drivesem.evaluation.curves import Tally
from drivesem.evaluation.resampling import Figure, Interval, Recalled, intervals
from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet

_NEEDED = "needs"
_WORDS = ("parameter", "frame", _NEEDED)
"""Columns of words; the others hold numbers."""
_LOOKS: dict[str, Any] = {"unbroken": _WORDS, "box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0)}


@dataclass(frozen=True, slots=True)
class Mean:
    """One parameter over all frames. loss, fails: mean Shapley values, with bootstrap intervals over frames.
    gradient_share: mean, None without a gradient. alone, without: frames that fail by it alone, and without it;
    needed: frames whose least change has it. found, least: medians over frames of how far the car goes that goes
    farthest, in `unit`, in the counterexample and, where it is needed, in the least change.
    """

    name: str
    loss: Interval
    fails: Interval
    gradient_share: float | None
    alone: int
    without: int
    needed: int
    found: float
    least: float | None
    unit: str

    def to_json(self) -> dict[str, Any]:
        """Flat, numbers by name."""
        data = asdict(self)
        for name in ("loss", "fails"):
            one: Interval = getattr(self, name)
            data |= {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
        return data


def means(explanations: Sequence[Explanation], draws: int, seed: int) -> list[Mean]:
    """Each parameter that any of the frames moves, in the order in which theta holds them."""
    names = list(dict.fromkeys(c.name for e in explanations for c in e.of_kind("parameter")))
    tables = [{c.name: c for c in e.of_kind("parameter")} for e in explanations]
    loss = _intervals(names, [[_value(t, n, "loss") for t in tables] for n in names], draws, seed)
    fails = _intervals(names, [[_value(t, n, "fails") for t in tables] for n in names], draws, seed)
    return [_mean(name, loss[i], fails[i], tables, explanations) for i, name in enumerate(names)]


def sheets(explanations: Sequence[Explanation], rows: Sequence[Mean]) -> list[Sheet]:
    """Parameters over all frames; then frame by frame, how little is enough."""
    by_parameter = tuple(
        (
            row.name,
            _bounded(row.loss, 1, 2),
            _bounded(row.fails, 100, 0),
            "-" if row.gradient_share is None else f"{100 * row.gradient_share:.0f}",
            str(row.alone),
            str(row.without),
            str(row.needed),
            _measure(row.found, row.unit),
            "-" if row.least is None else _measure(row.least, row.unit),
        )
        for row in rows
    )
    by_frame = tuple(_frame_row(e) for e in explanations)
    return [
        Sheet(
            f"by parameter, frames: {len(explanations)}",
            (
                *("parameter", "adds to loss", "of failing, %", "of gradient, %", "fail by it alone"),
                *("fail without it", "need it", "car moved by", "enough"),
            ),
            by_parameter,
            _LOOKS,
        ),
        Sheet(
            "how little is enough",
            (
                *("frame", "loss", "failures", "flips on the way", "size, steps", "enough, steps", "enough, %"),
                *(_NEEDED, "cars", "still", "most loss by"),
            ),
            by_frame,
            _LOOKS,
        ),
    ]


def what_if(explanation: Explanation) -> Sheet:
    """One frame: each parameter and car, what it adds, and what comes of it alone and of all but it."""
    rows: list[tuple[str, ...]] = [
        ("nothing", "", "", "", *_told(explanation.benign), "", ""),
        ("everything", "", "", "", *_told(explanation.found), "", ""),
    ]
    for one in explanation.contributions:
        loss, fails = f"{one.loss:+.2f}", f"{100 * one.fails:+.0f}"
        if one.loss_error is not None and one.fails_error is not None:
            loss, fails = f"{loss} ± {one.loss_error:.2f}", f"{fails} ± {100 * one.fails_error:.0f}"
        share = "-" if one.gradient_share is None else f"{100 * one.gradient_share:.0f}"
        rows.append((one.name, loss, fails, share, *_told(one.alone), *_told(one.without)))
    columns = (
        *("part", "adds to loss", "of failing, %", "of gradient, %"),
        *("alone: loss", "alone: failures", "without: loss", "without: failures"),
    )
    return Sheet(explanation.identifier, columns, tuple(rows))


def notes(draws: int) -> list[str]:
    """What the columns mean."""
    spread = f"; in brackets: 95 % of {draws} draws of frames" if draws else ""
    return [
        "Adds to loss, of failing: mean Shapley values, which add up to the rise of the loss and to 100 %"
        f"{spread}. Of gradient: share of |gradient x change|, taken at the photograph. Fail by it alone, without "
        "it: frames that fail by this parameter's part of the change only, and by all but it. Need it: frames "
        "whose least failing change has it. Car moved by, enough: how far the car goes that goes farthest, in the "
        "counterexample and in the least change where it is needed; medians over frames.",
        "Failures: lost objects + phantoms. Flips on the way: how often failing begins or ends between photograph "
        "and counterexample. Size: of the change in sign steps; enough: of the least that still fails, and its "
        "share; "
        f"{_NEEDED}, cars: what it moves; still: how it fails. Most loss by: the car with most of the loss.",
    ]


def exchange_note(names: Sequence[str]) -> str:
    """What is said of frames that are left out. names: theirs."""
    return f"left out, as the exchange of vehicles alone makes them fail: {', '.join(names)}"


def answer_of(
    out: Path, explanations: Sequence[Explanation], rows: Sequence[Mean], draws: int, facts: Mapping[str, Any]
) -> Answer:
    """explain.json (with `facts` in front), explain.md, explain.csv and explain.png."""
    appendix: list[str] = []
    for e in explanations:
        sheet = what_if(e)
        appendix += [*sheet.markdown(sheet.columns), ""]
        pictures = ("shapley", *(("sensitivity",) if e.sensitivity else ()), "minimal_overlay")
        appendix += [f"![](frames/{e.identifier}/{name}.png)\n" for name in pictures]
    tables = sheets(explanations, rows)
    left_out: Sequence[str] = facts["frames_by_exchange"]
    return Answer(
        out=out,
        name="explain",
        heading="Why it fails",
        data={**facts, "rows": [row.to_json() for row in rows], "explained": [_brief(e) for e in explanations]},
        tables={"explain": [line for e in explanations for line in _flat(e)]},
        sheets=tables,
        notes=[*notes(draws), *([f"Frames {exchange_note(left_out)}."] if left_out else [])],
        words=[name for sheet in tables for name in sheet.columns],
        printed_words=_WORDS,
        appendix=appendix,
        picture=partial(
            write_means,
            loss=[row.loss for row in rows],
            fails=[row.fails for row in rows],
            frames=len(explanations),
        ),
        failed={f"frame {name}": reason for name, reason in facts["frames_failed"].items()},
        failure="could not be explained",
    )


def _brief(explanation: Explanation) -> dict[str, Any]:
    """A frame in the summary; the rest is in its own folder."""
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


def _flat(explanation: Explanation) -> list[dict[str, Any]]:
    """A row for each parameter and each object: numbers by name."""
    rows: list[dict[str, Any]] = []
    for one in explanation.contributions:
        before, after = _sizes_of(one, explanation.sizes), _sizes_of(one, explanation.least.sizes)
        # Metres and degrees cannot be added up: a car's size is told in steps only.
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


def _sizes_of(one: Contribution, sizes: Sequence[Size]) -> list[Size]:
    """Of a parameter's cells, or of a car's."""
    return [size for size in sizes if one.name in (size.parameter, size.owner)]


def _mean(
    name: str,
    loss: Interval,
    fails: Interval,
    tables: Sequence[dict[str, Contribution]],
    explanations: Sequence[Explanation],
) -> Mean:
    known = [table[name] for table in tables if name in table]
    shares = [c.gradient_share for c in known if c.gradient_share is not None]
    found = [_farthest(name, e.sizes) for e in explanations]
    least = [_farthest(name, e.least.sizes) for e in explanations]
    moved, needed = [s for s in found if s is not None], [s for s in least if s is not None]
    return Mean(
        name=name,
        loss=loss,
        fails=fails,
        gradient_share=fmean(shares) if shares else None,
        alone=sum(c.alone.success for c in known),
        # A frame that does not move it fails without it.
        without=sum(c.without.success for c in known) + len(tables) - len(known),
        needed=len(needed),
        found=median(s.value for s in moved),
        least=median(s.value for s in needed) if needed else None,
        unit=moved[0].unit,
    )


def _farthest(name: str, sizes: Sequence[Size]) -> Size | None:
    own = [size for size in sizes if size.parameter == name]
    return max(own, key=lambda size: size.value) if own else None


def _value(table: dict[str, Contribution], name: str, field: str) -> float:
    return float(getattr(table[name], field)) if name in table else 0.0


def _intervals(names: Sequence[str], values: Sequence[Sequence[float]], draws: int, seed: int) -> list[Interval]:
    """Means over frames as the bootstrap takes them: sums of values over sums of ones."""
    frames = len(values[0])
    ones, order = np.ones(frames), np.arange(frames)
    figures = [
        Figure(name, (Recalled(Tally(ones, order, np.asarray(row), np.zeros(frames), ones)),))
        for name, row in zip(names, values, strict=True)
    ]
    return intervals(figures, frames, draws, np.random.default_rng(seed))


def _frame_row(explanation: Explanation) -> tuple[str, ...]:
    least = explanation.least
    most = max(explanation.of_kind("object"), key=lambda c: c.loss)
    benign_loss, _ = _told(explanation.benign)
    found_loss, fails = _told(explanation.found)
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
        _told(least.outcome)[1],
        f"{most.name.removeprefix('objects')} {most.loss:+.2f}",
    )


def _told(outcome: PartOutcome) -> tuple[str, str]:
    """Loss; lost objects and phantoms."""
    return f"{outcome.loss:.2f}", f"{outcome.lost} + {outcome.phantoms}"


def _bounded(one: Interval, factor: float, digits: int) -> str:
    if one.value is None:
        return "-"
    text = f"{factor * one.value:+.{digits}f}"
    if one.low is None or one.high is None:
        return text
    return f"{text} [{factor * one.low:+.{digits}f}, {factor * one.high:+.{digits}f}]"


def _measure(value: float, unit: str) -> str:
    return f"{value:.3g}" if unit == "code" else f"{value:.3g} {unit}"
