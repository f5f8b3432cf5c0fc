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

_GRID = 16
"""Contrast is that of so many pixels either way in a box, which takes the same time for near and far cars."""
_LIGHT_STEP = 4
"""Every fourth pixel either way gives the picture's light."""


@dataclass(frozen=True, slots=True)
class ObjectPatches:
    """What cells need of the objects in one picture. Pixels stay on its device, as every transfer would wait for it."""

    box_features: Tensor
    """(K, 2): height in px, and place across in [0, 1]."""
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
        box_features = torch.stack([bottom - top, (left + right) / (2 * width)], 1)
        return cls(box_features, pixels, image[:, ::_LIGHT_STEP, ::_LIGHT_STEP].mean().expand(len(grid)))

    def cells(self) -> list[Cell]:
        """The cells of the K objects."""
        whole = torch.tensor([0.0, 0, _GRID - 1, _GRID - 1]).expand(len(self.pixels), 1, 4)
        (contrast,) = compute_features(self.pixels.cpu(), whole, ("contrast",))[..., 0]
        height, across = self.box_features.T
        columns = zip(CELL_EDGES.values(), (height, contrast, across, self.light.cpu()), strict=True)
        levels = [np.searchsorted(edges, values.double().numpy(), side="right") for edges, values in columns]
        return [(size, low, place, light) for size, low, place, light in np.stack(levels, 1).tolist()]


@dataclass
class SearchLog:
    """Evaluated states of a search."""

    _states: list[tuple[Tensor, ObjectPatches, Tensor, int]] = field(
        default_factory=list[tuple[Tensor, ObjectPatches, Tensor, int]]
    )
    """Objects (K,), what cells need of them, whether each is missed (K,), and passes."""

    def record(self, image: Tensor, objects: Tensor, boxes_xyxy: Tensor, missed: Tensor, passes: int) -> None:
        """Add an evaluated state.

        Args:
            image: (3, H, W) RGB in [0, 1], what the detector sees.
            objects: (K,) int64, numbers of the objects that count in it.
            boxes_xyxy: (K, 4) px, their labels.
            missed: (K,) bool.
            passes: Detector passes that the state took.
        """
        if len(objects):
            self._states.append((objects, ObjectPatches.from_image(image, boxes_xyxy), missed, passes))

    def visits(self, counterexample: Sequence[Cell]) -> tuple[CellVisit, ...]:
        """All visits, by object and cell.

        Args:
            counterexample: Cell of each object in the counterexample, which the search has evaluated.
        """
        if not self._states:
            return ()
        objects, patches, missed, passes = zip(*self._states, strict=True)
        cells = ObjectPatches(
            torch.cat([p.box_features for p in patches]),
            torch.cat([p.pixels for p in patches]),
            torch.cat([p.light for p in patches]),
        ).cells()
        costs = [cost for cost, own in zip(passes, objects, strict=True) for _ in own]
        counts: dict[tuple[int, Cell], tuple[int, int]] = {}
        rows = zip(torch.cat(objects).tolist(), cells, costs, torch.cat(missed).tolist(), strict=True)
        for index, cell, cost, miss in rows:
            before = counts.get((index, cell), (0, 0))
            counts[index, cell] = (before[0] + cost, before[1] + miss)
        ends = set(enumerate(counterexample))
        return tuple(CellVisit(*pair, *numbers, final=pair in ends) for pair, numbers in sorted(counts.items()))
