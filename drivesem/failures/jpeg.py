"""Differentiable JPEG: what `kornia.enhance.jpeg_codec_differentiable` computes, in few passes.

Everything but the rounding is linear: RGB to luma and chroma, chroma at half the resolution, and the cosine
transform of blocks of 8 x 8. Each is a matrix along rows and along columns, and so is their product.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.fft
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.geometry import clamp_inclusive

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
"""Quantisation steps at quality 50: ITU-T T.81, annex K.1."""
_TO_YCC = np.array([[0.299, 0.587, 0.114], [-0.299, -0.587, 0.886], [0.701, -0.587, -0.114]]) * [
    [1],
    [0.564],
    [0.713],
]
"""From RGB to luma and chroma, as in kornia."""
_BLUR = np.array([np.exp(-2.0), 1.0, np.exp(-2.0)]) / (1.0 + 2.0 * np.exp(-2.0))
"""Blur of the chroma before it is sampled at half the resolution."""


@dataclass(frozen=True, slots=True)
class DifferentiableJpeg:
    """JPEG at one quality for images of one size."""

    luma: SeparableMap
    """Luma to DCT coefficients."""
    chroma: SeparableMap
    """Chroma to DCT coefficients at half the resolution."""
    luma_inverse: SeparableMap
    """Coefficients back to luma."""
    chroma_inverse: SeparableMap
    """Coefficients back to chroma at full resolution."""
    luma_steps: Tensor
    """Quantisation step of each luma coefficient."""
    chroma_steps: Tensor
    """Quantisation step of each chroma coefficient."""

    @classmethod
    def create(cls, hw: tuple[int, int], quality: int, like: Tensor) -> DifferentiableJpeg:
        """Build the transforms.

        Args:
            hw: Height and width of the images, px.
            quality: JPEG quality, 1 to 100.
            like: Tensor of the images' dtype and device.
        """
        maps = _transforms(hw, like.dtype, like.device)
        height, width = (maps[0].rows.outputs, maps[0].columns.outputs)
        steps = []
        for table, parts in ((_LUMINANCE, 8), (_CHROMINANCE, 16)):
            scaled = np.clip(
                (table * _soft_floor(5000 / quality if quality < 50 else 200 - 2 * quality) + 50) / 100, 1, 255
            )
            steps.append(
                torch.from_numpy(np.tile(_soft_floor(scaled), (height // parts, width // parts))).to(like)
            )
        return cls(*maps, *steps)

    def __call__(self, image: Tensor) -> Tensor:
        """Encode and decode an image (3, H, W) in [0, 1]; differentiable."""
        to_ycc = torch.from_numpy(_TO_YCC).to(image)
        # Centre the levels on 0; chroma's offset of half a level compensates the rounding.
        levels = torch.addmm(image.new_tensor([[-128.0], [-0.5], [-0.5]]), 255 * to_ycc, image.flatten(1))
        levels = levels.view_as(image)
        light = self.luma_inverse(_quantise(self.luma(levels[:1]), self.luma_steps))
        colour = self.chroma_inverse(_quantise(self.chroma(levels[1:]), self.chroma_steps))
        back = torch.linalg.inv(to_ycc.double()).to(image) / 255
        offset = back @ image.new_tensor([[128.0], [0.5], [0.5]])
        rgb = torch.addmm(offset, back, torch.cat([light, colour]).flatten(1))
        return clamp_inclusive(rgb.view_as(image), 0, 1)


def _soft_floor(value: Any) -> Any:
    """The differentiable floor by which kornia rounds quantisation steps."""
    whole = np.floor(value)
    return whole + (value - 0.5 - whole) ** 3


@lru_cache(maxsize=4)
def _transforms(
    hw: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> tuple[SeparableMap, SeparableMap, SeparableMap, SeparableMap]:
    """Luma and chroma to coefficients and back; images are padded to a multiple of 16 by their last pixels."""
    like = torch.empty(0, dtype=dtype, device=device)
    first, second, third, fourth = (
        SeparableMap.from_dense(rows, columns, like)
        for rows, columns in zip(*map(_axis_transforms, hw), strict=True)
    )
    return first, second, third, fourth


def _axis_transforms(size: int) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """The same along one axis of `size` pixels: luma and chroma to coefficients, and back."""
    padded_size = size + -size % 16
    half_size = padded_size // 2
    pad = np.eye(size)[np.minimum(np.arange(padded_size), size - 1)]
    downsample = np.zeros((half_size, size))
    for tap in range(2):
        for reach, weight in zip((-1, 0, 1), _BLUR, strict=True):
            source = 2 * np.arange(half_size) + tap + reach
            source = np.where(
                source < 0, -source, np.where(source >= padded_size, 2 * padded_size - 2 - source, source)
            )  # mirrored at the border
            np.add.at(downsample, (np.arange(half_size), np.minimum(source, size - 1)), 0.5 * weight)
    position = np.clip((np.arange(size) + 0.5) / 2 - 0.5, 0, half_size - 1)
    first = np.floor(position).astype(np.int64)
    upsample = np.zeros((half_size, size))
    np.add.at(upsample, (first, np.arange(size)), 1 - (position - first))
    np.add.at(upsample, (np.minimum(first + 1, half_size - 1), np.arange(size)), position - first)
    return (
        _block_dct(pad),
        _block_dct(downsample),
        _block_dct(np.eye(padded_size))[:, :size].T,
        _block_dct(upsample).T,
    )


def _block_dct(matrix: Matrix) -> Matrix:
    """Apply the cosine transform to every eight rows."""
    blocks = matrix.reshape(-1, 8, matrix.shape[1])
    return np.asarray(scipy.fft.dct(blocks, axis=1, norm="ortho")).reshape(matrix.shape)


def _quantise(coefficients: Tensor, steps: Tensor) -> Tensor:
    """Round coefficients (C, h, w) to steps (h, w), plus the cube of the remainder, which gives a gradient."""
    result: Tensor = _SoftRound.apply(coefficients, steps)  # pyright: ignore[reportAssignmentType]
    return result


class _SoftRound(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, steps: Tensor) -> Tensor:
        in_steps = coefficients / steps
        rounded = in_steps.round()
        remainder = in_steps.sub_(rounded)
        ctx.save_for_backward(remainder)
        return rounded.addcmul_(remainder.square(), remainder).mul_(steps)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None]:
        (remainder,) = ctx.saved_tensors
        return (3 * remainder.square()).mul_(gradients[0]), None


Matrix = NDArray[np.float64]

_BLOCK = 32
"""Outputs per matrix product: enough to be fast, few enough that they share most of their inputs."""


@dataclass(frozen=True, slots=True)
class BandedMatrix:
    """A linear map from vectors (inputs,) to vectors (outputs,)."""

    inputs: int
    """Length of the input."""
    outputs: int
    """Length of the output."""
    blocks: tuple[tuple[slice, slice, Tensor], ...]
    """Output range, input range, and the dense matrix between them."""

    @classmethod
    def from_dense(cls, matrix: Matrix, like: Tensor) -> BandedMatrix:
        """Convert a dense matrix (outputs, inputs) to the dtype and device of a tensor."""
        outputs, inputs = matrix.shape
        blocks = []
        for start in range(0, outputs, _BLOCK):
            rows = slice(start, min(start + _BLOCK, outputs))
            used = np.flatnonzero(matrix[rows].any(axis=0))
            columns = slice(int(used[0]), int(used[-1]) + 1) if len(used) else slice(0, 1)
            blocks.append((rows, columns, torch.from_numpy(matrix[rows, columns]).to(like).contiguous()))
        return cls(inputs, outputs, tuple(blocks))

    def map_rows(self, image: Tensor) -> Tensor:
        """Map each row of an image (C, H, inputs) to (C, H, outputs)."""
        source = image.contiguous().flatten(0, 1)
        result = source.new_empty(len(source), self.outputs)
        for rows, columns, matrix in self.blocks:
            torch.mm(source[:, columns], matrix.T, out=result[:, rows])
        return result.unflatten(0, image.shape[:2])

    def map_columns(self, image: Tensor) -> Tensor:
        """Map each column of an image (C, inputs, W) to (C, outputs, W)."""
        source = image.contiguous()
        result = source.new_empty(len(source), self.outputs, source.shape[2])
        for channel, target in zip(source, result, strict=True):
            for rows, columns, matrix in self.blocks:
                torch.mm(matrix, channel[columns], out=target[rows])
        return result


@dataclass(frozen=True, slots=True)
class SeparableMap:
    """A linear map of images, as one map over their height and one over their width."""

    rows: BandedMatrix
    """Map over the height: which input rows make each output row."""
    columns: BandedMatrix
    """Map over the width."""
    rows_back: BandedMatrix
    """Transpose of `rows`."""
    columns_back: BandedMatrix
    """Transpose of `columns`."""

    @classmethod
    def from_dense(cls, rows: Matrix, columns: Matrix, like: Tensor) -> SeparableMap:
        """Build the map from dense matrices.

        Args:
            rows: (h, H), over the height.
            columns: (w, W), over the width.
            like: Tensor of the images' dtype and device.
        """
        return cls(*(BandedMatrix.from_dense(matrix, like) for matrix in (rows, columns, rows.T, columns.T)))

    def __call__(self, image: Tensor) -> Tensor:
        """Map an image (C, H, W) to (C, h, w); differentiable."""
        result: Tensor = _SeparableMapFunction.apply(image, self)  # pyright: ignore[reportAssignmentType]
        return result


class _SeparableMapFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, separable: SeparableMap) -> Tensor:
        ctx.separable = separable
        return separable.rows.map_columns(separable.columns.map_rows(image))

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None]:
        separable: SeparableMap = ctx.separable
        return separable.columns_back.map_rows(separable.rows_back.map_columns(gradients[0])), None
