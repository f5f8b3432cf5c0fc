"""Detectors by name and by file; files that are something else."""

import json
import re
import resource
import zipfile
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from detectors import registry
from detectors.base import DetectorError
from detectors.files import read_state
from detectors.registry import SHIPPED, load_detector, load_predictor, read_weights, save_detector, write_weights
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
        match=r"detector: expected squeezedet, yolov3-slim, a path\.safetensors, or a name with prefix darknet:, "
        r".*, module:, maite:, ensemble: or planted:, found 'yolo9'$",
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


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_are_those_of_their_card(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, card = SHIPPED[name].read_bytes(), SHIPPED[name].with_suffix(".md").read_text()
    path = tmp_path / "own.safetensors"
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    path.with_suffix(".md").write_text(card)
    monkeypatch.setitem(SHIPPED, name, path)
    with pytest.raises(
        DetectorError, match=r"own\.safetensors: expected the SHA-256 of own\.md, [0-9a-f]{64}, found"
    ):
        load_detector(name)
    path.write_bytes(data)
    load_detector(name)
    path.with_suffix(".md").write_text("# nothing\n")
    with pytest.raises(DetectorError, match="which the card lacks"):
        load_detector(name)


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"classes": json.dumps(["a"] * 10_001)}, "classes: expected 1 to 10000, found 10001"),
        ({"classes": "[]"}, "classes: expected 1 to 10000, found 0"),
        ({"classes": "[1, 2]"}, "classes: expected a list of names"),
        ({"classes": '{"a": 1}'}, "classes: expected a list of names"),
        ({"classes": json.dumps([f"c{i}" for i in range(10_000)])}, "convdet.bias: expected shape (10005000,)"),
    ],
)
def test_weights_that_claim_much(facts: dict[str, str], message: str, weights: Path) -> None:
    """Nothing is made of what they say before it is known that the file fills it: the last would take 277 GB."""
    metadata, tensors = read_weights(weights)
    rewrite(weights, tensors, metadata | facts | {"anchors": json.dumps([[10, 10]] * 1000)})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DetectorError, match=re.escape(message)):
        load_detector(weights)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


def test_a_state_is_read_without_code_and_without_bombs(tmp_path: Path) -> None:
    path = tmp_path / "a.pth"
    torch.save({"weight": torch.ones(4)}, path)
    assert torch.equal(read_state(path, "weights")["weight"], torch.ones(4))
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, bytes(64 << 20) if "/data/" in name else data)
    with pytest.raises(
        DetectorError, match=r"a\.pth: expected weights, found parts of 67,\d+,\d+ bytes in a file of"
    ):
        read_state(path, "weights")
    torch.save({"weight": Path("a")}, path)
    with pytest.raises(
        DetectorError, match=r"a\.pth: expected weights, found more than .* \(Unsupported global: [^.]*path"
    ):
        read_state(path, "weights")
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(DetectorError, match=r"a\.pth: expected weights, found no regular file"):
        read_state(path, "weights")


def test_a_file_with_a_comma_in_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "a,b"
    folder.mkdir()
    path, spec = folder / "own,1.py", folder / "own,1.yaml"
    path.write_text(
        "import torch\n\nclass Own(torch.nn.Module):\n    def forward(self, images):\n"
        "        return torch.zeros(1, 6, 40) + images.mean()\n"
    )
    spec.write_text("classes: [Car, bus]\n")
    assert load_predictor(f"module:{path}:Own,{spec}").classes == ("Car", "bus")
    with pytest.raises(DetectorError, match=r"a,b/none\.onnx"):
        load_predictor(f"onnx:{folder}/none.onnx")


@pytest.mark.parametrize(
    ("text", "arguments", "spec"),
    [
        ("onnx:a,b/net,1.onnx", ["a,b/net,1.onnx"], None),
        ("onnx:a,b/net,1.onnx,a,b/net,1.yaml", ["a,b/net,1.onnx"], "a,b/net,1.yaml"),
        ("onnx:a,b/net,1.onnx,gone.yaml", ["a,b/net,1.onnx"], "gone.yaml"),
        ("hf:a,b", ["a,b"], None),
        ("hf:a,b,a,b/net,1.yaml", ["a,b"], "a,b/net,1.yaml"),
        ("hf:facebook/detr", ["facebook/detr"], None),
        ("torchvision:fcos,a,b/net,1.onnx", ["fcos", "a,b/net,1.onnx"], None),
        ("torchvision:fcos,a,b/net,1.onnx,a,b/net,1.yaml", ["fcos", "a,b/net,1.onnx"], "a,b/net,1.yaml"),
        ("torchvision:fcos,net.yaml", ["fcos"], "net.yaml"),
        ("torchvision:fcos,none,net.yaml", ["fcos", "none"], "net.yaml"),
        ("torchvision:fcos", ["fcos"], None),
    ],
)
def test_commas_in_detectors(
    text: str, arguments: list[str], spec: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a,b").mkdir()
    for name in ("a,b/net,1.onnx", "a,b/net,1.yaml", "net.yaml"):
        Path(name).touch()
    kind, _, rest = text.partition(":")
    assert registry._split_arguments(kind, rest) == (arguments, None if spec is None else Path(spec))


@pytest.mark.parametrize(
    "text", ["onnx:a,b.onnx", "hf:a,b", "torchvision:a,b,c,d.pth", "ultralytics:a,b.pt", "onnx:"]
)
def test_commas_between_files_that_do_not_exist(text: str) -> None:
    with pytest.raises(DetectorError, match=r"detector: expected \w+:WHAT(\[,WEIGHTS\])?\[,SPEC\.yaml\], found '"):
        load_predictor(text)
