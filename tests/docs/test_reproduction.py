"""Numbers with an interval on the page of the paper's tables are those of the pages that it links to."""

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs" / "research"
_INTERVAL = re.compile(r"-?\d+\.\d \[-?\d+\.\d, -?\d+\.\d\]")


def test_intervals_match_the_linked_pages() -> None:
    page = (DOCS / "reproduction.md").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\(([a-z-]+\.md)", page))
    sources = " ".join(" ".join((DOCS / name).read_text(encoding="utf-8").split()) for name in sorted(linked))
    intervals = _INTERVAL.findall(" ".join(page.split()))
    assert len(intervals) > 25
    assert [interval for interval in intervals if interval not in sources] == []
