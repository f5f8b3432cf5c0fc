"""Evaluates files of detections against labels by the rules of a protocol."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.analysis.evaluate.conditions import measure_conditions, write_conditions
from drivesem.analysis.evaluate.report import write_evaluation
from drivesem.analysis.evaluate.sets import EvaluationData, load_evaluation_data, parse_class_list
from drivesem.config.commands import EvalConfig
from drivesem.config.errors import UsageError, refuse
from drivesem.evaluation import coco, kitti
from drivesem.evaluation import results as breakdown
from drivesem.evaluation.conditions import ConditionRow, DetectedObjects
from drivesem.evaluation.curves import ClassMatches, InterpolationRule, average_precision, sampled_curve
from drivesem.evaluation.instances import EVERY_CLASS, DetectionTable, GroundTruthTable
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
from drivesem.evaluation.results import ClassRow, EvaluationMetrics, KittiRow

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
