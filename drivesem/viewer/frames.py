"""What `drivesem view` is shown: a scene, a folder of scenes, or a run; and who looks at it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from detectors.base import DetectorError, Predictor
from detectors.registry import load_predictor
from drivesem.attack.budgets import budget_of
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.space import Budget
from drivesem.config.commands import View
from drivesem.config.errors import UsageError
from drivesem.report.tables import number_of
from drivesem.run.finished import load_runs
from drivesem.run.folder import CONFIG, detector_of, trusted_attack
from drivesem.run.results import FrameResult
from drivesem.scenes.sources import scene_folders
from drivesem.viewer.server import ShownFrame
from scene_ir import files
from scene_ir.io import count_objects

_SETTING = "SCENE|RUN"
_OTHERWISE = "squeezedet"


@dataclass(frozen=True, slots=True)
class Shown:
    """title: for people; frames: by name, the one to begin with first: by default one with vehicles."""

    title: str
    frames: Mapping[str, ShownFrame]
    detector: Predictor
    budget: Budget
    t_star: float | None


def opened(config: View) -> Shown:
    """What a command is to show. Raises UsageError for what cannot be shown or looked at, FormatError naming a
    file that is not as it should be.
    """
    path = Path(config.scene)
    budget, t_star = budget_of(config.budget), config.t_star
    if _is_run(path):
        (run,) = load_runs([config.scene], setting=_SETTING)
        frames = {
            frame.result.identifier: ShownFrame(frame.folder / "scene", _told(frame.result))
            for frame in run.frames
        }
        attack = trusted_attack(run.folder, config.trust, _SETTING)
        t_star = attack.t_star if t_star is None else t_star
        own = config.detector is None
        detector = detector_of(attack, config.device, _SETTING) if own else _detector(config)
    else:
        if not path.is_dir():
            raise UsageError(_SETTING, "a scene of drivesem derender, a folder of some, or a run", config.scene)
        frames = {name: ShownFrame(folder) for name, folder in scene_folders(path).items()}
        detector = _detector(config)
    if config.frame is not None and config.frame not in frames:
        raise UsageError("--frame", f"a frame of {config.scene}", config.frame)
    first = config.frame or next((name for name, frame in frames.items() if count_objects(frame.folder)), None)
    if first is not None:
        frames = {first: frames[first], **frames}
    return Shown(path.resolve().name, frames, detector, budget, t_star)


def _is_run(path: Path) -> bool:
    """Whether a folder is a run of drivesem attack: drivesem derender leaves its settings beside scenes too."""
    if not (path / CONFIG).is_file():
        return False
    settings = files.read_yaml(path / CONFIG)
    return isinstance(settings, dict) and {"detector", "params", "combo"} <= settings.keys()


def _detector(config: View) -> Predictor:
    try:
        detector = load_predictor(config.detector or _OTHERWISE, config.device, config.tiles)
        JudgedClasses.of(detector)
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector that knows cars", error) from error
    return detector


def _told(result: FrameResult) -> str:
    """What came of a frame, in a few words."""
    kinds = [failure.kind for failure in result.failures]
    lost, phantoms = kinds.count("lost"), kinds.count("phantom")
    parts = [f"{lost} lost"] if lost else []
    parts += [number_of(phantoms, "phantom")] if phantoms else []
    return ", ".join(parts) or "withstood"
