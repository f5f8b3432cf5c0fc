"""Figures in pages follow from what docs/data keeps of their studies.

A page that tells of the study kept in docs/data/NAME has its part between `<!-- study NAME: begin -->` and
`<!-- study NAME: end -->`: each table in it, and each figure with an interval, is in the page that
`drivesem study --from docs/data/NAME --out OUT` writes.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from drivesem.cli import main

ROOT = Path(__file__).resolve().parents[2]
KEPT = sorted(path.parent for path in (ROOT / "docs" / "data").glob("*/study.json"))
MOST_BYTES = 3_500_000
"""Of one study."""
_BLOCK = re.compile(r"<!-- study (\S+): begin -->\n(.*?)<!-- study (\S+): end -->", re.DOTALL)
_TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
_NUMBER = r"-?\d+\.\d+"
_INTERVAL = re.compile(rf"{_NUMBER} \[{_NUMBER}, {_NUMBER}\]")


def blocks() -> list[tuple[str, str, str]]:
    """Of all pages: the study at the beginning, the text, and the study at the end."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [found for page in pages for found in _BLOCK.findall(page.read_text(encoding="utf-8"))]


def untrue(block: str, told: str) -> list[str]:
    """Tables, and figures with intervals, that are not in what the study tells."""
    tables, figures = _TABLE.findall(told), _INTERVAL.findall(told)
    wrong = [table for table in _TABLE.findall(block) if table not in tables]
    prose = " ".join(_TABLE.sub("", block).split())
    return wrong + [figure for figure in _INTERVAL.findall(prose) if figure not in figures]


def test_every_kept_study_is_told_and_small() -> None:
    found = blocks()
    assert {begin for begin, _, _ in found} == {folder.name for folder in KEPT}
    for begin, text, end in found:
        assert begin == end
        assert _TABLE.search(text)
    for folder in KEPT:
        assert sum(path.stat().st_size for path in folder.rglob("*")) < MOST_BYTES


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("folder", KEPT, ids=lambda folder: folder.name)
def test_pages_say_what_follows_from_it(folder: Path, tmp_path: Path) -> None:
    kept = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    settings = kept["facts"]["study"] if "facts" in kept else kept["settings"]
    name = settings["name"]
    assert main(["study", name, "--from", str(folder), "--out", str(tmp_path / "again")]) == 0
    told = (tmp_path / "again" / "study.md").read_text(encoding="utf-8")
    wrong = [one for begin, text, _ in blocks() if begin == folder.name for one in untrue(text, told)]
    assert not wrong


def test_other_figures_are_noticed() -> None:
    told = "## All\n\n| a | b |\n| --- | ---: |\n| c | 1.5 [-0.5, 2.0] |\n| d | 4.0 [3.0, 5.0] |\n\nNotes.\n"
    table = told.split("\n\n")[1] + "\n"
    text = f"Said of it:\n\n{table}\n- *It is* 1.5\n  [-0.5, 2.0], and 7 of 8.\n"
    assert not untrue(text, told)
    assert untrue(text.replace("5.0] |", "5.1] |"), told) == [table.replace("5.0] |", "5.1] |")]
    assert untrue(text.replace("| d | 4.0 [3.0, 5.0] |\n", ""), told)
    assert untrue(text.replace("*It is* 1.5", "*It is* 1.6"), told) == ["1.6 [-0.5, 2.0]"]
