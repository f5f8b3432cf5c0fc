"""Inception v3 up to its pooled features, in plain torch with torchvision's names of weights.

Two of its kind: FID's (Heusel et al., NIPS 2017) is TensorFlow's network of 2015-12-05, whose average pooling
leaves the border out and whose last block pools by the maximum; torchvision's is that of Szegedy et al., 2015.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FEATURES = 2048
_SIDE_PX = 299
"""What the network was trained on."""
_Kernel = int | tuple[int, int]


class _Conv(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: _Kernel, stride: int = 1, padding: _Kernel = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)), inplace=True)


class _Pool(nn.Module):
    """3x3, stride 1: the mean with or without the border, or the greatest."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind

    def forward(self, x: Tensor) -> Tensor:
        if self.kind == "greatest":
            return F.max_pool2d(x, 3, 1, 1)
        return F.avg_pool2d(x, 3, 1, 1, count_include_pad=self.kind == "with border")


class _A(nn.Module):
    """35x35: 1x1, 5x5, two 3x3, pooling."""

    def __init__(self, inputs: int, pooled: int, pool: str) -> None:
        super().__init__()
        self.branch1x1 = _Conv(inputs, 64, 1)
        self.branch5x5_1 = _Conv(inputs, 48, 1)
        self.branch5x5_2 = _Conv(48, 64, 5, padding=2)
        self.branch3x3dbl_1 = _Conv(inputs, 64, 1)
        self.branch3x3dbl_2 = _Conv(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = _Conv(96, 96, 3, padding=1)
        self.pool = _Pool(pool)
        self.branch_pool = _Conv(inputs, pooled, 1)

    def forward(self, x: Tensor) -> Tensor:
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        five = self.branch5x5_2(self.branch5x5_1(x))
        return torch.cat([self.branch1x1(x), five, double, self.branch_pool(self.pool(x))], 1)


class _B(nn.Module):
    """35x35 to 17x17."""

    def __init__(self) -> None:
        super().__init__()
        self.branch3x3 = _Conv(288, 384, 3, 2)
        self.branch3x3dbl_1 = _Conv(288, 64, 1)
        self.branch3x3dbl_2 = _Conv(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = _Conv(96, 96, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        return torch.cat([self.branch3x3(x), double, F.max_pool2d(x, 3, 2)], 1)


class _C(nn.Module):
    """17x17: 1x1, 7x7 in two, twice 7x7 in two, pooling."""

    def __init__(self, width: int, pool: str) -> None:
        super().__init__()

        def across(outputs: int) -> _Conv:
            return _Conv(width, outputs, (1, 7), padding=(0, 3))

        def down(outputs: int) -> _Conv:
            return _Conv(width, outputs, (7, 1), padding=(3, 0))

        self.branch1x1 = _Conv(768, 192, 1)
        self.branch7x7_1 = _Conv(768, width, 1)
        self.branch7x7_2 = across(width)
        self.branch7x7_3 = down(192)
        self.branch7x7dbl_1 = _Conv(768, width, 1)
        self.branch7x7dbl_2 = down(width)
        self.branch7x7dbl_3 = across(width)
        self.branch7x7dbl_4 = down(width)
        self.branch7x7dbl_5 = across(192)
        self.pool = _Pool(pool)
        self.branch_pool = _Conv(768, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        seven = self.branch7x7_3(self.branch7x7_2(self.branch7x7_1(x)))
        double = self.branch7x7dbl_3(self.branch7x7dbl_2(self.branch7x7dbl_1(x)))
        double = self.branch7x7dbl_5(self.branch7x7dbl_4(double))
        return torch.cat([self.branch1x1(x), seven, double, self.branch_pool(self.pool(x))], 1)


class _D(nn.Module):
    """17x17 to 8x8."""

    def __init__(self) -> None:
        super().__init__()
        self.branch3x3_1 = _Conv(768, 192, 1)
        self.branch3x3_2 = _Conv(192, 320, 3, 2)
        self.branch7x7x3_1 = _Conv(768, 192, 1)
        self.branch7x7x3_2 = _Conv(192, 192, (1, 7), padding=(0, 3))
        self.branch7x7x3_3 = _Conv(192, 192, (7, 1), padding=(3, 0))
        self.branch7x7x3_4 = _Conv(192, 192, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        seven = self.branch7x7x3_4(self.branch7x7x3_3(self.branch7x7x3_2(self.branch7x7x3_1(x))))
        return torch.cat([self.branch3x3_2(self.branch3x3_1(x)), seven, F.max_pool2d(x, 3, 2)], 1)


class _E(nn.Module):
    """8x8: 1x1, 3x3 both ways, 3x3 then both ways, pooling."""

    def __init__(self, inputs: int, pool: str) -> None:
        super().__init__()
        self.branch1x1 = _Conv(inputs, 320, 1)
        self.branch3x3_1 = _Conv(inputs, 384, 1)
        self.branch3x3_2a = _Conv(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3_2b = _Conv(384, 384, (3, 1), padding=(1, 0))
        self.branch3x3dbl_1 = _Conv(inputs, 448, 1)
        self.branch3x3dbl_2 = _Conv(448, 384, 3, padding=1)
        self.branch3x3dbl_3a = _Conv(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3dbl_3b = _Conv(384, 384, (3, 1), padding=(1, 0))
        self.pool = _Pool(pool)
        self.branch_pool = _Conv(inputs, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        three = self.branch3x3_1(x)
        double = self.branch3x3dbl_2(self.branch3x3dbl_1(x))
        both = [self.branch3x3_2a(three), self.branch3x3_2b(three)]
        both += [self.branch3x3dbl_3a(double), self.branch3x3dbl_3b(double)]
        return torch.cat([self.branch1x1(x), *both, self.branch_pool(self.pool(x))], 1)


class Inception(nn.Module):
    """forward: (B, 3, H, W) RGB in [0, 1] -> (B, 2048), means of the last block over the picture.

    original: FID's network; else torchvision's. Pictures are first brought to 299x299, bilinear, whatever their
    shape, as FID does.
    """

    def __init__(self, original: bool = True) -> None:
        super().__init__()
        mean = "without border" if original else "with border"
        self.Conv2d_1a_3x3 = _Conv(3, 32, 3, 2)
        self.Conv2d_2a_3x3 = _Conv(32, 32, 3)
        self.Conv2d_2b_3x3 = _Conv(32, 64, 3, padding=1)
        self.maxpool1 = nn.MaxPool2d(3, 2)
        self.Conv2d_3b_1x1 = _Conv(64, 80, 1)
        self.Conv2d_4a_3x3 = _Conv(80, 192, 3)
        self.maxpool2 = nn.MaxPool2d(3, 2)
        self.Mixed_5b = _A(192, 32, mean)
        self.Mixed_5c = _A(256, 64, mean)
        self.Mixed_5d = _A(288, 64, mean)
        self.Mixed_6a = _B()
        self.Mixed_6b = _C(128, mean)
        self.Mixed_6c = _C(160, mean)
        self.Mixed_6d = _C(160, mean)
        self.Mixed_6e = _C(192, mean)
        self.Mixed_7a = _D()
        self.Mixed_7b = _E(1280, mean)
        self.Mixed_7c = _E(2048, "greatest" if original else mean)

    def forward(self, x: Tensor) -> Tensor:
        x = F.interpolate(x, size=(_SIDE_PX, _SIDE_PX), mode="bilinear", align_corners=False)
        x = 2 * x - 1
        for block in self.children():
            x = block(x)
        return x.mean(dim=(2, 3))
