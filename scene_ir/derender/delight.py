"""Light of a closed sky: by how much each pixel of a photograph would change if clouds covered the sun.

A network estimates the logarithm of the ratio of both pictures at a lower resolution. A guided filter (He et al., ECCV
2010) moves its steps to the photograph's edges, where cast shadows end.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.derender import unet
from scene_ir.types import Camera
from scene_ir.weights import SHIPPED_WEIGHTS, load_frozen

Array = NDArray[np.float32]

WEIGHTS = SHIPPED_WEIGHTS / "delight.safetensors"
MAX_LOG_RATIO = 1.5
"""Bound of the logarithm: no pixel becomes more than 4.5 times as bright, or as dark."""
OFFSET = 0.02
"""Added to both pictures before their ratio is taken: black has no ratio."""
_GUIDE_RADIUS = 0.02
"""Radius of the guided filter, as a share of the focal length."""
_GUIDE_EPSILON = 2e-3
"""Variance of the guide, the photograph's logarithm, from which an edge is one."""


class DelightNet(unet.UNet):
    """RGB (N, 3, h, w) in [0, 1] and elevation (N, 1, h, w), sides multiples of 16 -> log ratio (N, 3, h/2, w/2)."""

    def __init__(self) -> None:
        super().__init__(3)

    def forward(self, image: Tensor, elevation: Tensor) -> Tensor:
        return MAX_LOG_RATIO * torch.tanh(super().forward(image, elevation))


@lru_cache(maxsize=1)
def load_network() -> DelightNet:
    """The shipped network."""
    return load_frozen(DelightNet(), WEIGHTS)


def estimate_closed_sky(
    image: Array, ground: Tensor, camera: Camera, network: DelightNet | None = None
) -> Array:
    """Estimate how a photograph would change if clouds covered the sun.

    Args:
        image: (H, W, 3) RGB float32 in [0, 1].
        ground: Plane (4,) n.x + d = 0 with n up.
        camera: The photograph's camera.
        network: In place of the shipped one.

    Returns:
        Logarithm (H, W, 3) of the ratio of the picture under a closed sky to the photograph, within `MAX_LOG_RATIO`;
        0 changes no pixel.
    """
    height, width = image.shape[:2]
    view = unet.prepare_input(image, ground, camera)
    coarse = (network or load_network()).predict(view)[0].permute(1, 2, 0).numpy()
    large = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    guide = np.log(image + np.float32(OFFSET))
    radius = max(2, round(_GUIDE_RADIUS * float(camera.intrinsics[0, 0])))
    sharp = cv2.ximgproc.guidedFilter(guide, large, radius, _GUIDE_EPSILON)
    return np.clip(sharp, -MAX_LOG_RATIO, MAX_LOG_RATIO).astype(np.float32)
