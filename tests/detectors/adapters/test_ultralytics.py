"""A detector of the Ultralytics package behind the contract; untrained, as its own file."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from detectors.base import DetectorError
from detectors.check import check_detector
from detectors.registry import load_detector

ultralytics = pytest.importorskip(
    "ultralytics", reason="Ultralytics is optional: pip install 'drivesem[ultralytics]'"
)


@pytest.fixture
def weights(tmp_path: Path, settle: Callable[[nn.Module, object], None]) -> Path:
    torch.manual_seed(0)
    path = tmp_path / "yolov8n.pt"
    yolo = ultralytics.YOLO("yolov8n.yaml")
    settle(yolo.model, torch.rand(2, 3, 64, 96))
    yolo.save(str(path))
    return path


def test_model_fulfils_the_contract(weights: Path) -> None:
    detector = load_detector(f"ultralytics:{weights}")
    assert len(detector.classes) == 80
    check_detector(detector, (64, 96)).require()


SMALL_RTDETR = """
nc: 3
backbone:
  - [-1, 1, Conv, [16, 3, 4]]
  - [-1, 1, Conv, [32, 3, 2]]
  - [-1, 1, Conv, [32, 3, 2]]
  - [-1, 1, Conv, [32, 3, 2]]
head:
  - [[1, 2, 3], 1, RTDETRDecoder, [nc, 32, 40, 4, 4, 2, 64]]
"""
"""40 queries of 32 numbers, two layers of a decoder."""


def test_boxes_of_rtdetr_are_those_of_the_library(
    tmp_path: Path, settle: Callable[[nn.Module, object], None]
) -> None:
    from ultralytics.models.rtdetr.predict import RTDETRPredictor

    torch.manual_seed(0)
    path, side = tmp_path / "small.pt", 128
    path.with_suffix(".yaml").write_text(SMALL_RTDETR)
    model = ultralytics.RTDETR(str(path.with_suffix(".yaml")))
    settle(model.model, torch.rand(2, 3, side, side))
    with torch.no_grad():
        for name, parameter in model.model.named_parameters():  # a fresh one predicts nearly the same everywhere
            if "head" in name:
                parameter.add_(0.2 * torch.randn_like(parameter))
    model.save(str(path))  # in half precision
    model = ultralytics.RTDETR(str(path))
    path.with_suffix(".yaml").write_text(f"size: {side}\n")
    detector = load_detector(f"ultralytics:{path}")
    image = (torch.rand(1, 3, side, side) * 255).byte()
    pixels = image.float() / 255
    predictor = RTDETRPredictor(overrides={"conf": 0.0, "max_det": 1000})
    predictor.model, predictor.batch = model.model, (["image"],)
    with torch.no_grad():
        (expected,) = predictor.postprocess(
            model.model.eval()(pixels), pixels, [image[0].permute(1, 2, 0).numpy()]
        )
        raw = detector(pixels)
    assert len(expected.boxes) == 40
    for *box, score, label in expected.boxes.data.tolist():
        # pixel centres lie at integers, the library counts from the corner
        distance = (raw.boxes_xyxy[0, :, 0] + 0.5 - torch.tensor(box)).abs().amax(1)
        off = (raw.probabilities[0, :, int(label)] - score).abs()
        assert float((distance / 100 + off).min()) < 1e-3
    check_detector(detector, (96, side)).require()


def test_invalid_files(tmp_path: Path) -> None:
    noise = tmp_path / "noise.pt"
    noise.write_bytes(b"nothing")
    for path, found in ((noise, r"\S"), (tmp_path / "gone.pt", "none")):
        with pytest.raises(
            DetectorError, match=rf"{path.name}: expected a \.pt file of Ultralytics, found {found}"
        ):
            load_detector(f"ultralytics:{path}")
