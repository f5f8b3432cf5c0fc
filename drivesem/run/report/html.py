"""Renders the self-contained HTML page of runs: no network, no server."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, zip_longest
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from drivesem.failures.grades import Grade
from drivesem.reporting import web
from drivesem.reporting.tables import format_count
from drivesem.run.report import page as grading
from drivesem.run.report.frames import CloseUp, FrameCard, build_cards, describe_outcome, format_size
from drivesem.run.report.page import (
    MetricDrop,
    ReportedRun,
    ReportPage,
    curve_chart,
    drop_chart,
    legend_key,
    loss_trace_chart,
)
from drivesem.run.results import RunSummary

_COLUMNS = {
    "AP50": "ap50",
    "AP70": "ap70",
    "AP50:95": "ap",
    "recall": "recall",
    "recall at t*": "recall_at_t_star",
}
_GLANCE = 4
"""Failures at the top of the page."""
_LARGEST_SIZE = 100
_FROM_CERTAIN = (Grade.CERTAIN, Grade.CONFIRMED, Grade.SHARED)
_NONE = "–"


@dataclass(frozen=True, slots=True)
class _MetricRow:
    name: str
    cells: tuple[str, ...]
    words: tuple[str, ...] = ()
    from_paper: bool = False


@dataclass(frozen=True, slots=True)
class _SummaryTile:
    title: str
    figure: str
    more: str


def render_report(page: ReportPage, at: Path) -> str:
    """Return the text of the page. at: its file, which links to the runs' folders are relative to.

    Raises FormatError if a picture of the gallery is missing.
    """
    runs, several = page.runs, len(page.runs) > 1
    cards = build_cards(runs, page.gallery)
    first = runs[0]
    return web.render_page(
        "drivesem.run.report:template.html",
        "drivesem.run.report:page.js",
        link_to=lambda folder, frame=None: _link(at, folder, frame),
        scene_of=lambda folder, frame: shlex.quote((folder / "frames" / frame / "scene").as_posix()),
        describe_outcome=describe_outcome,
        format_size=format_size,
        loss_trace_chart=loss_trace_chart,
        title=f"{len(runs)} runs" if several else f"{first.summary.detector} on {first.summary.dataset}",
        runs=runs,
        several=several,
        headline=_comparison(runs) if several else _verdict(first),
        how_sure="" if several else _how_sure(first),
        lead=_lead(runs),
        tiles=[] if several else _tiles(first),
        rows=[_run_row(run, any(r.paper for r in runs)) for run in runs] if several else _figure_rows(first),
        columns=(*_COLUMNS, "objects"),
        frames=len(cards),
        left_out=page.left_out,
        paper_before=next((f"{100 * run.paper.before:.1f}" for run in runs if run.paper), ""),
        falls=_draw_drops(runs),
        charts=[
            {
                "title": chart.title,
                "picture": curve_chart(chart),
                "legend": [(legend_key(place), line.name) for place, line in enumerate(chart.lines)],
                "note": chart.note,
            }
            for chart in page.charts
        ],
        at_a_glance=(glance := list(islice(_glance(cards), _GLANCE))),
        glance_title=_glance_title([shot for _, _, shot in glance]),
        graded=[run for run in runs if grading.is_known(run.summary, run.frames)],
        failures=any(result.failures for run in runs for result in run.frames),
        kinds=[] if several else grading.tabulate_kinds(first.frames, first.summary.attacked_classes or ("",)),
        grades=[str(grade) for grade in reversed(Grade)],
        rules=grading.build_grade_rules(first.grade_requirements),
        unknown=grading.UNKNOWN,
        grade_notes=_notes(runs),
        cards=cards,
        gallery=[card for card in cards if card.layers],
        params=sorted({param for card in cards for param in card.params}),
        weathers=sorted({card.weather for card in cards if card.weather}),
        largest=_LARGEST_SIZE,
    )


def _link(at: Path, folder: Path, frame: str | None) -> str:
    """Return a relative URL that ends in a slash."""
    target = folder if frame is None else folder / "frames" / frame
    relative = os.path.relpath(target.resolve(), at.resolve().parent)
    return quote(Path(relative).as_posix()) + "/"


def _percent(value: float | None) -> str:
    return _NONE if value is None else f"{100 * value:.1f}"


def _points(before: float | None, after: float | None) -> str:
    return _NONE if before is None or after is None else f"{100 * (before - after):.1f}"


def _describe_drop(before: float | None, after: float | None) -> str:
    """Describe a drop in points: `1.3 points lower`, or `unchanged`."""
    points = _points(before, after)
    if points in (_NONE, "0.0", "-0.0"):
        return _NONE if points == _NONE else "unchanged"
    return f"{points.removeprefix('-')} points {'higher' if points.startswith('-') else 'lower'}"


def _totals(summary: RunSummary) -> tuple[int, int]:
    return sum(summary.lost_objects.values()), sum(summary.phantoms.values())


def _verdict(run: ReportedRun) -> str:
    summary = run.summary
    lost, phantoms = _totals(summary)
    attacked = format_count(summary.frames_attacked, "attacked frame")
    if not summary.frames_attacked:
        return f"Nothing to attack: {grading.describe_objects(summary)}"
    if not lost and not phantoms:
        return f"{summary.detector} withstood in all of {attacked}"
    if grading.is_known(summary, run.frames):
        grade = grading.highest_grade(summary)
        if grade is None:
            return f"No certain failure: {format_count(lost + phantoms, 'failure')} by threshold, {grading.CHANCE}"
        frames = sum(any(f.grade == grade for f in r.failures) for r in run.frames)
        failures = format_count(summary.grades[str(grade)], f"{grade} failure")
        return f"{failures} of {summary.detector}, in {frames} of {attacked}"
    parts = [f"loses {format_count(lost, 'object')}"] if lost else []
    if phantoms:
        parts.append(f"reports {phantoms if lost else format_count(phantoms, 'object')}")
    frames = f"{summary.successes_moved} of {attacked}"
    return f"{summary.detector} {' and '.join(parts)}, in {frames}"


def _how_sure(run: ReportedRun) -> str:
    """Describe the failures of each highest grade by kind, a sentence each; "" without any."""
    failures = [failure for result in run.frames for failure in result.failures]
    if not failures:
        return ""
    if not grading.is_known(run.summary, run.frames):
        return (
            f"{grading.UNKNOWN[0].upper()}{grading.UNKNOWN[1:]}. They are failures by threshold, {grading.CHANCE}."
        )
    describe_outcome = []
    for grade in reversed(Grade):
        mine = [failure for failure in failures if failure.grade == grade]
        if mine and grade is Grade.THRESHOLD:
            others = "More by threshold only" if describe_outcome else "By threshold only"
            describe_outcome.append(f"{others}: {grading.summarise_kinds(mine)}.")
        elif mine:
            word = f"only {grade}" if describe_outcome else str(grade)
            describe_outcome.append(f"{word[0].upper()}{word[1:]}: {grading.summarise_kinds(mine)}.")
    unknown = sum(failure.grade is None for failure in failures)
    return " ".join([*describe_outcome, *([f"{unknown} of unknown grade."] if unknown else [])])


def _comparison(runs: Sequence[ReportedRun]) -> str:
    frames = format_count(runs[0].summary.frames, "frame")
    head = f"{len(runs)} runs on {frames}"
    if all(grading.is_known(run.summary, run.frames) for run in runs):
        surest = max(runs, key=lambda run: tuple(run.summary.grades[str(g)] for g in _FROM_CERTAIN))
        sure, failures = (surest.summary.grades[str(g)] for g in (Grade.CERTAIN, Grade.THRESHOLD))
        if not sure:
            return f"{head}: no certain failure in any"
        tie = _tie(runs, [run.summary.grades[str(Grade.CERTAIN)] for run in runs], "certain failures")
        if tie:
            return f"{head}: {tie}"
        return f"{head}: {surest.name} has most certain failures, {sure} of {failures} by threshold"
    counts = [run.summary.successes_moved for run in runs]
    tie = _tie(runs, counts, "broken frames by threshold")
    if tie:
        return f"{head}: {tie}"
    most = runs[counts.index(max(counts))]
    return f"{head}: {most.name} breaks most by threshold, {most.summary.successes_moved}"


def _tie(runs: Sequence[ReportedRun], counts: Sequence[int], what: str) -> str:
    """Describe which runs share the first place, or return ""."""
    most = max(counts)
    names = [run.name for run, count in zip(runs, counts, strict=True) if count == most]
    if len(names) == 1:
        return ""
    if len(names) == len(runs):
        return f"{'both' if len(runs) == 2 else 'all'} have as many {what}, {most} each"
    return f"{', '.join(names[:-1])} and {names[-1]} have most {what}, {most} each"


def _notes(runs: Sequence[ReportedRun]) -> list[str]:
    """Return the reasons why grades could not be reached."""
    several = len(runs) > 1
    return [
        f"{f'{run.name}: ' if several else ''}{note} ({format_count(frames, 'frame')})"
        for run in runs
        for note, frames in run.summary.grade_notes.items()
    ]


def _lead(runs: Sequence[ReportedRun]) -> str:
    summary = runs[0].summary
    frames = format_count(summary.frames, "frame")
    if len(runs) > 1:
        return f"The same {frames} of {summary.dataset}, with {format_count(summary.objects.all, summary.noun)}."
    data = f"{summary.dataset} ({grading.describe_frames(summary)}; {grading.describe_objects(summary)})"
    changed = " + ".join(summary.params)
    return (
        f"{changed} changed by {runs[0].method} within feasible limits, on {data}. Each failure was correct "
        f"before "
        f"the change, and is evaluated with labels that moved with the {summary.noun}s."
    )


def _tiles(run: ReportedRun) -> list[_SummaryTile]:
    summary = run.summary
    before, moved, stay = (
        s.headline.ap50 for s in (summary.benign, summary.attacked_moved, summary.attacked_paper)
    )
    paper = f"paper's mAP: {_percent(run.paper.before)} → {_percent(run.paper.after)}" if run.paper else ""
    by_labels = f"with benign labels {_percent(stay)}"
    left = len(summary.frames_not_attacked)
    objects, missed = summary.objects, summary.missed_before
    lost_share = summary.lost_by_grade[str(Grade.THRESHOLD)]
    return [
        _SummaryTile(
            "missed before the attack",
            f"{missed.count} of {missed.of}",
            f"{missed.percent} of judged {summary.noun}s; {objects.all} {summary.noun}s in all"
            if missed.of
            else "none is judged",
        ),
        _SummaryTile(
            "lost, by threshold",
            f"{lost_share.count} of {lost_share.of}",
            f"{lost_share.percent} of {summary.noun}s found before; {_by_class(summary)}"
            if lost_share.of
            else "none is found before",
        ),
        *_graded_tile(run),
        _SummaryTile(
            f"AP50 of {summary.headline}, %",
            f"{_percent(before)} → {_percent(moved)}",
            f"on {format_count(summary.benign.headline.objects, summary.headline)}: {_describe_drop(before, moved)}; "
            f"{by_labels}" + (f"; {paper}" if paper else ""),
        ),
        _SummaryTile(
            "frames broken, by threshold",
            f"{summary.successes_moved} of {summary.frames_attacked}",
            f"{summary.broken.percent} of attacked frames" + (f"; {left} not attacked" if left else ""),
        ),
        _SummaryTile(
            "feasible, %",
            _percent(summary.feasible_fraction),
            f"by the independent check; {format_count(summary.queries, 'query', 'queries')}",
        ),
    ]


def _graded_tile(run: ReportedRun) -> list[_SummaryTile]:
    grades, failures = run.summary.grades, sum(_totals(run.summary))
    if not failures:
        return []
    if not grading.is_known(run.summary, run.frames):
        return [_SummaryTile("certain failures", "unknown", "the failures of this run are not graded")]
    more = f"{grades[Grade.CONFIRMED]} confirmed, {grades[Grade.SHARED]} shared; the others by threshold only. "
    lost = run.summary.lost_by_grade[str(Grade.CERTAIN)]
    more += f"Certainly lost: {lost.format(f'{run.summary.noun}s found before')}"
    return [_SummaryTile("certain failures", f"{grades[Grade.CERTAIN]} of {failures}", more)]


def _by_class(summary: RunSummary) -> str:
    parts = []
    for word, counts in (("lost", summary.lost_objects), ("phantoms", summary.phantoms)):
        found = ", ".join(f"{number} {name}" for name, number in counts.items() if number)
        parts += [f"{word}: {found}"] if found else []
    return "; ".join(parts) or "nothing"


def _figure_rows(run: ReportedRun) -> list[_MetricRow]:
    summary = run.summary
    rows = [
        ("before: photographs", summary.benign),
        ("before: re-rendered", summary.rerendered),
        ("after, moved labels", summary.attacked_moved),
        ("after, benign labels (as in the paper)", summary.attacked_paper),
    ]
    found = [
        _MetricRow(
            name,
            (
                *(_percent(getattr(scores.headline, key)) for key in _COLUMNS.values()),
                str(scores.headline.objects),
            ),
        )
        for name, scores in rows
    ]
    if run.paper is not None:
        empty = (_NONE,) * len(_COLUMNS)
        found += [
            _MetricRow("the paper's mAP, before", (_percent(run.paper.before), *empty), from_paper=True),
            _MetricRow("the paper's mAP, after", (_percent(run.paper.after), *empty), from_paper=True),
        ]
    return found


def _run_row(run: ReportedRun, papers: bool) -> _MetricRow:
    """Build the row of a run. papers: whether there is a column of the paper's mAP."""
    summary = run.summary
    before, moved = summary.benign.headline, summary.attacked_moved.headline
    lost, phantoms = _totals(summary)
    return _MetricRow(
        run.name,
        (
            *_graded_cells(run),
            str(before.objects),
            _percent(before.ap50),
            _percent(moved.ap50),
            _points(before.ap50, moved.ap50),
            _percent(summary.attacked_paper.headline.ap50),
            *((_percent(run.paper.after if run.paper else None),) if papers else ()),
            _percent(moved.recall_at_t_star),
            f"{summary.successes_moved} of {summary.frames_attacked}",
            f"{lost} of {summary.objects.found_before}",
            str(phantoms),
            _percent(summary.feasible_fraction),
            str(summary.queries),
        ),
        words=(run.name, f"{run.method} on {summary.detector}: {' + '.join(summary.params)}"),
    )


def _graded_cells(run: ReportedRun) -> tuple[str, ...]:
    """Count failures of at least each grade, from certain on."""
    if not grading.is_known(run.summary, run.frames):
        return (_NONE,) * len(_FROM_CERTAIN)
    return tuple(str(run.summary.grades[str(grade)]) for grade in _FROM_CERTAIN)


def _draw_drops(runs: Sequence[ReportedRun]) -> Markup | None:
    """Draw the drops of AP50; None without objects."""
    found: list[MetricDrop] = []
    for run in runs:
        summary, several = run.summary, len(runs) > 1
        before, moved = summary.benign.headline.ap50, summary.attacked_moved.headline.ap50
        stay = summary.attacked_paper.headline.ap50
        if before is None or moved is None or stay is None:
            continue
        found.append(MetricDrop(run.name if several else "moved labels", 100 * before, 100 * moved))
        if not several:
            found.append(MetricDrop("benign labels, as in the paper", 100 * before, 100 * stay))
    papers = dict.fromkeys((run.summary.params, run.paper) for run in runs if run.paper is not None)
    found += [
        MetricDrop(f"the paper: {' + '.join(params)}", 100 * paper.before, 100 * paper.after, from_paper=True)
        for params, paper in papers
        if paper is not None
    ]
    headline = runs[0].summary.headline
    return drop_chart(found, f"AP50 of {headline}") if found else None


def _glance(cards: Sequence[FrameCard]) -> Iterator[tuple[FrameCard, str, CloseUp]]:
    """Yield close-ups, highest grade first; within a grade the first of each frame, then the second, ..."""
    shots = [
        [
            (card, one.run.name, shot)
            for one, found in zip(card.outcomes, card.close_ups, strict=True)
            for shot in found
        ]
        for card in cards
        if card.layers
    ]
    in_turn = [shot for turn in zip_longest(*shots) for shot in turn if shot is not None]
    yield from sorted(in_turn, key=lambda shot: -shot[2].rank)


def _glance_title(shots: Sequence[CloseUp]) -> str:
    """Return the heading of the close-ups, which depends on their highest grade."""
    if not shots or not any(shot.grade for shot in shots):
        return "Failures in close-up"
    surest = max(shots, key=lambda shot: shot.rank)
    if surest.rank > grading.rank_of_grade(Grade.THRESHOLD):
        return "Failures in close-up, highest grade first"
    return "Failures by threshold in close-up: none is certain"
