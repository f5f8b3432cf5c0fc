"""The map of a run: which cells of features its search visited, what fails there, and what is known to hold.

The unit of every share is the frame: objects of one picture and passes on it are not independent. The bound of a cell
is the one-sided 95 % limit of Clopper and Pearson on the share of frames in which such a search sees an object of the
cell missed, of the frames that have one.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from drivesem.failures.feature_cells import CELL_EDGES, LEVEL_NAMES, Cell, CellVisit
from drivesem.reporting.tables import format_count

LEVEL = 0.95
"""Confidence of bounds."""
CLEAR_BELOW = 0.1
"""Bound below which a cell is clear: no miss in 29 frames, or one in 46."""
CellState = Literal["failing", "clear", "missed", "unknown"]
"""failing: certain failures; clear: none, and a bound under `CLEAR_BELOW`; missed: misses that are not certain;
unknown: no miss, but too few frames."""
SearchedFrame = tuple[str, Sequence[CellVisit], Collection[int | None]]
"""Name of a frame, its visits, and the objects that are lost for certain in its counterexample."""
CELLS: tuple[Cell, ...] = tuple(
    (size, contrast, across, light)
    for size, contrast, across, light in itertools.product(
        *(range(len(edges) + 1) for edges in CELL_EDGES.values())
    )
)
"""All cells."""


@dataclass(frozen=True, slots=True)
class MapCell:
    """What a run knows of one cell."""

    where: dict[str, str]
    """Name of its level by feature."""
    state: CellState
    """What is known."""
    objects: int
    """Objects that lay in it, as photographed or after a change."""
    frames: int
    """Frames with such an object."""
    passes: int
    """Detector passes with an object in it, for each of its objects; a gradient counts as 3."""
    frames_missed: int
    """Frames of these in which such an object was missed in any pass."""
    missed_below: float
    """One-sided 95 % upper limit on the share of such frames, in [0, 1]."""
    certain: int
    """Objects that are lost for certain in it."""
    failures: tuple[tuple[str, int], ...] = ()
    """Frame and number of each of these objects."""

    def describe(self) -> str:
        """Such as `under 40 px, low contrast, left, dark: 3 certain of 12 objects`."""
        return f"{self.name}: {self.finding}"

    @property
    def name(self) -> str:
        """Such as `under 40 px, low contrast, left, dark`."""
        return ", ".join(self.where.values())

    @property
    def finding(self) -> str:
        """The evidence in one line."""
        if self.state == "failing":
            return f"{self.certain} certain of {format_count(self.objects, 'object')}"
        missed = f"{self.frames_missed} of {format_count(self.frames, 'frame')}"
        return f"{missed}, under {100 * self.missed_below:.2g} %" if self.state == "clear" else missed


@dataclass(frozen=True, slots=True)
class FailureMap:
    """The map of a run."""

    cells: tuple[MapCell, ...] = ()
    """Visited cells, in the order of `CELLS`."""
    searched: int = 0
    """Number of visited cells."""
    failing: int = 0
    """Of these, failing ones."""
    clear: int = 0
    """Of these, clear ones."""
    frames_without_record: int = 0
    """Frames left out, as the version that attacked them has no record of the search."""

    @classmethod
    def from_frames(cls, frames: Sequence[SearchedFrame]) -> FailureMap:
        """Build the map of a run's frames with judged vehicles."""
        known = [frame for frame in frames if frame[1]]
        by_cell = {cell: _map_cell(cell, known) for cell in sorted({v.cell for _, vs, _ in known for v in vs})}
        states = [cell.state for cell in by_cell.values()]
        counts = (states.count("failing"), states.count("clear"), len(frames) - len(known))
        return cls(tuple(by_cell.values()), len(by_cell), *counts)

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        data = asdict(self)
        cells = [cell | {"failures": [list(pair) for pair in cell["failures"]]} for cell in data["cells"]]
        return data | {"cells": cells}

    def cells_by_failure(self) -> dict[tuple[str, int], str]:
        """Return the name of its cell for each certain failure, given as frame and number of the object."""
        return {failure: cell.name for cell in self.cells for failure in cell.failures}

    @property
    def columns(self) -> list[tuple[str, str]]:
        """Light and place of each column of `grid`."""
        return list(itertools.product(LEVEL_NAMES["light"], LEVEL_NAMES["across"]))

    def grid(self) -> list[tuple[str, str, list[MapCell | None]]]:
        """Rows of a table: size, contrast, and the cells of all places in the dark, then in bright light; None where
        nothing was searched.
        """
        by_levels = {tuple(cell.where.values()): cell for cell in self.cells}
        rows = itertools.product(LEVEL_NAMES["height_px"], LEVEL_NAMES["contrast"])
        return [
            (size, contrast, [by_levels.get((size, contrast, place, light)) for light, place in self.columns])
            for size, contrast in rows
        ]

    def describe(self) -> str:
        """Describe the map in one line."""
        failing = max((cell for cell in self.cells if cell.certain), key=lambda cell: cell.certain, default=None)
        worst = f" (most: {failing.describe()})" if failing else ""
        left_out = format_count(self.frames_without_record, "frame")
        return (
            f"map: {self.searched} of {len(CELLS)} cells of size, contrast, place and light searched; "
            f"{self.failing} failing{worst}, {self.clear} clear (misses in under {100 * CLEAR_BELOW:.0f} % of frames)"
            f"{f'; {left_out} without a record of the search' if self.frames_without_record else ''}"
        )


def upper_limit(found: int, count: int) -> float:
    """One-sided 95 % upper limit of a proportion (Clopper and Pearson 1934): of 0 out of 59 it is 5 %."""
    from scipy.special import betaincinv  # imported on use: it takes a tenth of a second

    return 1.0 if found >= count else float(betaincinv(found + 1, count - found, LEVEL))


def _map_cell(cell: Cell, frames: Sequence[SearchedFrame]) -> MapCell:
    here = [(name, [v for v in visits if v.cell == cell], certain) for name, visits, certain in frames]
    here = [frame for frame in here if frame[1]]
    missed = sum(any(visit.misses for visit in visits) for _, visits, _ in here)
    lost = sorted((name, v.index) for name, vs, certain in here for v in vs if v.final and v.index in certain)
    limit = upper_limit(missed, len(here))
    state: CellState = "missed" if missed else "unknown"
    if lost or limit < CLEAR_BELOW:
        state = "failing" if lost else "clear"
    return MapCell(
        where={name: LEVEL_NAMES[name][level] for name, level in zip(CELL_EDGES, cell, strict=True)},
        state=state,
        objects=sum(len(visits) for _, visits, _ in here),
        frames=len(here),
        passes=sum(visit.passes for _, visits, _ in here for visit in visits),
        frames_missed=missed,
        missed_below=round(limit, 4),
        certain=len(lost),
        failures=tuple(lost),
    )
