"""SqueezeDet with constant weights: the same output and image gradient at lower cost.

No weight gradients are prepared; the two expansions of a Fire are never concatenated, because the next layer
applies separate parts of its weights to them; rectifiers work in place and after pooling; and the full-resolution
first layers run, forward and backward, in bands of rows that fit the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from detectors.convolution import (
    OneDnnWeights,
    convolve,
    convolve_add,
    empty_channels_last,
    gradient_weights,
    mask_gradient,
    order_weights,
    to_channels_last,
)

BAND_ROWS = 24
"""Pooled rows per band of the first layers: at 1242 px, 64 channels before pooling take 8 MB, a server's cache."""

_MAX_POOL_BACKWARD = torch.ops.aten.max_pool2d_with_indices_backward


@dataclass(frozen=True, slots=True)
class FrozenConvolution:
    """A stride-1 convolution of odd size that preserves the image size; its input may come in parts along the
    channels.
    """

    weights: tuple[Tensor | OneDnnWeights, ...]
    """(out, part, k, k) for each part of the input channels, from `order_weights`."""
    back: tuple[Tensor | OneDnnWeights, ...]
    """Weights that map an output gradient to the gradient of each part, from `order_weights`."""
    bias: Tensor
    """(out,)."""

    def __call__(self, parts: Sequence[Tensor], rectify: bool = False) -> Tensor:
        reach, final, slope = self.weights[0].shape[-1] // 2, len(parts) - 1, 0.0 if rectify else None
        result = convolve(parts[0], self.weights[0], self.bias, padding=reach, slope=None if final else slope)
        for i, (part, weight) in enumerate(zip(parts[1:], self.weights[1:], strict=True), start=1):
            result = convolve_add(result, part, weight, padding=reach, slope=slope if i == final else None)
        return result

    def backward(self, gradient: Tensor) -> list[Tensor]:
        """The gradient of each part."""
        reach = self.weights[0].shape[-1] // 2
        return [convolve(gradient, weight, padding=reach) for weight in self.back]


@dataclass(frozen=True, slots=True)
class FrozenFire:
    """The two expansions of a Fire, an optional pooling, and the next layer: a squeeze, or ConvDet."""

    expansions: tuple[FrozenConvolution, FrozenConvolution]
    """1x1 and 3x3."""
    pools: bool
    """Whether a pooling follows the expansions."""
    following: FrozenConvolution
    """The next layer."""

    def backward(self, gradients: Sequence[Tensor]) -> Tensor:
        """The gradient of the expansions' common input, from one of each output."""
        first, second = self.expansions
        total = second.backward(gradients[1])[0]
        return convolve_add(total, gradients[0], first.back[0], padding=first.back[0].shape[-1] // 2)


@dataclass(frozen=True, slots=True)
class FirstLayers:
    """All layers up to the first squeeze."""

    mean: Tensor
    """(3, 1, 1) subtracted from RGB in [0, 1]."""
    weight: Tensor | OneDnnWeights
    """(C, 3, k, k), for RGB in [0, 1] minus the mean."""
    bias: Tensor
    """(C,)."""
    back: Tensor | OneDnnWeights
    """(12, C, (k + 1) / 2, (k + 1) / 2): the input gradient as 2 x 2 RGB pixels per convolved pixel."""
    following: FrozenConvolution
    """The first squeeze."""


@dataclass(frozen=True, slots=True)
class _BandTrace:
    """Saved for backward: one band of pooled rows of the first layers."""

    images: slice
    """Images of the batch."""
    top: int
    """First pooled row."""
    pooled: Tensor
    indices: Tensor
    convolved_shape: torch.Size


@dataclass(frozen=True, slots=True)
class _FireTrace:
    """Saved for backward: one `FrozenFire`."""

    squeezed: Tensor
    parts: tuple[Tensor, ...]
    indices: tuple[Tensor, ...]
    """Of the poolings, if any."""
    shape: torch.Size
    """Height and width before pooling."""


@dataclass(frozen=True, slots=True)
class FrozenSqueezeDet:
    """All layers, in the precision they compute in."""

    first_layers: FirstLayers
    """Layers up to the first squeeze."""
    fires: tuple[FrozenFire, ...]
    """The Fires in order."""
    stride: int
    """Image pixels per grid cell."""

    def __call__(self, images: Tensor) -> Tensor:
        """ConvDet's output (B, channels, ceil(H / 16), ceil(W / 16)) for images (B, 3, H, W), RGB in [0, 1]."""
        keep = torch.is_grad_enabled() and images.requires_grad
        output: Tensor = _FrozenFunction.apply(images, self, keep)  # pyright: ignore[reportAssignmentType]
        return output


def freeze_convolution(layer: nn.Conv2d, parts: Sequence[int], dtype: torch.dtype) -> FrozenConvolution:
    """A layer in frozen form.

    Args:
        layer: The convolution.
        parts: Input channels of each part.
        dtype: Precision.
    """
    assert layer.bias is not None
    weight = layer.weight.detach().to(dtype)
    weights = weight.split(list(parts), 1)
    return FrozenConvolution(
        weights=tuple(order_weights(part) for part in weights),
        back=tuple(order_weights(part.flip(2, 3).transpose(0, 1)) for part in weights),
        bias=layer.bias.detach().to(dtype),
    )


def leading_padding(kernel: int) -> int:
    """Rows above and columns left of the image that a stride-2 convolution of this size pads, as TensorFlow's SAME
    does: the smaller half of k - 2.
    """
    return (kernel - 2) // 2


def freeze_first_layers(
    layer: nn.Conv2d, bgr_mean: Sequence[float], following: FrozenConvolution, dtype: torch.dtype
) -> FirstLayers:
    """The first layers in frozen form.

    Args:
        layer: Convolution of odd size and stride 2 on BGR in 0..255 minus its mean.
        bgr_mean: That mean.
        following: The first squeeze.
        dtype: Precision.
    """
    assert layer.bias is not None
    weight = layer.weight.detach().flip(1) * 255
    back = gradient_weights(weight, 2)
    mean = weight.new_tensor(list(reversed(bgr_mean))) / 255
    return FirstLayers(
        mean=mean.view(3, 1, 1),
        weight=order_weights(weight.to(dtype)),
        bias=layer.bias.detach().to(dtype),
        back=order_weights(back.to(dtype)),
        following=following,
    )


class _FrozenFunction(torch.autograd.Function):
    """The whole network as one autograd function of the images."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, net: FrozenSqueezeDet, keep: bool) -> Tensor:
        with torch.autocast(images.device.type, enabled=False):
            x, bands = _forward_first_layers(net, images, keep)
            traces: list[_FireTrace] = []
            for stage in net.fires:
                squeezed, parts, indices = x, [], []
                shape = squeezed.shape[2:]
                for expansion in stage.expansions:
                    part = expansion([squeezed], rectify=not stage.pools)
                    if stage.pools:
                        part, index = _pool(part)
                        part.relu_()  # after pooling: the same result on a quarter of the pixels
                        indices.append(index)
                    parts.append(part)
                x = stage.following(parts, rectify=stage is not net.fires[-1])
                if keep:
                    traces.append(_FireTrace(squeezed, tuple(parts), tuple(indices), shape))
        ctx.net, ctx.bands, ctx.passed = net, bands, traces
        ctx.like = images.shape, images.dtype
        return x

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None]:
        net: FrozenSqueezeDet = ctx.net
        shape, dtype = ctx.like
        x = to_channels_last(gradients[0])
        scale = None
        if x.dtype == torch.float16:
            # Gradients of one confidence may lie below float16's smallest number, 6e-8: scale them to at most 1.
            scale = gradients[0].abs().amax().clamp_min(torch.finfo(torch.float16).tiny)
            x = x / scale
        with torch.autocast(x.device.type, enabled=False):
            for stage, traces in zip(reversed(net.fires), reversed(ctx.passed), strict=True):
                parts = stage.following.backward(x)
                for i, part in enumerate(parts):
                    mask_gradient(part, traces.parts[i])
                    if stage.pools:
                        parts[i] = _unpool(part, traces.indices[i], traces.shape)
                x = stage.backward(parts)
                mask_gradient(x, traces.squeezed)
            image = _backward_first_layers(net, x, ctx.bands, shape, dtype)
        return (image if scale is None else image * scale), None, None


def _forward_first_layers(net: FrozenSqueezeDet, images: Tensor, keep: bool) -> tuple[Tensor, list[_BandTrace]]:
    layers, dtype = net.first_layers, net.first_layers.weight.dtype
    batch, _, height, width = images.shape
    padded_h, padded_w = height + -height % net.stride, width + -width % net.stride
    # Padded beyond a multiple of the stride: see SqueezeDet.forward. Zero is the mean colour.
    kernel = layers.weight.shape[-1]
    before, beyond = leading_padding(kernel), kernel - 2
    x = empty_channels_last((batch, 3, padded_h + beyond, padded_w + beyond), dtype, images.device)
    x[:, :, :before] = 0
    x[:, :, before + height :] = 0
    x[:, :, before : before + height, :before] = 0
    x[:, :, before : before + height, before + width :] = 0
    torch.sub(images, layers.mean, out=x[:, :, before : before + height, before : before + width])
    convolved_rows = padded_h // 2
    squeezed = empty_channels_last(
        (batch, len(layers.following.bias), padded_h // 4, padded_w // 4), dtype=dtype, device=images.device
    )
    bands: list[_BandTrace] = []
    for several, top, bottom in _bands(batch, squeezed.shape[2], images.device):
        rows = min(2 * bottom + 1, convolved_rows) - 2 * top
        seen = x[several, :, 4 * top : 4 * top + 2 * rows + beyond]
        convolved = convolve(seen, layers.weight, layers.bias, stride=2)
        pooled, indices = _pool(convolved)
        squeezed[several, :, top:bottom] = layers.following([pooled[:, :, : bottom - top].relu_()], rectify=True)
        if keep:
            bands.append(_BandTrace(several, top, pooled, indices, convolved.shape))
    return squeezed, bands


def _backward_first_layers(
    net: FrozenSqueezeDet, gradient: Tensor, bands: Sequence[_BandTrace], shape: torch.Size, dtype: torch.dtype
) -> Tensor:
    """The image gradient (B, 3, H, W), channels-last, from that of the first squeeze's output."""
    layers = net.first_layers
    batch, _, rows, columns = gradient.shape
    before, reach = leading_padding(layers.weight.shape[-1]), layers.back.shape[-1] - 1
    image = gradient.new_zeros((batch, 4 * rows + 2 * reach, 4 * columns + 2 * reach, 3), dtype=dtype)
    for band in bands:
        bottom = band.top + band.pooled.shape[2]
        (pooled,) = layers.following.backward(gradient[band.images, :, band.top : bottom])
        mask_gradient(pooled, band.pooled)
        convolved = _unpool(pooled, band.indices, band.convolved_shape[2:])
        quads = convolve(convolved, layers.back, padding=reach).permute(0, 2, 3, 1)  # (b, h, w, 2 * 2 * 3)
        into = image[band.images, 4 * band.top : 4 * band.top + 2 * quads.shape[1]]
        into = into.unflatten(1, (-1, 2)).unflatten(3, (-1, 2))  # (b, h, 2, w, 2, 3)
        into += quads.unflatten(3, (2, 2, 3)).transpose(2, 3)
    return image[:, before : before + shape[2], before : before + shape[3]].permute(0, 3, 1, 2)


def _bands(batch: int, rows: int, device: torch.device) -> Iterator[tuple[slice, int, int]]:
    """Images, first and last row (exclusive) of each band."""
    if device.type != "cpu":
        yield slice(0, batch), 0, rows
        return
    for image in range(batch):
        for top in range(0, rows, BAND_ROWS):
            yield slice(image, image + 1), top, min(top + BAND_ROWS, rows)


def _pool(x: Tensor) -> tuple[Tensor, Tensor]:
    pooled, indices = F.max_pool2d_with_indices(x, [3, 3], stride=[2, 2], ceil_mode=True)
    return pooled, indices


def _unpool(gradient: Tensor, indices: Tensor, image_hw: torch.Size) -> Tensor:
    before = empty_channels_last((*gradient.shape[:2], *image_hw), gradient.dtype, gradient.device)
    result: Tensor = _MAX_POOL_BACKWARD(gradient, before, [3, 3], [2, 2], [0, 0], [1, 1], True, indices)
    return result
