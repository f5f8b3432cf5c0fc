"""Benchmarks for maintainers: `python -m tools.bench NAME [options]`, from the repository's root.

Each prints its tables, with method, machine and versions, and writes its section of docs/benchmarks.md with
`--markdown`, as `drivesem bench` does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from detectors.base import DetectorError
from detectors.registry import load_predictor
from drivesem.bench import render
from drivesem.bench.scenes import MOST_CARS
from drivesem.bench.session import Measured, conduct, targets_of, watched
from drivesem.bench.tables import Section
from drivesem.config.errors import UsageError
from drivesem.config.values import numbers
from drivesem.run.allocation import keep_freed
from scene_ir.derender.derender import DerenderSettings
from scene_ir.errors import SceneError
from tools.bench import (
    depth,
    derender,
    devices,
    evaluation,
    foliage,
    found,
    install,
    label_free,
    memory,
    moves,
    parts,
    redraw,
    rivals,
    synth,
    viewer,
    weather,
)
from tools.bench.settings import BenchTool

_PROGRAM = "python -m tools.bench"
_RIVAL_SECONDS = (16.0, 180.0)
"""Seconds for measuring renderers, with --quick and without; imports and scenes take some more."""
_EXIT_BAD_INPUT = 2


def main(argv: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0 done, 2 bad input, which one line tells."""
    config = tyro.cli(BenchTool, prog=_PROGRAM, args=argv)
    keep_freed()
    try:
        return run(config)
    except (UsageError, SceneError, DetectorError, OSError) as error:
        sys.stderr.write(f"{_PROGRAM}: {' '.join(str(error).split())}\n")
        return _EXIT_BAD_INPUT


def run(config: BenchTool) -> int:
    """Measure, print, write; exit code 0. Raises UsageError, SceneError or DetectorError for bad input."""
    config.check()
    measure: dict[str, Callable[[BenchTool, Console], Measured]] = {
        "derender": _derender,
        "parts": _parts,
        "depth": _depth,
        "found": _found,
        "label-free": _label_free,
        "moves": _moves,
        "redraw": _redraw,
        "weather": _weather,
        "foliage": _foliage,
        "synth": _synth,
        "rivals": _rivals,
        "devices": _devices,
        "eval": _eval,
        "viewer": _viewer,
        "install": _install,
    }
    return conduct(config, _PROGRAM, measure[config.what])


def _derender(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    frames = _frames(config, derender)
    settings = DerenderSettings.fast() if config.fast else DerenderSettings()
    measured = derender.measure(frames, config.seed, config.processes, config.ablate, _sheets(config), settings)
    rows = list(watched(measured, frames, console))
    fields = {"rows": [asdict(row) for row in rows], "summary": derender.summary(rows)}
    return _measured(derender, fields)


def _parts(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    rows = list(watched(parts.measure(config), len(label_free.names(config)), console))
    return _measured(parts, {"rows": [asdict(row) for row in rows], "summary": parts.summary(rows)})


def _depth(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    frames = _frames(config, depth)
    measured = depth.measure(config, frames, _sheets(config))
    rows = [row for found in watched(measured, depth.count(config, frames), console) for row in found]
    return _measured(depth, {"rows": [asdict(row) for row in rows], "summary": depth.summary(rows)})


def _found(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    sheets = _sheets(config)
    try:
        frames = dict(watched(found.measure(config, sheets), found.count(config), console))
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    rows = [car for name in sorted(frames) for car in frames[name]]
    if sheets is not None:
        found.rank_sheets(rows, sheets)
    fields = {"frames": len(frames), "rows": [asdict(row) for row in rows], "summary": found.summary(rows)}
    return _measured(found, fields)


def _redraw(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    try:
        frames = dict(watched(redraw.measure(config, _sheets(config)), found.count(config), console))
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    rows = [frames[name] for name in sorted(frames)]
    fields = {"frames": len(rows), "rows": [asdict(row) for row in rows], "summary": redraw.summary(rows)}
    return _measured(redraw, fields)


def _weather(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    frames = _frames(config, weather)
    try:
        measured = weather.measure(config, frames, _sheets(config))
        rows = [row for found in watched(measured, frames, console) for row in found]
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    return _measured(weather, {"rows": [asdict(row) for row in rows], "summary": weather.summary(rows)})


def _foliage(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    frames = _frames(config, foliage)
    measured = foliage.measure(frames, _sheets(config))
    rows = [row for found in watched(measured, frames, console) for row in found]
    return _measured(foliage, {"rows": [asdict(row) for row in rows], "summary": foliage.summary(rows)})


def _devices(config: BenchTool, console: Console) -> Measured:
    frames = _frames(config, devices)
    measured = devices.measure(frames, config.detector, config.device)
    rows = [row for found in watched(measured, frames, console) for row in found]
    return _measured(devices, {"rows": [asdict(row) for row in rows], "summary": devices.summary(rows)})


def _label_free(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    frames = dict(watched(label_free.measure(config), len(label_free.names(config)), console))
    ordered = [frames[name] for name in sorted(frames)]
    rows = [asdict(row) for frame in ordered for row in frame.rows]
    fields = {"frames": len(frames), "rows": rows, "summary": label_free.summary(ordered)}
    return _measured(label_free, fields)


def _moves(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    frames = _frames(config, moves)
    try:
        measured = watched(moves.measure(config, frames, _sheets(config)), frames, console)
        rows = [row for found in measured for row in found]
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    return _measured(moves, {"rows": [asdict(row) for row in rows], "summary": moves.summary(rows)})


def _synth(config: BenchTool, console: Console) -> Measured:
    if not memory.supported():
        raise UsageError("bench synth", "a system with /proc", sys.platform)
    _on_cpu(config)
    rows = list(watched(synth.measure(_frames(config, synth), config.seed, config.processes), 3, console))
    first = {"frames_per_second": rows[0].frames_per_second, "peak_rss_mb": rows[0].peak_rss_mb}
    return _measured(synth, {**first, "rows": [asdict(row) for row in rows]})


def _rivals(config: BenchTool, console: Console) -> Measured:
    cars = numbers("--cars", config.cars)
    if max(cars) > MOST_CARS:
        raise UsageError("--cars", f"at most {MOST_CARS}", max(cars))
    sizes = render.sizes(cars, numbers("--triangles", config.triangles))
    measured = rivals.measure(sizes, _RIVAL_SECONDS[0 if config.quick else 1], config.seed, config.device)
    return _measured(rivals, {"rows": [asdict(row) for row in watched(measured, 2 * len(sizes), console)]})


def _eval(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    rows = watched(evaluation.measure(_frames(config, evaluation), config.seed), 3, console)
    return _measured(evaluation, {"rows": [asdict(row) for row in rows]})


def _viewer(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    scene = None if config.scenes is None else Path(config.scenes)
    states = viewer.QUICK_STATES if config.quick else viewer.FULL_STATES
    try:
        detector = load_predictor(config.detector, config.device, config.tiles)
        rows = list(watched(viewer.measure(scene, detector, states, config.seed), 8, console))
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    return _measured(viewer, {"rows": [asdict(row) for row in rows]})


def _install(config: BenchTool, console: Console) -> Measured:
    _on_cpu(config)
    rows = list(watched(install.measure(config.quick), 20, console))
    parts = (
        (install.STEPS_TITLE, install.STEPS, install.StepRow),
        (install.SIZES_TITLE, install.SIZES, install.SizeRow),
        (install.STARTS_TITLE, install.STARTS, install.StartRow),
    )
    of_kind = [
        (title, columns, [asdict(row) for row in rows if isinstance(row, kind)]) for title, columns, kind in parts
    ]
    sections = [Section(title, columns, told) for title, columns, told in of_kind if told]
    names = ("steps", "sizes", "starts")
    fields = {name: told for name, (_, _, told) in zip(names, of_kind, strict=True)}
    return Measured({**fields, "method": install.METHOD}, sections)


def _measured(benchmark: Any, fields: dict[str, Any]) -> Measured:
    """What a benchmark, one of the modules here, found; its table shows the summary, where there is one."""
    rows = fields.get("summary", fields["rows"])
    return Measured({**fields, "method": benchmark.METHOD}, [Section(benchmark.TITLE, benchmark.COLUMNS, rows)])


def _on_cpu(config: BenchTool) -> None:
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)


def _frames(config: BenchTool, benchmark: Any) -> int:
    return config.frames or (benchmark.QUICK_FRAMES if config.quick else benchmark.FULL_FRAMES)


def _sheets(config: BenchTool) -> Path | None:
    """The folder for pictures, beside the results."""
    targets = targets_of(config)
    return None if targets is None else targets[0].with_suffix("")


if __name__ == "__main__":
    raise SystemExit(main())
