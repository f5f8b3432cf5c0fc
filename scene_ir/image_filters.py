"""Image filters on NumPy arrays: smooth hole filling, and reductions over the colour channels.

The reductions repeat NumPy's order of operations, so that no bit differs; NumPy's own reductions over so short an
axis take ten times as long.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def push_pull(image: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Interpolate smoothly into unknown pixels: image (H, W, C), known (H, W) in [0, 1] -> (H, W, C).

    The pyramid of Gortler's lumigraph (SIGGRAPH 1996): weighted averages on the way up, missing values filled on
    the way down.
    """
    height, width = known.shape
    if min(height, width) <= 2 or bool((known > 0.999).all()):
        mean = (image * known[..., None]).sum((0, 1)) / max(float(known.sum()), 1e-6)
        return (image * known[..., None] + mean * (1 - known[..., None])).astype(np.float32)
    half = ((width + 1) // 2, (height + 1) // 2)
    weight = cv2.resize(cv2.GaussianBlur(known, (5, 5), 0), half, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(cv2.GaussianBlur(image * known[..., None], (5, 5), 0), half, interpolation=cv2.INTER_AREA)
    colour = colour.reshape(half[1], half[0], -1) / np.maximum(weight, 1e-6)[..., None]
    coarse = push_pull(colour.astype(np.float32), np.minimum(weight * 4, 1).astype(np.float32))
    up = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR).reshape(height, width, -1)
    return (image * known[..., None] + up * (1 - known[..., None])).astype(np.float32)


def channel_max(colours: NDArray[Any]) -> NDArray[Any]:
    """Maximum over the three channels of colours (..., 3)."""
    return np.maximum(np.maximum(colours[..., 0], colours[..., 1]), colours[..., 2])


def channel_mean(colours: NDArray[Any]) -> NDArray[Any]:
    """Mean over the three channels of float32 colours (..., 3)."""
    return (colours[..., 0] + colours[..., 1] + colours[..., 2]) / np.float32(3)


def channel_square_sum(colours: NDArray[Any]) -> NDArray[Any]:
    """Sum of squares over the three channels of colours (..., 3)."""
    red, green, blue = (colours[..., channel] for channel in range(3))
    return red * red + green * green + blue * blue
