"""Objects and detections of all frames in flat arrays, and the pairs of them that overlap.

Pairs are found frame by frame, without a Python loop over frames; what overlaps nothing else is most of a data
set, and needs no search for the best assignment.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

EVERY_CLASS = -1
"""Label of a region in which no detection of any class is judged (KITTI's DontCare)."""
_PAIRS_AT_ONCE = 2_000_000
"""Pairs whose overlap is computed together: some 200 MB."""


def from_xyxy(boxes_xyxy: Floats) -> Floats:
    """Left, top, right, bottom, width, height (N, 6) of (N, 4): KITTI's coordinates as they stand."""
    return np.concatenate([boxes_xyxy, boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]], axis=1)


def from_xywh(boxes_xywh: Floats) -> Floats:
    """The same of left, top, width, height (N, 4): COCO's sizes as they stand, to the last bit."""
    return np.concatenate([boxes_xywh[:, :2], boxes_xywh[:, :2] + boxes_xywh[:, 2:], boxes_xywh[:, 2:]], axis=1)


@dataclass(frozen=True, slots=True)
class Truths:
    """M true objects of F frames, each frame's in file order, frames ascending.

    frame (M,) in [0, F); label (M,) into a list of classes, or EVERY_CLASS; boxes (M, 6) px: see
    `from_xyxy`; ignore (M,): neither missed nor a hit. truncation (M,) in [0, 1] and occlusion (M,) 0 to 3, both
    -1 where unknown; distance_m (M,), NaN where unknown; area (M,) px^2.
    """

    frames: int
    frame: Integers
    label: Integers
    boxes: Floats
    ignore: Booleans
    truncation: Floats
    occlusion: Integers
    distance_m: Floats
    area: Floats

    def __len__(self) -> int:
        return len(self.frame)

    def rows(self, chosen: Booleans | Integers) -> Truths:
        """Some of the objects."""
        columns = ("frame", "label", "boxes", "ignore", "truncation", "occlusion", "distance_m", "area")
        return replace(self, **{name: getattr(self, name)[chosen] for name in columns})


@dataclass(frozen=True, slots=True)
class Found:
    """N detections, each frame's in file order, frames ascending; columns as in `Truths`. score (N,), finite."""

    frame: Integers
    label: Integers
    boxes: Floats
    score: Floats

    def __len__(self) -> int:
        return len(self.frame)

    def rows(self, chosen: Booleans | Integers) -> Found:
        """Some of the detections."""
        return Found(self.frame[chosen], self.label[chosen], self.boxes[chosen], self.score[chosen])


@dataclass(frozen=True, slots=True)
class Pairs:
    """P overlapping pairs, by frame, then truth, then detection. truth, found (P,): rows; overlap (P,): share."""

    truth: Integers
    found: Integers
    overlap: Floats

    def rows(self, chosen: Booleans | Integers) -> Pairs:
        """Some of the pairs."""
        return Pairs(self.truth[chosen], self.found[chosen], self.overlap[chosen])


def overlapping(truths: Truths, found: Found, least: float, by_detection: Booleans | None = None) -> Pairs:
    """All pairs of a frame whose overlap is more than 0 and at least `least`, whatever their labels.

    by_detection (M,): truths whose overlap is the share of the detection that lies on them, not IoU.
    """
    share = np.zeros(len(truths), np.bool_) if by_detection is None else by_detection
    # Columns on their own: most pairs are apart by their first one, and need no other.
    a, b = (np.ascontiguousarray(of.boxes.T) for of in (truths, found))
    parts: list[Pairs] = []
    for t, f in _same_frame(truths, found):
        for low, high in ((0, 2), (1, 3)):
            near = np.minimum(a[high, t], b[high, f]) > np.maximum(a[low, t], b[low, f])
            t, f = t[near], f[near]
        width = np.minimum(a[2, t], b[2, f]) - np.maximum(a[0, t], b[0, f])
        height = np.minimum(a[3, t], b[3, f]) - np.maximum(a[1, t], b[1, f])
        shared = width * height
        own = b[4, f] * b[5, f]
        overlap = shared / np.where(share[t], own, own + a[4, t] * a[5, t] - shared)
        kept = overlap >= least
        parts.append(Pairs(t[kept], f[kept], overlap[kept]))
    if not parts:
        return Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    return Pairs(
        np.concatenate([p.truth for p in parts]),
        np.concatenate([p.found for p in parts]),
        np.concatenate([p.overlap for p in parts]),
    )


def _same_frame(truths: Truths, found: Found) -> Iterator[tuple[Integers, Integers]]:
    """Rows of truths and of detections of one frame, all with all, some frames at a time."""
    frames = np.arange(truths.frames)
    t_start, t_end = np.searchsorted(truths.frame, frames), np.searchsorted(truths.frame, frames, side="right")
    f_start, f_end = np.searchsorted(found.frame, frames), np.searchsorted(found.frame, frames, side="right")
    count = (t_end - t_start) * (f_end - f_start)
    total = np.cumsum(count)
    first = 0
    while first < len(frames):
        done = total[first - 1] if first else 0
        last = max(int(np.searchsorted(total, done + _PAIRS_AT_ONCE, side="right")), first + 1)
        chosen = np.arange(first, last)[count[first:last] > 0]
        number = within(count[chosen])
        wide = np.repeat(f_end[chosen] - f_start[chosen], count[chosen])
        yield (
            np.repeat(t_start[chosen], count[chosen]) + number // np.maximum(wide, 1),
            np.repeat(f_start[chosen], count[chosen]) + number % np.maximum(wide, 1),
        )
        first = last


def within(counts: Integers) -> Integers:
    """0, 1, ..., count - 1 for each count, one after the other."""
    starts = np.cumsum(counts) - counts
    return np.arange(int(counts.sum())) - np.repeat(starts, counts)


def clusters(pairs: Pairs, truths: int, found: int) -> Integers:
    """A number for each pair (P,), the same for pairs that share a truth or a detection, directly or through
    others; ascending from 0. truths, found: how many rows there are.
    """
    if not len(pairs.truth):
        return np.zeros(0, np.int64)
    label = np.arange(found)
    while True:
        of_truth = np.full(truths, found)
        np.minimum.at(of_truth, pairs.truth, label[pairs.found])
        lowest = label.copy()
        np.minimum.at(lowest, pairs.found, of_truth[pairs.truth])
        if np.array_equal(lowest, label):
            return np.unique(label[pairs.found], return_inverse=True)[1].reshape(-1)
        label = lowest


def rank_in_cluster(cluster: Integers, member: Integers) -> Integers:
    """Which member of its cluster each pair is of, from 0. Pairs of a cluster, and of a member, are neighbours."""
    first = np.diff(cluster, prepend=-1) != 0
    number = np.cumsum(first | (np.diff(member, prepend=-1) != 0)) - 1
    return number - np.maximum.accumulate(np.where(first, number, 0))


def first_greatest(key: Floats, group: Integers) -> tuple[Integers, Floats]:
    """For groups of neighbouring rows: the first row with the greatest key, and that key."""
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    greatest = np.maximum.reduceat(key, starts)
    sizes = np.diff(starts, append=len(group))
    rows = np.where(key == np.repeat(greatest, sizes), np.arange(len(key)), len(key))
    return np.minimum.reduceat(rows, starts), greatest
