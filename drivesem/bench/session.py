"""Runs a benchmark: prints its tables, and writes them with machine, versions and command line."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from rich import box
from rich.table import Table

from drivesem.bench import session as tables
from drivesem.bench.timing import machine_facts, package_versions
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import Console, format_count
from scene_ir import files
from scene_ir.errors import FormatError

T = TypeVar("T")

_NOT_MEASURED = ("what", "json", "out", "markdown")
"""Settings that do not affect measurements."""


class BenchSettings(Protocol):
    """Settings of all benchmarks: its name, torch threads, device, output paths, and whether to print JSON."""

    @property
    def what(self) -> str: ...
    @property
    def threads(self) -> int | None: ...
    @property
    def device(self) -> str: ...
    @property
    def out(self) -> str | None: ...
    @property
    def markdown(self) -> str | None: ...
    @property
    def json(self) -> bool: ...


S = TypeVar("S", bound=BenchSettings)


@dataclass(frozen=True, slots=True)
class BenchResult:
    """A benchmark's measurements."""

    fields: dict[str, Any]
    """Fields of the JSON object, among them rows and method."""
    tables: Sequence[tables.BenchTable]
    """Tables to print."""


def run_benchmark(config: S, program: str, measure: Callable[[S, Console], BenchResult]) -> int:
    """Measure, print and write; returns the exit code 0.

    Args:
        config: Settings.
        program: Words before the benchmark's name on the command line.
        measure: The benchmark.

    Raises:
        UsageError: An unavailable device or an invalid path for results.
    """
    start = time.perf_counter()
    targets = output_paths(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    check_device(config.device)
    console = Console(stderr=True)
    measured = measure(config, console)
    result = {
        "what": config.what,
        **measured.fields,
        "machine": machine_facts(config.device),
        "versions": package_versions(),
        "command": _command(config, program),
        "seconds": round(time.perf_counter() - start, 3),
    }
    for section in measured.tables:
        console.print(tables.build_terminal_table(section))
    if targets is not None:
        files.write_json(targets[0], result)
        files.write_text(targets[1], tables.format_markdown(result, measured.tables))
    if config.markdown is not None:
        tables.replace_section(Path(config.markdown), result, measured.tables)
    if config.json:
        sys.stdout.write(json.dumps(result, allow_nan=False) + "\n")
    return 0


def show_progress(rows: Iterable[T], total: int, console: Console) -> Iterator[T]:
    """Pass rows through and show their count.

    Args:
        rows: Rows to pass through.
        total: Expected number.
        console: Where to show it.
    """
    with console.status("measuring") as status:
        for done, row in enumerate(rows, start=1):
            status.update(f"measuring: {done} rows of about {total}")
            yield row


def output_paths(config: BenchSettings) -> tuple[Path, Path] | None:
    """Paths of JSON and Markdown: in the folder `--out`, or FILE.json and FILE.md."""
    if config.out is None:
        return None
    out = Path(config.out)
    if out.suffix == ".json":
        if out.is_dir():
            raise UsageError("--out", "a folder, or a file.json", f"the folder {out}")
        return out, out.with_suffix(".md")
    if out.exists() and not out.is_dir():
        raise UsageError("--out", "a folder, or a file.json", f"the file {out}")
    return out / f"{config.what}.json", out / f"{config.what}.md"


def _command(config: Any, program: str) -> str:
    """The command line that repeats the measurement."""
    words = [program, config.what]
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name not in _NOT_MEASURED and value != field.default:
            words += [f"--{field.name.replace('_', '-')}", *([] if value is True else [str(value)])]
    return " ".join(words)


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
