"""`drivesem gradcheck`: the gradients that attacks follow against central differences, scene by scene."""

from __future__ import annotations

import importlib.metadata
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from detectors.base import DetectorError
from detectors.registry import load_detector
from detectors.squeezedet import SqueezeDet
from drivesem.attack.space import SIX, Parameter, StepSizes
from drivesem.config.commands import GradcheckConfig
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.run.attack import select_frames
from drivesem.run.driver import ProgressSettings, print_output_folder, run_frame_jobs
from drivesem.scenes.sources import SceneSource, open_source
from scene_ir import files
from scene_ir.raster.verbs import Backend
from tools.bench.gradcheck import (
    FUNCTIONALS,
    LOSS,
    POINTS,
    TERM,
    Differences,
    GradcheckRow,
    Gradients,
    Point,
    SceneCheck,
    rows_of,
    worst,
)
from tools.bench.reach.agreement import rows_of as rows_of_reach
from tools.bench.reach.frames import ReachWorker, measure_of
from tools.bench.reach.report import answer_of as reach_answer

_DEFAULT_SCENES = 1
_FILE_WIDTH = 120
"""Characters a line of the table where it goes to a file and not to a terminal."""
_PACKAGES = ("drivesem", "torch", "kornia", "numpy", "warp-lang")


def run(config: GradcheckConfig) -> int:
    """Check the scenes asked for; exit code 0 where all is inside the tolerance, 1 where something is not.

    Raises UsageError or SceneError for bad input.
    """
    if config.reach:
        return _reach(config)
    start = time.perf_counter()
    worker = GradcheckWorker(config)
    names, _, unreadable = select_frames(worker.source, replace(config, limit=config.limit or _DEFAULT_SCENES))
    if not names:
        raise UsageError("gradcheck", "at least one frame with vehicles", "none")
    scenes, failed = _check_all(worker, names)
    failed = unreadable | failed
    rows = worst(row for found in scenes.values() for row in found)
    passed = bool(rows) and all(row.passes(config.min_cosine, config.max_error) for row in rows)
    summary = {
        "rows": [asdict(row) for row in rows],
        "passed": passed,
        "tolerance": {"cosine": config.min_cosine, "relative_error": config.max_error},
        "scenes": {name: [asdict(row) for row in found] for name, found in scenes.items()},
        "frames_failed": dict(sorted(failed.items())),
        "settings": {
            "dataset": config.dataset,
            "detector": config.detector,
            "term": TERM,
            "seed": config.seed,
            "directions": config.directions,
            "functionals": FUNCTIONALS,
        },
        "versions": {package: importlib.metadata.version(package) for package in _PACKAGES},
        "seconds": round(time.perf_counter() - start, 3),
    }
    if config.out:
        files.write_json(Path(config.out) / "gradcheck.json", summary)
    if config.json:
        print_json(summary)
    else:
        console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
        _print(rows, config, console, len(scenes))
        for name, reason in failed.items():
            console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    return 0 if passed else 1


def _reach(config: GradcheckConfig) -> int:
    """How far gradients of margins hold; exit code 0."""
    check_device(config.device)
    worker = ReachWorker.of(config)
    names, _, unreadable = select_frames(worker.source, replace(config, limit=config.limit or _DEFAULT_SCENES))
    bar = ProgressSettings("comparing gradients and slopes", show_remaining=True)
    asked = run_frame_jobs(names, worker.measure, partial(measure_of, config), config, bar)
    rows = rows_of_reach([asked.results[name] for name in names if name in asked.results], config.seed)
    if not rows:
        raise UsageError("gradcheck --reach", "at least one vehicle that the detector finds", "none")
    facts = {
        "settings": {
            "dataset": config.dataset,
            "detector": config.detector,
            "seed": config.seed,
            "draws": config.draws,
            "frames": len(asked.results),
            "steps": asdict(StepSizes()),
        },
    }
    answer = reach_answer(Path(config.out or "."), rows, facts, unreadable | asked.failed)
    if config.out:
        answer.write()
    if config.json:
        print_json(answer.data)
    else:
        answer.print(Console(width=None if sys.stdout.isatty() else _FILE_WIDTH))
    if config.out:
        print_output_folder(answer.out, Console(stderr=True), answer.failed)
    return 0


@dataclass(frozen=True, slots=True)
class _Task:
    """A part of one scene's work at one point: the gradients, or the differences of one parameter."""

    identifier: str
    at: Point
    parameter: Parameter | None


class GradcheckWorker:
    """What one process needs: built once, used for many tasks. Raises UsageError or SceneError for bad input."""

    def __init__(self, config: GradcheckConfig) -> None:
        self.config = config
        check_device(config.device)
        self.source: SceneSource = open_source(config)
        self._detectors: dict[Backend, SqueezeDet] = {
            "reference": _detector(config.detector, "cpu").double(),
            "warp": _detector(config.detector, config.device),
        }
        self._current: tuple[str, SceneCheck] | None = None

    def do(self, task: _Task) -> Gradients | Differences:
        """One task; the scene is kept for the next one."""
        if self._current is None or self._current[0] != task.identifier:
            self._current = None
            scene = self.source.scene(task.identifier)
            check = SceneCheck(scene, self._detectors, self.config.seed, self.config.directions)
            self._current = (task.identifier, check)
        check = self._current[1]
        return check.gradients(task.at) if task.parameter is None else check.differences(task.at, task.parameter)

    def __call__(self, tasks: Sequence[_Task]) -> list[Gradients | Differences]:
        """Several tasks."""
        return [self.do(task) for task in tasks]


def _check_all(
    worker: GradcheckWorker, names: Sequence[str]
) -> tuple[dict[str, tuple[GradcheckRow, ...]], dict[str, str]]:
    """The rows of each scene, and why others have none."""
    parts = (None, *SIX)
    per_scene = [tuple(_Task(name, at, part) for at in POINTS for part in parts) for name in names]
    if len(names) >= worker.config.processes:
        jobs = per_scene
    else:  # too few scenes to keep every process busy: each makes the scene ready for itself
        jobs = [(task,) for tasks in per_scene for task in tasks]
    answers = run_frame_jobs(
        jobs,
        worker,
        partial(GradcheckWorker, worker.config),
        worker.config,
        ProgressSettings("checking gradients"),
        name=lambda tasks: tasks[0].identifier,
        size=len,
    )
    results: dict[_Task, Any] = {}
    for tasks, outcomes in answers.results.items():
        results.update(zip(tasks, outcomes, strict=True))

    def rows(name: str, at: Point) -> tuple[GradcheckRow, ...]:
        differences = {p: results[_Task(name, at, p)] for p in SIX}
        return rows_of(name, at, results[_Task(name, at, None)], differences)

    scenes = {
        name: tuple(row for at in POINTS for row in rows(name, at)) for name in names if name not in answers.failed
    }
    return scenes, answers.failed


def _detector(name: str, device: str) -> SqueezeDet:
    try:
        detector = load_detector(name, device)
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    if not isinstance(detector, SqueezeDet):
        raise UsageError("--detector", "one whose anchors can be held fixed: SqueezeDet", type(detector).__name__)
    return detector


def _print(rows: Sequence[GradcheckRow], config: GradcheckConfig, console: Console, scenes: int) -> None:
    title = f"gradients against central differences: {config.dataset}, "
    title += "1 scene" if scenes == 1 else f"the worst of {scenes} scenes"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("parameter", "at", "of", "backend"):
        table.add_column(heading)
    for heading in ("cosine", "error", "step", "other steps: error"):
        table.add_column(heading, justify="right")
    if scenes > 1:
        table.add_column("scene")
    for row in rows:
        of = "loss" if row.functional == LOSS else row.functional
        cells = [row.name.removesuffix(f" {LOSS}"), row.at, of, row.backend]
        if row.cosine is None or row.relative_error is None or row.step is None:
            cells += ["no effect", "", "", ""]
        else:
            others = [f"{a.step:.0e}: {a.relative_error:.1e}" for a in row.steps if a.step != row.step]
            cells += [f"{row.cosine:.5f}", f"{row.relative_error:.1e}", f"{row.step:.0e}", ", ".join(others)]
        style = None if row.passes(config.min_cosine, config.max_error) else "bold red"
        table.add_row(*cells, *([row.scene] if scenes > 1 else []), style=style)
    console.print(table)
    outside = sum(not row.passes(config.min_cosine, config.max_error) for row in rows)
    silent = sum(row.cosine is None for row in rows)
    counts = f"{len(rows) - outside - silent} of {format_count(len(rows), 'row')} inside the tolerance, {outside} outside"
    counts += f", {silent} without effect" if silent else ""
    tolerance = f"cosine at least {config.min_cosine:g}, error at most {config.max_error:g}"
    console.print(f"{counts} ({tolerance})", soft_wrap=True)
