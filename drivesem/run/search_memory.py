"""What the search `learn` knows of finished frames."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivesem.attacks.methods.learned import MIN_ROWS, MarginModel
from drivesem.failures.search_log import OBJECT_FEATURES
from scene_ir import files
from scene_ir.errors import FormatError

MARGINS = "margins.npz"
"""File of a frame: features and margins of its search, and the passes that it took."""
_INTERVAL = 4
"""The model is fitted anew after so many frames."""


@dataclass(frozen=True, slots=True)
class SearchedFrame:
    """What a search leaves for other frames."""

    rows: np.ndarray
    """(R, F + 1), see `SearchLog.margin_rows`."""
    passes: int
    """Detector passes that it took."""


@dataclass
class SearchMemory:
    """Finished frames, and the model of them."""

    _frames: dict[str, SearchedFrame] = field(default_factory=dict[str, SearchedFrame])
    """By identifier."""
    _damaged: set[str] = field(default_factory=set[str])
    """Frames with a file that cannot be read."""
    _frames_in_model: tuple[str, ...] = ()
    """Frames of the last fit."""
    _model: MarginModel | None = None
    """The last fit."""

    def add(self, identifier: str, frame: SearchedFrame) -> None:
        """Add a finished frame."""
        self._frames[identifier] = frame

    def read(self, folder: Path) -> None:
        """Add the frames in a run's folder of frames. A damaged file is named on standard error, and left out."""
        for path in sorted(folder.glob(f"*/{MARGINS}")):
            if path.parent.name in self._frames or path.parent.name in self._damaged:
                continue
            try:
                self.add(path.parent.name, read_searched_frame(path))
            except FormatError as error:
                sys.stderr.write(f"{error}; the search goes on without this frame\n")
                self._damaged.add(path.parent.name)

    def model(self) -> MarginModel | None:
        """A model of the frames, None for too few rows. The same frames give the same model."""
        frames = tuple(sorted(self._frames))
        frames = frames[: len(frames) // _INTERVAL * _INTERVAL]
        if frames != self._frames_in_model:
            rows = np.concatenate([self._frames[frame].rows for frame in frames])
            self._model = MarginModel(rows) if len(rows) >= MIN_ROWS else None
            self._frames_in_model = frames
        return self._model

    def allowance(self, passes: int) -> int:
        """Passes that the next frame may take, of `passes` in the mean: what earlier frames left is added, at most as
        much again.
        """
        left = sum(passes - frame.passes for frame in self._frames.values())
        return passes + min(max(left, 0), passes)


def write_searched_frame(path: Path, frame: SearchedFrame) -> None:
    """Write what `read_searched_frame` reads."""
    files.write_npz(path, {"rows": frame.rows, "passes": np.array(frame.passes)})


def read_searched_frame(path: Path) -> SearchedFrame:
    """Read a frame. Raises FormatError for a damaged file."""
    data, columns = files.read_npz(path), len(OBJECT_FEATURES) + 1
    rows, passes = data.get("rows"), data.get("passes")
    if rows is None or rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        expected = f"rows of {columns} finite numbers"
        raise FormatError(str(path), expected, "none" if rows is None else f"others, of shape {rows.shape}")
    if passes is None or passes.shape or passes.dtype.kind not in "iu":
        raise FormatError(str(path), "a number of passes", "none" if passes is None else "another value")
    return SearchedFrame(rows.astype(np.float32), int(passes))
