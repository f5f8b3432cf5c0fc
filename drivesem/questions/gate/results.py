"""What is kept of one frame, as plain dataclasses: the same samples before two detectors."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from drivesem.run.records import from_json
from scene_ir import files
from scene_ir.errors import FormatError

SCHEMA = 1
GATE = "gate.json"
"""The file that marks a frame as done."""


@dataclass(frozen=True, slots=True)
class Pair:
    """One certain failure's neighbourhood. index: of the object; error: kind of the failure; before, after: by
    sample, whether either detector does not find the object.
    """

    index: int
    label: str
    error: str
    before: tuple[bool, ...]
    after: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class FrameGate:
    """One frame. source: digest of the run's result. `seconds` alone may differ between two calls."""

    identifier: str
    source: str
    pairs: tuple[Pair, ...]
    seconds: float


def dump(result: FrameGate) -> str:
    """JSON text."""
    return json.dumps({"schema": SCHEMA, **asdict(result)}, allow_nan=False) + "\n"


def load(path: Path) -> FrameGate:
    """Read what `dump` gave. Raises FormatError naming the file."""
    data = files.read_json(path)
    if not isinstance(data, dict) or data.pop("schema", None) != SCHEMA:
        raise FormatError(f"{path}: schema", str(SCHEMA), "another one")
    try:
        return from_json(FrameGate, data)
    except (AttributeError, KeyError, TypeError) as error:
        raise FormatError(str(path), "the fields of a frame's gate", error) from error
