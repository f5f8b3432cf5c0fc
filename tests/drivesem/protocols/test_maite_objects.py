"""Data sets, attacks and metrics as MAITE objects, and NRTK, HEART, DataEval and XAITK with them.

HEART and XAITK's adapter ask for numpy below 2, so pip does not install them with drivesem; with --no-deps they work.
"""

import json
import sys
import types
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import drivesem as ds
from detectors.adapters.maite import MaiteTarget
from detectors.adapters.torchvision_interface import TorchvisionModule
from detectors.base import Detector, DetectorError
from detectors.registry import load_detector
from drivesem.cli import main
from drivesem.config.errors import UsageError
from scene_ir.errors import FormatError

KITTI = Path(__file__).parents[3] / ".." / "shared" / "data" / "kitti"
OPTIONS: dict[str, Any] = {
    "params": "translate,rotate",
    "steps": 2,
    "confirm": False,
    "second_detector": "off",
}


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_detector("squeezedet")


@pytest.fixture(scope="module")
def data(small_kitti: Path) -> ds.MaiteDataset:
    return ds.MaiteDataset(ds.open_dataset("kitti", small_kitti))


@pytest.fixture(scope="module")
def model(detector: Detector) -> ds.MaiteModel:
    return ds.MaiteModel(detector)


@pytest.fixture
def quiet() -> Iterator[None]:
    """Warnings of other projects' packages are no errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def batch_of(data: Any, *rows: int) -> tuple[list[Any], list[Any], list[Any]]:
    images, targets, metadata = zip(*(data[row] for row in rows), strict=True)
    return list(images), list(targets), list(metadata)


def test_they_have_what_the_protocols_require(data: ds.MaiteDataset, model: ds.MaiteModel) -> None:
    from maite.protocols import object_detection as protocols

    assert isinstance(data, protocols.FieldwiseDataset)
    assert isinstance(model, protocols.Model)
    assert isinstance(ds.MaiteMetric(), protocols.Metric)
    assert isinstance(ds.MaiteAttack(model), protocols.Augmentation)


def test_a_data_set_has_the_objects_that_count(data: ds.MaiteDataset, small_kitti: Path) -> None:
    frame = data.frames[data.frames.names[0]]
    assert frame.labels is not None
    image, target, metadata = data[0]
    np.testing.assert_array_equal(image, (frame.photograph * 255).round())
    assert (image.dtype, image.flags.c_contiguous) == (np.uint8, True)
    boxes = frame.labels.boxes_xyxy.numpy()
    rows = [int(np.flatnonzero((boxes == box).all(1))[0]) for box in target.boxes]
    names = [data.metadata["index2label"][label] for label in target.labels.tolist()]
    assert [{"Van": "Car"}.get(frame.labels.kind[row], frame.labels.kind[row]) for row in rows] == names
    assert (boxes[rows, 3] - boxes[rows, 1] >= 25).all()
    ignored = np.array(metadata["ignored_boxes"]).reshape(-1, 4)
    assert len(rows) > 0
    assert len(rows) + len(ignored) == len(boxes) + len(frame.labels.ignore_xyxy)
    assert metadata["id"] == "000008"
    assert len(list(data)) == len(data) == 1  # iterating ends
    everything = ds.MaiteDataset(data.frames, min_height=0, max_occlusion=3)
    assert len(everything[0][1].boxes) > len(rows)


def test_a_data_set_without_labels(tmp_path: Path, small_kitti: Path) -> None:
    (tmp_path / "training").mkdir()
    for name in ("image_2", "calib"):
        (tmp_path / "training" / name).symlink_to(small_kitti / "training" / name)
    with pytest.raises((FormatError, UsageError), match="label"):
        ds.MaiteDataset(ds.open_dataset("kitti", tmp_path))


def evaluate_by_command(root: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    words = ["--dataset", "kitti", "--root", str(root), "--workers", "1", "--bootstrap", "0", "--json"]
    assert main(["eval", "--detector", "squeezedet", *words]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("root", [None, pytest.param(KITTI, marks=pytest.mark.slow)], ids=["generated", "kitti"])
def test_evaluating_by_maite_equals_the_command(
    root: Path | None,
    small_kitti: Path,
    model: ds.MaiteModel,
    detector: Detector,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from maite.tasks import evaluate

    folder = small_kitti if root is None else root
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    data = ds.MaiteDataset(ds.open_dataset("kitti", folder))
    metric = ds.MaiteMetric(data.metadata["index2label"], t_star=detector.t_star)
    results, _, _ = evaluate(model=model, metric=metric, dataset=data, batch_size=2)
    by_command = evaluate_by_command(folder, capsys)
    assert results["objects"] > 0
    assert results == {name: by_command[name] for name in results}
    metric.reset()
    assert (metric.compute()["objects"], metric.compute()["ap50"]) == (0, None)


def test_ignored_boxes_and_other_numbers() -> None:
    car, far = [10.0, 10, 60, 60], [100.0, 10, 160, 60]
    truth = SimpleNamespace(boxes=[car], labels=[5], scores=[1])
    found = SimpleNamespace(
        boxes=torch.tensor([far, car]), labels=torch.tensor([5, 5]), scores=torch.tensor([0.9, 0.8])
    )
    metric = ds.MaiteMetric({5: "Car", 8: "Truck"}, t_star=0.5)
    metric.update([found], [truth], [{"id": 0}])
    assert metric.compute()["ap50"] == pytest.approx(0.5)
    metric.reset()
    metric.update([found], [truth], [{"id": 0, "ignored_boxes": [far]}])
    results = metric.compute()
    assert (results["ap50"], results["recall_at_t_star"], results["objects"]) == (pytest.approx(1.0), 1.0, 1)
    assert results["per_class"]["Truck"]["ap50"] is None


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (SimpleNamespace(boxes=[], labels=[]), "target: expected boxes, labels and scores, found SimpleNamespace"),
        (
            SimpleNamespace(boxes=[[0, 0, 1, 1]], labels=[0, 0], scores=[1]),
            r"target: expected boxes \(M, 4\), labels \(M,\) and scores \(M,\), found \(1, 4\), \(2,\) and \(1,\)",
        ),
        (SimpleNamespace(boxes=[[0, 0, 1, 1]], labels=[7], scores=[1]), r"labels among 0, 1, 2, 3 .*, found 7"),
    ],
)
def test_targets_without_what_the_protocol_requires(target: Any, message: str, data: ds.MaiteDataset) -> None:
    with pytest.raises(ValueError, match=message):
        ds.MaiteMetric().update([target], [target], [{}])
    if "among" not in message:
        with pytest.raises(ValueError, match=message):
            ds.MaiteAttack("squeezedet")(([data[0][0]], [target], [{"id": "a"}]))


def test_wrong_settings(data: ds.MaiteDataset) -> None:
    with pytest.raises(UsageError, match="headline: expected one of bus, found 'Car'"):
        ds.MaiteMetric({0: "bus"})
    with pytest.raises(ValueError, match="steps: expected at least 1, found 0"):
        ds.MaiteAttack("squeezedet", fit=False, **(OPTIONS | {"steps": 0}))(batch_of(data, 0))
    with pytest.raises(UsageError, match=r"metadata: expected a mapping with an id, found \{\}"):
        ds.MaiteAttack("squeezedet")(([data[0][0]], [data[0][1]], [{}]))
    with pytest.raises(DetectorError, match="MAITE image: expected an image"):
        ds.MaiteAttack("squeezedet")(([np.zeros((8, 8, 3), np.uint8)], [data[0][1]], [{"id": "a"}]))


@pytest.mark.slow
def test_an_attack_moves_the_labels(data: ds.MaiteDataset, detector: Detector) -> None:
    """It is `ds.attack` on the frame, and the boxes are those of the changed scene."""
    augmentation = ds.MaiteAttack(detector, frames=data.frames, fit=False, **OPTIONS)
    (image,), (target,), (metadata,) = augmentation(batch_of(data, 0))
    frame = data.frames["000008"]
    found = ds.attack(ds.derender(frame, fit=False), detector, **OPTIONS)
    np.testing.assert_array_equal(image, found.picture.transpose(2, 0, 1))
    attack = metadata["attack"]
    assert (attack["theta"], attack["success"], attack["feasible"]) == (found.theta, found.success, True)
    json.dumps(metadata)
    before, moved = data[0][1], found.scene.boxes()
    vehicles = np.flatnonzero(before.labels < 2)
    start = found.attacked.objective.benign.paper.boxes_xyxy.numpy()
    counted = 0
    for row in vehicles:
        (index,) = np.flatnonzero((start == before.boxes[row]).all(1))
        distances = np.abs(target.boxes - moved[index]).max(1)
        hidden = [box for box in metadata["ignored_boxes"] if np.abs(np.array(box) - moved[index]).max() < 1e-3]
        assert (distances.min() < 1e-3) != bool(hidden)
        counted += int(np.abs(before.boxes[row] - moved[index]).max() > 0.5)
    assert counted > 0
    assert data[0][2].keys() == {"id", "ignored_boxes"}  # what was given is unchanged


def test_an_attack_without_frames_takes_boxes_and_types(data: ds.MaiteDataset, model: ds.MaiteModel) -> None:
    """Images of floats, the names and numbers of another data set, and no camera."""
    (image,), (target,), _ = batch_of(data, 0)
    foreign = MaiteTarget(target.boxes, target.labels + 10, target.scores)
    names: dict[int, str] = {10: "car", 11: "lorry", 12: "person", 13: "rider"}
    floats = (image / 255).astype(np.float64)
    augmentation = ds.MaiteAttack(model, index2label=names, fit=False, **OPTIONS)
    (changed,), (after,), (metadata,) = augmentation(([floats], [foreign], [{"id": 3, "place": "here"}]))
    assert (changed.dtype, changed.shape) == (np.float64, image.shape)
    assert 0 < np.abs(changed - floats).max() <= 1
    assert set(after.labels.tolist()) <= set(names)
    assert metadata["place"] == "here"
    assert metadata["attack"]["theta"]
    people = foreign.labels >= 12
    assert {tuple(box) for box in foreign.boxes[people].tolist()} <= {tuple(box) for box in after.boxes.tolist()}


def test_an_image_without_vehicles_stays(data: ds.MaiteDataset, model: ds.MaiteModel) -> None:
    image = data[0][0]
    none = MaiteTarget(np.zeros((0, 4), np.float32), np.zeros(0, np.int64), np.zeros(0, np.float32))
    (changed,), (target,), (metadata,) = ds.MaiteAttack(model, **OPTIONS)(([image], [none], [{"id": "empty"}]))
    np.testing.assert_array_equal(changed, image)
    assert len(target.boxes) == 0
    assert metadata["attack"] is None


class StreetDataset:
    """Embedded streets as a MAITE data set, with a model's detections as labels, as in NRTK's examples."""

    def __init__(self, model: ds.MaiteModel, t_star: float) -> None:
        self.metadata = {"id": "streets", "index2label": model.metadata["index2label"]}
        self.images = [np.ascontiguousarray(ds.demo_scene(i).photograph.transpose(2, 0, 1)) for i in range(2)]
        self.targets = [
            MaiteTarget(found.boxes[rows], found.labels[rows], found.scores[rows])
            for found in model(self.images)
            for rows in [found.scores >= t_star]
        ]

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, row: int) -> tuple[Any, Any, Any]:
        return self.images[row], self.targets[row], {"id": row}


@pytest.fixture(scope="module")
def streets(model: ds.MaiteModel, detector: Detector) -> StreetDataset:
    return StreetDataset(model, detector.t_star)


@pytest.mark.usefixtures("quiet")
def test_nrtk_perturbs_what_a_detector_is_evaluated_on(
    streets: StreetDataset, model: ds.MaiteModel, detector: Detector
) -> None:
    """NRTK's example of brightness."""
    from maite.tasks import evaluate
    from nrtk import interop
    from nrtk.impls.perturb_image.photometric.enhance import BrightnessPerturber

    recall = {}
    for factor in (1.0, 0.1, 0.0):
        augmentation = interop.MAITEObjectDetectionAugmentation(
            augment=BrightnessPerturber(factor=factor), augment_id=f"brightness {factor}"
        )
        results, _, batches = evaluate(
            model=model,
            metric=ds.MaiteMetric(t_star=detector.t_star),
            dataset=streets,
            augmentation=augmentation,
            return_augmented_data=True,
        )
        recall[factor] = results["recall_at_t_star"]
        assert np.mean(batches[0][0][0]) == pytest.approx(factor * np.mean(streets[0][0]), abs=1)
    assert recall[1.0] == 1
    assert recall[1.0] > recall[0.1]
    assert recall[0.0] == 0


@pytest.mark.usefixtures("quiet")
def test_nrtk_perturbs_before_an_attack(streets: StreetDataset, model: ds.MaiteModel) -> None:
    from nrtk import interop
    from nrtk.impls.perturb_image.photometric.enhance import BrightnessPerturber

    darker = interop.MAITEObjectDetectionAugmentation(augment=BrightnessPerturber(factor=0.8), augment_id="darker")
    dark = darker(batch_of(streets, 0))
    (image,), (target,), (metadata,) = ds.MaiteAttack(model, fit=False, **OPTIONS)(dark)
    changed = (image != dark[0][0]).any(0)
    assert 0 < changed.mean() < 0.5  # vehicles and shadows; the rest is NRTK's picture
    assert metadata["nrtk_perturber_config"][0]["factor"] == 0.8
    assert np.abs(target.boxes - dark[1][0].boxes).max() > 1


@pytest.mark.usefixtures("quiet")
def test_dataeval_reads_a_data_set(data: ds.MaiteDataset) -> None:
    dataeval = pytest.importorskip("dataeval")
    metadata = dataeval.Metadata(data)
    np.testing.assert_array_equal(metadata.class_labels, data[0][1].labels)


@pytest.mark.usefixtures("quiet")
def test_xaitk_explains_a_detection(data: ds.MaiteDataset, model: ds.MaiteModel) -> None:
    """DRISE's saliency of the best car is higher inside its box than elsewhere."""
    adapter = pytest.importorskip("xaitk_jatic.interop.object_detection.model")
    from xaitk_saliency.impls.gen_object_detector_blackbox_sal.drise import DRISEStack

    image = data.get_input(0)
    (found,) = model([image])
    numbers = list(model.metadata["index2label"])
    saliency = DRISEStack(n=16, s=8, p1=0.5, seed=0).generate(
        image.transpose(1, 2, 0),
        found.boxes[:1],
        np.eye(len(numbers))[found.labels[:1]],
        adapter.JATICDetector(model, numbers),
        objectness=found.scores[:1],
    )[0]
    x0, y0, x1, y1 = found.boxes[0].astype(int)
    assert saliency[y0:y1, x0:x1].mean() > saliency.mean()


@pytest.fixture
def heart(monkeypatch: pytest.MonkeyPatch, quiet: None) -> Callable[..., Any]:
    """HEART's detector. ART reads torchvision's version and nothing else of it; PyPI's does not load next to a CPU's
    torch, so that a module with a version stands in for it.
    """
    estimators = pytest.importorskip("heart_library.estimators.object_detection")
    try:
        import torchvision as _  # noqa: F401
    except (ImportError, RuntimeError):
        stand_in = types.ModuleType("torchvision")
        stand_in.__dict__["__version__"] = "0.28.0"
        stand_in.__spec__ = ModuleSpec("torchvision", None)
        monkeypatch.setitem(sys.modules, "torchvision", stand_in)
    return estimators.JaticPyTorchObjectDetector


def wrap_for_heart(heart: Callable[..., Any], detector: Detector, image: NDArray[Any]) -> Any:
    """A detector as HEART's, for images of one size."""
    return heart(
        model=TorchvisionModule(detector),
        input_shape=image.shape,
        optimizer=None,
        clip_values=(0, 1),
        attack_losses=("objectness",),
        device_type="cpu",
    )


@pytest.mark.usefixtures("quiet")
def test_heart_attacks_the_pixels_of_a_detector(
    heart: Callable[..., Any], streets: StreetDataset, model: ds.MaiteModel, detector: Detector
) -> None:
    """HEART's example: PGD on a detector, evaluated as a MAITE model."""
    from art.attacks.evasion import ProjectedGradientDescent
    from heart_library.attacks.attack import JaticAttack

    image = (streets.images[0] / 255).astype(np.float32)
    estimator = wrap_for_heart(heart, detector, image)
    (by_heart,) = estimator(np.stack([image]))
    (by_drivesem,) = model([image])
    np.testing.assert_array_equal(by_heart.boxes, by_drivesem.boxes)
    pgd = ProjectedGradientDescent(
        estimator, norm=np.inf, eps=4 / 255, eps_step=2 / 255, max_iter=3, verbose=False
    )
    images, targets, metadata = JaticAttack(pgd, norm=2)(([image], streets.targets[:1], [{"id": 0}]))
    assert 0 < np.abs(images[0] - image).max() <= 4 / 255 + 1e-6
    assert metadata[0]["delta"] > 0
    recalls = []
    for picture in (image, images[0]):
        metric = ds.MaiteMetric(t_star=detector.t_star)
        metric.update(model([picture]), targets, metadata)
        recalls.append(metric.compute()["recall_at_t_star"])
    assert recalls[0] == 1
    assert recalls[1] < 0.5


@pytest.mark.usefixtures("quiet")
def test_a_detector_of_heart_is_a_detector(
    heart: Callable[..., Any], data: ds.MaiteDataset, detector: Detector
) -> None:
    image = data.get_input(0)
    estimator = wrap_for_heart(heart, detector, image)
    picture = image.transpose(1, 2, 0)
    found = ds.detect(ds.load_detector(estimator, classes=detector.classes), np.ascontiguousarray(picture))
    torch.testing.assert_close(found.scores, ds.detect(detector, np.ascontiguousarray(picture)).scores)


def test_a_maite_model_is_attacked(data: ds.MaiteDataset, model: ds.MaiteModel) -> None:
    """Without a gradient, by climb; the recorded detections are the model's in the picture found."""

    class Foreign:
        metadata = {"id": "foreign", "index2label": {3: "car"}}  # noqa: RUF012
        spec = {"scale": 255}  # noqa: RUF012
        calls = 0

        def __call__(self, batch: Sequence[np.ndarray]) -> list[MaiteTarget]:
            self.calls += len(batch)
            assert all(image.dtype == np.uint8 for image in batch)
            cars = [(found, found.labels == 0) for found in model(batch)]
            return [MaiteTarget(f.boxes[c], np.full(c.sum(), 3), f.scores[c]) for f, c in cars]

    foreign = Foreign()
    options = {"params": "translate", "passes": 24, "confirm": False, "second_detector": "off"}
    result = ds.attack(ds.demo_scene(0), foreign, **options)
    assert (result.config.method, result.feasible) == ("climb", True)
    assert foreign.calls > 10
    assert result.result.found_before
    recorded = result.result.detections_attacked
    found = ds.detect(foreign, result.picture)
    assert [record.score for record in recorded] == pytest.approx(found.scores.tolist())
    assert {record.label for record in recorded} == {"Car"}


MODEL_FILE = """
import drivesem as ds

model = ds.MaiteModel(ds.load_detector("squeezedet"))


class Wrapped:
    metadata = model.metadata

    def __call__(self, batch):
        return model(batch)
"""


@pytest.mark.slow
def test_a_maite_model_is_attacked_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wrapped.py").write_text(MODEL_FILE)
    name, out = f"maite:{tmp_path}/wrapped.py:Wrapped", tmp_path / "run"
    words = ["--limit", "1", "--workers", "1", "--params", "translate", "--passes", "24", "--no-confirm", "--json"]
    assert main(["attack", "--detector", name, *words, "--out", str(out)]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["detector"] == name
    assert metrics["frames_attacked"] == 1
    assert metrics["objects"]["found_before"] > 0
