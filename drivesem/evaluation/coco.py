"""COCO's average precision and recall: pycocotools defines them, ultrafast-pycocotools gives equal numbers."""

from __future__ import annotations

import contextlib
import importlib.util
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from drivesem.evaluation.instances import EVERY_CLASS, DetectionTable, GroundTruthTable, Integers

if TYPE_CHECKING:
    from detectors.types import Detections, Targets

Engine = Literal["pycocotools", "ultrafast-pycocotools"]
STATS = ("AP", "AP50", "AP75", "APs", "APm", "APl", "AR1", "AR10", "AR100", "ARs", "ARm", "ARl")
"""COCO's twelve numbers in pycocotools' order; -1 without objects."""
IOU_THRESHOLDS = np.linspace(0.5, 0.95, round((0.95 - 0.5) / 0.05) + 1)
"""Equal to pycocotools' to the last bit."""

MAX_DETECTIONS = 100
"""Maximum number of detections per image and class (COCO)."""
IOU_50, IOU_70 = 0, 4
"""Indices of 0.5 and 0.7 in `IOU_THRESHOLDS`."""


SCORE_TITLES = ("AP50", "AP70", "AP50:95", "recall", "recall at t*")
"""Titles of `ClassScores.columns`."""


@dataclass(frozen=True, slots=True)
class ClassScores:
    """Metrics of one class in [0, 1]; None without objects."""

    ap50: float | None
    """Average precision at IoU 0.5."""
    ap70: float | None
    """Average precision at IoU 0.7."""
    ap: float | None
    """Mean average precision over IoU 0.5 to 0.95."""
    recall: float | None
    """Recall at IoU 0.5 with all detections."""
    recall_at_t_star: float | None
    """Recall at IoU 0.5 with detections of at least t*."""
    objects: int
    """Number of evaluated objects."""

    @property
    def columns(self) -> tuple[float | None, ...]:
        """Metrics in the order of `SCORE_TITLES`."""
        return self.ap50, self.ap70, self.ap, self.recall, self.recall_at_t_star


@dataclass(frozen=True, slots=True)
class CocoScores:
    """COCO's metrics of a detector."""

    headline: ClassScores
    """Metrics of the class that the paper reports."""
    overall: ClassScores
    """Mean over classes with objects; recall is weighted by objects."""
    per_class: dict[str, ClassScores]
    """Metrics by class, in the detector's order."""

    @classmethod
    def from_classes(cls, per_class: dict[str, ClassScores], headline: str) -> CocoScores:
        """Combine the metrics of all classes."""
        return cls(headline=per_class[headline], overall=_overall(list(per_class.values())), per_class=per_class)

    def to_json(self) -> dict[str, Any]:
        """The headline's metrics, then `overall` and `per_class`."""
        return {
            **asdict(self.headline),
            "overall": asdict(self.overall),
            "per_class": {name: asdict(scores) for name, scores in self.per_class.items()},
        }


def evaluate(
    targets: Sequence[Targets],
    detections: Sequence[Detections],
    classes: Sequence[str],
    t_star: float,
    headline: str = "Car",
) -> CocoScores:
    """Compute COCO's metrics over images.

    Ignored targets are COCO's crowds: a detection with a sufficient share on one does not count.

    Args:
        targets: Labels of each image.
        detections: Detections in each image.
        classes: Names of the classes.
        t_star: Score threshold for the recall.
        headline: Class that the paper reports.

    Raises:
        ValueError: The lists differ in length, or `headline` is no class.
    """
    if len(targets) != len(detections):
        raise ValueError(f"detections: expected {len(targets)} images, found {len(detections)}")
    if headline not in classes:
        raise ValueError(f"headline: expected one of {', '.join(classes)}, found {headline!r}")
    evaluator = _run(targets, detections, classes)
    per_class = {name: _class_scores(evaluator, k, len(targets), t_star) for k, name in enumerate(classes)}
    return CocoScores.from_classes(per_class, headline)


def fastest_engine(truth_ids: Integers | None = None) -> Engine:
    """ultrafast-pycocotools if it is installed and no id (M,) is 0: unlike pycocotools, it matches those."""
    fast = importlib.util.find_spec("ultrafast_pycocotools") is not None
    return "ultrafast-pycocotools" if fast and (truth_ids is None or bool(truth_ids.all())) else "pycocotools"


def coco_stats(
    truths: GroundTruthTable,
    found: DetectionTable,
    classes: int,
    engine: Engine,
    truth_ids: Integers | None = None,
) -> list[float]:
    """Compute COCO's twelve numbers in the order of `STATS`.

    Args:
        truths: Objects. Ignored ones are crowds; those of `EVERY_CLASS` are crowds of every class.
        found: Detections.
        classes: Number of classes.
        engine: Library that computes them.
        truth_ids: (M,) ids of the objects in the file; pycocotools takes an id of 0 for "no match".
    """
    every = truths.label == EVERY_CLASS
    rows = np.concatenate([np.flatnonzero(~every), np.repeat(np.flatnonzero(every), classes)])
    labels = np.concatenate([truths.label[~every], np.tile(np.arange(classes), int(every.sum()))])
    ids = np.arange(1, len(rows) + 1)
    if truth_ids is not None and not every.any():
        ids = truth_ids[rows]
    truth = [
        {"id": i, "image_id": frame, "category_id": label, "bbox": box, "area": area, "iscrowd": crowd}
        for i, frame, label, box, area, crowd in zip(
            ids.tolist(),
            truths.frame[rows].tolist(),
            labels.tolist(),
            truths.boxes[rows][:, [0, 1, 4, 5]].tolist(),
            truths.area[rows].tolist(),
            (truths.ignore | every)[rows].astype(int).tolist(),
            strict=True,
        )
    ]
    if engine == "pycocotools":
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval as Evaluator
    else:
        from ultrafast_pycocotools import COCO  # pyright: ignore[reportMissingImports]
        from ultrafast_pycocotools import COCOeval as Evaluator  # pyright: ignore[reportMissingImports]
    with contextlib.redirect_stdout(io.StringIO()):
        shared: dict[str, Any] = {
            "images": [{"id": i} for i in range(truths.frames)],
            "categories": [{"id": k, "name": str(k)} for k in range(classes)],
        }
        dataset: Any = COCO()
        dataset.dataset = shared | {"annotations": truth}
        dataset.createIndex()
        detected: Any = COCO()
        if engine == "pycocotools" or not len(found):
            detected.dataset = shared | {"annotations": _detected(found)}
            detected.createIndex()
        else:  # an array avoids one dictionary per detection, which would double the time
            columns = [found.frame, found.boxes[:, [0, 1, 4, 5]], found.score, found.label]
            detected = dataset.loadRes(np.column_stack(columns))
        evaluator: Any = Evaluator(dataset, detected, iouType="bbox")
        evaluator.evaluate()
        evaluator.accumulate()
        evaluator.summarize()
    return [float(value) for value in evaluator.stats[: len(STATS)]]


def _detected(found: DetectionTable) -> list[dict[str, Any]]:
    """Convert detections to pycocotools' annotations."""
    return [
        {"id": i, "image_id": f, "category_id": k, "bbox": box, "area": box[2] * box[3], "iscrowd": 0, "score": s}
        for i, (f, k, box, s) in enumerate(
            zip(
                found.frame.tolist(),
                found.label.tolist(),
                found.boxes[:, [0, 1, 4, 5]].tolist(),
                found.score.tolist(),
                strict=True,
            ),
            start=1,
        )
    ]


def _run(targets: Sequence[Targets], detections: Sequence[Detections], classes: Sequence[str]) -> Any:
    """Run pycocotools' evaluator up to `accumulate`, without the progress that it prints."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    truth = [
        _annotation(i, box, label) | {"iscrowd": int(ignore)}
        for i, t in enumerate(targets)
        for box, label, ignore in zip(t.boxes_xyxy.tolist(), t.labels.tolist(), t.ignore.tolist(), strict=True)
    ]
    found = [
        _annotation(i, box, label) | {"iscrowd": 0, "score": score}
        for i, d in enumerate(detections)
        for box, label, score in zip(d.boxes_xyxy.tolist(), d.labels.tolist(), d.scores.tolist(), strict=True)
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        datasets = []
        for annotations in (truth, found):
            dataset = COCO()
            content: Any = {
                "images": [{"id": i + 1} for i in range(len(targets))],
                "categories": [{"id": k + 1, "name": name} for k, name in enumerate(classes)],
                # Ids start at 1: pycocotools takes 0 for "no match".
                "annotations": [a | {"id": n + 1} for n, a in enumerate(annotations)],
            }
            dataset.dataset = content
            dataset.createIndex()
            datasets.append(dataset)
        evaluator = COCOeval(*datasets, iouType="bbox")
        evaluator.params.maxDets = [MAX_DETECTIONS]
        evaluator.params.areaRng = [[0.0, 1e10]]
        evaluator.params.areaRngLbl = ["all"]
        evaluator.evaluate()
        evaluator.accumulate()
    return evaluator


def _annotation(image: int, box_xyxy: list[float], label: int) -> dict[str, Any]:
    x0, y0, x1, y1 = box_xyxy
    width, height = max(x1 - x0, 0.0), max(y1 - y0, 0.0)
    return {
        "image_id": image + 1,
        "category_id": label + 1,
        "bbox": [x0, y0, width, height],
        "area": width * height,
    }


def _class_scores(evaluator: Any, k: int, images: int, t_star: float) -> ClassScores:
    precision = evaluator.eval["precision"][:, :, k, 0, 0]
    entries = [e for e in evaluator.evalImgs[k * images : (k + 1) * images] if e is not None]
    objects = sum(int((e["gtIgnore"] == 0).sum()) for e in entries)
    if objects == 0:
        return ClassScores(None, None, None, None, None, 0)
    hits = [
        score
        for e in entries
        for score, match, ignored in zip(e["dtScores"], e["dtMatches"][IOU_50], e["dtIgnore"][IOU_50], strict=True)
        if match > 0 and not ignored
    ]
    return ClassScores(
        ap50=float(precision[IOU_50].mean()),
        ap70=float(precision[IOU_70].mean()),
        ap=float(precision.mean()),
        recall=len(hits) / objects,
        recall_at_t_star=sum(score >= t_star for score in hits) / objects,
        objects=objects,
    )


def _overall(per_class: list[ClassScores]) -> ClassScores:
    present = [s for s in per_class if s.objects]
    objects = sum(s.objects for s in present)
    if not objects:
        return ClassScores(None, None, None, None, None, 0)

    def mean(values: list[float | None], weights: list[int]) -> float:
        pairs = [(v, w) for v, w in zip(values, weights, strict=True) if v is not None]
        return sum(v * w for v, w in pairs) / sum(w for _, w in pairs)

    equal, sizes = [1] * len(present), [s.objects for s in present]
    return ClassScores(
        ap50=mean([s.ap50 for s in present], equal),
        ap70=mean([s.ap70 for s in present], equal),
        ap=mean([s.ap for s in present], equal),
        recall=mean([s.recall for s in present], sizes),
        recall_at_t_star=mean([s.recall_at_t_star for s in present], sizes),
        objects=objects,
    )
