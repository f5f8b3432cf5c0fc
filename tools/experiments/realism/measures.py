"""What two pictures, or two sets of pictures, may be compared by: names, what is shipped, and what needs weights.

Only the published networks with the published weights are called LPIPS and FID. Distances on other features bear
the features' name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.metrics import ssim
from numpy.typing import NDArray
from torch import Tensor, nn

from scene_ir.errors import FormatError, ShapeError
from tools.experiments.realism import weights
from tools.experiments.realism.closeness import PERCEPTUAL, Perception, Picture
from tools.experiments.realism.inception import Inception
from tools.experiments.realism.lpips import TRUNKS, Lpips, published_heads
from tools.experiments.realism.networks import MobileNetV2

Floats = NDArray[np.float64]

LEAST_PX = 64
"""Smallest side of a picture that is compared: LPIPS was learned on 64x64, and AlexNet needs as much."""
_SSIM_WINDOW = 11
"""Of Wang et al. (2004), with a deviation of 1.5 px."""
# ImageNet's, as torchvision gives them.
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_MOBILENET_PX = 224


class PairDistance(Protocol):
    """Of two pictures (H, W, 3) uint8 RGB of the same size."""

    def __call__(self, first: Picture, second: Picture) -> float: ...


class SetFeatures(Protocol):
    """A picture (H, W, 3) uint8 RGB -> its features (D,), float64."""

    def __call__(self, picture: Picture) -> Floats: ...


@dataclass(frozen=True, slots=True)
class Metric:
    """name: for people; unit; load: makes the measure, from a folder of weights and leave to download; pairwise:
    whether it compares two pictures, or two sets; squared: what it compares is averaged as a squared error first
    (PSNR); needs: weights that are not shipped.
    """

    name: str
    pairwise: bool
    load: Callable[[Path | None, bool], PairDistance | SetFeatures]
    unit: str = ""
    squared: bool = False
    needs: str | None = None


def squared_error(first: Picture, second: Picture) -> float:
    """Mean of squares over pixels and channels, of pictures in [0, 255]. Raises ShapeError for different sizes."""
    _same(first, second)
    difference = first.astype(np.float64) - second
    return float(np.mean(difference * difference))


def psnr_db(error: float) -> float | None:
    """PSNR of a mean squared error of pictures in [0, 255]; None stands for the infinite one of equal pictures."""
    return None if error == 0 else 10 * math.log10(255.0**2 / error)


def similarity(first: Picture, second: Picture) -> float:
    """SSIM of the luminance (Wang et al., 2004): Gaussian windows of 11 px that lie inside the picture, K 0.01 and
    0.03; 1 for equal pictures. Raises ShapeError for different or too small sizes."""
    _same(first, second)
    if min(first.shape[:2]) < _SSIM_WINDOW:
        raise ShapeError("picture", f"at least {_SSIM_WINDOW} px a side for SSIM", first.shape[:2])
    grey = [
        torch.from_numpy(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)).double()[None, None] / 255
        for picture in (first, second)
    ]
    # Beside C2, 9e-4, what keeps the quotient finite.
    values = ssim(grey[0], grey[1], _SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return float(values.mean())


def _same(first: Picture, second: Picture) -> None:
    if first.shape != second.shape:
        raise ShapeError("picture", str(first.shape), second.shape)


def tensor_of(picture: Picture) -> Tensor:
    """A picture (H, W, 3) uint8 as (1, 3, H, W) in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float()[None] / 255


class LpipsDistance:
    """LPIPS of pictures; features of the last few pictures are kept, because each is compared more than once."""

    def __init__(self, lpips: Lpips) -> None:
        self._lpips = lpips
        self._known: list[tuple[Picture, list[Tensor]]] = []

    @torch.no_grad()
    def __call__(self, first: Picture, second: Picture) -> float:
        """Raises ShapeError for different sizes."""
        _same(first, second)
        return float(self._lpips.between(self._features(first), self._features(second)))

    def _features(self, picture: Picture) -> list[Tensor]:
        for known, features in self._known:
            if known is picture:
                return features
        features = self._lpips.features(tensor_of(picture))
        # photograph, re-render and counterexample
        self._known = [*self._known[-2:], (picture, features)]
        return features


class Pooled:
    """Features of a network that takes a picture (1, 3, H, W) and gives (1, D)."""

    def __init__(self, net: Callable[[Tensor], Tensor]) -> None:
        self._net = net

    @torch.no_grad()
    def __call__(self, picture: Picture) -> Floats:
        """(D,) float64."""
        return self._net(tensor_of(picture))[0].double().numpy()


def _filled(net: nn.Module, file: str, folder: Path | None, fetch: bool) -> nn.Module:
    path = weights.find(file, folder, fetch)
    weights.fill(net, weights.read(path), path)
    return net


def _lpips(net: str) -> Metric:
    def load(folder: Path | None, fetch: bool) -> PairDistance:
        trunk = TRUNKS[net]()
        _filled(trunk, net, folder, fetch)
        return LpipsDistance(Lpips(trunk, published_heads(net)).eval())

    kinds = {"alex": "AlexNet", "vgg": "VGG-16", "squeeze": "SqueezeNet 1.1"}
    return Metric(f"LPIPS ({kinds[net]})", True, load, needs=net)


def _inception(name: str, file: str, original: bool) -> Metric:
    def load(folder: Path | None, fetch: bool) -> SetFeatures:
        return Pooled(_filled(Inception(original), file, folder, fetch))

    return Metric(name, False, load, needs=file)


def _mobilenet(folder: Path | None, fetch: bool) -> SetFeatures:
    net = _filled(MobileNetV2(), "mobilenet", folder, fetch)
    mean, deviation = (torch.tensor(values).view(1, 3, 1, 1) for values in (_MEAN, _DEVIATION))

    def features(image: Tensor) -> Tensor:
        size = (_MOBILENET_PX, _MOBILENET_PX)
        small = F.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
        return net((small - mean) / deviation)

    return Pooled(features)


def _backbone(folder: Path | None, fetch: bool) -> SetFeatures:
    """What the perceptual distance compares, averaged over the picture: 448 numbers."""
    del folder, fetch
    perception = Perception()

    def features(picture: Picture) -> Floats:
        with torch.no_grad():
            return torch.cat([x.mean(dim=(2, 3))[0] for x in perception.features(picture)]).double().numpy()

    return features


def _perceptual(folder: Path | None, fetch: bool) -> PairDistance:
    del folder, fetch
    perception = Perception()

    def distance(first: Picture, second: Picture) -> float:
        _same(first, second)
        return perception.distance(first, second, np.ones(first.shape[:2], np.bool_))

    return distance


METRICS: dict[str, Metric] = {
    "psnr": Metric("PSNR", True, lambda folder, fetch: squared_error, "dB", squared=True),
    "ssim": Metric("SSIM", True, lambda folder, fetch: similarity),
    "perceptual": Metric(PERCEPTUAL, True, _perceptual),
    "lpips-alex": _lpips("alex"),
    "lpips-vgg": _lpips("vgg"),
    "lpips-squeeze": _lpips("squeeze"),
    "frechet": Metric("Frechet distance (SqueezeDet backbone)", False, _backbone),
    "frechet-mobilenet": Metric("Frechet distance (MobileNetV2)", False, _mobilenet, needs="mobilenet"),
    "frechet-inception": _inception(
        "Frechet distance (Inception v3 of torchvision)", "inception-torchvision", False
    ),
    "fid": _inception("FID", "inception", True),
}
"""By the name that --metrics takes, in the order of tables."""


def missing(name: str, folder: Path | None) -> str | None:
    """Why a metric cannot be had without a download; None where it can."""
    needs = METRICS[name].needs
    if needs is None:
        return None
    try:
        weights.find(needs, folder)
    except FormatError as error:
        return str(error)
    return None


def load(names: Sequence[str], folder: Path | None, fetch: bool) -> dict[str, PairDistance | SetFeatures]:
    """The measures by name. Raises FormatError where weights are missing or are none."""
    return {name: METRICS[name].load(folder, fetch) for name in names}
