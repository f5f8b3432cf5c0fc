"""Convolutions with constant weights against torch's own, for inputs of several sizes."""

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
def test_equals_torch_for_all_sizes(kernel: int, inputs: int, outputs: int) -> None:
    weight, bias, reach = numbers(outputs, inputs, kernel, kernel), torch.linspace(-1, 1, outputs), kernel // 2
    ordered = order_weights(weight)
    for height, width in SIZES:
        x = numbers(1, inputs, height, width)
        expected = F.conv2d(x, weight, bias, padding=reach)
        atol = 1e-5 * float(expected.abs().max())
        torch.testing.assert_close(convolve(x, ordered, bias, padding=reach), expected, atol=atol, rtol=1e-5)
        found = convolve(x, ordered, bias, padding=reach, slope=0.0)
        torch.testing.assert_close(found, expected.relu(), atol=atol, rtol=1e-5)
        found = convolve_add(torch.ones_like(expected), x, ordered, padding=reach)
        torch.testing.assert_close(found, F.conv2d(x, weight, padding=reach) + 1, atol=atol, rtol=1e-5)


@needs_onednn
def test_each_size_is_queried_once_and_each_layout_stored_once(monkeypatch: pytest.MonkeyPatch) -> None:
    queried = []
    order = convolving._layout_key

    def counted(weight: Tensor) -> bytes:
        queried.append(weight)
        return order(weight)

    monkeypatch.setattr(convolving, "_layout_key", counted)
    ordered = order_weights(numbers(64, 32, 3, 3))
    assert isinstance(ordered, OneDnnWeights)
    for size in SIZES * 3:
        convolve(numbers(1, 32, *size), ordered, padding=1)
    assert len(queried) == len(set(SIZES))
    stored = {id(weight) for weight in ordered._by_size.values()}
    assert len(stored) == len(ordered._by_layout) <= 3
    for weight, size in zip(
        queried, dict.fromkeys(SIZES), strict=True
    ):  # what is given is what that size asked for
        assert order(ordered.for_input(numbers(1, 32, *size), 1, 1)) == order(weight)


@needs_onednn
def test_number_of_remembered_sizes_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convolving, "_MAX_SIZES", 4)
    ordered = order_weights(numbers(4, 3, 3, 3))
    assert isinstance(ordered, OneDnnWeights)
    for side in range(3, 14):
        x = numbers(1, 3, side, side)
        torch.testing.assert_close(convolve(x, ordered, padding=1), F.conv2d(x, ordered.plain, padding=1))
        assert len(ordered._by_size) <= 4


def test_other_precisions_are_unchanged() -> None:
    for dtype in (torch.float64, torch.bfloat16):
        weight = numbers(4, 3, 3, 3).to(dtype)
        ordered = order_weights(weight)
        assert isinstance(ordered, Tensor)
        assert torch.equal(ordered, weight)
