"""`drivesem bench WHAT`: figures with method, machine, versions."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from rich.console import Console

from detectors.base import DetectorError
from detectors.registry import SHIPPED, load_detector
from drivesem.bench import derender, detector, evaluation, found, label_free, memory, render, step, synth, tables
from drivesem.bench.scenes import MOST_CARS
from drivesem.bench.timing import machine, versions
from drivesem.settings.commands import Bench
from drivesem.settings.errors import UsageError
from drivesem.settings.values import numbers
from scene_ir import files

T = TypeVar("T")

_LOG_WIDTH = 120
"""Columns of tables that go to a file."""
_SECONDS = {"step": (36.0, 240.0), "render": (22.0, 240.0), "verbs": (6.0, 30.0), "detector": (20.0, 90.0)}
"""Seconds for measuring, with --quick and without; imports and scenes take some more."""


def run(config: Bench) -> int:
    """Measure, print, write; exit code 0. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    cars, triangles = numbers("--cars", config.cars), numbers("--triangles", config.triangles)
    if max(cars) > MOST_CARS:
        raise UsageError("--cars", f"at most {MOST_CARS}", max(cars))
    targets = _targets(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.device != "cpu":
        _check_device(config.device)
    measure: dict[str, Callable[[Bench, list[int], list[int], Console], dict[str, Any]]] = {
        "step": _step,
        "render": _render,
        "memory": _memory,
        "synth": _synth,
        "derender": _derender,
        "found": _found,
        "label-free": _label_free,
        "detector": _detector,
        "eval": _eval,
    }
    console = Console(stderr=True, width=None if sys.stderr.isatty() else _LOG_WIDTH)
    measured = measure[config.what](config, cars, triangles, console)
    result = {
        "what": config.what,
        **measured,
        "machine": machine(config.device),
        "versions": versions(),
        "command": _command(config),
        "seconds": round(time.perf_counter() - start, 3),
    }
    for section in tables.sections(result):
        console.print(tables.terminal(section))
    if targets is not None:
        files.write_json(targets[0], result)
        files.write_text(targets[1], tables.markdown(result))
    if config.markdown is not None:
        tables.rewrite(Path(config.markdown), result)
    if config.json:
        sys.stdout.write(json.dumps(result, allow_nan=False) + "\n")
    return 0


def _step(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    try:
        detector = load_detector(config.detector, config.device)
    except DetectorError as error:
        raise UsageError("--detector", "a detector", error) from error
    sizes, beside = step.cases(cars, triangles)
    rows = list(
        _watched(
            step.measure(sizes + beside, detector, _seconds("step", config), config.seed, config.device),
            len(sizes) + len(beside),
            console,
        )
    )
    return {
        "rows": [asdict(row) for row in rows[: len(sizes)]],
        "beside": [asdict(row) for row in rows[len(sizes) :]],
        "method": step.METHOD,
    }


def _render(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    sizes = render.sizes(cars, triangles)
    verbs = render.measure_verbs(
        render.usual(cars, triangles), _seconds("verbs", config), config.seed, config.device
    )
    verb_rows = [asdict(row) for row in verbs]
    rows = _watched(
        render.measure(sizes, _seconds("render", config), config.seed, config.device),
        len(sizes) * (len(render.BACKENDS) + 1),
        console,
    )
    return {"rows": [asdict(row) for row in rows], "verbs": verb_rows, "method": render.METHOD}


def _memory(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    if not memory.supported():
        raise UsageError("bench memory", "a system with /proc", sys.platform)
    if config.device != "cpu":
        raise UsageError("--device", "cpu (the memory of a GPU is not measured)", config.device)
    case_list = memory.cases(cars, triangles, config.quick)
    rows = _watched(memory.measure(case_list, config.seed, config.detector), len(case_list), console)
    return {"rows": [asdict(row) for row in rows], "method": memory.METHOD}


def _synth(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    if not memory.supported():
        raise UsageError("bench synth", "a system with /proc", sys.platform)
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)
    frames = config.frames or (synth.QUICK_FRAMES if config.quick else synth.FULL_FRAMES)
    workers = config.processes
    measured = list(_watched(synth.measure(frames, config.seed, workers), 3, console))
    return {
        "frames_per_second": measured[0].frames_per_second,
        "peak_rss_mb": measured[0].peak_rss_mb,
        "rows": [asdict(row) for row in measured],
        "method": synth.METHOD,
    }


def _derender(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)
    frames = config.frames
    if frames is None:
        frames = derender.QUICK_FRAMES if config.quick else derender.FULL_FRAMES
    targets = _targets(config)
    sheets = None if targets is None else targets[0].with_suffix("")
    rows = list(
        _watched(derender.measure(frames, config.seed, config.processes, config.ablate, sheets), frames, console)
    )
    return {
        "rows": [asdict(row) for row in rows],
        "summary": derender.summary(rows),
        "method": derender.METHOD,
    }


def _found(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)
    targets = _targets(config)
    sheets = None if targets is None else targets[0].with_suffix("")
    try:
        frames = dict(_watched(found.measure(config, sheets), found.count(config), console))
    except DetectorError as error:
        raise UsageError("--detector", "a detector", error) from error
    rows = [car for name in sorted(frames) for car in frames[name]]
    if sheets is not None:
        found.rank_sheets(rows, sheets)
    return {
        "frames": len(frames),
        "rows": [asdict(row) for row in rows],
        "summary": found.summary(rows),
        "method": found.METHOD,
    }


def _label_free(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)
    total = len(label_free.names(config))
    frames = dict(_watched(label_free.measure(config), total, console))
    ordered = [frames[name] for name in sorted(frames)]
    return {
        "frames": len(frames),
        "rows": [asdict(row) for frame in ordered for row in frame.rows],
        "summary": label_free.summary(ordered),
        "method": label_free.METHOD,
    }


def _detector(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    """All that are shipped, or the one that was asked for."""
    names = sorted(SHIPPED) if config.detector == Bench.detector else [config.detector]
    measured = detector.measure(names, _seconds("detector", config), config.seed, config.device)
    try:
        rows = list(_watched(measured, len(names) * len(detector.SIZES_HW), console))
    except DetectorError as error:
        raise UsageError("--detector", "a detector with gradients", error) from error
    return {"rows": [asdict(row) for row in rows], "method": detector.METHOD}


def _eval(config: Bench, cars: list[int], triangles: list[int], console: Console) -> dict[str, Any]:
    if config.device != "cpu":
        raise UsageError("--device", "cpu", config.device)
    frames = config.frames or (evaluation.QUICK_FRAMES if config.quick else evaluation.FULL_FRAMES)
    rows = list(_watched(evaluation.measure(frames, config.seed), 3, console))
    return {"rows": [asdict(row) for row in rows], "method": evaluation.METHOD}


def _watched(rows: Iterator[T], total: int, console: Console) -> Iterator[T]:
    """The same rows; says how far it has come."""
    with console.status("measuring") as status:
        for done, row in enumerate(rows, start=1):
            status.update(f"measuring: {done} rows of about {total}")
            yield row


_FOUND = ("dataset", "root", "scenes", "tiles", "limit")
"""Settings of bench found."""


def _seconds(name: str, config: Bench) -> float:
    return _SECONDS[name][0 if config.quick else 1]


def _targets(config: Bench) -> tuple[Path, Path] | None:
    """Where JSON and Markdown go: files in the folder `--out`, or FILE.json and FILE.md."""
    if config.out is None:
        return None
    out = Path(config.out)
    if out.suffix == ".json":
        if out.is_dir():
            raise UsageError("--out", "a folder, or a file.json", f"the folder {out}")
        return out, out.with_suffix(".md")
    if out.exists() and not out.is_dir():
        raise UsageError("--out", "a folder, or a file.json", f"the file {out}")
    return out / f"{config.what}.json", out / f"{config.what}.md"


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(
            "--device", "a torch device of this machine", f"{device!r}: {error}".split("\n")[0]
        ) from error


def _command(config: Bench) -> str:
    """The command line that measures this again."""
    default = Bench(what=config.what)
    words = ["drivesem", "bench", config.what, *(["--quick"] if config.quick else [])]
    words += ["--ablate"] if config.ablate else []
    for name in ("cars", "triangles", "frames", "workers", "threads", "detector", "device", "seed", *_FOUND):
        value = getattr(config, name)
        if value != getattr(default, name):
            words += [f"--{name}", str(value)]
    return " ".join(words)
