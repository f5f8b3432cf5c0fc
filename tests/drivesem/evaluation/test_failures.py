import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.types import Detections, Targets
from drivesem.evaluation.coco import evaluate
from drivesem.evaluation.failures import count_by_class, find_failures, match_detections

CLASSES = ("Car", "Truck", "Pedestrian")
A, B, C = [0.0, 0, 40, 30], [100.0, 50, 160, 90], [200.0, 20, 280, 70]
T_STAR = 0.5


def _targets(boxes, labels=None, ignore=None) -> Targets:
    n = len(boxes)
    return Targets(
        boxes_xyxy=torch.tensor(boxes, dtype=torch.float32).reshape(n, 4),
        labels=torch.tensor(labels or [0] * n, dtype=torch.int64),
        ignore=torch.tensor(ignore or [False] * n, dtype=torch.bool),
    )


def _detections(boxes, scores=None, labels=None) -> Detections:
    n = len(boxes)
    return Detections(
        boxes_xyxy=torch.tensor(boxes, dtype=torch.float32).reshape(n, 4),
        labels=torch.tensor(labels or [0] * n, dtype=torch.int64),
        scores=torch.tensor(scores or [0.9] * n, dtype=torch.float32),
    )


def _shift(box, dx):
    return [box[0] + dx, box[1], box[2] + dx, box[3]]


@pytest.mark.parametrize(
    ("detections", "found", "false_positive"),
    [
        (_detections([A, B]), [True, True], [False, False]),
        (_detections([A, A, B]), [True, True], [False, True, False]),
        (_detections([A, B], [0.9, 0.4]), [True, False], [False, False]),
        (_detections([A, B], labels=[1, 0]), [False, True], [True, False]),
        (_detections([_shift(A, 15.0)]), [False, False], [True]),
        (_detections([]), [False, False], []),
        # The better one takes the target, whatever the order they come in.
        (_detections([_shift(A, 4.0), A], [0.6, 0.8]), [True, False], [True, False]),
    ],
)
def test_judge(detections, found, false_positive):
    judgement = match_detections(_targets([A, B]), detections, T_STAR)
    assert judgement.detected.tolist() == found
    assert judgement.false_positive.tolist() == false_positive


def test_detections_on_ignored_targets_are_excused():
    judgement = match_detections(
        _targets([A, B], ignore=[False, True]), _detections([B, [100, 50, 120, 60], C]), T_STAR
    )
    assert judgement.detected.tolist() == [False, False]
    assert judgement.false_positive.tolist() == [False, False, True]
    # Only those of the class.
    other = match_detections(_targets([B], [1], [True]), _detections([B]), T_STAR)
    assert other.false_positive.tolist() == [True]


def test_lost_is_what_was_found_before_and_is_not_now():
    benign = _targets([A, B, C])
    before = _detections([A, B])
    moved = _targets([_shift(A, 30.0), B, C])
    after = _detections([A])  # the first box stayed behind, the second is gone, the third was never found
    failures = find_failures(benign, before, moved, after, T_STAR)
    assert failures.lost == (0, 1)
    assert failures.phantoms == (0,)
    assert failures.success
    # Under the benign labels, as in the paper, the first one is still met.
    assert find_failures(benign, before, benign, after, T_STAR).lost == (1,)


def test_what_became_ignored_is_not_lost():
    benign = _targets([A, B])
    hidden = _targets([A, B], ignore=[False, True])
    assert find_failures(benign, _detections([A, B]), hidden, _detections([A]), T_STAR).success is False


def test_false_positives_that_were_there_before_are_no_phantoms():
    truth = _targets([A])
    before = _detections([A, C], labels=[0, 2])
    same = find_failures(truth, before, truth, _detections([A, _shift(C, 5.0)], labels=[0, 2]), T_STAR)
    assert same.phantoms == ()
    other_class = find_failures(truth, before, truth, _detections([A, C], labels=[0, 1]), T_STAR)
    assert other_class.phantoms == (1,)
    elsewhere = find_failures(truth, before, truth, _detections([A, B], labels=[0, 2]), T_STAR)
    assert elsewhere.phantoms == (1,)
    faint = find_failures(truth, before, truth, _detections([A, B], [0.9, 0.3], [0, 2]), T_STAR)
    assert not faint.success


def test_rising_above_the_threshold_makes_a_phantom():
    truth = _targets([A])
    result = find_failures(truth, _detections([A, B], [0.9, 0.4]), truth, _detections([A, B], [0.9, 0.6]), T_STAR)
    assert result.phantoms == (1,)


def test_a_box_without_an_area_is_no_phantom():
    truth, found = _targets([A]), _detections([A, [60.0, 10, 60, 40]])
    assert find_failures(truth, found, truth, found, T_STAR).phantoms == ()


def test_counts_by_class():
    labels = torch.tensor([0, 2, 2, 1])
    assert count_by_class((1, 2, 3), labels, CLASSES) == {"Car": 0, "Truck": 1, "Pedestrian": 2}


def test_targets_must_correspond():
    with pytest.raises(ValueError, match="targets: expected the 2 benign objects, found 1"):
        find_failures(_targets([A, B]), _detections([]), _targets([A]), _detections([]), T_STAR)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_found_objects_are_cocos_recall_at_t_star(seed):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(6, 2, generator=generator) * 150
    boxes = torch.cat([corner, corner + 20 + torch.rand(6, 2, generator=generator) * 60], dim=1)
    truth = Targets(boxes, torch.randint(0, 2, (6,), generator=generator), torch.zeros(6, dtype=torch.bool))
    found = Detections(
        boxes + torch.randn(6, 4, generator=generator) * 6,
        truth.labels,
        torch.rand(6, generator=generator),
    )
    recall = evaluate([truth], [found], CLASSES, T_STAR).overall.recall_at_t_star
    assert float(match_detections(truth, found, T_STAR).detected.double().mean()) == pytest.approx(recall)


def test_nothing_changes_nothing_fails():
    truth, found = _targets([A, B], ignore=[False, True]), _detections([A, C])
    assert not find_failures(truth, found, truth, found, T_STAR).success
