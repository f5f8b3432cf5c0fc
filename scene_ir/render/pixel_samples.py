"""Pixels of several looks each: which faces a pixel sees, and by how much of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from scene_ir.raster.layout import Fragments
from scene_ir.render.borders import MeshEdges

GRID_SCALE = 256
"""Sights lie on a grid so much finer than that of looks."""


@dataclass(frozen=True, slots=True)
class PixelSamples:
    """What `rasterize` found in one draw, count x count looks a pixel. A sight is a face in a pixel: face, pixel
    (S,) int64, the pixel counted row by row; share (S,): of the pixel's looks that meet it; at (S, 2): its middle,
    (x, y) in looks. sight (T,) int64: of each look, where it meets a face.
    """

    fragments: Fragments
    count: int
    face: Tensor
    pixel: Tensor
    share: Tensor
    at: Tensor
    sight: Tensor

    @classmethod
    def from_fragments(cls, fragments: Fragments, count: int) -> PixelSamples:
        """Of a draw whose rectangle begins and ends with pixels."""
        x0, y0, x1, y1 = fragments.layout.rects[0].tolist()
        wide, rows, columns = x1 - x0, (y1 - y0) // count, (x1 - x0) // count
        face = fragments.face.reshape(rows, count, columns, count)
        low, high = (reduce(of, reduce(of, face.unbind(1)).unbind(2)) for of in (torch.minimum, torch.maximum))
        low, same = low.reshape(-1), (low == high).reshape(-1)
        row, column = (same & (low >= 0)).reshape(rows, columns).nonzero().unbind(1)
        whole = row * columns + column
        numbers = torch.zeros_like(low, dtype=torch.int64).index_put((whole,), torch.arange(len(whole)))
        sight = numbers.reshape(rows, 1, columns, 1).expand(rows, count, columns, count).reshape(-1)
        corner = torch.tensor([x0, y0])
        middle = torch.stack([column, row], dim=1) * count + corner + (count - 1) / 2
        # Of pixels that see several faces, or none in part, looks in the order of their faces.
        mixed = (~same).nonzero()[:, 0]
        step = torch.arange(count)
        first = mixed // columns * count * wide + mixed % columns * count
        looks = first[:, None] + (step[:, None] * wide + step).reshape(-1)
        seen, order = fragments.face.index_select(0, looks.reshape(-1)).reshape_as(looks).sort(dim=1)
        looks = looks.gather(1, order)
        begins = seen >= 0
        begins[:, 1:] &= seen[:, 1:] != seen[:, :-1]
        number = begins.reshape(-1).cumsum(0) - 1
        hit = (seen >= 0).reshape(-1)
        number, looks = number[hit], looks.reshape(-1)[hit]
        some = int(begins.sum())
        places = torch.stack([looks % wide, looks // wide], dim=1).to(middle)
        counts = torch.bincount(number, minlength=some).to(middle)
        centre = middle.new_zeros(some, 2).index_add(0, number, places) / counts[:, None] + corner
        sight[looks] = number + len(whole)
        return cls(
            fragments,
            count,
            torch.cat([low.index_select(0, whole), seen[begins]]).to(torch.int64),
            torch.cat([whole, mixed[begins.nonzero()[:, 0]]]),
            torch.cat([torch.ones_like(middle[:, 0]), counts / count**2]),
            torch.cat([middle, centre]),
            sight,
        )

    @property
    def wide(self) -> int:
        """Looks in a row."""
        return int(self.fragments.layout.rects[0, 2] - self.fragments.layout.rects[0, 0])

    def pixel_of(self, look: Tensor) -> Tensor:
        """The pixels (P,) of looks (P,)."""
        return look // self.wide // self.count * (self.wide // self.count) + look % self.wide // self.count

    def face_at(self, look: Tensor) -> Tensor:
        """(P,) int64, what looks (P,) see, -1 where that is nothing."""
        return self.fragments.face.index_select(0, look).to(torch.int64)

    def offsets_at_borders(self, edges: MeshEdges) -> tuple[SampleOffsets, SampleOffsets]:
        """Between looks that are neighbours: those that see two faces, but for those of one smooth surface, and
        those from a look that sees one to a look that sees nothing.
        """
        face, wide = self.fragments.face, self.wide
        here, there = [], []
        for step in (1, wide):
            first = (face[step:] != face[:-step]).nonzero()[:, 0]
            first = first[first % wide != wide - 1] if step == 1 else first
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
    """From looks here to there (P,). start, step (P, 3) float64: where (x, y, 1) the one is, and how far the other
    from it; down (P,): along a column, not along a row.
    """

    here: Tensor
    there: Tensor
    start: Tensor
    step: Tensor
    down: Tensor

    @classmethod
    def between(cls, samples: PixelSamples, here: Tensor, there: Tensor) -> SampleOffsets:
        wide = samples.wide
        x0, y0 = samples.fragments.layout.rects[0, :2].tolist()
        start = torch.stack([here % wide + x0, here // wide + y0, torch.ones_like(here)], dim=1)
        down = (there - here).abs() != 1
        sign = (there - here).sign()
        step = torch.stack([sign * ~down, sign * down, torch.zeros_like(here)], dim=1)
        return cls(here, there, start.to(torch.float64), step.to(torch.float64), down)
