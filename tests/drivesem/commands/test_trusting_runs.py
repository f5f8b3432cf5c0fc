"""Code that a run names is not run, unless one says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from detectors.registry import find_code_to_run
from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import to_yaml
from drivesem.run.folder import load_attack_config, load_trusted_config
from tests.drivesem.invoke import invoke

CODE = """
from pathlib import Path

Path({mark!r}).touch()

class D:
    pass
"""


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("squeezedet", None),
        ("weights.safetensors", None),
        ("darknet:a.cfg,a.weights", None),
        ("onnx:a.onnx", None),
        ("torchvision:retinanet_resnet50_fpn", None),
        ("planted:height_px=30:38@squeezedet", None),
        ("module:evil.py:D", "evil.py:D"),
        ("torchscript:evil.pt,spec.yaml", "evil.pt,spec.yaml"),
        ("export:evil.pt2", "evil.pt2"),
        ("ultralytics:evil.pt", "evil.pt"),
        ("planted:height_px=30:38@module:evil.py:D", "evil.py:D"),
    ],
)
def test_what_runs_code(name: str, code: str | None) -> None:
    assert find_code_to_run(name) == code


@pytest.fixture
def foreign(tmp_path: Path) -> Callable[[str], Path]:
    """A run without frames, whose setting names code that leaves a mark."""

    def make(setting: str) -> Path:
        run, code = tmp_path / "run", tmp_path / "evil.py"
        code.write_text(CODE.format(mark=str(tmp_path / "mark")))
        (run / "frames" / "a").mkdir(parents=True)
        (run / "config.yaml").write_text(to_yaml(replace(AttackConfig(), **{setting: f"module:{code}:D"})))
        return run

    return make


@pytest.mark.parametrize("setting", ["detector", "second_detector", "reference_detector"])
def test_each_setting_that_names_a_detector(foreign: Callable[[str], Path], setting: str) -> None:
    run = foreign(setting)
    with pytest.raises(UsageError, match=rf"config\.yaml: {setting}: expected .*--trust.*evil\.py:D"):
        load_trusted_config(run, trust=False)
    assert load_trusted_config(run, trust=True) == load_attack_config(run)


@pytest.mark.parametrize(
    "words",
    [["verify", "--run"], ["explain", "--run"], ["confirm", "--run"], ["retrain", "--run"], ["holes"]],
    ids=lambda words: words[0],
)
def test_each_command_that_loads_a_run_s_detector(
    words: list[str], write_run: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = write_run(tmp_path / "source")
    Path("evil.py").write_text(CODE.format(mark=str(tmp_path / "mark")))
    (run / "config.yaml").write_text(to_yaml(AttackConfig(params="rotate", detector="module:evil.py:D")))
    before = sorted(tmp_path.rglob("*"))
    (line,) = invoke(*words, run, code=2).err.splitlines()
    assert line.startswith(f"drivesem: {run}/config.yaml: detector: expected a detector that is data alone")
    assert "--trust" in line
    assert sorted(tmp_path.rglob("*")) == before
    assert main([*words, str(run), "--trust"]) == 2  # the class is no detector, but it was run
    assert (tmp_path / "mark").exists()
