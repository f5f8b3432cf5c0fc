"""Evaluated classes, targeted objects, and the score threshold."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from detectors.adapters.spec import COCO_CLASSES
from detectors.base import DetectorError
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.targets import ALL_TARGETS, DEFAULT_T_STAR, EvaluatedClasses, TargetSelection, resolve_t_star
from drivesem.config.errors import UsageError
from drivesem.evaluation.failures import FrameFailures

TARGETS = Targets(torch.rand(4, 4), torch.tensor([0, 0, 1, 2]), torch.tensor([False, False, False, True]))
DETECTIONS = Detections(torch.rand(2, 4), torch.tensor([0, 2]), torch.tensor([0.9, 0.8]))
FAILURES = FrameFailures(lost=(0, 1, 2), phantoms=(0, 1))
BOXES = torch.arange(16.0).view(4, 4)
EACH_CLASS = Targets(BOXES, torch.arange(4), torch.tensor([False, False, False, True]))


class NamedDetector:
    """A detector with classes and nothing else."""

    name = "named"
    t_star: float | None

    def __init__(self, *classes: str) -> None:
        self.classes = classes

    def forward(self, images: Tensor) -> Any:
        raise AssertionError("only its classes are needed")

    def decode(self, raw: Any) -> list[Detections]:
        raise AssertionError("only its classes are needed")


def evaluated(*classes: str) -> EvaluatedClasses:
    return EvaluatedClasses.from_detector(NamedDetector(*classes))


def test_all_is_targeted_by_default() -> None:
    assert TargetSelection.from_options(None, None) == ALL_TARGETS
    assert ALL_TARGETS.targets(TARGETS) is TARGETS
    assert ALL_TARGETS.failures(FAILURES, TARGETS, DETECTIONS, CLASSES) is FAILURES
    assert ALL_TARGETS.classes_of(("Car",)) == ("Car",)


@pytest.mark.parametrize(
    ("options", "selection", "ignored", "failures"),
    [
        (("2, 1", None), ((1, 2), None), [True, False, False, True], ((1, 2), ())),
        ((None, "Pedestrian,Car"), (None, ("Car", "Pedestrian")), [False, False, True, True], ((0, 1), (0, 1))),
        ((None, "Truck"), (None, ("Truck",)), [True, True, False, True], ((2,), ())),
        (("0,2", "Car"), ((0, 2), ("Car",)), [False, True, True, True], ((0,), (0,))),
    ],
)
def test_only_targeted_objects_and_classes_fail(options: Any, selection: Any, ignored: Any, failures: Any) -> None:
    selected = TargetSelection.from_options(*options)
    assert (selected.objects, selected.classes) == selection
    assert selected.targets(TARGETS).ignore.tolist() == ignored
    assert selected.failures(FAILURES, TARGETS, DETECTIONS, CLASSES) == FrameFailures(*failures)


@pytest.mark.parametrize(
    ("objects", "classes", "message"),
    [
        ("a", None, "--target-objects: expected indices of objects with commas, found 'a'"),
        ("-1", None, "--target-objects"),
        (",", None, "--target-objects"),
        (None, "Bus", "--target-classes: expected classes among Car, Truck, Pedestrian, Cyclist, found 'Bus'"),
        (None, "", "--target-classes"),
    ],
)
def test_invalid_options_are_named(objects: str | None, classes: str | None, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TargetSelection.from_options(objects, classes)


def test_coco_classes_are_matched_by_name() -> None:
    classes = evaluated(*COCO_CLASSES)
    assert classes.names == ("Car",)
    labels = torch.tensor([COCO_CLASSES.index(name) for name in ("person", "Car", "bus")])
    detections = classes.map_detections(Detections(BOXES[:3], labels, torch.tensor([0.9, 0.8, 0.7])))
    assert torch.equal(detections.boxes_xyxy, BOXES[1:2])
    assert detections.labels.tolist() == [0]
    assert detections.scores.tolist() == pytest.approx([0.8])


def test_a_detector_of_all_classes_needs_no_mapping() -> None:
    classes, detections = evaluated(*CLASSES), Detections(BOXES, torch.arange(4), torch.ones(4))
    assert classes.map_detections(detections) is detections
    assert classes.map_targets(EACH_CLASS) is EACH_CLASS
    assert classes.to_detector_targets(EACH_CLASS) is EACH_CLASS


def test_objects_of_unknown_classes_are_ignored_for_each_class_and_rows_stay() -> None:
    classes = evaluated("tram", "Cyclist", "Car")
    assert classes.names == ("Car", "Cyclist")
    targets = classes.map_targets(EACH_CLASS)
    foreign = [i for i, name in enumerate(CLASSES) if name not in classes.names]
    assert torch.equal(targets.boxes_xyxy, torch.cat([BOXES, BOXES[foreign]]))
    expected = [classes.names.index(name) if name in classes.names else 0 for name in CLASSES]
    assert targets.labels.tolist() == [*expected, *[1] * len(foreign)]
    for i, name in enumerate(CLASSES):
        assert bool(targets.ignore[i]) == (name not in classes.names or i == 3)
    assert bool(targets.ignore[4:].all())


def test_losses_get_the_detectors_own_labels() -> None:
    targets = Targets(BOXES[:2], torch.tensor([0, 1]), torch.zeros(2, dtype=torch.bool))
    assert evaluated("tram", "Cyclist", "Car").to_detector_targets(targets).labels.tolist() == [2, 1]


def test_a_detector_without_cars_is_refused() -> None:
    with pytest.raises(DetectorError, match=r"detector named: expected one that knows Car, found bus, tram$"):
        evaluated("bus", "tram")


def test_thresholds() -> None:
    plain, own, unset = NamedDetector("Car"), NamedDetector("Car"), NamedDetector("Car")
    own.t_star, unset.t_star = 0.6, None
    assert resolve_t_star(plain) == resolve_t_star(unset) == DEFAULT_T_STAR
    assert resolve_t_star(own) == resolve_t_star(own, default=0.2) == 0.6
    assert resolve_t_star(plain, default=0.2) == resolve_t_star(own, 0.2) == 0.2
