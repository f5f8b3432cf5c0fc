"""Detectors trained on with counterexamples, before benign frames, known and fresh counterexamples."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.base import Detector
from detectors.registry import load_detector, read_weights, save_detector
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.judging import HEADLINE, t_star_of
from drivesem.attack.labels import Difficulty
from drivesem.evaluation.coco import ClassScores, evaluate
from drivesem.evaluation.resampling import Figure, Interval, differences, intervals
from drivesem.questions.study import lessons as plan
from drivesem.questions.study import robust
from drivesem.questions.study.arms import Arm, draws_of
from drivesem.questions.study.counts import ArmCounts
from drivesem.questions.study.lessons import BENIGN, RETRAINED, Lesson, Parts, Taken
from drivesem.questions.study.rows import MODES, Figures, StudyRow, feasible_fraction, rows_of
from drivesem.questions.study.running import ARMS, ArmRun, Ran, run_arms, workers_of
from drivesem.questions.transfer.asking import detectors_of
from drivesem.questions.transfer.asking import rows_of as transfer_rows
from drivesem.questions.transfer.matrix import AP50, BROKEN, TransferRow, figures_of
from drivesem.report.terminal import Console
from drivesem.run.attack import Worker, select_frames
from drivesem.run.finished import load_runs
from drivesem.run.frame import as_detections, detection_records
from drivesem.run.looking import weights_digest
from drivesem.run.results import BoxRecord
from drivesem.settings.blocks import Asking
from drivesem.settings.commands import Study
from drivesem.settings.errors import UsageError
from drivesem.training.attacked import AttackedFrame
from drivesem.training.frames import FrameStore
from drivesem.training.judging import detect, judge
from drivesem.training.retraining import forget_other_weights
from drivesem.truth.redraw.choose import SecondRenderers
from scene_ir import files

_STAMP = "attacked.txt"
"""Beside weights: which of them the fresh counterexamples are against."""
_SEEN, _CHOSEN = "benign.json", "validation.json"
"""Beside weights: what was found in benign frames, and in those on which t* is chosen."""


@dataclass(frozen=True, slots=True)
class Judged:
    """One detector. benign: HEADLINE's figures on held-out benign frames; spread: their AP50 with bounds; known:
    the counterexamples against the detector as it was; fresh: those against this one. drops: of AP50 and recall on
    benign frames, from the detector as it was; gains: of AP50 by label mode, on known and on fresh ones, over what
    the detector as it was has on its own. All paired over frames. fresh: None where there were no such attacks.
    """

    name: str
    reference: tuple[float, float] | None
    t_star: float
    benign_frames: int
    benign: ClassScores
    spread: dict[str, Interval]
    known: TransferRow
    fresh: StudyRow | None
    drops: dict[str, Interval]
    gains: dict[str, dict[str, Interval]]

    def flat(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        counterexamples, benign = self.reference or (None, None)
        theirs, fresh = (
            self.known.flat(),
            defaultdict[str, Any](lambda: None, self.fresh.flat() if self.fresh else {}),
        )
        found: dict[str, Any] = {
            "name": self.name,
            "benign_ap50": self.benign.ap50,
            "paper_ap50": theirs["paper_ap50"],
            "moved_ap50": theirs["moved_ap50"],
            "drop_paper": theirs["drop_paper"],
            "drop_moved": theirs["drop_moved"],
            "recall_paper": theirs["paper_recall"],
            "recall_moved": theirs["moved_recall"],
            "reference": counterexamples,
            "reference_benign": benign,
            "t_star": self.t_star,
            "benign_frames": self.benign_frames,
            "benign_objects": self.benign.objects,
            "benign_recall": self.benign.recall,
            "frames": self.known.frames,
            "photographs_ap50": theirs["benign_ap50"],
            "broken_rate": theirs[BROKEN],
            "fresh_paper_ap50": fresh["paper_ap50"],
            "fresh_moved_ap50": fresh["moved_ap50"],
            "fresh_recall_moved": fresh["recall_moved"],
            "fresh_broken_rate": fresh["successes_moved"] / fresh["frames"] if fresh["frames"] else None,
            "feasible_fraction": fresh["feasible_fraction"],
        }
        bounded = {f"benign_{'' if key == AP50 else 'recall_'}drop": one for key, one in self.drops.items()}
        for name, gains in self.gains.items():
            prefix = "" if name == "known" else f"{name}_"
            bounded |= {f"{prefix}gain_{mode}": one for mode, one in gains.items()}
        for key, one in bounded.items():
            found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found


@dataclass(frozen=True, slots=True)
class Taught:
    """All that the study found. learned, judged: attacks on frames to train on, and on held-out ones; lessons with
    how many different counterexamples were shown in each; benign: frames to train on beside them; left_out: arms
    that could not be trained, what could not be judged, and why; chances: how likely each arm fails a car, in
    states of so many frames.
    """

    study: Study
    draws: int
    learned: Ran
    judged: Ran
    lessons: Mapping[str, tuple[Lesson, int]]
    benign: int
    rows: Sequence[Judged]
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    chances: Sequence[robust.RobustRow] = ()
    state_frames: int = 0

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        results = [result for ran in (self.learned, self.judged) for run in ran.runs for result in run.results]
        return {
            "study": self.study.name,
            "headline": HEADLINE,
            "frames": self.rows[0].known.frames,
            "benign_frames": self.rows[0].benign_frames,
            "frames_without_vehicles": self.learned.without_vehicles + self.judged.without_vehicles,
            "frames_failed": {**self.learned.failed, **self.judged.failed},
            "feasible_fraction": feasible_fraction(results),
            "bootstrap": self.draws,
            "attacked_to_train_on": len(self.learned.runs[0].results),
            "benign_to_train_on": self.benign,
            "training": {
                name: {"counterexamples": count, **_training(lesson)}
                for name, (lesson, count) in self.lessons.items()
            },
            "rows": [row.flat() for row in self.rows],
            "left_out": dict(self.left_out),
            "state_frames": self.state_frames,
            "states": self.study.states,
            "robust": [row.flat() for row in self.chances],
        }


def _training(lesson: Lesson) -> dict[str, Any]:
    told = ("seed", "steps", "batch", "window", "scale", "rate", "fraction", "mix", "loss", "precision")
    return {"pictures": lesson.pictures, "labels": lesson.labels, "weight": lesson.weight} | {
        key: getattr(lesson.config, key) for key in told
    }


@dataclass(frozen=True, slots=True)
class Ready:
    """What is checked before anything is written. arms, workers: of the attack on frames to train on, and of its
    placebo where that is trained on.
    """

    arms: Sequence[Arm]
    workers: Sequence[Worker]
    lessons: Sequence[Lesson]
    parts: Parts


def prepare(study: Study, out: Path) -> Ready:
    """Raises UsageError or SceneError for bad settings."""
    lessons = plan.lessons_of(study)
    arms = [plan.learning_arm(study)]
    if any(lesson.pictures in ("random", "generator") for lesson in lessons):
        arms.append(plan.placebo_arm(arms[0], out))
    plan.startable(study.detector, study.device, "--detector")
    parts = plan.parts_of(study)
    workers = plan.among(workers_of(arms), parts.learned)
    judging = plan.judging_arms(study, (), Path())
    held_out = plan.among(workers_of(judging), parts.judged)
    for one, setting in ((workers[0], "--root"), (held_out[0], "--held-out")):
        if not select_frames(one.source, one.config)[0]:
            raise UsageError(setting, "frames with vehicles", "none")
    return Ready(arms, workers, lessons, parts)


def run(study: Study, ready: Ready, out: Path, console: Console) -> Taught:
    """Attack, train, attack again, judge: what is there already stays. Raises UsageError or SceneError."""
    learned = run_arms(ready.arms, ready.workers, out)
    frames, random = ([_frames(one, out) for one in learned.runs] + [[]])[:2]
    worker, parts = ready.workers[0], ready.parts
    second = SecondRenderers(worker.config.dataset, worker.config.root)
    taken = Taken(frames, random, worker, second, out / plan.POOL, study.seed, study.near)
    reasons = {lesson.name: taken.missing(lesson) for lesson in ready.lessons}
    lessons = [lesson for lesson in ready.lessons if reasons[lesson.name] is None]
    benign = partial(plan.benign_samples, parts, frames, out=out)
    for lesson in lessons:
        plan.learn(study, lesson, taken, benign, plan.weights_of(out, lesson), console)
    names = {BENIGN: study.detector}
    names |= {lesson.name: str(plan.weights_of(out, lesson)) for lesson in lessons}
    seen = _on_benign_frames(study, ready, names, out, console)
    for lesson in lessons:
        weights = plan.weights_of(out, lesson)
        forget_other_weights(out / ARMS / lesson.run, weights, weights.parent / _STAMP)
    arms = plan.judging_arms(study, lessons, out)
    judged = run_arms(arms, plan.among(workers_of(arms), parts.judged), out)
    if not judged.runs[0].results:
        raise UsageError("--held-out", "frames with vehicles that can be taken apart", "none")
    known = _known(study, names, out / ARMS / arms[0].folder, out)
    draws = draws_of(study)
    rows = rows_for(study, lessons, seen, known, judged.runs, draws)
    states: Sequence[robust.FrameStates] = ()
    failed: Mapping[str, str] = {}
    if study.states:
        (held_out,) = load_runs([str(out / ARMS / arms[0].folder)])
        states, failed = robust.states_of(held_out, arms[0].config, list(names.values()), study, out)
    shown = {lesson.name: (lesson, len(taken.shown(lesson, CLASSES))) for lesson in lessons}
    trained_on = len(frames) if parts.benign is None else len(parts.benign[1])
    left_out = {name: reason for name, reason in reasons.items() if reason is not None}
    left_out |= {f"states of frame {name}": reason for name, reason in failed.items()}
    left_out |= {f"second pictures of frame {one.identifier}": one.note for one in states if one.note}
    chances = robust_rows(lessons, rows, states, draws, study.seed)
    return Taught(study, draws, learned, judged, shown, trained_on, rows, left_out, chances, len(states))


def _frames(run: ArmRun, out: Path) -> list[AttackedFrame]:
    folder = out / ARMS / run.arm.folder / "frames"
    return [AttackedFrame(folder / result.identifier) for result in run.results]


def robust_rows(
    lessons: Sequence[Lesson], rows: Sequence[Judged], states: Sequence[robust.FrameStates], draws: int, seed: int
) -> list[robust.RobustRow]:
    """How likely each arm fails a car: the detector as it was, then the lessons, their seeds together."""
    if not states:
        return []
    arms = [(BENIGN, BENIGN), *((lesson.arm, lesson.name) for lesson in lessons)]
    falls: dict[str, list[float | None]] = {}
    for (arm, _), row in zip(arms, rows, strict=True):
        falls.setdefault(arm, []).append(row.drops[AP50].value)
    return robust.rows_of(states, arms, falls, draws, seed)


@dataclass(frozen=True, slots=True)
class Seen:
    """A detector on benign frames."""

    scores: ClassScores
    figures: list[Figure]
    frames: int
    t_star: float


def _on_benign_frames(
    study: Study, ready: Ready, names: Mapping[str, str], out: Path, console: Console
) -> dict[str, Seen]:
    """Each detector on the held-out benign frames. A retrained one's t* is the score of best F1 on those of
    --validation, or else on these.
    """
    first = load_detector(study.detector, study.device)
    store = plan.held_out_frames(study, ready.parts, first.classes, out, console)
    wanted = store.judged(Difficulty())
    choosing = plan.validation_frames(study, first.classes, out)
    chosen_on = wanted if choosing is None else choosing.judged(Difficulty())
    found: dict[str, Seen] = {}
    for name, spec in names.items():
        detector = load_detector(spec, study.device)
        folder = out / RETRAINED / ("benign" if name == BENIGN else Path(spec).parent.name)
        seen = look_at(detector, store, folder / _SEEN, study.device)
        if name != BENIGN:
            chooses = seen
            if choosing is not None:
                chooses = look_at(detector, choosing, folder / _CHOSEN, study.device)
            set_threshold(detector, Path(spec), judge(chooses, chosen_on, detector.classes).t_star)
        found[name] = seen_by(detector, seen, wanted, t_star_of(detector, study.t_star))
    return found


def seen_by(detector: Detector, found: Sequence[Detections], wanted: Sequence[Targets], t_star: float) -> Seen:
    """The figures of what a detector found in benign frames."""
    scores = evaluate(wanted, found, detector.classes, t_star, HEADLINE).headline
    figures = figures_of(wanted, found, detector.classes.index(HEADLINE))
    return Seen(scores, figures, len(wanted), t_star)


def look_at(detector: Detector, store: FrameStore, path: Path, device: str) -> list[Detections]:
    """What is found in the frames of a store, remembered with the weights that found it."""
    key = {"weights": weights_digest(detector), "frames": list(store.names)}
    if path.is_file():
        kept = files.read_json(path)
        if all(kept[name] == value for name, value in key.items()):
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


def _known(study: Study, names: Mapping[str, str], run: Path, out: Path) -> list[TransferRow]:
    """The held-out counterexamples against the detector as it was, before all detectors."""
    settings = Asking(
        seed=study.seed,
        workers=study.workers,
        device=study.device,
        keep_going=study.keep_going,
        bootstrap=study.bootstrap,
    )
    asked = detectors_of(list(names.values()), settings, out, study.t_star)
    named = [replace(one, name=name) for one, name in zip(asked, names, strict=True)]
    return transfer_rows(load_runs([str(run)]), named, settings)[0]


def rows_for(
    study: Study,
    lessons: Sequence[Lesson],
    seen: Mapping[str, Seen],
    known: Sequence[TransferRow],
    runs: Sequence[ArmRun],
    draws: int,
) -> list[Judged]:
    counts = [ArmCounts.of(run) for run in runs]
    fresh = rows_of(counts, draws, study.seed)
    figures = [Figures.of(one).after for one in counts]
    before = seen[BENIGN]
    found = []
    for i, (name, one) in enumerate(seen.items()):
        gains = {
            "known": {
                m: _gain(known[0].figures[m], known[i].figures[m], known[i].frames, draws, study) for m in MODES
            },
        }
        again = i < len(runs)
        if again:
            frames = len(runs[i].results)
            gains["fresh"] = {m: _gain(figures[0][m], figures[i][m], frames, draws, study) for m in MODES}
        rng = np.random.default_rng(study.seed)
        fallen = differences(one.figures, before.figures, one.frames, draws, rng)
        spread = {
            "benign": _spread(one.figures, one.frames, draws, study),
            "known": _spread(known[i].figures["moved"], known[i].frames, draws, study),
        }
        if again:
            spread["fresh"] = _spread(figures[i]["moved"], len(runs[i].results), draws, study)
        found.append(
            Judged(
                name=name,
                reference=plan.reference_of(name, lessons, study),
                t_star=one.t_star,
                benign_frames=one.frames,
                benign=one.scores,
                spread=spread,
                known=known[i],
                fresh=fresh[i] if again else None,
                drops={d.name: d.interval for d in fallen},
                gains=gains,
            )
        )
    return found


def _gain(before: Sequence[Figure], after: Sequence[Figure], frames: int, draws: int, study: Study) -> Interval:
    """How far the first figure, AP50, rises; paired over frames."""
    (one,) = differences(before[:1], after[:1], frames, draws, np.random.default_rng(study.seed))
    return one.interval


def _spread(figures: Sequence[Figure], frames: int, draws: int, study: Study) -> Interval:
    (one,) = intervals(figures[:1], frames, draws, np.random.default_rng(study.seed))
    return one
