"""Objects of finished runs as points before a detector: the run's own, or a second one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import torch

from detectors.base import DetectorError
from detectors.types import CLASSES, Detections
from drivesem.analysis.transfer.run import DETECTIONS
from drivesem.attack.targets import EvaluatedClasses, resolve_t_star
from drivesem.config.errors import UsageError
from drivesem.config.options import WorkerOptions
from drivesem.run.detection_cache import DetectionCache, DetectorSpec, cache_detections
from drivesem.run.finished import METRICS as RUN_FIGURES
from drivesem.run.finished import AttackRun, RunFrame
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.run.results import BoxRecord
from drivesem.training.retraining import WEIGHTS
from scene_ir import files
from tools.experiments.realism.comparison import FrameParts
from tools.experiments.realism.measures import METRICS, missing
from tools.experiments.settings import WorthConfig
from tools.experiments.worth.measures import Floats, Points, detected, joined, realism

PREFERRED = ("lpips-alex", "perceptual")
"""The distance behind realism: LPIPS as in the paper where its weights are there."""
SHOWN = {"benign": "photographs", "attacked": "counterexamples"}
"""Pictures of a run whose objects are points, and what people call them."""


def distance_of(config: WorthConfig) -> str | None:
    """The distance behind realism, None for none. Raises UsageError for what is no distance."""
    folder = None if config.weights is None else Path(config.weights)
    if config.distance == "none":
        return None
    if config.distance is None:
        return next(name for name in PREFERRED if missing(name, folder) is None)
    known = [name for name, metric in METRICS.items() if metric.pairwise and not metric.squared and name != "ssim"]
    if config.distance not in known:
        raise UsageError("--distance", f"none, {', '.join(known)}", repr(config.distance))
    return config.distance


def _kept(frame: RunFrame) -> list[tuple[BoxRecord, BoxRecord]]:
    """Objects that are judged before and after."""
    result = frame.result
    pairs = zip(result.targets_benign, result.targets_moved, strict=True)
    return [(a, b) for a, b in pairs if not (a.ignore or b.ignore)]


def distances_of(frame: RunFrame, parts: FrameParts | None, name: str) -> Floats:
    """Of each judged object's surroundings before and after (M,), by that measure; 0 where nothing is measured."""
    kept = _kept(frame)
    if parts is None:
        return np.zeros(len(kept))
    by_index = {part.index: part.distances[name]["benign", "attacked"] for part in parts.region("boxes")}
    return np.array([by_index.get(a.index, 0.0) for a, _ in kept], np.float64)


def realism_of(distances: Sequence[Sequence[Floats]]) -> list[list[Floats]]:
    """Realism of the objects of runs, frame by frame, beside the greatest distance of all."""
    largest = max((float(d.max(initial=0)) for frames in distances for d in frames), default=0.0)
    return [[realism(d, largest) for d in frames] for frames in distances]


def own_points(run: AttackRun, picture: str, rho: Sequence[Floats] | None) -> Points:
    """Before the detector that was attacked. picture: of SHOWN; rho: realism of each frame's objects."""
    t_star = float(files.read_json(run.folder / RUN_FIGURES)["t_star"])
    found = [detections_from_records(getattr(f.result, f"detections_{picture}"), CLASSES) for f in run.frames]
    return _joined(run, picture, found, t_star, rho)


def _joined(
    run: AttackRun, picture: str, found: Sequence[Detections], t_star: float, rho: Sequence[Floats] | None
) -> Points:
    weights = [None] * len(run.frames) if rho is None else rho
    rows = zip(run.frames, found, weights, strict=True)
    return joined([_points(frame, picture, seen, t_star, own) for frame, seen, own in rows])


def _points(frame: RunFrame, picture: str, found: Detections, t_star: float, rho: Floats | None) -> Points:
    result = frame.result
    records = result.targets_benign if picture == "benign" else result.targets_moved
    other = result.targets_moved if picture == "benign" else result.targets_benign
    targets = targets_from_records(records, CLASSES)
    # The same objects before and after, or the sets could not be compared.
    targets.ignore.logical_or_(torch.tensor([box.ignore for box in other], dtype=torch.bool))
    return detected(targets, found, t_star, rho)


class SecondDetector:
    """Another detector, or the same one retrained: what it finds is remembered by the pictures' content."""

    def __init__(self, second: str, config: WorthConfig, out: Path) -> None:
        """second: a detector, or a folder of `drivesem retrain`. Raises UsageError for what is neither."""
        path = Path(second)
        name = str(path / WEIGHTS) if (path / WEIGHTS).is_file() else second
        self._settings = WorkerOptions(workers=1)
        self._order = DetectorSpec(name, config.device, config.tiles, out / DETECTIONS)
        try:
            self._predictor = self._order.load()
            self._names = EvaluatedClasses.from_detector(self._predictor).names
        except DetectorError as error:
            raise UsageError.from_detector_error(
                "--second", "a detector, or a run of drivesem retrain", error
            ) from error
        self._memory = DetectionCache(self._order, self._predictor)
        self.name, self.t_star = name, resolve_t_star(self._predictor)

    def look(self, runs: Sequence[AttackRun], shown: Collection[str] = tuple(SHOWN)) -> None:
        """Look at all pictures of runs at once, before `points` are asked for: each look reads all the weights.
        shown: which pictures, of SHOWN.
        """
        pictures = [frame.pictures[name] for run in runs for frame in run.frames for name in shown]
        cache_detections(self._order, self._predictor, pictures, self._settings, self.name)

    def points(self, run: AttackRun, picture: str, rho: Sequence[Floats] | None) -> Points:
        """As `own_points`, before this detector, which has looked at the run."""
        found = [self._found(frame.pictures[picture]) for frame in run.frames]
        return _joined(run, picture, found, self.t_star, rho)

    def _found(self, picture: Path) -> Detections:
        """Detections whose labels are places in CLASSES."""
        found = self._memory.load(picture)
        places = torch.tensor([CLASSES.index(name) for name in self._names])
        return Detections(found.boxes_xyxy, places[found.labels], found.scores)
