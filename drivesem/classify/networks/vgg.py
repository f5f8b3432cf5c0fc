"""VGG-16 (Simonyan and Zisserman 2015, arXiv:1409.1556), configuration D, by torchvision's names of weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from drivesem.classify.networks.base import Classifier

_CHANNELS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0)
"""Of each convolution, 3x3; 0 is a 2x2 pooling."""


def _convolutions() -> nn.Sequential:
    layers: list[nn.Module] = []
    before = 3
    for channels in _CHANNELS:
        if channels == 0:
            layers.append(nn.MaxPool2d(2))
        else:
            layers += [nn.Conv2d(before, channels, 3, padding=1), nn.ReLU(inplace=True)]
            before = channels
    return nn.Sequential(*layers)


class VGG16(Classifier):
    """The published network."""

    architecture = "vgg16"
    head = "classifier.6"

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__(classes)
        self.features = _convolutions()
        self.pool = nn.AdaptiveAvgPool2d(7)
        self.classifier = nn.Sequential(
            nn.Linear(512 * 7 * 7, 4096),
            nn.ReLU(inplace=True),
            nn.Dropout(),
            nn.Linear(4096, 4096),
            nn.ReLU(inplace=True),
            nn.Dropout(),
            nn.Linear(4096, len(self.classes)),
        )

    def encode(self, prepared: Tensor) -> Tensor:
        pooled = self.pool(self.features(prepared))
        return self.classifier[:6](torch.flatten(pooled, 1))


class PooledVGG16(Classifier):
    """Its convolutions, and one layer on mean and maximum of what the last of them find: where the three large
    layers of the published network are not at hand, which hold nine tenths of its weights.
    """

    architecture = "vgg16-pooled"
    head = "classifier"

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__(classes)
        self.features = _convolutions()
        self.classifier = nn.Linear(2 * 512, len(self.classes))

    def encode(self, prepared: Tensor) -> Tensor:
        x = self.features(prepared)
        return torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)
