"""`drivesem attack`: a run of attacks, resumable, and what came of it."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from drivesem.config.commands import AttackConfig, ReportConfig
from drivesem.evaluation.coco import SCORE_TITLES
from drivesem.failures.grades import Grade, Kind
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.run.attack import attack_dataset
from drivesem.run.folder import load_attack_config
from drivesem.run.report.page import KINDS, NO_KIND, describe_frames, describe_objects
from drivesem.run.results import RunSummary
from drivesem.run.run_report import build_reports, describe_next_step


def attack_command(config: AttackConfig) -> int:
    """`drivesem attack`: run or resume an attack."""
    summary = attack_dataset(config)
    if config.json:
        print_json(summary.to_json())
    else:
        _print(summary, Console())
    return 0


def _print(summary: RunSummary, console: Console) -> None:
    table = Table(
        title=f"{summary.detector} on {summary.dataset}: {' + '.join(summary.params)}", title_justify="left"
    )
    table.add_column(f"{summary.headline}, %")
    for title in (*SCORE_TITLES, "objects"):
        table.add_column(title, justify="right")
    rows = {
        "benign": summary.benign,
        "benign re-rendered": summary.rerendered,
        "attacked, moved labels": summary.attacked_moved,
        "attacked, benign labels (paper)": summary.attacked_paper,
    }
    for name, scores in rows.items():
        metrics = scores.headline.columns
        cells = ("-" if metric is None else f"{100 * metric:.1f}" for metric in metrics)
        table.add_row(name, *cells, str(scores.headline.objects))
    console.print(table)
    feasible = "-" if summary.feasible_fraction is None else f"{100 * summary.feasible_fraction:.1f} %"
    lost = summary.lost_by_grade
    lines = (
        f"{describe_frames(summary)}; {describe_objects(summary)}",
        f"missed before the attack: {summary.missed_before.format(f'judged {summary.noun}s')}",
        f"lost by threshold: {lost[Grade.THRESHOLD].format(f'{summary.noun}s found before')}; certainly lost: "
        f"{lost[Grade.CERTAIN].format()}; {format_count(sum(summary.phantoms.values()), 'phantom')} by threshold",
        f"frames broken by threshold: {summary.broken.format('attacked frames')}; feasible {feasible}; "
        f"{format_count(summary.queries, 'query', 'queries')} in {summary.seconds:.0f} s",
        summarise_grades(summary),
        *filter(None, [summarise_classes(summary)]),
        summary.map.describe(),
        summary.describe_rate(),
    )
    for line in filter(None, lines):
        console.print(line, soft_wrap=True)
    for note, frames in summary.grade_notes.items():
        console.print(f"{format_count(frames, 'frame')}: {note}", soft_wrap=True)
    if summary.frames_without_vehicles:
        console.print(f"{format_count(summary.frames_without_vehicles, 'frame')} without {summary.noun}s skipped")
    for name, reason in summary.frames_failed.items():
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    console.print(f"report: {Path(summary.out) / 'report.html'}", soft_wrap=True)
    config = load_attack_config(Path(summary.out))
    console.print(describe_next_step(config, summary), soft_wrap=True)


def summarise_grades(summary: RunSummary) -> str:
    """Numbers of failures by grade and kind, in one line."""
    grades = summary.grades
    failures, certain = grades[Grade.THRESHOLD], grades[Grade.CERTAIN]
    if not failures:
        return "no failure"
    kinds = {KINDS[Kind(name)]: count for name, count in summary.kinds.items() if count}
    without = failures - sum(kinds.values())
    unknown = (
        f"; {format_count(summary.frames_ungraded, 'frame')} of unknown grade" if summary.frames_ungraded else ""
    )
    kinds |= {NO_KIND: without} if without and not unknown else {}
    by_kind = f" ({', '.join(f'{count} {name}' for name, count in kinds.items())})" if kinds else ""
    if summary.fidelity["not_trusted"]:
        by_kind += f", {summary.fidelity['not_trusted']} in pictures that are not trusted"
    if not certain:
        return f"no certain failure: {failures} by threshold, which chance may explain{by_kind}{unknown}"
    by_grade = f"{certain} certain, {grades[Grade.CONFIRMED]} confirmed, {grades[Grade.SHARED]} shared"
    return f"failures: {by_grade}, of {failures} by threshold{by_kind}{unknown}"


def summarise_classes(summary: RunSummary) -> str:
    """Numbers of failures by class, in one line; "" unless people and vehicles are both attacked."""
    counts = ((name, summary.by_class[name]) for name in summary.attacked_classes)
    parts = [
        f"{name} {one.grades[Grade.CERTAIN]} certain of {one.grades[Grade.THRESHOLD]} ({one.found_before} found before)"
        for name, one in counts
    ]
    return f"failures by class: {'; '.join(parts)}" if parts else ""


def report_command(config: ReportConfig) -> int:
    """`drivesem report`: write the HTML report of one or more runs."""
    data = build_reports(config)
    if config.json:
        print_json(data)
        return 0
    runs, frames = format_count(len(data["runs"]), "run"), format_count(len(data["frames"]), "frame")
    Console().print(f"{runs}, {frames}, {data['bytes'] / 1e6:.1f} MB: {data['out']}", soft_wrap=True)
    return 0
