"""Smooth filling of what a picture does not show."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def push_pull(image: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Smooth interpolation into unknown pixels. image (H, W, C), known (H, W) in [0, 1] -> (H, W, C).

    The pyramid of Gortler's lumigraph (SIGGRAPH 1996): weighted averages go up, fill what is missing on the way
    down.
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


Colours = NDArray[Any]


def channel_max(colours: Colours) -> Colours:
    """The largest of the three channels."""
    return np.maximum(np.maximum(colours[..., 0], colours[..., 1]), colours[..., 2])


def channel_mean(colours: Colours) -> Colours:
    """The mean of the three channels."""
    return (colours[..., 0] + colours[..., 1] + colours[..., 2]) / np.float32(3)


def channel_square_sum(colours: Colours) -> Colours:
    """The squares of the three channels, added up."""
    red, green, blue = (colours[..., channel] for channel in range(3))
    return red * red + green * green + blue * blue
