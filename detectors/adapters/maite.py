"""MAITE's protocol for object detection: its models as detectors, and detectors as its models.

MAITE (https://github.com/mit-ll-ai-technology/maite) names attributes and calls. Objects are recognised by these,
so that nothing of it is imported: a model has `metadata` with an `id` and `index2label`, and maps a batch of images
(C, H, W) to targets with `boxes`, `labels` and `scores`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.adapters.function import FunctionPredictor
from detectors.adapters.spec import (
    BACKGROUND_NAMES,
    NO_CLASS,
    NetworkSpec,
    normalise_images,
    validate_settings,
    with_project_names,
)
from detectors.base import DetectorError, Predictor, detector_device, predict
from detectors.types import Detections

_SETTINGS = ("channels", "classes", "mean", "scale", "std", "t_star")
"""Settings of a `NetworkSpec` that apply to a MAITE model."""
_BYTES = 255.0
"""Scale at which a model gets whole numbers (uint8)."""
_MAX_NUMBER = 10_000
_ROUNDING = 1e-4
"""Floats may exceed [0, 1] by this."""


@dataclass(frozen=True, slots=True)
class MaiteTarget:
    """Labels or detections of one image, as MAITE's `ObjectDetectionTarget`."""

    boxes: NDArray[np.float32]
    """(M, 4) px, xyxy."""
    labels: NDArray[np.int64]
    """(M,) numbers of `index2label`."""
    scores: NDArray[np.float32]
    """(M,) in [0, 1]; 1 for labels."""


class MaiteModel:
    """A detector as a MAITE model."""

    def __init__(self, detector: Predictor, index2label: Mapping[int, str] | None = None) -> None:
        """Wrap a detector.

        Args:
            detector: The detector, from `ds.load_detector`.
            index2label: Numbers of the classes, such as those of the data set it is compared with. Detections of other
                classes are dropped. By default the detector's own numbers.
        """
        self.detector = detector
        own = {number: name for number, name in enumerate(detector.classes) if name != NO_CLASS}
        names = own if index2label is None else dict(index2label)
        number_by_name = {name: number for number, name in names.items()}
        if not number_by_name.keys() & set(own.values()):
            expected = f"classes among {', '.join(list(own.values())[:6])}"
            raise DetectorError(f"index2label: expected {expected}, found {', '.join(names.values()) or 'none'}")
        self._numbers = np.array([number_by_name.get(name, -1) for name in detector.classes], np.int64)
        self.metadata: dict[str, Any] = {"id": detector.name, "index2label": names}

    def __call__(self, batch: Sequence[Any], /) -> list[MaiteTarget]:
        """Detect objects in images (3, H, W), RGB: whole numbers from 0 to 255, or floats in [0, 1].

        Raises:
            DetectorError: An image has another shape or range.
        """
        device = detector_device(self.detector)
        return [
            self._to_target(predict(self.detector, image_from_array(image)[None].to(device))[0]) for image in batch
        ]

    def _to_target(self, found: Detections) -> MaiteTarget:
        boxes, labels, scores = (values.cpu().numpy() for values in (found.boxes_xyxy, found.labels, found.scores))
        numbers = self._numbers[labels]
        rows = numbers >= 0
        return MaiteTarget(boxes[rows].astype(np.float32), numbers[rows], scores[rows].astype(np.float32))


def image_from_array(image: Any) -> Tensor:
    """An image of MAITE (3, H, W), RGB, as floats in [0, 1].

    Args:
        image: Any array: whole numbers from 0 to 255, or floats in [0, 1].

    Raises:
        DetectorError: It has another shape or range.
    """
    given = image.detach().cpu() if isinstance(image, Tensor) else torch.from_numpy(np.array(image))
    most = 1.0 if given.is_floating_point() else _BYTES
    low, high = (float(given.min()), float(given.max())) if given.numel() else (0.0, 0.0)
    if given.ndim != 3 or given.shape[0] != 3 or not (-_ROUNDING <= low <= high <= most + _ROUNDING):
        expected = "an image (3, H, W) of whole numbers from 0 to 255, or floats in [0, 1]"
        found = f"{tuple(given.shape)} of {given.dtype}, from {low:.4g} to {high:.4g}"
        raise DetectorError(f"MAITE image: expected {expected}, found {found}")
    return (given.float() / most).clamp(0, 1)


def is_maite_model(instance: Any) -> bool:
    """Whether an object has what MAITE's protocol `Model` requires."""
    metadata = getattr(instance, "metadata", None)
    return (
        callable(instance)
        and not isinstance(instance, type)
        and isinstance(metadata, Mapping)
        and "id" in metadata
    )


def adapt_maite_model(model: Any, settings: Mapping[str, Any], where: str) -> Predictor:
    """A MAITE model as a detector, without a gradient.

    The model gets RGB images (3, H, W) of float32 in [0, 1]. Its attribute `spec`, a mapping, may change that:
    `scale: 255` for uint8, `channels: bgr`, `mean`, `std`; and give `classes` and `t_star`.

    Args:
        model: The model; of a `MaiteModel`, its detector is returned.
        settings: Settings of a `NetworkSpec` that override the attribute's.
        where: Beginning of error messages.

    Raises:
        DetectorError: It lacks what the protocol requires.
    """
    if isinstance(model, MaiteModel):
        return model.detector
    if not is_maite_model(model):
        expected = "a MAITE model (metadata with an id, called with a batch of images)"
        raise DetectorError(f"{where}: expected {expected}, found {_describe(model)}")
    chosen = {**validate_settings(getattr(model, "spec", {}), f"{where}: spec"), **settings}
    for key in chosen:
        if key not in _SETTINGS:
            raise DetectorError(f"{where}: {key}: expected one of {', '.join(_SETTINGS)}, found another setting")
    spec = NetworkSpec(**chosen)
    classes = _read_classes(model.metadata, where) if spec.classes is None else spec.classes
    as_bytes = spec.scale == _BYTES and not any(spec.mean) and spec.std == (1.0, 1.0, 1.0)

    def detect(image: Tensor) -> Any:
        array = normalise_images(image, spec)[0].cpu().numpy()
        return model([array.round().astype(np.uint8) if as_bytes else array])

    pixels = "uint8" if as_bytes else f"{spec.channels.upper()} in [0, {spec.scale:g}]"
    reading = f"the model gets {pixels} (a YAML file or its attribute `spec` sets `scale`; 255 gives uint8)"
    return FunctionPredictor(str(model.metadata["id"]), detect, classes, spec.t_star, reading)


def _read_classes(metadata: Mapping[str, Any], where: str) -> tuple[str, ...]:
    """Class names (max + 1,) by the numbers of `index2label`; "" for numbers without a class."""
    names = metadata.get("index2label")
    if not isinstance(names, Mapping) or not names:
        expected = "class names, metadata['index2label'], or `classes`"
        raise DetectorError(f"{where}: expected {expected}, found {'none' if names is None else repr(names)[:80]}")
    if not all(isinstance(key, int | np.integer) and 0 <= key < _MAX_NUMBER for key in names):
        expected = f"whole numbers from 0 to {_MAX_NUMBER - 1}"
        raise DetectorError(
            f"{where}: metadata['index2label']: expected {expected}, found {repr(list(names))[:80]}"
        )
    read = [str(names.get(number, NO_CLASS)) for number in range(int(max(names)) + 1)]
    read = [NO_CLASS if name in BACKGROUND_NAMES else name for name in read]
    return with_project_names(validate_settings({"classes": read}, f"{where}: metadata['index2label']")["classes"])


def _describe(model: Any) -> str:
    kind = type(model).__name__
    if not callable(model):
        return f"{kind}, which cannot be called"
    metadata = getattr(model, "metadata", None)
    return f"{kind} without metadata" if metadata is None else f"{kind} with metadata {repr(metadata)[:80]}"
