"""Four verbs that turn triangles into differentiable pixels: rasterize, interpolate, texture, antialias.

Each verb has two implementations behind one signature: `reference` (plain torch, any floating dtype; defines the
correct result) and `warp` (float32; one kernel source for CPU and CUDA; imported on first use). Visibility comes
from a hard z-buffer and is not differentiated; values at a hit are, and `antialias` differentiates outlines.

Clip coordinates are (u w, v w, w), as `geometry.to_clip` returns them: u, v in pixels (centres at integers), w in
metres in front of the camera. Shapes: N draws, T packed pixels (`PixelLayout`), F triangles, V vertices, K
attributes.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Literal

import torch
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError
from scene_ir.raster.layout import Fragments, PixelLayout, index_range
from scene_ir.types import check_finite, check_shape

__all__ = [
    "NEAR_M",
    "Backend",
    "Border",
    "Fragments",
    "PixelLayout",
    "antialias",
    "bounding_rects",
    "interpolate",
    "rasterize",
    "texture",
    "texture_packed",
]

NEAR_M = 0.05
"""Near plane, m: surfaces with a smaller w are cut away. Nothing in front of a car's camera is nearer."""

Backend = Literal["warp", "reference"]
Border = Literal["clamp", "zero"]


def rasterize(
    clip: Tensor,
    faces: Tensor,
    face_ranges: Tensor,
    layout: PixelLayout,
    backend: Backend = "warp",
    near: float = NEAR_M,
    cull: bool | Tensor = False,
) -> Fragments:
    """Find the nearest triangle at each pixel centre of each draw.

    Of two triangles on either side of a common edge, exactly one hits a pixel centre on the edge. At equal depth
    the lower face index wins. Triangles seen edge-on are skipped. The front of (v0, v1, v2) is where cross(v1 -
    v0, v2 - v0) points in the frame x right, y down, z forward. Closed meshes look the same without back faces, at
    half the cost, unless the near plane cuts them open.
    Source: Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates".

    Args:
        clip: (V, 3) clip coordinates.
        faces: (F, 3) int; both windings are visible.
        face_ranges: (N, 2) int; draw i covers faces [start, end) inside layout.rects[i]; ranges may overlap. On
            the CPU, nothing waits for a GPU; likewise `cull`.
        layout: Pixels of the draws.
        backend: Implementation.
        near: Near plane, m.
        cull: Whether to drop back faces, for all draws or (N,) bool.

    Raises:
        ShapeError: On wrong shapes or dtypes.
        RangeError: On values that are not finite (not checked on a GPU), or indices out of range.
    """
    _check_mesh(clip, faces, backend)
    if not clip.is_cuda:  # it would wait
        _check_finite("raster.clip", clip)
    count = layout.rects.shape[0]
    check_shape("raster.face_ranges", face_ranges, count, 2, floating=False)
    if near <= 0:
        raise RangeError("raster.near", "a positive distance", near)
    ranges = face_ranges.tolist()
    face_ranges = torch.tensor(ranges, dtype=torch.int64).view(-1, 2)
    if not all(0 <= end <= faces.shape[0] for pair in ranges for end in pair):
        raise RangeError("raster.face_ranges", f"indices in [0, {faces.shape[0]}]", ranges)
    culled = _cull_flags(cull, face_ranges)
    if backend == "reference":
        face_ranges, culled = face_ranges.to(clip.device), None if culled is None else culled.to(clip.device)
    face, depth, plan = _backend_module(backend).rasterize(clip.detach(), faces, face_ranges, layout, near, culled)
    return Fragments(layout, face, depth, face_ranges, near, culled, plan)


def interpolate(
    fragments: Fragments, clip: Tensor, faces: Tensor, attributes: Tensor, backend: Backend = "warp"
) -> Tensor:
    """Interpolate vertex attributes at the hits, perspective-correct; differentiable to `clip` and `attributes`.

    Args:
        fragments: Result of `rasterize`.
        clip, faces: As given to `rasterize`.
        attributes: (V, K).
        backend: Implementation.

    Returns:
        (T, K), 0 where nothing is hit.
    """
    _check_mesh(clip, faces, backend)
    check_shape("raster.attributes", attributes, clip.shape[0], None)
    _check_dtype("raster.attributes", attributes, clip.dtype)
    return _backend_module(backend).interpolate(fragments, clip, faces, attributes)


def texture(image: Tensor, uv: Tensor, backend: Backend = "warp", border: Border = "clamp") -> Tensor:
    """Sample an image with the Catmull-Rom kernel (a = -1/2), which is smooth at pixel centres too.

    Differentiable to `uv` and `image`. Source: Keys 1981, "Cubic convolution interpolation".

    Args:
        image: (C, H, W).
        uv: (T, 2) px, pixel centres at integers.
        backend: Implementation.
        border: Beyond the image, repeat its edge pixels ("clamp") or return 0 ("zero").

    Returns:
        (T, C); the pixel itself at integer uv.
    """
    check_shape("raster.image", image, None, None, None)
    check_shape("raster.uv", uv, None, 2)
    if border not in ("clamp", "zero"):
        raise RangeError("raster.border", "clamp or zero", border)
    if 0 in image.shape[1:]:
        raise ShapeError("raster.image", "at least one pixel", tuple(image.shape))
    _check_backend(backend, uv)
    _check_dtype("raster.image", image, uv.dtype)
    return _backend_module(backend).texture(image, uv, border == "clamp")


def texture_packed(
    values: Tensor,
    crop_rects: Tensor,
    crop_offsets: Tensor,
    layout: PixelLayout,
    uv: Tensor,
    backend: Backend = "warp",
    border: Border = "zero",
) -> Tensor:
    """`texture` for all draws at once: draw i samples crop i; differentiable to `uv` and `values`.

    Args:
        values: (S, C) texels of all crops, packed row-major.
        crop_rects: (N, 4) int64 px, half-open (x0, y0, x1, y1), position of each crop in the frame.
        crop_offsets: (N + 1,) int64, as in `PixelLayout`.
        layout: Pixels of the draws.
        uv: (T, 2) px of the frame.
        backend: Implementation.
        border: As for `texture`.

    Returns:
        (T, C); 0 for an empty crop.
    """
    crops = PixelLayout(crop_rects, crop_offsets)
    if crops.rects.shape[0] != layout.rects.shape[0]:
        raise ShapeError("raster.crop_rects", f"{layout.rects.shape[0]} crops, one a draw", crops.rects.shape[0])
    check_shape("raster.values", values, crops.size, None)
    check_shape("raster.uv", uv, layout.size, 2)
    if border not in ("clamp", "zero"):
        raise RangeError("raster.border", "clamp or zero", border)
    _check_backend(backend, uv)
    _check_dtype("raster.values", values, uv.dtype)
    return _backend_module(backend).texture_packed(values, crops, layout, uv, border == "clamp")


def antialias(fragments: Fragments, clip: Tensor, faces: Tensor, backend: Backend = "warp") -> Tensor:
    """Coverage (T,) in [0, 1] of each pixel by its draw, with outlines blended against empty neighbours.

    Between a hit pixel and an empty 4-neighbour of the same draw, the outline crosses the segment of their centres
    at t in [0, 1] from the hit: the hit pixel keeps 1/2 + t and the empty one gets t - 1/2, each clamped to [0,
    1]; of its neighbours, the one that changes a pixel most counts. An outline that sweeps over pixels therefore
    changes coverage continuously, and one along rows or columns covers exact areas. Parts narrower than a pixel
    are covered too much where they are hit, and not at all elsewhere. Differentiable to `clip` through the
    vertices of the outline's edge. The idea of differentiating analytic edge coverage is from Laine et al. 2020,
    "Modular primitives for high-performance differentiable rendering".

    Args:
        fragments: Result of `rasterize`.
        clip, faces: As given to `rasterize`.
        backend: Implementation.
    """
    _check_mesh(clip, faces, backend)
    return _backend_module(backend).antialias(fragments, clip, faces)


def bounding_rects(
    clip: Tensor, vertex_ranges: Tensor, height: int, width: int, margin: int = 2, near: float = NEAR_M
) -> Tensor:
    """Pixel rectangles that hold the vertices of each draw, inside the image.

    A draw on both sides of the near plane gets the whole image; one behind it, or without vertices, an empty
    rectangle.

    Args:
        clip: (V, 3).
        vertex_ranges: (N, 2) int, first vertex and end vertex of each draw.
        height, width: Image size, px.
        margin: Margin on each side, px.
        near: Near plane, m.

    Returns:
        (N, 4) int64, half-open.
    """
    check_shape("raster.clip", clip, None, 3)
    check_shape("raster.vertex_ranges", vertex_ranges, None, 2, floating=False)
    points = clip.detach().to("cpu", torch.float64)
    in_front = points[:, 2] >= near
    px = points[:, :2] / torch.where(in_front, points[:, 2], 1.0)[:, None]
    limit = torch.tensor([width, height], dtype=torch.float64)
    rects = torch.zeros(vertex_ranges.shape[0], 4, dtype=torch.int64)
    for i, (start, end) in enumerate(vertex_ranges.tolist()):
        front = in_front[start:end]
        if bool(front.all()) and end > start:
            low, high = px[start:end].aminmax(dim=0)
            low = (low - margin).ceil().clamp(min=0).minimum(limit)
            high = ((high + margin).floor() + 1).minimum(limit)
            rects[i, :2], rects[i, 2:] = low, high.maximum(low)
        elif bool(front.any()):
            rects[i, 2], rects[i, 3] = width, height
    return rects.to(clip.device)


def _backend_module(backend: Backend) -> ModuleType:
    """The implementation; Warp is imported only when it is used."""
    if backend == "warp":
        from scene_ir.raster import kernels

        return kernels
    from scene_ir.raster import reference

    return reference


def _check_mesh(clip: Tensor, faces: Tensor, backend: Backend) -> None:
    check_shape("raster.clip", clip, None, 3)
    check_shape("raster.faces", faces, None, 3, floating=False)
    _check_backend(backend, clip)
    if faces.shape[0]:
        low, high = index_range(faces)
        if not 0 <= low <= high < clip.shape[0]:
            raise RangeError("raster.faces", f"indices in [0, {clip.shape[0]})", [low, high])


def _check_finite(name: str, values: Tensor) -> None:
    """`check_finite`, in one pass over values with a finite sum."""
    if not math.isfinite(float(values.detach().sum())):
        check_finite(name, values)


def _cull_flags(cull: bool | Tensor, face_ranges: Tensor) -> Tensor | None:
    """Draws (N,) bool that lose their back faces; None if there are none."""
    if isinstance(cull, Tensor):
        check_shape("raster.cull", cull, face_ranges.shape[0], floating=False)
        return cull.to(face_ranges.device, torch.bool)
    return torch.ones_like(face_ranges[:, 0], dtype=torch.bool) if cull else None


def _check_backend(backend: Backend, tensor: Tensor) -> None:
    if backend not in ("warp", "reference"):
        raise RangeError("raster.backend", "warp or reference", backend)
    if backend == "warp" and tensor.dtype != torch.float32:
        raise ShapeError("raster", "float32 with backend warp (backend reference takes any dtype)", tensor.dtype)


def _check_dtype(name: str, tensor: Tensor, dtype: torch.dtype) -> None:
    if tensor.dtype != dtype:
        raise ShapeError(name, str(dtype), tensor.dtype)
