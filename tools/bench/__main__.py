"""Benchmarks for maintainers: `python -m tools.bench NAME [options]`, from the repository's root.

Each prints its tables, with method, machine and versions, and writes its section of docs/research/benchmarks.md with
`--markdown`, as `drivesem bench` does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from detectors.base import DetectorError
from detectors.registry import SHIPPED, load_detector, load_predictor
from drivesem import __version__
from drivesem.analysis.transfer import parse_detector_names
from drivesem.attacks.space import parse_params
from drivesem.bench import render
from drivesem.bench.scenes import MAX_CARS
from drivesem.bench.session import BenchResult, BenchTable, output_paths, run_benchmark, show_progress
from drivesem.config.constraints import parse_integers
from drivesem.config.errors import UsageError
from drivesem.config.options import CommandConfig
from drivesem.program import Program
from drivesem.reporting.tables import Console, format_count
from drivesem.run.attack import select_frames
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from scene_ir.derender.derender import DerenderSettings
from tools.bench import (
    climb,
    conditions,
    depth,
    derender,
    devices,
    evaluation,
    foliage,
    found,
    gradcheck,
    install,
    label_free,
    memory,
    moves,
    parts,
    people,
    redraw,
    rivals,
    scale,
    synth,
    viewer,
    weather,
)
from tools.bench import detector as detectors
from tools.bench.planted import across, across_report, summary, yardstick
from tools.bench.settings import BenchTool, ConditionsConfig, DetectorBenchConfig, GradcheckConfig

_PROGRAM = "python -m tools.bench"
_RIVAL_SECONDS = (16.0, 180.0)
"""Seconds for measuring renderers, with and without --quick, excluding imports and scenes."""
_DETECTOR_SECONDS = (20.0, 90.0)
"""Seconds for measuring detectors, with and without --quick."""
_SECONDS_A_PASS = 0.5
"""Estimated seconds per detector pass of an attack on a frame of KITTI's size, certificates included."""
_PLANTED_FRAMES = 3
"""Frames of `bench planted` without --limit."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark. Returns the exit code: 0 done, 1 a check failed, 2 bad input."""
    summary = "Benchmarks for maintainers."
    return Program(_PROGRAM, __version__, summary, BENCHMARKS, _load_benchmark).main(argv)


def _load_benchmark(name: str) -> Callable[[Any], int]:
    return gradcheck.run if name == "gradcheck" else partial(_run, _MEASURES[name])


def _conditions(config: ConditionsConfig, console: Console) -> BenchResult:
    detectors_of_recall = conditions.load_detectors(config.detectors, config.tiles) if config.recall else []
    frames, notes = conditions.collect_frames(config)
    console.print(f"{format_count(len(frames), 'frame')}, real ones of half {config.half}")
    for note in notes:
        console.print(note)
    judged = [frame for frame in frames if frame.condition != conditions.DAY]
    rows = list(show_progress(conditions.measure(config, judged), len(judged), console))
    fields: dict[str, Any] = {
        "half": config.half,
        "notes": notes,
        "rows": conditions.measure_rows(rows, config.bootstrap, config.seed),
        "joint": conditions.joint_rows(rows),
        "probe": conditions.probe_rows(rows, config.bootstrap, config.seed),
    }
    if config.recall:
        frames = [frame for frame in frames if frame.condition != conditions.JOINT]
        detected = conditions.detect_frames(config, detectors_of_recall, frames)
        hits = list(show_progress(detected, len(frames) * len(detectors_of_recall), console))
        fields["recall"] = conditions.recall_rows(hits, config.bootstrap, config.seed)
    conditions.write_sheets(judged, Path(config.out or ""))
    return BenchResult({**fields, "method": conditions.METHOD}, conditions.tables(config.half, fields))


def _run(
    measure: Callable[[Any, Console], BenchResult], config: BenchTool | ConditionsConfig | DetectorBenchConfig
) -> int:
    """Measure, print, write; exit code 0. Raises UsageError, SceneError or DetectorError for bad input."""
    if not isinstance(config, ConditionsConfig) and max(parse_integers("--cars", config.cars)) > MAX_CARS:
        raise UsageError("--cars", f"at most {MAX_CARS}", max(parse_integers("--cars", config.cars)))
    return run_benchmark(config, _PROGRAM, measure)


def _derender(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    frames = _frames(config, derender)
    settings = DerenderSettings.fast() if config.fast else DerenderSettings()
    measured = derender.measure(frames, config.seed, config.processes, config.ablate, _sheets(config), settings)
    rows = list(show_progress(measured, frames, console))
    fields = {"rows": [asdict(row) for row in rows], "summary": derender.summary(rows)}
    return _measured(derender, fields)


def _parts(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    rows = list(show_progress(parts.measure(config), len(label_free.names(config)), console))
    return _measured(parts, {"rows": [asdict(row) for row in rows], "summary": parts.summary(rows)})


def _depth(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    frames = _frames(config, depth)
    measured = depth.measure(config, frames, _sheets(config))
    rows = [row for found in show_progress(measured, depth.count(config, frames), console) for row in found]
    return _measured(depth, {"rows": [asdict(row) for row in rows], "summary": depth.summary(rows)})


def _found(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    sheets = _sheets(config)
    try:
        frames = dict(show_progress(found.measure(config, sheets), found.count(config), console))
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    rows = [car for name in sorted(frames) for car in frames[name]]
    if sheets is not None:
        found.rank_sheets(rows, sheets)
    fields = {"frames": len(frames), "rows": [asdict(row) for row in rows], "summary": found.summary(rows)}
    return _measured(found, fields)


def _redraw(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    try:
        frames = dict(show_progress(redraw.measure(config, _sheets(config)), found.count(config), console))
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    rows = [frames[name] for name in sorted(frames)]
    fields = {"frames": len(rows), "rows": [asdict(row) for row in rows], "summary": redraw.summary(rows)}
    return _measured(redraw, fields)


def _weather(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    frames = _frames(config, weather)
    try:
        measured = weather.measure(config, frames, _sheets(config))
        rows = [row for found in show_progress(measured, frames, console) for row in found]
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    return _measured(weather, {"rows": [asdict(row) for row in rows], "summary": weather.summary(rows)})


def _foliage(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    frames = _frames(config, foliage)
    measured = foliage.measure(frames, _sheets(config))
    rows = [row for found in show_progress(measured, frames, console) for row in found]
    return _measured(foliage, {"rows": [asdict(row) for row in rows], "summary": foliage.summary(rows)})


def _devices(config: BenchTool, console: Console) -> BenchResult:
    frames = _frames(config, devices)
    measured = devices.measure(frames, config.detector, config.device)
    rows = [row for found in show_progress(measured, frames, console) for row in found]
    return _measured(devices, {"rows": [asdict(row) for row in rows], "summary": devices.summary(rows)})


def _label_free(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    frames = dict(show_progress(label_free.measure(config), len(label_free.names(config)), console))
    ordered = [frames[name] for name in sorted(frames)]
    rows = [asdict(row) for frame in ordered for row in frame.rows]
    fields = {"frames": len(frames), "rows": rows, "summary": label_free.summary(ordered)}
    return _measured(label_free, fields)


def _moves(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    frames = _frames(config, moves)
    try:
        measured = show_progress(moves.measure(config, frames, _sheets(config)), frames, console)
        rows = [row for found in measured for row in found]
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    return _measured(moves, {"rows": [asdict(row) for row in rows], "summary": moves.summary(rows)})


def _people(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    rows: list[people.PersonRow] = []
    try:
        for frame in people.measure(config, _sheets(config)):
            rows += frame
            console.print(f"{frame[0].frame}: {format_count(len(frame), 'person', 'people')}")
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    figures, generator = people.summary(rows), people.compare_with_generator(rows)
    tables = [BenchTable(people.TITLE, people.COLUMNS, figures)]
    if generator:
        tables.append(BenchTable(people.GENERATOR_TITLE, people.GENERATOR_COLUMNS, generator))
    fields = {"rows": [asdict(row) for row in rows], "summary": figures, "generator": generator}
    return BenchResult({**fields, "method": people.METHOD}, tables)


def _synth(config: BenchTool, console: Console) -> BenchResult:
    if not memory.supported():
        raise UsageError("bench synth", "a system with /proc", sys.platform)
    _on_cpu(config)
    rows = list(show_progress(synth.measure(_frames(config, synth), config.seed, config.processes), 3, console))
    first = {"frames_per_second": rows[0].frames_per_second, "peak_rss_mb": rows[0].peak_rss_mb}
    return _measured(synth, {**first, "rows": [asdict(row) for row in rows]})


def _rivals(config: BenchTool, console: Console) -> BenchResult:
    sizes = render.sizes(parse_integers("--cars", config.cars), parse_integers("--triangles", config.triangles))
    measured = rivals.measure(sizes, _RIVAL_SECONDS[0 if config.quick else 1], config.seed, config.device)
    return _measured(rivals, {"rows": [asdict(row) for row in show_progress(measured, 2 * len(sizes), console)]})


def _eval(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    rows = show_progress(evaluation.measure(_frames(config, evaluation), config.seed), 3, console)
    return _measured(evaluation, {"rows": [asdict(row) for row in rows]})


def _viewer(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    scene = None if config.scenes is None else Path(config.scenes)
    states = viewer.QUICK_STATES if config.quick else viewer.FULL_STATES
    try:
        detector = load_predictor(config.detector, config.device, config.tiles)
        rows = list(show_progress(viewer.measure(scene, detector, states, config.seed), 8, console))
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    return _measured(viewer, {"rows": [asdict(row) for row in rows]})


def _install(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    rows = list(show_progress(install.measure(config.quick), 20, console))
    parts = (
        (install.STEPS_TITLE, install.STEPS, install.InstallStepRow),
        (install.SIZES_TITLE, install.SIZES, install.SizeRow),
        (install.STARTS_TITLE, install.STARTS, install.StartRow),
    )
    of_kind = [
        (title, columns, [asdict(row) for row in rows if isinstance(row, kind)]) for title, columns, kind in parts
    ]
    sections = [BenchTable(title, columns, table_rows) for title, columns, table_rows in of_kind if table_rows]
    names = ("steps", "sizes", "starts")
    fields = {name: table_rows for name, (_, _, table_rows) in zip(names, of_kind, strict=True)}
    return BenchResult({**fields, "method": install.METHOD}, sections)


def _paths(config: BenchTool, console: Console) -> BenchResult:
    _on_cpu(config)
    detectors = parse_detector_names(config.detector, "--detector")
    rows = [asdict(row) for row in show_progress(install.measure_paths(detectors), len(detectors), console)]
    table = BenchTable(install.PATHS_TITLE, install.PATHS, rows)
    return BenchResult({"rows": rows, "method": install.PATHS_METHOD}, [table])


def _memory(config: DetectorBenchConfig, console: Console) -> BenchResult:
    if not memory.supported():
        raise UsageError("bench memory", "a system with /proc", sys.platform)
    if config.device != "cpu":
        raise UsageError("--device", "cpu (the memory of a GPU is not measured)", config.device)
    cases = memory.cases(
        parse_integers("--cars", config.cars), parse_integers("--triangles", config.triangles), config.quick
    )
    rows = _dicts(show_progress(memory.measure(cases, config.seed, config.detector), len(cases), console))
    return BenchResult({"rows": rows, "method": memory.METHOD}, [BenchTable(memory.TITLE, memory.COLUMNS, rows)])


def _detector(config: DetectorBenchConfig, console: Console) -> BenchResult:
    """Measure all shipped detectors, or the one of --detector."""
    names = sorted(SHIPPED) if config.detector == DetectorBenchConfig.detector else [config.detector]
    measured = detectors.measure(names, _DETECTOR_SECONDS[0 if config.quick else 1], config.seed, config.device)
    try:
        rows = _dicts(show_progress(measured, len(names) * len(detectors.SIZES_HW), console))
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector with gradients", error) from error
    return BenchResult(
        {"rows": rows, "method": detectors.METHOD}, [BenchTable(detectors.TITLE, detectors.COLUMNS, rows)]
    )


def _climb(config: DetectorBenchConfig, console: Console) -> BenchResult:
    if config.device != "cpu":
        raise UsageError("--device", "cpu (the processor's time is measured)", config.device)
    try:
        by_precision = {
            name: load_detector(config.detector, gradient_precision=dtype)
            for name, dtype in climb.PRECISIONS.items()
        }
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector with gradients", error) from error
    cars, params = parse_integers("--cars", config.cars), parse_params(config.params)
    measured = climb.measure(cars, params, config.passes, 4 if config.quick else 20, by_precision, config.seed)
    rows = _dicts(show_progress(measured, len(cars) * len(by_precision), console))
    return BenchResult({"rows": rows, "method": climb.METHOD}, [BenchTable(climb.TITLE, climb.COLUMNS, rows)])


def _planted(config: DetectorBenchConfig, console: Console) -> BenchResult:
    return _planted_in_frames(config, console) if config.across is None else _planted_across(config, console)


def _planted_across(config: DetectorBenchConfig, console: Console) -> BenchResult:
    config = replace(config, limit=config.limit or _PLANTED_FRAMES)
    first = across.SharedFaultBench.of(config)
    names, _, failed = select_frames(first.source, config)
    pooling = run_frame_jobs(
        names,
        first.pool,
        partial(across.build_pool_worker, config),
        config,
        ProgressSettings("states", show_remaining=True),
    )
    pools = [pooling.results[name] for name in names if name in pooling.results]
    kinds = across.KINDS[1::8] if config.quick else across.KINDS
    kinds = [(kind, nth) for nth in range(config.each) for kind in kinds]
    planted = [across.plant_shared_fault(pools, kind, config.seed, nth, config.rarity) for kind, nth in kinds]
    faults = [one for one in planted if one is not None]
    console.print(f"{len(faults)} of {len(kinds)} faults could be planted")
    texts = tuple(one.fault.text for one in faults)
    second, frames = across.SharedFaultBench.of(config, texts), list(enumerate(pool.frame for pool in pools))
    frames = frames[: config.searched]
    build = partial(across.judge_of, config, texts)
    searching = run_frame_jobs(
        frames, second.judge, build, config, ProgressSettings("searches", show_remaining=True), lambda job: job[1]
    )
    judged = [searching.results[job] for job in frames if job in searching.results]
    rows = across_report.rule_rows(faults, pools, judged, tuple(first.workers) if frames else ())
    rule_rows, summed = [row.to_json() for row in rows], across_report.summary_rows(rows)
    summed += across_report.chance_rows(pools, config.seed, across_report.CHANCE_DETECTORS)
    found = across_report.found_rows(judged, tuple(first.workers), config.seed) if frames else []
    return BenchResult(
        {
            "rows": rule_rows,
            "summary": summed,
            "found": found,
            "unplanted": ["+".join(kind) for (kind, _), one in zip(kinds, planted, strict=True) if one is None],
            "failed": failed | pooling.failed | searching.failed,
            "method": across_report.METHOD,
        },
        [
            BenchTable(across_report.TITLE, across_report.COLUMNS, rule_rows),
            BenchTable(across_report.SUMMARY_TITLE, across_report.SUMMARY_COLUMNS, summed),
            BenchTable(across_report.FOUND_TITLE, across_report.FOUND_COLUMNS, found),
        ],
    )


def _planted_in_frames(config: DetectorBenchConfig, console: Console) -> BenchResult:
    config = replace(config, limit=config.limit or _PLANTED_FRAMES)
    judge = yardstick.PlantedFaultBench.of(config)
    names, _, failed = select_frames(next(iter(judge.workers.values())).source, config)
    methods = yardstick.chosen_methods(config)
    sought = min(config.faults or len(judge.kinds), len(judge.kinds))
    count = len(names) * (sought * len(methods) + len(judge.named))  # named ones once more without a fault
    console.print(
        f"{format_count(count, 'attack')} of {format_count(config.passes, 'pass', 'passes')}: "
        f"about {_minutes(count * config.passes)}"
    )
    searching = run_frame_jobs(
        names,
        judge.judge,
        partial(yardstick.judge_of, config),
        config,
        ProgressSettings("frames", show_remaining=True),
    )
    judged = [searching.results[name] for name in names if name in searching.results]
    rows, kinds = summary.method_rows(judged, methods, config.seed), summary.kind_rows(judged, methods)
    return BenchResult(
        {
            "rows": rows,
            "kinds": kinds,
            "attempts": [asdict(attempt) for frame in judged for attempt in frame.attempts],
            "failed": failed | searching.failed,
            "method": summary.METHOD,
        },
        [
            BenchTable(summary.TITLE, summary.COLUMNS, rows),
            BenchTable(summary.KINDS_TITLE, summary.kind_columns(methods), kinds),
        ],
    )


def _scale(config: DetectorBenchConfig, console: Console) -> BenchResult:
    rows = _dicts(show_progress(scale.measure(config), 2, console))
    return BenchResult({"rows": rows, "method": scale.METHOD}, [BenchTable(scale.TITLE, scale.COLUMNS, rows)])


def _minutes(passes: int) -> str:
    return f"{passes * _SECONDS_A_PASS / 60:.0f} min of one core"


def _dicts(rows: Iterable[Any]) -> list[dict[str, Any]]:
    return [asdict(row) for row in rows]


def _measured(benchmark: Any, fields: dict[str, Any]) -> BenchResult:
    """Build the result of a benchmark module; its table shows the summary, if there is one."""
    rows = fields.get("summary", fields["rows"])
    return BenchResult(
        {**fields, "method": benchmark.METHOD}, [BenchTable(benchmark.TITLE, benchmark.COLUMNS, rows)]
    )


def _on_cpu(config: BenchTool) -> None:
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)


def _frames(config: BenchTool, benchmark: Any) -> int:
    return config.frames or (benchmark.QUICK_FRAMES if config.quick else benchmark.FULL_FRAMES)


def _sheets(config: BenchTool) -> Path | None:
    """Folder of the pictures, in the folder of the results; None without results on disk."""
    targets = output_paths(config)
    return None if targets is None else targets[0].with_suffix("")


_MEASURES: dict[str, Callable[[Any, Console], BenchResult]] = {
    "derender": _derender,
    "parts": _parts,
    "depth": _depth,
    "found": _found,
    "label-free": _label_free,
    "moves": _moves,
    "people": _people,
    "redraw": _redraw,
    "weather": _weather,
    "foliage": _foliage,
    "synth": _synth,
    "rivals": _rivals,
    "devices": _devices,
    "eval": _eval,
    "viewer": _viewer,
    "install": _install,
    "paths": _paths,
    "memory": _memory,
    "detector": _detector,
    "climb": _climb,
    "conditions": _conditions,
    "planted": _planted,
    "scale": _scale,
}
BENCHMARKS: dict[str, type[CommandConfig]] = {
    "gradcheck": GradcheckConfig,
    **dict.fromkeys(_MEASURES, BenchTool),
    "conditions": ConditionsConfig,
    **dict.fromkeys(("memory", "detector", "climb", "planted", "scale"), DetectorBenchConfig),
}
"""Settings of each benchmark."""

if __name__ == "__main__":
    raise SystemExit(main())
