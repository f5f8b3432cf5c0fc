"""Frame by frame: how far gradients of margins hold. What is done is kept, and read by a second call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from detectors.base import Detector, DetectorError
from detectors.registry import load_detector
from drivesem.attack.objective import Objective
from drivesem.attack.space import PAPER_PARAMETERS, ParameterSpace
from drivesem.config.errors import UsageError
from drivesem.config.options import SceneOptions
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.scenes.sources import NoVehicleError, SceneSource, open_source
from scene_ir import files
from scene_ir.render.compositor import Compositor
from tools.bench.reach.slopes import Slopes, measure, probes
from tools.bench.settings import GradcheckConfig


@dataclass(frozen=True)
class ReachWorker:
    """What one process needs."""

    config: GradcheckConfig
    source: SceneSource
    detector: Detector
    kept: Path | None
    """Folder of what is done, by frame; None keeps nothing."""

    @classmethod
    def of(cls, config: GradcheckConfig) -> ReachWorker:
        """Raises UsageError or SceneError for settings that cannot be."""
        source = open_source(config)
        try:
            detector = load_detector(config.detector, config.device)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detector", "a detector with gradients", error) from error
        if type(detector).candidates is Detector.candidates:
            raise UsageError("--detector", "one that tells its candidates", detector.name)
        return cls(config, source, detector, None if config.out is None else Path(config.out) / "frames")

    def measure(self, name: str) -> tuple[Slopes, ...]:
        """Of a frame; what another call has done with the same settings is read."""
        asked: dict[str, Any] = {
            field.name: str(getattr(self.config, field.name)) for field in fields(SceneOptions)
        }
        asked |= {"detector": self.config.detector, "draws": self.config.draws}
        asked.pop("limit")
        path = None if self.kept is None else self.kept / f"{name}.json"
        if path is not None and self.config.resume and path.is_file():
            known = files.read_json(path)
            if known["asked"] == asked:
                return tuple(_of_json(row) for row in known["slopes"])
        found = self._measure(name)
        if path is not None:
            files.write_json(path, {"asked": asked, "slopes": [asdict(one) for one in found]})
        return found

    def _measure(self, name: str) -> tuple[Slopes, ...]:
        scene = self.source.scene(name)
        if not len(scene.objects):
            raise NoVehicleError(f"frame {name}", "a vehicle that can be taken apart", "none")
        space = ParameterSpace(scene, PAPER_PARAMETERS)
        objective = Objective(Compositor(scene), space, self.detector)
        views = NuisanceMarginOracle.for_objective(objective, Nuisances(), f"reach:{name}:{self.config.seed}")
        generator = torch.Generator().manual_seed(self.config.seed)
        tried = probes(space, generator)
        return measure(views, objective.feasible_set(), tried, self.config.draws, generator)


def measure_of(config: GradcheckConfig) -> Callable[[str], tuple[Slopes, ...]]:
    """`ReachWorker.measure` of another process."""
    return ReachWorker.of(config).measure


def _of_json(row: dict[str, Any]) -> Slopes:
    drawn: dict[str, Any] = {key: tuple(map(tuple, row[key])) for key in ("point", "smoothed", "wide")}
    return Slopes(**(row | drawn))
