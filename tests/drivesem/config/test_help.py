"""What `drivesem` and `COMMAND --help` print, and presets by name, as a newcomer types them."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from drivesem.cli import main
from drivesem.config import presets as preset_files
from drivesem.config.blocks import option
from drivesem.config.commands import COMMANDS
from drivesem.config.help import EXAMPLES, GROUPS, TOPICS, grouped
from drivesem.config.parsing import parse
from drivesem.config.presets import preset_path, presets


def printed(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_the_overview_names_every_command_once(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(words, capsys)
    assert sorted(name for names in TOPICS.values() for name in names) == sorted(COMMANDS)
    for topic, names in TOPICS.items():
        assert f"\n{topic}\n" in text
        assert all(re.search(rf"^  {name} ", text, re.MULTILINE) for name in names)
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize("words", [["--help"], ["attack", "--help"]])
def test_help_imports_nothing_that_takes_long(words: list[str]) -> None:
    code = (
        "import atexit, sys\n"
        "heavy = {'torch', 'cv2', 'numpy', 'warp', 'trimesh', 'PIL', 'scene_ir.files'}\n"
        "atexit.register(lambda: print('imported:', *sorted(heavy & set(sys.modules))))\n"
        f"from drivesem.cli import main; main({words!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.rstrip().endswith("\nimported:")


def test_the_package_is_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    typed = [sys.executable, "-m", "drivesem"]
    done = subprocess.run([*typed, "attack", "--help"], capture_output=True, text=True, check=True)
    assert done.stdout == printed(["attack", "--help"], capsys)
    wrong = subprocess.run([*typed, "atack"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert wrong.stderr.endswith("did you mean attack?\n")


def test_examples_parse(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for words, _ in EXAMPLES:
        parse(words.split()[1:])


@pytest.mark.parametrize("name", COMMANDS)
def test_help_tells_every_option_once_with_its_text(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = printed([name, "--help"], capsys)
    told = [field for _, group in grouped(name) for field in group]
    assert sorted(told) == sorted(field.name for field in dataclasses.fields(COMMANDS[name]))
    for field in dataclasses.fields(COMMANDS[name]):
        if "Positional" not in str(field.type) and field.name not in ("runs", "folders", "answers", "scene"):
            assert len(re.findall(rf"^  {option(field.name)}\b(?!-)", text, re.MULTILINE)) == 1
    lines = text.splitlines()
    for line, below in itertools.pairwise(lines):
        if line.startswith("  ") and line[2] != " ":
            assert below.startswith("      "), f"{line} has no text"


def test_attack_has_its_options_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(["attack", "-h"], capsys)
    places = [text.index(f"\n{title}:\n") for title in GROUPS]
    assert places == sorted(places)
    first = text[: text.index("how it is searched:")]
    assert all(word in first for word in ("--detector TEXT", "--dataset TEXT", "--combo N", "--budget TEXT"))
    assert "--project {feasible,bounds}" in text
    assert "(default: feasible)" in text
    assert "--resume, --no-resume" in text
    assert "--early-stop\n" in text


def test_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["presets", "--json"]) == 0
    told = {row["name"]: row for row in json.loads(capsys.readouterr().out)["presets"]}
    assert told["paper"]["commands"] == ["attack", "study"]
    assert told["quick"]["about"].startswith("A first look")
    assert main(["presets"]) == 0
    assert "train-squeezedet-whole" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--config", "fast"], ["--config", "elsewhere/quick.yaml"], ["--config"]])
def test_a_preset_that_is_none_is_told_with_those_there_are(words: list[str], refused: Any) -> None:
    line = refused("attack", *words)
    assert "--config: expected a YAML file, or a preset: paper, quick, found" in line


def test_a_file_of_ones_own_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert preset_path("quick") == str(presets()["quick"])
    Path("quick").write_text("combo: 4\n")
    assert parse(["attack", "--config", "quick"]).combo == 4  # pyright: ignore[reportAttributeAccessIssue]


def test_presets_of_a_wheel_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As an installer lays a wheel out: the package in site-packages, its data files beside the interpreter."""
    site, data = tmp_path / "lib" / "site-packages", tmp_path / "share" / "drivesem" / "configs"
    info = site / "drivesem-9.dist-info"
    for folder in (site / "drivesem", data, info):
        folder.mkdir(parents=True)
    (data / "mine.yaml").write_text("# Mine.\nfor: attack\ncombo: 3\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: drivesem\nVersion: 9\n")
    (info / "RECORD").write_text("../../share/drivesem/configs/mine.yaml,,\ndrivesem/__init__.py,,\n")
    monkeypatch.setattr(preset_files, "__file__", str(site / "drivesem" / "settings" / "presets.py"))
    monkeypatch.setattr(sys, "path", [str(site)])
    presets.cache_clear()
    try:
        assert presets() == {"mine": data / "mine.yaml"}
        assert parse(["attack", "--config", "mine"]).combo == 3  # pyright: ignore[reportAttributeAccessIssue]
    finally:
        monkeypatch.undo()
        presets.cache_clear()


def test_a_reader_that_has_enough_ends_the_command() -> None:
    words = (
        f"set -o pipefail; {sys.executable} -u -m drivesem.cli --tyro-print-completion bash | head -1 > /dev/null"
    )
    ended = subprocess.run(["bash", "-c", words], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) in ((141, ""), (0, ""))


def test_completion_is_offered() -> None:
    words = [sys.executable, "-m", "drivesem.cli", "--tyro-print-completion", "bash"]
    script = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "drivesem" in script
    assert "retrain" in script
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
