"""SqueezeDet with frozen weights against the same layers under autograd."""

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from detectors.base import AnchorPredictions
from detectors.convolution import OneDnnWeights
from detectors.registry import load_detector
from detectors.squeezedet import SqueezeDet, SqueezeDetPlus

FIELDS = ("boxes_xyxy", "deltas", "class_logits", "confidence_logits")


def shipped(dtype: torch.dtype = torch.float64) -> SqueezeDet:
    detector = load_detector("squeezedet").to(dtype)
    assert isinstance(detector, SqueezeDet)
    return detector.requires_grad_(False)


def smooth(batch: int, height: int, width: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    """Images with blobs of many sizes: noise alone excites no deep layer."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(batch, 3, height, width, dtype=dtype)
    for cells in (3, 8, 20):
        coarse = torch.rand(batch, 3, cells, 2 * cells, generator=generator, dtype=dtype)
        image += F.interpolate(coarse, (height, width), mode="bicubic")
    return (image / 3).clamp(0, 1)


def functional(raw: AnchorPredictions) -> Tensor:
    weight = torch.linspace(-1, 1, raw.deltas.numel(), dtype=raw.deltas.dtype).view_as(raw.deltas)
    total = raw.confidence_logits.sigmoid().square().sum() + raw.class_logits.square().sum()
    return total + (raw.deltas * weight).sum()


def gradient(detector: SqueezeDet, images: Tensor) -> tuple[AnchorPredictions, Tensor]:
    leaf = images.clone().requires_grad_(True)
    raw = detector(leaf)
    (slope,) = torch.autograd.grad(functional(raw), leaf)
    return raw, slope


def difference(first: Tensor, second: Tensor) -> float:
    return float((first.detach().double() - second.detach().double()).norm() / second.detach().double().norm())


def plus() -> SqueezeDetPlus:
    detector = SqueezeDetPlus(classes=("Car", "Truck"), anchors=[(40.0, 30.0), (90.0, 60.0)]).double().eval()
    detector.initialise(torch.Generator().manual_seed(0))
    torch.nn.init.normal_(detector.convdet.weight, std=0.02, generator=torch.Generator().manual_seed(1))
    return detector


# 97 to 210 rows: the first layers run in two and three bands, the last of them short.
@pytest.mark.parametrize("build", [shipped, plus])
@pytest.mark.parametrize(("batch", "height", "width"), [(2, 93, 131), (1, 16, 16), (2, 210, 100), (1, 97, 64)])
def test_frozen_layers_equal_the_plain_ones(
    build: Callable[[], SqueezeDet], batch: int, height: int, width: int
) -> None:
    detector, images = build(), smooth(batch, height, width)
    expected_raw, expected = gradient(detector.requires_grad_(True), images)
    raw, slope = gradient(detector.requires_grad_(False), images)
    assert raw.image_hw == expected_raw.image_hw
    for field in FIELDS:
        assert difference(getattr(raw, field), getattr(expected_raw, field)) < 1e-12
    assert slope.shape == images.shape
    assert float(expected.norm()) > 0
    assert difference(slope, expected) < 1e-12


def test_single_precision_differs_by_rounding_only() -> None:
    images = smooth(1, 120, 200)
    expected_raw, expected = gradient(shipped(), images)
    raw, slope = gradient(shipped(torch.float32), images.float())
    for field in FIELDS:
        assert difference(getattr(raw, field), getattr(expected_raw, field)) < 1e-5
    assert slope.dtype == torch.float32
    assert difference(slope, expected) < 1e-3


def test_without_gradient_the_numbers_are_the_same() -> None:
    detector, images = shipped(torch.float32), smooth(1, 64, 80, torch.float32)
    with torch.no_grad():
        without_gradient = detector(images)
    assert not without_gradient.confidence_logits.requires_grad
    differentiable = detector(images.requires_grad_(True))
    assert differentiable.confidence_logits.requires_grad
    for field in FIELDS:
        assert torch.equal(getattr(without_gradient, field), getattr(differentiable, field))


def test_a_detector_that_has_run_can_be_copied_and_pickled() -> None:
    detector, images = shipped(torch.float32), smooth(1, 48, 64, torch.float32)
    _, slope = gradient(detector, images)
    for other in (copy.deepcopy(detector), pickle.loads(pickle.dumps(detector))):
        assert torch.equal(gradient(other, images)[1], slope)
    assert torch.equal(gradient(detector, images)[1], slope)


@pytest.mark.parametrize(("batch", "height", "width"), [(1, 16, 16), (3, 40, 250), (2, 210, 33)])
def test_onednn_layouts_change_results_only_by_rounding(
    batch: int, height: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = smooth(batch, height, width, torch.float32)
    detector = shipped(torch.float32)
    raw, slope = gradient(detector, images)
    assert isinstance(detector._frozen_layers(coarse=False).first_layers.weight, OneDnnWeights)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    other = shipped(torch.float32)
    plain_raw, plain = gradient(other, images)
    assert not isinstance(other._frozen_layers(coarse=False).first_layers.weight, OneDnnWeights)
    for field in FIELDS:
        assert difference(getattr(raw, field), getattr(plain_raw, field)) < 1e-5
    assert difference(slope, plain) < 1e-4


def test_changed_weights_take_effect() -> None:
    detector, images = shipped(), smooth(1, 48, 48)
    with torch.no_grad():
        before = detector(images).confidence_logits
        detector.conv1.weight.mul_(0.5)
        after = detector(images).confidence_logits
    assert not torch.allclose(before, after)
    detector.requires_grad_(True)
    torch.testing.assert_close(after, detector(images).confidence_logits.detach())


def test_weights_get_gradients_when_they_are_to_be_trained() -> None:
    detector = shipped(torch.float32)
    detector(smooth(1, 48, 48, torch.float32))  # as an attack has it, before training goes on
    detector.requires_grad_(True).train()
    functional(detector(smooth(1, 48, 48, torch.float32))).backward()
    assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in detector.parameters())


def test_a_frozen_detector_prepares_no_gradient_of_a_weight() -> None:
    detector = shipped(torch.float32)
    raw, _ = gradient(detector, smooth(1, 48, 48, torch.float32))
    assert raw.confidence_logits.requires_grad
    assert all(p.grad is None for p in detector.parameters())


def test_bfloat16_applies_only_to_gradients_and_searches() -> None:
    coarse = load_detector("squeezedet", gradient_precision=torch.bfloat16)
    assert isinstance(coarse, SqueezeDet)
    exact, images = shipped(torch.float32), smooth(1, 120, 200, torch.float32)
    with torch.no_grad():
        assert torch.equal(coarse(images).confidence_logits, exact(images).confidence_logits)
        assert torch.equal(exact.forward_for_search(images).confidence_logits, exact(images).confidence_logits)
    raw, slope = gradient(coarse, images)
    expected_raw, expected = gradient(exact, images)
    search_predictions = coarse.forward_for_search(images)
    assert not search_predictions.confidence_logits.requires_grad
    assert torch.equal(search_predictions.confidence_logits, raw.confidence_logits)
    assert raw.boxes_xyxy.dtype == slope.dtype == torch.float32
    assert 0 < difference(raw.confidence_logits, expected_raw.confidence_logits) < 0.02
    assert float(F.cosine_similarity(slope.flatten(), expected.flatten(), dim=0)) > 0.9
