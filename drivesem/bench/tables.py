"""Figures as tables: for a terminal, and as Markdown for the documentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from drivesem.report.tables import number_of
from scene_ir import files
from scene_ir.errors import FormatError

Columns = dict[str, tuple[str, str | None]]
"""Field of a row: its heading in the documentation, and the short one for terminals, where it is shown there."""


@dataclass(frozen=True, slots=True)
class Section:
    """Rows of one kind."""

    title: str
    columns: Columns
    rows: Sequence[dict[str, Any]]


def terminal(section: Section) -> Table:
    """For people at a terminal: the columns that matter, those without a value left out."""
    table = Table(title=section.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    short = {name: brief for name, (_, brief) in _used(section).items() if brief is not None}
    for heading in short.values():
        table.add_column(heading, justify="right")
    for row in section.rows:
        table.add_row(*(_cell(row.get(name)) for name in short))
    return table


def markdown(result: dict[str, Any], sections: Sequence[Section]) -> str:
    """Tables, method, machine and versions of one benchmark."""
    lines: list[str] = []
    for section in sections:
        columns = _used(section)
        lines += [f"### {section.title}", "", _line(title for title, _ in columns.values())]
        lines.append(_line("---:" for _ in columns))
        lines += [_line(_cell(row.get(name)) for name in columns) for row in section.rows]
        lines.append("")
    machine, versions = result["machine"], result["versions"]
    gpu = f", {machine['gpu']}" if "gpu" in machine else ""
    lines += [
        f"Method. {result['method']}",
        "",
        f"Machine: {machine['cpu']}, {number_of(machine['cores'], 'core')}, "
        f"{number_of(machine['threads'], 'thread')} used, {machine['ram']} GB{gpu}. "
        f"{', '.join(f'{name} {version}' for name, version in versions.items())}. "
        f"Made by `{result['command']}` in {result['seconds']:.0f} s.",
        "",
    ]
    return "\n".join(lines)


def rewrite(path: Path, result: dict[str, Any], sections: Sequence[Section]) -> None:
    """Put a benchmark's tables between its marks in a Markdown file; the rest of the file stays as it is.

    A file that is missing is made; marks that are missing are added at its end. Raises FormatError for a beginning
    without an end.
    """
    what = result["what"]
    begin, end = f"<!-- bench {what}: begin -->", f"<!-- bench {what}: end -->"
    text = files.read_text(path) if path.exists() else "# Benchmarks\n"
    body = f"{begin}\n\n{markdown(result, sections)}\n{end}"
    if begin in text:
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise FormatError(str(path), end, f"none after {begin}")
        text = before + body + after
    else:
        text = f"{text.rstrip()}\n\n{body}\n"
    files.write_text(path, text)


def _used(section: Section) -> Columns:
    rows = section.rows
    return {name: both for name, both in section.columns.items() if any(_cell(row.get(name)) for row in rows)}


def _line(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value).replace("|", "/").replace(",", ", ").replace(",  ", ", ")
