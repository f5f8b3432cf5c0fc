"""The paper's experiments, and others, on frames of one's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.confirm.asking import confirm_run
from drivesem.analysis.confirm.report import Confirmation
from drivesem.analysis.transfer.asking import DETECTIONS
from drivesem.analysis.transfer.plot import write_heatmap
from drivesem.config.commands import ConfirmConfig
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.report.tables import AnalysisReport
from drivesem.report.terminal import Console
from drivesem.run.folder import ARMS, PRESENTATION, RETRAINED, claim, folder_of
from drivesem.training.known import warn_of_overlaps
from tools.experiments.detection import report, retrain, retrain_report, transfer
from tools.experiments.detection.arms import STUDY_JSON, base_attack, bootstrap_draws, build_arms
from tools.experiments.detection.attribution import AttributionPlan, attribute_drop, write_waterfall
from tools.experiments.detection.attribution import attribution_text as told_of_factors
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.grades import count_grades
from tools.experiments.detection.kept import keep, load_kept
from tools.experiments.detection.kept_retrain import keep_retrain, load_retrain
from tools.experiments.detection.kept_rows import KEPT, command_of
from tools.experiments.detection.kept_transfer import keep_transfer, load_transfer
from tools.experiments.detection.labels import compare_frame_labels, compare_labels
from tools.experiments.detection.largest import find_largest_changes, write_largest_changes
from tools.experiments.detection.lessons import CACHE, FRAMES, POOL
from tools.experiments.detection.plots import write_plot
from tools.experiments.detection.report import StudyResults, StudyText
from tools.experiments.detection.robust import STATES
from tools.experiments.detection.rows import compare_arms
from tools.experiments.detection.running import StudyArms, build_workers, run_arms
from tools.experiments.detection.searches import (
    count_withstanding,
    find_detected_objects,
    load_depths,
    search_costs,
)
from tools.experiments.detection.success import compare_success, success_curve
from tools.experiments.detection.taught import RetrainingCounts, summarise_retraining
from tools.experiments.detection.transfer import TransferCounts, build_matrix
from tools.experiments.settings import StudyConfig

_PICTURE, _LARGEST = "study.png", "largest.jpg"
_TABLES = (
    "study.md",
    *(
        f"{name}.csv"
        for name in ("study", "curves", "label_sets", "grades", "searches", "standing", "arms", "robust")
    ),
)
_WRITTEN = (
    *(_PICTURE, STUDY_JSON, _LARGEST),
    *_TABLES,
    *(ARMS, KEPT, DETECTIONS, RETRAINED, CACHE, FRAMES, POOL, STATES),
)
_FREE = (*PRESENTATION, "quick", "controls", "seeds", "paper_protocol", "confirm", "bootstrap")
"""Settings that may change on the way: they add frames, arms or draws, and alter none."""
_FREE_IN_RETRAIN = (
    *(name for name in PRESENTATION if name != "limit"),
    *("bootstrap", "benign_frames", "fresh", "controls", "detectors", "sources"),
    *("arms", "seeds", "states", "reattack", "validation"),
)
"""Of retrain: other frames to train on would make other detectors."""


def study_run(config: StudyConfig) -> AnalysisReport:
    """Run or continue a study, and write what is said of it; tell one that was kept, and write it where --out is
    given. Raises UsageError or SceneError for bad input.
    """
    if config.kept is not None:
        return _again(config, Path(config.kept))
    out = Path(config.out or f"runs/study-{config.name}-{config.dataset}-seed{config.seed}")
    console = Console(stderr=True)
    warn_of_overlaps([config.detector], config.held_out or config.root, console)
    answer = _answer(config, out, _STUDIES.get(config.name, _arms)(config, out, console))
    answer.write()
    return answer


def _again(config: StudyConfig, folder: Path) -> AnalysisReport:
    """The tables of a study that was kept."""
    out = folder_of(config.out, folder)
    settings, told = _AGAIN.get(config.name, _kept)(folder, config.name)
    study = settings if config.bootstrap is None else replace(settings, bootstrap=config.bootstrap)
    answer = _answer(study, out, told(study))
    if config.out is not None:
        answer.write()
    return answer


_Found = tuple[dict[str, Any], StudyText, Callable[[Path], None]]
"""A study's figures for JSON, its text, and what draws its picture."""


def _answer(study: StudyConfig, out: Path, found: _Found) -> AnalysisReport:
    data, told, draw = found
    return report.build_report(told, out, data, command_of(study), draw)


_Kept = tuple[StudyConfig, Callable[[StudyConfig], _Found]]
"""Settings of a study that was kept, and what is found with such settings."""


def _kept(folder: Path, name: str) -> _Kept:
    """Of arms."""
    kept = load_kept(folder, name)
    return kept.settings, partial(_found, counts=kept.counts, confirmed=kept.confirmed)


def _kept_transfer(folder: Path, name: str) -> _Kept:
    settings, counts = load_transfer(folder)
    return settings, partial(_transferred, counts=counts)


def _kept_retrain(folder: Path, name: str) -> _Kept:
    settings, counts = load_retrain(folder)
    return settings, partial(_retrained, counts=counts)


_AGAIN = {"transfer": _kept_transfer, "retrain": _kept_retrain}
"""Studies that keep more than arms."""


def _arms(config: StudyConfig, out: Path, console: Console) -> _Found:
    """Attacks side by side."""
    arms = build_arms(config, out)
    workers = build_workers(arms)
    claim(out, config, _WRITTEN, _FREE)
    if config.confirm:  # before hours of attacks: whether the frames can be drawn again
        SecondRenderers(workers[0].config.dataset, workers[0].config.root).check()
    ran = run_arms(arms, workers, out)
    counts = StudyCounts.from_arms(ran)
    if config.name == "searches":
        counts = replace(counts, seen=find_detected_objects(ran.runs[0], load_depths(ran.runs[0], out)))
    elif config.name == "labels":
        counts = replace(counts, labels={one.arm.name: compare_frame_labels(one) for one in ran.runs})
    confirmed = _confirmed(config, ran, out)
    write_largest_changes(out / _LARGEST, find_largest_changes(ran.runs, out))
    keep(out / KEPT, config, counts, confirmed)
    return _found(config, counts, confirmed)


def _found(config: StudyConfig, counts: StudyCounts, confirmed: Mapping[str, Confirmation]) -> _Found:
    """What follows from what is kept."""
    if config.name == "attribution":
        found = attribute_drop(
            config, AttributionPlan.from_study(config, base_attack(config)), counts, bootstrap_draws(config)
        )
        return found.to_json(), told_of_factors(found), partial(write_waterfall, found=found)
    return _text(replace(_findings(config, counts), confirmed=confirmed))


def _text(found: StudyResults) -> _Found:
    return found.to_json(), report.study_text(found), partial(write_plot, found=found)


def _confirmed(config: StudyConfig, ran: StudyArms, out: Path) -> dict[str, Confirmation]:
    """What second renderers' pictures say of each arm that is no control, where that is asked."""
    if not config.confirm:
        return {}
    shared = ConfirmConfig(workers=config.workers, device=config.device, keep_going=config.keep_going)
    arms = [run.arm for run in ran.runs if run.arm.control is None]
    return {arm.name: confirm_run(replace(shared, run=str(out / ARMS / arm.folder)))[0] for arm in arms}


def _attribution(config: StudyConfig, out: Path, console: Console) -> _Found:
    """What lies between ours and the paper's protocol."""
    arms = AttributionPlan.from_study(config, base_attack(config)).arms()
    workers = build_workers(arms)
    claim(out, config, _WRITTEN, _FREE)
    counts = StudyCounts.from_arms(run_arms(arms, workers, out))
    keep(out / KEPT, config, counts, {})
    return _found(config, counts, {})


def _transfer(config: StudyConfig, out: Path, console: Console) -> _Found:
    """Counterexamples before other detectors."""
    arms = build_arms(config, out)
    workers = build_workers(arms)
    asked = transfer.load_targets(config, out)
    claim(out, config, _WRITTEN, (*_FREE, "detectors", "sources"))
    counts = transfer.run(config, arms, workers, asked, out)
    keep_transfer(out / KEPT, config, counts)
    return _transferred(config, counts)


def _transferred(config: StudyConfig, counts: TransferCounts) -> _Found:
    found = build_matrix(config, counts)
    return (
        found.to_json(),
        transfer.transfer_text(found),
        partial(write_heatmap, rows=[one.row for one in found.rows]),
    )


def _retrain(config: StudyConfig, out: Path, console: Console) -> _Found:
    """Detectors trained on with counterexamples."""
    ready = retrain.prepare_retraining(config, out)
    claim(out, config, _WRITTEN, _FREE_IN_RETRAIN)
    counts = retrain.run_retraining(config, ready, out, console)
    keep_retrain(out / KEPT, config, counts)
    return _retrained(config, counts)


def _retrained(config: StudyConfig, counts: RetrainingCounts) -> _Found:
    found = summarise_retraining(config, counts)
    return found.to_json(), retrain_report.retraining_text(found), partial(retrain_report.write_plot, found=found)


_STUDIES = {"attribution": _attribution, "transfer": _transfer, "retrain": _retrain}
"""Studies that are more than attacks side by side."""


def _findings(config: StudyConfig, counts: StudyCounts) -> StudyResults:
    draws, arms = bootstrap_draws(config), counts.arms
    grades = [count_grades(one, draws, config.seed) for one in arms if one.graded]
    labels = [compare_labels(name, frames) for name, frames in counts.labels.items()]
    found = StudyResults(
        config, draws, counts, compare_arms(arms, draws, config.seed), grades=grades, label_sets=labels
    )
    if config.name == "searches":
        costs, standing = (
            search_costs(arms, counts.detected_objects, draws, config.seed),
            count_withstanding(arms, counts.detected_objects),
        )
        return replace(found, costs=costs, standing=standing)
    if config.name not in ("samples", "steps"):
        return found
    found = replace(found, curves=[success_curve(one, draws, config.seed) for one in arms])
    if config.name == "steps":
        return found
    beside = {one.arm.name: compare_success(arms[0], config.steps, one, draws, config.seed) for one in arms}
    return replace(found, beside=beside, within=config.steps)
