"""What is kept of one frame, as plain dataclasses: the same samples before two detectors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivesem.run.records import dump_record, load_record

SCHEMA = 2
GATE = "gate.json"
"""The file that marks a frame as done."""


@dataclass(frozen=True, slots=True)
class Pair:
    """One certain failure's neighbourhood. index: of the object, None where a picture is of one; error: kind of
    the failure; before, after: by sample, whether either detector does not find the object; phantoms_before,
    phantoms_after: by sample, whether it reports anything where nothing is, in the whole picture.
    """

    index: int | None
    label: str
    error: str
    before: tuple[bool, ...]
    after: tuple[bool, ...]
    phantoms_before: tuple[bool, ...] = ()
    phantoms_after: tuple[bool, ...] = ()


@dataclass(frozen=True, slots=True)
class FrameGate:
    """One frame. source: digest of the run's result. `seconds` alone may differ between two calls."""

    identifier: str
    source: str
    pairs: tuple[Pair, ...]
    seconds: float


def dump(result: FrameGate) -> str:
    """JSON text."""
    return dump_record(result, SCHEMA)


def load(path: Path) -> FrameGate:
    """Read what `dump` gave. Raises FormatError naming the file."""
    return load_record(path, FrameGate, SCHEMA)
