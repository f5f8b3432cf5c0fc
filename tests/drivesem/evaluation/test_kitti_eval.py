"""KITTI's benchmark: each rule by hand, and random frames beside a slow implementation that follows the rules."""

import numpy as np
import pytest

from drivesem.evaluation.instances import DetectionTable
from drivesem.evaluation.kitti import DIFFICULTIES, evaluate, recall_thresholds

KINDS = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck")
MIN_HEIGHT = {"easy": 40, "moderate": 25, "hard": 25}
MAX_OCCLUSION = {"easy": 0, "moderate": 1, "hard": 2}
MAX_TRUNCATION = {"easy": 0.15, "moderate": 0.30, "hard": 0.50}
MIN_OVERLAP = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
NEIGHBOUR = {"Car": "Van", "Pedestrian": "Person_sitting", "Cyclist": "none"}


# ---- the rules, one after the other, without a thought for speed ----


def _intersection(a, b):
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0.0


def _area(a):
    return (a[2] - a[0]) * (a[3] - a[1])


def _iou(a, b):
    shared = _intersection(a, b)
    return shared / (_area(a) + _area(b) - shared) if shared else 0.0


def _prepare(truth, found, name, difficulty, small):
    """Objects (box, counted) of class and neighbours, detections (box, score, ignored), DontCare regions."""
    objects = []
    for _, kind, box, truncation, occlusion in truth:
        if kind not in (name, NEIGHBOUR[name]):
            continue
        counted = (
            kind == name
            and box[3] - box[1] >= MIN_HEIGHT[difficulty]
            and occlusion <= MAX_OCCLUSION[difficulty]
            and truncation <= MAX_TRUNCATION[difficulty]
        )
        objects.append((box, counted))
    detections = [
        (box, score, small == "ignore" and box[3] - box[1] < MIN_HEIGHT[difficulty])
        for _, kind, box, score in found
        if kind == name
    ]
    return objects, detections, [row[2] for row in truth if row[1] == "DontCare"]


def _collect(objects, detections, least):
    scores, assigned = [], set()
    for box, counted in objects:
        best = None
        for j, (other, score, _) in enumerate(detections):
            if j not in assigned and _iou(box, other) > least and (best is None or score > detections[best][1]):
                best = j
        if best is not None:
            assigned.add(best)
            if counted and not detections[best][2]:
                scores.append(detections[best][1])
    return scores


def _count(objects, detections, regions, least, threshold):
    assigned, hits = set(), 0
    for box, counted in objects:
        best, best_overlap = None, 0.0
        for j, (other, score, ignored) in enumerate(detections):
            if j in assigned or score < threshold or _iou(box, other) <= least:
                continue
            if ignored:
                best = j if best is None else best
            elif best is None or detections[best][2] or _iou(box, other) > best_overlap:
                best, best_overlap = j, _iou(box, other)
        if best is not None:
            assigned.add(best)
            hits += counted and not detections[best][2]
    misfires = 0
    for j, (box, score, ignored) in enumerate(detections):
        excused = any(_intersection(box, region) / _area(box) > least for region in regions)
        misfires += not (j in assigned or ignored or score < threshold or excused)
    return hits, misfires


def _slow(truth, found, frames, name, difficulty, small):
    prepared = [
        _prepare([t for t in truth if t[0] == i], [d for d in found if d[0] == i], name, difficulty, small)
        for i in range(frames)
    ]
    least = MIN_OVERLAP[name]
    objects = sum(counted for one in prepared for _, counted in one[0])
    scores = sorted((s for o, d, _ in prepared for s in _collect(o, d, least)), reverse=True)
    thresholds, recall = [], 0.0
    for i, score in enumerate(scores):
        left = (i + 1) / objects
        right = (i + 2) / objects if i < len(scores) - 1 else left
        if right - recall < recall - left and i < len(scores) - 1:
            continue
        thresholds.append(score)
        recall += 1 / 40.0
    precision = [0.0] * 41
    for k, threshold in enumerate(thresholds):
        counts = [_count(*one, least, threshold) for one in prepared]
        hits, misfires = sum(c[0] for c in counts), sum(c[1] for c in counts)
        precision[k] = hits / (hits + misfires) if hits + misfires else 0.0
    precision = [max(precision[k:]) for k in range(41)]
    if not objects:
        return None, None, 0
    return sum(precision[::4]) / 11, sum(precision[1:]) / 40, objects


def _compare(truth, found, frames, truths, detections, small):
    curves = evaluate(truths, detections, KINDS, small)
    assert [(c.name, c.difficulty) for c in curves] == [(n, d) for n in MIN_OVERLAP for d in DIFFICULTIES]
    for curve in curves:
        r11, r40, objects = _slow(truth, found, frames, curve.name, curve.difficulty, small)
        assert curve.object_count == objects
        for ours, theirs in ((curve.r11(), r11), (curve.r40(), r40)):
            assert (ours is None) == (theirs is None)
            assert ours is None or ours == pytest.approx(theirs, abs=1e-12)


@pytest.mark.parametrize("small", ["ignore", "count"])
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("crowded", [False, True])
def test_a_few_random_frames(make_truths, make_found, draw_rows, seed, crowded, small):
    truth, found = draw_rows(seed, 12, crowded)
    _compare(truth, found, 12, make_truths(truth, 12), make_found(found), small)


@pytest.mark.slow
@pytest.mark.parametrize("small", ["ignore", "count"])
@pytest.mark.parametrize("crowded", [False, True])
def test_a_thousand_random_frames(make_truths, make_found, draw_rows, crowded, small):
    truth, found = draw_rows(1, 1000, crowded)
    _compare(truth, found, 1000, make_truths(truth, 1000), make_found(found), small)


# ---- each rule by hand ----

BOX = (100.0, 100.0, 200.0, 160.0)  # 60 px high
EMPTY = (500.0, 100.0, 600.0, 160.0)


def _metrics(make_truths, make_found, truth, found, name="Car", difficulty="easy", small="ignore", frames=1):
    curves = evaluate(make_truths(truth, frames), make_found(found), KINDS, small)
    return next(c for c in curves if (c.name, c.difficulty) == (name, difficulty))


@pytest.fixture
def metrics(make_truths, make_found):
    def call(truth, found, *args, **kwargs):
        return _metrics(make_truths, make_found, truth, found, *args, **kwargs)

    return call


def test_one_object_found(metrics):
    one = metrics([(0, "Car", BOX, 0.0, 0)], [(0, "Car", BOX, 0.9)])
    # one threshold: precision 1 at recall 0 and nowhere else
    assert (one.object_count, one.r11(), one.r40()) == (1, pytest.approx(1 / 11), 0.0)


def test_forty_objects_found_of_forty(metrics):
    boxes = [(float(200 * i), 100.0, 200.0 * i + 100, 160.0) for i in range(40)]
    truth = [(0, "Car", box, 0.0, 0) for box in boxes]
    found = [(0, "Car", box, 1 - i / 100) for i, box in enumerate(boxes)]
    one = metrics(truth, found)
    # n = 40: score 0 at r = 0; from then on every score is a threshold, 40 of them for 41 samples
    assert len(one.thresholds()) == 40
    assert one.r40() == pytest.approx(39 / 40)
    assert one.r11() == pytest.approx(10 / 11)


def test_every_object_of_many_found_is_one(metrics):
    boxes = [(float(200 * i), 100.0, 200.0 * i + 100, 160.0) for i in range(400)]
    one = metrics(
        [(0, "Car", box, 0.0, 0) for box in boxes], [(0, "Car", box, 1 - i / 1000) for i, box in enumerate(boxes)]
    )
    assert (len(one.thresholds()), one.r11(), one.r40()) == (41, 1.0, 1.0)


def test_a_false_positive_between(metrics):
    boxes = [(float(200 * i), 100.0, 200.0 * i + 100, 160.0) for i in range(4)]
    truth = [(0, "Car", box, 0.0, 0) for box in boxes]
    found = [(0, "Car", boxes[0], 0.9), (0, "Car", (0, 300, 90, 380), 0.8), (0, "Car", boxes[1], 0.7)]
    # precision 1 at the first threshold, 2/3 at the second, then nothing
    assert metrics(truth, found).precision()[:3] == pytest.approx([1, 2 / 3, 0])
    assert metrics(truth, found).r40() == pytest.approx(2 / 3 / 40)


@pytest.mark.parametrize(
    ("kind", "name", "width"),
    [("Car", "Car", 70.0), ("Pedestrian", "Pedestrian", 50.0), ("Cyclist", "Cyclist", 50.0)],
)
def test_overlap_must_exceed_the_class_threshold(metrics, kind, name, width):
    truth = [(0, kind, (0.0, 0.0, 100.0, 100.0), 0.0, 0)]
    exactly = metrics(truth, [(0, kind, (0.0, 0.0, width, 100.0), 0.9)], name)
    more = metrics(truth, [(0, kind, (0.0, 0.0, width + 1, 100.0), 0.9)], name)
    assert (exactly.r11(), more.r11()) == (0.0, pytest.approx(1 / 11))


@pytest.mark.parametrize(
    ("box", "truncation", "occlusion", "counted"),
    [
        (BOX, 0.15, 0, (1, 1, 1)),
        (BOX, 0.16, 0, (0, 1, 1)),
        (BOX, 0.30, 1, (0, 1, 1)),
        (BOX, 0.31, 1, (0, 0, 1)),
        (BOX, 0.50, 2, (0, 0, 1)),
        (BOX, 0.51, 2, (0, 0, 0)),
        (BOX, 0.0, 3, (0, 0, 0)),
        (BOX, -1.0, 0, (1, 1, 1)),
        ((0, 0, 99, 40), 0.0, 0, (1, 1, 1)),
        ((0, 0, 99, 39.9), 0.0, 0, (0, 1, 1)),
        ((0, 0, 99, 25), 0.0, 0, (0, 1, 1)),
        ((0, 0, 99, 24.9), 0.0, 0, (0, 0, 0)),
    ],
)
def test_what_counts_at_each_difficulty(metrics, box, truncation, occlusion, counted):
    truth = [(0, "Car", box, truncation, occlusion)]
    found = [(0, "Car", box, 0.9)]
    for difficulty, number in zip(DIFFICULTIES, counted, strict=True):
        one = metrics(truth, found, difficulty=difficulty)
        assert one.object_count == number
        assert (one.r11() is None) == (number == 0)


@pytest.mark.parametrize(("neighbour", "name"), [("Van", "Car"), ("Person_sitting", "Pedestrian")])
def test_neighbours_are_neither_missed_nor_hit(metrics, neighbour, name):
    truth = [(0, name, BOX, 0.0, 0), (0, neighbour, EMPTY, 0.0, 0)]
    missed = metrics(truth, [(0, name, BOX, 0.5)], name)
    hit = metrics(truth, [(0, name, EMPTY, 0.9), (0, name, BOX, 0.5)], name)
    assert missed.object_count == 1
    assert missed.precision()[0] == hit.precision()[0] == 1.0


def test_other_types_are_not_there(metrics):
    truth = [(0, "Car", BOX, 0.0, 0), (0, "Truck", EMPTY, 0.0, 0)]
    one = metrics(truth, [(0, "Car", EMPTY, 0.9), (0, "Car", BOX, 0.5)])
    assert one.precision()[0] == 0.5


def test_dont_care_takes_false_positives_out(metrics):
    truth = [(0, "Car", BOX, 0.0, 0), (0, "DontCare", (500.0, 0.0, 800.0, 400.0), -1.0, -1)]
    whole = metrics(truth, [(0, "Car", EMPTY, 0.9), (0, "Car", BOX, 0.5)])
    assert whole.precision()[0] == 1.0
    # 70 of 100 px wide: not more than 0.7 of the detection
    part = metrics(truth, [(0, "Car", (470.0, 100.0, 570.0, 160.0), 0.9), (0, "Car", BOX, 0.5)])
    assert part.precision()[0] == 0.5


def test_small_detections_in_both_kits(metrics):
    low = (500.0, 100.0, 600.0, 139.0)
    truth = [(0, "Car", BOX, 0.0, 0)]
    found = [(0, "Car", low, 0.9), (0, "Car", BOX, 0.5)]
    assert metrics(truth, found, small="ignore").precision()[0] == 1.0
    assert metrics(truth, found, small="count").precision()[0] == 0.5
    assert metrics(truth, found, small="ignore", difficulty="moderate").precision()[0] == 0.5


def test_an_ignored_detection_gives_way_to_one_that_counts(metrics):
    truth = [(0, "Car", (0.0, 0.0, 100.0, 41.0), 0.0, 0)]
    close, high = (0.0, 0.0, 100.0, 39.5), (0.0, 0.0, 100.0, 50.0)
    one = metrics(truth, [(0, "Car", close, 0.5), (0, "Car", high, 0.9)])
    assert one.precision()[0] == 1.0
    # the better score of an ignored one takes the object in the threshold pass: nothing is collected
    assert len(metrics(truth, [(0, "Car", close, 0.9), (0, "Car", high, 0.5)]).thresholds()) == 0


def test_the_count_pass_goes_by_overlap_and_the_threshold_pass_by_score(metrics):
    truth = [(0, "Car", (0.0, 0.0, 100.0, 50.0), 0.0, 0)]
    rough, exact = (0.0, 0.0, 100.0, 65.0), (0.0, 0.0, 100.0, 50.0)
    one = metrics(truth, [(0, "Car", rough, 0.9), (0, "Car", exact, 0.5)])
    assert one.thresholds().tolist() == [0.9]
    # the second is below the only threshold: no false positive
    assert one.precision()[0] == 1.0


def test_a_double_detection_is_a_false_positive(metrics):
    truth = [(0, "Car", BOX, 0.0, 0), (0, "Car", EMPTY, 0.0, 0)]
    found = [(0, "Car", BOX, 0.9), (0, "Car", BOX, 0.8), (0, "Car", EMPTY, 0.7)]
    assert metrics(truth, found).precision()[:2] == pytest.approx([1, 2 / 3])


def test_each_frame_for_itself(metrics):
    one = metrics([(0, "Car", BOX, 0.0, 0)], [(1, "Car", BOX, 0.9), (0, "Car", BOX, 0.5)], frames=2)
    assert one.precision()[0] == 0.5


def test_no_detections_at_all(metrics):
    one = metrics([(0, "Car", BOX, 0.0, 0)], [])
    assert (one.r11(), one.r40()) == (0.0, 0.0)
    assert metrics([], [(0, "Car", BOX, 0.9)]).r40() is None


def test_thresholds_by_the_plain_walk():
    draw = np.random.default_rng(3)
    for _ in range(200):
        objects = int(draw.integers(1, 900))
        scores = draw.random(int(draw.integers(0, objects + 1)))
        ordered, expected, recall = sorted(scores.tolist(), reverse=True), [], 0.0
        for i, score in enumerate(ordered):
            last = i == len(ordered) - 1
            if not last and (i + 2) / objects - recall < recall - (i + 1) / objects:
                continue
            expected.append(score)
            recall += 1.0 / 40.0
        assert recall_thresholds(scores, objects).tolist() == expected


def test_weights_are_copies_of_frames(make_truths, make_found, draw_rows):
    truth, found = draw_rows(5, 6, True)
    weights = np.array([2.0, 0, 1, 1, 3, 1])
    copies = [(f, i) for f, n in enumerate(weights.astype(int)) for i in range(n)]
    place = {pair: k for k, pair in enumerate(copies)}
    more_truth = [(place[pair], *t[1:]) for pair in copies for t in truth if t[0] == pair[0]]
    more_found = [(place[pair], *d[1:]) for pair in copies for d in found if d[0] == pair[0]]
    weighted = evaluate(make_truths(truth, 6), make_found(found), KINDS)
    repeated = evaluate(make_truths(more_truth, len(copies)), make_found(more_found), KINDS)
    for one, other in zip(weighted, repeated, strict=True):
        assert one.r40(weights) == (other.r40() if other.r40() is None else pytest.approx(other.r40(), abs=1e-12))


def test_letter_case_is_free(make_truths, make_found):
    truths = make_truths([(0, "Car", BOX, 0.0, 0)], 1)
    found: DetectionTable = make_found([(0, "Car", BOX, 0.9)])
    curve = evaluate(truths, found, tuple(kind.upper() for kind in KINDS))[0]
    assert curve.r11() == pytest.approx(1 / 11)
