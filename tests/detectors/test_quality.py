"""The quality loss: which anchors answer, and each of its terms by hand."""

import math

import pytest
import torch

from detectors import grid, quality
from detectors.base import AnchorPredictions
from detectors.squeezedet import SqueezeDet
from detectors.types import Targets

SIZES = ((16.0, 16.0),)
ANCHORS = torch.tensor([[0.0, 0, 16, 16], [8.0, 0, 24, 16], [16.0, 0, 32, 16], [64.0, 0, 80, 16]])


def test_an_object_is_answered_by_the_anchors_near_its_best_one() -> None:
    # IoU with the object: 1, 1/3 (not 0.6 of the best), 0, 0
    found = quality.choose_responsible_anchors(ANCHORS, ANCHORS, ANCHORS[:1], torch.tensor([0]))
    assert found.anchor.tolist() == [0]
    assert found.candidate.tolist() == [True]
    assert found.quality.tolist() == [1.0]


def test_what_lies_halfway_has_two_candidates_of_equal_weight() -> None:
    halfway = torch.tensor([[4.0, 0, 20, 16]])  # 12 px of 16 with the first two anchors: IoU 0.6 each
    found = quality.choose_responsible_anchors(ANCHORS, ANCHORS, halfway, torch.tensor([1]))
    assert found.anchor.tolist() == [0, 1]
    assert found.candidate.tolist() == [True, True]
    assert found.quality.tolist() == pytest.approx([0.6, 0.6])
    assert found.share.tolist() == [0.5, 0.5]


def test_an_anchor_goes_to_the_object_it_overlaps_more_but_for_one_that_is_anothers_own() -> None:
    objects = torch.tensor([[0.0, 0, 16, 16], [2.0, 0, 18, 16]])
    contested = quality.choose_responsible_anchors(ANCHORS, ANCHORS, objects, torch.tensor([0, 1]))
    assert dict(zip(contested.anchor.tolist(), contested.object.tolist(), strict=True)) == {0: 0, 1: 1}
    swapped = quality.choose_responsible_anchors(ANCHORS, ANCHORS, objects, torch.tensor([1, 0]))
    assert dict(zip(swapped.anchor.tolist(), swapped.object.tolist(), strict=True)) == {1: 0, 0: 1}


def test_distant_anchor_with_a_matching_box_is_responsible() -> None:
    boxes_xyxy = ANCHORS.clone()
    boxes_xyxy[3] = torch.tensor([0.0, 0, 16, 12])
    found = quality.choose_responsible_anchors(boxes_xyxy, ANCHORS, ANCHORS[:1], torch.tensor([0]))
    assert found.anchor.tolist() == [0, 3]
    assert found.candidate.tolist() == [True, False]
    assert found.quality.tolist() == [1.0, 0.75]


def test_own_anchor_answers_where_nothing_overlaps() -> None:
    found = quality.choose_responsible_anchors(
        ANCHORS, ANCHORS, torch.tensor([[500.0, 0, 510, 10]]), torch.tensor([2])
    )
    assert found.anchor.tolist() == [2]
    assert found.quality.tolist() == [0.0]


def one_row(confidence_logits: list[float], deltas: list[list[float]]) -> AnchorPredictions:
    """Four cells of 16 px side by side, one anchor of 16x16 px each, two classes at even odds."""
    offsets = torch.tensor([deltas], requires_grad=True)
    anchors = grid.anchors_cxcywh(SIZES, 1, 4, torch.float32, torch.device("cpu"))
    centre = anchors[:, :2] + offsets[..., :2] * anchors[:, 2:]
    size = anchors[:, 2:] * grid.safe_exp(offsets[..., 2:])
    logits = torch.tensor([confidence_logits])
    return AnchorPredictions(
        torch.cat((centre - size / 2, centre + size / 2), -1), offsets, torch.zeros(1, 4, 2), logits, (16, 64)
    )


def at_anchor(k: int) -> list[float]:
    return [16.0 * k + 7.5 - 8, -0.5, 16.0 * k + 7.5 + 8, 15.5]


def terms_of(
    raw: AnchorPredictions, target: Targets, own: list[int], silent: list[bool]
) -> dict[str, torch.Tensor]:
    pair = torch.zeros(len(own), dtype=torch.int64), torch.tensor(own, dtype=torch.int64)
    return quality.quality_loss_terms(raw, [target], SIZES, pair, torch.tensor([silent]))


def test_terms_by_hand() -> None:
    # The object is the second cell's anchor; its box lies 0.25 of its size to the right: IoU 12 / 20.
    shifted = [0.25, 0.0, 0.0, 0.0]
    raw = one_row([0.0, 0.0, math.log(0.2 / 0.8), 5.0], [[0.0] * 4, shifted, [0.0] * 4, [0.0] * 4])
    target = Targets(torch.tensor([at_anchor(1)]), torch.tensor([1]), torch.tensor([False]))
    found = terms_of(raw, target, [1], [True, False, True, False])  # the last one lies in a region
    entropy = -(0.6 * math.log(0.5) + 0.4 * math.log(0.5))
    alarms = 0.5**2 * -math.log(0.5) + 0.2**2 * -math.log(0.8)
    assert float(found["confidence"]) == pytest.approx(2 * (0.1**2 * entropy + alarms), rel=1e-5)
    assert float(found["class"]) == pytest.approx(math.log(2), rel=1e-5)
    # IoU 0.6 and nothing open in the hull; smooth L1 with beta 0.1: 0.25 - 0.05
    assert found["box"].item() == pytest.approx(2 * (1 - 0.6) + 0.2, rel=1e-5)


def test_a_frame_without_objects_only_teaches_silence() -> None:
    raw = one_row([0.0] * 4, [[0.0] * 4] * 4)
    none = Targets(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))
    found = terms_of(raw, none, [], [True] * 4)
    assert float(found["confidence"]) == pytest.approx(2 * 4 * 0.25 * math.log(2), rel=1e-5)
    assert float(found["box"]) == float(found["class"]) == 0.0


def test_a_confident_loose_box_is_pulled_down_and_a_shy_tight_one_up() -> None:
    raw = one_row([3.0, -1.0, -9.0, -9.0], [[0.55, 0, 0, 0], [0.0] * 4, [0.0] * 4, [0.0] * 4])
    logits = raw.confidence_logits.requires_grad_()
    target = Targets(torch.tensor([at_anchor(1)]), torch.tensor([0]), torch.tensor([False]))
    terms_of(raw, target, [1], [True, False, True, True])["confidence"].backward()
    assert logits.grad is not None
    assert logits.grad[0, 0] > 0 > logits.grad[0, 1]


def test_squeezedet_trains_with_it_if_selected() -> None:
    detector = SqueezeDet().eval()
    detector.initialise(torch.Generator().manual_seed(1))
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(2))
    target = Targets(torch.tensor([[20.0, 10, 60, 40]]), torch.tensor([0]), torch.tensor([False]))
    published = detector.loss(detector(image), [target])
    detector.trained_by = "quality"
    learned = detector.loss(detector(image), [target])
    assert learned.keys() == published.keys()
    assert learned["objectness"].item() == published["objectness"].item()
    parts = sum(learned[name].item() for name in ("confidence", "box", "class"))
    assert learned["total"].item() == pytest.approx(parts, rel=1e-5) != pytest.approx(published["total"].item())
