"""Metrics of an evaluation, by class and by distance, size, occlusion and weather, and their report.

Objects outside of a part are ignored: their detections count neither as hits nor as false positives. A false positive
belongs to no object and counts in every part, so precision in a small part is low; compare parts by recall.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.analysis.evaluate.conditions import CONDITION_COLUMNS, tabulate_conditions
from drivesem.evaluation import coco
from drivesem.evaluation.coco import STATS
from drivesem.evaluation.conditions import ConditionRow
from drivesem.evaluation.curves import InterpolationRule, average_precision
from drivesem.evaluation.instances import Booleans, GroundTruthTable
from drivesem.evaluation.matching import CandidatePairs, MatchResult
from drivesem.evaluation.resampling import Interval, PairedDifference
from drivesem.reporting.plots import write_bars, write_curves
from drivesem.reporting.tables import Console, ReportTable, cells_to_csv, format_count, format_percent
from scene_ir import files

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


_COCO_DESCRIPTIONS = (
    *("AP, IoU 0.50:0.95", "AP, IoU 0.50", "AP, IoU 0.75", "AP, small", "AP, medium", "AP, large"),
    *("AR, 1 detection", "AR, 10 detections", "AR, 100 detections", "AR, small", "AR, medium", "AR, large"),
)
_TEXT_COLUMNS = ("class", "metric", "what", "difficulty", "by", "part", *CONDITION_COLUMNS)
"""Columns of text; the others hold numbers."""
_AXES = {"distance": "distance", "size": "height", "occlusion": "occlusion as labelled", "weather": "weather"}


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:+.2f}"


def build_evaluation_tables(result: EvaluationMetrics, wide: bool = False) -> list[ReportTable]:
    """Build the tables of an evaluation, those of the protocol first. wide: one column per class in breakdowns."""
    found: list[ReportTable] = []
    if result.stats is not None:
        rows = zip(STATS, _COCO_DESCRIPTIONS, map(format_percent, result.stats), strict=True)
        found.append(ReportTable("COCO, all classes, %", ("metric", "what", "%"), tuple(rows)))
    if result.rows:
        kit = result.facts["small_detections"]
        found.append(
            ReportTable(
                f"KITTI 2D, %; small detections: {kit}",
                ("class", "difficulty", "R40", "R11", "objects"),
                tuple(
                    (r.name, r.difficulty, format_percent(r.r40), format_percent(r.r11), str(r.ground_truth))
                    for r in result.rows
                ),
            )
        )
    further = list(dict.fromkeys(key for row in result.classes for key in row.further))
    found.append(
        ReportTable(
            "Classes, %; t*: score of best F1",
            (
                "class",
                "IoU",
                "AP",
                *(key.upper() for key in further),
                "recall",
                "t*",
                "F1",
                "precision at t*",
                "recall at t*",
                "objects",
            ),
            tuple(
                (
                    *(
                        c.name,
                        f"{c.overlap:g}",
                        format_percent(c.ap),
                        *(format_percent(c.further.get(k)) for k in further),
                    ),
                    *(
                        format_percent(c.recall),
                        "-" if c.t_star is None else f"{c.t_star:.3f}",
                        format_percent(c.f1),
                    ),
                    *(format_percent(c.precision_at_t_star), format_percent(c.recall_at_t_star), str(c.objects)),
                )
                for c in result.classes
            ),
        )
    )
    if result.parts:
        found.append(_wide_parts(result) if wide else _parts(result))
    if result.conditions:
        found.append(tabulate_conditions(result.conditions))
    if result.intervals:
        draws, frames = result.facts["bootstrap"], result.facts["frames"]
        found.append(
            ReportTable(
                f"95 % intervals, %; {format_count(draws, 'bootstrap draw')} of {format_count(frames, 'frame')}",
                ("metric", "value", "low", "high"),
                tuple(
                    (i.name, format_percent(i.value), format_percent(i.low), format_percent(i.high))
                    for i in result.intervals
                ),
            )
        )
    if result.comparison:
        found.append(
            ReportTable(
                "Second minus first, percentage points; paired over frames",
                ("metric", "first", "second", "difference", "low", "high", "p"),
                tuple(
                    (
                        *(d.name, format_percent(d.first), format_percent(d.second), _signed(d.difference)),
                        *(_signed(d.low), _signed(d.high), "-" if d.p is None else f"{d.p:.4f}"),
                    )
                    for d in result.comparison
                ),
            )
        )
    return found


def _parts(result: EvaluationMetrics) -> ReportTable:
    rows = (
        (p.name, p.by, p.part, format_percent(p.ap), format_percent(p.recall), str(p.objects))
        for p in result.parts
    )
    title = "Parts, %; objects elsewhere are ignored, false positives count everywhere"
    return ReportTable(title, ("class", "by", "part", "AP", "recall", "objects"), tuple(rows))


def _wide_parts(result: EvaluationMetrics) -> ReportTable:
    names = tuple(row.name for row in result.classes if any(p.name == row.name for p in result.parts))
    cells = {(p.by, p.part, p.name): f"{format_percent(p.recall)} of {p.objects}" for p in result.parts}
    places = dict.fromkeys((p.by, p.part) for p in result.parts)
    rows = ((*place, *(cells.get((*place, name), "-") for name in names)) for place in places)
    return ReportTable("Recall by part, %, and objects", ("by", "part", *names), tuple(rows))


def print_evaluation(result: EvaluationMetrics, console: Console) -> None:
    """The tables, and what a reader must know."""
    for sheet in build_evaluation_tables(result, wide=True):
        console.print(
            *sheet.fit_to_console(console, _TEXT_COLUMNS, min_width=min(len(sheet.title) + 4, console.width)),
            sep="\n",
        )
    facts = result.facts
    counted = f", counted by {facts['engine']}" if "engine" in facts else ""
    console.print(
        f"{format_count(facts['frames'], 'frame')}, {format_count(facts['objects'], 'object')}, "
        f"{format_count(facts['detections'], 'detection')}{counted}"
    )
    for note in result.notes:
        console.print(note, soft_wrap=True)


def write_evaluation(out: Path, result: EvaluationMetrics) -> None:
    """Write metrics.json, a CSV per table, curves.csv, report.md and PNGs into `out`."""
    files.write_json(out / "metrics.json", result.to_json())
    for sheet in build_evaluation_tables(result):
        cells = [["" if cell == "-" else cell for cell in row] for row in sheet.rows]
        files.write_text(out / f"{_file_name(sheet.title)}.csv", cells_to_csv(sheet.columns, cells))
    rows = [(name, *(f"{value:.6f}" for value in row)) for name, curve in result.curves.items() for row in curve]
    files.write_text(out / "curves.csv", cells_to_csv(("class", "recall", "precision", "score"), rows))
    pictures = _pictures(out, result)
    files.write_text(out / "report.md", _markdown(result, pictures))


def _file_name(title: str) -> str:
    """Return a file name for a title, such as kitti-2d for "KITTI 2D, %"."""
    return re.sub(r"[^a-z0-9]+", "-", re.split(r"[,;]", title)[0].lower()).strip("-")


def _pictures(out: Path, result: EvaluationMetrics) -> dict[str, str]:
    """Write the plots. Returns descriptions by file name."""
    found: dict[str, str] = {}
    overlaps = {row.name: row.overlap for row in result.classes}
    curves = {
        f"{name}, IoU {overlaps[name]:g}": ([r[0] for r in rows], [r[1] for r in rows])
        for name, rows in result.curves.items()
        if rows
    }
    if curves:
        found["precision-recall.png"] = "Precision over recall, best at each recall or a higher one"
        write_curves(out / "precision-recall.png", "Precision over recall", curves)
    for name in dict.fromkeys(row.name for row in result.rows if row.r40 is not None):
        official = {
            f"{row.difficulty}, R40 {format_percent(row.r40)} %": _reached(row.precision)
            for row in result.rows
            if row.name == name and row.r40 is not None
        }
        file = f"kitti-{name.lower()}.png"
        found[file] = f"KITTI's 41 samples of precision: {name}"
        write_curves(out / file, f"{name}, KITTI 2D", official)
    for by in dict.fromkeys(part.by for part in result.parts):
        groups = list(dict.fromkeys(part.part for part in result.parts if part.by == by))
        recall = {(part.name, part.part): part.recall for part in result.parts if part.by == by}
        series: Mapping[str, list[float | None]] = {
            row.name: [recall.get((row.name, group)) for group in groups]
            for row in result.classes
            if any((row.name, group) in recall for group in groups)
        }
        file = f"recall-by-{by}.png"
        found[file] = f"Recall by {_AXES[by]}"
        write_bars(out / file, f"Recall by {_AXES[by]}", groups, series, _AXES[by])
    return found


def _reached(precision: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return recall and precision of KITTI's samples up to the last threshold."""
    count = max((k + 1 for k, value in enumerate(precision) if value > 0), default=1)
    return [k / (len(precision) - 1) for k in range(count)], list(precision[:count])


def _markdown(result: EvaluationMetrics, pictures: Mapping[str, str]) -> str:
    facts = result.facts
    lines = [f"# Evaluation, protocol {result.protocol}", ""]
    lines += [f"- {key}: {value}" for key, value in facts.items()]
    lines += [f"- {note}" for note in result.notes]
    for sheet in build_evaluation_tables(result):
        lines += ["", *sheet.to_markdown(_TEXT_COLUMNS)]
    for file, text in pictures.items():
        lines += ["", f"![{text}]({file})"]
    return "\n".join(lines) + "\n"
