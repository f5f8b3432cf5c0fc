"""The evaluated classes, the targeted objects, and the score threshold t* of a detector.

Labels use `detectors.types.CLASSES`; a detector may have more, fewer, or other classes. Classes of the same name are
evaluated. Detections of other classes do not count, and objects of a class that the detector lacks are ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors.base import DetectorError, Predictor
from detectors.types import CLASSES, Detections, Targets
from drivesem.config.errors import UsageError
from drivesem.evaluation.failures import FrameFailures

HEADLINE = "Car"
"""The class that the paper reports, which every evaluated detector must have."""
DEFAULT_T_STAR = 0.3
"""Score threshold of a detection for detectors without their own."""


def resolve_t_star(detector: Predictor, t_star: float | None = None, default: float = DEFAULT_T_STAR) -> float:
    """The score threshold of a detection.

    Args:
        detector: has its own threshold, or none.
        t_star: overrides the detector's own.
        default: for detectors without their own.
    """
    if t_star is not None:
        return t_star
    own: float | None = getattr(detector, "t_star", None)
    return default if own is None else float(own)


@dataclass(frozen=True, slots=True)
class EvaluatedClasses:
    """The classes of a detector that are evaluated."""

    names: tuple[str, ...]
    """Evaluated classes, in the order of CLASSES."""
    detector_classes: tuple[str, ...]
    """All classes of the detector, which its labels index."""

    @classmethod
    def from_detector(cls, detector: Predictor) -> EvaluatedClasses:
        """The evaluated classes of a detector. Raises DetectorError where it lacks HEADLINE."""
        own = tuple(detector.classes)
        if HEADLINE not in own:
            found = ", ".join(own[:6]) + (", ..." if len(own) > 6 else "")
            raise DetectorError(f"detector {detector.name}: expected one that knows {HEADLINE}, found {found}")
        return cls(tuple(name for name in CLASSES if name in own), own)

    def map_detections(self, detections: Detections) -> Detections:
        """Detections of the evaluated classes, on the CPU; labels change from the detector's own to `names`."""
        if detections.scores.is_cuda:
            detections = Detections(
                *(t.cpu() for t in (detections.boxes_xyxy, detections.labels, detections.scores))
            )
        if self.detector_classes == self.names:
            return detections
        labels = _index_map(self.detector_classes, self.names)[detections.labels]
        rows = labels >= 0
        return Detections(detections.boxes_xyxy[rows], labels[rows], detections.scores[rows])

    def map_targets(self, targets: Targets) -> Targets:
        """Targets with labels among `names` instead of CLASSES; rows stay in order.

        An object of another class is ignored for each of `names`, in additional rows at the end.
        """
        if self.names == CLASSES:
            return targets
        labels = _index_map(CLASSES, self.names).to(targets.labels.device)[targets.labels]
        foreign = labels < 0
        others = len(self.names) - 1
        additional = torch.arange(1, others + 1, device=labels.device).repeat(int(foreign.sum()))
        return Targets(
            boxes_xyxy=torch.cat([targets.boxes_xyxy, targets.boxes_xyxy[foreign].repeat_interleave(others, 0)]),
            labels=torch.cat([labels.clamp_min(0), additional]),
            ignore=torch.cat([targets.ignore | foreign, torch.ones_like(additional, dtype=torch.bool)]),
        )

    def to_detector_targets(self, targets: Targets) -> Targets:
        """Targets for the detector's loss: labels change from `names` to its own classes."""
        if self.detector_classes == self.names:
            return targets
        labels = _index_map(self.names, self.detector_classes).to(targets.labels.device)[targets.labels]
        return Targets(targets.boxes_xyxy, labels, targets.ignore)


def _index_map(names: Sequence[str], others: Sequence[str]) -> Tensor:
    """Index (N,) int64 of each of `names` in `others`; -1 where it is missing."""
    return torch.tensor([others.index(name) if name in others else -1 for name in names])


@dataclass(frozen=True, slots=True)
class TargetSelection:
    """The objects and classes that an attack targets; failures of others do not count. With targeted objects and no
    targeted class, no phantom counts.
    """

    objects: tuple[int, ...] | None = None
    """Indices of the scene's objects; None: all."""
    classes: tuple[str, ...] | None = None
    """Names among CLASSES; None: all."""

    @classmethod
    def from_options(cls, objects: str | None, classes: str | None) -> TargetSelection:
        """Parse the values of --target-objects and --target-classes. Raises UsageError naming the option."""
        rows = None if objects is None else _split(objects)
        names = None if classes is None else _split(classes)
        if rows is not None and not (rows and all(row.isdecimal() for row in rows)):
            raise UsageError("--target-objects", "indices of objects with commas", repr(objects))
        if names is not None and not (names and set(names) <= set(CLASSES)):
            raise UsageError("--target-classes", f"classes among {', '.join(CLASSES)}", repr(classes))
        return cls(
            objects=None if rows is None else tuple(sorted({int(row) for row in rows})),
            classes=None if names is None else tuple(name for name in CLASSES if name in names),
        )

    def targets(self, targets: Targets) -> Targets:
        """Targets with all but the targeted ones ignored. Labels are among CLASSES; the first rows are the scene's
        objects.
        """
        if self == ALL_TARGETS:
            return targets
        return Targets(targets.boxes_xyxy, targets.labels, targets.ignore | ~self._targeted(targets))

    def failures(
        self, failures: FrameFailures, targets: Targets, detections: Detections, names: Sequence[str]
    ) -> FrameFailures:
        """The failures that are targeted.

        Args:
            failures: all failures of a frame.
            targets: labels among CLASSES.
            detections: labels among `names`.
            names: the evaluated classes.
        """
        if self == ALL_TARGETS:
            return failures
        targeted = self._targeted(targets)
        phantom_classes = self.classes_of(names)
        return FrameFailures(
            lost=tuple(i for i in failures.lost if bool(targeted[i])),
            phantoms=tuple(i for i in failures.phantoms if names[int(detections.labels[i])] in phantom_classes),
        )

    def classes_of(self, names: Sequence[str]) -> tuple[str, ...]:
        """The classes among `names` in which phantoms count."""
        if self.classes is not None:
            return tuple(name for name in names if name in self.classes)
        return tuple(names) if self.objects is None else ()

    def headline(self, names: Sequence[str]) -> str:
        """The class among `names` with the first results: HEADLINE, unless it is not targeted."""
        targeted = self.classes_of(names) if self.classes is not None else ()
        return HEADLINE if HEADLINE in targeted or not targeted else targeted[0]

    def _targeted(self, targets: Targets) -> Tensor:
        """(M,) bool: which targets are targeted."""
        targeted = torch.ones(len(targets), dtype=torch.bool, device=targets.labels.device)
        if self.objects is not None:
            targeted &= torch.isin(torch.arange(len(targeted)), torch.tensor(self.objects)).to(targeted.device)
        if self.classes is not None:
            labels = torch.tensor([CLASSES.index(name) for name in self.classes]).to(targets.labels)
            targeted &= torch.isin(targets.labels, labels)
        return targeted


ALL_TARGETS = TargetSelection()


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]
