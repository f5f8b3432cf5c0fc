"""Several detectors as one, to attack together: what all of them get wrong, others may get wrong too.

An object is found where any member finds it, and a phantom is any member's. So that their scores compare, each
member's logits are shifted by what takes its t* to the ensemble's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from detectors import boxes
from detectors.base import Candidates, Detector, DetectorError, lowered_probability
from detectors.types import Detections, Targets

PREFIX = "ensemble:"
"""Before detectors with + between: ensemble:squeezedet+yolov3-slim."""
T_STAR = 0.5
NMS_IOU = 0.5
"""Detections of one class that overlap as much are one object's: the most certain member's stands."""


@dataclass(frozen=True, slots=True)
class Said:
    """What each member says of a batch."""

    members: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.members[0])

    def one(self, index: int) -> Said:
        """Of one image of the batch, as a batch of one."""
        return Said(tuple(raw.one(index) for raw in self.members))


class Ensemble(Detector):
    """Detectors with the same classes. DetectorError for fewer than two, other classes, or a t* of 0 or 1, which
    no shift takes to another.
    """

    def __init__(self, members: Sequence[Detector]) -> None:
        super().__init__()
        if len(members) < 2:
            raise DetectorError(f"{PREFIX} expected at least two detectors with + between, found {len(members)}")
        first, *others = members
        for one in others:
            if one.classes != first.classes:
                theirs, own = (", ".join(names) for names in (first.classes, one.classes))
                raise DetectorError(f"{PREFIX} {one.name}: expected {first.name}'s classes, {theirs}, found {own}")
        for one in members:
            if not 0 < one.t_star < 1:
                raise DetectorError(
                    f"{PREFIX} {one.name}: expected a t* above 0 and below 1, found {one.t_star:g}"
                )
        self.members = nn.ModuleList(members)
        self.name = PREFIX + "+".join(one.name for one in members)
        self.classes, self.t_star = first.classes, T_STAR

    def _each(self) -> list[Detector]:
        return [one for one in self.members if isinstance(one, Detector)]

    def forward(self, images: Tensor) -> Said:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        return Said(tuple(one(images) for one in self._each()))

    def loss(self, raw: Said, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """ "total" and "objectness": means of the members'."""
        terms = [one.loss(said, targets) for one, said in zip(self._each(), raw.members, strict=True)]
        return {name: torch.stack([own[name] for own in terms]).mean() for name in ("total", "objectness")}

    def candidates(self, raw: Said) -> Candidates:
        """All of the members'."""
        found = [one.candidates(said) for one, said in zip(self._each(), raw.members, strict=True)]
        placed = [c.boxes_xyxy.expand(-1, len(self.classes), -1) for c in found]
        logs = [_shifted(c.log_scores, _shift(one.t_star)) for c, one in zip(found, self._each(), strict=True)]
        return Candidates(torch.cat(placed), torch.cat(logs))

    @torch.no_grad()
    def decode(self, raw: Said) -> list[Detections]:
        """What any member finds, each object once."""
        every = [one.decode(said) for one, said in zip(self._each(), raw.members, strict=True)]
        return [self._joined([found[image] for found in every]) for image in range(len(raw))]

    def _joined(self, found: Sequence[Detections]) -> Detections:
        placed = torch.cat([one.boxes_xyxy for one in found])
        labels = torch.cat([one.labels for one in found])
        scores = torch.cat(
            [
                lowered_probability(one.scores, one.scores.new_tensor(_shift(member.t_star)))
                for one, member in zip(found, self._each(), strict=True)
            ]
        )
        order = torch.sort(scores, descending=True, stable=True).indices
        kept = order[boxes.nms(placed[order], scores[order], NMS_IOU, labels[order])]
        return Detections(placed[kept], labels[kept], scores[kept])

    @contextmanager
    def holding(self, raw: Said) -> Iterator[None]:
        """The members'."""
        with ExitStack() as stack:
            for one, said in zip(self._each(), raw.members, strict=True):
                stack.enter_context(one.holding(said))
            yield


def names_of(spec: str) -> list[str]:
    """The detectors of "ensemble:a+b". DetectorError where they are not two or more."""
    names = [part.strip() for part in spec.removeprefix(PREFIX).split("+")]
    if len(names) < 2 or not all(names):
        raise DetectorError(f"{spec}: expected {PREFIX}A+B, at least two detectors, found {len(names)}")
    return names


def _shift(t_star: float) -> float:
    """How far a member's logits are lowered."""
    return _logit(t_star) - _logit(T_STAR)


def _shifted(log_score: Tensor, by: float) -> Tensor:
    """log(s') of log(s), where the logit of s' is that of s less `by`; exact near 0."""
    return log_score - by - torch.log1p(log_score.exp() * math.expm1(-by))


def _logit(probability: float) -> float:
    return math.log(probability) - math.log1p(-probability)
