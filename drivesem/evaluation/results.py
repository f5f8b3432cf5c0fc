"""Metrics of an evaluation: by class, and by distance, size, occlusion and weather.

Objects outside of a part are ignored: their detections count neither as hits nor as false positives. A false positive
belongs to no object and counts in every part, so precision in a small part is low; compare parts by recall.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from drivesem.evaluation import coco
from drivesem.evaluation.conditions import ConditionRow
from drivesem.evaluation.curves import InterpolationRule, average_precision
from drivesem.evaluation.instances import Booleans, GroundTruthTable
from drivesem.evaluation.matching import CandidatePairs, MatchResult
from drivesem.evaluation.resampling import Interval, PairedDifference

DISTANCES_M = (0.0, 10.0, 20.0, 30.0, 50.0, np.inf)
HEIGHTS_PX = (0.0, 25.0, 40.0, 80.0, np.inf)
"""Includes KITTI's minimum heights."""
OCCLUSIONS = ("visible", "partly", "largely", "unknown")
"""KITTI's names of its codes 0 to 3."""


@dataclass(frozen=True, slots=True)
class ClassRow:
    """Metrics of one class; fractions, None without objects or detections."""

    name: str
    """Class."""
    overlap: float
    """IoU threshold."""
    objects: int
    """Number of objects to detect."""
    detections: int
    """Number of detections."""
    ap: float | None
    """Average precision by the protocol's rule at `overlap`; COCO's is the mean over its ten thresholds."""
    recall: float | None
    """Recall at `overlap` with all detections."""
    t_star: float | None
    """Score of the best F1."""
    f1: float | None
    """Best F1."""
    precision_at_t_star: float | None
    """Precision at that score."""
    recall_at_t_star: float | None
    """Recall at that score."""
    further: dict[str, float | None] = field(default_factory=dict)
    """Other average precisions by name."""


@dataclass(frozen=True, slots=True)
class KittiRow:
    """KITTI's metrics of one class at one difficulty."""

    name: str
    """Class."""
    difficulty: str
    """Easy, moderate or hard."""
    r11: float | None
    """Average precision over 11 recall samples."""
    r40: float | None
    """Average precision over 40 recall samples."""
    ground_truth: int
    """Number of objects to detect."""
    precision: list[float]
    """(41,) over recall."""


@dataclass(frozen=True, slots=True)
class PartRow:
    """Metrics of one class in one part of the objects."""

    name: str
    """Class."""
    by: str
    """Distance, size, occlusion or weather."""
    part: str
    """Name of the part, with its unit."""
    ap: float | None
    """Average precision, a fraction."""
    recall: float | None
    """Recall, a fraction."""
    objects: int
    """Number of objects to detect."""


@dataclass(frozen=True, slots=True)
class EvaluationMetrics:
    """All metrics of one evaluation."""

    protocol: str
    """Coco, kitti or voc."""
    facts: dict[str, Any]
    """What was evaluated."""
    classes: tuple[ClassRow, ...]
    """Metrics by class."""
    curves: dict[str, list[list[float]]]
    """Rows of recall, precision and score by class."""
    parts: tuple[PartRow, ...]
    """Metrics by part of the objects."""
    metrics: dict[str, float | None]
    """Metrics that intervals and comparisons refer to."""
    stats: list[float] | None = None
    """COCO's twelve numbers."""
    rows: tuple[KittiRow, ...] = ()
    """KITTI's metrics."""
    intervals: tuple[Interval, ...] = ()
    """Bootstrap intervals."""
    comparison: tuple[PairedDifference, ...] = ()
    """Differences to another detector."""
    notes: tuple[str, ...] = ()
    """Remarks on the evaluation."""
    conditions: tuple[ConditionRow, ...] = ()
    """Recall by condition."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """Files and rows of the labels, and what became of them."""

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints and metrics.json holds."""
        data: dict[str, Any] = {"protocol": self.protocol, **self.facts}
        if self.stats is not None:
            data |= {"stats": self.stats, "stats_names": list(coco.STATS)}
        if self.protocol == "kitti":
            data["rows"] = [_row_to_json(row) for row in self.rows]
        data["classes"] = []
        for row in map(_row_to_json, self.classes):
            further = row.pop("further")
            data["classes"].append(row | further)
        return data | {
            "metrics": self.metrics,
            "parts": [_row_to_json(part) for part in self.parts],
            "intervals": [asdict(interval) for interval in self.intervals],
            "comparison": [asdict(difference) for difference in self.comparison],
            "curves": self.curves,
            "notes": list(self.notes),
            "conditions": [asdict(row) for row in self.conditions],
            "data": dict(self.data),
        }


def _row_to_json(row: ClassRow | KittiRow | PartRow) -> dict[str, Any]:
    data = asdict(row)
    return {"class": data.pop("name"), **data}


def split_objects(truths: GroundTruthTable) -> dict[str, dict[str, Booleans]]:
    """Objects (M,) by kind and name of the part; kinds without any known value are left out."""
    parts: dict[str, dict[str, Booleans]] = {}
    if np.isfinite(truths.distance_m).any():
        parts["distance"] = _split_ranges(truths.distance_m, DISTANCES_M, "m")
    parts["size"] = _split_ranges(truths.boxes[:, 5], HEIGHTS_PX, "px high")
    if (truths.occlusion >= 0).any():
        parts["occlusion"] = {name: truths.occlusion == code for code, name in enumerate(OCCLUSIONS)}
    return parts


def _split_ranges(values: np.ndarray, bounds: Sequence[float], unit: str) -> dict[str, Booleans]:
    parts: dict[str, Booleans] = {}
    for low, high in pairwise(bounds):
        name = f"{low:g}+ {unit}" if np.isinf(high) else f"{low:g}-{high:g} {unit}"
        parts[name] = (values >= low) & (values < high)
    return parts


def score_parts(
    candidates: CandidatePairs,
    matches: Sequence[MatchResult],
    classes: Sequence[str],
    rule: InterpolationRule,
    weather: Sequence[str | None] | None = None,
) -> list[PartRow]:
    """Compute the metrics of every class in every part that has objects.

    Args:
        candidates: Objects and detections.
        matches: Matching of each class.
        classes: Names of the classes.
        rule: How recall is sampled.
        weather: (F,) weather of the frames, where known.
    """
    rows: list[PartRow] = []
    for by, parts in split_objects(candidates.ground_truth).items():
        for part, chosen in parts.items():
            for label, name in enumerate(classes):
                own = candidates.class_matches(matches[label], label, chosen)
                if objects := int(own.object_count()):
                    rows.append(PartRow(name, by, part, average_precision(own, rule), own.recall(), objects))
    for word in sorted({word for word in weather or () if word is not None}):
        weights = np.array([frame_weather == word for frame_weather in weather or ()], np.float64)
        for label, name in enumerate(classes):
            own = candidates.class_matches(matches[label], label)
            objects = own.object_count(weights)
            if objects:
                recall = float((own.true_positives * weights[own.frame]).sum()) / objects
                ap = average_precision(own, rule, weights)
                rows.append(PartRow(name, "weather", word, ap, recall, int(objects)))
    return rows
