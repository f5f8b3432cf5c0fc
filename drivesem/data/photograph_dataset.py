"""Labelled photographs without cameras: the reader of all layouts that have nothing more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from drivesem.data.account import DataAccount
from drivesem.data.label_table import LabelTable
from drivesem.data.photographs import FrameIndex, check_focal, read_labelled_photograph
from scene_ir.errors import FormatError
from scene_ir.types import Frame, Labels


class LabelFiles(Protocol):
    """The label files of a data set, and the images that they label."""

    @property
    def layout(self) -> str:
        """Layout."""
        ...

    @property
    def sources(self) -> Mapping[str, Path]:
        """Label file of each frame, by identifier, sorted."""
        ...

    @property
    def images(self) -> Mapping[str, Path]:
        """Image of each frame that has one, by identifier."""
        ...

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split."""
        ...

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that the data set states of a frame."""
        ...

    def table(self, identifiers: Sequence[str]) -> LabelTable:
        """Read the labels of frames, in pixels of the upright images; sizes are 0 where unknown."""
        ...

    def account(self) -> DataAccount:
        """Account for all files and label rows."""
        ...


class PhotographDataset(FrameIndex[Path]):
    """The frames of a data set of labelled photographs; an image may be missing until its frame is read.

    Images are turned upright by EXIF. Truncation and 3D boxes that are unknown are NaN, unknown occlusion is 3.

    Args:
        files: Labels and images.
        focal_px: Focal length of all images; by default EXIF's, or DEFAULT_FOCAL.
    """

    def __init__(self, files: LabelFiles, focal_px: float | None = None) -> None:
        check_focal(focal_px)
        super().__init__(f"the {files.layout} folder", files.sources)
        self.focal_px = focal_px
        self._files = files

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split, where the data set has splits."""
        return self._files.splits()

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that the data set states of a frame, such as weather and timeofday."""
        self._entry(identifier)
        return self._files.attributes(identifier)

    def account(self) -> DataAccount:
        """Account for all files and label rows; reads all labels."""
        return self._files.account()

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame. Raises FormatError naming file and field."""
        self._entry(identifier)
        return self._files.table((identifier,)).to_labels()

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels.

        Raises FormatError naming a damaged or missing image, or one of another size than its labels state.
        """
        source, path = self._entry(identifier), self._files.images.get(identifier)
        if path is None:
            raise FormatError(str(source), f"an image of frame {identifier!r} in the data set", "none")
        table = self._files.table((identifier,))  # refuses an image of another size
        provenance = {"dataset": self._files.layout, "image": path.name, "folder": path.parent.name}
        return read_labelled_photograph(identifier, path, table.to_labels(), provenance, self.focal_px)
