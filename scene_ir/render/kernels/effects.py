# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
"""Weather and foliage over the whole picture as fused Warp kernels, with gradients by hand; float32.

The model is in `environment`, its constants in `model`. The rows that hold wet road (the wet rows) have a kernel of
their own.
"""

from __future__ import annotations

import threading
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import Floats, launch, split_range, start_warp
from scene_ir.raster.simd import SIMD_OPTIONS, exp_, load, load3, store, store3, sum3
from scene_ir.render import model
from scene_ir.render.kernels.colour import (
    clamp01,
    clamp01_adjoint,
    clamp_slope,
    flat_array,
    lab_to_rgb,
    lab_to_rgb_adjoint,
    lightness_level,
    rgb_to_lab,
    rgb_to_lab_adjoint,
    scale_odds,
)
from scene_ir.types import Environment

start_warp()
wp.set_module_options(SIMD_OPTIONS)

FOG, RAIN, NEAREST = model.FOG_EXTINCTION_PER_M, model.RAIN_EXTINCTION_PER_M, 1.0 / model.HAZE_CAP_M
VEIL_BEND = model.VEIL_BEND**2
FLAT, FLAT_GREY = (
    model.OVERCAST_CONTRAST * share for share in (model.OVERCAST_COLOUR, 1.0 - model.OVERCAST_COLOUR)
)
FLAT_LIGHT = model.OVERCAST_TO - model.OVERCAST_CONTRAST * model.OVERCAST_FROM
COVER_AIR = model.COVER_AIR - model.COVER_STRUCTURE
"""Overcast, multiplied out."""
DAMP, DAMP_GREY = (model.DAMP_LIGHT * share for share in (model.DAMP_COLOUR, 1.0 - model.DAMP_COLOUR))
FILM_NEAR, FRESNEL = model.FILM * model.WATER, model.FILM * (1.0 - model.WATER)
WET_ROAD, WET_CHANGE = model.WET_ROAD, model.WET_ROAD - 1.0
THICK = model.THICK_SHARE * (1.0 - model.THICK_DARKNESS)
LEVEL_LOW, LEVEL_HIGH = model.LEVEL
LEAF_TURN_SLOPE = model.LEAF_TURN_MORE * model.LEAF_TURN_BEND
LUMA = wp.constant(wp.vec3f(*model.LUMA))
DARKENING = wp.constant(wp.vec3d(*model.DARKENING))
WARMTH = wp.constant(wp.vec3d(*model.WARMTH))
TWILIGHT_SKY = wp.constant(wp.vec3d(*model.TWILIGHT_SKY))

(OVERCAST, WET, MIST, COVER) = range(4)
(GAIN, GAIN_SLOPE, GAIN_BY_SUN, SKY_GAIN, SKY_GAIN_SLOPE) = range(4, 19, 3)
(AIR, AIR_BY_OVERCAST, AIR_BY_TIME, AIR_BY_SUN, AIR_BY_HAZE) = range(19, 34, 3)
CAMERA, SETTINGS = 34, 35
"""First index of each setting, equal for all pixels, and their count: weight of overcast; rain; fog; overcast of a
black sky; gain of the time of day (3), its slopes along time (3) and the low sun's share (3); the sky's further gain
(3) and its slope along time (3); airlight (3), its slopes along overcast, time and the low sun's share (3 each), and
its change by either of fog and rain, fully on alone (3); height of the camera, m.
"""
CODES = 5
"""Codes of the kernels: fog, rain, time, overcast, the low sun's share."""


@wp.func
def _grey_air(air: Floats):
    return wp.float64(LUMA[0] * air[0] + LUMA[1] * air[1] + LUMA[2] * air[2])


@wp.kernel
def _settings_kernel(start: int, code: Floats, air: Floats, camera: Floats, settings: Floats):
    """One thread per channel."""
    c = start + wp.tid()
    time = wp.float64(code[2])
    overcast = wp.float64(model.OVERCAST) * wp.float64(code[3])
    square = time * time
    dusk = wp.exp(wp.float64(-model.DUSK_ENDS) * square)
    dim = wp.exp(wp.float64(-model.DIMMING_ENDS) * square)
    dark = wp.exp(-DARKENING[c] * square)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    low_sun = wp.float64(code[4])
    warmth = WARMTH[c] * time * dusk
    dimming = wp.float64(model.DIMMING)
    gain = (dark - one) + low_sun * warmth - dimming * time * dim
    slope = (
        -two * DARKENING[c] * time * dark
        + low_sun * WARMTH[c] * (one - two * wp.float64(model.DUSK_ENDS) * square) * dusk
        - dimming * (one - two * wp.float64(model.DIMMING_ENDS) * square) * dim
    )
    _luma = _grey_air(air)
    away = wp.float64(model.OVERCAST_AIR) * _luma - wp.float64(air[c])
    plain = wp.float64(air[c]) + overcast * away
    darker = (wp.float64(model.OVERCAST_AIR) - one) * _luma
    fog = wp.float64(code[0])
    rain = wp.float64(code[1])
    greyed = wp.float64(model.HAZE_GREY) * (fog + rain - fog * rain)
    paler = _luma + overcast * darker - plain
    misty = plain + greyed * paler
    if c == 0:
        settings[OVERCAST] = wp.float32(overcast)
        settings[WET] = code[1]
        settings[MIST] = code[0]
        settings[CAMERA] = camera[0]
        settings[COVER] = wp.float32(wp.float64(COVER_AIR) * _luma + wp.float64(model.COVER_LIGHT))
    settings[GAIN + c] = wp.float32(gain)
    settings[GAIN_SLOPE + c] = wp.float32(slope)
    settings[GAIN_BY_SUN + c] = wp.float32(warmth)
    settings[SKY_GAIN + c] = wp.float32(square * TWILIGHT_SKY[c])
    settings[SKY_GAIN_SLOPE + c] = wp.float32(two * time * TWILIGHT_SKY[c])
    settings[AIR + c] = wp.float32(misty + gain * misty)
    along = away + greyed * (darker - away)
    settings[AIR_BY_OVERCAST + c] = wp.float32(wp.float64(model.OVERCAST) * along * (one + gain))
    settings[AIR_BY_TIME + c] = wp.float32(slope * misty)
    settings[AIR_BY_SUN + c] = wp.float32(warmth * misty)
    settings[AIR_BY_HAZE + c] = wp.float32(wp.float64(model.HAZE_GREY) * paler * (one + gain))


@wp.func
def _luma(x: wp.vec3f):
    return wp.dot(LUMA, x)


@wp.func
def _splat(x: wp.float32):
    return wp.vec3f(x, x, x)


@wp.func
def _apply_gain(x: wp.vec3f, gain: wp.vec3f):
    return wp.vec3f(x[0] + gain[0] * x[0], x[1] + gain[1] * x[1], x[2] + gain[2] * x[2])


@wp.func
def _overcast_change(x: wp.vec3f, sky: wp.float32, settings: Floats):
    """Change by full overcast."""
    y = _luma(x)
    flat = FLAT * x + _splat(FLAT_GREY * y + FLAT_LIGHT)
    return (flat + sky * (_splat(load(settings, COVER) + model.COVER_STRUCTURE * y) - flat)) - x


@wp.func
def _damp_change(x: wp.vec3f):
    """Change by wetting, at rain 1 / `model.DAMP`."""
    return (DAMP * x + _splat(DAMP_GREY * _luma(x))) - x


@wp.func
def _dampen(x: wp.vec3f, sky: wp.float32, settings: Floats):
    """A pixel after overcast, time of day and damp."""
    covered = x + load(settings, OVERCAST) * _overcast_change(x, sky, settings)
    timed = _apply_gain(covered, load3(settings, GAIN, 1) + sky * load3(settings, SKY_GAIN, 1))
    return timed + (model.DAMP * load(settings, WET)) * _damp_change(timed)


@wp.func
def _haze_depth(inverse: wp.float32):
    return 1.0 / wp.max(inverse, NEAREST)


@wp.func
def _mirror_share(depth: wp.float32, settings: Floats):
    """Share of light that a wet road mirrors, and its slope along the depth."""
    camera = load(settings, CAMERA)
    square = camera * camera + depth * depth
    cos = camera / wp.sqrt(square)
    away = 1.0 - cos
    bent = FRESNEL * away * away * away * away
    return FILM_NEAR + bent * away, 5.0 * bent * cos * depth / square


@wp.func
def _sqrt3(x: wp.vec3f):
    return wp.vec3f(wp.sqrt(x[0]), wp.sqrt(x[1]), wp.sqrt(x[2]))


@wp.func
def _apply_veil(x: wp.vec3f, veil: wp.float32, air: wp.vec3f):
    """See `environment.apply_veil`."""
    square = wp.cw_mul(x, x)
    light = square + _splat(VEIL_BEND)
    return x + (_sqrt3(light + veil * (wp.cw_mul(air, air) - square)) - _sqrt3(light))


@wp.func
def _apply_veil_adjoint(x: wp.vec3f, veil: wp.float32, air: wp.vec3f, g: wp.vec3f):
    """Gradients to x, to the veil and to the air."""
    square = wp.cw_mul(x, x)
    light = square + _splat(VEIL_BEND)
    more = wp.cw_mul(air, air) - square
    by_root = wp.cw_div(g, _sqrt3(light + veil * more))
    to_x = g + wp.cw_mul(x, (1.0 - veil) * by_root - wp.cw_div(g, _sqrt3(light)))
    return to_x, 0.5 * wp.dot(by_root, more), veil * wp.cw_mul(by_root, air)


@wp.func
def _apply_haze(x: wp.vec3f, depth: wp.float32, drops: wp.float32, settings: Floats):
    """A pixel after haze, streaks and fog."""
    rain = load(settings, WET)
    air = load3(settings, AIR, 1)
    far = _apply_veil(x, 1.0 - exp_(-RAIN * rain * depth), model.RAIN_AIR * air)
    streaked = far + (rain * drops) * (air - far)
    return _apply_veil(streaked, 1.0 - exp_(-FOG * load(settings, MIST) * depth), air)


@wp.func
def _sheen(x: wp.vec3f, mirrored: wp.vec3f, settings: Floats):
    """What a road mirrors, less its own colour."""
    return model.SHEEN_MIRROR * mirrored + model.SHEEN_AIR * load3(settings, AIR, 1) - WET_ROAD * x


@wp.kernel
def _dry_kernel(
    start: int,
    settings: Floats,
    image: Floats,
    inverse: Floats,
    sky: Floats,
    drops: Floats,
    plane: int,
    out: Floats,
):
    i = start + wp.tid()
    x = _dampen(load3(image, i, plane), load(sky, i), settings)
    store3(out, i, plane, _apply_haze(x, _haze_depth(load(inverse, i)), load(drops, i), settings))


@wp.kernel
def _wet_kernel(
    start: int,
    settings: Floats,
    image: Floats,
    inverse: Floats,
    sky: Floats,
    drops: Floats,
    plane: int,
    road: Floats,
    mirrored: Floats,
    out: Floats,
):
    i = start + wp.tid()
    depth = _haze_depth(load(inverse, i))
    x = _dampen(load3(image, i, plane), load(sky, i), settings)
    mirror = _dampen(load3(mirrored, i, plane), load(mirrored, i + 3 * plane), settings)
    share, _slope = _mirror_share(depth, settings)
    change = WET_CHANGE * x + share * _sheen(x, mirror, settings)
    wetted = x + (load(settings, WET) * load(road, i)) * change
    store3(out, i, plane, _apply_haze(wetted, depth, load(drops, i), settings))


@wp.func
def _dampen_adjoint(x: wp.vec3f, sky: wp.float32, g: wp.vec3f, settings: Floats):
    """Gradients of `_dampen` to x; to rain, time, overcast and the low sun's share (4); and to sky."""
    overcast = load(settings, OVERCAST)
    damping = model.DAMP * load(settings, WET)
    sky_gain = load3(settings, SKY_GAIN, 1)
    gain = load3(settings, GAIN, 1) + sky * sky_gain
    change = _overcast_change(x, sky, settings)
    covered = x + overcast * change
    rain = model.DAMP * wp.dot(g, _damp_change(_apply_gain(covered, gain)))
    wetted = g + damping * ((DAMP * g + DAMP_GREY * sum3(g) * LUMA) - g)
    by_gain = wp.cw_mul(wetted, covered)
    time = wp.dot(by_gain, load3(settings, GAIN_SLOPE, 1) + sky * load3(settings, SKY_GAIN_SLOPE, 1))
    low_sun = wp.dot(by_gain, load3(settings, GAIN_BY_SUN, 1))
    timed = _apply_gain(wetted, gain)
    flat = (1.0 - sky) * timed
    grey_slope = FLAT_GREY * sum3(flat) + model.COVER_STRUCTURE * sky * sum3(timed)
    out = timed + overcast * ((FLAT * flat + grey_slope * LUMA) - timed)
    g_sky = wp.dot(by_gain, sky_gain) + overcast * wp.dot(
        timed, _overcast_change(x, 1.0, settings) - _overcast_change(x, 0.0, settings)
    )
    return out, wp.vec4f(rain, time, model.OVERCAST * wp.dot(timed, change), low_sun), g_sky


@wp.func
def _haze_adjoint(
    x: wp.vec3f,
    mirrored: wp.vec3f,
    road: wp.float32,
    inverse: wp.float32,
    drops: wp.float32,
    g: wp.vec3f,
    settings: Floats,
):
    """Gradients of the wet road and `_apply_haze` to x, mirrored, fog, the other codes (4), inverse, road, drops."""
    rain = load(settings, WET)
    fog = load(settings, MIST)
    air = load3(settings, AIR, 1)
    depth = _haze_depth(inverse)
    share, slope = _mirror_share(depth, settings)
    wet = rain * road
    sheen = _sheen(x, mirrored, settings)
    change = WET_CHANGE * x + share * sheen
    wetted = x + wet * change
    clear = exp_(-RAIN * rain * depth)
    haze = model.RAIN_AIR * air
    far = _apply_veil(wetted, 1.0 - clear, haze)
    streaked = far + (rain * drops) * (air - far)
    visible = exp_(-FOG * fog * depth)

    g_far, g_fog, g_fog_air = _apply_veil_adjoint(streaked, 1.0 - visible, air, g)
    g_fogged = FOG * visible * g_fog
    g_drops = wp.dot(g_far, air - far)
    g_haze = (1.0 - rain * drops) * g_far
    g_wet, g_veil, g_haze_air = _apply_veil_adjoint(wetted, 1.0 - clear, haze, g_haze)
    g_hazed = RAIN * clear * g_veil
    g_change = wp.dot(g_wet, change)
    g_air = (
        g_fog_air + (rain * drops) * g_far + model.RAIN_AIR * g_haze_air + (model.SHEEN_AIR * wet * share) * g_wet
    )
    g_grey = wp.dot(g_air, load3(settings, AIR_BY_HAZE, 1))
    to_fog = g_fogged * depth + (1.0 - rain) * g_grey
    codes = wp.vec4f(
        g_hazed * depth + drops * g_drops + road * g_change + (1.0 - fog) * g_grey,
        wp.dot(g_air, load3(settings, AIR_BY_TIME, 1)),
        wp.dot(g_air, load3(settings, AIR_BY_OVERCAST, 1)),
        wp.dot(g_air, load3(settings, AIR_BY_SUN, 1)),
    )
    g_depth = g_fogged * fog + g_hazed * rain + wet * slope * wp.dot(g_wet, sheen)
    g_inverse = wp.where(inverse >= NEAREST, -(depth * depth) * g_depth, 0.0)
    g_x = (1.0 + wet * (WET_CHANGE - WET_ROAD * share)) * g_wet
    return (
        g_x,
        (model.SHEEN_MIRROR * wet * share) * g_wet,
        to_fog,
        codes,
        g_inverse,
        rain * g_change,
        rain * g_drops,
    )


@wp.func
def _store4(planes: Floats, i: int, plane: int, values: wp.vec4f):
    """Store four values at pixel i of as many planes."""
    store3(planes, i, plane, wp.vec3f(values[0], values[1], values[2]))
    store(planes, i + 3 * plane, values[3])


@wp.kernel
def _dry_adjoint_kernel(
    start: int,
    settings: Floats,
    image: Floats,
    inverse: Floats,
    sky: Floats,
    drops: Floats,
    plane: int,
    grad: Floats,
    grad_image: Floats,
    grad_inverse: Floats,
    code_parts: Floats,
    grad_maps: Floats,
):
    """code_parts: each pixel's part of the gradients to the `CODES`, one plane each; grad_maps: to sky, road
    and drops, likewise.
    """
    i = start + wp.tid()
    colour = load3(image, i, plane)
    sky_share = load(sky, i)
    x = _dampen(colour, sky_share, settings)
    g, _mirrored, to_fog, codes, g_inverse, _road, g_drops = _haze_adjoint(
        x, x, 0.0, load(inverse, i), load(drops, i), load3(grad, i, plane), settings
    )
    g_colour, parts, g_sky = _dampen_adjoint(colour, sky_share, g, settings)
    store3(grad_image, i, plane, g_colour)
    store(grad_inverse, i, g_inverse)
    store(code_parts, i, to_fog)
    _store4(code_parts, i + plane, plane, codes + parts)
    store(grad_maps, i, g_sky)
    store(grad_maps, i + plane, 0.0)
    store(grad_maps, i + 2 * plane, g_drops)


@wp.kernel
def _wet_adjoint_kernel(
    start: int,
    settings: Floats,
    image: Floats,
    inverse: Floats,
    sky: Floats,
    drops: Floats,
    plane: int,
    grad: Floats,
    road: Floats,
    mirrored: Floats,
    grad_mirrored: Floats,
    grad_image: Floats,
    grad_inverse: Floats,
    code_parts: Floats,
    grad_maps: Floats,
):
    i = start + wp.tid()
    colour = load3(image, i, plane)
    sky_share = load(sky, i)
    mirror_colour = load3(mirrored, i, plane)
    mirror_sky = load(mirrored, i + 3 * plane)
    g, g_mirror, to_fog, codes, g_inverse, g_road, g_drops = _haze_adjoint(
        _dampen(colour, sky_share, settings),
        _dampen(mirror_colour, mirror_sky, settings),
        load(road, i),
        load(inverse, i),
        load(drops, i),
        load3(grad, i, plane),
        settings,
    )
    g_colour, parts, g_sky = _dampen_adjoint(colour, sky_share, g, settings)
    g_mirrored, mirror_parts, g_mirror_sky = _dampen_adjoint(mirror_colour, mirror_sky, g_mirror, settings)
    store3(grad_image, i, plane, g_colour)
    store3(grad_mirrored, i, plane, g_mirrored)
    store(grad_mirrored, i + 3 * plane, g_mirror_sky)
    store(grad_inverse, i, g_inverse)
    store(code_parts, i, to_fog)
    _store4(code_parts, i + plane, plane, codes + parts + mirror_parts)
    store(grad_maps, i, g_sky)
    store(grad_maps, i + plane, g_road)
    store(grad_maps, i + 2 * plane, g_drops)


def _rows(values: Tensor, above: float) -> tuple[int, int]:
    """Rows [top, bottom) of a map (H, W) that hold all values above a number."""
    rows = (values.amax(dim=1) > above).nonzero()[:, 0]
    return (int(rows[0]), int(rows[-1]) + 1) if rows.numel() else (0, 0)


def _ranges(first: int, last: int) -> list[int]:
    return [first + edge for edge in split_range(last - first)]


class _ScratchMemory(threading.local):
    """Temporary memory: allocating it on every call would cost the CPU more than writing to it."""

    def __init__(self) -> None:
        self._room = torch.empty(0)

    def planes(self, like: Tensor, *sizes: int) -> list[Tensor]:
        """Float32 vectors of these sizes, valid until the next call."""
        if like.is_cuda:  # torch caches memory per stream there
            return [like.new_empty(size) for size in sizes]
        if self._room.numel() < sum(sizes):
            self._room = torch.empty(sum(sizes))
        return list(self._room[: sum(sizes)].split(sizes))


_scratch = _ScratchMemory()


class _Weather(torch.autograd.Function):
    """Weather over image (3, H, W) at inverse depth (H, W); code (5,), air (3,), camera (1,); sky, road, drops
    (H, W); mirrored (4, H, W) or None.
    """

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        inverse: Tensor,
        code: Tensor,
        air: Tensor,
        camera: Tensor,
        sky: Tensor,
        road: Tensor,
        drops: Tensor,
        mirrored: Tensor | None,
    ) -> Tensor:
        height, width = image.shape[1:]
        settings, out = image.new_empty(SETTINGS), image.new_empty(image.shape)
        if mirrored is None:
            top, bottom, mirrored = 0, 0, image.new_empty(0)
        else:  # finding the road would make the CPU wait for a GPU
            top, bottom = (0, height) if road.is_cuda else _rows(road, 0.0)
        saved = [t.detach().contiguous() for t in (image, inverse, sky, drops, road, mirrored)]
        settings_in = flat_array(settings)
        constants = [flat_array(t) for t in (code, air, camera)]
        launch(_settings_kernel, [0, 3], [*constants, settings_in])
        *inputs, road_in, mirrored_in = (flat_array(t) for t in saved)
        inputs = [settings_in, *inputs, height * width]
        for first, last in ((0, top), (bottom, height)):
            launch(_dry_kernel, _ranges(first * width, last * width), [*inputs, flat_array(out)])
        through = [road_in, mirrored_in, flat_array(out)]
        launch(_wet_kernel, _ranges(top * width, bottom * width), [*inputs, *through])
        ctx.save_for_backward(*saved, settings)
        ctx.rows = (top, bottom)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        top, bottom = ctx.rows
        image, inverse, _, _, _, mirrored, _ = ctx.saved_tensors
        *inputs, road_in, mirrored_in, settings_in = (flat_array(t) for t in ctx.saved_tensors)
        height, width = inverse.shape
        plane = height * width
        grad_image, grad_inverse = torch.empty_like(image), torch.empty_like(inverse)
        grad_maps, grad_mirrored = image.new_empty(3, height, width), torch.zeros_like(mirrored)
        parts = _scratch.planes(image, CODES * plane)[0]
        inputs = [settings_in, *inputs, plane, flat_array(grad.contiguous())]
        outputs = [flat_array(t) for t in (grad_image, grad_inverse, parts, grad_maps)]
        for first, last in ((0, top), (bottom, height)):
            launch(_dry_adjoint_kernel, _ranges(first * width, last * width), [*inputs, *outputs])
        through = [road_in, mirrored_in, flat_array(grad_mirrored)]
        launch(_wet_adjoint_kernel, _ranges(top * width, bottom * width), [*inputs, *through, *outputs])
        grad_code = _sum_rows_first(parts.view(CODES, height, width))
        to_mirrored = grad_mirrored if mirrored.numel() else None
        return grad_image, grad_inverse, grad_code, None, None, *grad_maps, to_mirrored


def _sum_rows_first(code_parts: Tensor) -> Tensor:
    """Sums (K,) of planes (K, H, W), rows first, so that they do not depend on the number of threads."""
    return code_parts.sum(dim=2).sum(dim=1)


ODDS, CHROMA, COS, SIN, RED, YELLOW, THICKER, THINNER, TURN_SLOPE, THICKER_SLOPE, THINNER_SLOPE = range(11)
LEAF_SETTINGS = 11
"""Indices of the settings, equal for all leaves, and their count: factor of the odds of lightness; of chroma;
cosine and sine of the turn of hue; shift of a* and b*; thicker and thinner; slopes of the turn along hue, of
thicker and thinner along density.
"""


@wp.kernel
def _leaf_settings_kernel(start: int, code: Floats, settings: Floats):
    """Thread 0 for the code, thread 1 for no change."""
    t = start + wp.tid()
    on = wp.float64(1 - t)
    one = wp.float64(1.0)
    hue = on * wp.float64(code[0])
    density = on * wp.float64(code[2])
    bend = wp.tanh(wp.float64(model.LEAF_TURN_BEND) * hue)
    rate = wp.float64(model.LEAF_TURN) + wp.float64(model.LEAF_TURN_MORE) * bend
    rate_slope = wp.float64(LEAF_TURN_SLOPE) * (one - bend * bend)
    thick = one / (one + wp.exp(wp.float64(-model.CROWN_BEND) * density))
    steep = wp.float64(model.CROWN_BEND) * density * thick * (one - thick)
    first = t * LEAF_SETTINGS
    settings[first + ODDS] = wp.float32(wp.exp(on * wp.float64(model.LEAF_LIGHTNESS) * wp.float64(code[1])))
    settings[first + CHROMA] = wp.float32(one + wp.float64(model.LEAF_CHROMA) * hue)
    settings[first + COS] = wp.float32(wp.cos(-rate * hue))
    settings[first + SIN] = wp.float32(wp.sin(-rate * hue))
    settings[first + RED] = wp.float32(wp.float64(model.LEAF_RED) * hue)
    settings[first + YELLOW] = wp.float32(wp.float64(model.LEAF_YELLOW) * hue)
    settings[first + THICKER] = wp.float32(density * thick)
    settings[first + THINNER] = wp.float32(-density * (one - thick))
    settings[first + TURN_SLOPE] = wp.float32(-rate - rate_slope * hue)
    settings[first + THICKER_SLOPE] = wp.float32(thick + steep)
    settings[first + THINNER_SLOPE] = wp.float32(thick - one + steep)


@wp.func
def _leaf_lab(lab: wp.vec3f, settings: Floats, at: int):
    """The leaf model without density: L*a*b*."""
    _dampen = lightness_level(lab[0])
    odds = load(settings, at + ODDS)
    level = scale_odds(_dampen, odds)
    chroma = load(settings, at + CHROMA) * wp.sqrt(odds / (_dampen * odds + (1.0 - _dampen)))
    cos = load(settings, at + COS)
    sin = load(settings, at + SIN)
    room = 4.0 * level * (1.0 - level)
    red = chroma * (cos * lab[1] - sin * lab[2]) + load(settings, at + RED) * room
    yellow = chroma * (sin * lab[1] + cos * lab[2]) + load(settings, at + YELLOW) * room
    return wp.vec3f(100.0 * level, red, yellow)


@wp.struct
class CrownPixel:
    """One pixel of `environment.compute_crown_maps`."""

    thinned: wp.float32
    thickened: wp.float32
    behind: wp.vec3f


@wp.func
def _read_crown(crowns: Floats, i: int, plane: int):
    """crowns: five planes: thinned, thickened, behind (3)."""
    at = CrownPixel()
    at.thinned = load(crowns, i)
    at.thickened = load(crowns, plane + i)
    at.behind = load3(crowns, 2 * plane + i, plane)
    return at


@wp.func
def _apply_crown(rgb: wp.vec3f, at: CrownPixel, settings: Floats, first: int):
    """Leaves in a thicker or thinner crown."""
    dense = (1.0 - THICK * load(settings, first + THICKER) * at.thickened) * rgb
    return dense + (model.THIN_SHARE * load(settings, first + THINNER) * at.thinned) * (at.behind - dense)


@wp.func
def _leaf_adjoint(lab: wp.vec3f, crown: CrownPixel, g: wp.vec3f, settings: Floats, at: int):
    """Gradients to lab and to hue, lightness and density (3)."""
    changed = _leaf_lab(lab, settings, at)
    rgb = lab_to_rgb(changed)
    keep = 1.0 - THICK * load(settings, at + THICKER) * crown.thickened
    through = model.THIN_SHARE * load(settings, at + THINNER) * crown.thinned
    g_thin = model.THIN_SHARE * crown.thinned * wp.dot(g, crown.behind - keep * rgb)
    g_dense = (1.0 - through) * g
    g_thick = -THICK * crown.thickened * wp.dot(g_dense, rgb)
    g_lab = lab_to_rgb_adjoint(changed, keep * g_dense)

    _dampen = lightness_level(lab[0])
    odds = load(settings, at + ODDS)
    bottom = _dampen * odds + (1.0 - _dampen)
    level = _dampen * odds / bottom
    root = wp.sqrt(odds / bottom)
    chroma = load(settings, at + CHROMA) * root
    cos = load(settings, at + COS)
    sin = load(settings, at + SIN)
    along = g_lab[1] * (cos * lab[1] - sin * lab[2]) + g_lab[2] * (sin * lab[1] + cos * lab[2])
    across = g_lab[2] * (cos * lab[1] - sin * lab[2]) - g_lab[1] * (sin * lab[1] + cos * lab[2])
    room = 4.0 * level * (1.0 - level)
    shift = load(settings, at + RED) * g_lab[1] + load(settings, at + YELLOW) * g_lab[2]
    g_level = 100.0 * g_lab[0] + 4.0 * (1.0 - 2.0 * level) * shift
    g_odds = g_level * level * (1.0 - level) + 0.5 * along * chroma * (1.0 - level)
    g_before = g_level * odds / (bottom * bottom) - 0.5 * along * chroma * (odds - 1.0) / bottom
    tint = model.LEAF_RED * g_lab[1] + model.LEAF_YELLOW * g_lab[2]
    code = wp.vec3f(
        model.LEAF_CHROMA * root * along + load(settings, at + TURN_SLOPE) * chroma * across + tint * room,
        model.LEAF_LIGHTNESS * g_odds,
        load(settings, at + THICKER_SLOPE) * g_thick + load(settings, at + THINNER_SLOPE) * g_thin,
    )
    out = wp.vec3f(
        0.01 * clamp_slope(lab[0] * 0.01, LEVEL_LOW, LEVEL_HIGH) * g_before,
        chroma * (cos * g_lab[1] + sin * g_lab[2]),
        chroma * (cos * g_lab[2] - sin * g_lab[1]),
    )
    return out, code


@wp.func
def _leaf_share(amount: wp.float32):
    return wp.where(amount > model.FEWEST_LEAVES, amount, 0.0)


@wp.kernel
def _foliage_kernel(
    start: int,
    settings: Floats,
    code: Floats,
    image: Floats,
    amount: Floats,
    crowns: Floats,
    plane: int,
    out: Floats,
):
    i = start + wp.tid()
    own = load3(image, i, plane)
    crown = _read_crown(crowns, i, plane)
    lab = rgb_to_lab(clamp01(own))
    now = _apply_crown(lab_to_rgb(_leaf_lab(lab, settings, 0)), crown, settings, 0)
    then = _apply_crown(lab_to_rgb(_leaf_lab(lab, settings, LEAF_SETTINGS)), crown, settings, LEAF_SETTINGS)
    size = wp.abs(load(code, 0)) + wp.abs(load(code, 1)) + wp.abs(load(code, 2))
    share = wp.where(size > 0.0, _leaf_share(load(amount, i)), 0.0)
    store3(out, i, plane, own + share * (now - then))


@wp.kernel
def _foliage_code_kernel(
    start: int,
    settings: Floats,
    image: Floats,
    amount: Floats,
    crowns: Floats,
    plane: int,
    grad: Floats,
    first: int,
    wet_pixels: int,
    code_parts: Floats,
):
    """shares: each pixel's part of the gradient to the code, planes of `wet_pixels` numbers, from pixel `first`
    on.
    """
    i = start + wp.tid()
    g = _leaf_share(load(amount, i)) * load3(grad, i, plane)
    _lab, code = _leaf_adjoint(
        rgb_to_lab(clamp01(load3(image, i, plane))), _read_crown(crowns, i, plane), g, settings, 0
    )
    store3(code_parts, i - first, wet_pixels, code)


@wp.kernel
def _foliage_image_kernel(
    start: int,
    settings: Floats,
    image: Floats,
    amount: Floats,
    crowns: Floats,
    plane: int,
    grad: Floats,
    grad_image: Floats,
):
    i = start + wp.tid()
    own = load3(image, i, plane)
    g = load3(grad, i, plane)
    rgb = clamp01(own)
    lab = rgb_to_lab(rgb)
    part = _leaf_share(load(amount, i)) * g
    crown = _read_crown(crowns, i, plane)
    now, _code = _leaf_adjoint(lab, crown, part, settings, 0)
    then, _none = _leaf_adjoint(lab, crown, part, settings, LEAF_SETTINGS)
    store3(grad_image, i, plane, g + clamp01_adjoint(own, rgb_to_lab_adjoint(rgb, now - then)))


class _Foliage(torch.autograd.Function):
    """Leaves of image (3, H, W); code (3,); amount (H, W); crowns (5, H, W)."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, code: Tensor, amount: Tensor, crowns: Tensor) -> Tensor:
        height, width = image.shape[1:]
        plane = height * width
        top, bottom = (0, height) if image.is_cuda else _rows(amount, model.FEWEST_LEAVES)
        saved_maps = [t.detach().contiguous() for t in (image, amount, crowns)]
        settings = image.new_empty(2 * LEAF_SETTINGS)
        out = saved_maps[0].clone()
        settings_in, own_code, maps = flat_array(settings), flat_array(code), [flat_array(t) for t in saved_maps]
        launch(_leaf_settings_kernel, [0, 2], [own_code, settings_in])
        inputs = [settings_in, own_code, *maps, plane]
        launch(_foliage_kernel, _ranges(top * width, bottom * width), [*inputs, flat_array(out)])
        ctx.save_for_backward(*saved_maps, settings)
        ctx.rows = (top, bottom)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        top, bottom = ctx.rows
        image, _, _, settings = ctx.saved_tensors
        height, width = image.shape[1:]
        first, last = top * width, bottom * width
        grad = grad.contiguous()
        inputs = [
            flat_array(settings),
            *(flat_array(t) for t in ctx.saved_tensors[:3]),
            height * width,
            flat_array(grad),
        ]
        grad_image = grad_code = None
        if ctx.needs_input_grad[0]:
            grad_image = grad.clone()
            launch(_foliage_image_kernel, _ranges(first, last), [*inputs, flat_array(grad_image)])
        if ctx.needs_input_grad[1]:
            (code_parts,) = _scratch.planes(image, 3 * (last - first))
            inputs = [*inputs, first, last - first, flat_array(code_parts)]
            launch(_foliage_code_kernel, _ranges(first, last), inputs)
            grad_code = _sum_rows_first(code_parts.view(3, bottom - top, width))
        return grad_image, grad_code, None, None


def apply_weather(
    image: Tensor,
    inverse: Tensor,
    weather: Tensor,
    air: Tensor,
    environment: Environment,
    mirrored: Tensor | None,
    drops: Tensor,
) -> Tensor:
    """See `environment.apply_weather`; float32, the airlight constant."""
    sky, road, ground = (getattr(environment, name).to(image) for name in ("sky", "road", "ground"))
    return _Weather.apply(
        image, inverse, weather, air.to(image).detach(), ground[3:].detach(), sky, road, drops, mirrored
    )


def apply_foliage(image: Tensor, environment: Environment, crowns: Tensor) -> Tensor:
    """See `environment.apply_foliage`; float32.

    Args:
        image, environment: As there.
        crowns: (5, H, W).
    """
    code, amount = environment.foliage.to(image), environment.foliage_map.to(image)
    return _Foliage.apply(image, code, amount, crowns.to(image))
