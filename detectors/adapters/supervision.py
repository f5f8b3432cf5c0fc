"""Detections of the package supervision, in both directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from detectors.base import DetectorError
from detectors.types import Detections

if TYPE_CHECKING:
    import supervision  # pyright: ignore[reportMissingImports]


def to_supervision(detections: Detections, classes: Sequence[str]) -> supervision.Detections:
    """Detections as `supervision.Detections`, which its annotators, trackers and metrics take.

    Args:
        detections: Detections of one image.
        classes: Class names that their labels index; they become `data["class_name"]`.

    Raises:
        DetectorError: supervision is missing.
    """
    try:
        import supervision  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DetectorError("to_supervision: needs supervision: pip install 'drivesem[supervision]'") from None
    labels = detections.labels.cpu().numpy()
    return supervision.Detections(
        xyxy=detections.boxes_xyxy.cpu().numpy().astype(np.float32).reshape(-1, 4),
        confidence=detections.scores.cpu().numpy().astype(np.float32),
        class_id=labels.astype(int),
        data={"class_name": np.array([classes[label] for label in labels], dtype=str)},
    )


def from_supervision(found: Any) -> Detections:
    """`supervision.Detections` of one image, best first.

    Args:
        found: Detections with `xyxy` (M, 4) px, `class_id` (M,) and `confidence` (M,).

    Raises:
        DetectorError: One of these is missing.
    """
    columns = {name: getattr(found, name, None) for name in ("xyxy", "class_id", "confidence")}
    missing = [name for name, values in columns.items() if values is None]
    if missing:
        expected = "xyxy, class_id and confidence"
        found_text = f"{type(found).__name__} without {' and '.join(missing)}"
        raise DetectorError(f"from_supervision: expected {expected}, found {found_text}")
    boxes, labels, scores = (torch.as_tensor(np.asarray(values)) for values in columns.values())
    order = scores.float().argsort(descending=True, stable=True)
    return Detections(boxes[order].float().reshape(-1, 4), labels[order].long(), scores[order].float())
