"""Cells of an object's features, and how often a search visited them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

CELL_EDGES: Mapping[str, tuple[float, ...]] = {
    "height_px": (40.0, 80.0),
    "contrast": (0.1, 0.2),
    "across": (1 / 3, 2 / 3),
    "light": (0.25,),
}
"""Inner edges of the cells by feature; fixed, so that runs compare and merge. Height, contrast and place are those of
`detectors.planted.FEATURES`: 40 px is the limit of KITTI's easy class, twice that a near car; the contrasts split the
cars of KITTI and BDD100K roughly in three. light is the mean of the picture in [0, 1]: 95 % of BDD100K's night
pictures are below 0.25, and 95 % of its day pictures above 0.3.
"""
LEVEL_NAMES: Mapping[str, tuple[str, ...]] = {
    "height_px": ("under 40 px", "40 to 80 px", "from 80 px"),
    "contrast": ("low contrast", "medium contrast", "high contrast"),
    "across": ("left", "middle", "right"),
    "light": ("dark", "bright"),
}
"""Names of the levels between the edges."""
Cell = tuple[int, int, int, int]
"""Level of each feature, in the order of `CELL_EDGES`."""


@dataclass(frozen=True, slots=True)
class CellVisit:
    """How often one object lay in a cell in the states that a search evaluated."""

    index: int
    """Number of the object."""
    cell: Cell
    """The cell."""
    passes: int
    """Detector passes with the object in it; a gradient counts as 3."""
    misses: int
    """Evaluated states in which it is missed there."""
    final: bool = False
    """Whether it lies there in the counterexample."""
    random: int = 0
    """Evaluated states that no score influenced."""
    random_misses: int = 0
    """Of these, states in which it is missed."""
    photographed: bool = False
    """Whether it lies there in the photograph."""
