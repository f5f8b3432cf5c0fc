"""`python -m tools.versions`: which steps it takes for which Python and versions, without taking them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from tools.versions import ROOT, lowest, main, run_words


class Recorder:
    """Takes no step but notes it; fails those whose words hold `failing`."""

    def __init__(self, failing: str = "") -> None:
        self.steps: list[str] = []
        self.pins = ""
        self.failing = failing

    def __call__(self, words: Sequence[str], folder: Path) -> str:
        line = " ".join(words)
        self.steps.append(line)
        if "-c" in words and "install" in words:
            self.pins = Path(words[words.index("-c") + 1]).read_text()
        return "no such version" if self.failing and self.failing in line else ""


def test_lower_bounds_are_pinned(tmp_path: Path) -> None:
    path = tmp_path / "pyproject.toml"
    path.write_text('[project]\ndependencies = ["torch>=2.6", "warp-lang >= 1.19, <2"]\n')
    assert lowest(path) == ["torch==2.6", "warp-lang==1.19"]
    path.write_text('[project]\ndependencies = ["torch"]\n')
    with pytest.raises(ValueError, match="dependency 'torch': expected a lower bound"):
        lowest(path)
    assert any(pin.startswith("numpy==") for pin in lowest(ROOT / "pyproject.toml"))


def test_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Recorder()
    assert main(["--python", "python8,python9", "--tests", "--out", str(tmp_path / "a.json")], run) == 0
    assert "pip wheel" in run.steps[0]
    assert [line.split()[0] for line in run.steps if "-m venv" in line] == ["python8"] * 2 + ["python9"] * 2
    assert len([line for line in run.steps if "drivesem.cli attack" in line]) == 4
    assert len([line for line in run.steps if "-m quick" in line]) == 4
    assert len([line for line in run.steps if "lowest.txt" in line]) == 2
    assert "kornia==" in run.pins
    told = json.loads((tmp_path / "a.json").read_text())
    assert [(row["python"], row["versions"], row["failed"]) for row in told][:2] == [
        ("python8", "lowest", ""), ("python8", "highest", ""),
    ]  # fmt: skip
    assert "python9, highest: works" in capsys.readouterr().out


def test_a_failure_ends_one_set_alone(capsys: pytest.CaptureFixture[str]) -> None:
    run = Recorder("lowest.txt")
    assert main(["--python", "python9"], run) == 1
    out = capsys.readouterr().out
    assert "python9, lowest: install: no such version" in out
    assert "python9, highest: works" in out
    assert len([line for line in run.steps if "doctor" in line]) == 1


def test_resolving_installs_nothing() -> None:
    run = Recorder()
    assert main(["--python", "python9", "--resolve", "--versions", "lowest"], run) == 0
    assert [line for line in run.steps if " install " in line and "--dry-run" not in line] == []
    assert not any("drivesem.cli" in line for line in run.steps)


def test_words_are_run(tmp_path: Path) -> None:
    assert run_words(["python3", "-c", "pass"], tmp_path) == ""
    assert run_words(["python3", "-c", "raise ValueError('so')"], tmp_path) == "ValueError: so"
    assert "nowhere" in run_words(["nowhere"], tmp_path)
