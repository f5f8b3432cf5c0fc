"""Files that other tools read: citation, hooks, issue templates; and pages that name extras and exit codes."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import drivesem
from drivesem.commands.doctor import FEATURES

ROOT = Path(__file__).resolve().parents[2]


def read(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_citation_has_this_version() -> None:
    citation = read("CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert str(citation["version"]) == drivesem.__version__
    assert citation["license"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"]
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= reference.keys()


def test_pre_commit_hooks_match_the_full_check() -> None:
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
    form = read(str(path.relative_to(ROOT)))
    if path.stem == "config":
        assert form == {"blank_issues_enabled": True}
        return
    assert {"name", "description", "body"} <= form.keys()
    ids = [part["id"] for part in form["body"]]
    assert len(set(ids)) == len(ids)
    assert all(part["type"] == "textarea" and part["attributes"]["label"] for part in form["body"])


def test_every_extra_is_documented() -> None:
    """An extra is named by `drivesem doctor` or by a page, or it brings tools of this repository."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert all(extras.values())
    text = " ".join(part.bring for part in FEATURES)
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    text += " ".join(page.read_text(encoding="utf-8") for page in pages)
    named = set(re.findall(r"\[([a-z,]+)\]", text))
    assert set(extras) <= {name for names in named for name in names.split(",")}


def test_exit_codes_are_documented() -> None:
    text = (ROOT / "docs" / "guide" / "start.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| ", text, re.MULTILINE)
    source = (ROOT / "drivesem" / "program.py").read_text(encoding="utf-8")
    constants = re.findall(r"^_EXIT_\w+ = (\d+)$", source, re.MULTILINE)
    assert rows == sorted({"0", "1", *constants}, key=int)
