"""Figures fitted to a made-up archive are those that were planted in it."""

import json
import tarfile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.tools.loading import tool

TOOLS = Path(__file__).parents[2] / "tools"
P2 = "7.2e+02 0 6.0e+02 4.5e+01 0 7.2e+02 1.7e+02 2.0e-01 0 0 1 2.7e-03"
OTHER = "7.0e+02 0 6.1e+02 0 0 7.0e+02 1.8e+02 0 0 0 1 0"


@pytest.fixture(scope="module", name="tool")
def script() -> ModuleType:
    return tool("fit_kitti_statistics")


def _line(kind: str, box: str, x: float, z: float, yaw: float, truncated: float = 0.0, occluded: int = 0) -> str:
    return f"{kind} {truncated} {occluded} 0 {box} 1.5 1.6 4.0 {x} 1.7 {z} {yaw}\n"


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    root = tmp_path / "kitti" / "training"
    for name in ("label_2", "calib"):
        (root / name).mkdir(parents=True)
    frames = {
        "000000": _line("Car", "10 100 60 152.5", 2.0, 12.0, -1.57) + _line("Van", "5 90 99 190", 2.0, 18.0, 1.55),
        "000001": _line("Car", "600 150 1199 299", -6.0, 3.0, 0.0, 0.4, 1)
        + _line("Pedestrian", "1 2 3 40", 4.0, 9.0, 0.0),
        "000002": "DontCare -1 -1 -10 700.00 150.00 1000.00 250.00 -1 -1 -1 -1000 -1000 -1000 -10\n",
    }
    for name, text in frames.items():
        (root / "label_2" / f"{name}.txt").write_text(text)
        (root / "calib" / f"{name}.txt").write_text(f"P2: {OTHER if name == '000002' else P2}\n")
    return tmp_path / "kitti"


def _archive(kitti: Path) -> Path:
    path = kitti.parent / "labels.tar.xz"
    with tarfile.open(path, "w:xz") as archive:
        archive.add(kitti / "training", "training")
    return path


def test_planted_figures_are_found(tool, kitti):
    found = tool.fit_source(_archive(kitti))
    assert found["vehicles_per_frame"][:4] == [0.33333, 0.33333, 0.33333, 0.0]
    assert found["depth_share"][0] == pytest.approx(1 / 3, abs=1e-5)
    assert found["depth_share"][2:4] == [0.33333, 0.33333]
    assert found["type_share"] == {"Car": 0.6667, "Van": 0.3333, "Truck": 0.0}
    assert found["people_per_frame"] == {"Pedestrian": 0.3333, "Cyclist": 0.0}
    assert found["occlusion_share"] == [0.6667, 0.3333, 0.0, 0.0]
    assert found["truncated_share"] == 0.3333
    assert (found["yaw_along_share"], found["yaw_same_direction_share"]) == (0.6667, 0.5)
    assert found["size_hwl_mean_m"]["Car"] == [1.5, 1.6, 4.0]
    assert "3 frames" in found["source"]


def test_cameras_are_sorted_by_how_often_they_took_a_frame_and_sized_by_their_outermost_box(tool, kitti):
    cameras = tool.fit_source(kitti)["cameras"]
    assert [camera["focal_px"] for camera in cameras] == [720.0, 700.0]
    assert cameras[0]["offset_px_m"] == [45.0, 0.2, 0.0027]
    assert cameras[0]["size_wh_px"] == [1200, 300]
    assert cameras[1]["size_wh_px"] == [1001, 251]


def test_archive_and_folder_give_the_same_bytes(tool, kitti, tmp_path):
    for name, source in (("one", _archive(kitti)), ("two", kitti), ("three", kitti / "training")):
        assert tool.main([str(source), "--out", str(tmp_path / f"{name}.json")]) == 0
    written = [(tmp_path / f"{name}.json").read_bytes() for name in ("one", "two", "three")]
    assert written[0] == written[1] == written[2]
    histogram = json.loads(written[0])["histograms"]
    assert (histogram["frames"], histogram["vehicles"]) == (3, 3)
    assert np.sum(histogram["quantities"]["depth_m"]["share"]) == pytest.approx(1.0, abs=1e-4)


def test_bad_input_is_one_line_and_exit_code_two(tool, kitti, tmp_path, capsys):
    broken = tmp_path / "broken.tar.xz"
    broken.write_bytes(b"no archive")
    bad = kitti / "training" / "label_2" / "000001.txt"
    bad.write_text("Car 0 0\n")
    for source, message in ((tmp_path / "none", "none"), (broken, "tar archive"), (kitti, "000001.txt:1")):
        assert tool.main([str(source), "--out", str(tmp_path / "out.json")]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out.json").exists()
