"""Regions of a tensor that can differ, and the rectangles that cover them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.int64]

_MAX_GROUPS = 80
"""Maximum number of column groups among which rectangles are chosen."""
_OVERHEAD = 0.02
"""Overhead of a rectangle as a share of the whole tensor: calls, and the places around it."""


class Rect(NamedTuple):
    """A rectangle of rows and columns."""

    top: int
    """First row."""
    bottom: int
    """Last row + 1."""
    left: int
    """First column."""
    right: int
    """Last column + 1."""

    @property
    def hw(self) -> tuple[int, int]:
        return self.bottom - self.top, self.right - self.left

    @property
    def area(self) -> int:
        return max(self.bottom - self.top, 0) * max(self.right - self.left, 0)

    def intersect(self, other: Rect) -> Rect:
        """The intersection; of area 0 if they are disjoint."""
        return Rect(
            max(self.top, other.top),
            min(self.bottom, other.bottom),
            max(self.left, other.left),
            min(self.right, other.right),
        )

    def slices_in(self, other: Rect) -> tuple[slice, slice]:
        """Its rows and columns relative to `other`."""
        return (
            slice(self.top - other.top, self.bottom - other.top),
            slice(self.left - other.left, self.right - other.left),
        )


@dataclass(frozen=True, slots=True)
class ReceptiveField:
    """Input rows and columns of a layer's outputs: `extent` from `stride` * i - `padding` on. All in (rows,
    columns).
    """

    extent: tuple[int, int] = (1, 1)
    """Number of inputs."""
    stride: tuple[int, int] = (1, 1)
    """Distance between outputs."""
    padding: tuple[int, int] = (0, 0)
    """Inputs before the first."""

    def input_rect(self, rect: Rect) -> Rect:
        """The input of an output rectangle; it may extend beyond the input."""
        top, left = (s * at - b for s, b, at in zip(self.stride, self.padding, (rect.top, rect.left), strict=True))
        lower, right = (
            s * (at - 1) - b + e
            for s, b, e, at in zip(self.stride, self.padding, self.extent, (rect.bottom, rect.right), strict=True)
        )
        return Rect(top, lower, left, right)


@dataclass(frozen=True, slots=True)
class ColumnRegion:
    """One interval of rows per column; on a road, changes form a band."""

    top: Rows
    """(W,) first row of each column."""
    bottom: Rows
    """(W,) last row + 1; the column is empty if not greater than `top`."""
    height: int
    """Rows of the tensor."""

    @classmethod
    def from_rects(cls, rects: Sequence[Rect], hw: tuple[int, int]) -> ColumnRegion:
        """The region of rectangles in a tensor of size `hw`, including what lies between those of one column."""
        height, width = hw
        top, bottom = np.full(width, height), np.zeros(width, np.int64)
        for rect in rects:
            visible = rect.intersect(Rect(0, height, 0, width))
            if visible.area:
                columns = slice(visible.left, visible.right)
                np.minimum(top[columns], visible.top, out=top[columns])
                np.maximum(bottom[columns], visible.bottom, out=bottom[columns])
        return cls(top, bottom, height)

    @classmethod
    def from_blocks(cls, blocks: NDArray[np.bool_], side: int, hw: tuple[int, int]) -> ColumnRegion:
        """The region of blocks of a tensor.

        Args:
            blocks: (ceil(h / side), ceil(w / side)) bool.
            side: Size of a block.
            hw: Size of the tensor.
        """
        height, width = hw
        covered = blocks.any(0)
        first = np.where(covered, blocks.argmax(0) * side, height)
        end = np.where(covered, np.minimum((len(blocks) - blocks[::-1].argmax(0)) * side, height), 0)
        return cls(np.repeat(first, side)[:width], np.repeat(end, side)[:width], height)

    @property
    def hw(self) -> tuple[int, int]:
        return self.height, len(self.top)

    @property
    def area(self) -> int:
        return int(np.maximum(self.bottom - self.top, 0).sum())

    def embed(self, at: tuple[int, int], hw: tuple[int, int]) -> ColumnRegion:
        """The region in a larger tensor `hw`, in which this one begins at row and column `at`."""
        columns = at[1], hw[1] - at[1] - len(self.top)
        empty = self.bottom <= self.top
        top = np.pad(np.where(empty, hw[0], self.top + at[0]), columns, constant_values=hw[0])
        return ColumnRegion(top, np.pad(np.where(empty, 0, self.bottom + at[0]), columns), hw[0])

    def union(self, other: ColumnRegion) -> ColumnRegion:
        """The smallest region that contains both, of tensors of one size."""
        return ColumnRegion(np.minimum(self.top, other.top), np.maximum(self.bottom, other.bottom), self.height)

    def contains(self, other: ColumnRegion) -> bool:
        """Whether `other`, of a tensor of the same size, lies inside."""
        empty = other.bottom <= other.top
        return bool((empty | ((self.top <= other.top) & (self.bottom >= other.bottom))).all())

    def dilate(self, by: int) -> ColumnRegion:
        """The region grown by `by` rows and columns."""
        return self.propagate(ReceptiveField((2 * by + 1, 2 * by + 1), (1, 1), (by, by)), self.hw)

    def propagate(self, span: ReceptiveField, hw: tuple[int, int]) -> ColumnRegion:
        """The outputs of a layer of size `hw` that depend on the region."""
        height, width = hw
        top, bottom = np.full(width, self.height), np.zeros(width, np.int64)
        starts = np.arange(width) * span.stride[1] - span.padding[1]
        for tap in range(span.extent[1]):
            at = starts + tap
            within = (at >= 0) & (at < len(self.top))
            here = at[within]
            top[within] = np.minimum(top[within], self.top[here])
            bottom[within] = np.maximum(bottom[within], self.bottom[here])
        empty = bottom <= top
        stride, before, extent = span.stride[0], span.padding[0], span.extent[0]
        first = np.maximum(-((extent - 1 - before - top) // stride), 0)
        end = np.minimum((bottom - 1 + before) // stride + 1, height)
        return ColumnRegion(np.where(empty, height, first), np.where(empty, 0, end), height)

    def upsample(self, factor: int) -> ColumnRegion:
        """The region in a tensor `factor` times as large."""
        top, bottom = (np.repeat(rows, factor) * factor for rows in (self.top, self.bottom))
        return ColumnRegion(top, bottom, self.height * factor)

    def rects(self) -> tuple[Rect, ...]:
        """Disjoint rectangles that cover the region with the least sum of areas and overheads (`_EXTRA`).

        In large tensors, sides are multiples of several columns and rows.
        """
        height, width = self.hw
        group = -(-width // _MAX_GROUPS)
        padded = -width % group
        tops = np.pad(self.top, (0, padded), constant_values=height).reshape(-1, group).min(1)
        bottoms = np.pad(self.bottom, (0, padded)).reshape(-1, group).max(1)
        covered = bottoms > tops
        tops = np.where(covered, tops // group * group, height)
        bottoms = np.where(covered, np.minimum(-(-bottoms // group) * group, height), 0)
        # A rectangle may only begin where a column differs from the previous one.
        edges = np.flatnonzero(np.diff(tops, prepend=-1) | np.diff(bottoms, prepend=-1))
        tops, bottoms, covered = tops[edges], bottoms[edges], covered[edges]
        starts = edges * group
        ends = np.append(starts[1:], width)
        best, begin = np.zeros(len(edges) + 1), np.zeros(len(edges) + 1, np.int64)
        for end in range(1, len(edges) + 1):
            if not covered[end - 1]:
                best[end], begin[end] = best[end - 1], end
                continue
            high = np.maximum.accumulate(bottoms[end - 1 :: -1]) - np.minimum.accumulate(tops[end - 1 :: -1])
            costs = best[end - 1 :: -1] + (ends[end - 1] - starts[end - 1 :: -1]) * high
            shortest = int(costs.argmin())
            best[end], begin[end] = costs[shortest] + _OVERHEAD * height * width, end - 1 - shortest
        rects: list[Rect] = []
        end = len(edges)
        while end > 0:
            first = int(begin[end])
            if first == end:
                end -= 1
                continue
            part = slice(first, end)
            rects.append(
                Rect(int(tops[part].min()), int(bottoms[part].max()), int(starts[first]), int(ends[end - 1]))
            )
            end = first
        return tuple(reversed(rects))
