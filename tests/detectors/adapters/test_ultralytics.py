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


def test_invalid_files(tmp_path: Path) -> None:
    noise = tmp_path / "noise.pt"
    noise.write_bytes(b"nothing")
    for path, found in ((noise, r"\S"), (tmp_path / "gone.pt", "none")):
        with pytest.raises(
            DetectorError, match=rf"{path.name}: expected a \.pt file of Ultralytics, found {found}"
        ):
            load_detector(f"ultralytics:{path}")
