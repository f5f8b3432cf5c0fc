"""Who finds failures that hold: by passes of the detector and by seconds, and what nobody can bring to fall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from detectors.types import CLASSES
from drivesem.evaluation import failures
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import Difference, Interval, differences, intervals, rate, wilson
from drivesem.failures.grades import Grade
from drivesem.run.folder import ARMS, FRAMES
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult
from drivesem.run.summary import at_least, certain_losses
from scene_ir.io import load_scene
from tools.experiments.detection.counts import ArmCounts, DetectedObject, FrameCounts
from tools.experiments.detection.running import ArmRun

_HEIGHTS_PX = (25.0, 40.0, 80.0)
"""Edges of classes by size: the first two are those of KITTI's difficulties."""
_DEPTHS_M = (15.0, 30.0)
"""Edges of classes by distance."""


@dataclass(frozen=True, slots=True)
class SearchCost:
    """What an arm's certain failures cost. seconds: all that a frame took on average, certificates included;
    per_100_passes, per_minute: certain failures; ahead: certain failures an object, the first arm's less this
    one's, None for the first.
    """

    name: str
    seconds: float
    per_100_passes: Interval
    per_minute: Interval
    ahead: Difference | None

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        found: dict[str, Any] = {"name": self.name, "seconds": self.seconds}
        for key, one in (("per_100_passes", self.per_100_passes), ("per_minute", self.per_minute)):
            found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        if self.ahead is not None:
            found |= {"ahead": self.ahead.difference, "ahead_low": self.ahead.low, "ahead_high": self.ahead.high}
        return found


@dataclass(frozen=True, slots=True)
class WithstandingObjects:
    """Objects of a class by size or distance, of those that the detector finds as photographed. lost: for certain,
    to any arm; standing: the share that none brought to fall, with Wilson's interval.
    """

    name: str
    objects: int
    lost: int

    @property
    def share(self) -> Interval:
        """The share that withstood; None where there are no objects."""
        if not self.objects:
            return Interval(self.name, None, None, None)
        kept = self.objects - self.lost
        return Interval(self.name, kept / self.objects, *wilson(kept, self.objects))

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        one = self.share
        return {
            "name": self.name,
            "objects": self.objects,
            "lost": self.lost,
            "standing": one.value,
            "low": one.low,
            "high": one.high,
        }


_Seen = Mapping[str, Sequence[DetectedObject]]
"""By frame, as `seen_of` gives them."""


def search_costs(runs: Sequence[ArmCounts], seen: _Seen, draws: int, seed: int) -> list[SearchCost]:
    """Of arms on the same frames, the first of which the others are compared with."""
    first = _certain(runs[0].frames)
    objects = np.array([len(seen[frame.identifier]) for frame in runs[0].frames], np.float64)
    found = []
    for run in runs:
        certain, seconds = _certain(run.frames), np.array([frame.seconds for frame in run.frames])
        passes = np.array([frame.passes for frame in run.frames], np.float64)
        figures = [rate("passes", certain, passes / 100), rate("minute", certain, seconds / 60)]
        by_pass, by_minute = intervals(figures, len(certain), draws, np.random.default_rng(seed))
        pair = [rate("certain", certain, objects)], [rate("certain", first, objects)]
        (ahead,) = differences(*pair, len(certain), draws, np.random.default_rng(seed))
        mean = float(seconds.mean()) if len(seconds) else 0.0
        found.append(SearchCost(run.arm.name, mean, by_pass, by_minute, None if run is runs[0] else ahead))
    return found


def load_depths(run: ArmRun, out: Path) -> dict[str, list[float]]:
    """Distances, m, of the objects of each frame by name, as photographed. out: the study's folder."""
    frames = out / ARMS / run.arm.folder / FRAMES
    names = [result.identifier for result in run.results]
    scenes = ((name, load_scene(frames / name / "scene").as_photographed()) for name in names)
    return {name: scene.objects.translation[:, 2].tolist() for name, scene in scenes}


def find_detected_objects(
    run: ArmRun, depths: Mapping[str, Sequence[float]]
) -> dict[str, tuple[DetectedObject, ...]]:
    """The judged objects of each frame that the detector finds in the photograph. depths: as of `depths_of`."""
    return {
        result.identifier: tuple(
            DetectedObject(i, height, depths[result.identifier][i]) for i, height in _objects(run, result).items()
        )
        for result in run.results
    }


def count_withstanding(runs: Sequence[ArmCounts], seen: _Seen) -> list[WithstandingObjects]:
    """By size and by distance, of all arms that are no controls."""
    searching = [run for run in runs if run.arm.control is None]
    told: list[tuple[float, float, bool]] = []
    for place, frame in enumerate(searching[0].frames):
        lost = {failure.object_index for run in searching for failure in certain_losses(run.frames[place])}
        told += [(one.height_px, one.depth_m, one.object_index in lost) for one in seen[frame.identifier]]
    by_height = _classes("height", "px", _HEIGHTS_PX, [(height, lost) for height, _, lost in told])
    by_depth = _classes("distance", "m", _DEPTHS_M, [(depth, lost) for _, depth, lost in told])
    return [_standing("all", [lost for _, _, lost in told]), *by_height, *by_depth]


def _certain(frames: Sequence[FrameCounts]) -> Floats:
    certain = at_least(Grade.CERTAIN)
    return np.array([sum(map(certain, frame.failures)) for frame in frames], np.float64)


def _objects(run: ArmRun, result: FrameResult) -> Mapping[int, float]:
    """Heights, px, of the judged objects by index that the detector finds in the photograph."""
    targets = run.judged.targets(as_targets(result.targets_benign, CLASSES))
    seen = as_detections(result.detections_benign, run.judged.names)
    found = failures.judge(targets, seen, run.summary.t_star).found.tolist()
    return {
        box.index: box.xyxy[3] - box.xyxy[1]
        for box, hit in zip(result.targets_benign, found, strict=False)  # further rows stand at the end
        if hit and box.index is not None
    }


def _classes(
    name: str, unit: str, edges: Sequence[float], of: Sequence[tuple[float, bool]]
) -> list[WithstandingObjects]:
    """Objects (value, lost) between edges, and beyond them."""
    bounds = (-np.inf, *edges, np.inf)
    found = []
    for low, high in pairwise(bounds):
        between = f"{low:g} to {high:g}" if low > -np.inf and high < np.inf else ""
        words = between or (f"below {high:g}" if high < np.inf else f"from {low:g}")
        found.append(_standing(f"{name} {words} {unit}", [lost for value, lost in of if low <= value < high]))
    return found


def _standing(name: str, lost: Sequence[bool]) -> WithstandingObjects:
    return WithstandingObjects(name, len(lost), sum(lost))
