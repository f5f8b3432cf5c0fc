# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
"""Night over the whole picture as a fused Warp kernel, with gradients by hand; float32. The model is in `night`."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import Floats, launch, split_range, start_warp
from scene_ir.raster.simd import SIMD_OPTIONS, exp_, load, load3, store, store3
from scene_ir.render import model
from scene_ir.render.channels import AIM, CORNER, GLARE, NOISE, RISE, STREET
from scene_ir.render.kernels.colour import flat_array

start_warp()
wp.set_module_options(SIMD_OPTIONS)

NEAREST, BEND = 1.0 / model.HAZE_CAP_M, model.NIGHT_BEND**2
CUT_M, SOFT_M, ABOVE, BELOW = model.HEAD_CUT_M, model.HEAD_SOFT_M, model.HEAD_ABOVE, 1.0 - model.HEAD_ABOVE
FAR = 1.0 / model.HEAD_FAR_M**2
SOFTENED, RETRO_WHITE, LIT_GAIN = model.SUN_SOFTENED, model.RETRO_WHITE, model.LIT_GAIN
NOISE_BLACK, NOISE_LEVEL = model.NOISE, model.NOISE_LEVEL
STREET_RGB = wp.constant(wp.vec3f(*model.STREET_RGB))
HEAD_RGB = wp.constant(wp.vec3f(*model.HEAD_RGB))
GLOW_RGB = wp.constant(wp.vec3f(*model.GLOW_RGB))


@wp.func
def _sqrt3(x: wp.vec3f):
    return wp.vec3f(wp.sqrt(x[0]), wp.sqrt(x[1]), wp.sqrt(x[2]))


@wp.func
def _splat(x: wp.float32):
    return wp.vec3f(x, x, x)


@wp.func
def _below_cut(depth: wp.float32, rise: wp.float32, camera_m: wp.float32):
    """Share of the beam below its cut-off."""
    return 1.0 / (1.0 + exp_((camera_m + depth * rise - CUT_M) * (1.0 / SOFT_M)))


@wp.func
def _soft_day(day: wp.vec3f):
    return wp.cw_div(day, _splat(1.0) + SOFTENED * day)


@wp.func
def _retro_day(day: wp.vec3f):
    """What headlamps light: bright surfaces send more light back."""
    return day + RETRO_WHITE * wp.cw_mul(day, wp.cw_mul(day, day))


@wp.func
def _not_negative(light: wp.vec3f):
    """Light; lamps on a road that a vehicle hides with an opacity beyond 1 are slightly negative."""
    return wp.vec3f(wp.max(light[0], 0.0), wp.max(light[1], 0.0), wp.max(light[2], 0.0))


@wp.func
def _slope_above_zero(light: wp.vec3f):
    return wp.vec3f(
        wp.where(light[0] >= 0.0, 1.0, 0.0),
        wp.where(light[1] >= 0.0, 1.0, 0.0),
        wp.where(light[2] >= 0.0, 1.0, 0.0),
    )


@wp.func
def _street_light(street: wp.float32, lit: wp.float32):
    return street * STREET_RGB + _splat(LIT_GAIN * lit)


@wp.kernel
def _night_kernel(
    start: int,
    settings: Floats,
    camera_m: float,
    image: Floats,
    inverse: Floats,
    sky: Floats,
    lit: Floats,
    vehicles: Floats,
    maps: Floats,
    plane: int,
    out: Floats,
):
    """settings: share of night, growth of glare."""
    i = start + wp.tid()
    share = load(settings, 0)
    x = load3(image, i, plane)
    depth = 1.0 / wp.max(load(inverse, i), NEAREST)
    below = _below_cut(depth, load(maps, RISE * plane + i), camera_m)
    head = load(maps, AIM * plane + i) * (ABOVE + BELOW * below) / (1.0 + FAR * depth * depth)
    street = load(maps, STREET * plane + i)
    day = wp.cw_mul(x, x)
    lamps = wp.cw_mul(_soft_day(day), _street_light(street, load(lit, i)))
    lamps = lamps + head * wp.cw_mul(_retro_day(day), HEAD_RGB)
    light = (
        lamps
        + load(sky, i) * (street * GLOW_RGB - lamps)
        + load(settings, 1) * load3(maps, GLARE * plane + i, plane)
    )
    dark_light = _not_negative(day + share * (light - day) + load3(vehicles, i, plane))
    dark = x + (_sqrt3(dark_light + _splat(BEND)) - _sqrt3(day + _splat(BEND)))
    seen = (1.0 - share * load(maps, CORNER * plane + i)) * dark
    noise = share * load3(maps, NOISE * plane + i, plane)
    store3(out, i, plane, seen + wp.cw_mul(noise, _splat(NOISE_BLACK) + NOISE_LEVEL * seen))


@wp.kernel
def _night_adjoint_kernel(
    start: int,
    settings: Floats,
    camera_m: float,
    image: Floats,
    inverse: Floats,
    sky: Floats,
    lit: Floats,
    vehicles: Floats,
    maps: Floats,
    plane: int,
    grad: Floats,
    grad_image: Floats,
    grad_maps: Floats,
    parts: Floats,
):
    """grad_maps: to inverse depth, sky, lit and the vehicles' lamps (3), one plane each; parts: each pixel's part of
    those to the settings.
    """
    i = start + wp.tid()
    share = load(settings, 0)
    x = load3(image, i, plane)
    inverse_depth = load(inverse, i)
    depth = 1.0 / wp.max(inverse_depth, NEAREST)
    rise = load(maps, RISE * plane + i)
    below = _below_cut(depth, rise, camera_m)
    aim = load(maps, AIM * plane + i)
    fall = 1.0 / (1.0 + FAR * depth * depth)
    cut = ABOVE + BELOW * below
    street = load(maps, STREET * plane + i)
    open_sky = load(sky, i)
    day = wp.cw_mul(x, x)
    surface = _soft_day(day)
    colour = _street_light(street, load(lit, i))
    head = aim * cut * fall
    retro = _retro_day(day)
    lamps = wp.cw_mul(surface, colour) + head * wp.cw_mul(retro, HEAD_RGB)
    glare = load3(maps, GLARE * plane + i, plane)
    light = lamps + open_sky * (street * GLOW_RGB - lamps) + load(settings, 1) * glare
    dark_light = day + share * (light - day) + load3(vehicles, i, plane)
    root = _sqrt3(_not_negative(dark_light) + _splat(BEND))
    day_root = _sqrt3(day + _splat(BEND))
    dark = x + (root - day_root)
    corner = load(maps, CORNER * plane + i)
    keep = 1.0 - share * corner
    seen = keep * dark
    noise = load3(maps, NOISE * plane + i, plane)

    g = load3(grad, i, plane)
    g_seen = g + (share * NOISE_LEVEL) * wp.cw_mul(g, noise)
    g_dark = keep * g_seen
    g_sum = wp.cw_mul(_slope_above_zero(dark_light), wp.cw_div(0.5 * g_dark, root))
    g_light = share * g_sum
    g_lamps = (1.0 - open_sky) * g_light
    g_colour = wp.cw_mul(g_lamps, surface)
    slope = wp.cw_div(_splat(1.0), _splat(1.0) + SOFTENED * day)
    g_retro = wp.cw_mul(g_lamps, HEAD_RGB)
    g_day = (1.0 - share) * g_sum + wp.cw_mul(wp.cw_mul(g_lamps, colour), wp.cw_mul(slope, slope))
    g_day = g_day + head * wp.cw_mul(g_retro, _splat(1.0) + (3.0 * RETRO_WHITE) * wp.cw_mul(day, day))
    g_head = aim * wp.dot(g_retro, retro)
    bent = (-BELOW / SOFT_M) * below * (1.0 - below) * rise
    g_depth = g_head * (fall * bent - cut * 2.0 * FAR * depth * fall * fall)
    store3(grad_image, i, plane, g_dark + wp.cw_mul(x, 2.0 * g_day - wp.cw_div(g_dark, day_root)))
    g_inverse = wp.where(inverse_depth >= NEAREST, -(depth * depth) * g_depth, 0.0)
    store3(grad_maps, 3 * plane + i, plane, g_sum)
    g_sky = wp.dot(g_light, street * GLOW_RGB - lamps)
    store3(grad_maps, i, plane, wp.vec3f(g_inverse, g_sky, LIT_GAIN * (g_colour[0] + g_colour[1] + g_colour[2])))
    g_share = wp.dot(wp.cw_mul(g, noise), _splat(NOISE_BLACK) + NOISE_LEVEL * seen)
    g_share = g_share - corner * wp.dot(g_seen, dark) + wp.dot(g_sum, light - day)
    store(parts, i, g_share)
    store(parts, plane + i, wp.dot(g_light, glare))


class _Night(torch.autograd.Function):
    """Night over image (3, H, W) at inverse depth (H, W); sky, lit (H, W); lamps (3, H, W); settings (2,); maps
    (14, H, W).
    """

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        inverse: Tensor,
        sky: Tensor,
        lit: Tensor,
        lamps: Tensor,
        settings: Tensor,
        maps: Tensor,
        camera_m: float,
    ) -> Tensor:
        saved = [t.detach().contiguous() for t in (settings, image, inverse, sky, lit, lamps, maps)]
        out = torch.empty_like(saved[1])
        launch(_night_kernel, split_range(inverse.numel()), [*_inputs(saved, camera_m), flat_array(out)])
        ctx.save_for_backward(*saved)
        ctx.camera_m = camera_m
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        image = ctx.saved_tensors[1]
        size = image.shape[1:]
        grad_image, grad_maps, parts = (
            torch.empty_like(image),
            image.new_empty(6, *size),
            image.new_empty(2, *size),
        )
        arrays = [flat_array(t) for t in (grad.contiguous(), grad_image, grad_maps, parts)]
        inputs = _inputs(ctx.saved_tensors, ctx.camera_m)
        launch(_night_adjoint_kernel, split_range(parts[0].numel()), [*inputs, *arrays])
        # rows first, so that sums do not depend on the number of threads
        return grad_image, *grad_maps[:3], grad_maps[3:], parts.sum(dim=2).sum(dim=1), None, None


def _inputs(saved: Any, camera_m: float) -> list[Any]:
    settings, *planes = (flat_array(t) for t in saved)
    return [settings, camera_m, *planes, saved[2].numel()]


def apply_night(
    image: Tensor,
    inverse: Tensor,
    sky: Tensor,
    lit: Tensor,
    lamps: Tensor,
    settings: Tensor,
    maps: Tensor,
    camera_m: float,
) -> Tensor:
    """See `night.apply_night`; float32.

    Args:
        image, inverse, sky, lit, lamps: As there.
        settings: (2,), share of night and growth of glare.
        maps: (14, H, W).
        camera_m: Height of the camera, m.
    """
    return _Night.apply(image, inverse, sky, lit, lamps, settings, maps, camera_m)
