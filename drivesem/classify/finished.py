"""A finished run of `drivesem classify attack`, as questions need it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from drivesem.classify.attack import Attacker
from drivesem.classify.objective import ClassifierObjective
from drivesem.classify.pictures import Shown
from drivesem.classify.protocol import aimed_by
from drivesem.classify.results import SCHEMA, ClassifiedFrame
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.failures.grades import Grade
from drivesem.report.tables import format_count
from drivesem.run.driver import CachedFrameResult, FrameAnalyser, ProgressSettings, analyse_frames
from drivesem.run.folder import CONFIG, FRAMES, PRESENTATION, check_referenced_files, claim_folder
from drivesem.run.frame import RESULT
from drivesem.run.records import from_json, load_record
from scene_ir import files
from scene_ir.errors import FormatError

K = TypeVar("K", bound=CachedFrameResult)


@dataclass(frozen=True)
class ClassifyRun:
    """folder: of the run; config: what was asked of it, on the device of the question; frames: by name."""

    folder: Path
    config: ClassifyConfig
    frames: dict[str, ClassifiedFrame]

    @classmethod
    def of(cls, asked: ClassifyConfig) -> ClassifyRun:
        """The run that a question is asked of. Raises UsageError where the folder is none."""
        folder = Path(asked.folder or "")
        path = folder / CONFIG
        loaded = files.read_yaml(path) if path.is_file() else None
        if not isinstance(loaded, dict) or loaded.get("what") != "attack":
            raise UsageError("RUN", "a folder of drivesem classify attack", folder)
        config: ClassifyConfig = from_json(ClassifyConfig, loaded, str(path))
        config.check()
        check_referenced_files(folder, config)
        paths = sorted((folder / FRAMES).glob(f"*/{RESULT}"))
        frames = [load_record(one, ClassifiedFrame, SCHEMA) for one in paths]
        if not frames:
            raise UsageError("RUN", "a run with pictures", f"none in {folder}")
        return cls(folder, replace(config, device=asked.device), {one.identifier: one for one in frames})

    def failures(self, limit: int | None, grades: Collection[str] = tuple(Grade)) -> list[str]:
        """Names of the pictures that are misclassified after the change, and were not before, of these grades."""
        return [name for name, frame in self.frames.items() if frame.grade in grades][:limit]

    def shown(self, name: str) -> Shown:
        """The picture of that name."""
        frame = self.frames[name]
        return Shown(self.config.split, frame.object, frame.view)

    def rebuilt(self, attacker: Attacker, name: str) -> tuple[ClassifierObjective, Tensor]:
        """The objective of a picture, and the theta that was found. Raises SceneError."""
        scene, space = attacker.scene(self.shown(name))
        path = self.folder / FRAMES / name / "theta.npz"
        theta = torch.from_numpy(files.read_npz(path)["theta"]).to(space.theta0)
        if theta.shape != space.theta0.shape:
            raise FormatError(f"{path}: theta", f"shape {tuple(space.theta0.shape)}", tuple(theta.shape))
        return ClassifierObjective(scene, space, attacker.network, aimed_by(self.config)), theta


class FailureWorker(FrameAnalyser[K]):
    """Answers a question about a run's failures, each in a folder of its own; built once for a process. question:
    its name, that of its folder in the run's and of its files; file, kind: of what is kept of a failure; grades:
    which failures it is about; needs_some: whether a run may have none; renews: as of `claim`; free: further
    settings that change no answer.
    """

    question: ClassVar[str]
    schema = SCHEMA
    grades: ClassVar[Collection[str]] = tuple(Grade)
    needs_some: ClassVar[bool] = True
    renews: ClassVar[bool] = False
    free: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: ClassifyConfig, run: ClassifyRun, out: Path) -> None:
        super().__init__(run.folder, out)
        self.config, self.run, self.attacker = config, run, Attacker.of(run.config)

    @abstractmethod
    def analyse(self, name: str, source: str, folder: Path) -> K:
        """What is kept of a failure. source: digest of the run's result; folder: for pictures."""


@dataclass(frozen=True, slots=True)
class Asked(Generic[K]):
    """What a question came to. answers: by failure, in the run's order; failed: why others have none."""

    run: ClassifyRun
    out: Path
    answers: list[K]
    failed: dict[str, str]

    @property
    def facts(self) -> dict[str, Any]:
        """What stands first in the JSON."""
        config = self.run.config
        told = {"out": str(self.out), "run": str(self.run.folder), "network": config.network}
        return told | {"method": config.method, "frames_failed": self.failed}


def ask_of_failures(config: ClassifyConfig, worker: type[FailureWorker[K]], title: str) -> Asked[K]:
    """Ask about a run's failures, or go on with it. title: of the bar. Raises UsageError or SceneError."""
    run = ClassifyRun.of(config)
    names = run.failures(config.limit, worker.grades)
    if worker.needs_some and not names:
        raise UsageError("RUN", "a run with failures", f"none in {format_count(len(run.frames), 'picture')}")
    out = Path(config.out) if config.out else run.folder / worker.question
    build = partial(worker, config, run, out)
    work = build()
    written = (*(f"{worker.question}.{kind}" for kind in ("json", "md", "csv", "xml")), FRAMES)
    claim_folder(out, config, written, (*PRESENTATION, "folder", *worker.free), renews=worker.renews)
    return Asked(
        run, out, *analyse_frames(names, work, build, config, ProgressSettings(title, show_remaining=True))
    )
