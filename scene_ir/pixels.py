"""Pictures of 8 bits and tensors in [0, 1]: one rule of rounding."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def to_uint8(image: Tensor) -> NDArray[np.uint8]:
    """An image (3, H, W) in [0, 1] as (H, W, 3) uint8, rounded to nearest."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()


def to_tensor(picture: NDArray[np.uint8]) -> Tensor:
    """A picture (H, W, 3) uint8 as (3, H, W) float32 in [0, 1]; `to_uint8` gives it back."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).to(torch.float32) / 255
