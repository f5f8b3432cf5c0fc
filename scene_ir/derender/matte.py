"""Opacity of objects from masks and cut-outs: how much of each pixel along the border is the object.

Pixels along an outline mix the object's colour just inside with the surroundings' just outside. Where the two
differ, the mixing share is read off the photograph (the colour line of Bayesian matting, Chuang 2001); elsewhere
the distance to the mask's border decides.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.derender.cutout import Cutout
from scene_ir.derender.silhouette import mask_bounds

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_BAND_PX = 2.5
"""Mixed pixels lie this near to the mask's border, on both sides."""
_GENEROUS_PX = 0.2
"""Distance of the prior border from the mask. Small, because occluders never move: a rim of vehicle around them
would stay when the vehicle moves away."""
_SOFTNESS_PX = 1.6
"""Width of the prior's ramp."""
_CONTRAST = 0.06
"""Difference of colours at which the photograph counts as much as the prior."""
_ODD = (1.8, 3.2)
"""Deviation from the surroundings, in their standard deviations, from which a pixel just outside begins to be, and
is, a piece of the object."""
_UNLIKE = 0.1
"""Least distance of such a pixel's colour from mixtures of the nearest object's and surroundings' colours."""
_BACKGROUND_SHARE = 0.04
"""Shares of a cut-out up to which a pixel is background."""
_GAIN = 1.25
"""Factor on larger shares."""
_BORDER_PX = 3.0
"""How far beyond the mask shares belong to its border."""
_UNDER_PX = 2.0
"""How far the matte continues under nearer objects."""


def compute_matte(image: Array, mask: Mask) -> Array:
    """Opacity (H, W) in [0, 1] of the object in `mask` (H, W); image (H, W, 3) RGB in [0, 1]."""
    opacity = np.zeros(mask.shape, np.float32)
    if not mask.any():
        return opacity
    x0, y0, x1, y1 = mask_bounds(mask)
    margin = int(4 * _BAND_PX) + 4
    window = (
        slice(max(y0 - margin, 0), min(y1 + margin, mask.shape[0])),
        slice(max(x0 - margin, 0), min(x1 + margin, mask.shape[1])),
    )
    colours, inner = image[window], mask[window]
    depth = _signed_distance(inner)
    prior = np.clip((depth + _GENEROUS_PX) / _SOFTNESS_PX + 0.5, 0, 1)
    inside = _nearest_colours(colours, depth > _BAND_PX, inner)
    outside = _nearest_colours(colours, depth < -_BAND_PX - 0.5, ~inner)
    if inside is None or outside is None:
        mixed = prior
    else:
        across = inside - outside
        length = (across * across).sum(-1)
        share = np.clip(((colours - outside) * across).sum(-1) / np.maximum(length, 1e-6), 0, 1)
        trust = length / (length + _CONTRAST**2)
        mixed = trust * share + (1 - trust) * prior
        odd = _colour_deviation(colours, share[..., None] * across, depth < -_BAND_PX - 1.5)
        # A window frame or branch that continues just outside is no piece of the object.
        unlike = np.linalg.norm(colours - outside - share[..., None] * across, axis=-1)
        unlike = np.clip(unlike / _UNLIKE - 1, 0, 1)
        piece = np.clip((odd - _ODD[0]) / (_ODD[1] - _ODD[0]), 0, 1) * unlike
        mixed = cv2.GaussianBlur(np.maximum(mixed, piece).astype(np.float32), (3, 3), 0.6)
    result = np.clip(mixed, np.clip(depth + 0.5, 0, 1), np.clip((depth + _BAND_PX + 1) / 1.5, 0, 1))
    opacity[window] = np.where(result < 0.02, 0, np.where(result > 0.98, 1, result))
    return opacity


def cutout_opacity(cutout: Cutout, mask: Mask, hidden: Mask) -> Array:
    """Opacity of a vehicle, slightly more than its visible shares.

    Some road that travels with a car is less visible than an edge of the car that stays behind.

    Args:
        cutout: The vehicle's shares of pixels.
        mask: Its pixels (H, W).
        hidden: Pixels (H, W) of nearer objects.

    Returns:
        (H, W) in [0, 1].
    """
    opacity = np.zeros(mask.shape, np.float32)
    if not mask.any():
        return opacity
    window = cutout.window
    raised = np.clip((cutout.visible - _BACKGROUND_SHARE) * _GAIN, 0, 1)
    depth = _signed_distance(mask[window])
    under = np.clip(depth + _UNDER_PX, 0, 1)
    opacity[window] = np.where(hidden[window], under, raised * (depth > -_BORDER_PX))
    return opacity


def _signed_distance(mask: Mask) -> Array:
    """Distance (H, W) px to the mask's border, positive inside; the image's border does not count."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return np.where(mask, inside - 0.5, 0.5 - outside).astype(np.float32)


def _colour_deviation(image: Array, explained: Array, surroundings: Mask) -> Array:
    """Distance (H, W), in standard deviations, of each pixel's colour, less a mixture's `explained` part (H, W,
    3), from the nearby surroundings' colours.
    """
    weight = cv2.GaussianBlur(surroundings.astype(np.float32), (0, 0), 4.0)
    scale = np.maximum(weight, 1e-4)[..., None]
    known = image * surroundings[..., None]
    mean = cv2.GaussianBlur(known, (0, 0), 4.0) / scale
    square = cv2.GaussianBlur(known * image, (0, 0), 4.0) / scale
    spread = np.sqrt(np.maximum(square - mean * mean, 0).sum(-1)) + 0.05
    deviation = np.sqrt(((image - explained - mean) ** 2).sum(-1)) / spread
    return np.where(weight > 0.01, deviation, 0).astype(np.float32)


def _nearest_colours(image: Array, certain: Mask, allowed: Mask) -> Array | None:
    """The slightly blurred colour (H, W, 3) of each pixel's nearest certain one; None if there is none."""
    if not certain.any():
        return None
    weight = allowed.astype(np.float32)
    blurred = cv2.GaussianBlur(image * weight[..., None], (0, 0), 1.2)
    blurred = blurred / np.maximum(cv2.GaussianBlur(weight, (0, 0), 1.2), 1e-3)[..., None]
    _, labels = cv2.distanceTransformWithLabels(
        (~certain).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(labels, np.int64)
    lookup = np.zeros((int(labels.max()) + 1, 3), np.float32)
    lookup[labels[certain]] = blurred[certain]
    return lookup[labels]
