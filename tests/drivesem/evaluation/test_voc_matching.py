"""VOC's matching and both of its averages beside an implementation that goes detection by detection."""

import numpy as np
import pytest

from drivesem.evaluation.curves import average_precision
from drivesem.evaluation.matching import Candidates

KINDS = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck")


def _overlap(a, b, share=False):
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(c[2] - c[0]) * (c[3] - c[1]) for c in (a, b)]
    return width * height / (areas[1] if share else sum(areas) - width * height)


def _slow(truth, found, kind):
    objects = [t for t in truth if t[1] == kind]
    regions = [t for t in truth if t[1] == "DontCare"]
    taken, outcome = set(), []
    for frame, _, box, _ in sorted((d for d in found if d[1] == kind), key=lambda d: -d[3]):
        overlaps = [(_overlap(t[2], box), -i) for i, t in enumerate(objects) if t[0] == frame]
        best, place = max(overlaps, default=(0.0, 0))
        if best >= 0.5:
            outcome.append(place not in taken)
            taken.add(place)
        elif not any(t[0] == frame and _overlap(t[2], box, share=True) >= 0.5 for t in regions):
            outcome.append(False)
    hits = np.cumsum(outcome)
    recall = hits / len(objects)
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
    candidates = Candidates.of(make_truths(truth, 10), make_found(found), 0.5, None)
    match = candidates.voc(0.5)
    for label, kind in enumerate(KINDS):
        tally = candidates.tally(match, label)
        if not tally.count():
            assert average_precision(tally, "voc") is None
            continue
        new, old = _slow(truth, found, kind)
        assert average_precision(tally, "voc") == pytest.approx(new, abs=1e-12)
        assert average_precision(tally, "voc07") == pytest.approx(old, abs=1e-12)


def test_a_second_detection_does_not_take_the_next_best_object(make_truths, make_found):
    left, right = (0.0, 0.0, 100.0, 100.0), (30.0, 0.0, 130.0, 100.0)
    near = (5.0, 0.0, 105.0, 100.0)
    truths = make_truths([(0, "Car", left), (0, "Car", right)], 1)
    found = make_found([(0, "Car", left, 0.9), (0, "Car", near, 0.8)])
    candidates = Candidates.of(truths, found, 0.5, None)
    assert candidates.voc(0.5).truth.tolist() == [0, -1]
    assert candidates.coco(0.5).truth.tolist() == [0, 1]
