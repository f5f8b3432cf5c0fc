"""KITTI's 2D object benchmark: matching, thresholds and average precision of the development kit.

Source: the object development kit of cvlibs.net/datasets/kitti (evaluate_object.cpp). What the kit does threshold
by threshold and frame by frame is done here once for every score at which anything changes, all frames together:
a pair that overlaps nothing else needs no search, and the few clusters that are left are replayed for each score.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivesem.evaluation.curves import KITTI_SAMPLES, Tally
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

CLASSES: dict[str, float] = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
"""What is judged, and the overlap that a detection must exceed."""
NEIGHBOURS: dict[str, str] = {"Van": "Car", "Person_sitting": "Pedestrian"}
"""Types that are neither missed nor a hit for a class."""
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHT_PX = (40.0, 25.0, 25.0)
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.30, 0.50)

SmallDetections = Literal["ignore", "count"]
"""What becomes of detections below the minimum height: the kit of 2017 ignores them, the older counts them."""
_REPLAYED_AT_ONCE = 3_000_000
"""Rows of pairs and detections that are replayed together: some 300 MB."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One class at one difficulty.

    tally: true and false positives at every score. collected_score, collected_frame (T,): the scores from which
    thresholds are drawn, and their frames.
    """

    name: str
    difficulty: str
    tally: Tally
    collected_score: Floats
    collected_frame: Integers

    @property
    def ground_truth(self) -> int:
        """How many objects count."""
        return int(self.tally.count())

    def thresholds(self, weights: Floats | None = None) -> Floats:
        """At most 41 scores, descending, about 1/40 of recall apart; see `recall_thresholds`."""
        if weights is None:
            scores = self.collected_score
        else:
            scores = np.repeat(self.collected_score, weights[self.collected_frame].astype(np.int64))
        return recall_thresholds(scores, self.tally.count(weights))

    def precision(self, weights: Floats | None = None) -> Floats:
        """Precision (41,) at recall 0, 1/40, ..., 1: each the best there or at a higher recall."""
        thresholds = self.thresholds(weights)
        hits, misfires = self.tally.curve(weights)
        # scores descend: the last step that is not below a threshold
        last = np.searchsorted(-self.tally.score, -thresholds, side="right") - 1
        samples = np.zeros(KITTI_SAMPLES)
        reached = hits[last] + misfires[last]
        # the kit divides by 0 where all that is left was matched to ignored objects
        samples[: len(last)] = np.where(reached > 0, hits[last] / np.maximum(reached, 1), 0.0)
        return np.maximum.accumulate(samples[::-1])[::-1]

    def r40(self, weights: Floats | None = None) -> float | None:
        """Mean of precision at 1/40, ..., 1, official since October 2019; None without objects."""
        return float(self.precision(weights)[1:].mean()) if self.tally.count(weights) > 0 else None

    def r11(self, weights: Floats | None = None) -> float | None:
        """Mean of precision at 0, 0.1, ..., 1; None without objects."""
        return float(self.precision(weights)[::4].mean()) if self.tally.count(weights) > 0 else None


def recall_thresholds(scores: Floats, objects: float) -> Floats:
    """Scores (at most 41) of `scores` (T,) at which recall comes nearest to 0, 1/40, ..., 1.

    Walks down the scores with a recall r = 0: score i is skipped while (i + 2) / objects is nearer to r than
    (i + 1) / objects is; the last never is. Otherwise it is a threshold, and r grows by 1/40.
    """
    ordered = np.sort(scores)[::-1]
    chosen: list[int] = []
    i, recall, last = 0, 0.0, len(ordered) - 1
    while i <= last and len(chosen) < KITTI_SAMPLES:
        # not skipped from about here on; two before, so that rounding decides as in a plain walk
        i = min(max(i, math.floor(recall * objects - 1.5) - 2), last)
        while i < last and (i + 2) / objects - recall < recall - (i + 1) / objects:
            i += 1
        chosen.append(i)
        recall += 1.0 / (KITTI_SAMPLES - 1.0)
        i += 1
    return ordered[chosen]


def evaluate(
    truths: Truths, found: Found, kinds: tuple[str, ...], small_detections: SmallDetections = "ignore"
) -> list[Curve]:
    """The curves of `CLASSES` at `DIFFICULTIES`, classes first.

    kinds: the types that labels are indices into, KITTI's; letter case is free. Truths with label EVERY_CLASS are
    DontCare regions; `Truths.ignore` is the same for one class.
    """
    plain = [kind.lower() for kind in kinds]
    found_kinds = np.array([*plain, ""], dtype=object)[found.label]
    truth_kinds = np.array([*plain, "dontcare"], dtype=object)[truths.label]
    curves: list[Curve] = []
    for name, least in CLASSES.items():
        neighbours = [kind.lower() for kind, of in NEIGHBOURS.items() if of == name]
        own = truth_kinds == name.lower()
        region = (truths.label == EVERY_CLASS) | (own & truths.ignore)
        valid = (own | np.isin(truth_kinds, neighbours)) & ~truths.ignore
        mine = found.rows(found_kinds == name.lower())
        matching = _Matching(truths.rows(valid), mine, least)
        stuff = truths.rows(region)
        on_stuff = overlapping(stuff, mine, least, np.ones(len(stuff), np.bool_))
        excused = np.zeros(len(mine), np.bool_)
        excused[on_stuff.found[on_stuff.overlap > least]] = True
        for d, difficulty in enumerate(DIFFICULTIES):
            judged = truths.rows(valid)
            height = judged.boxes[:, 5]
            counted = own[valid] & ~(
                (judged.occlusion > MAX_OCCLUSION[d])
                | (judged.truncation > MAX_TRUNCATION[d])
                | (height < MIN_HEIGHT_PX[d])
            )
            ignored = np.zeros(len(mine), np.bool_)
            if small_detections == "ignore":
                ignored = mine.boxes[:, 5] < MIN_HEIGHT_PX[d]
            curves.append(matching.curve(name, difficulty, counted, ignored, excused))
    return curves


class _Matching:
    """The pairs of one class, sorted into those that stand alone and clusters that compete."""

    def __init__(self, truths: Truths, found: Found, least: float) -> None:
        self.truths, self.found = truths, found
        pairs = overlapping(truths, found, least)
        pairs = pairs.rows(pairs.overlap > least)
        alone = (np.bincount(pairs.truth, minlength=len(truths))[pairs.truth] == 1) & (
            np.bincount(pairs.found, minlength=len(found))[pairs.found] == 1
        )
        self.alone = pairs.rows(alone)
        pairs = pairs.rows(~alone)
        cluster = clusters(pairs, len(truths), len(found))
        order = np.lexsort((pairs.found, pairs.truth, cluster))
        self.pairs, self.cluster = pairs.rows(order), cluster[order]
        self.single = np.ones(len(found), np.bool_)
        self.single[pairs.found] = False
        self.replays = _replays(self.pairs, self.cluster)

    def curve(self, name: str, difficulty: str, counted: Booleans, ignored: Booleans, excused: Booleans) -> Curve:
        """counted (M,): truths that must be found; ignored, excused (N,): detections that are too small, or on a
        region where nothing is judged.
        """
        truths, found = self.truths, self.found
        hit = np.zeros(len(found), np.bool_)
        taken = np.zeros(len(found), np.bool_)
        hit[self.alone.found[counted[self.alone.truth] & ~ignored[self.alone.found]]] = True
        taken[self.alone.found] = True
        misfire = self.single & ~taken & ~ignored & ~excused
        rows = np.flatnonzero(hit | misfire)
        scores, frames = [found.score[rows]], [found.frame[rows]]
        hits, misfires = [hit[rows].astype(np.float64)], [misfire[rows].astype(np.float64)]
        collected = [np.flatnonzero(hit)]
        if len(self.cluster):
            collected.append(_threshold_pass(self.pairs, self.cluster, found.score, counted, ignored))
            for replay in self.replays:
                rows, gained, wrong = replay.steps(found.score, counted, ignored, excused)
                scores.append(found.score[rows])
                frames.append(found.frame[rows])
                hits.append(gained)
                misfires.append(wrong)
        score = np.concatenate(scores)
        order = np.argsort(-score, kind="stable")
        best = np.concatenate(collected)
        return Curve(
            name,
            difficulty,
            Tally(
                score=score[order],
                frame=np.concatenate(frames)[order],
                hits=np.concatenate(hits)[order],
                misfires=np.concatenate(misfires)[order],
                objects=np.bincount(truths.frame[counted], minlength=truths.frames).astype(np.float64),
            ),
            collected_score=found.score[best],
            collected_frame=found.frame[best],
        )


def _threshold_pass(
    pairs: Pairs, cluster: Integers, score: Floats, counted: Booleans, ignored: Booleans
) -> Integers:
    """The detections (rows) of clusters whose scores are collected: truths in file order take the best score."""
    rank = rank_in_cluster(cluster, pairs.truth)
    assigned = np.zeros(len(score), np.bool_)
    collected = np.zeros(len(score), np.bool_)
    for r in range(int(rank.max()) + 1):
        now = np.flatnonzero(rank == r)
        f = pairs.found[now]
        key = np.where(assigned[f], -np.inf, score[f])
        best, greatest = first_greatest(key, cluster[now])
        chosen = now[best[greatest > -np.inf]]
        assigned[pairs.found[chosen]] = True
        good = counted[pairs.truth[chosen]] & ~ignored[pairs.found[chosen]]
        collected[pairs.found[chosen[good]]] = True
    return np.flatnonzero(collected)


def _members(cluster: Integers, found: Integers) -> tuple[Integers, Integers]:
    """Each pair of a cluster and a detection once, ascending."""
    count = int(found.max(initial=0)) + 1
    member = np.unique(cluster * count + found)
    return member // count, member % count


def _replays(pairs: Pairs, cluster: Integers) -> list[_Replay]:
    """The clusters in chunks that fit into memory."""
    sizes = np.bincount(cluster)
    members = np.bincount(_members(cluster, pairs.found)[0], minlength=len(sizes))
    cost = np.cumsum(members * (sizes + members))
    parts, first = [], 0
    while first < len(sizes):
        done = cost[first - 1] if first else 0
        last = max(int(np.searchsorted(cost, done + _REPLAYED_AT_ONCE, side="right")), first + 1)
        chosen = (cluster >= first) & (cluster < last)
        parts.append(_Replay(pairs.rows(chosen), cluster[chosen] - first))
        first = last
    return parts


class _Replay:
    """Clusters, each played once for every detection in it, with that detection's score as the threshold."""

    def __init__(self, pairs: Pairs, cluster: Integers) -> None:
        count = np.bincount(cluster)
        # members: the detections of each cluster, in file order
        member_cluster, self.members = _members(cluster, pairs.found)
        sizes = np.bincount(member_cluster, minlength=len(count))
        starts = np.cumsum(sizes) - sizes
        local = np.arange(len(self.members)) - starts[member_cluster]
        place = np.zeros(int(self.members.max()) + 1, np.int64)
        place[self.members] = local
        # one game a member; its slots are all members of its cluster
        slots = sizes[member_cluster]
        self.slot_game = np.repeat(np.arange(len(self.members)), slots)
        self.slot_found = self.members[np.repeat(starts[member_cluster], slots) + within(slots)]
        slot_start = np.cumsum(slots) - slots
        # the pairs of each game
        pair_start = np.cumsum(count) - count
        games = count[member_cluster]
        row = np.repeat(pair_start[member_cluster], games) + within(games)
        game = np.repeat(np.arange(len(self.members)), games)
        rank = rank_in_cluster(cluster, pairs.truth)[row]
        order = np.argsort(rank, kind="stable")
        self.rounds = np.split(order, np.searchsorted(rank[order], np.arange(1, int(rank.max()) + 1)))
        self.game, self.truth, self.overlap = game, pairs.truth[row], pairs.overlap[row]
        self.slot = slot_start[game] + place[pairs.found[row]]
        self.member_cluster = member_cluster

    def steps(
        self, score: Floats, counted: Booleans, ignored: Booleans, excused: Booleans
    ) -> tuple[Integers, Floats, Floats]:
        """Detections (rows), and by how much true and false positives grow as the threshold falls to each."""
        games = len(self.members)
        free = score[self.slot_found] >= score[self.members][self.slot_game]
        small = ignored[self.slot_found]
        hits = np.zeros(games)
        for now in self.rounds:
            slot = self.slot[now]
            # an ignored one only where there is no other, and then the first
            key = np.where(free[slot], np.where(small[slot], 0.0, self.overlap[now]), -1.0)
            best, greatest = first_greatest(key, self.game[now])
            chosen = now[best[greatest >= 0]]
            free[self.slot[chosen]] = False
            good = counted[self.truth[chosen]] & ~small[self.slot[chosen]]
            hits[self.game[chosen[good]]] += 1
        wrong = free & ~small & ~excused[self.slot_found]
        misfires = np.bincount(self.slot_game[wrong], minlength=games).astype(np.float64)
        order = np.lexsort((-score[self.members], self.member_cluster))
        same = np.diff(self.member_cluster[order], prepend=-1) == 0
        grown = [values[order] - np.where(same, np.roll(values[order], 1), 0.0) for values in (hits, misfires)]
        return self.members[order], grown[0], grown[1]
