"""torchvision's detection models behind the contract; untrained, their normalisation settled on one picture."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from detectors.base import DetectorError
from detectors.check import check_detector
from detectors.registry import load_detector

pytest.importorskip("torchvision", reason="torchvision is optional: pip install 'drivesem[torchvision]'")


@pytest.fixture
def settled(settle: Callable[[nn.Module, object], None]) -> Callable[[str], Any]:
    """Random models by name."""

    def settled(name: str) -> Any:
        torch.manual_seed(0)
        detector = load_detector(f"torchvision:{name},none")
        settle(detector, torch.rand(2, 3, 64, 96))
        return detector

    return settled


@pytest.mark.parametrize(
    "name",
    [
        "ssdlite320_mobilenet_v3_large",
        "fasterrcnn_mobilenet_v3_large_320_fpn",
        pytest.param("fcos_resnet50_fpn", marks=pytest.mark.slow),
        pytest.param("retinanet_resnet50_fpn_v2", marks=pytest.mark.slow),
        pytest.param("fasterrcnn_resnet50_fpn_v2", marks=pytest.mark.slow),
    ],
)
def test_models_fulfil_the_contract(name: str, settled: Callable[[str], Any]) -> None:
    detector = settled(name)
    detector.model.transform.min_size = (96,)
    check_detector(detector, (64, 96)).require()
    assert detector.classes[2] == "Car"
    assert len(detector.classes) == 80


def test_each_picture_keeps_to_its_own_proposals(settled: Callable[[str], Any]) -> None:
    detector = settled("fasterrcnn_mobilenet_v3_large_320_fpn")
    detector.model.transform.min_size = (96,)
    images = torch.rand(2, 3, 64, 96)
    raw = detector(images)
    few = tuple(proposals[:count] for proposals, count in zip(raw.constants, (3, 7), strict=True))
    with detector.freeze_choices(replace(raw, constants=few)):
        cut = detector(images)
    assert cut.counts == (3, 7)
    assert [cut.select(i).probabilities.shape[1] for i in (0, 1)] == [3, 7]


def test_what_is_decoded_is_what_torchvision_finds(settled: Callable[[str], Any]) -> None:
    detector = settled("ssdlite320_mobilenet_v3_large")
    image = torch.rand(3, 64, 96)
    own = detector.model([image])[0]
    (found,) = detector.decode(detector(image[None]))
    assert float(found.scores[0]) == pytest.approx(float(own["scores"].max()), rel=1e-4)
    best = own["boxes"][own["scores"].argmax()] - 0.5
    assert float((found.boxes_xyxy[0] - best).abs().max()) < 1.5  # the image's limits differ by a pixel


def test_weights_from_a_file(tmp_path: Path, settled: Callable[[str], Any]) -> None:
    detector = settled("ssdlite320_mobilenet_v3_large")
    path = tmp_path / "own.pth"
    torch.save(detector.model.state_dict(), path)
    again = load_detector(f"torchvision:ssdlite320_mobilenet_v3_large,{path}")
    image = torch.rand(1, 3, 64, 96)
    assert torch.equal(again(image).probabilities, detector(image).probabilities)
    spec = tmp_path / "own.yaml"
    spec.write_text("classes: [Car, bus]\nt_star: 0.45\n")
    with pytest.raises(DetectorError, match=r"own\.pth: expected weights of SSD, found"):
        load_detector(f"torchvision:ssdlite320_mobilenet_v3_large,{path},{spec}")
    other = load_detector(f"torchvision:ssdlite320_mobilenet_v3_large,none,{spec}")
    assert (other.classes, other.t_star) == (("Car", "bus"), 0.45)


def test_names_that_are_none() -> None:
    with pytest.raises(DetectorError, match=r"torchvision: expected one of .*fcos_resnet50_fpn.*, found 'yolo9'"):
        load_detector("torchvision:yolo9,none")
    with pytest.raises(DetectorError, match=r"gone\.pth: expected weights of SSD, found"):
        load_detector("torchvision:ssdlite320_mobilenet_v3_large,gone.pth")
