"""Pixel layouts and rasterisation results shared by the four verbs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import check_shape


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """Rectangles of the image, one per draw; the pixels of all draws are packed one after the other."""

    rects: Tensor
    """(N, 4) int64 px, half-open (x0, y0, x1, y1); empty where x1 <= x0 or y1 <= y0."""
    offsets: Tensor
    """(N + 1,) int64, first packed pixel of each draw; row-major within a draw; the last is the pixel count T."""

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
        """The layout of rectangles (N, 4) px, half-open (x0, y0, x1, y1)."""
        check_shape("layout.rects", rects, None, 4, floating=False)
        rects = rects.to(torch.int64)
        layout = object.__new__(cls)  # skips the check of its offsets
        object.__setattr__(layout, "rects", rects)
        object.__setattr__(layout, "offsets", _offsets(rects))
        return layout

    @classmethod
    def from_pixels(cls, pixels: Tensor) -> PixelLayout:
        """The layout of one-pixel draws at integer pixels (T, 2), (x, y)."""
        rects = torch.empty(len(pixels), 4, dtype=torch.int64, device=pixels.device)
        rects[:, :2] = pixels
        torch.add(rects[:, :2], 1, out=rects[:, 2:])
        layout = object.__new__(cls)
        object.__setattr__(layout, "rects", rects)
        object.__setattr__(layout, "offsets", torch.arange(len(pixels) + 1, device=pixels.device))
        return layout

    @property
    def size(self) -> int:
        """Number T of packed pixels."""
        return int(self.offsets[-1])

    def draw_index(self) -> Tensor:
        """Draw (T,) int64 of each packed pixel."""
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
        """Packed pixels of each draw as a slice, with the draw's (height, width) in px."""
        edges = self.offsets.tolist()
        shapes = [(max(y1 - y0, 0), max(x1 - x0, 0)) for x0, y0, x1, y1 in self.rects.tolist()]
        return [(slice(edges[i], edges[i + 1]), shape) for i, shape in enumerate(shapes)]


@dataclass(frozen=True, slots=True)
class RasterPlan:
    """Work division and vertex bounds that the fast `rasterize` leaves to `antialias`."""

    parts: Tensor
    """(P, 11) int32, draws or bands of their rows: x0, y0, x1, y1 of the draw; first row and end row; first packed
    pixel of the draw; first face and end face; 1 to cull back faces; first packed pixel of the band.
    """
    lanes: int
    """Kernel indices that share one part."""
    cuts: list[int]
    """Bounds of the threads' ranges in [0, lanes * P] for `rasterize`."""
    outline_cuts: list[int]
    """The same for `antialias`."""
    boxes: Tensor
    """(V, 4) int32 px, first and last pixel (x, y, x, y) that each vertex may touch."""
    clip: Tensor
    """(V, 3) vertices of the plan."""
    version: int
    """Version counter of `clip`; -1 where torch keeps none."""

    def matches(self, clip: Tensor) -> bool:
        """Whether `clip` is the tensor that the plan was made of, unchanged since."""
        same = self.clip.data_ptr() == clip.data_ptr() and self.clip.shape == clip.shape
        return same and self.clip.stride() == clip.stride() and self.version == tensor_version(clip)


def tensor_version(tensor: Tensor) -> int:
    """Torch's change counter of a tensor; -1 for inference tensors, which have none."""
    return -1 if tensor.is_inference() else tensor._version


@dataclass(frozen=True, slots=True)
class Fragments:
    """Result of `rasterize`."""

    layout: PixelLayout
    """Pixels of the draws."""
    face: Tensor
    """(T,) int32 index of the nearest face, -1 where nothing is hit."""
    depth: Tensor
    """(T,) w of the nearest hit in m, inf where there is none; not differentiable (interpolate w instead)."""
    face_ranges: Tensor
    """(N, 2) int64, first face and end face of each draw."""
    near: float
    """Near plane, m."""
    cull: Tensor | None = None
    """(N,) bool, draws without back faces; None if there are none."""
    plan: RasterPlan | None = None
    """Plan of the fast backend; None for the reference."""


def _offsets(rects: Tensor) -> Tensor:
    """Running pixel counts (N + 1,) of rectangles (N, 4)."""
    extent = (rects[:, 2:] - rects[:, :2]).clamp(min=0)
    return torch.nn.functional.pad(extent.prod(dim=1).cumsum(0), (1, 0))
