"""Detections of the package supervision, in and out."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import supervision
import torch
from supervision.metrics import MeanAveragePrecision

from detectors.adapters.supervision import from_supervision, to_supervision
from detectors.base import DetectorError, predict
from detectors.registry import load_predictor
from detectors.types import Detections

CLASSES = ("Car", "bus")
FOUND = Detections(
    torch.tensor([[1.0, 2, 30, 40], [5, 6, 20, 22]]), torch.tensor([1, 0]), torch.tensor([0.9, 0.4])
)


def test_detections_go_out_and_come_back() -> None:
    out = to_supervision(FOUND, CLASSES)
    assert isinstance(out, supervision.Detections)
    assert out["class_name"].tolist() == ["bus", "Car"]
    back = from_supervision(out[::-1])  # sorted again
    for name in ("boxes_xyxy", "labels", "scores"):
        torch.testing.assert_close(getattr(back, name), getattr(FOUND, name), rtol=0, atol=0)


def test_no_detections_go_out_and_come_back() -> None:
    none = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    assert len(to_supervision(none, CLASSES)) == 0
    assert len(from_supervision(to_supervision(none, CLASSES))) == 0
    assert len(from_supervision(supervision.Detections.empty())) == 0


def test_supervision_draws_and_measures_what_goes_out() -> None:
    out = to_supervision(FOUND, CLASSES)
    drawn = supervision.BoxAnnotator().annotate(np.zeros((50, 60, 3), np.uint8), out)
    assert drawn[2:41, 1].any()
    assert not drawn[:, 50:].any()
    metric = MeanAveragePrecision()
    assert metric.update(out, out).compute().map50 == pytest.approx(1.0)


def test_a_function_may_return_them() -> None:

    def detect(images: torch.Tensor) -> "supervision.Detections":
        assert images.shape[:2] == (1, 3)
        return to_supervision(FOUND, CLASSES)

    (found,) = predict(load_predictor(detect, classes=CLASSES), torch.zeros(1, 3, 50, 60))
    torch.testing.assert_close(found.boxes_xyxy, FOUND.boxes_xyxy)
    torch.testing.assert_close(found.labels, FOUND.labels)


def test_detections_without_scores() -> None:
    boxes = SimpleNamespace(xyxy=np.zeros((1, 4)), class_id=np.zeros(1), confidence=None)
    expected = "from_supervision: expected xyxy, class_id and confidence, found SimpleNamespace without confidence"
    with pytest.raises(DetectorError, match=expected):
        from_supervision(boxes)
    with pytest.raises(DetectorError, match="expected boxes, scores and labels"):
        predict(load_predictor(lambda images: boxes, classes=CLASSES), torch.zeros(1, 3, 50, 60))


def test_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "supervision", None)
    with pytest.raises(DetectorError, match=r"needs supervision: pip install 'drivesem\[supervision\]'"):
        to_supervision(FOUND, CLASSES)
