"""`drivesem check`: the table, the JSON, and the exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from drivesem.cli import main

BROKEN = """
import torch
from detectors.squeezedet import SqueezeDet

class Broken(SqueezeDet):
    def loss(self, raw, targets):
        return {"total": super().loss(raw, targets)["total"]}
"""


def test_a_detector_that_keeps_its_contract(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--detector", "squeezedet", "--size", "96x64", "--json"]) == 0
    captured = json.loads(capsys.readouterr().out)
    verdicts = {finding["name"]: finding["verdict"] for finding in captured["findings"]}
    assert captured["gradients"]
    assert verdicts["planted prediction"] == verdicts["gradient to the image"] == verdicts["frozen"] == "ok"


def test_a_broken_one_ends_in_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "broken.py"
    path.write_text(BROKEN)
    assert main(["check", "--detector", f"module:{path}:Broken", "--size", "96x64"]) == 1
    captured = " ".join(capsys.readouterr().out.split())
    assert "loss terms failed loss: expected total and objectness, found total" in captured
    assert "broken" in captured


RAISING = """
from detectors.squeezedet import SqueezeDet

class Raising(SqueezeDet):
    def {method}:
        raise KeyError("wheels")
"""


@pytest.mark.parametrize("method", ["forward(self, images)", "decode(self, raw)", "loss(self, raw, targets)"])
def test_a_detector_that_raises_exits_with_2(
    method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(RAISING.format(method=method))
    assert main(["check", "--detector", f"module:{path}:Raising", "--size", "96x64"]) == 2
    captured = capsys.readouterr()
    assert "raised" in captured.out
    expected = "drivesem: --detector: expected methods that raise nothing, found KeyError: 'wheels'"
    assert captured.err.splitlines()[-1] == f"{expected} (mine.py:6, in {method.partition('(')[0]})"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--detector", "yolo9"],
            "--detector: expected a detector (squeezedet, yolov3-slim, a path.safetensors, ",
        ),
        (
            ["--detector", "planted:aspect=1.6"],
            "--detector: planted: aspect: expected LOW:HIGH, two numbers in order, found 1.6\n",
        ),
        (["--detector", "gone.onnx"], "found 'gone.onnx'\n"),
        (
            ["--detector", "gone.safetensors"],
            "drivesem: --detector: gone.safetensors: expected a weights file, found none\n",
        ),
        (["--detector", "squeezedet", "--size", "32x32"], "--size: expected WIDTHxHEIGHT, each at least 64 px"),
    ],
)
def test_bad_input_ends_in_2(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", *words]) == 2
    assert message in capsys.readouterr().err
