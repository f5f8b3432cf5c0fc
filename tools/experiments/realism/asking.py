"""How far the pictures of runs are from one another, by frame and by vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.progress import track

from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.report.tables import AnalysisReport, ReportTable
from drivesem.report.terminal import Console
from drivesem.run.finished import AttackRun, load_runs
from drivesem.run.folder import resolve_output_folder
from tools.experiments.realism.comparison import PAIRS, FrameParts, RealismRow, frame_parts, rows
from tools.experiments.realism.measures import METRICS, load, missing, psnr_db
from tools.experiments.settings import RealismConfig

AVAILABLE = "available"
_WORDS = ("run", "parameters", "where", "metric")
_SIDES = {"benign": "photograph", "rerendered": "re-render", "attacked": "counterexample"}
REGION = {"frame": "frame", "boxes": "vehicles"}
"""What people call the parts of a picture."""
_NOTE = (
    "Mean over frames, and 95 % of the bootstrap over frames. Vehicles: the rectangle around each vehicle "
    "before and after, at least 64 px a side; a frame's figure is their mean. PSNR is that of the mean "
    "squared error; inf: equal pictures. A Frechet distance needs many more pictures than it has features to "
    "be compared with others' figures; beside the same number of pictures it ranks. It has no interval: draws "
    "with repetitions lie farther apart than the sets themselves."
)


def realism_run(config: RealismConfig) -> AnalysisReport:
    """Measure pictures of runs, and write what is said of them. Raises UsageError or SceneError for bad input."""
    runs = load_runs(config.runs, config.limit, "RUN")
    folder = None if config.weights is None else Path(config.weights)
    names, absent = chosen(config.metrics, folder, config.fetch)
    measures = load(names, folder, config.fetch)
    out = resolve_output_folder(config.out, runs[0].folder / "realism")
    console = Console(stderr=True)
    frames: list[tuple[FrameParts, ...]] = []
    for run in runs:
        wanted = [f for f in run.frames if f.result.success_moved or not config.successes]
        if not wanted:
            raise UsageError("--successes", "a run with a success", run.folder)
        looked = track(wanted, run.name, console=console, transient=True, disable=not console.is_terminal)
        frames.append(tuple(frame_parts(frame, measures) for frame in looked))
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    table = [
        (run, row)
        for run, parts in zip(runs, frames, strict=True)
        for row in rows(parts, names, draws, config.seed)
    ]
    data = {
        "runs": [_run_json(run, parts) for run, parts in zip(runs, frames, strict=True)],
        "rows": [_row_json(run, row) for run, row in table],
        "bootstrap": draws,
        "unavailable": absent,
    }
    answer = AnalysisReport(
        out=out,
        name="realism",
        heading="Realism",
        data=data,
        csv_tables={"realism": _parts(runs, frames, names)},
        tables=[_sheet(table, len(runs) > 1)],
        notes=[_NOTE],
        text_columns=_WORDS,
        failed=absent,
        failure_text="left out",
        json_only=True,
    )
    answer.write()
    return answer


def chosen(text: str, folder: Path | None, fetch: bool) -> tuple[list[str], dict[str, str]]:
    """The metrics that --metrics names, in the order of METRICS, and those that cannot be had, with reasons.

    `available` takes all that are on disk; with `fetch`, all. Raises UsageError for what is no metric.
    """
    if text == AVAILABLE:
        absent = {} if fetch else {name: why for name in METRICS if (why := missing(name, folder)) is not None}
        return [name for name in METRICS if name not in absent], absent
    words = [word.strip() for word in text.split(",") if word.strip()]
    wrong = [word for word in words if word not in METRICS]
    if wrong or not words:
        raise UsageError("--metrics", f"{AVAILABLE}, or {', '.join(METRICS)}", repr(wrong[0] if wrong else text))
    return [name for name in METRICS if name in words], {}


def _run_json(run: AttackRun, parts: Sequence[FrameParts]) -> dict[str, Any]:
    return {
        "run": run.name,
        "folder": str(run.folder),
        "params": run.params,
        "method": run.method,
        "detector": run.detector,
        "frames": len(parts),
        "vehicles": sum(len(frame.region("boxes")) for frame in parts),
    }


def _row_json(run: AttackRun, row: RealismRow) -> dict[str, Any]:
    metric = METRICS[row.metric]
    return {"run": run.name, "params": run.params, **asdict(row), "name": metric.name, "unit": metric.unit}


def _parts(
    runs: Sequence[AttackRun], frames: Sequence[Sequence[FrameParts]], names: Sequence[str]
) -> list[dict[str, Any]]:
    """A line for each frame and pair, and for each vehicle and pair; PSNR of equal pictures is empty."""
    pairwise = [name for name in names if METRICS[name].pairwise]
    lines = []
    for run, parts in zip(runs, frames, strict=True):
        for frame, part, pair in ((f, p, pair) for f in parts for p in f.parts for pair in PAIRS):
            line: dict[str, Any] = {"run": run.name, "frame": frame.identifier, "object": part.index}
            line |= {"kind": part.kind, "first": pair[0], "second": pair[1]}
            for name in pairwise:
                raw = part.distances[name][pair]
                value = psnr_db(raw) if METRICS[name].squared else raw
                line[name] = None if value is None else f"{value:.6g}"
            lines.append(line)
    return lines


def _sheet(table: Sequence[tuple[AttackRun, RealismRow]], several: bool) -> ReportTable:
    """A line a run, region and metric; pairs stand beside one another."""
    columns = ("run", "parameters", "where", "metric", *(_between(*pair) for pair in PAIRS), "pictures")
    lines: dict[tuple[str, ...], list[str]] = {}
    for run, row in table:
        metric = METRICS[row.metric]
        name = f"{metric.name}, {metric.unit}" if metric.unit else metric.name
        cells = lines.setdefault((run.name, run.params, REGION[row.region], name), [str(row.pictures)])
        cells.insert(-1, shown(row))
    rows = [(*key, *cells) for key, cells in lines.items()]
    cut = 0 if several else 2
    return ReportTable("distances between pictures", columns[cut:], tuple(row[cut:] for row in rows))


def _between(first: str, second: str) -> str:
    return f"{_SIDES[first]} and {_SIDES[second]}"


def shown(row: RealismRow) -> str:
    """A figure and its bounds."""
    infinite = METRICS[row.metric].squared and row.pictures > 0
    mean, low, high = (_digits(end, infinite) for end in (row.value, row.low, row.high))
    bounded = row.low is not None or (infinite and row.high is not None)
    return f"{mean} ({low} to {high})" if bounded and row.low != row.high else mean


def _digits(value: float | None, infinite: bool) -> str:
    """Three digits that count."""
    if value is None:
        return "inf" if infinite else "-"
    if value == 0:
        return "0"
    return f"{value:.{min(max(2 - math.floor(math.log10(abs(value))), 0), 6)}f}"
