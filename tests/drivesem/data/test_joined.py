"""Folders joined to one data set: every frame of each, in order, and nothing mixed up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.data.kitti import KittiDataset
from drivesem.data.subsets import open_folders
from scene_ir import files
from scene_ir.errors import FormatError

CALIBRATION = "P2: 700 0 60 0 0 700 20 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"


def _kitti(root: Path, names: list[str], value: int) -> Path:
    for name in names:
        files.write_png(root / f"training/image_2/{name}.png", np.full((40, 120, 3), value, np.uint8))
        files.write_text(root / f"training/calib/{name}.txt", CALIBRATION)
        box = f"{value}.00 5.00 90.00 30.00"
        files.write_text(root / f"training/label_2/{name}.txt", f"Car 0 0 -10 {box} 1.5 1.7 4.2 0 1.6 20 0.1\n")
    return root


def test_frames_of_both_folders_in_order(tmp_path: Path) -> None:
    first = _kitti(tmp_path / "b", ["000000", "000001"], 10)
    second = _kitti(tmp_path / "a", ["000000"], 20)
    joined = open_folders("kitti", f"{first},{second}")
    assert joined.identifiers == ("0/000000", "0/000001", "1/000000")
    for name, value in zip(joined.identifiers, (10, 10, 20), strict=True):
        labels = joined.labels(name)
        assert labels is not None
        assert float(labels.boxes_xyxy[0, 0]) == value
        assert torch.equal(joined.frame(name).photograph, torch.full((3, 40, 120), value / 255))


def test_one_folder_stays_itself(tmp_path: Path) -> None:
    assert isinstance(open_folders("kitti", str(_kitti(tmp_path, ["000000"], 10))), KittiDataset)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    first = _kitti(tmp_path / "a", ["000000"], 10)
    with pytest.raises(FormatError, match="missing"):
        open_folders("kitti", f"{first},{tmp_path / 'missing'}")
