"""Fill upright surfaces in a hole by copying columns of the same photograph from the side.

Walls, hedges and fences continue next to a car. Each hidden column copies another one from the hole's upper edge
to its foot, so that surfaces stay upright and sharp; adjacent columns copy adjacent columns unless a seam is
cheap. Dynamic programming finds the best assignment (shift-maps, Pritch et al., ICCV 2009, with one seam per
column) among long runs, because the eye notices short repeated ones first. Columns that fit no long run are not
copied. Copies are scaled with their foot's distance from the horizon, as walls along a road are.
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
    """Options of the column copy. Lengths in px are of the resized photograph except `settle_px`."""

    scale: float = 0.5
    """Size of the photograph at which columns are compared."""
    reach_px: int = 220
    """Largest tried shift."""
    step_px: int = 2
    """Step between tried shifts."""
    ring_px: int = 7
    """Width of the ring of known pixels around the hole that must agree with the copy's surroundings."""
    guess_px: float = 5.0
    """Blur at which a copy is compared with the guide."""
    most: float = 0.06
    """Bound of one pixel's squared colour difference."""
    most_ring: float = 0.25
    """The same in the ring."""
    ring_weight: float = 3.0
    """Weight of differences in the ring."""
    guess_weight: float = 3.0
    """Weight of differences from the guide."""
    seam_weight: float = 15.0
    """Weight of differences at seams."""
    far: float = 0.4
    """Cost per pixel of a shift by 100 px, in units of `most`."""
    jump: float = 3.0
    """Cost per pixel of a seam, in units of `most`."""
    again: float = 8.0
    """Factor on that cost where a seam shows something twice."""
    leave: float = 0.3
    """Cost per pixel of a column above which it is not copied."""
    least_px: int = 36
    """Least number of columns with one shift; half the width of a narrower hole."""
    settle: float = 0.75
    """Share of the difference from the guide's mean colour that is removed from the copy."""
    settle_px: float = 10.0
    """Blur of that difference, px of the full-size photograph."""

    def scaled_down(self, shrink: int) -> ColumnCopySettings:
        """The settings for a photograph at one over `shrink` of its size."""
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
"""Smaller shifts smear."""
_SAMPLES = 16
"""Heights at which two copies of a column are compared."""
_LEAST_HEIGHT_PX = 5.0
"""Least distance of a foot from the horizon for scaling."""
_LEAST_RATIO, _MOST_RATIO = 0.7, 1.45
"""Bounds of a source's size over its copy's: beyond, copies blur or show another street."""
_FOOT_PX = 12.0
"""Smoothing of the feet along the street: their noise must not distort the copies."""
_FORBIDDEN_COST = 4.0
"""Cost, in units of `most`, of copying a forbidden pixel."""


@dataclass(frozen=True, slots=True)
class ColumnCopy:
    """A photograph with copied columns."""

    image: Image
    """(H, W, 3) in [0, 1]."""
    copied: Mask
    """(H, W), the copied pixels."""


def copy_columns(
    image: Image,
    hole: Mask,
    forbidden: Mask,
    guide: StreetContinuation,
    horizon: float,
    settings: ColumnCopySettings | None = None,
) -> ColumnCopy:
    """Fill the upright part of a hole with columns from its sides.

    Args:
        image: (H, W, 3) in [0, 1].
        hole: Pixels (H, W) to fill.
        forbidden: Pixels (H, W) not to copy: ground, vehicles, the hole.
        guide: The street's smooth continuation and its ground.
        horizon: Its row, px.
        settings: Options of the copy.

    Returns:
        The image and the pixels that were filled, which may be fewer than the hole's.
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
    column = np.minimum((np.arange(width) * settings.scale).astype(np.int64), shifts.size - 1)
    moved = np.isfinite(shifts[column])
    source = np.arange(width) + np.where(moved, np.rint(shifts[column] / settings.scale), 0)
    ratio = _size_ratio(heights, np.arange(width), source)
    u = np.ascontiguousarray(np.broadcast_to(source.astype(np.float32), (height, width)))
    v = (horizon + (np.arange(height)[:, None] - horizon) * ratio).astype(np.float32)
    copy = cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    blocked = forbidden.astype(np.float32)
    bad = cv2.remap(blocked, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1.0,))
    copied = hole & (bad < 0.01) & moved
    copy = copy + settings.settle * masked_blur(guide.image - copy, copied, settings.settle_px)
    return ColumnCopy(np.where(copied[..., None], np.clip(copy, 0, 1), image).astype(np.float32), copied)


def _wall_heights(foot: Rows, horizon: float) -> Rows:
    """Smooth heights (W,) px from the horizon down to the foot."""
    return np.maximum(gaussian_filter1d(foot, _FOOT_PX, mode="nearest") - horizon, _LEAST_HEIGHT_PX)


def _size_ratio(heights: Rows, columns: NDArray[np.int64], where: Rows) -> Rows:
    """Size of each source over its copy's."""
    source = np.interp(where, np.arange(heights.size), heights)
    return np.clip(source / heights[columns], 1 / _MOST_RATIO, 1 / _LEAST_RATIO)


class _ColumnSearch:
    """Search for the shift of each column, on the resized photograph."""

    def __init__(
        self,
        image: Image,
        hole: Mask,
        forbidden: Mask,
        guide: Image,
        street: tuple[Rows, float],
        settings: ColumnCopySettings,
    ) -> None:
        """`hole` (h, w) is resized; the others are not. `street`: wall heights (W,) px and the horizon's row."""
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
        """Shifts (w,) px of the resized photograph; nan in columns that are not copied."""
        chosen = np.full(self.hole.shape[1], np.nan)
        columns = np.flatnonzero(self.hole.any(0))
        costs, samples = self._costs(columns)
        pixels = self.hole.sum(0).astype(np.float32)[columns]
        compared = pixels + self.ring.sum(0)[columns]
        for run in np.split(np.arange(columns.size), np.flatnonzero(np.diff(columns) > 1) + 1):
            limit = self.settings.leave * compared[run]
            least = min(self.settings.least_px, (run.size + 1) // 2)
            path = self._path(np.minimum(costs[run], limit[:, None]), samples[run], pixels[run], least)
            long = _long_runs(costs[run, path] < limit, path, least)
            chosen[columns[run[long]]] = self.shifts[path[long]]
        return chosen

    def _costs(self, columns: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Cost (columns, shifts) of each copy, and its sampled colours (columns, shifts, samples * 3)."""
        settings = self.settings
        used = np.flatnonzero((self.hole | self.ring)[:, columns].any(1))
        rows = np.arange(used[0], used[-1] + 1)
        part = np.ix_(rows, columns)
        hole, ring, image, guide = self.hole[part], self.ring[part], self.image[part], self.guide[part]
        height, width = self.hole.shape
        # One flat index is twice as fast as two.
        colours, smooth, forbidden = self.image.reshape(-1, 3), self.smooth.reshape(-1, 3), self.forbidden.ravel()
        top, last = hole.argmax(0), len(rows) - 1 - hole[::-1].argmax(0)
        sample = np.rint(top + (last - top) * np.linspace(0, 1, _SAMPLES)[:, None]).astype(np.int64)
        costs = np.empty((columns.size, self.shifts.size), np.float32)
        samples = np.empty((columns.size, self.shifts.size, _SAMPLES * 3), np.float32)
        for k, shift in enumerate(self.shifts.tolist()):
            where = columns + shift
            ratio = _size_ratio(self.heights, columns, where.astype(np.float64))
            v = np.rint(self.horizon + (rows[:, None] - self.horizon) * ratio).astype(np.int64)
            u = np.broadcast_to(where, v.shape)
            outside = (v < 0) | (v >= height) | (u < 0) | (u >= width)
            at = v.clip(0, height - 1) * width + u.clip(0, width - 1)
            copy, bad = colours.take(at, axis=0), forbidden.take(at) | outside
            apart = np.minimum(channel_square_sum(copy - image), settings.most_ring)
            cost = settings.ring_weight * np.where(bad, settings.most, apart) * ring
            guess = np.minimum(channel_square_sum(smooth.take(at, axis=0) - guide), settings.most)
            far = settings.far * abs(shift) / 100 * settings.most
            cost = cost + (settings.guess_weight * guess + _FORBIDDEN_COST * settings.most * bad + far) * hole
            costs[:, k] = cost.sum(0)
            samples[:, k] = copy[sample, np.arange(columns.size)].transpose(1, 0, 2).reshape(columns.size, -1)
        return costs, samples

    def _path(
        self, costs: NDArray[np.float32], samples: NDArray[np.float32], pixels: NDArray[np.float32], least: int
    ) -> NDArray[np.int64]:
        """Index of each column's shift: the least sum of costs and seams over runs of at least `least` columns.

        costs (columns, shifts); samples (columns, shifts, samples * 3); pixels (columns,): of the hole.
        """
        settings = self.settings
        count, size = costs.shape
        jump = np.where(self.shifts[:, None] > self.shifts[None], settings.again, 1.0) * settings.jump
        jump = (jump * settings.most).astype(np.float32)
        summed = np.concatenate([np.zeros((1, size)), np.cumsum(costs, 0, dtype=np.float64)])
        # Least cost of the columns so far, the last `least` of them with one shift, and where that shift began.
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
            colour = samples[start]
            square = (colour * colour).sum(1)
            apart = (square[:, None] + square[None] - 2 * colour @ colour.T).clip(0) / _SAMPLES
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
    """The good columns in runs of at least `least` columns with one shift."""
    ends = np.flatnonzero(np.diff(np.where(good, path, -1))) + 1
    parts = np.split(good, ends)
    return np.concatenate([part & (part.size >= least) for part in parts])
