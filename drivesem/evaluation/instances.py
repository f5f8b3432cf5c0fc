"""Ground truth and detections of all frames as flat arrays, and the pairs of them that overlap.

Pairs lie within a frame and are found without a Python loop over frames. Most of a data set overlaps nothing else and
needs no search for the best assignment.
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
"""Label of a region in which detections of all classes are ignored (KITTI's DontCare)."""
_PAIRS_AT_ONCE = 2_000_000
"""Pairs per batch of overlaps: some 200 MB."""


def boxes_from_xyxy(boxes_xyxy: Floats) -> Floats:
    """Left, top, right, bottom, width, height (N, 6) from corners (N, 4), which stay exact as in KITTI's files."""
    return np.concatenate([boxes_xyxy, boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]], axis=1)


def boxes_from_xywh(boxes_xywh: Floats) -> Floats:
    """The same from left, top, width, height (N, 4), where the sizes stay exact as in COCO's files."""
    return np.concatenate([boxes_xywh[:, :2], boxes_xywh[:, :2] + boxes_xywh[:, 2:], boxes_xywh[:, 2:]], axis=1)


@dataclass(frozen=True, slots=True)
class GroundTruthTable:
    """M labelled objects of F frames, by ascending frame, then in file order."""

    frames: int
    """Number of frames F."""
    frame: Integers
    """(M,) in [0, F)."""
    label: Integers
    """(M,) index of the class, or `EVERY_CLASS`."""
    boxes: Floats
    """(M, 6) px, see `boxes_from_xyxy`."""
    ignore: Booleans
    """(M,) objects that are neither missed nor detected."""
    truncation: Floats
    """(M,) in [0, 1]; -1 where unknown."""
    occlusion: Integers
    """(M,) 0 to 3 as in KITTI; -1 where unknown."""
    distance_m: Floats
    """(M,), NaN where unknown."""
    area: Floats
    """(M,) px^2."""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, chosen: Booleans | Integers) -> GroundTruthTable:
        """The chosen objects."""
        columns = ("frame", "label", "boxes", "ignore", "truncation", "occlusion", "distance_m", "area")
        return replace(self, **{name: getattr(self, name)[chosen] for name in columns})


@dataclass(frozen=True, slots=True)
class DetectionTable:
    """N detections, by ascending frame, then in file order."""

    frame: Integers
    """(N,) index of the frame."""
    label: Integers
    """(N,) index of the class."""
    boxes: Floats
    """(N, 6) px, see `boxes_from_xyxy`."""
    score: Floats
    """(N,), finite."""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, chosen: Booleans | Integers) -> DetectionTable:
        """The chosen detections."""
        return DetectionTable(self.frame[chosen], self.label[chosen], self.boxes[chosen], self.score[chosen])


@dataclass(frozen=True, slots=True)
class OverlapPairs:
    """P overlapping pairs, sorted by frame, then object, then detection."""

    truth: Integers
    """(P,) rows of the objects."""
    detection: Integers
    """(P,) rows of the detections."""
    overlap: Floats
    """(P,) in [0, 1]."""

    def select(self, chosen: Booleans | Integers) -> OverlapPairs:
        """The chosen pairs."""
        return OverlapPairs(self.truth[chosen], self.detection[chosen], self.overlap[chosen])


def find_overlaps(
    truths: GroundTruthTable, detections: DetectionTable, least: float, by_detection: Booleans | None = None
) -> OverlapPairs:
    """Find all pairs within a frame that overlap by at least `least`, with any labels.

    Args:
        truths: M objects.
        detections: N detections.
        least: Minimum overlap; pairs without any are left out.
        by_detection: (M,) objects for which the overlap is the share of the detection on them instead of the IoU.
    """
    share = np.zeros(len(truths), np.bool_) if by_detection is None else by_detection
    # One column at a time: most pairs are disjoint in the first one and need no other.
    a, b = (np.ascontiguousarray(table.boxes.T) for table in (truths, detections))
    parts: list[OverlapPairs] = []
    for t, f in _same_frame(truths, detections):
        for low, high in ((0, 2), (1, 3)):
            near = np.minimum(a[high, t], b[high, f]) > np.maximum(a[low, t], b[low, f])
            t, f = t[near], f[near]
        width = np.minimum(a[2, t], b[2, f]) - np.maximum(a[0, t], b[0, f])
        height = np.minimum(a[3, t], b[3, f]) - np.maximum(a[1, t], b[1, f])
        intersection = width * height
        detection_area = b[4, f] * b[5, f]
        overlap = intersection / np.where(
            share[t], detection_area, detection_area + a[4, t] * a[5, t] - intersection
        )
        enough = overlap >= least
        parts.append(OverlapPairs(t[enough], f[enough], overlap[enough]))
    if not parts:
        return OverlapPairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    return OverlapPairs(
        np.concatenate([p.truth for p in parts]),
        np.concatenate([p.detection for p in parts]),
        np.concatenate([p.overlap for p in parts]),
    )


def _same_frame(truths: GroundTruthTable, detections: DetectionTable) -> Iterator[tuple[Integers, Integers]]:
    """Yield all pairs of rows of objects and detections within a frame, some frames at a time."""
    frames = np.arange(truths.frames)
    t_start, t_end = np.searchsorted(truths.frame, frames), np.searchsorted(truths.frame, frames, side="right")
    f_start, f_end = (
        np.searchsorted(detections.frame, frames),
        np.searchsorted(detections.frame, frames, side="right"),
    )
    count = (t_end - t_start) * (f_end - f_start)
    total = np.cumsum(count)
    first = 0
    while first < len(frames):
        done = total[first - 1] if first else 0
        last = max(int(np.searchsorted(total, done + _PAIRS_AT_ONCE, side="right")), first + 1)
        chosen = np.arange(first, last)[count[first:last] > 0]
        number = counting_ranges(count[chosen])
        wide = np.repeat(f_end[chosen] - f_start[chosen], count[chosen])
        yield (
            np.repeat(t_start[chosen], count[chosen]) + number // np.maximum(wide, 1),
            np.repeat(f_start[chosen], count[chosen]) + number % np.maximum(wide, 1),
        )
        first = last


def counting_ranges(counts: Integers) -> Integers:
    """Concatenate 0, 1, ..., count - 1 for each count."""
    starts = np.cumsum(counts) - counts
    return np.arange(int(counts.sum())) - np.repeat(starts, counts)


def label_clusters(pairs: OverlapPairs, truths: int, detections: int) -> Integers:
    """Label connected pairs: those that share an object or a detection, directly or through other pairs.

    Args:
        pairs: P pairs.
        truths: Number of objects.
        detections: Number of detections.

    Returns:
        (P,) number of each pair's cluster, ascending from 0.
    """
    if not len(pairs.truth):
        return np.zeros(0, np.int64)
    label = np.arange(detections)
    while True:
        truth_label = np.full(truths, detections)
        np.minimum.at(truth_label, pairs.truth, label[pairs.detection])
        lowest = label.copy()
        np.minimum.at(lowest, pairs.detection, truth_label[pairs.truth])
        if np.array_equal(lowest, label):
            return np.unique(label[pairs.detection], return_inverse=True)[1].reshape(-1)
        label = lowest


def rank_in_cluster(cluster: Integers, member: Integers) -> Integers:
    """Rank of each pair's member in its cluster, from 0. Pairs must be sorted by cluster and member."""
    first = np.diff(cluster, prepend=-1) != 0
    number = np.cumsum(first | (np.diff(member, prepend=-1) != 0)) - 1
    return number - np.maximum.accumulate(np.where(first, number, 0))


def group_argmax(key: Floats, group: Integers) -> tuple[Integers, Floats]:
    """For groups of consecutive rows: the first row with the largest key, and that key."""
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    greatest = np.maximum.reduceat(key, starts)
    sizes = np.diff(starts, append=len(group))
    rows = np.where(key == np.repeat(greatest, sizes), np.arange(len(key)), len(key))
    return np.minimum.reduceat(rows, starts), greatest
