"""How likely detectors are to fail a car: the same states of held-out frames, in the same draws, before all.

The states are anywhere that the attack was allowed to go, all objects and what they share at once; a second
renderer draws some of them again. Beside them stand states around the certain failures of the detector as it was,
which an attack found in the same frames. Cars count that the detector as it was finds in the photograph.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.base import Predictor
from detectors.registry import load_detector
from drivesem.attack.feasible.bounds import Limits
from drivesem.attack.space import Parameter
from drivesem.attack.targets import t_star_of
from drivesem.config.commands import AttackConfig
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import LEVEL, Interval
from drivesem.failures.certificate import NuisanceCamera, SampleImage
from drivesem.failures.grades import AGREEMENT_RULE
from drivesem.failures.neighbourhood import NEAR_REACH, Neighbourhood, SceneSampler
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.run.attack import params_of
from drivesem.run.detection_cache import weights_digest
from drivesem.run.driver import FrameResultCache, ProgressSettings
from drivesem.run.finished import Run, rebuilt
from drivesem.run.folder import FRAMES
from drivesem.run.frame import RESULT
from drivesem.run.records import dump_record, load_record
from drivesem.run.results import load_frame
from drivesem.run.summary import certain_losses
from scene_ir import files
from scene_ir.errors import SceneError
from scene_ir.io import load_scene
from tools.experiments.settings import StudyConfig

ANYWHERE, REDRAWN, AROUND = "anywhere", "redrawn", "around"
"""States anywhere; some of them by the second renderer; states around certain failures."""
KINDS = (ANYWHERE, REDRAWN, AROUND)
CONTROLS = ("benign", "random")
"""Arms beside which others stand: what further training does, and what random edits do."""
LESS, AP50_FALLS = 1 / 3, 0.005
GOAL = {
    "third": "a third fewer failures than on benign frames alone",
    "benign": "intervals apart from benign's",
    "AP50": "at most 0.5 points of AP50 lost",
    "random": "intervals apart from random edits'",
    "phantoms": "phantoms no more than after benign frames alone, or intervals that meet",
}
"""What retraining is to reach, of states anywhere, by a short name."""
SCHEMA = 1
ROBUST, STATES = "robust.json", "states"
"""The file that marks a frame as done, and the folder of all of them."""
_REDRAWN_SHARE = AGREEMENT_RULE[1] / 16
"""Of the states: as many as grading has a second renderer draw of its draws."""


@dataclass(frozen=True, slots=True)
class FailureCounts:
    """Of one kind of states. cars: how often a car counts; lost: how often it is not found, by detector; pictures;
    phantoms: in how many of these something is reported where nothing is, by detector.
    """

    cars: int
    lost: tuple[int, ...]
    pictures: int
    phantoms: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class FrameStateCounts:
    """One frame. source: digest of the run's result; counts: by kind of states; note: why no second renderer drew,
    empty where one did.
    """

    identifier: str
    source: str
    counts: dict[str, FailureCounts]
    note: str


class StateEvaluator:
    """What one process needs: built once, used for many frames. run: an attack on held-out frames, against the
    first of the detectors; states: of each frame.
    """

    def __init__(self, run: Run, attack: AttackConfig, detectors: Sequence[str], states: int, out: Path) -> None:
        self.run, self.attack, self.states, self.out = run, attack, states, out
        self.params: tuple[Parameter, ...] = params_of(attack)
        # A run's scenes are read to the CPU.
        self.detectors: list[Predictor] = [load_detector(name) for name in detectors]
        self.second = SecondRenderers(attack.dataset, attack.root)
        self._cameras: list[NuisanceCamera] = []

    def __call__(self, name: str) -> None:
        """One frame, from the run's folder to its own."""
        source = self.run.folder / FRAMES / name
        result = load_frame(source / RESULT)
        objective, found = rebuilt(result, source, self.attack, self.params, self.detectors[0])
        limits = Limits(joint_weather=result.joint_weather)
        feasible = objective.feasible_set(limits, self.attack.project == "bounds")
        nuisances, stream = Nuisances.parse(self.attack.nuisances), f"judging:{name}:{self.attack.seed}"
        anywhere = SceneSampler(objective, feasible, nuisances, stream)
        counts, note = {}, ""
        cars = anywhere.judged
        asked = self.attack.t_star
        self._cameras = [replace(anywhere.camera, detector=d, t_star=t_star_of(d, asked)) for d in self.detectors]
        seen = [self._seen(anywhere.render(number), cars) for number in range(self.states)]
        counts[ANYWHERE] = self._counted(seen)
        try:
            second = self.second.of(name, load_scene(source / "scene"))
            camera, again = replace(anywhere.camera, renderer=second), range(redrawn_count(self.states))
            counts[REDRAWN] = self._counted([self._seen(anywhere.render(n, camera), cars) for n in again])
        except SceneError as error:
            note = f"no second renderer: expected {error.expected}, found {error.actual}"
        around = []
        for index in [one.index for one in certain_losses(result) if one.index is not None]:
            near = Neighbourhood(objective, feasible, found, index, nuisances, f"{stream}:{index}")
            samples = (near.sample(n, 1.0 if n % 2 == 0 else NEAR_REACH) for n in range(self.states))
            around += [self._seen(one.image, [index]) for one in samples if one is not None]
        counts[AROUND] = self._counted(around)
        kept = FrameStateCounts(name, files.sha256_digest(source / RESULT), counts, note)
        with files.atomic_folder(self.out / FRAMES / name) as part:
            files.write_text(part / ROBUST, dump_record(kept, SCHEMA))

    def _seen(self, exposure: SampleImage, cars: Sequence[int]) -> tuple[int, list[int], list[bool]]:
        """Cars that count in a picture; by detector, how many of them it does not find, and whether it reports
        what is not there.
        """
        counted = [index for index in cars if not bool(exposure.targets.ignore[index])]
        lost, phantoms = [], []
        for camera in self._cameras:
            judged = camera.detect(exposure).outcome
            lost.append(sum(not bool(judged.detected[index]) for index in counted))
            phantoms.append(bool(judged.background))
        return len(counted), lost, phantoms

    def _counted(self, seen: Sequence[tuple[int, list[int], list[bool]]]) -> FailureCounts:
        lost = np.array([lost for _, lost, _ in seen]).reshape(-1, len(self.detectors)).sum(0)
        phantoms = np.array([phantoms for _, _, phantoms in seen]).reshape(-1, len(self.detectors)).sum(0)
        cars = sum(count for count, _, _ in seen)
        return FailureCounts(cars, tuple(map(int, lost)), len(seen), tuple(map(int, phantoms)))


def redrawn_count(states: int) -> int:
    """How many of so many states a second renderer draws again."""
    return max(round(_REDRAWN_SHARE * states), 1)


def evaluate_states(
    run: Run, attack: AttackConfig, detectors: Sequence[str], study: StudyConfig, out: Path
) -> tuple[list[FrameStateCounts], dict[str, str]]:
    """Show states of a run's frames to detectors, or go on with it; and frames that could not be used, with
    reasons. What is kept belongs to these detectors, as they are.
    """
    seen = [(weights_digest(one), t_star_of(one, attack.t_star)) for one in map(load_detector, detectors)]
    name = hashlib.sha256(repr((seen, study.states)).encode()).hexdigest()[:16]
    folder = out / STATES / name
    build = partial(StateEvaluator, run, attack, detectors, study.states, folder)
    names = [frame.result.identifier for frame in run.frames]
    read = partial(load_record, kind=FrameStateCounts, schema=SCHEMA)
    return FrameResultCache(run.folder, folder, ROBUST, read).run(
        names, build(), build, study, ProgressSettings("asking all detectors", show_remaining=True)
    )


@dataclass(frozen=True, slots=True)
class RobustnessRow:
    """One arm, its seeds together. failures: by kind of states, the share of cars that are not found; fewer: by
    kind and the arm beside, the share of that arm's failures that this one is without, paired over frames;
    phantoms: the share of pictures anywhere that have any; ap50_falls: on benign frames, from the detector as it
    was, the mean over seeds. short_of: of GOAL what is not so, by short names; None for arms that it is not about.
    """

    arm: str
    title: str
    failures: dict[str, Interval]
    fewer: dict[tuple[str, str], Interval]
    phantoms: Interval
    ap50_falls: float | None
    short_of: tuple[str, ...] | None

    def to_row(self) -> dict[str, Any]:
        """Numbers by name: fractions of 1, None where there is nothing to count."""
        found: dict[str, Any] = {"arm": self.arm, "name": self.title, "ap50_falls": self.ap50_falls}
        told = {f"failures_{kind}": one for kind, one in self.failures.items()} | {"phantoms": self.phantoms}
        told |= {f"fewer_{kind}_than_{arm}": one for (kind, arm), one in self.fewer.items()}
        for key, one in told.items():
            found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found | {"goal": None if self.short_of is None else not self.short_of}


def compare_robustness(
    frames: Sequence[FrameStateCounts],
    arms: Sequence[tuple[str, str]],
    falls: Mapping[str, Sequence[float | None]],
    draws: int,
    seed: int,
) -> list[RobustnessRow]:
    """A row an arm. arms: arm and title of each detector, in the order in which they were asked; falls: of AP50,
    by arm, of each seed.
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
                kind, *(1 - _ratio(*pair) for pair in zip(shares[kind, arm], beside, strict=True))
            )
            for (kind, other), beside in shares.items()
            if other in CONTROLS and other != arm
        }
        phantoms = _shares(frames, ANYWHERE, own, weights, "phantoms")
        known = [one for one in falls[arm] if one is not None]
        row = RobustnessRow(
            arm,
            arms[own[0]][1],
            {kind: _interval(kind, *shares[kind, arm]) for kind in KINDS},
            fewer,
            _interval("phantoms", *phantoms),
            sum(known) / len(known) if known else None,
            None,
        )
        rows.append(row)
    by_arm = {row.arm: row for row in rows}
    if not set(CONTROLS) <= set(by_arm):
        return rows
    aimed = [row for row in rows if row.arm not in (*CONTROLS, arms[0][0])]
    return [replace(row, short_of=_short_of(row, by_arm)) if row in aimed else row for row in rows]


def _short_of(row: RobustnessRow, by_arm: Mapping[str, RobustnessRow]) -> tuple[str, ...]:
    """What GOAL asks for and is not so."""
    own, (benign, random) = row.failures[ANYWHERE], (by_arm[name].failures[ANYWHERE] for name in CONTROLS)
    less = row.fewer[ANYWHERE, CONTROLS[0]].value
    falls = row.ap50_falls
    met = {
        "third": less is not None and less >= LESS,
        "benign": _below(own, benign),
        "AP50": falls is not None and falls <= AP50_FALLS,
        "random": _below(own, random),
        "phantoms": not _below(by_arm[CONTROLS[0]].phantoms, row.phantoms),
    }
    return tuple(what for what in GOAL if not met[what])


def _below(one: Interval, other: Interval) -> bool:
    """Whether all of an interval lies below the other."""
    return one.high is not None and other.low is not None and one.high < other.low


def _shares(
    frames: Sequence[FrameStateCounts], kind: str, columns: Sequence[int], weights: Floats, what: str = "lost"
) -> tuple[Floats, Floats]:
    """The share () of cars lost, or of pictures with phantoms, a mean over detectors; and the same of each draw
    (draws,). nan where nothing counts.
    """
    counts = [frame.counts[kind] for frame in frames if kind in frame.counts]
    rows = weights[:, [kind in frame.counts for frame in frames]]
    hits = np.array([sum(getattr(one, what)[c] for c in columns) / len(columns) for one in counts])
    of = np.array([float(one.cars if what == "lost" else one.pictures) for one in counts])
    return _ratio(hits.sum(), of.sum()), _ratio(rows @ hits, rows @ of)


def _ratio(part: Floats, whole: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.asarray(whole) > 0, np.divide(part, whole), np.nan)


def _interval(name: str, value: Floats, drawn: Floats) -> Interval:
    known = drawn[np.isfinite(drawn)]
    if not np.isfinite(value):
        return Interval(name, None, None, None)
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]) if len(known) else (None, None)
    return Interval(name, float(value), None if low is None else float(low), None if high is None else float(high))
