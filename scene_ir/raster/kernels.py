# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501, UP018, RUF046, SIM102 - the line above; Warp needs int(0) to declare what a loop changes, and
# evaluates both sides of `and`, so that a cheap test first saves time only as an `if` of its own.
"""The four verbs as NVIDIA Warp kernels: one source for CPU and CUDA, float32 tensors, used without copies.

The mathematics, its order of operations and its constants are those of `reference`, so that both decide alike
which triangle a pixel shows; fusing of multiply and add is off for the same reason. Gradients are written by hand.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.layout import Fragments, Layout
from scene_ir.raster.reference import DEGENERATE as _DEGENERATE
from scene_ir.raster.reference import SLACK_PX as _SLACK_PX
from scene_ir.raster.reference import SNAP_PX as _SNAP_PX
from scene_ir.raster.reference import first_largest


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Drops what native code writes to the standard error stream meanwhile."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


wp.config.quiet = True
wp.config.log_level = 40  # errors only; `quiet` is what older versions look at
# On a machine without a GPU, Warp's native code warns that it found no CUDA driver and heeds no log level.
with nullcontext() if torch.cuda.is_available() else _without_stderr():
    wp.init()
wp.set_module_options({"fuse_fp": False, "fast_math": False, "enable_backward": False})

DEGENERATE = wp.constant(wp.float64(_DEGENERATE))
SLACK_PX = wp.constant(wp.float64(_SLACK_PX))
SNAP_PX = wp.constant(wp.float64(_SNAP_PX))
FAR = wp.constant(wp.float64(1e300))
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))

NOTHING = (1 << 63) - 1
"""Key of a pixel that no triangle has reached: above all (depth bits << 32 | face)."""


@wp.struct
class Job:
    """One triangle of one draw: its pixel bounds, signed edge normals and |det|; the draw's rectangle and offset."""

    face: int
    x0: int
    y0: int
    x1: int
    y1: int
    offset: int
    bounds: wp.vec4i
    n0: wp.vec3d
    n1: wp.vec3d
    n2: wp.vec3d
    det: wp.float64


@wp.func
def find(offsets: wp.array(dtype=wp.int64), count: int, i: int):
    """The last of `count` ranges that starts at or before i; offsets ascend, empty ranges are passed over."""
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
def grow(box: wp.vec4d, x: wp.float64, y: wp.float64, w: wp.float64):
    scale = ONE / w
    u = x * scale
    v = y * scale
    return wp.vec4d(wp.min(box[0], u), wp.min(box[1], v), wp.max(box[2], u), wp.max(box[3], v))


@wp.func
def grow_side(box: wp.vec4d, a: wp.vec3d, b: wp.vec3d, near: wp.float64):
    """`box` widened by corner a and by where the side from a to b passes the near plane."""
    grown = box
    if a[2] >= near:
        grown = grow(grown, a[0], a[1], a[2])
    if (a[2] >= near) != (b[2] >= near):
        share = (near - a[2]) / (b[2] - a[2])
        grown = grow(grown, a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), near)
    return grown


@wp.func
def whole(value: wp.float64, low: int, high: int):
    """A whole number as an int, kept within [low, high]."""
    return wp.int32(wp.max(wp.float64(low), wp.min(wp.float64(high), value)))


@wp.func
def edge(n: wp.vec3d, x: int, y: int):
    return (n[0] * wp.float64(x) + n[1] * wp.float64(y)) + n[2]


@wp.func
def extent(c: wp.vec3d):
    return (wp.abs(c[0]) + wp.abs(c[1])) + wp.abs(c[2])


@wp.func
def inside(e: wp.float64, n: wp.vec3d):
    """Whether a pixel with edge function e is inside; on the edge, one of the two sides' triangles owns it."""
    first = n[0]
    if first == ZERO:
        first = n[1]
    if first == ZERO:
        first = n[2]
    return e > ZERO or (e == ZERO and first > ZERO)


@wp.func
def make_job(
    i: int,
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    job_offsets: wp.array(dtype=wp.int64),
    face_ranges: wp.array2d(dtype=wp.int64),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    near: wp.float64,
):
    """The i-th triangle over all draws; its bounds are empty where it cannot be seen."""
    job = Job()
    draw = find(job_offsets, rects.shape[0], i)
    job.face = wp.int32(face_ranges[draw, 0]) + i - wp.int32(job_offsets[draw])
    job.x0 = wp.int32(rects[draw, 0])
    job.y0 = wp.int32(rects[draw, 1])
    job.x1 = wp.int32(rects[draw, 2])
    job.y1 = wp.int32(rects[draw, 3])
    job.offset = wp.int32(offsets[draw])
    job.bounds = wp.vec4i(0, 0, 0, 0)
    c0 = wp.vec3d(clip[faces[job.face, 0]])
    c1 = wp.vec3d(clip[faces[job.face, 1]])
    c2 = wp.vec3d(clip[faces[job.face, 2]])
    if (c0[2] >= near or c1[2] >= near or c2[2] >= near) and job.x0 < job.x1 and job.y0 < job.y1:
        box = wp.vec4d(FAR, FAR, -FAR, -FAR)
        box = grow_side(box, c0, c1, near)
        box = grow_side(box, c1, c2, near)
        box = grow_side(box, c2, c0, near)
        xa = whole(wp.ceil(box[0] - SLACK_PX), job.x0, job.x1)
        ya = whole(wp.ceil(box[1] - SLACK_PX), job.y0, job.y1)
        xb = whole(wp.floor(box[2] + SLACK_PX) + ONE, xa, job.x1)
        yb = whole(wp.floor(box[3] + SLACK_PX) + ONE, ya, job.y1)
        if xb > xa or yb > ya:
            n0 = wp.cross(c1, c2)
            n1 = wp.cross(c2, c0)
            n2 = wp.cross(c0, c1)
            det = (c0[0] * n0[0] + c0[1] * n0[1]) + c0[2] * n0[2]
            if wp.abs(det) > DEGENERATE * (extent(c0) * extent(c1) * extent(c2)):
                sign = ONE
                if det < ZERO:
                    sign = -ONE
                job.n0 = n0 * sign
                job.n1 = n1 * sign
                job.n2 = n2 * sign
                job.det = det * sign
                job.bounds = wp.vec4i(xa, ya, xb, yb)
    return job


@wp.kernel
def rasterize_kernel(
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    job_offsets: wp.array(dtype=wp.int64),
    face_ranges: wp.array2d(dtype=wp.int64),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    near: wp.float64,
    keys: wp.array(dtype=wp.int64),
):
    job = make_job(wp.tid(), clip, faces, job_offsets, face_ranges, rects, offsets, near)
    for y in range(job.bounds[1], job.bounds[3]):
        row = job.offset + (y - job.y0) * (job.x1 - job.x0) - job.x0
        for x in range(job.bounds[0], job.bounds[2]):
            e0 = edge(job.n0, x, y)
            e1 = edge(job.n1, x, y)
            e2 = edge(job.n2, x, y)
            if e0 >= ZERO and e1 >= ZERO and e2 >= ZERO:
                if inside(e0, job.n0) and inside(e1, job.n1) and inside(e2, job.n2):
                    w = job.det / ((e0 + e1) + e2)
                    if w >= near and w < FAR:
                        bits = wp.int64(wp.cast(wp.float32(w), wp.int32))
                        wp.atomic_min(keys, row + x, (bits << wp.int64(32)) | wp.int64(job.face))


@wp.kernel
def unpack_kernel(
    keys: wp.array(dtype=wp.int64), face: wp.array(dtype=wp.int32), depth: wp.array(dtype=wp.float32)
):
    i = wp.tid()
    bits = wp.int32(keys[i] >> wp.int64(32))
    if bits < 0x7F800000:
        face[i] = wp.int32(keys[i] & wp.int64(0xFFFFFFFF))
        depth[i] = wp.cast(bits, wp.float32)
    else:
        face[i] = -1
        depth[i] = wp.float32(wp.inf)


@wp.func
def pixel_xy(i: int, rects: wp.array2d(dtype=wp.int64), offsets: wp.array(dtype=wp.int64)):
    """Image coordinates of packed pixel i, and the width of its draw."""
    draw = find(offsets, rects.shape[0], i)
    within = i - wp.int32(offsets[draw])
    x0 = wp.int32(rects[draw, 0])
    y0 = wp.int32(rects[draw, 1])
    width = wp.int32(rects[draw, 2]) - x0
    row = within // width
    return wp.vec3i(x0 + within - row * width, y0 + row, width)


@wp.kernel
def interpolate_kernel(
    face: wp.array(dtype=wp.int32),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    attributes: wp.array2d(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    i = wp.tid()
    f = face[i]
    if f >= 0:
        at = pixel_xy(i, rects, offsets)
        i0 = faces[f, 0]
        i1 = faces[f, 1]
        i2 = faces[f, 2]
        c0 = wp.vec3d(clip[i0])
        c1 = wp.vec3d(clip[i1])
        c2 = wp.vec3d(clip[i2])
        e0 = edge(wp.cross(c1, c2), at[0], at[1])
        e1 = edge(wp.cross(c2, c0), at[0], at[1])
        e2 = edge(wp.cross(c0, c1), at[0], at[1])
        scale = ONE / ((e0 + e1) + e2)
        for k in range(attributes.shape[1]):
            value = e0 * wp.float64(attributes[i0, k]) + e1 * wp.float64(attributes[i1, k])
            out[i, k] = wp.float32((value + e2 * wp.float64(attributes[i2, k])) * scale)


@wp.kernel
def interpolate_backward_kernel(
    face: wp.array(dtype=wp.int32),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    attributes: wp.array2d(dtype=wp.float32),
    grad_out: wp.array2d(dtype=wp.float32),
    with_clip: bool,
    with_attributes: bool,
    grad_clip: wp.array(dtype=wp.vec3d),
    grad_attributes: wp.array2d(dtype=wp.float32),
):
    i = wp.tid()
    f = face[i]
    if f >= 0:
        at = pixel_xy(i, rects, offsets)
        i0 = faces[f, 0]
        i1 = faces[f, 1]
        i2 = faces[f, 2]
        c0 = wp.vec3d(clip[i0])
        c1 = wp.vec3d(clip[i1])
        c2 = wp.vec3d(clip[i2])
        e0 = edge(wp.cross(c1, c2), at[0], at[1])
        e1 = edge(wp.cross(c2, c0), at[0], at[1])
        e2 = edge(wp.cross(c0, c1), at[0], at[1])
        scale = ONE / ((e0 + e1) + e2)
        b0 = e0 * scale
        b1 = e1 * scale
        b2 = e2 * scale
        # d out_k / d e_i = (a_ik - out_k) / sum e
        g0 = ZERO
        g1 = ZERO
        g2 = ZERO
        for k in range(attributes.shape[1]):
            g = wp.float64(grad_out[i, k])
            if with_clip:
                a0 = wp.float64(attributes[i0, k])
                a1 = wp.float64(attributes[i1, k])
                a2 = wp.float64(attributes[i2, k])
                value = b0 * a0 + b1 * a1 + b2 * a2
                g0 += g * (a0 - value)
                g1 += g * (a1 - value)
                g2 += g * (a2 - value)
            if with_attributes:
                wp.atomic_add(grad_attributes, i0, k, wp.float32(g * b0))
                wp.atomic_add(grad_attributes, i1, k, wp.float32(g * b1))
                wp.atomic_add(grad_attributes, i2, k, wp.float32(g * b2))
        if with_clip:
            p = wp.vec3d(wp.float64(at[0]), wp.float64(at[1]), ONE)
            # q . (a x b) has the gradients b x q to a and q x a to b; here gathered by corner.
            q0 = p * (g0 * scale)
            q1 = p * (g1 * scale)
            q2 = p * (g2 * scale)
            wp.atomic_add(grad_clip, i0, wp.cross(q1, c2) + wp.cross(c1, q2))
            wp.atomic_add(grad_clip, i1, wp.cross(q2, c0) + wp.cross(c2, q0))
            wp.atomic_add(grad_clip, i2, wp.cross(q0, c1) + wp.cross(c0, q1))


@wp.func
def weights(t: float):
    """Catmull-Rom weights of the pixels at -1, 0, 1, 2 for a sample at t in [0, 1)."""
    return wp.vec4f(
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@wp.func
def slopes(t: float):
    """Derivatives of `weights`."""
    return wp.vec4f(
        (-1.5 * t + 2.0) * t - 0.5,
        (4.5 * t - 5.0) * t,
        (-4.5 * t + 4.0) * t + 0.5,
        (1.5 * t - 1.0) * t,
    )


@wp.func
def local(value: float, origin: int, size: int):
    """Place in a crop; beyond 3 px outside all taps lie outside as well. A NaN stays one."""
    place = value - float(origin)
    if place < -4.0:
        place = -4.0
    if place > float(size + 3):
        place = float(size + 3)
    return place


@wp.func
def tap(first: int, k: int, size: int):
    """Index of tap k, of those at first - 1 ... first + 2, kept inside the crop."""
    return wp.clamp(first + k - 1, 0, size - 1)


@wp.func
def trim(weight: wp.vec4f, first: int, size: int):
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
class Taps:
    """The 4 x 4 texels of a sample: flat places of its columns and rows, weights, and the weights' derivatives."""

    columns: wp.vec4i
    rows: wp.vec4i
    wx: wp.vec4f
    wy: wp.vec4f
    sx: wp.vec4f
    sy: wp.vec4f


@wp.func
def find_taps(
    uv: wp.vec2f,
    x0: int,
    y0: int,
    width: int,
    height: int,
    start: int,
    texel_stride: int,
    clamp: bool,
):
    taps = Taps()
    u = local(uv[0], x0, width)
    v = local(uv[1], y0, height)
    x = wp.clamp(wp.int32(wp.floor(u)), -4, width + 3)
    y = wp.clamp(wp.int32(wp.floor(v)), -4, height + 3)
    taps.columns = wp.vec4i(tap(x, 0, width), tap(x, 1, width), tap(x, 2, width), tap(x, 3, width)) * texel_stride
    taps.rows = wp.vec4i(tap(y, 0, height), tap(y, 1, height), tap(y, 2, height), tap(y, 3, height))
    taps.rows = (taps.rows * width + wp.vec4i(start, start, start, start)) * texel_stride
    taps.wx = weights(u - wp.floor(u))
    taps.wy = weights(v - wp.floor(v))
    taps.sx = slopes(u - wp.floor(u))
    taps.sy = slopes(v - wp.floor(v))
    if not clamp:
        taps.wx = trim(taps.wx, x, width)
        taps.wy = trim(taps.wy, y, height)
        taps.sx = trim(taps.sx, x, width)
        taps.sy = trim(taps.sy, y, height)
    return taps


@wp.func
def row_sum(texels: wp.array(dtype=wp.float32), base: int, columns: wp.vec4i, weight: wp.vec4f):
    low = weight[0] * texels[base + columns[0]] + weight[1] * texels[base + columns[1]]
    return low + (weight[2] * texels[base + columns[2]] + weight[3] * texels[base + columns[3]])


@wp.kernel
def texture_kernel(
    texels: wp.array(dtype=wp.float32),
    channels: int,
    channel_stride: int,
    texel_stride: int,
    crops: wp.array2d(dtype=wp.int64),
    crop_offsets: wp.array(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    uv: wp.array(dtype=wp.vec2f),
    clamp: bool,
    out: wp.array2d(dtype=wp.float32),
):
    i = wp.tid()
    draw = find(offsets, crops.shape[0], i)
    x0 = wp.int32(crops[draw, 0])
    y0 = wp.int32(crops[draw, 1])
    width = wp.int32(crops[draw, 2]) - x0
    height = wp.int32(crops[draw, 3]) - y0
    if width > 0 and height > 0:
        t = find_taps(uv[i], x0, y0, width, height, wp.int32(crop_offsets[draw]), texel_stride, clamp)
        for c in range(channels):
            base = c * channel_stride
            low = t.wy[0] * row_sum(texels, base + t.rows[0], t.columns, t.wx)
            low += t.wy[1] * row_sum(texels, base + t.rows[1], t.columns, t.wx)
            high = t.wy[2] * row_sum(texels, base + t.rows[2], t.columns, t.wx)
            high += t.wy[3] * row_sum(texels, base + t.rows[3], t.columns, t.wx)
            out[i, c] = low + high


@wp.kernel
def texture_backward_kernel(
    texels: wp.array(dtype=wp.float32),
    channels: int,
    channel_stride: int,
    texel_stride: int,
    crops: wp.array2d(dtype=wp.int64),
    crop_offsets: wp.array(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    uv: wp.array(dtype=wp.vec2f),
    clamp: bool,
    grad_out: wp.array2d(dtype=wp.float32),
    with_uv: bool,
    with_texels: bool,
    grad_uv: wp.array(dtype=wp.vec2f),
    grad_texels: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    draw = find(offsets, crops.shape[0], i)
    x0 = wp.int32(crops[draw, 0])
    y0 = wp.int32(crops[draw, 1])
    width = wp.int32(crops[draw, 2]) - x0
    height = wp.int32(crops[draw, 3]) - y0
    if width > 0 and height > 0:
        t = find_taps(uv[i], x0, y0, width, height, wp.int32(crop_offsets[draw]), texel_stride, clamp)
        gu = float(0.0)
        gv = float(0.0)
        for c in range(channels):
            g = grad_out[i, c]
            base = c * channel_stride
            for row in range(4):
                at = base + t.rows[row]
                if with_uv:
                    gu += g * t.wy[row] * row_sum(texels, at, t.columns, t.sx)
                    gv += g * t.sy[row] * row_sum(texels, at, t.columns, t.wx)
                if with_texels:
                    for column in range(4):
                        wp.atomic_add(grad_texels, at + t.columns[column], g * t.wy[row] * t.wx[column])
        if with_uv:
            grad_uv[i] = wp.vec2f(gu, gv)


@wp.func
def offer(
    keys: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
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
    """Enters a triangle's end at `value` on a line of pixels [low, high) for the pair (s, s + 1), if that is a hit
    pixel on the triangle's side and an empty one. pixel: packed index of s; step: to that of s + 1."""
    beyond = value - wp.float64(s)
    if s >= low and s + 1 < high and beyond > -SNAP_PX and beyond < ONE + SNAP_PX:
        here = face[pixel] >= 0
        after = face[pixel + step] >= 0
        if here != after and here == is_end:
            t = beyond
            if not is_end:
                t = wp.float64(s) + ONE - value
            bits = wp.int64(wp.cast(wp.float32(wp.clamp(t, ZERO, ONE)), wp.int32))
            wp.atomic_max(keys, axis, pixel, (bits << wp.int64(32)) | wp.int64(key))


@wp.func
def offer_end(
    keys: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
    axis: int,
    value: wp.float64,
    low: int,
    high: int,
    origin: int,
    step: int,
    is_end: bool,
    key: int,
):
    """`offer` to the pair around `value`, and to both its neighbours where it meets a pixel centre. origin: packed
    index that pixel 0 of the line would have."""
    if value > wp.float64(low - 1) and value < wp.float64(high):
        below = wp.int32(wp.floor(value))
        offer(keys, face, axis, value, below, low, high, origin + below * step, step, is_end, key)
        nearest = wp.int32(wp.round(value))
        if wp.abs(value - wp.float64(nearest)) <= SNAP_PX:
            if nearest != below:
                offer(keys, face, axis, value, nearest, low, high, origin + nearest * step, step, is_end, key)
            other = nearest - 1
            if other != below:
                offer(keys, face, axis, value, other, low, high, origin + other * step, step, is_end, key)


@wp.func
def cut(span: wp.vec4d, slope: wp.float64, base: wp.float64, index: wp.float64):
    """`span` (low, high, low edge, high edge) of a line cut by slope * s + base >= 0; empty where high < low."""
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
def scan(
    job: Job,
    axis: int,
    line: int,
    near: wp.float64,
    face: wp.array(dtype=wp.int32),
    keys: wp.array2d(dtype=wp.int64),
):
    """Offers the ends of the triangle's interval on a row (axis 0) or column (axis 1) of pixels."""
    other = 1 - axis
    at = wp.float64(line)
    b0 = job.n0[other] * at + job.n0[2]
    b1 = job.n1[other] * at + job.n1[2]
    b2 = job.n2[other] * at + job.n2[2]
    span = wp.vec4d(-FAR, FAR, ZERO, ZERO)
    span = cut(span, job.n0[axis], b0, ZERO)
    span = cut(span, job.n1[axis], b1, ONE)
    span = cut(span, job.n2[axis], b2, ONE + ONE)
    slope = (job.n0[axis] + job.n1[axis]) + job.n2[axis]
    # w >= near is sum e <= |det| / near: a fourth side, which is never an outline.
    span = cut(span, -slope, job.det / near - ((b0 + b1) + b2), wp.float64(3.0))
    if span[0] <= span[1]:
        width = job.x1 - job.x0
        low = job.x0
        high = job.x1
        step = 1
        origin = job.offset + (line - job.y0) * width - job.x0
        if axis == 1:
            low = job.y0
            high = job.y1
            step = width
            origin = job.offset + (line - job.x0) - job.y0 * width
        low_edge = wp.int32(span[2])
        high_edge = wp.int32(span[3])
        if low_edge < 3:
            offer_end(keys, face, axis, span[0], low, high, origin, step, False, job.face * 3 + low_edge)
        if high_edge < 3:
            offer_end(keys, face, axis, span[1], low, high, origin, step, True, job.face * 3 + high_edge)


SMALL = wp.constant(64)
"""Bounds of up to this many pixels are searched for an empty one before the triangle is cut with its lines."""


@wp.func
def meets_empty(job: Job, face: wp.array(dtype=wp.int32)):
    """Whether there is an empty pixel in the triangle's bounds or beside them; without one it makes no outline."""
    found = (job.bounds[2] - job.bounds[0]) * (job.bounds[3] - job.bounds[1]) > SMALL
    if not found:
        width = job.x1 - job.x0
        for y in range(wp.max(job.bounds[1] - 1, job.y0), wp.min(job.bounds[3] + 1, job.y1)):
            row = job.offset + (y - job.y0) * width - job.x0
            for x in range(wp.max(job.bounds[0] - 1, job.x0), wp.min(job.bounds[2] + 1, job.x1)):
                if face[row + x] < 0:
                    found = bool(True)
    return found


@wp.kernel
def outline_kernel(
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    job_offsets: wp.array(dtype=wp.int64),
    face_ranges: wp.array2d(dtype=wp.int64),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    near: wp.float64,
    face: wp.array(dtype=wp.int32),
    keys: wp.array2d(dtype=wp.int64),
):
    job = make_job(wp.tid(), clip, faces, job_offsets, face_ranges, rects, offsets, near)
    if meets_empty(job, face):
        for line in range(job.bounds[1], job.bounds[3]):
            scan(job, 0, line, near, face, keys)
        for line in range(job.bounds[0], job.bounds[2]):
            scan(job, 1, line, near, face, keys)


@wp.struct
class Crossing:
    """An outline between a hit pixel and an empty neighbour: both pixels, the edge's corners, and its edge function
    at both, which is 0 at the outline."""

    hit: int
    empty: int
    ia: int
    ib: int
    p_hit: wp.vec3d
    p_empty: wp.vec3d
    e_hit: wp.float64
    e_empty: wp.float64


@wp.func
def crossing(
    axis: int,
    i: int,
    code: int,
    face: wp.array(dtype=wp.int32),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
):
    """The outline on edge `code` = face * 3 + edge between packed pixel i and the next one along `axis`."""
    found = Crossing()
    at = pixel_xy(i, rects, offsets)
    p = wp.vec3d(wp.float64(at[0]), wp.float64(at[1]), ONE)
    q = p + wp.vec3d(wp.float64(1 - axis), wp.float64(axis), ZERO)
    step = 1
    if axis == 1:
        step = at[2]
    found.hit = i
    found.empty = i + step
    found.p_hit = p
    found.p_empty = q
    if face[i] < 0:
        found.hit = i + step
        found.empty = i
        found.p_hit = q
        found.p_empty = p
    f = code // 3
    found.ia = faces[f, (code - 3 * f + 1) % 3]
    found.ib = faces[f, (code - 3 * f + 2) % 3]
    n = wp.cross(wp.vec3d(clip[found.ia]), wp.vec3d(clip[found.ib]))
    found.e_hit = (n[0] * found.p_hit[0] + n[1] * found.p_hit[1]) + n[2]
    found.e_empty = (n[0] * found.p_empty[0] + n[1] * found.p_empty[1]) + n[2]
    return found


@wp.func
def side_of(i: int, pixel: int):
    """0 where `pixel` is the first of the pair that starts at i, 1 where it is the second."""
    side = 0
    if pixel != i:
        side = 1
    return side


@wp.kernel
def change_kernel(
    keys: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    change: wp.array2d(dtype=wp.float64),
):
    axis, i = wp.tid()
    if keys[axis, i] >= wp.int64(0):
        code = wp.int32(keys[axis, i] & wp.int64(0xFFFFFFFF))
        found = crossing(axis, i, code, face, rects, offsets, clip, faces)
        t = found.e_hit / (found.e_hit - found.e_empty)
        pixel = found.empty
        if t < HALF:
            pixel = found.hit
        change[2 * axis + side_of(i, pixel), pixel] = wp.abs(HALF - t)


@wp.kernel
def change_backward_kernel(
    keys: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    clip: wp.array(dtype=wp.vec3f),
    faces: wp.array2d(dtype=wp.int32),
    grad_change: wp.array2d(dtype=wp.float64),
    grad_clip: wp.array(dtype=wp.vec3d),
):
    axis, i = wp.tid()
    if keys[axis, i] >= wp.int64(0):
        code = wp.int32(keys[axis, i] & wp.int64(0xFFFFFFFF))
        found = crossing(axis, i, code, face, rects, offsets, clip, faces)
        length = found.e_hit - found.e_empty
        pixel = found.empty
        sign = ONE
        if found.e_hit / length < HALF:
            pixel = found.hit
            sign = -ONE
        grad_t = sign * grad_change[2 * axis + side_of(i, pixel), pixel]
        # t = e_hit / (e_hit - e_empty), and e = p . (a x b)
        scale = grad_t / (length * length)
        q = (found.p_empty * found.e_hit - found.p_hit * found.e_empty) * scale
        wp.atomic_add(grad_clip, found.ia, wp.cross(wp.vec3d(clip[found.ib]), q))
        wp.atomic_add(grad_clip, found.ib, wp.cross(q, wp.vec3d(clip[found.ia])))


def rasterize(
    clip: Tensor, faces: Tensor, face_ranges: Tensor, layout: Layout, near: float
) -> tuple[Tensor, Tensor]:
    """See `verbs.rasterize`. Returns face (T,) int32 and depth (T,)."""
    size = layout.size
    keys = torch.full((size,), NOTHING, dtype=torch.int64, device=clip.device)
    face = torch.empty(size, dtype=torch.int32, device=clip.device)
    depth = torch.empty(size, dtype=torch.float32, device=clip.device)
    mesh = _mesh(clip, faces)
    jobs, count = _jobs(face_ranges)
    _launch(rasterize_kernel, count if size else 0, [*mesh, *jobs, *_layout(layout), near, wp.from_torch(keys)])
    _launch(unpack_kernel, size, [wp.from_torch(keys), wp.from_torch(face), wp.from_torch(depth)])
    return face, depth


def interpolate(fragments: Fragments, clip: Tensor, faces: Tensor, attributes: Tensor) -> Tensor:
    """See `verbs.interpolate`."""
    return _Interpolate.apply(fragments, clip, faces, attributes)


def texture(image: Tensor, uv: Tensor, clamp: bool) -> Tensor:
    """See `verbs.texture`."""
    channels, height, width = image.shape
    crop = torch.tensor([[0, 0, width, height]], device=uv.device)
    ends = torch.tensor([[0, width * height], [0, uv.shape[0]]], device=uv.device)
    strides = (channels, height * width, 1)
    return _Texture.apply(image, strides, (crop, ends[0]), ends[1], uv, clamp)


def texture_packed(values: Tensor, crops: Layout, layout: Layout, uv: Tensor, clamp: bool) -> Tensor:
    """See `verbs.texture_packed`."""
    channels = values.shape[1]
    return _Texture.apply(values, (channels, 1, channels), (crops.rects, crops.offsets), layout.offsets, uv, clamp)


def antialias(fragments: Fragments, clip: Tensor, faces: Tensor) -> Tensor:
    """See `verbs.antialias`."""
    return _Antialias.apply(fragments, clip, faces)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fragments: Fragments, clip: Tensor, faces: Tensor, attributes: Tensor) -> Tensor:
        ctx.save_for_backward(fragments.face, clip, faces, attributes)
        ctx.layout = fragments.layout
        out = attributes.new_zeros(fragments.face.shape[0], attributes.shape[1])
        hits = [wp.from_torch(fragments.face), *_layout(fragments.layout)]
        inputs = [*hits, *_mesh(clip, faces), _floats(attributes), wp.from_torch(out)]
        _launch(interpolate_kernel, out.shape[0] if out.numel() else 0, inputs)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out: Tensor):
        face, clip, faces, attributes = ctx.saved_tensors
        _, with_clip, _, with_attributes = ctx.needs_input_grad
        grad_clip = torch.zeros_like(clip, dtype=torch.float64)
        grad_attributes = torch.zeros_like(attributes, memory_format=torch.contiguous_format)
        inputs = [
            *(wp.from_torch(face), *_layout(ctx.layout), *_mesh(clip, faces)),
            *(_floats(attributes), _floats(grad_out), with_clip, with_attributes),
            *(wp.from_torch(grad_clip, dtype=wp.vec3d), wp.from_torch(grad_attributes)),
        ]
        _launch(interpolate_backward_kernel, face.shape[0] if grad_out.numel() else 0, inputs)
        to_clip = grad_clip.to(clip.dtype) if with_clip else None
        return None, to_clip, None, grad_attributes if with_attributes else None


class _Texture(torch.autograd.Function):
    @staticmethod
    def forward(ctx, texels: Tensor, strides, crops, offsets: Tensor, uv: Tensor, clamp: bool) -> Tensor:
        ctx.save_for_backward(texels, *crops, offsets, uv)
        ctx.strides, ctx.clamp = strides, clamp
        out = uv.new_zeros(uv.shape[0], strides[0])
        inputs = [*_sampling(texels, strides, crops, offsets, uv), clamp, wp.from_torch(out)]
        _launch(texture_kernel, out.shape[0] if out.numel() else 0, inputs)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out: Tensor):
        texels, crop_rects, crop_offsets, offsets, uv = ctx.saved_tensors
        with_texels, with_uv = ctx.needs_input_grad[0], ctx.needs_input_grad[4]
        grad_uv = torch.zeros_like(uv, memory_format=torch.contiguous_format)
        grad_texels = torch.zeros_like(texels, memory_format=torch.contiguous_format)
        inputs = [
            *_sampling(texels, ctx.strides, (crop_rects, crop_offsets), offsets, uv),
            *(ctx.clamp, _floats(grad_out), with_uv, with_texels),
            *(wp.from_torch(grad_uv, dtype=wp.vec2f), wp.from_torch(grad_texels.view(-1))),
        ]
        _launch(texture_backward_kernel, uv.shape[0] if grad_out.numel() else 0, inputs)
        return grad_texels if with_texels else None, None, None, None, grad_uv if with_uv else None, None


class _Antialias(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fragments: Fragments, clip: Tensor, faces: Tensor) -> Tensor:
        size = fragments.face.shape[0]
        face = wp.from_torch(fragments.face)
        mesh, layout = _mesh(clip, faces), _layout(fragments.layout)
        jobs, count = _jobs(fragments.face_ranges)
        keys = torch.full((2, size), -1, dtype=torch.int64, device=clip.device)
        change = torch.zeros(4, size, dtype=torch.float64, device=clip.device)
        inputs = [*mesh, *jobs, *layout, fragments.near, face, wp.from_torch(keys)]
        _launch(outline_kernel, count if size else 0, inputs)
        inputs = [wp.from_torch(keys), face, *layout, *mesh, wp.from_torch(change)]
        _launch(change_kernel, (2, size) if size else 0, inputs)
        amount, side = first_largest(change)
        ctx.save_for_backward(fragments.face, clip, faces, keys, side)
        ctx.layout = fragments.layout
        return torch.where(fragments.face >= 0, 1 - amount, amount).to(clip.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out: Tensor):
        face, clip, faces, keys, side = ctx.saved_tensors
        grad = torch.where(face >= 0, -grad_out, grad_out).to(torch.float64)
        grad_change = grad.new_zeros(4, face.shape[0]).scatter(0, side[None], grad[None])
        grad_clip = torch.zeros_like(clip, dtype=torch.float64)
        inputs = [
            *(wp.from_torch(keys), wp.from_torch(face), *_layout(ctx.layout), *_mesh(clip, faces)),
            *(wp.from_torch(grad_change), wp.from_torch(grad_clip, dtype=wp.vec3d)),
        ]
        _launch(change_backward_kernel, tuple(keys.shape) if keys.numel() else 0, inputs)
        return None, grad_clip.to(clip.dtype), None


def _launch(kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list) -> None:
    """Run a kernel on the device of its arrays, in torch's current stream."""
    if dim == 0:
        return
    device = next(i.device for i in inputs if isinstance(i, wp.array))
    stream = wp.stream_from_torch(wp.device_to_torch(device)) if device.is_cuda else None
    wp.launch(kernel, dim=dim, inputs=inputs, device=device, stream=stream)


def _mesh(clip: Tensor, faces: Tensor) -> list[wp.array]:
    corners = faces.to(torch.int32).contiguous()
    return [wp.from_torch(clip.detach().contiguous(), dtype=wp.vec3f), wp.from_torch(corners)]


def _jobs(face_ranges: Tensor) -> tuple[list[wp.array], int]:
    """Running triangle counts over the draws, the face ranges, and the number of triangles over all draws."""
    counts = face_ranges.diff(dim=1)[:, 0].clamp(min=0)
    offsets = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    return [wp.from_torch(offsets), wp.from_torch(face_ranges.contiguous())], int(offsets[-1])


def _layout(layout: Layout) -> list[wp.array]:
    return [wp.from_torch(layout.rects.contiguous()), wp.from_torch(layout.offsets.contiguous())]


def _floats(values: Tensor) -> wp.array:
    return wp.from_torch(values.detach().contiguous())


def _sampling(texels: Tensor, strides, crops, offsets: Tensor, uv: Tensor) -> list:
    flat = wp.from_torch(texels.detach().contiguous().view(-1))
    places = [wp.from_torch(t.contiguous()) for t in (*crops, offsets)]
    return [flat, *strides, *places, wp.from_torch(uv.detach().contiguous(), dtype=wp.vec2f)]
