"""Fill holes with patches of the same photograph, from coarse to fine.

Wexler's space-time completion (CVPR 2004) with the randomised nearest-neighbour search of PatchMatch (Barnes
2009). Sources at the same height relative to the horizon are preferred, where a road's texture has the same scale,
and sources that resemble a guide (`street.continue_street`). Pure NumPy: the same input and seed give the same
bytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STEPS = (-3, -1, 0, 1, 3)
_PATTERN = np.array([(dy, dx) for dy in _STEPS for dx in _STEPS if abs(dy) + abs(dx) < 6], np.int64)
"""Sample points of a 7x7 patch: 21 of 49 are as good at less than half the cost."""
_RADIUS = 3
_SIDEWAYS = 0.4
"""Factor on sideways distances in the initial guess."""
_CHUNK = 4096
"""Patches compared at a time, which bounds memory."""


@dataclass(frozen=True, slots=True)
class PatchFillSettings:
    """Options of the patch fill."""

    coarsest_radius: float = 4.0
    """Pyramid levels are added until no hole is thicker than this, px."""
    max_levels: int = 6
    """Largest number of levels."""
    iterations: tuple[int, int] = (8, 0)
    """Search rounds at the coarsest and the finest level, which copies the pixels that the level before it found."""
    row_weight: float = 0.05
    """Cost of copying from another height, against a colour error."""
    column_weight: float = 0.004
    """Cost of copying from far away sideways."""
    search_px: tuple[float, float] = (160.0, 24.0)
    """Range of random trials: at the coarsest level in px of the full image, then in px of each level."""
    ground_weight: float = 0.02
    """Cost of showing no ground where there must be ground."""
    guessed: float = 0.3
    """Weight of a pixel in the hole against one outside when patches are compared."""
    confidence_px: float = 12.0
    """Distance from the hole's border over which confidence in filled pixels falls."""
    guide_weight: float = 3.0
    """Cost of a source with blurred surroundings unlike the guide."""
    guide_px: float = 2.5
    """That blur, px."""
    settle_px: float = 6.0
    """Blur at which the fill's mean colour is adjusted to the guide's, px."""
    grain_px: float = 1.5
    """Detail finer than this, px, is each pixel's own source's."""
    keep: float = 0.85
    """A random source must cost less by this factor, so that neighbours keep copying neighbours."""

    def scaled_down(self, shrink: int) -> PatchFillSettings:
        """The settings for a photograph at one over `shrink` of its size."""
        coarse, fine = self.search_px
        return replace(
            self,
            confidence_px=self.confidence_px / shrink,
            search_px=(coarse / shrink, fine / shrink),
            guide_px=self.guide_px / shrink,
            settle_px=self.settle_px / shrink,
        )


@dataclass(frozen=True, slots=True)
class GroundMaps:
    """Where ground must be, and where there is ground to copy."""

    wanted: Mask
    """(H, W), pixels that show ground once the vehicles are removed."""
    share: NDArray[np.float32]
    """(H, W) in [0, 1], share of ground in each pixel of the photograph."""

    def halved(self, size: tuple[int, int]) -> GroundMaps:
        """The maps at the next coarser level, of `size` (width, height)."""
        wanted = cv2.resize(self.wanted.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
        like = cv2.resize(self.share.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return GroundMaps(wanted, np.asarray(like, np.float32))


def fill_patches(
    image: Image,
    hole: Mask,
    forbidden: Mask,
    horizon: float,
    ground: GroundMaps,
    seed: int = 0,
    settings: PatchFillSettings | None = None,
    guide: Image | None = None,
) -> Image:
    """Fill a hole with patches of the image.

    Args:
        image: (H, W, 3) RGB in [0, 1].
        hole: Pixels (H, W) to fill.
        forbidden: Pixels (H, W) not to copy, besides the hole.
        horizon: Its row, px.
        ground: Where ground must be, and where it can be copied from.
        seed: Of the random search.
        settings: Options of the fill.
        guide: A smooth image (H, W, 3) that the fill should resemble.

    Returns:
        (H, W, 3) in [0, 1], equal to the image outside the hole.
    """
    settings = settings or PatchFillSettings()
    if not hole.any():
        return image.copy()
    forbidden = forbidden | hole
    pyramid = [(image.astype(np.float32), hole, forbidden)]
    grounds, guides = [ground], [guide]
    while len(pyramid) < settings.max_levels and min(pyramid[-1][1].shape) >= 48:
        level_image, level_hole, level_forbidden = pyramid[-1]
        if float(_distance(level_hole).max()) <= settings.coarsest_radius:
            break
        pyramid.append(_halve(level_image, level_hole, level_forbidden))
        size = pyramid[-1][1].shape[::-1]
        grounds.append(grounds[-1].halved(size))
        finer = guides[-1]
        smaller = None if finer is None else cv2.resize(finer, size, interpolation=cv2.INTER_AREA)
        guides.append(None if smaller is None else np.asarray(smaller, np.float32))
    rng = np.random.default_rng(seed)
    source: NDArray[np.int64] | None = None
    current = pyramid[-1][0]
    for index in reversed(range(len(pyramid))):
        level_image, level_hole, level_forbidden = pyramid[index]
        level_guide = guides[index]
        if source is None:
            start = level_image[initial_sources(level_forbidden, grounds[index])]
            if level_guide is not None:
                sigma = max(settings.settle_px / 2**index, 1.0)
                start = start + masked_blur(level_guide - start, level_hole, sigma)
        else:
            size = (level_image.shape[1], level_image.shape[0])
            start = cv2.resize(current, size, interpolation=cv2.INTER_LINEAR)
        start = np.where(level_hole[..., None], start, level_image)
        share = index / max(len(pyramid) - 1, 1)
        rounds = round(settings.iterations[1] + (settings.iterations[0] - settings.iterations[1]) * share)
        level = _Level(start, level_hole, level_forbidden, grounds[index], (horizon, 2**index), settings)
        if level_guide is not None:
            level.follow(level_guide)
        current, source = level.run(source, rounds, rng)
    assert source is not None
    current = _with_grain(current, image, hole, forbidden, source, settings.grain_px)
    if guide is not None:
        current = current + masked_blur(guide - current, hole, settings.settle_px)
    return np.where(hole[..., None], np.clip(current, 0, 1), image).astype(np.float32)


def _with_grain(
    current: Image, image: Image, hole: Mask, forbidden: Mask, source: NDArray[np.int64], sigma: float
) -> Image:
    """The fill with each pixel's own source's fine detail, which the mean of several sources has lost."""
    detail = image - masked_blur(image, ~forbidden, sigma)
    smooth = masked_blur(current, np.ones_like(hole), sigma)
    rows, columns = source[hole].T
    result = current.copy()
    result[hole] = smooth[hole] + detail[rows, columns]
    return result


def masked_blur(values: Image, mask: Mask, sigma: float) -> Image:
    """Gaussian mean of the values inside a mask.

    Args:
        values: (H, W, 3).
        mask: (H, W).
        sigma: Standard deviation, px.

    Returns:
        (H, W, 3).
    """
    x0, y0, width, height = cv2.boundingRect(mask.astype(np.uint8))
    reach = math.ceil(4 * sigma) + 1  # as far as OpenCV's kernel
    part = slice(max(y0 - reach, 0), y0 + height + reach), slice(max(x0 - reach, 0), x0 + width + reach)
    weight = mask[part].astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    mean = np.zeros(values.shape, np.float32)
    coloured = values[part] * weight[..., None]
    mean[part] = cv2.GaussianBlur(coloured, (0, 0), sigma) / np.maximum(total, 1e-3)[..., None]
    return mean


def mirror_sources(unknown: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (H, W) of each pixel mirrored at the nearest end of the unknown area (H, W).

    Sideways counts as nearer, since a street continues sideways behind a car: hedge, wall, kerb, road. Known
    pixels point to themselves. At least one pixel must be known.
    """
    height, width = unknown.shape
    nearest = np.asarray(
        distance_transform_edt(unknown, sampling=(1.0, _SIDEWAYS), return_distances=False, return_indices=True)
    )
    rows, columns = 2 * nearest - np.mgrid[0:height, 0:width]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.where(inside, rows, nearest[0]), np.where(inside, columns, nearest[1])
    known = ~unknown[rows, columns]
    return np.where(known, rows, nearest[0]), np.where(known, columns, nearest[1])


def initial_sources(unknown: Mask, ground: GroundMaps) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`mirror_sources`, with ground from the nearest ground where there must be ground."""
    rows, columns = mirror_sources(unknown)
    other = unknown | (ground.share < 0.5)
    if other.all():
        return rows, columns
    ground_rows, ground_columns = mirror_sources(other)
    take = ground.wanted & unknown
    return np.where(take, ground_rows, rows), np.where(take, ground_columns, columns)


def _distance(mask: Mask) -> NDArray[np.float32]:
    """Distance (H, W) px from each pixel in the mask to the nearest one outside."""
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _halve(image: Image, hole: Mask, forbidden: Mask) -> tuple[Image, Mask, Mask]:
    """The next coarser level: colours averaged over allowed pixels, masks by maximum."""
    size = ((image.shape[1] + 1) // 2, (image.shape[0] + 1) // 2)
    allowed = (~forbidden).astype(np.float32)
    weight = cv2.resize(allowed, size, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(image * allowed[..., None], size, interpolation=cv2.INTER_AREA)
    plain = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    colour = np.where(weight[..., None] > 0.2, colour / np.maximum(weight, 1e-6)[..., None], plain)
    half_hole = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    return colour.astype(np.float32), half_hole, (weight < 0.5) | half_hole


class _Level:
    """One level of the pyramid: the current image, its target pixels, and the search for their sources."""

    def __init__(
        self,
        image: Image,
        hole: Mask,
        forbidden: Mask,
        ground: GroundMaps,
        horizon_and_scale: tuple[float, int],
        settings: PatchFillSettings,
    ) -> None:
        self.settings = settings
        horizon, scale = horizon_and_scale[0] / horizon_and_scale[1], horizon_and_scale[1]
        self.scale = scale
        pad = _RADIUS
        self.pad = pad
        self.padded = np.asarray(cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_REFLECT), np.float32)
        self.height, self.width = hole.shape
        self.stride = self.width + 2 * pad
        kernel = np.ones((2 * _RADIUS + 1, 2 * _RADIUS + 1), np.uint8)
        blocked = cv2.dilate(forbidden.astype(np.uint8), kernel).astype(bool)
        if blocked.all():
            blocked = forbidden
        self.allowed = ~blocked
        self.hole = hole
        target = cv2.dilate(hole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        self.rows, self.columns = np.nonzero(target)
        self.index = np.full(hole.shape, -1, np.int64)
        self.index[target] = np.arange(self.rows.size)
        self.offsets = _PATTERN[:, 0] * self.stride + _PATTERN[:, 1]
        self.ground = ground
        self.wanted = ground.wanted[self.rows, self.columns] * np.float32(settings.ground_weight)
        self.reach = np.maximum(np.abs(self.rows - horizon), 24 / scale).astype(np.float32)
        self.column_unit = 200.0 / scale
        self.confidence = np.exp(-_distance(hole)[target] * scale / settings.confidence_px).astype(np.float32)
        self.confidence = np.maximum(self.confidence, 1e-4)
        # Known pixels at the hole's border weigh more than guessed ones inside.
        certain = np.where(hole, settings.guessed, 1).astype(np.float32)
        certain = cv2.copyMakeBorder(certain, pad, pad, pad, pad, cv2.BORDER_REFLECT).reshape(-1)
        trust = certain[self._flat(self.rows, self.columns)[:, None] + self.offsets]
        self.trust = np.repeat(trust / trust.sum(1, keepdims=True), 3, axis=1)
        self.guide: Image | None = None
        self.blurred = image

    def follow(self, guide: Image) -> None:
        """Prefer sources that resemble the guide (H, W, 3) at their targets."""
        self.guide = guide[self.rows, self.columns]
        image = self.padded[self.pad : -self.pad, self.pad : -self.pad]
        self.blurred = masked_blur(image, self.allowed, max(self.settings.guide_px / self.scale, 0.7))

    def _flat(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
        return (rows + self.pad) * self.stride + columns + self.pad

    def _patches(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        index = self._flat(rows, columns)[:, None] + self.offsets
        values = self.padded.reshape(-1, 3).take(index, axis=0, mode="clip")
        # Not -1: there may be no rows.
        return values.reshape(rows.size, 3 * self.offsets.size)

    def _cost(
        self, which: NDArray[np.int64], rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Cost of source positions for the targets `which`; infinite where copying is not allowed."""
        parts = [slice(start, start + _CHUNK) for start in range(0, which.size, _CHUNK)]
        costs = [self._chunk_cost(which[part], rows[part], columns[part]) for part in parts]
        return np.concatenate(costs) if costs else np.zeros(0, np.float32)

    def _chunk_cost(
        self, which: NDArray[np.int64], rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        difference = self._patches(rows, columns) - self.target_patches[which]
        colour = np.einsum("pk,pk,pk->p", difference, difference, self.trust[which])
        dy = (rows - self.rows[which]) / self.reach[which]
        dx = (columns - self.columns[which]) / self.column_unit
        cost = colour + self.settings.row_weight * dy * dy + self.settings.column_weight * dx * dx
        cost = cost + self.wanted[which] * (1 - self.ground.share[rows, columns])
        if self.guide is not None:
            apart = self.blurred[rows, columns] - self.guide[which]
            cost = cost + self.settings.guide_weight * np.einsum("pk,pk->p", apart, apart)
        return np.where(self.allowed[rows, columns], cost, np.inf).astype(np.float32)

    def _try(
        self, which: NDArray[np.int64], rows: NDArray[np.int64], columns: NDArray[np.int64], gain: float = 1.0
    ) -> None:
        """Accept proposed sources that cost less than `gain` times the current ones."""
        rows = np.clip(rows, 0, self.height - 1)
        columns = np.clip(columns, 0, self.width - 1)
        current = self.source[which]
        new = self.allowed[rows, columns] & ((rows != current[:, 0]) | (columns != current[:, 1]))
        which, rows, columns = which[new], rows[new], columns[new]
        cost = self._cost(which, rows, columns)
        better = cost < gain * self.best[which]
        chosen = which[better]
        self.source[chosen, 0], self.source[chosen, 1] = rows[better], columns[better]
        self.best[chosen] = cost[better]

    def _start(self, coarse: NDArray[np.int64] | None) -> None:
        """Set the initial sources: mirrored ones, or the coarser level's where better."""
        everything = np.arange(self.rows.size)
        rows, columns = initial_sources(~self.allowed, self.ground)
        self.source = np.stack([rows[self.rows, self.columns], columns[self.rows, self.columns]], 1)
        self.best = self._cost(everything, self.source[:, 0], self.source[:, 1])
        if coarse is not None:
            up = coarse[
                np.minimum(self.rows // 2, coarse.shape[0] - 1), np.minimum(self.columns // 2, coarse.shape[1] - 1)
            ]
            parity = np.stack([self.rows % 2, self.columns % 2], 1)
            proposed = np.where(up >= 0, 2 * up + parity, self.source)
            self._try(everything, proposed[:, 0], proposed[:, 1])

    def _search(self, rng: np.random.Generator, step: int, radius: float) -> None:
        """One round: neighbours' offsets, then random positions in shrinking windows."""
        everything = np.arange(self.rows.size)
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            dy, dx = dy * step, dx * step
            rows, columns = self.rows + dy, self.columns + dx
            inside = (rows >= 0) & (rows < self.height) & (columns >= 0) & (columns < self.width)
            neighbour = np.where(
                inside, self.index[rows.clip(0, self.height - 1), columns.clip(0, self.width - 1)], -1
            )
            which = everything[neighbour >= 0]
            near = neighbour[which]
            self._try(which, self.source[near, 0] - dy, self.source[near, 1] - dx, 1 / self.settings.keep)
        while radius >= 1:
            spread_y = np.minimum(radius, 0.5 * self.reach + 2)
            rows = self.source[:, 0] + rng.uniform(-1, 1, self.rows.size) * spread_y
            columns = self.source[:, 1] + rng.uniform(-1, 1, self.rows.size) * radius
            drawn = np.rint(rows).astype(np.int64), np.rint(columns).astype(np.int64)
            self._try(everything, *drawn, self.settings.keep)
            radius /= 3

    def _vote(self) -> None:
        """Set each hole pixel to the confidence-weighted mean of the overlapping patches."""
        flat = self.padded.reshape(-1, 3)
        weight = self.confidence / (self.best + 0.002)
        total = np.zeros((len(flat), 4))
        target = self._flat(self.rows, self.columns)
        source = self._flat(self.source[:, 0], self.source[:, 1])
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                offset = dy * self.stride + dx
                share = weight * (1.0 if dy == dx == 0 else 0.5)
                colour = flat[source + offset] * share[:, None]
                # No target twice: each pixel is added to once.
                total[target + offset] += np.concatenate([colour, share[:, None]], axis=1)
        inner = self._flat(*np.nonzero(self.hole))
        mean = total[inner, :3] / np.maximum(total[inner, 3:], 1e-12)
        flat[inner] = mean.astype(np.float32)

    def run(
        self, coarse: NDArray[np.int64] | None, rounds: int, rng: np.random.Generator
    ) -> tuple[Image, NDArray[np.int64]]:
        """Alternate search and vote.

        Args:
            coarse: Sources (h, w, 2) of the coarser level, if there is one.
            rounds: Number of rounds.
            rng: Of the random trials.

        Returns:
            The image (H, W, 3), and the sources (H, W, 2), -1 where nothing is filled.
        """
        everything = (self.rows, self.columns)
        self.target_patches = self._patches(*everything)
        self._start(coarse)
        radius = (
            max(self.settings.search_px[0] / self.scale, 4.0) if coarse is None else self.settings.search_px[1]
        )
        for round_index in range(rounds):
            self._search(rng, 1 if round_index % 2 == 0 else 2, radius)
            self._vote()
            self.target_patches = self._patches(*everything)
            self.best = self._cost(np.arange(self.rows.size), self.source[:, 0], self.source[:, 1])
        dense = np.full((self.height, self.width, 2), -1, np.int64)
        dense[everything] = self.source
        pad = self.pad
        return self.padded[pad:-pad, pad:-pad], dense
