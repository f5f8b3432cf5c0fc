"""From a hard mask to opacity: how much of each pixel along the border is car.

Along the outline a pixel is a mixture of the car's colour just inside and the surroundings' just outside; where
the two differ, the mixing share is read off the photograph (the colour line of Bayesian matting, Chuang 2001), and
where they do not, the distance to the mask's border decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.derender.cutout import Cutout
from scene_ir.derender.silhouette import mask_bounds

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class MatteSettings:
    """band_px: mixed pixels are looked for this far on both sides of the mask; generous_px: how far the prior
    border lies outside the mask (some road that travels with a car shows less than an edge of car left behind);
    softness_px: width of the prior ramp; contrast: difference of colours at which the photograph counts as much as
    the prior; odd: deviations from the surroundings (in their standard deviations) between which a pixel just
    outside begins to be, and is, taken for a piece of the car; unlike: how far its colour must at least be from
    mixtures of the nearest car's and surroundings' colours to be one.
    """

    band_px: float = 2.5
    generous_px: float = 0.7
    softness_px: float = 1.6
    contrast: float = 0.06
    odd: tuple[float, float] = (1.8, 3.2)
    unlike: float = 0.1


@dataclass(frozen=True, slots=True)
class ShareSettings:
    """nothing: shares up to which a pixel is background; gain: by which larger ones are raised; border_px: how far
    beyond the mask shares are its border's; under_px: how far the matte runs on under what is nearer."""

    nothing: float = 0.04
    gain: float = 1.25
    border_px: float = 3.0
    under_px: float = 2.0


def compute_matte(
    image: Array, mask: Mask, unknown: Mask, ground: Mask, settings: MatteSettings | None = None
) -> Array:
    """Opacity (H, W) in [0, 1] of the car in `mask`.

    image (H, W, 3) RGB in [0, 1]. unknown (H, W): pixels of nearer things. The car runs on behind their border, so
    that no gap opens along it. ground (H, W): where what is odd is a shadow.
    """
    settings = settings or MatteSettings()
    opacity = np.zeros(mask.shape, np.float32)
    if not mask.any():
        return opacity
    x0, y0, x1, y1 = mask_bounds(mask)
    margin = int(4 * settings.band_px) + 4
    window = (
        slice(max(y0 - margin, 0), min(y1 + margin, mask.shape[0])),
        slice(max(x0 - margin, 0), min(x1 + margin, mask.shape[1])),
    )
    colours, car, hidden = image[window], mask[window], unknown[window]
    depth = _signed_distance(car)
    prior = np.clip((depth + settings.generous_px) / settings.softness_px + 0.5, 0, 1)
    inside = _carried(colours, depth > settings.band_px, car)
    outside = _carried(colours, (depth < -settings.band_px - 0.5) & ~hidden, ~car & ~hidden)
    if inside is None or outside is None:
        mixed = prior
    else:
        across = inside - outside
        length = (across * across).sum(-1)
        share = np.clip(((colours - outside) * across).sum(-1) / np.maximum(length, 1e-6), 0, 1)
        trust = length / (length + settings.contrast**2)
        mixed = trust * share + (1 - trust) * prior
        odd = _oddness(
            colours, share[..., None] * across, (depth < -settings.band_px - 1.5) & ~hidden & ~ground[window]
        )
        low, high = settings.odd
        # What goes on just outside, a window frame or a branch, is no piece of the car.
        unlike = np.linalg.norm(colours - outside - share[..., None] * across, axis=-1)
        unlike = np.clip(unlike / settings.unlike - 1, 0, 1)
        piece = np.clip((odd - low) / (high - low), 0, 1) * unlike * ~ground[window]
        mixed = np.maximum(mixed, piece)
        mixed = cv2.GaussianBlur(mixed.astype(np.float32), (3, 3), 0.6)
    low = np.clip(depth + 0.5, 0, 1)
    high = np.clip((depth + settings.band_px + 1) / 1.5, 0, 1)
    result = np.clip(mixed, low, high)
    result = np.where(hidden, np.maximum(result, prior), result)
    opacity[window] = np.where(result < 0.02, 0, np.where(result > 0.98, 1, result))
    return opacity


def cutout_opacity(cutout: Cutout, mask: Mask, hidden: Mask, settings: ShareSettings | None = None) -> Array:
    """Opacity (H, W) in [0, 1] of the car of a cut-out. mask (H, W): its pixels; hidden (H, W): of nearer things.

    A little more than what is seen of it: some road that travels with a car shows less than an edge of car that is
    left behind.
    """
    settings = settings or ShareSettings()
    opacity = np.zeros(mask.shape, np.float32)
    if not mask.any():
        return opacity
    window = cutout.window
    raised = np.clip((cutout.visible - settings.nothing) * settings.gain, 0, 1)
    car = mask[window]
    depth = _signed_distance(car)
    under = np.clip(depth + settings.under_px, 0, 1)
    # Beyond the mask shares of a pixel belong to its border; farther off they are of nothing that is cut out.
    raised = np.where(hidden[window], under, raised * (depth > -settings.border_px))
    opacity[window] = raised
    return opacity


def _signed_distance(mask: Mask) -> Array:
    """Distance (H, W) px to the mask's border, positive inside; the image's border is no border of the mask."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return np.where(mask, inside - 0.5, 0.5 - outside).astype(np.float32)


def _oddness(image: Array, explained: Array, sure: Mask) -> Array:
    """How far (H, W) each pixel, less what a mixture with the car explains (H, W, 3), is from the colours of the
    `sure` surroundings near it, in standard deviations."""
    weight = cv2.GaussianBlur(sure.astype(np.float32), (0, 0), 4.0)
    scale = np.maximum(weight, 1e-4)[..., None]
    known = image * sure[..., None]
    mean = cv2.GaussianBlur(known, (0, 0), 4.0) / scale
    square = cv2.GaussianBlur(known * image, (0, 0), 4.0) / scale
    spread = np.sqrt(np.maximum(square - mean * mean, 0).sum(-1)) + 0.05
    odd = np.sqrt(((image - explained - mean) ** 2).sum(-1)) / spread
    return np.where(weight > 0.01, odd, 0).astype(np.float32)


def _carried(image: Array, sure: Mask, allowed: Mask) -> Array | None:
    """Each pixel gets the (slightly averaged) colour of the nearest sure one; None where there is none."""
    if not sure.any():
        return None
    weight = allowed.astype(np.float32)
    blurred = cv2.GaussianBlur(image * weight[..., None], (0, 0), 1.2)
    blurred = blurred / np.maximum(cv2.GaussianBlur(weight, (0, 0), 1.2), 1e-3)[..., None]
    _, labels = cv2.distanceTransformWithLabels(
        (~sure).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(labels, np.int64)
    lookup = np.zeros((int(labels.max()) + 1, 3), np.float32)
    lookup[labels[sure]] = blurred[sure]
    return lookup[labels]
