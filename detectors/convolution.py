"""Convolutions with constant weights.

In float32 on a CPU, weights are stored in oneDNN's layout, which saves a reorder per call, and sums and rectifiers
are fused into the convolution (`OneDnnWeights`). Images and all other weights are channels-last.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

_ONEDNN = torch.ops.mkldnn
_RELU_BACKWARD = torch.ops.aten.threshold_backward.grad_input
_LEAKY_RELU_BACKWARD = torch.ops.aten.leaky_relu_backward.grad_input
_MAX_SIZES = 1024
"""Input sizes remembered per layer, as many as oneDNN does."""
_MAX_LAYOUTS = 1 << 14
"""Layouts remembered in all: some 200 bytes each."""
_UNSET = slice(108, 112)
"""Bytes between dtype and padded sides in oneDNN's dnnl_memory_desc (64 bit)."""


class OneDnnWeights:
    """Weights (O, I, k, k) in the layouts that oneDNN prefers for the inputs seen so far.

    The layout depends on the input size and the number of threads. Given another layout, oneDNN reorders the
    weights in each call, which from one of its own layouts takes as long as the convolution itself. So each input
    size is queried once. A layer has two or three distinct layouts; each is stored once.
    """

    _layouts: ClassVar[dict[tuple[object, ...], bytes]] = {}
    """Layouts of all layers, by the shape of the weights and the input size."""

    def __init__(self, weight: Tensor) -> None:
        self.plain = to_channels_last(weight)
        self._by_size: dict[tuple[object, ...], Tensor] = {}
        self._by_layout: dict[bytes, Tensor] = {}

    @property
    def shape(self) -> torch.Size:
        return self.plain.shape

    @property
    def dtype(self) -> torch.dtype:
        return self.plain.dtype

    def for_input(self, x: Tensor, stride: int, padding: int) -> Tensor:
        """The weights in the layout for an input.

        Args:
            x: (B, I, h, w).
            stride: In both directions.
            padding: In both directions.
        """
        key = x.shape, stride, padding, torch.get_num_threads()
        weight = self._by_size.get(key)
        if weight is None:
            known = self._layouts.get((self.plain.shape, *key))  # of another layer of this shape
            weight = None if known is None else self._by_layout.get(known)
            if weight is None:
                weight = self._reorder(key)
            if len(self._by_size) >= _MAX_SIZES:
                self._by_size.clear()
            self._by_size[key] = weight
        return weight

    def _reorder(self, key: tuple[torch.Size, int, int, int]) -> Tensor:
        shape, stride, padding, _ = key
        reordered = _ONEDNN._reorder_convolution_weight(
            self.plain, [padding] * 2, [stride] * 2, [1, 1], 1, list(shape)
        )
        layout = _layout_key(reordered)
        if len(self._layouts) >= _MAX_LAYOUTS:
            self._layouts.clear()
        self._layouts[(self.plain.shape, *key)] = layout
        return self._by_layout.setdefault(layout, reordered)


def _layout_key(weight: Tensor) -> bytes:
    """oneDNN's description of a tensor's layout, without four bytes that are never set."""
    description = bytearray(_ONEDNN._get_mkldnn_serialized_md(weight).numpy().tobytes())
    description[_UNSET] = bytes(4)
    return bytes(description)


def order_weights(weight: Tensor) -> Tensor | OneDnnWeights:
    """Weights for `convolve`: with oneDNN's layouts where it applies, otherwise channels-last."""
    weight = to_channels_last(weight)
    if weight.device.type != "cpu" or weight.dtype != torch.float32 or not torch.backends.mkldnn.is_available():
        return weight
    return OneDnnWeights(weight)


def convolve(
    x: Tensor,
    weight: Tensor | OneDnnWeights,
    bias: Tensor | None = None,
    stride: int = 1,
    padding: int = 0,
    slope: float | None = None,
) -> Tensor:
    """Convolution, then optionally a rectifier.

    Args:
        x: (B, I, h, w).
        weight: (O, I, k, k), from `order_weights`.
        bias: (O,).
        stride: In both directions.
        padding: In both directions.
        slope: Negative slope of the rectifier; None for none.
    """
    if isinstance(weight, OneDnnWeights):
        after = "none" if slope is None else "leaky_relu" if slope else "relu"
        scalars = [slope] if slope else []
        result: Tensor = _ONEDNN._convolution_pointwise(
            x,
            weight.for_input(x, stride, padding),
            bias,
            [padding] * 2,
            [stride] * 2,
            [1, 1],
            1,
            after,
            scalars,
            "",
        )
        return result
    return rectify(F.conv2d(x, weight, bias, stride, padding), slope)


def convolve_add(
    total: Tensor,
    x: Tensor,
    weight: Tensor | OneDnnWeights,
    stride: int = 1,
    padding: int = 0,
    slope: float | None = None,
) -> Tensor:
    """Add a convolution to `total` in place, then optionally rectify.

    Args:
        total: (B, O, h', w').
        x: (B, I, h, w).
        weight: (O, I, k, k), from `order_weights`.
        stride: In both directions.
        padding: In both directions.
        slope: Negative slope of the rectifier; None for none.
    """
    if isinstance(weight, OneDnnWeights):
        after = "relu" if slope == 0 else None  # no other rectifier after a sum
        result: Tensor = _ONEDNN._convolution_pointwise_(
            total,
            x,
            weight.for_input(x, stride, padding),
            None,
            [padding] * 2,
            [stride] * 2,
            [1, 1],
            1,
            "add",
            1.0,
            after,
            [],
            None,
        )
        return rectify(result, None if slope == 0 else slope)
    total += F.conv2d(x, weight, None, stride, padding)
    return rectify(total, slope)


def gradient_weights(weight: Tensor, stride: int) -> Tensor:
    """Weights of the convolution that maps an output gradient to the input gradient of a strided convolution.

    For weights (O, I, k, k) it returns (stride * stride * I, O, m, m) with m = ceil(k / stride). Each output pixel
    holds the `stride` x `stride` input pixels from `stride` times its position on, row by row.
    """
    kernel = weight.shape[-1]
    more = -kernel % stride
    # Input row s * i + a gets its gradient through the kernel's row a + s * m from the convolved row i - m.
    taps = F.pad(weight, (0, more, 0, more)).unflatten(2, (-1, stride)).unflatten(4, (-1, stride))
    return taps.permute(3, 5, 1, 0, 2, 4).flatten(0, 2).flip(2, 3)  # of (O, I, m, a, n, b)


def mask_gradient(gradient: Tensor, rectified: Tensor, slope: float = 0.0) -> None:
    """Backpropagate through a rectifier in place.

    Args:
        gradient: (N, C, h, w), overwritten.
        rectified: The rectifier's output.
        slope: Its negative slope.
    """
    if slope == 0:
        _RELU_BACKWARD(gradient, rectified, 0, grad_input=gradient)
    else:
        _LEAKY_RELU_BACKWARD(gradient, rectified, slope, True, grad_input=gradient)


def empty_channels_last(shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """An uninitialised channels-last tensor.

    Args:
        shape: (B, C, h, w).
        dtype: Its type.
        device: Its device.
    """
    return torch.empty(tuple(shape), dtype=dtype, device=device, memory_format=torch.channels_last)


def to_channels_last(x: Tensor) -> Tensor:
    """The tensor in channels-last format."""
    return x.contiguous(memory_format=torch.channels_last)


def rectify(x: Tensor, slope: float | None) -> Tensor:
    """Rectify in place with this negative slope; None for no rectifier."""
    if slope is None:
        return x
    return x.relu_() if slope == 0 else F.leaky_relu_(x, slope)
