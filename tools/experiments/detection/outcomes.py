"""What each arm achieves: failures by grade, their cost, success against queries, and objects that withstand all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from detectors.types import CLASSES
from drivesem.evaluation import failures
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import (
    Interval,
    NamedMetric,
    PairedDifference,
    bootstrap_intervals,
    paired_differences,
    ratio_metric,
    wilson,
)
from drivesem.failures.grades import Grade, Kind
from drivesem.run.folder import ARMS, FRAMES
from drivesem.run.frame import certain_losses, detections_from_records, has_grade, targets_from_records
from scene_ir.io import load_scene
from tools.experiments.detection.arms import ArmRun
from tools.experiments.detection.counts import ArmCounts, DetectedObject, FailureRecord, FrameCounts
from tools.experiments.tables import interval_columns

_SURVIVE = "survive"
_HEIGHTS_PX = (25.0, 40.0, 80.0)
"""Edges of size classes: the first two are those of KITTI's difficulties."""
_DEPTHS_M = (15.0, 30.0)
"""Edges of distance classes."""


@dataclass(frozen=True, slots=True)
class ArmGrades:
    """The graded failures of one arm; intervals by bootstrap over frames."""

    name: str
    """Name of the arm."""
    control: str | None
    """Kind of control, if it is one."""
    frames: int
    """Number of frames."""
    objects: int
    """Judged objects before the attack."""
    passes: int
    """Detector passes, without those for grading."""
    counts: dict[Grade, int]
    """Failures of at least each grade."""
    rates: dict[Grade, Interval]
    """The same per object."""
    kinds: dict[Kind, dict[Grade, int]]
    """Failures of each kind by grade."""
    second_rendered: int
    """Certain failures that a second renderer drew."""
    survive: Interval
    """Share of them that it confirms."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        row: dict[str, Any] = {
            "name": self.name,
            "control": self.control,
            "frames": self.frames,
            "objects": self.objects,
            "passes": self.passes,
        }
        for grade, share in self.rates.items():
            row |= {str(grade): self.counts[grade], f"{grade}_rate": share.value}
            row |= {f"{grade}_low": share.low, f"{grade}_high": share.high}
        row |= {f"{kind}_{grade}": n for kind, by_grade in self.kinds.items() for grade, n in by_grade.items()}
        return row | {"second_rendered": self.second_rendered} | interval_columns(_SURVIVE, self.survive)


def count_grades(run: ArmCounts, draws: int, seed: int) -> ArmGrades:
    """Count the failures of an arm that is fully graded.

    Args:
        run: The arm.
        draws: Bootstrap draws of frames.
        seed: Seed of the draws.
    """
    frames = run.frames
    objects = np.array([frame.judged_objects for frame in frames], np.float64)
    recorded = [failure for frame in frames for failure in frame.failures]
    hits = {grade: _count_per_frame(frames, has_grade(grade)) for grade in Grade}
    drawn = _count_per_frame(frames, lambda failure: failure.second_rendered)
    metrics = [ratio_metric(str(grade), hits[grade], objects) for grade in Grade]
    metrics.append(ratio_metric(_SURVIVE, hits[Grade.CONFIRMED], drawn))
    *rates, survive = bootstrap_intervals(metrics, len(frames), draws, np.random.default_rng(seed))
    return ArmGrades(
        name=run.arm.name,
        control=run.arm.control,
        frames=len(frames),
        objects=int(objects.sum()),
        passes=sum(frame.passes for frame in frames),
        counts={grade: int(hits[grade].sum()) for grade in Grade},
        rates=dict(zip(Grade, rates, strict=True)),
        kinds={
            kind: {grade: sum(f.error == kind and has_grade(grade)(f) for f in recorded) for grade in Grade}
            for kind in Kind
        },
        second_rendered=int(drawn.sum()),
        survive=survive,
    )


def _count_per_frame(frames: Sequence[FrameCounts], counts: Callable[[FailureRecord], bool]) -> Floats:
    """Failures (F,) of each frame that count."""
    return np.array([sum(map(counts, frame.failures)) for frame in frames], np.float64)


@dataclass(frozen=True, slots=True)
class SearchCost:
    """What the certain failures of an arm cost."""

    name: str
    """Name of the arm."""
    seconds: float
    """Mean time of a frame, certificates included."""
    per_100_passes: Interval
    """Certain failures per 100 detector passes."""
    per_minute: Interval
    """Certain failures per minute."""
    ahead: PairedDifference | None
    """Certain failures per object, the first arm's less this one's; None for the first."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        row: dict[str, Any] = {"name": self.name, "seconds": self.seconds}
        row |= interval_columns("per_100_passes", self.per_100_passes)
        row |= interval_columns("per_minute", self.per_minute)
        return row if self.ahead is None else row | interval_columns("ahead", self.ahead.interval)


def search_costs(
    runs: Sequence[ArmCounts], objects: Mapping[str, Sequence[DetectedObject]], draws: int, seed: int
) -> list[SearchCost]:
    """Cost of each arm, compared with the first.

    Args:
        runs: Arms on the same frames.
        objects: Detected objects by frame, from `find_detected_objects`.
        draws: Bootstrap draws of frames.
        seed: Seed of the draws.
    """
    certain_of_first = _count_per_frame(runs[0].frames, has_grade(Grade.CERTAIN))
    detected = np.array([len(objects[frame.identifier]) for frame in runs[0].frames], np.float64)
    costs = []
    for run in runs:
        certain = _count_per_frame(run.frames, has_grade(Grade.CERTAIN))
        seconds = np.array([frame.seconds for frame in run.frames])
        passes = np.array([frame.passes for frame in run.frames], np.float64)
        metrics = [ratio_metric("passes", certain, passes / 100), ratio_metric("minute", certain, seconds / 60)]
        by_pass, by_minute = bootstrap_intervals(metrics, len(certain), draws, np.random.default_rng(seed))
        pair = [ratio_metric("certain", certain, detected)], [ratio_metric("certain", certain_of_first, detected)]
        (ahead,) = paired_differences(*pair, len(certain), draws, np.random.default_rng(seed))
        mean = float(seconds.mean()) if len(seconds) else 0.0
        costs.append(SearchCost(run.arm.name, mean, by_pass, by_minute, None if run is runs[0] else ahead))
    return costs


@dataclass(frozen=True, slots=True)
class WithstandingObjects:
    """Objects of one size or distance class that the detector finds in the photograph."""

    name: str
    """Name of the class."""
    objects: int
    """Number of objects."""
    lost: int
    """How many of them some arm makes the detector lose with certainty."""

    @property
    def share(self) -> Interval:
        """Share that no arm makes it lose, with Wilson's interval; None without objects."""
        if not self.objects:
            return Interval(self.name, None, None, None)
        standing = self.objects - self.lost
        return Interval(self.name, standing / self.objects, *wilson(standing, self.objects))

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        share = self.share
        row = {"name": self.name, "objects": self.objects, "lost": self.lost}
        return row | {"standing": share.value, "low": share.low, "high": share.high}


def load_depths(run: ArmRun, out: Path) -> dict[str, list[float]]:
    """Distances in metres of the objects in each frame's photograph, from a run of the study in `out`."""
    frames = out / ARMS / run.arm.folder / FRAMES
    names = [result.identifier for result in run.results]
    scenes = ((name, load_scene(frames / name / "scene").as_photographed()) for name in names)
    return {name: scene.objects.translation[:, 2].tolist() for name, scene in scenes}


def find_detected_objects(
    run: ArmRun, depths: Mapping[str, Sequence[float]]
) -> dict[str, tuple[DetectedObject, ...]]:
    """Judged objects by frame that the detector finds in the photograph; depths: from `load_depths`."""
    objects: dict[str, tuple[DetectedObject, ...]] = {}
    for result in run.results:
        targets = run.judged.map_targets(targets_from_records(result.targets_benign, CLASSES))
        detections = detections_from_records(result.detections_benign, run.judged.names)
        found = failures.match_detections(targets, detections, run.summary.t_star).detected.tolist()
        # targets have further rows at the end
        hits = [box for box, hit in zip(result.targets_benign, found, strict=False) if hit]
        objects[result.identifier] = tuple(
            DetectedObject(box.index, box.xyxy[3] - box.xyxy[1], depths[result.identifier][box.index])
            for box in hits
            if box.index is not None
        )
    return objects


def count_withstanding(
    runs: Sequence[ArmCounts], objects: Mapping[str, Sequence[DetectedObject]]
) -> list[WithstandingObjects]:
    """Objects that withstand all arms but controls, by size and by distance; objects: by frame."""
    arms = [run for run in runs if run.arm.control is None]
    rows: list[tuple[DetectedObject, bool]] = []
    for place, frame in enumerate(arms[0].frames):
        lost = {failure.index for run in arms for failure in certain_losses(run.frames[place])}
        rows += [(one, one.object_index in lost) for one in objects[frame.identifier]]
    by_height = [(one.height_px, lost) for one, lost in rows]
    by_depth = [(one.depth_m, lost) for one, lost in rows]
    return [
        WithstandingObjects("all", len(rows), sum(lost for _, lost in rows)),
        *_classes("height", "px", _HEIGHTS_PX, by_height),
        *_classes("distance", "m", _DEPTHS_M, by_depth),
    ]


def _classes(
    name: str, unit: str, edges: Sequence[float], rows: Sequence[tuple[float, bool]]
) -> list[WithstandingObjects]:
    """Objects (value, lost) between the edges and beyond them."""
    classes = []
    for low, high in pairwise((-np.inf, *edges, np.inf)):
        bounds = f"{low:g} to {high:g}"
        if low == -np.inf or high == np.inf:
            bounds = f"below {high:g}" if high < np.inf else f"from {low:g}"
        lost = [lost for value, lost in rows if low <= value < high]
        classes.append(WithstandingObjects(f"{name} {bounds} {unit}", len(lost), sum(lost)))
    return classes


@dataclass(frozen=True, slots=True)
class SuccessCurve:
    """Share of frames that an arm breaks within so many queries, by moved labels."""

    name: str
    """Name of the arm."""
    max_queries: int
    """Its query budget."""
    shares: tuple[Interval, ...]
    """Share after 1, 2, ... queries, with intervals over frames."""
    mean_queries: float | None
    """Mean queries of a frame; a frame that is never broken takes the whole budget."""

    def at(self, queries: int) -> Interval:
        """The share after so many queries, or at the end."""
        return self.shares[min(queries, self.max_queries) - 1]

    def to_json(self) -> list[dict[str, Any]]:
        """One row for each number of queries."""
        return [
            {"name": self.name, "queries": q, "share": one.value, "low": one.low, "high": one.high}
            for q, one in enumerate(self.shares, start=1)
        ]


def first_successes(frames: Sequence[FrameCounts]) -> Floats:
    """Queries (F,) to the first success of each frame, at which it ends; infinite without one."""
    return np.array([f.queries if f.success_moved else np.inf for f in frames], np.float64)


def success_curve(run: ArmCounts, draws: int, seed: int) -> SuccessCurve:
    """The success curve of an arm.

    Args:
        run: The arm.
        draws: Bootstrap draws of frames.
        seed: Seed of the draws.
    """
    first, most = first_successes(run.frames), query_limit(run)
    metrics = [_broken_share(first <= q) for q in range(1, most + 1)]
    shares = bootstrap_intervals(metrics, len(first), draws, np.random.default_rng(seed))
    mean = float(np.mean([f.queries for f in run.frames])) if run.frames else None
    return SuccessCurve(run.arm.name, most, tuple(shares), mean)


def query_limit(run: ArmCounts) -> int:
    """The query budget of an arm."""
    config = run.arm.config
    return 1 if config.method == "fgsm" else config.queries or config.steps


def compare_success(run: ArmCounts, queries: int, other: ArmCounts, draws: int, seed: int) -> PairedDifference:
    """Share of frames that `run` breaks within a budget, less what another arm breaks with all of its own.

    Args:
        run: The arm with the budget.
        queries: The budget.
        other: The other arm, on the same frames.
        draws: Bootstrap draws of frames, paired.
        seed: Seed of the draws.
    """
    own, others = first_successes(run.frames) <= queries, np.isfinite(first_successes(other.frames))
    rng = np.random.default_rng(seed)
    (difference,) = paired_differences([_broken_share(others)], [_broken_share(own)], len(own), draws, rng)
    return difference


def _broken_share(broken: np.ndarray) -> NamedMetric:
    """Share of broken frames (F,) bool, that can be reweighted by frame."""
    return ratio_metric("share", broken.astype(np.float64), np.ones(len(broken)))
