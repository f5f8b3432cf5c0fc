"""The studies on detectors: run or continue one, store its results, and report them; or report stored results."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from drivesem.analysis.confirm import Confirmation, run_confirm
from drivesem.analysis.transfer import DETECTIONS
from drivesem.config.commands import ConfirmConfig
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.reporting.tables import AnalysisReport, Console
from drivesem.run.folder import ARMS, PRESENTATION, RETRAINED, claim_folder, resolve_output_folder
from drivesem.training.card import warn_about_overlaps
from tools.experiments.detection.arms import STUDY_JSON, StudyArms, build_arms, build_workers, run_arms
from tools.experiments.detection.attribution import AttributionPlan, attribute_drop, attribution_report
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.labels import compare_frame_labels
from tools.experiments.detection.outcomes import find_detected_objects, load_depths
from tools.experiments.detection.plots import find_largest_changes, write_largest_changes, write_plot
from tools.experiments.detection.report import arms_report, build_results
from tools.experiments.detection.retraining import prepare_retraining, run_retraining
from tools.experiments.detection.retraining_arms import CACHE, FRAMES, POOL
from tools.experiments.detection.retraining_report import retraining_report
from tools.experiments.detection.retraining_results import summarise_retraining
from tools.experiments.detection.robustness import STATES
from tools.experiments.detection.stored_results import (
    load_retraining,
    load_study,
    load_transfer,
    save_retraining,
    save_study,
    save_transfer,
)
from tools.experiments.detection.transfer import build_matrix, load_targets, run_transfer, transfer_report
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import RESULTS

_LARGEST = "largest.jpg"
_CSV_TABLES = ("study", "curves", "label_sets", "grades", "searches", "standing", "arms", "robust")
_WRITTEN = (
    *("study.md", "study.png", STUDY_JSON, _LARGEST),
    *(f"{name}.csv" for name in _CSV_TABLES),
    *(ARMS, RESULTS, DETECTIONS, RETRAINED, CACHE, FRAMES, POOL, STATES),
)
_FREE_SETTINGS = (*PRESENTATION, "quick", "controls", "seeds", "paper_protocol", "confirm", "bootstrap")
"""Settings that may differ when a study is continued: they add frames, arms or draws, and change none."""
_FREE_TRANSFER_SETTINGS = (*_FREE_SETTINGS, "detectors", "sources")
_FREE_RETRAINING_SETTINGS = (
    *(name for name in PRESENTATION if name != "limit"),
    *("bootstrap", "benign_frames", "fresh", "controls", "detectors", "sources"),
    *("arms", "seeds", "states", "reattack", "validation"),
)
"""The same for retraining: other training frames would make other detectors."""


def run_study(config: StudyConfig) -> AnalysisReport:
    """Run or continue a study, or report stored results with --from.

    Returns:
        The report, which is written into the study's folder; with --from only if --out is given.

    Raises:
        UsageError: Bad settings.
        SceneError: A frame that cannot be used, without --keep-going, or damaged results.
    """
    if config.results is not None:
        folder = Path(config.results)
        report = report_results(config, folder, resolve_output_folder(config.out, folder))
        if config.out is not None:
            report.write()
        return report
    out = Path(config.out or f"runs/study-{config.name}-{config.dataset}-seed{config.seed}")
    console = Console(stderr=True)
    warn_about_overlaps([config.detector], config.held_out or config.root, console)
    if config.name == "retrain":
        _run_retraining(config, out, console)
    elif config.name == "transfer":
        _run_transfer(config, out)
    else:
        _run_arms(config, out)
    report = report_results(config, out / RESULTS, out)
    report.write()
    return report


def report_results(config: StudyConfig, folder: Path, out: Path) -> AnalysisReport:
    """Report stored results.

    Args:
        config: The study's name, and --bootstrap to override the stored one.
        folder: Folder of the results.
        out: Folder that the report states.

    Raises:
        FormatError: Damaged results, or those of another study.
    """

    def settings(stored: StudyConfig) -> StudyConfig:
        return stored if config.bootstrap is None else replace(stored, bootstrap=config.bootstrap)

    if config.name == "retrain":
        study, retraining = load_retraining(folder)
        return retraining_report(summarise_retraining(settings(study), retraining), out)
    if config.name == "transfer":
        study, transfer = load_transfer(folder)
        return transfer_report(build_matrix(settings(study), transfer), out)
    archive = load_study(folder, config.name)
    study = settings(archive.settings)
    if config.name == "attribution":
        return attribution_report(attribute_drop(study, archive.counts), out)
    results = build_results(study, archive.counts, archive.confirmed)
    return replace(arms_report(results, out), picture=partial(write_plot, results=results))


def _run_arms(config: StudyConfig, out: Path) -> None:
    """Run a study that compares arms, and store its results."""
    attribution = config.name == "attribution"
    arms = AttributionPlan.from_study(config).arms() if attribution else build_arms(config, out)
    workers = build_workers(arms)
    claim_folder(out, config, _WRITTEN, _FREE_SETTINGS)
    confirm = config.confirm and not attribution
    if confirm:  # before hours of attacks: can the frames be rendered by a second renderer?
        SecondRenderers(workers[0].config.dataset, workers[0].config.root).check()
    finished = run_arms(arms, workers, out)
    counts = StudyCounts.from_arms(finished)
    if config.name == "searches":
        first = finished.runs[0]
        counts = replace(counts, detected_objects=find_detected_objects(first, load_depths(first, out)))
    elif config.name == "labels":
        counts = replace(counts, labels={run.arm.name: compare_frame_labels(run) for run in finished.runs})
    confirmed = _confirm_arms(config, finished, out) if confirm else {}
    if not attribution:
        write_largest_changes(out / _LARGEST, find_largest_changes(finished.runs, out))
    save_study(out / RESULTS, config, counts, confirmed)


def _confirm_arms(config: StudyConfig, finished: StudyArms, out: Path) -> dict[str, Confirmation]:
    """Re-test the counterexamples of all arms but controls with a second renderer."""
    shared = ConfirmConfig(workers=config.workers, device=config.device, keep_going=config.keep_going)
    arms = [run.arm for run in finished.runs if run.arm.control is None]
    return {arm.name: run_confirm(replace(shared, run=str(out / ARMS / arm.folder)))[0] for arm in arms}


def _run_transfer(config: StudyConfig, out: Path) -> None:
    arms = build_arms(config, out)
    workers = build_workers(arms)
    targets = load_targets(config, out)
    claim_folder(out, config, _WRITTEN, _FREE_TRANSFER_SETTINGS)
    save_transfer(out / RESULTS, config, run_transfer(config, arms, workers, targets, out))


def _run_retraining(config: StudyConfig, out: Path, console: Console) -> None:
    inputs = prepare_retraining(config, out)
    claim_folder(out, config, _WRITTEN, _FREE_RETRAINING_SETTINGS)
    save_retraining(out / RESULTS, config, run_retraining(config, inputs, out, console))
