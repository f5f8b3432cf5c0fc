"""Precision and recall as sums over frames, so that a frame can be counted twice or not at all.

A `Tally` holds by how much true and false positives grow as the score threshold falls. A bootstrap draw is a
weight for each frame; the figures of the data set have weight 1 throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivesem.evaluation.instances import Floats, Integers

Rule = Literal["coco", "kitti", "voc", "voc07"]
"""How precision is sampled over recall; see `average_precision`."""
KITTI_SAMPLES = 41
_COCO_RECALL = np.linspace(0.0, 1.00, round((1.00 - 0.0) / 0.01) + 1)
"""As pycocotools has it, to the last bit."""


@dataclass(frozen=True, slots=True)
class Tally:
    """One class. E steps by descending score: score (E,), frame (E,), hits and misfires (E,): by how much true and
    false positives grow at and below that score (a step may be negative where a lower score changes who is
    matched). objects (F,): how many there are to find in each frame.
    """

    score: Floats
    frame: Integers
    hits: Floats
    misfires: Floats
    objects: Floats

    def curve(self, weights: Floats | None = None) -> tuple[Floats, Floats]:
        """True and false positives (E,) at each step's score. weights (F,): of the frames."""
        if weights is None:
            return np.cumsum(self.hits), np.cumsum(self.misfires)
        weight = weights[self.frame]
        return np.cumsum(self.hits * weight), np.cumsum(self.misfires * weight)

    def count(self, weights: Floats | None = None) -> float:
        """Objects to find."""
        return float(self.objects.sum() if weights is None else self.objects @ weights)

    def precision_recall(self) -> tuple[Floats, Floats]:
        """Precision and recall (E,) at each step; recall is NaN where there is no object."""
        hits, misfires = self.curve()
        objects = self.count()
        precision = hits / np.maximum(hits + misfires, 1)
        return precision, hits / objects if objects else np.full(len(hits), np.nan)

    def recall(self) -> float | None:
        """With all detections; None without objects."""
        objects = self.count()
        return float(self.hits.sum()) / objects if objects else None

    def best_f1(self) -> tuple[float, float, float, float] | None:
        """F1, its score, precision and recall, where F1 is greatest; None without objects or detections."""
        if not len(self.score) or not self.count():
            return None
        precision, recall = self.precision_recall()
        f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
        # only where the score falls next can a threshold stand
        f1[:-1][self.score[:-1] == self.score[1:]] = -1
        best = int(f1.argmax())
        return float(f1[best]), float(self.score[best]), float(precision[best]), float(recall[best])


def average_precision(tally: Tally, rule: Rule, weights: Floats | None = None) -> float | None:
    """The mean over recall samples of the best precision at that recall or a higher one; None without objects.

    coco: 101 samples 0, 0.01, ..., 1 (pycocotools). kitti: 40 samples 1/40, ..., 1 of the plain curve. voc: the
    whole area (VOC 2010 and later). voc07: 11 samples 0, 0.1, ..., 1.
    """
    if tally.count(weights) <= 0:
        return None
    if not len(tally.score):
        return 0.0
    if rule == "voc":
        recall, best = _envelope(tally, weights)
        return float(np.diff(recall, prepend=0.0) @ best)
    return float(sampled_precision(tally, rule, weights).mean())


def sampled_precision(
    tally: Tally, rule: Literal["coco", "kitti", "voc07"], weights: Floats | None = None
) -> Floats:
    """The best precision at each sample's recall or a higher one, of a tally with objects; 0 beyond its recall."""
    samples = {
        "coco": _COCO_RECALL,
        "kitti": np.arange(1, KITTI_SAMPLES) / (KITTI_SAMPLES - 1),
        "voc07": np.arange(11) / 10,
    }[rule]
    if not len(tally.score):
        return np.zeros(len(samples))
    recall, best = _envelope(tally, weights)
    # 1e-12: a recall of 0.3 that was computed as 3 / 10 must reach the sample 0.1 * 3; pycocotools has no margin
    margin = 0.0 if rule == "coco" else 1e-12
    places = np.searchsorted(recall, samples - margin, side="left")
    return np.where(places < len(best), best[np.minimum(places, len(best) - 1)], 0.0)


def _envelope(tally: Tally, weights: Floats | None) -> tuple[Floats, Floats]:
    """Recall (E,) at each step, and the best precision (E,) there or at a higher one."""
    hits, misfires = tally.curve(weights)
    # pycocotools divides so; where nothing was weighed yet, precision is 0
    precision = hits / (hits + misfires + np.spacing(1))
    return hits / tally.count(weights), np.maximum.accumulate(precision[::-1])[::-1]


def sampled_curve(tally: Tally, samples: int = 101) -> list[list[float]]:
    """Recall, best precision there or at a higher recall, and the score where it is reached: at most `samples`
    rows, evenly spaced in recall, as far as recall goes.
    """
    objects = tally.count()
    if not len(tally.score) or not objects:
        return []
    hits, misfires = tally.curve()
    recall = hits / objects
    precision = hits / np.maximum(hits + misfires, 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    wanted = np.linspace(0, 1, samples)
    places = np.searchsorted(recall, wanted - 1e-12, side="left")
    return [
        [float(w), float(best[i]), float(tally.score[i])]
        for w, i in zip(wanted, places, strict=True)
        if i < len(best)
    ]
