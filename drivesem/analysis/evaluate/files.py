"""Reads and aligns labels and detections, and evaluates them by the rules of a protocol."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.analysis.evaluate import report as breakdown
from drivesem.analysis.evaluate.conditions import measure_conditions, write_conditions
from drivesem.analysis.evaluate.report import ClassRow, EvaluationMetrics, KittiRow, write_evaluation
from drivesem.config.commands import EvalConfig
from drivesem.config.constraints import parse_attributes, parse_class_map
from drivesem.config.errors import UsageError, refuse
from drivesem.data.account import write_account
from drivesem.data.classes import object_type
from drivesem.data.kitti_labels import TYPES
from drivesem.data.label_table import REGION, LabelTable, select_by_attributes
from drivesem.evaluation import coco, kitti
from drivesem.evaluation.conditions import ConditionRow, DetectedObjects
from drivesem.evaluation.curves import ClassMatches, InterpolationRule, average_precision, sampled_curve
from drivesem.evaluation.instances import (
    EVERY_CLASS,
    DetectionTable,
    GroundTruthTable,
    boxes_from_xywh,
    boxes_from_xyxy,
)
from drivesem.evaluation.matching import CandidatePairs, MatchResult, mean_of_known
from drivesem.evaluation.resampling import (
    DRAWS,
    Interval,
    NamedMetric,
    PairedDifference,
    WeightedAveragePrecision,
    WeightedKittiPrecision,
    bootstrap_intervals,
    paired_differences,
)
from drivesem.reporting.tables import format_count
from drivesem.run.labels import detect_labels_layout, read_labels
from drivesem.store import local_copy
from scene_ir import files

_MAX_LISTED = 3
_KITTI_TYPES = tuple(kind for kind in TYPES if kind != "DontCare")


@dataclass(frozen=True, slots=True)
class EvaluationData:
    """Labels, and one or two sets of detections."""

    frames: tuple[str, ...]
    """Names of the frames."""
    classes: tuple[str, ...]
    """Class names; labels are indices into them."""
    truths: GroundTruthTable
    """Labels."""
    found: list[DetectionTable]
    """One or two sets of detections."""
    truth_ids: np.ndarray | None
    """Ids of the labels in their file (M,), if it has them."""
    weather: tuple[str | None, ...]
    """Weather of each frame, if known."""
    notes: tuple[str, ...] = ()
    """Remarks on the evaluation."""
    attributes: tuple[Mapping[str, str], ...] = ()
    """Attributes of each frame."""
    account: Mapping[str, Any] = field(default_factory=dict)
    """Files and rows of the labels, as JSON."""


def load_evaluation_data(config: EvalConfig) -> EvaluationData:
    """Read labels and detections, and map their classes.

    Raises UsageError or FormatError for frames that do not match, unmapped classes, invalid scores, or no
    detections.
    """
    gt_path = local_copy(config.gt or "", "--gt")
    paths = [local_copy(p, "--pred") for p in (config.pred, config.pred_b) if p is not None]
    gt_layout = detect_labels_layout(gt_path) if config.gt_format == "auto" else config.gt_format
    truth = read_labels(gt_path, gt_layout, stage=config.stage)
    account = truth.account
    wanted = _wanted(config, truth)
    gt_known = _known(gt_layout, truth)
    stages = (config.stage, config.stage_b or config.stage)
    tables: list[LabelTable] = []
    for path, stage in zip(paths, stages, strict=False):
        layout = detect_labels_layout(path) if config.pred_format == "auto" else config.pred_format
        table = read_labels(path, layout, scored=True, stage=stage, truth=truth)
        # KITTI and runs have a file for every frame; in other layouts a frame without detections has none
        needed = (wanted or truth.frames) if layout in ("kitti", "run") else ()
        table = _aligned(table, truth, path, needed)
        tables.append(table)
    if wanted is not None:
        truth, tables = truth.reindex(wanted), [table.reindex(wanted) for table in tables]
    else:
        tables = [t if t.frames == truth.frames else t.reindex(truth.frames) for t in tables]
    classes = _classes(config, truth, tables, gt_known)
    chosen = _chosen(config, classes)
    truths, ids = _truths(
        _renamed(truth, parse_class_map("--map-gt", config.map_gt), classes, gt_path, "--map-gt"), chosen
    )
    found = [
        _found(
            _renamed(table, parse_class_map("--map", config.map), classes, path, "--map").with_box_format(
                truth.box_format
            ),
            chosen,
        )
        for table, path in zip(tables, paths, strict=True)
    ]
    judged = tuple(classes) if chosen is None else tuple(chosen)
    if truths.ignore.all():
        raise UsageError(str(gt_path), f"objects of {', '.join(judged) or 'some class'} to evaluate", "none")
    return EvaluationData(
        truth.frames,
        judged,
        truths,
        found,
        ids,
        tuple(truth.weather()),
        _notes(config, truths),
        _attributes(truth),
        write_account(account, roles=False),
    )


def _known(layout: str, truth: LabelTable) -> tuple[str, ...]:
    """Return the classes that a layout defines, and those that occur."""
    fixed: tuple[str, ...] = _KITTI_TYPES if layout in ("kitti", "vkitti1", "vkitti2") else ()
    if layout == "run":
        from detectors.types import CLASSES

        fixed = CLASSES
    return tuple(dict.fromkeys((*fixed, *truth.kinds)))


def _wanted(config: EvalConfig, truth: LabelTable) -> tuple[str, ...] | None:
    if config.where is not None:
        attributes = dict(zip(truth.frames, _attributes(truth), strict=True))
        return tuple(select_by_attributes(attributes, parse_attributes("--where", config.where)))
    if config.frames is None:
        return None
    names = [line.strip() for line in files.read_text(Path(config.frames)).splitlines() if line.strip()]
    missing = sorted(set(names) - set(truth.frames))
    if missing or not names:
        raise UsageError("--frames", f"identifiers of {config.gt}", _some(missing) if missing else "none")
    return tuple(dict.fromkeys(names))


def _attributes(table: LabelTable) -> tuple[Mapping[str, str], ...]:
    """Return the attributes of each frame that are texts."""
    rows = (table.frame_attributes.get(i, {}) for i in range(len(table.frames)))
    return tuple({name: value for name, value in row.items() if isinstance(value, str)} for row in rows)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (f", ... ({len(names)} in all)" if len(names) > _MAX_LISTED else "")


def _aligned(table: LabelTable, truth: LabelTable, path: Path, needed: Sequence[str]) -> LabelTable:
    """The table, if its frames are labelled ones, and those `needed` among them. Files name them with _ for /."""
    flat = {"_".join(name.split("/")): name for name in truth.frames}
    if not set(table.frames) <= set(truth.frames) and set(table.frames) <= set(flat):
        table = replace(table, frames=tuple(flat[name] for name in table.frames))
    others = sorted(set(table.frames) - set(truth.frames))
    if others:
        raise UsageError(str(path), f"ids of the {len(truth.frames)} labelled frames", f"{_some(others)}")
    missing = sorted(set(needed) - set(table.frames))
    if missing:
        raise UsageError(
            str(path), "detections of every labelled frame (or --frames)", f"none of {_some(missing)}"
        )
    return table


def _classes(
    config: EvalConfig, truth: LabelTable, tables: Sequence[LabelTable], known: Sequence[str]
) -> tuple[str, ...]:
    """All class names after mapping. For KITTI its types; else those of the labels, and of detections by them."""
    if config.protocol == "kitti":
        return _KITTI_TYPES
    mapping = parse_class_map("--map-gt", config.map_gt)
    names = [mapping.get(kind, kind) for kind in truth.kinds]
    allowed = {mapping.get(kind, kind) for kind in known} | set(names)
    own = parse_class_map("--map", config.map)
    detected = {own.get(kind, kind) for table in tables for kind in _used(table)}
    extra = sorted(name for name in detected if name is not None and name in allowed and name not in names)
    return tuple(dict.fromkeys(name for name in (*names, *extra) if name is not None))


def _used(table: LabelTable) -> list[str]:
    """Return the classes that occur."""
    return [table.kinds[i] for i in np.unique(table.kind[table.kind >= 0]).tolist()]


def _chosen(config: EvalConfig, classes: Sequence[str]) -> tuple[str, ...] | None:
    if config.classes is None:
        return None
    names = parse_class_list(config.classes)
    for name in names:
        if name not in classes:
            raise UsageError("--classes", f"some of {', '.join(classes)}", repr(name))
    # KITTI's neighbouring classes must stay: its own rules leave out what is not judged
    return None if config.protocol == "kitti" else names


def parse_class_list(text: str) -> tuple[str, ...]:
    """Parse "Car,Van" into unique names."""
    return tuple(dict.fromkeys(word.strip() for word in text.split(",")))


def _renamed(
    table: LabelTable, mapping: Mapping[str, str | None], classes: Sequence[str], path: Path, option: str
) -> LabelTable:
    """Rename classes, and drop the boxes of excluded ones.

    Args:
        table: The boxes.
        mapping: New names of classes; None excludes a class.
        classes: Classes of the result.
        path: File of the table, for errors.
        option: Option of the mapping, for errors.
    """
    index = {name.lower(): i for i, name in reversed(list(enumerate(classes)))}
    exact = {name: i for i, name in enumerate(classes)}
    types = [object_type(name) for name in classes]
    meant = {kind: i for i, kind in enumerate(types) if kind is not None and types.count(kind) == 1}
    unknown = sorted(set(mapping) - set(table.kinds))
    if unknown and not set(mapping) & set(table.kinds):
        raise UsageError(option, f"classes of {path} ({', '.join(table.kinds) or 'none'})", _some(unknown))
    out = len(classes)
    places = np.full(len(table.kinds) + 1, REGION)
    for i, kind in enumerate(table.kinds):
        name = mapping.get(kind, kind)
        if name is None:
            places[i] = out
            continue
        # letter case decides only where two classes differ by nothing else, synonyms only where names do not match
        place = exact.get(name, index.get(name.lower(), meant.get(object_type(name) or "")))
        if place is None:
            if not (table.kind == i).any():
                place = out
            else:
                expected = f"one of {', '.join(classes) or 'none'}, or {option} {kind}=CLASS (or {kind}=-)"
                raise UsageError(
                    f"{path}: class {kind!r}",
                    expected,
                    f"{format_count(int((table.kind == i).sum()), 'box', 'boxes')} of it",
                )
        places[i] = place
    kind = places[table.kind]  # REGION, -1, is the last place
    table = replace(table, kinds=tuple(classes), kind=kind)
    return table.select(kind != out) if (kind == out).any() else table


def _selection(
    kind: np.ndarray, kinds: Sequence[str], chosen: Sequence[str] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return which boxes belong to a selected class or a region, and their labels among the selected classes."""
    if chosen is None:
        return np.ones(len(kind), np.bool_), kind
    places = np.full(len(kinds) + 1, len(chosen))
    places[-1] = REGION
    for i, name in enumerate(chosen):
        places[kinds.index(name)] = i
    labels = places[kind]
    return labels != len(chosen), labels


def _truths(table: LabelTable, chosen: Sequence[str] | None) -> tuple[GroundTruthTable, np.ndarray | None]:
    keep, labels = _selection(table.kind, table.kinds, chosen)
    boxes = boxes_from_xywh(table.boxes) if table.box_format == "xywh" else boxes_from_xyxy(table.boxes)
    truths = GroundTruthTable(
        frames=len(table.frames),
        frame=table.frame,
        label=labels,
        boxes=boxes,
        ignore=table.ignore,
        truncation=table.truncation,
        occlusion=table.occlusion,
        distance_m=np.hypot(table.pose[:, 3], table.pose[:, 5]),
        area=np.where(np.isnan(table.area), boxes[:, 4] * boxes[:, 5], table.area),
    )
    ids = table.box_ids
    return (truths, ids) if keep.all() else (truths.select(keep), None if ids is None else ids[keep])


def _found(table: LabelTable, chosen: Sequence[str] | None) -> DetectionTable:
    keep, labels = _selection(table.kind, table.kinds, chosen)
    boxes = boxes_from_xywh(table.boxes) if table.box_format == "xywh" else boxes_from_xyxy(table.boxes)
    return DetectionTable(table.frame, labels, boxes, table.score).select(keep & (labels >= 0))


def _notes(config: EvalConfig, truths: GroundTruthTable) -> tuple[str, ...]:
    """Return remarks on the evaluation."""
    notes: list[str] = []
    if config.protocol == "kitti":
        unknown = int(((truths.occlusion < 0) & ~truths.ignore & (truths.label >= 0)).sum())
        if unknown:
            notes.append(
                format_count(
                    unknown,
                    "object without occlusion counts as visible",
                    "objects without occlusion count as visible",
                )
            )
        unknown = int(((truths.truncation < 0) & ~truths.ignore & (truths.label >= 0)).sum())
        if unknown:
            notes.append(
                format_count(
                    unknown,
                    "object without truncation counts as whole",
                    "objects without truncation count as whole",
                )
            )
        judged = ", ".join(kitti.CLASSES)
        notes.append(
            f"evaluated classes: {judged}; detections below the minimum height: {config.small_detections}"
        )
    return tuple(notes)


VOC_OVERLAP = 0.5
"""Least IoU of a match (VOC)."""
MANY_FRAMES = 5000
"""Number of frames above which there is no bootstrap by default."""


def evaluate_files(config: EvalConfig) -> EvaluationMetrics:
    """Evaluate files of detections, and write the results. Raises UsageError or SceneError for bad input."""
    with _no_garbage_collection():
        result = evaluate(config, load_evaluation_data(config))
    if config.out is not None:
        write_evaluation(Path(config.out), result)
        write_conditions(Path(config.out), result.conditions)
    return result


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Switch off garbage collection, which takes a sixth of the time for a million annotations."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def evaluate(config: EvalConfig, sets: EvaluationData) -> EvaluationMetrics:
    """Compute all metrics of the configured protocol. sets: labels and detections."""
    evaluator = _ProtocolEvaluator(config, sets)
    first = evaluator.evaluate(sets.found[0])
    generator = np.random.default_rng(config.seed)
    compared: list[PairedDifference] = []
    spread: list[Interval] = []
    draws = config.bootstrap
    if draws is None:
        draws = 0 if sets.truths.frames > MANY_FRAMES and len(sets.found) == 1 else DRAWS
    if draws:
        spread = bootstrap_intervals(first.metrics, sets.truths.frames, draws, generator)
    if len(sets.found) > 1:
        second = evaluator.evaluate(sets.found[1])
        compared = paired_differences(first.metrics, second.metrics, sets.truths.frames, draws, generator)
    stats, facts = evaluator.stats(sets.found[0])
    conditions: list[ConditionRow] = []
    if config.by is not None:
        thresholds = {row.name: row.t_star for row in first.classes if row.t_star is not None}
        pairs = [(i, name) for i, name in enumerate(evaluator.names) if name in thresholds]
        objects = {
            name: DetectedObjects.from_matches(first.candidates, first.matches[i], i, thresholds[name])
            for i, name in pairs
        }
        conditions = measure_conditions(config, objects, sets.attributes, draws)
    counted = sets.truths.label[~sets.truths.ignore]
    return EvaluationMetrics(
        protocol=config.protocol,
        facts={
            "gt": config.gt,
            "pred": config.pred,
            **({"pred_b": config.pred_b} if config.pred_b is not None else {}),
            "frames": sets.truths.frames,
            "objects": int((counted != EVERY_CLASS).sum()),
            "detections": len(sets.found[0]),
            "bootstrap": draws,
            **facts,
        },
        classes=first.classes,
        curves=first.curves,
        parts=tuple(
            breakdown.score_parts(first.candidates, first.matches, evaluator.names, evaluator.rule, sets.weather)
        ),
        metrics={metric.name: metric.value() for metric in first.metrics},
        stats=stats,
        rows=first.rows,
        intervals=tuple(spread),
        comparison=tuple(compared),
        notes=sets.notes,
        conditions=tuple(conditions),
        data=sets.account,
    )


@dataclass(frozen=True, slots=True)
class _DetectionMetrics:
    """Matches and metrics of one set of detections."""

    candidates: CandidatePairs
    matches: tuple[MatchResult, ...]
    classes: tuple[ClassRow, ...]
    curves: dict[str, list[list[float]]]
    metrics: tuple[NamedMetric, ...]
    rows: tuple[KittiRow, ...] = ()


_MAX_DETECTIONS = 2000
"""Largest number of detections of a class per frame; the cost of KITTI's matching grows with its square."""


class _ProtocolEvaluator:
    """Rules of one protocol. names: the evaluated classes."""

    def __init__(self, config: EvalConfig, sets: EvaluationData) -> None:
        self.config, self.sets = config, sets
        self.names: tuple[str, ...] = sets.classes
        self.truths, self.relabel = sets.truths, np.arange(len(sets.classes) + 1)
        self.rule: InterpolationRule = "coco" if config.protocol == "coco" else "voc"
        if config.protocol == "kitti":
            self.rule = "kitti"
            wanted = parse_class_list(config.classes) if config.classes is not None else kitti.CLASSES
            self.names = tuple(name for name in kitti.CLASSES if name in wanted)
            if not self.names:
                raise UsageError("--classes", f"some of {', '.join(kitti.CLASSES)}", config.classes)
            self.relabel, self.truths = _without_others(sets, self.names)

    def stats(self, found: DetectionTable) -> tuple[list[float] | None, dict[str, Any]]:
        """Return COCO's twelve numbers, and facts about the evaluation."""
        if self.config.protocol == "kitti":
            return None, {"small_detections": self.config.small_detections}
        if self.config.protocol == "voc":
            return None, {"overlap": VOC_OVERLAP}
        ids = self.sets.truth_ids
        engine = coco.fastest_engine(ids)
        return coco.coco_stats(self.truths, found, len(self.names), engine, ids), {"engine": engine}

    def overlap(self, name: str) -> float:
        """Return the least IoU of a match for a class."""
        return kitti.CLASSES[name] if self.config.protocol == "kitti" else VOC_OVERLAP

    def evaluate(self, found: DetectionTable) -> _DetectionMetrics:
        """Match one set of detections, and compute its metrics."""
        curves: list[kitti.KittiCurve] = []
        if self.config.protocol == "kitti":
            small = self.config.small_detections
            count_by_frame_and_class = np.bincount(found.frame * len(self.sets.classes) + found.label)
            largest_count = int(count_by_frame_and_class.max(initial=0))
            expected = f"at most {_MAX_DETECTIONS:,} detections of a class in a frame for --protocol kitti"
            refuse(largest_count > _MAX_DETECTIONS, "--pred", expected, f"{largest_count:,}")
            curves = kitti.evaluate(self.sets.truths, found, self.sets.classes, small)
            curves = [curve for curve in curves if curve.name in self.names]
            labels = self.relabel[found.label]
            found = DetectionTable(found.frame, labels, found.boxes, found.score).select(labels >= 0)
        limit = coco.MAX_DETECTIONS if self.config.protocol == "coco" else None
        candidates = CandidatePairs.from_tables(self.truths, found, VOC_OVERLAP, limit)
        by_overlap = {o: self._match(candidates, o) for o in {self.overlap(name) for name in self.names}}
        matches = tuple(by_overlap[self.overlap(name)] for name in self.names)
        tallies = [candidates.class_matches(match, k) for k, match in enumerate(matches)]
        further, metrics = self._compute_metrics(candidates, tallies, curves)
        return _DetectionMetrics(
            candidates,
            matches,
            tuple(self._row(k, tally, found, further[k]) for k, tally in enumerate(tallies)),
            {name: sampled_curve(tally) for name, tally in zip(self.names, tallies, strict=True)},
            metrics,
            tuple(
                KittiRow(c.name, c.difficulty, c.r11(), c.r40(), c.object_count, c.precision().tolist())
                for c in curves
            ),
        )

    def _match(self, candidates: CandidatePairs, overlap: float) -> MatchResult:
        return candidates.match_voc(overlap) if self.config.protocol == "voc" else candidates.match_coco(overlap)

    def _row(
        self, label: int, tally: ClassMatches, found: DetectionTable, further: dict[str, float | None]
    ) -> ClassRow:
        best = tally.best_f1()
        f1, t_star, precision, recall = best if best is not None else (None, None, None, None)
        return ClassRow(
            name=self.names[label],
            overlap=self.overlap(self.names[label]),
            objects=int(tally.object_count()),
            detections=int((found.label == label).sum()),
            ap=further.pop("ap", average_precision(tally, self.rule)),
            recall=tally.recall(),
            t_star=t_star,
            f1=f1,
            precision_at_t_star=precision,
            recall_at_t_star=recall,
            further=further,
        )

    def _compute_metrics(
        self, candidates: CandidatePairs, tallies: Sequence[ClassMatches], curves: Sequence[kitti.KittiCurve]
    ) -> tuple[list[dict[str, float | None]], tuple[NamedMetric, ...]]:
        """Return further metrics of each class, and the metrics with intervals."""
        if self.config.protocol == "kitti":
            names = [f"{c.name} {c.difficulty} R40" for c in curves]
            return [{} for _ in tallies], tuple(
                NamedMetric(name, (WeightedKittiPrecision(c),)) for name, c in zip(names, curves, strict=True)
            )
        if self.config.protocol == "voc":
            old = [{"ap07": average_precision(tally, "voc07")} for tally in tallies]
            parts = tuple(WeightedAveragePrecision(tally, "voc") for tally in tallies)
            return old, (
                NamedMetric("mAP", parts),
                NamedMetric("mAP07", tuple(WeightedAveragePrecision(t, "voc07") for t in tallies)),
            )
        averaged: list[list[WeightedAveragePrecision]] = []
        for threshold in coco.IOU_THRESHOLDS.tolist():
            match = candidates.match_coco(threshold)
            averaged.append(
                [
                    WeightedAveragePrecision(candidates.class_matches(match, k), "coco")
                    for k in range(len(self.names))
                ]
            )
        further: list[dict[str, float | None]] = []
        for k in range(len(self.names)):
            values = [row[k].value(None) for row in averaged]
            further.append({"ap50": values[0], "ap75": values[5], "ap": mean_of_known(values)})
        return further, (
            NamedMetric("AP", tuple(part for row in averaged for part in row)),
            NamedMetric("AP50", tuple(averaged[0])),
            NamedMetric("AP75", tuple(averaged[5])),
        )


def _without_others(sets: EvaluationData, names: Sequence[str]) -> tuple[np.ndarray, GroundTruthTable]:
    """Return the label in `names` by label (-1 for others), and the labels of `names`, with neighbouring classes
    ignored.
    """
    relabel = np.full(len(sets.classes) + 1, -1)
    neighbour = np.zeros(len(sets.classes) + 1, np.bool_)
    for i, kind in enumerate(sets.classes):
        near = kitti.NEIGHBOURS.get(kind)
        if kind in names:
            relabel[i] = names.index(kind)
        elif near in names:
            relabel[i], neighbour[i] = names.index(near), True
    truths = sets.truths
    labels = relabel[truths.label]
    selected = truths.select((labels >= 0) | (truths.label == EVERY_CLASS))
    label = relabel[selected.label]
    ignore = selected.ignore | neighbour[selected.label] | (label < 0)
    own = np.where(neighbour, -1, relabel)
    return own, GroundTruthTable(
        selected.frames,
        selected.frame,
        label,
        selected.boxes,
        ignore,
        selected.truncation,
        selected.occlusion,
        selected.distance_m,
        selected.area,
    )
