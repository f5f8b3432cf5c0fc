"""KITTI's 2D object benchmark: matching, thresholds and average precision of the development kit.

Source: the object development kit of cvlibs.net/datasets/kitti (evaluate_object.cpp). The kit matches threshold by
threshold and frame by frame; here all frames are matched at once for every score at which anything changes. A pair
that overlaps nothing else needs no search; the few remaining clusters are replayed for each score.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivesem.evaluation.curves import KITTI_SAMPLES, ClassMatches
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

CLASSES: dict[str, float] = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
"""Evaluated classes, and the IoU that a detection must exceed."""
NEIGHBOURS: dict[str, str] = {"Van": "Car", "Person_sitting": "Pedestrian"}
"""Types that count neither as misses nor as hits of a class."""
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHT_PX = (40.0, 25.0, 25.0)
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.30, 0.50)

SmallDetections = Literal["ignore", "count"]
"""Treatment of detections below the minimum height: the kit of 2017 ignores them, older ones count them."""
_REPLAYED_AT_ONCE = 3_000_000
"""Rows of pairs and detections per replayed batch: some 300 MB."""


@dataclass(frozen=True, slots=True)
class KittiCurve:
    """Matches of one class at one difficulty."""

    name: str
    """Class."""
    difficulty: str
    """One of `DIFFICULTIES`."""
    matches: ClassMatches
    """True and false positives at every score."""
    collected_score: Floats
    """(T,) scores from which thresholds are chosen."""
    collected_frame: Integers
    """(T,) their frames."""

    @property
    def object_count(self) -> int:
        """Number of objects to detect."""
        return int(self.matches.object_count())

    def thresholds(self, weights: Floats | None = None) -> Floats:
        """At most 41 descending scores, about 1/40 of recall apart; see `recall_thresholds`."""
        if weights is None:
            scores = self.collected_score
        else:
            scores = np.repeat(self.collected_score, weights[self.collected_frame].astype(np.int64))
        return recall_thresholds(scores, self.matches.object_count(weights))

    def precision(self, weights: Floats | None = None) -> Floats:
        """Precision (41,) at recall 0, 1/40, ..., 1: the maximum at that recall or a higher one."""
        thresholds = self.thresholds(weights)
        hits, misfires = self.matches.cumulative_counts(weights)
        # scores descend: the last step that is not below a threshold
        last = np.searchsorted(-self.matches.score, -thresholds, side="right") - 1
        samples = np.zeros(KITTI_SAMPLES)
        reached = hits[last] + misfires[last]
        # the kit divides by 0 where all remaining detections match ignored objects
        samples[: len(last)] = np.where(reached > 0, hits[last] / np.maximum(reached, 1), 0.0)
        return np.maximum.accumulate(samples[::-1])[::-1]

    def r40(self, weights: Floats | None = None) -> float | None:
        """Mean precision at recall 1/40, ..., 1, official since October 2019; None without objects."""
        return float(self.precision(weights)[1:].mean()) if self.matches.object_count(weights) > 0 else None

    def r11(self, weights: Floats | None = None) -> float | None:
        """Mean precision at recall 0, 0.1, ..., 1; None without objects."""
        return float(self.precision(weights)[::4].mean()) if self.matches.object_count(weights) > 0 else None


def recall_thresholds(scores: Floats, objects: float) -> Floats:
    """Choose at most 41 of `scores` (T,) at which recall is nearest to 0, 1/40, ..., 1.

    Starting with r = 0, score i is skipped while (i + 2) / objects is nearer to r than (i + 1) / objects; the last
    never is. Otherwise it becomes a threshold, and r grows by 1/40.
    """
    ordered = np.sort(scores)[::-1]
    chosen: list[int] = []
    i, recall, last = 0, 0.0, len(ordered) - 1
    while i <= last and len(chosen) < KITTI_SAMPLES:
        # skipping ends about here; start two earlier, so that rounding decides as in a plain loop
        i = min(max(i, math.floor(recall * objects - 1.5) - 2), last)
        while i < last and (i + 2) / objects - recall < recall - (i + 1) / objects:
            i += 1
        chosen.append(i)
        recall += 1.0 / (KITTI_SAMPLES - 1.0)
        i += 1
    return ordered[chosen]


def evaluate(
    truths: GroundTruthTable,
    detections: DetectionTable,
    kinds: tuple[str, ...],
    small_detections: SmallDetections = "ignore",
) -> list[KittiCurve]:
    """Compute the curves of `CLASSES` at `DIFFICULTIES`, ordered by class.

    Args:
        truths: Objects. Those with label `EVERY_CLASS` are DontCare regions; ignored ones are so for their class.
        detections: Detections.
        kinds: KITTI's types, which labels index; letter case does not matter.
        small_detections: Treatment of detections below the minimum height.
    """
    plain = [kind.lower() for kind in kinds]
    curves: list[KittiCurve] = []
    for name, least in CLASSES.items():
        neighbours = [kind.lower() for kind, of in NEIGHBOURS.items() if of == name]
        is_own, is_neighbour = (  # by label; `EVERY_CLASS` is the last
            np.array([*(kind in kinds_of for kind in plain), False]) for kinds_of in ([name.lower()], neighbours)
        )
        own = is_own[truths.label]
        region = (truths.label == EVERY_CLASS) | (own & truths.ignore)
        valid = (own | is_neighbour[truths.label]) & ~truths.ignore
        own_detections = detections.select(is_own[detections.label])
        judged = truths.select(valid)
        matching = _Matching(judged, own_detections, least)
        stuff = truths.select(region)
        on_stuff = find_overlaps(stuff, own_detections, least, np.ones(len(stuff), np.bool_))
        excused = np.zeros(len(own_detections), np.bool_)
        excused[on_stuff.detection[on_stuff.overlap > least]] = True
        for d, difficulty in enumerate(DIFFICULTIES):
            height = judged.boxes[:, 5]
            counted = own[valid] & ~(
                (judged.occlusion > MAX_OCCLUSION[d])
                | (judged.truncation > MAX_TRUNCATION[d])
                | (height < MIN_HEIGHT_PX[d])
            )
            ignored = np.zeros(len(own_detections), np.bool_)
            if small_detections == "ignore":
                ignored = own_detections.boxes[:, 5] < MIN_HEIGHT_PX[d]
            curves.append(matching.curve(name, difficulty, counted, ignored, excused))
    return curves


class _Matching:
    """The pairs of one class, separated into isolated pairs and clusters that compete."""

    def __init__(self, truths: GroundTruthTable, detections: DetectionTable, least: float) -> None:
        self.truths, self.detections = truths, detections
        pairs = find_overlaps(truths, detections, least)
        pairs = pairs.select(pairs.overlap > least)
        alone = (np.bincount(pairs.truth, minlength=len(truths))[pairs.truth] == 1) & (
            np.bincount(pairs.detection, minlength=len(detections))[pairs.detection] == 1
        )
        self.alone = pairs.select(alone)
        pairs = pairs.select(~alone)
        cluster = label_clusters(pairs, len(truths), len(detections))
        order = np.lexsort((pairs.detection, pairs.truth, cluster))
        self.pairs, self.cluster = pairs.select(order), cluster[order]
        self.single = np.ones(len(detections), np.bool_)
        self.single[pairs.detection] = False
        self.replays = _replays(self.pairs, self.cluster)

    def curve(
        self, name: str, difficulty: str, counted: Booleans, ignored: Booleans, excused: Booleans
    ) -> KittiCurve:
        """Compute a curve. counted (M,): objects to detect; ignored, excused (N,): detections that are too small, or
        in a region that is not evaluated.
        """
        truths, detections = self.truths, self.detections
        hit = np.zeros(len(detections), np.bool_)
        taken = np.zeros(len(detections), np.bool_)
        hit[self.alone.detection[counted[self.alone.truth] & ~ignored[self.alone.detection]]] = True
        taken[self.alone.detection] = True
        misfire = self.single & ~taken & ~ignored & ~excused
        rows = np.flatnonzero(hit | misfire)
        scores, frames = [detections.score[rows]], [detections.frame[rows]]
        hits, misfires = [hit[rows].astype(np.float64)], [misfire[rows].astype(np.float64)]
        collected = [np.flatnonzero(hit)]
        if len(self.cluster):
            collected.append(_threshold_pass(self.pairs, self.cluster, detections.score, counted, ignored))
            for replay in self.replays:
                rows, gained, wrong = replay.steps(detections.score, counted, ignored, excused)
                scores.append(detections.score[rows])
                frames.append(detections.frame[rows])
                hits.append(gained)
                misfires.append(wrong)
        score = np.concatenate(scores)
        order = np.argsort(-score, kind="stable")
        best = np.concatenate(collected)
        return KittiCurve(
            name,
            difficulty,
            ClassMatches(
                score=score[order],
                frame=np.concatenate(frames)[order],
                true_positives=np.concatenate(hits)[order],
                false_positives=np.concatenate(misfires)[order],
                objects=np.bincount(truths.frame[counted], minlength=truths.frames).astype(np.float64),
            ),
            collected_score=detections.score[best],
            collected_frame=detections.frame[best],
        )


def _threshold_pass(
    pairs: OverlapPairs, cluster: Integers, score: Floats, counted: Booleans, ignored: Booleans
) -> Integers:
    """Rows of the clusters' detections that provide scores for thresholds: in file order, objects take the detection
    with the highest score.
    """
    rank = rank_in_cluster(cluster, pairs.truth)
    assigned = np.zeros(len(score), np.bool_)
    collected = np.zeros(len(score), np.bool_)
    for r in range(int(rank.max()) + 1):
        now = np.flatnonzero(rank == r)
        f = pairs.detection[now]
        key = np.where(assigned[f], -np.inf, score[f])
        best, greatest = group_argmax(key, cluster[now])
        chosen = now[best[greatest > -np.inf]]
        assigned[pairs.detection[chosen]] = True
        good = counted[pairs.truth[chosen]] & ~ignored[pairs.detection[chosen]]
        collected[pairs.detection[chosen[good]]] = True
    return np.flatnonzero(collected)


def _members(cluster: Integers, detections: Integers) -> tuple[Integers, Integers]:
    """The unique pairs of a cluster and a detection, ascending."""
    count = int(detections.max(initial=0)) + 1
    member = np.sort(cluster * count + detections)
    member = member[np.diff(member, prepend=-1) != 0]  # np.unique hashes integers, which takes longer
    return member // count, member % count


def _replays(pairs: OverlapPairs, cluster: Integers) -> list[_Replay]:
    """Split the clusters into batches that fit into memory."""
    sizes = np.bincount(cluster)
    members = np.bincount(_members(cluster, pairs.detection)[0], minlength=len(sizes))
    cost = np.cumsum(members * (sizes + members))
    parts, first = [], 0
    while first < len(sizes):
        done = cost[first - 1] if first else 0
        last = max(int(np.searchsorted(cost, done + _REPLAYED_AT_ONCE, side="right")), first + 1)
        chosen = (cluster >= first) & (cluster < last)
        parts.append(_Replay(pairs.select(chosen), cluster[chosen] - first))
        first = last
    return parts


class _Replay:
    """Clusters, each matched once per detection in it, with that detection's score as the threshold."""

    def __init__(self, pairs: OverlapPairs, cluster: Integers) -> None:
        count = np.bincount(cluster)
        # members: the detections of each cluster, in file order
        member_cluster, self.members = _members(cluster, pairs.detection)
        sizes = np.bincount(member_cluster, minlength=len(count))
        starts = np.cumsum(sizes) - sizes
        local = np.arange(len(self.members)) - starts[member_cluster]
        place = np.zeros(int(self.members.max()) + 1, np.int64)
        place[self.members] = local
        # one game per member; its slots are all members of its cluster
        slots = sizes[member_cluster]
        self.slot_game = np.repeat(np.arange(len(self.members)), slots)
        self.slot_found = self.members[np.repeat(starts[member_cluster], slots) + counting_ranges(slots)]
        slot_start = np.cumsum(slots) - slots
        # the pairs of each game
        pair_start = np.cumsum(count) - count
        games = count[member_cluster]
        row = np.repeat(pair_start[member_cluster], games) + counting_ranges(games)
        game = np.repeat(np.arange(len(self.members)), games)
        rank = rank_in_cluster(cluster, pairs.truth)[row]
        order = np.argsort(rank, kind="stable")
        self.rounds = np.split(order, np.searchsorted(rank[order], np.arange(1, int(rank.max()) + 1)))
        self.game, self.truth, self.overlap = game, pairs.truth[row], pairs.overlap[row]
        self.slot = slot_start[game] + place[pairs.detection[row]]
        self.member_cluster = member_cluster

    def steps(
        self, score: Floats, counted: Booleans, ignored: Booleans, excused: Booleans
    ) -> tuple[Integers, Floats, Floats]:
        """Rows of detections, and the growth of true and false positives as the threshold falls to each.

        Args:
            score: (N,) of the detections.
            counted: (M,) objects to detect.
            ignored: (N,) detections that are too small.
            excused: (N,) detections in a region that is not evaluated.
        """
        games = len(self.members)
        free = score[self.slot_found] >= score[self.members][self.slot_game]
        small = ignored[self.slot_found]
        hits = np.zeros(games)
        for now in self.rounds:
            slot = self.slot[now]
            # a small detection only where there is no other, and then the first
            key = np.where(free[slot], np.where(small[slot], 0.0, self.overlap[now]), -1.0)
            best, greatest = group_argmax(key, self.game[now])
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
