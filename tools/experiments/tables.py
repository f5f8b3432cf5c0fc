"""Dataclass rows as CSV tables, and a study's metadata as JSON, read back with one-line errors."""

from __future__ import annotations

import csv
import gzip
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from drivesem.config.errors import UsageError
from drivesem.config.options import format_command_line
from drivesem.evaluation.resampling import Interval
from drivesem.run.records import load_record
from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from tools.experiments.settings import StudyConfig

RESULTS = "results"
"""Folder of a study's stored results, inside the study's folder."""
METADATA = "study.json"
"""File in it with the study's settings and what is no table."""
SCHEMA = 2
UNRECORDED = ("out", "json", "resume", "workers")
"""Settings that do not describe a study."""
_MAX_BYTES = 1 << 28
_MAX_DRAWS = 100_000
T = TypeVar("T")
_PARSERS: dict[Any, Callable[[str], Any]] = {
    str: str,
    int: int,
    float: float,
    bool: {"True": True, "False": False}.__getitem__,
}


def interval_columns(name: str, interval: Interval, digits: int | None = None) -> dict[str, float | None]:
    """The columns `name`, `name_low` and `name_high` of a CSV or JSON row; digits: decimals, by default all."""
    values = {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    if digits is None:
        return values
    return {key: None if value is None else round(value, digits) for key, value in values.items()}


def write_table(path: Path, kinds: Sequence[type[Any]], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV table, with gzip if the name ends in .gz; equal rows give equal bytes.

    Args:
        path: File to write.
        kinds: Dataclasses, side by side in a row; each scalar field is a column.
        rows: For each row one instance of each of the dataclasses.
    """
    columns = [list(_columns(kind)) for kind in kinds]
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(name for names in columns for name in names)
    for row in rows:
        writer.writerow(getattr(part, name) for part, names in zip(row, columns, strict=True) for name in names)
    data = buffer.getvalue().encode()
    files.write_bytes(path, gzip.compress(data, mtime=0) if path.suffix == ".gz" else data)


def read_table(path: Path, kinds: Sequence[type[Any]]) -> list[tuple[Any, ...]]:
    """Read what `write_table` wrote: for each row one instance of each of the dataclasses.

    Raises:
        FormatError: Naming file, line and column, for other columns or a cell of another type.
    """
    data = files.read_gzip(path, _MAX_BYTES) if path.suffix == ".gz" else files.read_bytes(path, _MAX_BYTES)
    lines = csv.reader(io.StringIO(files.decode_utf8(data, path), newline=""))
    parsers = [_columns(kind) for kind in kinds]
    names = [name for columns in parsers for name in columns]
    heading = next(lines, [])
    if heading != names:
        raise FormatError(str(path), f"columns {', '.join(names)}", ", ".join(heading) or "none")
    rows = []
    for cells in lines:
        if len(cells) != len(names):
            raise FormatError(f"{path}:{lines.line_num}", f"{len(names)} cells", len(cells))
        cell, row = iter(cells), []
        for kind, columns in zip(kinds, parsers, strict=True):
            values = {
                name: _parse(parse, next(cell), path, lines.line_num, name) for name, parse in columns.items()
            }
            row.append(kind(**values))
        rows.append(tuple(row))
    return rows


def _parse(parse: Callable[[str], Any], cell: str, path: Path, line: int, column: str) -> Any:
    try:
        return parse(cell)
    except (ValueError, KeyError) as error:
        raise FormatError(f"{path}:{line}: {column}", "a value of this column", repr(cell)) from error


@cache
def _columns(kind: type[Any]) -> dict[str, Callable[[str], Any]]:
    """The scalar fields of a dataclass, each with what parses a cell; an empty cell of an optional one is None."""
    columns: dict[str, Callable[[str], Any]] = {}
    for name, hint in get_type_hints(kind).items():
        parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        parse = next((_PARSERS[part] for part in parts if part in _PARSERS), None)
        if parse is not None:
            columns[name] = partial(_parse_optional, parse) if NoneType in parts else parse
    return columns


def _parse_optional(parse: Callable[[str], Any], cell: str) -> Any:
    return parse(cell) if cell else None


def study_settings(study: StudyConfig) -> dict[str, Any]:
    """The settings that describe a study."""
    return {name: value for name, value in asdict(study).items() if name not in UNRECORDED}


def study_command(study: StudyConfig) -> str:
    """The command that repeats a study."""
    line = format_command_line("study", study, (*UNRECORDED, "name"))
    return line.replace("drivesem study", f"python -m tools.experiments {study.name}", 1)


def read_metadata(folder: Path, kind: type[T], name: str) -> T:
    """Read METADATA as a dataclass with the study's settings in its field `settings`.

    Raises FormatError unless it is of a study called `name` with valid settings.
    """
    path = folder / METADATA
    data = files.read_json(path)
    recorded = data.get("settings") if isinstance(data, dict) else None
    found = recorded.get("name") if isinstance(recorded, dict) else None
    if found != name:
        raise FormatError(f"{path}: settings.name", name, found)
    metadata: Any = load_record(path, kind, SCHEMA)
    settings: StudyConfig = metadata.settings
    try:
        replace(settings, pace=None).check()  # the folder that --pace named may be gone
    except UsageError as error:
        raise FormatError(f"{path}: settings: {error.field}", error.expected, error.actual) from error
    if settings.seed < 0 or (settings.bootstrap or 0) > _MAX_DRAWS:
        found = f"{settings.seed} and {settings.bootstrap}"
        raise FormatError(f"{path}: settings", f"a seed from 0, at most {_MAX_DRAWS} bootstrap draws", found)
    return metadata


def write_metadata(folder: Path, study: StudyConfig, **facts: Any) -> None:
    """Write METADATA: the study's settings and further facts."""
    files.write_json(folder / METADATA, {"schema": SCHEMA, "settings": study_settings(study), **facts})


@contextmanager
def matching_tables(folder: Path) -> Iterator[None]:
    """Report tables of one study that do not fit together as one FormatError."""
    try:
        yield
    except SceneError:
        raise
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise FormatError(str(folder), "tables that fit together", repr(error)) from error
