"""Detectors whose network gives many boxes with class probabilities: their loss and decoding, written once.

The loss is the one that attacks raise. It asks for nothing but boxes and probabilities, so that networks of any
family are attacked for the same thing; training needs the family's own.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from detectors import boxes
from detectors.base import Candidates, Detector, lowered_probability
from detectors.grid import IGNORE_OVERLAP, MEETING_IOU
from detectors.squeezedet import WEIGHT_CONFIDENCE_NEGATIVE, WEIGHT_CONFIDENCE_POSITIVE
from detectors.types import CLASSES, Detections, Targets

LEAST_SCORE = 0.05
"""What scores less is not decoded (torchvision's box_score_thresh)."""
CANDIDATES = 1000
"""Of an image, before suppression: the best scores."""
TOP_DETECTIONS = 100
"""Of an image, after suppression, as in COCO's evaluation."""
NMS_IOU = 0.5
LEAST_PROBABILITY = 1e-12
"""Whose logarithm is still a number."""
T_STAR = 0.3
"""Where nobody has measured the score of best F1."""


@dataclass(frozen=True, slots=True)
class DensePredictions:
    """A predictions for each of B images; differentiable.

    boxes_xyxy (B, A, K, 4) px of the image, not clipped: K is 1, or C where each class has a box of its own.
    probabilities (B, A, C) in [0, 1]. image_hw: size of the image, px. held: what the gradient takes as constant,
    one a image (Faster R-CNN: its proposals). counts: of each image its own predictions, which come first; what
    follows only fills up to the largest count, A. None: all are an image's own.
    """

    boxes_xyxy: Tensor
    probabilities: Tensor
    image_hw: tuple[int, int]
    held: tuple[Tensor, ...] = ()
    counts: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        b, a, c = self.probabilities.shape
        found = tuple(self.boxes_xyxy.shape)
        if found not in ((b, a, 1, 4), (b, a, c, 4)):
            raise ValueError(f"boxes_xyxy: expected shape {(b, a, 1, 4)} or {(b, a, c, 4)}, found {found}")
        if self.counts is not None and (len(self.counts) != b or max(self.counts, default=a) != a):
            raise ValueError(f"counts: expected {b}, the largest of them {a}, found {self.counts}")

    def __len__(self) -> int:
        return int(self.probabilities.shape[0])

    def one(self, index: int) -> DensePredictions:
        """What is said about one image of the batch, as a batch of one; without what only fills up."""
        rows = slice(index, index + 1)
        own = slice(None if self.counts is None else self.counts[index])
        held = self.held[rows] if self.held else ()
        return DensePredictions(self.boxes_xyxy[rows, own], self.probabilities[rows, own], self.image_hw, held)

    def planted(self, box_xyxy: Tensor, label: int) -> DensePredictions:
        """The same, but for a certain prediction in the first place of each image, and silence of all others."""
        # A network that suppresses may have said nothing: then there is no first place yet.
        missing = max(1 - self.probabilities.shape[1], 0)
        placed = F.pad(self.boxes_xyxy, (0, 0, 0, 0, 0, missing)).clone()
        probabilities = torch.zeros_like(F.pad(self.probabilities, (0, 0, 0, missing)))
        placed[:, 0] = box_xyxy.to(placed)
        probabilities[:, 0, label] = 1
        counts = None if self.counts is None else tuple(max(count, 1) for count in self.counts)
        return replace(self, boxes_xyxy=placed, probabilities=probabilities, counts=counts)

    def lowered(self, label: int, by: Tensor) -> DensePredictions:
        """The same, but for the class's probabilities; see `detectors.base.Lowerable`."""
        own = lowered_probability(self.probabilities[..., label], by)
        column = torch.arange(self.probabilities.shape[-1], device=own.device) == label
        return replace(self, probabilities=torch.where(column, own[..., None], self.probabilities))

    def boxes_of(self, image: int, label: int) -> Tensor:
        """Boxes (A, 4) px of one image for one class."""
        return self.boxes_xyxy[image, :, label if self.boxes_xyxy.shape[2] > 1 else 0]


class DenseDetector(Detector):
    """A detector whose `predict` gives boxes and class probabilities."""

    nms_iou = NMS_IOU
    least_score = LEAST_SCORE

    def __init__(self, name: str, classes: Sequence[str], t_star: float = T_STAR) -> None:
        super().__init__()
        self.name = name
        self.classes = tuple(classes)
        self.t_star = t_star

    @abstractmethod
    def predict(self, images: Tensor) -> DensePredictions:
        """images (B, 3, H, W), RGB in [0, 1], any size; differentiable to the images."""

    def forward(self, images: Tensor) -> DensePredictions:
        """What `predict` gives. ValueError where the images have another shape than (B, 3, H, W)."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"images: expected shape (B, 3, H, W), found {tuple(images.shape)}")
        return self.predict(images)

    def loss(self, raw: DensePredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """`dense_loss`, for attacks: it says nothing of where boxes should be."""
        return dense_loss(raw, targets, self.classes)

    def candidates(self, raw: DensePredictions) -> Candidates:
        """Every prediction; what has no area inside the image is none."""
        return Candidates(raw.boxes_xyxy[0], raw.probabilities[0].clamp_min(LEAST_PROBABILITY).log())

    @torch.no_grad()
    def decode(self, raw: DensePredictions) -> list[Detections]:
        """The best scores, NMS in each class, the best of what is left."""
        return [decode_one(raw, image, self.least_score, self.nms_iou) for image in range(len(raw))]


def dense_loss(raw: DensePredictions, targets: Sequence[Targets], classes: Sequence[str]) -> dict[str, Tensor]:
    """ "missed", "alarms" and their sum, as "total" and "objectness"; a mean over the images.

    missed: an object counts by its most probable prediction of its class that meets it (IoU of at least 0.5), with
    1 as the target, and by 1 where none does. alarms: the other predictions, each with 0 as the target, in classes
    that this project's labels know; in all where the detector knows none of them. No alarm is what meets an object
    of its class, or lies to more than half in an ignored region of its class. Which predictions meet what is taken
    as constant. Squares, and weights, are those of SqueezeDet's term of the same name, so that one attack's
    figures can be held against another's. Raises ValueError as `Detector.loss` does.
    """
    if len(targets) != len(raw):
        raise ValueError(f"targets: expected {len(raw)}, one for each image, found {len(targets)}")
    known = [i for i, name in enumerate(classes) if name in CLASSES] or list(range(len(classes)))
    missed, alarms = [], []
    for image, target in enumerate(targets):
        labels = target.labels.to(raw.probabilities.device)
        if bool(((labels < 0) | (labels >= len(classes))).any()):
            raise ValueError(f"targets.labels: expected 0..{len(classes) - 1}, found {target.labels.tolist()}")
        own = raw.one(image)
        unseen, silent = _of_image(own, target)
        missed.append(unseen)
        probabilities = own.probabilities[0][:, known]
        heard = torch.where(silent[:, known], probabilities.square(), 0.0)
        alarms.append(heard.sum() / max(len(probabilities), 1))
    terms = {
        "missed": WEIGHT_CONFIDENCE_POSITIVE * torch.stack(missed).mean(),
        "alarms": WEIGHT_CONFIDENCE_NEGATIVE * torch.stack(alarms).mean(),
    }
    total = terms["missed"] + terms["alarms"]
    return terms | {"total": total, "objectness": total}


def _of_image(raw: DensePredictions, target: Targets) -> tuple[Tensor, Tensor]:
    """How much of one image's objects is not seen, (), and which predictions should be silent, (A, C) bool."""
    probabilities = raw.probabilities[0]
    silent = torch.ones_like(probabilities, dtype=torch.bool)
    unseen = probabilities.new_zeros(())
    wanted_xyxy, ignore = target.boxes_xyxy.to(probabilities), target.ignore.to(probabilities.device)
    for label in sorted(set(target.labels.tolist())):
        of_class = target.labels.to(ignore.device) == label
        placed = raw.boxes_of(0, label).detach()
        objects, regions = wanted_xyxy[of_class & ~ignore], wanted_xyxy[of_class & ignore]
        meets = boxes.iou_matrix(objects, placed) >= MEETING_IOU
        if len(objects) and len(placed):
            seen = probabilities[:, label].expand_as(meets).masked_fill(~meets, 0.0).max(1).values
            unseen = unseen + (1 - seen).square().sum()
        else:
            unseen = unseen + len(objects)
        excused = (boxes.ioa_matrix(placed, regions) > IGNORE_OVERLAP).any(1)
        silent[:, label] = ~(meets.any(0) | excused)
    return unseen / max(int((~ignore).sum()), 1), silent


def decode_one(raw: DensePredictions, image: int, least_score: float, nms_iou: float) -> Detections:
    """What is found in one image of the batch."""
    scores = raw.probabilities[image].detach()
    place, label = (scores >= least_score).nonzero(as_tuple=True)
    score = scores[place, label]
    best = torch.sort(score, descending=True, stable=True).indices[:CANDIDATES]
    place, label, score = place[best], label[best], score[best]
    column = label if raw.boxes_xyxy.shape[2] > 1 else torch.zeros_like(label)
    clipped = boxes.clip(raw.boxes_xyxy[image].detach()[place, column], *raw.image_hw)
    # What lies outside of the image has no area left, and an untrained network's box may be inverted.
    there = boxes.area(clipped) > 0
    clipped, label, score = clipped[there], label[there], score[there]
    kept = boxes.nms(clipped, score, nms_iou, label)[:TOP_DETECTIONS]
    return Detections(clipped[kept], label[kept], score[kept])
