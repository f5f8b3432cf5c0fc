"""Separable linear maps of images by banded matrices: each output depends on a few neighbouring inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

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
