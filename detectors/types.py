"""What goes into a detector's loss and what comes out of it. Knows no scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

CLASSES = ("Car", "Truck", "Pedestrian", "Cyclist")
"""Classes of the shipped detectors; a label is an index into this."""


def _check(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name}: expected shape {shape}, found {tuple(tensor.shape)}")


@dataclass(frozen=True, slots=True)
class Targets:
    """Ground truth of one image. boxes_xyxy (M, 4) px; labels (M,) int64 into the detector's classes;
    ignore (M,) bool: neither missed nor a hit when detected (too small, hidden, DontCare).
    """

    boxes_xyxy: Tensor
    labels: Tensor
    ignore: Tensor

    def __post_init__(self) -> None:
        m = self.boxes_xyxy.shape[0]
        _check("targets.boxes_xyxy", self.boxes_xyxy, (m, 4))
        _check("targets.labels", self.labels, (m,))
        _check("targets.ignore", self.ignore, (m,))
        if self.ignore.dtype != torch.bool:
            raise ValueError(f"targets.ignore: expected bool, found {self.ignore.dtype}")

    def __len__(self) -> int:
        return int(self.boxes_xyxy.shape[0])


@dataclass(frozen=True, slots=True)
class Detections:
    """What a detector found in one image, best first. boxes_xyxy (M, 4) px; labels (M,) int64;
    scores (M,) in [0, 1].
    """

    boxes_xyxy: Tensor
    labels: Tensor
    scores: Tensor

    def __post_init__(self) -> None:
        m = self.boxes_xyxy.shape[0]
        _check("detections.boxes_xyxy", self.boxes_xyxy, (m, 4))
        _check("detections.labels", self.labels, (m,))
        _check("detections.scores", self.scores, (m,))

    def __len__(self) -> int:
        return int(self.boxes_xyxy.shape[0])
