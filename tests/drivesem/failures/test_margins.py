"""Margins: values, signs, and gradients against differences."""

import math

import torch
from torch import Tensor

from detectors.base import Candidates
from drivesem.failures import margins as margin

T_STAR = 0.4
CAR, TRUCK = 0, 1
BOX = torch.tensor([[100.0, 100.0, 200.0, 160.0]], dtype=torch.float64)
LABEL = torch.tensor([CAR])
NOTHING = torch.zeros(1, 4, dtype=torch.float64)


def logit(score: float) -> float:
    return math.log(score / (1 - score))


def candidates(boxes: Tensor, scores: Tensor) -> Candidates:
    return Candidates(boxes[:, None], scores.log())


def two() -> tuple[Tensor, Tensor]:
    """A box on the object, and one beside it with a better score."""
    boxes = torch.tensor([[104.0, 101.0, 202.0, 158.0], [400.0, 100.0, 480.0, 160.0]], dtype=torch.float64)
    return boxes, torch.tensor([[0.7, 0.1], [0.9, 0.2]], dtype=torch.float64)


def test_the_best_that_meets_the_object_counts() -> None:
    found = margin.object_margins(candidates(*two()), BOX, LABEL, NOTHING, T_STAR)
    torch.testing.assert_close(found, torch.tensor([logit(0.7) - logit(T_STAR)], dtype=torch.float64))


def test_what_shows_counts_too() -> None:
    boxes, scores = two()
    elsewhere = BOX + 600
    assert (
        margin.object_margins(candidates(boxes, scores), elsewhere, LABEL, NOTHING, T_STAR).item()
        == margin.MIN_MARGIN
    )
    visible = margin.object_margins(candidates(boxes, scores), elsewhere, LABEL, BOX, T_STAR)
    assert visible.item() > 0


def test_another_class_does_not_count() -> None:
    found = margin.object_margins(candidates(*two()), BOX, torch.tensor([TRUCK]), NOTHING, T_STAR)
    torch.testing.assert_close(found.item(), logit(0.1) - logit(T_STAR))


def test_the_sign_turns_for_places() -> None:
    boxes, scores = two()
    place = boxes[1:].clone()
    found = margin.place_margins(candidates(boxes, scores), place, T_STAR)
    torch.testing.assert_close(found.item(), logit(T_STAR) - logit(0.9))
    assert margin.place_margins(candidates(boxes, scores), place + 300, T_STAR).item() == -margin.MIN_MARGIN


def test_background_is_what_no_label_covers() -> None:
    """The best candidate of any class on nothing counts. What touches a label, or lies on one for the most part,
    is no background.
    """
    boxes, scores = two()
    only = logit(T_STAR) - logit(0.9)
    torch.testing.assert_close(margin.background_margin(candidates(boxes, scores), BOX, T_STAR).item(), only)
    # half of it covered, and a small part of a large label
    for label in (boxes[1:] + torch.tensor([0, 0, 40.0, 0]), torch.tensor([[300.0, 0.0, 900.0, 300.0]])):
        covered = torch.cat([BOX, label.to(BOX)])
        assert margin.background_margin(candidates(boxes, scores), covered, T_STAR).item() == -margin.MIN_MARGIN
    nothing = margin.background_margin(candidates(boxes, scores), BOX[:0], T_STAR).item()
    torch.testing.assert_close(nothing, only)
    by_class = candidates(boxes, scores.flip(1))
    torch.testing.assert_close(margin.background_margin(by_class, BOX, T_STAR).item(), only)
    soft = margin.background_margin(candidates(boxes, scores), BOX, T_STAR, 50.0).item()
    torch.testing.assert_close(soft, only, atol=1e-6, rtol=0)


def test_a_sharp_soft_margin_is_the_margin() -> None:
    pair = candidates(*two())
    hard = margin.object_margins(pair, BOX, LABEL, NOTHING, T_STAR)
    soft = margin.object_margins(pair, BOX, LABEL, NOTHING, T_STAR, sharpness=200.0)
    torch.testing.assert_close(hard, soft, atol=1e-3, rtol=0)
    place = BOX + 1
    torch.testing.assert_close(
        margin.place_margins(pair, place, T_STAR),
        margin.place_margins(pair, place, T_STAR, sharpness=200.0),
        atol=1e-2,
        rtol=0,
    )


def test_no_objects_no_margins() -> None:
    empty = torch.zeros(0, 4, dtype=torch.float64)
    found = margin.object_margins(candidates(*two()), empty, torch.zeros(0, dtype=torch.int64), empty, T_STAR)
    assert found.shape == (0,)
    assert margin.place_margins(candidates(*two()), empty, T_STAR).shape == (0,)


def test_gradients_against_differences() -> None:
    generator = torch.Generator().manual_seed(3)
    boxes = BOX + 30 * torch.rand(12, 4, generator=generator, dtype=torch.float64)
    scores = torch.rand(12, 2, generator=generator, dtype=torch.float64).clamp(0.05, 0.95)
    leaves = (boxes.requires_grad_(True), scores.requires_grad_(True))

    def objects(b: Tensor, s: Tensor) -> Tensor:
        return margin.object_margins(candidates(b, s), BOX, LABEL, BOX + 8, T_STAR, sharpness=2.0)

    def places(b: Tensor, s: Tensor) -> Tensor:
        return margin.place_margins(candidates(b, s), BOX + 5, T_STAR, sharpness=2.0)

    assert torch.autograd.gradcheck(objects, leaves)
    assert torch.autograd.gradcheck(places, leaves)


def test_a_badly_placed_box_is_pulled_towards_its_object() -> None:
    boxes = torch.tensor([[150.0, 100.0, 250.0, 160.0]], dtype=torch.float64, requires_grad=True)
    scores = torch.tensor([[0.9, 0.01]], dtype=torch.float64)
    margin.object_margins(candidates(boxes, scores), BOX, LABEL, NOTHING, T_STAR, sharpness=2.0).sum().backward()
    assert boxes.grad is not None
    assert boxes.grad[0, 0] < 0
    assert boxes.grad[0, 2] < 0


def test_gradients_are_never_so_small_that_they_slow_a_detector_down() -> None:
    """Boxes that meet the object less and less: the last weights of the soft maximum are subnormal numbers, and
    change nothing.
    """
    boxes = BOX.float() + torch.linspace(0, 200, 400)[:, None]
    scores = torch.full((400, 2), 0.9, requires_grad=True)
    soft = margin.object_margins(
        candidates(boxes, scores), BOX.float(), LABEL, NOTHING.float(), T_STAR, sharpness=4.0
    )
    soft.sum().backward()
    assert scores.grad is not None
    sizes = scores.grad.abs()
    assert bool((sizes > 0).any())
    assert not bool(((sizes > 0) & (sizes < 1e-24)).any())
    exact = margin.object_margins(
        candidates(boxes.double(), scores.detach().double()), BOX, LABEL, NOTHING, T_STAR, sharpness=4.0
    )
    torch.testing.assert_close(soft.detach().double(), exact, rtol=1e-6, atol=0)
