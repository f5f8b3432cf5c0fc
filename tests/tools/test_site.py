"""The documentation site: every page is in the navigation, links lead to pages, and it builds without a warning."""

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
        ("[a](docs/guide/attack.md)", "README.md", "index.md", "[a](guide/attack.md)"),
        ("![a](docs/example.jpg)", "README.md", "index.md", "![a](example.jpg)"),
        (
            "[a](docs/guide/where.md#failure-regions)",
            "README.md",
            "index.md",
            "[a](guide/where.md#failure-regions)",
        ),
        ("[c](detectors/weights/)", "README.md", "index.md", "[c](cards.md)"),
        ("[c](CITATION.cff)", "README.md", "index.md", "c (`CITATION.cff`)"),
        (
            "[c](../../detectors/weights/squeezedet.md)",
            "docs/guide/detector.md",
            "guide/detector.md",
            "[c](../cards/squeezedet.md)",
        ),
        ("[c](../../docs/guide/train.md)", "detectors/weights/x.md", "cards/x.md", "[c](../guide/train.md)"),
        ("[t](../glossary.md)", "docs/guide/start.md", "guide/start.md", "[t](../glossary.md)"),
        (
            "[w](https://a.org/b) [h](#c)",
            "README.md",
            "index.md",
            "[w](https://a.org/b) [h](#c)",
        ),
    ],
)
def test_links_between_files_become_links_between_pages(text: str, source: str, place: str, expected: str) -> None:
    assert hooks.relink(text, source, place) == expected


def test_commands_page_lists_options() -> None:
    page = "".join(hooks.iterate_commands())
    assert "### attack" in page
    assert "--combo" in page
    assert "│" not in page


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "tools/site/mkdocs.yml").read_text(encoding="utf-8")
    for page in (*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")):
        assert f": {page.relative_to(ROOT / 'docs').as_posix()}\n" in text


@pytest.mark.slow
def test_it_builds_without_a_warning(tmp_path: Path) -> None:
    words = ["build", "--strict", "-q", "-f", "tools/site/mkdocs.yml", "-d", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # a notice of the theme, not a warning
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *words],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    start = (tmp_path / "site/index.html").read_text(encoding="utf-8")
    assert "Find out where a driving detector breaks" in start
    assert (tmp_path / "site/cards/squeezedet.html").is_file()
