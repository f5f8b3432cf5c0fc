"""`drivesem train --anchors N` on labels written for the purpose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from detectors.anchors import mean_best_iou
from detectors.squeezedet import ANCHOR_SIZES_WH
from scene_ir import files
from tests.drivesem.invoke import invoke

CALIB = "P2: 700 0 300 0 0 700 90 0 0 0 1 0\n"


def line(kind: str, width: float, height: float) -> str:
    return f"{kind} 0 0 0 10 20 {10 + width} {20 + height} 1.5 1.6 4.0 0 1.5 20 0\n"


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Two frames: cars of two shapes, a pedestrian, a car too low, a region to ignore."""
    frames = [
        line("Car", 60, 40) + line("Car", 64, 40) + line("Pedestrian", 20, 50) + line("DontCare", 300, 300),
        line("Car", 20, 20) + line("Car", 20, 22) + line("Car", 9, 8),
    ]
    for number, text in enumerate(frames):
        base = tmp_path / "training"
        files.write_png(base / "image_2" / f"{number:06d}.png", np.zeros((96, 160, 3), np.uint8))
        files.write_text(base / "label_2" / f"{number:06d}.txt", text)
        files.write_text(base / "calib" / f"{number:06d}.txt", CALIB)
    return tmp_path


def fitted(words: list[str]) -> dict:
    out = invoke("train", *words, "--json").out
    assert out.count("\n") == 1
    return json.loads(out)


def test_clusters_of_all_boxes_that_are_not_ignored(kitti: Path) -> None:
    result = fitted(["--root", str(kitti), "--anchors", "3"])
    assert result["anchors"] == [[20.0, 21.0], [20.0, 50.0], [62.0, 40.0]]
    assert (result["frames"], result["boxes"]) == (2, 5)
    overlaps = [60 / 62, 62 / 64, 1.0, 20 / 21, 21 / 22]
    assert result["mean_iou"] == pytest.approx(sum(overlaps) / 5, abs=1e-4)
    sizes = np.array([[60, 40], [64, 40], [20, 50], [20, 20], [20, 22]])
    published = mean_best_iou(sizes, np.array(ANCHOR_SIZES_WH))
    assert result["published_mean_iou"] == pytest.approx(published, abs=1e-4)
    assert published < result["mean_iou"]


def test_limit(kitti: Path) -> None:
    first = fitted(["--root", str(kitti), "--anchors", "2", "--limit", "1"])
    assert first["anchors"] == [[20.0, 50.0], [62.0, 40.0]]


def test_a_table_for_people(kitti: Path) -> None:
    captured = invoke("train", "--root", kitti, "--anchors", "3")
    assert captured.out == ""
    assert "published" in captured.err
    assert "62 x 40" in captured.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--anchors", "0"], "--anchors: expected a number above 0"),
        (["--anchors", "6"], "--anchors: expected at most 5, the number of different sizes, found 6"),
    ],
)
def test_bad_input_is_one_line(words: list[str], message: str, kitti: Path) -> None:
    captured = invoke("train", "--root", kitti, *words, code=2)
    assert captured.err.count("\n") == 1
    assert message in captured.err
