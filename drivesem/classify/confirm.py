"""`drivesem classify confirm`: re-tests a run's failures with a second renderer, for the grade confirmed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

import torch

from drivesem.classify.analysis import ClassifyRun
from drivesem.classify.attack import Attacker
from drivesem.classify.results import (
    SCHEMA,
    SECOND_PICTURE,
    ClassifyMetrics,
    SecondRenderComparison,
    write_run_report,
)
from drivesem.classify.scenes import picture_camera
from drivesem.classify.second_renderer import PosedObject, measure_agreement, open_second_renderer
from drivesem.config.commands import ClassifyConfig
from drivesem.failures.grades import Grade
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.finished import METRICS
from drivesem.run.folder import FRAMES
from drivesem.run.labels import RESULT
from drivesem.run.lock import acquire_folder_lock
from drivesem.run.records import dump_record
from scene_ir import files
from scene_ir.io import round_to_8bit, to_uint8


class PictureConfirmer:
    """Re-tests failures in one process; built once."""

    def __init__(self, config: ClassifyConfig, run: ClassifyRun) -> None:
        self.run, self.renderer = run, open_second_renderer(config.renderer)
        self.attacker = Attacker.from_config(run.config)

    @torch.no_grad()
    def __call__(self, name: str) -> None:
        """Re-test one failure and update its folder in the run."""
        objective, theta = self.run.load_objective(self.attacker, name)
        scene = objective.scene
        pictures, agreements = [], []
        for change in (None, objective.space.change(theta)):
            own = scene.mesh.render(scene.camera_vertices(change), picture_camera(), scene.lights(change))
            other = self.renderer.render(PosedObject.from_scene(scene, change))
            pictures.append(round_to_8bit(scene.composite(other)))
            agreements.append(measure_agreement(scene, own, other))
        opinion = self.attacker.grader.compare_second_render(
            name, objective.classify, self.renderer.name, *pictures
        )
        result = self.run.results[name]
        grade = result.grade
        if grade in (Grade.CERTAIN, Grade.CONFIRMED):
            grade = str(Grade.CONFIRMED if opinion.agrees else Grade.CERTAIN)
        result = replace(result, grade=grade, second=SecondRenderComparison(opinion, *agreements))
        folder = self.run.folder / FRAMES / name
        files.write_png(folder / SECOND_PICTURE, to_uint8(pictures[1]))
        files.write_text(folder / RESULT, dump_record(result, SCHEMA))


def confirm_failures(config: ClassifyConfig) -> tuple[ClassifyMetrics, dict[str, Any]]:
    """Re-test the failures of a run that this renderer has not tested yet, and rewrite the run's report.

    Returns:
        The run's metrics, and facts about the comparison.

    Raises:
        UsageError: There is no such run.
        SceneError: A failure that cannot be re-tested, without --keep-going.
        NoSecondRendererError: There is no second renderer; nothing is written.
    """
    run = ClassifyRun.load(config)
    make = partial(PictureConfirmer, config, run)
    confirmer = make()
    acquire_folder_lock(run.folder)
    renderer, names = confirmer.renderer.name, run.failure_names(config.limit)
    unfinished = [name for name in names if not (config.resume and _is_tested_by(renderer, run, name))]
    worker: Callable[[str], None] = confirmer
    failed = run_frame_jobs(unfinished, worker, make, config, ProgressSettings("re-testing failures")).failed
    old_metrics = files.read_json(run.folder / METRICS)
    metrics = write_run_report(
        run.config,
        run.folder,
        confirmer.attacker.network.classes,
        [run.view(name) for name in run.results],
        old_metrics["frames_failed"],
        old_metrics["seconds"],
    )
    results = ClassifyRun.load(config).results
    comparisons = [results[name].second for name in names if name not in failed]
    agreements = [one for c in comparisons if c is not None for one in (c.before, c.after)]
    ious, colours = [one.iou for one in agreements], [one.colour for one in agreements]
    facts: dict[str, Any] = {
        "renderer": renderer,
        "failures": len(comparisons),
        "agree": sum(c is not None and c.agreement.agrees for c in comparisons),
        "iou": {"mean": fmean(ious), "least": min(ious)} if ious else None,
        "colour": {"mean": fmean(colours), "most": max(colours)} if colours else None,
        "frames_failed": failed,
    }
    return metrics, facts


def _is_tested_by(renderer: str, run: ClassifyRun, name: str) -> bool:
    second = run.results[name].second
    return second is not None and second.agreement.by == renderer
