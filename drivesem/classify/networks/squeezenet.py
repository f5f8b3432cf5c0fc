"""SqueezeNet 1.1 (Iandola et al. 2016, arXiv:1602.07360) up to its last Fire module, and one layer on what that
finds anywhere. The names of its convolutions are those of SqueezeDet, which begins with the same ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.squeezedet import BGR_MEAN, Fire, SqueezeDet
from drivesem.classify.networks.base import Classifier

_FIRES = dict(list(SqueezeDet.layout.fires.items())[:8])
"""Up to fire9: what SqueezeDet has after that is its own."""


class SqueezeNet(Classifier):
    """Mean and maximum of the last maps go to the last layer."""

    architecture = "squeezenet"
    head = "classifier"
    published_head = "conv10"

    def __init__(self, classes: Sequence[str]) -> None:
        mean = [value / 255 for value in reversed(BGR_MEAN)]
        super().__init__(classes, mean, [1 / 255] * 3)
        channels = SqueezeDet.layout.channels
        self.conv1 = nn.Conv2d(3, channels, SqueezeDet.layout.kernel, 2)
        self.fires = nn.ModuleDict()
        for name, (squeeze, expand) in _FIRES.items():
            self.fires[name] = Fire(channels, squeeze, expand)
            channels = 2 * expand
        self.classifier = nn.Linear(2 * channels, len(self.classes))

    def encode(self, prepared: Tensor) -> Tensor:
        x = F.max_pool2d(F.relu(self.conv1(prepared.flip(1))), 3, 2, ceil_mode=True)  # its weights read BGR
        for name, fire in self.fires.items():
            x = fire(x)
            if name in SqueezeDet.layout.pooled:
                x = F.max_pool2d(x, 3, 2, ceil_mode=True)
        return torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)
