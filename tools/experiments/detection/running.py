"""The arms of a study run frame by frame: a scene is taken apart once, then each arm attacks it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from drivesem.attack.targets import JudgedClasses
from drivesem.run.attack import WRITTEN, Worker, attack_frames, select_frames
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import ARMS, PRESENTATION, claim
from drivesem.run.frame import RESULT
from drivesem.run.results import FrameResult, RunSummary, load_frame
from drivesem.scenes.sources import NoVehicleError, SceneSource
from scene_ir import files
from tools.experiments.detection.arms import AttackArm

_FREE = (*PRESENTATION, "like")
"""Settings of an arm that may change on the way: the study's folder may have moved, and what lies in it."""


@dataclass(frozen=True, slots=True)
class ArmRun:
    """What came of an arm. results: of the frames that all arms have, in one order; judged: the detector's classes
    that count.
    """

    arm: AttackArm
    summary: RunSummary
    results: tuple[FrameResult, ...]
    judged: JudgedClasses


@dataclass(frozen=True, slots=True)
class StudyArms:
    """All arms. without_vehicles: frames that were passed over; failed: those that could not be used, and why."""

    runs: tuple[ArmRun, ...]
    without_vehicles: int
    failed: dict[str, str]


@dataclass(frozen=True, slots=True)
class AttackTotals:
    """What is said of attacks as such. frames: that all arms have; pictures: attacked, of all arms; feasible: of
    these, in how many the independent check finds nothing violated; without_vehicles, failed: as of `Ran`.
    """

    frames: int
    pictures: int
    feasible: int
    without_vehicles: int
    failed: dict[str, str]

    @classmethod
    def from_arms(cls, ran: StudyArms) -> AttackTotals:
        """Of finished runs."""
        checked = [result.feasible for run in ran.runs for result in run.results]
        frames = len(ran.runs[0].results)
        return cls(frames, len(checked), sum(checked), ran.without_vehicles, ran.failed)


def feasible_share(*attacks: AttackTotals) -> float | None:
    """Share of the attacked pictures in which nothing is violated; None where there are none."""
    pictures = sum(one.pictures for one in attacks)
    return sum(one.feasible for one in attacks) / pictures if pictures else None


def run_arms(arms: Sequence[AttackArm], workers: Sequence[Worker], out: Path) -> StudyArms:
    """Run or continue all arms in `out / ARMS`. workers: of the arms, as `workers_of` makes them.

    Raises UsageError or SceneError for bad input.
    """
    first = workers[0]
    names, without, failed = select_frames(first.source, first.config)
    folders = [out / ARMS / arm.folder for arm in arms]
    for worker, folder in zip(workers, folders, strict=True):
        claim(folder, worker.config, WRITTEN, _FREE)
    todo = [name for name in names if not all(_done(folder, name) for folder in folders)]
    work, build = partial(_attack, workers=workers, folders=folders), partial(_in_process, arms, folders)
    answers = run_frame_jobs(
        todo, work, build, first.config, ProgressSettings(f"frames, {len(arms)} attacks each")
    )
    failed |= answers.failed
    empty = {name for name, usable in answers.results.items() if not usable}
    names = [name for name in names if name not in failed and name not in empty]
    runs = []
    for arm, worker, folder in zip(arms, workers, folders, strict=True):
        summary = attack_frames(worker, names, folder)
        results = tuple(load_frame(folder / "frames" / name / RESULT) for name in names)
        runs.append(ArmRun(arm, summary, results, JudgedClasses.of(worker.detector)))
    return StudyArms(tuple(runs), without + len(empty), dict(sorted(failed.items())))


def build_workers(arms: Sequence[AttackArm]) -> list[Worker]:
    """One for each arm, with one source for all, and one detector for all that attack the same. The first arm of
    each detector needs of it what any other needs. Raises UsageError or SceneError for settings that cannot be.
    """
    first: dict[str, Worker] = {}
    source: SceneSource | None = None
    for config in (arm.config for arm in arms):
        if config.detector not in first:
            worker = Worker.of(config)
            source = source or worker.source
            first[config.detector] = replace(worker, source=source)
    return [first[arm.config.detector].beside(arm.config) for arm in arms]


def _attack(name: str, workers: Sequence[Worker], folders: Sequence[Path]) -> bool:
    """One frame by all arms that have not done it, in their order. False where it has no vehicle."""
    todo = [(w, folder) for w, folder in zip(workers, folders, strict=True) if not _done(folder, name)]
    scene = workers[0].source.scene(name)
    for worker, folder in todo:
        try:
            worker.attack_scene(name, scene, folder)
        except NoVehicleError:
            return False
        # Photograph, background and what else all arms have is most of a frame's folder.
        if folder != folders[0] and _done(folders[0], name):
            files.hardlink_duplicates(folder / "frames" / name, folders[0] / "frames" / name)
    return True


def _in_process(arms: Sequence[AttackArm], folders: Sequence[Path]) -> Callable[[str], bool]:
    return partial(_attack, workers=build_workers(arms), folders=folders)


def _done(folder: Path, name: str) -> bool:
    return (folder / "frames" / name / RESULT).is_file()
