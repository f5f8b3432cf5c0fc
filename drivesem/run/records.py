"""Dataclasses as JSON, and back from what `dataclasses.asdict` and JSON made of them."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from scene_ir import files
from scene_ir.errors import FormatError

T = TypeVar("T")
_hints = functools.cache(get_type_hints)


def from_json(kind: Any, value: Any) -> Any:
    """A value of a type: dataclasses, tuples and dicts of others are built again, all else is as JSON has it.
    Raises KeyError, TypeError or AttributeError where the value was not made of the type.
    """
    if dataclasses.is_dataclass(kind):
        return kind(**{name: from_json(_hints(kind)[name], part) for name, part in value.items()})  # pyright: ignore[reportCallIssue]
    if get_origin(kind) is tuple:
        return tuple(from_json(get_args(kind)[0], part) for part in value)
    if isinstance(kind, UnionType):
        whole = next((part for part in get_args(kind) if dataclasses.is_dataclass(part)), None)
        return value if whole is None or value is None else from_json(whole, value)
    if get_origin(kind) is dict:
        return {name: from_json(get_args(kind)[1], part) for name, part in value.items()}
    return value


def dump_record(record: Any, schema: int) -> str:
    """JSON text of a dataclass, with the version of its fields. ValueError where a number is not finite."""
    return json.dumps({"schema": schema, **dataclasses.asdict(record)}, indent=1, allow_nan=False) + "\n"


def load_record(path: Path, kind: type[T], schema: int, what: str) -> T:
    """Read what `dump_record` gave. what: it is, for people. Raises FormatError naming the file."""
    data = files.read_json(path)
    if not isinstance(data, dict) or data.pop("schema", None) != schema:
        raise FormatError(f"{path}: schema", str(schema), "another one")
    try:
        return from_json(kind, data)
    except (AttributeError, KeyError, TypeError) as error:
        raise FormatError(str(path), what, error) from error
