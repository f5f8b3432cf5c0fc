import pytest
import torch

from detectors.adapters.spec import COCO_CLASSES
from detectors.base import DetectorError
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.targets import DEFAULT_T_STAR, EvaluatedClasses, resolve_t_star


class Named:
    """A detector of these classes, and of nothing else."""

    name = "named"

    def __init__(self, *classes: str) -> None:
        self.classes = classes

    def forward(self, images):
        raise AssertionError("its classes are all that is asked for")

    def decode(self, raw):
        raise AssertionError("its classes are all that is asked for")


BOXES = torch.arange(16.0).view(4, 4)
TRUTH = Targets(BOXES, torch.arange(4), torch.tensor([False, False, False, True]))


def test_classes_of_coco_are_judged_by_name():
    judged = EvaluatedClasses.from_detector(Named(*COCO_CLASSES))
    assert judged.names == ("Car",)
    person, car, bus = (COCO_CLASSES.index(name) for name in ("person", "Car", "bus"))
    found = judged.map_detections(
        Detections(BOXES[:3], torch.tensor([person, car, bus]), torch.tensor([0.9, 0.8, 0.7]))
    )
    assert torch.equal(found.boxes_xyxy, BOXES[1:2])
    assert found.labels.tolist() == [0]
    assert found.scores.tolist() == pytest.approx([0.8])


def test_a_detector_of_all_classes_sees_everything_as_it_is():
    judged = EvaluatedClasses.from_detector(Named(*CLASSES))
    found = Detections(BOXES, torch.arange(4), torch.ones(4))
    assert judged.map_detections(found) is found
    assert judged.map_targets(TRUTH) is TRUTH
    assert judged.to_detector_targets(TRUTH) is TRUTH


def test_objects_without_a_name_are_ignored_for_each_class_and_rows_stay():
    judged = EvaluatedClasses.from_detector(Named("tram", "Cyclist", "Car"))
    assert judged.names == ("Car", "Cyclist")
    targets = judged.map_targets(TRUTH)
    foreign = [i for i, name in enumerate(CLASSES) if name not in judged.names]
    assert torch.equal(targets.boxes_xyxy, torch.cat([BOXES, BOXES[foreign]]))
    expected = [judged.names.index(name) if name in judged.names else 0 for name in CLASSES]
    assert targets.labels.tolist() == [*expected, *[1] * len(foreign)]
    for i, name in enumerate(CLASSES):
        assert bool(targets.ignore[i]) == (name not in judged.names or i == 3)
    assert bool(targets.ignore[4:].all())


def test_losses_get_the_detector_s_own_numbers():
    judged = EvaluatedClasses.from_detector(Named("tram", "Cyclist", "Car"))
    own = judged.to_detector_targets(Targets(BOXES[:2], torch.tensor([0, 1]), torch.zeros(2, dtype=torch.bool)))
    assert own.labels.tolist() == [2, 1]


def test_a_detector_without_cars_is_refused():
    with pytest.raises(DetectorError, match=r"detector named: expected one that knows Car, found bus, tram$"):
        EvaluatedClasses.from_detector(Named("bus", "tram"))


def test_thresholds():
    plain, own, unset = Named("Car"), Named("Car"), Named("Car")
    own.t_star, unset.t_star = 0.6, None
    assert resolve_t_star(plain) == resolve_t_star(unset) == DEFAULT_T_STAR
    assert resolve_t_star(own) == resolve_t_star(own, otherwise=0.2) == 0.6
    assert resolve_t_star(plain, otherwise=0.2) == resolve_t_star(own, asked=0.2) == 0.2
