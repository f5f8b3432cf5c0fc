"""Counts per arm and frame from which the tables of a study are computed: detections, failures, cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from detectors.types import CLASSES
from drivesem.attacks.targets import HEADLINE
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.run.results import FrameResult
from tools.experiments.detection.arms import ArmRun, AttackArm, StudyArms
from tools.experiments.detection.labels import FrameLabels


@dataclass(frozen=True, slots=True)
class FailureRecord:
    """One failure of a frame."""

    index: int | None
    """Index of the lost object in the scene; None for a phantom."""
    error: str | None
    """Kind of error, one of `failures.grades.Kind`."""
    grade: str | None
    """Highest grade, one of `failures.grades.Grade`; None if not graded."""
    second_rendered: bool
    """Whether a second renderer drew it."""


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """One frame of an arm."""

    identifier: str
    """Name of the frame."""
    queries: int
    """Gradients or evaluated renders."""
    passes: int
    """Detector passes; a gradient counts as 3."""
    seconds: float
    """Time that the frame took."""
    feasible: bool
    """Whether the independent check finds no violation."""
    success_paper: bool
    """Whether the frame fails by the benign labels."""
    success_moved: bool
    """Whether it fails by the moved labels."""
    size: float
    """Norm of theta, each coordinate in units of its range."""
    judged_objects: int
    """Objects of the judged classes to find in the photograph."""
    failures: tuple[FailureRecord, ...] = ()
    """The failures of the frame."""

    @classmethod
    def from_result(cls, result: FrameResult, names: Sequence[str]) -> FrameCounts:
        """Count one result; names: the judged classes."""
        judged = [b for b in result.targets_benign if not b.ignore and b.index is not None and b.label in names]
        return cls(
            identifier=result.identifier,
            queries=result.queries,
            passes=result.passes or 0,
            seconds=result.seconds,
            feasible=result.feasible,
            success_paper=result.success_paper,
            success_moved=result.success_moved,
            size=change_size(result),
            judged_objects=len(judged),
            failures=tuple(
                FailureRecord(f.index, f.error, f.grade, f.second is not None) for f in result.failures
            ),
        )


@dataclass(frozen=True, slots=True)
class ArmCounts:
    """One arm on F frames."""

    arm: AttackArm
    """The arm."""
    frames: tuple[FrameCounts, ...]
    """Counts of each frame (F)."""
    before: ThresholdMatches
    """Detections in the photographs."""
    after: Mapping[str, ThresholdMatches]
    """Detections in the attacked pictures by label mode, `paper` and `moved`."""

    @classmethod
    def from_run(cls, run: ArmRun) -> ArmCounts:
        """Count the results of a finished run."""
        names, label = run.judged.names, run.judged.names.index(HEADLINE)
        benign = [run.judged.map_targets(targets_from_records(r.targets_benign, CLASSES)) for r in run.results]
        moved = [run.judged.map_targets(targets_from_records(r.targets_moved, CLASSES)) for r in run.results]
        photographs = [detections_from_records(r.detections_benign, names) for r in run.results]
        attacked = [detections_from_records(r.detections_attacked, names) for r in run.results]
        return cls(
            arm=run.arm,
            frames=tuple(FrameCounts.from_result(result, names) for result in run.results),
            before=ThresholdMatches.from_frames(benign, photographs, label),
            after={
                "paper": ThresholdMatches.from_frames(benign, attacked, label),
                "moved": ThresholdMatches.from_frames(moved, attacked, label),
            },
        )

    @property
    def graded(self) -> bool:
        """Whether all failures are graded."""
        return all(failure.grade is not None for frame in self.frames for failure in frame.failures)


@dataclass(frozen=True, slots=True)
class DetectedObject:
    """An object that the detector finds in the photograph."""

    object_index: int
    """Index in the scene."""
    height_px: float
    """Height of its box."""
    depth_m: float
    """Distance from the camera along its axis."""


@dataclass(frozen=True, slots=True)
class StudyCounts:
    """All arms of a study, on the same frames."""

    arms: tuple[ArmCounts, ...]
    """Counts of each arm."""
    without_vehicles: int
    """Frames skipped for lack of vehicles."""
    failed: Mapping[str, str]
    """Reason by frame that could not be used."""
    detected_objects: Mapping[str, tuple[DetectedObject, ...]] = field(default_factory=dict)
    """By frame, for the study `searches`."""
    labels: Mapping[str, tuple[FrameLabels, ...]] = field(default_factory=dict)
    """By arm, frame by frame, for the study `labels`."""

    @classmethod
    def from_arms(cls, arms: StudyArms) -> StudyCounts:
        """Count finished arms, without what only some studies need."""
        return cls(tuple(map(ArmCounts.from_run, arms.runs)), arms.without_vehicles, arms.failed)

    @property
    def frames(self) -> list[FrameCounts]:
        """The frames of all arms."""
        return [frame for arm in self.arms for frame in arm.frames]


def change_size(result: FrameResult) -> float:
    """Norm of a frame's theta, each coordinate in units of its range."""
    values = [c.value / (c.upper - c.lower) for c in result.theta if c.upper > c.lower]
    return float(np.linalg.norm(values))
