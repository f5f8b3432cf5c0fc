"""Detectors with a planted fault: a known failure, with which search methods can be evaluated.

A fault depends on the image alone. Overlapping predictions of a car form a group; its features come from the
group's mean box and the pixels inside. If all features of a fault lie in their bands, the logits of the group's
predictions are lowered. Bands have soft edges, which keeps the fault differentiable to the image through boxes,
scores and pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from detectors import boxes
from detectors.base import (
    Detector,
    DetectorError,
    DetectorWrapper,
    Predictor,
    SuppressiblePredictions,
    lower_probability,
)
from detectors.types import Detections

PREFIX = "planted:"
"""Before a fault and the detector that gets it: planted:height_px=30:38@squeezedet."""
DEFAULT_INNER = "squeezedet"
BLIND_TO = "Car"
"""Class that faults affect."""

DEPTH = 8.0
"""Default decrease in logits: a score of 0.98 falls to 0.02."""
SOFTNESS = 0.1
"""Default scale of a band's logistic edges, as a share of its width."""
_INWARD = 2.0
"""Position of an edge's midpoint inside the band, in scales: at the band's ends a score is lowered by 0.12 of the
depth, about one logit; in its middle by 0.91 of it; half a width outside by 0.0009 of it.
"""

FLOOR = 0.05
"""Predictions of lower scores are not affected: they detect nothing."""
SAME_CAR_IOU = 0.3
"""IoU from which a prediction belongs to the same car as a better one."""

_LUMA = (0.299, 0.587, 0.114)
"""RGB weights (ITU-R BT.601)."""
_PAINT = (0.2, 0.4, 0.8, 0.75)
"""Part of a box that mostly shows paint, below windows and above tyres: left, top, right, bottom as shares of the
box.
"""
_LEAST_VARIANCE = 1e-8
"""Added to the variance of luma: keeps the gradient of its root finite."""
_ORDERED, _POSITIVE = "LOW:HIGH, two numbers in order", "a positive number"


@dataclass(frozen=True, slots=True)
class _FeatureInputs:
    """Input of the features."""

    boxes_xyxy: Tensor
    """(B, A, 4) px, inside the image."""
    image_hw: tuple[int, int]
    light: Tensor | None
    """(B, 2, H + 1, W + 1) integral images of luma and its square; None if no feature needs pixels."""

    def means(self, part: Sequence[float]) -> Tensor:
        """Mean luma and mean squared luma (2, B, A) of a part of each box, in shares of the box.

        Pixels cut by the part's edges count in proportion: differentiable to image and box.
        """
        assert self.light is not None
        boxes_xyxy = self.boxes_xyxy.to(self.light)
        corner, size = (
            boxes_xyxy[..., :2].repeat(1, 1, 2),
            (boxes_xyxy[..., 2:] - boxes_xyxy[..., :2]).repeat(1, 1, 2),
        )
        centre, reach = _centred(corner + boxes_xyxy.new_tensor(part) * size)
        # A pixel extends half a pixel beyond its centre, and no part is smaller than a pixel.
        left, top = (centre - reach + 0.5).unbind(-1)
        right, bottom = (centre + reach + 0.5).unbind(-1)
        corners = ((left, top), (right, top), (left, bottom), (right, bottom))
        places = torch.stack([torch.stack(xy, -1) for xy in corners], 2)
        height, width = self.image_hw
        sums = F.grid_sample(
            self.light,
            2 * places / boxes_xyxy.new_tensor([width, height]) - 1,
            padding_mode="border",
            align_corners=True,
        )
        total = sums[..., 3] - sums[..., 2] - sums[..., 1] + sums[..., 0]
        return (total / (4 * reach.prod(-1))[:, None]).transpose(0, 1)


def _centred(parts_xyxy: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (..., 2) and half sizes (..., 2) px; half sizes are at least half a pixel."""
    top_left, bottom_right = parts_xyxy[..., :2], parts_xyxy[..., 2:]
    return (top_left + bottom_right) / 2, ((bottom_right - top_left) / 2).clamp_min(0.5)


def _height(inputs: _FeatureInputs) -> Tensor:
    return inputs.boxes_xyxy[..., 3] - inputs.boxes_xyxy[..., 1]


def _aspect(inputs: _FeatureInputs) -> Tensor:
    return (inputs.boxes_xyxy[..., 2] - inputs.boxes_xyxy[..., 0]) / _height(inputs).clamp_min(1)


def _across(inputs: _FeatureInputs) -> Tensor:
    return (inputs.boxes_xyxy[..., 0] + inputs.boxes_xyxy[..., 2]) / (2 * inputs.image_hw[1])


def _lightness(inputs: _FeatureInputs) -> Tensor:
    return inputs.means(_PAINT)[0]


def _contrast(inputs: _FeatureInputs) -> Tensor:
    mean, square = inputs.means((0.0, 0.0, 1.0, 1.0))
    return ((square - mean.square()).clamp_min(0) + _LEAST_VARIANCE).sqrt()


_MEASURES: dict[str, Callable[[_FeatureInputs], Tensor]] = {
    "height_px": _height,
    "aspect": _aspect,
    "across": _across,
    "lightness": _lightness,
    "contrast": _contrast,
}
FEATURES = tuple(_MEASURES)
"""height_px: of the box; aspect: width over height, which indicates the heading; across: the centre's horizontal
place in the image, 0 left to 1 right; lightness: mean luma of the paint part, 0 to 1; contrast: standard deviation
of luma in the box, 0 to 0.5 (root mean square contrast, Peli 1990).
"""
PIXEL_FEATURES = ("lightness", "contrast")
"""Features of the pixels; the others are of the box alone."""


def compute_features(images: Tensor, boxes_xyxy: Tensor, names: Sequence[str] = FEATURES) -> Tensor:
    """Features of boxes; differentiable to images and boxes. Boxes are clipped to the image first.

    Args:
        images: (B, 3, H, W), RGB in [0, 1].
        boxes_xyxy: (B, A, 4) px.
        names: Some of FEATURES.

    Returns:
        (F, B, A), in the order of `names`.
    """
    height, width = int(images.shape[2]), int(images.shape[3])
    light = _light(images) if set(names) & set(PIXEL_FEATURES) else None
    inputs = _FeatureInputs(boxes.clip(boxes_xyxy, height, width), (height, width), light)
    return torch.stack([_MEASURES[name](inputs).to(boxes_xyxy) for name in names])


def _light(images: Tensor) -> Tensor:
    # Sums over half a million pixels: float32 would leave small boxes three digits.
    luma = (images.double() * images.new_tensor(_LUMA).double().view(1, 3, 1, 1)).sum(1)
    sums = torch.stack([luma, luma.square()], 1).cumsum(2).cumsum(3)
    return F.pad(sums, (1, 0, 1, 0))


@dataclass(frozen=True, slots=True)
class CarGroups:
    """Predictions grouped by car."""

    rows: Tensor
    """(R,) int64: the predictions in groups."""
    car: Tensor
    """(R,) int64: index of the group, 0 to K - 1."""
    boxes_xyxy: Tensor
    """(K, 4) px: mean box of each group."""


def group_cars(boxes_xyxy: Tensor, scores: Tensor) -> CarGroups:
    """Group predictions of cars with boxes (A, 4) px and scores (A,), by `FLOOR` and `SAME_CAR_IOU`.

    A group's box is the mean of its predictions', weighted by squared scores: the best one alone would jump
    between predictions. Differentiable, with the grouping as a constant.
    """
    rows = (scores.detach() >= FLOOR).nonzero()[:, 0]
    car_boxes, weights = boxes_xyxy[rows], scores[rows].square()
    detached = car_boxes.detach()
    best = boxes.nms(detached, scores[rows].detach(), SAME_CAR_IOU)
    overlap = boxes.iou_matrix(detached, detached[best])
    # A box without area overlaps nothing, not even itself.
    overlap[best, torch.arange(len(best), device=best.device)] = 1
    shares = weights[:, None] * (overlap >= SAME_CAR_IOU)
    means = (shares.T @ car_boxes) / shares.sum(0)[:, None]
    car = overlap.argmax(1) if len(best) else rows
    return CarGroups(rows, car, means)


@dataclass(frozen=True, slots=True)
class Band:
    """An interval of one feature."""

    feature: str
    """One of FEATURES."""
    low: float
    """Lower end, in the feature's unit."""
    high: float
    """Upper end."""

    def __post_init__(self) -> None:
        if self.feature not in FEATURES:
            raise DetectorError(f"planted: expected features among {', '.join(FEATURES)}, found {self.feature!r}")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            found = f"{_format_number(self.low)}:{_format_number(self.high)}"
            raise DetectorError(f"planted: {self.feature}: expected {_ORDERED}, found {found}")

    @property
    def width(self) -> float:
        return self.high - self.low


@dataclass(frozen=True, slots=True)
class PlantedFault:
    """Blindness to cars with all features in given bands.

    Raises:
        DetectorError: No bands, a feature twice, or a depth or softness that is not positive.
    """

    bands: tuple[Band, ...]
    """One per feature."""
    depth: float = DEPTH
    """Logits by which scores are lowered."""
    softness: float = SOFTNESS
    """Scale of the bands' edges; see `SOFTNESS`."""

    def __post_init__(self) -> None:
        if not self.bands or len({band.feature for band in self.bands}) != len(self.bands):
            found = ", ".join(band.feature for band in self.bands) or "none"
            raise DetectorError(f"planted: expected at least one feature, each once, found {found}")
        for name in ("depth", "softness"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise DetectorError(f"planted: {name}: expected {_POSITIVE}, found {value}")

    @classmethod
    def parse(cls, text: str) -> PlantedFault:
        """A fault from "height_px=30:38,lightness=0.2:0.35", optionally with depth=6 and softness=0.05; the
        inverse of `text`.
        """
        bands: list[Band] = []
        settings: dict[str, float] = {}
        for part in text.split(","):
            name, _, value = (word.strip() for word in part.partition("="))
            if name in ("depth", "softness") and name not in settings:
                settings[name] = _parse_number(value)
                if math.isnan(settings[name]):
                    raise DetectorError(f"planted: {name}: expected {_POSITIVE}, found {value or 'nothing'}")
            else:
                low, _, high = value.partition(":")
                ends = _parse_number(low), _parse_number(high)
                if name in FEATURES and any(map(math.isnan, ends)):
                    raise DetectorError(f"planted: {name}: expected {_ORDERED}, found {value or 'nothing'}")
                bands.append(Band(name, *ends))
        return cls(tuple(bands), **settings)

    @property
    def text(self) -> str:
        """The fault in the form that `parse` reads."""
        parts = [f"{band.feature}={_format_number(band.low)}:{_format_number(band.high)}" for band in self.bands]
        for name, usual in (("depth", DEPTH), ("softness", SOFTNESS)):
            if getattr(self, name) != usual:
                parts.append(f"{name}={_format_number(getattr(self, name))}")
        return ",".join(parts)

    @property
    def feature_names(self) -> tuple[str, ...]:
        """The features of the bands."""
        return tuple(band.feature for band in self.bands)

    def membership(self, values: Tensor) -> Tensor:
        """How far (...) features (F, ...), ordered as `feature_names`, lie in all bands: 0 outside, 1 inside."""
        inside = []
        for band, value in zip(self.bands, values, strict=True):
            scale = self.softness * band.width
            inside += [
                torch.sigmoid((value - band.low) / scale - _INWARD),
                torch.sigmoid((band.high - value) / scale - _INWARD),
            ]
        return torch.stack(inside).prod(0)

    def contains(self, values: Tensor) -> Tensor:
        """Whether (...) features (F, ...), in the order of `feature_names`, lie in all bands."""
        inside = [
            (value >= band.low) & (value <= band.high) for band, value in zip(self.bands, values, strict=True)
        ]
        return torch.stack(inside).all(0)

    def logit_drop(self, image: Tensor, boxes_xyxy: Tensor, scores: Tensor) -> Tensor:
        """Logits (A,) by which predictions of cars are lowered; differentiable to all arguments.

        Args:
            image: (3, H, W), RGB in [0, 1].
            boxes_xyxy: (A, 4) px.
            scores: (A,).
        """
        cars = group_cars(boxes_xyxy, scores)
        values = compute_features(image[None], cars.boxes_xyxy[None], self.feature_names)[:, 0]
        by = self.depth * self.membership(values)
        return torch.zeros_like(scores).index_put((cars.rows,), by[cars.car])


class PlantedDetector(DetectorWrapper):
    """`inner` with a planted fault.

    It must provide candidates and `SuppressiblePredictions`, as all detectors of this package do.

    Raises:
        DetectorError: The detector knows no cars.
    """

    def __init__(self, inner: Detector, fault: PlantedFault) -> None:
        super().__init__(inner)
        self.fault = fault
        self.name, self._label = _faulty_name_and_label(inner, fault)

    def forward(self, images: Tensor) -> Any:
        """The inner detector's predictions of images (B, 3, H, W), with the fault.

        Raises:
            DetectorError: These are not `SuppressiblePredictions`.
        """
        raw = self.inner(images)
        if not isinstance(raw, SuppressiblePredictions):
            raise DetectorError(
                f"detector {self.inner.name}: expected raw predictions with `suppress`, found {type(raw).__name__}"
            )
        # Images may differ in number of candidates; padding is not lowered.
        by = pad_sequence([self._logit_drop(image, raw, i) for i, image in enumerate(images)], batch_first=True)
        return raw.suppress(self._label, by)

    def _logit_drop(self, image: Tensor, raw: Any, index: int) -> Tensor:
        candidates = self.inner.candidates(raw.select(index))
        return self.fault.logit_drop(
            image, candidates.boxes_for_class(self._label), candidates.log_scores[:, self._label].exp()
        )


@dataclass(frozen=True, slots=True)
class _PlantedPredictions:
    """Images and the inner detector's predictions."""

    images: Tensor
    predictions: Any


class PlantedPredictor:
    """A detector without gradients with a planted fault: the scores of decoded cars are lowered."""

    def __init__(self, inner: Predictor, fault: PlantedFault) -> None:
        self.inner = inner
        self.fault = fault
        self.name, self._label = _faulty_name_and_label(inner, fault)
        self.classes = inner.classes

    def forward(self, images: Tensor) -> _PlantedPredictions:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        return _PlantedPredictions(images, self.inner.forward(images))

    @torch.no_grad()
    def decode(self, raw: _PlantedPredictions) -> list[Detections]:
        """The inner detector's detections, best first by the lowered scores."""
        return [
            self._lower_scores(image, found)
            for image, found in zip(raw.images, self.inner.decode(raw.predictions), strict=True)
        ]

    def _lower_scores(self, image: Tensor, found: Detections) -> Detections:
        cars = found.labels == self._label
        by = self.fault.logit_drop(
            image.to(found.boxes_xyxy), found.boxes_xyxy, torch.where(cars, found.scores, 0.0)
        )
        scores = lower_probability(found.scores, by)
        order = torch.sort(scores, descending=True, stable=True).indices
        return Detections(found.boxes_xyxy[order], found.labels[order], scores[order])


def plant_fault(detector: Predictor, fault: PlantedFault) -> Predictor:
    """A detector with a planted fault, frozen; with gradients if it has them."""
    if isinstance(detector, Detector):
        return PlantedDetector(detector, fault).requires_grad_(False)
    return PlantedPredictor(detector, fault)


def parse_planted_name(name: str) -> tuple[PlantedFault, str]:
    """The fault and the inner detector's name of `planted:FAULT[@DETECTOR]`.

    Raises:
        DetectorError: The fault is malformed.
    """
    parts, _, inner = name.removeprefix(PREFIX).partition("@")
    return PlantedFault.parse(parts), inner or DEFAULT_INNER


def _faulty_name_and_label(inner: Predictor, fault: PlantedFault) -> tuple[str, int]:
    """The name of a detector with a fault, and the label of the affected class."""
    if BLIND_TO not in inner.classes:
        raise DetectorError(f"detector {inner.name}: expected one that knows {BLIND_TO}, found none")
    return f"{PREFIX}{fault.text}@{inner.name}", inner.classes.index(BLIND_TO)


def _parse_number(text: str) -> float:
    """The number in a text; nan if there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _format_number(value: float) -> str:
    """The fewest digits that represent the number exactly."""
    brief = f"{value:g}"
    return brief if float(brief) == value else repr(value)
