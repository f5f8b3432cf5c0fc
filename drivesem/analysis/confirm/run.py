"""Re-renders counterexamples of a run with a second renderer and tests the detector again."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

from detectors.types import CLASSES
from drivesem.analysis.confirm.comparison import ConfirmedFrame, compare_failures, compare_objects, pair_targets
from drivesem.analysis.confirm.report import (
    Confirmation,
    build_confirm_report,
    draw_confirm_sheet,
    summarise_confirmation,
)
from drivesem.attack.targets import EvaluatedClasses
from drivesem.config.commands import ConfirmConfig
from drivesem.config.constraints import is_url
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.report.tables import AnalysisReport
from drivesem.run.detection_cache import detect_objects, image_to_tensor
from drivesem.run.driver import FrameAnalyser, ProgressSettings, analyse_frames
from drivesem.run.finished import METRICS, AttackRun, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim_folder, load_run_detector, load_trusted_config
from drivesem.run.frame import detection_records, target_records
from scene_ir import files
from scene_ir.io import load_scene, to_uint8

_WRITTEN = ("confirm.json", "confirm.md", "confirm.csv", FRAMES)
_FREE = (*PRESENTATION, "run", "root", "seed")


def run_confirm(config: ConfirmConfig) -> tuple[Confirmation, AnalysisReport]:
    """Re-test a run's frames, or resume, and write the report.

    Raises UsageError or SceneError for bad input, NoSecondRendererError before anything is written.
    """
    (run,) = load_runs([config.run or ""], config.limit)
    out = Path(config.out) if config.out else run.folder / "confirm"
    make_analyser = partial(ConfirmAnalyser, config, run, out)
    analyser = make_analyser()
    claim_folder(out, config, _WRITTEN, _FREE)
    names = [frame.result.identifier for frame in run.frames]
    progress_settings = ProgressSettings("re-rendering frames", keep=False)
    confirmed, failed = analyse_frames(names, analyser, make_analyser, config, progress_settings)
    if not confirmed:
        raise UsageError("--run", "a run with frames that can be used", run.folder)
    results = [frame.result for frame in run.frames if frame.result.identifier not in failed]
    classes = EvaluatedClasses.from_detector(analyser.detector).names
    confirmation = summarise_confirmation(confirmed, results, classes, analyser.t_star)
    facts = {
        "run": str(run.folder),
        "detector": run.detector,
        "params": run.params,
        "t_star": analyser.t_star,
    }
    report = build_confirm_report(out, confirmation, confirmed, facts, failed)
    report.write()
    return confirmation, report


class ConfirmAnalyser(FrameAnalyser[ConfirmedFrame]):
    """Re-renders frames of a run and compares the detector's failures."""

    file, kind, schema = "confirmed.json", ConfirmedFrame, 2

    def __init__(self, config: ConfirmConfig, run: AttackRun, out: Path) -> None:
        super().__init__(run.folder, out)
        attack = load_trusted_config(run.folder, config.trust)
        self.frames = {frame.result.identifier: frame for frame in run.frames}
        if attack.dataset == DEMO and config.root is not None:
            raise UsageError("--root", "none for the embedded scenes", config.root)
        if config.root is None and is_url(attack.root or ""):  # the local copy may be anywhere
            raise UsageError("--root", "the run's data set, as the run read it from a URL", attack.root)
        self.second = SecondRenderers(attack.dataset, config.root or attack.root)
        self.second.check()
        self.detector = load_run_detector(attack, config.device)
        self.device, self.t_star = config.device, float(files.read_json(run.folder / METRICS)["t_star"])

    def analyse(self, name: str, folder: Path) -> ConfirmedFrame:
        """See `FrameAnalyser`. Raises SceneError if no second renderer reproduces the frame's photograph."""
        start = time.perf_counter()
        changed = load_scene(self.run_folder / FRAMES / name / "scene")
        renderer = self.second.renderer_for(name, changed)
        renders = [renderer.render(scene) for scene in (changed.as_photographed(), changed)]
        count = len(changed.objects)
        targets = pair_targets(renders[0], renders[1], count)
        classes = EvaluatedClasses.from_detector(self.detector)
        pictures = [to_uint8(render.image) for render in renders]
        detections = [detect_objects(self.detector, image_to_tensor(p, self.device)) for p in pictures]
        result = self.frames[name].result
        compositor, second = compare_failures(result, targets, detections, classes, self.t_star)
        confirmed = ConfirmedFrame(
            identifier=name,
            source=self.source_digest(name),
            renderer=renderer.name,
            compositor=compositor,
            second=second,
            objects=compare_objects(result, targets, count),
            targets_benign=target_records(targets.benign, CLASSES, count),
            targets_changed=target_records(targets.changed, CLASSES, count),
            detections_benign=detection_records(detections[0], classes.names),
            detections_changed=detection_records(detections[1], classes.names),
            not_carried=renderer.unsupported_changes(changed),
            seconds=round(time.perf_counter() - start, 3),
        )
        files.write_png(folder / f"{renderer.name}.png", pictures[1])
        sheet = draw_confirm_sheet(self.frames[name], confirmed, pictures[1], self.t_star)
        files.write_png(folder / "sheet.png", sheet)
        return confirmed
