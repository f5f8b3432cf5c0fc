# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: UP018, RUF046, SIM102 - the line above; Warp needs int(0) to declare a loop variable, and evaluates
# both sides of `and`, so that a cheap test first saves time only as a separate `if`.
"""The four verbs as Warp kernels: one source for CPU and CUDA, float32 tensors, no copies.

Mathematics, order of operations and constants are those of `reference`, so that both agree which triangle a pixel
shows; fused multiply-add is off for the same reason. Gradients are written by hand.

On a CPU the draws are distributed over threads, large ones in bands of rows, so that each pixel belongs to one
thread (`RasterPlan`). Triangles are rejected by the pixel bounds of their corners, which cost one division per
vertex; for outlines, only those remain that meet a row or column in which a hit pixel borders an empty one. A draw
with visible back faces, with most triangles behind others, is processed front to back and skips what is
hidden.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import (
    Floats,
    Floats2D,
    Floats3D,
    Ints,
    Ints2D,
    Longs,
    Longs2D,
    Vec2fs,
    Vec3ds,
    Vec3fs,
    Vec3is,
    Vec4is,
    Words,
    array,
    launch,
    split_range,
    start_warp,
    threads,
)
from scene_ir.raster.layout import (
    Fragments,
    PixelLayout,
    RasterPlan,
    gpu_lanes,
    gpu_parts,
    int32_faces,
    split_for_threads,
    split_outlines,
    tensor_version,
)
from scene_ir.raster.reference import DEGENERATE as _DEGENERATE
from scene_ir.raster.reference import SLACK_PX as _SLACK_PX
from scene_ir.raster.reference import SNAP_PX as _SNAP_PX

start_warp()
wp.set_module_options({"fuse_fp": False, "fast_math": False, "enable_backward": False})

DEGENERATE = wp.constant(wp.float64(_DEGENERATE))
SLACK_PX = wp.constant(wp.float64(_SLACK_PX))
SNAP_PX = wp.constant(wp.float64(_SNAP_PX))
FAR = wp.constant(wp.float64(1e300))
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
ALL_BITS = wp.constant(wp.uint64((1 << 64) - 1))
FARTHER = wp.constant(wp.float64(1.0 + 1e-6))
"""A depth this many times another one is farther, in float32 too."""
ROUNDING = wp.constant(wp.float64(1e-12))
"""Relative error of a sum of edge functions; a thousand times the rounding of float64."""
LIMIT_PX = wp.constant(wp.float64(1e9))
"""Clamp of pixel positions, which keeps them within int32."""
BEHIND_NEAR = wp.constant(-(1 << 31))
"""Marks a vertex before the near plane; its image position is meaningless."""
WIDE_ROW_PX = wp.constant(12)
"""Rows longer than this justify the divisions that find a triangle's first and last pixel."""
MIN_SLOPE = wp.constant(wp.float64(1e-6))
"""An edge function that changes by a smaller share of itself per pixel does not bound a row."""

TILE_PX = wp.constant(16)
"""Side of the squares for which the farthest visible depth is tracked."""
EMPTY_KEY = wp.constant(wp.int64((0x7F800000 << 32) | 0xFFFFFFFF))
"""Key of a pixel that no triangle has reached, (depth bits << 32 | face): infinite depth, face -1."""
X0, Y0, X1, Y1, ROW, ROW_END, OFFSET, FACE, FACE_END, CULL, FIRST = (wp.constant(i) for i in range(11))
"""Columns of `RasterPlan.parts`."""


@wp.struct
class TriangleEdges:
    """Signed edge normals and |det| of a triangle; det is 0 for an invisible one."""

    n0: wp.vec3d
    n1: wp.vec3d
    n2: wp.vec3d
    det: wp.float64


@wp.func
def _find_range(offsets: Longs, count: int, i: int):
    """The last of `count` ranges that starts at or before i; offsets ascend, empty ranges are skipped."""
    if i < count:  # a shortcut for draws of one pixel each
        if offsets[i] == wp.int64(i) and offsets[i + 1] == wp.int64(i + 1):
            return i
    low = int(0)
    high = int(count)
    while high - low > 1:
        middle = (low + high) // 2
        if wp.int32(offsets[middle]) <= i:
            low = middle
        else:
            high = middle
    return low


@wp.func
def _find_part(parts: Ints2D, i: int):
    """The part that holds packed pixel i."""
    low = int(0)
    high = parts.shape[0]
    while high - low > 1:
        middle = (low + high) // 2
        if parts[middle, FIRST] <= i:
            low = middle
        else:
            high = middle
    return low


@wp.func
def _to_int(value: wp.float64):
    """A whole number as an int."""
    return wp.int32(wp.clamp(value, -LIMIT_PX, LIMIT_PX))


@wp.func
def _pixels_near(u: wp.float64, v: wp.float64):
    """First and last pixel (x, y, x, y) that a point at u, v may touch; none where the first is later."""
    return wp.vec4i(
        _to_int(wp.ceil(u - SLACK_PX)),
        _to_int(wp.ceil(v - SLACK_PX)),
        _to_int(wp.floor(u + SLACK_PX)),
        _to_int(wp.floor(v + SLACK_PX)),
    )


@wp.func
def _merge_boxes(a: wp.vec4i, b: wp.vec4i):
    return wp.vec4i(wp.min(a[0], b[0]), wp.min(a[1], b[1]), wp.max(a[2], b[2]), wp.max(a[3], b[3]))


@wp.kernel
def _corner_kernel(start: int, clip: Vec3fs, near: wp.float64, boxes: Vec4is):
    i = start + wp.tid()
    c = wp.vec3d(clip[i])
    if c[2] >= near:
        scale = ONE / c[2]
        boxes[i] = _pixels_near(c[0] * scale, c[1] * scale)
    else:
        boxes[i] = wp.vec4i(BEHIND_NEAR, 0, 0, 0)


@wp.func
def _extend_by_edge(box: wp.vec4i, a: wp.vec3d, b: wp.vec3d, near: wp.float64):
    """`box` extended by corner a and by the crossing of edge a-b with the near plane."""
    grown = box
    if a[2] >= near:
        scale = ONE / a[2]
        grown = _merge_boxes(grown, _pixels_near(a[0] * scale, a[1] * scale))
    if (a[2] >= near) != (b[2] >= near):
        share = (near - a[2]) / (b[2] - a[2])
        scale = ONE / near
        u = (a[0] + share * (b[0] - a[0])) * scale
        v = (a[1] + share * (b[1] - a[1])) * scale
        grown = _merge_boxes(grown, _pixels_near(u, v))
    return grown


@wp.func
def _face_bounds(corner: wp.vec3i, clip: Vec3fs, boxes: Vec4is, near: wp.float64):
    """First and last pixel (x, y, x, y) of the part of a triangle beyond the near plane."""
    a = boxes[corner[0]]
    b = boxes[corner[1]]
    c = boxes[corner[2]]
    box = _merge_boxes(a, _merge_boxes(b, c))
    if box[0] == BEHIND_NEAR:
        c0 = wp.vec3d(clip[corner[0]])
        c1 = wp.vec3d(clip[corner[1]])
        c2 = wp.vec3d(clip[corner[2]])
        box = wp.vec4i(2000000000, 2000000000, -2000000000, -2000000000)
        box = _extend_by_edge(box, c0, c1, near)
        box = _extend_by_edge(box, c1, c2, near)
        box = _extend_by_edge(box, c2, c0, near)
    return box


@wp.func
def _edge_value(n: wp.vec3d, x: wp.float64, y: wp.float64):
    return (n[0] * x + n[1] * y) + n[2]


@wp.func
def _edge_value_px(n: wp.vec3d, x: int, y: int):
    return _edge_value(n, wp.float64(x), wp.float64(y))


@wp.func
def _l1_norm(c: wp.vec3d):
    return (wp.abs(c[0]) + wp.abs(c[1])) + wp.abs(c[2])


@wp.func
def _owns_pixel(e: wp.float64, n: wp.vec3d):
    """Whether a pixel with edge function e >= 0 is inside; an edge belongs to one of its two triangles."""
    first = n[0]
    if first == ZERO:
        first = n[1]
    if first == ZERO:
        first = n[2]
    return e > ZERO or first > ZERO


@wp.func
def _face_edges(corner: wp.vec3i, clip: Vec3fs, cull: int):
    """Edge functions of a triangle; none for a culled back face."""
    c0 = wp.vec3d(clip[corner[0]])
    c1 = wp.vec3d(clip[corner[1]])
    c2 = wp.vec3d(clip[corner[2]])
    edges = TriangleEdges()
    n0 = wp.cross(c1, c2)
    det = (c0[0] * n0[0] + c0[1] * n0[1]) + c0[2] * n0[2]
    if cull == 0 or det < ZERO:
        if wp.abs(det) > DEGENERATE * (_l1_norm(c0) * _l1_norm(c1) * _l1_norm(c2)):
            sign = ONE
            if det < ZERO:
                sign = -ONE
            edges.n0 = n0 * sign
            edges.n1 = wp.cross(c2, c0) * sign
            edges.n2 = wp.cross(c0, c1) * sign
            edges.det = det * sign
    return edges


@wp.func
def _narrow_span(span: wp.vec2i, n: wp.vec3d, run: wp.float64, y: int):
    """Columns [first, end) of a row without those certainly outside an edge, with a margin of two; `run` is 1 /
    n[0].
    """
    base = n[1] * wp.float64(y) + n[2]
    first = span[0]
    end = span[1]
    if wp.abs(n[0]) > MIN_SLOPE * (wp.abs(n[1] * wp.float64(y)) + wp.abs(n[2])):
        x = wp.clamp(-base * run, -LIMIT_PX, LIMIT_PX)
        if n[0] > ZERO:
            first = wp.max(first, wp.int32(wp.floor(x)) - 1)
        else:
            end = wp.min(end, wp.int32(wp.ceil(x)) + 2)
    return wp.vec2i(first, end)


@wp.func
def _fill_triangle(
    e: TriangleEdges,
    face: int,
    box: wp.vec4i,
    origin: int,
    width: int,
    near: wp.float64,
    alone: bool,
    layered: bool,
    keys: Longs,
):
    """Offer a triangle to the pixels of `box`, half-open.

    `origin` is the packed index of pixel (0, 0); `layered` means that many pixels probably show something nearer.
    """
    n = (e.n0 + e.n1) + e.n2
    # Bounds the rounding error of the depth's denominator, n . (x, y, 1).
    reach = wp.max(wp.max(wp.abs(box[0]), wp.abs(box[1])), wp.max(wp.abs(box[2]), wp.abs(box[3])))
    slack = ROUNDING * (_l1_norm(e.n0) + _l1_norm(e.n1) + _l1_norm(e.n2)) * wp.float64(reach + 1)
    runs = wp.vec3d(ONE / e.n0[0], ONE / e.n1[0], ONE / e.n2[0])
    for y in range(box[1], box[3]):
        row = origin + y * width
        span = wp.vec2i(box[0], box[2])
        if span[1] - span[0] > WIDE_ROW_PX:
            span = _narrow_span(span, e.n0, runs[0], y)
            span = _narrow_span(span, e.n1, runs[1], y)
            span = _narrow_span(span, e.n2, runs[2], y)
        for x in range(span[0], span[1]):
            if layered:
                behind = wp.float64(wp.cast(wp.int32(keys[row + x] >> wp.int64(32)), wp.float32))
                if e.det > (_edge_value_px(n, x, y) + slack) * (behind * FARTHER):
                    continue
            e0 = _edge_value_px(e.n0, x, y)
            e1 = _edge_value_px(e.n1, x, y)
            e2 = _edge_value_px(e.n2, x, y)
            least = wp.min(e0, wp.min(e1, e2))
            if least == ZERO:
                if not (_owns_pixel(e0, e.n0) and _owns_pixel(e1, e.n1) and _owns_pixel(e2, e.n2)):
                    least = -ONE
            w = e.det / ((e0 + e1) + e2)
            bits = wp.int64(wp.cast(wp.float32(w), wp.int32))
            key = (bits << wp.int64(32)) | wp.int64(face)
            key = wp.where(least >= ZERO, key, EMPTY_KEY)
            key = wp.where(w >= near, key, EMPTY_KEY)
            key = wp.where(w < FAR, key, EMPTY_KEY)
            if alone or key < EMPTY_KEY:
                wp.atomic_min(keys, row + x, key)


@wp.func
def _update_tiles(
    part: int, x0: int, x1: int, row: int, row_end: int, origin: int, width: int, keys: Longs, tiles: Floats3D
):
    """Record the farthest visible depth of each tile of a part."""
    for ty in range((row_end - row + TILE_PX - 1) // TILE_PX):
        for tx in range((x1 - x0 + TILE_PX - 1) // TILE_PX):
            farthest = wp.int64(0)
            for y in range(row + ty * TILE_PX, wp.min(row + ty * TILE_PX + TILE_PX, row_end)):
                for x in range(x0 + tx * TILE_PX, wp.min(x0 + tx * TILE_PX + TILE_PX, x1)):
                    farthest = wp.max(farthest, keys[origin + y * width + x])
            tiles[part, ty, tx] = wp.cast(wp.int32(farthest >> wp.int64(32)), wp.float32)


@wp.func
def _is_hidden(corner: wp.vec3i, clip: Vec3fs, part: int, x0: int, row: int, box: wp.vec4i, tiles: Floats3D):
    """Whether all tiles that a triangle in `box` may touch showed nearer surfaces at the last update."""
    nearest = wp.float64(wp.min(clip[corner[0]][2], wp.min(clip[corner[1]][2], clip[corner[2]][2])))
    for ty in range((box[1] - row) // TILE_PX, (box[3] - 1 - row) // TILE_PX + 1):
        for tx in range((box[0] - x0) // TILE_PX, (box[2] - 1 - x0) // TILE_PX + 1):
            if nearest <= wp.float64(tiles[part, ty, tx]) * FARTHER:
                return False
    return True


@wp.kernel
def _rasterize_kernel(
    start: int,
    lanes: int,
    parts: Ints2D,
    clip: Vec3fs,
    faces: Vec3is,
    boxes: Vec4is,
    near: wp.float64,
    order: Ints,
    tiles: Floats3D,
    keys: Longs,
):
    i = start + wp.tid()
    part = i // lanes
    x0 = parts[part, X0]
    x1 = parts[part, X1]
    row = parts[part, ROW]
    row_end = parts[part, ROW_END]
    width = x1 - x0
    origin = parts[part, OFFSET] - parts[part, Y0] * width - x0
    face = parts[part, FACE] + (i - part * lanes)
    end = parts[part, FACE_END]
    if x1 <= x0 or row_end <= row:
        end = face
    sorted = order.shape[0] > 0
    quarter = (end - face) // 4
    begin = int(face)
    while face < end:
        f = face
        if sorted:
            f = order[face]
            if quarter > 0 and (face == begin + quarter or face == begin + 2 * quarter):
                _update_tiles(part, x0, x1, row, row_end, origin, width, keys, tiles)
        box = _face_bounds(faces[f], clip, boxes, near)
        box = wp.vec4i(
            wp.max(box[0], x0), wp.max(box[1], row), wp.min(box[2] + 1, x1), wp.min(box[3] + 1, row_end)
        )
        some = box[0] < box[2] and box[1] < box[3]
        if sorted and some and quarter > 0 and face >= begin + quarter:
            some = not _is_hidden(faces[f], clip, part, x0, row, box, tiles)
        if some:
            e = _face_edges(faces[f], clip, parts[part, CULL])
            if e.det > ZERO:
                _fill_triangle(e, f, box, origin, width, near, lanes == 1, sorted, keys)
        face += lanes


@wp.kernel
def unpack_kernel(start: int, keys: Longs, face: Ints, depth: Floats):
    """Split the keys of pixels into face and depth.

    Args:
        start: First index.
        keys: (depth bits << 32 | face) of each pixel.
        face, depth: Receive the parts.
    """
    i = start + wp.tid()
    key = keys[i]
    face[i] = wp.int32(key & wp.int64(0xFFFFFFFF))
    depth[i] = wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)


@wp.func
def _pixel_xy(i: int, rects: Longs2D, offsets: Longs):
    """Image coordinates of packed pixel i, and the width of its draw."""
    draw = _find_range(offsets, rects.shape[0], i)
    within = i - wp.int32(offsets[draw])
    x0 = wp.int32(rects[draw, 0])
    y0 = wp.int32(rects[draw, 1])
    width = wp.int32(rects[draw, 2]) - x0
    row = within // width
    return wp.vec3i(x0 + within - row * width, y0 + row, width)


@wp.struct
class TriangleHit:
    """A triangle at a pixel.

    Attributes:
        i0, i1, i2: Vertex indices.
        c0, c1, c2: Clip coordinates.
        e: Edge functions at the pixel.
        scale: 1 / sum of `e`.
        b: Perspective-correct weights.
    """

    i0: int
    i1: int
    i2: int
    c0: wp.vec3d
    c1: wp.vec3d
    c2: wp.vec3d
    e: wp.vec3d
    scale: wp.float64
    b: wp.vec3d


@wp.func
def triangle_hit(f: int, x: wp.float64, y: wp.float64, clip: Vec3fs, faces: Vec3is):
    """The hit of face f at pixel (x, y).

    Args:
        f: Face.
        x, y: Pixel, px.
        clip, faces: The mesh.
    """
    hit = TriangleHit()
    corners = faces[f]
    hit.i0 = corners[0]
    hit.i1 = corners[1]
    hit.i2 = corners[2]
    hit.c0 = wp.vec3d(clip[hit.i0])
    hit.c1 = wp.vec3d(clip[hit.i1])
    hit.c2 = wp.vec3d(clip[hit.i2])
    e0 = _edge_value(wp.cross(hit.c1, hit.c2), x, y)
    e1 = _edge_value(wp.cross(hit.c2, hit.c0), x, y)
    e2 = _edge_value(wp.cross(hit.c0, hit.c1), x, y)
    hit.e = wp.vec3d(e0, e1, e2)
    hit.scale = ONE / ((e0 + e1) + e2)
    hit.b = hit.e * hit.scale
    return hit


@wp.func
def add_corner_gradients(hit: TriangleHit, q0: wp.vec3d, q1: wp.vec3d, q2: wp.vec3d, grad_clip: Vec3ds):
    """Add gradients to the edge functions, each times the pixel (x, y, 1), to the corners' gradients.

    Args:
        hit: The triangle.
        q0, q1, q2: Gradient to each edge function times (x, y, 1).
        grad_clip: (V,) gradient to clip coordinates.
    """
    # q . (a x b) has the gradients b x q to a and q x a to b, gathered by corner here.
    wp.atomic_add(grad_clip, hit.i0, wp.cross(q1, hit.c2) + wp.cross(hit.c1, q2))
    wp.atomic_add(grad_clip, hit.i1, wp.cross(q2, hit.c0) + wp.cross(hit.c2, q0))
    wp.atomic_add(grad_clip, hit.i2, wp.cross(q0, hit.c1) + wp.cross(hit.c0, q1))


@wp.kernel
def _interpolate_kernel(
    start: int,
    face: Ints,
    rects: Longs2D,
    offsets: Longs,
    clip: Vec3fs,
    faces: Vec3is,
    attributes: Floats2D,
    out: Floats2D,
):
    i = start + wp.tid()
    f = face[i]
    if f >= 0:
        at = _pixel_xy(i, rects, offsets)
        hit = triangle_hit(f, wp.float64(at[0]), wp.float64(at[1]), clip, faces)
        for k in range(attributes.shape[1]):
            value = hit.e[0] * wp.float64(attributes[hit.i0, k]) + hit.e[1] * wp.float64(attributes[hit.i1, k])
            out[i, k] = wp.float32((value + hit.e[2] * wp.float64(attributes[hit.i2, k])) * hit.scale)


@wp.kernel
def _interpolate_backward_kernel(
    start: int,
    face: Ints,
    rects: Longs2D,
    offsets: Longs,
    clip: Vec3fs,
    faces: Vec3is,
    attributes: Floats2D,
    grad_out: Floats2D,
    with_clip: bool,
    with_attributes: bool,
    grad_clip: Vec3ds,
    grad_attributes: Floats2D,
):
    i = start + wp.tid()
    f = face[i]
    if f >= 0:
        at = _pixel_xy(i, rects, offsets)
        hit = triangle_hit(f, wp.float64(at[0]), wp.float64(at[1]), clip, faces)
        # d out_k / d e_i = (a_ik - out_k) / sum e
        g0 = ZERO
        g1 = ZERO
        g2 = ZERO
        for k in range(attributes.shape[1]):
            g = wp.float64(grad_out[i, k])
            if with_clip:
                a0 = wp.float64(attributes[hit.i0, k])
                a1 = wp.float64(attributes[hit.i1, k])
                a2 = wp.float64(attributes[hit.i2, k])
                value = hit.b[0] * a0 + hit.b[1] * a1 + hit.b[2] * a2
                g0 += g * (a0 - value)
                g1 += g * (a1 - value)
                g2 += g * (a2 - value)
            if with_attributes:
                wp.atomic_add(grad_attributes, hit.i0, k, wp.float32(g * hit.b[0]))
                wp.atomic_add(grad_attributes, hit.i1, k, wp.float32(g * hit.b[1]))
                wp.atomic_add(grad_attributes, hit.i2, k, wp.float32(g * hit.b[2]))
        if with_clip:
            p = wp.vec3d(wp.float64(at[0]), wp.float64(at[1]), ONE)
            add_corner_gradients(hit, p * (g0 * hit.scale), p * (g1 * hit.scale), p * (g2 * hit.scale), grad_clip)


@wp.func
def _bicubic_weights(t: float):
    """Catmull-Rom weights of the pixels at -1, 0, 1, 2 for a sample at t in [0, 1)."""
    return wp.vec4f(
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@wp.func
def _bicubic_slopes(t: float):
    """Derivatives of `_bicubic_weights`."""
    return wp.vec4f(
        (-1.5 * t + 2.0) * t - 0.5, (4.5 * t - 5.0) * t, (-4.5 * t + 4.0) * t + 0.5, (1.5 * t - 1.0) * t
    )


@wp.func
def _clamp_to_crop(value: float, origin: int, size: int):
    """Position in a crop; farther than 3 px outside, all taps lie outside as well. NaN stays NaN."""
    place = value - float(origin)
    if place < -4.0:
        place = -4.0
    if place > float(size + 3):
        place = float(size + 3)
    return place


@wp.func
def _tap_index(first: int, k: int, size: int):
    """Index of tap k of those at first - 1 ... first + 2, clamped to the crop."""
    return wp.clamp(first + k - 1, 0, size - 1)


@wp.func
def _zero_outside(weight: wp.vec4f, first: int, size: int):
    """Weights with those of taps outside the crop set to 0."""
    keep = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    if first - 1 >= 0 and first - 1 < size:
        keep[0] = weight[0]
    if first >= 0 and first < size:
        keep[1] = weight[1]
    if first + 1 >= 0 and first + 1 < size:
        keep[2] = weight[2]
    if first + 2 >= 0 and first + 2 < size:
        keep[3] = weight[3]
    return keep


@wp.struct
class BicubicTaps:
    """The 4 x 4 texels of a sample: flat offsets of columns and rows, weights (wx, wy), and their derivatives (sx,
    sy).
    """

    columns: wp.vec4i
    rows: wp.vec4i
    wx: wp.vec4f
    wy: wp.vec4f
    sx: wp.vec4f
    sy: wp.vec4f


@wp.func
def bicubic_taps(
    uv: wp.vec2f, x0: int, y0: int, width: int, height: int, start: int, texel_stride: int, clamp: bool
):
    """Taps of a sample in one crop.

    Args:
        uv: Position in the frame, px.
        x0, y0, width, height: Crop, px.
        start: First texel of the crop.
        texel_stride: Distance between texels.
        clamp: Whether edge texels repeat beyond the crop.
    """
    taps = BicubicTaps()
    u = _clamp_to_crop(uv[0], x0, width)
    v = _clamp_to_crop(uv[1], y0, height)
    x = wp.clamp(wp.int32(wp.floor(u)), -4, width + 3)
    y = wp.clamp(wp.int32(wp.floor(v)), -4, height + 3)
    taps.wx = _bicubic_weights(u - wp.floor(u))
    taps.wy = _bicubic_weights(v - wp.floor(v))
    taps.sx = _bicubic_slopes(u - wp.floor(u))
    taps.sy = _bicubic_slopes(v - wp.floor(v))
    if x >= 1 and x + 2 < width and y >= 1 and y + 2 < height:  # nearly always
        at = start + (y - 1) * width
        taps.columns = wp.vec4i(x - 1, x, x + 1, x + 2) * texel_stride
        taps.rows = wp.vec4i(at, at + width, at + 2 * width, at + 3 * width) * texel_stride
        return taps
    taps.columns = (
        wp.vec4i(
            _tap_index(x, 0, width), _tap_index(x, 1, width), _tap_index(x, 2, width), _tap_index(x, 3, width)
        )
        * texel_stride
    )
    taps.rows = wp.vec4i(
        _tap_index(y, 0, height), _tap_index(y, 1, height), _tap_index(y, 2, height), _tap_index(y, 3, height)
    )
    taps.rows = (taps.rows * width + wp.vec4i(start, start, start, start)) * texel_stride
    if not clamp:
        taps.wx = _zero_outside(taps.wx, x, width)
        taps.wy = _zero_outside(taps.wy, y, height)
        taps.sx = _zero_outside(taps.sx, x, width)
        taps.sy = _zero_outside(taps.sy, y, height)
    return taps


@wp.func
def _weighted_row(texels: Floats, base: int, columns: wp.vec4i, weight: wp.vec4f):
    low = weight[0] * texels[base + columns[0]] + weight[1] * texels[base + columns[1]]
    return low + (weight[2] * texels[base + columns[2]] + weight[3] * texels[base + columns[3]])


@wp.kernel
def _texture_kernel(
    start: int,
    texels: Floats,
    channels: int,
    channel_stride: int,
    texel_stride: int,
    crops: Longs2D,
    crop_offsets: Longs,
    offsets: Longs,
    uv: Vec2fs,
    clamp: bool,
    out: Floats2D,
):
    i = start + wp.tid()
    draw = _find_range(offsets, crops.shape[0], i)
    x0 = wp.int32(crops[draw, 0])
    y0 = wp.int32(crops[draw, 1])
    width = wp.int32(crops[draw, 2]) - x0
    height = wp.int32(crops[draw, 3]) - y0
    if width > 0 and height > 0:
        t = bicubic_taps(uv[i], x0, y0, width, height, wp.int32(crop_offsets[draw]), texel_stride, clamp)
        for c in range(channels):
            base = c * channel_stride
            low = t.wy[0] * _weighted_row(texels, base + t.rows[0], t.columns, t.wx)
            low += t.wy[1] * _weighted_row(texels, base + t.rows[1], t.columns, t.wx)
            high = t.wy[2] * _weighted_row(texels, base + t.rows[2], t.columns, t.wx)
            high += t.wy[3] * _weighted_row(texels, base + t.rows[3], t.columns, t.wx)
            out[i, c] = low + high


@wp.kernel
def _texture_backward_kernel(
    start: int,
    texels: Floats,
    channels: int,
    channel_stride: int,
    texel_stride: int,
    crops: Longs2D,
    crop_offsets: Longs,
    offsets: Longs,
    uv: Vec2fs,
    clamp: bool,
    grad_out: Floats2D,
    with_uv: bool,
    with_texels: bool,
    grad_uv: Vec2fs,
    grad_texels: Floats,
):
    i = start + wp.tid()
    draw = _find_range(offsets, crops.shape[0], i)
    x0 = wp.int32(crops[draw, 0])
    y0 = wp.int32(crops[draw, 1])
    width = wp.int32(crops[draw, 2]) - x0
    height = wp.int32(crops[draw, 3]) - y0
    if width > 0 and height > 0:
        t = bicubic_taps(uv[i], x0, y0, width, height, wp.int32(crop_offsets[draw]), texel_stride, clamp)
        gu = float(0.0)
        gv = float(0.0)
        for c in range(channels):
            g = grad_out[i, c]
            base = c * channel_stride
            for row in range(4):
                at = base + t.rows[row]
                if with_uv:
                    gu += g * t.wy[row] * _weighted_row(texels, at, t.columns, t.sx)
                    gv += g * t.sy[row] * _weighted_row(texels, at, t.columns, t.wx)
                if with_texels:
                    for column in range(4):
                        wp.atomic_add(grad_texels, at + t.columns[column], g * t.wy[row] * t.wx[column])
        if with_uv:
            grad_uv[i] = wp.vec2f(gu, gv)


@wp.func
def _record_outline(
    keys: Longs2D,
    face: Ints,
    axis: int,
    value: wp.float64,
    s: int,
    low: int,
    high: int,
    pixel: int,
    step: int,
    is_end: bool,
    key: int,
):
    """Record the end of a triangle's interval at `value` for the pair (s, s + 1), if one of the two is a hit pixel
    on the triangle's side and the other is empty.

    `pixel` is the packed index of s on a line of pixels [low, high); `step` leads to s + 1.
    """
    beyond = value - wp.float64(s)
    if s >= low and s + 1 < high and beyond > -SNAP_PX and beyond < ONE + SNAP_PX:
        is_hit = face[pixel] >= 0
        next_is_hit = face[pixel + step] >= 0
        if is_hit != next_is_hit and is_hit == is_end:
            t = beyond
            if not is_end:
                t = wp.float64(s) + ONE - value
            bits = wp.int64(wp.cast(wp.float32(wp.clamp(t, ZERO, ONE)), wp.int32))
            wp.atomic_max(keys, axis, pixel, (bits << wp.int64(32)) | wp.int64(key))


@wp.func
def _record_end(
    keys: Longs2D,
    face: Ints,
    axis: int,
    value: wp.float64,
    low: int,
    high: int,
    origin: int,
    step: int,
    is_end: bool,
    key: int,
):
    """`_record_outline` for the pair around `value`, and for both neighbours where it meets a pixel centre.

    `origin` is the packed index of pixel 0 of the line.
    """
    if value > wp.float64(low - 1) and value < wp.float64(high):
        below = wp.int32(wp.floor(value))
        _record_outline(keys, face, axis, value, below, low, high, origin + below * step, step, is_end, key)
        nearest = wp.int32(wp.round(value))
        if wp.abs(value - wp.float64(nearest)) <= SNAP_PX:
            if nearest != below:
                _record_outline(
                    keys, face, axis, value, nearest, low, high, origin + nearest * step, step, is_end, key
                )
            other = nearest - 1
            if other != below:
                _record_outline(
                    keys, face, axis, value, other, low, high, origin + other * step, step, is_end, key
                )


@wp.func
def _clip_interval(span: wp.vec4d, slope: wp.float64, base: wp.float64, index: wp.float64):
    """`span` (low, high, low edge, high edge) of a line clipped by slope * s + base >= 0; empty where high < low."""
    low = span[0]
    high = span[1]
    low_edge = span[2]
    high_edge = span[3]
    if slope > ZERO:
        s = -base / slope
        if s > low:
            low = s
            low_edge = index
    elif slope < ZERO:
        s = -base / slope
        if s < high:
            high = s
            high_edge = index
    elif base < ZERO:
        high = -FAR
        low = FAR
    return wp.vec4d(low, high, low_edge, high_edge)


@wp.func
def _read_bits(words: Words, first: int, count: int):
    """`count` bits, 1 to 64, from bit `first`, which becomes the lowest. Reads one word beyond them."""
    word = first >> 6
    bit = wp.uint64(first & 63)
    high = (words[word + 1] << wp.uint64(1)) << (wp.uint64(63) - bit)
    return ((words[word] >> bit) | high) & (ALL_BITS >> wp.uint64(64 - count))


@wp.func
def _any_bit(words: Words, x: int, x_end: int, y: int, y_end: int, origin: int, width: int):
    """Whether a bit is set in columns [x, x_end) of rows [y, y_end)."""
    seen = wp.uint64(0)
    if x_end - x <= 64:
        at = origin + y * width + x
        last = origin + y_end * width + x
        keep = ALL_BITS >> wp.uint64(64 - (x_end - x))
        while at < last and seen == wp.uint64(0):
            word = at >> 6
            bit = wp.uint64(at & 63)
            seen = ((words[word] >> bit) | ((words[word + 1] << wp.uint64(1)) << (wp.uint64(63) - bit))) & keep
            at += width
    else:
        for row in range(y, y_end):
            first = int(x)
            while first < x_end:
                seen = seen | _read_bits(words, origin + row * width + first, wp.min(x_end - first, 64))
                first += 64
    return seen != wp.uint64(0)


@wp.func
def _lowest_bit(bits: wp.uint64):
    """Position, 0 to 63, of the lowest set bit."""
    return wp.int32(wp.bit_count((bits & (~bits + wp.uint64(1))) - wp.uint64(1)))


@wp.kernel
def _hit_kernel(start: int, face: Ints, hits: Words, coverage: Floats):
    """For 64 packed pixels, set a bit of `hits` and a coverage of 1 where a face is hit."""
    word = start + wp.tid()
    bits = wp.uint64(0)
    for i in range(64 * word, wp.min(64 * word + 64, face.shape[0])):
        hit = wp.where(face[i] >= 0, wp.uint64(1), wp.uint64(0))
        bits = bits | (hit << wp.uint64(i & 63))
        coverage[i] = float(hit)
    hits[word] = bits


@wp.kernel
def _boundary_kernel(
    start: int,
    parts: Ints2D,
    hits: Words,
    boundary: Words,
    right: Words,
    below: Words,
    either: Words,
    keys: Longs2D,
):
    """For 64 packed pixels, mark where hit and empty pixels meet, and clear the pairs' keys.

    `right`, `below`: this pixel and the next in the row or column differ; `either`: either; `boundary`:
    any of the four neighbours differs.
    """
    word = start + wp.tid()
    i = int(64 * word)
    end = wp.min(i + 64, keys.shape[1])
    boundary_bits = wp.uint64(0)
    right_bits = wp.uint64(0)
    below_bits = wp.uint64(0)
    while i < end:  # pixels of one row
        part = _find_part(parts, i)
        width = parts[part, X1] - parts[part, X0]
        within = i - parts[part, OFFSET]
        y = within // width
        x = within - y * width
        count = wp.min(end - i, width - x)
        run = ALL_BITS >> wp.uint64(64 - count)
        here = _read_bits(hits, i, count)
        to_right = here ^ _read_bits(hits, i + 1, count)
        if x + count == width:
            to_right = to_right & (run >> wp.uint64(1))
        to_below = wp.uint64(0)
        if parts[part, Y0] + y + 1 < parts[part, Y1]:
            to_below = here ^ _read_bits(hits, i + width, count)
        differs = to_right | to_below
        if x > 0:
            differs = differs | (here ^ _read_bits(hits, i - 1, count))
        else:
            differs = differs | ((here ^ (here << wp.uint64(1))) & run & ~wp.uint64(1))
        if y > 0:
            differs = differs | (here ^ _read_bits(hits, i - width, count))
        place = wp.uint64(i & 63)
        right_bits = right_bits | (to_right << place)
        below_bits = below_bits | (to_below << place)
        boundary_bits = boundary_bits | (differs << place)
        i += count
    boundary[word] = boundary_bits
    right[word] = right_bits
    below[word] = below_bits
    either[word] = right_bits | below_bits
    while right_bits != wp.uint64(0):
        keys[0, 64 * word + _lowest_bit(right_bits)] = wp.int64(-1)
        right_bits = right_bits & (right_bits - wp.uint64(1))
    while below_bits != wp.uint64(0):
        keys[1, 64 * word + _lowest_bit(below_bits)] = wp.int64(-1)
        below_bits = below_bits & (below_bits - wp.uint64(1))


@wp.func
def _scan_line(
    e: TriangleEdges,
    code: int,
    axis: int,
    line: int,
    low: int,
    high: int,
    origin: int,
    step: int,
    near: wp.float64,
    face: Ints,
    keys: Longs2D,
):
    """Record the ends of the triangle's interval on pixels [low, high) of a row (axis 0) or column (axis 1).

    `code` is 3 * face; `origin` the packed index of pixel 0 of the line; `step` leads to the next pixel.
    """
    other = 1 - axis
    line_px = wp.float64(line)
    b0 = e.n0[other] * line_px + e.n0[2]
    b1 = e.n1[other] * line_px + e.n1[2]
    b2 = e.n2[other] * line_px + e.n2[2]
    span = wp.vec4d(-FAR, FAR, ZERO, ZERO)
    span = _clip_interval(span, e.n0[axis], b0, ZERO)
    span = _clip_interval(span, e.n1[axis], b1, ONE)
    span = _clip_interval(span, e.n2[axis], b2, ONE + ONE)
    slope = (e.n0[axis] + e.n1[axis]) + e.n2[axis]
    # w >= near is sum e <= |det| / near: a fourth side, which is never an outline.
    span = _clip_interval(span, -slope, e.det / near - ((b0 + b1) + b2), wp.float64(3.0))
    if span[0] <= span[1]:
        low_edge = wp.int32(span[2])
        high_edge = wp.int32(span[3])
        if low_edge < 3:
            _record_end(keys, face, axis, span[0], low, high, origin, step, False, code + low_edge)
        if high_edge < 3:
            _record_end(keys, face, axis, span[1], low, high, origin, step, True, code + high_edge)


@wp.kernel
def _outline_kernel(
    start: int,
    lanes: int,
    parts: Ints2D,
    clip: Vec3fs,
    faces: Vec3is,
    boxes: Vec4is,
    near: wp.float64,
    face: Ints,
    right: Words,
    below: Words,
    either: Words,
    keys: Longs2D,
):
    """For each marked pair, find the triangle edge that reaches farthest from the hit to the empty pixel."""
    i = start + wp.tid()
    part = i // lanes
    x0 = parts[part, X0]
    x1 = parts[part, X1]
    row = parts[part, ROW]
    row_end = parts[part, ROW_END]
    column_end = wp.min(row_end + 1, parts[part, Y1])  # a column's last pair extends into the next part
    width = x1 - x0
    origin = parts[part, OFFSET] - parts[part, Y0] * width - x0
    f = parts[part, FACE] + (i - part * lanes)
    end = parts[part, FACE_END]
    if x1 <= x0 or row_end <= row:
        end = f
    while f < end:
        box = _face_bounds(faces[f], clip, boxes, near)
        # A pair may begin one pixel before the first that the triangle touches.
        xa = wp.max(box[0] - 1, x0)
        ya = wp.max(box[1] - 1, row)
        xb = wp.min(box[2] + 1, x1)
        yb = wp.min(box[3] + 1, row_end)
        if xa < xb and ya < yb:
            if _any_bit(either, xa, xb, ya, yb, origin, width):
                e = _face_edges(faces[f], clip, parts[part, CULL])
                if e.det > ZERO:
                    for y in range(wp.max(box[1], row), yb):
                        if _any_bit(right, xa, xb, y, y + 1, origin, width):
                            _scan_line(e, 3 * f, 0, y, x0, x1, origin + y * width, 1, near, face, keys)
                    x = wp.max(box[0], x0)
                    while x < xb:
                        columns = wp.uint64(0)
                        for y in range(ya, yb):
                            columns = columns | _read_bits(below, origin + y * width + x, wp.min(xb - x, 64))
                        while columns != wp.uint64(0):
                            column = x + _lowest_bit(columns)
                            _scan_line(
                                e, 3 * f, 1, column, row, column_end, origin + column, width, near, face, keys
                            )
                            columns = columns & (columns - wp.uint64(1))
                        x += 64
        f += lanes


@wp.struct
class OutlineCrossing:
    """An outline between a hit pixel and an empty neighbour.

    Attributes:
        ia, ib: Vertices of the edge.
        p_hit, p_empty: The pixels (x, y, 1).
        e_hit, e_empty: The edge function there; it is 0 at the outline.
        t: Distance of the outline from the hit, as a share.
        changes: Which pixel of the pair (0, 1) changes.
    """

    ia: int
    ib: int
    p_hit: wp.vec3d
    p_empty: wp.vec3d
    e_hit: wp.float64
    e_empty: wp.float64
    t: wp.float64
    changes: int


@wp.func
def _find_crossing(axis: int, x: int, y: int, first_is_hit: bool, code: int, clip: Vec3fs, faces: Vec3is):
    """The outline on edge `code` = face * 3 + edge between pixel (x, y) and the next one along `axis`."""
    crossing = OutlineCrossing()
    p = wp.vec3d(wp.float64(x), wp.float64(y), ONE)
    q = p + wp.vec3d(wp.float64(1 - axis), wp.float64(axis), ZERO)
    if first_is_hit:
        crossing.p_hit = p
        crossing.p_empty = q
    else:
        crossing.p_hit = q
        crossing.p_empty = p
    f = code // 3
    corner = faces[f]
    crossing.ia = corner[(code - 3 * f + 1) % 3]
    crossing.ib = corner[(code - 3 * f + 2) % 3]
    n = wp.cross(wp.vec3d(clip[crossing.ia]), wp.vec3d(clip[crossing.ib]))
    crossing.e_hit = (n[0] * crossing.p_hit[0] + n[1] * crossing.p_hit[1]) + n[2]
    crossing.e_empty = (n[0] * crossing.p_empty[0] + n[1] * crossing.p_empty[1]) + n[2]
    crossing.t = crossing.e_hit / (crossing.e_hit - crossing.e_empty)
    if (crossing.t < HALF) != first_is_hit:
        crossing.changes = 1
    return crossing


@wp.kernel
def _coverage_kernel(
    start: int,
    parts: Ints2D,
    clip: Vec3fs,
    faces: Vec3is,
    face: Ints,
    boundary: Words,
    right: Words,
    below: Words,
    keys: Longs2D,
    choice: Longs,
    coverage: Floats,
):
    """For 64 packed pixels, coverage where a hit and an empty pixel meet.

    `choice` receives the deciding edge * 4 + the neighbour's side, -1 where there is none.
    """
    word = start + wp.tid()
    bits = boundary[word]
    while bits != wp.uint64(0):
        i = 64 * word + _lowest_bit(bits)
        bits = bits & (bits - wp.uint64(1))
        part = _find_part(parts, i)
        width = parts[part, X1] - parts[part, X0]
        row = (i - parts[part, OFFSET]) // width
        column = i - parts[part, OFFSET] - row * width
        hit = face[i] >= 0
        largest = ZERO
        chosen = wp.int64(-1)
        # Order of sides: the pairs that start and end here along the row, then along the column.
        side = int(0)
        while side < 4:
            axis = side // 2
            back = side - 2 * axis
            step = 1
            if axis == 1:
                step = width
            x = column - back * (1 - axis)
            y = row - back * axis
            if x >= 0 and y >= 0:
                pair = i - back * step
                marked = _read_bits(below, pair, 1)
                if axis == 0:
                    marked = _read_bits(right, pair, 1)
                if marked != wp.uint64(0):
                    key = keys[axis, pair]
                    if key >= wp.int64(0):
                        code = wp.int32(key & wp.int64(0xFFFFFFFF))
                        first_is_hit = hit != (back == 1)
                        c = _find_crossing(
                            axis, parts[part, X0] + x, parts[part, Y0] + y, first_is_hit, code, clip, faces
                        )
                        amount = wp.abs(HALF - c.t)
                        if c.changes == back:
                            if amount > largest or side == 0:
                                largest = amount
                                chosen = wp.int64(code) * wp.int64(4) + wp.int64(side)
            side += 1
        choice[i] = chosen
        if hit:
            coverage[i] = wp.float32(ONE - largest)
        else:
            coverage[i] = wp.float32(largest)


@wp.kernel
def _coverage_backward_kernel(
    start: int,
    parts: Ints2D,
    clip: Vec3fs,
    faces: Vec3is,
    face: Ints,
    boundary: Words,
    choice: Longs,
    grad_out: Floats,
    grad_clip: Vec3ds,
):
    word = start + wp.tid()
    bits = boundary[word]
    while bits != wp.uint64(0):
        i = 64 * word + _lowest_bit(bits)
        bits = bits & (bits - wp.uint64(1))
        chosen = choice[i]
        if chosen >= wp.int64(0):
            part = _find_part(parts, i)
            width = parts[part, X1] - parts[part, X0]
            row = (i - parts[part, OFFSET]) // width
            column = i - parts[part, OFFSET] - row * width
            code = wp.int32(chosen / wp.int64(4))
            side = wp.int32(chosen - wp.int64(code) * wp.int64(4))
            axis = side // 2
            back = side - 2 * axis
            x = parts[part, X0] + column - back * (1 - axis)
            y = parts[part, Y0] + row - back * axis
            hit = face[i] >= 0
            c = _find_crossing(axis, x, y, hit != (back == 1), code, clip, faces)
            # An empty pixel gets t - 1/2, a hit one keeps 1/2 + t: both grow with t = e_hit / (e_hit - e_empty), and
            # e = p . (a x b).
            length = c.e_hit - c.e_empty
            scale = wp.float64(grad_out[i]) / (length * length)
            q = (c.p_empty * c.e_hit - c.p_hit * c.e_empty) * scale
            wp.atomic_add(grad_clip, c.ia, wp.cross(wp.vec3d(clip[c.ib]), q))
            wp.atomic_add(grad_clip, c.ib, wp.cross(q, wp.vec3d(clip[c.ia])))


def rasterize(
    clip: Tensor, faces: Tensor, face_ranges: Tensor, layout: PixelLayout, near: float, cull: Tensor | None
) -> tuple[Tensor, Tensor, RasterPlan]:
    """Implement `verbs.rasterize`.

    Args:
        clip, faces, face_ranges, layout, near, cull: See `verbs.rasterize`.

    Returns:
        Faces (T,) int32, depths (T,), and the plan for `antialias`.
    """
    plan = _make_plan(clip, faces, face_ranges, layout, near, cull)
    size = layout.size
    keys = torch.full((size,), int(EMPTY_KEY), dtype=torch.int64, device=clip.device)
    face = torch.empty(size, dtype=torch.int32, device=clip.device)
    depth = torch.empty(size, dtype=torch.float32, device=clip.device)
    if size:
        order = _front_to_back_order(clip, faces, face_ranges, cull)
        wide, high = (max(r[k + 2] - r[k] for r in layout.host_rects) if len(order) else 0 for k in (0, 1))
        tiles = clip.new_empty(len(plan.parts), -(-high // TILE_PX), -(-wide // TILE_PX), dtype=torch.float32)
        inputs = [
            plan.lanes,
            array(plan.parts),
            *_mesh_arrays(clip, faces),
            _box_array(plan),
            near,
            array(order),
            array(tiles),
            array(keys),
        ]
        launch(_rasterize_kernel, plan.cuts, inputs, clip.device)
        launch(unpack_kernel, split_range(size), [array(keys), array(face), array(depth)], clip.device)
    return face, depth, plan


def interpolate(fragments: Fragments, clip: Tensor, faces: Tensor, attributes: Tensor) -> Tensor:
    """Implement `verbs.interpolate`.

    Args:
        fragments, clip, faces, attributes: See `verbs.interpolate`.
    """
    return _Interpolate.apply(fragments, clip, faces, attributes)


def texture(image: Tensor, uv: Tensor, clamp: bool) -> Tensor:
    """Implement `verbs.texture`.

    Args:
        image, uv: See `verbs.texture`.
        clamp: Whether edge pixels repeat beyond the image.
    """
    channels, height, width = image.shape
    crop = torch.tensor([[0, 0, width, height]], device=uv.device)
    ends = torch.tensor([[0, width * height], [0, uv.shape[0]]], device=uv.device)
    strides = (channels, height * width, 1)
    return _Texture.apply(image, strides, (crop, ends[0]), ends[1], uv, clamp)


def texture_packed(values: Tensor, crops: PixelLayout, layout: PixelLayout, uv: Tensor, clamp: bool) -> Tensor:
    """Implement `verbs.texture_packed`.

    Args:
        values, layout, uv: See `verbs.texture_packed`.
        crops: Positions of the crops.
        clamp: Whether edge pixels repeat beyond a crop.
    """
    channels = values.shape[1]
    return _Texture.apply(values, (channels, 1, channels), (crops.rects, crops.offsets), layout.offsets, uv, clamp)


def antialias(fragments: Fragments, clip: Tensor, faces: Tensor) -> Tensor:
    """Implement `verbs.antialias`.

    Args:
        fragments, clip, faces: See `verbs.antialias`.
    """
    return _Antialias.apply(fragments, clip, faces)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fragments: Fragments, clip: Tensor, faces: Tensor, attributes: Tensor) -> Tensor:
        ctx.save_for_backward(fragments.face, clip, faces, attributes)
        ctx.layout = fragments.layout
        out = attributes.new_zeros(fragments.face.shape[0], attributes.shape[1])
        hits = [array(fragments.face), *_layout_arrays(fragments.layout)]
        inputs = [*hits, *_mesh_arrays(clip, faces), _dense(attributes), array(out)]
        launch(_interpolate_kernel, split_range(out.shape[0] if out.numel() else 0), inputs, out.device)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out: Tensor):
        face, clip, faces, attributes = ctx.saved_tensors
        _, with_clip, _, with_attributes = ctx.needs_input_grad
        grad_clip = torch.zeros_like(clip, dtype=torch.float64)
        grad_attributes = torch.zeros_like(attributes, memory_format=torch.contiguous_format)
        inputs = [
            *(array(face), *_layout_arrays(ctx.layout), *_mesh_arrays(clip, faces)),
            *(_dense(attributes), _dense(grad_out), with_clip, with_attributes),
            *(array(grad_clip, wp.vec3d), array(grad_attributes)),
        ]
        count = face.shape[0] if grad_out.numel() else 0
        launch(_interpolate_backward_kernel, _single_thread(count), inputs, clip.device)
        to_clip = grad_clip.to(clip.dtype) if with_clip else None
        return None, to_clip, None, grad_attributes if with_attributes else None


class _Texture(torch.autograd.Function):
    @staticmethod
    def forward(ctx, texels: Tensor, strides, crops, offsets: Tensor, uv: Tensor, clamp: bool) -> Tensor:
        ctx.save_for_backward(texels, *crops, offsets, uv)
        ctx.strides, ctx.clamp = strides, clamp
        out = uv.new_zeros(uv.shape[0], strides[0])
        inputs = [*_texel_arrays(texels, strides, crops, offsets, uv), clamp, array(out)]
        launch(_texture_kernel, split_range(out.shape[0] if out.numel() else 0), inputs, out.device)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out: Tensor):
        texels, crop_rects, crop_offsets, offsets, uv = ctx.saved_tensors
        with_texels, with_uv = ctx.needs_input_grad[0], ctx.needs_input_grad[4]
        grad_uv = torch.zeros_like(uv, memory_format=torch.contiguous_format)
        grad_texels = torch.zeros_like(texels, memory_format=torch.contiguous_format)
        inputs = [
            *_texel_arrays(texels, ctx.strides, (crop_rects, crop_offsets), offsets, uv),
            *(ctx.clamp, _dense(grad_out), with_uv, with_texels),
            *(array(grad_uv, wp.vec2f), array(grad_texels.view(-1))),
        ]
        count = uv.shape[0] if grad_out.numel() else 0
        edges = _single_thread(count) if with_texels else split_range(count)
        launch(_texture_backward_kernel, edges, inputs, uv.device)
        return grad_texels if with_texels else None, None, None, None, grad_uv if with_uv else None, None


class _Antialias(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fragments: Fragments, clip: Tensor, faces: Tensor) -> Tensor:
        plan = fragments.plan
        if plan is None or not plan.matches(clip):
            plan = _make_plan(clip, faces, fragments.face_ranges, fragments.layout, fragments.near, fragments.cull)
        size, like = fragments.face.shape[0], fragments.face
        coverage = torch.empty(size, dtype=clip.dtype, device=clip.device)
        count = (size + 63) // 64
        marks = torch.empty(
            (5, count + 1), dtype=torch.int64, device=clip.device
        )  # the last is read, never written
        keys, choice = like.new_empty((2, size), dtype=torch.int64), like.new_empty(size, dtype=torch.int64)
        if size:
            parts, mesh, face = array(plan.parts), _mesh_arrays(clip, faces), array(like)
            hits, boundary, right, below, either = (array(m, wp.uint64) for m in marks)
            found, seen, edges = array(keys), array(coverage), _split_words(size)
            launch(_hit_kernel, edges, [face, hits, seen], like.device)
            launch(_boundary_kernel, edges, [parts, hits, boundary, right, below, either, found], like.device)
            inputs = [
                plan.lanes,
                parts,
                *mesh,
                _box_array(plan),
                fragments.near,
                face,
                right,
                below,
                either,
                found,
            ]
            launch(_outline_kernel, plan.outline_cuts, inputs, like.device)
            inputs = [parts, *mesh, face, boundary, right, below, found, array(choice), seen]
            launch(_coverage_kernel, edges, inputs, like.device)
        ctx.save_for_backward(like, clip, faces, marks[1], choice)
        ctx.plan = plan
        return coverage

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out: Tensor):
        face, clip, faces, boundary, choice = ctx.saved_tensors
        grad_clip = torch.zeros_like(clip, dtype=torch.float64)
        if face.shape[0]:
            inputs = [
                *(array(ctx.plan.parts), *_mesh_arrays(clip, faces), array(face)),
                *(array(boundary, wp.uint64), array(choice)),
                *(_dense(grad_out), array(grad_clip, wp.vec3d)),
            ]
            launch(_coverage_backward_kernel, _single_thread(boundary.shape[0] - 1), inputs, face.device)
        return None, grad_clip.to(clip.dtype), None


def _single_thread(count: int) -> list[int]:
    """[0, count) for one thread: its pixels may add to the same vertices or texels."""
    return [0, count]


def _split_words(size: int) -> list[int]:
    """Ranges of the 64-bit words that hold `size` bits."""
    return [*(edge // 64 for edge in split_range(size)[:-1]), (size + 63) // 64]


def _make_plan(
    clip: Tensor, faces: Tensor, face_ranges: Tensor, layout: PixelLayout, near: float, cull: Tensor | None
) -> RasterPlan:
    """Divide the draws between threads and bound the vertices."""
    if clip.device.type == "cpu":
        rows, cuts = split_for_threads(layout, face_ranges, cull, threads())
        parts, lanes = torch.tensor(rows, dtype=torch.int32).view(-1, 11), 1
        outlines = split_outlines(rows, len(cuts) - 1)
    else:
        parts = gpu_parts(layout, face_ranges, cull).to(clip.device, non_blocking=True)
        lanes = gpu_lanes(faces, layout.rects.shape[0])
        cuts = outlines = [0, parts.shape[0] * lanes]
    boxes = torch.empty((clip.shape[0], 4), dtype=torch.int32, device=clip.device)
    inputs = [array(clip.contiguous(), wp.vec3f), near, array(boxes, wp.vec4i)]
    launch(_corner_kernel, split_range(clip.shape[0]), inputs, clip.device)
    return RasterPlan(parts, lanes, cuts, outlines, boxes, clip.detach(), tensor_version(clip))


def _front_to_back_order(clip: Tensor, faces: Tensor, face_ranges: Tensor, cull: Tensor | None) -> Tensor:
    """Faces (F,) int32 from nearest to farthest for a single CPU draw with visible back faces; else empty, (0,)."""
    if clip.device.type != "cpu" or len(face_ranges) != 1 or cull is not None or not len(faces):
        return torch.empty(0, dtype=torch.int32, device=clip.device)
    start, end = face_ranges[0].tolist()
    nearest = clip[:, 2][faces[start:end]].amin(dim=1)
    order = torch.arange(len(faces), dtype=torch.int32, device=clip.device)
    order[start:end] = nearest.argsort().to(torch.int32) + start
    return order


def _mesh_arrays(clip: Tensor, faces: Tensor) -> list[Any]:
    """Vertices and faces as arrays."""
    return [array(clip.contiguous(), wp.vec3f), array(int32_faces(faces), wp.vec3i)]


def _box_array(plan: RasterPlan) -> Any:
    return array(plan.boxes, wp.vec4i)


def _layout_arrays(layout: PixelLayout) -> list[Any]:
    return [array(layout.rects.contiguous()), array(layout.offsets.contiguous())]


def _dense(values: Tensor) -> Any:
    return array(values.contiguous())


def _texel_arrays(texels: Tensor, strides, crops, offsets: Tensor, uv: Tensor) -> list:
    flat = array(texels.contiguous().view(-1))
    places = [array(t.contiguous()) for t in (*crops, offsets)]
    return [flat, *strides, *places, array(uv.contiguous(), wp.vec2f)]
