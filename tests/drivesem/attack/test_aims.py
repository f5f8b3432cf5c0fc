"""Whom an attack is after."""

import pytest
import torch

from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.targets import ALL_TARGETS, TargetSelection
from drivesem.config.errors import UsageError
from drivesem.evaluation.failures import FrameFailures

TARGETS = Targets(torch.rand(4, 4), torch.tensor([0, 0, 1, 2]), torch.tensor([False, False, False, True]))
FOUND = Detections(torch.rand(2, 4), torch.tensor([0, 2]), torch.tensor([0.9, 0.8]))
FAILED = FrameFailures(lost=(0, 1, 2), phantoms=(0, 1))


def test_everything_is_aimed_at_by_default():
    assert TargetSelection.from_options(None, None) == ALL_TARGETS
    assert ALL_TARGETS.targets(TARGETS) is TARGETS
    assert ALL_TARGETS.failures(FAILED, TARGETS, FOUND, CLASSES) is FAILED
    assert ALL_TARGETS.classes_of(("Car",)) == ("Car",)


def test_chosen_objects_alone_can_be_lost():
    aim = TargetSelection.from_options("2, 1", None)
    assert aim.objects == (1, 2)
    assert aim.targets(TARGETS).ignore.tolist() == [True, False, False, True]
    assert aim.failures(FAILED, TARGETS, FOUND, CLASSES) == FrameFailures(lost=(1, 2), phantoms=())


def test_chosen_classes_are_lost_and_seen():
    aim = TargetSelection.from_options(None, "Pedestrian,Car")
    assert aim.classes == ("Car", "Pedestrian")
    assert aim.targets(TARGETS).ignore.tolist() == [False, False, True, True]
    assert aim.failures(FAILED, TARGETS, FOUND, CLASSES) == FrameFailures(lost=(0, 1), phantoms=(0, 1))
    trucks = TargetSelection.from_options(None, "Truck")
    assert trucks.failures(FAILED, TARGETS, FOUND, CLASSES) == FrameFailures(lost=(2,), phantoms=())


def test_objects_and_classes_together():
    aim = TargetSelection.from_options("0,2", "Car")
    assert aim.failures(FAILED, TARGETS, FOUND, CLASSES) == FrameFailures(lost=(0,), phantoms=(0,))


@pytest.mark.parametrize(
    ("objects", "classes", "named"),
    [
        ("a", None, "--target-objects: expected indices of objects with commas, found 'a'"),
        ("-1", None, "--target-objects"),
        (",", None, "--target-objects"),
        (None, "Bus", "--target-classes: expected classes among Car, Truck, Pedestrian, Cyclist, found 'Bus'"),
        (None, "", "--target-classes"),
    ],
)
def test_bad_words_are_named(objects, classes, named):
    with pytest.raises(UsageError, match=named):
        TargetSelection.from_options(objects, classes)
