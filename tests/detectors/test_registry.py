"""Detectors by name and by file; files that are something else."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from detectors.base import DetectorError
from detectors.registry import SHIPPED, load_detector, read_weights, save_detector, write_weights
from detectors.squeezedet import ANCHOR_SIZES_WH, SqueezeDet, SqueezeDetPlus


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    detector = SqueezeDet(classes=("Car", "Truck"), t_star=0.25)
    detector.initialise(torch.Generator().manual_seed(0))
    path = tmp_path / "own.safetensors"
    save_detector(detector, path, {"note": "made for a test"})
    return path


def test_round_trip(weights: Path) -> None:
    detector = load_detector(weights)
    assert (detector.name, detector.classes, detector.t_star) == ("squeezedet", ("Car", "Truck"), 0.25)
    assert not detector.training
    assert not any(p.requires_grad for p in detector.parameters())
    weight = detector.get_parameter("convdet.weight")
    assert weight.dtype == torch.float32
    assert weight.is_contiguous(memory_format=torch.channels_last)
    expected = SqueezeDet(classes=("Car", "Truck"))
    expected.initialise(torch.Generator().manual_seed(0))
    assert torch.equal(weight, expected.convdet.weight.half().float())
    assert weights.stat().st_size < 5e6
    assert [p.name for p in weights.parent.iterdir()] == ["own.safetensors"]


@pytest.mark.parametrize("kind", [SqueezeDet, SqueezeDetPlus])
def test_anchors_and_layout_travel_with_the_weights(kind: type[SqueezeDet], tmp_path: Path) -> None:
    detector = kind(anchors=[(40.0, 30.0), (90.5, 61.25)]).eval()
    detector.initialise(torch.Generator().manual_seed(0))
    save_detector(detector, tmp_path / "own.safetensors")
    loaded = load_detector(tmp_path / "own.safetensors")
    assert type(loaded) is kind
    assert loaded.anchors == ((40.0, 30.0), (90.5, 61.25))
    with torch.no_grad():
        assert loaded(torch.rand(1, 3, 32, 48)).boxes_xyxy.shape == (1, 2 * 2 * 3, 4)


def test_anchors_in_metadata_that_are_none(weights: Path) -> None:
    for bad in ("[[1, 2, 3]]", "[]", "[[5, -1]]", '"none"', "7", "{"):
        rewrite(weights, state(), {"anchors": bad})
        with pytest.raises(DetectorError, match=r"own\.safetensors: expected metadata .* anchors \(pairs, px\)"):
            load_detector(weights)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(
        DetectorError,
        match=r"detector: expected one of squeezedet, yolov3-slim or a path\.safetensors, found 'yolo9'",
    ):
        load_detector("yolo9")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DetectorError, match=r"gone\.safetensors: expected a weights file, found none"):
        load_detector(tmp_path / "gone.safetensors")


def test_damaged_file(tmp_path: Path) -> None:
    path = tmp_path / "noise.safetensors"
    path.write_bytes(b"this is no safetensors file, whatever its name says")
    with pytest.raises(DetectorError, match=r"noise\.safetensors: expected a safetensors file, found"):
        load_detector(path)


def rewrite(weights: Path, tensors: dict[str, torch.Tensor], metadata: dict[str, str]) -> None:
    save_file(tensors, weights, metadata)


def state() -> dict[str, torch.Tensor]:
    return {k: v.contiguous() for k, v in SqueezeDet().state_dict().items()}


def test_other_architecture(weights: Path) -> None:
    rewrite(weights, {"backbone.0.weight": torch.zeros(2), "head.bias": torch.zeros(1)}, {})
    with pytest.raises(DetectorError) as caught:
        load_detector(weights)
    message = str(caught.value)
    assert "\n" not in message
    assert "own.safetensors: expected the 64 tensors of squeezedet, found 64 missing (conv1.bias, ...)" in message
    assert "2 unexpected (backbone.0.weight, ...)" in message
    rewrite(weights, state(), {"architecture": "resnet"})
    with pytest.raises(DetectorError, match=r"expected architecture .*squeezedet.*, found 'resnet'"):
        load_detector(weights)


def test_other_shapes_and_values(weights: Path) -> None:
    rewrite(weights, state(), {"classes": '["Car"]'})
    with pytest.raises(DetectorError, match=r"convdet\.\w+: expected shape \(54,.* of squeezedet with 1 classes"):
        load_detector(weights)
    broken = state()
    broken["conv1.bias"][3] = float("nan")
    rewrite(weights, broken, {})
    with pytest.raises(DetectorError, match=r"conv1\.bias: expected finite numbers"):
        load_detector(weights)
    for wrong in ({"t_star": "high"}, {"classes": "3"}, {"classes": "Car"}):
        rewrite(weights, state(), wrong)
        with pytest.raises(DetectorError, match="expected metadata classes"):
            load_detector(weights)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_detector_is_whole(name: str) -> None:
    detector = load_detector(name)
    assert detector.name == name
    assert detector.classes == ("Car", "Truck", "Pedestrian", "Cyclist")
    assert 0.05 < detector.t_star < 0.99
    assert f"t* = {detector.t_star:.3f}" in SHIPPED[name].with_suffix(".md").read_text()
    if isinstance(detector, SqueezeDet):
        assert detector.anchors == ANCHOR_SIZES_WH


def test_the_same_weights_give_the_same_bytes(tmp_path: Path) -> None:
    facts = dict.fromkeys("zyxwvutsrq", "größer")
    tensors = {"a": torch.arange(5.0), "b.c": torch.ones(3, 2, dtype=torch.float16)}
    for i in range(6):
        write_weights(tmp_path / f"{i}.safetensors", facts, tensors)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    found, read = read_weights(tmp_path / "0.safetensors")
    assert found == facts
    assert all(torch.equal(read[name], tensor) for name, tensor in tensors.items())
