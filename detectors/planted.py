"""Detectors that are blind by construction: a failure that is known judges what looks for failures.

A planted fault is told from the image alone. Predictions of a car that lie on each other are about one car. It has
features, of their mean box and of the picture inside of it. Where all features of a fault lie in their bands, the
logits of these predictions are lowered. Bands have soft edges, so that the fault is differentiable to the image,
through boxes, scores and pixels.
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
from detectors.base import Detector, DetectorError, Lowerable, Predictor, lowered_probability
from detectors.types import Detections
from detectors.wrapping import Wrapping

PREFIX = "planted:"
"""Before a fault in words, and the detector that has it: planted:height_px=30:38@squeezedet."""
DEFAULT_INNER = "squeezedet"
BLIND_TO = "Car"
"""The class that faults are about."""

DEPTH = 8.0
"""Logits: a certain score of 0.98 falls to 0.02."""
SOFTNESS = 0.1
"""Scale of a band's logistic edges, as a share of its width."""
_INWARD = 2.0
"""Where the middle of an edge lies, in scales inside of the band: at the band's ends a score is lowered by 0.12 of
the depth, about a logit, in its middle by 0.91 of it, and half a width outside by 0.0009 of it."""

FLOOR = 0.05
"""Predictions of lower scores stay as they are: nothing is found by them."""
SAME_CAR_IOU = 0.3
"""From here on, a prediction is about the same car as a better one."""

_LUMA = (0.299, 0.587, 0.114)
"""Of display colours (ITU-R BT.601)."""
_PAINT = (0.2, 0.4, 0.8, 0.75)
"""Left, top, right and bottom of the part of a box that mostly shows paint, in shares of the box: below windows,
above tyres."""
_LEAST_VARIANCE = 1e-8
"""Of luma: keeps the gradient of its root finite."""
_ORDERED, _POSITIVE = "LOW:HIGH, two numbers in order", "a positive number"


@dataclass(frozen=True, slots=True)
class _Boxed:
    """What features are made of. boxes_xyxy (B, A, 4) px, inside the image; light (B, 2, H + 1, W + 1): sums of
    luma and of its square over all pixels above and to the left, None where nobody asks.
    """

    boxes_xyxy: Tensor
    image_hw: tuple[int, int]
    light: Tensor | None

    def means(self, part: Sequence[float]) -> Tensor:
        """Mean luma and mean squared luma (2, B, A) of a part of each box, given in shares of it. Pixels that the
        part's edges cut count by their share: differentiable to image and box.
        """
        assert self.light is not None
        here = self.boxes_xyxy.to(self.light)
        corner, size = here[..., :2].repeat(1, 1, 2), (here[..., 2:] - here[..., :2]).repeat(1, 1, 2)
        centre, reach = _centred(corner + here.new_tensor(part) * size)
        # A pixel reaches half a pixel beyond its centre, and no part is smaller than a pixel.
        left, top = (centre - reach + 0.5).unbind(-1)
        right, bottom = (centre + reach + 0.5).unbind(-1)
        corners = ((left, top), (right, top), (left, bottom), (right, bottom))
        places = torch.stack([torch.stack(xy, -1) for xy in corners], 2)
        height, width = self.image_hw
        sums = F.grid_sample(
            self.light,
            2 * places / here.new_tensor([width, height]) - 1,
            padding_mode="border",
            align_corners=True,
        )
        total = sums[..., 3] - sums[..., 2] - sums[..., 1] + sums[..., 0]
        return (total / (4 * reach.prod(-1))[:, None]).transpose(0, 1)


def _centred(parts_xyxy: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (..., 2) and half sizes (..., 2) px, of at least half a pixel."""
    top_left, bottom_right = parts_xyxy[..., :2], parts_xyxy[..., 2:]
    return (top_left + bottom_right) / 2, ((bottom_right - top_left) / 2).clamp_min(0.5)


def _height(boxed: _Boxed) -> Tensor:
    return boxed.boxes_xyxy[..., 3] - boxed.boxes_xyxy[..., 1]


def _aspect(boxed: _Boxed) -> Tensor:
    return (boxed.boxes_xyxy[..., 2] - boxed.boxes_xyxy[..., 0]) / _height(boxed).clamp_min(1)


def _across(boxed: _Boxed) -> Tensor:
    return (boxed.boxes_xyxy[..., 0] + boxed.boxes_xyxy[..., 2]) / (2 * boxed.image_hw[1])


def _lightness(boxed: _Boxed) -> Tensor:
    return boxed.means(_PAINT)[0]


def _contrast(boxed: _Boxed) -> Tensor:
    mean, square = boxed.means((0.0, 0.0, 1.0, 1.0))
    return ((square - mean.square()).clamp_min(0) + _LEAST_VARIANCE).sqrt()


_MEASURES: dict[str, Callable[[_Boxed], Tensor]] = {
    "height_px": _height,
    "aspect": _aspect,
    "across": _across,
    "lightness": _lightness,
    "contrast": _contrast,
}
FEATURES = tuple(_MEASURES)
"""height_px: of the box; aspect: its width over its height, which tells the heading; across: its centre's place in
the picture, 0 left to 1 right; lightness: mean luma of the part of it that shows paint, 0 to 1; contrast: standard
deviation of luma in it, 0 to 0.5 (root mean square contrast, Peli 1990)."""
OF_THE_PICTURE = ("lightness", "contrast")
"""Those that ask for pixels; the others are of the box alone."""


def features(images: Tensor, boxes_xyxy: Tensor, names: Sequence[str] = FEATURES) -> Tensor:
    """Features (F, B, A) of boxes (B, A, 4) px in images (B, 3, H, W), RGB in [0, 1]; differentiable to both.

    Boxes are cut at the image's border first. KeyError for a name not in FEATURES.
    """
    height, width = int(images.shape[2]), int(images.shape[3])
    light = _light(images) if set(names) & set(OF_THE_PICTURE) else None
    boxed = _Boxed(boxes.clip(boxes_xyxy, height, width), (height, width), light)
    return torch.stack([_MEASURES[name](boxed).to(boxes_xyxy) for name in names])


def _light(images: Tensor) -> Tensor:
    # Sums over half a million pixels: float32 would leave three digits to small boxes.
    luma = (images.double() * images.new_tensor(_LUMA).double().view(1, 3, 1, 1)).sum(1)
    sums = torch.stack([luma, luma.square()], 1).cumsum(2).cumsum(3)
    return F.pad(sums, (1, 0, 1, 0))


@dataclass(frozen=True, slots=True)
class SeenCars:
    """Cars as predictions tell of them. rows (R,) int64: the predictions that count; car (R,) int64: which of the
    K cars each is about; boxes_xyxy (K, 4) px: their means.
    """

    rows: Tensor
    car: Tensor
    boxes_xyxy: Tensor


def seen_cars(boxes_xyxy: Tensor, scores: Tensor) -> SeenCars:
    """Group predictions of cars with boxes (A, 4) px and scores (A,), by `FLOOR` and `SAME_CAR_IOU`.

    A car's box is the mean of its predictions', weighted by squares of their scores: the best one alone would jump
    from one to the next. Differentiable, the grouping taken as constant.
    """
    rows = (scores.detach() >= FLOOR).nonzero()[:, 0]
    placed, weights = boxes_xyxy[rows], scores[rows].square()
    still = placed.detach()
    best = boxes.nms(still, scores[rows].detach(), SAME_CAR_IOU)
    overlap = boxes.iou_matrix(still, still[best])
    # A box without an area overlaps nothing, not even itself.
    overlap[best, torch.arange(len(best), device=best.device)] = 1
    shares = weights[:, None] * (overlap >= SAME_CAR_IOU)
    means = (shares.T @ placed) / shares.sum(0)[:, None]
    car = overlap.argmax(1) if len(best) else rows
    return SeenCars(rows, car, means)


@dataclass(frozen=True, slots=True)
class Band:
    """One feature from `low` to `high`."""

    feature: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if self.feature not in FEATURES:
            raise DetectorError(f"planted: expected features among {', '.join(FEATURES)}, found {self.feature!r}")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            found = f"{_short(self.low)}:{_short(self.high)}"
            raise DetectorError(f"planted: {self.feature}: expected {_ORDERED}, found {found}")

    @property
    def width(self) -> float:
        return self.high - self.low


@dataclass(frozen=True, slots=True)
class PlantedFault:
    """Cars whose features lie in all bands are not seen. depth: logits by which their scores are lowered;
    softness: of the bands' edges, see `SOFTNESS`. Raises DetectorError for what is no such fault.
    """

    bands: tuple[Band, ...]
    depth: float = DEPTH
    softness: float = SOFTNESS

    def __post_init__(self) -> None:
        if not self.bands or len({band.feature for band in self.bands}) != len(self.bands):
            found = ", ".join(band.feature for band in self.bands) or "none"
            raise DetectorError(f"planted: expected at least one feature, each once, found {found}")
        for name in ("depth", "softness"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise DetectorError(f"planted: {name}: expected {_POSITIVE}, found {value}")

    @classmethod
    def of(cls, text: str) -> PlantedFault:
        """Of "height_px=30:38,lightness=0.2:0.35", with depth=6 and softness=0.05 where wanted: the inverse of
        `text`.
        """
        bands: list[Band] = []
        settings: dict[str, float] = {}
        for part in text.split(","):
            name, _, value = (word.strip() for word in part.partition("="))
            if name in ("depth", "softness") and name not in settings:
                settings[name] = _number(value)
                if math.isnan(settings[name]):
                    raise DetectorError(f"planted: {name}: expected {_POSITIVE}, found {value or 'nothing'}")
            else:
                low, _, high = value.partition(":")
                ends = _number(low), _number(high)
                if name in FEATURES and any(map(math.isnan, ends)):
                    raise DetectorError(f"planted: {name}: expected {_ORDERED}, found {value or 'nothing'}")
                bands.append(Band(name, *ends))
        return cls(tuple(bands), **settings)

    @property
    def text(self) -> str:
        """The fault in words."""
        words = [f"{band.feature}={_short(band.low)}:{_short(band.high)}" for band in self.bands]
        for name, usual in (("depth", DEPTH), ("softness", SOFTNESS)):
            if getattr(self, name) != usual:
                words.append(f"{name}={_short(getattr(self, name))}")
        return ",".join(words)

    @property
    def names(self) -> tuple[str, ...]:
        """The features that it asks for."""
        return tuple(band.feature for band in self.bands)

    def share(self, values: Tensor) -> Tensor:
        """How far (...) features (F, ...), in the order of `names`, lie in all bands: 0 outside, 1 inside."""
        inside = []
        for band, value in zip(self.bands, values, strict=True):
            scale = self.softness * band.width
            inside += [
                torch.sigmoid((value - band.low) / scale - _INWARD),
                torch.sigmoid((band.high - value) / scale - _INWARD),
            ]
        return torch.stack(inside).prod(0)

    def contains(self, values: Tensor) -> Tensor:
        """Whether (...) features (F, ...), in the order of `names`, lie in all bands."""
        inside = [
            (value >= band.low) & (value <= band.high) for band, value in zip(self.bands, values, strict=True)
        ]
        return torch.stack(inside).all(0)

    def lowers(self, image: Tensor, boxes_xyxy: Tensor, scores: Tensor) -> Tensor:
        """Logits (A,) by which predictions of cars in an image (3, H, W) are lowered, with boxes (A, 4) px and
        scores (A,); differentiable to all three.
        """
        cars = seen_cars(boxes_xyxy, scores)
        values = features(image[None], cars.boxes_xyxy[None], self.names)[:, 0]
        by = self.depth * self.share(values)
        return torch.zeros_like(scores).index_put((cars.rows,), by[cars.car])


class PlantedDetector(Wrapping):
    """`inner` with a planted fault; all else is inner's. Raises DetectorError where it knows no cars.

    It must tell its candidates, and its raw predictions must be `Lowerable`, as those of all detectors of this
    package are.
    """

    def __init__(self, inner: Detector, fault: PlantedFault) -> None:
        super().__init__(inner)
        self.fault = fault
        self.name, self._label = _names(inner, fault)

    def forward(self, images: Tensor) -> Any:
        """What inner says of images (B, 3, H, W), less the fault. DetectorError where that is not `Lowerable`."""
        raw = self.inner(images)
        if not isinstance(raw, Lowerable):
            raise DetectorError(
                f"detector {self.inner.name}: expected raw predictions that can be lowered, found "
                f"{type(raw).__name__}"
            )
        # Images may have other numbers of candidates; what fills them up is not lowered.
        by = pad_sequence([self._by(image, raw, i) for i, image in enumerate(images)], batch_first=True)
        return raw.lowered(self._label, by)

    def _by(self, image: Tensor, raw: Any, index: int) -> Tensor:
        told = self.inner.candidates(raw.one(index))
        return self.fault.lowers(image, told.boxes_of(self._label), told.log_scores[:, self._label].exp())


@dataclass(frozen=True, slots=True)
class _Seen:
    """Images and what the inner detector says of them."""

    images: Tensor
    said: Any


class PlantedPredictor:
    """A detector without gradients that has a planted fault: of what it decodes, scores of cars are lowered."""

    def __init__(self, inner: Predictor, fault: PlantedFault) -> None:
        self.inner = inner
        self.fault = fault
        self.name, self._label = _names(inner, fault)
        self.classes = inner.classes

    def forward(self, images: Tensor) -> _Seen:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        return _Seen(images, self.inner.forward(images))

    @torch.no_grad()
    def decode(self, raw: _Seen) -> list[Detections]:
        """Inner's, best first by the lowered scores."""
        return [
            self._lowered(image, found)
            for image, found in zip(raw.images, self.inner.decode(raw.said), strict=True)
        ]

    def _lowered(self, image: Tensor, found: Detections) -> Detections:
        cars = found.labels == self._label
        by = self.fault.lowers(image.to(found.boxes_xyxy), found.boxes_xyxy, torch.where(cars, found.scores, 0.0))
        scores = lowered_probability(found.scores, by)
        order = torch.sort(scores, descending=True, stable=True).indices
        return Detections(found.boxes_xyxy[order], found.labels[order], scores[order])


def with_fault(detector: Predictor, fault: PlantedFault) -> Predictor:
    """A detector with a planted fault, with gradients where it has them, and frozen."""
    if isinstance(detector, Detector):
        return PlantedDetector(detector, fault).requires_grad_(False)
    return PlantedPredictor(detector, fault)


def parts_of(name: str) -> tuple[PlantedFault, str]:
    """The fault and the inner detector's name, of `planted:FAULT[@DETECTOR]`. Raises DetectorError."""
    words, _, inner = name.removeprefix(PREFIX).partition("@")
    return PlantedFault.of(words), inner or DEFAULT_INNER


def _names(inner: Predictor, fault: PlantedFault) -> tuple[str, int]:
    """What a detector with a fault is called, and its label of what the fault is about."""
    if BLIND_TO not in inner.classes:
        raise DetectorError(f"detector {inner.name}: expected one that knows {BLIND_TO}, found none")
    return f"{PREFIX}{fault.text}@{inner.name}", inner.classes.index(BLIND_TO)


def _number(text: str) -> float:
    """nan where it is none: what takes it refuses that."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _short(value: float) -> str:
    """As few digits as give the number back."""
    brief = f"{value:g}"
    return brief if float(brief) == value else repr(value)
