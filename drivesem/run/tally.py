"""What the frames of a run add up to: said once, for runs and for parts of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.judging import JudgedClasses
from drivesem.evaluation import coco
from drivesem.failures.grades import Grade, Kind
from drivesem.failures.kinds import OF_OBJECTS
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult


class Graded(Protocol):
    """A failure, as `results.Failure`, or what is counted of one."""

    @property
    def index(self) -> int | None: ...
    @property
    def error(self) -> str | None: ...
    @property
    def grade(self) -> str | None: ...


F = TypeVar("F", bound=Graded)
F_co = TypeVar("F_co", bound=Graded, covariant=True)


class Failing(Protocol[F_co]):
    """A frame with failures."""

    @property
    def failures(self) -> Sequence[F_co]: ...


def boxes_of(
    results: Sequence[FrameResult], judged: JudgedClasses, labels: str, seen: str
) -> tuple[list[Targets], list[Detections]]:
    """Targets and detections of each frame. labels: benign or moved; seen: benign, rerendered or attacked."""
    targets = [judged.targets(as_targets(getattr(r, f"targets_{labels}"), CLASSES)) for r in results]
    return targets, [as_detections(getattr(r, f"detections_{seen}"), judged.names) for r in results]


def at_least(grade: Grade) -> Callable[[Graded], bool]:
    """Whether a failure has that grade or a higher one; every failure has that of the threshold."""
    higher = list(Grade)[list(Grade).index(grade) :]
    return lambda failure: failure.grade in higher or grade is Grade.THRESHOLD


def certain_losses(result: Failing[F]) -> list[F]:
    """Certain failures of objects; a phantom has no object whose states could be looked through."""
    certain = at_least(Grade.CERTAIN)
    return [f for f in result.failures if f.index is not None and f.error in OF_OBJECTS and certain(f)]


def graded(results: Sequence[FrameResult]) -> dict[str, Any]:
    """Those of the fields that say how sure the failures are, and what the search cost."""
    failures = [failure for r in results for failure in r.failures]
    return {
        "passes": sum(r.passes or 0 for r in results),
        "grades": {str(grade): sum(map(at_least(grade), failures)) for grade in Grade},
        "kinds": {str(kind): sum(f.error == kind for f in failures) for kind in Kind},
        "frames_ungraded": sum(not r.graded for r in results),
        "grade_notes": dict(Counter(note for r in results for note in r.grade_notes)),
    }


def tally(results: Sequence[FrameResult], judged: JudgedClasses, t_star: float, headline: str) -> dict[str, Any]:
    """Those fields of `RunSummary` that follow from its frames, by name."""

    def scores(labels: str, seen: str) -> coco.Scores:
        return coco.evaluate(*boxes_of(results, judged, labels, seen), judged.names, t_star, headline)

    def count(kind: str) -> dict[str, int]:
        labels = [failure.label for r in results for failure in r.failures if failure.kind == kind]
        return {name: labels.count(name) for name in judged.names}

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
        **graded(results),
    }
