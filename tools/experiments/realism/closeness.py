"""How near two pictures look."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from detectors.registry import load_detector
from detectors.squeezedet import BGR_MEAN, SqueezeDet
from scene_ir.errors import ShapeError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

PERCEPTUAL = "perceptual distance (SqueezeDet backbone)"
_MARGIN_PX = 32
"""Context around a region that the backbone sees."""


class Perception:
    """A perceptual distance after Zhang et al. (CVPR 2018), unweighted: features of SqueezeNet's first layers, as
    the shipped detector has them, each pixel's scaled to unit length, squared differences averaged over a region.
    It is not LPIPS, whose layers and weights are others.
    """

    def __init__(self) -> None:
        detector = load_detector("squeezedet")
        assert isinstance(detector, SqueezeDet)
        self._net = detector

    @torch.no_grad()
    def distance(self, first: Picture, second: Picture, region: Mask) -> float:
        """Of two pictures (H, W, 3) uint8 over a region (H, W); 0 for equal ones. Raises ShapeError for an empty
        region."""
        if not region.any():
            raise ShapeError("region", "at least one pixel", 0)
        rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
        window = (
            slice(max(int(rows[0]) - _MARGIN_PX, 0), int(rows[-1]) + 1 + _MARGIN_PX),
            slice(max(int(columns[0]) - _MARGIN_PX, 0), int(columns[-1]) + 1 + _MARGIN_PX),
        )
        share = torch.from_numpy(region[window].astype(np.float32))[None, None]
        total = 0.0
        layers = list(zip(self.features(first[window]), self.features(second[window]), strict=True))
        for one, two in layers:
            apart = (F.normalize(one, dim=1) - F.normalize(two, dim=1)).square().sum(dim=1)[0]
            weight = F.adaptive_avg_pool2d(share, (apart.shape[0], apart.shape[1]))[0, 0]
            total += float((apart * weight).sum() / weight.sum())
        return total / len(layers)

    def features(self, picture: Picture) -> list[Tensor]:
        """Of conv1, fire3 and fire5: (1, C, h, w) at a half, a quarter and an eighth of the picture's size."""
        image = torch.from_numpy(np.ascontiguousarray(picture[..., ::-1].transpose(2, 0, 1))).float()[None]
        net, found = self._net, []
        x = F.relu(net.conv1(image - image.new_tensor(BGR_MEAN).view(1, 3, 1, 1)))
        found.append(x)
        for first, second in (("fire2", "fire3"), ("fire4", "fire5")):
            x = F.max_pool2d(x, 3, stride=2, padding=1)
            x = net.fires[second](net.fires[first](x))
            found.append(x)
        return found
