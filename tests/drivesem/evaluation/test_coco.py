import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.types import Detections, Targets
from drivesem.evaluation.coco import evaluate

CLASSES = ("Car", "Truck", "Pedestrian")


def _targets(boxes, labels=None, ignore=None) -> Targets:
    n = len(boxes)
    return Targets(
        boxes_xyxy=torch.tensor(boxes, dtype=torch.float32).reshape(n, 4),
        labels=torch.tensor(labels if labels is not None else [0] * n, dtype=torch.int64),
        ignore=torch.tensor(ignore if ignore is not None else [False] * n, dtype=torch.bool),
    )


def _detections(boxes, scores, labels=None) -> Detections:
    n = len(boxes)
    return Detections(
        boxes_xyxy=torch.tensor(boxes, dtype=torch.float32).reshape(n, 4),
        labels=torch.tensor(labels if labels is not None else [0] * n, dtype=torch.int64),
        scores=torch.tensor(scores, dtype=torch.float32),
    )


A, B, C = [0.0, 0, 40, 30], [100.0, 50, 160, 90], [200.0, 20, 280, 70]


def test_perfect_detections_give_one_everywhere():
    truth = [_targets([A, B, C], [0, 1, 0]), _targets([B], [0])]
    found = [_detections([C, B, A], [0.9, 0.8, 0.7], [0, 1, 0]), _detections([B], [0.6], [0])]
    scores = evaluate(truth, found, CLASSES, t_star=0.65)
    for name in ("Car", "Truck"):
        one = scores.per_class[name]
        assert (one.ap50, one.ap70, one.ap, one.recall) == pytest.approx((1, 1, 1, 1))
    assert scores.headline is scores.per_class["Car"]
    assert scores.headline.recall_at_t_star == pytest.approx(2 / 3)
    assert scores.overall.ap50 == pytest.approx(1)
    assert scores.overall.recall_at_t_star == pytest.approx(3 / 4)
    assert scores.overall.objects == 4


def test_a_class_without_objects_has_no_score_and_null_in_json():
    scores = evaluate([_targets([A])], [_detections([A], [0.9])], CLASSES, 0.5)
    assert scores.per_class["Pedestrian"].ap50 is None
    text = json.dumps(scores.to_json(), allow_nan=False)
    assert json.loads(text)["per_class"]["Pedestrian"]["recall"] is None
    assert json.loads(text)["ap50"] == pytest.approx(1)
    empty = evaluate([_targets([])], [_detections([], [])], CLASSES, 0.5)
    assert empty.overall.ap is None


def test_nothing_detected_gives_zero():
    scores = evaluate([_targets([A])], [_detections([], [])], CLASSES, 0.5)
    assert (scores.headline.ap50, scores.headline.recall, scores.headline.recall_at_t_star) == (0, 0, 0)


def test_iou_thresholds():
    shifted = [4.0, 0, 44, 30]  # IoU 36 / 44 = 0.82
    scores = evaluate([_targets([A])], [_detections([shifted], [0.9])], CLASSES, 0.5).headline
    assert scores.ap50 == pytest.approx(1)
    assert scores.ap70 == pytest.approx(1)
    assert scores.ap == pytest.approx(0.7)  # 0.5, 0.55, ..., 0.8: seven of ten
    further = [10.0, 0, 50, 30]  # IoU 0.6
    scores = evaluate([_targets([A])], [_detections([further], [0.9])], CLASSES, 0.5).headline
    assert (scores.ap50, scores.ap70) == pytest.approx((1, 0))


def test_ignored_objects_are_neither_missed_nor_hit():
    truth = [_targets([A, B], ignore=[False, True])]
    with_it = evaluate(truth, [_detections([B, A, B], [0.9, 0.8, 0.7])], CLASSES, 0.5).headline
    without = evaluate(truth, [_detections([A], [0.8])], CLASSES, 0.5).headline
    assert with_it == without
    assert with_it.ap50 == pytest.approx(1)
    assert with_it.objects == 1
    # On nothing it is a false positive, and a part of an ignored region counts nowhere.
    assert evaluate(truth, [_detections([C, A], [0.9, 0.8])], CLASSES, 0.5).headline.ap50 == pytest.approx(0.5)
    part = [100.0, 50, 110, 60]
    assert evaluate(truth, [_detections([part, A], [0.9, 0.8])], CLASSES, 0.5).headline.ap50 == pytest.approx(1)


def test_nothing_is_printed(capsys):
    evaluate([_targets([A])], [_detections([A], [0.9])], CLASSES, 0.5)
    assert capsys.readouterr().out == ""


def test_errors():
    with pytest.raises(ValueError, match="detections: expected 1 images, found 0"):
        evaluate([_targets([A])], [], CLASSES, 0.5)
    with pytest.raises(ValueError, match="headline: expected one of Car, Truck, Pedestrian, found 'Van'"):
        evaluate([], [], CLASSES, 0.5, headline="Van")


def _slow_ap(truth: list[Targets], found: list[Detections], label: int, iou_threshold: float) -> float | None:
    """AP with 101 recall samples, straight from the definition, ignored targets by intersection over detection."""
    rows, positives = [], 0
    for t, d in zip(truth, found, strict=True):
        boxes = [
            b for b, k, i in zip(t.boxes_xyxy.tolist(), t.labels, t.ignore, strict=True) if k == label and not i
        ]
        skip = [b for b, k, i in zip(t.boxes_xyxy.tolist(), t.labels, t.ignore, strict=True) if k == label and i]
        positives += len(boxes)
        taken = set()
        order = sorted(range(len(d)), key=lambda n: -float(d.scores[n]))
        for n in order:
            if int(d.labels[n]) != label:
                continue
            box = d.boxes_xyxy[n].tolist()
            best = max(
                (
                    (_iou(box, b), g)
                    for g, b in enumerate(boxes)
                    if g not in taken and _iou(box, b) >= iou_threshold
                ),
                default=None,
            )
            if best is not None:
                taken.add(best[1])
                rows.append((float(d.scores[n]), 1))
            elif not any(_inter(box, b) / _area(box) >= iou_threshold for b in skip):
                rows.append((float(d.scores[n]), 0))
    if positives == 0:
        return None
    rows.sort(key=lambda r: -r[0])
    hits = np.cumsum([r[1] for r in rows])
    recall, precision = hits / positives, hits / np.arange(1, len(rows) + 1)
    samples = [max(precision[recall >= r - 1e-12], default=0.0) for r in np.linspace(0, 1, 101)]
    return float(np.mean(samples))


def _inter(a, b):
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0)


def _area(a):
    return (a[2] - a[0]) * (a[3] - a[1])


def _iou(a, b):
    return _inter(a, b) / (_area(a) + _area(b) - _inter(a, b))


def _random_case(seed: int):
    draw = np.random.default_rng(seed)
    truth, found = [], []
    for _ in range(draw.integers(1, 4)):
        n = int(draw.integers(0, 6))
        corner, size = draw.uniform(0, 200, (n, 2)), draw.uniform(15, 80, (n, 2))
        boxes = np.concatenate([corner, corner + size], axis=1)
        labels = draw.integers(0, 3, n)
        truth.append(_targets(boxes.tolist(), labels.tolist(), (draw.random(n) < 0.2).tolist()))
        near = boxes[draw.random(n) < 0.8]
        near_labels = labels[: len(near)]
        jitter = near + draw.normal(0, 5, near.shape)
        jitter[:, 2:] = np.maximum(jitter[:, 2:], jitter[:, :2] + 1)
        extra = int(draw.integers(0, 4))
        corner, size = draw.uniform(0, 200, (extra, 2)), draw.uniform(15, 80, (extra, 2))
        all_boxes = np.concatenate([jitter, np.concatenate([corner, corner + size], axis=1)])
        all_labels = np.concatenate([near_labels, draw.integers(0, 3, extra)])
        found.append(_detections(all_boxes.tolist(), draw.random(len(all_boxes)).tolist(), all_labels.tolist()))
    return truth, found


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_ap_agrees_with_a_slow_independent_implementation(seed):
    truth, found = _random_case(seed)
    scores = evaluate(truth, found, CLASSES, 0.5)
    for label, name in enumerate(CLASSES):
        expected = _slow_ap(truth, found, label, 0.5), _slow_ap(truth, found, label, 0.7)
        actual = scores.per_class[name].ap50, scores.per_class[name].ap70
        assert actual == pytest.approx(expected, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_the_order_of_objects_and_detections_does_not_matter(seed):
    truth, found = _random_case(seed)
    generator = torch.Generator().manual_seed(seed)
    swapped_truth, swapped_found = [], []
    for t, d in zip(truth, found, strict=True):
        p, q = torch.randperm(len(t), generator=generator), torch.randperm(len(d), generator=generator)
        swapped_truth.append(Targets(t.boxes_xyxy[p], t.labels[p], t.ignore[p]))
        swapped_found.append(Detections(d.boxes_xyxy[q], d.labels[q], d.scores[q]))
    assert evaluate(truth, found, CLASSES, 0.5) == evaluate(swapped_truth, swapped_found, CLASSES, 0.5)
