"""Convolutions with weights that stay as they are. In single precision on a CPU, weights lie as oneDNN wants them,
where each pass would order them anew, and sums and rectifiers are part of the convolution (`Ordered`). Images and
other weights are channels-last.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

_ONEDNN = torch.ops.mkldnn
_BACK_RELU = torch.ops.aten.threshold_backward.grad_input
_BACK_LEAKY = torch.ops.aten.leaky_relu_backward.grad_input
_MOST_SIZES = 1024
"""Sizes that a layer's weights remember, as many as oneDNN does."""
_UNSET = slice(108, 112)
"""Between dtype and padded sides (oneDNN's dnnl_memory_desc, 64 bit)."""


class Ordered:
    """Weights (O, I, k, k) in the order that oneDNN wants for the picture at hand.

    That depends on the picture's size, and on the number of threads. Given weights in another order, oneDNN lays
    them out anew at each call: from one of its own orders into another that takes as long as the convolution of a
    whole picture. So each size is asked about once. There are few orders, two or three of a layer, each kept
    once.
    """

    def __init__(self, weight: Tensor) -> None:
        self.plain = last(weight)
        self._of_size: dict[tuple[object, ...], Tensor] = {}
        self._of_order: dict[bytes, Tensor] = {}

    @property
    def shape(self) -> torch.Size:
        return self.plain.shape

    @property
    def dtype(self) -> torch.dtype:
        return self.plain.dtype

    def at(self, x: Tensor, stride: int, padding: int) -> Tensor:
        """Those for x (B, I, h, w)."""
        key = x.shape, stride, padding, torch.get_num_threads()
        found = self._of_size.get(key)
        if found is None:
            made = _ONEDNN._reorder_convolution_weight(
                self.plain, [padding] * 2, [stride] * 2, [1, 1], 1, list(x.shape)
            )
            if len(self._of_size) >= _MOST_SIZES:
                self._of_size.clear()
            found = self._of_size[key] = self._of_order.setdefault(_order(made), made)
        return found


def _order(weight: Tensor) -> bytes:
    """What tells oneDNN's orders apart: its description of a tensor, without four bytes that nobody sets."""
    told = bytearray(_ONEDNN._get_mkldnn_serialized_md(weight).numpy().tobytes())
    told[_UNSET] = bytes(4)
    return bytes(told)


def ordered(weight: Tensor) -> Tensor | Ordered:
    """Weights as `convolve` takes them: in oneDNN's own order where it computes, else channels-last."""
    weight = last(weight)
    if weight.device.type != "cpu" or weight.dtype != torch.float32 or not torch.backends.mkldnn.is_available():
        return weight
    return Ordered(weight)


def convolve(
    x: Tensor,
    weight: Tensor | Ordered,
    bias: Tensor | None = None,
    stride: int = 1,
    padding: int = 0,
    slope: float | None = None,
) -> Tensor:
    """slope: of a rectifier below 0 that comes after; None for none."""
    if isinstance(weight, Ordered):
        after = "none" if slope is None else "leaky_relu" if slope else "relu"
        scalars = [slope] if slope else []
        result: Tensor = _ONEDNN._convolution_pointwise(
            x, weight.at(x, stride, padding), bias, [padding] * 2, [stride] * 2, [1, 1], 1, after, scalars, ""
        )
        return result
    return rectified(F.conv2d(x, weight, bias, stride, padding), slope)


def convolve_onto(
    total: Tensor,
    x: Tensor,
    weight: Tensor | Ordered,
    stride: int = 1,
    padding: int = 0,
    slope: float | None = None,
) -> Tensor:
    """`total`, in place, plus a convolution; then the rectifier."""
    if isinstance(weight, Ordered):
        after = "relu" if slope == 0 else None  # no other rectifier after a sum
        result: Tensor = _ONEDNN._convolution_pointwise_(
            total,
            x,
            weight.at(x, stride, padding),
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
        return rectified(result, None if slope == 0 else slope)
    total += F.conv2d(x, weight, None, stride, padding)
    return rectified(total, slope)


def phases(weight: Tensor, stride: int) -> Tensor:
    """Weights (stride * stride * I, O, m, m) that take the gradient of a convolution's output to its input's, for
    weights (O, I, k, k): m is ceil(k / stride). Each place of theirs gives `stride` x `stride` of the input, row
    by row: those from `stride` times that place on.
    """
    kernel = weight.shape[-1]
    more = -kernel % stride
    # Input row s * i + a gets its gradient through the kernel's row a + s * m from the convolved row i - m.
    taps = F.pad(weight, (0, more, 0, more)).unflatten(2, (-1, stride)).unflatten(4, (-1, stride))
    return taps.permute(3, 5, 1, 0, 2, 4).flatten(0, 2).flip(2, 3)  # of (O, I, m, a, n, b)


def mask(gradient: Tensor, rectified: Tensor, slope: float = 0.0) -> None:
    """What a rectifier lets through of a gradient (N, C, h, w), in place, by what came out of it."""
    if slope == 0:
        _BACK_RELU(gradient, rectified, 0, grad_input=gradient)
    else:
        _BACK_LEAKY(gradient, rectified, slope, True, grad_input=gradient)


def empty(shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Channels-last."""
    return torch.empty(tuple(shape), dtype=dtype, device=device, memory_format=torch.channels_last)


def last(x: Tensor) -> Tensor:
    """The same, channels-last."""
    return x.contiguous(memory_format=torch.channels_last)


def rectified(x: Tensor, slope: float | None) -> Tensor:
    """In place, through a rectifier of that slope below 0, if any."""
    if slope is None:
        return x
    return x.relu_() if slope == 0 else F.leaky_relu_(x, slope)
