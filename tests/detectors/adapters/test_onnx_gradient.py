"""Gradients of ONNX graphs: equal to ONNX Runtime's outputs, and to differences; graphs that cannot be converted."""

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from detectors.adapters import onnx_gradient
from detectors.adapters.onnx import OnnxPredictor
from detectors.adapters.onnx_gradient import BoxSuppression, OnnxDetector
from detectors.base import Detector, DetectorError, predict
from detectors.check import check_detector
from detectors.registry import load_detector, load_predictor
from detectors.types import Targets
from tools.onnx_graph import constant_graph

pytest.importorskip("onnxruntime")
SIDE = 64
NEEDED = ("onnx", "onnx2pytorch")


class Cells(nn.Module):
    """YOLOv8's output (1, 6, 64) for an image of 64 x 64: a box around each cell of 8 px, two classes."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Conv2d(3, 2, 8, stride=8)
        with torch.no_grad():
            self.head.weight.normal_(0, 0.3, generator=torch.Generator().manual_seed(1))
            self.head.bias.zero_()
        y, x = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
        centre = torch.stack((x, y)).float().view(1, 2, 64) * 8 + 4
        self.register_buffer("boxes", torch.cat((centre, torch.full_like(centre, 24.0)), 1))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return torch.cat((self.boxes, self.head(images).flatten(2).sigmoid()), 1)


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"needs {package}")
    path = tmp_path / "cells.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(Cells().eval(), (torch.zeros(1, 3, SIDE, SIDE),), str(path), dynamo=False)
    path.with_suffix(".yaml").write_text("classes: [Car, bus]\nformat: yolov8\n")
    return path


def test_a_converted_graph_fulfils_the_contract(exported: Path) -> None:
    detector = load_detector(f"onnx:{exported}")
    assert isinstance(detector, OnnxDetector)
    assert check_detector(detector, (64, 96)).require().gradients


def test_detections_are_those_of_onnx_runtime_with_tiles(exported: Path) -> None:
    detector, runtime = (load_predictor(f"{kind}:{exported}") for kind in ("onnx", "onnx-runtime"))
    assert not isinstance(runtime, Detector)
    assert isinstance(detector, OnnxDetector)
    images = torch.rand(2, 3, 128, 256, generator=torch.Generator().manual_seed(0))
    raw = detector(images)
    assert len(raw.tile_counts[0]) > 1
    for found, expected in zip(predict(detector, images), predict(runtime, images), strict=True):
        assert len(found) > 1
        assert torch.equal(found.boxes_xyxy, expected.boxes_xyxy)
        assert torch.equal(found.scores, expected.scores)
    differentiable = detector(images.clone().requires_grad_(True))
    torch.testing.assert_close(differentiable.probabilities.detach(), raw.probabilities, atol=1e-5, rtol=1e-4)


def test_gradient_equals_differences(exported: Path) -> None:
    detector = load_detector(f"onnx:{exported}")
    detector.double()
    image = torch.rand(1, 3, 128, 256, generator=torch.Generator().manual_seed(0)).double().requires_grad_(True)
    box = Targets(torch.tensor([[8.0, 8, 60, 60]]), torch.tensor([0]), torch.tensor([False]))

    def loss(pixels: torch.Tensor) -> torch.Tensor:
        return detector.loss(detector(pixels), [box])["total"]

    (slopes,) = torch.autograd.grad(loss(image), image)
    for seed in range(3):
        way = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed)).double()
        with torch.no_grad():
            difference = (loss(image + 1e-5 * way) - loss(image - 1e-5 * way)) / 2e-5
        assert float((slopes * way).sum()) == pytest.approx(float(difference), rel=1e-5)


def test_candidates_leave_out_parts_of_complete_detections(exported: Path) -> None:
    detector = load_detector(f"onnx:{exported}")
    raw = detector(torch.rand(1, 3, 128, 256, generator=torch.Generator().manual_seed(0)))
    lowered = detector.candidates(raw).log_scores < raw.probabilities[0].log() - 1e-4
    assert 0 < int(lowered.sum()) < lowered.numel()
    assert not bool(lowered[: raw.tile_counts[0][0]].any())  # the whole image is cut nowhere


def test_a_broken_torchvision_is_no_obstacle(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for name in [m for m in sys.modules if m.split(".")[0] in ("torchvision", "onnx2pytorch")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    onnx_gradient.convert_graph.cache_clear()
    assert isinstance(load_predictor(f"onnx:{exported}"), OnnxDetector)
    assert sys.modules["torchvision"] is None
    assert "torchvision.ops" not in sys.modules


def test_an_operator_that_cannot_be_converted_is_named(exported: Path) -> None:
    import onnx

    model = onnx.load(str(exported))
    next(node for node in model.graph.node if node.op_type == "Sigmoid").op_type = "Unheard"
    path = exported.with_name("odd.onnx")
    onnx.save(model, str(path))
    with pytest.raises(DetectorError, match=r"^operator Unheard cannot be converted \(.*\)$"):
        onnx_gradient.convert_graph(path, "cpu", 0, 0)


def test_a_graph_that_is_not_converted_has_no_gradient_and_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "constant.onnx"
    path.write_bytes(constant_graph((1, 3, 64, 64), {"output": np.full((1, 6, 64), 0.5)}))
    path.with_suffix(".yaml").write_text("classes: [Car, bus]\nformat: yolov8\n")

    def refuse(*_: object) -> nn.Module:
        raise DetectorError("operator Loop cannot be converted (why)")

    monkeypatch.setattr(onnx_gradient, "convert_graph", refuse)
    predictor = load_predictor(f"onnx:{path}")
    assert isinstance(predictor, OnnxPredictor)
    assert predictor.gradient_obstacle == "operator Loop cannot be converted (why)"
    with pytest.raises(DetectorError, match=r"which has none \(operator Loop cannot be converted \(why\)\)$"):
        load_detector(f"onnx:{path}")


def test_suppression_of_a_graph() -> None:
    corners = torch.tensor([[[0.0, 0, 10, 10], [10, 11, 1, 0], [20, 20, 30, 30]]])
    scores = torch.tensor([[[0.6, 0.9, 0.1], [0.1, 0.2, 0.7]]])
    expected = [[0, 0, 1], [0, 1, 2], [0, 1, 1]]
    suppress = BoxSuppression(is_centre=False)
    assert (
        suppress(corners, scores, torch.tensor([2]), torch.tensor([0.5]), torch.tensor([0.15])).tolist()
        == expected
    )
