"""SqueezeDet with weights that stay as they are: the same numbers, and the gradient to the images, at less cost.

An attack runs the detector thousands of times and never changes it. So here no gradient of a weight is prepared;
what two expansions of a Fire give is never joined, because the next layer takes each of them by its own part of
the weights; rectifiers work in place, and after pooling; and the full-resolution stem runs in bands of rows that
stay in the processor's cache, backwards too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from detectors.convolving import Ordered, convolve, convolve_onto, empty, last, mask, ordered, phases

BAND_ROWS = 24
"""Pooled rows a band of the stem: at 1242 px its 64 convolved channels take 8 MB, which a server's cache holds."""

_BACK_POOL = torch.ops.aten.max_pool2d_with_indices_backward


@dataclass(frozen=True, slots=True)
class Convolution:
    """A convolution of odd size, stride 1, that keeps the image's size. Its input may come in parts.

    weights: one (out, part, k, k) for each part of the input channels; back: the weights that take a gradient of
    the output to one of each part. Both as `ordered` has them.
    """

    weights: tuple[Tensor | Ordered, ...]
    back: tuple[Tensor | Ordered, ...]
    bias: Tensor

    def __call__(self, parts: Sequence[Tensor], rectify: bool = False) -> Tensor:
        reach, final, slope = self.weights[0].shape[-1] // 2, len(parts) - 1, 0.0 if rectify else None
        result = convolve(parts[0], self.weights[0], self.bias, padding=reach, slope=None if final else slope)
        for i, (part, weight) in enumerate(zip(parts[1:], self.weights[1:], strict=True), start=1):
            result = convolve_onto(result, part, weight, padding=reach, slope=slope if i == final else None)
        return result

    def backward(self, gradient: Tensor) -> list[Tensor]:
        """The gradient to each part."""
        reach = self.weights[0].shape[-1] // 2
        return [convolve(gradient, weight, padding=reach) for weight in self.back]


@dataclass(frozen=True, slots=True)
class Stage:
    """The two expansions of a Fire, a pooling where there is one, and what comes next: squeeze, or ConvDet."""

    expansions: tuple[Convolution, Convolution]
    pools: bool
    following: Convolution

    def backward(self, gradients: Sequence[Tensor]) -> Tensor:
        """The gradient to what both expansions take, of one to each of their outputs."""
        first, second = self.expansions
        total = second.backward(gradients[1])[0]
        return convolve_onto(total, gradients[0], first.back[0], padding=first.back[0].shape[-1] // 2)


@dataclass(frozen=True, slots=True)
class Stem:
    """Everything up to the first squeeze. mean (3, 1, 1): of RGB in [0, 1]; weight (C, 3, k, k), for what is left
    of the pixels; back (12, C, (k + 1) / 2, (k + 1) / 2): its gradient, as the four pixels of RGB that a convolved
    one begins with.
    """

    mean: Tensor
    weight: Tensor | Ordered
    bias: Tensor
    back: Tensor | Ordered
    following: Convolution


@dataclass(frozen=True, slots=True)
class _Band:
    """What the way back needs of rows `top`, `top + 1`, ... of some images' pooled stem."""

    images: slice
    top: int
    pooled: Tensor
    indices: Tensor
    convolved_shape: torch.Size


@dataclass(frozen=True, slots=True)
class _Passed:
    """What the way back needs of a stage. indices: of the poolings, if any; shape: of the channels before them."""

    squeezed: Tensor
    parts: tuple[Tensor, ...]
    indices: tuple[Tensor, ...]
    shape: torch.Size


@dataclass(frozen=True, slots=True)
class FrozenNet:
    """The layers, in the precision they compute in."""

    stem: Stem
    stages: tuple[Stage, ...]
    stride: int

    def __call__(self, images: Tensor) -> Tensor:
        """ConvDet's output (B, channels, ceil(H / 16), ceil(W / 16)) for images (B, 3, H, W), RGB in [0, 1]."""
        keep = torch.is_grad_enabled() and images.requires_grad
        output: Tensor = _Frozen.apply(images, self, keep)  # pyright: ignore[reportAssignmentType]
        return output


def convolution(layer: nn.Conv2d, parts: Sequence[int], dtype: torch.dtype) -> Convolution:
    """A layer as it is needed here. parts: how many input channels come in each part."""
    assert layer.bias is not None
    weight = layer.weight.detach().to(dtype)
    weights = weight.split(list(parts), 1)
    return Convolution(
        weights=tuple(ordered(part) for part in weights),
        back=tuple(ordered(part.flip(2, 3).transpose(0, 1)) for part in weights),
        bias=layer.bias.detach().to(dtype),
    )


def rows_before(kernel: int) -> int:
    """Rows above and columns to the left of the image that a convolution of that size and stride 2 begins with, as
    TensorFlow's SAME has them: of k - 2 in all, the smaller half.
    """
    return (kernel - 2) // 2


def stem(layer: nn.Conv2d, bgr_mean: Sequence[float], following: Convolution, dtype: torch.dtype) -> Stem:
    """The stem of a convolution of odd size and stride 2 that wants BGR in 0..255 less its mean."""
    assert layer.bias is not None
    weight = layer.weight.detach().flip(1) * 255
    back = phases(weight, 2)
    mean = weight.new_tensor(list(reversed(bgr_mean))) / 255
    return Stem(
        mean=mean.view(3, 1, 1),
        weight=ordered(weight.to(dtype)),
        bias=layer.bias.detach().to(dtype),
        back=ordered(back.to(dtype)),
        following=following,
    )


class _Frozen(torch.autograd.Function):
    """The whole network as one function of the images."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, net: FrozenNet, keep: bool) -> Tensor:
        with torch.autocast(images.device.type, enabled=False):
            x, bands = _through_stem(net, images, keep)
            passed: list[_Passed] = []
            for stage in net.stages:
                squeezed, parts, indices = x, [], []
                shape = squeezed.shape[2:]
                for expansion in stage.expansions:
                    part = expansion([squeezed], rectify=not stage.pools)
                    if stage.pools:
                        part, index = _pool(part)
                        part.relu_()  # after pooling: the same, of a quarter of the pixels
                        indices.append(index)
                    parts.append(part)
                x = stage.following(parts, rectify=stage is not net.stages[-1])
                if keep:
                    passed.append(_Passed(squeezed, tuple(parts), tuple(indices), shape))
        ctx.net, ctx.bands, ctx.passed = net, bands, passed
        ctx.like = images.shape, images.dtype
        return x

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None]:
        net: FrozenNet = ctx.net
        shape, dtype = ctx.like
        x = last(gradients[0])
        scale = None
        if x.dtype == torch.float16:
            # Its smallest number is 6e-8, and gradients of one confidence are smaller: carry them relative to 1.
            scale = gradients[0].abs().amax().clamp_min(torch.finfo(torch.float16).tiny)
            x = x / scale
        with torch.autocast(x.device.type, enabled=False):
            for stage, passed in zip(reversed(net.stages), reversed(ctx.passed), strict=True):
                parts = stage.following.backward(x)
                for i, part in enumerate(parts):
                    mask(part, passed.parts[i])
                    if stage.pools:
                        parts[i] = _unpool(part, passed.indices[i], passed.shape)
                x = stage.backward(parts)
                mask(x, passed.squeezed)
            image = _back_through_stem(net, x, ctx.bands, shape, dtype)
        return (image if scale is None else image * scale), None, None


def _through_stem(net: FrozenNet, images: Tensor, keep: bool) -> tuple[Tensor, list[_Band]]:
    layers, dtype = net.stem, net.stem.weight.dtype
    batch, _, height, width = images.shape
    padded_h, padded_w = height + -height % net.stride, width + -width % net.stride
    # More rows and columns than a multiple of the stride: see SqueezeDet.forward. Zero is the mean colour.
    kernel = layers.weight.shape[-1]
    before, beyond = rows_before(kernel), kernel - 2
    x = empty((batch, 3, padded_h + beyond, padded_w + beyond), dtype, images.device)
    x[:, :, :before] = 0
    x[:, :, before + height :] = 0
    x[:, :, before : before + height, :before] = 0
    x[:, :, before : before + height, before + width :] = 0
    torch.sub(images, layers.mean, out=x[:, :, before : before + height, before : before + width])
    convolved_rows = padded_h // 2
    squeezed = empty(
        (batch, len(layers.following.bias), padded_h // 4, padded_w // 4), dtype=dtype, device=images.device
    )
    bands: list[_Band] = []
    for several, top, bottom in _bands(batch, squeezed.shape[2], images.device):
        rows = min(2 * bottom + 1, convolved_rows) - 2 * top
        seen = x[several, :, 4 * top : 4 * top + 2 * rows + beyond]
        convolved = convolve(seen, layers.weight, layers.bias, stride=2)
        pooled, indices = _pool(convolved)
        squeezed[several, :, top:bottom] = layers.following([pooled[:, :, : bottom - top].relu_()], rectify=True)
        if keep:
            bands.append(_Band(several, top, pooled, indices, convolved.shape))
    return squeezed, bands


def _back_through_stem(
    net: FrozenNet, gradient: Tensor, bands: Sequence[_Band], shape: torch.Size, dtype: torch.dtype
) -> Tensor:
    """The gradient to the images (B, 3, H, W), stored channels-last, of one to the first squeeze's output."""
    layers = net.stem
    batch, _, rows, columns = gradient.shape
    before, reach = rows_before(layers.weight.shape[-1]), layers.back.shape[-1] - 1
    image = gradient.new_zeros((batch, 4 * rows + 2 * reach, 4 * columns + 2 * reach, 3), dtype=dtype)
    for band in bands:
        bottom = band.top + band.pooled.shape[2]
        (pooled,) = layers.following.backward(gradient[band.images, :, band.top : bottom])
        mask(pooled, band.pooled)
        convolved = _unpool(pooled, band.indices, band.convolved_shape[2:])
        quads = convolve(convolved, layers.back, padding=reach).permute(0, 2, 3, 1)  # (b, h, w, 2 * 2 * 3)
        into = image[band.images, 4 * band.top : 4 * band.top + 2 * quads.shape[1]]
        into = into.unflatten(1, (-1, 2)).unflatten(3, (-1, 2))  # (b, h, 2, w, 2, 3)
        into += quads.unflatten(3, (2, 2, 3)).transpose(2, 3)
    return image[:, before : before + shape[2], before : before + shape[3]].permute(0, 3, 1, 2)


def _bands(batch: int, rows: int, device: torch.device) -> Iterator[tuple[slice, int, int]]:
    """Images, first and last row (exclusive) of what goes through the stem at once."""
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
    before = empty((*gradient.shape[:2], *image_hw), gradient.dtype, gradient.device)
    result: Tensor = _BACK_POOL(gradient, before, [3, 3], [2, 2], [0, 0], [1, 1], True, indices)
    return result
