# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501, UP018, SIM102, RUF059 - the line above; Warp needs int(0) to declare what a loop changes; `wp.grad`
# returns the gradients of all arguments.
"""The compositor's per-pixel work as Warp kernels: one pass a stage, forward and backward, float32.

What each stage computes is defined by the plain torch of `compositor` and `texture`, which the backend `reference`
runs; the constants are theirs. A stage is a `torch.autograd.Function`; gradients of the per-pixel functions come
from `wp.grad`, those that gather at vertices are written by hand. Shapes: N objects, V vertices, T packed pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.kernels import slopes, weights
from scene_ir.raster.launch import array, between, field, halves, launch, load, share, start_warp, vec3
from scene_ir.raster.layout import Fragments, Layout
from scene_ir.render import surfaces, texture

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False})

vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec9 = wp.types.vector(length=9, dtype=wp.float32)
vec5 = wp.types.vector(length=5, dtype=wp.float32)
vec17 = wp.types.vector(length=17, dtype=wp.float32)

NEAR = wp.constant(wp.float32(0.05))
FAR_AWAY = wp.constant(wp.float32(1e5))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
DEPTH_LOW, DEPTH_HIGH = (wp.constant(wp.float32(v)) for v in texture.DEPTH_TOLERANCE_M)
STRETCH_LOW, STRETCH_HIGH = (wp.constant(wp.float32(v)) for v in texture.STRETCH)
GRAZING, GRAZING_PAINT = (wp.constant(wp.float32(v)) for v in texture.GRAZING)
OPEN_TURN_LOW, OPEN_TURN_HIGH = (wp.constant(wp.float32(v)) for v in texture.OPEN_TURN)
OPEN_ALPHA_LOW, OPEN_ALPHA_HIGH = (wp.constant(wp.float32(v)) for v in texture.OPEN_ALPHA)
RIM_LOW, RIM_HIGH = (wp.constant(wp.float32(v)) for v in texture.RIM)
OUTLINE_LOW, OUTLINE_HIGH = (wp.constant(wp.float32(v * v)) for v in texture.OUTLINE_TURN)
BORDER_LOW, BORDER_HIGH = (wp.constant(wp.float32(v)) for v in texture.BORDER_PX)
MIRRORED_LOW, MIRRORED_HIGH = (wp.constant(wp.float32(v)) for v in texture.MIRRORED_RIM)
EXTENDED_LOW, EXTENDED_HIGH = (wp.constant(wp.float32(v)) for v in texture.EXTENDED_PX)
SHADOW_LOW, SHADOW_HIGH = (wp.constant(wp.float32(v)) for v in texture.SHADOW_EXTENDED_PX)
OPAQUE, EVEN = wp.constant(wp.float32(1.0 - 1e-6)), wp.constant(wp.float32(1e-6))
AROUND, ABOVE = (wp.constant(wp.float32(v)) for v in texture.AMBIENT)
GROUND_RGB = wp.constant(wp.vec3f(*texture.GROUND_RGB))
HORIZON_RGB = wp.constant(wp.vec3f(*texture.HORIZON_RGB))
ZENITH_RGB = wp.constant(wp.vec3f(*texture.ZENITH_RGB))


@wp.func
def step(x: float, low: float, high: float):
    """`texture.smoothstep`."""
    t = wp.clamp((x - low) * (1.0 / (high - low)), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def step_slope(x: float, low: float, high: float):
    """The derivative of `step`."""
    t = wp.clamp((x - low) * (1.0 / (high - low)), 0.0, 1.0)
    return 6.0 * (t - t * t) * (1.0 / (high - low))


# ---------------------------------------------------------------------------------------------- pixels of a layout


@wp.kernel(enable_backward=False)
def table_kernel(
    start: int,
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.vec4i),
):
    """For each packed pixel of a draw: the draw, x, y px, and the width of its rectangle."""
    draw = start + wp.tid()
    x0 = wp.int32(rects[draw, 0])
    y0 = wp.int32(rects[draw, 1])
    width = wp.int32(rects[draw, 2]) - x0
    at = wp.int32(offsets[draw])
    if width > 0:
        for y in range(wp.int32(rects[draw, 3]) - y0):
            for x in range(width):
                table[at] = wp.vec4i(draw, x0 + x, y0 + y, width)
                at += 1


# ------------------------------------------------------------------------------------------- what a mesh pixel shows


@wp.struct
class Hit:
    """A triangle at a pixel: its corners, and their perspective-correct weights."""

    i0: int
    i1: int
    i2: int
    c0: wp.vec3d
    c1: wp.vec3d
    c2: wp.vec3d
    b: wp.vec3d
    scale: wp.float64


@wp.func
def edge_at(a: wp.vec3d, b: wp.vec3d, x: wp.float64, y: wp.float64):
    n = wp.cross(a, b)
    return (n[0] * x + n[1] * y) + n[2]


@wp.func
def find_hit(f: int, x: int, y: int, clip: wp.array(dtype=wp.vec3f), faces: wp.array(dtype=wp.vec3i)):
    hit = Hit()
    corners = faces[f]
    hit.i0 = corners[0]
    hit.i1 = corners[1]
    hit.i2 = corners[2]
    hit.c0 = wp.vec3d(clip[hit.i0])
    hit.c1 = wp.vec3d(clip[hit.i1])
    hit.c2 = wp.vec3d(clip[hit.i2])
    px = wp.float64(x)
    py = wp.float64(y)
    e0 = edge_at(hit.c1, hit.c2, px, py)
    e1 = edge_at(hit.c2, hit.c0, px, py)
    e2 = edge_at(hit.c0, hit.c1, px, py)
    hit.scale = ONE / ((e0 + e1) + e2)
    hit.b = wp.vec3d(e0, e1, e2) * hit.scale
    return hit


@wp.func
def add_to_corners(
    hit: Hit, x: int, y: int, g0: wp.float64, g1: wp.float64, g2: wp.float64, grad_clip: wp.array(dtype=wp.vec3d)
):
    """Add what gradients g to the (unnormalised, times scale) edge functions mean for the corners."""
    p = wp.vec3d(wp.float64(x), wp.float64(y), ONE) * hit.scale
    q0 = p * g0
    q1 = p * g1
    q2 = p * g2
    wp.atomic_add(grad_clip, hit.i0, wp.cross(q1, hit.c2) + wp.cross(hit.c1, q2))
    wp.atomic_add(grad_clip, hit.i1, wp.cross(q2, hit.c0) + wp.cross(hit.c2, q0))
    wp.atomic_add(grad_clip, hit.i2, wp.cross(q0, hit.c1) + wp.cross(hit.c0, q1))


@wp.func
def corner_values(
    i: int,
    clip: wp.array(dtype=wp.vec3f),
    facing: wp.array(dtype=wp.float32),
    brighter: wp.array(dtype=wp.float32),
    base_clip: wp.array(dtype=wp.vec3f),
    base: wp.array(dtype=wp.vec3f),
):
    """Clip then minus now (3), w then, cosine now minus then, and then, paint, height, how much brighter."""
    then = base_clip[i]
    delta = then - clip[i]
    fixed = base[i]
    turned = facing[i] - fixed[0]
    return vec9(delta[0], delta[1], delta[2], then[2], turned, fixed[0], fixed[1], fixed[2], brighter[i])


@wp.func
def exact_dot(a: vec9, b: vec9):
    """In double precision: differences between corners matter, which are small beside the values."""
    total = wp.float64(a[0]) * wp.float64(b[0])
    for k in range(1, 9):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@wp.kernel(enable_backward=False)
def look_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.int32),
    clip: wp.array(dtype=wp.vec3f),
    facing: wp.array(dtype=wp.float32),
    brighter: wp.array(dtype=wp.float32),
    base_clip: wp.array(dtype=wp.vec3f),
    base: wp.array(dtype=wp.vec3f),
    faces: wp.array(dtype=wp.vec3i),
    out: wp.array(dtype=vec9),
):
    i = start + wp.tid()
    value = vec9()
    if face[i] >= 0:
        at = table[i]
        hit = find_hit(face[i], at[1], at[2], clip, faces)
        a = corner_values(hit.i0, clip, facing, brighter, base_clip, base) * wp.float32(hit.b[0])
        a += corner_values(hit.i1, clip, facing, brighter, base_clip, base) * wp.float32(hit.b[1])
        a += corner_values(hit.i2, clip, facing, brighter, base_clip, base) * wp.float32(hit.b[2])
        value = vec9(FAR_AWAY, FAR_AWAY, a[3], a[3] - a[2], a[4], a[5], a[6], a[7], a[8])
        if a[3] > NEAR:
            value[0] = (a[0] - wp.float32(at[1]) * a[2]) / a[3]
            value[1] = (a[1] - wp.float32(at[2]) * a[2]) / a[3]
    out[i] = value


@wp.kernel(enable_backward=False)
def look_backward_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.int32),
    clip: wp.array(dtype=wp.vec3f),
    facing: wp.array(dtype=wp.float32),
    brighter: wp.array(dtype=wp.float32),
    base_clip: wp.array(dtype=wp.vec3f),
    base: wp.array(dtype=wp.vec3f),
    faces: wp.array(dtype=wp.vec3i),
    value: wp.array(dtype=vec9),
    grad_out: wp.array(dtype=vec9),
    grad_clip: wp.array(dtype=wp.vec3d),
    grad_facing: wp.array(dtype=wp.float32),
    grad_brighter: wp.array(dtype=wp.float32),
):
    i = start + wp.tid()
    if face[i] >= 0:
        at = table[i]
        x = wp.float32(at[1])
        y = wp.float32(at[2])
        hit = find_hit(face[i], at[1], at[2], clip, faces)
        v = value[i]
        go = grad_out[i]
        # Back through the division, to the interpolated values.
        g = vec9(0.0, 0.0, -go[3], go[2] + go[3], go[4], go[5], go[6], go[7], go[8])
        if v[2] > NEAR:
            g[0] = go[0] / v[2]
            g[1] = go[1] / v[2]
            g[2] -= g[0] * x + g[1] * y
            g[3] -= g[0] * v[0] + g[1] * v[1]
        s0 = exact_dot(g, corner_values(hit.i0, clip, facing, brighter, base_clip, base))
        s1 = exact_dot(g, corner_values(hit.i1, clip, facing, brighter, base_clip, base))
        s2 = exact_dot(g, corner_values(hit.i2, clip, facing, brighter, base_clip, base))
        mean = hit.b[0] * s0 + hit.b[1] * s1 + hit.b[2] * s2
        add_to_corners(hit, at[1], at[2], s0 - mean, s1 - mean, s2 - mean, grad_clip)
        d = wp.vec3d(wp.float64(g[0]), wp.float64(g[1]), wp.float64(g[2]))
        wp.atomic_add(grad_clip, hit.i0, d * -hit.b[0])
        wp.atomic_add(grad_clip, hit.i1, d * -hit.b[1])
        wp.atomic_add(grad_clip, hit.i2, d * -hit.b[2])
        wp.atomic_add(grad_facing, hit.i0, g[4] * wp.float32(hit.b[0]))
        wp.atomic_add(grad_facing, hit.i1, g[4] * wp.float32(hit.b[1]))
        wp.atomic_add(grad_facing, hit.i2, g[4] * wp.float32(hit.b[2]))
        if g[8] != 0.0:
            wp.atomic_add(grad_brighter, hit.i0, g[8] * wp.float32(hit.b[0]))
            wp.atomic_add(grad_brighter, hit.i1, g[8] * wp.float32(hit.b[1]))
            wp.atomic_add(grad_brighter, hit.i2, g[8] * wp.float32(hit.b[2]))


def _look_inputs(fixed) -> list:
    table, face, clip, facing, brighter, base_clip, base, faces = fixed
    return [
        *(array(table, wp.vec4i), array(face), vec3(clip), array(facing), array(brighter)),
        *(vec3(base_clip), vec3(base), array(faces, wp.vec3i)),
    ]


# ------------------------------------------------------------------------------------------------------ the outline


@wp.struct
class Fringe:
    """How a pixel at a mesh's outline leans on its neighbours: `compositor._Fringe`, one row of it."""

    known: wp.vec4f
    weight: wp.vec4f
    total: float
    own: float
    hit: float
    pixel: wp.vec4i


@wp.func
def fringe_of(
    i: int,
    at: wp.vec4i,
    rects: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
    coverage: wp.array(dtype=wp.float32),
):
    out = Fringe()
    draw = at[0]
    out.pixel = wp.vec4i(i, i, i, i)
    if at[1] > wp.int32(rects[draw, 0]):
        out.pixel[0] = i - 1
    if at[1] + 1 < wp.int32(rects[draw, 2]):
        out.pixel[1] = i + 1
    if at[2] > wp.int32(rects[draw, 1]):
        out.pixel[2] = i - at[3]
    if at[2] + 1 < wp.int32(rects[draw, 3]):
        out.pixel[3] = i + at[3]
    total = float(0.0)
    for k in range(4):
        j = out.pixel[k]
        if j != i:
            if face[j] >= 0:
                raw = wp.max(2.0 * coverage[j] - 1.0, 0.0) + 1e-3
                out.known[k] = 1.0
                out.weight[k] = raw
                total += raw
    out.total = wp.max(total, 1e-3)
    out.weight = out.weight / out.total
    if face[i] >= 0:
        out.hit = 1.0
    out.own = 1.0
    if total > 0.0:
        out.own = step(coverage[i], 0.5, 1.0) * out.hit
    return out


@wp.func
def leans(i: int, face: wp.array(dtype=wp.int32), coverage: wp.array(dtype=wp.float32)):
    """Whether a pixel belongs to the mesh and is not wholly covered by it."""
    return coverage[i] < 1.0 and (face[i] >= 0 or coverage[i] > 0.0)


@wp.kernel(enable_backward=False)
def fill_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    rects: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
    coverage: wp.array(dtype=wp.float32),
    values: wp.array(dtype=vec9),
    out: wp.array(dtype=vec9),
):
    i = start + wp.tid()
    if leans(i, face, coverage):
        f = fringe_of(i, table[i], rects, face, coverage)
        mean = values[f.pixel[0]] * f.weight[0] + values[f.pixel[1]] * f.weight[1]
        mean += values[f.pixel[2]] * f.weight[2] + values[f.pixel[3]] * f.weight[3]
        out[i] = values[i] * (f.own * f.hit) + mean * (1.0 - f.own)
    else:
        out[i] = values[i]


@wp.kernel(enable_backward=False)
def keep_kernel(
    start: int,
    face: wp.array(dtype=wp.int32),
    coverage: wp.array(dtype=wp.float32),
    grad: wp.array(dtype=vec9),
    kept: wp.array(dtype=vec9),
):
    """Moves gradients of leaning pixels from `grad` to `kept`, so that `fill_backward_kernel` can spread them."""
    i = start + wp.tid()
    if leans(i, face, coverage):
        kept[i] = grad[i]
        grad[i] = vec9()


@wp.func
def fringe_to_coverage(
    i: int,
    f: Fringe,
    coverage: wp.array(dtype=wp.float32),
    to_own: float,
    to_weight: wp.vec4f,
    grad_coverage: wp.array(dtype=wp.float32),
):
    """Add what gradients to a pixel's own share and to its neighbours' weights mean for their coverages."""
    shared = wp.dot(to_weight, f.weight)
    for n in range(4):
        if f.known[n] > 0.0:
            if coverage[f.pixel[n]] >= 0.5:
                wp.atomic_add(grad_coverage, f.pixel[n], 2.0 * (to_weight[n] - shared) / f.total)
    if f.known[0] + f.known[1] + f.known[2] + f.known[3] > 0.0:
        wp.atomic_add(grad_coverage, i, to_own * f.hit * step_slope(coverage[i], 0.5, 1.0))


@wp.kernel(enable_backward=False)
def fill_backward_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    rects: wp.array2d(dtype=wp.int64),
    face: wp.array(dtype=wp.int32),
    coverage: wp.array(dtype=wp.float32),
    values: wp.array(dtype=vec9),
    kept: wp.array(dtype=vec9),
    grad: wp.array(dtype=vec9),
    grad_coverage: wp.array(dtype=wp.float32),
):
    i = start + wp.tid()
    if leans(i, face, coverage):
        f = fringe_of(i, table[i], rects, face, coverage)
        g = kept[i]
        rest = 1.0 - f.own
        wp.atomic_add(grad, i, g * (f.own * f.hit))
        to_own = f.hit * wp.dot(g, values[i])
        to_weight = wp.vec4f(0.0, 0.0, 0.0, 0.0)
        for n in range(4):
            if f.known[n] > 0.0:
                wp.atomic_add(grad, f.pixel[n], g * (rest * f.weight[n]))
                along = wp.dot(g, values[f.pixel[n]])
                to_own -= f.weight[n] * along
                to_weight[n] = rest * along
        fringe_to_coverage(i, f, coverage, to_own, to_weight, grad_coverage)


# --------------------------------------------------------------------------------------- looking up the photograph


@wp.struct
class Taps:
    """The 4 x 4 texels of a Catmull-Rom sample, of those inside the crop: flat places, weights and their slopes."""

    columns: wp.vec4i
    rows: wp.vec4i
    wx: wp.vec4f
    wy: wp.vec4f
    sx: wp.vec4f
    sy: wp.vec4f


@wp.func
def kept(weight: wp.vec4f, first: int, size: int):
    """Weights with those of taps outside the crop set to 0."""
    out = weight
    for k in range(4):
        if first + k - 1 < 0 or first + k - 1 >= size:
            out[k] = 0.0
    return out


@wp.func
def taps_at(uv: wp.vec2f, rect: wp.vec4i, start: int, zero_border: bool):
    taps = Taps()
    width = rect[2] - rect[0]
    height = rect[3] - rect[1]
    u = wp.clamp(uv[0] - wp.float32(rect[0]), -4.0, wp.float32(width + 3))
    v = wp.clamp(uv[1] - wp.float32(rect[1]), -4.0, wp.float32(height + 3))
    x = wp.int32(wp.floor(u))
    y = wp.int32(wp.floor(v))
    for k in range(4):
        taps.columns[k] = wp.clamp(x + k - 1, 0, width - 1)
        taps.rows[k] = start + wp.clamp(y + k - 1, 0, height - 1) * width
    tu = u - wp.floor(u)
    tv = v - wp.floor(v)
    taps.wx = weights(tu)
    taps.wy = weights(tv)
    taps.sx = slopes(tu)
    taps.sy = slopes(tv)
    if zero_border:
        taps.wx = kept(taps.wx, x, width)
        taps.wy = kept(taps.wy, y, height)
        taps.sx = kept(taps.sx, x, width)
        taps.sy = kept(taps.sy, y, height)
    return taps


@wp.func
def sample(texels: wp.array(dtype=vec8), t: Taps):
    out = vec8()
    for k in range(4):
        a = texels[t.rows[k] + t.columns[0]]
        b = texels[t.rows[k] + t.columns[1]]
        c = texels[t.rows[k] + t.columns[2]]
        d = texels[t.rows[k] + t.columns[3]]
        out += ((a * t.wx[0] + b * t.wx[1]) + (c * t.wx[2] + d * t.wx[3])) * t.wy[k]
    return out


@wp.struct
class Sampled:
    """A texel between texels, and how it changes along u and v."""

    value: vec8
    to_u: vec8
    to_v: vec8


@wp.func
def sample_both(texels: wp.array(dtype=vec8), t: Taps):
    out = Sampled()
    for k in range(4):
        a = texels[t.rows[k] + t.columns[0]]
        b = texels[t.rows[k] + t.columns[1]]
        c = texels[t.rows[k] + t.columns[2]]
        d = texels[t.rows[k] + t.columns[3]]
        along = (a * t.wx[0] + b * t.wx[1]) + (c * t.wx[2] + d * t.wx[3])
        out.value += along * t.wy[k]
        out.to_v += along * t.sy[k]
        out.to_u += ((a * t.sx[0] + b * t.sx[1]) + (c * t.sx[2] + d * t.sx[3])) * t.wy[k]
    return out


@wp.func
def texel_at(texels: wp.array(dtype=vec8), rect: wp.vec4i, start: int, uv: wp.vec2f):
    """The texel at a place of the frame; 0 in an empty crop."""
    out = vec8()
    if rect[2] > rect[0]:
        out = sample(texels, taps_at(uv, rect, start, False))
    return out


@wp.func
def texel_around(texels: wp.array(dtype=vec8), rect: wp.vec4i, start: int, uv: wp.vec2f):
    """`texel_at`, and how it changes."""
    out = Sampled()
    if rect[2] > rect[0]:
        out = sample_both(texels, taps_at(uv, rect, start, False))
    return out


@wp.func
def rect_of(rects: wp.array2d(dtype=wp.int64), i: int):
    return wp.vec4i(wp.int32(rects[i, 0]), wp.int32(rects[i, 1]), wp.int32(rects[i, 2]), wp.int32(rects[i, 3]))


# ------------------------------------------------------------------------------------ a pixel of mesh, of its halo


@wp.func
def inside_weight(u: float, v: float, wh: wp.vec2f, low: float, high: float):
    """`texture.inside_weight`."""
    beyond_u = wp.max(-u, u - (wh[0] - 1.0))
    beyond_v = wp.max(-v, v - (wh[1] - 1.0))
    return (1.0 - step(beyond_u, low, high)) * (1.0 - step(beyond_v, low, high))


@wp.func
def facing_weight(turned: float, cos_then: float, paint: float):
    """`texture.facing_weight`."""
    positive = 0.5 * (cos_then + wp.sqrt(cos_then * cos_then + 1e-4))
    slack = GRAZING + (GRAZING_PAINT - GRAZING) * paint
    return 1.0 - step(turned / (positive + slack), STRETCH_LOW, STRETCH_HIGH)


@wp.func
def seen_weight(look: vec9, texel: vec8, xy: wp.vec2f, wh: wp.vec2f):
    """How much of what is shown the photograph knows; and how much of it it sees there at all."""
    u = xy[0] + look[0]
    v = xy[1] + look[1]
    clear = 1.0 - step(texel[4], 0.0, 1.0)
    inside = inside_weight(u, v, wh, BORDER_LOW, BORDER_HIGH)
    facing = facing_weight(look[4], look[5], look[6])
    weight = facing * inside * clear
    if inside < 1.0:
        near = inside_weight(u, v, wh, EXTENDED_LOW, EXTENDED_HIGH) * step(texel[3], 0.5, 0.95)
        weight = weight + facing * (1.0 - inside) * near * clear
    weight = weight * (1.0 - step(look[2] - texel[6], DEPTH_LOW, DEPTH_HIGH))
    return wp.vec2f(weight, inside * clear)


@wp.func
def relit(c: float, brighter: float):
    """`texture.relit`, one channel of it."""
    return c * (1.0 + brighter * (1.0 - c * c))


@wp.func
def relit_slope(c: float, brighter: float):
    """Its derivative to the colour."""
    return 1.0 + brighter * (1.0 - 3.0 * c * c)


@wp.func
def mesh_pixel(look: vec9, texel: vec8, xy: wp.vec2f, wh: wp.vec2f):
    """Premultiplied RGB, opacity, and how much is left to be completed."""
    seen = seen_weight(look, texel, xy, wh)
    weight = seen[0]
    alpha = texel[3]
    rim = 1.0 - step(look[5], RIM_LOW, RIM_HIGH)
    opened = step(look[4], OPEN_TURN_LOW, OPEN_TURN_HIGH) * rim * wp.max(1.0 - alpha, 0.0)
    empty = seen[1] * (1.0 - step(texel[7], 0.1, 0.9))
    closed = weight * opened * (1.0 - empty) * step(alpha, OPEN_ALPHA_LOW, OPEN_ALPHA_HIGH)
    shown = weight + closed / wp.max(alpha, OPEN_ALPHA_LOW)
    out = vec5()
    out[0] = shown * relit(texel[0], look[8])
    out[1] = shown * relit(texel[1], look[8])
    out[2] = shown * relit(texel[2], look[8])
    out[3] = shown * alpha
    out[4] = (1.0 - weight) * (1.0 - empty)
    return out


@wp.func
def plainly_seen(look: vec9, texel: vec8, u: float, v: float, wh: wp.vec2f):
    """Whether every weight of `mesh_pixel` is flat at full: then it is the texel, relit, and so is its gradient."""
    seen = texel[4] <= 0.0 and texel[7] >= 0.9 and look[2] - texel[6] <= DEPTH_LOW
    if seen:
        seen = (
            u >= -BORDER_LOW
            and u <= wh[0] - 1.0 + BORDER_LOW
            and v >= -BORDER_LOW
            and v <= wh[1] - 1.0 + BORDER_LOW
        )
    if seen:  # nothing opens up: it did not turn, lies inside, or is opaque
        seen = look[4] <= OPEN_TURN_LOW or look[5] >= RIM_HIGH or texel[3] >= OPAQUE
    if seen:
        seen = look[4] <= STRETCH_LOW * (GRAZING_PAINT + wp.max(look[5], 0.0))
    return seen


@wp.func
def mesh_loss(look: vec9, texel: vec8, xy: wp.vec2f, wh: wp.vec2f, g: wp.vec4f, to_fill: float):
    p = mesh_pixel(look, texel, xy, wh)
    return p[0] * g[0] + p[1] * g[1] + p[2] * g[2] + p[3] * g[3] + p[4] * to_fill


@wp.func
def halo_pixel(look: vec9, texel: vec8, xy: wp.vec2f, wh: wp.vec2f):
    """Premultiplied RGB and opacity."""
    seen = seen_weight(look, texel, xy, wh)
    on_outline = 1.0 - step(look[4] * look[4], OUTLINE_LOW, OUTLINE_HIGH)
    shown = seen[0] * step(texel[5], 0.0, 1.0) * on_outline
    return wp.vec4f(
        shown * relit(texel[0], look[8]),
        shown * relit(texel[1], look[8]),
        shown * relit(texel[2], look[8]),
        shown * texel[3],
    )


@wp.func
def halo_loss(look: vec9, texel: vec8, xy: wp.vec2f, wh: wp.vec2f, g: wp.vec4f):
    return wp.dot(halo_pixel(look, texel, xy, wh), g)


@wp.func
def in_mesh(i: int, face: wp.array(dtype=wp.int32), coverage: wp.array(dtype=wp.float32)):
    return face[i] >= 0 or coverage[i] > 0.0


@wp.func
def in_halo(i: int, nearest: wp.array(dtype=wp.int64), coverage: wp.array(dtype=wp.float32)):
    return nearest[i] >= wp.int64(0) and coverage[i] < 1.0


@wp.kernel(enable_backward=False)
def shade_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.int32),
    coverage: wp.array(dtype=wp.float32),
    nearest: wp.array(dtype=wp.int64),
    texels: wp.array(dtype=vec8),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    frame_wh: wp.array(dtype=wp.vec2f),
    look: wp.array(dtype=vec9),
    mesh: wp.array(dtype=wp.vec4f),
    halo: wp.array(dtype=wp.vec4f),
    fill: wp.array(dtype=wp.float32),
):
    i = start + wp.tid()
    at = table[i]
    to_mesh = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_halo = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    left = float(0.0)
    rect = rect_of(rects, at[0])
    first = wp.int32(offsets[at[0]])
    xy = wp.vec2f(wp.float32(at[1]), wp.float32(at[2]))
    wh = frame_wh[at[0]]
    if in_mesh(i, face, coverage):
        a = look[i]
        uv = wp.vec2f(xy[0] + a[0], xy[1] + a[1])
        texel = texel_at(texels, rect, first, uv)
        to_mesh = wp.vec4f(relit(texel[0], a[8]), relit(texel[1], a[8]), relit(texel[2], a[8]), texel[3])
        if not plainly_seen(a, texel, uv[0], uv[1], wh):
            p = mesh_pixel(a, texel, xy, wh)
            to_mesh = wp.vec4f(p[0], p[1], p[2], p[3])
            left = p[4]
    if in_halo(i, nearest, coverage):
        a = look[wp.int32(nearest[i])]
        to_halo = halo_pixel(a, texel_at(texels, rect, first, wp.vec2f(xy[0] + a[0], xy[1] + a[1])), xy, wh)
    mesh[i] = to_mesh
    halo[i] = to_halo
    fill[i] = left


@wp.kernel(enable_backward=False)
def shade_backward_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.int32),
    coverage: wp.array(dtype=wp.float32),
    nearest: wp.array(dtype=wp.int64),
    texels: wp.array(dtype=vec8),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    frame_wh: wp.array(dtype=wp.vec2f),
    look: wp.array(dtype=vec9),
    grad_mesh: wp.array(dtype=wp.vec4f),
    grad_halo: wp.array(dtype=wp.vec4f),
    grad_fill: wp.array(dtype=wp.float32),
    grad_look: wp.array(dtype=vec9),
):
    i = start + wp.tid()
    at = table[i]
    rect = rect_of(rects, at[0])
    first = wp.int32(offsets[at[0]])
    xy = wp.vec2f(wp.float32(at[1]), wp.float32(at[2]))
    wh = frame_wh[at[0]]
    if in_mesh(i, face, coverage):
        a = look[i]
        uv = wp.vec2f(xy[0] + a[0], xy[1] + a[1])
        g = grad_mesh[i]
        texel = texel_around(texels, rect, first, uv)
        c = texel.value
        to_look = vec9()
        to_texel = vec8(0.0, 0.0, 0.0, g[3], 0.0, 0.0, 0.0, 0.0)
        for k in range(3):
            to_texel[k] = g[k] * relit_slope(c[k], a[8])
            to_look[8] += g[k] * c[k] * (1.0 - c[k] * c[k])
        # Where opacity changes along a surface that turned, so does how much of it opens up.
        even = a[4] <= OPEN_TURN_LOW or wp.max(wp.abs(texel.to_u[3]), wp.abs(texel.to_v[3])) <= EVEN
        if not (even and plainly_seen(a, texel.value, uv[0], uv[1], wh)):
            to_look, to_texel, to_xy, to_wh, to_g, to_f = wp.grad(mesh_loss)(
                a, texel.value, xy, wh, g, grad_fill[i]
            )
        to_look[0] += wp.dot(to_texel, texel.to_u)
        to_look[1] += wp.dot(to_texel, texel.to_v)
        wp.atomic_add(grad_look, i, to_look)
    if in_halo(i, nearest, coverage):
        j = wp.int32(nearest[i])
        b = look[j]
        uw = wp.vec2f(xy[0] + b[0], xy[1] + b[1])
        texel2 = texel_around(texels, rect, first, uw)
        if texel2.value[3] != 0.0 or texel2.to_u[3] != 0.0 or texel2.to_v[3] != 0.0:  # else there is nothing near
            to_look2, to_texel2, to_xy2, to_wh2, to_g2 = wp.grad(halo_loss)(b, texel2.value, xy, wh, grad_halo[i])
            to_look2[0] += wp.dot(to_texel2, texel2.to_u)
            to_look2[1] += wp.dot(to_texel2, texel2.to_v)
            wp.atomic_add(grad_look, j, to_look2)


# ------------------------------------------------------------------- completion of what the photograph did not see


@wp.struct
class Meshes:
    """What the mesh at a pixel is found by."""

    table: wp.array(dtype=wp.vec4i)
    rects: wp.array2d(dtype=wp.int64)
    face: wp.array(dtype=wp.int32)
    coverage: wp.array(dtype=wp.float32)
    clip: wp.array(dtype=wp.vec3f)
    faces: wp.array(dtype=wp.vec3i)
    attributes: wp.array(dtype=vec17)


@wp.func
def own_at(m: Meshes, i: int):
    """The mesh's own attributes at a pixel that it hits, else 0."""
    value = vec17()
    if m.face[i] >= 0:
        at = m.table[i]
        hit = find_hit(m.face[i], at[1], at[2], m.clip, m.faces)
        value = m.attributes[hit.i0] * wp.float32(hit.b[0])
        value += m.attributes[hit.i1] * wp.float32(hit.b[1])
        value += m.attributes[hit.i2] * wp.float32(hit.b[2])
    return value


@wp.func
def own_filled(m: Meshes, i: int):
    """`own_at`, continued over the outline."""
    value = own_at(m, i)
    if leans(i, m.face, m.coverage):
        f = fringe_of(i, m.table[i], m.rects, m.face, m.coverage)
        value = value * (f.own * f.hit)
        for n in range(4):
            if f.known[n] > 0.0:
                value += own_at(m, f.pixel[n]) * ((1.0 - f.own) * f.weight[n])
    return value


@wp.func
def exact_dot17(a: vec17, b: vec17):
    """See `exact_dot`."""
    total = wp.float64(a[0]) * wp.float64(b[0])
    for k in range(1, 17):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@wp.func
def own_to_clip(m: Meshes, i: int, g: vec17, share: float, grad_clip: wp.array(dtype=wp.vec3d)):
    """Add what `share` of a gradient to `own_at` means for the corners; returns g . own_at."""
    at = m.table[i]
    hit = find_hit(m.face[i], at[1], at[2], m.clip, m.faces)
    s0 = exact_dot17(g, m.attributes[hit.i0])
    s1 = exact_dot17(g, m.attributes[hit.i1])
    s2 = exact_dot17(g, m.attributes[hit.i2])
    mean = hit.b[0] * s0 + hit.b[1] * s1 + hit.b[2] * s2
    if share != 0.0:
        part = wp.float64(share)
        add_to_corners(hit, at[1], at[2], part * (s0 - mean), part * (s1 - mean), part * (s2 - mean), grad_clip)
    return wp.float32(mean)


@wp.func
def own_backward(
    m: Meshes, i: int, g: vec17, grad_clip: wp.array(dtype=wp.vec3d), grad_coverage: wp.array(dtype=wp.float32)
):
    """Add what a gradient to `own_filled` means for corners and coverages."""
    if leans(i, m.face, m.coverage):
        f = fringe_of(i, m.table[i], m.rects, m.face, m.coverage)
        rest = 1.0 - f.own
        to_own = float(0.0)
        if m.face[i] >= 0:
            to_own = own_to_clip(m, i, g, f.own, grad_clip)
        to_weight = wp.vec4f(0.0, 0.0, 0.0, 0.0)
        for n in range(4):
            if f.known[n] > 0.0:
                along = own_to_clip(m, f.pixel[n], g, rest * f.weight[n], grad_clip)
                to_own -= f.weight[n] * along
                to_weight[n] = rest * along
        fringe_to_coverage(i, f, m.coverage, to_own, to_weight, grad_coverage)
    elif m.face[i] >= 0:
        own_to_clip(m, i, g, 1.0, grad_clip)


@wp.func
def unit(v: wp.vec3f):
    return v / wp.max(wp.length(v), 1e-6)


@wp.func
def clamped(v: wp.vec3f):
    return wp.vec3f(wp.clamp(v[0], 0.0, 1.0), wp.clamp(v[1], 0.0, 1.0), wp.clamp(v[2], 0.0, 1.0))


@wp.func
def shade(
    normal: wp.vec3f,
    to_eye: wp.vec3f,
    albedo: wp.vec3f,
    paint: float,
    glass: float,
    height: float,
    sunlit: wp.vec4f,
):
    """`texture.shade`, one row of it. sunlit: direction and strength of the sun."""
    sun = wp.vec3f(sunlit[0], sunlit[1], sunlit[2])
    dome = 0.5 - 0.5 * normal[1]
    soft = wp.dot(normal, sun)
    direct = 0.5 * (soft + wp.sqrt(soft * soft + 0.01))
    occluded = 0.45 + 0.55 * step(height, -0.05, 0.4)
    diffuse = ((AROUND + ABOVE * dome) + sunlit[3] * direct) * occluded
    cosine = wp.clamp(wp.dot(normal, to_eye), 0.0, 1.0)
    mirror = normal * (2.0 * cosine) - to_eye
    above = HORIZON_RGB + (ZENITH_RGB - HORIZON_RGB) * step(-mirror[1], 0.0, 0.9)
    surround = GROUND_RGB + (above - GROUND_RGB) * step(-mirror[1], -0.08, 0.12)
    rest = 1.0 - cosine
    fresnel = 0.04 + 0.96 * (rest * rest) * (rest * rest) * rest
    strength = (0.55 * paint * fresnel + glass * (0.10 + 0.75 * fresnel)) * (0.5 + 0.5 * occluded)
    g = wp.clamp(wp.dot(mirror, sun), 0.0, 1.0)
    g2 = g * g
    g4 = g2 * g2
    g8 = g4 * g4
    g32 = (g8 * g8) * (g8 * g8)
    glint = (g32 * g8) * (0.35 * paint + 0.5 * glass)
    lit = albedo * diffuse
    return lit + (surround - lit) * strength + (wp.vec3f(1.0, 1.0, 1.0) - lit) * glint


@wp.func
def mirror_place(own: vec17):
    """Where the photograph shows the other side of the car, px."""
    safe = wp.max(own[11], 0.1)
    return wp.vec2f(own[9] / safe, own[10] / safe)


@wp.func
def completed(
    own: vec17,
    facing: float,
    texel: vec8,
    turn: wp.vec2f,
    to_eye: wp.vec3f,
    sun: wp.vec4f,
    wh: wp.vec2f,
):
    """`Compositor._completion`, one row of it. own: colours (3), local normal (3), paint, glass, height, mirror clip
    (3), mirror cosine, gain (3), lift; facing: cosine towards the camera now."""
    normal = unit(wp.vec3f(turn[0] * own[3] + turn[1] * own[5], own[4], turn[0] * own[5] - turn[1] * own[3]))
    light = shade(normal, to_eye, wp.vec3f(own[0], own[1], own[2]), own[6], own[7], own[8], sun)
    left = wp.vec3f(wp.exp(-light[0] * own[13]), wp.exp(-light[1] * own[14]), wp.exp(-light[2] * own[15]))
    colour = wp.vec3f(1.0, 1.0, 1.0) - left * (1.0 - own[16])  # `texture.finished`
    uv = mirror_place(own)
    weight = inside_weight(uv[0], uv[1], wh, BORDER_LOW, BORDER_HIGH)
    weight = weight * (1.0 - step(texel[4], 0.0, 1.0)) * step(texel[3], 0.5, 0.95)
    weight = weight * (1.0 - step(own[11] - texel[6], DEPTH_LOW, DEPTH_HIGH))
    weight = weight * facing_weight(facing - own[12], own[12], own[6]) * step(own[12], 0.05, 0.2)
    weight = weight * (1.0 - step(texel[5], MIRRORED_LOW, MIRRORED_HIGH))
    straight = clamped(wp.vec3f(texel[0], texel[1], texel[2]) / wp.max(texel[3], 0.4))
    return colour + (straight - colour) * weight


@wp.func
def completed_loss(
    own: vec17,
    facing: float,
    texel: vec8,
    turn: wp.vec2f,
    to_eye: wp.vec3f,
    sun: wp.vec4f,
    wh: wp.vec2f,
    g: wp.vec3f,
):
    return wp.dot(completed(own, facing, texel, turn, to_eye, sun, wh), g)


@wp.func
def mirror_loss(own: vec17, g: wp.vec2f):
    return wp.dot(mirror_place(own), g)


@wp.struct
class View:
    """What completion knows of an object: see `Complete`."""

    turn: wp.array(dtype=wp.vec2f)
    sun: wp.array(dtype=wp.vec4f)
    frame_wh: wp.array(dtype=wp.vec2f)
    unproject: wp.array(dtype=wp.mat33f)


@wp.func
def eye_of(view: View, at: wp.vec4i):
    """Unit vector towards the camera at a pixel."""
    ray = view.unproject[at[0]] @ wp.vec3f(wp.float32(at[1]), wp.float32(at[2]), 1.0)
    return unit(ray) * -1.0


@wp.kernel(enable_backward=False)
def complete_kernel(
    start: int,
    need: wp.array(dtype=wp.int64),
    texels: wp.array(dtype=vec8),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    view: View,
    meshes: Meshes,
    look: wp.array(dtype=vec9),
    fill: wp.array(dtype=wp.float32),
    mesh: wp.array(dtype=wp.vec4f),
):
    i = wp.int32(need[start + wp.tid()])
    at = meshes.table[i]
    o = at[0]
    v = own_filled(meshes, i)
    texel = texel_at(texels, rect_of(rects, o), wp.int32(offsets[o]), mirror_place(v))
    a = look[i]
    c = completed(v, a[4] + a[5], texel, view.turn[o], eye_of(view, at), view.sun[o], view.frame_wh[o])
    f = fill[i]
    mesh[i] = mesh[i] + wp.vec4f(c[0] * f, c[1] * f, c[2] * f, f)


@wp.kernel(enable_backward=False)
def complete_backward_kernel(
    start: int,
    need: wp.array(dtype=wp.int64),
    texels: wp.array(dtype=vec8),
    rects: wp.array2d(dtype=wp.int64),
    offsets: wp.array(dtype=wp.int64),
    view: View,
    meshes: Meshes,
    look: wp.array(dtype=vec9),
    fill: wp.array(dtype=wp.float32),
    grad_mesh: wp.array(dtype=wp.vec4f),
    grad_look: wp.array(dtype=vec9),
    grad_fill: wp.array(dtype=wp.float32),
    grad_turn: wp.array(dtype=wp.vec2d),
    grad_clip: wp.array(dtype=wp.vec3d),
    grad_coverage: wp.array(dtype=wp.float32),
):
    i = wp.int32(need[start + wp.tid()])
    at = meshes.table[i]
    o = at[0]
    v = own_filled(meshes, i)
    a = look[i]
    rect = rect_of(rects, o)
    first = wp.int32(offsets[o])
    texel = texel_around(texels, rect, first, mirror_place(v))
    eye = eye_of(view, at)
    c = completed(v, a[4] + a[5], texel.value, view.turn[o], eye, view.sun[o], view.frame_wh[o])
    g = grad_mesh[i]
    f = fill[i]
    to_colour = wp.vec3f(g[0] * f, g[1] * f, g[2] * f)
    grad_fill[i] = grad_fill[i] + g[0] * c[0] + g[1] * c[1] + g[2] * c[2] + g[3]
    to_own, to_facing, to_texel, to_turn, to_eye, to_sun, to_wh, to_g = wp.grad(completed_loss)(
        v, a[4] + a[5], texel.value, view.turn[o], eye, view.sun[o], view.frame_wh[o], to_colour
    )
    move = wp.vec2f(wp.dot(to_texel, texel.to_u), wp.dot(to_texel, texel.to_v))
    more, to_move = wp.grad(mirror_loss)(v, move)
    own_backward(meshes, i, to_own + more, grad_clip, grad_coverage)
    to_look = vec9()
    to_look[4] = to_facing
    to_look[5] = to_facing
    wp.atomic_add(grad_look, i, to_look)
    wp.atomic_add(grad_turn, o, wp.vec2d(wp.float64(to_turn[0]), wp.float64(to_turn[1])))


# --------------------------------------------------------------------------------------------- mesh and halo as one


@wp.kernel(enable_backward=False)
def combine_kernel(
    start: int,
    face: wp.array(dtype=wp.int32),
    nearest: wp.array(dtype=wp.int64),
    coverage: wp.array(dtype=wp.float32),
    mesh: wp.array(dtype=wp.vec4f),
    halo: wp.array(dtype=wp.vec4f),
    look: wp.array(dtype=vec9),
    colour: wp.array(dtype=wp.vec4f),
    opacity: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    i = start + wp.tid()
    c = wp.vec3f(0.0, 0.0, 0.0)
    inverse = float(0.0)
    solid = float(0.0)
    z = float(wp.inf)
    if in_mesh(i, face, coverage):
        share = coverage[i]
        m = mesh[i]
        near = look[i][3]
        a = m[3] * share
        c = wp.vec3f(m[0], m[1], m[2]) * share
        solid = a
        inverse = a / wp.max(near, NEAR)
        z = near
    if in_halo(i, nearest, coverage):
        share = 1.0 - coverage[i]
        h = halo[i]
        near = look[wp.int32(nearest[i])][3]
        a = h[3] * share
        c += wp.vec3f(h[0], h[1], h[2]) * share
        solid += a
        inverse += a / wp.max(near, NEAR)
        z = wp.min(z, near)
    colour[i] = wp.vec4f(c[0], c[1], c[2], inverse)
    opacity[i] = solid
    depth[i] = z


@wp.kernel(enable_backward=False)
def combine_backward_kernel(
    start: int,
    face: wp.array(dtype=wp.int32),
    nearest: wp.array(dtype=wp.int64),
    coverage: wp.array(dtype=wp.float32),
    mesh: wp.array(dtype=wp.vec4f),
    halo: wp.array(dtype=wp.vec4f),
    look: wp.array(dtype=vec9),
    grad_colour: wp.array(dtype=wp.vec4f),
    grad_opacity: wp.array(dtype=wp.float32),
    grad_mesh: wp.array(dtype=wp.vec4f),
    grad_halo: wp.array(dtype=wp.vec4f),
    grad_coverage: wp.array(dtype=wp.float32),
    grad_look: wp.array(dtype=vec9),
):
    i = start + wp.tid()
    g = grad_colour[i]
    to_mesh = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_halo = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    to_share = float(0.0)
    if in_mesh(i, face, coverage):
        m = mesh[i]
        z = look[i][3]
        safe = wp.max(z, NEAR)
        to_a = grad_opacity[i] + g[3] / safe
        to_share = g[0] * m[0] + g[1] * m[1] + g[2] * m[2] + to_a * m[3]
        to_mesh = wp.vec4f(g[0], g[1], g[2], to_a) * coverage[i]
        if g[3] != 0.0 and z > NEAR:
            to_z = vec9()
            to_z[3] = -g[3] * m[3] * coverage[i] / (safe * safe)
            wp.atomic_add(grad_look, i, to_z)
    if in_halo(i, nearest, coverage):
        h = halo[i]
        j = wp.int32(nearest[i])
        z = look[j][3]
        safe = wp.max(z, NEAR)
        to_a = grad_opacity[i] + g[3] / safe
        to_share -= g[0] * h[0] + g[1] * h[1] + g[2] * h[2] + to_a * h[3]
        to_halo = wp.vec4f(g[0], g[1], g[2], to_a) * (1.0 - coverage[i])
        if g[3] != 0.0 and z > NEAR:
            to_z = vec9()
            to_z[3] = -g[3] * h[3] * (1.0 - coverage[i]) / (safe * safe)
            wp.atomic_add(grad_look, j, to_z)
    grad_mesh[i] = to_mesh
    grad_halo[i] = to_halo
    grad_coverage[i] = to_share


# ---------------------------------------------------------------------------------------------------------- shadows


@wp.struct
class Ground:
    """Photographed shadows: what they take away, three numbers a texel, and where the crops lie; from a pixel (x, y, 1)
    to its place (s, t, 1) / w on the patch, 0 to 1 both ways, and to that point's clip coordinates then, over w now.
    """

    inside: wp.array(dtype=wp.mat33d)
    then: wp.array(dtype=wp.mat33d)
    dark: wp.array(dtype=wp.vec3f)
    rects: wp.array2d(dtype=wp.int64)
    offsets: wp.array(dtype=wp.int64)
    frame_wh: wp.array(dtype=wp.vec2f)


@wp.func
def ground_place(ground: Ground, o: int, x: int, y: int):
    """Where the photograph shows the ground point that a pixel shows, px, and 1 where the patch reaches, else 0."""
    p = wp.vec3d(wp.float64(x), wp.float64(y), ONE)
    q = ground.inside[o] @ p
    out = wp.vec3f(FAR_AWAY, FAR_AWAY, 0.0)
    if q[2] > ZERO and q[2] * wp.float64(NEAR) <= ONE:
        if q[0] >= ZERO and q[0] <= q[2] and q[1] >= ZERO and q[1] <= q[2]:
            r = ground.then[o] @ p
            if r[2] > wp.float64(NEAR) * q[2]:
                out = wp.vec3f(wp.float32(r[0] / r[2]), wp.float32(r[1] / r[2]), 1.0)
    return out


@wp.func
def dark_row(dark: wp.array(dtype=wp.vec3f), row: int, t: Taps, w: wp.vec4f):
    low = dark[row + t.columns[0]] * w[0] + dark[row + t.columns[1]] * w[1]
    return low + (dark[row + t.columns[2]] * w[2] + dark[row + t.columns[3]] * w[3])


@wp.func
def in_frame(uv: wp.vec2f, wh: wp.vec2f):
    """Kept within two pixels of the frame, where crops repeat their border."""
    return wp.vec2f(wp.min(wp.max(uv[0], -2.0), wh[0] + 1.0), wp.min(wp.max(uv[1], -2.0), wh[1] + 1.0))


@wp.func
def reached(uv: wp.vec2f, rect: wp.vec4i):
    """Whether a lookup can find anything in a crop."""
    found = uv[0] > wp.float32(rect[0] - 2) and uv[0] < wp.float32(rect[2] + 1)
    return found and uv[1] > wp.float32(rect[1] - 2) and uv[1] < wp.float32(rect[3] + 1)


@wp.kernel(enable_backward=False)
def shadow_kernel(start: int, table: wp.array(dtype=wp.vec4i), ground: Ground, out: wp.array(dtype=wp.vec3f)):
    i = start + wp.tid()
    at = table[i]
    factor = wp.vec3f(1.0, 1.0, 1.0)
    place = ground_place(ground, at[0], at[1], at[2])
    if place[2] > 0.0:
        rect = rect_of(ground.rects, at[0])
        wh = ground.frame_wh[at[0]]
        uv = in_frame(wp.vec2f(place[0], place[1]), wh)
        if reached(uv, rect):
            t = taps_at(uv, rect, wp.int32(ground.offsets[at[0]]), True)
            dark = dark_row(ground.dark, t.rows[0], t, t.wx) * t.wy[0]
            dark += dark_row(ground.dark, t.rows[1], t, t.wx) * t.wy[1]
            dark += dark_row(ground.dark, t.rows[2], t, t.wx) * t.wy[2]
            dark += dark_row(ground.dark, t.rows[3], t, t.wx) * t.wy[3]
            factor = factor - dark * inside_weight(place[0], place[1], wh, SHADOW_LOW, SHADOW_HIGH)
    out[i] = factor


@wp.func
def border_loss(place: wp.vec2f, wh: wp.vec2f):
    return inside_weight(place[0], place[1], wh, SHADOW_LOW, SHADOW_HIGH)


@wp.kernel(enable_backward=False)
def shadow_backward_kernel(
    start: int,
    table: wp.array(dtype=wp.vec4i),
    ground: Ground,
    grad_out: wp.array(dtype=wp.vec3f),
    grad_then: wp.array(dtype=wp.mat33d),
):
    i = start + wp.tid()
    g = grad_out[i]
    if g[0] == 0.0 and g[1] == 0.0 and g[2] == 0.0:
        return  # under a vehicle
    at = table[i]
    o = at[0]
    place = ground_place(ground, o, at[1], at[2])
    if place[2] > 0.0:
        rect = rect_of(ground.rects, o)
        wh = ground.frame_wh[o]
        flat = wp.vec2f(place[0], place[1])
        uv = in_frame(flat, wh)
        if reached(uv, rect):
            t = taps_at(uv, rect, wp.int32(ground.offsets[o]), True)
            dark = float(0.0)
            to_u = float(0.0)
            to_v = float(0.0)
            for k in range(4):
                e0 = wp.dot(g, ground.dark[t.rows[k] + t.columns[0]])
                e1 = wp.dot(g, ground.dark[t.rows[k] + t.columns[1]])
                e2 = wp.dot(g, ground.dark[t.rows[k] + t.columns[2]])
                e3 = wp.dot(g, ground.dark[t.rows[k] + t.columns[3]])
                along = e0 * t.wx[0] + e1 * t.wx[1] + e2 * t.wx[2] + e3 * t.wx[3]
                dark += t.wy[k] * along
                to_v += t.sy[k] * along
                to_u += t.wy[k] * (e0 * t.sx[0] + e1 * t.sx[1] + e2 * t.sx[2] + e3 * t.sx[3])
            if uv[0] != place[0]:
                to_u = float(0.0)
            if uv[1] != place[1]:
                to_v = float(0.0)
            if uv[0] != place[0] or uv[1] != place[1]:
                border = border_loss(flat, wh)
                to_border, to_wh = wp.grad(border_loss)(flat, wh)
                to_u = to_u * border + dark * to_border[0]
                to_v = to_v * border + dark * to_border[1]
            if to_u != 0.0 or to_v != 0.0:
                p = wp.vec3d(wp.float64(at[1]), wp.float64(at[2]), ONE)
                scale = -ONE / wp.dot(ground.then[o][2], p)
                a = wp.float64(to_u) * scale
                b = wp.float64(to_v) * scale
                c = -(a * wp.float64(place[0]) + b * wp.float64(place[1]))
                wp.atomic_add(grad_then, o, wp.outer(wp.vec3d(a, b, c), p))


def _shadow_inputs(s: Setting, table: Tensor, then: Tensor) -> list:
    ground = Ground()
    dark, rects, offsets = s.dark
    ground.inside, ground.then = field(s.inside, wp.mat33d), field(then, wp.mat33d)
    ground.dark, ground.rects, ground.offsets = field(dark, wp.vec3f), field(rects), field(offsets)
    ground.frame_wh = field(s.frame_wh, wp.vec2f)
    return [array(table, wp.vec4i), ground]


# ----------------------------------------------------------------------------------------------- all stages as one


@dataclass(frozen=True, slots=True)
class Setting:
    """What `Photographed` reads and does not change. See `fused.Fixed` and `compositor.Drawn` for what is not said here.

    ground: the shadows' patches, one an object; inside (N, 3, 3) float64: see `Ground`. painter:
    None, or what repaints premultiplied RGBA of mesh and halo (T, 4) each, given them, what the pixels look at (T, 9),
    how much of them was filled (T,) and the codes, differentiable. reach_px: how far each halo reaches.
    """

    fragments: Fragments
    ground: Layout
    inside: Tensor
    reach_px: Sequence[float]
    faces: Tensor
    base_clip: Tensor
    base: Tensor
    own: Tensor
    texels: tuple[Tensor, Tensor, Tensor]
    dark: tuple[Tensor, Tensor, Tensor]
    frame_wh: Tensor
    sun: Tensor
    unproject: Tensor
    painter: Painter | None


Painter = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""From mesh, halo, look, fill, codes, table and nearest to mesh and halo."""


class _Parts:
    """Objects [start, end) as ranges of packed pixels: what one thread draws from the first stage to the last."""

    def __init__(self, s: Setting, code: Tensor | None) -> None:
        self.pixels = s.fragments.layout.offsets.tolist()
        self.ground = s.ground.offsets.tolist()
        count = len(self.pixels) - 1
        work = [
            2.0 * (self.pixels[i + 1] - self.pixels[i]) + self.ground[i + 1] - self.ground[i] for i in range(count)
        ]
        # A GPU works on all at once; a painter is torch's.
        whole = s.faces.device.type != "cpu" or code is not None
        self.edges = [0, count] if whole else between(list(range(count + 1)), work)


class Photographed(torch.autograd.Function):
    """All pixels of photographed objects, and of their shadows.

    clip (V, 3), facing (V,), brighter (V,), coverage (T,), yaw (N,), then (N, 3, 3) float64 (see `Ground`), code (N, 5) or (0,):
    differentiable, the code through the painter. -> premultiplied RGB and opacity / depth (T, 4),
    opacity (T,), depth (T,) m (inf where nothing is), and the factors by which the ground is darkened (Ts, 3).
    """

    @staticmethod
    def forward(ctx: Any, clip, facing, brighter, coverage, yaw, then, code, s: Setting):
        size, device = coverage.shape[0], clip.device
        clip, facing, brighter = clip.detach(), facing.detach(), brighter.detach().contiguous()
        then = then.detach().contiguous()
        coverage, face = coverage.detach().contiguous(), s.fragments.face
        parts = _Parts(s, code if s.painter is not None else None)
        table, ground_table = _table_like(s.fragments.layout, device), _table_like(s.ground, device)
        nearest = torch.empty(size, dtype=torch.int64, device=device)
        turn = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1).detach()
        found, look = clip.new_empty(size, 9), clip.new_empty(size, 9)
        mesh, halo, fill = clip.new_empty(size, 4), clip.new_empty(size, 4), clip.new_empty(size)
        colour, opacity, depth = clip.new_empty(size, 4), clip.new_empty(size), clip.new_empty(size)
        shadow = clip.new_empty(s.ground.size, 3)
        seen = _look_inputs((table, face, clip, facing, brighter, s.base_clip, s.base, s.faces))
        filled = [*_outline(s, table, coverage), array(found, vec9), array(look, vec9)]
        shades = _shade_inputs(s, table, nearest, coverage, look)
        shaded = [*shades, array(mesh, wp.vec4f), array(halo, wp.vec4f), array(fill)]
        combined = [*_combine_inputs(s, nearest, coverage, mesh, halo, look), array(colour, wp.vec4f)]
        combined += [array(opacity), array(depth)]
        shadowed = [*_shadow_inputs(s, ground_table, then), vec3(shadow)]
        tables = [(s.fragments.layout, table), (s.ground, ground_table)]
        needs: dict[int, Tensor] = {}

        def work(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            for layout, out in tables:
                inputs = [array(layout.rects), array(layout.offsets), array(out, wp.vec4i)]
                launch(table_kernel, [start, end], inputs, (), device)
            ranges = [parts.ground[start], parts.ground[end]]
            launch(shadow_kernel, ranges, shadowed, (), device)
            if last == first:
                return
            surfaces.nearest_hits(s.fragments, s.reach_px, range(start, end), nearest)
            launch(look_kernel, [first, last], [*seen, array(found, vec9)], (), device)
            launch(fill_kernel, [first, last], filled, (), device)
            launch(shade_kernel, [first, last], shaded, (), device)
            needs[start] = need = fill[first:last].nonzero()[:, 0] + first
            if need.numel():
                inputs = _complete_inputs(s, need, table, turn, clip, coverage, look, fill)
                launch(complete_kernel, [0, need.shape[0]], [*inputs, array(mesh, wp.vec4f)], (), device)
            if s.painter is None:
                launch(combine_kernel, [first, last], combined, (), device)

        load(look_kernel)
        share(work, parts.edges)
        ctx.painted = None
        if s.painter is not None:
            with torch.enable_grad():
                leaves = tuple(t.detach().requires_grad_() for t in (mesh, halo, look, fill, code))
                ctx.painted = leaves, s.painter(*leaves, table, nearest)
            mesh, halo = (t.detach().contiguous() for t in ctx.painted[1])
            combined = [*_combine_inputs(s, nearest, coverage, mesh, halo, look), array(colour, wp.vec4f)]
            launch(combine_kernel, halves(size), [*combined, array(opacity), array(depth)], (), device)
        ctx.setting, ctx.parts, ctx.needs = s, parts, needs
        ctx.save_for_backward(
            clip,
            facing,
            brighter,
            coverage,
            turn,
            found,
            look,
            mesh,
            halo,
            fill,
            table,
            ground_table,
            nearest,
            then,
        )
        ctx.mark_non_differentiable(depth)
        return colour, opacity, depth, shadow

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colour: Tensor, grad_opacity: Tensor, _: Tensor, grad_shadow: Tensor):
        clip, facing, brighter, coverage, turn, found, look, mesh, halo, fill, *others = ctx.saved_tensors
        table, ground_table, nearest, then = others
        s: Setting = ctx.setting
        parts: _Parts = ctx.parts
        device = clip.device
        grad_colour, grad_opacity = grad_colour.contiguous(), grad_opacity.contiguous()
        grad_shadow = grad_shadow.contiguous()
        grad_mesh, grad_halo = torch.empty_like(mesh), torch.empty_like(halo)
        grad_coverage, grad_look = torch.empty_like(coverage), torch.empty_like(look)
        kept, grad_fill, grad_facing = torch.empty_like(look), torch.empty_like(fill), torch.zeros_like(facing)
        grad_brighter = torch.zeros_like(brighter)
        grad_clip = torch.zeros(clip.shape, dtype=torch.float64, device=device)
        grad_then = torch.zeros_like(then)
        grad_turn = torch.zeros_like(turn, dtype=torch.float64)
        to_clip, to_look = array(grad_clip, wp.vec3d), array(grad_look, vec9)
        through = [
            *(*_combine_inputs(s, nearest, coverage, mesh, halo, look), array(grad_colour, wp.vec4f)),
            *(array(grad_opacity), array(grad_mesh, wp.vec4f), array(grad_halo, wp.vec4f)),
            *(array(grad_coverage), to_look),
        ]
        shades = _shade_inputs(s, table, nearest, coverage, look)
        spread = [
            *_outline(s, table, coverage),
            array(found, vec9),
            array(kept, vec9),
            to_look,
            array(grad_coverage),
        ]
        looked = _look_inputs((table, s.fragments.face, clip, facing, brighter, s.base_clip, s.base, s.faces))
        looked += [array(found, vec9), to_look, to_clip, array(grad_facing), array(grad_brighter)]
        shadowed = [*_shadow_inputs(s, ground_table, then), vec3(grad_shadow)]
        shadowed.append(array(grad_then, wp.mat33d))

        def combine(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            grad_look[first:last].zero_()
            launch(combine_backward_kernel, [first, last], through, (), device)

        def work(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            launch(shadow_backward_kernel, [parts.ground[start], parts.ground[end]], shadowed, (), device)
            if last == first:
                return
            if ctx.painted is None:
                combine(start, end)
            if ctx.painted is None:
                grad_fill[first:last].zero_()
            need = ctx.needs[start]
            if need.numel():
                inputs = [
                    *_complete_inputs(s, need, table, turn, clip, coverage, look, fill),
                    *(array(grad_mesh, wp.vec4f), to_look, array(grad_fill), array(grad_turn, wp.vec2d)),
                    *(to_clip, array(grad_coverage)),
                ]
                launch(complete_backward_kernel, [0, need.shape[0]], inputs, (), device)
            inputs = [
                *shades,
                array(grad_mesh, wp.vec4f),
                array(grad_halo, wp.vec4f),
                array(grad_fill),
                to_look,
            ]
            launch(shade_backward_kernel, [first, last], inputs, (), device)
            inputs = [array(s.fragments.face), array(coverage), to_look, array(kept, vec9)]
            launch(keep_kernel, [first, last], inputs, (), device)
            launch(fill_backward_kernel, [first, last], spread, (), device)
            launch(look_backward_kernel, [first, last], looked, (), device)

        grad_code = None
        if ctx.painted is not None:
            combine(0, len(parts.pixels) - 1)
            leaves, painted = ctx.painted
            grad_mesh, grad_halo, more, to_fill, grad_code = torch.autograd.grad(
                painted, leaves, (grad_mesh, grad_halo), allow_unused=True
            )
            grad_fill.copy_(torch.zeros_like(fill) if to_fill is None else to_fill)
            grad_mesh, grad_halo = grad_mesh.contiguous(), grad_halo.contiguous()
            grad_look += more
        share(work, parts.edges)
        grad_yaw = (grad_turn[:, 1] * turn[:, 0] - grad_turn[:, 0] * turn[:, 1]).to(turn.dtype)
        to_place = grad_clip.to(clip.dtype), grad_facing, grad_brighter
        return *to_place, grad_coverage, grad_yaw, grad_then, grad_code, None


def _table_like(layout: Layout, device: torch.device) -> Tensor:
    return torch.empty(layout.size, 4, dtype=torch.int32, device=device)


def _outline(s: Setting, table: Tensor, coverage: Tensor) -> list:
    rects, face = s.fragments.layout.rects, s.fragments.face
    return [array(table, wp.vec4i), array(rects), array(face), array(coverage)]


def _shade_inputs(s: Setting, table: Tensor, nearest: Tensor, coverage: Tensor, look: Tensor) -> list:
    texels, rects, offsets = s.texels
    return [
        *(array(table, wp.vec4i), array(s.fragments.face), array(coverage), array(nearest)),
        *(array(texels, vec8), array(rects), array(offsets), array(s.frame_wh, wp.vec2f), array(look, vec9)),
    ]


def _complete_inputs(
    s: Setting,
    need: Tensor,
    table: Tensor,
    turn: Tensor,
    clip: Tensor,
    coverage: Tensor,
    look: Tensor,
    fill: Tensor,
) -> list:
    view, meshes = View(), Meshes()
    view.turn, view.sun = field(turn, wp.vec2f), field(s.sun, wp.vec4f)
    view.frame_wh, view.unproject = field(s.frame_wh, wp.vec2f), field(s.unproject, wp.mat33f)
    meshes.table, meshes.rects = field(table, wp.vec4i), field(s.fragments.layout.rects)
    meshes.face, meshes.coverage = field(s.fragments.face), field(coverage)
    meshes.clip, meshes.faces = field(clip, wp.vec3f), field(s.faces, wp.vec3i)
    meshes.attributes = field(s.own, vec17)
    texels, rects, offsets = s.texels
    return [
        *(array(need), array(texels, vec8), array(rects), array(offsets), view, meshes),
        *(array(look, vec9), array(fill)),
    ]


def _combine_inputs(
    s: Setting, nearest: Tensor, coverage: Tensor, mesh: Tensor, halo: Tensor, look: Tensor
) -> list:
    return [
        *(array(s.fragments.face), array(nearest), array(coverage), array(mesh, wp.vec4f)),
        *(array(halo, wp.vec4f), array(look, vec9)),
    ]


@wp.kernel(enable_backward=True)
def adjoints_kernel(out: wp.array(dtype=wp.float32)):
    """Never run. Warp writes adjoints of what a differentiable kernel calls; those that `wp.grad` alone asks for may
    miss some of the functions below them (Warp 1.19), and then their gradients are silently 0."""
    a = vec8()
    xy = wp.vec2f(0.0, 0.0)
    c = wp.vec3f(0.0, 0.0, 0.0)
    g = wp.vec4f(0.0, 0.0, 0.0, 0.0)
    b = vec9()
    out[0] = mesh_loss(b, a, xy, xy, g, 0.0) + halo_loss(b, a, xy, xy, g) + border_loss(xy, xy)
    out[1] = completed_loss(vec17(), 0.0, a, xy, c, g, xy, c) + mirror_loss(vec17(), xy)
