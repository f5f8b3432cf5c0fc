"""Detectors as modules that are called like torchvision's, as ART and HEART call them for attacks on pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from detectors.base import Detector
from detectors.types import Targets


class TorchvisionModule(nn.Module):
    """A detector with a gradient as a torchvision detector: losses with targets, detections without."""

    def __init__(self, detector: Detector) -> None:
        """Wrap a detector."""
        super().__init__()
        self.detector = detector

    def forward(
        self, images: Tensor | Sequence[Tensor], targets: Sequence[Mapping[str, Tensor]] | None = None
    ) -> dict[str, Tensor] | list[dict[str, Tensor]]:
        """Detect objects, or compute losses.

        Args:
            images: (B, 3, H, W) or B images of one size (3, H, W), RGB in [0, 1].
            targets: `boxes` (M, 4) px and `labels` (M,) of each image, or None.

        Returns:
            With targets, the terms of the detector's loss, differentiable: `objectness` is what attacks raise. Without,
            `boxes`, `labels` and `scores` of each image.
        """
        batch = images if isinstance(images, Tensor) else torch.stack(list(images))
        raw = self.detector(batch)
        if targets is not None:
            known = [
                (target["boxes"].to(batch), target["labels"].to(batch.device, torch.int64)) for target in targets
            ]
            ignore = [torch.zeros(len(labels), dtype=torch.bool, device=batch.device) for _, labels in known]
            return self.detector.loss(
                raw, [Targets(*pair, none) for pair, none in zip(known, ignore, strict=True)]
            )
        return [
            {"boxes": found.boxes_xyxy, "labels": found.labels, "scores": found.scores}
            for found in self.detector.decode(raw)
        ]
