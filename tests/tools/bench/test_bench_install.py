"""`python -m tools.bench install` as a maintainer types it."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from drivesem.config.errors import UsageError
from tools.bench import install
from tools.bench.__main__ import main
from tools.versions import StepResult

PACKAGES = [["drivesem", "9.1", 5], *([f"p{i}", str(i), i * 1_000_000] for i in range(12))]


class Recorder:
    """Takes no step but notes it, and leaves what the real one would."""

    def __init__(self, failing: str = "") -> None:
        self.steps: list[tuple[str, Path]] = []
        self.failing = failing

    def __call__(self, words: Sequence[str], folder: Path) -> StepResult:
        line = " ".join(words)
        self.steps.append((line, folder))
        if self.failing and self.failing in line:
            return StepResult("no such thing")
        if "git clone" in line:
            Path(words[-1]).mkdir()
            (Path(words[-1]) / "a.py").write_bytes(bytes(2_000_000))
        if "distributions" in line:
            return StepResult(output=json.dumps(PACKAGES))
        return StepResult()


def test_the_readmes_words_one_after_another() -> None:
    run = Recorder()
    rows = list(install.measure(quick=False, run=run))
    steps = [row for row in rows if isinstance(row, install.InstallStepRow)]
    assert [row.step.split()[0] for row in steps] == ["git", "python3", "pip", "drivesem", "in"]
    assert [row.mb for row in steps] == [2, 0, 0, 0, 2]
    assert steps[-1].seconds == pytest.approx(sum(row.seconds for row in steps[:-1]), abs=0.05)
    attack, folder = next((line, folder) for line, folder in run.steps if "--combo 2" in line)
    assert attack.startswith("env WARP_CACHE_PATH="), "kernels of other runs must not be found"
    assert folder.name == "clone"
    readme = (install.ROOT / "README.md").read_text(encoding="utf-8")
    assert steps[2].step in readme
    assert steps[3].step in readme


def test_the_largest_packages_and_all_others() -> None:
    rows = [row for row in install.measure(quick=False, run=Recorder()) if isinstance(row, install.SizeRow)]
    assert [row.package for row in rows] == [
        "drivesem, its wheel",
        *(f"p{i}" for i in range(11, 3, -1)),
        "4 others",
    ]
    assert [row.mb for row in rows[-2:]] == [4, 0 + 1 + 2 + 3]
    assert rows[0].version == "9.1"


def test_a_step_that_fails_is_named() -> None:
    with pytest.raises(UsageError, match=r"pip install .*no such thing"):
        list(install.measure(quick=False, run=Recorder(failing="pip install")))


class DetectorRecorder(Recorder):
    """Leaves the report of an attack too."""

    def __call__(self, words: Sequence[str], folder: Path) -> StepResult:
        result = super().__call__(words, folder)
        if "attack" in words and not result.failed:
            out = Path(words[words.index("--out") + 1])
            out.mkdir()
            (out / "report.html").touch()
        return result


def test_paths_of_detectors() -> None:
    run = DetectorRecorder()
    hf, bundled = install.measure_paths(["hf:models/detr", "squeezedet"], run)
    assert (hf.detector, hf.lines, hf.outcome, bundled.detector) == ("hf:detr", 5, "report", "squeezedet")
    lines = [line for line, _ in run.steps]
    assert lines[2].endswith("pip install -q -c constraints.txt -e .[transformers]")
    assert lines[3].endswith("check --detector hf:models/detr")
    assert lines[7].endswith("-e .")
    (failed,) = install.measure_paths(["onnx:a.onnx"], DetectorRecorder(failing=" check "))
    assert failed.outcome == "check: no such thing"
    assert failed.attack == 0
    (without,) = install.measure_paths(["onnx:a.onnx"], Recorder())
    assert without.outcome == "attack: no report"


@pytest.mark.slow
def test_install(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of this environment: whatever it takes, drivesem's help loads no torch, and comes at once."""
    page = tmp_path / "page.md"
    assert main(["install", "--quick", "--json", "--markdown", str(page)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["steps"] == []
    sizes = {row["package"]: row["mb"] for row in found["sizes"]}
    assert sizes["torch"] > 100
    assert 1 < sizes["drivesem, its wheel"] < 100
    assert {row["command"] for row in found["starts"]} >= {
        "drivesem",
        "drivesem --version",
        "drivesem attack --help",
    }
    assert all(0 < row["seconds"] < 60 for row in found["starts"])
    assert page.read_text().count("###") == 2
