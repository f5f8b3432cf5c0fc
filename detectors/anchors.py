"""Anchor shapes for a data set: k-means of its boxes' sizes, with 1 - IoU as the distance (as YOLO9000 has it).

IoU is that of two boxes around one centre. A cluster's anchor is the mean of its sizes. Plain k-means libraries
measure Euclidean distance, by which large boxes would get nearly all anchors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detectors.types import Targets

STARTS = 8
"""Runs from different first anchors, of which the best is kept: a single one ends in a local optimum."""

_MOST_ROUNDS = 300
"""Of one run: means under this distance may in theory go round in circles."""

_ROUNDING = 1e-12
"""Distance of a size from itself, in floating-point numbers."""


@dataclass(frozen=True, slots=True)
class Anchors:
    """sizes_wh: width and height of each anchor in px, smallest area first. mean_iou: what `mean_best_iou` says of
    the sizes they were made from.
    """

    sizes_wh: tuple[tuple[float, float], ...]
    mean_iou: float


def fit_anchors(sizes_wh: np.ndarray, count: int, seed: int = 0, starts: int = STARTS) -> Anchors:
    """`count` anchors for boxes of sizes (N, 2): width and height, px. The same seed gives the same anchors.

    Each start draws its first anchors as k-means++ does, by the square of the distance. Raises ValueError where
    sizes are no positive numbers, or fewer of them differ than there are to be anchors.
    """
    sizes = _checked(sizes_wh)
    different = len(np.unique(sizes, axis=0))
    if not 1 <= count <= different:
        raise ValueError(f"count: expected 1 to {different}, the number of different sizes, found {count}")
    if starts < 1:
        raise ValueError(f"starts: expected at least 1, found {starts}")
    generator = np.random.default_rng(seed)
    runs = [_settle(sizes, _first(sizes, count, generator)) for _ in range(starts)]
    best = max(runs, key=lambda anchors: mean_best_iou(sizes, anchors))
    best = best[np.lexsort((best[:, 0], best.prod(1)))]
    return Anchors(tuple((float(w), float(h)) for w, h in best), mean_best_iou(sizes, best))


def mean_best_iou(sizes_wh: np.ndarray, anchors_wh: np.ndarray) -> float:
    """The mean over sizes (N, 2) of the highest IoU with one of the anchors (K, 2), in (0, 1]."""
    return float(size_iou(sizes_wh, anchors_wh).max(1).mean())


def size_iou(sizes_wh: np.ndarray, anchors_wh: np.ndarray) -> np.ndarray:
    """IoU (N, K) of boxes of sizes (N, 2) with anchors (K, 2) around the same centre."""
    sizes, anchors = np.asarray(sizes_wh, np.float64), np.asarray(anchors_wh, np.float64)
    shared = np.minimum(sizes[:, None], anchors[None]).prod(2)
    return shared / (sizes.prod(1)[:, None] + anchors.prod(1)[None] - shared)


def target_sizes(targets: Targets) -> np.ndarray:
    """Sizes (N, 2) in px, float64, of the objects of one image that are not ignored and have an area."""
    kept = targets.boxes_xyxy[~targets.ignore].double().cpu().numpy()
    sizes = kept[:, 2:] - kept[:, :2]
    return sizes[(sizes > 0).all(1)]


def _checked(sizes_wh: np.ndarray) -> np.ndarray:
    sizes = np.asarray(sizes_wh, np.float64)
    if sizes.ndim != 2 or sizes.shape[1] != 2 or len(sizes) == 0:
        raise ValueError(f"sizes: expected shape (N, 2) with N of at least 1, found {sizes.shape}")
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise ValueError("sizes: expected positive finite numbers, found others")
    return sizes


def _first(sizes: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """(count, 2) different sizes, each drawn by the square of its distance from those before it (k-means++)."""
    chosen = [sizes[generator.integers(len(sizes))]]
    for _ in range(count - 1):
        distance = 1 - size_iou(sizes, np.stack(chosen)).max(1)
        weight = np.where(distance > _ROUNDING, distance, 0.0) ** 2
        if weight.sum() == 0:  # what is left differs by rounding only: any will do
            weight = np.ones(len(sizes))
        chosen.append(sizes[generator.choice(len(sizes), p=weight / weight.sum())])
    return np.stack(chosen)


def _settle(sizes: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Means of clusters and clusters of means, until no size changes its cluster."""
    before = np.full(len(sizes), -1)
    for _ in range(_MOST_ROUNDS):
        overlap = size_iou(sizes, anchors)
        cluster = overlap.argmax(1)
        counts = np.bincount(cluster, minlength=len(anchors))
        if (cluster == before).all():
            break
        # An anchor that no size is nearest to starts anew where the present ones fit worst.
        worst = iter(sizes[np.argsort(overlap.max(1), kind="stable")])
        sums = np.stack([np.bincount(cluster, sizes[:, axis], len(anchors)) for axis in (0, 1)], 1)
        anchors = np.stack([total / n if n else next(worst) for total, n in zip(sums, counts, strict=True)])
        before = cluster
    return anchors
