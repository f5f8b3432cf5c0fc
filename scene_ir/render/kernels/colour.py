# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
"""CIE L*a*b* and back, and the paint of vehicles, as NVIDIA Warp functions with gradients by hand; float32.

What they compute is in `texture` (`lab`, `rgb_of`, `apply_texture_code`); a test holds both together.
A function's gradient is the function that ends in `_adjoint`: arguments, then the gradient to the result.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.lanes import SIMD_OPTIONS, exp_, load, load3, log_, store, store3
from scene_ir.raster.launch import launch, split_range, start_warp
from scene_ir.render import model

start_warp()
wp.set_module_options(SIMD_OPTIONS)

SHARPNESS, BEYOND = model.GAMUT_SHARPNESS, math.exp(-model.GAMUT_SHARPNESS)
GLOSS_PER_L = model.GLOSS_GAIN / model.GLOSSY_L
LEVEL_LOW, LEVEL_HIGH = model.LEVEL
DUST = wp.constant(wp.vec3f(*model.DUST_RGB))

# sRGB to and from XYZ relative to white, D65: kornia's matrices, their rows divided, columns multiplied, by it.
TO_X = wp.constant(wp.vec3f(0.412453 / 0.95047, 0.357580 / 0.95047, 0.180423 / 0.95047))
TO_Y = wp.constant(wp.vec3f(0.212671, 0.715160, 0.072169))
TO_Z = wp.constant(wp.vec3f(0.019334 / 1.08883, 0.119193 / 1.08883, 0.950227 / 1.08883))
TO_R = wp.constant(wp.vec3f(3.2404813432005266 * 0.95047, -1.5371515162713185, -0.4985363261688878 * 1.08883))
TO_G = wp.constant(wp.vec3f(-0.9692549499965682 * 0.95047, 1.8759900014898907, 0.0415559265582928 * 1.08883))
TO_B = wp.constant(wp.vec3f(0.0556466391351772 * 0.95047, -0.2040413383665112, 1.0573110696453443 * 1.08883))


@wp.func
def linear(x: wp.float32):
    """sRGB to linear light."""
    power = exp_(2.4 * log_(wp.max((x + 0.055) * (1.0 / 1.055), 1e-3)))
    return wp.where(x > 0.04045, power, x * (1.0 / 12.92))


@wp.func
def linear_slope(x: wp.float32, value: wp.float32):
    return wp.where(x > 0.04045, 2.4 * value / wp.max(x + 0.055, 1e-3), 1.0 / 12.92)


@wp.func
def root(x: wp.float32):
    """The cube root of CIE L*a*b*, straight near 0."""
    return wp.where(x > 0.008856, exp_(log_(wp.max(x, 0.008856)) * (1.0 / 3.0)), 7.787 * x + 4.0 / 29.0)


@wp.func
def root_slope(x: wp.float32, value: wp.float32):
    return wp.where(x > 0.008856, value / (3.0 * wp.max(x, 0.008856)), 7.787)


@wp.func
def cube(f: wp.float32):
    return wp.where(f > 0.2068966, f * f * f, (f - 4.0 / 29.0) * (1.0 / 7.787))


@wp.func
def cube_slope(f: wp.float32):
    return wp.where(f > 0.2068966, 3.0 * f * f, 1.0 / 7.787)


@wp.func
def gamma(x: wp.float32):
    """Linear light to sRGB."""
    power = 1.055 * exp_(log_(wp.max(x, 0.0031308)) * (1.0 / 2.4)) - 0.055
    return wp.where(x > 0.0031308, power, 12.92 * x)


@wp.func
def gamma_slope(x: wp.float32, value: wp.float32):
    return wp.where(x > 0.0031308, (value + 0.055) / (2.4 * wp.max(x, 0.0031308)), 12.92)


@wp.func
def into_gamut(x: wp.float32):
    """softplus(x) - softplus(x - 1), softplus(x) = log(1 + exp(SHARPNESS x)) / SHARPNESS."""
    power = exp_(SHARPNESS * x)
    return log_((1.0 + power) / (1.0 + BEYOND * power)) * (1.0 / SHARPNESS)


@wp.func
def into_gamut_slope(x: wp.float32):
    power = exp_(SHARPNESS * x)
    return (power / (1.0 + power)) * ((1.0 - BEYOND) / (1.0 + BEYOND * power))


@wp.func
def light_of(rgb: wp.vec3f):
    return wp.vec3f(linear(rgb[0]), linear(rgb[1]), linear(rgb[2]))


@wp.func
def lab_of(rgb: wp.vec3f):
    light = light_of(rgb)
    x = root(wp.dot(TO_X, light))
    y = root(wp.dot(TO_Y, light))
    z = root(wp.dot(TO_Z, light))
    return wp.vec3f(116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z))


@wp.func
def lab_adjoint(rgb: wp.vec3f, g: wp.vec3f):
    light = light_of(rgb)
    x = wp.dot(TO_X, light)
    y = wp.dot(TO_Y, light)
    z = wp.dot(TO_Z, light)
    g_x = root_slope(x, root(x)) * (500.0 * g[1])
    g_y = root_slope(y, root(y)) * (116.0 * g[0] - 500.0 * g[1] + 200.0 * g[2])
    g_z = root_slope(z, root(z)) * (-200.0 * g[2])
    g_light = g_x * TO_X + g_y * TO_Y + g_z * TO_Z
    return wp.vec3f(
        linear_slope(rgb[0], light[0]) * g_light[0],
        linear_slope(rgb[1], light[1]) * g_light[1],
        linear_slope(rgb[2], light[2]) * g_light[2],
    )


@wp.func
def roots_of(lab: wp.vec3f):
    y = (lab[0] + 16.0) * (1.0 / 116.0)
    return wp.vec3f(lab[1] * (1.0 / 500.0) + y, y, y - lab[2] * (1.0 / 200.0))


@wp.func
def rgb_of(lab: wp.vec3f):
    """sRGB in (0, 1): what is out of gamut bends back softly."""
    f = roots_of(lab)
    xyz = wp.vec3f(cube(f[0]), cube(f[1]), cube(wp.max(f[2], 0.0)))
    return wp.vec3f(
        into_gamut(gamma(wp.dot(TO_R, xyz))),
        into_gamut(gamma(wp.dot(TO_G, xyz))),
        into_gamut(gamma(wp.dot(TO_B, xyz))),
    )


@wp.func
def channel_slope(x: wp.float32):
    value = gamma(x)
    return into_gamut_slope(value) * gamma_slope(x, value)


@wp.func
def rgb_adjoint(lab: wp.vec3f, g: wp.vec3f):
    f = roots_of(lab)
    xyz = wp.vec3f(cube(f[0]), cube(f[1]), cube(wp.max(f[2], 0.0)))
    g_xyz = (channel_slope(wp.dot(TO_R, xyz)) * g[0]) * TO_R
    g_xyz += (channel_slope(wp.dot(TO_G, xyz)) * g[1]) * TO_G
    g_xyz += (channel_slope(wp.dot(TO_B, xyz)) * g[2]) * TO_B
    g_x = cube_slope(f[0]) * g_xyz[0]
    g_y = cube_slope(f[1]) * g_xyz[1]
    g_z = wp.where(f[2] >= 0.0, cube_slope(f[2]) * g_xyz[2], 0.0)
    return wp.vec3f((g_x + g_y + g_z) * (1.0 / 116.0), g_x * (1.0 / 500.0), g_z * (-1.0 / 200.0))


@wp.func
def within(x: wp.float32, low: wp.float32, high: wp.float32):
    """The slope of clamping: 1 from low to high."""
    return wp.where(x >= low, 1.0, 0.0) * wp.where(x <= high, 1.0, 0.0)


@wp.func
def clamped(x: wp.vec3f):
    return wp.vec3f(wp.min(wp.max(x[0], 0.0), 1.0), wp.min(wp.max(x[1], 0.0), 1.0), wp.min(wp.max(x[2], 0.0), 1.0))


@wp.func
def clamped_adjoint(x: wp.vec3f, g: wp.vec3f):
    return wp.vec3f(within(x[0], 0.0, 1.0) * g[0], within(x[1], 0.0, 1.0) * g[1], within(x[2], 0.0, 1.0) * g[2])


@wp.func
def level_of(lightness: wp.float32):
    return wp.min(wp.max(lightness * 0.01, LEVEL_LOW), LEVEL_HIGH)


@wp.func
def lifted(level: wp.float32, odds: wp.float32):
    """sigmoid(logit(level) + log(odds))."""
    return level * odds / (level * odds + (1.0 - level))


@wp.struct
class Coat:
    """What changes a paint: shifts of lightness, a*, b*; gloss; dirt; and how much of it sticks at this height."""

    shift: wp.float32
    red: wp.float32
    yellow: wp.float32
    gloss: wp.float32
    dirt: wp.float32
    grip: wp.float32


@wp.func
def painted(lab: wp.vec3f, coat: Coat, base: wp.float32):
    """The paint model before dust: L*a*b*. base: L* about which gloss turns contrast."""
    odds = exp_(model.LIGHTNESS_GAIN * coat.shift + coat.gloss * GLOSS_PER_L * (lab[0] - base))
    level = lifted(level_of(lab[0]), odds)
    room = 4.0 * model.CHROMA_GAIN * level * (1.0 - level)
    return wp.vec3f(100.0 * level, lab[1] + coat.red * room, lab[2] + coat.yellow * room)


@wp.func
def dusted(rgb: wp.vec3f, coat: Coat):
    return rgb + (model.DIRT_GAIN * coat.dirt * coat.grip) * (DUST - rgb)


@wp.func
def painted_adjoint(lab: wp.vec3f, coat: Coat, base: wp.float32, g: wp.vec3f):
    """-> the colour, dusted; gradients to lab, (shift, red, yellow), (gloss, dirt, grip), base."""
    odds = exp_(model.LIGHTNESS_GAIN * coat.shift + coat.gloss * GLOSS_PER_L * (lab[0] - base))
    before = level_of(lab[0])
    level = lifted(before, odds)
    room = 4.0 * model.CHROMA_GAIN * level * (1.0 - level)
    changed = wp.vec3f(100.0 * level, lab[1] + coat.red * room, lab[2] + coat.yellow * room)
    out = rgb_of(changed)
    veil = model.DIRT_GAIN * coat.dirt * coat.grip
    g_veil = model.DIRT_GAIN * wp.dot(g, DUST - out)
    g_lab = rgb_adjoint(changed, (1.0 - veil) * g)
    g_room = coat.red * g_lab[1] + coat.yellow * g_lab[2]
    g_level = 100.0 * g_lab[0] + 4.0 * model.CHROMA_GAIN * (1.0 - 2.0 * level) * g_room
    g_odds = g_level * level * (1.0 - level)
    bottom = before * odds + (1.0 - before)
    g_before = g_level * odds / (bottom * bottom)
    g_tint = wp.vec3f(model.LIGHTNESS_GAIN * g_odds, room * g_lab[1], room * g_lab[2])
    g_finish = wp.vec3f(GLOSS_PER_L * (lab[0] - base) * g_odds, coat.grip * g_veil, coat.dirt * g_veil)
    g_base = -GLOSS_PER_L * coat.gloss * g_odds
    g_light = 0.01 * within(lab[0] * 0.01, LEVEL_LOW, LEVEL_HIGH) * g_before - g_base
    return out + veil * (DUST - out), wp.vec3f(g_light, g_lab[1], g_lab[2]), g_tint, g_finish, g_base


@wp.func
def grip_at(height: wp.float32):
    return 1.0 - model.CLEAN_ROOF * wp.min(wp.max(height, 0.0), 1.0)


@wp.func
def coat_at(code: wp.array(dtype=wp.float32), i: int, height: wp.float32):
    coat = Coat()
    coat.shift = load(code, 5 * i)
    coat.red = load(code, 5 * i + 1)
    coat.yellow = load(code, 5 * i + 2)
    coat.gloss = load(code, 5 * i + 3)
    coat.dirt = load(code, 5 * i + 4)
    coat.grip = grip_at(height)
    return coat


@wp.func
def bare():
    return Coat()


@wp.func
def size_of(coat: Coat):
    return wp.abs(coat.shift) + wp.abs(coat.red) + wp.abs(coat.yellow) + wp.abs(coat.gloss) + wp.abs(coat.dirt)


@wp.func
def paint_change(rgb: wp.vec3f, coat: Coat, base: wp.float32):
    """What a coat adds to an opaque colour in [0, 1]; exactly 0 where it is bare, whatever the rounding."""
    lab = lab_of(rgb)
    change = dusted(rgb_of(painted(lab, coat, base)), coat) - rgb_of(painted(lab, bare(), base))
    return wp.where(size_of(coat) > 0.0, 1.0, 0.0) * change


@wp.func
def paint_change_adjoint(rgb: wp.vec3f, coat: Coat, base: wp.float32, g: wp.vec3f):
    """-> the change itself; gradients to rgb, (shift, red, yellow), (gloss, dirt, grip), base."""
    lab = lab_of(rgb)
    now, g_lab, g_tint, g_finish, g_base = painted_adjoint(lab, coat, base, g)
    then, g_bare, _tint, _finish, _base = painted_adjoint(lab, bare(), base, g)
    return now - then, lab_adjoint(rgb, g_lab - g_bare), g_tint, g_finish, g_base


@wp.func
def painted_share(opacity: wp.float32, paint: wp.float32):
    return wp.where(wp.min(opacity, paint) > 0.0, opacity * paint, 0.0)


@wp.kernel
def paint_kernel(
    start: int,
    colour: wp.array(dtype=wp.float32),
    opacity: wp.array(dtype=wp.float32),
    code: wp.array(dtype=wp.float32),
    paint: wp.array(dtype=wp.float32),
    height: wp.array(dtype=wp.float32),
    base: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.float32),
):
    i = start + wp.tid()
    alpha = load(opacity, i)
    own = load3(colour, 3 * i, 1)
    straight = clamped((1.0 / wp.max(alpha, model.LEAST_ALPHA)) * own)
    change = paint_change(straight, coat_at(code, i, load(height, i)), load(base, i))
    store3(out, 3 * i, 1, own + painted_share(alpha, load(paint, i)) * change)


@wp.kernel
def paint_adjoint_kernel(
    start: int,
    colour: wp.array(dtype=wp.float32),
    opacity: wp.array(dtype=wp.float32),
    code: wp.array(dtype=wp.float32),
    paint: wp.array(dtype=wp.float32),
    height: wp.array(dtype=wp.float32),
    base: wp.array(dtype=wp.float32),
    grad: wp.array(dtype=wp.float32),
    rows: int,
    grads: wp.array(dtype=wp.float32),
):
    """grads: opacity, paint, height, base, the code's five, the colour's three, `rows` numbers each."""
    i = start + wp.tid()
    alpha = load(opacity, i)
    own = load3(colour, 3 * i, 1)
    g = load3(grad, 3 * i, 1)
    scale = 1.0 / wp.max(alpha, model.LEAST_ALPHA)
    straight = scale * own
    rgb = clamped(straight)
    up = load(height, i)
    share = load(paint, i)
    touched = wp.where(wp.min(alpha, share) > 0.0, 1.0, 0.0)
    coat = coat_at(code, i, up)
    change, g_rgb, g_tint, g_finish, g_base = paint_change_adjoint(
        rgb, coat, load(base, i), painted_share(alpha, share) * g
    )
    along = touched * wp.dot(g, change)
    g_straight = scale * clamped_adjoint(straight, g_rgb)
    thin = wp.where(alpha >= model.LEAST_ALPHA, wp.dot(g_straight, straight), 0.0)
    store(grads, i, share * along - thin)
    store(grads, i + rows, alpha * along)
    store(grads, i + 2 * rows, -model.CLEAN_ROOF * within(up, 0.0, 1.0) * g_finish[2])
    store(grads, i + 3 * rows, g_base)
    store3(grads, i + 4 * rows, rows, g_tint)
    store(grads, i + 7 * rows, g_finish[0])
    store(grads, i + 8 * rows, g_finish[1])
    store3(grads, i + 9 * rows, rows, g + g_straight)


class _Paint(torch.autograd.Function):
    """Rows: colour (R, 3), opacity (R,), code (R, 5), paint, height, base lightness (R,)."""

    @staticmethod
    def forward(ctx: Any, *rows: Tensor) -> Tensor:
        given = [row.detach().contiguous() for row in rows]
        out = torch.empty_like(given[0])
        launch(paint_kernel, split_range(out.shape[0]), [array(t) for t in (*given, out)])
        ctx.save_for_backward(*given)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        given = ctx.saved_tensors
        rows = given[0].shape[0]
        grads = given[0].new_empty(12, rows)
        inputs = [*(array(t) for t in (*given, grad)), rows]
        launch(paint_adjoint_kernel, split_range(rows), inputs, [array(grads)])
        return grads[9:].T, grads[0], grads[4:9].T, grads[1], grads[2], grads[3]


def array(values: Tensor) -> Any:
    """A float tensor as Warp's array of its numbers, one after the other."""
    return wp.from_torch(values.detach().contiguous().view(-1), dtype=wp.float32)


def paint(
    colour: Tensor, opacity: Tensor, code: Tensor, share: Tensor, height: Tensor, base_lightness: Tensor
) -> Tensor:
    """See `texture.apply_texture_code`. All float32; differentiable to all."""
    return _Paint.apply(colour, opacity, code, share, height, base_lightness)
