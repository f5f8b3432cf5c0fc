"""Files that other tools read: the citation, hooks, issue templates; and that the pages name what there is."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import drivesem
from drivesem.doctor import PARTS

ROOT = Path(__file__).resolve().parents[2]


def read(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_the_citation_is_of_this_version() -> None:
    told = read("CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= told.keys()
    assert str(told["version"]) == drivesem.__version__
    assert told["license"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"]
    for reference in told["references"]:
        assert {"type", "title", "authors"} <= reference.keys()


def test_hooks_are_those_of_the_whole_check() -> None:
    (local,) = read(".pre-commit-config.yaml")["repos"]
    ids = [hook["id"] for hook in local["hooks"]]
    assert ids == ["ruff", "ruff-format", "basedpyright", "architecture"]
    for hook in local["hooks"]:
        assert {"name", "entry", "language"} <= hook.keys()
        if hook["language"] == "system" and "files" in hook:
            pattern = re.compile(hook["files"])
            assert pattern.search("drivesem/cli.py")
            assert not pattern.search("tests/docs/test_habits.py")


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda p: p.stem)
def test_issue_templates_are_forms(path: Path) -> None:
    told = read(str(path.relative_to(ROOT)))
    if path.stem == "config":
        assert told == {"blank_issues_enabled": True}
        return
    assert {"name", "description", "body"} <= told.keys()
    ids = [part["id"] for part in told["body"]]
    assert len(set(ids)) == len(ids)
    assert all(part["type"] == "textarea" and part["attributes"]["label"] for part in told["body"])


def test_every_extra_means_something() -> None:
    """An extra is named where its part is missing, in a page, or brings tools of this repository."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert all(extras.values())
    told = " ".join(part.bring for part in PARTS)
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
    told += " ".join(page.read_text(encoding="utf-8") for page in pages)
    named = set(re.findall(r"\[([a-z,]+)\]", told))
    assert set(extras) <= {name for names in named for name in names.split(",")}


def test_exit_codes_stand_in_one_table() -> None:
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| ", text, re.MULTILINE)
    source = (ROOT / "drivesem" / "cli.py").read_text(encoding="utf-8")
    constants = re.findall(r"^_EXIT_\w+ = (\d+)$", source, re.MULTILINE)
    assert rows == sorted({"0", "1", *constants}, key=int)
