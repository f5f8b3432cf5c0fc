"""Tables and intervals in the documentation follow from the stored results in docs/data.

A page marks what it takes from docs/data/NAME with `<!-- study NAME: begin -->` and `<!-- study NAME: end -->`. Each
table there, and each number with an interval, is in the page that `python -m tools.experiments ... --from
docs/data/NAME` writes.
"""

import json
import re
from pathlib import Path

import pytest

from tools.experiments.__main__ import main

ROOT = Path(__file__).resolve().parents[2]
STUDIES = sorted(path.parent for path in (ROOT / "docs" / "data").glob("*/study.json"))
MAX_BYTES = 3_500_000
"""Size limit of one stored study."""
_BLOCK = re.compile(r"<!-- study (\S+): begin -->\n(.*?)<!-- study (\S+): end -->", re.DOTALL)
_TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
_NUMBER = r"-?\d+\.\d+"
_INTERVAL = re.compile(rf"{_NUMBER} \[{_NUMBER}, {_NUMBER}\]")


def read_pages() -> str:
    """Text of the README and of all pages."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return "\n".join(page.read_text(encoding="utf-8") for page in pages)


def find_mismatches(block: str, computed: str) -> list[str]:
    """Tables of a block, and intervals of its prose, that the computed page does not contain."""
    tables, intervals = _TABLE.findall(computed), _INTERVAL.findall(computed)
    wrong = [table for table in _TABLE.findall(block) if table not in tables]
    prose = " ".join(_TABLE.sub("", block).split())
    return wrong + [interval for interval in _INTERVAL.findall(prose) if interval not in intervals]


def test_every_stored_study_is_documented_and_small() -> None:
    text = read_pages()
    names = set(re.findall(r"docs/data/([\w-]+)", text))
    names |= {f"searches{suffix}" for suffix in re.findall(r"`(-[\w-]+)`", text)}
    assert {folder.name for folder in STUDIES} <= names
    for begin, block, end in _BLOCK.findall(text):
        assert begin == end
        assert _TABLE.search(block)
    for folder in STUDIES:
        assert sum(path.stat().st_size for path in folder.rglob("*")) < MAX_BYTES


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("folder", STUDIES, ids=lambda folder: folder.name)
def test_pages_match_the_stored_results(folder: Path, tmp_path: Path) -> None:
    stored = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    settings = stored["facts"]["study"] if "facts" in stored else stored["settings"]
    assert main([settings["name"], "--from", str(folder), "--out", str(tmp_path / "again")]) == 0
    computed = (tmp_path / "again" / "study.md").read_text(encoding="utf-8")
    blocks = [block for begin, block, _ in _BLOCK.findall(read_pages()) if begin == folder.name]
    assert not [wrong for block in blocks for wrong in find_mismatches(block, computed)]


def test_other_numbers_are_noticed() -> None:
    computed = "## All\n\n| a | b |\n| --- | ---: |\n| c | 1.5 [-0.5, 2.0] |\n| d | 4.0 [3.0, 5.0] |\n\nNotes.\n"
    table = computed.split("\n\n")[1] + "\n"
    text = f"In words:\n\n{table}\n- *It is* 1.5\n  [-0.5, 2.0], and 7 of 8.\n"
    assert not find_mismatches(text, computed)
    assert find_mismatches(text.replace("5.0] |", "5.1] |"), computed) == [table.replace("5.0] |", "5.1] |")]
    assert find_mismatches(text.replace("| d | 4.0 [3.0, 5.0] |\n", ""), computed)
    assert find_mismatches(text.replace("*It is* 1.5", "*It is* 1.6"), computed) == ["1.6 [-0.5, 2.0]"]
