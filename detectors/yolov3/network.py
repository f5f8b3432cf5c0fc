"""The network of a `.cfg`: for training, and with folded normalisation for frozen weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.yolov3.cfg import (
    ConvolutionLayer,
    DarknetCfg,
    MaxPoolLayer,
    RouteLayer,
    ShortcutLayer,
    UpsampleLayer,
    YoloHead,
)

SLOPE = 0.1
"""Negative slope of Darknet's leaky rectifier."""
EPSILON = 1e-5
"""Added to the batch variance."""
MOMENTUM = 0.03
"""Share of a batch in the running statistics: Darknet's 0.01 is too slow for a few thousand steps."""


class ConvolutionBlock(nn.Module):
    """A convolution, then optionally normalisation and a leaky rectifier."""

    def __init__(self, layer: ConvolutionLayer, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(
            channels, layer.filters, layer.size, layer.stride, layer.padding, bias=not layer.normalised
        )
        self.norm = nn.BatchNorm2d(layer.filters, EPSILON, MOMENTUM) if layer.normalised else None
        self.leaky = layer.leaky

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        if self.norm is not None:
            x = self.norm(x)
        return F.leaky_relu(x, SLOPE, inplace=True) if self.leaky else x

    def fold(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Weight and bias of the equivalent single convolution in eval mode."""
        weight, bias = self.conv.weight, self.conv.bias
        norm = self.norm
        if norm is not None:
            assert norm.running_mean is not None
            assert norm.running_var is not None
            scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
            weight = weight * scale[:, None, None, None]
            bias = norm.bias - norm.running_mean * scale
        assert bias is not None
        return weight.to(dtype).contiguous(memory_format=torch.channels_last), bias.to(dtype)


class DarknetNetwork(nn.Module):
    """A trainable network; `layers` holds a block for each convolution, by its number in the file."""

    def __init__(self, cfg: DarknetCfg) -> None:
        super().__init__()
        self.cfg = cfg
        self.layers = nn.ModuleDict()
        for i, layer in enumerate(cfg.layers):
            if isinstance(layer, ConvolutionLayer):
                self.layers[str(i)] = ConvolutionBlock(layer, cfg.channels[i - 1] if i else 3)

    @property
    def blocks(self) -> dict[int, ConvolutionBlock]:
        """The convolutions by number, in the file's order."""
        return {int(name): block for name, block in self.layers.items() if isinstance(block, ConvolutionBlock)}

    def forward(self, x: Tensor) -> list[Tensor]:
        """x (B, 3, H, W), sides multiples of `cfg.stride`, to (B, anchors * (5 + C), h, w) for each head."""
        blocks = self.blocks
        return run_layers(self.cfg, x, lambda i, x: blocks[i](x))

    @torch.no_grad()
    def fold(self, dtype: torch.dtype) -> FoldedNetwork:
        """The network in eval mode with its present weights."""
        return FoldedNetwork(self.cfg, {i: block.fold(dtype) for i, block in self.blocks.items()})


@dataclass(frozen=True, slots=True)
class FoldedNetwork:
    """A network with normalisation folded into the convolutions; without weight gradients."""

    cfg: DarknetCfg
    """Its description."""
    weights: dict[int, tuple[Tensor, Tensor]]
    """Weight and bias by layer number."""

    def __call__(self, x: Tensor) -> list[Tensor]:
        """As `DarknetNetwork.forward`; x has the weights' dtype."""
        return run_layers(self.cfg, x, self._convolve)

    def _convolve(self, i: int, x: Tensor) -> Tensor:
        layer = self.cfg.layers[i]
        assert isinstance(layer, ConvolutionLayer)
        x = F.conv2d(x, *self.weights[i], layer.stride, layer.padding)
        return F.leaky_relu_(x, SLOPE) if layer.leaky else x


def run_layers(cfg: DarknetCfg, x: Tensor, convolve: Callable[[int, Tensor], Tensor]) -> list[Tensor]:
    """The input of each head.

    Args:
        cfg: The network.
        x: (B, 3, H, W).
        convolve: Applies the convolution of this number.
    """
    last_use = _last_uses(cfg)
    stored: dict[int, Tensor] = {}
    head_inputs = []
    for i, layer in enumerate(cfg.layers):
        match layer:
            case ConvolutionLayer():
                x = convolve(i, x)
            case MaxPoolLayer():
                x = _max_pool(x, layer)
            case RouteLayer():
                parts = [stored[k] for k in layer.layers]
                x = parts[0] if len(parts) == 1 else torch.cat(parts, 1)
            case ShortcutLayer():
                x = x + stored[layer.layer]
            case UpsampleLayer():
                x = F.interpolate(x, scale_factor=float(layer.factor), mode="nearest")
            case YoloHead():
                head_inputs.append(x)
        for k in [k for k in stored if last_use[k] <= i]:
            del stored[k]
        if last_use.get(i, i) > i:
            stored[i] = x
    return head_inputs


def _last_uses(cfg: DarknetCfg) -> dict[int, int]:
    """The last layer that uses each output beyond the next layer."""
    last_use: dict[int, int] = {}
    for i, layer in enumerate(cfg.layers):
        used = (
            layer.layers
            if isinstance(layer, RouteLayer)
            else (layer.layer,)
            if isinstance(layer, ShortcutLayer)
            else ()
        )
        last_use.update(dict.fromkeys(used, i))
    return last_use


def _max_pool(x: Tensor, layer: MaxPoolLayer) -> Tensor:
    # Darknet pads by size - 1 in total, the odd one right and below, with -inf. Sides are multiples of the stride,
    # so windows no larger than the stride never reach the padding.
    before = (layer.size - 1) // 2
    after = layer.size - 1 - before
    if before or layer.size > layer.stride:
        x = F.pad(x, (before, after, before, after), value=-torch.inf)
    return F.max_pool2d(x, layer.size, layer.stride)
