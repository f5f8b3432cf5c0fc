"""`drivesem gate` on the shipped detector: it passes beside itself, and not with noise in its weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from detectors.registry import load_detector, save_detector
from drivesem.cli import main
from tools.noisy_weights import with_noise


@pytest.mark.slow
def test_itself_passes_and_noise_in_the_weights_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, noisy = tmp_path / "run", tmp_path / "noisy.safetensors"
    words = ["--method", "climb", "--params", "color,weather,translate,rotate", "--limit", "1", "--workers", "1"]
    assert main(["attack", *words, "--no-confirm", "--second-detector", "off", "--out", str(run)]) == 0
    save_detector(with_noise(load_detector("squeezedet"), 0.5), noisy)

    def overall(data: dict[str, Any]) -> dict[str, Any]:
        return next(row for row in data["rows"] if row["hole"] == "all")

    def gate(after: str, out: str) -> tuple[int, dict[str, Any]]:
        capsys.readouterr()
        words = ["gate", str(run), "--after", after, "--samples", "16", "--workers", "1", "--json"]
        return main([*words, "--out", str(tmp_path / out)]), json.loads(capsys.readouterr().out)

    code, data = gate("squeezedet", "itself")
    assert (code, data["passed"]) == (0, True)
    assert data["rows"]
    assert {(row["difference"], *row["interval"]) for row in data["rows"]} == {(0, 0, 0)}
    assert 0 < overall(data)["before"] < 1

    code, data = gate(str(noisy), "noisy")
    assert (code, data["passed"]) == (1, False)
    assert overall(data)["difference"] > 0.05
