"""Summarises the frames of a run, or of a part of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.targets import EvaluatedClasses
from drivesem.evaluation import coco
from drivesem.failures.grades import Grade, Kind
from drivesem.failures.kinds import OBJECT_KINDS
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.run.results import FrameResult


class GradedFailure(Protocol):
    """A failure with a kind and a grade, such as `results.Failure`."""

    @property
    def index(self) -> int | None: ...
    @property
    def error(self) -> str | None: ...
    @property
    def grade(self) -> str | None: ...


F = TypeVar("F", bound=GradedFailure)
F_co = TypeVar("F_co", bound=GradedFailure, covariant=True)


class FrameWithFailures(Protocol[F_co]):
    """A frame with failures, such as `results.FrameResult`."""

    @property
    def failures(self) -> Sequence[F_co]: ...


def targets_and_detections(
    results: Sequence[FrameResult], classes: EvaluatedClasses, labels: str, picture: str
) -> tuple[list[Targets], list[Detections]]:
    """Return targets and detections of each frame.

    Args:
        results: The frames.
        classes: Evaluated classes.
        labels: benign or moved.
        picture: benign, rerendered or attacked.
    """
    targets = [
        classes.map_targets(targets_from_records(getattr(r, f"targets_{labels}"), CLASSES)) for r in results
    ]
    return targets, [detections_from_records(getattr(r, f"detections_{picture}"), classes.names) for r in results]


def has_grade(grade: Grade) -> Callable[[GradedFailure], bool]:
    """Return a predicate: whether a failure has at least this grade. Every failure has that of the threshold."""
    higher = list(Grade)[list(Grade).index(grade) :]
    return lambda failure: failure.grade in higher or grade is Grade.THRESHOLD


def certain_losses(result: FrameWithFailures[F]) -> list[F]:
    """Return the certain failures of objects, without phantoms."""
    certain = has_grade(Grade.CERTAIN)
    return [f for f in result.failures if f.index is not None and f.error in OBJECT_KINDS and certain(f)]


def count_grades(results: Sequence[FrameResult]) -> dict[str, Any]:
    """Count failures by grade and kind, and detector passes."""
    failures = [failure for r in results for failure in r.failures]
    return {
        "passes": sum(r.passes or 0 for r in results),
        "grades": {str(grade): sum(map(has_grade(grade), failures)) for grade in Grade},
        "kinds": {str(kind): sum(f.error == kind for f in failures) for kind in Kind},
        "frames_ungraded": sum(not r.graded for r in results),
        "grade_notes": dict(Counter(note for r in results for note in r.grade_notes)),
    }


def summarise_frames(
    results: Sequence[FrameResult], classes: EvaluatedClasses, t_star: float, headline: str
) -> dict[str, Any]:
    """Compute the fields of `RunSummary` that follow from its frames.

    Args:
        results: The frames.
        classes: Evaluated classes.
        t_star: Score from which detections count.
        headline: Class of the headline.
    """

    def scores(labels: str, picture: str) -> coco.CocoScores:
        return coco.evaluate(
            *targets_and_detections(results, classes, labels, picture), classes.names, t_star, headline
        )

    def count(kind: str) -> dict[str, int]:
        labels = [failure.label for r in results for failure in r.failures if failure.kind == kind]
        return {name: labels.count(name) for name in classes.names}

    return {
        "frames": len(results),
        "objects": sum(r.objects for r in results),
        "benign": scores("benign", "benign"),
        "rerendered": scores("benign", "rerendered"),
        "attacked_paper": scores("benign", "attacked"),
        "attacked_moved": scores("moved", "attacked"),
        "lost_objects": count("lost"),
        "phantoms": count("phantom"),
        "successes_paper": sum(r.success_paper for r in results),
        "successes_moved": sum(r.success_moved for r in results),
        "feasible_fraction": sum(r.feasible for r in results) / len(results) if results else None,
        "queries": sum(r.queries for r in results),
        **count_grades(results),
    }
