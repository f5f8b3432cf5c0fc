"""Several detectors as one, to be attacked together.

An object is detected if any member detects it, and a false positive of any member is one of the ensemble. Each
member's logits are shifted so that its t* becomes the ensemble's, which makes scores comparable.
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
from detectors.base import Candidates, Detector, DetectorError, lower_probability
from detectors.types import Detections, Targets

PREFIX = "ensemble:"
"""Before detector names joined by +: ensemble:squeezedet+yolov3-slim."""
T_STAR = 0.5
NMS_IOU = 0.5
"""IoU above which the best of several detections of one class is used."""


@dataclass(frozen=True, slots=True)
class EnsemblePredictions:
    """Raw predictions of all members for a batch."""

    members: tuple[Any, ...]
    """One per member."""

    def __len__(self) -> int:
        return len(self.members[0])

    def select(self, index: int) -> EnsemblePredictions:
        """The predictions of one image, as a batch of one."""
        return EnsemblePredictions(tuple(raw.select(index) for raw in self.members))


class Ensemble(Detector):
    """Detectors with the same classes.

    Raises:
        DetectorError: Fewer than two members, different classes, or a t* of 0 or 1, which no shift can change.
    """

    def __init__(self, members: Sequence[Detector]) -> None:
        super().__init__()
        if len(members) < 2:
            raise DetectorError(f"{PREFIX} expected at least two detectors joined by +, found {len(members)}")
        first, *others = members
        for member in others:
            if member.classes != first.classes:
                theirs, own = (", ".join(names) for names in (first.classes, member.classes))
                raise DetectorError(
                    f"{PREFIX} {member.name}: expected {first.name}'s classes, {theirs}, found {own}"
                )
        for member in members:
            if not 0 < member.t_star < 1:
                raise DetectorError(
                    f"{PREFIX} {member.name}: expected a t* above 0 and below 1, found {member.t_star:g}"
                )
        self.members = nn.ModuleList(members)
        self.name = PREFIX + "+".join(one.name for one in members)
        self.classes, self.t_star = first.classes, T_STAR

    def _with_predictions(self, raw: EnsemblePredictions) -> list[tuple[Detector, Any]]:
        return list(zip(self._detectors(), raw.members, strict=True))

    def _detectors(self) -> list[Detector]:
        return [member for member in self.members if isinstance(member, Detector)]

    def forward(self, images: Tensor) -> EnsemblePredictions:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        return EnsemblePredictions(tuple(member(images) for member in self._detectors()))

    def loss(self, raw: EnsemblePredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """Means of the members' "total" and "objectness"."""
        losses = [member.loss(predictions, targets) for member, predictions in self._with_predictions(raw)]
        return {name: torch.stack([terms[name] for terms in losses]).mean() for name in ("total", "objectness")}

    def candidates(self, raw: EnsemblePredictions) -> Candidates:
        """The members' candidates, with shifted scores."""
        boxes_xyxy, log_scores = [], []
        for member, predictions in self._with_predictions(raw):
            candidates = member.candidates(predictions)
            boxes_xyxy.append(candidates.boxes_xyxy.expand(-1, len(self.classes), -1))
            log_scores.append(_lower_log_scores(candidates.log_scores, _shift(member.t_star)))
        return Candidates(torch.cat(boxes_xyxy), torch.cat(log_scores))

    @torch.no_grad()
    def decode(self, raw: EnsemblePredictions) -> list[Detections]:
        """The members' detections after suppression across members."""
        per_member = [member.decode(predictions) for member, predictions in self._with_predictions(raw)]
        return [self._merge([detections[image] for detections in per_member]) for image in range(len(raw))]

    def _merge(self, per_member: Sequence[Detections]) -> Detections:
        boxes_xyxy = torch.cat([detections.boxes_xyxy for detections in per_member])
        labels = torch.cat([detections.labels for detections in per_member])
        shifts = [
            d.scores.new_tensor(_shift(m.t_star)) for m, d in zip(self._detectors(), per_member, strict=True)
        ]
        scores = torch.cat([lower_probability(d.scores, by) for d, by in zip(per_member, shifts, strict=True)])
        order = torch.sort(scores, descending=True, stable=True).indices
        selected = order[boxes.nms(boxes_xyxy[order], scores[order], NMS_IOU, labels[order])]
        return Detections(boxes_xyxy[selected], labels[selected], scores[selected])

    @contextmanager
    def freeze_choices(self, raw: EnsemblePredictions) -> Iterator[None]:
        """`freeze_choices` of all members."""
        with ExitStack() as stack:
            for member, predictions in self._with_predictions(raw):
                stack.enter_context(member.freeze_choices(predictions))
            yield


def parse_member_names(spec: str) -> list[str]:
    """The detectors of "ensemble:a+b".

    Raises:
        DetectorError: Fewer than two names.
    """
    names = [part.strip() for part in spec.removeprefix(PREFIX).split("+")]
    if len(names) < 2 or not all(names):
        raise DetectorError(f"{spec}: expected {PREFIX}A+B, at least two detectors, found {len(names)}")
    return names


def _shift(t_star: float) -> float:
    """How far a member's logits are lowered."""
    return _logit(t_star) - _logit(T_STAR)


def _lower_log_scores(log_score: Tensor, by: float) -> Tensor:
    """Logarithms of scores after lowering their logits by `by`; exact near 0."""
    return log_score - by - torch.log1p(log_score.exp() * math.expm1(-by))


def _logit(probability: float) -> float:
    return math.log(probability) - math.log1p(-probability)
