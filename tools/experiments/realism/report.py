"""The report on how far the pictures of runs are from one another, by frame and by vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.progress import track

from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.reporting.tables import AnalysisReport, Console, ReportTable
from drivesem.run.finished import AttackRun, load_runs
from drivesem.run.folder import resolve_output_folder
from tools.experiments.realism.comparison import PAIRS, FrameRegions, RealismRow, measure_frame, realism_rows
from tools.experiments.realism.metrics import METRICS, load_metrics, psnr_db, why_missing
from tools.experiments.settings import RealismConfig

AVAILABLE = "available"
_TEXT_COLUMNS = ("run", "parameters", "where", "metric")
_SIDES = {"benign": "photograph", "rerendered": "re-render", "attacked": "counterexample"}
REGION_NAMES = {"frame": "frame", "boxes": "vehicles"}
"""Names of REGIONS in tables."""
_NOTE = (
    "Mean over frames, and 95 % of the bootstrap over frames. Vehicles: the rectangle around each vehicle before and "
    "after, at least 64 px a side; their mean is a frame's value. PSNR is that of the mean squared error; inf: equal "
    "pictures. A Frechet distance is comparable with published ones only for many more pictures than features; for "
    "equal numbers of pictures it ranks. It has no interval: draws with repetitions are farther apart than the sets "
    "themselves."
)


def run_realism(config: RealismConfig) -> AnalysisReport:
    """Measure the pictures of runs, and write the report. Raises UsageError or SceneError for bad input."""
    runs = load_runs(config.runs, config.limit, "RUN")
    folder = None if config.weights is None else Path(config.weights)
    names, absent = choose_metrics(config.metrics, folder, config.fetch)
    measures = load_metrics(names, folder, config.fetch)
    out = resolve_output_folder(config.out, runs[0].folder / "realism")
    console = Console(stderr=True)
    frames: list[tuple[FrameRegions, ...]] = []
    for run in runs:
        wanted = [f for f in run.frames if f.result.success_moved or not config.successes]
        if not wanted:
            raise UsageError("--successes", "a run with a success", run.folder)
        tracked = track(wanted, run.name, console=console, transient=True, disable=not console.is_terminal)
        frames.append(tuple(measure_frame(frame, measures) for frame in tracked))
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    table = [
        (run, row)
        for run, parts in zip(runs, frames, strict=True)
        for row in realism_rows(parts, names, draws, config.seed)
    ]
    data = {
        "runs": [_run_facts(run, parts) for run, parts in zip(runs, frames, strict=True)],
        "rows": [_row_facts(run, row) for run, row in table],
        "bootstrap": draws,
        "unavailable": absent,
    }
    report = AnalysisReport(
        out=out,
        name="realism",
        heading="Realism",
        data=data,
        csv_tables={"realism": _region_rows(runs, frames, names)},
        tables=[_distance_table(table, len(runs) > 1)],
        notes=[_NOTE],
        text_columns=_TEXT_COLUMNS,
        failed=absent,
        failure_text="left out",
        json_only=True,
    )
    report.write()
    return report


def choose_metrics(text: str, folder: Path | None, fetch: bool) -> tuple[list[str], dict[str, str]]:
    """The metrics that --metrics names, in the order of METRICS.

    Args:
        text: Names with commas, or `available`: those with weights on disk, or all with `fetch`.
        folder: Folder of weights.
        fetch: Whether missing weights may be downloaded.

    Returns:
        Names, and the reason by name that is not available.

    Raises:
        UsageError: An unknown name.
    """
    if text == AVAILABLE:
        absent = {} if fetch else {name: why for name in METRICS if (why := why_missing(name, folder)) is not None}
        return [name for name in METRICS if name not in absent], absent
    words = [word.strip() for word in text.split(",") if word.strip()]
    wrong = [word for word in words if word not in METRICS]
    if wrong or not words:
        raise UsageError("--metrics", f"{AVAILABLE}, or {', '.join(METRICS)}", repr(wrong[0] if wrong else text))
    return [name for name in METRICS if name in words], {}


def _run_facts(run: AttackRun, parts: Sequence[FrameRegions]) -> dict[str, Any]:
    return {
        "run": run.name,
        "folder": str(run.folder),
        "params": run.params,
        "method": run.method,
        "detector": run.detector,
        "frames": len(parts),
        "vehicles": sum(len(frame.select("boxes")) for frame in parts),
    }


def _row_facts(run: AttackRun, row: RealismRow) -> dict[str, Any]:
    metric = METRICS[row.metric]
    return {"run": run.name, "params": run.params, **asdict(row), "name": metric.name, "unit": metric.unit}


def _region_rows(
    runs: Sequence[AttackRun], frames: Sequence[Sequence[FrameRegions]], names: Sequence[str]
) -> list[dict[str, Any]]:
    """A row for each frame or vehicle and pair; PSNR of equal pictures is empty."""
    pairwise = [name for name in names if METRICS[name].pairwise]
    lines = []
    for run, parts in zip(runs, frames, strict=True):
        for frame, part, pair in ((f, p, pair) for f in parts for p in f.regions for pair in PAIRS):
            line: dict[str, Any] = {"run": run.name, "frame": frame.identifier, "object": part.index}
            line |= {"kind": part.kind, "first": pair[0], "second": pair[1]}
            for name in pairwise:
                raw = part.distances[name][pair]
                value = psnr_db(raw) if METRICS[name].squared else raw
                line[name] = None if value is None else f"{value:.6g}"
            lines.append(line)
    return lines


def _distance_table(table: Sequence[tuple[AttackRun, RealismRow]], several: bool) -> ReportTable:
    """A line for each run, region and metric, with a column for each pair."""
    columns = ("run", "parameters", "where", "metric", *(_name_pair(*pair) for pair in PAIRS), "pictures")
    lines: dict[tuple[str, ...], list[str]] = {}
    for run, row in table:
        metric = METRICS[row.metric]
        name = f"{metric.name}, {metric.unit}" if metric.unit else metric.name
        cells = lines.setdefault((run.name, run.params, REGION_NAMES[row.region], name), [str(row.pictures)])
        cells.insert(-1, format_value(row))
    rows = [(*key, *cells) for key, cells in lines.items()]
    cut = 0 if several else 2
    return ReportTable("distances between pictures", columns[cut:], tuple(row[cut:] for row in rows))


def _name_pair(first: str, second: str) -> str:
    return f"{_SIDES[first]} and {_SIDES[second]}"


def format_value(row: RealismRow) -> str:
    """A value with its interval."""
    infinite = METRICS[row.metric].squared and row.pictures > 0
    mean, low, high = (_format_number(end, infinite) for end in (row.value, row.low, row.high))
    bounded = row.low is not None or (infinite and row.high is not None)
    return f"{mean} ({low} to {high})" if bounded and row.low != row.high else mean


def _format_number(value: float | None, infinite: bool) -> str:
    """Three significant digits."""
    if value is None:
        return "inf" if infinite else "-"
    if value == 0:
        return "0"
    return f"{value:.{min(max(2 - math.floor(math.log10(abs(value))), 0), 6)}f}"
