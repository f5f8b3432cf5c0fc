"""De-rendering of a data set's frames or of photographs into scene folders, resumable."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path

from drivesem.config.commands import DerenderConfig
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import PRESENTATION, claim_folder
from drivesem.scenes.scene_sheet import write_scene_sheet
from drivesem.scenes.sources import SceneSource, compile_source_kernels, open_source
from scene_ir.io import count_objects, load_scene, save_scene

RECORD, SHEET = "scene.json", "sheet.jpg"


@dataclass(frozen=True, slots=True)
class DerenderSummary:
    """One de-rendered frame."""

    objects: int
    """Number of objects in its scene."""
    seconds: float | None
    """Time to de-render and write it; None for frames of an earlier run."""
    left_out: dict[str, str] = field(default_factory=dict)
    """With people: why some stay in the background, by label."""


@dataclass(frozen=True, slots=True)
class DerenderRunResult:
    """The frames of a run of `drivesem derender`."""

    out: Path
    """Folder of the scenes."""
    frames: dict[str, DerenderSummary]
    """De-rendered frames, in order."""
    failed: dict[str, str]
    """Frames that could not be de-rendered, with the reason."""
    seconds: float
    """Total time."""


class FrameDerenderer:
    """Per-process state, built once and reused for all frames."""

    def __init__(self, config: DerenderConfig, out: Path) -> None:
        self.config, self.out = config, out
        self.source: SceneSource = open_source(config)

    def __call__(self, identifier: str) -> DerenderSummary:
        """De-render a frame into its folder. Raises SceneError for an unusable frame."""
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
        left_out = {key: reason for key, reason in scene.provenance.items() if key.endswith(".background")}
        return DerenderSummary(len(scene.objects), seconds, left_out)


def derender_frames(config: DerenderConfig, on_source: Callable[[SceneSource], None]) -> DerenderRunResult:
    """De-render the frames that are not in the folder yet.

    Args:
        config: the settings.
        on_source: called with the source, before the first frame.

    Raises:
        UsageError: a setting is invalid.
        SceneError: the input cannot be read.
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
        complete = config.resume and (out / name / RECORD).is_file()
        if complete and (not config.sheet or (out / name / SHEET).is_file()):
            done[name] = DerenderSummary(count_objects(out / name), None)
    on_source(worker.source)
    pending = [name for name in names if name not in done]
    if pending:
        compile_source_kernels(config)
    progress = ProgressSettings("de-rendering frames", show_remaining=True)
    jobs = run_frame_jobs(pending, worker, build, config, progress)
    done |= jobs.results
    frames = {name: done[name] for name in names if name in done}
    seconds = round(time.perf_counter() - start, 3)
    return DerenderRunResult(out, frames, dict(sorted(jobs.failed.items())), seconds)
