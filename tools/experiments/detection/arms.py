"""The arms of each study: attacks and their controls on the same frames, run or continued frame by frame."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.transfer import parse_detector_names, shorten_detector_names
from drivesem.attacks.methods.base import GRADIENT_PASSES
from drivesem.attacks.space import PAPER_PARAMETERS, Parameter
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.commands import COMBO_NUMBERS, DEFAULT_COMBO, AttackConfig
from drivesem.config.options import GradingOptions, SceneAttackOptions, WorkerOptions, shared_options
from drivesem.run.attack import WRITTEN, AttackWorker, attack_frames, select_frames
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import ARMS, FRAMES, PRESENTATION, claim_folder
from drivesem.run.frame import write_frame
from drivesem.run.labels import RESULT
from drivesem.run.results import FrameResult, RunSummary, load_frame
from drivesem.run.run_report import PAPER_COMBOS, PAPER_SINGLE, PROTOCOL, follows_paper
from drivesem.scenes.sources import NoVehicleError, SceneSource
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.settings import StudyConfig

PLACEBO, RANDOM = "placebo", "random"
"""Controls: one random edit as large as the attack's own; and the best of as many random samples as the attack
takes steps, from the box that those steps can reach."""
PAPER_PROTOCOL = "paper's protocol"
STUDY_JSON = "study.json"
"""A study's metrics, in its folder."""
SEARCH_METHODS = ("climb", "corners", "si-fgsm", "apgd", "halton", "cma-es")
"""Methods of the study `searches`; the placebo is as large as the edits of the first."""
_QUICK_FRAMES, _FRAMES = 6, 200
_DRAWS = 1000
_CONTROL_SEEDS = 3
_APGD_FACTOR = 4
"""Steps of Auto-PGD, in multiples of --steps: enough for its step size to shrink."""
_STEPS_FACTOR = 2
"""Steps of the study `steps`, in multiples of --steps: enough to see where more are of no use."""
_FREE_SETTINGS = (*PRESENTATION, "like")
"""Settings of an arm that may differ when a study is continued: its folder may have moved."""


@dataclass(frozen=True, slots=True)
class AttackArm:
    """One attack on all frames of a study."""

    name: str
    """Name in tables."""
    folder: str
    """Folder of its run, inside `arms`."""
    config: AttackConfig
    """Settings of the attack."""
    reference: float | None = None
    """The paper's mAP after this attack, a fraction."""
    control: str | None = None
    """RANDOM or PLACEBO, of a control."""
    control_of: str | None = None
    """Name of the arm that a control belongs to."""


@dataclass(frozen=True, slots=True)
class ArmRun:
    """The finished run of an arm."""

    arm: AttackArm
    """The arm."""
    summary: RunSummary
    """Totals of its run."""
    results: tuple[FrameResult, ...]
    """Results of the frames that all arms have, in the same order."""
    judged: EvaluatedClasses
    """Classes of its detector that count."""


@dataclass(frozen=True, slots=True)
class StudyArms:
    """The finished runs of all arms."""

    runs: tuple[ArmRun, ...]
    """One run for each arm."""
    without_vehicles: int
    """Frames skipped for lack of vehicles."""
    failed: dict[str, str]
    """Reason by frame that could not be used."""


@dataclass(frozen=True, slots=True)
class AttackTotals:
    """Totals over the attacks of a study."""

    frames: int
    """Frames that all arms have."""
    pictures: int
    """Attacked pictures of all arms."""
    feasible: int
    """Attacked pictures that pass the independent feasibility check."""
    without_vehicles: int
    """Frames skipped for lack of vehicles."""
    failed: dict[str, str]
    """Reason by frame that could not be used."""

    @classmethod
    def from_arms(cls, arms: StudyArms) -> AttackTotals:
        """Count the results of finished arms."""
        feasible = [result.feasible for run in arms.runs for result in run.results]
        frames = len(arms.runs[0].results)
        return cls(frames, len(feasible), sum(feasible), arms.without_vehicles, arms.failed)


def feasible_share(*attacks: AttackTotals) -> float | None:
    """Share of attacked pictures that are feasible, a fraction; None without pictures."""
    pictures = sum(one.pictures for one in attacks)
    return sum(one.feasible for one in attacks) / pictures if pictures else None


def base_attack(study: StudyConfig) -> AttackConfig:
    """The attack that the arms of a study vary."""
    limit = study.limit or (_QUICK_FRAMES if study.quick else _FRAMES)
    common: dict[str, Any] = {}
    for block in (SceneAttackOptions, GradingOptions, WorkerOptions):
        common |= shared_options(study, block)
    # --confirm of a study re-tests whole arms; certain failures are confirmed in any case.
    common |= {"limit": limit, "method": study.method, "confirm": AttackConfig.confirm}
    return AttackConfig(**common)


def bootstrap_draws(study: StudyConfig) -> int:
    """Bootstrap draws of frames for intervals."""
    return _DRAWS if study.bootstrap is None else study.bootstrap


def build_arms(study: StudyConfig, out: Path) -> list[AttackArm]:
    """The arms of a study that writes into `out`; a placebo follows the arm that it matches in size."""
    base = base_attack(study)
    combo = replace(base, combo=DEFAULT_COMBO)
    match study.name:
        case "single" | "multi":
            return _paper_arms(base, study, out)
        case "grades":
            return _grade_arms(base, out)
        case "searches":
            return _search_arms(base, study, out)
        case "samples":
            return _sample_arms(combo, study)
        case "transfer":
            sources = _source_arms(base, study)
            return _add_controls(sources, out, (PLACEBO,)) if study.controls else sources
        case "steps":
            config = replace(combo, method="si-fgsm", steps=_STEPS_FACTOR * study.steps, early_stop=True)
            rates = (0.5, 1.0, 2.0) if study.quick else (0.25, 0.5, 1.0, 2.0, 4.0)
            return [_arm(f"rate {rate:g}", replace(config, rate=rate)) for rate in rates]
        case _:
            return _label_arms(base, study.quick)


def _arm(name: str, config: AttackConfig, reference: float | None = None) -> AttackArm:
    """An arm; the paper's number stands only next to the paper's own protocol."""
    return AttackArm(name, re.sub(r"[^a-z0-9.]+", "-", name), config, reference if follows_paper(config) else None)


def _combo_arm(base: AttackConfig, number: int) -> AttackArm:
    return _arm(f"combo {number}", replace(base, combo=number), PAPER_COMBOS[number])


def _paper_arms(base: AttackConfig, study: StudyConfig, out: Path) -> list[AttackArm]:
    """The six parameters or the four combinations, by our protocol and by the paper's, with controls."""
    ours = [_arm(p.value, replace(base, params=p.value), PAPER_SINGLE[p]) for p in PAPER_PARAMETERS]
    if study.name == "multi":
        ours = [_combo_arm(base, number) for number in COMBO_NUMBERS]
    arms = list(ours)
    # the paper's loss exists for this project's own architectures only
    foreign = ":" in study.detector or study.detector.endswith(".onnx")
    if study.paper_protocol and not foreign and not follows_paper(base):
        protocol: dict[str, Any] = PROTOCOL
        references = {f"combo {number}": value for number, value in PAPER_COMBOS.items()} | PAPER_SINGLE
        arms += [
            _arm(f"{arm.name}, {PAPER_PROTOCOL}", replace(arm.config, **protocol), references[arm.name])
            for arm in ours
        ]
    if study.name == "multi" and study.method == "si-fgsm":
        longer = replace(base, combo=DEFAULT_COMBO, method="apgd", steps=_APGD_FACTOR * study.steps)
        arms.append(_arm(f"combo {DEFAULT_COMBO}, apgd", longer))
    seeds = study.seeds or (1 if study.quick else _CONTROL_SEEDS)
    return _add_controls(arms, out, seeds=seeds) if study.controls else arms


def matching_control(config: AttackConfig) -> str:
    """The control with as many chances as an attack: RANDOM if the best iterate counts, PLACEBO if the last."""
    return RANDOM if config.keep == "best" else PLACEBO


def _add_controls(
    arms: Sequence[AttackArm], out: Path, kinds: Sequence[str] = (RANDOM, PLACEBO), seeds: int = 1
) -> list[AttackArm]:
    """Each arm followed by its controls, by `seeds` seeds; RANDOM only for attacks that keep the best iterate."""
    controlled: list[AttackArm] = []
    for arm in arms:
        # relative to the working directory, as in the settings of the run
        configs = {
            RANDOM: replace(arm.config, method="random", range="steps", queries=arm.config.steps),
            PLACEBO: replace(arm.config, method="placebo", like=os.path.join(out, ARMS, arm.folder)),
        }
        controlled.append(arm)
        for kind in kinds:
            if kind == RANDOM and matching_control(arm.config) != RANDOM:
                continue
            for number in range(seeds):
                name, folder = f"{arm.name} {kind}", f"{arm.folder}-{kind}"
                if number:
                    name, folder = f"{name} {number + 1}", f"{folder}-{number + 1}"
                config = replace(configs[kind], seed=arm.config.seed + number)
                controlled.append(AttackArm(name, folder, config, control=kind, control_of=arm.name))
    return controlled


def _source_arms(base: AttackConfig, study: StudyConfig) -> list[AttackArm]:
    """The default combination on each source detector; the first has the folder that `multi` gives it."""
    sources = parse_detector_names(study.sources or study.detector, "--sources")
    arms = []
    for place, (source, short) in enumerate(zip(sources, shorten_detector_names(sources), strict=True)):
        arm = _combo_arm(replace(base, detector=source), DEFAULT_COMBO)
        folder = arm.folder if place == 0 else f"{arm.folder}-{re.sub(r'[^a-zA-Z0-9.]+', '-', short)}"
        arms.append(replace(arm, name=short, folder=folder))
    return arms


def _grade_arms(base: AttackConfig, out: Path) -> list[AttackArm]:
    """For three parameter sets: si-FGSM and longer Auto-PGD with placebos, and samples at si-FGSM's budget."""
    parameter_sets = {
        f"combo {DEFAULT_COMBO}": replace(base, combo=DEFAULT_COMBO),
        "weather": replace(base, params=Parameter.WEATHER.value),
        "all six": replace(base, params=",".join(p.value for p in PAPER_PARAMETERS)),
    }
    arms: list[AttackArm] = []
    for name, config in parameter_sets.items():
        attacks = [
            _arm(name, replace(config, method="si-fgsm")),
            _arm(f"{name}, apgd", replace(config, method="apgd", steps=_APGD_FACTOR * base.steps)),
        ]
        halton = replace(config, method="halton", queries=GRADIENT_PASSES * base.steps)
        arms += [*_add_controls(attacks, out, (PLACEBO,)), _arm(f"{name}, halton", halton)]
    return arms


def _search_arms(base: AttackConfig, study: StudyConfig, out: Path) -> list[AttackArm]:
    """Search methods on the same parameters, at equal passes or, with --pace, in equal time."""
    config = replace(base, combo=DEFAULT_COMBO if study.params is None else None, params=study.params)
    passes = dict.fromkeys(SEARCH_METHODS, study.passes)
    if study.pace is not None:
        passes = _passes_for_equal_time(study.passes, Path(study.pace) / STUDY_JSON)
    first, *others = (_arm(name, replace(config, method=name, passes=passes[name])) for name in SEARCH_METHODS)
    searching, placebo = _add_controls([first], out, (PLACEBO,))
    return [searching, *others, replace(placebo, config=replace(placebo.config, passes=None))]


def _passes_for_equal_time(passes: int, study: Path) -> dict[str, int]:
    """Passes by method that take as long as the slowest method's, by the seconds per frame of an earlier study."""
    try:
        rows = {row["name"]: float(row["seconds"]) for row in files.read_json(study)["searches"]}
        seconds = {name: rows[name] for name in SEARCH_METHODS}
    except (TypeError, KeyError, ValueError) as error:
        raise FormatError(f"{study}: searches", f"seconds of {', '.join(SEARCH_METHODS)}", error) from error
    if not all(0 < own < math.inf for own in seconds.values()):
        raise FormatError(f"{study}: searches", "positive seconds", seconds)
    slowest = max(seconds.values())
    return {name: round(passes * slowest / own) for name, own in seconds.items()}


def _sample_arms(base: AttackConfig, study: StudyConfig) -> list[AttackArm]:
    """Each method up to its first success; gradient-free ones in the reach of si-FGSM, then in all of the bounds."""
    arms = [
        _arm("si-fgsm", replace(base, method="si-fgsm", early_stop=True)),
        _arm("apgd", replace(base, method="apgd", early_stop=True)),
        _arm("fgsm", replace(base, method="fgsm")),
    ]
    for method in ("random", "halton", "cma-es"):
        search = replace(base, method=method, queries=study.queries, early_stop=True)
        arms.append(_arm(method, replace(search, range="steps")))
        if not study.quick:
            arms.append(_arm(f"{method}, bounds", search))
    if not study.quick:
        arms.append(_arm("sgd", replace(base, method="sgd", early_stop=True)))
    return arms


def _label_arms(base: AttackConfig, quick: bool) -> list[AttackArm]:
    """Attacks on the benign labels, as in the paper, and one on labels that move with the cars."""
    fixed = replace(base, objective_labels="paper")
    arms = [
        _arm(name, replace(fixed, params=name)) for name in (("translate",) if quick else ("translate", "rotate"))
    ]
    arms += [_combo_arm(fixed, number) for number in ((DEFAULT_COMBO,) if quick else COMBO_NUMBERS)]
    moved = _arm(f"combo {DEFAULT_COMBO}, moved", replace(base, combo=DEFAULT_COMBO, objective_labels="moved"))
    return [replace(arm, reference=None) for arm in arms] + [moved]


def run_arms(arms: Sequence[AttackArm], workers: Sequence[AttackWorker], out: Path) -> StudyArms:
    """Run or continue all arms, in the folder `arms` of `out`; each scene is de-rendered once.

    Args:
        arms: The arms.
        workers: One worker for each arm, from `build_workers`.
        out: Folder of the study.

    Raises:
        UsageError: Settings that do not fit a run that is there.
        SceneError: A frame that cannot be used, without --keep-going.
    """
    first = workers[0]
    names, without_vehicles, failed = select_frames(first.source, first.config)
    folders = [out / ARMS / arm.folder for arm in arms]
    for worker, folder in zip(workers, folders, strict=True):
        claim_folder(folder, worker.config, WRITTEN, _FREE_SETTINGS)
    jobs = run_frame_jobs(
        [name for name in names if not all(_is_done(folder, name) for folder in folders)],
        partial(_attack_frame, workers=workers, folders=folders),
        partial(_build_frame_worker, arms, folders),
        first.config,
        ProgressSettings(f"frames, {len(arms)} attacks each"),
    )
    failed |= jobs.failed
    empty = {name for name, has_vehicles in jobs.results.items() if not has_vehicles}
    names = [name for name in names if name not in failed and name not in empty]
    runs = []
    for arm, worker, folder in zip(arms, workers, folders, strict=True):
        summary = attack_frames(worker, names, folder)
        results = tuple(load_frame(folder / FRAMES / name / RESULT) for name in names)
        runs.append(ArmRun(arm, summary, results, EvaluatedClasses.from_detector(worker.detector)))
    return StudyArms(tuple(runs), without_vehicles + len(empty), dict(sorted(failed.items())))


def build_workers(arms: Sequence[AttackArm]) -> list[AttackWorker]:
    """One worker for each arm; all share one scene source, and arms on the same detector share that.

    Raises UsageError or SceneError for settings that cannot be used.
    """
    first: dict[str, AttackWorker] = {}
    source: SceneSource | None = None
    for config in (arm.config for arm in arms):
        if config.detector not in first:
            worker = AttackWorker.from_config(config)
            source = source or worker.source
            first[config.detector] = replace(worker, source=source)
    return [first[arm.config.detector].with_config(arm.config) for arm in arms]


def _attack_frame(name: str, workers: Sequence[AttackWorker], folders: Sequence[Path]) -> bool:
    """Attack one frame by all arms that have not done so, in order; False if it has no vehicle."""
    scene = workers[0].source.scene(name)
    for worker, folder in zip(workers, folders, strict=True):
        if _is_done(folder, name):
            continue
        try:
            attacked = worker.attack_scene(name, scene)
        except NoVehicleError:
            return False
        write_frame(attacked, folder / FRAMES / name)
        # photograph and background, which all arms share, are most of a frame's folder
        if folder != folders[0] and _is_done(folders[0], name):
            files.hardlink_duplicates(folder / FRAMES / name, folders[0] / FRAMES / name)
    return True


def _build_frame_worker(arms: Sequence[AttackArm], folders: Sequence[Path]) -> Callable[[str], bool]:
    return partial(_attack_frame, workers=build_workers(arms), folders=folders)


def _is_done(folder: Path, name: str) -> bool:
    return (folder / FRAMES / name / RESULT).is_file()
