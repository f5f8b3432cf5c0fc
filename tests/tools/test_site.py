"""The documentation's site: every page is in its place, links lead to pages, and it builds without a warning."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytest.importorskip("mkdocs", reason="mkdocs is not installed")

from tools.site import hooks  # noqa: E402


@pytest.mark.parametrize(
    ("text", "source", "place", "expected"),
    [
        ("[a](docs/attacks.md)", "README.md", "index.md", "[a](attacks.md)"),
        ("![a](docs/example.jpg)", "README.md", "index.md", "![a](example.jpg)"),
        ("[a](docs/holes.md#a-gate)", "README.md", "index.md", "[a](holes.md#a-gate)"),
        ("[c](detectors/weights/)", "README.md", "index.md", "[c](cards.md)"),
        ("[c](CITATION.cff)", "README.md", "index.md", "c (`CITATION.cff`)"),
        (
            "[c](../detectors/weights/squeezedet.md)",
            "docs/detectors.md",
            "detectors.md",
            "[c](cards/squeezedet.md)",
        ),
        ("[c](../../docs/training.md)", "detectors/weights/x.md", "cards/x.md", "[c](../training.md)"),
        ("[t](../truth.md)", "docs/tutorials/kitti.md", "tutorials/kitti.md", "[t](../truth.md)"),
        (
            "[w](https://a.org/b) [h](#c)",
            "README.md",
            "index.md",
            "[w](https://a.org/b) [h](#c)",
        ),
    ],
)
def test_links_between_files_become_links_between_pages(text: str, source: str, place: str, expected: str) -> None:
    assert hooks.relinked(text, source, place) == expected


def test_every_command_has_its_options_on_a_page() -> None:
    page = "".join(hooks.commands_page())
    assert "### attack" in page
    assert "--combo" in page


def test_every_page_of_the_docs_is_in_the_navigation() -> None:
    text = (ROOT / "tools/site/mkdocs.yml").read_text(encoding="utf-8")
    for page in (*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")):
        assert f": {page.relative_to(ROOT / 'docs').as_posix()}\n" in text


@pytest.mark.slow
def test_it_builds_without_a_warning(tmp_path: Path) -> None:
    words = ["build", "--strict", "-q", "-f", "tools/site/mkdocs.yml", "-d", str(tmp_path / "site")]
    own = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # of the theme's own future, and no warning of ours
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *words], cwd=ROOT, env=own, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    start = (tmp_path / "site/index.html").read_text(encoding="utf-8")
    assert "Find out where a driving detector breaks" in start
    assert (tmp_path / "site/cards/squeezedet.html").is_file()
