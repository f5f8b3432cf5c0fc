"""Data sets by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from drivesem.data.kitti import KittiDataset
from scene_ir.errors import RangeError
from scene_ir.types import Frame, Labels


class Dataset(Protocol):
    """What every reader offers: frames by identifier, in a fixed order."""

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        ...

    def labels(self, identifier: str) -> Labels | None:
        """The labels of one frame, without decoding its image; None where the data set has none."""
        ...

    def frame(self, identifier: str) -> Frame:
        """One frame. FormatError naming the file where something is wrong with it."""
        ...


DATASETS: dict[str, Callable[[Path], Dataset]] = {"kitti": KittiDataset}
"""Readers by the name that the command line takes."""


def open_dataset(name: str, root: Path | str) -> Dataset:
    """The data set `name` under `root`. RangeError for an unknown name, FormatError for a bad folder."""
    if name not in DATASETS:
        raise RangeError("dataset", f"one of {', '.join(sorted(DATASETS))}", name)
    return DATASETS[name](Path(root))
