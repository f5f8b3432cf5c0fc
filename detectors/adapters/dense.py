"""Loss and decoding shared by detectors that predict many boxes with class probabilities.

The loss is the one that attacks raise. It needs only boxes and probabilities, so that networks of all families are
attacked for the same goal; training needs the family's own loss.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode

from detectors import boxes
from detectors.base import Candidates, Detector, lower_probability
from detectors.grid import IGNORE_OVERLAP, MEETING_IOU
from detectors.squeezedet import WEIGHT_CONFIDENCE_NEGATIVE, WEIGHT_CONFIDENCE_POSITIVE
from detectors.types import CLASSES, Detections, Targets

LEAST_SCORE = 0.05
"""Lowest decoded score (torchvision's box_score_thresh)."""
CANDIDATES = 1000
"""Maximum number of boxes per image before suppression."""
TOP_DETECTIONS = 100
"""Maximum number of detections per image, as in COCO's evaluation."""
NMS_IOU = 0.5
LEAST_PROBABILITY = 1e-12
"""Lower bound before taking a logarithm."""
T_STAR = 0.3
"""Default t*, if the score of best F1 has not been measured."""


_BATCH_NORMALISATIONS = (F.batch_norm, torch.batch_norm, torch.ops.aten.batch_norm.default)


class BatchNormGradientFix(TorchFunctionMode):
    """Corrects a wrong gradient of torch (2.14 and earlier, on the CPU): batch normalisation of one image misreads a
    gradient that `flatten` and `permute` behind it have turned to channels last. It reads a contiguous one correctly.
    """

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        output = func(*args, **(kwargs or {}))
        if func in _BATCH_NORMALISATIONS and output.requires_grad:
            output.register_hook(Tensor.contiguous)
        return output


@dataclass(frozen=True, slots=True)
class DensePredictions:
    """A predictions for each of B images; differentiable."""

    boxes_xyxy: Tensor
    """(B, A, K, 4) px of the image, not clipped: K is 1, or C where each class has its own box."""
    probabilities: Tensor
    """(B, A, C) in [0, 1]."""
    image_hw: tuple[int, int]
    """Size of the image, px."""
    constants: tuple[Tensor, ...] = ()
    """One tensor per image that the gradient treats as constant (Faster R-CNN: its proposals)."""
    counts: tuple[int, ...] | None = None
    """Number of each image's own predictions, which come first; the rest is padding. None: no padding."""
    tile_counts: tuple[tuple[int, ...], ...] = ()
    """For each image, the number of predictions of each of its tiles, where a detector divides images."""

    def __post_init__(self) -> None:
        b, a, c = self.probabilities.shape
        found = tuple(self.boxes_xyxy.shape)
        if found not in ((b, a, 1, 4), (b, a, c, 4)):
            raise ValueError(f"boxes_xyxy: expected shape {(b, a, 1, 4)} or {(b, a, c, 4)}, found {found}")
        if self.counts is not None and (len(self.counts) != b or max(self.counts, default=a) != a):
            raise ValueError(f"counts: expected {b}, the largest of them {a}, found {self.counts}")

    def __len__(self) -> int:
        return int(self.probabilities.shape[0])

    def select(self, index: int) -> DensePredictions:
        """The predictions of one image, as a batch of one, without padding."""
        count = None if self.counts is None else self.counts[index]
        return DensePredictions(
            self.boxes_xyxy[index : index + 1, :count],
            self.probabilities[index : index + 1, :count],
            self.image_hw,
            self.constants[index : index + 1],
            tile_counts=self.tile_counts[index : index + 1],
        )

    def inject(self, box_xyxy: Tensor, label: int) -> DensePredictions:
        """A copy with this box as the only confident prediction in each image, in the first place."""
        # A network with built-in suppression may have no predictions: then add a first place.
        missing = max(1 - self.probabilities.shape[1], 0)
        boxes_xyxy = F.pad(self.boxes_xyxy, (0, 0, 0, 0, 0, missing)).clone()
        probabilities = torch.zeros_like(F.pad(self.probabilities, (0, 0, 0, missing)))
        boxes_xyxy[:, 0] = box_xyxy.to(boxes_xyxy)
        probabilities[:, 0, label] = 1
        counts = None if self.counts is None else tuple(max(count, 1) for count in self.counts)
        tiles = tuple((rows[0] if sum(rows) else 1, *rows[1:]) for rows in self.tile_counts)
        return replace(self, boxes_xyxy=boxes_xyxy, probabilities=probabilities, counts=counts, tile_counts=tiles)

    def suppress(self, label: int, by: Tensor) -> DensePredictions:
        """A copy with the class's probabilities lowered; see `detectors.base.SuppressiblePredictions`."""
        lowered = lower_probability(self.probabilities[..., label], by)
        column = torch.arange(self.probabilities.shape[-1], device=lowered.device) == label
        return replace(self, probabilities=torch.where(column, lowered[..., None], self.probabilities))

    def boxes_for_class(self, image: int, label: int) -> Tensor:
        """Boxes (A, 4) px of one image for one class."""
        return self.boxes_xyxy[image, :, label if self.boxes_xyxy.shape[2] > 1 else 0]


class DenseDetector(Detector):
    """A detector based on a `predict` method that gives boxes and class probabilities."""

    nms_iou = NMS_IOU
    """IoU of suppression."""
    least_score = LEAST_SCORE
    """Lowest decoded score."""

    def __init__(self, name: str, classes: Sequence[str], t_star: float = T_STAR) -> None:
        super().__init__()
        self.name = name
        self.classes = tuple(classes)
        self.t_star = t_star

    @abstractmethod
    def predict(self, images: Tensor) -> DensePredictions:
        """images (B, 3, H, W), RGB in [0, 1], any size; differentiable to the images."""

    def forward(self, images: Tensor) -> DensePredictions:
        """The result of `predict`.

        Raises:
            ValueError: Images are not (B, 3, H, W).
        """
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"images: expected shape (B, 3, H, W), found {tuple(images.shape)}")
        return self.predict(images)

    def loss(self, raw: DensePredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """`dense_loss`: for attacks; it does not depend on box positions beyond matching."""
        return dense_loss(raw, targets, self.classes)

    def candidates(self, raw: DensePredictions) -> Candidates:
        """Every prediction."""
        return Candidates(raw.boxes_xyxy[0], raw.probabilities[0].clamp_min(LEAST_PROBABILITY).log())

    @torch.no_grad()
    def decode(self, raw: DensePredictions) -> list[Detections]:
        """The best scores, NMS per class, then the best remaining ones."""
        return [decode_one(raw, image, self.least_score, self.nms_iou) for image in range(len(raw))]


def dense_loss(raw: DensePredictions, targets: Sequence[Targets], classes: Sequence[str]) -> dict[str, Tensor]:
    """Terms "missed" and "alarms", and their sum as "total" and "objectness"; means over the images.

    missed: each object counts by its most probable matching prediction (same class, IoU of at least 0.5) with
    target 1, and by 1 if there is none. alarms: all other predictions, with target 0, in the classes of this
    project's labels, or in all classes if the detector has none of them; except those that match an object of
    their class or lie mostly in an ignored region of their class. Matching is constant in the gradient. Squares
    and weights are those of SqueezeDet's "objectness", so that results of one attack are comparable.

    Args:
        raw: Predictions of a batch.
        targets: One Targets per image.
        classes: The detector's classes.

    Raises:
        ValueError: Targets and images differ in number, or a label is not one of the classes.
    """
    if len(targets) != len(raw):
        raise ValueError(f"targets: expected {len(raw)}, one for each image, found {len(targets)}")
    known = [i for i, name in enumerate(classes) if name in CLASSES] or list(range(len(classes)))
    missed_terms, alarm_terms = [], []
    for image, target in enumerate(targets):
        labels = target.labels.to(raw.probabilities.device)
        if bool(((labels < 0) | (labels >= len(classes))).any()):
            raise ValueError(f"targets.labels: expected 0..{len(classes) - 1}, found {target.labels.tolist()}")
        predictions = raw.select(image)
        missed, silent = _image_terms(predictions, target)
        missed_terms.append(missed)
        probabilities = predictions.probabilities[0][:, known]
        false_probabilities = torch.where(silent[:, known], probabilities.square(), 0.0)
        alarm_terms.append(false_probabilities.sum() / max(len(probabilities), 1))
    terms = {
        "missed": WEIGHT_CONFIDENCE_POSITIVE * torch.stack(missed_terms).mean(),
        "alarms": WEIGHT_CONFIDENCE_NEGATIVE * torch.stack(alarm_terms).mean(),
    }
    total = terms["missed"] + terms["alarms"]
    return terms | {"total": total, "objectness": total}


def _image_terms(raw: DensePredictions, target: Targets) -> tuple[Tensor, Tensor]:
    """The image's missed term (), and which predictions should be silent, (A, C) bool."""
    probabilities = raw.probabilities[0]
    silent = torch.ones_like(probabilities, dtype=torch.bool)
    missed = probabilities.new_zeros(())
    objects_xyxy, ignore = target.boxes_xyxy.to(probabilities), target.ignore.to(probabilities.device)
    for label in sorted(set(target.labels.tolist())):
        of_class = target.labels.to(ignore.device) == label
        boxes_xyxy = raw.boxes_for_class(0, label).detach()
        objects, regions = objects_xyxy[of_class & ~ignore], objects_xyxy[of_class & ignore]
        matches = boxes.iou_matrix(objects, boxes_xyxy) >= MEETING_IOU
        if len(objects) and len(boxes_xyxy):
            detected = probabilities[:, label].expand_as(matches).masked_fill(~matches, 0.0).max(1).values
            missed = missed + (1 - detected).square().sum()
        else:
            missed = missed + len(objects)
        ignored = (boxes.ioa_matrix(boxes_xyxy, regions) > IGNORE_OVERLAP).any(1)
        silent[:, label] = ~(matches.any(0) | ignored)
    return missed / max(int((~ignore).sum()), 1), silent


def decode_one(raw: DensePredictions, image: int, least_score: float, nms_iou: float) -> Detections:
    """Detections of one image of the batch.

    Args:
        raw: Predictions of a batch.
        image: Index of the image.
        least_score: Lowest decoded score.
        nms_iou: IoU of suppression.
    """
    scores = raw.probabilities[image].detach()
    row, label = (scores >= least_score).nonzero(as_tuple=True)
    score = scores[row, label]
    best = torch.sort(score, descending=True, stable=True).indices[:CANDIDATES]
    row, label, score = row[best], label[best], score[best]
    column = label if raw.boxes_xyxy.shape[2] > 1 else torch.zeros_like(label)
    clipped = boxes.clip(raw.boxes_xyxy[image].detach()[row, column], *raw.image_hw)
    # Boxes outside the image have no area left, and an untrained network's boxes may be inverted.
    has_area = boxes.area(clipped) > 0
    clipped, label, score = clipped[has_area], label[has_area], score[has_area]
    selected = boxes.nms(clipped, score, nms_iou, label)[:TOP_DETECTIONS]
    return Detections(clipped[selected], label[selected], score[selected])
