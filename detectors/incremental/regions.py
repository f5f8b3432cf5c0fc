"""Which places of a tensor can differ, and the rectangles in which they are computed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.int64]

_GROUPS = 80
"""Groups of columns at most that rectangles are chosen from."""
_EXTRA = 0.02
"""What a rectangle costs beside its places, as a share of the whole tensor's: calls, and places around it."""


class Rect(NamedTuple):
    """Rows from top to bottom and columns from left to right, the last of each exclusive."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def hw(self) -> tuple[int, int]:
        return self.bottom - self.top, self.right - self.left

    @property
    def area(self) -> int:
        return max(self.bottom - self.top, 0) * max(self.right - self.left, 0)

    def meet(self, other: Rect) -> Rect:
        """What both cover; of no area where they do not meet."""
        return Rect(
            max(self.top, other.top),
            min(self.bottom, other.bottom),
            max(self.left, other.left),
            min(self.right, other.right),
        )

    def inside(self, other: Rect) -> tuple[slice, slice]:
        """This one's rows and columns, counted in `other`."""
        return (
            slice(self.top - other.top, self.bottom - other.top),
            slice(self.left - other.left, self.right - other.left),
        )


@dataclass(frozen=True, slots=True)
class Span:
    """How a layer's output places lie over its input's: `extent` rows and columns from `stride` * i - `before` on.

    Each (of rows, of columns).
    """

    extent: tuple[int, int] = (1, 1)
    stride: tuple[int, int] = (1, 1)
    before: tuple[int, int] = (0, 0)

    def window(self, rect: Rect) -> Rect:
        """The input that an output rectangle is made of; it may lie outside."""
        top, left = (s * at - b for s, b, at in zip(self.stride, self.before, (rect.top, rect.left), strict=True))
        lower, right = (
            s * (at - 1) - b + e
            for s, b, e, at in zip(self.stride, self.before, self.extent, (rect.bottom, rect.right), strict=True)
        )
        return Rect(top, lower, left, right)


@dataclass(frozen=True, slots=True)
class Region:
    """Of each column of a tensor `height` rows high the rows from `top` (W,) to `bottom` (W,), the latter
    exclusive; none where they are not below. One piece a column: on a road, what changes is a band.
    """

    top: Rows
    bottom: Rows
    height: int

    @classmethod
    def of(cls, rects: Sequence[Rect], hw: tuple[int, int]) -> Region:
        """What rectangles cover of a tensor, and what lies between those of a column."""
        height, width = hw
        top, bottom = np.full(width, height), np.zeros(width, np.int64)
        for rect in rects:
            seen = rect.meet(Rect(0, height, 0, width))
            if seen.area:
                columns = slice(seen.left, seen.right)
                np.minimum(top[columns], seen.top, out=top[columns])
                np.maximum(bottom[columns], seen.bottom, out=bottom[columns])
        return cls(top, bottom, height)

    @classmethod
    def of_blocks(cls, blocks: NDArray[np.bool_], side: int, hw: tuple[int, int]) -> Region:
        """Of which blocks (ceil(h / side), ceil(w / side)) of a tensor are covered."""
        height, width = hw
        any_row = blocks.any(0)
        first = np.where(any_row, blocks.argmax(0) * side, height)
        end = np.where(any_row, np.minimum((len(blocks) - blocks[::-1].argmax(0)) * side, height), 0)
        return cls(np.repeat(first, side)[:width], np.repeat(end, side)[:width], height)

    @property
    def hw(self) -> tuple[int, int]:
        return self.height, len(self.top)

    @property
    def area(self) -> int:
        return int(np.maximum(self.bottom - self.top, 0).sum())

    def placed(self, at: tuple[int, int], hw: tuple[int, int]) -> Region:
        """The same in a larger tensor (h, w), in which this one begins at that row and column."""
        columns = at[1], hw[1] - at[1] - len(self.top)
        empty = self.bottom <= self.top
        top = np.pad(np.where(empty, hw[0], self.top + at[0]), columns, constant_values=hw[0])
        return Region(top, np.pad(np.where(empty, 0, self.bottom + at[0]), columns), hw[0])

    def joined(self, other: Region) -> Region:
        """What either covers, of a tensor of the same size."""
        return Region(np.minimum(self.top, other.top), np.maximum(self.bottom, other.bottom), self.height)

    def contains(self, other: Region) -> bool:
        """Whether nothing of `other`, of the same size, lies outside."""
        empty = other.bottom <= other.top
        return bool((empty | ((self.top <= other.top) & (self.bottom >= other.bottom))).all())

    def grown(self, by: int) -> Region:
        """The same, and what is at most `by` rows and columns away."""
        return self.reached(Span((2 * by + 1, 2 * by + 1), (1, 1), (by, by)), self.hw)

    def reached(self, span: Span, hw: tuple[int, int]) -> Region:
        """The output places of a layer (h, w) that see any of these."""
        height, width = hw
        top, bottom = np.full(width, self.height), np.zeros(width, np.int64)
        starts = np.arange(width) * span.stride[1] - span.before[1]
        for tap in range(span.extent[1]):
            at = starts + tap
            within = (at >= 0) & (at < len(self.top))
            here = at[within]
            top[within] = np.minimum(top[within], self.top[here])
            bottom[within] = np.maximum(bottom[within], self.bottom[here])
        empty = bottom <= top
        stride, before, extent = span.stride[0], span.before[0], span.extent[0]
        first = np.maximum(-((extent - 1 - before - top) // stride), 0)
        end = np.minimum((bottom - 1 + before) // stride + 1, height)
        return Region(np.where(empty, height, first), np.where(empty, 0, end), height)

    def enlarged(self, factor: int) -> Region:
        """The same of a tensor `factor` times as large."""
        top, bottom = (np.repeat(rows, factor) * factor for rows in (self.top, self.bottom))
        return Region(top, bottom, self.height * factor)

    def rects(self) -> tuple[Rect, ...]:
        """Rectangles beside each other that cover it, as few and as small as pays: the least sum of their areas
        and of `_EXTRA` for each. Sides are a multiple of some columns and rows where the tensor is large.
        """
        height, width = self.hw
        group = -(-width // _GROUPS)
        padded = -width % group
        tops = np.pad(self.top, (0, padded), constant_values=height).reshape(-1, group).min(1)
        bottoms = np.pad(self.bottom, (0, padded)).reshape(-1, group).max(1)
        covered = bottoms > tops
        tops = np.where(covered, tops // group * group, height)
        bottoms = np.where(covered, np.minimum(-(-bottoms // group) * group, height), 0)
        # Only where a column differs from the one before it may a rectangle begin.
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
            best[end], begin[end] = costs[shortest] + _EXTRA * height * width, end - 1 - shortest
        found: list[Rect] = []
        end = len(edges)
        while end > 0:
            first = int(begin[end])
            if first == end:
                end -= 1
                continue
            part = slice(first, end)
            found.append(
                Rect(int(tops[part].min()), int(bottoms[part].max()), int(starts[first]), int(ends[end - 1]))
            )
            end = first
        return tuple(reversed(found))
