"""Extend masks of large vehicles beyond a template that does not fit, by colours.

The network that cuts vehicles out follows the placed template where colours are ambiguous, so it misses roofs,
bonnets and mirrors that the template lacks. Near vehicles are large enough for their colours to decide: pixels
along the border are compared with certain pixels of the vehicle and of its surroundings nearby, and borders prefer
edges of the photograph (random walks with priors, Grady 2005).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from scene_ir.derender.cutout import Cutout

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

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
_CONTRAST = 0.05
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
        link = np.exp(-apart / (2 * _CONTRAST**2)).astype(np.float64) + 1e-3
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
