"""Which pixels a draw covers, and what was found there: the tensors that the four verbs share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import check_shape


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """The rectangle of the image that each draw covers; the pixels of all draws lie packed one after the other.

    rects: (N, 4) int64 px, half-open (x0, y0, x1, y1), empty where x1 <= x0 or y1 <= y0. offsets: (N + 1,) int64,
    the first packed pixel of each draw; pixels are row-major inside a draw; offsets[-1] is their count T.
    """

    rects: Tensor
    offsets: Tensor

    def __post_init__(self) -> None:
        check_shape("layout.rects", self.rects, None, 4, floating=False)
        check_shape("layout.offsets", self.offsets, self.rects.shape[0] + 1, floating=False)
        for name in ("rects", "offsets"):
            if getattr(self, name).dtype != torch.int64:
                raise ShapeError(f"layout.{name}", "int64", getattr(self, name).dtype)
        if not torch.equal(self.offsets, _offsets(self.rects)):
            raise RangeError("layout.offsets", "running pixel counts of layout.rects", self.offsets.tolist())

    @classmethod
    def from_rects(cls, rects: Tensor) -> PixelLayout:
        """The layout of rectangles (N, 4) int64 px, half-open (x0, y0, x1, y1)."""
        check_shape("layout.rects", rects, None, 4, floating=False)
        rects = rects.to(torch.int64)
        layout = object.__new__(cls)  # its offsets need no second look
        object.__setattr__(layout, "rects", rects)
        object.__setattr__(layout, "offsets", _offsets(rects))
        return layout

    @classmethod
    def from_pixels(cls, pixels: Tensor) -> PixelLayout:
        """That of draws of a pixel each, (T, 2) (x, y), whole numbers."""
        rects = torch.empty(len(pixels), 4, dtype=torch.int64, device=pixels.device)
        rects[:, :2] = pixels
        torch.add(rects[:, :2], 1, out=rects[:, 2:])
        layout = object.__new__(cls)
        object.__setattr__(layout, "rects", rects)
        object.__setattr__(layout, "offsets", torch.arange(len(pixels) + 1, device=pixels.device))
        return layout

    @property
    def size(self) -> int:
        """The number T of packed pixels."""
        return int(self.offsets[-1])

    def draw_index(self) -> Tensor:
        """The draw (T,) int64 that each packed pixel belongs to."""
        count = self.rects.shape[0]
        return torch.repeat_interleave(torch.arange(count, device=self.rects.device), self.offsets.diff())

    def pixel_xy(self) -> Tensor:
        """Image coordinates (T, 2) int64 px, (x, y), of each packed pixel."""
        draw = self.draw_index()
        within = torch.arange(draw.shape[0], device=draw.device) - self.offsets[draw]
        x0, y0, x1, _ = self.rects[draw].unbind(-1)
        width = x1 - x0
        return torch.stack([x0 + within % width, y0 + within // width], dim=-1)

    def spans(self) -> list[tuple[slice, tuple[int, int]]]:
        """For each draw its packed pixels as a slice, and the (height, width) px to view them in."""
        edges = self.offsets.tolist()
        shapes = [(max(y1 - y0, 0), max(x1 - x0, 0)) for x0, y0, x1, y1 in self.rects.tolist()]
        return [(slice(edges[i], edges[i + 1]), shape) for i, shape in enumerate(shapes)]


@dataclass(frozen=True, slots=True)
class RasterPlan:
    """What the fast backend prepares for `rasterize` and uses again for `antialias`.

    parts: (P, 11) int32, draws or bands of their rows: the draw's x0, y0, x1, y1; the first row and the end; the
    draw's first packed pixel; its faces' start and end; 1 where its back faces are culled; the first packed pixel.
    lanes: how many kernel indices share a part. cuts, outline_cuts: where in [0, lanes * P) the threads' shares
    begin and end, for each of the two.
    boxes: (V, 4) int32 px, the first and last pixel (x, y, x, y) that each vertex may touch. clip: (V, 3), the
    vertices that this was made of, and their `version`, -1 where torch keeps none.
    """

    parts: Tensor
    lanes: int
    cuts: list[int]
    outline_cuts: list[int]
    boxes: Tensor
    clip: Tensor
    version: int

    def matches(self, clip: Tensor) -> bool:
        """Whether `clip` is what this was made of, not changed since."""
        same = self.clip.data_ptr() == clip.data_ptr() and self.clip.shape == clip.shape
        return same and self.clip.stride() == clip.stride() and self.version == tensor_version(clip)


def tensor_version(tensor: Tensor) -> int:
    """Counts torch's changes to a tensor; -1 for tensors of inference mode, which have no count."""
    return -1 if tensor.is_inference() else tensor._version


@dataclass(frozen=True, slots=True)
class Fragments:
    """What `rasterize` found. face: (T,) int32, index into the faces, -1 where nothing is hit;
    depth: (T,) m, w of the nearest hit, inf where there is none, not differentiable (interpolate w instead).
    face_ranges: (N, 2) int64 and near: m, as they were given. cull: (N,) bool, the draws without back faces, or
    None. plan: what the fast backend uses again, or None.
    """

    layout: PixelLayout
    face: Tensor
    depth: Tensor
    face_ranges: Tensor
    near: float
    cull: Tensor | None = None
    plan: RasterPlan | None = None


def _offsets(rects: Tensor) -> Tensor:
    """Running pixel counts (N + 1,) of rectangles (N, 4)."""
    extent = (rects[:, 2:] - rects[:, :2]).clamp(min=0)
    return torch.nn.functional.pad(extent.prod(dim=1).cumsum(0), (1, 0))
