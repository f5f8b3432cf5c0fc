"""`drivesem bench WHAT`: figures with method, machine, versions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

from detectors.base import Detector, DetectorError
from detectors.registry import load_detector
from drivesem.bench import boxes, night, render, step
from drivesem.bench.scenes import MAX_CARS
from drivesem.bench.session import BenchResult, BenchTable, run_benchmark, show_progress
from drivesem.config.commands import BenchConfig
from drivesem.config.constraints import parse_integers
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import Console, format_count
from drivesem.run.attack import select_frames
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.scenes.sources import open_source
from scene_ir.errors import FormatError

_SECONDS = {"step": (36.0, 240.0), "render": (22.0, 240.0), "verbs": (6.0, 30.0)}
"""Seconds of measuring, with --quick and without; imports and scenes take some more."""


def bench_command(config: BenchConfig) -> int:
    """`drivesem bench`: measure, print, write."""
    cars, _ = _sizes(config)
    if max(cars) > MAX_CARS:
        raise UsageError("--cars", f"at most {MAX_CARS}", max(cars))
    measure: dict[str, Callable[[BenchConfig, Console], BenchResult]] = {
        "step": _step,
        "render": _render,
        "night": _night,
    }
    return run_benchmark(config, "drivesem bench", measure[config.what])


def _step(config: BenchConfig, console: Console) -> BenchResult:
    try:
        detector = load_detector(config.detector, config.device)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    if config.boxes is not None:
        return _boxes(config, Path(config.boxes), detector, console)
    sizes, extra = step.cases(*_sizes(config))
    seconds = _seconds("step", config)
    measured = step.measure(
        sizes + extra, detector, seconds, config.seed, config.device, config.whole, config.keep_mb
    )
    rows = list(show_progress(measured, len(sizes) + len(extra), console))
    rows, extra_rows = rows[: len(sizes)], rows[len(sizes) :]
    return BenchResult(
        {"rows": rows, "extra": extra_rows, "method": step.METHOD},
        [BenchTable(step.TITLE, step.COLUMNS, rows), BenchTable(step.EXTRA_TITLE, step.COLUMNS, extra_rows)],
    )


def _boxes(config: BenchConfig, path: Path, detector: Detector, console: Console) -> BenchResult:
    try:
        frames = boxes.read_labelled_frames(path, -(-config.frames // 4) if config.quick else config.frames)
    except FormatError as error:
        raise UsageError("--boxes", error.expected, f"{error.field}: {error.actual}") from error
    measured = boxes.measure(frames, detector, config.seed, config.device, config.whole, config.keep_mb)
    costs = list(show_progress(measured, len(frames), console))
    row = boxes.summarise(costs)
    return BenchResult(
        {"what": "step boxes", "boxes": row, "frames": costs, "method": boxes.METHOD},
        [BenchTable(boxes.TITLE, boxes.COLUMNS, [row])],
    )


def _render(config: BenchConfig, console: Console) -> BenchResult:
    sizes, default_size = render.sizes(*_sizes(config)), render.default_size(*_sizes(config))
    verbs = list(render.measure_verbs(default_size, _seconds("verbs", config), config.seed, config.device))
    measured = render.measure(sizes, _seconds("render", config), config.seed, config.device)
    rows = list(show_progress(measured, len(sizes) * len(render.BACKENDS), console))
    return BenchResult(
        {"rows": rows, "verbs": verbs, "method": render.METHOD},
        [
            BenchTable(render.TITLE, render.COLUMNS, rows),
            BenchTable(render.VERBS_TITLE, render.VERB_COLUMNS, verbs),
        ],
    )


def _night(config: BenchConfig, console: Console) -> BenchResult:
    settings = night.build_attack_config(config)
    time_frame = night.build_frame_timer(settings)
    names, skipped, failed = select_frames(open_source(settings), settings)
    count = config.count or len(names)
    vehicles = night.count_labelled_vehicles(settings, names)
    chosen = night.pick_evenly(names, config.limit or night.FRAMES, vehicles)
    attack = night.format_attack(settings)
    console.print(f"timing: {attack}", soft_wrap=True)
    console.print(
        f"on {len(chosen)} of {format_count(len(names), 'frame')} with vehicles; {skipped} without vehicles skipped"
    )
    build = partial(night.build_frame_timer, settings)
    timed = run_frame_jobs(chosen, time_frame, build, config, ProgressSettings("frames", show_remaining=True))
    times = [time for time in timed.results.values() if time is not None]
    night.require_frames(times)
    processes = min(config.processes, len(chosen))
    parts, nights = night.part_rows(times, processes), night.night_rows(times, count, processes, config.seed)
    fields = {
        "attack": attack,
        "parts": parts,
        "nights": nights,
        "measured": [asdict(one) for one in times],
        "failed": failed | timed.failed,
    }
    return BenchResult(
        fields | {"method": f"Attack: {attack}. {night.METHOD}"},
        [
            BenchTable(night.PARTS_TITLE, night.PARTS_COLUMNS, parts),
            BenchTable(night.NIGHTS_TITLE, night.NIGHTS_COLUMNS, nights),
        ],
    )


def _sizes(config: BenchConfig) -> tuple[list[int], list[int]]:
    return parse_integers("--cars", config.cars), parse_integers("--triangles", config.triangles)


def _seconds(name: str, config: BenchConfig) -> float:
    return _SECONDS[name][0 if config.quick else 1]
