"""ResNet-50 (He et al. 2015, arXiv:1512.03385), by torchvision's names of weights; as there, a block that halves
the picture does so in its 3x3 convolution.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from drivesem.classify.networks.base import Classifier

_BLOCKS = (3, 4, 6, 3)
_EXPANSION = 4


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1, and what went in."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = _EXPANSION * width
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out))

    def forward(self, x: Tensor) -> Tensor:
        inner = F.relu(self.bn1(self.conv1(x)))
        inner = F.relu(self.bn2(self.conv2(inner)))
        return F.relu(self.bn3(self.conv3(inner)) + self.downsample(x))


class ResNet50(Classifier):
    """The published network."""

    architecture = "resnet50"
    head = "fc"

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__(classes)
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, padding=1)
        channels = 64
        for i, count in enumerate(_BLOCKS):
            width, blocks = 64 << i, []
            for k in range(count):
                blocks.append(Bottleneck(channels, width, 2 if i > 0 and k == 0 else 1))
                channels = _EXPANSION * width
            self.add_module(f"layer{i + 1}", nn.Sequential(*blocks))
        self.fc = nn.Linear(channels, len(self.classes))

    def encode(self, prepared: Tensor) -> Tensor:
        x = self.maxpool(F.relu(self.bn1(self.conv1(prepared))))
        for i in range(len(_BLOCKS)):
            x = self.get_submodule(f"layer{i + 1}")(x)
        return torch.flatten(F.adaptive_avg_pool2d(x, 1), 1)
