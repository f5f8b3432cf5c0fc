"""The figures of an evaluation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from drivesem.evaluation import breakdown, coco
from drivesem.evaluation.resampling import Difference, Interval


@dataclass(frozen=True, slots=True)
class ClassRow:
    """One class. ap: by the protocol's rule at `overlap`, COCO's as the mean over its ten; recall: there, with all
    detections; f1, precision, recall at t_star, the score of best F1. further: other average precisions.
    Fractions; None where there is no object or no detection.
    """

    name: str
    overlap: float
    objects: int
    detections: int
    ap: float | None
    recall: float | None
    t_star: float | None
    f1: float | None
    precision_at_t_star: float | None
    recall_at_t_star: float | None
    further: dict[str, float | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class KittiRow:
    """One class at one difficulty; precision: 41 samples over recall."""

    name: str
    difficulty: str
    r11: float | None
    r40: float | None
    ground_truth: int
    precision: list[float]


@dataclass(frozen=True, slots=True)
class Result:
    """All figures of one evaluation. stats: COCO's twelve numbers; rows: KITTI's; curves: recall, precision and
    score by class; figures: those that intervals and comparisons are of.
    """

    protocol: str
    facts: dict[str, Any]
    classes: tuple[ClassRow, ...]
    curves: dict[str, list[list[float]]]
    parts: tuple[breakdown.PartRow, ...]
    figures: dict[str, float | None]
    stats: list[float] | None = None
    rows: tuple[KittiRow, ...] = ()
    intervals: tuple[Interval, ...] = ()
    comparison: tuple[Difference, ...] = ()
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """What --json prints and metrics.json holds."""
        data: dict[str, Any] = {"protocol": self.protocol, **self.facts}
        if self.stats is not None:
            data |= {"stats": self.stats, "stats_names": list(coco.STATS)}
        if self.protocol == "kitti":
            data["rows"] = [_renamed(asdict(row)) for row in self.rows]
        data["classes"] = [{**_renamed(row), **row.pop("further")} for row in map(asdict, self.classes)]
        for row in data["classes"]:
            row.pop("further", None)
        data["figures"] = self.figures
        data["parts"] = [_renamed(asdict(part)) for part in self.parts]
        data["intervals"] = [asdict(one) for one in self.intervals]
        data["comparison"] = [asdict(one) for one in self.comparison]
        data["curves"] = self.curves
        data["notes"] = list(self.notes)
        return data


def _renamed(row: dict[str, Any]) -> dict[str, Any]:
    return {"class": row["name"], **{key: value for key, value in row.items() if key != "name"}}
