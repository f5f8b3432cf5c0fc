"""Several samples per pixel, grouped by the face they hit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from scene_ir.raster.layout import Fragments
from scene_ir.render.borders import MeshEdges

GRID_SCALE = 256
"""Resolution of the groups' centres, relative to the grid of samples."""


@dataclass(frozen=True, slots=True)
class PixelSamples:
    """Result of `rasterize` for one draw with count x count samples per pixel; samples of one pixel that hit one
    face form a group (S).
    """

    fragments: Fragments
    """Faces at the samples (T)."""
    count: int
    """Samples along each side of a pixel."""
    face: Tensor
    """(S,) int64, face of each group."""
    pixel: Tensor
    """(S,) int64, pixel of each group, row-major in the draw."""
    share: Tensor
    """(S,) share of the pixel's samples in the group."""
    at: Tensor
    """(S, 2) centre of the group, (x, y) in samples."""
    group: Tensor
    """(T,) int64, group of each sample that hits a face."""

    @classmethod
    def from_fragments(cls, fragments: Fragments, count: int) -> PixelSamples:
        """Group the samples of a draw; its rectangle starts and ends at pixel borders."""
        x0, y0, x1, y1 = fragments.layout.rects[0].tolist()
        row_length, rows, columns = x1 - x0, (y1 - y0) // count, (x1 - x0) // count
        face = fragments.face.reshape(rows, count, columns, count)
        low, high = (reduce(of, reduce(of, face.unbind(1)).unbind(2)) for of in (torch.minimum, torch.maximum))
        low, same = low.reshape(-1), (low == high).reshape(-1)
        row, column = (same & (low >= 0)).reshape(rows, columns).nonzero().unbind(1)
        whole = row * columns + column
        numbers = torch.zeros_like(low, dtype=torch.int64).index_put((whole,), torch.arange(len(whole)))
        group = numbers.reshape(rows, 1, columns, 1).expand(rows, count, columns, count).reshape(-1)
        corner = torch.tensor([x0, y0])
        middle = torch.stack([column, row], dim=1) * count + corner + (count - 1) / 2
        # Pixels with several faces, or partly empty: samples ordered by face.
        mixed = (~same).nonzero()[:, 0]
        step = torch.arange(count)
        first = mixed // columns * count * row_length + mixed % columns * count
        samples = first[:, None] + (step[:, None] * row_length + step).reshape(-1)
        seen_faces, order = fragments.face.index_select(0, samples.reshape(-1)).reshape_as(samples).sort(dim=1)
        samples = samples.gather(1, order)
        begins = seen_faces >= 0
        begins[:, 1:] &= seen_faces[:, 1:] != seen_faces[:, :-1]
        number = begins.reshape(-1).cumsum(0) - 1
        hit = (seen_faces >= 0).reshape(-1)
        number, samples = number[hit], samples.reshape(-1)[hit]
        some = int(begins.sum())
        places = torch.stack([samples % row_length, samples // row_length], dim=1).to(middle)
        counts = torch.bincount(number, minlength=some).to(middle)
        centre = middle.new_zeros(some, 2).index_add(0, number, places) / counts[:, None] + corner
        group[samples] = number + len(whole)
        return cls(
            fragments,
            count,
            torch.cat([low.index_select(0, whole), seen_faces[begins]]).to(torch.int64),
            torch.cat([whole, mixed[begins.nonzero()[:, 0]]]),
            torch.cat([torch.ones_like(middle[:, 0]), counts / count**2]),
            torch.cat([middle, centre]),
            group,
        )

    @property
    def row_length(self) -> int:
        """Samples per row."""
        return int(self.fragments.layout.rects[0, 2] - self.fragments.layout.rects[0, 0])

    def pixel_at(self, sample: Tensor) -> Tensor:
        """Pixels (P,) of samples (P,)."""
        return (
            sample // self.row_length // self.count * (self.row_length // self.count)
            + sample % self.row_length // self.count
        )

    def face_at(self, sample: Tensor) -> Tensor:
        """(P,) int64, faces at samples (P,), -1 where nothing is hit."""
        return self.fragments.face.index_select(0, sample).to(torch.int64)

    def offsets_at_borders(self, edges: MeshEdges) -> tuple[SampleOffsets, SampleOffsets]:
        """Pairs of neighbouring samples: those that hit different faces of no common smooth surface, and those
        from a sample that hits a face to one that hits nothing.
        """
        face, row_length = self.fragments.face, self.row_length
        here, there = [], []
        for step in (1, row_length):
            first = (face[step:] != face[:-step]).nonzero()[:, 0]
            first = first[first % row_length != row_length - 1] if step == 1 else first
            here.append(first)
            there.append(first + step)
        here, there = torch.cat(here), torch.cat(there)
        one, other = self.face_at(here), self.face_at(there)
        inner = ((one >= 0) & (other >= 0)).nonzero()[:, 0]
        inner = inner[~edges.join_smoothly(one.index_select(0, inner), other.index_select(0, inner))]
        outwards, inwards = (one >= 0) & (other < 0), (one < 0) & (other >= 0)
        rim = torch.cat([here[outwards], there[inwards]]), torch.cat([there[outwards], here[inwards]])
        return SampleOffsets.between(self, here[inner], there[inner]), SampleOffsets.between(self, *rim)


@dataclass(frozen=True, slots=True)
class SampleOffsets:
    """Paths (P) between neighbouring samples."""

    here: Tensor
    """(P,) int64, sample at the start."""
    there: Tensor
    """(P,) int64, sample at the end."""
    start: Tensor
    """(P, 3) float64, position (x, y, 1) of the start."""
    step: Tensor
    """(P, 3) float64, difference between end and start."""
    down: Tensor
    """(P,) bool, whether the path runs along a column."""

    @classmethod
    def between(cls, samples: PixelSamples, here: Tensor, there: Tensor) -> SampleOffsets:
        """Paths between pairs of samples.

        Args:
            samples: Grid of samples.
            here, there: (P,) int64, samples at start and end.
        """
        row_length = samples.row_length
        x0, y0 = samples.fragments.layout.rects[0, :2].tolist()
        start = torch.stack([here % row_length + x0, here // row_length + y0, torch.ones_like(here)], dim=1)
        down = (there - here).abs() != 1
        sign = (there - here).sign()
        step = torch.stack([sign * ~down, sign * down, torch.zeros_like(here)], dim=1)
        return cls(here, there, start.to(torch.float64), step.to(torch.float64), down)
