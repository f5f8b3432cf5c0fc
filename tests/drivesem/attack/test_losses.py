"""Goals of attacks, against cases counted by hand."""

import math

import pytest
import torch

from detectors.base import Candidates, Detector, DetectorError
from detectors.registry import load_detector
from detectors.squeezedet import SqueezeDet
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack import losses

CAR, TRUCK, PERSON = 0, 1, 2
ALL = tuple(range(len(CLASSES)))
OBJECTS = torch.tensor([[0.0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 100, 20]])
T_STAR = 0.5
"""Its logit is 0, so that what is far from failure can be read off."""


def logit(score: float) -> float:
    return math.log(score / (1 - score))


def truth(ignore=(False, False, False)) -> Targets:
    return Targets(OBJECTS, torch.tensor([CAR, CAR, TRUCK]), torch.tensor(ignore))


def candidates(*rows: tuple[list[float], int, float]) -> Candidates:
    boxes = torch.tensor([row[0] for row in rows], dtype=torch.float32).reshape(-1, 1, 4)
    scores = torch.full((len(rows), len(CLASSES)), 1e-9)
    for i, (_, label, score) in enumerate(rows):
        scores[i, label] = score
    return Candidates(boxes, scores.log())


def of(name: str, found: Candidates, targets: Targets, known=ALL) -> float:
    return float(losses.goal_loss(name, found, targets, T_STAR, known))


SEEN = candidates(
    ([0, 0, 20, 18], CAR, 0.9),  # meets the first car
    ([0, 0, 20, 16], CAR, 0.95),  # and this one better scored
    ([48, 0, 68, 20], CAR, 0.7),  # IoU 12/28 with the second car: none
    ([80, 0, 100, 20], CAR, 0.2),  # a truck is no car
)


def test_hide_counts_the_best_score_that_meets_each_object():
    assert of("hide", SEEN, truth()) == pytest.approx(
        -logit(0.95) + losses.MAX_MARGIN + losses.MAX_MARGIN, abs=1e-5
    )
    assert of("hide", SEEN, truth((False, True, True))) == pytest.approx(-logit(0.95), abs=1e-5)
    assert of("hide", SEEN, truth((True, True, True))) == 0


def test_the_highest_threshold_has_a_logit():
    assert losses.threshold_logit(0.3) == math.log(0.3) - math.log1p(-0.3)
    assert 16 < losses.threshold_logit(1.0) < 17
    assert math.isfinite(float(losses.goal_loss("failure", SEEN, truth(), 1.0, ALL)))


def test_hiding_what_is_hidden_gains_nothing():
    lone = truth((False, True, True))
    faint = [of("hide", candidates(([0, 0, 20, 20], CAR, score)), lone) for score in (0.4, 0.01, 0.001)]
    assert faint[0] == pytest.approx(logit(0.6), abs=1e-5)
    assert faint[1:] == [losses.MAX_MARGIN] * 2


def test_phantom_is_the_mean_of_the_best_false_alarms():
    few = SEEN.log_scores[:, CAR].exp().tolist()[2:]
    expected = sum(logit(score) for score in few)
    cars = of("phantom", SEEN, truth((False, False, True)), known=(CAR,))
    assert cars == pytest.approx(expected / 2, abs=1e-5)
    # Of the other classes every candidate is silent, so of all of them eight count.
    rest = losses.MAX_PHANTOMS - 2
    assert of("phantom", SEEN, truth()) == pytest.approx(
        (expected + rest * logit(1e-9)) / losses.MAX_PHANTOMS, rel=1e-3
    )


def test_what_lies_on_an_ignored_object_of_its_class_is_no_phantom():
    on_ignored = candidates(([2, 2, 10, 10], CAR, 0.8))
    assert of("phantom", on_ignored, truth((True, True, True)), known=(CAR,)) == -losses.MAX_MARGIN
    assert of("phantom", on_ignored, truth(), known=(CAR,)) == pytest.approx(logit(0.8), abs=1e-5)


def test_no_phantom_of_a_class_that_is_not_judged():
    person = candidates(([200, 0, 210, 30], PERSON, 0.9))
    assert of("phantom", person, truth(), known=(PERSON,)) == pytest.approx(logit(0.9), abs=1e-5)
    assert of("phantom", person, truth(), known=(CAR,)) < logit(1e-8)


def test_localisation_is_how_far_the_best_box_is_from_its_object():
    assert of("localisation", SEEN, truth()) == pytest.approx((1 - 16 / 20) + 1 + 0, abs=1e-6)
    assert of("localisation", candidates(), truth()) == 3


def test_failure_is_hide_and_phantom():
    both = of("hide", SEEN, truth()) + of("phantom", SEEN, truth())
    assert of("failure", SEEN, truth()) == pytest.approx(both, abs=1e-6)


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
    value = losses.goal_loss(name, Candidates(boxes, logs), truth((True, True, True)), T_STAR, known=())
    gradient, _ = torch.autograd.grad(value, [logs, boxes], allow_unused=True)
    assert gradient is not None
    assert not bool(gradient.any())


def test_detections_are_candidates_without_a_gradient():
    found = Detections(OBJECTS[:2], torch.tensor([CAR, TRUCK]), torch.tensor([0.9, 0.3]))
    told = losses.candidates_from_detections(found, len(CLASSES))
    assert told.boxes_for_class(TRUCK).tolist() == OBJECTS[:2].tolist()
    assert of("hide", told, truth((False, True, True))) == pytest.approx(-logit(0.9), abs=1e-5)


@pytest.mark.parametrize("name", ["squeezedet", "yolov3-slim"])
def test_candidates_are_what_is_decoded(name):
    detector = load_detector(name)
    height, width = 96, 160
    image = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(1))
    limit = torch.tensor([width - 1.0, height - 1.0] * 2)
    with torch.no_grad():
        raw = detector(image)
        raws = [raw, raw.inject(torch.tensor([10.0, 20, 60, 70]), CAR)]
        told = [detector.candidates(one) for one in raws]
    found = [detector.decode(one)[0] for one in raws]
    assert len(found[1]) == 1
    for one, detections in zip(told, found, strict=True):
        for box, label, score in zip(
            detections.boxes_xyxy, detections.labels.tolist(), detections.scores, strict=True
        ):
            same = (one.log_scores[:, label].exp() - score).abs() < 1e-5
            placed = torch.minimum(one.boxes_for_class(label)[same].clamp(min=0), limit)
            assert bool(((placed - box).abs() < 0.1).all(1).any())


def test_a_detector_that_does_not_tell_is_named():
    class Silent(SqueezeDet):
        candidates = Detector.candidates

    with pytest.raises(DetectorError, match="detector squeezedet: expected one that tells its candidates"):
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
