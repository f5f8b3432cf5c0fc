"""How likely retrained detectors miss a car in the same sampled states of held-out frames.

The states lie anywhere that the attack may go, with all objects and the environment changed at once; a second
renderer draws some of them again. Further states lie around the certain failures of the original detector that an
attack found in the same frames.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.base import Predictor
from detectors.registry import load_detector
from drivesem.attacks.feasible.constraints import FeasibilityLimits
from drivesem.attacks.space import Parameter
from drivesem.attacks.targets import resolve_t_star
from drivesem.config.commands import AttackConfig
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import LEVEL, Interval
from drivesem.failures.certificate import NuisanceCamera, SampleImage
from drivesem.failures.grades import AGREEMENT_RULE
from drivesem.failures.neighbourhood import NEAR_REACH, Neighbourhood, SceneSampler
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.run.attack import resolve_parameters
from drivesem.run.detection_cache import weights_digest
from drivesem.run.driver import FrameAnalyser, ProgressSettings, analyse_frames
from drivesem.run.finished import AttackRun, rebuild_objective
from drivesem.run.folder import FRAMES
from drivesem.run.frame import certain_losses
from drivesem.run.labels import RESULT
from drivesem.run.results import load_frame
from scene_ir.errors import SceneError
from scene_ir.io import load_scene
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import interval_columns

ANYWHERE, REDRAWN, AROUND = "anywhere", "redrawn", "around"
KINDS = (ANYWHERE, REDRAWN, AROUND)
"""Kinds of states: anywhere within the bounds, some of those by a second renderer, around certain failures."""
CONTROLS = ("benign", "random")
"""Arms to compare with: further training on benign frames, and on random edits."""
GOAL = {
    "third": "a third fewer failures than on benign frames alone",
    "benign": "an interval apart from benign's",
    "AP50": "at most 0.5 points of AP50 lost",
    "random": "an interval apart from random edits'",
    "phantoms": "no more phantoms than on benign frames alone, or overlapping intervals",
}
"""Goals of retraining by short name, for states anywhere."""
STATES = "states"
"""Folder of the evaluated frames, in the study's."""
_MIN_REDUCTION, _MAX_AP50_DROP = 1 / 3, 0.005
_REDRAWN_SHARE = AGREEMENT_RULE[1] / 16
"""Share of states that a second renderer draws: as many as grading has it draw of its nuisance samples."""


@dataclass(frozen=True, slots=True)
class FailureCounts:
    """Failures of D detectors in states of one kind."""

    cars: int
    """Times that a car counts."""
    lost: tuple[int, ...]
    """Times that it is missed, by detector (D)."""
    pictures: int
    """Number of pictures."""
    phantoms: tuple[int, ...]
    """Pictures with a detection where nothing is, by detector (D)."""


@dataclass(frozen=True, slots=True)
class FrameStateCounts:
    """Failures in the states of one frame."""

    identifier: str
    """Name of the frame."""
    source: str
    """Digest of the run's result."""
    counts: dict[str, FailureCounts]
    """Failures by kind of states."""
    note: str
    """Why no second renderer drew the frame; empty if one did."""


class StateEvaluator(FrameAnalyser[FrameStateCounts]):
    """Tests detectors in sampled states of a run's frames, one process for many frames.

    Cars count that the original detector, the first, finds in the photograph.
    """

    file, kind, schema = "robust.json", FrameStateCounts, 1

    def __init__(
        self, run: AttackRun, attack: AttackConfig, detectors: Sequence[str], states: int, out: Path
    ) -> None:
        """Load the detectors.

        Args:
            run: An attack on held-out frames.
            attack: Its settings.
            detectors: Names or files; the attack was on the first.
            states: States of each kind in a frame.
            out: Folder of the evaluated frames.
        """
        super().__init__(run.folder, out)
        self.attack, self.states = attack, states
        self.params: tuple[Parameter, ...] = resolve_parameters(attack)
        # a run's scenes are read to the CPU
        self.detectors: list[Predictor] = [load_detector(name) for name in detectors]
        self.second = SecondRenderers(attack.dataset, attack.root)

    def analyse(self, name: str, folder: Path) -> FrameStateCounts:
        """See `FrameAnalyser`."""
        frame_folder = self.run_folder / FRAMES / name
        result = load_frame(frame_folder / RESULT)
        objective, state = rebuild_objective(result, frame_folder, self.attack, self.params, self.detectors[0])
        limits = FeasibilityLimits(joint_weather=result.joint_weather)
        feasible = objective.feasible_set(limits, self.attack.project == "bounds")
        nuisances, stream = Nuisances.parse(self.attack.nuisances), f"judging:{name}:{self.attack.seed}"
        sampler = SceneSampler(objective, feasible, nuisances, stream)
        cars, t_star = sampler.counted_objects, self.attack.t_star
        cameras = [
            replace(sampler.camera, detector=one, t_star=resolve_t_star(one, t_star)) for one in self.detectors
        ]
        counts, note = {}, ""
        counts[ANYWHERE] = _count_failures(cameras, ((sampler.render(n), cars) for n in range(self.states)))
        try:
            second = self.second.renderer_for(name, load_scene(frame_folder / "scene"))
            camera, again = replace(sampler.camera, renderer=second), range(redrawn_count(self.states))
            counts[REDRAWN] = _count_failures(cameras, ((sampler.render(n, camera), cars) for n in again))
        except SceneError as error:
            note = f"no second renderer: expected {error.expected}, found {error.actual}"
        around: list[tuple[SampleImage, list[int]]] = []
        for index in [one.index for one in certain_losses(result) if one.index is not None]:
            near = Neighbourhood(objective, feasible, state, index, nuisances, f"{stream}:{index}")
            samples = (near.sample(n, 1.0 if n % 2 == 0 else NEAR_REACH) for n in range(self.states))
            around += [(one.image, [index]) for one in samples if one is not None]
        counts[AROUND] = _count_failures(cameras, around)
        return FrameStateCounts(name, self.source_digest(name), counts, note)


def _count_failures(
    cameras: Sequence[NuisanceCamera], pictures: Iterable[tuple[SampleImage, Sequence[int]]]
) -> FailureCounts:
    """Misses and phantoms by detector in pictures, each with the indices of the cars that count if not ignored."""
    lost, phantoms = np.zeros(len(cameras), np.int64), np.zeros(len(cameras), np.int64)
    cars = count = 0
    for image, indices in pictures:
        counted = [index for index in indices if not bool(image.targets.ignore[index])]
        for place, camera in enumerate(cameras):
            outcome = camera.detect(image).outcome
            lost[place] += sum(not bool(outcome.detected[index]) for index in counted)
            phantoms[place] += bool(outcome.background)
        cars, count = cars + len(counted), count + 1
    return FailureCounts(cars, tuple(lost.tolist()), count, tuple(phantoms.tolist()))


def redrawn_count(states: int) -> int:
    """How many of so many states a second renderer draws."""
    return max(round(_REDRAWN_SHARE * states), 1)


def evaluate_states(
    run: AttackRun, attack: AttackConfig, detectors: Sequence[str], study: StudyConfig, out: Path
) -> tuple[list[FrameStateCounts], dict[str, str]]:
    """Test detectors in sampled states of a run's frames, or continue; results belong to these exact detectors.

    Args:
        run: An attack on held-out frames.
        attack: Its settings.
        detectors: Names or files; the attack was on the first.
        study: Settings of the study.
        out: Folder of the study.

    Returns:
        Counts of each frame, and the reason by frame that could not be used.
    """
    loaded = [(weights_digest(one), resolve_t_star(one, attack.t_star)) for one in map(load_detector, detectors)]
    name = hashlib.sha256(repr((loaded, study.states)).encode()).hexdigest()[:16]
    build = partial(StateEvaluator, run, attack, detectors, study.states, out / STATES / name)
    names = [frame.result.identifier for frame in run.frames]
    progress = ProgressSettings("testing detectors in sampled states", show_remaining=True)
    return analyse_frames(names, build(), build, study, progress)


@dataclass(frozen=True, slots=True)
class RobustnessRow:
    """How likely a retraining arm misses a car, its seeds together."""

    arm: str
    """Short name of the arm."""
    title: str
    """Its name in tables."""
    failures: dict[str, Interval]
    """Share of cars missed, by kind of states."""
    fewer: dict[tuple[str, str], Interval]
    """Reduction of failures by kind of states and by the arm compared with, a fraction, paired over frames."""
    phantoms: Interval
    """Share of pictures anywhere that have a phantom."""
    ap50_drop: float | None
    """Drop of AP50 on benign frames from the original detector, a mean over seeds."""
    short_of: tuple[str, ...] | None
    """Goals that are missed, by short name; None for arms without a goal."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name: fractions of 1, None where there is nothing to count."""
        row: dict[str, Any] = {"arm": self.arm, "name": self.title, "ap50_falls": self.ap50_drop}
        named = {f"failures_{kind}": one for kind, one in self.failures.items()} | {"phantoms": self.phantoms}
        named |= {f"fewer_{kind}_than_{arm}": one for (kind, arm), one in self.fewer.items()}
        for key, one in named.items():
            row |= interval_columns(key, one)
        return row | {"goal": None if self.short_of is None else not self.short_of}


def compare_robustness(
    frames: Sequence[FrameStateCounts],
    arms: Sequence[tuple[str, str]],
    drops: Mapping[str, Sequence[float | None]],
    draws: int,
    seed: int,
) -> list[RobustnessRow]:
    """Compare how likely the arms miss a car.

    Args:
        frames: Failures in the states of each frame.
        arms: Short name and title of each detector, in the order of the counts.
        drops: Drop of AP50 by arm, one for each seed.
        draws: Bootstrap draws of frames.
        seed: Seed of the draws.

    Returns:
        One row for each arm.
    """
    even = np.full(len(frames), 1 / len(frames))
    weights = np.random.default_rng(seed).multinomial(len(frames), even, draws).astype(np.float64)
    columns: dict[str, list[int]] = {}
    for column, (arm, _) in enumerate(arms):
        columns.setdefault(arm, []).append(column)
    shares = {(kind, arm): _shares(frames, kind, own, weights) for kind in KINDS for arm, own in columns.items()}
    rows = []
    for arm, own in columns.items():
        fewer = {
            (kind, other): _interval(
                kind, *(1 - _ratio(*pair) for pair in zip(shares[kind, arm], share, strict=True))
            )
            for (kind, other), share in shares.items()
            if other in CONTROLS and other != arm
        }
        known = [drop for drop in drops[arm] if drop is not None]
        rows.append(
            RobustnessRow(
                arm=arm,
                title=arms[own[0]][1],
                failures={kind: _interval(kind, *shares[kind, arm]) for kind in KINDS},
                fewer=fewer,
                phantoms=_interval("phantoms", *_shares(frames, ANYWHERE, own, weights, "phantoms")),
                ap50_drop=sum(known) / len(known) if known else None,
                short_of=None,
            )
        )
    by_arm = {row.arm: row for row in rows}
    if not set(CONTROLS) <= set(by_arm):
        return rows
    without_goal = (*CONTROLS, arms[0][0])
    return [row if row.arm in without_goal else replace(row, short_of=_missed_goals(row, by_arm)) for row in rows]


def _missed_goals(row: RobustnessRow, by_arm: Mapping[str, RobustnessRow]) -> tuple[str, ...]:
    own, (benign, random) = row.failures[ANYWHERE], (by_arm[name].failures[ANYWHERE] for name in CONTROLS)
    reduction = row.fewer[ANYWHERE, CONTROLS[0]].value
    met = {
        "third": reduction is not None and reduction >= _MIN_REDUCTION,
        "benign": _lies_below(own, benign),
        "AP50": row.ap50_drop is not None and row.ap50_drop <= _MAX_AP50_DROP,
        "random": _lies_below(own, random),
        "phantoms": not _lies_below(by_arm[CONTROLS[0]].phantoms, row.phantoms),
    }
    return tuple(goal for goal in GOAL if not met[goal])


def _lies_below(first: Interval, second: Interval) -> bool:
    """Whether all of the first interval lies below the second."""
    return first.high is not None and second.low is not None and first.high < second.low


def _shares(
    frames: Sequence[FrameStateCounts], kind: str, columns: Sequence[int], weights: Floats, what: str = "lost"
) -> tuple[Floats, Floats]:
    """Share () of cars lost, or of pictures with phantoms, a mean over detectors, and that of each draw (draws,);
    nan where nothing counts.
    """
    counts = [frame.counts[kind] for frame in frames if kind in frame.counts]
    rows = weights[:, [kind in frame.counts for frame in frames]]
    hits = np.array([sum(getattr(one, what)[c] for c in columns) / len(columns) for one in counts])
    totals = np.array([float(one.cars if what == "lost" else one.pictures) for one in counts])
    return _ratio(hits.sum(), totals.sum()), _ratio(rows @ hits, rows @ totals)


def _ratio(part: Floats, whole: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.asarray(whole) > 0, np.divide(part, whole), np.nan)


def _interval(name: str, value: Floats, drawn: Floats) -> Interval:
    known = drawn[np.isfinite(drawn)]
    if not np.isfinite(value):
        return Interval(name, None, None, None)
    if not len(known):
        return Interval(name, float(value), None, None)
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()
    return Interval(name, float(value), low, high)
