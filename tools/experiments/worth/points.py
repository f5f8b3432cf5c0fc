"""Objects of finished runs as points under a detector: the attacked one, or a second one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import torch

from detectors.base import DetectorError
from detectors.types import CLASSES, Detections
from drivesem.analysis.transfer import DETECTIONS
from drivesem.attacks.targets import EvaluatedClasses, resolve_t_star
from drivesem.config.errors import UsageError
from drivesem.config.options import WorkerOptions
from drivesem.run.detection_cache import DetectionCache, DetectorSpec, cache_detections
from drivesem.run.finished import METRICS as RUN_METRICS
from drivesem.run.finished import AttackRun, RunFrame
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.run.results import BoxRecord
from drivesem.training.retrain import WEIGHTS
from scene_ir import files
from tools.experiments.realism.comparison import FrameRegions
from tools.experiments.realism.metrics import METRICS, why_missing
from tools.experiments.settings import WorthConfig
from tools.experiments.worth.measures import Floats, MembershipPoints, join_points, points_from_detections, realism

PREFERRED_DISTANCES = ("lpips-alex", "perceptual")
"""Distances for realism, the first that is available: LPIPS as in the paper, if its weights are on disk."""
PICTURE_NAMES = {"benign": "photographs", "attacked": "counterexamples"}
"""Pictures of a run with points, and their names in tables."""


def choose_distance(config: WorthConfig) -> str | None:
    """The distance for realism, or None. Raises UsageError for an unknown one."""
    folder = None if config.weights is None else Path(config.weights)
    if config.distance == "none":
        return None
    if config.distance is None:
        return next(name for name in PREFERRED_DISTANCES if why_missing(name, folder) is None)
    known = [name for name, metric in METRICS.items() if metric.pairwise and not metric.squared and name != "ssim"]
    if config.distance not in known:
        raise UsageError("--distance", f"none, {', '.join(known)}", repr(config.distance))
    return config.distance


def _judged_objects(frame: RunFrame) -> list[tuple[BoxRecord, BoxRecord]]:
    """Objects that count before and after."""
    result = frame.result
    pairs = zip(result.targets_benign, result.targets_moved, strict=True)
    return [(a, b) for a, b in pairs if not (a.ignore or b.ignore)]


def object_distances(frame: RunFrame, parts: FrameRegions | None, name: str) -> Floats:
    """Distance of each judged object's surroundings before and after (M,).

    Args:
        frame: The frame.
        parts: Its measured regions; None gives zeros.
        name: Name of the metric.
    """
    objects = _judged_objects(frame)
    if parts is None:
        return np.zeros(len(objects))
    by_index = {part.index: part.distances[name]["benign", "attacked"] for part in parts.select("boxes")}
    return np.array([by_index.get(a.index, 0.0) for a, _ in objects], np.float64)


def realism_weights(distances: Sequence[Sequence[Floats]]) -> list[list[Floats]]:
    """Realism of objects by run and frame, relative to the largest distance of all."""
    largest = max((float(d.max(initial=0)) for frames in distances for d in frames), default=0.0)
    return [[realism(d, largest) for d in frames] for frames in distances]


def attacked_detector_points(run: AttackRun, picture: str, rho: Sequence[Floats] | None) -> MembershipPoints:
    """Points under the attacked detector.

    Args:
        run: The run.
        picture: One of PICTURE_NAMES.
        rho: Realism of each frame's objects.
    """
    t_star = float(files.read_json(run.folder / RUN_METRICS)["t_star"])
    found = [detections_from_records(getattr(f.result, f"detections_{picture}"), CLASSES) for f in run.frames]
    return _join_frames(run, picture, found, t_star, rho)


def _join_frames(
    run: AttackRun, picture: str, found: Sequence[Detections], t_star: float, rho: Sequence[Floats] | None
) -> MembershipPoints:
    weights = [None] * len(run.frames) if rho is None else rho
    rows = zip(run.frames, found, weights, strict=True)
    return join_points([_points(frame, picture, seen, t_star, own) for frame, seen, own in rows])


def _points(
    frame: RunFrame, picture: str, found: Detections, t_star: float, rho: Floats | None
) -> MembershipPoints:
    result = frame.result
    records = result.targets_benign if picture == "benign" else result.targets_moved
    other = result.targets_moved if picture == "benign" else result.targets_benign
    targets = targets_from_records(records, CLASSES)
    # the same objects before and after, so that the sets are comparable
    targets.ignore.logical_or_(torch.tensor([box.ignore for box in other], dtype=torch.bool))
    return points_from_detections(targets, found, t_star, rho)


class SecondDetector:
    """Another detector, or the same one retrained; its detections are cached by the pictures' content."""

    def __init__(self, second: str, config: WorthConfig, out: Path) -> None:
        """Load the detector.

        Args:
            second: A detector, or a folder of `drivesem retrain`.
            config: Device and tiling.
            out: Folder of cached detections.

        Raises:
            UsageError: Neither of them.
        """
        path = Path(second)
        name = str(path / WEIGHTS) if (path / WEIGHTS).is_file() else second
        self._settings = WorkerOptions(workers=1)
        self._spec = DetectorSpec(name, config.device, config.tiles, out / DETECTIONS)
        try:
            self._predictor = self._spec.load()
            self._names = EvaluatedClasses.from_detector(self._predictor).names
        except DetectorError as error:
            raise UsageError.from_detector_error(
                "--second", "a detector, or a run of drivesem retrain", error
            ) from error
        self._cache = DetectionCache(self._spec, self._predictor)
        self.name, self.t_star = name, resolve_t_star(self._predictor)

    def detect(self, runs: Sequence[AttackRun], kinds: Collection[str] = tuple(PICTURE_NAMES)) -> None:
        """Detect in the pictures of runs, of the kinds of PICTURE_NAMES, before `points` needs them."""
        pictures = [frame.pictures[name] for run in runs for frame in run.frames for name in kinds]
        cache_detections(self._spec, self._predictor, pictures, self._settings, self.name)

    def points(self, run: AttackRun, picture: str, rho: Sequence[Floats] | None) -> MembershipPoints:
        """Points under this detector, as `attacked_detector_points` gives them; needs `detect` on the run."""
        found = [self._load(frame.pictures[picture]) for frame in run.frames]
        return _join_frames(run, picture, found, self.t_star, rho)

    def _load(self, picture: Path) -> Detections:
        """Detections with labels that index CLASSES."""
        found = self._cache.load(picture)
        places = torch.tensor([CLASSES.index(name) for name in self._names])
        return Detections(found.boxes_xyxy, places[found.labels], found.scores)
