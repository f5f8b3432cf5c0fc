"""Detections of one class, each with what it is beside the labels at COCO's IoUs: all that its figures need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detectors.types import Detections, Targets
from drivesem.evaluation.coco import IOU_50, IOU_70, IOU_THRESHOLDS, ClassScores
from drivesem.evaluation.curves import Tally, sampled_precision
from drivesem.evaluation.instances import Booleans, Floats, Integers
from drivesem.evaluation.matching import NOTHING
from drivesem.evaluation.outcome import Outcome

FALSE, TRUE, IGNORED = range(3)
"""What a detection is at one IoU."""


@dataclass(frozen=True, slots=True)
class Matches:
    """N detections of one class in the pictures of F frames, beside the labels of one mode. frame (N,), ascending;
    score (N,): as float32 has them; marks (N, T): FALSE, TRUE or IGNORED at each of IOU_THRESHOLDS; objects (F,):
    how many there are to find.
    """

    frame: Integers
    score: Floats
    marks: Integers
    objects: Floats

    @classmethod
    def of(cls, targets: Sequence[Targets], detections: Sequence[Detections], label: int) -> Matches:
        """Matched as COCO does. The i-th of both belong to one frame."""
        candidates = Outcome.of(targets, detections, label).candidates
        found, truths = candidates.found, candidates.truths
        marks = np.full((len(found), len(IOU_THRESHOLDS)), FALSE)
        for place, overlap in enumerate(IOU_THRESHOLDS):
            match = candidates.coco(overlap)
            marks[match.truth != NOTHING, place] = TRUE
            marks[match.excused, place] = IGNORED
        objects = np.bincount(truths.frame[~truths.ignore], minlength=truths.frames)
        return cls(found.frame, found.score, marks, objects.astype(np.float64))

    def tally(self, place: int) -> Tally:
        """At one of IOU_THRESHOLDS."""
        order = np.argsort(-self.score, kind="stable")
        rows = order[self.marks[order, place] != IGNORED]
        hits = self.marks[rows, place] == TRUE
        return Tally(
            score=self.score[rows],
            frame=self.frame[rows],
            hits=hits.astype(np.float64),
            misfires=(~hits).astype(np.float64),
            objects=self.objects,
        )

    def telling(self) -> Booleans:
        """Which detections (N,) have a say in the figures, however frames are weighed: those from the lowest true
        one on, without what is ignored at every IoU. False ones below it come after the last step of recall.
        """
        true = (self.marks == TRUE).any(axis=1)
        lowest = self.score[true].min(initial=np.inf)
        return (self.score >= lowest) & (self.marks != IGNORED).any(axis=1)

    def scores(self, t_star: float) -> ClassScores:
        """The figures that `coco.evaluate` gives of the same pictures, to the last bit."""
        objects = int(self.objects.sum())
        if not objects:
            return ClassScores(None, None, None, None, None, 0)
        tallies = (self.tally(place) for place in range(len(IOU_THRESHOLDS)))
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
