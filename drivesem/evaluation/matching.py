"""Matches detections to objects by COCO's rule and by VOC's, all frames at once.

COCO (pycocotools, `evaluateImg`): by descending score, each detection takes the free object with the largest IoU. An
unmatched one is excused where a sufficient share of it lies on an ignored object. VOC (`VOCevaldet.m`): each detection
considers only the object that it overlaps most; it is wrong if that is taken, and excused if that is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drivesem.evaluation.curves import ClassMatches
from drivesem.evaluation.instances import (
    EVERY_CLASS,
    Booleans,
    DetectionTable,
    Floats,
    GroundTruthTable,
    Integers,
    OverlapPairs,
    counting_ranges,
    find_overlaps,
    group_argmax,
    label_clusters,
    rank_in_cluster,
)

MAX_DETECTIONS = 100
"""Maximum number of detections per image and class, by score (COCO)."""
UNMATCHED = -1
_NEARLY_ONE = 1 - 1e-10
"""Largest IoU threshold (pycocotools)."""


@dataclass(frozen=True, slots=True)
class MatchResult:
    """The matching of N detections at one threshold."""

    ground_truth: Integers
    """(N,) row of the object that each detection matches, or `UNMATCHED`."""
    excused: Booleans
    """(N,) detections that do not count: on something ignored, or beyond the maximum number."""


@dataclass(frozen=True)
class CandidatePairs:
    """Pairs of one class, or with an ignored region, above a minimum overlap, for matching at several thresholds."""

    ground_truth: GroundTruthTable
    """M objects."""
    detections: DetectionTable
    """N detections."""
    pairs: OverlapPairs
    """Pairs that may match."""
    judged: Booleans
    """(N,) detections within the maximum number per image and class."""

    @classmethod
    def from_tables(
        cls, truths: GroundTruthTable, detections: DetectionTable, least: float, limit: int | None = MAX_DETECTIONS
    ) -> CandidatePairs:
        """Find all candidate pairs.

        Args:
            truths: Objects.
            detections: Detections.
            least: Minimum overlap.
            limit: Maximum number of detections per image and class.
        """
        ignored = truths.ignore | (truths.label == EVERY_CLASS)
        pairs = find_overlaps(truths, detections, min(least, _NEARLY_ONE), ignored)
        same = truths.label[pairs.truth] == detections.label[pairs.detection]
        pairs = pairs.select(same | (truths.label[pairs.truth] == EVERY_CLASS))
        judged = np.ones(len(detections), np.bool_)
        if limit is not None:
            order = np.lexsort((-detections.score, detections.label, detections.frame))
            key = np.stack([detections.frame[order], detections.label[order]])
            starts = np.flatnonzero((np.diff(key, prepend=-2) != 0).any(axis=0))
            judged[order[counting_ranges(np.diff(starts, append=len(order))) >= limit]] = False
            pairs = pairs.select(judged[pairs.detection])
        return cls(truths, detections, pairs, judged)

    @cached_property
    def _ignored(self) -> Booleans:
        """(M,) objects that are neither missed nor detected."""
        return self.ground_truth.ignore | (self.ground_truth.label == EVERY_CLASS)

    @cached_property
    def _by_score(self) -> dict[int, Integers]:
        """Rows of each class's detections by descending score, in file order for equal scores."""
        order = np.lexsort((-self.detections.score, self.detections.label))
        classes, starts = np.unique(self.detections.label[order], return_index=True)
        return dict(zip(classes.tolist(), np.split(order, starts[1:]), strict=True)) if len(order) else {}

    @cached_property
    def _clusters(self) -> tuple[OverlapPairs, Integers]:
        """Pairs that share objects or detections, in matching order, and the cluster of each.

        A higher threshold leaves fewer pairs and joins no clusters, so one order serves all thresholds.
        """
        pairs = self.pairs.select(~self._ignored[self.pairs.truth])
        pairs = pairs.select(~self._is_isolated(pairs))
        cluster = label_clusters(pairs, len(self.ground_truth), len(self.detections))
        # by score within a cluster, in file order for equal scores; of equal overlaps, the last object wins
        order = np.lexsort((-pairs.truth, pairs.detection, -self.detections.score[pairs.detection], cluster))
        return pairs.select(order), cluster[order]

    def _is_isolated(self, pairs: OverlapPairs) -> Booleans:
        """(P,) pairs that share neither object nor detection with another one."""
        return (np.bincount(pairs.truth, minlength=len(self.ground_truth))[pairs.truth] == 1) & (
            np.bincount(pairs.detection, minlength=len(self.detections))[pairs.detection] == 1
        )

    def match_coco(self, least: float) -> MatchResult:
        """Match by COCO's rule at one IoU threshold."""
        threshold = min(least, _NEARLY_ONE)
        pairs = self.pairs.select(self.pairs.overlap >= threshold)
        excused = ~self.judged
        ignored = self._ignored[pairs.truth]
        excused[pairs.detection[ignored]] = True
        pairs = pairs.select(~ignored)
        truth = np.full(len(self.detections), UNMATCHED)
        isolated = self._is_isolated(pairs)
        truth[pairs.detection[isolated]] = pairs.truth[isolated]
        if not isolated.all():
            pairs, cluster = self._clusters
            enough = pairs.overlap >= threshold
            self._match_clusters(pairs.select(enough), cluster[enough], truth)
        return MatchResult(truth, excused & (truth == UNMATCHED))

    def _match_clusters(self, pairs: OverlapPairs, cluster: Integers, truth: Integers) -> None:
        """Fill in `truth` (N,) for pairs that share objects or detections, in the order of `_clusters`."""
        rank = rank_in_cluster(cluster, pairs.detection)
        by_rank = np.argsort(rank, kind="stable")
        free = np.ones(len(self.ground_truth), np.bool_)
        for now in np.split(by_rank, np.searchsorted(rank[by_rank], np.arange(1, int(rank.max()) + 1))):
            key = np.where(free[pairs.truth[now]], pairs.overlap[now], -1.0)
            best, greatest = group_argmax(key, cluster[now])
            chosen = now[best[greatest > 0]]
            free[pairs.truth[chosen]] = False
            truth[pairs.detection[chosen]] = pairs.truth[chosen]

    def match_voc(self, least: float) -> MatchResult:
        """Match by VOC's rule at one IoU threshold.

        A detection is excused if the object that it overlaps most is ignored ("difficult"), or if it is unmatched and
        a sufficient share of it lies on a region of every class.
        """
        near = self.pairs.select(self.pairs.overlap >= least)
        excused = np.zeros(len(self.detections), np.bool_)
        region = self.ground_truth.label[near.truth] == EVERY_CLASS
        excused[near.detection[region]] = True
        pairs = near.select(~region)
        pairs = replace(
            pairs, overlap=np.where(self.ground_truth.ignore[pairs.truth], self._iou(pairs), pairs.overlap)
        )
        pairs = pairs.select(pairs.overlap >= least)
        truth = np.full(len(self.detections), UNMATCHED)
        wrong = np.zeros(len(self.detections), np.bool_)
        if len(pairs.truth):
            pairs = pairs.select(np.lexsort((pairs.truth, pairs.detection)))
            best, _ = group_argmax(pairs.overlap, pairs.detection)
            pairs = pairs.select(best)
            difficult = self.ground_truth.ignore[pairs.truth]
            excused[pairs.detection[difficult]] = True
            pairs = pairs.select(~difficult)
            order = np.lexsort((pairs.detection, -self.detections.score[pairs.detection], pairs.truth))
            first = np.diff(pairs.truth[order], prepend=-1) != 0
            wrong[pairs.detection] = True
            truth[pairs.detection[order[first]]] = pairs.truth[order[first]]
        return MatchResult(truth, excused & ~wrong)

    def _iou(self, pairs: OverlapPairs) -> Floats:
        """IoU (P,) of pairs; for ignored objects, pairs store the detection's share instead."""
        one, other = self.ground_truth.boxes[pairs.truth], self.detections.boxes[pairs.detection]
        shared = (np.minimum(one[:, 2:4], other[:, 2:4]) - np.maximum(one[:, :2], other[:, :2])).prod(axis=1)
        return shared / (one[:, 4:].prod(axis=1) + other[:, 4:].prod(axis=1) - shared)

    def class_matches(self, match: MatchResult, label: int, counted: Booleans | None = None) -> ClassMatches:
        """Collect the matches of one class.

        Args:
            match: Matching at one threshold.
            label: Index of the class.
            counted: (M,) objects to detect; all by default. Matches of others count neither way.
        """
        truths, detections = self.ground_truth, self.detections
        wanted = (truths.label == label) & ~truths.ignore
        if counted is not None:
            wanted &= counted
        rows = self._by_score.get(label, np.zeros(0, np.int64))
        matched = match.ground_truth[rows]
        hit = np.append(wanted, False)[matched]  # UNMATCHED is the last
        misfire = (matched == UNMATCHED) & ~match.excused[rows]
        counts = hit | misfire
        rows = rows[counts]
        return ClassMatches(
            score=detections.score[rows],
            frame=detections.frame[rows],
            true_positives=hit[counts].astype(np.float64),
            false_positives=misfire[counts].astype(np.float64),
            objects=np.bincount(truths.frame[wanted], minlength=truths.frames).astype(np.float64),
        )


def mean_of_known(values: list[float | None]) -> float | None:
    """The mean of the known values; None without any."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
