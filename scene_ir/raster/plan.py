"""Division of draws between threads, and cached properties of faces, for the fast backend."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor

from scene_ir.raster.layout import PixelLayout, tensor_version

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


class _TensorCache(Generic[V]):
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


_index_ranges = _TensorCache(_index_range)
_int32_copies = _TensorCache(lambda faces: faces.to(torch.int32).contiguous())


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
            layout.rects.tolist(), layout.offsets.tolist()[:-1], face_ranges.tolist(), culled, strict=True
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
    """`RasterPlan.parts` with one part per draw, without waiting for the device.

    Args:
        layout: Pixels of the draws.
        face_ranges: (N, 2) first face and end face of each draw.
        cull: (N,) bool, or None.
    """
    flag = torch.zeros_like(face_ranges[:, :1]) if cull is None else cull.to(face_ranges)[:, None]
    first = layout.offsets[:-1, None]
    rows = layout.rects[:, [1, 3]]
    return torch.cat([layout.rects, rows, first, face_ranges, flag, first], dim=1).to(torch.int32)


def gpu_lanes(faces: Tensor, draws: int) -> int:
    """GPU threads that share the triangles of a draw: about one per triangle."""
    return max(32, min(_GPU_LANES, -(-faces.shape[0] // max(draws, 1))))
