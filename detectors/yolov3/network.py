"""A network from its `.cfg`: as it is trained, and folded for when its weights stay as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.yolov3.cfg import Cfg, Convolution, Head, MaxPool, Route, Shortcut, Upsample

SLOPE = 0.1
"""Of Darknet's leaky rectifier below 0."""
EPSILON = 1e-5
"""Added to the variance of a batch."""
MOMENTUM = 0.03
"""Share of a batch in the running mean and variance: Darknet's is 0.01, too slow for some thousand steps."""


class Block(nn.Module):
    """Convolution, then normalisation and leaky rectifier where the file says so."""

    def __init__(self, layer: Convolution, channels: int) -> None:
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

    def folded(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Weight and bias of the one convolution that this block is in eval mode."""
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


class Network(nn.Module):
    """layers: a Block for each convolution, under its number in the file; other layers have no weights."""

    def __init__(self, cfg: Cfg) -> None:
        super().__init__()
        self.cfg = cfg
        self.layers = nn.ModuleDict()
        for i, layer in enumerate(cfg.layers):
            if isinstance(layer, Convolution):
                self.layers[str(i)] = Block(layer, cfg.channels[i - 1] if i else 3)

    @property
    def blocks(self) -> dict[int, Block]:
        """The convolutions by their number, in the file's order."""
        return {int(name): block for name, block in self.layers.items() if isinstance(block, Block)}

    def forward(self, x: Tensor) -> list[Tensor]:
        """x (B, 3, H, W), sides multiples of `cfg.stride` -> for each head (B, anchors * (5 + C), h, w)."""
        blocks = self.blocks
        return run(self.cfg, x, lambda i, x: blocks[i](x))

    @torch.no_grad()
    def folded(self, dtype: torch.dtype) -> Folded:
        """The network in eval mode with the weights as they are now."""
        return Folded(self.cfg, {i: block.folded(dtype) for i, block in self.blocks.items()})


@dataclass(frozen=True, slots=True)
class Folded:
    """Convolutions that took in their normalisation: layer number -> weight, bias, without a gradient."""

    cfg: Cfg
    weights: dict[int, tuple[Tensor, Tensor]]

    def __call__(self, x: Tensor) -> list[Tensor]:
        """As `Network.forward`; x of the weights' dtype."""
        return run(self.cfg, x, self._convolve)

    def _convolve(self, i: int, x: Tensor) -> Tensor:
        layer = self.cfg.layers[i]
        assert isinstance(layer, Convolution)
        x = F.conv2d(x, *self.weights[i], layer.stride, layer.padding)
        return F.leaky_relu_(x, SLOPE) if layer.leaky else x


def run(cfg: Cfg, x: Tensor, convolve: Callable[[int, Tensor], Tensor]) -> list[Tensor]:
    """What goes into each head. convolve: the convolution of that number on its input."""
    last = _last_uses(cfg)
    kept: dict[int, Tensor] = {}
    found = []
    for i, layer in enumerate(cfg.layers):
        match layer:
            case Convolution():
                x = convolve(i, x)
            case MaxPool():
                x = _max_pool(x, layer)
            case Route():
                parts = [kept[k] for k in layer.layers]
                x = parts[0] if len(parts) == 1 else torch.cat(parts, 1)
            case Shortcut():
                x = x + kept[layer.layer]
            case Upsample():
                x = F.interpolate(x, scale_factor=float(layer.factor), mode="nearest")
            case Head():
                found.append(x)
        for k in [k for k in kept if last[k] <= i]:
            del kept[k]
        if last.get(i, i) > i:
            kept[i] = x
    return found


def _last_uses(cfg: Cfg) -> dict[int, int]:
    """Of each layer that another than the next one asks for: the last that does."""
    last: dict[int, int] = {}
    for i, layer in enumerate(cfg.layers):
        asked = layer.layers if isinstance(layer, Route) else (layer.layer,) if isinstance(layer, Shortcut) else ()
        last.update(dict.fromkeys(asked, i))
    return last


def _max_pool(x: Tensor, layer: MaxPool) -> Tensor:
    # Darknet pads by size - 1 in all, the odd one right and below, with what no maximum takes. Sides are multiples
    # of the stride: windows that begin inside and are no larger than it never meet that.
    before = (layer.size - 1) // 2
    after = layer.size - 1 - before
    if before or layer.size > layer.stride:
        x = F.pad(x, (before, after, before, after), value=-torch.inf)
    return F.max_pool2d(x, layer.size, layer.stride)
