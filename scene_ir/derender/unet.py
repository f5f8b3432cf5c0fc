"""The U-Net that the networks of `segmentation` and `depth` share.

Its input is the photograph at 0.4 of KITTI's size and each pixel's elevation above the horizon. Half of the
channels of its first stages are normalised over the photograph rather than over the training set (IBN-Net, Pan et
al., ECCV 2018), so that a network trained on generated images generalises to the light and colours of photographs.
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
"""Focal length of the network's input: 0.4 of KITTI's 721 px."""
_MAX_PX = 250_000
"""Largest number of input pixels: three times KITTI's."""
STRIDE = 16
"""Sides of the network's input are multiples of it."""
_MEAN, _SPREAD = 0.42, 0.27
"""Mean and standard deviation of photographs' values, about."""


@dataclass(frozen=True, slots=True)
class NetworkInput:
    """A photograph as the network's input."""

    image: Array
    """(h, w, 3) RGB in [0, 1]."""
    elevation: Array
    """(h, w), see `compute_elevation`."""


def compute_elevation(ground: Tensor, camera: Camera, size_hw: tuple[int, int]) -> Array:
    """Sine of each pixel's elevation above the ground's horizon.

    Args:
        ground: Plane (4,) n.x + d = 0 with n up.
        camera: The photograph's camera.
        size_hw: Height and width of the result.

    Returns:
        (h, w) in [-1, 1], of the photograph resized to `size_hw`.
    """
    height, width = size_hw
    v = (np.arange(height) + 0.5) * (camera.height / height) - 0.5
    u = (np.arange(width) + 0.5) * (camera.width / width) - 0.5
    inverse = np.linalg.inv(camera.intrinsics.double().numpy())
    ray = np.einsum("ij,jhw->ihw", inverse, np.stack([*np.meshgrid(u, v), np.ones((height, width))]))
    up = ground[:3].double().numpy()
    return (np.einsum("i,ihw->hw", up, ray) / np.linalg.norm(ray, axis=0)).astype(np.float32)


def prepare_input(image: Array, ground: Tensor, camera: Camera) -> NetworkInput:
    """Resize a photograph for the network.

    Args:
        image: (H, W, 3) RGB in [0, 1].
        ground: Plane (4,) n.x + d = 0 with n up.
        camera: The photograph's camera.

    Returns:
        The network's input.
    """
    height, width = image.shape[:2]
    scale = INPUT_FOCAL_PX / float(camera.intrinsics[0, 0])
    scale *= min(1.0, (_MAX_PX / (height * width * scale**2)) ** 0.5)
    h, w = (max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (height, width))
    small = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), np.float32)
    return NetworkInput(small, compute_elevation(ground, camera, (h, w)))


class _Norm(nn.Module):
    """Normalisation: the first half of the channels over the photograph, the others over the training set."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.own = nn.InstanceNorm2d(channels // 2, affine=True)
        self.shared = nn.BatchNorm2d(channels - channels // 2)

    def forward(self, x: Tensor) -> Tensor:
        own, shared = x.chunk(2, 1)
        return torch.cat([self.own(own), self.shared(shared)], 1)


class _Block(nn.Module):
    """3x3 convolution, normalisation, ReLU; residual if input and output have the same shape."""

    def __init__(self, channels: int, out: int, stride: int = 1, own: bool = False) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, out, 3, stride=stride, padding=1, bias=False)
        self.norm = _Norm(out) if own else nn.BatchNorm2d(out)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm(self.convolution(x)))
        return x + y if self.residual else y


class _DilatedBlock(nn.Module):
    """A dilated 5x5 depthwise convolution and a pointwise one; residual."""

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


class _UpBlock(nn.Module):
    """Coarse features upsampled by 2 and merged with fine ones."""

    def __init__(self, coarse: int, fine: int, out: int) -> None:
        super().__init__()
        self.coarse = nn.Conv2d(coarse, out, 1, bias=False)
        self.fine = nn.Conv2d(fine, out, 1, bias=False)
        self.norm = nn.BatchNorm2d(out)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        large = F.interpolate(self.coarse(coarse), scale_factor=2.0, mode="bilinear", align_corners=False)
        return F.relu(self.norm(large + self.fine(fine)))


class UNet(nn.Module):
    """RGB (N, 3, h, w) in [0, 1] and elevation (N, 1, h, w), sides multiples of 16 -> (N, C, h/2, w/2)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fine = _Block(4, 16, 2, own=True)
        self.middle = nn.Sequential(_Block(16, 48, 2, own=True), _Block(48, 48, own=True), _Block(48, 48))
        self.coarse = nn.Sequential(_Block(48, 88, 2, own=True), _Block(88, 88), _Block(88, 88))
        self.whole = nn.Sequential(
            _Block(88, 112, 2), _DilatedBlock(112, 1), _DilatedBlock(112, 2), _DilatedBlock(112, 3)
        )
        self.to_coarse = _UpBlock(112, 88, 64)
        self.to_middle = _UpBlock(64, 48, 48)
        self.joined = _Block(48, 48)
        self.to_fine = _UpBlock(48, 16, 24)
        self.out = nn.Conv2d(24, channels, 3, padding=1)

    def forward(self, image: Tensor, elevation: Tensor) -> Tensor:
        x = torch.cat([(image - _MEAN) / _SPREAD, 3.0 * elevation], 1)
        fine = self.fine(x.contiguous(memory_format=torch.channels_last))
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        x = self.joined(self.to_middle(self.to_coarse(self.whole(coarse), coarse), middle))
        return self.out(self.to_fine(x, fine))

    def predict(self, view: NetworkInput) -> Tensor:
        """Output (1, C, h/2, w/2) for one input, without gradients."""
        with torch.no_grad():
            return self(
                torch.from_numpy(view.image).permute(2, 0, 1)[None], torch.from_numpy(view.elevation)[None, None]
            )
