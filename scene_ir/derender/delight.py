"""Light of a closed sky: how a photograph would change if clouds covered the sun, at a lower resolution.

`render.environment.compute_closed_sky_gain` brings the result to the photograph's resolution and edges.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.derender import unet
from scene_ir.types import Camera
from scene_ir.weights import SHIPPED_WEIGHTS, load_frozen

Array = NDArray[np.float32]

WEIGHTS = SHIPPED_WEIGHTS / "delight.safetensors"


class DelightNet(unet.UNet):
    """RGB (N, 3, h, w) in [0, 1] and elevation (N, 1, h, w), sides multiples of 16 -> logits (N, 3, h/2, w/2) of
    `Environment.closed_sky`."""

    def __init__(self) -> None:
        super().__init__(3)


@lru_cache(maxsize=1)
def load_network() -> DelightNet:
    """The shipped network."""
    return load_frozen(DelightNet(), WEIGHTS)


def estimate_closed_sky(image: Array, ground: Tensor, camera: Camera, network: DelightNet | None = None) -> Tensor:
    """Estimate how a photograph would change if clouds covered the sun.

    Args:
        image: (H, W, 3) RGB float32 in [0, 1].
        ground: Plane (4,) n.x + d = 0 with n up.
        camera: The photograph's camera.
        network: In place of the shipped one.

    Returns:
        Codes (3, h, w) as of `Environment.closed_sky`, multiples of 1 / 255.
    """
    logits = (network or load_network()).predict(unet.prepare_input(image, ground, camera))[0]
    return (torch.sigmoid(logits) * 255).round() / 255
