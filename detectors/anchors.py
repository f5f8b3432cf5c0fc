"""Fits anchor shapes to a data set: k-means of box sizes with 1 - IoU as the distance, as in YOLO9000.

IoU is that of two boxes with one centre; a cluster's anchor is the mean of its sizes. k-means libraries use
Euclidean distance, which would give large boxes nearly all anchors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detectors.types import Targets

STARTS = 8
"""Runs from different initial anchors, of which the best is used: a single one may end in a local optimum."""

_MAX_ITERATIONS = 300
"""Iterations per run: k-means with this distance need not converge."""

_ROUNDING = 1e-12
"""Rounding error of a size's distance from itself."""


@dataclass(frozen=True, slots=True)
class AnchorFit:
    """Anchors and how well they fit."""

    sizes_wh: tuple[tuple[float, float], ...]
    """Width and height of each anchor, px, smallest area first."""
    mean_iou: float
    """`mean_best_iou` over the fitted sizes, in (0, 1]."""


def fit_anchors(sizes_wh: np.ndarray, count: int, seed: int = 0, starts: int = STARTS) -> AnchorFit:
    """Fit anchors to box sizes, initialised as in k-means++. The same seed gives the same anchors.

    Args:
        sizes_wh: (N, 2) width and height, px.
        count: Number of anchors.
        seed: Seed of the initial anchors.
        starts: Number of runs.

    Raises:
        ValueError: Sizes are not positive numbers, or fewer of them are distinct than there are anchors.
    """
    sizes = _validate_sizes(sizes_wh)
    distinct = len(np.unique(sizes, axis=0))
    if not 1 <= count <= distinct:
        raise ValueError(f"count: expected 1 to {distinct}, the number of different sizes, found {count}")
    if starts < 1:
        raise ValueError(f"starts: expected at least 1, found {starts}")
    generator = np.random.default_rng(seed)
    runs = [_run_k_means(sizes, _draw_initial_anchors(sizes, count, generator)) for _ in range(starts)]
    best = max(runs, key=lambda anchors: mean_best_iou(sizes, anchors))
    best = best[np.lexsort((best[:, 0], best.prod(1)))]
    return AnchorFit(tuple((float(w), float(h)) for w, h in best), mean_best_iou(sizes, best))


def mean_best_iou(sizes_wh: np.ndarray, anchors_wh: np.ndarray) -> float:
    """Mean over sizes (N, 2) of the highest IoU with any anchor (K, 2), in (0, 1]."""
    return float(size_iou(sizes_wh, anchors_wh).max(1).mean())


def size_iou(sizes_wh: np.ndarray, anchors_wh: np.ndarray) -> np.ndarray:
    """IoU (N, K) of boxes of sizes (N, 2) and anchors (K, 2) with one centre."""
    sizes, anchors = np.asarray(sizes_wh, np.float64), np.asarray(anchors_wh, np.float64)
    shared = np.minimum(sizes[:, None], anchors[None]).prod(2)
    return shared / (sizes.prod(1)[:, None] + anchors.prod(1)[None] - shared)


def target_sizes(targets: Targets) -> np.ndarray:
    """Sizes (M, 2) px, float64, of an image's objects that are not ignored and have an area."""
    objects = targets.boxes_xyxy[~targets.ignore].double().cpu().numpy()
    sizes = objects[:, 2:] - objects[:, :2]
    return sizes[(sizes > 0).all(1)]


def _validate_sizes(sizes_wh: np.ndarray) -> np.ndarray:
    sizes = np.asarray(sizes_wh, np.float64)
    if sizes.ndim != 2 or sizes.shape[1] != 2 or len(sizes) == 0:
        raise ValueError(f"sizes: expected shape (N, 2) with N of at least 1, found {sizes.shape}")
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise ValueError("sizes: expected positive finite numbers, found others")
    return sizes


def _draw_initial_anchors(sizes: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """(count, 2) distinct sizes, each drawn with probability proportional to the squared distance from the
    previous ones.
    """
    initial = [sizes[generator.integers(len(sizes))]]
    for _ in range(count - 1):
        distance = 1 - size_iou(sizes, np.stack(initial)).max(1)
        weight = np.where(distance > _ROUNDING, distance, 0.0) ** 2
        if weight.sum() == 0:  # the rest differs by rounding only: any will do
            weight = np.ones(len(sizes))
        initial.append(sizes[generator.choice(len(sizes), p=weight / weight.sum())])
    return np.stack(initial)


def _run_k_means(sizes: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Alternate between clusters and means until no size changes its cluster."""
    previous = np.full(len(sizes), -1)
    for _ in range(_MAX_ITERATIONS):
        overlap = size_iou(sizes, anchors)
        cluster = overlap.argmax(1)
        counts = np.bincount(cluster, minlength=len(anchors))
        if (cluster == previous).all():
            break
        # An empty cluster restarts at the size that fits worst.
        worst = iter(sizes[np.argsort(overlap.max(1), kind="stable")])
        sums = np.stack([np.bincount(cluster, sizes[:, axis], len(anchors)) for axis in (0, 1)], 1)
        anchors = np.stack([total / n if n else next(worst) for total, n in zip(sums, counts, strict=True)])
        previous = cluster
    return anchors
