"""The log of a search: in which cells of features it evaluated each object, and how often the object was missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from detectors import boxes
from detectors.planted import compute_features
from drivesem.failures.feature_cells import CELL_EDGES, Cell, CellVisit

OBJECT_FEATURES: tuple[str, ...] = ("height_px", "aspect", "across", "lightness", "contrast", "light")
"""Features of an object as drawn: those of `detectors.planted.FEATURES`, and the mean of the picture."""
_GRID = 16
"""Lightness and contrast are those of so many pixels either way in a box, which takes the same time for near and far
cars."""
_LIGHT_STEP = 4
"""Every fourth pixel either way gives the picture's light."""


@dataclass(frozen=True, slots=True)
class ObjectPatches:
    """What features need of the objects in one picture. Pixels stay on its device: every transfer would wait for it."""

    box_features: Tensor
    """(K, 3): height in px, width by height, and place across in [0, 1]."""
    pixels: Tensor
    """(K, 3, G, G) RGB, a grid of pixels of each box."""
    light: Tensor
    """(K,), mean of the picture."""

    @classmethod
    @torch.no_grad()
    def from_image(cls, image: Tensor, boxes_xyxy: Tensor) -> ObjectPatches:
        """Sample the boxes (K, 4) px of an image (3, H, W)."""
        height, width = image.shape[1:]
        left, top, right, bottom = boxes.clip(boxes_xyxy.cpu(), height, width).unbind(1)
        steps = torch.linspace(0, 1, _GRID)
        x, y = left[:, None] + (right - left)[:, None] * steps, top[:, None] + (bottom - top)[:, None] * steps
        grid = torch.stack(torch.broadcast_tensors(x[:, None], y[:, :, None]), -1)
        grid = 2 * grid / torch.tensor([max(width - 1, 1), max(height - 1, 1)]) - 1
        source = image[None].expand(len(grid), -1, -1, -1)
        pixels = F.grid_sample(source, grid.to(image), mode="nearest", padding_mode="border", align_corners=True)
        tall = bottom - top
        box_features = torch.stack([tall, (right - left) / tall.clamp_min(1), (left + right) / (2 * width)], 1)
        return cls(box_features, pixels, image[:, ::_LIGHT_STEP, ::_LIGHT_STEP].mean().expand(len(grid)))

    def features(self) -> Tensor:
        """(K, F) float64 on the CPU, in the order of `OBJECT_FEATURES`."""
        whole = torch.tensor([0.0, 0, _GRID - 1, _GRID - 1]).expand(len(self.pixels), 1, 4)
        of_pixels = compute_features(self.pixels.cpu(), whole, ("lightness", "contrast"))[..., 0]
        return torch.cat([self.box_features.double(), of_pixels.double().T, self.light.cpu().double()[:, None]], 1)

    def cells(self) -> list[Cell]:
        """The cells of the K objects."""
        return cells_of_features(self.features())


def cells_of_features(features: Tensor) -> list[Cell]:
    """The cells of K objects with features (K, F) in the order of `OBJECT_FEATURES`."""
    columns = dict(zip(OBJECT_FEATURES, features.T.numpy(), strict=True))
    levels = [np.searchsorted(edges, columns[name], side="right") for name, edges in CELL_EDGES.items()]
    return [(size, low, place, light) for size, low, place, light in np.stack(levels, 1).tolist()]


def _join(patches: Sequence[ObjectPatches]) -> ObjectPatches:
    return ObjectPatches(
        torch.cat([p.box_features for p in patches]),
        torch.cat([p.pixels for p in patches]),
        torch.cat([p.light for p in patches]),
    )


@dataclass(frozen=True, slots=True)
class _State:
    """An evaluated state."""

    objects: Tensor
    """(K,) int64."""
    patches: ObjectPatches
    """What features need of them."""
    missed: Tensor
    """(K,) bool."""
    passes: int
    """Detector passes."""
    margins: Tensor | None
    """(K,) logits."""
    random: bool
    """Whether no score influenced the state."""


@dataclass
class SearchLog:
    """Evaluated states of a search."""

    _states: list[_State] = field(default_factory=list[_State])

    def record(
        self,
        image: Tensor,
        objects: Tensor,
        boxes_xyxy: Tensor,
        missed: Tensor,
        passes: int,
        margins: Tensor | None = None,
        random: bool = False,
    ) -> None:
        """Add an evaluated state.

        Args:
            image: (3, H, W) RGB in [0, 1], what the detector sees.
            objects: (K,) int64, numbers of the objects that count in it.
            boxes_xyxy: (K, 4) px, their labels.
            missed: (K,) bool.
            passes: Detector passes that the state took.
            margins: (K,) logits, where they are known.
            random: Whether no score influenced the state.
        """
        if len(objects):
            patches = ObjectPatches.from_image(image, boxes_xyxy)
            self._states.append(_State(objects, patches, missed, passes, margins, random))

    def margin_rows(self) -> np.ndarray:
        """(R, F + 1) float32: features of each object in each state with margins, and its margin."""
        states = [state for state in self._states if state.margins is not None]
        if not states:
            return np.empty((0, len(OBJECT_FEATURES) + 1), np.float32)
        margins = torch.cat([state.margins.double().cpu() for state in states if state.margins is not None])
        features = _join([state.patches for state in states]).features()
        return torch.cat([features, margins[:, None]], 1).float().numpy()

    def visits(self, photograph: Sequence[Cell], counterexample: Sequence[Cell]) -> tuple[CellVisit, ...]:
        """All visits, by object and cell.

        Args:
            photograph: Cell of each object in the photograph.
            counterexample: The same in the counterexample. The search has evaluated both.
        """
        if not self._states:
            return ()
        cells = _join([state.patches for state in self._states]).cells()
        states = [state for state in self._states for _ in state.objects]
        objects, missed = (
            torch.cat([getattr(state, name).cpu() for state in self._states]) for name in ("objects", "missed")
        )
        counts: dict[tuple[int, Cell], np.ndarray] = {}
        for index, cell, state, miss in zip(objects.tolist(), cells, states, missed.tolist(), strict=True):
            row = np.array([state.passes, miss, state.random, state.random and miss])
            counts[index, cell] = counts.get((index, cell), 0) + row
        start, end = set(enumerate(photograph)), set(enumerate(counterexample))
        visits: list[CellVisit] = []
        for pair, row in sorted(counts.items()):
            passes, misses, random, random_misses = row.tolist()
            visits.append(CellVisit(*pair, passes, misses, pair in end, random, random_misses, pair in start))
        return tuple(visits)
