"""`drivesem bench WHAT`: figures with method, machine, versions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from detectors.base import Detector, DetectorError
from detectors.registry import load_detector
from drivesem.bench import boxes, night, render, step
from drivesem.bench.scenes import MOST_CARS
from drivesem.bench.session import Measured, conduct, watched
from drivesem.bench.tables import Section
from drivesem.config.commands import BenchConfig
from drivesem.config.constraints import parse_integers
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count
from drivesem.report.terminal import Console
from drivesem.run.attack import select_frames
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.scenes.sources import open_source
from scene_ir.errors import FormatError

_SECONDS = {"step": (36.0, 240.0), "render": (22.0, 240.0), "verbs": (6.0, 30.0)}
"""Seconds for measuring, with --quick and without; imports and scenes take some more."""


def bench_command(config: BenchConfig) -> int:
    """Measure, print, write; exit code 0. Raises UsageError or SceneError for bad input."""
    cars, _ = _sizes(config)
    if max(cars) > MOST_CARS:
        raise UsageError("--cars", f"at most {MOST_CARS}", max(cars))
    measure: dict[str, Callable[[BenchConfig, Console], Measured]] = {
        "step": _step,
        "render": _render,
        "night": _night,
    }
    return conduct(config, "drivesem bench", measure[config.what])


def _step(config: BenchConfig, console: Console) -> Measured:
    try:
        detector = load_detector(config.detector, config.device)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    if config.boxes is not None:
        return _boxes(config, Path(config.boxes), detector, console)
    sizes, beside = step.cases(*_sizes(config))
    seconds = _seconds("step", config)
    measured = step.measure(
        sizes + beside, detector, seconds, config.seed, config.device, config.whole, config.keep_mb
    )
    rows = _dicts(watched(measured, len(sizes) + len(beside), console))
    rows, beside_rows = rows[: len(sizes)], rows[len(sizes) :]
    return Measured(
        {"rows": rows, "beside": beside_rows, "method": step.METHOD},
        [Section(step.TITLE, step.COLUMNS, rows), Section(step.BESIDE_TITLE, step.COLUMNS, beside_rows)],
    )


def _boxes(config: BenchConfig, path: Path, detector: Detector, console: Console) -> Measured:
    try:
        frames = boxes.frames_of(path, -(-config.frames // 4) if config.quick else config.frames)
    except FormatError as error:
        raise UsageError("--boxes", error.expected, f"{error.field}: {error.actual}") from error
    measured = boxes.measure(frames, detector, config.seed, config.device, config.whole, config.keep_mb)
    costs = list(watched(measured, len(frames), console))
    row = asdict(boxes.BoxesRow.of(costs))
    return Measured(
        {"what": "step boxes", "boxes": row, "frames": _dicts(costs), "method": boxes.METHOD},
        [Section(boxes.TITLE, boxes.COLUMNS, [row])],
    )


def _render(config: BenchConfig, console: Console) -> Measured:
    sizes, usual = render.sizes(*_sizes(config)), render.usual(*_sizes(config))
    verbs = _dicts(render.measure_verbs(usual, _seconds("verbs", config), config.seed, config.device))
    measured = render.measure(sizes, _seconds("render", config), config.seed, config.device)
    rows = _dicts(watched(measured, len(sizes) * len(render.BACKENDS), console))
    return Measured(
        {"rows": rows, "verbs": verbs, "method": render.METHOD},
        [Section(render.TITLE, render.COLUMNS, rows), Section(render.VERBS_TITLE, render.VERB_COLUMNS, verbs)],
    )


def _night(config: BenchConfig, console: Console) -> Measured:
    settings = night.settings_of(config)
    time_frame = night.timer_of(settings)
    names, without, failed = select_frames(open_source(settings), settings)
    count = config.count or len(names)
    chosen = night.spread(names, config.limit or night.FRAMES)
    console.print(
        f"told by {len(chosen)} of {format_count(len(names), 'frame')} with vehicles; {without} without passed over"
    )
    build = partial(night.timer_of, settings)
    asked = run_frame_jobs(chosen, time_frame, build, config, ProgressSettings("frames", show_remaining=True))
    spent = [one for one in asked.results.values() if one is not None]
    night.check_some(spent)
    processes = min(config.processes, len(chosen))
    parts, nights = night.part_rows(spent), night.night_rows(spent, count, processes, config.seed)
    told = {"parts": parts, "nights": nights, "measured": _dicts(spent), "failed": failed | asked.failed}
    return Measured(
        told | {"method": night.METHOD},
        [
            Section(night.PARTS_TITLE, night.PARTS_COLUMNS, parts),
            Section(night.NIGHTS_TITLE, night.NIGHTS_COLUMNS, nights),
        ],
    )


def _sizes(config: BenchConfig) -> tuple[list[int], list[int]]:
    return parse_integers("--cars", config.cars), parse_integers("--triangles", config.triangles)


def _seconds(name: str, config: BenchConfig) -> float:
    return _SECONDS[name][0 if config.quick else 1]


def _dicts(rows: Iterable[Any]) -> list[dict[str, Any]]:
    return [asdict(row) for row in rows]
