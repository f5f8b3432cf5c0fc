"""A finished run of `drivesem classify attack`, as questions need it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from drivesem.classify.attack import Attacker
from drivesem.classify.objective import ClassifierObjective
from drivesem.classify.pictures import Shown
from drivesem.classify.protocol import aimed_by, params_of
from drivesem.classify.results import SCHEMA, ClassifiedFrame
from drivesem.run.ask import Bar, Kept, KeptFrames
from drivesem.run.finished import Run
from drivesem.run.folder import CONFIG, FRAMES
from drivesem.run.frame import RESULT
from drivesem.run.records import from_json, load_record
from drivesem.settings.commands import Classify
from drivesem.settings.errors import UsageError
from drivesem.truth.grades import Grade
from scene_ir import files
from scene_ir.errors import FormatError

K = TypeVar("K", bound=Kept)


@dataclass(frozen=True)
class ClassifyRun:
    """folder: of the run; config: what was asked of it, on the device of the question; frames: by name."""

    folder: Path
    config: Classify
    frames: dict[str, ClassifiedFrame]

    @classmethod
    def of(cls, asked: Classify) -> ClassifyRun:
        """The run that a question is asked of. Raises UsageError where the folder is none."""
        folder = Path(asked.folder or "")
        path = folder / CONFIG
        loaded = files.read_yaml(path) if path.is_file() else None
        if not isinstance(loaded, dict) or loaded.get("what") != "attack":
            raise UsageError("RUN", "a folder of drivesem classify attack", folder)
        config: Classify = from_json(Classify, loaded, str(path))
        config.check()
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

    def ask(
        self,
        asked: Classify,
        out: Path,
        kept: tuple[str, Callable[[Path], K]],
        build: Callable[[], Callable[[str], object]],
        bar: Bar,
        grades: Collection[str] = tuple(Grade),
    ) -> tuple[list[K], dict[str, str]]:
        """Answers about the run's failures, kept in `out`. kept: their file, and what reads it."""
        config = self.config
        params = ",".join(str(one) for one in params_of(config))
        run = Run(self.folder.name, self.folder, config.network, config.method, params, ())
        return KeptFrames(run, out, *kept).ask(self.failures(asked.limit, grades), build(), build, asked, bar)

    def facts(self, out: Path, failed: dict[str, str]) -> dict[str, Any]:
        """What stands first in a question's JSON."""
        config = self.config
        told = {"out": str(out), "run": str(self.folder), "network": config.network, "method": config.method}
        return told | {"frames_failed": failed}
