"""Figures with an interval beside the paper's are those of the pages that they are taken from."""

from __future__ import annotations

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
_FIGURE = re.compile(r"-?\d+\.\d \[-?\d+\.\d, -?\d+\.\d\]")


def test_every_figure_stands_on_a_page_that_is_linked() -> None:
    page = (DOCS / "reproduction.md").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\(([a-z-]+\.md)", page))
    sources = " ".join(" ".join((DOCS / name).read_text(encoding="utf-8").split()) for name in sorted(linked))
    figures = _FIGURE.findall(" ".join(page.split()))
    assert len(figures) > 25
    assert [figure for figure in figures if figure not in sources] == []
