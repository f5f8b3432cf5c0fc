"""Frames perturbed by the project's own renderer, as training sees them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from detectors.types import CLASSES
from drivesem.data.kitti import KittiDataset
from drivesem.training.frames import FrameStore
from drivesem.training.semantic import VARIANTS, SemanticFrames


def store(root: Path, cache: Path) -> FrameStore:
    dataset = KittiDataset(root)
    return FrameStore(dataset, dataset.identifiers, cache, CLASSES)


def test_frames_without_vehicles_stay_as_they_are(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    frames = store(kitti_folder(tmp_path / "data", 1, kind="Pedestrian"), tmp_path / "cache")
    semantic = SemanticFrames(frames, tmp_path / "semantic", 1.0, 0)
    assert len(semantic) == 1
    image, targets = semantic.draw(0, 0, np.random.default_rng(0))
    assert np.array_equal(image, frames[0][0])
    assert targets.labels[~targets.ignore].tolist() == [CLASSES.index("Pedestrian")]
    assert not list((tmp_path / "semantic" / "000000").iterdir())


@pytest.mark.slow
def test_vehicles_move_and_their_labels_too(tmp_path: Path) -> None:
    from drivesem.synth.write import Order, synthesise

    list(synthesise(Order(tmp_path / "data", 3, seed=1)))
    frames = store(tmp_path / "data", tmp_path / "cache")
    index = max(range(3), key=lambda i: sum(kind in ("Car", "Van") for kind in frames.labels[i].kind))
    semantic = SemanticFrames(frames, tmp_path / "semantic", 1.0, 0)
    drawn = [semantic.draw(index, 0, np.random.default_rng(seed)) for seed in range(8)]
    assert len(list((tmp_path / "semantic").glob("*/*.png"))) == VARIANTS
    benign_image, benign = frames[index]
    for image, targets in drawn:
        assert image.shape == benign_image.shape
        assert (image != benign_image).mean() > 0.01
        assert int((~targets.ignore).sum()) > 0
    boxes = {tuple(targets.boxes_xyxy[~targets.ignore].flatten().tolist()) for _, targets in drawn}
    assert 2 <= len(boxes) <= VARIANTS
    assert tuple(benign.boxes_xyxy[~benign.ignore].flatten().tolist()) not in boxes
    plain = SemanticFrames(frames, tmp_path / "semantic", 0.0, 0).draw(index, 0, np.random.default_rng(0))
    assert np.array_equal(plain[0], benign_image)
    again = SemanticFrames(frames, tmp_path / "again", 1.0, 0).draw(index, 5, np.random.default_rng(0))
    assert np.array_equal(again[0], drawn[0][0])
