"""TorchScript and torch.export files and user classes as differentiable detectors; invalid files."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from torch import nn

from detectors.adapters.network import GradientFreePredictor, NetworkDetector
from detectors.base import DetectorError, explain_missing_gradient, predict
from detectors.check import check_detector
from detectors.planted import PlantedDetector, PlantedFault
from detectors.registry import load_detector, load_predictor
from detectors.types import Targets
from drivesem.run.probes import gradient
from drivesem.scenes.scene import demo_scene
from scene_ir.errors import RangeError

DOCS = Path(__file__).resolve().parents[3] / "docs" / "guide" / "detector.md"
SIDE = 64
CLASSES = "[Car, bus, person]"


class TinyNetwork(nn.Module):
    """YOLOv8's output for an image of 64 x 64: a box of 24 px around each cell of 8 px."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Conv2d(3, 3, 8, stride=8)
        with torch.no_grad():
            self.head.weight.normal_(0, 0.3, generator=torch.Generator().manual_seed(1))
            self.head.bias.zero_()
        y, x = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
        centre = torch.stack((x, y)).float().view(1, 2, 64) * 8 + 4
        self.register_buffer("boxes", torch.cat((centre, torch.full_like(centre, 24.0)), 1))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return torch.cat((self.boxes, self.head(images).flatten(2).sigmoid()), 1)


class SuppressingNetwork(nn.Module):
    """Suppresses by itself: a box of 32 px around each dark cell of 16 px, in torchvision's way."""

    def __init__(self) -> None:
        super().__init__()
        self.contrast = nn.Parameter(torch.tensor(12.0))

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        light = nn.functional.avg_pool2d(images.mean(1, keepdim=True), 16)
        y, x = torch.meshgrid(*(torch.arange(side) for side in light.shape[2:]), indexing="ij")
        corner = torch.stack((x, y), -1).reshape(-1, 2).to(light) * 16
        scores = (self.contrast * (0.5 - light.flatten())).sigmoid()
        dark = scores > 0.5
        return torch.cat((corner - 8, corner + 24), -1)[dark], torch.zeros(int(dark.sum())).long(), scores[dark]


@pytest.fixture
def scripted(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.pt"
    with warnings.catch_warnings():
        # torch deprecates the writing of TorchScript; files of it stay
        for kind in (DeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", kind)
        torch.jit.script(TinyNetwork().eval()).save(str(path))
    path.with_suffix(".yaml").write_text(f"size: {SIDE}\nclasses: {CLASSES}\nt_star: 0.4\n")
    return path


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "exported.pt2"
    torch.export.save(torch.export.export(TinyNetwork().eval(), (torch.zeros(1, 3, SIDE, SIDE),)), path)
    path.with_suffix(".yaml").write_text(f"classes: {CLASSES}\nt_star: 0.4\n")
    return path


def test_torchscript_file_fulfils_the_contract(scripted: Path) -> None:
    detector = load_detector(f"torchscript:{scripted}")
    assert (detector.name, detector.classes, detector.t_star) == ("tiny", ("Car", "bus", "person"), 0.4)
    assert check_detector(detector, (64, 96)).require().gradients


def test_exported_program_fulfils_the_contract(program: Path) -> None:
    detector = load_detector(f"export:{program}")
    assert detector.classes == ("Car", "bus", "person")
    assert check_detector(detector, (64, 96)).require().gradients


def test_predictions_are_the_networks(scripted: Path, program: Path) -> None:
    image = torch.rand(1, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    raw = TinyNetwork()(image)
    for name in (f"torchscript:{scripted}", f"export:{program}"):
        raw_detections = load_detector(name)(image)
        torch.testing.assert_close(raw_detections.probabilities, raw[:, 4:].transpose(1, 2))
        # pixel centres lie at integers, the network counts from the corner
        torch.testing.assert_close(raw_detections.boxes_xyxy[0, 0, 0], torch.tensor([-8.5, -8.5, 15.5, 15.5]))


def test_settings_file_as_argument(scripted: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.yml"
    other.write_text(f"size: {SIDE}\nclasses: [a, b, c]\n")
    assert load_predictor(f"torchscript:{scripted},{other}").classes == ("a", "b", "c")


def test_invalid_files(tmp_path: Path, scripted: Path) -> None:
    noise = tmp_path / "noise.pt"
    noise.write_bytes(b"no network")
    for kind, what in (("torchscript", "a TorchScript file"), ("export", "a program of torch.export")):
        with pytest.raises(DetectorError, match=rf"noise\.pt: expected {what}, found \S"):
            load_detector(f"{kind}:{noise}")
        with pytest.raises(DetectorError, match=rf"gone\.pt: expected {what}, found none"):
            load_detector(f"{kind}:{tmp_path / 'gone.pt'}")
    scripted.with_suffix(".yaml").write_text(f"size: 72\nclasses: {CLASSES}\n")
    with pytest.raises(DetectorError, match=r"tiny\.pt: expected a network that takes an image of 72 x 72 px"):
        load_detector(f"torchscript:{scripted}")
    for name in ("torchscript:", f"torchscript:{scripted},more", "torchvision:a,b,c"):
        with pytest.raises(DetectorError, match=r"detector: expected torch\w+:WHAT"):
            load_detector(name)
    with pytest.raises(DetectorError, match="expected float32 for its gradients"):
        load_detector(f"torchscript:{scripted}", gradient_precision=torch.bfloat16)


@pytest.fixture
def documented(tmp_path: Path) -> Path:
    """The class that the docs show."""
    documented_code = re.search(
        r"my_detector\.py\"\)\.write_text\('''\n(.*?)'''\)", DOCS.read_text(encoding="utf-8"), re.DOTALL
    )
    assert documented_code is not None
    assert len(documented_code[1].splitlines()) <= 30
    path = tmp_path / "my_detector.py"
    path.write_text(documented_code[1])
    return path


def test_documented_class_fulfils_the_contract(documented: Path) -> None:
    detector = load_detector(f"module:{documented}:Blobs")
    assert detector.classes == ("Car", "Pedestrian")
    assert not any(parameter.requires_grad for parameter in detector.parameters())
    check_detector(detector, (64, 96)).require()
    dark = torch.full((1, 3, 64, 96), 0.9)
    dark[:, :, 16:32, 32:64] = 0.1
    found = predict(detector, dark)[0]
    assert len(found)
    centre = (found.boxes_xyxy[0, :2] + found.boxes_xyxy[0, 2:]) / 2
    assert 32 <= float(centre[0]) <= 64
    assert 16 <= float(centre[1]) <= 32


def test_images_of_a_batch_are_independent_with_built_in_suppression() -> None:
    settings = {"classes": ("Car", "person"), "multiple": 16, "format": "torchvision"}
    detector = NetworkDetector("choosing", SuppressingNetwork(), settings).requires_grad_(False)
    light, dark = (
        torch.linspace(0.3, 0.9, 64).expand(1, 3, 64, 64),
        torch.linspace(0, 0.4, 64).expand(1, 3, 64, 64),
    )
    pictures = torch.cat((light, dark, torch.ones_like(light)))
    raw = detector(pictures)
    assert raw.counts == (4, 16, 0)
    box = Targets(torch.tensor([[8.0, 8, 40, 40]]), torch.tensor([0]), torch.tensor([False]))
    faulty = PlantedDetector(detector, PlantedFault.parse("height_px=20:40")).requires_grad_(False)
    lowered = faulty(pictures)
    for image, picture in enumerate(pictures):
        alone = detector(picture[None])
        assert torch.equal(raw.select(image).probabilities, alone.probabilities)
        assert torch.equal(detector.loss(raw.select(image), [box])["total"], detector.loss(alone, [box])["total"])
        assert torch.equal(lowered.select(image).probabilities, faulty(picture[None]).probabilities)
    assert float(lowered.probabilities.max()) < float(raw.probabilities.max())
    check_detector(detector, (64, 96)).require()


def test_a_class_of_an_installed_module() -> None:
    assert load_detector("module:detectors.squeezedet:SqueezeDet").name == "squeezedet"


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("module:detectors.squeezedet", "module: expected FILE.py:CLASS or PACKAGE.MODULE:CLASS"),
        ("module:detectors.gone:Net", "module: expected a module detectors.gone"),
        ("module:gone.py:Net", "gone.py: expected a Python file, found none"),
        ("module:detectors.squeezedet:Gone", "expected a class Gone, found NoneType"),
        ("module:pathlib:Path", "expected a Detector or a torch.nn.Module, found PosixPath"),
    ],
)
def test_invalid_class_names(place: str, message: str) -> None:
    with pytest.raises(DetectorError, match=message):
        load_detector(place)


def test_missing_library_names_the_install_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import sys

    for library, name, advice in (
        ("torchvision", "fcos_resnet50_fpn,none", "drivesem doctor"),
        ("ultralytics", str(tmp_path / "a.pt"), r"pip install 'drivesem\[ultralytics\]'"),
        ("transformers", str(tmp_path), r"pip install 'drivesem\[transformers\]'"),
    ):
        for module in [m for m in sys.modules if m.split(".")[0] == library]:
            monkeypatch.delitem(sys.modules, module)
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(DetectorError, match=advice):
            load_detector(f"{'hf' if library == 'transformers' else library}:{name}")


class NormalisedNetwork(TinyNetwork):
    """The same, with boxes along a row, as transformers make them of a batch normalisation."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(3)
        with torch.no_grad():
            self.norm.running_var.copy_(torch.tensor([0.5, 2.0, 4.0]))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        rows = self.norm(self.head(images)).flatten(2).permute(0, 2, 1)
        return torch.cat((self.boxes.permute(0, 2, 1), rows.sigmoid()), 2)


@pytest.mark.parametrize("kind", ["module", "torchscript", "export"])
def test_gradient_through_batch_normalisation_equals_differences(kind: str, tmp_path: Path) -> None:
    network, image = NormalisedNetwork().eval(), torch.zeros(1, 3, SIDE, SIDE)
    settings = f"size: {SIDE}\nclasses: {CLASSES}\nformat: yolov8\n"
    (tmp_path / "net.yaml").write_text(settings)
    if kind == "module":
        network.spec = yaml.safe_load(settings)
        detector = load_predictor(network)
    else:
        path = tmp_path / ("net.pt2" if kind == "export" else "net.pt")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if kind == "export":
                torch.export.save(torch.export.export(network, (image,)), path)
            else:
                torch.jit.trace(network, image).save(str(path))
        detector = load_detector(f"{kind}:{path}")
    assert isinstance(detector, NetworkDetector)
    check_detector(detector, (SIDE, SIDE)).require()


class NumpyNetwork(TinyNetwork):
    """The same by numpy: without a gradient."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(super().forward(torch.from_numpy(images.numpy())).detach().numpy())


@pytest.mark.parametrize("forward", [NumpyNetwork.forward, torch.no_grad()(TinyNetwork.forward)])
def test_a_module_without_a_gradient_is_a_predictor(forward: Callable[..., torch.Tensor]) -> None:
    network = type("Forward", (NumpyNetwork,), {"forward": forward})()
    network.spec = {"size": SIDE, "classes": ["Car", "bus", "person"]}
    plain = TinyNetwork()
    plain.spec = network.spec
    loaded, expected = load_predictor(network), load_predictor(plain)
    assert isinstance(loaded, GradientFreePredictor)
    assert isinstance(expected, NetworkDetector)
    image = torch.rand(1, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    found, same = predict(loaded, image)[0], predict(expected, image)[0]
    assert len(found)
    assert torch.equal(found.scores, same.scores)
    assert explain_missing_gradient(loaded) == f" ({loaded.gradient_obstacle})"
    with pytest.raises(RangeError, match=r"one with a gradient, found Forward \(its outputs do not depend"):
        gradient(demo_scene(0), loaded)
