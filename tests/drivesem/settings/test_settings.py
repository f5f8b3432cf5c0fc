"""The command line as a user types it: precedence, unknown keys, one line and exit code 2 for bad input."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from drivesem.cli import main, parse
from drivesem.settings.commands import COMMANDS, Attack, Synth
from drivesem.settings.errors import UsageError
from drivesem.settings.text import to_yaml, yaml_arguments


def test_defaults() -> None:
    assert parse(["attack"]) == Attack()
    assert parse(["synth", "--frames", "3"]) == Synth(frames=3)


def test_command_line_wins_over_preset(tmp_path: Path) -> None:
    preset = tmp_path / "preset.yaml"
    preset.write_text("combo: 3\nsteps: 4\njson: true\nresume: false\n")
    config = parse(["attack", "--steps", "7", "--config", str(preset)])
    assert config == Attack(combo=3, steps=7, json=True, resume=False)


def test_resolved_configuration_reads_back(tmp_path: Path) -> None:
    config = Attack(params="translate,mesh", limit=2, keep_going=True, resume=False, out="a b")
    path = tmp_path / "config.yaml"
    path.write_text("".join(f"{line}\n" for line in to_yaml(config).splitlines() if "null" not in line))
    assert parse(["attack", f"--config={path}"]) == config


_NEEDED = {"train": ("--root", "frames"), "retrain": ("--run", "run")}
"""Options without which a command does not begin."""


def test_shipped_presets_parse() -> None:
    presets = sorted((Path(__file__).parents[3] / "configs").glob("*.yaml"))
    assert presets
    for preset in presets:
        command = preset.stem.split("-")[0]
        command = command if command in COMMANDS else "attack"
        assert isinstance(parse([command, "--config", str(preset), *_NEEDED.get(command, ())]), COMMANDS[command])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("combos: 2\n", "combos: expected one of"),
        ("[1, 2]\n", "expected a mapping"),
        ("combo: [\n", "expected YAML"),
        ("json: 3\n", "json: expected true or false"),
        ("steps: {a: 1}\n", "steps: expected one value"),
    ],
)
def test_bad_preset(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=message) as caught:
        yaml_arguments(str(path), Attack)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["attack", "--combo", "7"], "--combo: expected 1, 2, 3 or 4, found 7"),
        (["attack", "--combo", "2", "--params", "mesh"], "--params: expected no --combo"),
        (["attack", "--params", "wheels"], "wheels"),
        (["attack", "--steps", "0"], "--steps: expected at least 1, found 0"),
        (["attack", "--steps", "many"], "--steps"),
        (["attack", "--limit", "0"], "--limit"),
        (["attack", "--workers", "0"], "--workers"),
        (["attack", "--dataset", "kitti"], "--root"),
        (["attack", "--dataset", "kitty", "--root", "."], "kitty"),
        (["attack", "--root", "somewhere"], "--root"),
        (["attack", "--objective-labels", "mine"], "--objective-labels"),
        (["attack", "--frobnicate"], "frobnicate"),
        (["attack", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (["attack", "--detector", "nowhere.safetensors"], "nowhere.safetensors"),
        (["attack", "--detector", "retinanot"], "retinanot"),
        (["attack", "--device", "quantum"], "quantum"),
        (["frobnicate"], "frobnicate"),
        ([], "subcommand"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("drivesem: ")
    assert message in captured.err
    assert not list(tmp_path.iterdir()), "bad settings leave nothing behind"


def test_help_is_quick() -> None:
    best = min(_seconds([sys.executable, "-m", "drivesem.cli", "--help"]) for _ in range(3))
    assert best < 0.5


def _seconds(words: list[str]) -> float:
    start = time.perf_counter()
    finished = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "attack" in finished.stdout
    return time.perf_counter() - start
