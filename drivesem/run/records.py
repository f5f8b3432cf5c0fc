"""Converts dataclasses to JSON, and back."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from scene_ir import files
from scene_ir.errors import FormatError

T = TypeVar("T")
_hints = functools.cache(get_type_hints)


def from_json(kind: Any, value: Any, where: str) -> Any:
    """Restore a value from what `dataclasses.asdict` and JSON made of it.

    Args:
        kind: Type of the value: a dataclass, tuple, dict or plain type.
        value: The JSON value.
        where: Name of the file, for errors.

    Raises:
        FormatError: A field is missing, unknown, or of another type.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _parse_record(kind, value, where)
    if origin is tuple:
        _require(isinstance(value, list), where, "a list", value)
        kinds = parts[:1] * len(value) if parts[1:] == (...,) else parts
        _require(len(value) == len(kinds), where, f"{len(kinds)} values", value)
        return tuple(from_json(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))
    if origin is dict:
        _require(isinstance(value, dict), where, "an object", value)
        return {name: from_json(parts[1], part, f"{where}.{name}") for name, part in value.items()}
    if isinstance(kind, UnionType) or origin is Union:
        (whole,) = (part for part in parts if part is not NoneType)
        return None if value is None else from_json(whole, value, where)
    if origin is Literal:
        _require(value in parts, where, f"one of {', '.join(map(str, parts))}", value)
    if kind in _TYPE_NAMES:
        known = type(value) in ((int, float) if kind is float else (kind,))
        _require(known and (kind is not float or math.isfinite(value)), where, _TYPE_NAMES[kind], value)
    return value


_TYPE_NAMES = {str: "text", int: "an integer", float: "a finite number", bool: "true or false"}


def _parse_record(kind: Any, value: Any, where: str) -> Any:
    _require(isinstance(value, dict), where, "an object", value)
    own = dataclasses.fields(kind)
    for name in value.keys() - {field.name for field in own}:
        raise FormatError(f"{where}: {name}", f"a field of {kind.__name__}", "an unknown one")
    for field in own:
        optional = (field.default, field.default_factory) != (dataclasses.MISSING, dataclasses.MISSING)
        _require(field.name in value or optional, f"{where}: {field.name}", "a value", None)
    return kind(**{name: from_json(_hints(kind)[name], part, f"{where}: {name}") for name, part in value.items()})


def _require(good: bool, where: str, expected: str, found: object) -> None:
    if not good:
        raise FormatError(where, expected, "nothing" if found is None else repr(found)[:60])


def dump_record(record: Any, schema: int) -> str:
    """Return a dataclass as JSON text, with the version of its fields. Raises ValueError if a number is not
    finite.
    """
    return json.dumps({"schema": schema, **dataclasses.asdict(record)}, indent=1, allow_nan=False) + "\n"


def load_record(path: Path, kind: type[T], schema: int) -> T:
    """Load a dataclass from a file of `dump_record`.

    Args:
        path: The file.
        kind: The dataclass.
        schema: Version of its fields.

    Raises:
        FormatError: The file is damaged, or another version of drivesem wrote it.
    """
    data = files.read_json(path)
    found = data.pop("schema", None) if isinstance(data, dict) else None
    if found != schema:
        raise FormatError(f"{path}: schema", str(schema), f"{found!r}, of another version of drivesem")
    return from_json(kind, data, str(path))
