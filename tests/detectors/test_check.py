"""The contract check: a small detector passes, and each violation is named."""

import re

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from detectors.adapters.dense import DenseDetector, DensePredictions
from detectors.base import Candidates, DetectorError, predict
from detectors.check import check_detector, survey_streets
from detectors.squeezedet import SqueezeDet
from detectors.types import Detections

IMAGE_HW = (64, 96)


class CellDetector(DenseDetector):
    """A convolution over cells of 16 px, each with a box around it."""

    def __init__(self) -> None:
        super().__init__("small", ("Car", "bus"), 0.5)
        self.head = nn.Conv2d(3, 2, 16, stride=16)
        generator = torch.Generator().manual_seed(3)
        with torch.no_grad():
            self.head.weight.normal_(0, 0.2, generator=generator)

    def predict(self, images: torch.Tensor) -> DensePredictions:
        high, wide = images.shape[2:]
        cells = self.head(F.pad(images, (0, -wide % 16, 0, -high % 16)))
        rows, columns = cells.shape[2:]
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        corner = torch.stack((x, y), -1).view(1, -1, 1, 2).to(cells) * 16
        boxes = torch.cat((corner - 12, corner + 28), -1).expand(len(images), -1, -1, -1)
        return DensePredictions(boxes, cells.flatten(2).transpose(1, 2).sigmoid(), (high, wide))


class DetachedDetector(CellDetector):
    def predict(self, images):
        return super().predict(images.detach() + 0 * images)


class DoubledGradient(CellDetector):
    """A gradient of twice the length."""

    def predict(self, images):
        return super().predict(2 * images - images.detach())


class InputWriter(CellDetector):
    def predict(self, images):
        images.data[:, :, 0, 0] = 0
        return super().predict(images)


class BoxesOutside(CellDetector):
    def decode(self, raw):
        return [Detections(d.boxes_xyxy + 5, d.labels, d.scores) for d in super().decode(raw)]


class WorstFirst(CellDetector):
    def decode(self, raw):
        return [Detections(d.boxes_xyxy.flip(0), d.labels.flip(0), d.scores.flip(0)) for d in super().decode(raw)]


class OtherLabels(CellDetector):
    def decode(self, raw):
        return [Detections(d.boxes_xyxy, d.labels + 1, d.scores) for d in super().decode(raw)]


class ChangingDetector(CellDetector):
    """Other detections in each call."""

    calls = 0

    def predict(self, images):
        self.calls += 1
        return super().predict(images * (1 + 0.1 * self.calls))


class SilentDetector(CellDetector):
    def decode(self, raw):
        return [Detections(d.boxes_xyxy[:0], d.labels[:0], d.scores[:0]) for d in super().decode(raw)]


class MissingTerm(CellDetector):
    def loss(self, raw, targets):
        return {"total": super().loss(raw, targets)["total"]}


class InfiniteLoss(CellDetector):
    """A loss that is not finite."""

    def loss(self, raw, targets):
        return {name: term / 0 for name, term in super().loss(raw, targets).items()}


class OtherCandidates(CellDetector):
    """Candidates with other scores than the detections'."""

    def candidates(self, raw):
        candidates = super().candidates(raw)
        return Candidates(candidates.boxes_xyxy, candidates.log_scores - 1)


class BatchMixing(CellDetector):
    """One image affects the detections in the other."""

    def predict(self, images):
        return super().predict(images + images.mean(0, keepdim=True))


class UnfrozenDropout(CellDetector):
    """Dropout that ignores frozen weights."""

    def train(self, mode=True):
        self.shaken = mode
        return self

    def predict(self, images):
        return super().predict(images * 2 if getattr(self, "shaken", False) else images)


def test_conforming_detector_passes() -> None:
    report = check_detector(CellDetector(), IMAGE_HW)
    assert report.require() is report
    assert {finding.verdict for finding in report.findings} == {"ok"}
    assert report.gradients


@pytest.mark.parametrize(
    ("broken", "check", "detail"),
    [
        (DetachedDetector, "gradient to the image", "found zero everywhere"),
        (DoubledGradient, "gradient to the image", "against differences in float64"),
        (InputWriter, "image untouched", "expected unchanged images"),
        (BoxesOutside, "detections", "expected inside 0..95 x 0..63"),
        (WorstFirst, "detections", "expected best first"),
        (OtherLabels, "detections", "labels: expected 0..1, found 1 to 2"),
        (ChangingDetector, "deterministic", "expected identical detections"),
        (SilentDetector, "planted prediction", "expected only the injected box, found 0"),
        (MissingTerm, "loss terms", "expected total and objectness, found total"),
        (InfiniteLoss, "loss terms", "expected a finite number"),
        (OtherCandidates, "candidates", "expected every detection among them"),
        (BatchMixing, "batch as singles", "of the detections differ"),
        (UnfrozenDropout, "frozen", "differ after train()"),
    ],
)
def test_violation_is_named(broken: type[CellDetector], check: str, detail: str) -> None:
    report = check_detector(broken(), IMAGE_HW)
    found = {finding.name: finding for finding in report.failed}
    assert check in found, report
    assert detail in found[check].detail
    with pytest.raises(DetectorError, match=f"'small' violates the contract: .*{check}"):
        report.require()


def test_predictor_without_gradients() -> None:
    class PlainPredictor:
        name, classes = "told", ("Car",)

        def forward(self, images):
            return images

        def decode(self, raw):
            box = torch.tensor([[1.0, 2, 30, 40]])
            return [Detections(box, torch.tensor([0]), torch.tensor([0.5])) for _ in raw]

    report = check_detector(PlainPredictor(), IMAGE_HW)
    assert not report.failed
    assert not report.gradients
    tried = {finding.name for finding in report.findings if finding.verdict == "ok"}
    assert tried == {"name, classes, t*", "detections", "image untouched", "deterministic", "batch as singles"}


def test_custom_predictions_need_a_plant_function() -> None:
    class CustomPredictions(CellDetector):
        def predict(self, images):
            detail = super().predict(images)
            return _Plain(detail.boxes_xyxy, detail.probabilities, detail.image_hw)

    class _Plain(DensePredictions):
        inject = None

        def select(self, index):
            detail = super().select(index)
            return _Plain(detail.boxes_xyxy, detail.probabilities, detail.image_hw)

    def plant(raw, box, label):
        return DensePredictions(raw.boxes_xyxy, raw.probabilities, raw.image_hw).inject(box, label)

    def verdict(report):
        return next(f.verdict for f in report.findings if f.name == "planted prediction")

    assert verdict(check_detector(CustomPredictions(), IMAGE_HW, plant=plant)) == "ok"
    assert verdict(
        check_detector(CustomPredictions(), IMAGE_HW, plant=lambda raw, box, label: plant(raw, box + 9, label))
    ) == ("failed")


def test_squeezedet_fulfils_the_contract() -> None:
    detector = SqueezeDet()
    detector.initialise(torch.Generator().manual_seed(0))
    check_detector(detector, (64, 128)).require()


def test_frozen_weights_stay_in_eval_mode() -> None:
    detector = SqueezeDet()
    detector.train()
    assert detector.training
    detector.requires_grad_(False)
    assert not detector.training
    assert not detector.dropout.training
    assert not detector.train().training
    detector.requires_grad_(True)
    assert detector.train().dropout.training


def test_squeezedet_decodes_an_injected_prediction() -> None:
    detector = SqueezeDet()
    raw = detector(torch.full((1, 3, 64, 128), 0.5))
    box = torch.tensor([20.0, 10, 90, 50])
    (found,) = detector.decode(raw.inject(box, 2))
    assert found.labels.tolist() == [2]
    torch.testing.assert_close(found.boxes_xyxy, box[None])
    assert float(found.scores[0]) > 0.999
    assert len(predict(detector, torch.full((1, 3, 64, 128), 0.5))) == 1


class FixedDetections:
    """Finds the same number of boxes in each picture: those of the picture's number."""

    name = "fixed"

    def __init__(self, boxes: list[list[float]], scores: list[float], classes: tuple[str, ...] = ("bus", "Car")):
        self.boxes, self.scores, self.classes, self.calls = boxes, scores, classes, 0

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return images

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        boxes = torch.tensor(self.boxes).reshape(-1, 4)
        return [Detections(boxes, torch.ones(len(boxes), dtype=torch.int64), torch.tensor(self.scores))]


CAR, FAR = [10.0, 10, 60, 40], [70.0, 20, 90, 32]


@pytest.mark.parametrize(
    ("boxes", "scores", "problem"),
    [
        ([CAR, FAR], [0.9, 0.6], None),
        ([], [], r"no car with a score of 0.5 or more in 2 pictures \(no detection at all\)"),
        ([CAR], [0.4], r"no car .* in 2 pictures \(the best score of one is 0.4\)"),
        ([CAR, FAR], [3.5, 0.6], r"scores outside \[0, 1\], from 0.6 to 3.5"),
        ([CAR, FAR], [0.9, -0.1], r"scores outside \[0, 1\], from -0.1 to 0.9"),
        ([[5.0, 5, 7, 6], [9.0, 9, 11, 10]], [0.9, 0.6], "only boxes with sides below 4 px"),
        ([CAR], [0.9], r"2 times the same box, \[10.0, 10.0, 60.0, 40.0\]"),
    ],
)
def test_what_is_no_detector_of_cars(boxes: list[list[float]], scores: list[float], problem: str | None) -> None:
    streets, found = survey_streets(FixedDetections(boxes, scores), torch.zeros(2, 3, *IMAGE_HW), 0.5)
    assert len(found) == streets.pictures == 2
    assert streets.as_check.verdict == ("ok" if problem is None else "failed")
    if problem is None:
        assert (streets.boxes, streets.height_low_px, streets.height_high_px) == (4, 12, 30)
        assert (streets.score_low, streets.score_high) == (pytest.approx(0.6), pytest.approx(0.9))
    else:
        assert re.fullmatch(problem, streets.as_check.detail)


def test_no_cars_to_find_and_pictures_until_one_is_found() -> None:
    streets, _ = survey_streets(FixedDetections([CAR], [0.9], ("", "bus")), torch.zeros(2, 3, *IMAGE_HW), 0.5)
    assert streets.problem == "no class Car among , bus"
    streets, _ = survey_streets(
        FixedDetections([CAR], [0.9], ("Van", "Bus")), torch.zeros(1, 3, *IMAGE_HW), 0.5, classes=("Bus", "Van")
    )
    assert (streets.boxes, streets.problem) == (1, None)
    detector = FixedDetections([CAR, FAR], [0.9, 0.6])
    streets, _ = survey_streets(detector, torch.zeros(5, 3, *IMAGE_HW), 0.5, until_found=True)
    assert (streets.pictures, detector.calls) == (1, 1)
