"""`drivesem check`: the table, the JSON, and the exit codes."""

from __future__ import annotations

from pathlib import Path

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
