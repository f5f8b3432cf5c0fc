"""Perceptual distances of pictures: LPIPS 0.1 on published networks, and one on the shipped detector's backbone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import resources

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn

from detectors.registry import load_detector
from detectors.squeezedet import BGR_MEAN, Fire, SqueezeDet
from drivesem.classify.networks.architectures import vgg16_convolutions
from scene_ir import files
from scene_ir.errors import ShapeError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

PERCEPTUAL = "perceptual distance (SqueezeDet backbone)"
"""Name of `PerceptualDistance` in tables."""
_MARGIN_PX = 32
"""Context around a region that the backbone sees."""
# of the published code of LPIPS: pictures in [-1, 1] become what torchvision's weights expect
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10
"""Of the published code, added to the length of a feature."""


class PerceptualDistance:
    """A perceptual distance after Zhang et al. (CVPR 2018), unweighted.

    Features of SqueezeNet's first layers from the shipped detector, scaled to unit length at each pixel; squared
    differences are averaged over a region. It is not LPIPS, which has other layers and weights.
    """

    def __init__(self) -> None:
        detector = load_detector("squeezedet")
        assert isinstance(detector, SqueezeDet)
        self._net = detector

    @torch.no_grad()
    def distance(self, first: Picture, second: Picture, region: Mask) -> float:
        """Distance of two pictures (H, W, 3) over a region (H, W); 0 if equal.

        Args:
            first: RGB picture.
            second: RGB picture of the same size.
            region: Pixels that count.

        Raises:
            ShapeError: An empty region.
        """
        if not region.any():
            raise ShapeError("region", "at least one pixel", 0)
        rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
        window = (
            slice(max(int(rows[0]) - _MARGIN_PX, 0), int(rows[-1]) + 1 + _MARGIN_PX),
            slice(max(int(columns[0]) - _MARGIN_PX, 0), int(columns[-1]) + 1 + _MARGIN_PX),
        )
        share = torch.from_numpy(region[window].astype(np.float32))[None, None]
        total = 0.0
        layers = list(zip(self.features(first[window]), self.features(second[window]), strict=True))
        for one, other in layers:
            difference = (F.normalize(one, dim=1) - F.normalize(other, dim=1)).square().sum(dim=1)[0]
            weight = F.adaptive_avg_pool2d(share, (difference.shape[0], difference.shape[1]))[0, 0]
            total += float((difference * weight).sum() / weight.sum())
        return total / len(layers)

    def features(self, picture: Picture) -> list[Tensor]:
        """Features of conv1, fire3 and fire5: (1, C, h, w) at 1/2, 1/4 and 1/8 of the picture's size."""
        image = torch.from_numpy(np.ascontiguousarray(picture[..., ::-1].transpose(2, 0, 1))).float()[None]
        x = F.relu(self._net.conv1(image - image.new_tensor(BGR_MEAN).view(1, 3, 1, 1)))
        features = [x]
        for first, second in (("fire2", "fire3"), ("fire4", "fire5")):
            x = F.max_pool2d(x, 3, stride=2, padding=1)
            x = self._net.fires[second](self._net.fires[first](x))
            features.append(x)
        return features


class FeatureTrunk(nn.Module):
    """A chain of layers with outputs at some of them; forward: (B, 3, H, W) -> a tensor (B, C, h, w) for each tap.

    torchvision itself is not imported: its compiled operators must match the installed torch, its weights need not.
    """

    def __init__(self, features: Sequence[nn.Module], taps: Sequence[int], widths: Sequence[int]) -> None:
        """Build the chain.

        Args:
            features: Layers, named as torchvision names them.
            taps: Indices of the layers with an output.
            widths: Channels of the outputs.
        """
        super().__init__()
        self.features = nn.Sequential(*features)
        self.taps, self.widths = tuple(taps), tuple(widths)

    def forward(self, x: Tensor) -> list[Tensor]:
        """The outputs at the taps, in order."""
        outputs = []
        for place, layer in enumerate(self.features):
            x = layer(x)
            if place in self.taps:
                outputs.append(x)
            if place == self.taps[-1]:
                break
        return outputs


def alexnet() -> FeatureTrunk:
    """torchvision's AlexNet (arXiv:1404.5997) up to the fifth convolution's ReLU."""
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    layers += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
    return FeatureTrunk(layers, (1, 4, 7, 9, 11), (64, 192, 384, 256, 256))


def vgg16() -> FeatureTrunk:
    """VGG-16 up to relu5_3, with outputs at the last ReLU of each of the five stages."""
    return FeatureTrunk(vgg16_convolutions(), (3, 8, 15, 22, 29), (64, 128, 256, 512, 512))


def squeezenet() -> FeatureTrunk:
    """SqueezeNet 1.1 up to its last fire module."""

    def pool() -> nn.Module:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool()]
    layers += [Fire(64, 16, 64), Fire(128, 16, 64), pool(), Fire(128, 32, 128), Fire(256, 32, 128), pool()]
    layers += [Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)]
    return FeatureTrunk(layers, (1, 4, 7, 9, 10, 11, 12), (64, 128, 256, 384, 384, 512, 512))


TRUNKS: dict[str, Callable[[], FeatureTrunk]] = {"alex": alexnet, "vgg": vgg16, "squeeze": squeezenet}
"""Trunks of LPIPS by name."""


def load_published_heads(net: str) -> list[Tensor]:
    """The learned weights (C,) of each layer of `alex`, `vgg` or `squeeze`, as published with LPIPS 0.1."""
    folder = resources.files("tools.experiments.realism") / "weights"
    with resources.as_file(folder / "lpips-0.1.safetensors") as path:
        files.check_model_card(path, files.read_bytes(path))
        tensors = load_file(path)
    return [tensors[f"{net}.lin{i}"] for i in range(len(TRUNKS[net]().taps))]


class Lpips(nn.Module):
    """LPIPS 0.1 (Zhang et al., CVPR 2018), a distance of pictures; 0 if equal.

    Features of a classifier at several layers, scaled to unit length at each pixel; squared differences, weighted
    by a learned number for each channel, summed over channels, averaged over the picture, summed over layers.
    """

    def __init__(self, trunk: FeatureTrunk, heads: Sequence[Tensor]) -> None:
        """heads: a weight (C,) for each channel of each of the trunk's taps. Raises ShapeError if they do not fit."""
        super().__init__()
        widths = tuple(head.numel() for head in heads)
        if widths != trunk.widths:
            raise ShapeError("LPIPS weights", f"{trunk.widths} channels", widths)
        self.trunk = trunk
        self.heads = nn.ParameterList([nn.Parameter(head.reshape(-1), requires_grad=False) for head in heads])
        self.register_buffer("shift", torch.tensor(_SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1))

    def features(self, images: Tensor) -> list[Tensor]:
        """Images (B, 3, H, W) RGB in [0, 1] -> unit features (B, C, h, w) of each layer."""
        shift, scale = self.get_buffer("shift"), self.get_buffer("scale")
        outputs = self.trunk((2 * images - 1 - shift) / scale)
        return [x / (x.square().sum(dim=1, keepdim=True).sqrt() + _EPSILON) for x in outputs]

    def distance(self, first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
        """Distances (B,) of two pictures' features."""
        layers = zip(first, second, self.heads, strict=True)
        parts = [((a - b).square() * w.view(1, -1, 1, 1)).sum(dim=1).mean(dim=(1, 2)) for a, b, w in layers]
        return torch.stack(parts).sum(dim=0)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Images (B, 3, H, W) RGB in [0, 1] -> distances (B,)."""
        return self.distance(self.features(first), self.features(second))
