"""LPIPS 0.1 (Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, CVPR 2018).

Features of a classifier at several layers, each pixel's scaled to unit length; squared differences, weighed by a
learned non-negative number a channel, summed over channels, averaged over the picture, summed over layers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import resources

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from scene_ir import files
from scene_ir.errors import ShapeError
from tools.experiments.realism import networks
from tools.experiments.realism.networks import Trunk

TRUNKS: dict[str, Callable[[], Trunk]] = {
    "alex": networks.alexnet,
    "vgg": networks.vgg16,
    "squeeze": networks.squeezenet,
}
# Of the published code: pictures in [-1, 1] are brought to what torchvision's weights expect.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10
"""Of the published code, beside the length of a feature."""


def published_heads(net: str) -> list[Tensor]:
    """The learned weights (C,) of each layer of `alex`, `vgg` or `squeeze`, as published with LPIPS 0.1."""
    with resources.as_file(
        resources.files("tools.experiments.realism") / "weights" / "lpips-0.1.safetensors"
    ) as path:
        files.check_model_card(path, files.read_bytes(path))
        tensors = load_file(path)
    return [tensors[f"{net}.lin{i}"] for i in range(len(TRUNKS[net]().taps))]


class Lpips(nn.Module):
    """A distance of pictures; 0 for equal ones. heads: a weight (C,) for each channel of each of the trunk's taps.

    Raises ShapeError where the heads do not fit the trunk.
    """

    def __init__(self, trunk: Trunk, heads: Sequence[Tensor]) -> None:
        super().__init__()
        widths = tuple(head.numel() for head in heads)
        if widths != trunk.widths:
            raise ShapeError("LPIPS weights", f"{trunk.widths} channels", widths)
        self.trunk = trunk
        self.heads = nn.ParameterList([nn.Parameter(head.reshape(-1), requires_grad=False) for head in heads])
        self.register_buffer("shift", torch.tensor(_SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1))

    def features(self, images: Tensor) -> list[Tensor]:
        """Images (B, 3, H, W) RGB in [0, 1] -> unit features (B, C, h, w) a layer."""
        shift, scale = self.get_buffer("shift"), self.get_buffer("scale")
        found = self.trunk((2 * images - 1 - shift) / scale)
        return [x / (x.square().sum(dim=1, keepdim=True).sqrt() + _EPSILON) for x in found]

    def between(self, first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
        """Of two pictures' features -> (B,)."""
        layers = zip(first, second, self.heads, strict=True)
        parts = [((a - b).square() * w.view(1, -1, 1, 1)).sum(dim=1).mean(dim=(1, 2)) for a, b, w in layers]
        return torch.stack(parts).sum(dim=0)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Images (B, 3, H, W) RGB in [0, 1] -> distances (B,)."""
        return self.between(self.features(first), self.features(second))
