"""What is kept of one frame, as plain dataclasses: samples around its certain failures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesem.run.records import dump_record, load_record
from drivesem.truth.rare import Share
from drivesem.truth.rules import Flags, Floats

SCHEMA = 2
HOLES, RECHECK = "holes.json", "recheck.json"
"""The files that mark a frame as done: its rules, and further samples inside of them."""


@dataclass(frozen=True, slots=True)
class Samples:
    """names: of features; values: a row a sample; margins: logits beyond t*, below 0 where the object was not
    found."""

    names: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]
    margins: tuple[float, ...]

    def columns(self) -> dict[str, Floats]:
        """Features (n,) by name."""
        table = np.array(self.values, np.float64).reshape(len(self.values), len(self.names))
        return {name: table[:, i] for i, name in enumerate(self.names)}

    @property
    def failing(self) -> Flags:
        """(n,)."""
        return np.array(self.margins, np.float64) < 0


@dataclass(frozen=True, slots=True)
class Around:
    """Around one certain failure. index: of the object; error, grade: of the failure; asked: samples of the whole
    neighbourhood; near: of the part of it around the failure, as a hole may be small; where: the rule of both;
    fresh: further ones of the whole, inside of the rule, which it is held against; lost: in how much of the whole
    the object is lost.
    """

    index: int
    label: str
    error: str
    grade: str
    asked: Samples
    near: Samples
    where: dict[str, tuple[float, float]]
    fresh: Samples
    lost: Share


@dataclass(frozen=True, slots=True)
class FrameHoles:
    """One frame. source: digest of the run's result. `seconds` alone may differ between two calls."""

    identifier: str
    source: str
    around: tuple[Around, ...]
    passes: int
    seconds: float


@dataclass(frozen=True, slots=True)
class FrameRecheck:
    """Of one frame, samples inside of the rule around each of its failures, by seeds that neither the rule nor its
    probability knew. source: digest of the run's result; indices: of the objects.
    """

    identifier: str
    source: str
    indices: tuple[int, ...]
    inside: tuple[Samples, ...]
    passes: int
    seconds: float


def dump(result: FrameHoles | FrameRecheck) -> str:
    """JSON text."""
    return dump_record(result, SCHEMA)


def load(path: Path) -> FrameHoles:
    """Read what `dump` gave. Raises FormatError naming the file."""
    return load_record(path, FrameHoles, SCHEMA)


def load_recheck(path: Path) -> FrameRecheck:
    """The same of further samples."""
    return load_record(path, FrameRecheck, SCHEMA)
