"""`drivesem check`: the table, the JSON, and the exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from tests.drivesem.invoke import invoke, run_json

BROKEN = """
import torch
from detectors.squeezedet import SqueezeDet

class Broken(SqueezeDet):
    def loss(self, raw, targets):
        return {"total": super().loss(raw, targets)["total"]}
"""


def test_a_detector_that_keeps_its_contract() -> None:
    captured = run_json("check", "--detector", "squeezedet", "--size", "96x64")
    verdicts = {finding["name"]: finding["verdict"] for finding in captured["promises"]}
    assert captured["gradient"]
    assert verdicts["cars on streets"] == "ok"
    seen = captured["seen"]
    assert (seen["pictures"], seen["problem"]) == (3, None)
    assert seen["boxes"] > 6
    assert 0 <= seen["score_low"] < 0.5 < seen["score_high"] <= 1
    assert verdicts["planted prediction"] == verdicts["gradient to the image"] == verdicts["frozen"] == "ok"


def test_a_broken_one_ends_in_1(tmp_path: Path) -> None:
    path = tmp_path / "broken.py"
    path.write_text(BROKEN)
    captured = " ".join(
        invoke("check", "--detector", f"module:{path}:Broken", "--size", "96x64", code=1).out.split()
    )
    assert "loss terms failed loss: expected total and objectness, found total" in captured
    assert "broken" in captured


RAISING = """
from detectors.squeezedet import SqueezeDet

class Raising(SqueezeDet):
    def {method}:
        raise KeyError("wheels")
"""


@pytest.mark.parametrize("method", ["forward(self, images)", "decode(self, raw)", "loss(self, raw, targets)"])
def test_a_detector_that_raises_exits_with_2(method: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(RAISING.format(method=method))
    captured = invoke("check", "--detector", f"module:{path}:Raising", "--size", "96x64", code=2)
    assert "raised" in captured.out
    expected = "drivesem: --detector: expected methods that raise nothing, found KeyError: 'wheels'"
    assert captured.err.splitlines()[-1] == f"{expected} (mine.py:6, in {method.partition('(')[0]})"


MISREAD = """
import torch

class Misread(torch.nn.Module):
    spec = {"size": [64, 128], "classes": "coco"}

    def forward(self, images):
        return torch.full((1, 168, 85), 1e-3) + images.mean() * 0
"""


def test_a_network_without_detections_on_streets_fails(tmp_path: Path) -> None:
    path, picture = tmp_path / "mine.py", tmp_path / "streets.png"
    path.write_text(MISREAD)
    words = ("check", "--detector", f"module:{path}:Misread", "--size", "96x64", "--limit", "1")
    captured = json.loads(invoke(*words, "--json", "--out", picture, code=1).out)
    assert captured["seen"]["boxes"] == 0
    (failed,) = [one for one in captured["promises"] if one["name"] == "cars on streets"]
    assert failed["verdict"] == "failed"
    assert "no car with a score of 0.3 or more in 1 pictures" in failed["detail"]
    assert "read as yolox, input BGR in [0, 255], letterbox" in failed["detail"]
    assert "yolov5 is possible too (`format` in a YAML file)" in failed["detail"]
    assert cv2.imread(str(picture)).shape[1] > 1000


def test_eval_warns_of_a_network_without_detections(small_kitti: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(MISREAD)
    words = ("--dataset", "kitti", "--root", small_kitti, "--workers", "1")
    captured = invoke("eval", "--detector", f"module:{path}:Misread", *words)
    assert "Misread: no car with a score of 0.3 or more in 1 pictures" in captured.err


def test_streets_of_a_data_set(small_kitti: Path, tmp_path: Path) -> None:
    words = ("check", "--detector", "squeezedet", "--size", "96x64", "--dataset", "kitti", "--root", small_kitti)
    captured = run_json(*words, "--limit", "1", "--out", tmp_path / "streets.jpg")
    assert captured["seen"]["pictures"] == 1
    assert (tmp_path / "streets.jpg").is_file()
