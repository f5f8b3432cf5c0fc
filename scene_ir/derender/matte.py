"""Opacity of objects from masks and cut-outs: how much of each pixel along the border is the object.

Pixels along an outline mix the object's colour just inside with the surroundings' just outside. Where the two
differ, the mixing share is read off the photograph (the colour line of Bayesian matting, Chuang 2001); elsewhere
the distance to the mask's border decides.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

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


MIN_HEIGHT_PX = 80.0
"""Lower vehicles have too few pixels for their colours to decide."""
_WORKING_PX = 128.0
"""Higher vehicles are scaled down to this height."""
_BAND, _INNER = 0.1, 0.05
"""How far outside and inside the mask, in heights, the border may be."""
_NEAR = 0.2
"""Half the side of the squares in which colours are compared, in heights."""
_CLUSTERS = 20
"""Number of colour clusters."""
_SAMPLE = 7
"""Every such pixel is used to find the clusters; a prime, so that samples lie in all columns."""
_PRIOR_PX = 12.0
"""Pixels that weigh as much as the statistics of the whole vehicle."""
_NETWORK_WEIGHT, _OUTLINE_WEIGHT = 0.6, 1.6
"""Weights of the network's shares and of the template's outline against the colours'."""
_DARK = 0.25
"""Brightness from which colours have full weight; black has none."""
_PULL = 0.04
"""Weight of all those against smoothness."""
_EXTENSION_CONTRAST = 0.05
"""Difference of neighbouring colours that is an edge."""
_SHADE = 0.3
"""Share of shadow from which a pixel is ground."""
_THIN = 0.02
"""Half the width, in heights, of pieces too thin to be added."""
_FIRM = 4.0
"""Steepness of shares about one half once they are decided."""


def extend_mask(image: NDArray[np.uint8], first: Cutout, other: Cutout, covered: Array, allowed: Mask) -> Cutout:
    """Add pixels next to a cut-out that look like the vehicle.

    Args:
        image: (H, W, 3) RGB.
        first: The unrefined cut-out with the template at its place.
        other: The same with the template at its label. Colours decide where the two differ.
        covered: Share (H, W) of the two outlines that cover each pixel.
        allowed: Pixels (H, W) that may be the vehicle's.

    Returns:
        The extended cut-out; the same object for a vehicle lower than `MIN_HEIGHT_PX`.
    """
    solid = first.visible >= 0.5
    rows = np.flatnonzero(solid.any(1))
    if not len(rows) or rows[-1] + 1 - rows[0] < MIN_HEIGHT_PX:
        return first
    height = rows[-1] + 1 - rows[0]
    scale = min(_WORKING_PX / height, 1.0)
    second = other.full_map("visible", image.shape)[first.window]
    parts = (first.visible, second, first.front, first.shadow, np.asarray(covered[first.window], np.float32))
    size = (max(round(solid.shape[1] * scale), 1), max(round(solid.shape[0] * scale), 1))
    small = np.stack([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts]).astype(np.float32)
    free = cv2.resize(allowed[first.window].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    photo = cv2.resize(image[first.window], size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    share = _extended_share(photo, small, free, height * scale)
    wide = cv2.resize(share, solid.shape[::-1], interpolation=cv2.INTER_LINEAR)
    visible = np.clip(np.maximum(first.visible, wide * allowed[first.window]), 0, 1 - first.front)
    return replace(first, visible=visible, shadow=np.minimum(first.shadow, 1 - visible - first.front).clip(0))


def _extended_share(photo: NDArray[np.uint8], shares: Array, free: Mask, height: float) -> Array:
    """Share (h, w) of the vehicle in each pixel. shares (5, h, w): visible in either cut-out, front, shadow,
    covered.
    """
    first, second, front, shade, covered = shares
    solid = first >= 0.5
    either = solid | (second >= 0.5) | (covered >= 0.5)
    inside = _distance_inside(solid) > _INNER * height
    ground = (shade >= _SHADE) & ~solid & (covered < 0.5)
    outside = (_distance_inside(~either) > _BAND * height) | ground | (front >= 0.5) | ~free
    undecided = ~inside & ~outside
    if not inside.any() or not outside.any() or not undecided.any():
        return first
    ratio = _colour_log_ratio(photo, inside, outside & free, height)
    # Pixels that one cut-out misses are more often vehicle than not.
    network = np.clip(0.25 * np.minimum(first, second) + 0.75 * np.maximum(first, second), 0.05, 0.95)
    light = np.clip(photo.max(-1) / np.float32(255 * _DARK), 0, 1)
    odds = light * ratio + _NETWORK_WEIGHT * np.log(network / (1 - network)) + _OUTLINE_WEIGHT * (covered - 0.25)
    walked = _random_walk(photo, inside, undecided, 1 / (1 + np.exp(-odds)))
    # Spikes along edges of the background are no part of the vehicle.
    opened = cv2.morphologyEx(((walked >= 0.5) | solid).astype(np.uint8), cv2.MORPH_OPEN, _disc(_THIN * height))
    whole = (opened > 0) | solid
    _, components = cv2.connectedComponents(whole.astype(np.uint8), connectivity=4)
    connected = np.isin(components, np.unique(np.asarray(components)[solid]))
    # Firm shares: the refinement would take halves for borders.
    share = np.where(whole, walked, np.minimum(walked, first))
    return np.where(connected, np.clip(_FIRM * (share - 0.5) + 0.5, 0, 1), 0).astype(np.float32)


def _disc(radius: float) -> NDArray[np.uint8]:
    """A disc of at least 1 px radius."""
    side = 2 * max(round(radius), 1) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _distance_inside(mask: Mask) -> Array:
    """Distance (h, w), px, from the nearest pixel outside the mask; the image's border does not count."""
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _colour_log_ratio(photo: NDArray[np.uint8], inside: Mask, outside: Mask, height: float) -> Array:
    """Log ratio (h, w) of the frequencies of a pixel's colour on the vehicle and outside it, nearby."""
    clusters = _colour_clusters(photo)
    side = 2 * max(round(_NEAR * height), 1) + 1
    shares = []
    for region in (inside, outside):
        count = np.bincount(clusters[region], minlength=_CLUSTERS).astype(np.float32)
        frequency = (count + 1) / (count.sum() + _CLUSTERS)
        around = cv2.boxFilter(region.astype(np.float32), -1, (side, side), normalize=False)
        own = np.zeros(clusters.shape, np.float32)
        for cluster in range(_CLUSTERS):
            such = clusters == cluster
            own[such] = cv2.boxFilter((such & region).astype(np.float32), -1, (side, side), normalize=False)[such]
        whole = frequency[clusters]
        shares.append(((own + _PRIOR_PX * whole) / (around + _PRIOR_PX), whole))
    (on_vehicle, anywhere), (off_vehicle, _) = shares
    # Vehicles have the same paint everywhere; their surroundings vary.
    return np.clip(np.log(np.maximum(on_vehicle, anywhere) / off_vehicle), -4, 4)


def _colour_clusters(photo: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Index (h, w) of each pixel's colour cluster."""
    colours = cv2.cvtColor(photo, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(np.float32)
    colours[:, 1:] *= 2  # Shades of one paint differ more than paints of one shade.
    some = np.ascontiguousarray(colours[::_SAMPLE])
    rank = np.argsort(np.argsort(some @ np.array([1, 0.5, 0.25], np.float32), kind="stable"), kind="stable")
    start = (rank * _CLUSTERS // len(rank)).astype(np.int32)[:, None]
    stop = (cv2.TERM_CRITERIA_MAX_ITER, 8, 0.0)
    _, _, centres = cv2.kmeans(some, _CLUSTERS, start, stop, 1, cv2.KMEANS_USE_INITIAL_LABELS)
    distance = (centres * centres).sum(1) - 2 * colours @ centres.T
    return np.asarray(distance.argmin(1), np.int64).reshape(photo.shape[:2])


def _random_walk(photo: NDArray[np.uint8], inside: Mask, undecided: Mask, prior: Array) -> Array:
    """Shares (h, w): 1 inside, 0 outside, and smooth except across edges and near the prior where undecided."""
    values = photo.astype(np.float32) / 255
    known = inside.astype(np.float32)
    index = np.cumsum(undecided.ravel()).reshape(undecided.shape) - 1
    count = int(undecided.sum())
    weight = np.full(count, _PULL, np.float64)
    target = _PULL * prior[undecided].astype(np.float64)
    rows, columns, links = [], [], []
    for a, b in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        apart = ((values[a] - values[b]) ** 2).sum(-1)
        link = np.exp(-apart / (2 * _EXTENSION_CONTRAST**2)).astype(np.float64) + 1e-3
        for p, q in ((a, b), (b, a)):
            mine = undecided[p]
            np.add.at(weight, index[p][mine], link[mine])
            np.add.at(target, index[p][mine], (link * known[q] * ~undecided[q])[mine])
            pair = mine & undecided[q]
            rows.append(index[p][pair])
            columns.append(index[q][pair])
            links.append(-link[pair])
    matrix = coo_array((np.concatenate(links), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    matrix = (matrix + diags_array(weight)).tocsr()
    solved, _ = cg(matrix, target, x0=prior[undecided].astype(np.float64), rtol=1e-3, maxiter=60)
    known[undecided] = solved
    return known
