"""`drivesem derender`: a scene folder for each frame of a data set, or for one photograph."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from drivesem.run.folder import PRESENTATION, claim
from drivesem.run.workers import outcomes
from drivesem.scenes.sheet import write_scene_sheet
from drivesem.scenes.sources import PlainPhotograph, SceneSource, open_source
from drivesem.settings.commands import Derender
from scene_ir.errors import SceneError
from scene_ir.io import count_objects, load_scene, save_scene

RECORD, SHEET = "scene.json", "sheet.jpg"


@dataclass(frozen=True, slots=True)
class Taken:
    """One frame taken apart. objects: vehicles in its scene; seconds: to take it apart and write it, None where an
    earlier run did.
    """

    objects: int
    seconds: float | None


class _Worker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Derender, out: Path) -> None:
        self.config = config
        self.out = out
        self.source: SceneSource = open_source(config)

    def take_apart(self, identifier: str) -> Taken:
        """One frame, from the source to its folder. Raises SceneError for a frame that cannot be used."""
        start = time.perf_counter()
        folder = self.out / identifier
        if self.config.resume and (folder / RECORD).is_file():
            scene, seconds = load_scene(folder), None
        else:
            scene = self.source.scene(identifier)
            save_scene(scene, folder)
            seconds = round(time.perf_counter() - start, 3)
        if self.config.sheet and not (folder / SHEET).is_file():
            write_scene_sheet(folder / SHEET, scene, identifier)
        return Taken(len(scene.objects), seconds)


def _in_process(config: Derender, out: Path) -> Callable[[str], Taken]:
    return _Worker(config, out).take_apart


def run(config: Derender) -> int:
    """Take apart the frames that are not there yet; exit code 0. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    config = replace(config, fit=config.fit and not config.fast, fast=False)
    out = Path(config.out or f"scenes/{config.dataset if config.photo is None else Path(config.photo).stem}")
    worker = _Worker(config, out)
    claim(out, config, partial(_clear, worker.source.identifiers()), (*PRESENTATION, "sheet"))
    names = list(islice(worker.source.identifiers(), config.limit))
    done: dict[str, Taken] = {}
    todo = []
    for name in names:
        whole = config.resume and (out / name / RECORD).is_file()
        if whole and (not config.sheet or (out / name / SHEET).is_file()):
            done[name] = Taken(count_objects(out / name), None)
        else:
            todo.append(name)
    failed: dict[str, str] = {}
    columns = (
        *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()),
        *(TimeElapsedColumn(), TimeRemainingColumn()),
    )
    console = Console(stderr=True)
    if isinstance(worker.source, PlainPhotograph):
        focal = worker.source.focal
        console.print(f"camera: focal length {focal.length_px:.0f} px ({focal.source})", soft_wrap=True)
    if config.meshes is not None:
        from drivesem.synth.assets import unreadable_in

        for name, fault in unreadable_in(config.meshes):
            console.print(f"--meshes: {name} is left out: {fault}", soft_wrap=True, highlight=False, markup=False)
    with Progress(*columns, console=console, disable=not todo) as progress:
        task = progress.add_task("taking frames apart", total=len(todo))
        for name, outcome in outcomes(worker.take_apart, partial(_in_process, config, out), todo, config):
            try:
                done[name] = outcome()
            except SceneError as error:
                if not config.keep_going:
                    raise
                failed[name] = str(error)
            progress.advance(task)
    seconds = round(time.perf_counter() - start, 3)
    frames = {name: asdict(done[name]) for name in names if name in done}
    if config.json:
        found = {"out": str(out), "frames": frames, "failed": dict(sorted(failed.items())), "seconds": seconds}
        sys.stdout.write(json.dumps(found) + "\n")
        return 0
    lines = Console()
    for name, taken in frames.items():
        spent = "there before" if taken["seconds"] is None else f"{taken['seconds']:.1f} s"
        lines.print(f"{name}: {taken['objects']} vehicles, {spent}", soft_wrap=True, highlight=False)
    for name, reason in sorted(failed.items()):
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    lines.print(f"{len(frames)} scenes in {out} ({seconds:.0f} s)", soft_wrap=True)
    return 0


def _clear(identifiers: Iterable[str], out: Path) -> None:
    """Remove the scenes of earlier runs, and nothing else."""
    for identifier in identifiers:
        if (out / identifier / RECORD).is_file():
            shutil.rmtree(out / identifier)
