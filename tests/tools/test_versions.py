"""`python -m tools.versions`: which steps it takes for which Python and versions, without taking them."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tools.versions import PACKAGES, ROOT, StepResult, hiding_prefix, lowest_versions, main, run_words


class Recorder:
    """Takes no step but notes it; fails those whose words hold `failing`."""

    def __init__(self, failing: str = "", egl: str = "missing") -> None:
        self.steps: list[str] = []
        self.pins = ""
        self.failing, self.egl = failing, egl

    def __call__(self, words: Sequence[str], folder: Path) -> StepResult:
        line = " ".join(words)
        self.steps.append(line)
        if "-c" in words and "lowest.txt" in line:
            self.pins = Path(words[words.index("-c") + 1]).read_text()
        if self.failing and self.failing in line:
            return StepResult("no such version")
        if "sys.version_info" in line:
            return StepResult(output="3.13\n")
        if "importlib.metadata" in line:
            return StepResult(output=json.dumps({"Python": "9.0.1", "torch": "9.1"}))
        if "doctor" in line:
            return StepResult(output=json.dumps({"parts": [{"name": "EGL", "status": self.egl}]}))
        return StepResult(
            output=json.dumps({"frames": 10, "grades": {"certain": 3}, "more": 0}) if "attack" in line else ""
        )


def test_lower_bounds_are_pinned(tmp_path: Path) -> None:
    path = tmp_path / "pyproject.toml"
    newer = """"numpy>=2.0; python_version < '3.13'", "numpy>=2.1; python_version >= '3.13'\""""
    path.write_text(f'[project]\ndependencies = ["torch>=2.6", "warp-lang >= 1.19, <2", {newer}]\n')
    assert lowest_versions(path, "3.11") == ["torch==2.6", "warp-lang==1.19", "numpy==2.0"]
    assert lowest_versions(path, "3.13")[2] == "numpy==2.1"
    path.write_text('[project]\ndependencies = ["torch"]\n')
    with pytest.raises(ValueError, match="dependency 'torch': expected a lower bound"):
        lowest_versions(path, "3.11")
    for python in ("3.11", "3.12", "3.13"):
        names = [pin.partition("==")[0] for pin in lowest_versions(ROOT / "pyproject.toml", python)]
        assert len(names) == len(set(names))
        assert set(PACKAGES) <= set(names)


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
    assert told[0]["found"] == {"Python": "9.0.1", "torch": "9.1"}
    assert told[0]["metrics"] == {"frames": 10, "grades": {"certain": 3}}
    out = capsys.readouterr().out
    assert "python9, highest: works\n    {'frames': 10, 'grades': {'certain': 3}}; without EGL\n" in out
    assert "| 9.0.1 | highest | 9.1 |" in out


def test_pinned_and_bare(capsys: pytest.CaptureFixture[str]) -> None:
    run = Recorder()
    assert main(["--python", "python9", "--versions", "pinned", "--bare", "--quick"], run) == 0
    within = [line for line in run.steps if line.startswith("unshare -rm")]
    assert [
        any(word in line for line in within) for word in ("-m venv", "constraints.txt", "doctor", "--limit 1")
    ] == [True] * 4
    assert main(["--python", "python9", "--versions", "pinned", "--bare"], Recorder(egl="works")) == 1
    assert "doctor: EGL is hidden, and works" in capsys.readouterr().out


def test_a_layer_marks_what_is_hidden_and_nothing_else(tmp_path: Path) -> None:
    usr, work = tmp_path / "usr", tmp_path / "work"
    for name in ("bin/x86_64-linux-gnu-gcc-12", "bin/env", "lib/a/libEGL.so.1", "lib/a/libc.so.6"):
        (usr / name).parent.mkdir(parents=True, exist_ok=True)
        (usr / name).touch()
    words = hiding_prefix(work, usr)
    marked = sorted(
        str(path.relative_to(work / "upper")) for path in (work / "upper").rglob("*") if not path.is_dir()
    )
    assert marked == ["bin/x86_64-linux-gnu-gcc-12", "lib/a/libEGL.so.1"]
    assert f"lowerdir={usr},upperdir={work / 'upper'}" in words[4]


def namespaces() -> bool:
    """Whether this machine makes mount namespaces for whoever asks."""
    words = ["unshare", "-rm", "true"]
    return shutil.which(words[0]) is not None and subprocess.run(words, capture_output=True).returncode == 0


@pytest.mark.skipif(not namespaces(), reason="--bare needs mount namespaces; the layer's marks are tested above")
def test_what_is_hidden_is_not_there(tmp_path: Path) -> None:
    hidden = run_words(
        [*hiding_prefix(tmp_path), "sh", "-c", "ls /usr/bin/env /usr/bin/*gcc* /usr/lib/*/libEGL*"], tmp_path
    )
    assert hidden.output == "/usr/bin/env\n"
    assert "cannot access" in hidden.failed


def test_a_failure_ends_one_set_alone(capsys: pytest.CaptureFixture[str]) -> None:
    run = Recorder("lowest.txt")
    assert main(["--python", "python9"], run) == 1
    out = capsys.readouterr().out
    assert "python9, lowest: install: no such version" in out
    assert "python9, highest: works" in out
    assert len([line for line in run.steps if "doctor" in line]) == 1


def test_words_are_run(tmp_path: Path) -> None:
    assert run_words(["python3", "-c", "print(7)"], tmp_path) == StepResult("", "7\n")
    assert run_words(["python3", "-c", "raise ValueError('so')"], tmp_path).failed == "ValueError: so"
    tests = "print('FAILED a.py::b - so'); print('1 failed in 3 s'); raise SystemExit(1)"
    assert run_words(["python3", "-c", tests], tmp_path).failed == "FAILED a.py::b - so"
    assert "nowhere" in run_words(["nowhere"], tmp_path).failed
