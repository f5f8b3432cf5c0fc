"""Measures of realism: distances of two pictures or of two sets of pictures, by name.

Only the published networks with the published weights are called LPIPS and FID; distances on other features are
named after the features.
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

from scene_ir.errors import FormatError, RangeError, ShapeError
from tools.experiments.realism.feature_networks import Inception, MobileNetV2
from tools.experiments.realism.perceptual import (
    PERCEPTUAL,
    TRUNKS,
    Lpips,
    PerceptualDistance,
    Picture,
    load_published_heads,
)
from tools.experiments.realism.weights import find_weights, load_weights, read_weights

Floats = NDArray[np.float64]

MIN_SIDE_PX = 64
"""Smallest side of a picture: LPIPS was trained on 64x64, and AlexNet needs as much."""
_SSIM_WINDOW = 11
"""Of Wang et al. (2004), with a deviation of 1.5 px."""
# ImageNet's, as torchvision gives them.
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_MOBILENET_PX = 224


class PairDistance(Protocol):
    """A distance of two pictures (H, W, 3) uint8 RGB of the same size."""

    def __call__(self, first: Picture, second: Picture) -> float: ...


class SetFeatures(Protocol):
    """Features (D,) float64 of a picture (H, W, 3) uint8 RGB."""

    def __call__(self, picture: Picture) -> Floats: ...


@dataclass(frozen=True, slots=True)
class Metric:
    """A measure of realism."""

    name: str
    """Name in tables."""
    pairwise: bool
    """Whether it compares two pictures, or else two sets of pictures."""
    load: Callable[[Path | None, bool], PairDistance | SetFeatures]
    """Builds it from a folder of weights; the flag permits downloads."""
    unit: str = ""
    """Unit in tables."""
    squared: bool = False
    """Whether squared errors are averaged first (PSNR)."""
    needs: str | None = None
    """Weights that are not shipped, one of `WEIGHT_FILES`."""


def squared_error(first: Picture, second: Picture) -> float:
    """Mean squared error over pixels and channels. Raises ShapeError for different sizes."""
    _check_sizes(first, second)
    difference = first.astype(np.float64) - second
    return float(np.mean(difference * difference))


def psnr_db(error: float) -> float | None:
    """PSNR of a mean squared error of pictures in [0, 255]; None for the infinite one of equal pictures."""
    return None if error == 0 else 10 * math.log10(255.0**2 / error)


def structural_similarity(first: Picture, second: Picture) -> float:
    """SSIM of the luminance (Wang et al., 2004): Gaussian windows of 11 px that lie inside the picture, K 0.01 and
    0.03; 1 for equal pictures. Raises ShapeError for different or too small sizes."""
    _check_sizes(first, second)
    if min(first.shape[:2]) < _SSIM_WINDOW:
        raise ShapeError("picture", f"at least {_SSIM_WINDOW} px a side for SSIM", first.shape[:2])
    grey = [
        torch.from_numpy(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)).double()[None, None] / 255
        for picture in (first, second)
    ]
    # C2, 9e-4, keeps the quotient finite.
    values = ssim(grey[0], grey[1], _SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return float(values.mean())


def _check_sizes(first: Picture, second: Picture) -> None:
    if first.shape != second.shape:
        raise ShapeError("picture", str(first.shape), second.shape)


def picture_to_tensor(picture: Picture) -> Tensor:
    """A picture (H, W, 3) uint8 as (1, 3, H, W) in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float()[None] / 255


class LpipsDistance:
    """LPIPS of pictures; features of the last three are cached, because each is compared more than once."""

    def __init__(self, lpips: Lpips) -> None:
        self._lpips = lpips
        self._known: list[tuple[Picture, list[Tensor]]] = []

    @torch.no_grad()
    def __call__(self, first: Picture, second: Picture) -> float:
        """Raises ShapeError for different sizes."""
        _check_sizes(first, second)
        return float(self._lpips.distance(self._features(first), self._features(second)))

    def _features(self, picture: Picture) -> list[Tensor]:
        for known, features in self._known:
            if known is picture:
                return features
        features = self._lpips.features(picture_to_tensor(picture))
        # photograph, re-render and counterexample
        self._known = [*self._known[-2:], (picture, features)]
        return features


class PooledFeatures:
    """Features of a network that maps a picture (1, 3, H, W) to (1, D)."""

    def __init__(self, net: Callable[[Tensor], Tensor]) -> None:
        self._net = net

    @torch.no_grad()
    def __call__(self, picture: Picture) -> Floats:
        """(D,) float64."""
        return self._net(picture_to_tensor(picture))[0].double().numpy()


def _load_network(net: nn.Module, file: str, folder: Path | None, fetch: bool) -> nn.Module:
    path = find_weights(file, folder, fetch)
    load_weights(net, read_weights(path), path)
    return net


def _lpips(net: str) -> Metric:
    def load(folder: Path | None, fetch: bool) -> PairDistance:
        trunk = TRUNKS[net]()
        _load_network(trunk, net, folder, fetch)
        return LpipsDistance(Lpips(trunk, load_published_heads(net)).eval())

    kinds = {"alex": "AlexNet", "vgg": "VGG-16", "squeeze": "SqueezeNet 1.1"}
    return Metric(f"LPIPS ({kinds[net]})", True, load, needs=net)


def _inception(name: str, file: str, original: bool) -> Metric:
    def load(folder: Path | None, fetch: bool) -> SetFeatures:
        return PooledFeatures(_load_network(Inception(original), file, folder, fetch))

    return Metric(name, False, load, needs=file)


def _mobilenet(folder: Path | None, fetch: bool) -> SetFeatures:
    net = _load_network(MobileNetV2(), "mobilenet", folder, fetch)
    mean, deviation = (torch.tensor(values).view(1, 3, 1, 1) for values in (_MEAN, _DEVIATION))

    def features(image: Tensor) -> Tensor:
        size = (_MOBILENET_PX, _MOBILENET_PX)
        small = F.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
        return net((small - mean) / deviation)

    return PooledFeatures(features)


def _backbone(folder: Path | None, fetch: bool) -> SetFeatures:
    """Features of the perceptual distance, averaged over the picture: 448 numbers."""
    del folder, fetch
    perception = PerceptualDistance()

    def features(picture: Picture) -> Floats:
        with torch.no_grad():
            return torch.cat([x.mean(dim=(2, 3))[0] for x in perception.features(picture)]).double().numpy()

    return features


def _perceptual(folder: Path | None, fetch: bool) -> PairDistance:
    del folder, fetch
    perception = PerceptualDistance()

    def distance(first: Picture, second: Picture) -> float:
        _check_sizes(first, second)
        return perception.distance(first, second, np.ones(first.shape[:2], np.bool_))

    return distance


METRICS: dict[str, Metric] = {
    "psnr": Metric("PSNR", True, lambda folder, fetch: squared_error, "dB", squared=True),
    "ssim": Metric("SSIM", True, lambda folder, fetch: structural_similarity),
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


def why_missing(name: str, folder: Path | None) -> str | None:
    """Why a metric is not available without a download, or None; folder: of"""
    needs = METRICS[name].needs
    if needs is None:
        return None
    try:
        find_weights(needs, folder)
    except FormatError as error:
        return str(error)
    return None


def load_metrics(names: Sequence[str], folder: Path | None, fetch: bool) -> dict[str, PairDistance | SetFeatures]:
    """Load metrics.

    Args:
        names: Names among METRICS.
        folder: Folder of
        fetch: Download missing ones.

    Raises:
        FormatError: Missing or damaged
    """
    return {name: METRICS[name].load(folder, fetch) for name in names}


@dataclass(frozen=True, slots=True)
class Gaussian:
    """A set of features taken as a Gaussian."""

    mean: Floats
    """Mean (D,)."""
    root: Floats
    """Matrix (K, D) with root^T root the covariance."""

    @classmethod
    def from_features(cls, features: Floats) -> Gaussian:
        """Fit features (N, D), N >= 2, with the covariance over N - 1.

        Raises ShapeError for fewer than two, RangeError for a feature that is not finite.
        """
        if features.ndim != 2 or len(features) < 2:
            raise ShapeError("features of a Frechet distance", "at least two pictures", len(features))
        if not np.isfinite(features).all():
            raise RangeError("features of a Frechet distance", "finite numbers", "others")
        features = features.astype(np.float64)
        mean = features.mean(axis=0)
        root = (features - mean) / np.sqrt(len(features) - 1)
        if len(root) > root.shape[1]:
            root = np.asarray(np.linalg.qr(root, mode="r"))
        return cls(mean, root)

    @classmethod
    def from_moments(cls, mean: Floats, covariance: Floats) -> Gaussian:
        """Take a mean (D,) and a covariance (D, D). Raises ShapeError if they do not fit, RangeError if the
        covariance is not symmetric and positive semi-definite.
        """
        if mean.ndim != 1 or covariance.shape != (len(mean), len(mean)):
            raise ShapeError("covariance", f"({len(mean)}, {len(mean)})", covariance.shape)
        values, vectors = np.linalg.eigh(covariance)
        # rounding leaves eigenvalues of 0 a little below it.
        least = -1e-10 * max(float(np.abs(values).max(initial=0)), 1.0)
        if not np.allclose(covariance, covariance.T) or float(values.min(initial=0)) < least:
            raise RangeError("covariance", "symmetric and positive semi-definite", "another matrix")
        return cls(mean.astype(np.float64), np.sqrt(values.clip(0))[:, None] * vectors.T)


def frechet_distance(first: Gaussian, second: Gaussian) -> float:
    """Frechet distance of two sets of features (Heusel et al., NIPS 2017, eq. 6), at least 0.

    |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)). With C = R^T R, the trace of the square root is the sum of the
    singular values of R1 R2^T: no matrix root, and no regularisation with fewer pictures than features. Raises
    ShapeError if the numbers of features differ.
    """
    if first.mean.shape != second.mean.shape:
        raise ShapeError("features of a Frechet distance", f"{len(first.mean)} a picture", len(second.mean))
    difference = first.mean - second.mean
    spread = float(np.square(first.root).sum() + np.square(second.root).sum())
    common = float(np.linalg.svd(first.root @ second.root.T, compute_uv=False).sum())
    return max(float(difference @ difference) + spread - 2 * common, 0.0)
