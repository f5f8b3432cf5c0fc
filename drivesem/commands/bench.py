"""`drivesem bench WHAT`: figures with method, machine, versions."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from detectors.base import Detector, DetectorError
from detectors.registry import SHIPPED, load_detector
from drivesem.attack.space import parse_params
from drivesem.bench import boxes, night, render, step
from drivesem.bench.scenes import MOST_CARS
from drivesem.bench.session import Measured, conduct, watched
from drivesem.bench.tables import Section
from drivesem.config.commands import BenchConfig
from drivesem.config.errors import UsageError
from drivesem.config.values import numbers
from drivesem.report.tables import format_count
from drivesem.report.terminal import Console
from drivesem.run.attack import select_frames
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.scenes.sources import open_source
from scene_ir.errors import FormatError
from tools.bench import climb, detector, memory, scale
from tools.bench.planted import across, across_names, summary, yardstick

_SECONDS_A_PASS = 0.5
"""Of an attack on a frame as large as KITTI's, with its certificates and its share of the frame's survey."""
_PLANTED_FRAMES = 3
"""Frames of `bench planted`, where nobody says how many."""
_SECONDS = {"step": (36.0, 240.0), "render": (22.0, 240.0), "verbs": (6.0, 30.0), "detector": (20.0, 90.0)}
"""Seconds for measuring, with --quick and without; imports and scenes take some more."""


def run(config: BenchConfig) -> int:
    """Measure, print, write; exit code 0. Raises UsageError or SceneError for bad input."""
    cars, _ = _sizes(config)
    if max(cars) > MOST_CARS:
        raise UsageError("--cars", f"at most {MOST_CARS}", max(cars))
    measure: dict[str, Callable[[BenchConfig, Console], Measured]] = {
        "step": _step,
        "render": _render,
        "memory": _memory,
        "detector": _detector,
        "climb": _climb,
        "planted": _planted,
        "night": _night,
        "scale": _scale,
    }
    return conduct(config, "drivesem bench", measure[config.what])


def _step(config: BenchConfig, console: Console) -> Measured:
    try:
        detector = load_detector(config.detector, config.device)
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
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


def _memory(config: BenchConfig, console: Console) -> Measured:
    if not memory.supported():
        raise UsageError("bench memory", "a system with /proc", sys.platform)
    if config.device != "cpu":
        raise UsageError("--device", "cpu (the memory of a GPU is not measured)", config.device)
    cases = memory.cases(*_sizes(config), config.quick)
    rows = _dicts(watched(memory.measure(cases, config.seed, config.detector), len(cases), console))
    return Measured({"rows": rows, "method": memory.METHOD}, [Section(memory.TITLE, memory.COLUMNS, rows)])


def _detector(config: BenchConfig, console: Console) -> Measured:
    """All that are shipped, or the one that was asked for."""
    names = sorted(SHIPPED) if config.detector == BenchConfig.detector else [config.detector]
    measured = detector.measure(names, _seconds("detector", config), config.seed, config.device)
    try:
        rows = _dicts(watched(measured, len(names) * len(detector.SIZES_HW), console))
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector with gradients", error) from error
    return Measured({"rows": rows, "method": detector.METHOD}, [Section(detector.TITLE, detector.COLUMNS, rows)])


def _climb(config: BenchConfig, console: Console) -> Measured:
    if config.device != "cpu":
        raise UsageError("--device", "cpu (the processor's time is measured)", config.device)
    try:
        detectors = {
            name: load_detector(config.detector, gradient_precision=dtype)
            for name, dtype in climb.PRECISIONS.items()
        }
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector with gradients", error) from error
    cars, params = _sizes(config)[0], parse_params(config.params)
    measured = climb.measure(cars, params, config.passes, 4 if config.quick else 20, detectors, config.seed)
    rows = _dicts(watched(measured, len(cars) * len(detectors), console))
    return Measured({"rows": rows, "method": climb.METHOD}, [Section(climb.TITLE, climb.COLUMNS, rows)])


def _planted(config: BenchConfig, console: Console) -> Measured:
    return _planted_in_frames(config, console) if config.across is None else _planted_across(config, console)


def _planted_across(config: BenchConfig, console: Console) -> Measured:
    config = replace(config, limit=config.limit or _PLANTED_FRAMES)
    first = across.Across.of(config)
    names, _, failed = select_frames(first.source, config)
    pooling = run_frame_jobs(
        names, first.pool, partial(across.pool_of, config), config, ProgressSettings("states", show_remaining=True)
    )
    pools = [pooling.results[name] for name in names if name in pooling.results]
    kinds = across.KINDS[1::8] if config.quick else across.KINDS
    kinds = [(kind, nth) for nth in range(config.each) for kind in kinds]
    planted = [across.plant_across(pools, kind, config.seed, nth) for kind, nth in kinds]
    faults = [one for one in planted if one is not None]
    console.print(f"{len(faults)} of {len(kinds)} faults could be planted")
    texts = tuple(one.fault.text for one in faults)
    second, frames = across.Across.of(config, texts), list(enumerate(pool.frame for pool in pools))
    frames = frames[: config.searched]
    build = partial(across.judge_of, config, texts)
    asked = run_frame_jobs(
        frames, second.judge, build, config, ProgressSettings("searches", show_remaining=True), lambda job: job[1]
    )
    judged = [asked.results[job] for job in frames if job in asked.results]
    rows = across_names.rows_of(faults, pools, judged, tuple(first.workers) if frames else ())
    told, summed = [row.to_json() for row in rows], across_names.summary_rows(rows)
    summed += across_names.chance_rows(pools, config.seed, across_names.SHAMS)
    return Measured(
        {
            "rows": told,
            "summary": summed,
            "unplanted": ["+".join(kind) for (kind, _), one in zip(kinds, planted, strict=True) if one is None],
            "failed": failed | pooling.failed | asked.failed,
            "method": across_names.METHOD,
        },
        [
            Section(across_names.TITLE, across_names.COLUMNS, told),
            Section(across_names.SUMMARY_TITLE, across_names.SUMMARY_COLUMNS, summed),
        ],
    )


def _planted_in_frames(config: BenchConfig, console: Console) -> Measured:
    config = replace(config, limit=config.limit or _PLANTED_FRAMES)
    judge = yardstick.Yardstick.of(config)
    names, _, failed = select_frames(next(iter(judge.workers.values())).source, config)
    methods = yardstick.methods_of(config)
    sought = min(config.faults or len(judge.kinds), len(judge.kinds))
    count = len(names) * (sought * len(methods) + len(judge.named))  # named ones once more without a fault
    console.print(
        f"{format_count(count, 'attack')} of {format_count(config.passes, 'pass', 'passes')}: "
        f"about {_minutes(count * config.passes)}"
    )
    asked = run_frame_jobs(
        names,
        judge.judge,
        partial(yardstick.judge_of, config),
        config,
        ProgressSettings("frames", show_remaining=True),
    )
    judged = [asked.results[name] for name in names if name in asked.results]
    rows, kinds = summary.rows_of(judged, methods, config.seed), summary.kind_rows(judged, methods)
    return Measured(
        {
            "rows": rows,
            "kinds": kinds,
            "attempts": [asdict(attempt) for frame in judged for attempt in frame.attempts],
            "failed": failed | asked.failed,
            "method": summary.METHOD,
        },
        [
            Section(summary.TITLE, summary.COLUMNS, rows),
            Section(summary.KINDS_TITLE, summary.kind_columns(methods), kinds),
        ],
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


def _scale(config: BenchConfig, console: Console) -> Measured:
    rows = _dicts(watched(scale.measure(config), 2, console))
    return Measured({"rows": rows, "method": scale.METHOD}, [Section(scale.TITLE, scale.COLUMNS, rows)])


def _minutes(passes: int) -> str:
    return f"{passes * _SECONDS_A_PASS / 60:.0f} min of one core"


def _sizes(config: BenchConfig) -> tuple[list[int], list[int]]:
    return numbers("--cars", config.cars), numbers("--triangles", config.triangles)


def _seconds(name: str, config: BenchConfig) -> float:
    return _SECONDS[name][0 if config.quick else 1]


def _dicts(rows: Iterable[Any]) -> list[dict[str, Any]]:
    return [asdict(row) for row in rows]
