"""Planted faults: features, suppression, and gradients."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from detectors.adapters.dense import DenseDetector, DensePredictions
from detectors.base import Detector, DetectorError, predict
from detectors.check import check_detector
from detectors.planted import (
    DEPTH,
    FEATURES,
    FLOOR,
    Band,
    PlantedDetector,
    PlantedFault,
    PlantedPredictor,
    compute_features,
    group_cars,
    parse_planted_name,
    plant_fault,
)
from detectors.registry import load_detector, load_predictor
from detectors.squeezedet import SqueezeDet
from detectors.types import Detections

HW = (64, 96)


class MovingBoxes(DenseDetector):
    """Boxes of several heights in cells of 16 px that move a little with what the cell shows."""

    def __init__(self) -> None:
        super().__init__("cells", ("Car", "bus"), 0.5)
        self.head = nn.Conv2d(3, 2, 16, stride=16)
        generator = torch.Generator().manual_seed(3)
        with torch.no_grad():
            self.head.weight.normal_(0, 0.2, generator=generator)

    def predict(self, images: torch.Tensor) -> DensePredictions:
        high, wide = images.shape[2:]
        cells = self.head(F.pad(images, (0, -wide % 16, 0, -high % 16)))
        rows, columns = cells.shape[2:]
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        corner = torch.stack((x, y), -1).view(1, -1, 2).to(cells) * 16
        logits = cells.flatten(2).transpose(1, 2)
        grown = 10 + corner[..., :1] / 8 + logits[..., :1]
        boxes = torch.cat((corner - grown, corner + grown), -1)[:, :, None]
        return DensePredictions(boxes, logits.sigmoid(), (int(high), int(wide)))


def picture(seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 3, *HW, generator=generator, dtype=dtype)


def squeezedet() -> SqueezeDet:
    detector = SqueezeDet()
    detector.initialise(torch.Generator().manual_seed(0))
    detector.requires_grad_(False)
    return detector


@pytest.mark.parametrize(
    "text",
    [
        "height_px=30:38",
        "height_px=30:38,lightness=0.2:0.35",
        "aspect=1.25:1.5,depth=6,softness=0.05",
        "across=0.1:0.30000000000000004,contrast=0.01:0.02",
    ],
)
def test_text_round_trip(text: str) -> None:
    assert PlantedFault.parse(text).text == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected features among height_px, aspect, across, lightness, contrast, found ''"),
        ("weight=1:2", "found 'weight'"),
        ("aspect", "aspect: expected LOW:HIGH, two numbers in order, found nothing"),
        ("aspect=1.6", "aspect: expected LOW:HIGH, two numbers in order, found 1.6"),
        ("aspect=:2", "aspect: expected LOW:HIGH, two numbers in order, found :2"),
        ("aspect=2:1", "found 2:1"),
        ("aspect=1:inf", "found 1:inf"),
        ("aspect=1:2,aspect=3:4", "each once, found aspect, aspect"),
        ("depth=3", "at least one feature, each once, found none"),
        ("aspect=1:2,depth=no", "depth: expected a positive number, found no"),
        ("aspect=1:2,softness=0", "softness: expected a positive number, found 0"),
    ],
)
def test_invalid_faults_are_one_line_errors(text: str, message: str) -> None:
    with pytest.raises(DetectorError) as caught:
        PlantedFault.parse(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_features_by_hand() -> None:
    """A box whose paint is lighter than the rest of it, half a pixel off the grid."""
    image = torch.full((1, 3, 40, 100), 0.2)
    image[:, :, 18:24, 24:36] = 0.6
    box = torch.tensor([[[19.5, 9.5, 39.5, 29.5]]])  # columns 20 to 39, rows 10 to 29
    height, aspect, across, lightness, contrast = compute_features(image, box)[:, 0, 0].tolist()
    assert (height, aspect) == (20, 1)
    assert across == pytest.approx(0.295)
    # paint: columns 23.5 to 35.5, rows 17.5 to 24.5, of which the last row is 0.2
    assert lightness == pytest.approx((0.6 * 6 + 0.2 * 1) / 7, abs=1e-5)
    share = 72 / 400
    assert contrast == pytest.approx(0.4 * (share * (1 - share)) ** 0.5, abs=1e-3)


def test_pixels_that_an_edge_cuts_count_by_their_share() -> None:
    image = torch.zeros(1, 3, 20, 30)
    image[:, :, :, 15:] = 1
    # The paint's part is 12 of 20 px wide: columns 9.25 to 21.25 of which those from 14.5 on are white.
    (lightness,) = compute_features(image, torch.tensor([[[5.25, 0.0, 25.25, 19.0]]]), ("lightness",))[
        :, 0, 0
    ].tolist()
    assert lightness == pytest.approx((21.25 - 14.5) / 12, abs=1e-6)


def test_features_have_gradients_to_boxes_and_pixels() -> None:
    image = picture(1, torch.float64)[:, :, :16, :24].clone().requires_grad_()
    placed = torch.tensor([[[3.3, 2.2, 14.1, 12.7], [8.4, 1.6, 20.3, 14.9]]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda i, b: compute_features(i, b), (image, placed.requires_grad_()))


def test_boxes_are_cut_at_the_border() -> None:
    inside, beyond = torch.tensor([[[0.0, 0, 50, 63]]]), torch.tensor([[[-9.0, -5, 50, 80]]])
    assert torch.equal(compute_features(picture(), inside), compute_features(picture(), beyond))


def test_a_box_without_an_area_has_features() -> None:
    values = compute_features(picture(), torch.tensor([[[200.0, 10, 210, 10]]]))
    assert bool(torch.isfinite(values).all())


@settings(max_examples=40, deadline=None)
@given(low=st.floats(-5, 5), width=st.floats(0.01, 10), softness=st.floats(0.01, 0.12))
def test_outside_nothing_is_lowered_and_inside_by_the_depth(low: float, width: float, softness: float) -> None:
    fault = PlantedFault((Band("aspect", low, low + width),), softness=softness)
    reach = 10 * softness * width
    outside = torch.tensor([[low - reach, low + width + reach]], dtype=torch.float64)
    middle = torch.tensor([[low + width / 2]], dtype=torch.float64)
    assert float(fault.depth * fault.membership(outside).max()) < 1e-4
    assert float(fault.membership(middle)) > 0.78
    assert fault.contains(middle).all()
    assert not fault.contains(outside).any()


def test_two_bands_must_both_match() -> None:
    fault = PlantedFault.parse("aspect=1:2,lightness=0.2:0.4")
    values = torch.tensor([[1.5, 1.5, 3.5], [0.3, 0.9, 0.3]])
    assert fault.membership(values).tolist() == pytest.approx([0.823, 0, 0], abs=2e-3)
    assert fault.contains(values).tolist() == [True, False, False]


class FixedDetector(DenseDetector):
    """Two cars, each told of twice, and a bus on one of them; nothing of it is in the picture."""

    boxes = torch.tensor([[5.0, 5, 25, 25], [5, 5, 27, 30], [50, 5, 80, 45], [50, 7, 80, 45], [50, 5, 80, 45]])

    def __init__(self) -> None:
        super().__init__("fixed", ("Car", "bus"), 0.5)

    def predict(self, images: torch.Tensor) -> DensePredictions:
        scores = torch.tensor([[0.9, 0], [0.6, 0], [0.8, 0], [0.7, 0], [0, 0.9]]).to(images)
        count = len(images)
        return DensePredictions(self.boxes[:, None].expand(count, -1, -1, -1), scores.expand(count, -1, -1), HW)


def test_predictions_that_lie_on_each_other_are_one_car() -> None:
    cars = group_cars(FixedDetector.boxes, torch.tensor([0.9, 0.6, 0.8, 0.7, 0.01]))
    assert cars.rows.tolist() == [0, 1, 2, 3]
    assert cars.car.tolist() == [0, 0, 1, 1]
    mean = (0.81 * 25 + 0.36 * 30) / (0.81 + 0.36)
    torch.testing.assert_close(cars.boxes_xyxy[0, 3], torch.tensor(mean))
    nothing = group_cars(FixedDetector.boxes, torch.zeros(5))
    assert (len(nothing.rows), tuple(nothing.boxes_xyxy.shape)) == (0, (0, 4))
    point = group_cars(torch.tensor([[3.0, 3, 3, 3]]), torch.tensor([0.5]))
    assert point.boxes_xyxy.tolist() == [[3, 3, 3, 3]]


def test_only_predictions_of_cars_in_the_band_are_lowered() -> None:
    """The first car's mean box is 21.5 px high, its second prediction's own is 25."""
    inner = FixedDetector()
    before = inner(picture())
    after = plant_fault(inner, PlantedFault.parse("height_px=18:23,softness=0.02")).forward(picture())
    fallen = before.probabilities[0, :, 0].logit() - after.probabilities[0, :, 0].logit()
    assert fallen[:2].tolist() == pytest.approx([DEPTH, DEPTH], abs=1e-2)
    torch.testing.assert_close(after.probabilities[0, 2:], before.probabilities[0, 2:])
    assert torch.equal(after.boxes_xyxy, before.boxes_xyxy)
    (found,) = plant_fault(inner, PlantedFault.parse("height_px=18:23")).decode(after)
    assert found.labels[found.scores > 0.5].tolist() == [1, 0]


def test_a_bus_stays_in_a_car_s_band() -> None:
    inner = FixedDetector()
    after = plant_fault(inner, PlantedFault.parse("height_px=30:50,softness=0.02")).forward(picture())
    assert after.probabilities[0, :, 0].tolist() == pytest.approx([0.9, 0.6, 0.0013, 0.0008, 0], abs=1e-4)
    assert after.probabilities[0, 4, 1] == inner(picture()).probabilities[0, 4, 1]


def test_only_anchors_that_predict_cars_are_lowered() -> None:
    inner = squeezedet()
    before = inner(picture())
    after = plant_fault(inner, PlantedFault.parse("height_px=10:100,softness=0.02")).forward(picture())
    fallen = (before.confidence_logits - after.confidence_logits)[0]
    candidates = inner.candidates(before)
    counts = candidates.log_scores[:, 0].exp() >= FLOOR
    car = before.class_logits[0].argmax(-1) == 0
    assert (counts & car).any()
    assert (counts & ~car).any()
    within = fallen[counts & car]
    assert float(torch.minimum(within, (within - DEPTH).abs()).abs().quantile(0.9)) < 0.1
    assert float(within.max()) == pytest.approx(DEPTH, abs=0.1)
    assert not fallen[~(counts & car)].any()
    candidates_after = plant_fault(inner, PlantedFault.parse("aspect=1:2")).candidates(after)  # type: ignore[attr-defined]
    assert torch.equal(candidates_after.log_scores, inner.candidates(after).log_scores)


@pytest.mark.parametrize("inner", [MovingBoxes, squeezedet])
@pytest.mark.parametrize(
    "text", ["height_px=20:36,softness=0.3", "lightness=0.4:0.55,aspect=0.7:1.6,softness=0.3"]
)
def test_faulty_detector_fulfils_the_contract(inner: type[Detector], text: str) -> None:
    detector = plant_fault(inner(), PlantedFault.parse(text))
    report = check_detector(detector, HW).require()
    assert report.gradients
    tried = {finding.name for finding in report.findings if finding.verdict == "ok"}
    assert {"candidates", "gradient to the image", "planted prediction", "frozen"} <= tried


@pytest.mark.parametrize(
    "text", ["lightness=0.47:0.53", "contrast=0.2:0.25", "height_px=23:31,lightness=0.45:0.52"]
)
def test_the_gradient_is_that_of_differences(text: str) -> None:
    detector = PlantedDetector(MovingBoxes().double(), PlantedFault.parse(text)).requires_grad_(False)
    image = picture(2, torch.float64)
    live = image.clone().requires_grad_()

    def value(pixels: torch.Tensor) -> torch.Tensor:
        return detector(pixels).probabilities[..., 0].log().sum()

    (gradient,) = torch.autograd.grad(value(live), live)
    direction = torch.randn(image.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    step = 1e-6
    slope = float((value(image + step * direction) - value(image - step * direction)) / (2 * step))
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-5)
    (without,) = torch.autograd.grad(detector.inner(live).probabilities[..., 0].log().sum(), live)
    assert float((gradient - without).norm()) > 0.01 * float(without.norm())


class PlainCarPredictor:
    """A detector without gradients: one car, one bus."""

    name = "plain"
    classes: tuple[str, ...] = ("bus", "Car")

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        boxes = torch.tensor([[10.0, 10, 40, 40], [20.0, 10, 50, 40]])
        return [Detections(boxes, torch.tensor([1, 0]), torch.tensor([0.9, 0.6])) for _ in raw]


def test_predictor_without_gradients_can_have_a_fault() -> None:
    detector = plant_fault(PlainCarPredictor(), PlantedFault.parse("height_px=20:40"))
    assert isinstance(detector, PlantedPredictor)
    (found,) = predict(detector, picture())
    assert found.labels.tolist() == [0, 1]
    assert found.scores.tolist() == pytest.approx([0.6, 0.0063], abs=1e-3)
    assert not check_detector(detector, HW).require().gradients


def test_names_of_detectors_with_faults() -> None:
    assert parse_planted_name("planted:aspect=1:2") == (PlantedFault.parse("aspect=1:2"), "squeezedet")
    name = "planted:aspect=1:2@yolov3-slim"
    detector = load_detector(name)
    assert isinstance(detector, PlantedDetector)
    assert (detector.name, detector.inner.name, detector.training) == (name, "yolov3-slim", False)
    assert isinstance(load_predictor("planted:aspect=1:2"), PlantedDetector)
    for wrong, message in (("aspect=2:1", "aspect: expected LOW:HIGH"), ("aspect=1:2@no", "found 'no'")):
        with pytest.raises(DetectorError, match=message):
            load_predictor(f"planted:{wrong}")


def test_detectors_that_cannot_have_a_fault() -> None:
    class Blind(MovingBoxes):
        def __init__(self) -> None:
            super().__init__()
            self.classes = ("dog", "bus")

    class Own(MovingBoxes):
        def forward(self, images: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
            return images

    fault = PlantedFault.parse("aspect=1:2")
    with pytest.raises(DetectorError, match="expected one that knows Car"):
        plant_fault(Blind(), fault)
    with pytest.raises(DetectorError, match="raw predictions with `suppress`, found Tensor"):
        plant_fault(Own(), fault).forward(picture())


def test_every_feature_can_be_in_a_fault() -> None:
    fault = PlantedFault(tuple(Band(name, 0.0, 1.0) for name in FEATURES))
    assert fault.feature_names == FEATURES
    assert PlantedFault.parse(fault.text) == fault
