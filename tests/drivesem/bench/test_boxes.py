"""Frames of labels without pictures: which are taken, what stands in them, what a step costs."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pytest
import torch

from detectors.base import Detector
from detectors.registry import load_detector
from drivesem.bench import boxes
from drivesem.data.kitti import format_calibration
from scene_ir.errors import FormatError
from scene_ir.render.compositor import Compositor

PROJECTION = torch.tensor([[721.5, 0.0, 609.6, 44.9], [0.0, 721.5, 172.9, 0.2], [0.0, 0.0, 1.0, 0.003]])
CAR = "Car 0.00 0 -1.58 540.0 170.0 640.0 230.0 1.50 1.62 3.88 -0.50 1.65 18.00 -1.60"
VAN = "Van 0.00 0 1.20 700.0 160.0 760.0 200.0 2.00 1.80 4.50 4.00 1.70 26.00 1.40"
FAR = "Car 0.00 0 -1.58 600.0 170.0 606.0 174.0 1.50 1.62 3.88 0.00 1.65 190.00 -1.60"
CYCLIST = "Cyclist 0.00 0 -1.58 540.0 170.0 560.0 230.0 1.70 0.60 1.80 -0.50 1.65 18.00 -1.60"


def archive(path: Path, frames: dict[str, list[str]]) -> Path:
    with tarfile.open(path, "w:xz") as out:
        for name, lines in frames.items():
            for folder, text in (("label_2", "\n".join(lines) + "\n"), ("calib", format_calibration(PROJECTION))):
                info = tarfile.TarInfo(f"training/{folder}/{name}.txt")
                info.size = len(text.encode())
                out.addfile(info, io.BytesIO(text.encode()))
    return path


def test_frames_with_vehicles_are_taken_evenly(tmp_path: Path) -> None:
    frames = {f"{i:06}": [CYCLIST, FAR] if i % 2 else [CAR, CYCLIST, VAN, FAR] for i in range(12)}
    found = boxes.read_labelled_frames(archive(tmp_path / "a.tar.xz", frames), 3)
    assert [one.name for one in found] == ["000000", "000004", "000008"]
    assert [one.rows for one in found] == [(0, 2)] * 3  # neither people nor what is too far to be taken apart
    few = boxes.read_labelled_frames(archive(tmp_path / "b.tar.xz", {"000001": [CAR], "000002": [CYCLIST]}), 9)
    assert [one.name for one in few] == ["000001"]


@pytest.mark.parametrize("frames", [{}, {"000001": [CYCLIST]}])
def test_no_vehicles_are_refused(tmp_path: Path, frames: dict[str, list[str]]) -> None:
    with pytest.raises(FormatError, match="frames with vehicles"):
        boxes.read_labelled_frames(archive(tmp_path / "a.tar.xz", frames), 3)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tar.xz").write_text("no archive")
    with pytest.raises(FormatError, match="a tar archive"):
        boxes.read_labelled_frames(tmp_path / "a.tar.xz", 3)
    with pytest.raises(FormatError, match="a tar archive"):
        boxes.read_labelled_frames(tmp_path / "none.tar.xz", 3)


def test_vehicles_stand_where_the_labels_have_them(tmp_path: Path) -> None:
    (frame,) = boxes.read_labelled_frames(archive(tmp_path / "a.tar.xz", {"000001": [CAR, VAN]}), 1)
    scene = boxes.build_scene(frame, 0)
    assert scene.photograph.shape == (3, 375, 1242)
    rendered = Compositor(scene).render(scene)
    assert torch.equal((rendered.image * 255).round(), (scene.photograph * 255).round())
    for index, box in enumerate(frame.labels.boxes_xyxy):
        rows, columns = (rendered.object_id == index + 1).nonzero().unbind(1)
        middle = torch.stack([columns.float().mean(), rows.float().mean()])
        assert float((middle - (box[:2] + box[2:]) / 2).abs().max()) < 25


@pytest.mark.slow
def test_a_frame_is_measured(tmp_path: Path) -> None:
    detector = load_detector("squeezedet")
    assert isinstance(detector, Detector)
    frames = boxes.read_labelled_frames(archive(tmp_path / "a.tar.xz", {"000001": [CAR]}), 1)
    (cost,) = boxes.measure(frames, detector, 0, "cpu")
    assert (cost["frame"], cost["vehicles"]) == ("000001", 1)
    assert 0.001 < cost["changed"] < 0.1
    assert min(cost["ratio"], cost["first_ratio"], cost["step_ms"], cost["detector_ms"]) > 0
    row = boxes.summarise([cost, cost])
    assert (row["frames"], row["median_ratio"], row["p90_ratio"], row["worst_ratio"]) == (2, *(cost["ratio"],) * 3)
    assert cost["cpu_ratio"] > 0
    assert (row["median_cpu_ratio"], row["p90_cpu_ratio"], row["worst_cpu_ratio"]) == (cost["cpu_ratio"],) * 3
    assert 0 < cost["step_cpu_ms"] < torch.get_num_threads() * 2 * cost["step_ms"] + 20
