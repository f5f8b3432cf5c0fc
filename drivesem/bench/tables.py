"""Formats measurements as tables for the terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from drivesem.report.tables import format_count
from scene_ir import files
from scene_ir.errors import FormatError

Columns = dict[str, tuple[str, str | None]]
"""By field: the heading in the documentation, and the short one for terminals, or None to omit it there."""


@dataclass(frozen=True, slots=True)
class BenchTable:
    """Rows of one kind."""

    title: str
    """Heading."""
    columns: Columns
    """Fields to print."""
    rows: Sequence[dict[str, Any]]
    """Values by field."""


def build_terminal_table(section: BenchTable) -> Table:
    """A table for the terminal, without columns that have no values."""
    table = Table(title=section.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    short = {name: brief for name, (_, brief) in _columns_with_values(section).items() if brief is not None}
    for heading in short.values():
        table.add_column(heading, justify="right")
    for row in section.rows:
        table.add_row(*(_format_cell(row.get(name)) for name in short))
    return table


def format_markdown(result: dict[str, Any], sections: Sequence[BenchTable]) -> str:
    """Tables, method, machine and versions of one benchmark."""
    lines: list[str] = []
    for section in sections:
        columns = _columns_with_values(section)
        lines += [f"### {section.title}", "", _format_row(title for title, _ in columns.values())]
        lines.append(_format_row("---:" for _ in columns))
        lines += [_format_row(_format_cell(row.get(name)) for name in columns) for row in section.rows]
        lines.append("")
    machine, versions = result["machine"], result["versions"]
    gpu = f", {machine['gpu']}" if "gpu" in machine else ""
    lines += [
        f"Method. {result['method']}",
        "",
        f"Machine: {machine['cpu']}, {format_count(machine['cores'], 'core')}, "
        f"{format_count(machine['threads'], 'thread')} used, {machine['ram']} GB{gpu}. "
        f"{', '.join(f'{name} {version}' for name, version in versions.items())}. "
        f"Made by `{result['command']}` in {result['seconds']:.0f} s.",
        "",
    ]
    return "\n".join(lines)


def replace_section(path: Path, result: dict[str, Any], sections: Sequence[BenchTable]) -> None:
    """Replace a benchmark's tables between its markers in a Markdown file.

    A missing file is created; missing markers are appended.

    Args:
        path: The file.
        result: The benchmark's JSON object.
        sections: Its tables.

    Raises:
        FormatError: A begin marker without an end marker.
    """
    what = result["what"]
    begin, end = f"<!-- bench {what}: begin -->", f"<!-- bench {what}: end -->"
    text = files.read_text(path) if path.exists() else "# Benchmarks\n"
    body = f"{begin}\n\n{format_markdown(result, sections)}\n{end}"
    if begin in text:
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise FormatError(str(path), end, f"none after {begin}")
        text = before + body + after
    else:
        text = f"{text.rstrip()}\n\n{body}\n"
    files.write_text(path, text)


def _columns_with_values(section: BenchTable) -> Columns:
    rows = section.rows
    return {
        name: both for name, both in section.columns.items() if any(_format_cell(row.get(name)) for row in rows)
    }


def _format_row(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |"


def _format_cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value).replace("|", "/").replace(",", ", ").replace(",  ", ", ")
