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

from drivesem.bench import tables
from drivesem.bench.timing import machine_facts, package_versions
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.report.terminal import Console
from scene_ir import files

T = TypeVar("T")

_LOG_WIDTH = 120
"""Width of tables written to a file, columns."""
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
    console = Console(stderr=True, width=None if sys.stderr.isatty() else _LOG_WIDTH)
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
