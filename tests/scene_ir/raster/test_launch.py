"""Tensors as kernel arrays: equal to Warp's own, which are computed once per kind."""

from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor

from scene_ir.raster import launch
from scene_ir.raster.launch import array


def describe_arrays(values: Tensor, dtype: Any = None) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Address, dimensions, shape and strides of our array and of Warp's."""
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
def test_arrays_equal_those_of_warp(
    shape: tuple[int, ...], torch_dtype: torch.dtype, dtype: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For other lengths and slices too, and with or without a template."""
    monkeypatch.setattr(launch, "_array_templates", {})
    for rows in (7, 2, 1, 0, 9):
        values = torch.zeros(rows, *shape[1:], dtype=torch_dtype) if len(shape) else torch.zeros(shape)
        if shape == (3,):  # one vector
            values = torch.zeros(3)
        ours, expected = describe_arrays(values, dtype)
        assert ours == expected
        if values.ndim and rows > 2:
            ours, expected = (
                describe_arrays(values[1:], dtype) if shape != (3,) else describe_arrays(values, dtype)
            )
            assert ours == expected


def test_strided_tensors_do_not_use_a_contiguous_template() -> None:
    rows = torch.zeros(6, 4)
    array(rows)
    for values in (rows.T.contiguous().T, torch.zeros(12, 4)[::2]):
        ours, expected = describe_arrays(values)
        assert ours == expected


def test_an_array_keeps_its_tensor_alive() -> None:
    array(torch.zeros(5))
    made = array(torch.full((5,), 3.0))
    assert made._ref.tolist() == [3.0] * 5
