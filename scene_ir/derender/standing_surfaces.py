"""What stands behind the cars: columns of the same photograph, moved sideways.

Walls, hedges and fences go on beside a car. Each hidden column copies another one, whole from the hole's upper
edge down to its foot, so what stands stays upright and sharp; columns next to each other copy neighbours unless a
seam is cheap. Of all choices dynamic programming takes the best (shift-maps, Pritch et al., ICCV 2009, with one
seam per column) among long runs: short ones, repeated, are what the eye finds first. What no long run fits is left
to others. Copies grow and shrink with their foot's distance from the horizon, as walls along a road do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from scene_ir.derender.patch_fill import masked_blur
from scene_ir.derender.street import StreetContinuation
from scene_ir.image_filters import channel_square_sum

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Rows = NDArray[np.float64]
_AREA = cv2.INTER_AREA


@dataclass(frozen=True, slots=True)
class ColumnCopySettings:
    """scale: of the photograph at which columns are compared. In px of that size: reach_px, step_px: shifts that
    are tried; ring_px: what is known so near to the hole must agree with what is known beside the copy; guess_px:
    blur at which a copy is held against the guide. Weights of squared differences of colour, one pixel's at most
    `most` (`most_ring` in the ring): ring_weight, guess_weight, seam_weight. far: cost of a shift by 100 px, per
    pixel, in units of `most`. jump: cost of a seam, per pixel, in the same units; again: how often it counts where
    something is shown twice. leave: cost of a column, per pixel, from which on it is left to others. least_px:
    columns that share a shift at least; in a narrower hole half of that. settle, settle_px: how much of the copy's
    mean colour is brought to the guide's, over which distance in px of the photograph.
    """

    scale: float = 0.5
    reach_px: int = 220
    step_px: int = 2
    ring_px: int = 7
    guess_px: float = 5.0
    most: float = 0.06
    most_ring: float = 0.25
    ring_weight: float = 3.0
    guess_weight: float = 3.0
    seam_weight: float = 15.0
    far: float = 0.4
    jump: float = 3.0
    again: float = 8.0
    leave: float = 0.3
    least_px: int = 36
    settle: float = 0.75
    settle_px: float = 10.0

    def scaled_down(self, shrink: int) -> ColumnCopySettings:
        """For a photograph at one over `shrink` of its size: the same lengths of what is to be seen."""
        return replace(
            self,
            reach_px=self.reach_px // shrink,
            step_px=max(self.step_px // shrink, 1),
            ring_px=-(-self.ring_px // shrink),
            guess_px=self.guess_px / shrink,
            least_px=self.least_px // shrink,
            settle_px=self.settle_px / shrink,
        )


_LEAST_SHIFT_PX = 4
"""Smaller shifts only smear."""
_SAMPLES = 16
"""Heights at which two copies of a column are compared."""
_LEAST_HEIGHT_PX = 5.0
"""Of a foot below the horizon: what is farther keeps its size."""
_LEAST_RATIO, _MOST_RATIO = 0.7, 1.45
"""Of a source's size to its copy's: more would blur, or show another street."""
_FOOT_PX = 12.0
"""Feet are smoothed so far along the street: their noise must not shake what stands on them."""
_FORBIDDEN_COST = 4.0
"""Cost, in units of `most`, of a pixel that must not be copied."""


@dataclass(frozen=True, slots=True)
class ColumnCopy:
    """image (H, W, 3) with what was copied; done (H, W): those pixels."""

    image: Image
    copied: Mask


def copy_columns(
    image: Image,
    hole: Mask,
    forbidden: Mask,
    guide: StreetContinuation,
    horizon: float,
    settings: ColumnCopySettings | None = None,
) -> ColumnCopy:
    """The image with the upright part of the hole copied from columns beside it.

    image (H, W, 3) in [0, 1]; hole, forbidden (H, W): what to fill, and what must not be copied: ground, other
    vehicles, the hole; guide: roughly what is to be seen, and where ground is; horizon: its row, px. Pixels that
    the best columns do not show are left to others.
    """
    settings = settings or ColumnCopySettings()
    hole = hole & ~guide.ground
    height, width = hole.shape
    size = (max(round(width * settings.scale), 1), max(round(height * settings.scale), 1))
    small = cv2.resize(hole.astype(np.float32), size, interpolation=_AREA) > 0.3
    if not small.any():
        return ColumnCopy(image.copy(), np.zeros_like(hole))
    heights = _wall_heights(guide.foot, horizon)
    shifts = _ColumnSearch(image, small, forbidden, guide.image, (heights, horizon), settings).best_shifts()
    place = np.minimum((np.arange(width) * settings.scale).astype(np.int64), shifts.size - 1)
    moved = np.isfinite(shifts[place])
    where = np.arange(width) + np.where(moved, np.rint(shifts[place] / settings.scale), 0)
    ratio = _size_ratio(heights, np.arange(width), where)
    u = np.ascontiguousarray(np.broadcast_to(where.astype(np.float32), (height, width)))
    v = (horizon + (np.arange(height)[:, None] - horizon) * ratio).astype(np.float32)
    copy = cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    blocked = forbidden.astype(np.float32)
    bad = cv2.remap(blocked, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1.0,))
    done = hole & (bad < 0.01) & moved
    copy = copy + settings.settle * masked_blur(guide.image - copy, done, settings.settle_px)
    return ColumnCopy(np.where(done[..., None], np.clip(copy, 0, 1), image).astype(np.float32), done)


def _wall_heights(foot: Rows, horizon: float) -> Rows:
    """Heights (W,) px from the horizon down to the foot, smooth."""
    return np.maximum(gaussian_filter1d(foot, _FOOT_PX, mode="nearest") - horizon, _LEAST_HEIGHT_PX)


def _size_ratio(heights: Rows, columns: NDArray[np.int64], where: Rows) -> Rows:
    """Size of the source against its copy's."""
    source = np.interp(where, np.arange(heights.size), heights)
    return np.clip(source / heights[columns], 1 / _MOST_RATIO, 1 / _LEAST_RATIO)


class _ColumnSearch:
    """The shift of each column at the size at which columns are compared."""

    def __init__(
        self,
        image: Image,
        hole: Mask,
        forbidden: Mask,
        guide: Image,
        street: tuple[Rows, float],
        settings: ColumnCopySettings,
    ) -> None:
        """hole (h, w): at the smaller size; all else of the photograph's; street: heights of the feet, horizon."""
        self.settings, self.hole = settings, hole
        height, width = hole.shape

        def small(values: Image) -> Image:
            return np.asarray(cv2.resize(values, (width, height), interpolation=_AREA), np.float32)

        self.image, self.guide = small(image), small(guide)
        self.forbidden = small(forbidden.astype(np.float32)) > 0
        heights, horizon = street
        self.horizon = horizon * settings.scale
        columns = (np.arange(width) + 0.5) / settings.scale
        self.heights = np.interp(columns, np.arange(heights.size), heights) * settings.scale
        reach = np.ones((2 * settings.ring_px + 1, 2 * settings.ring_px + 1), np.uint8)
        above_foot = np.arange(height)[:, None] < self.horizon + self.heights
        self.ring = (cv2.dilate(hole.astype(np.uint8), reach) > 0) & ~self.forbidden & above_foot
        self.smooth = masked_blur(self.image, ~self.forbidden, settings.guess_px)
        shifts = np.arange(-settings.reach_px, settings.reach_px + 1, settings.step_px)
        self.shifts = shifts[np.abs(shifts) >= _LEAST_SHIFT_PX]

    def best_shifts(self) -> Rows:
        """Shifts (w,) px of this size; nan in columns without a hole."""
        chosen = np.full(self.hole.shape[1], np.nan)
        columns = np.flatnonzero(self.hole.any(0))
        costs, looks = self._costs(columns)
        pixels = self.hole.sum(0).astype(np.float32)[columns]
        judged = pixels + self.ring.sum(0)[columns]
        for run in np.split(np.arange(columns.size), np.flatnonzero(np.diff(columns) > 1) + 1):
            limit = self.settings.leave * judged[run]
            least = min(self.settings.least_px, (run.size + 1) // 2)
            path = self._path(np.minimum(costs[run], limit[:, None]), looks[run], pixels[run], least)
            kept = _long_runs(costs[run, path] < limit, path, least)
            chosen[columns[run[kept]]] = self.shifts[path[kept]]
        return chosen

    def _costs(self, columns: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Cost (columns, shifts) of each copy, and its colours (columns, shifts, samples * 3)."""
        settings = self.settings
        used = np.flatnonzero((self.hole | self.ring)[:, columns].any(1))
        rows = np.arange(used[0], used[-1] + 1)
        part = np.ix_(rows, columns)
        hole, ring, image, guide = self.hole[part], self.ring[part], self.image[part], self.guide[part]
        height, width = self.hole.shape
        # By one index: two take twice as long.
        colours, smooth, forbidden = self.image.reshape(-1, 3), self.smooth.reshape(-1, 3), self.forbidden.ravel()
        top, last = hole.argmax(0), len(rows) - 1 - hole[::-1].argmax(0)
        sample = np.rint(top + (last - top) * np.linspace(0, 1, _SAMPLES)[:, None]).astype(np.int64)
        costs = np.empty((columns.size, self.shifts.size), np.float32)
        looks = np.empty((columns.size, self.shifts.size, _SAMPLES * 3), np.float32)
        for k, shift in enumerate(self.shifts.tolist()):
            where = columns + shift
            ratio = _size_ratio(self.heights, columns, where.astype(np.float64))
            v = np.rint(self.horizon + (rows[:, None] - self.horizon) * ratio).astype(np.int64)
            u = np.broadcast_to(where, v.shape)
            outside = (v < 0) | (v >= height) | (u < 0) | (u >= width)
            at = v.clip(0, height - 1) * width + u.clip(0, width - 1)
            found, bad = colours.take(at, axis=0), forbidden.take(at) | outside
            apart = np.minimum(channel_square_sum(found - image), settings.most_ring)
            cost = settings.ring_weight * np.where(bad, settings.most, apart) * ring
            guess = np.minimum(channel_square_sum(smooth.take(at, axis=0) - guide), settings.most)
            far = settings.far * abs(shift) / 100 * settings.most
            cost = cost + (settings.guess_weight * guess + _FORBIDDEN_COST * settings.most * bad + far) * hole
            costs[:, k] = cost.sum(0)
            looks[:, k] = found[sample, np.arange(columns.size)].transpose(1, 0, 2).reshape(columns.size, -1)
        return costs, looks

    def _path(
        self, costs: NDArray[np.float32], looks: NDArray[np.float32], pixels: NDArray[np.float32], least: int
    ) -> NDArray[np.int64]:
        """Index of each column's shift: least sum of costs and seams over runs of at least so many columns.

        costs (columns, shifts); looks (columns, shifts, samples * 3); pixels (columns,): of the hole.
        """
        settings = self.settings
        count, size = costs.shape
        jump = np.where(self.shifts[:, None] > self.shifts[None], settings.again, 1.0) * settings.jump
        jump = (jump * settings.most).astype(np.float32)
        summed = np.concatenate([np.zeros((1, size)), np.cumsum(costs, 0, dtype=np.float64)])
        # Of the columns so far, the last `least` of them with the same shift; and where that shift began.
        total = np.full((count + 1, size), np.inf)
        began = np.zeros((count + 1, size), np.int64)
        before = np.full((count + 1, size), -1, np.int64)
        stay = np.arange(size)
        for end in range(least, count + 1):
            start = end - least
            if start == 0:
                total[end] = summed[end]
                continue
            total[end], began[end] = total[end - 1] + costs[end - 1], began[end - 1]
            before[end] = before[end - 1]
            if start < least:
                continue
            look = looks[start]
            square = (look * look).sum(1)
            apart = (square[:, None] + square[None] - 2 * look @ look.T).clip(0) / _SAMPLES
            seam = (settings.seam_weight * np.minimum(apart, settings.most) + jump) * pixels[start]
            reached = total[start][:, None] + seam
            last = reached.argmin(0)
            new = reached[last, stay] + summed[end] - summed[start]
            better = new < total[end]
            total[end] = np.where(better, new, total[end])
            began[end] = np.where(better, start, began[end])
            before[end] = np.where(better, last, before[end])
        path = np.empty(count, np.int64)
        end, shift = count, int(total[count].argmin())
        while end > 0:
            start, last = int(began[end, shift]), int(before[end, shift])
            path[start:end] = shift
            end, shift = start, last
        return path


def _long_runs(good: NDArray[np.bool_], path: NDArray[np.int64], least: int) -> NDArray[np.bool_]:
    """The good columns of runs with one shift that are at least so long."""
    ends = np.flatnonzero(np.diff(np.where(good, path, -1))) + 1
    parts = np.split(good, ends)
    return np.concatenate([part & (part.size >= least) for part in parts])
