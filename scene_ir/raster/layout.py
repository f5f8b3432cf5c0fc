"""Pixel layouts and rasterisation results shared by the four verbs."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

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
    _lists: list[list[Any]] = field(default_factory=list, init=False, compare=False, repr=False)
    """Rects and offsets as lists, once needed."""

    def __post_init__(self) -> None:
        check_shape("layout.rects", self.rects, None, 4, floating=False)
        check_shape("layout.offsets", self.offsets, self.rects.shape[0] + 1, floating=False)
        for name in ("rects", "offsets"):
            if getattr(self, name).dtype != torch.int64:
                raise ShapeError(f"layout.{name}", "int64", getattr(self, name).dtype)
        if not torch.equal(self.offsets, _offsets(self.rects)):
            raise RangeError("layout.offsets", "running pixel counts of layout.rects", self.offsets.tolist())

    @classmethod
    def _unchecked(cls, rects: Tensor, offsets: Tensor) -> PixelLayout:
        layout = object.__new__(cls)
        for name, value in (("rects", rects), ("offsets", offsets), ("_lists", [])):
            object.__setattr__(layout, name, value)
        return layout

    @classmethod
    def from_rects(cls, rects: Tensor, device: torch.device | None = None) -> PixelLayout:
        """The layout of rectangles.

        Args:
            rects: (N, 4) px, half-open (x0, y0, x1, y1).
            device: Device of the layout; by default that of `rects`. From the CPU, nothing waits for a GPU.
        """
        check_shape("layout.rects", rects, None, 4, floating=False)
        rects = rects.to(torch.int64)
        offsets = _offsets(rects)
        if device is None or device == rects.device:
            return cls._unchecked(rects, offsets)
        both = torch.cat([rects.flatten(), offsets]).to(device, non_blocking=True)
        layout = cls._unchecked(both[: rects.numel()].view(-1, 4), both[rects.numel() :])
        layout._lists.extend([rects.tolist(), offsets.tolist()])
        return layout

    @classmethod
    def from_pixels(cls, pixels: Tensor) -> PixelLayout:
        """The layout of one-pixel draws at integer pixels (T, 2), (x, y)."""
        rects = torch.empty(len(pixels), 4, dtype=torch.int64, device=pixels.device)
        rects[:, :2] = pixels
        torch.add(rects[:, :2], 1, out=rects[:, 2:])
        return cls._unchecked(rects, torch.arange(len(pixels) + 1, device=pixels.device))

    @property
    def host_rects(self) -> list[list[int]]:
        """`rects` as lists."""
        return self._host()[0]

    @property
    def host_offsets(self) -> list[int]:
        """`offsets` as a list."""
        return self._host()[1]

    def _host(self) -> list[list[Any]]:
        if not self._lists:
            self._lists.extend([self.rects.tolist(), self.offsets.tolist()])
        return self._lists

    @property
    def size(self) -> int:
        """Number T of packed pixels."""
        return self.host_offsets[-1] if self._lists else int(self.offsets[-1])

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
        edges = self.host_offsets
        shapes = [(max(y1 - y0, 0), max(x1 - x0, 0)) for x0, y0, x1, y1 in self.host_rects]
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


V = TypeVar("V")

_TRIANGLE_WORK = 1.5
"""Cost of a triangle in `rasterize`, in pixels of a draw; measured on a CPU with triangles of a few pixels."""
_OUTLINE_WORK = 10.0
"""Cost of a triangle in `antialias`, which visits few of the pixels."""
_MIN_WORK = 10_000.0
"""Least work for a second thread, in pixels: handing work over takes about 50 microseconds."""
_TOLERANCE = 0.1
"""Relative imbalance between threads at which a draw is split."""
_GPU_LANES = 8192
"""Most GPU threads that share the triangles of a draw."""


class TensorCache(Generic[V]):
    """A function of a tensor, computed once while the tensor lives unchanged."""

    def __init__(self, compute: Callable[[Tensor], V]) -> None:
        self._compute = compute
        self._entries: dict[int, tuple[weakref.ref[Tensor], int, V]] = {}

    def __call__(self, tensor: Tensor) -> V:
        if tensor.is_inference():  # these have no change counter
            return self._compute(tensor)
        key = id(tensor)
        entry = self._entries.get(key)
        if entry is not None and entry[0]() is tensor and entry[1] == tensor_version(tensor):
            return entry[2]
        value = self._compute(tensor)
        self._entries[key] = (
            weakref.ref(tensor, lambda _: self._entries.pop(key, None)),
            tensor_version(tensor),
            value,
        )
        return value


def _index_range(faces: Tensor) -> tuple[int, int]:
    low, high = faces.aminmax()
    return int(low), int(high)


_index_ranges = TensorCache(_index_range)
_int32_copies = TensorCache(lambda faces: faces.to(torch.int32).contiguous())


def index_range(faces: Tensor) -> tuple[int, int]:
    """Lowest and highest index in faces (F, 3), F > 0."""
    return _index_ranges(faces)


def int32_faces(faces: Tensor) -> Tensor:
    """Faces (F, 3) as contiguous int32; the same tensor if it is that already."""
    if faces.dtype == torch.int32 and faces.is_contiguous():
        return faces
    return _int32_copies(faces)


def split_for_threads(
    layout: PixelLayout, face_ranges: Tensor, cull: Tensor | None, threads: int
) -> tuple[list[list[int]], list[int]]:
    """Divide the draws of `rasterize` between CPU threads, cutting draws into bands of rows where needed.

    Args:
        layout: Pixels of the draws.
        face_ranges: (N, 2) first face and end face of each draw.
        cull: (N,) bool, or None.
        threads: Most threads to use.

    Returns:
        Rows of `RasterPlan.parts` without empty draws, and the bounds of the threads' ranges.
    """
    culled = [0] * len(face_ranges) if cull is None else cull.to(torch.int64).tolist()
    draws = [
        (rect, offset, faces, flag)
        for rect, offset, faces, flag in zip(
            layout.host_rects, layout.host_offsets[:-1], face_ranges.tolist(), culled, strict=True
        )
        if rect[2] > rect[0] and rect[3] > rect[1]
    ]
    total = sum(_row_work(rect, faces, rect[1]) for rect, _, faces, _ in draws)
    shares = max(1, min(threads, int(total / _MIN_WORK) + 1))
    target = total / shares
    parts: list[list[int]] = []
    cuts, done = [0], 0.0
    for rect, offset, faces, flag in draws:
        x0, y0, x1, y1 = rect
        row = y0
        while row < y1:
            room, remaining = target * len(cuts) - done, _row_work(rect, faces, row)
            end = y1
            if len(cuts) < shares and remaining - room > _TOLERANCE * target:
                end = row + round((y1 - row) * max(room, 0.0) / remaining)
                if room <= _TOLERANCE * target or end <= row:
                    if len(parts) > cuts[-1]:
                        cuts.append(len(parts))
                        continue
                    end = y1
            first = offset + (row - y0) * (x1 - x0)
            parts.append([x0, y0, x1, y1, row, end, offset, *faces, flag, first])
            done += remaining * (end - row) / (y1 - row)
            row = end
            if row < y1:
                cuts.append(len(parts))
    return parts, [*cuts, len(parts)]


def split_outlines(parts: Sequence[Sequence[int]], shares: int) -> list[int]:
    """Bounds of up to `shares` ranges of `RasterPlan.parts` with equal work for `antialias`."""
    work = [_OUTLINE_WORK * max(p[8] - p[7], 0) + (p[5] - p[4]) * (p[2] - p[0]) for p in parts]
    total, done, cuts = sum(work), 0.0, [0]
    for i, part_work in enumerate(work):
        if i > cuts[-1] and len(cuts) < shares and done + part_work / 2 > total * len(cuts) / shares:
            cuts.append(i)
        done += part_work
    return [*cuts, len(parts)]


def _row_work(rect: Sequence[int], faces: Sequence[int], row: int) -> float:
    """Cost in pixels of a draw's rows from `row` on."""
    return _TRIANGLE_WORK * max(faces[1] - faces[0], 0) + (rect[3] - row) * (rect[2] - rect[0])


def gpu_parts(layout: PixelLayout, face_ranges: Tensor, cull: Tensor | None) -> Tensor:
    """`RasterPlan.parts` (N, 11) on the CPU, with one part per draw.

    Args:
        layout: Pixels of the draws.
        face_ranges: (N, 2) first face and end face of each draw, on the CPU.
        cull: (N,) bool, on the CPU, or None.
    """
    flags = [False] * len(face_ranges) if cull is None else cull.tolist()
    draws = zip(layout.host_rects, layout.host_offsets[:-1], face_ranges.tolist(), flags, strict=True)
    rows = [[*rect, rect[1], rect[3], first, *faces, flag, first] for rect, first, faces, flag in draws]
    return torch.tensor(rows, dtype=torch.int32).view(-1, 11)


def gpu_lanes(faces: Tensor, draws: int) -> int:
    """GPU threads that share the triangles of a draw: about one per triangle."""
    return max(32, min(_GPU_LANES, -(-faces.shape[0] // max(draws, 1))))
