"""The least of a change that still fails: shortened, stripped of what is not needed, shortened again.

A change theta is taken back along s * theta, s from 1 to 0, and every point is projected onto the feasible set.
Failing need not be monotone in s: cars are lost and found again on the way. So scales are looked at on a grid
first, and the smallest one that fails is bisected against its neighbour, which does not. What fails only between
two neighbours of the grid is not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.errors import RangeError

_HALVINGS = 5
"""Bisection steps between two neighbours of the grid: with 16 of them a scale is found to 1/512."""
_ROUNDING = 1e-5
"""Of norms in float32, relative."""


@dataclass(frozen=True, slots=True)
class ThetaBlock:
    """Coordinates that are dropped together. mask (D,) bool."""

    name: str
    mask: Tensor


@dataclass(frozen=True, slots=True)
class LeastSearch:
    """What the search knows of thetas (D,). project: onto the feasible set. fails: of what was projected. size:
    the norm that shall be small. points: of the grid of scales, without 0.
    """

    project: Callable[[Tensor], Tensor]
    fails: Callable[[Tensor], bool]
    size: Callable[[Tensor], float]
    points: int


@dataclass(frozen=True, slots=True)
class Minimal:
    """theta (D,): the least change that was found, feasible and failing; scale: of what is left of the change.

    scan: whether the whole change fails at each scale of the grid, 0 and 1 included. shortened (D,): after the
    first bisection; shortened_scale: its scale. dropped: names of blocks, in the order in which they went.
    """

    theta: Tensor
    scale: float
    scan: tuple[bool, ...]
    shortened: Tensor
    shortened_scale: float
    dropped: tuple[str, ...]

    @property
    def sign_changes(self) -> int:
        """How often failing begins or ends between neighbours of the grid: 1 where it is monotone."""
        return sum(a != b for a, b in zip(self.scan, self.scan[1:], strict=False))


def minimal(theta: Tensor, blocks: Sequence[ThetaBlock], search: LeastSearch) -> Minimal:
    """The least of theta (D,) that fails. blocks: what to try to drop, in this order, until nothing more goes.

    A block goes where the rest, at some scale, still fails and is no larger than what there was. Raises RangeError
    where theta does not fail.
    """
    scan = tuple(_fails_at(theta, k / search.points, search) for k in range(search.points + 1))
    if not scan[-1] or scan[0]:
        found = "one that does not" if not scan[-1] else "a failure without any change"
        raise RangeError("theta", "a change that fails", found)
    first = scan.index(True)
    scale = _bisected(theta, (first - 1) / search.points, first / search.points, search)
    shortened, shortened_scale = search.project(theta * scale), scale
    direction, dropped = theta, []
    again = True
    while again:
        again = False
        for block in blocks:
            rest = torch.where(block.mask, torch.zeros_like(direction), direction)
            if torch.equal(rest, direction) or not bool(rest.any()):
                continue
            found = _smallest(rest, search.size(search.project(direction * scale)), search)
            if found is not None:
                direction, scale, again = rest, found, True
                dropped.append(block.name)
    if dropped:
        scale = _shortest(direction, scale, search)
    return Minimal(search.project(direction * scale), scale, scan, shortened, shortened_scale, tuple(dropped))


def _fails_at(direction: Tensor, scale: float, search: LeastSearch) -> bool:
    return search.fails(search.project(direction * scale))


def _smallest(direction: Tensor, most: float, search: LeastSearch) -> float | None:
    """A scale up to 1 that fails and is no larger than `most`; the smallest on half the grid, None without one."""
    limit = min(1.0, most / search.size(direction))
    points = max(search.points // 2, 1)
    for k in range(1, points + 1):
        scale = limit * k / points
        theta = search.project(direction * scale)
        # Projected, a change may be longer than its scale says: what is feasible need not be star-shaped.
        if search.size(theta) <= most * (1 + _ROUNDING) and search.fails(theta):
            return scale
    return None


def _shortest(direction: Tensor, scale: float, search: LeastSearch) -> float:
    """The smallest failing scale up to `scale`, which fails, as `minimal` says."""
    for k in range(1, search.points):
        if _fails_at(direction, scale * k / search.points, search):
            return _bisected(direction, scale * (k - 1) / search.points, scale * k / search.points, search)
    return _bisected(direction, scale * (search.points - 1) / search.points, scale, search)


def _bisected(direction: Tensor, low: float, high: float, search: LeastSearch) -> float:
    """The failing end of an interval whose lower end does not fail, halved."""
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if _fails_at(direction, middle, search):
            high = middle
        else:
            low = middle
    return high
