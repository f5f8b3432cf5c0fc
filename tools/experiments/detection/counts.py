"""What a study's tables are computed from: of each arm, frame by frame, what was found, lost and spent.

Taken from the results of its runs, or from what an earlier study kept of them (`kept`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from detectors.types import CLASSES
from drivesem.attack.targets import HEADLINE
from drivesem.evaluation.matches import Matches
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult
from tools.experiments.detection.arms import AttackArm
from tools.experiments.detection.labels import FrameLabels
from tools.experiments.detection.running import ArmRun, StudyArms


@dataclass(frozen=True, slots=True)
class FailureRecord:
    """One failure. index: the lost object; error: its kind as `truth.kinds` names it; asked: whether a second
    renderer was.
    """

    object_index: int | None
    kind: str | None
    grade: str | None
    second_rendered: bool


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """One frame of an arm. size: of the change, as `size_of` gives it; judged: objects of all judged classes that
    the detector is to find in the photograph; the rest as in `FrameResult`.
    """

    identifier: str
    queries: int
    passes: int
    seconds: float
    feasible: bool
    success_paper: bool
    success_moved: bool
    size: float
    judged_objects: int
    failures: tuple[FailureRecord, ...]

    @classmethod
    def from_result(cls, result: FrameResult, names: Sequence[str]) -> FrameCounts:
        """names: of the judged classes."""
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
            judged=len(judged),
            failures=tuple(
                FailureRecord(f.index, f.error, f.grade, f.second is not None) for f in result.failures
            ),
        )


@dataclass(frozen=True, slots=True)
class ArmCounts:
    """One arm. before: detections in the photographs; after: in the attacked pictures, by label mode."""

    arm: AttackArm
    frames: tuple[FrameCounts, ...]
    before: Matches
    after: Mapping[str, Matches]

    @classmethod
    def from_run(cls, run: ArmRun) -> ArmCounts:
        """What came of it."""
        names, label = run.judged.names, run.judged.names.index(HEADLINE)
        benign = [run.judged.targets(as_targets(r.targets_benign, CLASSES)) for r in run.results]
        moved = [run.judged.targets(as_targets(r.targets_moved, CLASSES)) for r in run.results]
        photographs = [as_detections(r.detections_benign, names) for r in run.results]
        attacked = [as_detections(r.detections_attacked, names) for r in run.results]
        return cls(
            arm=run.arm,
            frames=tuple(FrameCounts.from_result(result, names) for result in run.results),
            before=Matches.of(benign, photographs, label),
            after={
                "paper": Matches.of(benign, attacked, label),
                "moved": Matches.of(moved, attacked, label),
            },
        )

    @property
    def graded(self) -> bool:
        """Whether somebody asked how sure each failure is."""
        return all(failure.grade is not None for frame in self.frames for failure in frame.failures)


@dataclass(frozen=True, slots=True)
class DetectedObject:
    """An object that the detector finds in the photograph. index: in the scene; height_px: of its box."""

    object_index: int
    height_px: float
    depth_m: float


@dataclass(frozen=True, slots=True)
class StudyCounts:
    """All arms, on the same frames. without_vehicles: frames that were passed over; failed: those that could not
    be used, and why; seen: by frame, labels: by arm, frame by frame, where a study asks for them.
    """

    arms: tuple[ArmCounts, ...]
    without_vehicles: int
    failed: Mapping[str, str]
    detected_objects: Mapping[str, tuple[DetectedObject, ...]] = field(default_factory=dict)
    labels: Mapping[str, tuple[FrameLabels, ...]] = field(default_factory=dict)

    @classmethod
    def from_arms(cls, ran: StudyArms) -> StudyCounts:
        """Of finished runs, without what only some studies ask for."""
        return cls(tuple(map(ArmCounts.from_run, ran.runs)), ran.without_vehicles, ran.failed)

    @property
    def frames(self) -> list[FrameCounts]:
        """Of all arms."""
        return [frame for arm in self.arms for frame in arm.frames]


def change_size(result: FrameResult) -> float:
    """Norm of a frame's theta, each coordinate in units of its bounds."""
    values = [c.value / (c.upper - c.lower) for c in result.theta if c.upper > c.lower]
    return float(np.linalg.norm(values))
