"""Large vehicles whose template does not fit: what looks like the vehicle beside its mask becomes part of it.

The network that cuts vehicles out follows the placed template where colours tell little, so roofs, bonnets and
mirrors that the template lacks are left out. Near vehicles are large enough for their own colours to tell: what
lies along the border is compared with what is surely the vehicle near by, and with what is surely not, and
borders prefer edges of the photograph (random walks with priors, Grady 2005).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from scene_ir.derender.cutout import Cutout

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

MIN_HEIGHT_PX = 80.0
"""Height of vehicles whose colours tell enough."""
_SAMPLE = 7
"""One of so many pixels is enough to find the kinds of colours; a prime, so that samples lie in all columns."""

_FIRM = 4.0
"""Steepness of shares about one half once they are decided."""


@dataclass(frozen=True, slots=True)
class MaskExtensionSettings:
    """How far a vehicle may go on, and what tells it. Lengths are in its heights.

    working_px: height to which larger vehicles are scaled down: colours tell as much there. band, inner: how far
    beyond the mask it may go on, and how far inside the mask is not sure. near: half the side of the squares in
    which colours are compared. colours: kinds that are told apart. few: pixels that tell as much as what is known
    from the whole vehicle. looks, outline: weights against the colours' of the network's opinion and of the
    template's outline. dark: brightness from which on colours tell fully; in black none does. pull: of all those
    against smoothness. contrast: difference of neighbours' colours that is an edge. shade: share of shadow from
    which on a pixel is ground. thin: half the width of what is too thin to be added.
    """

    working_px: float = 128.0
    band: float = 0.1
    inner: float = 0.05
    near: float = 0.2
    colours: int = 20
    few: float = 12.0
    looks: float = 0.6
    outline: float = 1.6
    dark: float = 0.25
    pull: float = 0.04
    contrast: float = 0.05
    shade: float = 0.3
    thin: float = 0.02


def extend_mask(
    image: NDArray[np.uint8],
    seen: Cutout,
    other: Cutout,
    drawn: Array,
    allowed: Mask,
    settings: MaskExtensionSettings | None = None,
) -> Cutout:
    """The cut-out with what beside it looks like the vehicle.

    image (H, W, 3) RGB. seen, other: after the first look, with the template at two places; what only one of them
    takes for the vehicle is decided by colours. drawn (H, W): share of the two places whose outline a pixel is in.
    allowed (H, W): where the vehicle may be: not what is nearer. Vehicles lower than `LEAST_PX` stay as they are.
    """
    settings = settings or MaskExtensionSettings()
    solid = seen.visible >= 0.5
    rows = np.flatnonzero(solid.any(1))
    if not len(rows) or rows[-1] + 1 - rows[0] < MIN_HEIGHT_PX:
        return seen
    high = rows[-1] + 1 - rows[0]
    scale = min(settings.working_px / high, 1.0)
    second = other.full_map("visible", image.shape)[seen.window]
    parts = (seen.visible, second, seen.front, seen.shadow, np.asarray(drawn[seen.window], np.float32))
    size = (max(round(solid.shape[1] * scale), 1), max(round(solid.shape[0] * scale), 1))
    small = np.stack([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts]).astype(np.float32)
    free = cv2.resize(allowed[seen.window].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    photo = cv2.resize(image[seen.window], size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    more = _more(photo, small, free, high * scale, settings)
    wide = cv2.resize(more, solid.shape[::-1], interpolation=cv2.INTER_LINEAR)
    # What is in front stays there.
    visible = np.clip(np.maximum(seen.visible, wide * allowed[seen.window]), 0, 1 - seen.front)
    return replace(seen, visible=visible, shadow=np.minimum(seen.shadow, 1 - visible - seen.front).clip(0))


def _more(
    photo: NDArray[np.uint8], shares: Array, free: Mask, high: float, settings: MaskExtensionSettings
) -> Array:
    """How much (h, w) of each pixel is vehicle. shares (5, h, w): visible at either look, front, shadow, drawn."""
    first, second, front, shade, drawn = shares
    solid = first >= 0.5
    either = solid | (second >= 0.5) | (drawn >= 0.5)
    inside = _depth(solid) > settings.inner * high
    ground = (shade >= settings.shade) & ~solid & (drawn < 0.5)
    outside = (_depth(~either) > settings.band * high) | ground | (front >= 0.5) | ~free
    open_ = ~inside & ~outside
    if not inside.any() or not outside.any() or not open_.any():
        return first
    ratio = _likelier(photo, inside, outside & free, high, settings)
    # What one look has missed is more often vehicle than not.
    seen = np.clip(0.25 * np.minimum(first, second) + 0.75 * np.maximum(first, second), 0.05, 0.95)
    light = np.clip(photo.max(-1) / np.float32(255 * settings.dark), 0, 1)
    odds = light * ratio + settings.looks * np.log(seen / (1 - seen)) + settings.outline * (drawn - 0.25)
    found = _walked(photo, inside, open_, 1 / (1 + np.exp(-odds)), settings)
    # Spikes along what is behind are none of the vehicle's.
    added = cv2.morphologyEx(
        ((found >= 0.5) | solid).astype(np.uint8), cv2.MORPH_OPEN, _disc(settings.thin * high)
    )
    whole = (added > 0) | solid
    _, parts = cv2.connectedComponents(whole.astype(np.uint8), connectivity=4)
    kept = np.isin(parts, np.unique(np.asarray(parts)[solid]))
    # What is decided is: the second look would take halves for borders.
    found = np.where(whole, found, np.minimum(found, first))
    return np.where(kept, np.clip(_FIRM * (found - 0.5) + 0.5, 0, 1), 0).astype(np.float32)


def _disc(radius: float) -> NDArray[np.uint8]:
    """A disc of a radius, px, at least 1."""
    side = 2 * max(round(radius), 1) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _depth(mask: Mask) -> Array:
    """Distance (h, w), px, from the nearest pixel beside the mask; 0 there. The image's border is none."""
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _likelier(
    photo: NDArray[np.uint8], inside: Mask, outside: Mask, high: float, settings: MaskExtensionSettings
) -> Array:
    """Log of how much likelier (h, w) a pixel's colour is on the vehicle near by than beside it near by."""
    kinds = _kinds(photo, settings.colours)
    side = 2 * max(round(settings.near * high), 1) + 1
    shares = []
    for region in (inside, outside):
        count = np.bincount(kinds[region], minlength=settings.colours).astype(np.float32)
        known = (count + 1) / (count.sum() + settings.colours)
        around = cv2.boxFilter(region.astype(np.float32), -1, (side, side), normalize=False)
        own = np.zeros(kinds.shape, np.float32)
        for kind in range(settings.colours):
            such = kinds == kind
            own[such] = cv2.boxFilter((such & region).astype(np.float32), -1, (side, side), normalize=False)[such]
        shares.append(((own + settings.few * known[kinds]) / (around + settings.few), known[kinds]))
    (here, anywhere), (beside, _) = shares
    # Vehicles have the same paint everywhere; what is around them changes.
    here = np.maximum(here, anywhere)
    return np.clip(np.log(here / beside), -4, 4)


def _kinds(photo: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """Which of `count` kinds of colours (h, w) each pixel has."""
    colours = cv2.cvtColor(photo, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(np.float32)
    colours[:, 1:] *= 2  # Shades of one paint differ by more than paints of one shade do.
    some = np.ascontiguousarray(colours[::_SAMPLE])
    rank = np.argsort(np.argsort(some @ np.array([1, 0.5, 0.25], np.float32), kind="stable"), kind="stable")
    start = (rank * count // len(rank)).astype(np.int32)[:, None]
    stop = (cv2.TERM_CRITERIA_MAX_ITER, 8, 0.0)
    _, _, centres = cv2.kmeans(some, count, start, stop, 1, cv2.KMEANS_USE_INITIAL_LABELS)
    apart = (centres * centres).sum(1) - 2 * colours @ centres.T
    return np.asarray(apart.argmin(1), np.int64).reshape(photo.shape[:2])


def _walked(
    photo: NDArray[np.uint8], inside: Mask, open_: Mask, prior: Array, settings: MaskExtensionSettings
) -> Array:
    """Shares (h, w) that are smooth but across edges, 1 inside, near the prior where open, 0 elsewhere."""
    values = photo.astype(np.float32) / 255
    known = inside.astype(np.float32)
    index = np.cumsum(open_.ravel()).reshape(open_.shape) - 1
    count = int(open_.sum())
    weight = np.full(count, settings.pull, np.float64)
    target = settings.pull * prior[open_].astype(np.float64)
    rows, columns, links = [], [], []
    for a, b in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        apart = ((values[a] - values[b]) ** 2).sum(-1)
        link = np.exp(-apart / (2 * settings.contrast**2)).astype(np.float64) + 1e-3
        for p, q in ((a, b), (b, a)):
            mine = open_[p]
            np.add.at(weight, index[p][mine], link[mine])
            np.add.at(target, index[p][mine], (link * known[q] * ~open_[q])[mine])
            pair = mine & open_[q]
            rows.append(index[p][pair])
            columns.append(index[q][pair])
            links.append(-link[pair])
    matrix = coo_array((np.concatenate(links), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    matrix = (matrix + diags_array(weight)).tocsr()
    solved, _ = cg(matrix, target, x0=prior[open_].astype(np.float64), rtol=1e-3, maxiter=60)
    found = known.copy()
    found[open_] = solved
    return found
