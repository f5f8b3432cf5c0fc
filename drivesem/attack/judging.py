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

HEADLINE = "Car"
"""The class that the paper reports; a detector that is judged knows it."""
DEFAULT_T_STAR = 0.3
"""The score from which a detection counts, where a detector has no threshold of its own."""


@dataclass(frozen=True, slots=True)
class JudgedClasses:
    """names: the judged classes, in the order of CLASSES; own: all of the detector's, which its labels index."""

    names: tuple[str, ...]
    own: tuple[str, ...]

    @classmethod
    def of(cls, detector: Predictor) -> JudgedClasses:
        """Raises DetectorError where the detector does not know HEADLINE."""
        own = tuple(detector.classes)
        if HEADLINE not in own:
            raise DetectorError(f"detector {detector.name}: expected one that knows {HEADLINE}, found {_few(own)}")
        return cls(tuple(name for name in CLASSES if name in own), own)

    def detections(self, found: Detections) -> Detections:
        """Detections with labels among the detector's own classes, as those with labels among `names`."""
        if self.own == self.names:
            return found
        label = _places(self.own, self.names).to(found.labels.device)[found.labels]
        kept = label >= 0
        return Detections(found.boxes_xyxy[kept], label[kept], found.scores[kept])

    def targets(self, targets: Targets) -> Targets:
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

    def own_targets(self, targets: Targets) -> Targets:
        """Targets with labels among `names`, as the detector's loss takes them: labels among its own classes."""
        if self.own == self.names:
            return targets
        label = _places(self.names, self.own).to(targets.labels.device)[targets.labels]
        return Targets(targets.boxes_xyxy, label, targets.ignore)


def t_star_of(detector: Predictor, asked: float | None = None, otherwise: float = DEFAULT_T_STAR) -> float:
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
