"""What is kept of one frame, as plain dataclasses: samples around its certain failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesem.failures.rare import Share
from drivesem.failures.rules import Flags, Floats
from drivesem.run.records import dump_record, load_record

SCHEMA = 3
HOLES, FRESH, RECHECK = "holes.json", "fresh.json", "recheck.json"
"""The files that mark a frame as done: its samples, and further ones inside of rules."""


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


def joined(parts: Sequence[Samples]) -> Samples:
    """All samples, of the same features."""
    some = [part for part in parts if part.margins]
    names = some[0].names if some else ()
    values = tuple(row for part in some for row in part.values)
    return Samples(names, values, tuple(margin for part in some for margin in part.margins))


@dataclass(frozen=True, slots=True)
class Around:
    """Around one certain failure. index: of the object; error, grade: of the failure; asked: samples of the whole
    neighbourhood; near: of the part of it around the failure, as a hole may be small; lost: in how much of the
    whole the object is lost.
    """

    index: int
    label: str
    error: str
    grade: str
    asked: Samples
    near: Samples
    lost: Share


@dataclass(frozen=True, slots=True)
class Beside:
    """Samples of all objects of a class, anywhere within the bounds, lost or not. objects: of each sample."""

    label: str
    objects: tuple[int, ...]
    samples: Samples

    def by_object(self) -> dict[int, Samples]:
        """The samples of each."""
        found: dict[int, Samples] = {}
        for index in dict.fromkeys(self.objects):
            rows = [row for row, of in enumerate(self.objects) if of == index]
            values, margins = self.samples.values, self.samples.margins
            found[index] = Samples(
                self.samples.names, tuple(values[row] for row in rows), tuple(margins[row] for row in rows)
            )
        return found


@dataclass(frozen=True, slots=True)
class FrameHoles:
    """One frame. source: digest of the run's result; beside: by class. `seconds` alone may differ between two
    calls.
    """

    identifier: str
    source: str
    around: tuple[Around, ...]
    beside: tuple[Beside, ...]
    passes: int
    seconds: float


@dataclass(frozen=True, slots=True)
class FrameInside:
    """Of one frame, further samples inside of the rule of each of its failures. source: digest of the run's
    result; indices: of the objects.
    """

    identifier: str
    source: str
    indices: tuple[int, ...]
    inside: tuple[Samples, ...]
    passes: int
    seconds: float


def dump(result: FrameHoles | FrameInside) -> str:
    """JSON text."""
    return dump_record(result, SCHEMA)


def load(path: Path) -> FrameHoles:
    """Read what `dump` gave. Raises FormatError naming the file."""
    return load_record(path, FrameHoles, SCHEMA)


def load_inside(path: Path) -> FrameInside:
    """The same of further samples."""
    return load_record(path, FrameInside, SCHEMA)
