"""`python -m tools.bench eval`: the same frames in both layouts, and the whole command timed."""

import json
from pathlib import Path

import pytest

from drivesem.data.layouts import read_table
from scene_ir.errors import FormatError
from tools.bench import evaluation
from tools.bench.__main__ import main

_FRAMES = 5


def test_both_layouts_hold_the_same_boxes(tmp_path: Path) -> None:
    assert evaluation._write(tmp_path, _FRAMES, 0) == 20 * _FRAMES
    labels = read_table(tmp_path / "label_2", "kitti")
    coco = read_table(tmp_path / "truth.json", "coco")
    detected = read_table(tmp_path / "found", "kitti", scored=True, truth=labels)
    results = read_table(tmp_path / "found.json", "coco", scored=True, truth=coco)
    for first, second, count in ((labels, coco, 5), (detected, results, 20)):
        assert len(first.boxes) == len(second.boxes) == count * _FRAMES
        assert first.boxes == pytest.approx(second.with_box_format(first.box_format).boxes, abs=1e-6)


def test_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["eval", "--frames", str(_FRAMES), "--json", "--markdown", str(tmp_path / "all.md")]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    alone, coco, kitti = result["rows"]
    assert [row["protocol"] for row in result["rows"]] == ["coco", "coco", "kitti"]
    assert (alone["engine"], alone["ratio"]) == ("pycocotools alone", 1.0)
    for row in (coco, kitti):
        assert (row["frames"], row["detections"]) == (_FRAMES, 20 * _FRAMES)
        assert row["processor_s"] > alone["processor_s"]  # a process, which starts and reads
    text = (tmp_path / "all.md").read_text()
    assert f"### {evaluation.TITLE}" in text
    assert f"`python -m tools.bench eval --frames {_FRAMES}`" in text


def test_a_command_that_fails_is_told() -> None:
    with pytest.raises(FormatError, match="exit code 2: drivesem: /nowhere: expected"):
        evaluation._command(["--gt", "/nowhere", "--pred", "/nowhere"])
