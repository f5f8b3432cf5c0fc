"""Detectors trained on with counterexamples, before benign frames, known and fresh counterexamples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from detectors.base import Detector
from detectors.registry import load_detector, read_weights, save_detector
from detectors.types import CLASSES, Detections
from drivesem.analysis.transfer.asking import detectors_of, pairs_of
from drivesem.analysis.transfer.matrix import PairCounts
from drivesem.attack.labels import Difficulty
from drivesem.attack.targets import HEADLINE, t_star_of
from drivesem.config.blocks import DetectionOptions
from drivesem.config.errors import UsageError
from drivesem.evaluation.matches import Matches
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.report.terminal import Console
from drivesem.run.attack import Worker, select_frames
from drivesem.run.detection_cache import weights_digest
from drivesem.run.finished import load_runs
from drivesem.run.folder import ARMS, RETRAINED
from drivesem.run.frame import as_detections, detection_records
from drivesem.run.results import BoxRecord
from drivesem.training.attacked import AttackedFrame
from drivesem.training.frames import FrameStore
from drivesem.training.judging import detect, judge
from drivesem.training.retraining import forget_other_weights
from scene_ir import files
from tools.experiments.detection import lessons as plan
from tools.experiments.detection import robust
from tools.experiments.detection.arms import AttackArm
from tools.experiments.detection.counts import ArmCounts
from tools.experiments.detection.lessons import BENIGN, FrameDivision, RetrainingArm, TrainingPictures
from tools.experiments.detection.running import ArmRun, AttackTotals, build_workers, run_arms
from tools.experiments.detection.taught import BenignMatches, RetrainingCounts
from tools.experiments.settings import StudyConfig

_STAMP = "attacked.txt"
"""Beside weights: which of them the fresh counterexamples are against."""
_SEEN, _CHOSEN = "benign.json", "validation.json"
"""Beside weights: what was found in benign frames, and in those on which t* is chosen."""


@dataclass(frozen=True, slots=True)
class StudyInputs:
    """What is checked before anything is written. arms, workers: of the attack on frames to train on, and of its
    placebo where that is trained on.
    """

    arms: Sequence[AttackArm]
    workers: Sequence[Worker]
    lessons: Sequence[RetrainingArm]
    parts: FrameDivision


def prepare_retraining(study: StudyConfig, out: Path) -> StudyInputs:
    """Raises UsageError or SceneError for bad settings."""
    lessons = plan.build_retraining_arms(study)
    arms = [plan.training_attack(study)]
    if any(lesson.pictures in ("random", "generator") for lesson in lessons):
        arms.append(plan.placebo_attack(arms[0], out))
    plan.startable(study.detector, study.device, "--detector")
    parts = plan.divide_frames(study)
    workers = plan.limit_sources(build_workers(arms), parts.training)
    judging = plan.test_attacks(study, (), Path())
    held_out = plan.limit_sources(build_workers(judging), parts.test)
    for one, setting in ((workers[0], "--root"), (held_out[0], "--held-out")):
        if not select_frames(one.source, one.config)[0]:
            raise UsageError(setting, "frames with vehicles", "none")
    return StudyInputs(arms, workers, lessons, parts)


def run_retraining(study: StudyConfig, ready: StudyInputs, out: Path, console: Console) -> RetrainingCounts:
    """Attack, train, attack again, judge: what is there already stays. Raises UsageError or SceneError."""
    learned = run_arms(ready.arms, ready.workers, out)
    frames, random = ([_frames(one, out) for one in learned.runs] + [[]])[:2]
    worker, parts = ready.workers[0], ready.parts
    second = SecondRenderers(worker.config.dataset, worker.config.root)
    taken = TrainingPictures(frames, random, worker, second, out / plan.POOL, study.seed, study.near)
    reasons = {lesson.name: taken.missing(lesson) for lesson in ready.lessons}
    lessons = [lesson for lesson in ready.lessons if reasons[lesson.name] is None]
    benign = partial(plan.benign_samples, parts, frames, out=out)
    for lesson in lessons:
        plan.train_arm(study, lesson, taken, benign, plan.weights_path(out, lesson), console)
    names = {BENIGN: study.detector}
    names |= {lesson.name: str(plan.weights_path(out, lesson)) for lesson in lessons}
    store = plan.held_out_frames(study, parts, load_detector(study.detector).classes, out, console)
    seen = _on_benign_frames(study, store, names, out)
    for lesson in lessons:
        weights = plan.weights_path(out, lesson)
        forget_other_weights(out / ARMS / lesson.run_name, weights, weights.parent / _STAMP)
    arms = plan.test_attacks(study, lessons, out)
    judged = run_arms(arms, plan.limit_sources(build_workers(arms), parts.test), out)
    if not judged.runs[0].results:
        raise UsageError("--held-out", "frames with vehicles that can be taken apart", "none")
    known = _known(study, names, out / ARMS / arms[0].folder, out)
    states: Sequence[robust.FrameStateCounts] = ()
    failed: Mapping[str, str] = {}
    if study.states:
        (held_out,) = load_runs([str(out / ARMS / arms[0].folder)])
        states, failed = robust.evaluate_states(held_out, arms[0].config, list(names.values()), study, out)
    left_out = {name: reason for name, reason in reasons.items() if reason is not None}
    left_out |= {f"states of frame {name}": reason for name, reason in failed.items()}
    left_out |= {f"second pictures of frame {one.identifier}": one.note for one in states if one.note}
    return RetrainingCounts(
        attack=learned.runs[0].arm.name,
        training_attacks=AttackTotals.from_arms(learned),
        test_attacks=AttackTotals.from_arms(judged),
        counterexamples={lesson.name: len(taken.samples(lesson, CLASSES)) for lesson in lessons},
        benign_training_frames=len(frames) if parts.benign_training is None else len(parts.benign_training[1]),
        benign_frames=store.names,
        benign_matches=seen,
        known=known,
        fresh=[ArmCounts.from_run(one) for one in judged.runs],
        left_out=left_out,
        states=states,
    )


def _frames(run: ArmRun, out: Path) -> list[AttackedFrame]:
    return [AttackedFrame(out / ARMS / run.arm.folder, result.identifier) for result in run.results]


def _on_benign_frames(
    study: StudyConfig, store: FrameStore, names: Mapping[str, str], out: Path
) -> dict[str, BenignMatches]:
    """Each detector on held-out benign frames. A retrained one's t* is the score of best F1 on those of
    --validation, or else on these.
    """
    wanted = store.judged(Difficulty())
    choosing = plan.validation_frames(study, store.classes, out)
    chosen_on = wanted if choosing is None else choosing.judged(Difficulty())
    found: dict[str, BenignMatches] = {}
    for name, spec in names.items():
        detector = load_detector(spec, study.device)
        folder = out / RETRAINED / ("benign" if name == BENIGN else Path(spec).parent.name)
        seen = cached_detections(detector, store, folder / _SEEN, study.device)
        if name != BENIGN:
            chooses = seen
            if choosing is not None:
                chooses = cached_detections(detector, choosing, folder / _CHOSEN, study.device)
            set_threshold(detector, Path(spec), judge(chooses, chosen_on, detector.classes).t_star)
        matches = Matches.of(wanted, seen, detector.classes.index(HEADLINE))
        found[name] = BenignMatches(matches, t_star_of(detector, study.t_star))
    return found


def cached_detections(detector: Detector, store: FrameStore, path: Path, device: str) -> list[Detections]:
    """What is found in the frames of a store, remembered with their pictures and the weights that found it."""
    key = {"weights": weights_digest(detector), "frames": list(store.names), "pictures": store.digest}
    if path.is_file():
        kept = files.read_json(path)
        if all(kept.get(name) == value for name, value in key.items()):
            records = [tuple(BoxRecord(**record) for record in rows) for rows in kept["detections"]]
            return [as_detections(rows, detector.classes) for rows in records]
    found = detect(detector, store, range(len(store)), device)
    rows = [[asdict(record) for record in detection_records(one, detector.classes)] for one in found]
    files.write_json(path, key | {"detections": rows})
    return found


def set_threshold(detector: Detector, weights: Path, t_star: float) -> None:
    """Write it beside the weights, unless it is there."""
    facts, _ = read_weights(weights)
    if facts["t_star"] != f"{t_star:.6g}":
        detector.t_star = t_star
        kept = {name: facts[name] for name in ("retrained_from", "steps")}
        save_detector(detector, weights, kept)
    detector.t_star = float(f"{t_star:.6g}")


def _known(study: StudyConfig, names: Mapping[str, str], run: Path, out: Path) -> list[PairCounts]:
    """The held-out counterexamples against the detector as it was, before all detectors."""
    settings = DetectionOptions(
        seed=study.seed,
        workers=study.workers,
        device=study.device,
        keep_going=study.keep_going,
    )
    asked = detectors_of(list(names.values()), settings, out, study.t_star)
    named = [replace(one, name=name) for one, name in zip(asked, names, strict=True)]
    return pairs_of(load_runs([str(run)]), named, settings)[0]
