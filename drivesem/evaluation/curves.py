"""Precision and recall as sums over frames, so that a bootstrap draw can weight each frame.

`ClassMatches` holds how much true and false positives grow as the score threshold falls. The metrics of a data set
have weight 1 for all frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivesem.evaluation.instances import Floats, Integers

InterpolationRule = Literal["coco", "kitti", "voc", "voc07"]
"""How recall is sampled; see `average_precision`."""
KITTI_SAMPLES = 41
_COCO_RECALL = np.linspace(0.0, 1.00, round((1.00 - 0.0) / 0.01) + 1)
"""Equal to pycocotools' to the last bit."""


@dataclass(frozen=True, slots=True)
class ClassMatches:
    """Matches of one class: E steps by descending score, in F frames."""

    score: Floats
    """(E,) score of each step."""
    frame: Integers
    """(E,) frame of each step."""
    true_positives: Floats
    """(E,) growth of the true positives; negative where a lower score changes the matching."""
    false_positives: Floats
    """(E,) growth of the false positives."""
    objects: Floats
    """(F,) number of objects to detect in each frame."""

    def cumulative_counts(self, weights: Floats | None = None) -> tuple[Floats, Floats]:
        """True and false positives (E,) at each step's score, with weights (F,) of the frames."""
        if weights is None:
            return np.cumsum(self.true_positives), np.cumsum(self.false_positives)
        weight = weights[self.frame]
        return np.cumsum(self.true_positives * weight), np.cumsum(self.false_positives * weight)

    def object_count(self, weights: Floats | None = None) -> float:
        """Number of objects to detect, with weights (F,) of the frames."""
        return float(self.objects.sum() if weights is None else self.objects @ weights)

    def precision_recall(self) -> tuple[Floats, Floats]:
        """Precision and recall (E,) at each step; recall is NaN without objects."""
        true_positives, false_positives = self.cumulative_counts()
        objects = self.object_count()
        precision = true_positives / np.maximum(true_positives + false_positives, 1)
        return precision, true_positives / objects if objects else np.full(len(true_positives), np.nan)

    def recall(self) -> float | None:
        """Recall with all detections; None without objects."""
        objects = self.object_count()
        return float(self.true_positives.sum()) / objects if objects else None

    def best_f1(self) -> tuple[float, float, float, float] | None:
        """The largest F1 and its score, precision and recall; None without objects or detections."""
        if not len(self.score) or not self.object_count():
            return None
        precision, recall = self.precision_recall()
        f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
        # a threshold can only lie where the score falls next
        f1[:-1][self.score[:-1] == self.score[1:]] = -1
        best = int(f1.argmax())
        return float(f1[best]), float(self.score[best]), float(precision[best]), float(recall[best])


def average_precision(
    matches: ClassMatches, rule: InterpolationRule, weights: Floats | None = None
) -> float | None:
    """Average the interpolated precision (the maximum at that recall or a higher one) over recall.

    Args:
        matches: Matches of a class.
        rule: Where recall is sampled. coco: 101 samples 0, 0.01, ..., 1 (pycocotools); kitti: 40 samples 1/40, ..., 1;
            voc: the area under the curve (VOC 2010 and later); voc07: 11 samples 0, 0.1, ..., 1.
        weights: (F,) of the frames.

    Returns:
        In [0, 1]; None without objects.
    """
    if matches.object_count(weights) <= 0:
        return None
    if not len(matches.score):
        return 0.0
    if rule == "voc":
        recall, best = _envelope(matches, weights)
        return float(np.diff(recall, prepend=0.0) @ best)
    return float(sampled_precision(matches, rule, weights).mean())


def sampled_precision(
    matches: ClassMatches, rule: Literal["coco", "kitti", "voc07"], weights: Floats | None = None
) -> Floats:
    """Interpolate precision at the recall samples of a rule, for matches with objects; 0 beyond the largest recall.

    Args:
        matches: Matches of a class.
        rule: See `average_precision`.
        weights: (F,) of the frames.
    """
    samples = {
        "coco": _COCO_RECALL,
        "kitti": np.arange(1, KITTI_SAMPLES) / (KITTI_SAMPLES - 1),
        "voc07": np.arange(11) / 10,
    }[rule]
    if not len(matches.score):
        return np.zeros(len(samples))
    recall, best = _envelope(matches, weights)
    # 1e-12: a recall of 3 / 10 must reach the sample 0.1 * 3; pycocotools has no margin
    margin = 0.0 if rule == "coco" else 1e-12
    places = np.searchsorted(recall, samples - margin, side="left")
    return np.where(places < len(best), best[np.minimum(places, len(best) - 1)], 0.0)


def _envelope(matches: ClassMatches, weights: Floats | None) -> tuple[Floats, Floats]:
    """Recall (E,) at each step, and the maximum precision (E,) there or at a higher one."""
    true_positives, false_positives = matches.cumulative_counts(weights)
    # as pycocotools divides; precision is 0 where nothing has weight yet
    precision = true_positives / (true_positives + false_positives + np.spacing(1))
    return true_positives / matches.object_count(weights), np.maximum.accumulate(precision[::-1])[::-1]


def sampled_curve(matches: ClassMatches, samples: int = 101) -> list[list[float]]:
    """Sample the curve evenly in recall: at most `samples` rows of recall, interpolated precision, and score."""
    objects = matches.object_count()
    if not len(matches.score) or not objects:
        return []
    true_positives, false_positives = matches.cumulative_counts()
    recall = true_positives / objects
    precision = true_positives / np.maximum(true_positives + false_positives, 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    recalls = np.linspace(0, 1, samples)
    places = np.searchsorted(recall, recalls - 1e-12, side="left")
    return [
        [float(w), float(best[i]), float(matches.score[i])]
        for w, i in zip(recalls, places, strict=True)
        if i < len(best)
    ]
