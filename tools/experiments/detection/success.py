"""Success against queries: which share of the frames each arm has broken after so many.

Arms of these studies end a frame at its first success, so its number of queries is where that was; the share after
q queries is the empirical distribution of these numbers. Success is judged by `moved` labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import Difference, Figure, Interval, differences, intervals, rate
from tools.experiments.detection.counts import ArmCounts, FrameCounts


@dataclass(frozen=True, slots=True)
class SuccessCurve:
    """One arm. most: the queries it may take; shares: by queries (1 to most), with bounds over frames; mean:
    queries of a frame, those that were not broken with all of theirs.
    """

    name: str
    max_queries: int
    shares: tuple[Interval, ...]
    mean_queries: float | None

    def at(self, queries: int) -> Interval:
        """After so many queries, or all of them where there are fewer."""
        return self.shares[min(queries, self.max_queries) - 1]

    def to_json(self) -> list[dict[str, Any]]:
        """A row for each number of queries."""
        return [
            {"name": self.name, "queries": q, "share": one.value, "low": one.low, "high": one.high}
            for q, one in enumerate(self.shares, start=1)
        ]


def first_successes(frames: Sequence[FrameCounts]) -> Floats:
    """Queries (F,) to the first success of each frame; infinite where there was none."""
    return np.array([f.queries if f.success_moved else np.inf for f in frames], np.float64)


def success_curve(run: ArmCounts, draws: int, seed: int) -> SuccessCurve:
    """An arm's curve, with bootstrap intervals over frames."""
    first, most = first_successes(run.frames), query_limit(run)
    figures = [_share(first <= q) for q in range(1, most + 1)]
    shares = intervals(figures, len(first), draws, np.random.default_rng(seed))
    mean = float(np.mean([f.queries for f in run.frames])) if run.frames else None
    return SuccessCurve(run.arm.name, most, tuple(shares), mean)


def query_limit(run: ArmCounts) -> int:
    """How many queries an arm may take."""
    config = run.arm.config
    if config.method == "fgsm":
        return 1
    return config.queries or config.steps


def compare_success(run: ArmCounts, queries: int, other: ArmCounts, draws: int, seed: int) -> Difference:
    """The share that `run` breaks within so many queries (second), less what `other` does with all of its own
    (first); paired over frames.
    """
    mine, theirs = first_successes(run.frames) <= queries, np.isfinite(first_successes(other.frames))
    rng = np.random.default_rng(seed)
    (one,) = differences([_share(theirs)], [_share(mine)], len(mine), draws, rng)
    return one


def _share(broken: np.ndarray) -> Figure:
    """The share of frames (F,) bool, to be weighed by frames."""
    return rate("share", broken.astype(np.float64), np.ones(len(broken)))
