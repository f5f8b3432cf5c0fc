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
"""File of a frame's rows: features and margins of its search."""
_FRAMES = 4
"""The model is fitted anew after so many frames."""


@dataclass
class SearchMemory:
    """Rows of finished frames, and the model of them."""

    _rows: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """(R, F + 1) by frame."""
    _frames_in_model: tuple[str, ...] = ()
    """Frames of the last fit."""
    _model: MarginModel | None = None
    """The last fit."""

    def add(self, frame: str, rows: np.ndarray) -> None:
        """Add the rows (R, F + 1) of a frame, see `SearchLog.margin_rows`."""
        self._rows[frame] = rows

    def read(self, folder: Path) -> None:
        """Add the frames in a run's folder of frames. A damaged file is named on standard error, and left out."""
        for path in sorted(folder.glob(f"*/{MARGINS}")):
            if path.parent.name in self._rows:
                continue
            try:
                rows = read_margin_rows(path)
            except FormatError as error:
                sys.stderr.write(f"{error}; the search goes on without this frame\n")
                rows = np.empty((0, len(OBJECT_FEATURES) + 1), np.float32)
            self.add(path.parent.name, rows)

    def model(self) -> MarginModel | None:
        """A model of the frames, None for too few rows. The same frames give the same model."""
        frames = tuple(sorted(self._rows))
        frames = frames[: len(frames) // _FRAMES * _FRAMES]
        if frames != self._frames_in_model:
            rows = np.concatenate([self._rows[frame] for frame in frames])
            self._model = MarginModel(rows) if len(rows) >= MIN_ROWS else None
            self._frames_in_model = frames
        return self._model


def read_margin_rows(path: Path) -> np.ndarray:
    """Read a frame's rows (R, F + 1). Raises FormatError for a damaged file."""
    rows = files.read_npz(path).get("rows")
    columns = len(OBJECT_FEATURES) + 1
    if rows is None or rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        expected = f"rows of {columns} finite numbers"
        raise FormatError(str(path), expected, "none" if rows is None else f"others, of shape {rows.shape}")
    return rows.astype(np.float32)
