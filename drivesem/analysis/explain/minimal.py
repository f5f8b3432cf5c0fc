"""Finds the smallest part of a change that still fails: shortens it, drops blocks, and shortens it again.

The change theta is scaled by s from 1 to 0, and every point is projected onto the feasible set. Failing need not
be monotone in s, as objects are lost and found again. So scales are evaluated on a grid first, and the smallest
that fails is bisected against its neighbour, which does not. Failures between two neighbours are missed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.errors import RangeError

_HALVINGS = 5
"""Bisection steps between two neighbours of the grid; a grid of 16 points resolves a scale to 1/512."""
_ROUNDING = 1e-5
"""Relative rounding error of norms in float32."""


@dataclass(frozen=True, slots=True)
class ThetaBlock:
    """Coordinates that are dropped together."""

    name: str
    """Name of the block."""
    mask: Tensor
    """Its coordinates (D,) bool."""


@dataclass(frozen=True, slots=True)
class MinimalChangeSearch:
    """Functions of theta (D,) that define the search."""

    project: Callable[[Tensor], Tensor]
    """Projects onto the feasible set."""
    fails: Callable[[Tensor], bool]
    """Whether the detector fails at a feasible theta."""
    size: Callable[[Tensor], float]
    """The norm to minimise."""
    points: int
    """Points of the grid of scales, without 0."""


@dataclass(frozen=True, slots=True)
class ShortenedChange:
    """Result of the search."""

    theta: Tensor
    """Smallest change found (D,), feasible and failing."""
    scale: float
    """Its scale relative to the remaining blocks, in [0, 1]."""
    scan: tuple[bool, ...]
    """Whether the whole change fails at each scale of the grid, 0 and 1 included."""
    shortened: Tensor
    """The whole change (D,) after the first bisection."""
    shortened_scale: float
    """Its scale, in [0, 1]."""
    dropped: tuple[str, ...]
    """Names of the dropped blocks, in order."""

    @property
    def sign_changes(self) -> int:
        """Changes between failing and not failing along the grid; 1 if monotone."""
        return sum(a != b for a, b in zip(self.scan, self.scan[1:], strict=False))


def find_minimal_change(
    theta: Tensor, blocks: Sequence[ThetaBlock], search: MinimalChangeSearch
) -> ShortenedChange:
    """Find the smallest part of a change that fails.

    A block is dropped if the rest, at some scale, still fails and is no larger than before. This is repeated until
    no block can be dropped.

    Args:
        theta: The change (D,).
        blocks: Blocks to drop, in this order.
        search: Functions that define the search.

    Raises:
        RangeError: The change does not fail, or no change is needed.
    """
    scan = tuple(_fails_at(theta, k / search.points, search) for k in range(search.points + 1))
    if not scan[-1] or scan[0]:
        actual = "one that does not" if not scan[-1] else "a failure without any change"
        raise RangeError("theta", "a change that fails", actual)
    first = scan.index(True)
    scale = _bisect(theta, (first - 1) / search.points, first / search.points, search)
    shortened, shortened_scale = search.project(theta * scale), scale
    direction, dropped = theta, []
    again = True
    while again:
        again = False
        for block in blocks:
            rest = torch.where(block.mask, torch.zeros_like(direction), direction)
            if torch.equal(rest, direction) or not bool(rest.any()):
                continue
            rest_scale = _failing_scale_within(rest, search.size(search.project(direction * scale)), search)
            if rest_scale is not None:
                direction, scale, again = rest, rest_scale, True
                dropped.append(block.name)
    if dropped:
        scale = _smallest_failing_scale(direction, scale, search)
    return ShortenedChange(
        search.project(direction * scale), scale, scan, shortened, shortened_scale, tuple(dropped)
    )


def _fails_at(direction: Tensor, scale: float, search: MinimalChangeSearch) -> bool:
    return search.fails(search.project(direction * scale))


def _failing_scale_within(direction: Tensor, max_size: float, search: MinimalChangeSearch) -> float | None:
    """Return the smallest failing scale on half the grid with a change not larger than `max_size`, or None."""
    limit = min(1.0, max_size / search.size(direction))
    points = max(search.points // 2, 1)
    for k in range(1, points + 1):
        scale = limit * k / points
        theta = search.project(direction * scale)
        # projected, a change may be longer than its scale implies: the feasible set need not be star-shaped
        if search.size(theta) <= max_size * (1 + _ROUNDING) and search.fails(theta):
            return scale
    return None


def _smallest_failing_scale(direction: Tensor, scale: float, search: MinimalChangeSearch) -> float:
    """Return the smallest failing scale up to `scale`, which fails, by grid and bisection."""
    for k in range(1, search.points):
        if _fails_at(direction, scale * k / search.points, search):
            return _bisect(direction, scale * (k - 1) / search.points, scale * k / search.points, search)
    return _bisect(direction, scale * (search.points - 1) / search.points, scale, search)


def _bisect(direction: Tensor, low: float, high: float, search: MinimalChangeSearch) -> float:
    """Bisect an interval of scales; its upper end fails, its lower end does not. Return its failing end."""
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if _fails_at(direction, middle, search):
            high = middle
        else:
            low = middle
    return high
