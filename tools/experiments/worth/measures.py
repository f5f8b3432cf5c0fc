"""Information worth and information gain (section 3 of the paper), and what they are for detection.

A classifier divides a data set into a subset for each of its answers; with memberships mu_i(x_t), realism rho(x_t)

    p_j^i   = sum_t rho mu_i 1[y_t = j] / sum_t rho mu_i
    gamma_i = sum_t rho mu_i / sum_l sum_t rho mu_l
    E       = sum_i gamma_i (- sum_j p_j^i log p_j^i),

the entropy of the true label that is left once the answer is known. Gain: E of a classifier less that of its
successor.

For detection each object is a point, and for each object there is one empty place in its frame, since a detector
that misses says "nothing" and that answer must have something to be wrong about. Answers are the classes and
nothing. A class's membership of an object is the best score among detections of the class that overlap the object
by IoU 0.5 and no other object more; nothing has what is left of 1. Empty places take the frame's false detections,
best first; the others are nothing for certain. Binary: the class of the best score from t* on, else nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import stdtrit  # Student's quantiles; `scipy.stats` takes a third of a second to load

from detectors import boxes
from detectors.types import CLASSES, Detections, Targets
from drivesem.evaluation.failures import MATCH_IOU
from drivesem.evaluation.resampling import LEVEL, Interval
from scene_ir.errors import RangeError, ShapeError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NOTHING = "nothing"
ANSWERS = (*CLASSES, NOTHING)
"""Of a detector: its classes, and that there is nothing."""
MEMBERSHIPS = ("binary", "fractional")


@dataclass(frozen=True, slots=True)
class Points:
    """A data set under one classifier. fractional, binary (M, I): memberships, rows that sum to 1; label (M,): the
    true one; unit (M,): what is drawn together for intervals, such as the frame; realism (M,) in [0, 1].
    """

    fractional: Floats
    binary: Floats
    label: Integers
    unit: Integers
    realism: Floats

    def membership(self, kind: str) -> Floats:
        """Of MEMBERSHIPS."""
        return self.binary if kind == "binary" else self.fractional


@dataclass(frozen=True, slots=True)
class Worth:
    """value: E; shares (I,): gamma; entropies (I,): of each subset, 0 for an empty one."""

    value: float
    shares: Floats
    entropies: Floats


def information_worth(
    membership: Floats, label: Integers, weights: Floats | None = None, base: float = np.e
) -> Worth:
    """E of memberships (M, I) and true labels (M,); weights (M,): rho, by default 1 each.

    Between 0 and the logarithm, to that base, of the number of labels. Raises ShapeError where sizes differ,
    RangeError for negative numbers, for a base that is no base, and where all weights are 0.
    """
    weights = np.ones(len(label)) if weights is None else weights
    if membership.ndim != 2 or len(membership) != len(label) or len(weights) != len(label):
        raise ShapeError("memberships, labels, weights", "one of each a point", membership.shape)
    if not base > 1:
        raise RangeError("base of the logarithm", "a number above 1", base)
    for name, values in (("memberships", membership), ("weights", weights)):
        if not (np.isfinite(values).all() and (values >= 0).all()):
            raise RangeError(name, "finite numbers of at least 0", "others")
    found = _of_mass(_mass(membership * weights[:, None], label, int(label.max(initial=0)) + 1), base)
    if found is None:
        raise RangeError("weights", "a point that counts", "none")
    return found


def _mass(membership: Floats, label: Integers, labels: int) -> Floats:
    """(I, labels): what there is of each label in each subset."""
    return membership.T @ one_hot(label, labels)


def _of_mass(mass: Floats, base: float) -> Worth | None:
    """Worth of masses (I, L); None where there is nothing."""
    inside = mass.sum(axis=1)
    if not inside.sum() > 0:
        return None
    p = np.divide(mass, inside[:, None], out=np.zeros_like(mass), where=inside[:, None] > 0)
    logs = np.log(p, out=np.zeros_like(p), where=p > 0) / np.log(base)
    entropies = np.abs(-(p * logs).sum(axis=1))
    shares = inside / inside.sum()
    return Worth(float(shares @ entropies), shares, entropies)


def realism(distances: Floats, largest: float | None = None) -> Floats:
    """rho = 1 - d / d_max, of distances (M,); largest: d_max, by default their greatest. 1 where all are 0."""
    largest = float(distances.max(initial=0)) if largest is None else largest
    return np.ones(len(distances)) if largest == 0 else 1 - distances / largest


def one_hot(places: Integers, count: int) -> Floats:
    """(M,) -> (M, count)."""
    return np.eye(count)[places]


def classified(probabilities: Floats, label: Integers, rho: Floats | None = None) -> Points:
    """Points of a classifier's probabilities (M, L): of equal ones the first is the answer."""
    return Points(
        fractional=probabilities,
        binary=one_hot(probabilities.argmax(axis=1), probabilities.shape[1]),
        label=label,
        unit=np.arange(len(label)),
        realism=np.ones(len(label)) if rho is None else rho,
    )


def detected(targets: Targets, found: Detections, t_star: float, rho: Floats | None = None) -> Points:
    """Points of one frame: its objects that are not ignored, then as many empty places.

    Labels are places in CLASSES. rho: realism of each object; an empty place has their mean.
    """
    overlap = boxes.iou_matrix(found.boxes_xyxy, targets.boxes_xyxy)
    kept = ~targets.ignore
    share = boxes.ioa_matrix(found.boxes_xyxy, targets.boxes_xyxy)
    same = found.labels[:, None] == targets.labels[None]
    excused = (same & targets.ignore & (share >= MATCH_IOU)).any(dim=1)
    overlap, label = overlap[:, kept], targets.labels[kept].numpy().astype(np.int64)
    count = len(label)
    scores = np.zeros((2 * count, len(CLASSES)))
    empty = count
    for d in torch.argsort(found.scores, descending=True, stable=True).tolist():
        best = int(overlap[d].argmax()) if count else 0
        if count and float(overlap[d, best]) >= MATCH_IOU:
            place = best
        elif excused[d] or empty == 2 * count:
            continue
        else:
            place, empty = empty, empty + 1
        kind = int(found.labels[d])
        scores[place, kind] = max(scores[place, kind], float(found.scores[d]))
    rho = np.ones(count) if rho is None else rho
    return Points(
        fractional=_with_nothing(scores),
        binary=_answered(scores, t_star),
        label=np.concatenate([label, np.full(count, len(CLASSES))]),
        unit=np.zeros(2 * count, np.int64),
        realism=np.concatenate([rho, np.full(count, rho.mean() if count else 1.0)]),
    )


def _with_nothing(scores: Floats) -> Floats:
    """Scores (M, L) as memberships (M, L + 1): nothing has what is left of 1; more than 1 is scaled."""
    total = scores.sum(axis=1, keepdims=True)
    return np.concatenate([scores, np.maximum(1 - total, 0)], axis=1) / np.maximum(total, 1)


def _answered(scores: Floats, t_star: float) -> Floats:
    answer = np.where(scores.max(axis=1, initial=0) >= t_star, scores.argmax(axis=1), scores.shape[1])
    return one_hot(answer, scores.shape[1] + 1)


def joined(parts: Sequence[Points]) -> Points:
    """Several frames' points as one data set; each frame is a unit."""
    unit = np.repeat(np.arange(len(parts)), [len(part.label) for part in parts])
    names = ("fractional", "binary", "label", "realism")
    stacked = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Points(**stacked, unit=unit)


@dataclass(frozen=True, slots=True)
class Setting:
    """How worth is counted. weighted: whether realism counts."""

    kind: str
    weighted: bool
    base: float = float(np.e)


def jackknife(name: str, value: float | None, without: Sequence[float | None]) -> Interval:
    """A figure and its 95 % interval by what it is without each of the units in turn (Quenouille 1956, Tukey
    1958): of one that few units make too small, as they do an entropy, or too large. No bounds where one of these
    is None, or they are fewer than two.

    That bias, as far as it goes with one over their number, is taken from the interval and not from the value,
    which may thus lie outside. The bootstrap, whose draws have fewer different units still, would have it twice.
    """
    known, units = np.array([v for v in without if v is not None]), len(without)
    if value is None or len(known) < max(units, 2):
        return Interval(name, value, None, None)
    apart = known - known.mean()
    middle = units * value - (units - 1) * float(known.mean())
    half = float(stdtrit(units - 1, (1 + LEVEL) / 2)) * math.sqrt((units - 1) / units * float(apart @ apart))
    return Interval(name, value, middle - half, middle + half)


def worth_of(points: Points, setting: Setting) -> Interval:
    """Information worth, with its interval, within what an entropy can be; None where nothing counts."""
    value, without = _worths(points, setting)
    one = jackknife(setting.kind, value, without)
    if one.low is None or one.high is None:
        return one
    most = np.log(len(np.unique(points.label))) / np.log(setting.base)
    low, high = np.clip((one.low, one.high), 0, most).tolist()
    return replace(one, low=low, high=high)


def gain_of(before: Points, after: Points, setting: Setting) -> Interval:
    """Information gain of a classifier's successor on the same points. Raises ShapeError where they differ."""
    if not (np.array_equal(before.label, after.label) and np.array_equal(before.unit, after.unit)):
        raise ShapeError("points of the successor", f"the same {len(before.label)} labels", len(after.label))
    (first, one_out), (second, other_out) = (
        _worths(points, setting) for points in (before, replace(after, realism=before.realism))
    )
    value, *without = (
        None if a is None or b is None else a - b
        for a, b in zip((first, *one_out), (second, *other_out), strict=True)
    )
    return jackknife(setting.kind, value, without)


def _worths(points: Points, setting: Setting) -> tuple[float | None, list[float | None]]:
    """Worth of all points, and of those without each unit in turn."""
    counts = points.realism if setting.weighted else np.ones(len(points.label))
    weighed = points.membership(setting.kind) * counts[:, None]
    labels = int(points.label.max(initial=0)) + 1
    whole = _mass(weighed, points.label, labels)

    def value(mass: Floats) -> float | None:
        found = _of_mass(mass, setting.base)
        return None if found is None else found.value

    order = np.argsort(points.unit, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(points.unit[order])) + 1)
    # What is left may be short of 0 by rounding.
    left = (np.maximum(whole - _mass(weighed[one], points.label[one], labels), 0) for one in rows if len(one))
    return value(whole), [value(mass) for mass in left]
