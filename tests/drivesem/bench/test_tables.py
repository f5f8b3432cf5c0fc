"""Markdown from results, and a file in which only one section is written anew."""

from pathlib import Path
from typing import Any

import pytest

from drivesem.bench import session as tables
from drivesem.bench import step
from scene_ir.errors import FormatError
from tools.bench import memory


def _result(what: str, **row: Any) -> dict[str, Any]:
    return {
        "what": what,
        "rows": [{"cars": 8, "triangles": 5000, **row}],
        "method": "As it is done.",
        "machine": {"cpu": "a processor", "cores": 2, "threads": 2, "ram": 24.0},
        "versions": {"python": "3.11.7"},
        "command": f"drivesem bench {what}",
        "seconds": 3.2,
    }


def _sections(result: dict[str, Any]) -> list[tables.BenchTable]:
    columns = {"step": step.COLUMNS, "memory": memory.COLUMNS}[result["what"]]
    return [tables.BenchTable("A title", columns, result["rows"])]


def _rewrite(path: Path, result: dict[str, Any]) -> None:
    tables.replace_section(path, result, _sections(result))


def test_columns_without_a_value_are_left_out() -> None:
    result = _result("step", ratio=1.175, ratio_iqr=0.01, lod=True)
    text = tables.format_markdown(result, _sections(result))
    lines = text.splitlines()
    assert "| cars | triangles a car | level of detail | ratio | IQR |" in lines
    assert "| 8 | 5,000 | on | 1.18 | 0.01 |" in lines
    assert "a processor, 2 cores, 2 threads used, 24.0 GB" in text
    assert "`drivesem bench step` in 3 s" in text


def test_only_the_own_section_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "benchmarks.md"
    _rewrite(path, _result("step", ratio=1.5))
    _rewrite(path, _result("memory", peak_mb=700.0))
    path.write_text(path.read_text() + "\nWritten by hand.\n")
    _rewrite(path, _result("step", ratio=1.1))
    text = path.read_text()
    assert text.startswith("# Benchmarks\n")
    assert text.count("bench step: begin") == text.count("bench memory: begin") == 1
    assert "| 1.1 |" in text
    assert "1.5" not in text
    assert "| 700 |" in text
    assert text.rstrip().endswith("Written by hand.")


def test_a_section_without_an_end(tmp_path: Path) -> None:
    path = tmp_path / "benchmarks.md"
    path.write_text("<!-- bench step: begin -->\n")
    with pytest.raises(FormatError, match=r"bench step: end"):
        _rewrite(path, _result("step"))


def test_a_terminal_shows_every_row() -> None:
    (section,) = _sections(_result("step", ratio=1.5))
    assert tables.build_terminal_table(section).row_count == 1
