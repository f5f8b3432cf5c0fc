"""What every benchmark's command shares: figures shown and written beside machine, versions and command line."""

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
from drivesem.bench.timing import machine, versions
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.report.terminal import Console
from scene_ir import files

T = TypeVar("T")

_LOG_WIDTH = 120
"""Columns of tables that go to a file."""
_NOT_MEASURED = ("what", "json", "out", "markdown")
"""Settings that do not change figures."""


class BenchSettings(Protocol):
    """What all benchmarks are told. what: which one; markdown: a file one section of which is written anew."""

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
class Measured:
    """What a benchmark found: the fields of its JSON object, rows and method among them, and what is shown."""

    fields: dict[str, Any]
    sections: Sequence[tables.Section]


def conduct(config: S, program: str, measure: Callable[[S, Console], Measured]) -> int:
    """Measure, print, write; exit code 0. program: the words before the benchmark's name on the command line.

    Raises UsageError for a device or a place for results that cannot be, and what `measure` raises.
    """
    start = time.perf_counter()
    targets = targets_of(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    check_device(config.device)
    console = Console(stderr=True, width=None if sys.stderr.isatty() else _LOG_WIDTH)
    measured = measure(config, console)
    result = {
        "what": config.what,
        **measured.fields,
        "machine": machine(config.device),
        "versions": versions(),
        "command": _command(config, program),
        "seconds": round(time.perf_counter() - start, 3),
    }
    for section in measured.sections:
        console.print(tables.terminal(section))
    if targets is not None:
        files.write_json(targets[0], result)
        files.write_text(targets[1], tables.markdown(result, measured.sections))
    if config.markdown is not None:
        tables.rewrite(Path(config.markdown), result, measured.sections)
    if config.json:
        sys.stdout.write(json.dumps(result, allow_nan=False) + "\n")
    return 0


def watched(rows: Iterable[T], total: int, console: Console) -> Iterator[T]:
    """The same rows; says how far it has come."""
    with console.status("measuring") as status:
        for done, row in enumerate(rows, start=1):
            status.update(f"measuring: {done} rows of about {total}")
            yield row


def targets_of(config: BenchSettings) -> tuple[Path, Path] | None:
    """Where JSON and Markdown go: files in the folder `--out`, or FILE.json and FILE.md."""
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
    """The command line that measures this again."""
    words = [program, config.what]
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name not in _NOT_MEASURED and value != field.default:
            words += [f"--{field.name.replace('_', '-')}", *([] if value is True else [str(value)])]
    return " ".join(words)
