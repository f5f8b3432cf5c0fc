"""The study `retrain`: detectors trained on counterexamples, tested on benign frames, known and fresh
counterexamples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from detectors.base import Detector
from detectors.registry import load_detector, read_weights, save_detector
from detectors.types import CLASSES, Detections
from drivesem.analysis.transfer import TransferCounts, evaluate_pairs, load_target_detectors
from drivesem.attacks.labels import Difficulty
from drivesem.attacks.targets import HEADLINE, resolve_t_star
from drivesem.config.errors import UsageError
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.reporting.tables import Console
from drivesem.run.attack import AttackWorker, select_frames
from drivesem.run.detection_cache import weights_digest
from drivesem.run.finished import load_runs
from drivesem.run.folder import ARMS, RETRAINED
from drivesem.run.frame import detection_records, detections_from_records
from drivesem.run.results import BoxRecord
from drivesem.training.frames import AttackedFrame, FrameStore
from drivesem.training.retrain import discard_stale_run, load_start
from drivesem.training.validation import detect_in_store, score_detections
from scene_ir import files
from tools.experiments.detection.arms import ArmRun, AttackArm, AttackTotals, build_workers, run_arms
from tools.experiments.detection.counts import ArmCounts
from tools.experiments.detection.retraining_arms import (
    BENIGN,
    POOL,
    FrameDivision,
    RetrainingArm,
    TrainingPictures,
    benign_samples,
    benign_test_frames,
    build_retraining_arms,
    divide_frames,
    limit_sources,
    placebo_attack,
    test_attacks,
    train_arm,
    training_attack,
    validation_frames,
    weights_path,
)
from tools.experiments.detection.retraining_results import BenignMatches, RetrainingCounts
from tools.experiments.detection.robustness import FrameStateCounts, evaluate_states
from tools.experiments.detection.transfer import detection_settings
from tools.experiments.settings import StudyConfig

_STAMP = "attacked.txt"
"""Records next to weights that the fresh counterexamples are against them."""
_BENIGN_DETECTIONS, _VALIDATION_DETECTIONS = "benign.json", "validation.json"
"""Cached detections next to weights."""


@dataclass(frozen=True, slots=True)
class StudyInputs:
    """Inputs that are checked before anything is written."""

    attacks: Sequence[AttackArm]
    """The attack on the frames to train on, and its placebo if an arm needs it."""
    workers: Sequence[AttackWorker]
    """One worker for each attack."""
    arms: Sequence[RetrainingArm]
    """The retraining arms."""
    division: FrameDivision
    """Which frames are for what."""


def prepare_retraining(study: StudyConfig, out: Path) -> StudyInputs:
    """Check the settings of the study in `out`. Raises UsageError or SceneError."""
    arms = build_retraining_arms(study)
    attacks = [training_attack(study)]
    if any(arm.pictures in ("random", "generator") for arm in arms):
        attacks.append(placebo_attack(attacks[0], out))
    load_start(study.detector, study.device, "--detector")
    division = divide_frames(study)
    workers = limit_sources(build_workers(attacks), division.training)
    test_workers = limit_sources(build_workers(test_attacks(study, (), Path())), division.test)
    for worker, setting in ((workers[0], "--root"), (test_workers[0], "--held-out")):
        if not select_frames(worker.source, worker.config)[0]:
            raise UsageError(setting, "frames with vehicles", "none")
    return StudyInputs(attacks, workers, arms, division)


def run_retraining(study: StudyConfig, inputs: StudyInputs, out: Path, console: Console) -> RetrainingCounts:
    """Attack, train, attack again and test, or continue.

    Args:
        study: Settings of the study.
        inputs: From `prepare_retraining`.
        out: Folder of the study.
        console: Where progress is shown.

    Raises:
        UsageError: No counterexample to train on, or no frame to test on.
        SceneError: A frame that cannot be used, without --keep-going.
    """
    division, worker = inputs.division, inputs.workers[0]
    training = run_arms(inputs.attacks, inputs.workers, out)
    frames, random = ([_attacked_frames(run, out) for run in training.runs] + [[]])[:2]
    second = SecondRenderers(worker.config.dataset, worker.config.root)
    pictures = TrainingPictures(frames, random, worker, second, out / POOL, study.seed, study.near)
    reasons = {arm.name: pictures.missing(arm) for arm in inputs.arms}
    arms = [arm for arm in inputs.arms if reasons[arm.name] is None]
    benign = partial(benign_samples, division, frames, out=out)
    for arm in arms:
        train_arm(study, arm, pictures, benign, weights_path(out, arm), console)
    detectors = {BENIGN: study.detector} | {arm.name: str(weights_path(out, arm)) for arm in arms}
    store = benign_test_frames(study, division, load_detector(study.detector).classes, out, console)
    benign_matches = _test_on_benign_frames(study, store, detectors, out)
    for arm in arms:
        weights = weights_path(out, arm)
        discard_stale_run(out / ARMS / arm.run_name, weights, weights.parent / _STAMP)
    attacks = test_attacks(study, arms, out)
    test = run_arms(attacks, limit_sources(build_workers(attacks), division.test), out)
    if not test.runs[0].results:
        raise UsageError("--held-out", "frames with vehicles that can be de-rendered", "none")
    run = out / ARMS / attacks[0].folder
    known = _test_on_known(study, detectors, run, out)
    states: Sequence[FrameStateCounts] = ()
    failed: Mapping[str, str] = {}
    if study.states:
        (held_out,) = load_runs([str(run)])
        states, failed = evaluate_states(held_out, attacks[0].config, list(detectors.values()), study, out)
    left_out = {name: reason for name, reason in reasons.items() if reason is not None}
    left_out |= {f"states of frame {name}": reason for name, reason in failed.items()}
    left_out |= {f"second pictures of frame {one.identifier}": one.note for one in states if one.note}
    return RetrainingCounts(
        attack=training.runs[0].arm.name,
        training_attacks=AttackTotals.from_arms(training),
        test_attacks=AttackTotals.from_arms(test),
        counterexamples={arm.name: len(pictures.samples(arm, CLASSES)) for arm in arms},
        benign_training_frames=len(frames)
        if division.benign_training is None
        else len(division.benign_training[1]),
        benign_frames=store.names,
        benign_matches=benign_matches,
        known=known,
        fresh=[ArmCounts.from_run(one) for one in test.runs],
        left_out=left_out,
        states=states,
    )


def _attacked_frames(run: ArmRun, out: Path) -> list[AttackedFrame]:
    return [AttackedFrame(out / ARMS / run.arm.folder, result.identifier) for result in run.results]


def _test_on_benign_frames(
    study: StudyConfig, store: FrameStore, detectors: Mapping[str, str], out: Path
) -> dict[str, BenignMatches]:
    """Test each detector on the held-out benign frames; t* of a retrained one has the best F1 on the frames of
    --validation, or else on these.
    """
    targets = store.evaluation_targets(Difficulty())
    validation = validation_frames(study, store.classes, out)
    validation_targets = targets if validation is None else validation.evaluation_targets(Difficulty())
    results: dict[str, BenignMatches] = {}
    for name, spec in detectors.items():
        detector = load_detector(spec, study.device)
        folder = out / RETRAINED / ("benign" if name == BENIGN else Path(spec).parent.name)
        detections = cached_detections(detector, store, folder / _BENIGN_DETECTIONS, study.device)
        if name != BENIGN:
            chosen_on = detections
            if validation is not None:
                path = folder / _VALIDATION_DETECTIONS
                chosen_on = cached_detections(detector, validation, path, study.device)
            set_threshold(
                detector, Path(spec), score_detections(chosen_on, validation_targets, detector.classes).t_star
            )
        matches = ThresholdMatches.from_frames(targets, detections, detector.classes.index(HEADLINE))
        results[name] = BenignMatches(matches, resolve_t_star(detector, study.t_star))
    return results


def cached_detections(detector: Detector, store: FrameStore, path: Path, device: str) -> list[Detections]:
    """Detections in the frames of a store, cached by pictures and weights.

    Args:
        detector: The detector.
        store: The frames.
        path: File of the cache.
        device: Device of the detector.
    """
    key = {"weights": weights_digest(detector), "frames": list(store.names), "pictures": store.digest}
    if path.is_file():
        cached = files.read_json(path)
        if all(cached.get(name) == value for name, value in key.items()):
            records = [tuple(BoxRecord(**record) for record in rows) for rows in cached["detections"]]
            return [detections_from_records(rows, detector.classes) for rows in records]
    detections = detect_in_store(detector, store, range(len(store)), device)
    rows = [[asdict(record) for record in detection_records(one, detector.classes)] for one in detections]
    files.write_json(path, key | {"detections": rows})
    return detections


def set_threshold(detector: Detector, weights: Path, t_star: float) -> None:
    """Record t* with the detector's weights file, unless it is there."""
    facts, _ = read_weights(weights)
    if facts["t_star"] != f"{t_star:.6g}":
        detector.t_star = t_star
        save_detector(detector, weights, {name: facts[name] for name in ("retrained_from", "steps")})
    detector.t_star = float(f"{t_star:.6g}")


def _test_on_known(study: StudyConfig, detectors: Mapping[str, str], run: Path, out: Path) -> list[TransferCounts]:
    """Test all detectors on the held-out counterexamples of the original one."""
    settings = detection_settings(study)
    loaded = load_target_detectors(list(detectors.values()), settings, out, study.t_star)
    named = [replace(one, name=name) for one, name in zip(loaded, detectors, strict=True)]
    return evaluate_pairs(load_runs([str(run)]), named, settings)[0]
