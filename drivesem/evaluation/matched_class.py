"""Detections of one class, matched to the labels of all frames at one IoU or at COCO's ten."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detectors.types import Detections, Targets
from drivesem.evaluation.coco import IOU_50, IOU_70, IOU_THRESHOLDS, ClassScores
from drivesem.evaluation.curves import ClassMatches, sampled_precision
from drivesem.evaluation.instances import (
    Booleans,
    DetectionTable,
    Floats,
    GroundTruthTable,
    Integers,
    boxes_from_xyxy,
)
from drivesem.evaluation.matching import UNMATCHED, CandidatePairs, MatchResult
from drivesem.evaluation.resampling import (
    Interval,
    NamedMetric,
    WeightedAveragePrecision,
    WeightedRecall,
    bootstrap_intervals,
)

OVERLAP = 0.5
"""Minimum IoU of a hit."""


@dataclass(frozen=True, slots=True)
class FrameMarks:
    """Boxes (N, 4) px of one class in one frame at one score threshold."""

    hits: Floats
    """Detections that match an object."""
    matched: Floats
    """Objects that are detected."""
    missed: Floats
    """Objects that are missed."""
    ignored: Floats
    """Objects that are ignored."""
    false_positives: Floats
    """Detections that match nothing."""
    false_positive_scores: Floats
    """(N,) their scores."""

    @property
    def error_count(self) -> int:
        """Number of missed objects and false positives."""
        return len(self.missed) + len(self.false_positives)


@dataclass(frozen=True, slots=True)
class MatchedClass:
    """One class in all frames, matched by COCO's rule at `OVERLAP`."""

    candidates: CandidatePairs
    """Objects and detections of the class, with label 0."""
    match: MatchResult
    """Their matching."""

    @classmethod
    def from_frames(cls, targets: Sequence[Targets], found: Sequence[Detections], label: int) -> MatchedClass:
        """Match the objects and detections of one class.

        Args:
            targets: Labels of each image.
            detections: Detections in each image.
            label: Index of the class.
        """
        truth_rows = [t.labels == label for t in targets]
        found_rows = [d.labels == label for d in found]
        boxes = _stacked([t.boxes_xyxy[k].numpy() for t, k in zip(targets, truth_rows, strict=True)])
        unknown = np.full(len(boxes), -1)
        ignored = [t.ignore[k].numpy() for t, k in zip(targets, truth_rows, strict=True)]
        truths = GroundTruthTable(
            frames=len(targets),
            frame=_frames([int(k.sum()) for k in truth_rows]),
            label=np.zeros(len(boxes), np.int64),
            boxes=boxes_from_xyxy(boxes),
            ignore=np.concatenate([np.zeros(0, np.bool_), *ignored]),
            truncation=unknown.astype(np.float64),
            occlusion=unknown,
            distance_m=np.full(len(boxes), np.nan),
            area=(boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]),
        )
        seen = _stacked([d.boxes_xyxy[k].numpy() for d, k in zip(found, found_rows, strict=True)])
        scores = [d.scores[k].numpy() for d, k in zip(found, found_rows, strict=True)]
        detections = DetectionTable(
            frame=_frames([int(k.sum()) for k in found_rows]),
            label=np.zeros(len(seen), np.int64),
            boxes=boxes_from_xyxy(seen),
            score=np.concatenate([np.zeros(0), *scores]),
        )
        candidates = CandidatePairs.from_tables(truths, detections, OVERLAP)
        return cls(candidates, candidates.match_coco(OVERLAP))

    def intervals(self, draws: int, seed: int) -> list[Interval]:
        """AP50 and recall with bootstrap intervals over frames."""
        tally = self.candidates.class_matches(self.match, 0)
        metrics = (
            NamedMetric("AP50", (WeightedAveragePrecision(tally, "coco"),)),
            NamedMetric("recall", (WeightedRecall(tally),)),
        )
        return bootstrap_intervals(
            metrics, self.candidates.ground_truth.frames, draws, np.random.default_rng(seed)
        )

    def frame_marks(self, frame: int, threshold: float) -> FrameMarks:
        """The boxes of one frame, with detections of at least that score."""
        truths, found = self.candidates.ground_truth, self.candidates.detections
        mine = np.arange(*np.searchsorted(truths.frame, (frame, frame + 1)))
        seen = np.arange(*np.searchsorted(found.frame, (frame, frame + 1)))
        seen = seen[found.score[seen] >= threshold]
        matched = self.match.ground_truth[seen]
        hit, ignored = np.isin(mine, matched), truths.ignore[mine]
        alarms = seen[(matched == UNMATCHED) & ~self.match.excused[seen]]
        boxes = truths.boxes[:, :4]
        return FrameMarks(
            hits=found.boxes[seen[matched != UNMATCHED], :4],
            matched=boxes[mine[hit]],
            missed=boxes[mine[~hit & ~ignored]],
            ignored=boxes[mine[ignored]],
            false_positives=found.boxes[alarms, :4],
            false_positive_scores=found.score[alarms],
        )


def _stacked(parts: Sequence[NDArray[np.float32]]) -> Floats:
    return np.concatenate([np.zeros((0, 4)), *parts]).astype(np.float64)


def _frames(counts: Sequence[int]) -> NDArray[np.int64]:
    return np.repeat(np.arange(len(counts)), counts)


FALSE, TRUE, IGNORED = range(3)
"""Marks of a detection at one IoU threshold."""


@dataclass(frozen=True, slots=True)
class ThresholdMatches:
    """N detections of one class in F frames, matched at each of COCO's T IoU thresholds."""

    frame: Integers
    """(N,) ascending."""
    score: Floats
    """(N,) exact values of float32."""
    marks: Integers
    """(N, T) `FALSE`, `TRUE` or `IGNORED` at each of `IOU_THRESHOLDS`."""
    objects: Floats
    """(F,) number of objects to detect."""

    @classmethod
    def from_frames(
        cls, targets: Sequence[Targets], detections: Sequence[Detections], label: int
    ) -> ThresholdMatches:
        """Match by COCO's rule.

        Args:
            targets: Labels of each frame.
            detections: Detections in each frame.
            label: Index of the class.
        """
        candidates = MatchedClass.from_frames(targets, detections, label).candidates
        found, truths = candidates.detections, candidates.ground_truth
        marks = np.full((len(found), len(IOU_THRESHOLDS)), FALSE)
        for place, overlap in enumerate(IOU_THRESHOLDS):
            match = candidates.match_coco(overlap)
            marks[match.ground_truth != UNMATCHED, place] = TRUE
            marks[match.excused, place] = IGNORED
        objects = np.bincount(truths.frame[~truths.ignore], minlength=truths.frames)
        return cls(found.frame, found.score, marks, objects.astype(np.float64))

    def class_matches(self, place: int) -> ClassMatches:
        """The matches at one of `IOU_THRESHOLDS`, by its index."""
        order = np.argsort(-self.score, kind="stable")
        rows = order[self.marks[order, place] != IGNORED]
        hits = self.marks[rows, place] == TRUE
        return ClassMatches(
            score=self.score[rows],
            frame=self.frame[rows],
            true_positives=hits.astype(np.float64),
            false_positives=(~hits).astype(np.float64),
            objects=self.objects,
        )

    def affects_metrics(self) -> Booleans:
        """(N,) detections that affect the metrics under any weights of the frames: those not ignored at every IoU,
        from the lowest score of a true one. False ones below it come after the last step of recall.
        """
        true = (self.marks == TRUE).any(axis=1)
        lowest = self.score[true].min(initial=np.inf)
        return (self.score >= lowest) & (self.marks != IGNORED).any(axis=1)

    def scores(self, t_star: float) -> ClassScores:
        """Compute the metrics of `coco.evaluate`, equal to the last bit."""
        objects = int(self.objects.sum())
        if not objects:
            return ClassScores(None, None, None, None, None, 0)
        tallies = (self.class_matches(place) for place in range(len(IOU_THRESHOLDS)))
        precision = np.stack([sampled_precision(tally, "coco") for tally in tallies])
        hits = self.score[self.marks[:, IOU_50] == TRUE]
        return ClassScores(
            ap50=float(precision[IOU_50].mean()),
            ap70=float(precision[IOU_70].mean()),
            ap=float(precision.mean()),
            recall=len(hits) / objects,
            recall_at_t_star=int((hits >= t_star).sum()) / objects,
            objects=objects,
        )
