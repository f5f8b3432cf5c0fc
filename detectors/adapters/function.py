"""Detectors without a gradient: functions of images with the outputs of torchvision, MAITE or supervision."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from detectors.adapters.spec import with_project_names
from detectors.base import DetectorError
from detectors.types import Detections

RawBoxes: TypeAlias = tuple[Any, Any, Any]
"""Boxes (M, 4) px, scores (M,) or (M, C), and labels (M,) as a library gives them; floats of any array type."""
_NAMES = (("boxes", "scores", "labels"), ("xyxy", "confidence", "class_id"))
"""Names of boxes, scores and labels in torchvision's dicts and MAITE's targets, and in supervision's detections."""


class FunctionPredictor:
    """A detector without a gradient, from a function of images that returns boxes, scores and labels."""

    def __init__(
        self,
        name: str,
        function: Callable[[Tensor], Any],
        classes: Sequence[str],
        t_star: float | None = None,
        reading: str = "",
    ) -> None:
        """Wrap a function.

        Args:
            name: The detector's name.
            function: Maps an image (1, 3, H, W), RGB in [0, 1], to a dict or an object, or to a list of one.
            classes: Class names that the labels index; detections of a class without a name ("") are dropped.
            t_star: Score of best F1, if known.
            reading: What is assumed about its input and output, for messages.
        """
        names = with_project_names(classes)
        self.name, self.classes = name, tuple(filter(None, names))
        self._rows = torch.tensor([self.classes.index(name) if name else -1 for name in names])
        self.t_star, self.reading = t_star, reading
        self._function = function

    @torch.no_grad()
    def forward(self, images: Tensor) -> list[tuple[RawBoxes, tuple[int, int]]]:
        """The output of each image, and the image's (height, width)."""
        return [
            (self._read(self._function(image[None])), (int(image.shape[1]), int(image.shape[2])))
            for image in images
        ]

    def decode(self, raw: list[tuple[RawBoxes, tuple[int, int]]]) -> list[Detections]:
        """Check and clip the boxes, and sort them by score."""
        return [self._to_detections(output, hw) for output, hw in raw]

    def _read(self, output: Any) -> RawBoxes:
        """Boxes, scores and labels of an output."""
        output = output[0] if isinstance(output, list | tuple) and len(output) == 1 else output
        for boxes, scores, labels in _NAMES:
            values = [_get(output, name) for name in (boxes, scores, labels)]
            if all(value is not None for value in values):
                return values[0], values[1], values[2]
        missing = " and ".join(name for name in _NAMES[0] if _get(output, name) is None)
        expected = "boxes, scores and labels for an image (a dict, a MAITE target, or supervision.Detections)"
        raise DetectorError(
            f"detector {self.name}: expected {expected}, found {type(output).__name__} without {missing}"
        )

    def _to_detections(self, output: RawBoxes, hw: tuple[int, int]) -> Detections:
        boxes, scores = (torch.as_tensor(values).float().cpu() for values in output[:2])
        labels = torch.as_tensor(output[2]).long().cpu()
        count = len(scores)
        known = labels.shape == (count,) and bool(((labels >= 0) & (labels < len(self._rows))).all())
        if known and scores.ndim == 2 and bool((labels < scores.shape[1]).all()):
            scores = scores.gather(1, labels[:, None])[:, 0]
        in_range = bool(((scores >= 0) & (scores <= 1)).all() and boxes.isfinite().all())
        if boxes.numel() != 4 * count or scores.shape != (count,) or not (known and in_range):
            expected = f"boxes (M, 4) px, scores (M,) in [0, 1] and labels (M,) below {len(self._rows)}"
            found = f"{tuple(boxes.shape)}, {tuple(scores.shape)} and {tuple(labels.shape)}, or other values"
            raise DetectorError(f"detector {self.name}: expected {expected}, found {found}")
        boxes, labels = boxes.reshape(-1, 4), self._rows[labels]
        limit = boxes.new_tensor([hw[1], hw[0], hw[1], hw[0]])
        order = scores.argsort(descending=True, stable=True)
        order = order[labels[order] >= 0]
        return Detections(boxes[order].clamp_min(0).minimum(limit), labels[order], scores[order])


def _get(output: Any, name: str) -> Any:
    """A value of a dict or an attribute of an object; None without it."""
    return output.get(name) if isinstance(output, Mapping) else getattr(output, name, None)
