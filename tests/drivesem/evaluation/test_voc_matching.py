"""VOC's matching and both of its averages beside an implementation that goes detection by detection."""

from dataclasses import replace

import numpy as np
import pytest

from drivesem.evaluation.curves import average_precision
from drivesem.evaluation.matching import CandidatePairs

KINDS = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck")


def _overlap(a, b, share=False):
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(c[2] - c[0]) * (c[3] - c[1]) for c in (a, b)]
    return width * height / (areas[1] if share else sum(areas) - width * height)


def _slow(truth, difficult, found, kind):
    """VOCevaldet.m, and regions of every class."""
    objects = [t for t in truth if t[1] == kind]
    hard = [d for t, d in zip(truth, difficult, strict=True) if t[1] == kind]
    regions = [t for t in truth if t[1] == "DontCare"]
    taken, outcome = set(), []
    for frame, _, box, _ in sorted((d for d in found if d[1] == kind), key=lambda d: -d[3]):
        overlaps = [(_overlap(t[2], box), -i) for i, t in enumerate(objects) if t[0] == frame]
        best, place = max(overlaps, default=(0.0, 0))
        if best >= 0.5:
            if not hard[-place]:
                outcome.append(place not in taken)
                taken.add(place)
        elif not any(t[0] == frame and _overlap(t[2], box, share=True) >= 0.5 for t in regions):
            outcome.append(False)
    hits = np.cumsum(outcome)
    recall = hits / (len(objects) - sum(hard))
    precision = hits / np.arange(1, len(outcome) + 1)
    old = sum(max(precision[recall >= k / 10 - 1e-12], default=0.0) for k in range(11)) / 11
    steps = np.concatenate([[0.0], recall])
    new = sum((steps[i + 1] - steps[i]) * max(precision[i:]) for i in range(len(precision)))
    return new, old


@pytest.mark.parametrize("seed", range(12))
def test_random_frames(make_truths, make_found, draw_rows, seed):
    truth, found = draw_rows(seed, 10, True)
    # scores that differ: what comes first among equal ones is not VOC's affair
    found = [(*row[:3], row[3] + i * 1e-6) for i, row in enumerate(found)]
    # difficult ones are wide, so that they hold detections on others
    difficult = np.random.default_rng(seed).random(len(truth)) < 0.3
    wide = np.outer(difficult, [-25, -25, 25, 25])
    truth = [(t[0], t[1], tuple(t[2] + more), *t[3:]) for t, more in zip(truth, wide, strict=True)]
    truths = make_truths(truth, 10)
    truths = replace(truths, ignore=truths.ignore | difficult)
    candidates = CandidatePairs.from_tables(truths, make_found(found), 0.5, None)
    match = candidates.match_voc(0.5)
    for label, kind in enumerate(KINDS):
        tally = candidates.class_matches(match, label)
        if not tally.object_count():
            assert average_precision(tally, "voc") is None
            continue
        new, old = _slow(truth, difficult, found, kind)
        assert average_precision(tally, "voc") == pytest.approx(new, abs=1e-12)
        assert average_precision(tally, "voc07") == pytest.approx(old, abs=1e-12)


def test_a_second_detection_does_not_take_the_next_best_object(make_truths, make_found):
    left, right = (0.0, 0.0, 100.0, 100.0), (30.0, 0.0, 130.0, 100.0)
    near = (5.0, 0.0, 105.0, 100.0)
    truths = make_truths([(0, "Car", left), (0, "Car", right)], 1)
    found = make_found([(0, "Car", left, 0.9), (0, "Car", near, 0.8)])
    candidates = CandidatePairs.from_tables(truths, found, 0.5, None)
    assert candidates.match_voc(0.5).ground_truth.tolist() == [0, -1]
    assert candidates.match_coco(0.5).ground_truth.tolist() == [0, 1]


def test_a_detection_belongs_to_a_difficult_object_only_if_it_overlaps_none_more(make_truths, make_found):
    """By IoU: a difficult object that holds a whole detection takes none that lies on another one."""
    car, difficult, large = (0.0, 0.0, 100.0, 100.0), (30.0, 0.0, 130.0, 100.0), (0.0, 0.0, 300.0, 300.0)
    near = (20.0, 0.0, 120.0, 100.0)
    truths = make_truths([(0, "Car", car), (0, "Car", difficult), (1, "Car", car), (1, "Car", large)], 2)
    truths = replace(truths, ignore=np.array([False, True, False, True]))
    rows = [(0, "Car", car, 0.9), (0, "Car", near, 0.8), (1, "Car", car, 0.7), (1, "Car", near, 0.6)]
    match = CandidatePairs.from_tables(truths, make_found(rows), 0.5, None).match_voc(0.5)
    assert match.ground_truth.tolist() == [0, -1, 2, -1]
    assert match.excused.tolist() == [False, True, False, False]
