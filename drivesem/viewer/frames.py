"""Open what `drivesem view` displays: a scene, a folder of scenes, or a run, and the detector that evaluates it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from detectors.base import DetectorError, Predictor
from detectors.registry import load_predictor
from drivesem.attack.budgets import parse_budget
from drivesem.attack.space import Budget
from drivesem.attack.targets import EvaluatedClasses
from drivesem.config.commands import ViewConfig
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count
from drivesem.run.finished import load_runs
from drivesem.run.folder import CONFIG, load_run_detector, load_trusted_config
from drivesem.run.results import FrameResult
from drivesem.scenes.sources import find_scene_folders
from drivesem.viewer.server import ViewerFrame
from scene_ir import files
from scene_ir.io import count_objects

_SETTING = "SCENE|RUN"
_DEFAULT_DETECTOR = "squeezedet"


@dataclass(frozen=True, slots=True)
class ViewerFrames:
    """The frames of one viewer and the settings that they share."""

    title: str
    """Title of the page."""
    frames: Mapping[str, ViewerFrame]
    """Frames by name; the page opens the first one."""
    detector: Predictor
    """Detector that evaluates each state."""
    budget: Budget
    """Range of the sliders."""
    t_star: float | None
    """Score from which a detection counts; None: the detector's own."""


def open_viewer_frames(config: ViewConfig) -> ViewerFrames:
    """Open the scenes or the run that a command names.

    Raises UsageError for a path or detector that cannot be used, FormatError for a damaged file.
    """
    path = Path(config.scene)
    budget, t_star = parse_budget(config.budget), config.t_star
    if _is_run(path):
        (run,) = load_runs([config.scene], setting=_SETTING)
        frames = {
            frame.result.identifier: ViewerFrame(frame.folder / "scene", _summarize_frame(frame.result))
            for frame in run.frames
        }
        attack = load_trusted_config(run.folder, config.trust, _SETTING)
        t_star = attack.t_star if t_star is None else t_star
        own = config.detector is None
        detector = load_run_detector(attack, config.device, _SETTING) if own else _load_detector(config)
    else:
        if not path.is_dir():
            raise UsageError(_SETTING, "a scene of drivesem derender, a folder of some, or a run", config.scene)
        frames = {name: ViewerFrame(folder) for name, folder in find_scene_folders(path).items()}
        detector = _load_detector(config)
    if config.frame is not None and config.frame not in frames:
        raise UsageError("--frame", f"a frame of {config.scene}", config.frame)
    first = config.frame or next((name for name, frame in frames.items() if count_objects(frame.folder)), None)
    if first is not None:
        frames = {first: frames[first], **frames}
    return ViewerFrames(path.resolve().name, frames, detector, budget, t_star)


def _is_run(path: Path) -> bool:
    """Whether a folder is a run of drivesem attack. A folder of drivesem derender has settings too."""
    if not (path / CONFIG).is_file():
        return False
    settings = files.read_yaml(path / CONFIG)
    return isinstance(settings, dict) and {"detector", "params", "combo"} <= settings.keys()


def _load_detector(config: ViewConfig) -> Predictor:
    try:
        detector = load_predictor(config.detector or _DEFAULT_DETECTOR, config.device, config.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector that knows cars", error) from error
    return detector


def _summarize_frame(result: FrameResult) -> str:
    """Failures of a frame in a few words."""
    kinds = [failure.kind for failure in result.failures]
    lost, phantoms = kinds.count("lost"), kinds.count("phantom")
    parts = [f"{lost} lost"] if lost else []
    parts += [format_count(phantoms, "phantom")] if phantoms else []
    return ", ".join(parts) or "withstood"
