"""Several folders of one layout as one data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from drivesem.data.registry import Dataset, open_dataset
from scene_ir.types import Frame, Labels


class JoinedDataset:
    """The frames of several data sets, one after the other. Identifiers: "NUMBER/IDENTIFIER", numbers from 0."""

    def __init__(self, datasets: Sequence[Dataset]) -> None:
        self._datasets = tuple(datasets)

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, in the order of the data sets, each sorted."""
        return tuple(f"{i}/{name}" for i, dataset in enumerate(self._datasets) for name in dataset.identifiers)

    def labels(self, identifier: str) -> Labels | None:
        """The labels of one frame; None where its data set has none."""
        dataset, name = self._of(identifier)
        return dataset.labels(name)

    def frame(self, identifier: str) -> Frame:
        """One frame. FormatError naming the file where something is wrong with it."""
        dataset, name = self._of(identifier)
        return dataset.frame(name)

    def _of(self, identifier: str) -> tuple[Dataset, str]:
        number, _, name = identifier.partition("/")
        return self._datasets[int(number)], name


def open_folders(name: str, roots: str) -> Dataset:
    """The data set `name` in a folder, or in several with commas between. Raises as `open_dataset` does."""
    folders = [Path(part) for part in roots.split(",") if part]
    if len(folders) < 2:
        return open_dataset(name, roots)
    return JoinedDataset([open_dataset(name, folder) for folder in folders])
