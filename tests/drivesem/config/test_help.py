"""What `drivesem` and `COMMAND --help` print, and presets by name, as a newcomer types them."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

from drivesem.cli import EXAMPLES, TOPICS, main
from drivesem.config import presets as preset_files
from drivesem.config.commands import COMMANDS
from drivesem.config.options import option_name
from drivesem.config.parsing import field_texts, parse
from drivesem.config.presets import find_presets, resolve_preset


def printed(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with contextlib.suppress(SystemExit):
        assert main(words) == 0
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
    assert options_in(done.stdout) == options_in(printed(["attack", "--help"], capsys))
    wrong = subprocess.run([*typed, "atack"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert wrong.stderr.endswith("found atack; did you mean attack?\n")


def test_examples_parse(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for words in EXAMPLES:
        parse(words.split()[1:])


def options_in(text: str) -> set[str]:
    """The options that a help text describes."""
    return set(re.findall(r"^[│ ] (?:-\w[^,]*, )?(--[\w-]+)", text, re.MULTILINE))


@pytest.mark.parametrize("name", COMMANDS)
def test_all_options_have_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    hints = get_type_hints(COMMANDS[name], include_extras=True)
    named = {
        field.name for field in dataclasses.fields(COMMANDS[name]) if "Positional" not in repr(hints[field.name])
    }
    text = printed([name, "--help-all"], capsys)
    aliases = {"--to-format": "--to", "--from-format": "--from"}
    aliases |= {"--finder": "--detector"} if name == "derender" else {}
    expected = {aliases.get(option_name(field), option_name(field)) for field in named}
    assert options_in(text) - {"--help", "--help-all", "--config"} == expected
    assert options_in(printed([name, "--help"], capsys)) - {"--help", "--help-all", "--config"} <= expected
    texts = field_texts(COMMANDS[name])
    for field in dataclasses.fields(COMMANDS[name]):
        assert texts[field.name].endswith("."), field.name
        assert len(texts[field.name]) <= 115, field.name


def test_attack_shows_twenty_options_first(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(["attack", "-h"], capsys)
    listed = options_in(text) - {"--help", "--help-all"}
    assert len(listed) == 20
    assert {"--detector", "--dataset", "--combo", "--budget", "--second-detector", "--config"} <= listed
    assert "--step-form" not in text
    everything = printed(["attack", "--help-all"], capsys)
    assert "--project {feasible,bounds}" in everything
    assert "(default: feasible)" in everything
    assert "--resume, --no-resume" in everything
    assert "{None}" not in everything


def test_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    listed = json.loads(printed(["attack", "--config", "list", "--json"], capsys))["presets"]
    assert [row["name"] for row in listed] == ["paper", "quick"]
    assert listed[1]["about"].startswith("A first look")
    assert "train-squeezedet-whole" in printed(["train", "--config", "list"], capsys)
    assert printed(["doctor", "--config", "list"], capsys) == "no presets for doctor\n"


def test_a_file_of_ones_own_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert resolve_preset("quick") == str(find_presets()["quick"])
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
    find_presets.cache_clear()
    try:
        assert find_presets() == {"mine": data / "mine.yaml"}
        assert parse(["attack", "--config", "mine"]).combo == 3  # pyright: ignore[reportAttributeAccessIssue]
    finally:
        monkeypatch.undo()
        find_presets.cache_clear()


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
