"""Average precision and recall; pycocotools is the definition."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from detectors.types import Detections, Targets

MAX_DETECTIONS = 100
"""Detections judged an image and class, as COCO does."""
_IOU_50, _IOU_70 = 0, 4
"""Places of 0.5 and 0.7 among COCO's thresholds 0.5, 0.55, ..., 0.95."""


@dataclass(frozen=True, slots=True)
class ClassScores:
    """Fractions of 1; None where there is no object to find. ap50, ap70: at IoU 0.5 and 0.7; ap: mean over IoU 0.5
    to 0.95; recall: at IoU 0.5 with all detections; recall_at_t_star: with those of score t* and above; objects:
    how many were judged.
    """

    ap50: float | None
    ap70: float | None
    ap: float | None
    recall: float | None
    recall_at_t_star: float | None
    objects: int


@dataclass(frozen=True, slots=True)
class Scores:
    """per_class: in the detector's order; overall: the mean over classes that have objects (recall: over objects);
    headline: the class the paper reports.
    """

    headline: ClassScores
    overall: ClassScores
    per_class: dict[str, ClassScores]

    def to_json(self) -> dict[str, Any]:
        """The headline's figures in front, `overall` and `per_class` beside them."""
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
) -> Scores:
    """COCO's figures over images; the i-th targets and detections belong to one image.

    Ignored targets are COCO's crowds: a detection whose share on one reaches the IoU threshold counts nowhere.
    Raises ValueError where the two lists differ in length or `headline` is no class.
    """
    if len(targets) != len(detections):
        raise ValueError(f"detections: expected {len(targets)} images, found {len(detections)}")
    if headline not in classes:
        raise ValueError(f"headline: expected one of {', '.join(classes)}, found {headline!r}")
    evaluator = _run(targets, detections, classes)
    per_class = {name: _class_scores(evaluator, k, len(targets), t_star) for k, name in enumerate(classes)}
    return Scores(headline=per_class[headline], overall=_overall(list(per_class.values())), per_class=per_class)


def _run(targets: Sequence[Targets], detections: Sequence[Detections], classes: Sequence[str]) -> Any:
    """pycocotools' evaluator after `accumulate`; it prints its progress, which is swallowed."""
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
                # pycocotools takes id 0 for "no match": they begin at 1.
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
        for score, match, ignored in zip(
            e["dtScores"], e["dtMatches"][_IOU_50], e["dtIgnore"][_IOU_50], strict=True
        )
        if match > 0 and not ignored
    ]
    return ClassScores(
        ap50=float(precision[_IOU_50].mean()),
        ap70=float(precision[_IOU_70].mean()),
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
