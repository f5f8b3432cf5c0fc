"""Information worth and information gain (section 3 of the paper), also for detection.

A classifier divides a data set into a subset for each of its answers. With memberships mu_i(x_t) and realism rho(x_t)

    p_j^i   = sum_t rho mu_i 1[y_t = j] / sum_t rho mu_i
    gamma_i = sum_t rho mu_i / sum_l sum_t rho mu_l
    E       = sum_i gamma_i (- sum_j p_j^i log p_j^i),

E is the entropy of the true label that is left once the answer is known. Gain: E of a classifier less that of its
successor.

For detection each object is a point, and for each object its frame has one empty place as a further point: a detector
that misses answers "nothing", and that answer must be able to be wrong. Answers are the classes and nothing. A
class's membership of an object is the best score of its detections that overlap the object at an IoU of 0.5 and no
other object more; nothing has what is left of 1. Empty places take the frame's false detections, best first; the
others are nothing with certainty. Binary: the class of the best score from t* on, or else nothing.
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
"""Answers of a detector."""
MEMBERSHIPS = ("binary", "fractional")


@dataclass(frozen=True, slots=True)
class MembershipPoints:
    """A data set of M points under one classifier with I answers."""

    fractional: Floats
    """Fractional memberships (M, I); rows sum to 1."""
    binary: Floats
    """Binary memberships (M, I)."""
    label: Integers
    """True labels (M,)."""
    unit: Integers
    """Unit that a point is resampled with (M,), such as its frame."""
    realism: Floats
    """Realism (M,) in [0, 1]."""

    def membership(self, kind: str) -> Floats:
        """Memberships (M, I) of a kind of MEMBERSHIPS."""
        return self.binary if kind == "binary" else self.fractional


@dataclass(frozen=True, slots=True)
class InformationWorth:
    """Expected entropy of the true label once the answer is known."""

    value: float
    """E, the weighted mean of the entropies."""
    shares: Floats
    """Share gamma of each subset (I,)."""
    entropies: Floats
    """Entropy of each subset (I,); 0 for an empty one."""


def information_worth(
    membership: Floats, label: Integers, weights: Floats | None = None, base: float = np.e
) -> InformationWorth:
    """Information worth of memberships, between 0 and the logarithm of the number of labels.

    Args:
        membership: Memberships (M, I).
        label: True labels (M,).
        weights: Weights rho (M,), by default 1 each.
        base: Base of the logarithm.

    Raises:
        ShapeError: Sizes that differ.
        RangeError: Negative numbers, a base of at most 1, or weights that are all 0.
    """
    weights = np.ones(len(label)) if weights is None else weights
    if membership.ndim != 2 or len(membership) != len(label) or len(weights) != len(label):
        raise ShapeError("memberships, labels, weights", "one of each a point", membership.shape)
    if not base > 1:
        raise RangeError("base of the logarithm", "a number above 1", base)
    for name, values in (("memberships", membership), ("weights", weights)):
        if not (np.isfinite(values).all() and (values >= 0).all()):
            raise RangeError(name, "finite numbers of at least 0", "others")
    found = _worth_from_mass(_mass(membership * weights[:, None], label, int(label.max(initial=0)) + 1), base)
    if found is None:
        raise RangeError("weights", "a point that counts", "none")
    return found


def _mass(membership: Floats, label: Integers, labels: int) -> Floats:
    """Mass of each label in each subset (I, labels)."""
    return membership.T @ one_hot(label, labels)


def _worth_from_mass(mass: Floats, base: float) -> InformationWorth | None:
    """Worth of masses (I, L); None without any mass."""
    inside = mass.sum(axis=1)
    if not inside.sum() > 0:
        return None
    p = np.divide(mass, inside[:, None], out=np.zeros_like(mass), where=inside[:, None] > 0)
    logs = np.log(p, out=np.zeros_like(p), where=p > 0) / np.log(base)
    entropies = np.abs(-(p * logs).sum(axis=1))
    shares = inside / inside.sum()
    return InformationWorth(float(shares @ entropies), shares, entropies)


def realism(distances: Floats, largest: float | None = None) -> Floats:
    """Realism rho = 1 - d / d_max of distances (M,); 1 if all are 0. `largest`: d_max, by default their maximum."""
    largest = float(distances.max(initial=0)) if largest is None else largest
    return np.ones(len(distances)) if largest == 0 else 1 - distances / largest


def one_hot(places: Integers, count: int) -> Floats:
    """Indices (M,) as one-hot rows (M, count)."""
    return np.eye(count)[places]


def points_from_probabilities(
    probabilities: Floats, label: Integers, rho: Floats | None = None
) -> MembershipPoints:
    """Points from a classifier's probabilities; of equal ones the first is the answer.

    Args:
        probabilities: Probabilities (M, L).
        label: True labels (M,).
        rho: Realism (M,), by default 1 each.
    """
    return MembershipPoints(
        fractional=probabilities,
        binary=one_hot(probabilities.argmax(axis=1), probabilities.shape[1]),
        label=label,
        unit=np.arange(len(label)),
        realism=np.ones(len(label)) if rho is None else rho,
    )


def points_from_detections(
    targets: Targets, found: Detections, t_star: float, rho: Floats | None = None
) -> MembershipPoints:
    """Points of one frame: its objects that are not ignored, then as many empty places.

    Args:
        targets: Targets with labels that index CLASSES.
        found: Detections with such labels.
        t_star: Score from which a detection counts.
        rho: Realism of each object; an empty place has their mean.
    """
    overlap = boxes.iou_matrix(found.boxes_xyxy, targets.boxes_xyxy)
    counted = ~targets.ignore
    share = boxes.ioa_matrix(found.boxes_xyxy, targets.boxes_xyxy)
    same = found.labels[:, None] == targets.labels[None]
    excused = (same & targets.ignore & (share >= MATCH_IOU)).any(dim=1)
    overlap, label = overlap[:, counted], targets.labels[counted].numpy().astype(np.int64)
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
    return MembershipPoints(
        fractional=_add_nothing(scores),
        binary=_threshold_answers(scores, t_star),
        label=np.concatenate([label, np.full(count, len(CLASSES))]),
        unit=np.zeros(2 * count, np.int64),
        realism=np.concatenate([rho, np.full(count, rho.mean() if count else 1.0)]),
    )


def _add_nothing(scores: Floats) -> Floats:
    """Scores (M, L) as memberships (M, L + 1): the last column takes the rest; sums above 1 are scaled."""
    total = scores.sum(axis=1, keepdims=True)
    return np.concatenate([scores, np.maximum(1 - total, 0)], axis=1) / np.maximum(total, 1)


def _threshold_answers(scores: Floats, t_star: float) -> Floats:
    answer = np.where(scores.max(axis=1, initial=0) >= t_star, scores.argmax(axis=1), scores.shape[1])
    return one_hot(answer, scores.shape[1] + 1)


def join_points(parts: Sequence[MembershipPoints]) -> MembershipPoints:
    """The points of several frames as one data set, with each frame as a unit."""
    unit = np.repeat(np.arange(len(parts)), [len(part.label) for part in parts])
    names = ("fractional", "binary", "label", "realism")
    stacked = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return MembershipPoints(**stacked, unit=unit)


@dataclass(frozen=True, slots=True)
class WorthSettings:
    """How worth is computed."""

    kind: str
    """One of MEMBERSHIPS."""
    weighted: bool
    """Whether points are weighted by realism."""
    base: float = float(np.e)
    """Base of the logarithm."""


def jackknife(name: str, value: float | None, without: Sequence[float | None]) -> Interval:
    """Jackknife interval of a statistic that is biased for few units, such as an entropy (Quenouille 1956, Tukey 1958).

    The bias of order 1/n is removed from the interval, not from the value, which may thus lie outside. The
    bootstrap, with fewer distinct units in each draw, would have the bias twice.

    Args:
        name: Name of the interval.
        value: The statistic.
        without: The statistic without each unit in turn.

    Returns:
        The 95 % interval; without bounds for fewer than two units, or if one of the values is None.
    """
    known, units = np.array([v for v in without if v is not None]), len(without)
    if value is None or len(known) < max(units, 2):
        return Interval(name, value, None, None)
    deviations = known - known.mean()
    middle = units * value - (units - 1) * float(known.mean())
    half = float(stdtrit(units - 1, (1 + LEVEL) / 2)) * math.sqrt(
        (units - 1) / units * float(deviations @ deviations)
    )
    return Interval(name, value, middle - half, middle + half)


def worth_interval(points: MembershipPoints, setting: WorthSettings) -> Interval:
    """Information worth with its interval, clipped to the range of an entropy; None if no point counts."""
    value, without = _worth_and_leave_one_out(points, setting)
    one = jackknife(setting.kind, value, without)
    if one.low is None or one.high is None:
        return one
    most = np.log(len(np.unique(points.label))) / np.log(setting.base)
    low, high = np.clip((one.low, one.high), 0, most).tolist()
    return replace(one, low=low, high=high)


def information_gain(before: MembershipPoints, after: MembershipPoints, setting: WorthSettings) -> Interval:
    """Information gain of a classifier's successor.

    Args:
        before: Points under the classifier.
        after: The same points under its successor.
        setting: How worth is computed.

    Raises:
        ShapeError: Other labels or units.
    """
    if not (np.array_equal(before.label, after.label) and np.array_equal(before.unit, after.unit)):
        raise ShapeError("points of the successor", f"the same {len(before.label)} labels", len(after.label))
    (first, one_out), (second, other_out) = (
        _worth_and_leave_one_out(points, setting) for points in (before, replace(after, realism=before.realism))
    )
    value, *without = (
        None if a is None or b is None else a - b
        for a, b in zip((first, *one_out), (second, *other_out), strict=True)
    )
    return jackknife(setting.kind, value, without)


def _worth_and_leave_one_out(
    points: MembershipPoints, setting: WorthSettings
) -> tuple[float | None, list[float | None]]:
    """Worth of all points, and without each unit in turn."""
    counts = points.realism if setting.weighted else np.ones(len(points.label))
    weighed = points.membership(setting.kind) * counts[:, None]
    labels = int(points.label.max(initial=0)) + 1
    whole = _mass(weighed, points.label, labels)

    def value(mass: Floats) -> float | None:
        found = _worth_from_mass(mass, setting.base)
        return None if found is None else found.value

    order = np.argsort(points.unit, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(points.unit[order])) + 1)
    # rounding may leave a little less than 0
    left = (np.maximum(whole - _mass(weighed[one], points.label[one], labels), 0) for one in rows if len(one))
    return value(whole), [value(mass) for mass in left]
