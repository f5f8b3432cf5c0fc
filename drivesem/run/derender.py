"""Frames of a data set, or one photograph, taken apart: a scene folder for each, resumable."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

from drivesem.config.commands import DerenderConfig
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import PRESENTATION, claim_folder
from drivesem.scenes.sheet import write_scene_sheet
from drivesem.scenes.sources import SceneSource, make_ready, open_source
from scene_ir.io import count_objects, load_scene, save_scene

RECORD, SHEET = "scene.json", "sheet.jpg"


@dataclass(frozen=True, slots=True)
class DerenderSummary:
    """One frame taken apart. objects: vehicles in its scene; seconds: to take it apart and write it, None where an
    earlier run did.
    """

    objects: int
    seconds: float | None


@dataclass(frozen=True, slots=True)
class DerenderRunResult:
    """All frames: in order those that were taken apart, and why others could not be."""

    out: Path
    frames: dict[str, DerenderSummary]
    failed: dict[str, str]
    seconds: float


class FrameDerenderer:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: DerenderConfig, out: Path) -> None:
        self.config, self.out = config, out
        self.source: SceneSource = open_source(config)

    def __call__(self, identifier: str) -> DerenderSummary:
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
        return DerenderSummary(len(scene.objects), seconds)


def derender_frames(config: DerenderConfig, begin: Callable[[SceneSource], None]) -> DerenderRunResult:
    """Take apart the frames that are not there yet. begin: is told the source, before the first frame. Raises
    UsageError or SceneError for bad input.
    """
    start = time.perf_counter()
    config = replace(config, fit=config.fit and not config.fast, fast=False)
    out = Path(config.out or f"scenes/{config.dataset if config.photo is None else Path(config.photo).stem}")
    build = partial(FrameDerenderer, config, out)
    worker = build()
    scenes = (name for name in worker.source.identifiers() if (out / name / RECORD).is_file())
    claim_folder(out, config, scenes, (*PRESENTATION, "sheet"))
    names = list(islice(worker.source.identifiers(), config.limit))
    done: dict[str, DerenderSummary] = {}
    for name in names:
        whole = config.resume and (out / name / RECORD).is_file()
        if whole and (not config.sheet or (out / name / SHEET).is_file()):
            done[name] = DerenderSummary(count_objects(out / name), None)
    begin(worker.source)
    todo = [name for name in names if name not in done]
    if todo:
        make_ready(config)
    answers = run_frame_jobs(
        todo, worker, build, config, ProgressSettings("taking frames apart", show_remaining=True)
    )
    done |= answers.results
    frames = {name: done[name] for name in names if name in done}
    return DerenderRunResult(
        out, frames, dict(sorted(answers.failed.items())), round(time.perf_counter() - start, 3)
    )
