import pytest
import torch

from detectors.types import Detections, Targets
from drivesem.attack import losses

CAR, TRUCK = 0, 1
OBJECTS = torch.tensor([[0.0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 100, 20]])


def truth(ignore=(False, False, False)) -> Targets:
    return Targets(OBJECTS, torch.tensor([CAR, CAR, TRUCK]), torch.tensor(ignore))


def found(*rows: tuple[list[float], int, float]) -> Detections:
    boxes = torch.tensor([r[0] for r in rows], dtype=torch.float32).reshape(-1, 4)
    return Detections(
        boxes, torch.tensor([r[1] for r in rows], dtype=torch.int64), torch.tensor([r[2] for r in rows])
    )


def test_nothing_found_costs_one_an_object():
    assert losses.detection_objectness(truth(), found()) == 3
    assert losses.detection_objectness(truth((True, False, True)), found()) == 1


def test_by_hand():
    detections = found(
        ([0, 0, 20, 18], CAR, 0.9),  # meets the first car
        ([0, 0, 20, 16], CAR, 0.4),  # meets it too, and is one too many
        ([48, 0, 68, 20], CAR, 0.7),  # IoU 12/28 with the second car: a miss and a false alarm
        ([80, 0, 100, 20], CAR, 0.2),  # a truck is no car
    )
    expected = (0.1**2 + 1 + 1) + (0.4**2 + 0.7**2 + 0.2**2)
    assert losses.detection_objectness(truth(), detections) == pytest.approx(expected, abs=1e-6)


def test_what_lies_on_an_ignored_object_is_no_false_alarm():
    on_ignored = found(([2, 2, 10, 10], CAR, 0.8))
    assert losses.detection_objectness(truth((True, True, True)), on_ignored) == 0


def test_it_rises_as_an_object_fades():
    losses = [
        losses.detection_objectness(truth((False, True, True)), found(([0, 0, 20, 20], CAR, score)))
        for score in (0.9, 0.6, 0.3)
    ]
    assert losses == sorted(losses)
    assert losses[0] == pytest.approx(0.01, abs=1e-6)
