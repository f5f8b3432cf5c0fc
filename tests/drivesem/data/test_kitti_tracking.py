"""KITTI's tracking folders, written by the test: labels with tracks, calibration, faults by line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.data.kitti_tracking import KittiTrackingDataset, list_sequences
from drivesem.data.subsets import find_clips, select_clip
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

CALIB = """P0: 721 0 40 0 0 721 20 0 0 0 1 0
P1: 721 0 40 0 0 721 20 0 0 0 1 0
P2: 721 0 40 44.8 0 721 20 0.2 0 0 1 0.002
P3: 721 0 40 0 0 721 20 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 1 0 0 0 0 1 0 0 0 0 1 0
Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0
"""
LINES = """0 3 Car 0 0 -1.57 10 14 27 24 1.5 1.7 4.2 1 1.6 14 -1.5
0 -1 DontCare -1 -1 -10 40 10 50 20 -1000 -1000 -1000 -10 -1 -1 -1
0 9 Van 1 1 0.5 30 12 45 25 2.1 1.9 4.8 3 1.6 18 0.4
2 9 Person 2 0 0.5 30 12 35 25 1.2 0.5 0.6 3 1.6 18 0.4

2 3 Car 0 2 -1.57 11 14 28 24 1.5 1.7 4.2 1 1.6 13 -1.5
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for sequence in ("0001", "0004"):
        for number in range(3):
            image = np.full((40, 80, 3), 10 * number, np.uint8)
            files.write_png(tmp_path / "training" / "image_02" / sequence / f"{number:06d}.png", image)
        files.write_text(tmp_path / "training" / "label_02" / f"{sequence}.txt", LINES)
        files.write_text(tmp_path / "training" / "calib" / f"{sequence}.txt", CALIB)
    return tmp_path


def test_a_sequence_reads(folder: Path) -> None:
    assert list_sequences(folder) == list_sequences(folder / "training") == ("0001", "0004")
    sequence = KittiTrackingDataset(folder, "0001")
    assert sequence.identifiers == ("000000", "000001", "000002")
    assert sequence.tracks("000000") == (3, 9)
    assert sequence.tracks("000001") == ()
    assert sequence.tracks("000002") == (9, 3)
    frame = sequence.frame("000000")
    labels = frame.labels
    assert labels is not None
    assert labels.kind == ("Car", "Van")
    assert labels.size_lhw.tolist()[0] == pytest.approx([4.2, 1.5, 1.7])
    assert labels.truncation.tolist() == pytest.approx([0.0, 0.2])
    assert labels.ignore_xyxy.tolist() == [[40, 10, 50, 20]]
    assert frame.photograph.shape == (3, 40, 80)
    assert frame.camera.projection is not None
    assert float(frame.camera.projection[0, 3]) == pytest.approx(44.8)
    assert sequence.labels("000002").kind == ("Person_sitting", "Car")
    assert len(sequence.labels("000001").kind) == 0
    assert torch.equal(sequence.frame("000002").photograph, torch.full((3, 40, 80), 20 / 255))


def test_clips_of_a_folder(folder: Path) -> None:
    clips = find_clips(folder)
    assert list(clips) == ["0001", "0004"]
    assert select_clip(clips, None).name == "0001"
    clip = select_clip(clips, "0004")
    assert [clip.tracks(name) for name in clip.frames] == [(3, 9), (), (9, 3)]
    with pytest.raises(FormatError, match="--sequence: expected one of 0001, 0004, found 0009"):
        select_clip(clips, "0009")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 3 Car 0 0", r"0001.txt:7: expected 17 fields, or 18 with a score, found 5"),
        ("x" + LINES.splitlines()[0][1:], r"0001.txt:7: frame: expected a number, found 'x'"),
        (
            LINES.splitlines()[0].replace("0 3 Car 0", "0 4.5 Car 0"),
            r"7: track: expected a whole number, found 4.5",
        ),
        (LINES.splitlines()[0], r"7: track: expected each once in frame 0, found 3"),
        (LINES.splitlines()[0].replace("0 3 Car 0", "0 4 Car 3"), r"7: truncated: expected 0, 1 or 2, found 3"),
        (LINES.splitlines()[0].replace("0 3", "0 4").replace(" 14 -1.5", " far -1.5"), r"7: z: expected a number"),
    ],
)
def test_errors_name_the_line(folder: Path, line: str, message: str) -> None:
    path = folder / "training" / "label_02" / "0001.txt"
    files.write_text(path, LINES + line + "\n")
    with pytest.raises(FormatError, match=message):
        KittiTrackingDataset(folder, "0001").labels("000000")


def test_errors_name_missing_files(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(RangeError, match=r"one of 0001, 0004, found 0003"):
        KittiTrackingDataset(folder, "0003")
    (folder / "training" / "calib" / "0001.txt").unlink()
    with pytest.raises(FormatError, match=r"calib/0001.txt"):
        KittiTrackingDataset(folder, "0001").frame("000000")
    empty = tmp_path_factory.mktemp("empty")
    with pytest.raises(FormatError, match="expected Virtual KITTI, a KITTI tracking folder"):
        find_clips(empty)
    with pytest.raises(FormatError, match="no such folder"):
        find_clips(empty / "none")
