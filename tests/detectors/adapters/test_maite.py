"""MAITE models as detectors, and detectors as MAITE models."""

import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from detectors.adapters.maite import MaiteModel
from detectors.base import Detector, DetectorError, Predictor, predict
from detectors.registry import find_code_to_run, load_detector, load_predictor
from drivesem.cli import main
from drivesem.synth.demo import demo_scene

FILE = '''
import numpy as np
from types import SimpleNamespace
from detectors.adapters.maite import MaiteModel
from detectors.registry import load_detector


class Foreign:
    """A MAITE model with COCO-like numbers and a score for each of them."""

    metadata = {"id": "foreign", "index2label": {0: "__background__", 1: "person", 3: "car", 4: "N/A", 5: "N/A"}}

    def __init__(self):
        self.model = MaiteModel(load_detector("squeezedet"))

    def __call__(self, batch):
        targets = []
        for found in self.model(batch):
            cars = found.labels == 0
            scores = np.zeros((cars.sum(), 6), np.float32)
            scores[:, 3] = found.scores[cars]
            targets.append(SimpleNamespace(boxes=found.boxes[cars], labels=np.full(cars.sum(), 3), scores=scores))
        return targets


class WithoutMetadata:
    def __call__(self, batch):
        return []


class WithoutScores:
    metadata = {"id": "without", "index2label": {0: "car"}}

    def __call__(self, batch):
        return [SimpleNamespace(boxes=np.zeros((0, 4)), labels=np.zeros(0)) for _ in batch]


class Faulty(WithoutScores):
    def __call__(self, batch):
        return batch[0].no_such_attribute


def make():
    return Foreign()


model = Foreign()
number = 3
'''


@pytest.fixture(scope="module")
def picture() -> torch.Tensor:
    """An embedded street (3, H, W) in [0, 1], whole 255ths."""
    return (demo_scene(0, 0).photograph * 255).round() / 255


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_detector("squeezedet")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "foreign.py"
    path.write_text(FILE)
    return path


class Recorder:
    """A MAITE model that finds nothing and records what it gets."""

    def __init__(self, spec: dict[str, Any] | None = None, **metadata: Any) -> None:
        self.metadata = {"id": "recorder", "index2label": {0: "car"}} | metadata
        self.spec = spec or {}
        self.batch: Sequence[np.ndarray] = ()

    def __call__(self, batch: Sequence[np.ndarray]) -> list[SimpleNamespace]:
        self.batch = batch
        return [SimpleNamespace(boxes=np.empty(0), labels=np.empty(0), scores=np.empty(0)) for _ in batch]


def detect(predictor: Predictor, picture: torch.Tensor) -> Any:
    return predict(predictor, picture[None])[0]


def test_a_detector_is_a_maite_model(detector: Detector, picture: torch.Tensor) -> None:
    protocols = pytest.importorskip("maite.protocols.object_detection")
    model = MaiteModel(detector)
    assert isinstance(model, protocols.Model)
    assert model.metadata == {"id": "squeezedet", "index2label": dict(enumerate(detector.classes))}
    whole_numbers = (picture * 255).round().to(torch.uint8)
    found = detect(detector, picture)
    for image in (picture, picture.numpy(), whole_numbers, whole_numbers.numpy()[:, ::1], list(picture.numpy())):
        (target,) = model([image])
        np.testing.assert_array_equal(target.boxes, found.boxes_xyxy)
        np.testing.assert_array_equal(target.labels, found.labels)
        np.testing.assert_array_equal(target.scores, found.scores)
    assert load_predictor(model) is detector  # its gradient remains


@pytest.mark.parametrize(
    ("image", "found"),
    [
        (np.zeros((4, 6, 3), np.uint8), r"\(4, 6, 3\) of torch.uint8"),
        (np.full((3, 4, 6), 255.0), r"of torch.float64, from 255 to 255"),
        (np.full((3, 4, 6), -0.5, np.float32), "from -0.5 to -0.5"),
        (np.full((3, 4, 6), 300), "from 300 to 300"),
        (np.full((3, 4, 6), np.nan, np.float32), "from nan to nan"),
        (np.zeros((4, 6), np.uint8), r"\(4, 6\)"),
    ],
)
def test_a_maite_model_refuses_other_images(detector: Detector, image: np.ndarray, found: str) -> None:
    expected = (
        r"MAITE image: expected an image \(3, H, W\) of whole numbers from 0 to 255, or floats in \[0, 1\], found "
    )
    with pytest.raises(DetectorError, match=expected + ".*" + found):
        MaiteModel(detector)([image])


def test_a_maite_model_takes_the_numbers_of_a_data_set(detector: Detector, picture: torch.Tensor) -> None:
    found = detect(detector, picture)
    trucks = found.labels == detector.classes.index("Truck")
    assert 0 < int(trucks.sum()) < len(found)
    (target,) = MaiteModel(detector, {7: "Truck", 9: "Tram"})([picture])
    np.testing.assert_array_equal(target.boxes, found.boxes_xyxy[trucks])
    assert set(target.labels.tolist()) == {7}
    with pytest.raises(DetectorError, match=r"index2label: expected classes among Car, Truck, .*, found Tram"):
        MaiteModel(detector, {9: "Tram"})


@pytest.mark.parametrize("name", ["Foreign", "make", "model"])
def test_a_maite_model_is_a_detector(name: str, file: Path, detector: Detector, picture: torch.Tensor) -> None:
    """A class, a function and a model; with gaps in the numbers, names that are no class, and a score per class."""
    loaded = load_predictor(f"maite:{file}:{name}")
    assert (loaded.name, loaded.classes) == ("foreign", ("person", "Car"))
    found, wanted = detect(loaded, picture), detect(detector, picture)
    cars = wanted.labels == detector.classes.index("Car")
    torch.testing.assert_close(found.boxes_xyxy, wanted.boxes_xyxy[cars], rtol=0, atol=0)
    torch.testing.assert_close(found.scores, wanted.scores[cars], rtol=0, atol=0)
    assert set(found.labels.tolist()) == {1}


def test_settings_of_what_a_maite_model_gets(tmp_path: Path, picture: torch.Tensor) -> None:
    model = Recorder()
    detect(load_predictor(model), picture)
    assert model.batch[0].dtype == np.float32
    np.testing.assert_array_equal(model.batch[0], picture)
    model = Recorder({"scale": 255, "channels": "bgr", "t_star": 0.6})
    loaded = load_predictor(model)
    assert getattr(loaded, "t_star", None) == 0.6
    detect(loaded, picture)
    assert model.batch[0].dtype == np.uint8
    np.testing.assert_array_equal(model.batch[0], (picture.flip(0) * 255).round())
    model = Recorder({"scale": 255, "mean": 10, "std": 2})
    detect(load_predictor(model), picture)
    np.testing.assert_allclose(model.batch[0], (picture * 255 - 10) / 2, rtol=1e-5)


def test_class_names_may_come_with_the_call() -> None:
    assert load_predictor(Recorder(index2label=None), classes=["Car", "bus"]).classes == ("Car", "bus")


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            SimpleNamespace(metadata={"id": "x", "index2label": {0: "car"}}),
            "detector: expected .*, a MAITE model or a function of images, found SimpleNamespace",
        ),
        (
            Recorder(index2label=None),
            r"detector recorder: expected class names, metadata\['index2label'\], or `classes`, found none$",
        ),
        (Recorder(index2label=["car"]), r"or `classes`, found \['car'\]$"),
        (
            Recorder(index2label={"a": "car"}),
            r"metadata\['index2label'\]: expected whole numbers from 0 to 9999, found",
        ),
        (Recorder(index2label={-1: "car"}), r"expected whole numbers from 0 to 9999, found \[-1\]"),
        (Recorder(index2label={0: "car", 1: "car"}), r"index2label'\]: classes: expected .* each once, found"),
        (Recorder({"size": 640}), "detector recorder: size: expected one of channels, classes, .*, found another"),
        (Recorder({"scale": -1}), "detector recorder: spec: scale: expected a positive number, found -1"),
    ],
)
def test_objects_without_what_the_protocol_requires(model: Any, message: str) -> None:
    with pytest.raises(DetectorError, match=message) as caught:
        load_predictor(model)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (SimpleNamespace(boxes=np.zeros((1, 4))), "found SimpleNamespace without scores and labels$"),
        (None, "found NoneType without boxes and scores and labels$"),
        (
            SimpleNamespace(boxes=np.zeros((2, 4)), scores=np.zeros(1), labels=np.zeros(1)),
            r"expected boxes \(M, 4\) px, scores \(M,\) in \[0, 1\] and labels \(M,\) below 1, found \(2, 4\)",
        ),
        (SimpleNamespace(boxes=np.zeros((1, 4)), scores=np.full(1, 2.0), labels=np.zeros(1)), "or other values"),
        (SimpleNamespace(boxes=np.zeros((1, 4)), scores=np.zeros(1), labels=np.ones(1)), "labels.*below 1"),
        (SimpleNamespace(boxes=np.zeros((1, 4)), scores=np.zeros((1, 0)), labels=np.zeros(1)), r"\(1, 0\)"),
    ],
)
def test_targets_without_what_the_protocol_requires(found: Any, message: str, picture: torch.Tensor) -> None:
    class Model(Recorder):
        def __call__(self, batch: Sequence[np.ndarray]) -> list[Any]:
            return [found]

    with pytest.raises(DetectorError, match=message):
        detect(load_predictor(Model()), picture)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("WithoutMetadata", "expected a MAITE model .metadata with an id, called with a batch of images., found "),
        ("number", "expected a MAITE model .*, found int, which cannot be called"),
        ("Missing", "expected a model, class or function .*:Missing, found no such name"),
        (
            "Faulty",
            r"expected methods that raise nothing, found AttributeError: .* \(foreign.py:\d+, in __call__\)",
        ),
        (
            "WithoutScores",
            "expected boxes, scores and labels for an image .*, found SimpleNamespace without scores",
        ),
    ],
)
def test_the_command_names_what_is_missing(
    name: str, message: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--detector", f"maite:{file}:{name}"]) == 2
    code, line = capsys.readouterr().err.splitlines()
    assert code == f"drivesem: --detector: runs the code in {file}:{name}"
    assert re.search(message, line)


@pytest.mark.parametrize("name", ["maite:nowhere", "maite:nowhere.py:Model", "maite:no_such_module:Model"])
def test_places_without_a_model(name: str) -> None:
    with pytest.raises(DetectorError, match="expected"):
        load_predictor(name)


def test_loading_runs_code_and_gives_no_gradient(file: Path, tmp_path: Path) -> None:
    name = f"maite:{file}:model"
    assert find_code_to_run(name) == f"{file}:model"
    with pytest.raises(DetectorError, match="expected one with gradients, found 'maite:"):
        load_detector(name)
    spec = tmp_path / "spec.yaml"
    spec.write_text("t_star: 0.4\n")
    assert getattr(load_predictor(f"{name},{spec}"), "t_star", None) == 0.4


def test_check_finds_cars_and_names_what_a_blind_model_gets(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--detector", f"maite:{file}:Foreign"]) == 0
    file.write_text(FILE.replace("self.model(batch)", "self.model([image * 0 for image in batch])"))
    capsys.readouterr()
    assert main(["check", "--detector", f"maite:{file}:Foreign"]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "RGB in [0, 1]" in printed
    assert "gives uint8" in printed
