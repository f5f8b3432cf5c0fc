"""Each kind of failure by a hand-made case, and what is none."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from detectors.types import Detections, Targets
from drivesem.failures.grades import Kind
from drivesem.failures.kinds import Fault, LabelledDetections, find_faults, match_detections

CAR, TRUCK = 0, 1
T_STAR = 0.5
NEAR = (100.0, 100.0, 200.0, 160.0)
FAR = (400.0, 100.0, 440.0, 130.0)
BADLY = (100.0, 100.0, 145.0, 160.0)
"""IoU of 0.45 with NEAR."""
NOWHERE = (700.0, 100.0, 780.0, 150.0)

Box = tuple[float, float, float, float]


def targets(*boxes: Box, ignore: tuple[int, ...] = ()) -> Targets:
    flags = torch.tensor([i in ignore for i in range(len(boxes))], dtype=torch.bool)
    return Targets(torch.tensor(boxes).reshape(-1, 4), torch.full((len(boxes),), CAR), flags)


def view(
    truth: Targets, *reports: tuple[Box, int, float], visible_boxes: dict[int, Box] | None = None
) -> LabelledDetections:
    """Reports: box, label, score."""
    visible = truth.boxes_xyxy.clone()
    for row, box in (visible_boxes or {}).items():
        visible[row] = torch.tensor(box)
    boxes = torch.tensor([r[0] for r in reports]).reshape(-1, 4)
    labels = torch.tensor([r[1] for r in reports], dtype=torch.int64)
    return LabelledDetections(truth, visible, Detections(boxes, labels, torch.tensor([r[2] for r in reports])))


BOTH = targets(NEAR, FAR)
RIGHT = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8))


def test_nothing_fails_where_all_is_found() -> None:
    assert find_faults(RIGHT, RIGHT, T_STAR) == ()


def test_missed() -> None:
    assert find_faults(RIGHT, view(BOTH, (FAR, CAR, 0.8), (NEAR, CAR, 0.4)), T_STAR) == (
        Fault(Kind.MISSED, 0, -1),
    )


def test_a_flip_of_class_is_one_failure() -> None:
    assert find_faults(RIGHT, view(BOTH, (NEAR, TRUCK, 0.9), (FAR, CAR, 0.8)), T_STAR) == (
        Fault(Kind.CLASS, 0, 0),
    )


def test_badly_placed() -> None:
    assert find_faults(RIGHT, view(BOTH, (FAR, CAR, 0.8), (BADLY, CAR, 0.7)), T_STAR) == (
        Fault(Kind.PLACED, 0, 1),
    )


def test_a_class_error_outranks_a_bad_box() -> None:
    changed = view(BOTH, (FAR, CAR, 0.8), (BADLY, CAR, 0.7), (NEAR, TRUCK, 0.6))
    assert find_faults(RIGHT, changed, T_STAR) == (Fault(Kind.CLASS, 0, 2),)


def test_found_twice() -> None:
    again = (102.0, 101.0, 201.0, 160.0)
    for label in (CAR, TRUCK):
        changed = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (again, label, 0.6))
        assert find_faults(RIGHT, changed, T_STAR) == (Fault(Kind.TWICE, 0, 2),)
        assert find_faults(changed, changed, T_STAR) == ()


def test_background() -> None:
    changed = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (NOWHERE, CAR, 0.6))
    assert find_faults(RIGHT, changed, T_STAR) == (Fault(Kind.BACKGROUND, -1, 2),)


def test_one_phantom_per_place_of_any_class() -> None:
    changed = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (NOWHERE, CAR, 0.6), (NOWHERE, TRUCK, 0.7))
    assert find_faults(RIGHT, changed, T_STAR) == (Fault(Kind.BACKGROUND, -1, 3),)


def test_an_occluded_object_is_found_by_what_shows_of_it() -> None:
    left_half = (100.0, 100.0, 145.0, 160.0)
    changed = view(BOTH, (left_half, CAR, 0.8), (FAR, CAR, 0.8), visible_boxes={0: left_half})
    assert find_faults(RIGHT, changed, T_STAR) == ()
    assert match_detections(changed, T_STAR).detected.tolist() == [True, True]


def test_ignored_objects_are_no_failures_and_excuse_what_lies_on_them() -> None:
    now = targets(NEAR, FAR, ignore=(0,))
    assert find_faults(RIGHT, view(now, (FAR, CAR, 0.8)), T_STAR) == ()
    assert find_faults(RIGHT, view(now, (FAR, CAR, 0.8), (NEAR, TRUCK, 0.9)), T_STAR) == ()


def test_no_phantom_where_the_benign_picture_was_suspect() -> None:
    changed = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (NOWHERE, CAR, 0.6))
    for score, faults in ((0.26, 0), (0.24, 1)):
        benign = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (NOWHERE, TRUCK, score))
        assert len(find_faults(benign, changed, T_STAR)) == faults


def test_no_phantom_where_a_witness_sees_an_object() -> None:
    changed = view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (NOWHERE, CAR, 0.6))
    assert find_faults(RIGHT, changed, T_STAR, torch.tensor([NOWHERE])) == ()
    assert len(find_faults(RIGHT, changed, T_STAR, torch.tensor([NEAR]))) == 1


def test_what_lies_inside_an_object_is_no_phantom() -> None:
    wheel = (110.0, 140.0, 120.0, 150.0)
    assert find_faults(RIGHT, view(BOTH, (NEAR, CAR, 0.9), (FAR, CAR, 0.8), (wheel, CAR, 0.7)), T_STAR) == ()


def test_what_was_missed_before_is_no_failure() -> None:
    assert find_faults(view(BOTH, (FAR, CAR, 0.8)), view(BOTH, (FAR, CAR, 0.8)), T_STAR) == ()


boxes = st.tuples(*(st.floats(0, 300) for _ in range(2)), *(st.floats(10, 120) for _ in range(2))).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@given(
    st.lists(boxes, min_size=1, max_size=4),
    st.lists(st.tuples(boxes, st.integers(0, 1), st.floats(0.05, 1)), max_size=6),
    st.lists(st.tuples(boxes, st.integers(0, 1), st.floats(0.05, 1)), max_size=6),
)
def test_each_object_fails_at_most_once_and_only_if_it_was_found(
    truth: list[Box], before: list[tuple[Box, int, float]], after: list[tuple[Box, int, float]]
) -> None:
    benign, changed = view(targets(*truth), *before), view(targets(*truth), *after)
    faults = find_faults(benign, changed, T_STAR)
    of_objects = [fault.target for fault in faults if fault.kind is not Kind.BACKGROUND]
    assert len(of_objects) == len(set(of_objects))
    found = match_detections(benign, T_STAR).detected
    assert all(bool(found[target]) for target in of_objects)
    assert find_faults(benign, benign, T_STAR) == ()
