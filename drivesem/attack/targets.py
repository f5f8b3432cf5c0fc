"""Which of a detector's classes are judged, and from which score on: said once for eval, attacks and transfer.

Labels know the classes of `detectors.types.CLASSES`; a detector may know more, fewer, or others. Classes of the
same name are judged. What a detector says of others counts nowhere, and objects that it has no name for are
ignored: neither missed nor a hit.
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
"""The class that the paper reports; a detector that is judged knows it."""
DEFAULT_T_STAR = 0.3
"""The score from which a detection counts, where a detector has no threshold of its own."""


@dataclass(frozen=True, slots=True)
class EvaluatedClasses:
    """names: the judged classes, in the order of CLASSES; own: all of the detector's, which its labels index."""

    names: tuple[str, ...]
    detector_classes: tuple[str, ...]

    @classmethod
    def from_detector(cls, detector: Predictor) -> EvaluatedClasses:
        """Raises DetectorError where the detector does not know HEADLINE."""
        own = tuple(detector.classes)
        if HEADLINE not in own:
            raise DetectorError(f"detector {detector.name}: expected one that knows {HEADLINE}, found {_few(own)}")
        return cls(tuple(name for name in CLASSES if name in own), own)

    def map_detections(self, found: Detections) -> Detections:
        """Detections with labels among the detector's own classes, as those with labels among `names`."""
        if self.detector_classes == self.names:
            return found
        label = _places(self.detector_classes, self.names).to(found.labels.device)[found.labels]
        kept = label >= 0
        return Detections(found.boxes_xyxy[kept], label[kept], found.scores[kept])

    def map_targets(self, targets: Targets) -> Targets:
        """Targets with labels among CLASSES, as those with labels among `names`.

        The i-th row stays the i-th. An object of no judged class is ignored for each of them, in further rows at
        the end.
        """
        if self.names == CLASSES:
            return targets
        label = _places(CLASSES, self.names).to(targets.labels.device)[targets.labels]
        foreign = label < 0
        others = len(self.names) - 1
        further = torch.arange(1, others + 1, device=label.device).repeat(int(foreign.sum()))
        return Targets(
            boxes_xyxy=torch.cat([targets.boxes_xyxy, targets.boxes_xyxy[foreign].repeat_interleave(others, 0)]),
            labels=torch.cat([label.clamp_min(0), further]),
            ignore=torch.cat([targets.ignore | foreign, torch.ones_like(further, dtype=torch.bool)]),
        )

    def to_detector_targets(self, targets: Targets) -> Targets:
        """Targets with labels among `names`, as the detector's loss takes them: labels among its own classes."""
        if self.detector_classes == self.names:
            return targets
        label = _places(self.names, self.detector_classes).to(targets.labels.device)[targets.labels]
        return Targets(targets.boxes_xyxy, label, targets.ignore)


def resolve_t_star(detector: Predictor, asked: float | None = None, otherwise: float = DEFAULT_T_STAR) -> float:
    """The score from which a detection counts: as asked, else the detector's own, else `otherwise`."""
    if asked is not None:
        return asked
    own: float | None = getattr(detector, "t_star", None)
    return otherwise if own is None else float(own)


def _places(names: Sequence[str], among: Sequence[str]) -> Tensor:
    """Where each of `names` stands among others (N,) int64; -1 where it is none of them."""
    return torch.tensor([among.index(name) if name in among else -1 for name in names])


def _few(names: Sequence[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


@dataclass(frozen=True, slots=True)
class TargetSelection:
    """objects: indices of the scene's objects; classes: names among CLASSES; None is all of them.

    Of others, what is lost counts as no failure, and no attack asks for it. Where objects are chosen and no
    class, no phantom counts: the attack is after these objects.
    """

    objects: tuple[int, ...] | None = None
    classes: tuple[str, ...] | None = None

    @classmethod
    def from_options(cls, objects: str | None, classes: str | None) -> TargetSelection:
        """Of a command's words, with commas. Raises UsageError naming the setting."""
        rows = None if objects is None else _words(objects)
        names = None if classes is None else _words(classes)
        if rows is not None and not (rows and all(row.isdecimal() for row in rows)):
            raise UsageError("--target-objects", "indices of objects with commas", repr(objects))
        if names is not None and not (names and set(names) <= set(CLASSES)):
            raise UsageError("--target-classes", f"classes among {', '.join(CLASSES)}", repr(classes))
        return cls(
            objects=None if rows is None else tuple(sorted({int(row) for row in rows})),
            classes=None if names is None else tuple(name for name in CLASSES if name in names),
        )

    def targets(self, targets: Targets) -> Targets:
        """Targets with labels among CLASSES, those that are not aimed at ignored. The i-th is object i, as far as
        there are objects.
        """
        if self == ALL_TARGETS:
            return targets
        return Targets(targets.boxes_xyxy, targets.labels, targets.ignore | ~self._aimed_at(targets))

    def failures(
        self, found: FrameFailures, targets: Targets, detections: Detections, names: Sequence[str]
    ) -> FrameFailures:
        """Those failures that are aimed at. targets: labels among CLASSES; detections: labels among `names`."""
        if self == ALL_TARGETS:
            return found
        aimed = self._aimed_at(targets)
        known = self.classes_of(names)
        return FrameFailures(
            lost=tuple(i for i in found.lost if bool(aimed[i])),
            phantoms=tuple(i for i in found.phantoms if names[int(detections.labels[i])] in known),
        )

    def classes_of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of `names` whose phantoms count."""
        if self.classes is not None:
            return tuple(name for name in names if name in self.classes)
        return tuple(names) if self.objects is None else ()

    def _aimed_at(self, targets: Targets) -> Tensor:
        """(M,) bool."""
        aimed = torch.ones(len(targets), dtype=torch.bool, device=targets.labels.device)
        if self.objects is not None:
            aimed &= torch.isin(torch.arange(len(aimed)), torch.tensor(self.objects)).to(aimed.device)
        if self.classes is not None:
            aimed &= torch.isin(
                targets.labels, torch.tensor([CLASSES.index(c) for c in self.classes]).to(targets.labels)
            )
        return aimed


ALL_TARGETS = TargetSelection()


def _words(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]
