"""What stood behind the cars: holes filled by copying patches of the same photograph, coarse to fine.

The fill is Wexler's space-time completion (CVPR 2004) with the randomised nearest-neighbour search of PatchMatch
(Barnes 2009). Copies prefer sources at the same height above or below the horizon, where a road's texture has the
same scale, and where a guide says what is to be seen (`street.continued`), sources that look like it. Everything
is numpy: the same input and seed give the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STEPS = (-3, -1, 0, 1, 3)
_PATTERN = np.array([(dy, dx) for dy in _STEPS for dx in _STEPS if abs(dy) + abs(dx) < 6], np.int64)
"""Sample points of a 7x7 patch: 21 of 49 tell as much of it at less than half the price."""
_RADIUS = 3
_SIDEWAYS = 0.4
"""How much nearer than up and down a pixel to the side counts for the first guess."""


@dataclass(frozen=True, slots=True)
class PatchFillSettings:
    """coarsest_radius: px, pyramid levels are added until no hole is thicker than this; iterations: search rounds
    at the coarsest and finest level; row_weight, column_weight: how much a copy from another height or from far
    away costs against a colour error; confidence_px: how fast trust in a filled pixel falls away from the hole's
    border; search_px: how far from the best source so far others are tried, at the coarsest level in px of the
    full image, then in px of each level; ground_weight: cost of showing no ground where ground must be; guessed:
    weight of a pixel in the hole against one outside, when patches are compared; guide_weight: cost of a source
    whose surroundings, blurred by guide_px, have not the guide's colour; settle_px: over which distance the fill's
    mean colour is brought to the guide's; grain_px: finer detail is each pixel's own source's; keep: a source that
    was drawn by chance must cost less by this factor, so that neighbours keep copying neighbours.
    """

    coarsest_radius: float = 4.0
    max_levels: int = 6
    iterations: tuple[int, int] = (8, 2)
    row_weight: float = 0.05
    column_weight: float = 0.004
    search_px: tuple[float, float] = (160.0, 24.0)
    ground_weight: float = 0.02
    guessed: float = 0.3
    confidence_px: float = 12.0
    guide_weight: float = 3.0
    guide_px: float = 2.5
    settle_px: float = 6.0
    grain_px: float = 1.5
    keep: float = 0.85

    def scaled_down(self, shrink: int) -> PatchFillSettings:
        """For a photograph at one over `shrink` of its size: the same lengths of what is to be seen."""
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
    """wanted (H, W): pixels that see the ground once the cars are gone; like (H, W) in [0, 1]: how much each pixel
    of the photograph looks like ground.
    """

    wanted: Mask
    share: NDArray[np.float32]

    def halved(self, size: tuple[int, int]) -> GroundMaps:
        """At the next coarser level, of `size` (width, height)."""
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
    """The image with `hole` filled from pixels that are not `forbidden`.

    image (H, W, 3) RGB in [0, 1]; hole, forbidden (H, W), forbidden is taken to contain hole; horizon: its row,
    px; ground: where ground is to be seen, and where it can be copied from; guide (H, W, 3): roughly what is to be
    seen, smooth in the hole -> (H, W, 3) in [0, 1], equal to the image outside the hole.
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
    """The fill with fine detail as it is at each pixel's own source: the mean of several sources has lost it."""
    detail = image - masked_blur(image, ~forbidden, sigma)
    smooth = masked_blur(current, np.ones_like(hole), sigma)
    rows, columns = source[hole].T
    result = current.copy()
    result[hole] = smooth[hole] + detail[rows, columns]
    return result


def masked_blur(values: Image, mask: Mask, sigma: float) -> Image:
    """Gaussian mean (H, W, 3), sigma px, of the values (H, W, 3) in the mask (H, W)."""
    weight = mask.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    mean = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma) / np.maximum(total, 1e-3)[..., None]
    return np.asarray(mean, np.float32)


def mirror_sources(unknown: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (H, W) of a first guess: each unknown pixel copies what lies mirrored at the hole's nearest
    end.

    unknown (H, W), not everywhere. Sideways counts as nearer than up and down, since streets run on sideways
    behind a car: hedge, wall, kerb, road. Known pixels point to themselves.
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
    """`mirrored`, with ground from the nearest ground where ground must be."""
    rows, columns = mirror_sources(unknown)
    other = unknown | (ground.share < 0.5)
    if other.all():
        return rows, columns
    ground_rows, ground_columns = mirror_sources(other)
    take = ground.wanted & unknown
    return np.where(take, ground_rows, rows), np.where(take, ground_columns, columns)


def _distance(mask: Mask) -> NDArray[np.float32]:
    """Distance (H, W) px of each pixel in the mask to the nearest one outside."""
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _halve(image: Image, hole: Mask, forbidden: Mask) -> tuple[Image, Mask, Mask]:
    """The next coarser level: colours averaged over allowed pixels only, masks by maximum."""
    size = ((image.shape[1] + 1) // 2, (image.shape[0] + 1) // 2)
    allowed = (~forbidden).astype(np.float32)
    weight = cv2.resize(allowed, size, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(image * allowed[..., None], size, interpolation=cv2.INTER_AREA)
    plain = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    colour = np.where(weight[..., None] > 0.2, colour / np.maximum(weight, 1e-6)[..., None], plain)
    half_hole = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    return colour.astype(np.float32), half_hole, (weight < 0.5) | half_hole


class _Level:
    """One pyramid level of the completion: the current image, its target pixels, and their search for sources."""

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
        # What the photograph shows at the hole's border weighs more than what is only guessed inside.
        certain = np.where(hole, settings.guessed, 1).astype(np.float32)
        certain = cv2.copyMakeBorder(certain, pad, pad, pad, pad, cv2.BORDER_REFLECT).reshape(-1)
        trust = certain[self._flat(self.rows, self.columns)[:, None] + self.offsets]
        self.trust = np.repeat(trust / trust.sum(1, keepdims=True), 3, axis=1)
        self.guide: Image | None = None
        self.blurred = image

    def follow(self, guide: Image) -> None:
        """Prefer sources that look like the guide (H, W, 3) at the place that they are copied to."""
        self.guide = guide[self.rows, self.columns]
        image = self.padded[self.pad : -self.pad, self.pad : -self.pad]
        self.blurred = masked_blur(image, self.allowed, max(self.settings.guide_px / self.scale, 0.7))

    def _flat(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
        return (rows + self.pad) * self.stride + columns + self.pad

    def _patches(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        index = self._flat(rows, columns)[:, None] + self.offsets
        values = self.padded.reshape(-1, 3).take(index, axis=0, mode="clip")
        # Not -1: there may be no row.
        return values.reshape(rows.size, 3 * self.offsets.size)

    def _cost(
        self, which: NDArray[np.int64], rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Cost of source positions for the targets `which`; infinite where copying is not allowed."""
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
        """Take the proposed sources where their cost is below `gain` times the current one."""
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
        """First sources: mirrored ones, or the coarser level's where these are better."""
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
        """Each hole pixel becomes the trust-weighted mean of what the patches around it say."""
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
        """Alternate search and vote. -> the image (H, W, 3) and the sources (H, W, 2), -1 where nothing is
        filled."""
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
