"""How the fast backend shares the draws between threads, and what it knows of a mesh's faces once and for all."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor

from scene_ir.raster.layout import PixelLayout, tensor_version

V = TypeVar("V")

_TRIANGLE_WORK = 1.5
"""What a triangle costs `rasterize`, in pixels of a draw, measured on a CPU with triangles of a few pixels."""
_OUTLINE_WORK = 10.0
"""The same for `antialias`, which looks at few of the pixels."""
_MIN_WORK = 10_000.0
"""Less work than this is not worth a second thread: handing over costs some 50 microseconds."""
_TOLERANCE = 0.1
"""A thread may have this share more or less than the others before a draw is cut in two."""
_GPU_LANES = 8192
"""At most this many GPU threads share the triangles of a draw."""


class _TensorCache(Generic[V]):
    """What `compute` says of a tensor, asked once while the tensor lives and torch sees no change of it."""

    def __init__(self, compute: Callable[[Tensor], V]) -> None:
        self._compute = compute
        self._kept: dict[int, tuple[weakref.ref[Tensor], int, V]] = {}

    def __call__(self, tensor: Tensor) -> V:
        if tensor.is_inference():  # these do not count their changes
            return self._compute(tensor)
        key = id(tensor)
        kept = self._kept.get(key)
        if kept is not None and kept[0]() is tensor and kept[1] == tensor_version(tensor):
            return kept[2]
        value = self._compute(tensor)
        self._kept[key] = (weakref.ref(tensor, lambda _: self._kept.pop(key, None)), tensor_version(tensor), value)
        return value


def _index_range(faces: Tensor) -> tuple[int, int]:
    low, high = faces.aminmax()
    return int(low), int(high)


_index_ranges = _TensorCache(_index_range)
_int32_copies = _TensorCache(lambda faces: faces.to(torch.int32).contiguous())


def index_range(faces: Tensor) -> tuple[int, int]:
    """The lowest and the highest index in faces (F, 3), F > 0."""
    return _index_ranges(faces)


def int32_faces(faces: Tensor) -> Tensor:
    """Faces (F, 3) as contiguous int32, themselves where they are that."""
    if faces.dtype == torch.int32 and faces.is_contiguous():
        return faces
    return _int32_copies(faces)


def split_for_threads(
    layout: PixelLayout, face_ranges: Tensor, cull: Tensor | None, threads: int
) -> tuple[list[list[int]], list[int]]:
    """Rows of Plan.parts, those without pixels left out, and where the threads' shares begin, for `rasterize`.

    A thread's share is a run of draws; where that is too uneven a draw is cut into bands of rows.
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
            room, left = target * len(cuts) - done, _row_work(rect, faces, row)
            end = y1
            if len(cuts) < shares and left - room > _TOLERANCE * target:
                end = row + round((y1 - row) * max(room, 0.0) / left)
                if room <= _TOLERANCE * target or end <= row:
                    if len(parts) > cuts[-1]:
                        cuts.append(len(parts))
                        continue
                    end = y1
            first = offset + (row - y0) * (x1 - x0)
            parts.append([x0, y0, x1, y1, row, end, offset, *faces, flag, first])
            done += left * (end - row) / (y1 - row)
            row = end
            if row < y1:
                cuts.append(len(parts))
    return parts, [*cuts, len(parts)]


def split_outlines(parts: Sequence[Sequence[int]], shares: int) -> list[int]:
    """Where up to `shares` shares of the rows of Plan.parts begin and end, even for `antialias`."""
    work = [_OUTLINE_WORK * max(p[8] - p[7], 0) + (p[5] - p[4]) * (p[2] - p[0]) for p in parts]
    total, done, cuts = sum(work), 0.0, [0]
    for i, each in enumerate(work):
        if i > cuts[-1] and len(cuts) < shares and done + each / 2 > total * len(cuts) / shares:
            cuts.append(i)
        done += each
    return [*cuts, len(parts)]


def _row_work(rect: Sequence[int], faces: Sequence[int], row: int) -> float:
    """What the rows from `row` on of a draw cost, in pixels."""
    return _TRIANGLE_WORK * max(faces[1] - faces[0], 0) + (rect[3] - row) * (rect[2] - rect[0])


def gpu_parts(layout: PixelLayout, face_ranges: Tensor, cull: Tensor | None) -> Tensor:
    """Plan.parts, one a draw, without waiting for the device."""
    flag = torch.zeros_like(face_ranges[:, :1]) if cull is None else cull.to(face_ranges)[:, None]
    first = layout.offsets[:-1, None]
    rows = layout.rects[:, [1, 3]]
    return torch.cat([layout.rects, rows, first, face_ranges, flag, first], dim=1).to(torch.int32)


def gpu_lanes(faces: Tensor, draws: int) -> int:
    """How many GPU threads share the triangles of a draw: about one each."""
    return max(32, min(_GPU_LANES, -(-faces.shape[0] // max(draws, 1))))
