"""`drivesem classify confirm`: a run's failures drawn again by a second renderer, and the grade `confirmed`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

import torch

from drivesem.classify.attack import Attacker, report_run
from drivesem.classify.finished import ClassifyRun
from drivesem.classify.page import SECOND_PICTURE
from drivesem.classify.redraw.base import Redraw, Solid, likeness
from drivesem.classify.redraw.mitsuba import MitsubaRenderer
from drivesem.classify.redraw.pyrender import PyrenderRenderer
from drivesem.classify.results import SCHEMA, ClassifiedRun, SecondLook
from drivesem.classify.scenes import camera
from drivesem.config.commands import ClassifyConfig
from drivesem.failures.grades import Grade
from drivesem.failures.second_renderer.base import NoSecondRendererError
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.finished import METRICS
from drivesem.run.folder import FRAMES
from drivesem.run.frame import RESULT
from drivesem.run.lock import acquire_folder_lock
from drivesem.run.records import dump_record
from scene_ir import files
from scene_ir.io import round_to_8bit, to_uint8


def open_renderer(name: str) -> Redraw:
    """mitsuba, pyrender, or auto: Mitsuba where it is installed. Raises NoSecondRendererError."""
    if name != "pyrender":
        try:
            return MitsubaRenderer()
        except NoSecondRendererError:
            if name == "mitsuba":
                raise
    return PyrenderRenderer()


class ConfirmWorker:
    """What one process needs: built once, used for many pictures."""

    def __init__(self, config: ClassifyConfig, run: ClassifyRun) -> None:
        self.run, self.renderer = run, open_renderer(config.renderer)
        self.attacker = Attacker.of(run.config)

    @torch.no_grad()
    def __call__(self, name: str) -> None:
        """One picture, into its folder in the run."""
        objective, theta = self.run.rebuilt(self.attacker, name)
        scene, by = objective.scene, self.renderer.name
        pictures, alike = [], []
        for change in (None, objective.space.change(theta)):
            own = scene.mesh.render(scene.placed(change), camera(), scene.lights(change))
            other = self.renderer.draw(Solid.of(scene, change))
            pictures.append(round_to_8bit(scene.shown(other)))
            alike.append(likeness(scene, own, other))
        agreement = self.attacker.grader.agreement(name, objective.look, by, *pictures)
        frame = self.run.frames[name]
        grade = frame.grade
        if grade in (Grade.CERTAIN, Grade.CONFIRMED):
            grade = str(Grade.CONFIRMED if agreement.agrees else Grade.CERTAIN)
        record = replace(frame, grade=grade, second=SecondLook(agreement, *alike))
        folder = self.run.folder / FRAMES / name
        files.write_png(folder / SECOND_PICTURE, to_uint8(pictures[1]))
        files.write_text(folder / RESULT, dump_record(record, SCHEMA))


def confirm_run(config: ClassifyConfig) -> tuple[ClassifiedRun, dict[str, Any]]:
    """Confirm a run's failures, or go on with it: its figures and its report are written anew. Raises UsageError
    or SceneError for bad input, NoSecondRendererError before anything is written.
    """
    run = ClassifyRun.of(config)
    build = partial(ConfirmWorker, config, run)
    worker = build()
    acquire_folder_lock(run.folder)
    by, names = worker.renderer.name, run.failures(config.limit)
    todo = [name for name in names if not (config.resume and _is_by(by, run, name))]
    work: Callable[[str], None] = worker
    failed = run_frame_jobs(todo, work, build, config, ProgressSettings("drawing failures again")).failed
    before = files.read_json(run.folder / METRICS)
    done = [run.shown(name) for name in run.frames]
    classes = worker.attacker.network.classes
    found = report_run(run.config, run.folder, classes, done, before["frames_failed"], before["seconds"])
    again = ClassifyRun.of(config).frames
    looks = [again[name].second for name in names if name not in failed]
    alike = [one for look in looks if look is not None for one in (look.before, look.after)]
    ious, colours = [one.iou for one in alike], [one.colour for one in alike]
    facts: dict[str, Any] = {
        "renderer": by,
        "failures": len(looks),
        "agree": sum(look is not None and look.agreement.agrees for look in looks),
        "iou": {"mean": fmean(ious), "least": min(ious)} if ious else None,
        "colour": {"mean": fmean(colours), "most": max(colours)} if colours else None,
        "frames_failed": failed,
    }
    return found, facts


def _is_by(renderer: str, run: ClassifyRun, name: str) -> bool:
    second = run.frames[name].second
    return second is not None and second.agreement.by == renderer
