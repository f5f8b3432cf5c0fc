"""Training of the segmentation network: what it is shown, what it should say, and that a run can be gone on
with."""

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from scene_ir.derender.segmentation import StreetClass
from tests.tools.loading import tool

training: Any = tool("train_segmenter")
SETTINGS = training.SegmentSettings(steps=4, batch=2, frames=2)


@pytest.fixture(scope="module")
def streets() -> list[Any]:
    return [training.street(7, index, "train") for index in range(2)]


@pytest.fixture(scope="module")
def store(streets: list[Any], tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "street", lambda seed, index, split: streets[index])
        return training.SegmentStore(tmp_path_factory.mktemp("segment"), 2, 7, "train")


def test_classes_are_the_generators(streets: list[Any]) -> None:
    frame = streets[0]
    classes = training.surface_classes(frame)
    environment = frame.environment
    clear = {
        "sky": [StreetClass.SKY],
        "foliage_map": [StreetClass.LEAVES, StreetClass.GRASS],
        "road": [StreetClass.ROAD],
    }
    for name, kinds in clear.items():
        share = getattr(environment, name).numpy()
        found = np.isin(classes, kinds)
        assert found[share == 1].mean() > 0.999, name
        assert found[share == 0].mean() < 0.001, name
    vehicle = np.isin(frame.semantic, [12, 13, 14])
    assert np.array_equal(classes == StreetClass.VEHICLE, vehicle)


def test_a_crop_keeps_picture_classes_and_elevation_together(store: Any) -> None:
    for seed in range(6):
        image, classes, height = training.random_crop(store, 0, np.random.default_rng(seed))
        assert image.shape == (*training.CROP_HW, 3)
        assert set(np.unique(classes)) <= set(StreetClass)
        sky = classes == StreetClass.SKY
        assert not sky[height < -0.03].any()
        assert not (classes == StreetClass.ROAD)[height > 0.03].any()
        assert (np.diff(height, axis=0) < 0).all()


def test_a_step_is_a_function_of_seed_and_number(store: Any) -> None:
    first, again, other = (training.build_batch(store, step, SETTINGS) for step in (3, 3, 4))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])
    images, heights, classes = first
    assert images.shape == (2, 3, *training.CROP_HW)
    assert heights.shape == (2, 1, *training.CROP_HW)
    assert classes.shape == (2, *training.CROP_HW)
    assert 0 <= float(images.min()) <= float(images.max()) <= 1


def test_the_truth_costs_least(store: Any) -> None:
    _, _, classes = training.build_batch(store, 0, SETTINGS)
    shares = F.avg_pool2d(F.one_hot(classes, len(StreetClass)).permute(0, 3, 1, 2).float(), 2)
    right = training.compute_loss((shares + 1e-6).log(), classes)
    assert right < training.compute_loss((shares.roll(1, 1) + 1e-6).log(), classes)
    assert right < training.compute_loss(torch.zeros_like(shares), classes)


def test_judged_by_overlap(streets: list[Any]) -> None:
    metrics = training.judge(training.SegmentRun(SETTINGS).averaged(), streets)
    assert set(metrics) == set(training.JUDGED)
    assert all(0 <= whole <= 1 for whole, _ in metrics.values())
    assert training.format_table(metrics).count("\n") == 1 + len(metrics)
