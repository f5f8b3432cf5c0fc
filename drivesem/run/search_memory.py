"""What the search `learn` knows of finished frames."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.learned import MIN_ROWS, Knowledge, MarginModel
from drivesem.attacks.objective import Objective
from drivesem.failures.feature_cells import CELL_EDGES, CellVisit
from drivesem.failures.search_log import OBJECT_FEATURES
from scene_ir import files
from scene_ir.errors import FormatError

MARGINS = "margins.npz"
"""File of what other frames learn from a frame's search."""
_FRAMES = 4
"""The model is fitted anew after so many frames."""
_COLUMNS = len(OBJECT_FEATURES) + 1


@dataclass(frozen=True, slots=True)
class Experience:
    """What other frames learn from the search of one."""

    rows: np.ndarray
    """(R, F + 1) float32, features and margins, see `SearchLog.margin_rows`."""
    scene: np.ndarray
    """(S,) float32, the scene's coordinates of theta in the counterexample."""
    objects: np.ndarray
    """(L, P) float32, those of the objects that are lost for certain in it."""
    cells: np.ndarray
    """(L, 4) int64, the cells of these objects."""

    @classmethod
    def from_search(
        cls, objective: Objective, theta: Tensor, visits: Sequence[CellVisit], certain: Collection[int | None]
    ) -> Experience:
        """Of a finished search.

        Args:
            objective: Of the search.
            theta: (D,), of the counterexample.
            visits: Cells of the objects, see `SearchLog.visits`.
            certain: Objects that are lost for certain.
        """
        space, theta = objective.space, theta.float().cpu()
        blocks = [(theta[where], space.owner_count(parameter)) for parameter, where in space.blocks.items()]
        scene = torch.cat([theta[:0], *(block for block, owners in blocks if not owners)])
        objects = torch.cat(
            [theta.new_empty(space.count, 0), *(block.view(owners, -1) for block, owners in blocks if owners)], 1
        )
        lost = [visit for visit in visits if visit.final and visit.index in certain]
        cells = np.array([visit.cell for visit in lost], int).reshape(-1, len(CELL_EDGES))
        return cls(
            objective.search_log.margin_rows(),
            scene.numpy(),
            objects[[visit.index for visit in lost]].numpy(),
            cells,
        )

    @classmethod
    def empty(cls) -> Experience:
        """Of a frame of which nothing is known."""
        rows, scene, objects = (np.empty(shape, np.float32) for shape in ((0, _COLUMNS), 0, (0, 0)))
        return cls(rows, scene, objects, np.empty((0, len(CELL_EDGES)), int))

    @classmethod
    def read(cls, path: Path) -> Experience:
        """Read a frame's file. Raises FormatError for a damaged one."""
        arrays = files.read_npz(path)
        try:
            rows, scene, objects, cells = (arrays[part.name] for part in fields(cls))
        except KeyError as error:
            raise FormatError(str(path), "rows, scene, objects and cells", sorted(arrays)) from error
        fits = rows.shape[1:] == (_COLUMNS,) and scene.ndim == 1 and objects.ndim == 2
        if not (fits and cells.shape == (len(objects), len(CELL_EDGES))):
            shapes = f"rows {rows.shape}, scene {scene.shape}, objects {objects.shape}, cells {cells.shape}"
            expected = f"rows (R, {_COLUMNS}), scene (S,), objects (L, P), cells (L, {len(CELL_EDGES)})"
            raise FormatError(str(path), expected, shapes)
        if not all(np.isfinite(numbers).all() for numbers in (rows, scene, objects)):
            raise FormatError(str(path), "finite numbers", "others")
        rows, scene, objects = (numbers.astype(np.float32) for numbers in (rows, scene, objects))
        return cls(rows, scene, objects, cells.astype(int))

    def write(self, path: Path) -> None:
        """Write the frame's file."""
        files.write_npz(path, {part.name: getattr(self, part.name) for part in fields(self)})


@dataclass
class SearchMemory:
    """What finished frames have shown, and the model of their margins."""

    _frames: dict[str, Experience] = field(default_factory=dict[str, Experience])
    """By frame."""
    _frames_in_model: tuple[str, ...] = ()
    """Frames of the last fit."""
    _model: MarginModel | None = None
    """The last fit."""

    def add(self, frame: str, experience: Experience) -> None:
        """Add a frame."""
        self._frames[frame] = experience

    def read(self, folder: Path) -> None:
        """Add the frames in a run's folder of frames. A damaged file is named on standard error, and left out."""
        for path in sorted(folder.glob(f"*/{MARGINS}")):
            if path.parent.name in self._frames:
                continue
            try:
                experience = Experience.read(path)
            except FormatError as error:
                sys.stderr.write(f"{error}; the search goes on without this frame\n")
                experience = Experience.empty()
            self.add(path.parent.name, experience)

    def knowledge(self) -> Knowledge:
        """What the frames have shown. The same frames give the same."""
        names = sorted(self._frames)
        losing = [self._frames[name] for name in names if len(self._frames[name].cells)]
        return Knowledge(
            model=self._fit_model(tuple(names[: len(names) // _FRAMES * _FRAMES])),
            losses=[(torch.from_numpy(one.scene), own) for one in losing for own in torch.from_numpy(one.objects)],
            failing=frozenset(tuple(cell) for one in losing for cell in one.cells.tolist()),
        )

    def _fit_model(self, names: tuple[str, ...]) -> MarginModel | None:
        """A model of these frames; None for too few rows."""
        if names != self._frames_in_model:
            rows = np.concatenate([self._frames[name].rows for name in names])
            self._model = MarginModel(rows) if len(rows) >= MIN_ROWS else None
            self._frames_in_model = names
        return self._model
