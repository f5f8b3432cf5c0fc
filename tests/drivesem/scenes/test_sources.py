"""What `drivesem derender` says of meshes, segmenters and laser points that cannot be used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from detectors.types import Detections
from drivesem.cli import main
from drivesem.scenes import label_free
from scene_ir import files
from scene_ir.meshes.templates import template


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: a photograph, a KITTI folder with a frame without vehicles or points, and bad files."""
    monkeypatch.chdir(tmp_path)
    image = np.full((60, 200, 3), 90, np.uint8)
    files.write_png(Path("photo.png"), image)
    files.write_png(Path("D/training/image_2/000000.png"), image)
    files.write_text(Path("D/training/label_2/000000.txt"), "")
    files.write_text(Path("D/training/calib/000000.txt"), "P2: 90 0 100 0 0 90 30 0 0 0 1 0\n")
    Path("empty").mkdir()
    files.write_text(Path("texts/readme.txt"), "no mesh")
    files.write_text(Path("bad/car.obj"), "v 1 2\nf 1 2 3\n")
    files.write_text(Path("bad-glb/car.glb"), "no mesh")
    files.write_text(Path("wrong.onnx"), "no network")
    return tmp_path


KITTI = ("--dataset", "kitti", "--root", "D")
PHOTO = ("photo.png",)


@pytest.mark.parametrize("source", [KITTI, PHOTO], ids=["kitti", "photo"])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--meshes", "empty"], "empty: expected at least one vehicle mesh"),
        (["--meshes", "texts"], "texts: expected at least one vehicle mesh"),
        (["--meshes", "nowhere"], "--meshes: expected a folder, found nowhere"),
        (["--meshes", "wrong.onnx"], "--meshes: expected a folder, found wrong.onnx"),
        (["--meshes", "bad"], "bad: expected at least one vehicle mesh"),
        (["--meshes", "bad-glb"], "car.glb: expected a readable mesh"),
        (["--segmenter", "none.onnx"], "none.onnx: expected a readable file"),
        (["--segmenter", "wrong.onnx"], "wrong.onnx: expected an ONNX network"),
        (["--segmenter", "empty"], "empty: expected a readable file"),
        (["--velodyne"], "velodyne: expected "),
    ],
)
def test_what_cannot_be_used_is_one_line_and_exit_code_2(
    source: tuple[str, ...], words: list[str], message: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(p.name for p in place.iterdir())
    assert main(["derender", *source, *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err
    assert sorted(p.name for p in place.iterdir()) == before


def test_meshes_that_are_left_out_are_named(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    monkeypatch.setattr(label_free, "detect", lambda *_: nothing)
    shape = template("sedan")
    turned = shape.vertices.numpy() * np.array([4.5, -1.5, -1.8])
    trimesh.Trimesh(turned, shape.faces.numpy(), process=False).export(place / "bad" / "sedan.obj")
    assert main(["derender", "photo.png", "--meshes", "bad", "--workers", "1", "--out", "S"]) == 0
    output = [line for line in capsys.readouterr().err.splitlines() if line.startswith("--meshes")]
    assert len(output) == 1
    assert output[0].startswith("--meshes: left out: ")
