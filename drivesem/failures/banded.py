"""Linear maps along rows and columns of pictures, each of whose outputs is made of a few neighbouring inputs."""

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
"""Outputs that are computed in one matrix product: enough for its speed, few beside the inputs that they share."""


@dataclass(frozen=True, slots=True)
class Banded:
    """A map from vectors (inputs,) to vectors (outputs,). blocks: outputs, the inputs that they are made of, and
    the matrix between them.
    """

    inputs: int
    outputs: int
    blocks: tuple[tuple[slice, slice, Tensor], ...]

    @classmethod
    def of(cls, matrix: Matrix, like: Tensor) -> Banded:
        """Of a whole matrix (outputs, inputs), in the dtype and on the device of a tensor."""
        outputs, inputs = matrix.shape
        blocks = []
        for start in range(0, outputs, _BLOCK):
            rows = slice(start, min(start + _BLOCK, outputs))
            taken = np.flatnonzero(matrix[rows].any(axis=0))
            columns = slice(int(taken[0]), int(taken[-1]) + 1) if len(taken) else slice(0, 1)
            blocks.append((rows, columns, torch.from_numpy(matrix[rows, columns]).to(like).contiguous()))
        return cls(inputs, outputs, tuple(blocks))

    def across(self, image: Tensor) -> Tensor:
        """Of each row of an image (C, H, inputs): (C, H, outputs)."""
        source = image.contiguous().flatten(0, 1)
        result = source.new_empty(len(source), self.outputs)
        for rows, columns, matrix in self.blocks:
            torch.mm(source[:, columns], matrix.T, out=result[:, rows])
        return result.unflatten(0, image.shape[:2])

    def down(self, image: Tensor) -> Tensor:
        """Of each column of an image (C, inputs, W): (C, outputs, W)."""
        source = image.contiguous()
        result = source.new_empty(len(source), self.outputs, source.shape[2])
        for channel, target in zip(source, result, strict=True):
            for rows, columns, matrix in self.blocks:
                torch.mm(matrix, channel[columns], out=target[rows])
        return result


@dataclass(frozen=True, slots=True)
class Separable:
    """A linear map of images, along rows and columns by themselves. back: its transpose."""

    rows: Banded
    columns: Banded
    rows_back: Banded
    columns_back: Banded

    @classmethod
    def of(cls, rows: Matrix, columns: Matrix, like: Tensor) -> Separable:
        """rows (h, H): what rows are made of; columns (w, W)."""
        return cls(*(Banded.of(matrix, like) for matrix in (rows, columns, rows.T, columns.T)))

    def __call__(self, image: Tensor) -> Tensor:
        """Of an image (C, H, W): (C, h, w); differentiable."""
        result: Tensor = _Mapped.apply(image, self)  # pyright: ignore[reportAssignmentType]
        return result


class _Mapped(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, by: Separable) -> Tensor:
        ctx.by = by
        return by.rows.down(by.columns.across(image))

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None]:
        by: Separable = ctx.by
        return by.columns_back.across(by.rows_back.down(gradients[0])), None
