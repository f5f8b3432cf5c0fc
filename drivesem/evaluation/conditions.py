"""Recall by condition (weather, time of day), at equal box heights.

Frames of different conditions hold objects of different sizes: in fog, only near and therefore large cars are
labelled, and a detector looks better there than by day. So the recall within bins of box height is averaged with the
shares of these bins among the objects of a reference condition.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivesem.evaluation.instances import Booleans, Floats, Integers
from drivesem.evaluation.matching import UNMATCHED, CandidatePairs, MatchResult

HEIGHT_BINS_PX = (0.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0, 128.0, 192.0, np.inf)
"""Edges of the bins of box height."""
_LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class DetectedObjects:
    """N objects, and whether each is detected."""

    frame: Integers
    """(N,) index of the frame."""
    height: Floats
    """(N,) box height, px."""
    hit: Booleans
    """(N,) whether a detection matches."""

    @classmethod
    def from_matches(
        cls, candidates: CandidatePairs, match: MatchResult, label: int, threshold: float
    ) -> DetectedObjects:
        """Collect the objects of a class that are not ignored.

        Args:
            candidates: Objects and detections.
            match: Their matching.
            label: Index of the class.
            threshold: Lowest score of a detection.
        """
        truths = candidates.ground_truth
        rows = np.flatnonzero((truths.label == label) & ~truths.ignore)
        matched = match.ground_truth[candidates.detections.score >= threshold]
        return cls(truths.frame[rows], truths.boxes[rows, 5], np.isin(rows, matched[matched != UNMATCHED]))


@dataclass(frozen=True, slots=True)
class ConditionRow:
    """Recall of one class in one condition; None where nothing can be measured."""

    condition: str
    """Values of the attributes."""
    frames: int
    """Number of frames."""
    objects: int
    """Number of objects."""
    median_height: float | None
    """Median box height, px."""
    recall: float | None
    """Share of detected objects."""
    low: float | None
    """Lower end of its 95 % bootstrap interval over frames."""
    high: float | None
    """Upper end."""
    equal_recall: float | None
    """Recall at the box heights of the reference."""
    equal_low: float | None
    """Lower end of its 95 % bootstrap interval over frames; the reference's shares of heights are fixed."""
    equal_high: float | None
    """Upper end."""
    covered: float | None
    """Share of the reference's objects in bins of height that occur in this condition; the others do not count."""


def group_frames(attributes: Sequence[Mapping[str, str]], names: Sequence[str]) -> dict[str, Integers]:
    """Group frames by the values of attributes; frames without one of them are "unknown" there.

    Args:
        attributes: Attributes of each frame.
        names: Attributes to group by.

    Returns:
        Indices of frames by condition, the condition with most frames first.
    """
    groups: dict[str, list[int]] = {}
    for frame, values in enumerate(attributes):
        groups.setdefault(", ".join(values.get(name, "unknown") for name in names), []).append(frame)
    ordered = sorted(groups.items(), key=lambda group: (-len(group[1]), group[0]))
    return {name: np.array(frames, np.int64) for name, frames in ordered}


def recall_by_condition(
    objects: DetectedObjects,
    frames: int,
    groups: Mapping[str, Integers],
    reference: str,
    draws: int,
    generator: np.random.Generator,
) -> list[ConditionRow]:
    """Compute the recall of each condition, with bootstrap intervals over its frames.

    Args:
        objects: Objects of all frames.
        frames: Number of frames.
        groups: Indices of frames by condition.
        reference: Condition that gives the shares of box heights; it comes first.
        draws: Number of bootstrap draws; 0 for no intervals. A single frame has no interval.
        generator: Source of random numbers.
    """
    bins = len(HEIGHT_BINS_PX) - 1
    place = np.digitize(objects.height, HEIGHT_BINS_PX[1:-1])
    counts, hits = np.zeros((frames, bins)), np.zeros((frames, bins))
    np.add.at(counts, (objects.frame, place), 1)
    np.add.at(hits, (objects.frame, place), objects.hit)
    shares = counts[groups[reference]].sum(axis=0)
    shares /= max(shares.sum(), 1)
    order = [reference, *(name for name in groups if name != reference)]
    rows: list[ConditionRow] = []
    for name in order:
        chosen = groups[name]
        own_counts, own_hits = counts[chosen], hits[chosen]
        # one frame cannot show how much frames differ
        size = draws if len(chosen) > 1 else 0
        drawn = generator.multinomial(len(chosen), np.full(len(chosen), 1 / len(chosen)), size=size)
        total = own_counts.sum(axis=0)
        plain, equal = average_recalls(own_hits.sum(axis=0)[None], total[None], shares)
        plain_draws, equal_draws = average_recalls(drawn @ own_hits, drawn @ own_counts, shares)
        heights = objects.height[np.isin(objects.frame, chosen)]
        rows.append(
            ConditionRow(
                name,
                len(chosen),
                int(total.sum()),
                float(np.median(heights)) if len(heights) else None,
                _or_none(plain[0]),
                *_interval(plain_draws),
                _or_none(equal[0]),
                *_interval(equal_draws),
                _or_none(float(shares[total > 0].sum())) if total.any() else None,
            )
        )
    return rows


def average_recalls(hits: Floats, counts: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """Average recalls over bins of box height.

    Args:
        hits: (D, B) detected objects.
        counts: (D, B) objects.
        shares: (B,) weight of each bin.

    Returns:
        The recall (D,) of all objects, and the recall (D,) averaged by `shares` over the bins that have objects; NaN
        where there is no object.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        plain = hits.sum(axis=1) / counts.sum(axis=1)
        weights = np.where(counts > 0, shares, 0.0)
        equal = (np.nan_to_num(hits / counts) * weights).sum(axis=1) / weights.sum(axis=1)
    return plain, equal


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _interval(values: Floats) -> tuple[float | None, float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return None, None
    low, high = np.quantile(known, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return float(low), float(high)
