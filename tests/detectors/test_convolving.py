"""Convolutions with weights that stay, against torch's own: each size in the order that oneDNN wants for it."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from detectors import convolution as convolving
from detectors.convolution import OneDnnWeights, convolve, convolve_add, order_weights

needs_onednn = pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="torch without oneDNN")
SIZES = ((24, 78), (8, 26), (12, 40), (3, 5), (10, 61), (24, 78))


def numbers(*shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(len(shape))
    return torch.randn(shape, generator=generator).contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("kernel", [1, 3])
@pytest.mark.parametrize(("inputs", "outputs"), [(64, 256), (96, 20), (16, 3)])
def test_each_size_gives_what_torch_gives(kernel: int, inputs: int, outputs: int) -> None:
    weight, bias, reach = numbers(outputs, inputs, kernel, kernel), torch.linspace(-1, 1, outputs), kernel // 2
    made = order_weights(weight)
    for height, width in SIZES:
        x = numbers(1, inputs, height, width)
        expected = F.conv2d(x, weight, bias, padding=reach)
        atol = 1e-5 * float(expected.abs().max())
        torch.testing.assert_close(convolve(x, made, bias, padding=reach), expected, atol=atol, rtol=1e-5)
        found = convolve(x, made, bias, padding=reach, slope=0.0)
        torch.testing.assert_close(found, expected.relu(), atol=atol, rtol=1e-5)
        found = convolve_add(torch.ones_like(expected), x, made, padding=reach)
        torch.testing.assert_close(found, F.conv2d(x, weight, padding=reach) + 1, atol=atol, rtol=1e-5)


@needs_onednn
def test_a_size_is_asked_about_once_and_an_order_is_kept_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    order = convolving._layout_key

    def counted(weight: Tensor) -> bytes:
        asked.append(weight)
        return order(weight)

    monkeypatch.setattr(convolving, "_layout_key", counted)
    made = order_weights(numbers(64, 32, 3, 3))
    assert isinstance(made, OneDnnWeights)
    for size in SIZES * 3:
        convolve(numbers(1, 32, *size), made, padding=1)
    assert len(asked) == len(set(SIZES))
    kept = {id(weight) for weight in made._by_size.values()}
    assert len(kept) == len(made._by_layout) <= 3
    for weight, size in zip(asked, dict.fromkeys(SIZES), strict=True):  # what is given is what that size asked for
        assert order(made.for_input(numbers(1, 32, *size), 1, 1)) == order(weight)


@needs_onednn
def test_no_more_sizes_are_remembered_than_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convolving, "_MAX_SIZES", 4)
    made = order_weights(numbers(4, 3, 3, 3))
    assert isinstance(made, OneDnnWeights)
    for side in range(3, 14):
        x = numbers(1, 3, side, side)
        torch.testing.assert_close(convolve(x, made, padding=1), F.conv2d(x, made.plain, padding=1))
        assert len(made._by_size) <= 4


def test_other_precisions_stay_as_they_are() -> None:
    for dtype in (torch.float64, torch.bfloat16):
        weight = numbers(4, 3, 3, 3).to(dtype)
        made = order_weights(weight)
        assert isinstance(made, Tensor)
        assert torch.equal(made, weight)
