"""Attack losses, against values computed by hand."""

import math

import pytest
import torch

from detectors.base import Candidates, Detector, DetectorError
from detectors.registry import load_detector
from detectors.squeezedet import SqueezeDet
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks import losses

CAR, TRUCK, PERSON = 0, 1, 2
ALL = tuple(range(len(CLASSES)))
OBJECTS = torch.tensor([[0.0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 100, 20]])
T_STAR = 0.5
"""Its logit is 0, so that distances to failure are logits."""


def logit(score: float) -> float:
    return math.log(score / (1 - score))


def truth(ignore=(False, False, False)) -> Targets:
    return Targets(OBJECTS, torch.tensor([CAR, CAR, TRUCK]), torch.tensor(ignore))


def detections_of(*rows: tuple[list[float], int, float]) -> Detections:
    boxes, labels, scores = zip(*rows, strict=True) if rows else ((), (), ())
    boxes_xyxy = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    return Detections(boxes_xyxy, torch.tensor(labels, dtype=torch.int64), torch.tensor(scores))


def candidates(*rows: tuple[list[float], int, float]) -> Candidates:
    return losses.candidates_from_detections(detections_of(*rows), len(CLASSES))


def goal(name: str, found: Candidates, targets: Targets, columns=ALL) -> float:
    return float(losses.goal_loss(name, found, targets, T_STAR, columns))


CANDIDATES = candidates(
    ([0, 0, 20, 18], CAR, 0.9),  # meets the first car
    ([0, 0, 20, 16], CAR, 0.95),  # and this one better scored
    ([48, 0, 68, 20], CAR, 0.7),  # IoU 12/28 with the second car: none
    ([80, 0, 100, 20], CAR, 0.2),  # a truck is no car
)


def test_hide_counts_the_best_overlapping_score_of_each_object():
    assert goal("hide", CANDIDATES, truth()) == pytest.approx(
        -logit(0.95) + losses.MAX_MARGIN + losses.MAX_MARGIN, abs=1e-5
    )
    assert goal("hide", CANDIDATES, truth((False, True, True))) == pytest.approx(-logit(0.95), abs=1e-5)
    assert goal("hide", CANDIDATES, truth((True, True, True))) == 0


def test_the_highest_threshold_has_a_logit():
    assert losses.threshold_logit(0.3) == math.log(0.3) - math.log1p(-0.3)
    assert 16 < losses.threshold_logit(1.0) < 17
    assert math.isfinite(float(losses.goal_loss("failure", CANDIDATES, truth(), 1.0, ALL)))


def test_hide_is_bounded_for_hidden_objects():
    lone = truth((False, True, True))
    faint = [goal("hide", candidates(([0, 0, 20, 20], CAR, score)), lone) for score in (0.4, 0.01, 0.001)]
    assert faint[0] == pytest.approx(logit(0.6), abs=1e-5)
    assert faint[1:] == [losses.MAX_MARGIN] * 2


def test_phantom_is_the_mean_of_the_best_false_alarms():
    few = CANDIDATES.log_scores[:, CAR].exp().tolist()[2:]
    expected = sum(logit(score) for score in few)
    cars = goal("phantom", CANDIDATES, truth((False, False, True)), columns=(CAR,))
    assert cars == pytest.approx(expected / 2, abs=1e-5)
    # Of the other classes every candidate is silent, so of all of them eight count.
    rest = losses.MAX_PHANTOMS - 2
    assert goal("phantom", CANDIDATES, truth()) == pytest.approx(
        (expected + rest * logit(1e-12)) / losses.MAX_PHANTOMS, rel=1e-3
    )


def test_detections_on_ignored_objects_are_no_phantoms():
    on_ignored = candidates(([2, 2, 10, 10], CAR, 0.8))
    assert goal("phantom", on_ignored, truth((True, True, True)), columns=(CAR,)) == -losses.MAX_MARGIN
    assert goal("phantom", on_ignored, truth(), columns=(CAR,)) == pytest.approx(logit(0.8), abs=1e-5)


def test_classes_that_are_not_evaluated_have_no_phantoms():
    person = candidates(([200, 0, 210, 30], PERSON, 0.9))
    assert goal("phantom", person, truth(), columns=(PERSON,)) == pytest.approx(logit(0.9), abs=1e-5)
    assert goal("phantom", person, truth(), columns=(CAR,)) < logit(1e-8)


def test_localisation_is_the_distance_of_the_best_box():
    assert goal("localisation", CANDIDATES, truth()) == pytest.approx((1 - 16 / 20) + 1 + 0, abs=1e-6)
    assert goal("localisation", candidates(), truth()) == 3


def test_failure_is_hide_and_phantom():
    both = goal("hide", CANDIDATES, truth()) + goal("phantom", CANDIDATES, truth())
    assert goal("failure", CANDIDATES, truth()) == pytest.approx(both, abs=1e-6)


@pytest.mark.parametrize("name", losses.GOALS)
def test_gradients_are_differences(name):
    generator = torch.Generator().manual_seed(3)
    rough = torch.rand(6, 4, generator=generator, dtype=torch.float64)
    boxes = torch.cat([OBJECTS.double() + rough[:3], OBJECTS.double() + 200 + rough[3:]])[:, None]
    logs = -0.2 - torch.rand(6, len(CLASSES), generator=generator, dtype=torch.float64)
    live = [boxes.requires_grad_(True), logs.requires_grad_(True)]

    def value(placed, scores):
        return losses.goal_loss(name, Candidates(placed, scores), truth(), 0.4, ALL)

    assert torch.autograd.gradcheck(value, live, eps=1e-6, atol=1e-6)
    gradients = torch.autograd.grad(value(*live), live, allow_unused=True)
    assert any(gradient is not None and bool(gradient.any()) for gradient in gradients)


@pytest.mark.parametrize("name", losses.GOALS)
def test_where_nothing_can_fail_the_gradient_is_zero(name):
    boxes, logs = torch.rand(2, 1, 4, requires_grad=True), torch.full((2, len(CLASSES)), -3.0, requires_grad=True)
    value = losses.goal_loss(name, Candidates(boxes, logs), truth((True, True, True)), T_STAR, columns=())
    gradient, _ = torch.autograd.grad(value, [logs, boxes], allow_unused=True)
    assert gradient is not None
    assert not bool(gradient.any())


def test_detections_are_candidates_without_a_gradient():
    found = candidates((OBJECTS[0].tolist(), CAR, 0.9), (OBJECTS[1].tolist(), TRUCK, 0.3))
    assert found.boxes_for_class(TRUCK).tolist() == OBJECTS[:2].tolist()
    assert goal("hide", found, truth((False, True, True))) == pytest.approx(-logit(0.9), abs=1e-5)


@pytest.mark.parametrize("name", ["squeezedet", "yolov3-slim"])
def test_candidates_include_the_decoded_detections(name):
    detector = load_detector(name)
    height, width = 96, 160
    image = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(1))
    limit = torch.tensor([width - 1.0, height - 1.0] * 2)
    with torch.no_grad():
        raw = detector(image)
        raws = [raw, raw.inject(torch.tensor([10.0, 20, 60, 70]), CAR)]
        decodable = [detector.candidates(one) for one in raws]
    found = [detector.decode(one)[0] for one in raws]
    assert len(found[1]) == 1
    for one, detections in zip(decodable, found, strict=True):
        for box, label, score in zip(
            detections.boxes_xyxy, detections.labels.tolist(), detections.scores, strict=True
        ):
            same = (one.log_scores[:, label].exp() - score).abs() < 1e-5
            placed = torch.minimum(one.boxes_for_class(label)[same].clamp(min=0), limit)
            assert bool(((placed - box).abs() < 0.1).all(1).any())


def test_a_detector_without_candidates_is_named():
    class Silent(SqueezeDet):
        candidates = Detector.candidates

    with pytest.raises(DetectorError, match="detector squeezedet: expected one that provides its candidates"):
        Silent().candidates(None)


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="candidates: expected boxes of shape"):
        Candidates(torch.zeros(2, 3, 4), torch.zeros(2, 4))


def test_the_loss_of_an_untrained_detector_is_finite():
    detector = SqueezeDet()
    detector.requires_grad_(False)
    image = torch.rand(1, 3, 64, 96, requires_grad=True)
    for name in losses.GOALS:
        value = losses.goal_loss(name, detector.candidates(detector(image)), truth(), 0.4, ALL)
        assert bool(torch.isfinite(value))


def test_objectness_counts_one_for_each_undetected_object():
    assert losses.detection_objectness(truth(), detections_of()) == 3
    assert losses.detection_objectness(truth((True, False, True)), detections_of()) == 1


def test_objectness_by_hand():
    detections = detections_of(
        ([0, 0, 20, 18], CAR, 0.9),  # matches the first car
        ([0, 0, 20, 16], CAR, 0.4),  # matches it too: a duplicate
        ([48, 0, 68, 20], CAR, 0.7),  # IoU 12/28 with the second car: a miss and a false positive
        ([80, 0, 100, 20], CAR, 0.2),  # a truck is no car
    )
    expected = (0.1**2 + 1 + 1) + (0.4**2 + 0.7**2 + 0.2**2)
    assert losses.detection_objectness(truth(), detections) == pytest.approx(expected, abs=1e-6)
    on_ignored = detections_of(([2, 2, 10, 10], CAR, 0.8))
    assert losses.detection_objectness(truth((True, True, True)), on_ignored) == 0


def test_objectness_rises_as_an_object_fades():
    only_first = truth((False, True, True))
    values = [
        losses.detection_objectness(only_first, detections_of(([0, 0, 20, 20], CAR, score)))
        for score in (0.9, 0.6, 0.3)
    ]
    assert values == sorted(values)
    assert values[0] == pytest.approx(0.01, abs=1e-6)
