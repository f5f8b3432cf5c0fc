"""What is trained on, what is judged, and the frames decoded once."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from detectors.types import CLASSES
from drivesem.attacks.labels import Difficulty
from drivesem.data.kitti import KittiDataset
from drivesem.training.frames import (
    PIXELS,
    TRAINING_LIMITS,
    FrameStore,
    adapt_limits,
    evaluation_targets,
    training_targets,
)
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8
from scene_ir.types import Labels


def test_what_is_trained_on_and_what_is_judged(labels: Callable[..., Labels]) -> None:
    box = [10.0, 10.0, 60.0, 40.0]
    rows = labels(
        ("Car", "Van", "Truck", "Car", "Tram", "Cyclist", "person"),
        [box, box, [10.0, 10.0, 60.0, 21.0], box, box, [10.0, 10.0, 60.0, 30.0], box],
        [0, 1, 0, 3, 0, 2, 0],
        [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, float("nan")],
    )
    trained, judged = (
        training_targets(rows, TRAINING_LIMITS, CLASSES),
        evaluation_targets(rows, Difficulty(), CLASSES),
    )
    assert trained.labels.tolist()[:4] == [0, 0, 1, 0]
    assert trained.ignore.tolist() == [False, False, True, True, True, False, False, True]
    # left: a car and a person; the other five and the region are ignored for each of the four classes
    assert judged.ignore.tolist() == [False, False] + 6 * 4 * [True]
    assert judged.labels.tolist() == [0, 2] + [k for k in range(4) for _ in range(6)]


def test_a_detector_of_other_classes(labels: Callable[..., Labels]) -> None:
    box = [10.0, 10.0, 60.0, 40.0]
    rows = labels(("Truck", "Car", "Truck"), [box, box, [1.0, 1.0, 9.0, 9.0]], [0, 0, 0], [0.0, 0.0, 0.0])
    trained = training_targets(rows, TRAINING_LIMITS, ("Pedestrian", "Car"))
    assert trained.labels[~trained.ignore].tolist() == [1]
    assert trained.ignore.tolist() == [False, True, True]
    judged = evaluation_targets(rows, Difficulty(), ("Pedestrian", "Car"))
    assert judged.labels.tolist() == [1, 0, 0, 0, 1, 1, 1]


def test_occlusion_that_is_never_known_leaves_nothing_out(labels: Callable[..., Labels]) -> None:
    box = [10.0, 10.0, 60.0, 40.0]
    never, once = labels(("Car",), [box], [3], [0.0]), labels(("Car",), [box], [0], [0.0])
    assert adapt_limits(TRAINING_LIMITS, [never, once]) == TRAINING_LIMITS
    assert not bool(training_targets(never, adapt_limits(TRAINING_LIMITS, [never]), CLASSES).ignore[0])
    assert bool(training_targets(never, adapt_limits(TRAINING_LIMITS, [never, once]), CLASSES).ignore[0])


def test_frame_store_reads_on_where_it_stopped(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    def store() -> FrameStore:
        dataset = KittiDataset(tmp_path / "data")
        return FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES)

    kitti_folder(tmp_path / "data", 1)
    assert len(store()) == 1
    kitti_folder(tmp_path / "data", 3)
    frames = store()
    assert len(frames) == frames.object_count() == 3
    for i, name in enumerate(frames.names):
        photograph = frames.dataset.frame(name).photograph
        assert np.array_equal(frames[i][0], (photograph * 255).round().permute(1, 2, 0).byte().numpy())
        assert frames[i][1].ignore.tolist() == [False, True]


def test_frames_of_another_folder_are_decoded_anew(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    """Though they have the same names, as many pixels, and some of them are the same pictures."""

    def store(folder: str) -> FrameStore:
        dataset = KittiDataset(tmp_path / folder)
        return FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES)

    for seed, folder in enumerate(("one", "other")):
        kitti_folder(tmp_path / folder, 3, seed=seed)
    shutil.copytree(tmp_path / "one", tmp_path / "mixed")
    last = Path("training", "image_2", "000002.png")
    shutil.copy(tmp_path / "other" / last, tmp_path / "mixed" / last)
    digests = {}
    for folder in ("one", "other", "mixed", "one"):
        frames = store(folder)
        assert (tmp_path / "cache" / PIXELS).stat().st_size == 3 * 80 * 120 * 3
        for i, name in enumerate(frames.names):
            assert np.array_equal(frames.image(i), to_uint8(frames.dataset.frame(name).photograph))
        assert digests.setdefault(folder, frames.digest) == frames.digest
    assert len(set(digests.values())) == 3


def test_a_cache_of_the_same_pictures_stays(
    tmp_path: Path, kitti_folder: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few of many frames are looked at, the last among them, wherever the folder lies now."""
    kitti_folder(tmp_path / "data", 30)
    dataset = KittiDataset(tmp_path / "data")
    FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES)
    (tmp_path / "data").rename(tmp_path / "moved")
    read: list[str] = []
    dataset = KittiDataset(tmp_path / "moved")
    frame = dataset.frame
    monkeypatch.setattr(dataset, "frame", lambda name: (read.append(name), frame(name))[1])
    FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES)
    assert read == [f"{i:06d}" for i in (29, 23, 17, 11, 5)]


def test_a_cache_that_was_cut_short_is_decoded_anew(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    dataset = KittiDataset(kitti_folder(tmp_path / "data", 2))
    first = FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES).digest
    with (tmp_path / "cache" / PIXELS).open("r+b") as file:
        file.truncate(100)
    assert FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES).digest == first


def test_anchors_of_few_boxes_are_refused(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    dataset = KittiDataset(kitti_folder(tmp_path / "data", 2))
    store = FrameStore(dataset, dataset.identifiers, tmp_path / "cache", CLASSES)
    with pytest.raises(ValueError, match="count: expected 1 to 1"):
        store.fit_anchors(0)


def test_frames_without_labels_are_refused(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    root = kitti_folder(tmp_path / "data", 1)
    (root / "training" / "label_2" / "000000.txt").unlink()
    (root / "training" / "label_2").rmdir()
    with pytest.raises(FormatError, match="frame 000000: expected labels, found none"):
        FrameStore(KittiDataset(root), ("000000",), tmp_path / "cache", CLASSES)
