"""Which detection finds which object, by COCO's rule and by VOC's, all frames together.

COCO (pycocotools, `evaluateImg`): detections by descending score take the free object with the greatest IoU; one
that finds none is excused where it meets an ignored object, by the share of itself that lies there. VOC
(`VOCevaldet.m`): each detection looks only at the object it overlaps most, and is wrong where that is taken, and
excused where that is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drivesem.evaluation.curves import Tally
from drivesem.evaluation.instances import (
    EVERY_CLASS,
    Booleans,
    Floats,
    Found,
    Integers,
    Pairs,
    Truths,
    clusters,
    first_greatest,
    overlapping,
    rank_in_cluster,
    within,
)

MAX_DETECTIONS = 100
"""Detections judged an image and class, the best ones (COCO)."""
NOTHING = -1
_NEARLY_ONE = 1 - 1e-10
"""No IoU threshold is higher (pycocotools)."""


@dataclass(frozen=True, slots=True)
class Match:
    """truth (N,): the object (row) that each detection finds, or NOTHING; excused (N,): counted nowhere, because
    it lies on what is ignored or beyond the number of detections that are judged.
    """

    truth: Integers
    excused: Booleans


@dataclass(frozen=True)
class Candidates:
    """Pairs of one class or of an ignored region, down to a least overlap, for several thresholds. judged (N,):
    detections among the best of their image and class.
    """

    truths: Truths
    found: Found
    pairs: Pairs
    judged: Booleans

    @classmethod
    def of(cls, truths: Truths, found: Found, least: float, limit: int | None = MAX_DETECTIONS) -> Candidates:
        """All pairs with an overlap of at least `least`. limit: detections judged an image and class."""
        ignored = truths.ignore | (truths.label == EVERY_CLASS)
        pairs = overlapping(truths, found, min(least, _NEARLY_ONE), ignored)
        same = truths.label[pairs.truth] == found.label[pairs.found]
        pairs = pairs.rows(same | (truths.label[pairs.truth] == EVERY_CLASS))
        judged = np.ones(len(found), np.bool_)
        if limit is not None:
            order = np.lexsort((-found.score, found.label, found.frame))
            key = np.stack([found.frame[order], found.label[order]])
            starts = np.flatnonzero((np.diff(key, prepend=-2) != 0).any(axis=0))
            judged[order[within(np.diff(starts, append=len(order))) >= limit]] = False
            pairs = pairs.rows(judged[pairs.found])
        return cls(truths, found, pairs, judged)

    @cached_property
    def _ignored(self) -> Booleans:
        """Objects (M,) that are neither missed nor a hit."""
        return self.truths.ignore | (self.truths.label == EVERY_CLASS)

    @cached_property
    def _by_score(self) -> Integers:
        """Detections (N,) by descending score, in file order where scores are equal."""
        return np.argsort(-self.found.score, kind="stable")

    @cached_property
    def _contest(self) -> tuple[Pairs, Integers]:
        """Pairs that share objects or detections, as they are looked at in turn, and the cluster of each.

        A higher threshold leaves fewer pairs, and what shares nothing stays apart: one order serves them all.
        """
        pairs = self.pairs.rows(~self._ignored[self.pairs.truth])
        pairs = pairs.rows(~self._alone(pairs))
        cluster = clusters(pairs, len(self.truths), len(self.found))
        # by score within a cluster, in file order where scores are equal; of equal overlaps the last object wins
        order = np.lexsort((-pairs.truth, pairs.found, -self.found.score[pairs.found], cluster))
        return pairs.rows(order), cluster[order]

    def _alone(self, pairs: Pairs) -> Booleans:
        """Which pairs share neither object nor detection with another one."""
        return (np.bincount(pairs.truth, minlength=len(self.truths))[pairs.truth] == 1) & (
            np.bincount(pairs.found, minlength=len(self.found))[pairs.found] == 1
        )

    def coco(self, least: float) -> Match:
        """COCO's matching at one IoU threshold."""
        threshold = min(least, _NEARLY_ONE)
        pairs = self.pairs.rows(self.pairs.overlap >= threshold)
        excused = ~self.judged
        ignored = self._ignored[pairs.truth]
        excused[pairs.found[ignored]] = True
        pairs = pairs.rows(~ignored)
        truth = np.full(len(self.found), NOTHING)
        alone = self._alone(pairs)
        truth[pairs.found[alone]] = pairs.truth[alone]
        if not alone.all():
            pairs, cluster = self._contest
            kept = pairs.overlap >= threshold
            self._compete(pairs.rows(kept), cluster[kept], truth)
        return Match(truth, excused & (truth == NOTHING))

    def _compete(self, pairs: Pairs, cluster: Integers, truth: Integers) -> None:
        """Fill in `truth` (N,) for pairs that share objects or detections, as `_contest` has them."""
        rank = rank_in_cluster(cluster, pairs.found)
        by_rank = np.argsort(rank, kind="stable")
        free = np.ones(len(self.truths), np.bool_)
        for now in np.split(by_rank, np.searchsorted(rank[by_rank], np.arange(1, int(rank.max()) + 1))):
            key = np.where(free[pairs.truth[now]], pairs.overlap[now], -1.0)
            best, greatest = first_greatest(key, cluster[now])
            chosen = now[best[greatest > 0]]
            free[pairs.truth[chosen]] = False
            truth[pairs.found[chosen]] = pairs.truth[chosen]

    def voc(self, least: float) -> Match:
        """VOC's matching at one IoU threshold. A detection that overlaps an ignored ("difficult") object most is
        excused, and one on a region of every class, by the share of itself there, if no object takes it.
        """
        near = self.pairs.rows(self.pairs.overlap >= least)
        excused = np.zeros(len(self.found), np.bool_)
        region = self.truths.label[near.truth] == EVERY_CLASS
        excused[near.found[region]] = True
        pairs = near.rows(~region)
        pairs = replace(pairs, overlap=np.where(self.truths.ignore[pairs.truth], self._iou(pairs), pairs.overlap))
        pairs = pairs.rows(pairs.overlap >= least)
        truth = np.full(len(self.found), NOTHING)
        wrong = np.zeros(len(self.found), np.bool_)
        if len(pairs.truth):
            pairs = pairs.rows(np.lexsort((pairs.truth, pairs.found)))
            best, _ = first_greatest(pairs.overlap, pairs.found)
            pairs = pairs.rows(best)
            difficult = self.truths.ignore[pairs.truth]
            excused[pairs.found[difficult]] = True
            pairs = pairs.rows(~difficult)
            order = np.lexsort((pairs.found, -self.found.score[pairs.found], pairs.truth))
            first = np.diff(pairs.truth[order], prepend=-1) != 0
            wrong[pairs.found] = True
            truth[pairs.found[order[first]]] = pairs.truth[order[first]]
        return Match(truth, excused & ~wrong)

    def _iou(self, pairs: Pairs) -> Floats:
        """IoU (P,) of pairs, of which those with ignored objects hold the detection's share."""
        one, other = self.truths.boxes[pairs.truth], self.found.boxes[pairs.found]
        shared = (np.minimum(one[:, 2:4], other[:, 2:4]) - np.maximum(one[:, :2], other[:, :2])).prod(axis=1)
        return shared / (one[:, 4:].prod(axis=1) + other[:, 4:].prod(axis=1) - shared)

    def tally(self, match: Match, label: int, counted: Booleans | None = None) -> Tally:
        """One class. counted (M,): objects to find; those that are found and not counted make no difference."""
        truths, found = self.truths, self.found
        wanted = (truths.label == label) & ~truths.ignore
        if counted is not None:
            wanted &= counted
        rows = self._by_score[found.label[self._by_score] == label]
        matched = match.truth[rows]
        hit = np.append(wanted, False)[matched]  # NOTHING is the last
        misfire = (matched == NOTHING) & ~match.excused[rows]
        kept = hit | misfire
        rows = rows[kept]
        return Tally(
            score=found.score[rows],
            frame=found.frame[rows],
            hits=hit[kept].astype(np.float64),
            misfires=misfire[kept].astype(np.float64),
            objects=np.bincount(truths.frame[wanted], minlength=truths.frames).astype(np.float64),
        )


def mean_of(values: list[float | None]) -> float | None:
    """The mean of those that are known; None where none is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
