"""The maintainers' scripts behind the shipped weights: reading the backbone, the frame store, the judge."""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.squeezedet import SqueezeDet
from detectors.types import Detections, Targets
from drivesem.data.kitti import KittiWriter
from scene_ir.types import Labels
from tests.tools.loading import tool

backbone, training = tool("fetch_backbone"), tool("train_squeezedet")


def test_unpickler_admits_numpy_only() -> None:
    arrays = {"conv1": [np.zeros((3, 3, 3, 64), np.float32), np.zeros(64, np.float32)]}
    read = backbone.NumpyUnpickler(io.BytesIO(pickle.dumps(arrays))).load()
    assert np.array_equal(read["conv1"][0], arrays["conv1"][0])
    for evil in (print, Path("x"), np.load):
        with pytest.raises(pickle.UnpicklingError, match="is not admitted"):
            backbone.NumpyUnpickler(io.BytesIO(pickle.dumps(evil))).load()


def test_backbone_names_are_those_of_the_detector() -> None:
    detector = SqueezeDet()
    layers: dict[str, list[np.ndarray]] = {}
    for name, value in detector.state_dict().items():
        if not name.startswith(detector.fresh_layers):
            layer = (
                name.removeprefix("fires.").rsplit(".", 1)[0].replace(".squeeze", ".squeeze1x1").replace(".", "/")
            )
            array = value.numpy()
            layers.setdefault(layer, []).append(array.transpose(2, 3, 1, 0) if array.ndim == 4 else array)
    other = SqueezeDet()
    other.load_backbone(backbone.named(layers))
    for name, value in detector.state_dict().items():
        if not name.startswith(detector.fresh_layers):
            assert torch.equal(other.state_dict()[name], value), name


def labels(kind: tuple[str, ...], boxes_xyxy: list, occlusion: list[int], truncation: list[float]) -> Labels:
    n = len(kind)
    return Labels(
        kind=kind,
        boxes_xyxy=torch.tensor(boxes_xyxy, dtype=torch.float32),
        truncation=torch.tensor(truncation),
        occlusion=torch.tensor(occlusion),
        translation=torch.tensor([[0.0, 1.6, 20.0]]).repeat(n, 1),
        yaw=torch.zeros(n),
        size_lhw=torch.tensor([[4.0, 1.5, 1.7]]).repeat(n, 1),
        ignore_xyxy=torch.tensor([[0.0, 0.0, 9.0, 9.0]]),
    )


def test_what_is_trained_on_and_what_is_judged() -> None:
    box = [10.0, 10.0, 60.0, 40.0]
    rows = labels(
        ("Car", "Van", "Truck", "Car", "Tram", "Cyclist"),
        [box, box, [10.0, 10.0, 60.0, 21.0], box, box, [10.0, 10.0, 60.0, 30.0]],
        [0, 1, 0, 3, 0, 2],
        [0.0, 0.5, 0.0, 0.0, 0.0, 0.0],
    )
    trained, judged = training.training_targets(rows), training.judged_targets(rows)
    assert trained.labels.tolist()[:4] == [0, 0, 1, 0]
    assert trained.ignore.tolist() == [False, False, True, True, True, False, True]
    assert judged.ignore.tolist() == [False, True, True, True, True, True, True]


def test_frame_store_reads_on_where_it_stopped(tmp_path: Path) -> None:
    writer = KittiWriter(tmp_path / "data")
    projection = torch.tensor([[700.0, 0, 60, 0], [0, 700, 40, 0], [0, 0, 1, 0]])
    generator = np.random.default_rng(0)
    images = [generator.integers(0, 255, (80, 120, 3), dtype=np.uint8) for _ in range(3)]
    rows = labels(("Car",), [[10.0, 10.0, 60.0, 40.0]], [0], [0.0])
    writer.write_photograph("000000", images[0], rows, projection)
    assert len(training.FrameStore(tmp_path / "data", tmp_path / "cache")) == 1
    for i in (1, 2):
        writer.write_photograph(f"{i:06d}", images[i], rows, projection)
    store = training.FrameStore(tmp_path / "data", tmp_path / "cache")
    assert len(store) == 3
    for i in range(3):
        assert np.array_equal(store[i][0], images[i])
        assert store[i][1].ignore.tolist() == [False, True]


def test_judge_by_hand() -> None:
    def found(boxes_xyxy: list, scores: list[float]) -> Detections:
        return Detections(
            torch.tensor(boxes_xyxy), torch.zeros(len(scores), dtype=torch.int64), torch.tensor(scores)
        )

    car, far, region = [0.0, 0.0, 10.0, 10.0], [50.0, 0.0, 60.0, 10.0], [80.0, 0.0, 99.0, 20.0]
    wanted = Targets(torch.tensor([car, far, region]), torch.tensor([0, 0, 0]), torch.tensor([False, False, True]))
    # hit at 0.9; double at 0.8 is false; inside the ignored region at 0.7 counts nowhere; hit at 0.6
    detections = found([car, [0.0, 0.0, 10.0, 11.0], [82.0, 2.0, 90.0, 9.0], far], [0.9, 0.8, 0.7, 0.6])
    marks = training.judge([detections], [wanted])
    assert marks.scores.headline.objects == 2
    assert marks.scores.headline.recall == 1.0
    assert marks.scores.headline.ap50 == pytest.approx((51 * 1.0 + 50 * 2 / 3) / 101)
    assert marks.mark == pytest.approx(1.25 * (51 * 1.0 + 50 * 2 / 3) / 101)
    assert marks.f1 == pytest.approx(2 * 2 / (3 + 2))
    assert marks.t_star == pytest.approx(0.6)
