"""What a detector sees of a scene's objects in a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Predictor, predict
from detectors.boxes import ioa_matrix, iou_matrix
from detectors.types import CLASSES, Detections
from scene_ir.io import to_uint8
from scene_ir.types import Category

Picture = NDArray[np.uint8]

SCORE, IOU = 0.3, 0.5
"""From which on, of a detection and of its overlap, a box counts as found."""
_HALF = 0.5
CAR = CLASSES[int(Category.CAR)]
VEHICLES = (CAR, "Truck", "truck", "bus", "train")
"""What a detector, ours or COCO's, may call what is left of a car."""


@dataclass(frozen=True, slots=True)
class DetectorSight:
    """How a detector saw one box: the IoU and the score of the detection that was given to it; zeros of none."""

    iou: float = 0.0
    score: float = 0.0

    @property
    def found(self) -> bool:
        """Whether that counts as found."""
        return self.iou >= IOU


UNSEEN = DetectorSight()


@dataclass(frozen=True, slots=True)
class CarView:
    """A picture (H, W, 3), the boxes (N, 4) px of the scene's N objects in it, and what a detector found, classes
    its labels' names.
    """

    picture: Picture
    boxes_xyxy: Tensor
    detections: Detections
    classes: tuple[str, ...]
    assigned: list[DetectorSight]
    """What was given to each object, as a car or the names of its view."""

    def sight(self, row: int, names: Sequence[str], score: float = SCORE) -> DetectorSight:
        """Best overlap with an object's box of all detections of its class, also those of other objects."""
        found = self.named(names, score)
        if not len(found):
            return UNSEEN
        overlap = iou_matrix(self.boxes_xyxy[row : row + 1], found.boxes_xyxy)[0]
        best = int(overlap.argmax())
        return DetectorSight(round(float(overlap[best]), 4), round(float(found.scores[best]), 4))

    def named(self, names: Sequence[str], score: float = SCORE) -> Detections:
        """The detections that are called so and score more."""
        of_name = torch.tensor([self.classes[int(label)] in names for label in self.detections.labels])
        wanted = of_name.bool() & (self.detections.scores > score)
        return Detections(
            *(t[wanted] for t in (self.detections.boxes_xyxy, self.detections.labels, self.detections.scores))
        )

    def ghost(self, row: int, before: CarView) -> DetectorSight:
        """The surest car at least half of which lies in an object's box, and that `before` did not have there."""
        found, known = self.named((CAR,)), before.named((CAR,))
        box = self.boxes_xyxy[row : row + 1]
        new = ioa_matrix(found.boxes_xyxy, box)[:, 0] >= _HALF
        if len(known):
            new &= iou_matrix(found.boxes_xyxy, known.boxes_xyxy).amax(dim=1) < IOU
        if not bool(new.any()):
            return UNSEEN
        best = int(torch.where(new, found.scores, -1.0).argmax())
        overlap = float(iou_matrix(found.boxes_xyxy[best : best + 1], box))
        return DetectorSight(round(overlap, 4), round(float(found.scores[best]), 4))


class DetectorView:
    """A detector for pictures as they are written to files."""

    def __init__(self, predictor: Predictor, names: Sequence[str] = (CAR,), score: float = SCORE) -> None:
        """names: classes of the detections that are assigned to objects; score: what these exceed."""
        self._predictor, self._names, self._score = predictor, names, score

    def view_cars(self, image: Tensor, boxes_xyxy: Tensor) -> CarView:
        """image (3, H, W) in [0, 1]; boxes (N, 4) px of the objects in it."""
        picture = to_uint8(image)
        given = torch.from_numpy(picture.transpose(2, 0, 1).copy()).float() / 255
        found = predict(self._predictor, given[None])[0]
        view = CarView(picture, boxes_xyxy, found, self._predictor.classes, [])
        return replace(view, assigned=assign(boxes_xyxy, view.named(self._names, self._score)))


def assign(boxes_xyxy: Tensor, detections: Detections) -> list[DetectorSight]:
    """One detection for each box (N, 4) at most, and one box for each detection: the best overlaps first."""
    overlap = iou_matrix(boxes_xyxy, detections.boxes_xyxy.to(boxes_xyxy)).numpy().copy()
    found = [UNSEEN] * len(boxes_xyxy)
    while overlap.size and overlap.max() > 0:
        box, detection = np.unravel_index(int(overlap.argmax()), overlap.shape)
        score = float(detections.scores[int(detection)])
        found[int(box)] = DetectorSight(round(float(overlap[box, detection]), 4), round(score, 4))
        overlap[box] = 0
        overlap[:, detection] = 0
    return found
