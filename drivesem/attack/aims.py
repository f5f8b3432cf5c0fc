"""Whom an attack is after: everything, chosen objects, or chosen classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors.types import CLASSES, Detections, Targets
from drivesem.config.errors import UsageError
from drivesem.evaluation.failures import Failures


@dataclass(frozen=True, slots=True)
class Aim:
    """objects: indices of the scene's objects; classes: names among CLASSES; None is all of them.

    Of others, what is lost counts as no failure, and no attack asks for it. Where objects are chosen and no
    class, no phantom counts: the attack is after these objects.
    """

    objects: tuple[int, ...] | None = None
    classes: tuple[str, ...] | None = None

    @classmethod
    def of(cls, objects: str | None, classes: str | None) -> Aim:
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
        if self == EVERYTHING:
            return targets
        return Targets(targets.boxes_xyxy, targets.labels, targets.ignore | ~self._aimed_at(targets))

    def failures(
        self, found: Failures, targets: Targets, detections: Detections, names: Sequence[str]
    ) -> Failures:
        """Those failures that are aimed at. targets: labels among CLASSES; detections: labels among `names`."""
        if self == EVERYTHING:
            return found
        aimed = self._aimed_at(targets)
        known = self.classes_of(names)
        return Failures(
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


EVERYTHING = Aim()


def _words(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]
