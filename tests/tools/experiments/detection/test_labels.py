"""Benign and moved labels of attacked frames."""

import pytest

from tests.tools.experiments.detection.conftest import arm, arm_run, frame
from tools.experiments.detection.labels import LabelComparison, compare_frame_labels, compare_labels


def iou(shift: float) -> float:
    """Of a box 50 px wide and itself, shifted."""
    return (50 - shift) / (50 + shift)


def sets_of(run) -> LabelComparison:
    return compare_labels(run.arm.name, compare_frame_labels(run))


def test_overlap_and_failures_of_labels_alone() -> None:
    """The detector follows the car: any failure is the labels'. 10 px is an IoU of 0.67, 40 px one of 0.11."""
    shifts = [0.0, 10.0, 40.0, 40.0]
    found = sets_of(arm_run(arm("translate"), [frame(str(i), moved_by=s) for i, s in enumerate(shifts)]))
    assert (found.frames, found.objects) == (4, 8)
    assert found.iou["least"] == pytest.approx(iou(40))
    assert found.iou["median"] == 1.0
    assert found.below == {0.5: 2 / 8, 0.7: 3 / 8}
    half, strict = found.counts[0.5], found.counts[0.7]
    assert (half.paper, half.moved, half.only_unmoved) == (2, 0, 2)
    assert (strict.paper, strict.moved, strict.only_unmoved) == (3, 0, 3)
    assert (half.lost_paper, half.lost_only_unmoved) == (2, 2)
    flat = found.to_row()
    assert flat["only_unmoved_at_0.7"] == 3
    assert flat["below_0.5"] == 0.25


def test_a_car_that_is_really_lost_is_lost_by_both() -> None:
    one = sets_of(arm_run(arm("mesh"), [frame("0", moved_by=3.0, found=False)])).counts[0.5]
    assert (one.paper, one.moved, one.only_unmoved) == (1, 1, 0)
    assert (one.lost_paper, one.lost_only_unmoved) == (1, 0)
