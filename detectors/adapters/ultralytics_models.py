"""Detectors of the Ultralytics package (YOLOv8, YOLO11, ...; AGPL-3.0), as differentiable networks.

Their files are pickles of whole modules: reading one runs what is in it. torch's `weights_only` cannot hold there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor, nn

from detectors.adapters import coco
from detectors.adapters.network import NetworkDetector
from detectors.adapters.spec import settings_of
from detectors.base import DetectorError

STRIDE = 32
"""Images are padded to a multiple of this, px; they are not resized."""


class _First(nn.Module):
    """A model, and of what it gives the predictions alone: what it gives besides is for its own training."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> Tensor:
        given = self.model(images)
        return given if isinstance(given, Tensor) else given[0]


def load(path: Path, spec: Path | None = None) -> NetworkDetector:
    """The detector in a file that Ultralytics wrote. DetectorError where it is none, or the package is missing."""
    try:
        from ultralytics import YOLO  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DetectorError(f"{path}: needs Ultralytics: pip install 'drivesem[ultralytics]'") from None
    if path.suffix != ".pt" or not path.is_file():
        raise DetectorError(f"{path}: expected a .pt file of Ultralytics, found none")
    try:
        model: Any = YOLO(str(path)).model
        head = model.model[-1]
        names = coco.ours(str(model.names[i]) for i in range(len(model.names)))
    except Exception as error:  # whatever its reader and the pickle inside raise
        raise DetectorError(f"{path}: expected a .pt file of Ultralytics, found {error}") from None
    if not type(head).__name__.endswith("Detect"):
        raise DetectorError(f"{path}: expected a detector, found one that ends in {type(head).__name__}")
    # Heads that choose for themselves give no gradient to what they leave out.
    if getattr(head, "end2end", False):
        head.end2end = False
    settings = {"multiple": STRIDE, "format": "yolov8"} | settings_of(path, spec)
    return NetworkDetector(path.stem, _First(model.float().eval()), settings, names, where=str(path))
