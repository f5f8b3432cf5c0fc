"""A small network that looks at a street: what the networks of `segment` and `depth` share.

A U-Net of residual convolutions that sees the picture at 0.4 of KITTI's size, and how far each pixel looks above
the horizon. Half of the channels of its first stages are normalised over the picture itself and not over the
training set (IBN-Net, Pan et al., ECCV 2018): it has seen generated pictures only, and that is what lets it take a
photograph's light and colours as they come.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from scene_ir.types import Camera

Array = NDArray[np.float32]

INPUT_FOCAL_PX = 288.0
"""Focal length that pictures are resized to: 0.4 of KITTI's 721 px."""
_MOST_PX = 250_000
"""Larger pictures are resized to fewer: three times KITTI's."""
STRIDE = 16
"""Sides of the network's input are multiples of it."""
_MEAN, _SPREAD = 0.42, 0.27
"""Of the photograph's values, about."""


@dataclass(frozen=True, slots=True)
class NetworkInput:
    """A photograph as a network sees it. image (h, w, 3) RGB in [0, 1]; elevation (h, w): see `elevation`."""

    image: Array
    elevation: Array


def compute_elevation(ground: Tensor, camera: Camera, size_hw: tuple[int, int]) -> Array:
    """The sine (h, w) of the angle by which each pixel of the resized photograph looks above the ground's horizon.

    ground: (4,) plane n.x + d = 0, n up.
    """
    height, width = size_hw
    v = (np.arange(height) + 0.5) * (camera.height / height) - 0.5
    u = (np.arange(width) + 0.5) * (camera.width / width) - 0.5
    inverse = np.linalg.inv(camera.intrinsics.double().numpy())
    ray = np.einsum("ij,jhw->ihw", inverse, np.stack([*np.meshgrid(u, v), np.ones((height, width))]))
    up = ground[:3].double().numpy()
    return (np.einsum("i,ihw->hw", up, ray) / np.linalg.norm(ray, axis=0)).astype(np.float32)


def prepare_input(image: Array, ground: Tensor, camera: Camera) -> NetworkInput:
    """A photograph (H, W, 3) RGB in [0, 1] at the size that networks are made for."""
    height, width = image.shape[:2]
    scale = INPUT_FOCAL_PX / float(camera.intrinsics[0, 0])
    scale *= min(1.0, (_MOST_PX / (height * width * scale**2)) ** 0.5)
    h, w = (max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (height, width))
    small = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), np.float32)
    return NetworkInput(small, compute_elevation(ground, camera, (h, w)))


class _Norm(nn.Module):
    """Normalisation: the first half of the channels over the picture itself, the others as in training."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.own = nn.InstanceNorm2d(channels // 2, affine=True)
        self.shared = nn.BatchNorm2d(channels - channels // 2)

    def forward(self, x: Tensor) -> Tensor:
        own, shared = x.chunk(2, 1)
        return torch.cat([self.own(own), self.shared(shared)], 1)


class _Block(nn.Module):
    """3x3 convolution, normalisation, ReLU; added to its input where that has the same shape."""

    def __init__(self, channels: int, out: int, stride: int = 1, own: bool = False) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, out, 3, stride=stride, padding=1, bias=False)
        self.norm = _Norm(out) if own else nn.BatchNorm2d(out)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm(self.convolution(x)))
        return x + y if self.residual else y


class _Wide(nn.Module):
    """A 5x5 depthwise convolution, dilated, and a pointwise one; added to its input."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(
            channels, channels, 5, padding=2 * dilation, dilation=dilation, groups=channels, bias=False
        )
        self.inner = nn.BatchNorm2d(channels)
        self.pointwise = nn.Conv2d(channels, channels, 1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + F.relu(self.norm(self.pointwise(F.relu(self.inner(self.depthwise(x))))))


class _Up(nn.Module):
    """What was seen coarsely, twice as large, joined with what was seen finely."""

    def __init__(self, coarse: int, fine: int, out: int) -> None:
        super().__init__()
        self.coarse = nn.Conv2d(coarse, out, 1, bias=False)
        self.fine = nn.Conv2d(fine, out, 1, bias=False)
        self.norm = nn.BatchNorm2d(out)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        large = F.interpolate(self.coarse(coarse), scale_factor=2.0, mode="bilinear", align_corners=False)
        return F.relu(self.norm(large + self.fine(fine)))


class UNet(nn.Module):
    """RGB (N, 3, h, w) in [0, 1] and `elevation` (N, 1, h, w), sides multiples of 16, to (N, C, h/2, w/2)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fine = _Block(4, 16, 2, own=True)
        self.middle = nn.Sequential(_Block(16, 48, 2, own=True), _Block(48, 48, own=True), _Block(48, 48))
        self.coarse = nn.Sequential(_Block(48, 88, 2, own=True), _Block(88, 88), _Block(88, 88))
        self.whole = nn.Sequential(_Block(88, 112, 2), _Wide(112, 1), _Wide(112, 2), _Wide(112, 3))
        self.to_coarse = _Up(112, 88, 64)
        self.to_middle = _Up(64, 48, 48)
        self.joined = _Block(48, 48)
        self.to_fine = _Up(48, 16, 24)
        self.out = nn.Conv2d(24, channels, 3, padding=1)

    def forward(self, image: Tensor, elevation: Tensor) -> Tensor:
        x = torch.cat([(image - _MEAN) / _SPREAD, 3.0 * elevation], 1)
        fine = self.fine(x.contiguous(memory_format=torch.channels_last))
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        x = self.joined(self.to_middle(self.to_coarse(self.whole(coarse), coarse), middle))
        return self.out(self.to_fine(x, fine))

    def predict(self, view: NetworkInput) -> Tensor:
        """What it makes of one view (1, channels, h/2, w/2)."""
        with torch.no_grad():
            return self(
                torch.from_numpy(view.image).permute(2, 0, 1)[None], torch.from_numpy(view.elevation)[None, None]
            )
