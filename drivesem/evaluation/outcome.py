"""What a detector hit, missed and made up in each frame, and intervals of its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detectors.types import Detections, Targets
from drivesem.evaluation.instances import Floats, Found, Truths, from_xyxy
from drivesem.evaluation.matching import NOTHING, Candidates, Match
from drivesem.evaluation.resampling import Averaged, Figure, Interval, Recalled, intervals

OVERLAP = 0.5
"""IoU from which a detection hits."""


@dataclass(frozen=True, slots=True)
class Marks:
    """Boxes (N, 4) px of one frame, of one class, at one score threshold. found: the detections that hit; hit,
    missed, ignored: true boxes; alarms: detections of nothing, and their scores (N,).
    """

    found: Floats
    hit: Floats
    missed: Floats
    ignored: Floats
    alarms: Floats
    alarm_scores: Floats

    @property
    def mistakes(self) -> int:
        """Missed objects and false alarms."""
        return len(self.missed) + len(self.alarms)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Objects and detections of one class (label 0) in all frames, matched as COCO does at OVERLAP."""

    candidates: Candidates
    match: Match

    @classmethod
    def of(cls, targets: Sequence[Targets], found: Sequence[Detections], label: int) -> Outcome:
        """The i-th targets and detections belong to one image; others than those of `label` are left out."""
        truth_rows = [t.labels == label for t in targets]
        found_rows = [d.labels == label for d in found]
        boxes = _stacked([t.boxes_xyxy[k].numpy() for t, k in zip(targets, truth_rows, strict=True)])
        unknown = np.full(len(boxes), -1)
        ignored = [t.ignore[k].numpy() for t, k in zip(targets, truth_rows, strict=True)]
        truths = Truths(
            frames=len(targets),
            frame=_frames([int(k.sum()) for k in truth_rows]),
            label=np.zeros(len(boxes), np.int64),
            boxes=from_xyxy(boxes),
            ignore=np.concatenate([np.zeros(0, np.bool_), *ignored]),
            truncation=unknown.astype(np.float64),
            occlusion=unknown,
            distance_m=np.full(len(boxes), np.nan),
            area=(boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]),
        )
        seen = _stacked([d.boxes_xyxy[k].numpy() for d, k in zip(found, found_rows, strict=True)])
        scores = [d.scores[k].numpy() for d, k in zip(found, found_rows, strict=True)]
        detections = Found(
            frame=_frames([int(k.sum()) for k in found_rows]),
            label=np.zeros(len(seen), np.int64),
            boxes=from_xyxy(seen),
            score=np.concatenate([np.zeros(0), *scores]),
        )
        candidates = Candidates.of(truths, detections, OVERLAP)
        return cls(candidates, candidates.coco(OVERLAP))

    def intervals(self, draws: int, seed: int) -> list[Interval]:
        """AP50 and recall with bootstrap bounds over frames."""
        tally = self.candidates.tally(self.match, 0)
        figures = (Figure("AP50", (Averaged(tally, "coco"),)), Figure("recall", (Recalled(tally),)))
        return intervals(figures, self.candidates.truths.frames, draws, np.random.default_rng(seed))

    def marks(self, frame: int, threshold: float) -> Marks:
        """One frame at detections of that score and above."""
        truths, found = self.candidates.truths, self.candidates.found
        mine = np.arange(*np.searchsorted(truths.frame, (frame, frame + 1)))
        seen = np.arange(*np.searchsorted(found.frame, (frame, frame + 1)))
        seen = seen[found.score[seen] >= threshold]
        matched = self.match.truth[seen]
        hit, ignored = np.isin(mine, matched), truths.ignore[mine]
        alarms = seen[(matched == NOTHING) & ~self.match.excused[seen]]
        boxes = truths.boxes[:, :4]
        return Marks(
            found=found.boxes[seen[matched != NOTHING], :4],
            hit=boxes[mine[hit]],
            missed=boxes[mine[~hit & ~ignored]],
            ignored=boxes[mine[ignored]],
            alarms=found.boxes[alarms, :4],
            alarm_scores=found.score[alarms],
        )


def _stacked(parts: Sequence[NDArray[np.float32]]) -> Floats:
    return np.concatenate([np.zeros((0, 4)), *parts]).astype(np.float64)


def _frames(counts: Sequence[int]) -> NDArray[np.int64]:
    return np.repeat(np.arange(len(counts)), counts)
