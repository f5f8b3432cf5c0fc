"""Tensors handed to kernels: what Warp itself makes of them, and of which it is asked only once."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor

from scene_ir.raster import launch
from scene_ir.raster.launch import array


def told(values: Tensor, dtype: Any = None) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Address, dimensions, shape and strides, as ours and as Warp's own."""
    made = array(values, dtype)
    expected: Any = wp.from_torch(values.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
    fields = [(one.data, one.ndim, list(one.shape), list(one.strides)) for one in (made, expected)]
    assert made.grad == 0
    return fields[0], fields[1]


@pytest.mark.parametrize(
    ("shape", "torch_dtype", "dtype"),
    [
        ((7,), torch.float32, None), ((7,), torch.int64, wp.uint64), ((7, 4), torch.int32, wp.vec4i),
        ((7, 3, 3), torch.float64, wp.mat33d), ((7, 4), torch.int64, None), ((7, 3, 4), torch.float32, wp.vec4f),
        ((3,), torch.float32, wp.vec3f), ((), torch.float32, None),
    ],
)  # fmt: skip
def test_arrays_are_those_that_warp_makes(
    shape: tuple[int, ...], torch_dtype: torch.dtype, dtype: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of other lengths too, and of parts of a tensor; whether they were seen before or not."""
    monkeypatch.setattr(launch, "_array_templates", {})
    for rows in (7, 2, 1, 0, 9):
        values = torch.zeros(rows, *shape[1:], dtype=torch_dtype) if len(shape) else torch.zeros(shape)
        if shape == (3,):  # one vector
            values = torch.zeros(3)
        ours, expected = told(values, dtype)
        assert ours == expected
        if values.ndim and rows > 2:
            ours, expected = told(values[1:], dtype) if shape != (3,) else told(values, dtype)
            assert ours == expected


def test_tensors_that_do_not_lie_in_rows_are_never_taken_for_those_that_do() -> None:
    rows = torch.zeros(6, 4)
    array(rows)
    for values in (rows.T.contiguous().T, torch.zeros(12, 4)[::2]):
        ours, expected = told(values)
        assert ours == expected


def test_an_array_keeps_its_tensor() -> None:
    array(torch.zeros(5))
    made = array(torch.full((5,), 3.0))
    assert made._ref.tolist() == [3.0] * 5
