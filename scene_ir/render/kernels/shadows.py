# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: UP018, SIM102, RUF059 - the line above; Warp needs int(0) to declare a variable that a loop changes;
# `wp.grad` returns gradients to all arguments.
"""Photographed shadows on the ground, as Warp kernels: what `reference` does in plain torch; float32.

A patch of ground is a plane: a 3 x 3 matrix maps a pixel to the photograph, without triangles.
"""

from __future__ import annotations

import warp as wp

from scene_ir.raster.launch import Floats, Longs, Longs2D, Mat33ds, Vec2fs, Vec3fs, Vec4fs, Vec4is, start_warp
from scene_ir.raster.verbs import NEAR_M
from scene_ir.render import model
from scene_ir.render.kernels.shading import crop_taps, inside_weight, read_rect, sample_darkness

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False})

NEAR = wp.constant(wp.float32(NEAR_M))
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
EXTENDED = wp.constant(wp.vec2f(*model.SHADOW_EXTENDED_PX))


@wp.struct
class ShadowArrays:
    """Photographed shadows.

    Attributes:
        inside: (N,) from a pixel (x, y, 1) to its place (s, t, 1) / w on the patch, s and t in [0, 1].
        then: (N,) from the pixel to the photographed clip coordinates of that point, divided by w now.
        dark: (S,) light that the shadows remove, three numbers per texel and a 0.
        rects: (N, 4) crops of the texels.
        offsets: (N + 1,) first texel of each crop.
        frame_wh: (N,) px.
    """

    inside: Mat33ds
    then: Mat33ds
    dark: Vec4fs
    rects: Longs2D
    offsets: Longs
    frame_wh: Vec2fs


@wp.func
def _photographed_ground(ground: ShadowArrays, o: int, x: int, y: int):
    """Photograph position, px, of the ground point at a pixel, and 1 where the patch reaches, else 0."""
    p = wp.vec3d(wp.float64(x), wp.float64(y), ONE)
    q = ground.inside[o] @ p
    out = wp.vec3f(model.FAR_AWAY_PX, model.FAR_AWAY_PX, 0.0)
    if q[2] > ZERO and q[2] * wp.float64(NEAR) <= ONE:
        if q[0] >= ZERO and q[0] <= q[2] and q[1] >= ZERO and q[1] <= q[2]:
            r = ground.then[o] @ p
            if r[2] > wp.float64(NEAR) * q[2]:
                out = wp.vec3f(wp.float32(r[0] / r[2]), wp.float32(r[1] / r[2]), 1.0)
    return out


@wp.func
def _clamp_to_frame(uv: wp.vec2f, wh: wp.vec2f):
    """Clamped to two pixels around the frame, where crops repeat their border."""
    return wp.vec2f(wp.min(wp.max(uv[0], -2.0), wh[0] + 1.0), wp.min(wp.max(uv[1], -2.0), wh[1] + 1.0))


@wp.func
def _reaches_crop(uv: wp.vec2f, rect: wp.vec4i):
    """Whether a lookup can hit a crop."""
    found = uv[0] > wp.float32(rect[0] - 2) and uv[0] < wp.float32(rect[2] + 1)
    return found and uv[1] > wp.float32(rect[1] - 2) and uv[1] < wp.float32(rect[3] + 1)


@wp.kernel(enable_backward=False)
def shadow_kernel(start: int, table: Vec4is, ground: ShadowArrays, out: Vec3fs):
    """Shadow factors of packed patch pixels.

    Args:
        start: First index.
        table: Draw, x, y and row width of each pixel.
        ground: The shadows.
        out: Factors.
    """
    i = start + wp.tid()
    at = table[i]
    factor = wp.vec3f(1.0, 1.0, 1.0)
    place = _photographed_ground(ground, at[0], at[1], at[2])
    if place[2] > 0.0:
        rect = read_rect(ground.rects, at[0])
        wh = ground.frame_wh[at[0]]
        uv = _clamp_to_frame(wp.vec2f(place[0], place[1]), wh)
        if _reaches_crop(uv, rect):
            t = crop_taps(uv, rect, ground.offsets[at[0]], False)
            dark = sample_darkness(ground.dark, t.rows, t.columns, t.wx, t.wy, t.sx, t.sy)[0]
            factor = factor - wp.vec3f(dark[0], dark[1], dark[2]) * inside_weight(place[0], place[1], wh, EXTENDED)
    out[i] = factor


@wp.func
def _border_loss(place: wp.vec2f, wh: wp.vec2f):
    return inside_weight(place[0], place[1], wh, EXTENDED)


@wp.kernel(enable_backward=False)
def shadow_backward_kernel(start: int, table: Vec4is, ground: ShadowArrays, grad_out: Vec3fs, grad_then: Mat33ds):
    """Gradient of `shadow_kernel` to `then`.

    Args:
        start, table, ground: As for `shadow_kernel`.
        grad_out: Gradient to the factors.
        grad_then: Gradient to `ShadowArrays.then`.
    """
    i = start + wp.tid()
    g = grad_out[i]
    if g[0] == 0.0 and g[1] == 0.0 and g[2] == 0.0:
        return  # under a vehicle
    at = table[i]
    o = at[0]
    place = _photographed_ground(ground, o, at[1], at[2])
    if place[2] > 0.0:
        rect = read_rect(ground.rects, o)
        wh = ground.frame_wh[o]
        flat = wp.vec2f(place[0], place[1])
        uv = _clamp_to_frame(flat, wh)
        if _reaches_crop(uv, rect):
            t = crop_taps(uv, rect, ground.offsets[o], False)
            sums = sample_darkness(ground.dark, t.rows, t.columns, t.wx, t.wy, t.sx, t.sy)
            along = wp.vec4f(g[0], g[1], g[2], 0.0)
            dark = wp.dot(along, sums[0])
            to_u = wp.dot(along, sums[1])
            to_v = wp.dot(along, sums[2])
            if uv[0] != place[0]:
                to_u = float(0.0)
            if uv[1] != place[1]:
                to_v = float(0.0)
            if uv[0] != place[0] or uv[1] != place[1]:
                border = _border_loss(flat, wh)
                to_border, to_wh = wp.grad(_border_loss)(flat, wh)
                to_u = to_u * border + dark * to_border[0]
                to_v = to_v * border + dark * to_border[1]
            if to_u != 0.0 or to_v != 0.0:
                p = wp.vec3d(wp.float64(at[1]), wp.float64(at[2]), ONE)
                scale = -ONE / wp.dot(ground.then[o][2], p)
                a = wp.float64(to_u) * scale
                b = wp.float64(to_v) * scale
                c = -(a * wp.float64(place[0]) + b * wp.float64(place[1]))
                wp.atomic_add(grad_then, o, wp.outer(wp.vec3d(a, b, c), p))


@wp.kernel(enable_backward=True)
def _adjoints_kernel(out: Floats):
    """Never run: see `shading._adjoints_kernel`."""
    out[0] = _border_loss(wp.vec2f(0.0, 0.0), wp.vec2f(0.0, 0.0))
