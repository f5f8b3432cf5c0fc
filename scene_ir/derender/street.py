"""Continue a street smoothly into unknown pixels: lane lines, kerbs and verges along the road, colours sideways.

Edges on the ground vote for the road's heading and curvature. The ground is laid out in metres and straightened
along the road. What stays the same along the road is a profile across it; the rest is continued sideways, row by
row. Upright surfaces and the sky are continued separately, so that no colours run across the ground's end. The
result is smooth but has the street's structure; `standing_surfaces` and `patch_fill` add the texture. Huang et al.
(SIGGRAPH 2014) guide completion by planes and their translations in a similar way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from scene_ir.image_filters import channel_max, channel_mean, push_pull
from scene_ir.types import Camera

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_HEADINGS = np.linspace(-0.5, 0.5, 81)
"""Tried slopes of the road against the camera's axis."""
_BENDS = np.linspace(-0.012, 0.012, 13)
"""Tried curvatures, 1/m: down to a radius of 83 m."""
_VOTERS = 6000
"""Edge pixels that vote, divided by the square of `coarse`."""
_VOTE_M = 45.0
"""Edges nearer than this vote."""
_VOTE_SLOPE = 0.03
"""Difference in slope at which an edge's vote falls to 1/e."""
_BEND_COST = 4.0
"""Share of the votes that each 1/m of curvature costs: straight roads are likelier."""
_EDGE = 0.08
_ACROSS_M, _ALONG = 0.07, 0.03
"""Size of the profile's cells: m across, and natural logarithm of the distance."""
_COLUMNS, _ROWS = 700, 160
_AROUND = 12.0
"""Blur across the profile, in columns: 0.8 m, wider than lines and narrower than a shadow."""
_TINT = 0.15
"""Difference in tint from the street's colour at which a ground cell has half weight."""
_SQUASH = 8
"""Columns averaged into one before colours are continued, so that they go on sideways."""
_FAR_M = 90.0
"""Ground beyond is not distinguished from upright surfaces."""
_ROBUST = 0.04
"""Difference from the profile at which a pixel has half weight."""
_MARKING = 0.08
"""Difference from the surrounding ground at which a ground pixel has half weight in the sideways continuation."""
_DOUBT = 1.0
"""Splits of a column are equally good up to this many more px of the wrong class."""
_PAVEMENT_M = 2.5
"""Width of the ground between certain ground, such as a parking space, and walls and hedges: a pavement."""
_FARTHEST_M = 7.0
"""Most hidden ground where the foot is known on one side only."""
_FIT_PX, _MIN_COLUMNS = 100, 20
"""Range and least number of columns next to a hidden stretch that the foot is extrapolated from."""
_FAR_PX = 60
"""This near to the vanishing point, a foot is the road's far end, not a wall's."""
_DROP = 2.0
"""Rows per column by which the skyline falls behind the edge of a tree or house."""
_PAINT_PX = 6.0
"""Colours of walls this near to unknown pixels are not used."""
_SURE_PX = 8
"""Range of good splits up to which a column counts as known."""


@dataclass(frozen=True, slots=True)
class StreetShares:
    """Shares of ground and sky in known pixels."""

    ground: NDArray[np.float32]
    """(H, W) in [0, 1]."""
    sky: NDArray[np.float32]
    """(H, W) in [0, 1]."""
    stood: Mask
    """(H, W), footprints of vehicles: hidden ground."""
    flat: NDArray[np.float32] | None = None
    """(H, W) in [0, 1], share of ground given that a pixel shows no vehicle; by default the same as `ground`."""


@dataclass(frozen=True, slots=True)
class GroundCoordinates:
    """Point at which each pixel's ray meets the ground."""

    across: NDArray[np.float32]
    """(H, W) m to the right."""
    along: NDArray[np.float32]
    """(H, W) m ahead; inf above the horizon."""


@dataclass(frozen=True, slots=True)
class StreetContinuation:
    """A photograph with its street continued into unknown pixels."""

    image: Image
    """(H, W, 3), known pixels and their smooth continuation."""
    ground: Mask
    """(H, W), pixels of ground, hidden ones by interpolation."""
    heading: float
    """Slope of the road against the camera's axis."""
    bend: float
    """Curvature of the road, 1/m."""
    foot: NDArray[np.float64]
    """(W,), row of the ground's end."""


def ground_coordinates(ground: torch.Tensor, camera: Camera) -> GroundCoordinates:
    """Ground coordinates of a camera's pixels; `ground` (4,) is the plane n.x + d = 0."""
    matrix = camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    centre = -inverse @ matrix[:, 3]
    plane = ground.double().numpy()
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = inverse[:, 0] * u[..., None] + inverse[:, 1] * v[..., None] + inverse[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = -(plane[:3] @ centre + plane[3]) / (ray @ plane[:3])
    seen = np.isfinite(step) & (step > 0) & (step < 400)
    step = np.where(seen, step, 0)
    across = np.where(seen, centre[0] + step * ray[..., 0], 0)
    along = np.where(seen, centre[2] + step * ray[..., 2], np.inf)
    return GroundCoordinates(across.astype(np.float32), np.where(along > 0, along, np.inf).astype(np.float32))


def continue_street(
    image: Image,
    unknown: Mask,
    share: StreetShares,
    plane: GroundCoordinates,
    horizon: float,
    coarse: int = 1,
) -> StreetContinuation:
    """Continue the street of the known pixels into the unknown ones.

    Args:
        image: (H, W, 3) in [0, 1].
        unknown: Pixels (H, W) that must not be used.
        share: Shares of ground and sky in known pixels.
        plane: Ground coordinates of the pixels.
        horizon: Its row, px.
        coarse: Size of the profile's cells, in those of a full-size photograph.

    Returns:
        The continued photograph and the road's course.
    """
    rows = np.arange(image.shape[0])[:, None]
    seen = ~unknown & (share.ground > 0.5)
    heading, bend = estimate_road_course(image, seen & (plane.along < _VOTE_M), plane, _VOTERS // coarse**2)
    level = np.where(share.stood, 1, share.ground).astype(np.float32)
    foot = find_foot_rows(level, unknown & ~share.stood, plane, horizon, _vanishing_column(plane, heading))
    below = rows >= foot[None]
    ground = below & (plane.along < _FAR_M)
    sky = (rows < find_skyline_rows(share.sky, unknown, horizon)[None]) & ~below
    upright = ~ground & ~sky
    # Known pixels are classified by their own shares: trees in front of the sky, signs on the verge.
    flat = np.where(unknown, ground, ground & ((share.ground if share.flat is None else share.flat) > 0.5))
    clear = np.where(unknown, sky, share.sky > 0.5)
    along = np.where(flat, plane.along, 1.0)
    straight = plane.across - heading * along - bend * along**2 / 2
    rows, columns = _ROWS // coarse, _COLUMNS // coarse
    column = np.rint(straight / (coarse * _ACROSS_M)).astype(np.int64) + columns // 2
    row = np.rint(np.log(np.maximum(along, 1.0)) / (coarse * _ALONG)).astype(np.int64)
    laid_out = flat & (column >= 0) & (column < columns) & (row < rows)
    cell = np.where(laid_out, row * columns + column, 0)
    local, profile = _road_profile(image, cell, laid_out & ~unknown, coarse)
    local = np.where(laid_out[..., None], local.reshape(-1, 3)[cell], 0)
    profile = np.where(laid_out[..., None], profile.reshape(-1, 3)[cell], 0)
    rest = (image - profile).astype(np.float32)
    # Lines, dashes and crossings differ from the ground around them; continued, they would smear.
    marking = channel_max(np.abs(image - local)) / _MARKING
    weight = np.where(unknown | ~flat, 0, np.where(laid_out, 1 / (1 + marking**4), 1)).astype(np.float32)
    guess = _fill_sideways(rest, weight) + profile
    # Paint at the borders of removed cars must not tint the walls behind them.
    apart = cv2.distanceTransform((~unknown).astype(np.uint8), cv2.DIST_L2, 5) > _PAINT_PX
    standing = (apart & ~flat & ~clear).astype(np.float32)
    walls = (_fill_sideways(image, standing) + push_pull(image, standing)) / 2
    guess = np.where(upright[..., None], walls, guess)
    guess = np.where(sky[..., None], _fill_sideways(image, (~unknown & clear).astype(np.float32)), guess)
    guess = np.clip(guess, 0, 1)
    return StreetContinuation(
        np.where(unknown[..., None], guess, image).astype(np.float32), ground, heading, bend, foot
    )


def _vanishing_column(plane: GroundCoordinates, heading: float) -> float:
    """Column of the road's vanishing point: where the farthest row of the ground lies straight ahead."""
    rows = np.flatnonzero((plane.along < 399).all(1))
    if rows.size == 0:
        return plane.along.shape[1] / 2
    return float(np.abs(plane.across[rows[0]] - heading * plane.along[rows[0]]).argmin())


def find_foot_rows(
    ground: NDArray[np.float32], unknown: Mask, plane: GroundCoordinates, horizon: float, ahead: float
) -> NDArray[np.float64]:
    """Find the row at which each column's ground ends.

    A hidden foot continues straight from the visible columns next to it, at most towards the road's vanishing
    point. Without such columns, walls are assumed `_PAVEMENT_M` beyond the last certain ground. A hidden foot
    stays within the hidden rows.

    Args:
        ground: Share of ground (H, W) in known pixels.
        unknown: Hidden pixels (H, W).
        plane: Ground coordinates of the pixels.
        horizon: Its row, px.
        ahead: Column of the road's vanishing point.

    Returns:
        Rows (W,).
    """
    height = ground.shape[0]
    start = int(np.clip(np.ceil(horizon + 1), 0, height - 2))
    top, bottom = (start + part for part in _class_splits(ground[start:], unknown[start:]))
    columns = np.arange(len(top))
    sure = bottom - top <= _SURE_PX
    foot = (top + bottom) / 2
    foot[sure] = median_filter(foot[sure], 15, mode="nearest") if sure.any() else foot[sure]
    last = np.minimum(bottom, height - 1).astype(np.int64)
    aside = np.abs(plane.across[last, columns] - (plane.across[last, np.full_like(columns, int(ahead))]))
    default, farthest = (horizon + (last - horizon) * aside / (aside + gap) for gap in (_PAVEMENT_M, _FARTHEST_M))
    edges = np.flatnonzero(np.diff(np.concatenate([[True], sure, [True]]).astype(np.int8)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        here = columns[first:end]
        left = _extrapolate_foot(columns, foot, sure & (columns < first), (horizon, ahead), here)
        right = _extrapolate_foot(columns, foot, sure & (columns >= end), (horizon, ahead), here)
        if left is None or right is None:
            side = right if left is None else left
            foot[here] = default[here] if side is None else np.maximum(side, farthest[here])
        elif (first - 1 - ahead) * (end - ahead) > 0:
            foot[here] = np.interp(here, [first - 1, end], [foot[first - 1], foot[end]])
        else:
            foot[here] = np.maximum(left, right)
    return np.clip(foot, np.where(sure, foot, top), np.where(sure, foot, bottom))


def _extrapolate_foot(
    columns: NDArray[np.int64],
    foot: NDArray[np.float64],
    known: Mask,
    vanishing: tuple[float, float],
    to: NDArray[np.int64],
) -> NDArray[np.float64] | None:
    """Rows at columns `to` of the line through the known columns next to them; None if these determine no line."""
    horizon, ahead = vanishing
    near = columns[known & (np.abs(columns - to.mean()) < to.size / 2 + _FIT_PX)]
    if near.size < _MIN_COLUMNS:
        return None
    end = near[np.abs(near - to.mean()).argmin()]
    apart = float(end - ahead)
    one_side = bool(((to - ahead) * apart > 0).any())
    if not one_side or abs(apart) < _FAR_PX:
        return None
    drop = float(foot[end] - horizon)
    slope = float(np.polyfit(near, foot[near], 1)[0])
    share = float(np.clip(slope * apart / max(drop, 1.0), 0, 1))
    return foot[end] + share * drop / apart * (to - end)


def find_skyline_rows(sky: NDArray[np.float32], unknown: Mask, horizon: float) -> NDArray[np.float64]:
    """Find the row of each column's skyline, below which there is no sky.

    A hidden skyline is the lower of both sides: a tree or house that rises above the rest ends soon behind its
    edge.

    Args:
        sky: Share of sky (H, W) in known pixels.
        unknown: Hidden pixels (H, W).
        horizon: Its row, px.

    Returns:
        Rows (W,).
    """
    end = int(np.clip(np.ceil(horizon + 1), 2, sky.shape[0]))
    top, bottom = _class_splits(1 - sky[:end], unknown[:end])
    sure = bottom - top <= _SURE_PX
    if not sure.any():
        return top
    columns = np.arange(len(top))
    rows = median_filter(((top + bottom) / 2)[sure], 15, mode="nearest")
    known = columns[sure]
    after = np.searchsorted(known, columns).clip(max=known.size - 1)
    before = (after - 1).clip(min=0)
    left = np.where(known[after] == columns, rows[after], rows[before])
    right = rows[after]
    drop = np.minimum(left + _DROP * abs(columns - known[before]), right + _DROP * abs(known[after] - columns))
    hidden = np.minimum(np.maximum(left, right), drop)
    return np.clip(np.where(sure, np.interp(columns, known, rows), hidden), top, bottom)


def _class_splits(share: NDArray[np.float32], unknown: Mask) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """First and last row (W,) of the equally good splits of each column into other pixels above and a class below,
    by the class's share (H, W) in known pixels.
    """
    height, width = share.shape
    gain = np.where(unknown, 0.0, share - 0.5)
    # The best split has most of the class below it and least above it.
    total = np.concatenate([np.cumsum(gain[::-1], 0)[::-1], np.zeros((1, width))])
    total = 2 * total - gain.sum(0)
    good = total >= total.max(0) - _DOUBT
    return good.argmax(0).astype(float), (height - good[::-1].argmax(0)).astype(float)


def estimate_road_course(
    image: Image, known: Mask, plane: GroundCoordinates, voters: int = _VOTERS
) -> tuple[float, float]:
    """Estimate the road's course: the one that most edges on the ground follow.

    Args:
        image: (H, W, 3) in [0, 1].
        known: Ground pixels (H, W) that may vote.
        plane: Ground coordinates of the pixels.
        voters: About how many edge pixels vote.

    Returns:
        Heading (slope) and curvature (1/m); 0, 0 if there are too few edges.
    """
    smooth: Any = cv2.GaussianBlur(channel_mean(image), (0, 0), 1.0)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)
    strength = np.hypot(gx, gy)
    kernel = np.ones((5, 5), np.uint8)
    inside = cv2.erode(known.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=(0,)) > 0
    rows, columns = np.nonzero(inside & (strength > _EDGE))
    if rows.size < 50:
        return 0.0, 0.0
    every = rows.size // voters + 1
    rows, columns = rows[::every], columns[::every]
    tangent_u, tangent_v = -gy[rows, columns], gx[rows, columns]

    def change(values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Central differences along the edges."""
        right, left = values[rows, columns + 1], values[rows, columns - 1]
        down, up = values[rows + 1, columns], values[rows - 1, columns]
        return ((right - left) * tangent_u + (down - up) * tangent_v) / 2

    across, along = change(plane.across), change(plane.along)
    length = np.maximum(np.hypot(across, along), 1e-9)
    across, along, away = across / length, along / length, plane.along[rows, columns]
    weight = np.minimum(strength[rows, columns], 0.3)
    best = (-np.inf, 0.0, 0.0)
    for bend in _BENDS.tolist():
        slope = _HEADINGS[:, None].astype(np.float32) + np.float32(bend) * away
        votes = np.exp(-(((across - slope * along) / _VOTE_SLOPE) ** 2)) @ weight
        index = int(np.argmax(votes))
        best = max(best, (float(votes[index]) * (1 - _BEND_COST * abs(bend)), float(_HEADINGS[index]), bend))
    return best[1], best[2]


def _road_profile(image: Image, cell: NDArray[np.int64], known: Mask, coarse: int) -> tuple[Image, Image]:
    """The ground's colour around each cell, and the difference of lines along the road from it, both (rows,
    columns, 3) of the straightened ground.
    """
    shape = (_ROWS // coarse, _COLUMNS // coarse)
    where, size = cell[known], shape[0] * shape[1]
    count = np.bincount(where, minlength=size).reshape(shape)
    colour = np.stack([np.bincount(where, image[..., c][known], size) for c in range(3)], -1).reshape(*shape, 3)
    colour = (colour / np.maximum(count, 1)[..., None]).astype(np.float32)
    filled = known_cells = (count > 0).astype(np.float32)

    def mean(values: Image, weight: NDArray[np.float32], sigma: tuple[float, float]) -> tuple[Image, Image]:
        down, across = sigma[0] / coarse, sigma[1] / coarse
        total = cv2.GaussianBlur(weight, (0, 0), sigmaX=across, sigmaY=down)
        blurred = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigmaX=across, sigmaY=down)
        return (blurred / np.maximum(total, 1e-4)[..., None]).astype(np.float32), np.asarray(total, np.float32)

    street, _ = mean(colour, filled, (1.5, 40.0))
    difference = colour - street
    # Car paint has colours that no ground has: an unlabelled car must not continue along the road.
    tint = channel_max(np.abs(difference - channel_mean(difference)[..., None]))
    filled = np.asarray(filled / (1 + (tint / _TINT) ** 4), np.float32)
    weight = filled
    line, total = mean(difference, weight, (10.0, 0.5))
    for _ in range(3):
        # Reweighting brings the mean near to the median: dashes do not become lines, lines stay.
        weight = np.asarray(filled / (1 + (channel_max(np.abs(difference - line)) / _ROBUST) ** 2), np.float32)
        line, total = mean(difference, weight, (10.0, 0.5))
    local, _ = mean(colour, known_cells, (1.5, _AROUND))
    return local, line * np.clip(total * 10, 0, 1)[..., None]


def _fill_sideways(image: Image, weight: NDArray[np.float32]) -> Image:
    """Smooth continuation (H, W, 3), mostly within rows, of weighted pixels; weight (H, W)."""
    height, width = weight.shape
    size = (max(width // _SQUASH, 1), height)
    mass = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(image * weight[..., None], size, interpolation=cv2.INTER_AREA)
    colour = (colour / np.maximum(mass, 1e-6)[..., None]).astype(np.float32)
    smooth = push_pull(colour, np.minimum(mass * 2, 1).astype(np.float32))
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
