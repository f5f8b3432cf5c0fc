"""Input of a detector's loss and output of its decoding."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

CLASSES = ("Car", "Truck", "Pedestrian", "Cyclist")
"""Classes of the shipped detectors; labels are indices into it."""


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name}: expected shape {shape}, found {tuple(tensor.shape)}")


@dataclass(frozen=True, slots=True)
class Targets:
    """Ground truth of one image."""

    boxes_xyxy: Tensor
    """(M, 4) px."""
    labels: Tensor
    """(M,) int64, indices into the detector's classes."""
    ignore: Tensor
    """(M,) bool: neither a hit nor a miss (too small, hidden, DontCare)."""

    def __post_init__(self) -> None:
        m = self.boxes_xyxy.shape[0]
        _check_shape("targets.boxes_xyxy", self.boxes_xyxy, (m, 4))
        _check_shape("targets.labels", self.labels, (m,))
        _check_shape("targets.ignore", self.ignore, (m,))
        if self.ignore.dtype != torch.bool:
            raise ValueError(f"targets.ignore: expected bool, found {self.ignore.dtype}")

    def __len__(self) -> int:
        return int(self.boxes_xyxy.shape[0])


@dataclass(frozen=True, slots=True)
class Detections:
    """Detections of one image, best first."""

    boxes_xyxy: Tensor
    """(M, 4) px."""
    labels: Tensor
    """(M,) int64, indices into the detector's classes."""
    scores: Tensor
    """(M,) in [0, 1]."""

    def __post_init__(self) -> None:
        m = self.boxes_xyxy.shape[0]
        _check_shape("detections.boxes_xyxy", self.boxes_xyxy, (m, 4))
        _check_shape("detections.labels", self.labels, (m,))
        _check_shape("detections.scores", self.scores, (m,))

    def __len__(self) -> int:
        return int(self.boxes_xyxy.shape[0])
