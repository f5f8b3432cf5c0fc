"""JPEG as a map of pictures that has a gradient: what `kornia.enhance.jpeg_codec_differentiable` computes, in few
passes. Nothing is written.

Everything but the rounding is linear: colours to luminance and colour differences, these at half the resolution,
and the cosine transform of blocks of 8 x 8. Along rows and columns each is a matrix, and so is what they make
together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.fft
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesem.failures.banded import Matrix, Separable
from scene_ir.geometry import kept_within

_LUMINANCE = np.array(
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ],
    dtype=np.float64,
)
_CHROMINANCE = np.full((8, 8), 99.0)
_CHROMINANCE[:4, :4] = [[17, 18, 24, 47], [18, 21, 26, 66], [24, 26, 56, 99], [47, 66, 99, 99]]
"""Steps of the coefficients at quality 50: ITU-T T.81, annex K.1."""
_TO_YCC = np.array([[0.299, 0.587, 0.114], [-0.299, -0.587, 0.886], [0.701, -0.587, -0.114]]) * [
    [1],
    [0.564],
    [0.713],
]
"""From RGB to luminance and colour differences, as kornia has them."""
_BLUR = np.array([np.exp(-2.0), 1.0, np.exp(-2.0)]) / (1.0 + 2.0 * np.exp(-2.0))
"""Over pixels, before colour differences are taken at half the resolution."""


@dataclass(frozen=True, slots=True)
class Codec:
    """JPEG at one quality for pictures of one size. light, colour: to coefficients; light_back, colour_back: to
    pixels; light_steps, colour_steps: of the coefficients.
    """

    light: Separable
    colour: Separable
    light_back: Separable
    colour_back: Separable
    light_steps: Tensor
    colour_steps: Tensor

    @classmethod
    def of(cls, hw: tuple[int, int], quality: int, like: Tensor) -> Codec:
        """For pictures (3, H, W) of the dtype and on the device of a tensor. quality: 1 to 100."""
        maps = _maps(hw, like.dtype, like.device)
        height, width = (maps[0].rows.outputs, maps[0].columns.outputs)
        steps = []
        for table, parts in ((_LUMINANCE, 8), (_CHROMINANCE, 16)):
            scaled = np.clip(
                (table * _step(5000 / quality if quality < 50 else 200 - 2 * quality) + 50) / 100, 1, 255
            )
            steps.append(torch.from_numpy(np.tile(_step(scaled), (height // parts, width // parts))).to(like))
        return cls(*maps, *steps)

    def __call__(self, image: Tensor) -> Tensor:
        """What is left of a picture (3, H, W) in [0, 1]; differentiable."""
        to_ycc = torch.from_numpy(_TO_YCC).to(image)
        # Less the middle of the levels: the colour differences' own is in the rounding's favour, half a level.
        levels = torch.addmm(image.new_tensor([[-128.0], [-0.5], [-0.5]]), 255 * to_ycc, image.flatten(1))
        levels = levels.view_as(image)
        light = self.light_back(_rounded(self.light(levels[:1]), self.light_steps))
        colour = self.colour_back(_rounded(self.colour(levels[1:]), self.colour_steps))
        back = torch.linalg.inv(to_ycc.double()).to(image) / 255
        offset = back @ image.new_tensor([[128.0], [0.5], [0.5]])
        rgb = torch.addmm(offset, back, torch.cat([light, colour]).flatten(1))
        return kept_within(rgb.view_as(image), 0, 1)


def _step(value: Any) -> Any:
    """A whole number, nearly: the differentiable floor that kornia rounds steps with."""
    whole = np.floor(value)
    return whole + (value - 0.5 - whole) ** 3


@lru_cache(maxsize=4)
def _maps(
    hw: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> tuple[Separable, Separable, Separable, Separable]:
    """Light and colour to coefficients and back; pictures go on to a multiple of 16 as their last pixels."""
    like = torch.empty(0, dtype=dtype, device=device)
    first, second, third, fourth = (
        Separable.of(rows, columns, like) for rows, columns in zip(*map(_side, hw), strict=True)
    )
    return first, second, third, fourth


def _side(size: int) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """The same along one side: coefficients of `size` pixels, and of them at half the resolution, and back."""
    whole = size + -size % 16
    half = whole // 2
    continued = np.eye(size)[np.minimum(np.arange(whole), size - 1)]
    thinned = np.zeros((half, size))
    for tap in range(2):
        for reach, weight in zip((-1, 0, 1), _BLUR, strict=True):
            at = 2 * np.arange(half) + tap + reach
            at = np.where(at < 0, -at, np.where(at >= whole, 2 * whole - 2 - at, at))  # mirrored at the border
            np.add.at(thinned, (np.arange(half), np.minimum(at, size - 1)), 0.5 * weight)
    place = np.clip((np.arange(size) + 0.5) / 2 - 0.5, 0, half - 1)
    first = np.floor(place).astype(np.int64)
    doubled = np.zeros((half, size))
    np.add.at(doubled, (first, np.arange(size)), 1 - (place - first))
    np.add.at(doubled, (np.minimum(first + 1, half - 1), np.arange(size)), place - first)
    return _cosines(continued), _cosines(thinned), _cosines(np.eye(whole))[:, :size].T, _cosines(doubled).T


def _cosines(matrix: Matrix) -> Matrix:
    """The cosine transform of every eight rows."""
    blocks = matrix.reshape(-1, 8, matrix.shape[1])
    return np.asarray(scipy.fft.dct(blocks, axis=1, norm="ortho")).reshape(matrix.shape)


def _rounded(coefficients: Tensor, steps: Tensor) -> Tensor:
    """Coefficients (C, h, w) in whole steps (h, w), with a cube of what is left, so that there is a gradient."""
    result: Tensor = _Rounded.apply(coefficients, steps)  # pyright: ignore[reportAssignmentType]
    return result


class _Rounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, steps: Tensor) -> Tensor:
        counted = coefficients / steps
        whole = counted.round()
        left = counted.sub_(whole)
        ctx.save_for_backward(left)
        return whole.addcmul_(left.square(), left).mul_(steps)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None]:
        (left,) = ctx.saved_tensors
        return (3 * left.square()).mul_(gradients[0]), None
