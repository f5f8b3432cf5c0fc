# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
"""CIE L*a*b* conversions and paint changes as Warp functions with gradients by hand; float32.

Their definitions are in `texture` (`rgb_to_lab`, `lab_to_soft_rgb`, `apply_texture_code`); a test compares both.
The gradient of a function is the function that ends in `_adjoint`: arguments, then the gradient to the result.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import Floats, launch, split_range, start_warp
from scene_ir.raster.simd import SIMD_OPTIONS, exp_, load, load3, log_, store, store3
from scene_ir.render import model

start_warp()
wp.set_module_options(SIMD_OPTIONS)

SHARPNESS, GAMUT_TAIL = model.GAMUT_SHARPNESS, math.exp(-model.GAMUT_SHARPNESS)
GLOSS_PER_L = model.GLOSS_GAIN / model.GLOSSY_L
LEVEL_LOW, LEVEL_HIGH = model.LEVEL
DUST = wp.constant(wp.vec3f(*model.DUST_RGB))

# sRGB to and from XYZ relative to D65 white: kornia's matrices with rows divided or columns multiplied by white.
TO_X = wp.constant(wp.vec3f(0.412453 / 0.95047, 0.357580 / 0.95047, 0.180423 / 0.95047))
TO_Y = wp.constant(wp.vec3f(0.212671, 0.715160, 0.072169))
TO_Z = wp.constant(wp.vec3f(0.019334 / 1.08883, 0.119193 / 1.08883, 0.950227 / 1.08883))
TO_R = wp.constant(wp.vec3f(3.2404813432005266 * 0.95047, -1.5371515162713185, -0.4985363261688878 * 1.08883))
TO_G = wp.constant(wp.vec3f(-0.9692549499965682 * 0.95047, 1.8759900014898907, 0.0415559265582928 * 1.08883))
TO_B = wp.constant(wp.vec3f(0.0556466391351772 * 0.95047, -0.2040413383665112, 1.0573110696453443 * 1.08883))


@wp.func
def _to_linear(x: wp.float32):
    """sRGB to linear light."""
    power = exp_(2.4 * log_(wp.max((x + 0.055) * (1.0 / 1.055), 1e-3)))
    return wp.where(x > 0.04045, power, x * (1.0 / 12.92))


@wp.func
def _to_linear_slope(x: wp.float32, value: wp.float32):
    return wp.where(x > 0.04045, 2.4 * value / wp.max(x + 0.055, 1e-3), 1.0 / 12.92)


@wp.func
def _lab_root(x: wp.float32):
    """Cube root of CIE L*a*b*, linear near 0."""
    return wp.where(x > 0.008856, exp_(log_(wp.max(x, 0.008856)) * (1.0 / 3.0)), 7.787 * x + 4.0 / 29.0)


@wp.func
def _lab_root_slope(x: wp.float32, value: wp.float32):
    return wp.where(x > 0.008856, value / (3.0 * wp.max(x, 0.008856)), 7.787)


@wp.func
def _lab_cube(f: wp.float32):
    return wp.where(f > 0.2068966, f * f * f, (f - 4.0 / 29.0) * (1.0 / 7.787))


@wp.func
def _lab_cube_slope(f: wp.float32):
    return wp.where(f > 0.2068966, 3.0 * f * f, 1.0 / 7.787)


@wp.func
def _to_srgb(x: wp.float32):
    """Linear light to sRGB."""
    power = 1.055 * exp_(log_(wp.max(x, 0.0031308)) * (1.0 / 2.4)) - 0.055
    return wp.where(x > 0.0031308, power, 12.92 * x)


@wp.func
def _to_srgb_slope(x: wp.float32, value: wp.float32):
    return wp.where(x > 0.0031308, (value + 0.055) / (2.4 * wp.max(x, 0.0031308)), 12.92)


@wp.func
def _into_gamut(x: wp.float32):
    """softplus(x) - softplus(x - 1), softplus(x) = log(1 + exp(SHARPNESS x)) / SHARPNESS."""
    power = exp_(SHARPNESS * x)
    return log_((1.0 + power) / (1.0 + GAMUT_TAIL * power)) * (1.0 / SHARPNESS)


@wp.func
def _into_gamut_slope(x: wp.float32):
    power = exp_(SHARPNESS * x)
    return (power / (1.0 + power)) * ((1.0 - GAMUT_TAIL) / (1.0 + GAMUT_TAIL * power))


@wp.func
def _linear_rgb(rgb: wp.vec3f):
    return wp.vec3f(_to_linear(rgb[0]), _to_linear(rgb[1]), _to_linear(rgb[2]))


@wp.func
def rgb_to_lab(rgb: wp.vec3f):
    light = _linear_rgb(rgb)
    x = _lab_root(wp.dot(TO_X, light))
    y = _lab_root(wp.dot(TO_Y, light))
    z = _lab_root(wp.dot(TO_Z, light))
    return wp.vec3f(116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z))


@wp.func
def rgb_to_lab_adjoint(rgb: wp.vec3f, g: wp.vec3f):
    light = _linear_rgb(rgb)
    x = wp.dot(TO_X, light)
    y = wp.dot(TO_Y, light)
    z = wp.dot(TO_Z, light)
    g_x = _lab_root_slope(x, _lab_root(x)) * (500.0 * g[1])
    g_y = _lab_root_slope(y, _lab_root(y)) * (116.0 * g[0] - 500.0 * g[1] + 200.0 * g[2])
    g_z = _lab_root_slope(z, _lab_root(z)) * (-200.0 * g[2])
    g_light = g_x * TO_X + g_y * TO_Y + g_z * TO_Z
    return wp.vec3f(
        _to_linear_slope(rgb[0], light[0]) * g_light[0],
        _to_linear_slope(rgb[1], light[1]) * g_light[1],
        _to_linear_slope(rgb[2], light[2]) * g_light[2],
    )


@wp.func
def _xyz_roots(lab: wp.vec3f):
    y = (lab[0] + 16.0) * (1.0 / 116.0)
    return wp.vec3f(lab[1] * (1.0 / 500.0) + y, y, y - lab[2] * (1.0 / 200.0))


@wp.func
def lab_to_rgb(lab: wp.vec3f):
    """sRGB in (0, 1): colours out of gamut bend back softly."""
    f = _xyz_roots(lab)
    xyz = wp.vec3f(_lab_cube(f[0]), _lab_cube(f[1]), _lab_cube(wp.max(f[2], 0.0)))
    return wp.vec3f(
        _into_gamut(_to_srgb(wp.dot(TO_R, xyz))),
        _into_gamut(_to_srgb(wp.dot(TO_G, xyz))),
        _into_gamut(_to_srgb(wp.dot(TO_B, xyz))),
    )


@wp.func
def _channel_slope(x: wp.float32):
    value = _to_srgb(x)
    return _into_gamut_slope(value) * _to_srgb_slope(x, value)


@wp.func
def lab_to_rgb_adjoint(lab: wp.vec3f, g: wp.vec3f):
    f = _xyz_roots(lab)
    xyz = wp.vec3f(_lab_cube(f[0]), _lab_cube(f[1]), _lab_cube(wp.max(f[2], 0.0)))
    g_xyz = (_channel_slope(wp.dot(TO_R, xyz)) * g[0]) * TO_R
    g_xyz += (_channel_slope(wp.dot(TO_G, xyz)) * g[1]) * TO_G
    g_xyz += (_channel_slope(wp.dot(TO_B, xyz)) * g[2]) * TO_B
    g_x = _lab_cube_slope(f[0]) * g_xyz[0]
    g_y = _lab_cube_slope(f[1]) * g_xyz[1]
    g_z = wp.where(f[2] >= 0.0, _lab_cube_slope(f[2]) * g_xyz[2], 0.0)
    return wp.vec3f((g_x + g_y + g_z) * (1.0 / 116.0), g_x * (1.0 / 500.0), g_z * (-1.0 / 200.0))


@wp.func
def clamp_slope(x: wp.float32, low: wp.float32, high: wp.float32):
    """Slope of clamping: 1 from low to high.

    Args:
        x: Value.
        low, high: Bounds.
    """
    return wp.where(x >= low, 1.0, 0.0) * wp.where(x <= high, 1.0, 0.0)


@wp.func
def clamp01(x: wp.vec3f):
    return wp.vec3f(wp.min(wp.max(x[0], 0.0), 1.0), wp.min(wp.max(x[1], 0.0), 1.0), wp.min(wp.max(x[2], 0.0), 1.0))


@wp.func
def clamp01_adjoint(x: wp.vec3f, g: wp.vec3f):
    return wp.vec3f(
        clamp_slope(x[0], 0.0, 1.0) * g[0], clamp_slope(x[1], 0.0, 1.0) * g[1], clamp_slope(x[2], 0.0, 1.0) * g[2]
    )


@wp.func
def lightness_level(lightness: wp.float32):
    return wp.min(wp.max(lightness * 0.01, LEVEL_LOW), LEVEL_HIGH)


@wp.func
def scale_odds(level: wp.float32, odds: wp.float32):
    """sigmoid(logit(level) + log(odds))."""
    return level * odds / (level * odds + (1.0 - level))


@wp.struct
class PaintChange:
    """Shifts of lightness, a* and b*; gloss; dirt; and the share of dirt that sticks at this height."""

    shift: wp.float32
    red: wp.float32
    yellow: wp.float32
    gloss: wp.float32
    dirt: wp.float32
    grip: wp.float32


@wp.func
def _repaint(lab: wp.vec3f, change: PaintChange, base: wp.float32):
    """The paint model without dust: L*a*b*. base: L* about which gloss changes contrast."""
    odds = exp_(model.LIGHTNESS_GAIN * change.shift + change.gloss * GLOSS_PER_L * (lab[0] - base))
    level = scale_odds(lightness_level(lab[0]), odds)
    room = 4.0 * model.CHROMA_GAIN * level * (1.0 - level)
    return wp.vec3f(100.0 * level, lab[1] + change.red * room, lab[2] + change.yellow * room)


@wp.func
def _add_dust(rgb: wp.vec3f, change: PaintChange):
    return rgb + (model.DIRT_GAIN * change.dirt * change.grip) * (DUST - rgb)


@wp.func
def _repaint_adjoint(lab: wp.vec3f, change: PaintChange, base: wp.float32, g: wp.vec3f):
    """The colour with dust; gradients to lab, (shift, red, yellow), (gloss, dirt, grip), base."""
    odds = exp_(model.LIGHTNESS_GAIN * change.shift + change.gloss * GLOSS_PER_L * (lab[0] - base))
    before = lightness_level(lab[0])
    level = scale_odds(before, odds)
    room = 4.0 * model.CHROMA_GAIN * level * (1.0 - level)
    changed = wp.vec3f(100.0 * level, lab[1] + change.red * room, lab[2] + change.yellow * room)
    out = lab_to_rgb(changed)
    veil = model.DIRT_GAIN * change.dirt * change.grip
    g_veil = model.DIRT_GAIN * wp.dot(g, DUST - out)
    g_lab = lab_to_rgb_adjoint(changed, (1.0 - veil) * g)
    g_room = change.red * g_lab[1] + change.yellow * g_lab[2]
    g_level = 100.0 * g_lab[0] + 4.0 * model.CHROMA_GAIN * (1.0 - 2.0 * level) * g_room
    g_odds = g_level * level * (1.0 - level)
    bottom = before * odds + (1.0 - before)
    g_before = g_level * odds / (bottom * bottom)
    g_tint = wp.vec3f(model.LIGHTNESS_GAIN * g_odds, room * g_lab[1], room * g_lab[2])
    g_finish = wp.vec3f(GLOSS_PER_L * (lab[0] - base) * g_odds, change.grip * g_veil, change.dirt * g_veil)
    g_base = -GLOSS_PER_L * change.gloss * g_odds
    g_light = 0.01 * clamp_slope(lab[0] * 0.01, LEVEL_LOW, LEVEL_HIGH) * g_before - g_base
    return out + veil * (DUST - out), wp.vec3f(g_light, g_lab[1], g_lab[2]), g_tint, g_finish, g_base


@wp.func
def _dust_share(height: wp.float32):
    return 1.0 - model.CLEAN_ROOF * wp.min(wp.max(height, 0.0), 1.0)


@wp.func
def _read_change(code: Floats, i: int, height: wp.float32):
    change = PaintChange()
    change.shift = load(code, 5 * i)
    change.red = load(code, 5 * i + 1)
    change.yellow = load(code, 5 * i + 2)
    change.gloss = load(code, 5 * i + 3)
    change.dirt = load(code, 5 * i + 4)
    change.grip = _dust_share(height)
    return change


@wp.func
def _no_change():
    return PaintChange()


@wp.func
def _change_size(change: PaintChange):
    return (
        wp.abs(change.shift)
        + wp.abs(change.red)
        + wp.abs(change.yellow)
        + wp.abs(change.gloss)
        + wp.abs(change.dirt)
    )


@wp.func
def _difference(rgb: wp.vec3f, change: PaintChange, base: wp.float32):
    """Change of an opaque colour in [0, 1]; exactly 0 without change, for any rounding."""
    lab = rgb_to_lab(rgb)
    difference = _add_dust(lab_to_rgb(_repaint(lab, change, base)), change) - lab_to_rgb(
        _repaint(lab, _no_change(), base)
    )
    return wp.where(_change_size(change) > 0.0, 1.0, 0.0) * difference


@wp.func
def _difference_adjoint(rgb: wp.vec3f, change: PaintChange, base: wp.float32, g: wp.vec3f):
    """The change itself; gradients to rgb, (shift, red, yellow), (gloss, dirt, grip), base."""
    lab = rgb_to_lab(rgb)
    now, g_lab, g_tint, g_finish, g_base = _repaint_adjoint(lab, change, base, g)
    then, g_bare, _tint, _finish, _base = _repaint_adjoint(lab, _no_change(), base, g)
    return now - then, rgb_to_lab_adjoint(rgb, g_lab - g_bare), g_tint, g_finish, g_base


@wp.func
def _paint_opacity(opacity: wp.float32, paint: wp.float32):
    return wp.where(wp.min(opacity, paint) > 0.0, opacity * paint, 0.0)


@wp.kernel
def _paint_kernel(
    start: int,
    colour: Floats,
    opacity: Floats,
    code: Floats,
    paint: Floats,
    height: Floats,
    base: Floats,
    out: Floats,
):
    i = start + wp.tid()
    alpha = load(opacity, i)
    own = load3(colour, 3 * i, 1)
    straight = clamp01((1.0 / wp.max(alpha, model.LEAST_ALPHA)) * own)
    difference = _difference(straight, _read_change(code, i, load(height, i)), load(base, i))
    store3(out, 3 * i, 1, own + _paint_opacity(alpha, load(paint, i)) * difference)


@wp.kernel
def _paint_adjoint_kernel(
    start: int,
    colour: Floats,
    opacity: Floats,
    code: Floats,
    paint: Floats,
    height: Floats,
    base: Floats,
    grad: Floats,
    rows: int,
    grads: Floats,
):
    """grads: opacity, paint, height, base, the code's five, the colour's three, `rows` numbers each."""
    i = start + wp.tid()
    alpha = load(opacity, i)
    own = load3(colour, 3 * i, 1)
    g = load3(grad, 3 * i, 1)
    scale = 1.0 / wp.max(alpha, model.LEAST_ALPHA)
    straight = scale * own
    rgb = clamp01(straight)
    up = load(height, i)
    share = load(paint, i)
    touched = wp.where(wp.min(alpha, share) > 0.0, 1.0, 0.0)
    change = _read_change(code, i, up)
    difference, g_rgb, g_tint, g_finish, g_base = _difference_adjoint(
        rgb, change, load(base, i), _paint_opacity(alpha, share) * g
    )
    along = touched * wp.dot(g, difference)
    g_straight = scale * clamp01_adjoint(straight, g_rgb)
    thin = wp.where(alpha >= model.LEAST_ALPHA, wp.dot(g_straight, straight), 0.0)
    store(grads, i, share * along - thin)
    store(grads, i + rows, alpha * along)
    store(grads, i + 2 * rows, -model.CLEAN_ROOF * clamp_slope(up, 0.0, 1.0) * g_finish[2])
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
        launch(_paint_kernel, split_range(out.shape[0]), [flat_array(t) for t in (*given, out)])
        ctx.save_for_backward(*given)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        given = ctx.saved_tensors
        rows = given[0].shape[0]
        grads = given[0].new_empty(12, rows)
        inputs = [*(flat_array(t) for t in (*given, grad)), rows]
        launch(_paint_adjoint_kernel, split_range(rows), [*inputs, flat_array(grads)])
        return grads[9:].T, grads[0], grads[4:9].T, grads[1], grads[2], grads[3]


def flat_array(values: Tensor) -> Any:
    """A float tensor as a Warp array of its numbers in order."""
    return wp.from_torch(values.detach().contiguous().view(-1), dtype=wp.float32)


def repaint(
    colour: Tensor, opacity: Tensor, code: Tensor, share: Tensor, height: Tensor, base_lightness: Tensor
) -> Tensor:
    """See `texture.apply_texture_code`; float32, differentiable to all.

    Args:
        colour, opacity, code, height, base_lightness: As there.
        share: Paint share of the pixels.
    """
    return _Paint.apply(colour, opacity, code, share, height, base_lightness)
