"""The contract of detectors: images to raw predictions, to detections; with gradients, also to a loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from detectors.types import Detections, Targets


class DetectorError(ValueError):
    """A detector that cannot be had: no such name or file, or weights that belong to another one."""


@dataclass(frozen=True, slots=True)
class RawPredictions:
    """What the network says about each of its A anchors, before any choice is made; differentiable.

    boxes_xyxy (B, A, 4) px of the input image, not clipped; deltas (B, A, 4), the box head's own numbers;
    class_logits (B, A, C); confidence_logits (B, A); image_hw, size of the input image in pixels.
    """

    boxes_xyxy: Tensor
    deltas: Tensor
    class_logits: Tensor
    confidence_logits: Tensor
    image_hw: tuple[int, int]

    def __post_init__(self) -> None:
        b, a = self.confidence_logits.shape
        c = self.class_logits.shape[-1]
        for name, shape in {"boxes_xyxy": (b, a, 4), "deltas": (b, a, 4), "class_logits": (b, a, c)}.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"raw.{name}: expected shape {shape}, found {found}")

    def __len__(self) -> int:
        return int(self.confidence_logits.shape[0])

    def one(self, index: int) -> RawPredictions:
        """What is said about one image of the batch, as a batch of one."""
        rows = slice(index, index + 1)
        return RawPredictions(
            self.boxes_xyxy[rows],
            self.deltas[rows],
            self.class_logits[rows],
            self.confidence_logits[rows],
            self.image_hw,
        )


class Predictor(Protocol):
    """A detector that need have no gradient: what `Detector` is, less loss and t*; detectors of other projects.

    name; classes: labels are indices into it, "Car" among them where it knows cars. What `forward` gives is its
    own affair, `decode` takes it.
    """

    name: str
    classes: tuple[str, ...]

    def forward(self, images: Tensor) -> Any:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        ...

    def decode(self, raw: Any) -> list[Detections]:
        """One Detections for each image, best first, boxes inside the image; carries no gradient."""
        ...


@torch.no_grad()
def predict(predictor: Predictor, images: Tensor) -> list[Detections]:
    """What is found in images (B, 3, H, W), RGB in [0, 1]: one Detections for each."""
    return predictor.decode(predictor.forward(images))


class Detector(nn.Module, ABC):
    """A detector: `name`, `classes` (labels are indices into it), `t_star` (score of best F1 on benign frames)."""

    name: str
    classes: tuple[str, ...]
    t_star: float
    fresh_layers: tuple[str, ...] = ()
    """Beginnings of the names of those parameters that no pretrained backbone provides."""

    @abstractmethod
    def forward(self, images: Tensor) -> RawPredictions:
        """images (B, 3, H, W), RGB in [0, 1], any size; differentiable to the images."""

    @abstractmethod
    def loss(self, raw: RawPredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """Scalars "confidence", "box", "class", their sum "total", and "objectness"; one Targets for each image.

        "objectness" falls as the objects' confidences rise to 1 and those elsewhere fall to 0: attacks raise it.
        """

    @abstractmethod
    def decode(self, raw: RawPredictions) -> list[Detections]:
        """One Detections for each image, best first, boxes inside the image; carries no gradient."""
