# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportReturnType=false
# ruff: noqa: E501, UP018, SIM102, SIM109, RUF046 - the line above; Warp needs int(0) to declare what a loop changes, and evaluates
# both sides of `and`, so that a cheap test first saves time only as an `if` of its own.
"""Shadow maps, shading, camera as Warp kernels.

Each function here follows the numpy function of the same name in `tests/drivesem/synth/reference_*.py`, which defines
it, with the same constants in the same order; a test holds both together. Rows and pixels are dealt out to the threads, so the result does not depend on their number.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp

from drivesem.synth import lamps
from drivesem.synth.layout import Road
from drivesem.synth.light import (
    LEAF_DEPTH_M,
    MIRRORED_GROUND,
    PANORAMA_GLARE,
    SHADOW_OFFSET_M,
    SHADOW_OFFSET_TEXELS,
    SLUSH_PATCHES,
    SLUSH_RGB,
    SLUSH_SHARE,
    SOAKED,
    Light,
    Response,
    develop,
    ground_light,
)
from drivesem.synth.soup import GROUND, Material, Semantic, Soup
from drivesem.synth.view import (
    BYTE_SUM_SCALE,
    LAMP_NUMBERS,
    SIZE,
    NoiseSet,
    Setting,
    Shadow,
    Sight,
    SunMaps,
    fine_matrix,
)
from scene_ir.raster.launch import launch, split_range, start_warp, threads
from scene_ir.raster.simd import SIMD_OPTIONS, exp_, load, log_
from scene_ir.raster.verbs import NEAR_M

start_warp()
wp.set_module_options(SIMD_OPTIONS)

Floats = wp.array(dtype=wp.float32)
Ints = wp.array(dtype=wp.int32)
Longs = wp.array(dtype=wp.int64)
Bytes = wp.array(dtype=wp.uint8)
Vec2s = wp.array(dtype=wp.vec2f)
Vec3s = wp.array(dtype=wp.vec3f)
Vec4s = wp.array(dtype=wp.vec4f)

FOLD, UNFOLD = wp.constant(wp.float32(1.0 / SIZE)), wp.constant(wp.float32(SIZE))
LAST = wp.constant(wp.float32(SIZE - 1e-3))
STRIDE = wp.constant(SIZE + 1)
BYTES = wp.constant(wp.float32(BYTE_SUM_SCALE))
LEAF_DEPTH, OFFSET, PER_TEXEL = (
    wp.constant(wp.float32(v)) for v in (LEAF_DEPTH_M, SHADOW_OFFSET_M, SHADOW_OFFSET_TEXELS)
)
GLARE = wp.constant(wp.float32(PANORAMA_GLARE))
SLUSH, SLUSHY, PATCHES = (
    wp.constant(wp.vec3f(*SLUSH_RGB)),
    *(wp.constant(wp.float32(v)) for v in (SLUSH_SHARE, SLUSH_PATCHES)),
)
PI = wp.constant(wp.float32(np.pi))
INFINITE = wp.constant(wp.float32(np.inf))
CURVE, BRIGHTEST = 2048, 16.0
"""Steps of the table of display values, and the radiance at its end: all above is white."""
WHITE, PER_ROOT = wp.constant(wp.float32(BRIGHTEST)), wp.constant(wp.float32(CURVE / BRIGHTEST**0.5))
TABLE = 22
"""Numbers a face in `Scene.table`: three rows for the normal, two for the surface coordinates, albedo, pattern."""
COLUMNS = wp.constant(TABLE)
SLIVER = wp.constant(wp.float64(1e-9))
"""Triangles smaller than this, px squared, are seen edge-on."""
NEAR = wp.constant(wp.float64(NEAR_M))
RIM = wp.constant(wp.float32(0.5))
"""So far from the border of the near shadow map, m, nobody looks into the far one: more than its soft edges reach."""

LAMP = wp.constant(LAMP_NUMBERS)
STREET, BEAM = wp.constant(wp.float32(lamps.STREET)), wp.constant(wp.float32(lamps.BEAM))
BEAM_WIDE, BEAM_CUT, BEAM_EDGE, BEAM_DOWN, BEAM_FLOOD, FLOOD_WIDE, BEAM_STRAY = (
    wp.constant(wp.float32(v))
    for v in (
        *(lamps.BEAM_WIDE, lamps.BEAM_CUT, lamps.BEAM_EDGE, lamps.BEAM_DOWN),
        *(lamps.BEAM_FLOOD, lamps.FLOOD_WIDE, lamps.BEAM_STRAY),
    )
)
RETRO, RETRO_RAD, ROUGH, LAMP_SIZE = (
    wp.constant(wp.float32(v)) for v in (lamps.RETRO, lamps.RETRO_RAD, lamps.ROUGH, lamps.LAMP_SIZE_M)
)
WET_ROUGH, PUDDLE_ROUGH, COAT_ROUGH, BRIGHTEST_GLINT = (
    wp.constant(wp.float32(v))
    for v in (lamps.WET_ROUGH, lamps.PUDDLE_ROUGH, lamps.COAT_ROUGH, lamps.BRIGHTEST_GLINT)
)
WARM, COOL = (wp.constant(wp.vec3f(*rgb)) for rgb in (lamps.WINDOW_RGB, lamps.WINDOW_COOL))
WINDOW_FROM, WINDOW_SLOPE = (wp.constant(wp.float32(v)) for v in (lamps.WINDOW_FROM, lamps.WINDOW_SLOPE))
M_SKY, M_ROAD, M_PARKING, M_PAVEMENT, M_KERB, M_GRASS, M_GRAVEL = (wp.constant(int(m)) for m in list(Material)[:7])
M_FACADE, M_ROOF, M_WALL, M_FENCE, M_LEAF, M_BARK, M_METAL = (wp.constant(int(m)) for m in list(Material)[7:14])
M_FLAT, M_PAINT, M_GLASS, M_TYRE, M_LIGHT, M_TRIM = (wp.constant(int(m)) for m in list(Material)[14:20])
S_SKY = wp.constant(wp.uint8(Semantic.SKY))

vec22 = wp.types.vector(length=TABLE, dtype=wp.float32)


@wp.struct
class Noise:
    """The textures of `NoiseSet`, flat."""

    soft: Floats
    rough: Floats
    grain: Floats


@wp.struct
class Air:
    """`Light`, and what follows from it. right, forward: azimuths 90 degrees and 0. lamps: `Setting.lamps`, flat."""

    sun: wp.vec3f
    up: wp.vec3f
    right: wp.vec3f
    forward: wp.vec3f
    sun_colour: wp.vec3f
    zenith: wp.vec3f
    horizon: wp.vec3f
    ambient: wp.vec3f
    bounce: wp.vec3f
    town: wp.vec3f
    tarmac: wp.vec3f
    haze: wp.float32
    clouds: wp.float32
    cloud_seed: wp.float32
    wet: wp.float32
    snow: wp.float32
    fog: wp.int32
    panorama: Floats
    panorama_height: wp.int32
    panorama_width: wp.int32
    panorama_turn: wp.float32
    night: wp.float32
    lamps: Floats
    lamp_count: wp.int32


@wp.struct
class StreetMarkings:
    """Markings (middle, width, dash, period), the crossing (from, to; from > to: none), d from which on its stop line
    lies, and `SOAKED` by material."""

    markings: Vec4s
    count: wp.int32
    crossing: wp.vec2f
    own_side: wp.float32
    soaked: Vec3s


@wp.struct
class Lens:
    """The view. ray (3 x 3): fine pixels to rays. axes (3 x 3), origin: camera to world. develop: exposure and white
    balance; curve: see `apply_tone_curve`."""

    ray: wp.mat33f
    axes: wp.mat33f
    origin: wp.vec3f
    centre: wp.vec3f
    focal: wp.float32
    height_m: wp.float32
    width: wp.int32
    develop: wp.vec3f
    curve: Floats


@wp.struct
class PixelArrays:
    """What each fine pixel shows, flat, and the faces' numbers."""

    table: Floats
    face: Ints
    depth: Floats
    material: Bytes
    owner: Ints
    ground: Bytes


@wp.struct
class Shade:
    """Shadow maps, flat, and footprints that hide the sky: rows of x, z, reach in all, cos, sin, half sizes, reach."""

    rows: wp.mat33f
    shift: wp.vec3f
    depth: Floats
    near: wp.vec4f
    far: wp.vec4f
    texels: wp.int32
    sunny: wp.int32
    prints: wp.array2d(dtype=wp.float32)


@wp.struct
class Spot:
    """One sample: the reference's `Samples`. retro: 1 where it sends light back to its source, else 0; rough: 1 for
    ground, else 0."""

    point: wp.vec3f
    world: wp.vec3f
    normal: wp.vec3f
    u: wp.float32
    v: wp.float32
    albedo: wp.vec3f
    pattern: wp.vec4f
    lit: wp.float32
    open_sky: wp.float32
    pixel_m: wp.float32
    along_px: wp.float32
    retro: wp.float32
    rough: wp.float32
    owner: wp.float32


# ------------------------------------------------------------------------------------------------------- noise, light


@wp.func
def saturate(x: float):
    return wp.min(wp.max(x, 0.0), 1.0)


@wp.func
def power(x: float, exponent: float):
    """x ** exponent of x >= 0."""
    return wp.where(x > 1e-30, exp_(log_(wp.max(x, 1e-30)) * exponent), 0.0)


@wp.func
def noise(texture: Floats, u: float, v: float, per_m: float):
    x = u * per_m * FOLD
    y = v * per_m * FOLD
    x = wp.min((x - wp.floor(x)) * UNFOLD, LAST)
    y = wp.min((y - wp.floor(y)) * UNFOLD, LAST)
    column = wp.int32(x)
    row = wp.int32(y)
    across = x - float(column)
    down = y - float(row)
    at = row * STRIDE + column
    upper = load(texture, at) * (1.0 - across) + load(texture, at + 1) * across
    lower = load(texture, at + STRIDE) * (1.0 - across) + load(texture, at + STRIDE + 1) * across
    return upper * (1.0 - down) + lower * down


@wp.func
def texel(pixels: Floats, i: int):
    return wp.vec3f(load(pixels, 3 * i), load(pixels, 3 * i + 1), load(pixels, 3 * i + 2))


@wp.func
def panorama_radiance(air: Air, direction: wp.vec3f):
    azimuth = wp.atan2(wp.dot(direction, air.right), wp.dot(direction, air.forward)) - air.panorama_turn
    elevation = wp.asin(saturate(wp.dot(direction, air.up)))
    turn = azimuth * (0.5 / PI) + 0.5
    x = (turn - wp.floor(turn)) * float(air.panorama_width) - 0.5
    y = wp.max((0.5 - elevation * (1.0 / PI)) * float(air.panorama_height) - 0.5, 0.0)
    column = wp.int32(wp.floor(x))
    row = wp.int32(wp.floor(y))
    across = x - float(column)
    down = y - float(row)
    left = wp.where(column < 0, air.panorama_width - 1, column)
    right = wp.where(column + 1 >= air.panorama_width, 0, column + 1)
    first = row * air.panorama_width
    second = wp.min(row + 1, air.panorama_height - 1) * air.panorama_width
    upper = texel(air.panorama, first + left) * (1.0 - across) + texel(air.panorama, first + right) * across
    lower = texel(air.panorama, second + left) * (1.0 - across) + texel(air.panorama, second + right) * across
    return upper * (1.0 - down) + lower * down


@wp.func
def gradient(air: Air, height: float):
    blend = wp.sqrt(saturate(height))
    return air.horizon * (1.0 - blend) + air.zenith * blend


@wp.func
def sky_radiance(air: Air, textures: Noise, direction: wp.vec3f):
    if air.panorama_width > 0:
        return panorama_radiance(air, direction)
    height = saturate(wp.dot(direction, air.up))
    colour = gradient(air, height)
    if air.clouds > 0.0:
        reach = 60.0 / wp.max(height + 0.09, 0.09)
        x = wp.dot(direction, air.right) * reach + air.cloud_seed
        field = noise(textures.soft, x, wp.dot(direction, air.forward) * reach, 1.0)
        cover = saturate((field - 1.6 + 2.6 * air.clouds) * 0.6) * wp.min(air.clouds * 1.4, 1.0)
        white = air.horizon * (1.15 + 0.1 * wp.clamp(field, -1.5, 1.5))
        colour += (white - colour) * cover
    glow = saturate(wp.dot(direction, air.sun))
    glow *= glow
    glow *= glow
    glow *= glow
    return colour + air.sun_colour * (0.9 * glow * glow * glow)


@wp.func
def reflected_radiance(air: Air, textures: Noise, direction: wp.vec3f, soft: bool):
    height = wp.dot(direction, air.up)
    sky = wp.vec3f()
    if air.panorama_width > 0:
        seen = panorama_radiance(air, direction)
        sky = wp.vec3f(wp.min(seen[0], GLARE), wp.min(seen[1], GLARE), wp.min(seen[2], GLARE))
    else:
        sky = gradient(air, height)
    azimuth = wp.atan2(wp.dot(direction, air.right), wp.dot(direction, air.forward))
    ridge = 0.20 + 0.09 * noise(textures.soft, azimuth * 81.4872 + air.cloud_seed, height * 20.0, 1.0)
    sharpness = float(12.0)
    if soft:
        ridge *= 0.7
        sharpness = 5.0
    above = saturate((height - ridge) * sharpness + 0.5)
    below = saturate(-height * 14.0 + 0.5)
    return (sky * above + air.town * (1.0 - above)) * (1.0 - below) + air.tarmac * below


@wp.func
def apply_tone_curve(x: float, curve: Floats):
    """`light.develop` of a radiance x, exposed and white, by a table over the root of x."""
    place = wp.sqrt(wp.min(wp.max(x, 0.0), WHITE)) * PER_ROOT
    i = wp.int32(place)
    share = place - float(i)
    return load(curve, i) * (1.0 - share) + load(curve, i + 1) * share


# ---------------------------------------------------------------------------------------------------------- materials


@wp.func
def fade(pixel_m: float, per_detail: float):
    return saturate(1.4 - pixel_m * per_detail)


@wp.func
def fraction(x: float):
    return x - wp.floor(x)


@wp.func
def pulse(x: float, period: float, share: float, blur: float):
    phase = wp.abs(fraction(x / period) - 0.5) * period
    soft = wp.max(blur, 1e-4)
    sharp = saturate((share * period * 0.5 - phase) / soft + 0.5)
    melt = saturate(soft / period * 2.0 - 0.5)
    return sharp * (1.0 - melt) + share * melt


@wp.func
def paint_road(s: Spot, street: StreetMarkings, textures: Noise):
    d = s.u
    q = s.v
    x = d + s.pattern[0]
    tone = 1.0 + 0.09 * noise(textures.soft, x, q * 0.4, 1.0 / 0.08)
    near = fade(s.pixel_m, 1.0 / 0.15)
    if near > 0.0:
        tone += 0.06 * noise(textures.rough, x * 1.5, q * 0.12 + s.pattern[0], 1.0 / 0.03) * near
    near = fade(s.along_px, 1.0 / 0.05)
    if near > 0.0:
        tone += 0.17 * noise(textures.grain, x, q, 1.0 / 0.012) * near
    near = fade(s.along_px, 1.0 / 0.2)
    if near > 0.0:
        tone += 0.10 * noise(textures.grain, x, q, 1.0 / 0.05) * near
    patch = noise(textures.soft, x * 0.7 + 91.0, q * 0.25 + 37.0, 1.0 / 0.05)
    tone *= 1.0 - 0.22 * saturate((patch - 1.35) * 6.0)
    near = fade(s.along_px, 1.0 / 0.12)
    if near > 0.0:
        crack = wp.abs(noise(textures.soft, x + 13.0, q * 0.8 + 7.0, 1.0 / 0.035))
        tone *= 1.0 - 0.35 * saturate(1.0 - crack * 26.0) * near
    tone *= 1.0 + 0.035 * wp.cos(d * (2.0 * PI / 1.7))
    albedo = s.albedo * wp.max(tone, 0.2)
    cover = float(0.0)
    for i in range(street.count):
        line = street.markings[i]
        away = wp.abs(d - line[0])
        if away < line[1] + 0.3:
            across = saturate((line[1] / 2.0 - away) / s.pixel_m + 0.5) * wp.min(line[1] / s.pixel_m, 1.0)
            if across > 0.0:
                if line[2] < line[3]:
                    across *= pulse(q, line[3], line[2] / line[3], s.along_px)
                cover = wp.max(cover, across)
    if street.crossing[0] < street.crossing[1]:
        if d < 200.0:
            if q > street.crossing[0] - 1.2:
                if q < street.crossing[1] + 1.2:
                    cover = 0.0
            if d > street.own_side:
                thick = wp.max(s.along_px, 1e-3)
                bar = saturate((0.25 - wp.abs(q - (street.crossing[0] - 1.6))) / thick + 0.5)
                cover = wp.max(cover, bar * wp.min(0.5 / thick, 1.0))
    if cover > 0.0:
        cover *= wp.clamp(0.75 + 0.28 * noise(textures.rough, x, q, 1.0 / 0.02), 0.25, 1.0)
        albedo += (wp.vec3f(0.62, 0.62, 0.60) - albedo) * cover
    return albedo


@wp.func
def paint_slabs(s: Spot, textures: Noise, size_m: float, joint_m: float):
    u = s.u + fraction(s.pattern[0])
    v = s.v
    tone = 1.0 + 0.10 * noise(textures.soft, u, v, 1.0 / 0.06)
    near = fade(s.along_px, 1.0 / 0.08)
    if near > 0.0:
        tone += 0.12 * noise(textures.grain, u, v, 1.0 / 0.02) * near
    near = fade(s.along_px, 1.0 / size_m)
    if near > 0.0:
        tone += 0.07 * near * noise(textures.grain, wp.floor(u / size_m) * 3.7, wp.floor(v / size_m) * 5.3, 1.0)
    near = fade(s.along_px, 1.0 / (size_m * 0.7))
    if near > 0.0:
        share = 1.0 - joint_m / size_m
        joints = 1.0 - pulse(u, size_m, share, wp.max(s.pixel_m, 0.008)) * pulse(v, size_m, share, s.along_px)
        tone *= 1.0 - 0.45 * joints * near
    return s.albedo * wp.max(tone, 0.2)


@wp.func
def paint_grass(s: Spot, textures: Noise):
    u = s.world[0] + s.pattern[0]
    v = s.world[2]
    tone = 1.0 + 0.16 * noise(textures.soft, u, v, 1.0 / 0.08)
    near = fade(s.along_px, 1.0 / 0.3)
    if near > 0.0:
        tone += 0.30 * noise(textures.rough, u, v * 0.6, 1.0 / 0.035) * near
    near = fade(s.along_px, 1.0 / 0.08)
    if near > 0.0:
        tone += 0.30 * noise(textures.grain, u, v * 0.5, 1.0 / 0.02) * near
    dry = wp.clamp(0.25 + 0.3 * noise(textures.soft, u + 50.0, v, 1.0 / 0.05), 0.0, 0.8)
    albedo = s.albedo * (1.0 - dry) + wp.vec3f(0.16, 0.135, 0.07) * dry
    return albedo * wp.max(tone, 0.25)


@wp.func
def fifth(x: float):
    return x * x * x * x * x


@wp.func
def beam_share(ahead: float, rise: float):
    """`lamps.beam_share` of a direction by its cosines to the beam's axis and to the vertical."""
    aside = wp.sqrt(wp.max(1.0 - ahead * ahead - rise * rise, 0.0)) / wp.max(ahead, 1e-3)
    below = saturate((-rise - BEAM_CUT) / BEAM_EDGE + 0.5)
    narrow = aside / BEAM_WIDE
    wide = aside / FLOOD_WIDE
    core = exp_(-narrow * narrow - wp.max(-rise - 0.03, 0.0) / BEAM_DOWN)
    return saturate(4.0 * ahead) * (below * (core + BEAM_FLOOD * exp_(-wide * wide)) + BEAM_STRAY)


@wp.func
def lamp_light(s: Spot, air: Air, i: int):
    """Irradiance at right angles from lamp i, by colour; none of a vehicle's own lamps on itself."""
    at = i * LAMP
    if load(air.lamps, at + 10) == s.owner:
        return wp.vec3f()
    to = wp.vec3f(load(air.lamps, at), load(air.lamps, at + 1), load(air.lamps, at + 2)) - s.point
    square = wp.dot(to, to)
    away = -to / wp.sqrt(square + 1e-9)
    axis = wp.vec3f(load(air.lamps, at + 3), load(air.lamps, at + 4), load(air.lamps, at + 5))
    ahead = wp.dot(away, axis)
    kind = load(air.lamps, at + 9)
    share = saturate(ahead)
    if kind == STREET:
        share = saturate(ahead * 4.0)
    elif kind == BEAM:
        share = beam_share(ahead, wp.dot(away, air.up))
    colour = wp.vec3f(load(air.lamps, at + 6), load(air.lamps, at + 7), load(air.lamps, at + 8))
    return colour * (share / (square + LAMP_SIZE * LAMP_SIZE))


@wp.func
def towards_lamp(s: Spot, air: Air, i: int):
    at = i * LAMP
    return wp.normalize(wp.vec3f(load(air.lamps, at), load(air.lamps, at + 1), load(air.lamps, at + 2)) - s.point)


@wp.func
def lamplight(s: Spot, air: Air):
    """What matt surfaces get from all lamps."""
    total = wp.vec3f()
    back = -wp.normalize(s.point)
    seen = saturate(wp.dot(s.normal, back))
    for i in range(air.lamp_count):
        to = towards_lamp(s, air, i)
        slope = wp.dot(s.normal, to)
        if slope > 0.0:
            gain = slope
            if s.rough > 0.0:
                gain *= s.open_sky * (1.0 - ROUGH + ROUGH / wp.max(slope + seen, 1e-3))
            if s.retro > 0.0:
                off = (1.0 - wp.dot(to, back)) * 2.0 / (RETRO_RAD * RETRO_RAD)
                gain *= 1.0 + RETRO / (1.0 + off)
            total += lamp_light(s, air, i) * gain
    return total


@wp.func
def glints(s: Spot, air: Air, rough: float, reflectance: float):
    """Radiance of all lamps in a coat of microfacets, with slopes of the width `rough` (Trowbridge and Reitz)."""
    total = wp.vec3f()
    back = -wp.normalize(s.point)
    seen = wp.max(wp.dot(s.normal, back), 1e-3)
    square = rough * rough
    for i in range(air.lamp_count):
        to = towards_lamp(s, air, i)
        slope = wp.dot(s.normal, to)
        if slope > 0.0:
            half = wp.normalize(to + back)
            cosine = saturate(wp.dot(s.normal, half))
            spread = cosine * cosine * (square - 1.0) + 1.0
            fresnel = reflectance + (1.0 - reflectance) * fifth(1.0 - saturate(wp.dot(half, back)))
            masked = 2.0 * slope * seen * (1.0 - rough) + (slope + seen) * rough
            # radiance is per irradiance on white, without pi
            weight = square / (spread * spread) * 0.5 / masked * fresnel * slope
            total += lamp_light(s, air, i) * weight
    return wp.vec3f(
        wp.min(total[0], BRIGHTEST_GLINT), wp.min(total[1], BRIGHTEST_GLINT), wp.min(total[2], BRIGHTEST_GLINT)
    )


@wp.func
def facade(s: Spot, air: Air, textures: Noise, incoming: wp.vec3f):
    """Radiance of a wall with windows: `_facade` of the reference, lit."""
    pitch = s.pattern[0]
    storey = s.pattern[1]
    wide = s.pattern[2]
    tall = s.pattern[3]
    u = s.u
    v = s.v
    blur = wp.max(s.pixel_m, 0.01)
    tone = 1.0 + 0.05 * noise(textures.soft, u, v, 1.0 / 0.05)
    tone += 0.05 * noise(textures.rough, u * 3.0, v * 0.6, 1.0 / 0.04)
    near = fade(s.pixel_m, 1.0 / 0.06)
    if near > 0.0:
        tone += 0.05 * noise(textures.grain, u, v, 1.0 / 0.02) * near
    if v < 0.6:
        tone *= 0.62
    albedo = s.albedo * wp.max(tone, 0.3)
    row = v - 0.5
    if row <= 0.0:
        return wp.cw_mul(albedo, incoming)
    frame = pulse(u, pitch, wp.min(wide + 0.20 / pitch, 0.9), blur)
    frame *= pulse(row, storey, wp.min(tall + 0.20 / storey, 0.92), blur)
    albedo += (wp.vec3f(0.62, 0.61, 0.58) - albedo) * (frame * 0.85)
    pane = pulse(u, pitch, wide, blur) * pulse(row, storey, tall, blur)
    if pane <= 0.0:
        return wp.cw_mul(albedo, incoming)
    bar = wp.abs(fraction(u / pitch) - 0.5) * pitch
    pane *= 1.0 - saturate((0.035 - bar) / blur + 0.5) * wp.min(0.07 / blur, 1.0)
    cell = noise(
        textures.grain,
        wp.floor(u / pitch) * 7.1 + pitch * 99.0,
        wp.floor(row / storey) * 9.7 + storey * 55.0,
        1.0,
    )
    inside = 0.02 + 0.22 * saturate(cell * 0.5)
    sill = fraction(row / storey) - 0.5
    inside *= wp.clamp(1.0 - 1.4 * sill / wp.max(tall, 0.1), 0.3, 1.0)
    albedo += (wp.vec3f(1.0, 0.97, 0.92) * inside - albedo) * pane
    room = WARM + (COOL - WARM) * (0.5 + 0.5 * wp.sin(40.0 * cell))
    room *= saturate((cell - WINDOW_FROM) * WINDOW_SLOPE) * wp.clamp(1.0 + sill, 0.5, 1.5) * (pane * air.night)
    view = wp.normalize(s.point)
    cosine = saturate(-wp.dot(view, s.normal))
    mirror = view + s.normal * (2.0 * cosine) + air.up * (0.02 * cell)
    fresnel = 0.06 + 0.94 * fifth(1.0 - cosine)
    glare = reflected_radiance(air, textures, mirror, False) * (fresnel * pane * 0.8)
    return wp.cw_mul(albedo, incoming) + glare + room


@wp.func
def irradiance(s: Spot, air: Air):
    facing = wp.dot(s.normal, air.up)
    slope = saturate(wp.dot(s.normal, air.sun)) * s.lit
    sky = (0.5 + 0.5 * facing) * s.open_sky
    ground = (0.5 - 0.5 * facing) * s.open_sky
    total = air.sun_colour * slope + air.ambient * sky + air.bounce * ground
    if air.lamp_count > 0:
        total += lamplight(s, air)
    return total


@wp.func
def polish(s: Spot, air: Air, textures: Noise, base: wp.vec3f, gloss: wp.vec3f):
    view = wp.normalize(s.point)
    cosine = saturate(-wp.dot(view, s.normal))
    mirror = view + s.normal * (2.0 * cosine)
    fresnel = gloss[0] + (1.0 - gloss[0]) * fifth(1.0 - cosine)
    out = reflected_radiance(air, textures, mirror, False) * (fresnel * gloss[1] * (0.35 + 0.65 * s.open_sky))
    glint = saturate(wp.dot(mirror, air.sun))
    if glint * s.lit > 0.0:
        square = glint * glint
        fourth = square * square
        sharp = power(glint, gloss[2]) * 14.0 + fourth * fourth * fourth * 0.25
        out += air.sun_colour * (sharp * fresnel * s.lit)
    if air.lamp_count > 0:
        out += glints(s, air, COAT_ROUGH, gloss[0]) * gloss[1]
    return base + out


@wp.func
def dirty(s: Spot, textures: Noise):
    height = -s.world[1]
    stain = 0.08 * noise(textures.rough, s.world[0] + s.world[2], height, 1.0 / 0.02)
    dust = wp.clamp((0.55 - height) * 0.9 + stain, 0.0, 0.35)
    return s.albedo + (wp.vec3f(0.13, 0.115, 0.095) - s.albedo) * dust


@wp.func
def leaf(s: Spot, air: Air, textures: Noise, incoming: wp.vec3f):
    p = s.world
    tone = 0.22 * noise(textures.soft, p[0] + 0.5 * p[2], p[1] - 0.3 * p[0], 1.0 / 0.06)
    near = fade(s.pixel_m, 1.0 / 0.09)
    if near > 0.0:
        tone += 0.32 * near * noise(textures.grain, p[0] + 0.6 * p[2], p[1] + 0.5 * p[2], 1.0 / 0.035)
    through = saturate(-wp.dot(s.normal, air.sun)) * s.lit * 0.35
    total = incoming + wp.cw_mul(air.sun_colour, wp.vec3f(1.0, 1.15, 0.5)) * through
    return wp.cw_mul(s.albedo * exp_(tone), total)


@wp.func
def surface(s: Spot, material: int, air: Air, street: StreetMarkings, textures: Noise):
    incoming = irradiance(s, air)
    tone = float(1.0)
    if material == M_LEAF:
        return leaf(s, air, textures, incoming)
    if material == M_ROAD:
        return wp.cw_mul(paint_road(s, street, textures), incoming)
    if material == M_FACADE:
        return facade(s, air, textures, incoming)
    if material == M_PAVEMENT or material == M_PARKING:
        size_m = wp.where(material == M_PARKING, 0.2, 0.42)
        joint_m = wp.where(material == M_PARKING, 0.02, 0.016)
        return wp.cw_mul(paint_slabs(s, textures, size_m, joint_m), incoming)
    if material == M_GRASS:
        return wp.cw_mul(paint_grass(s, textures), incoming)
    if material >= M_METAL and material <= M_TRIM:
        base = s.albedo
        gloss = wp.vec3f(0.03, 0.5, 60.0)
        if material == M_PAINT:
            base = dirty(s, textures)
            gloss = wp.vec3f(0.05 + 0.02 * air.wet, 1.0, 600.0)
        elif material == M_GLASS:
            gloss = wp.vec3f(0.07, 1.0, 900.0)
        elif material == M_LIGHT:
            base *= 0.8
            gloss = wp.vec3f(0.08, 0.9, 500.0)
        elif material == M_METAL:
            gloss = wp.vec3f(0.10, 0.5, 40.0)
        elif material == M_FLAT:
            base *= 1.0 + 0.08 * noise(textures.soft, s.world[0] + s.world[2], s.world[1], 1.0 / 0.03)
            gloss = wp.vec3f(0.03, 0.4, 60.0)
        else:
            base *= 0.9
        return polish(s, air, textures, wp.cw_mul(base, incoming), gloss) + s.albedo * s.pattern[1]
    if material == M_KERB:
        tone += 0.12 * noise(textures.soft, s.u, s.v, 1.0 / 0.05) - 0.35 * (
            1.0 - pulse(s.v, 1.0, 0.98, s.along_px)
        )
    elif material == M_GRAVEL:
        tone += 0.2 * noise(textures.rough, s.u, s.v, 1.0 / 0.03) * fade(s.along_px, 1.0 / 0.2)
        tone += 0.3 * noise(textures.grain, s.u, s.v, 1.0 / 0.03) * fade(s.along_px, 1.0 / 0.1)
        tone = wp.max(tone, 0.3)
    elif material == M_ROOF:
        tone += 0.12 * noise(textures.soft, s.u, s.v, 1.0 / 0.06) + 0.1 * noise(
            textures.grain, s.u, s.v, 1.0 / 0.1
        )
        tone *= 1.0 - 0.3 * (1.0 - pulse(s.v, 0.34, 0.8, s.pixel_m)) * fade(s.pixel_m, 1.0 / 0.25)
        tone = wp.max(tone, 0.3)
    elif material == M_WALL:
        tone += 0.10 * noise(textures.soft, s.u, s.v, 1.0 / 0.04)
        tone += 0.12 * noise(textures.rough, s.u * 2.0, s.v * 0.7, 1.0 / 0.03)
        tone = wp.max(tone, 0.3)
    elif material == M_FENCE:
        board = noise(textures.grain, wp.floor(s.u / 0.13) * 3.3, 0.0, 1.0)
        tone = (0.25 + 0.75 * pulse(s.u, 0.13, 0.86, s.pixel_m)) * (
            1.0 + 0.15 * board * fade(s.pixel_m, 1.0 / 0.13)
        )
        tone *= 1.0 + 0.12 * noise(textures.rough, s.u * 6.0, s.v, 1.0 / 0.05)
        tone = wp.max(tone, 0.2)
    elif material == M_BARK:
        tone += 0.3 * noise(textures.rough, (s.world[0] + s.world[2]) * 3.0, s.world[1], 1.0 / 0.04)
        tone = wp.max(tone, 0.3)
    return wp.cw_mul(s.albedo, incoming) * tone


@wp.func
def wetted(s: Spot, material: int, dry: wp.vec3f, air: Air, street: StreetMarkings, textures: Noise):
    soaked = street.soaked[material]
    out = dry * (1.0 - soaked[0] * air.wet)
    if soaked[1] + soaked[2] > 0.0:
        x = s.world[0]
        z = s.world[2] * 0.5
        depth = noise(textures.soft, x + 17.0, z, 1.0 / 0.04) + 0.25 * noise(textures.rough, x, z, 1.0 / 0.03)
        puddle = saturate((depth - 0.5) * 1.1)
        film = air.wet * (soaked[1] + soaked[2] * puddle)
        view = wp.normalize(s.point)
        cosine = saturate(-wp.dot(view, s.normal))
        share = (0.02 + 0.98 * fifth(1.0 - cosine)) * film
        hidden = 0.25 + 0.75 * s.open_sky
        mirror = view + s.normal * (2.0 * cosine)
        out = out * (1.0 - share) + reflected_radiance(air, textures, mirror, True) * (share * hidden)
        if air.lamp_count > 0:
            out += glints(s, air, WET_ROUGH + (PUDDLE_ROUGH - WET_ROUGH) * puddle, 0.02) * (film * hidden)
    return out


@wp.func
def slushed(s: Spot, bare: wp.vec3f, air: Air, textures: Noise):
    patch = noise(textures.soft, s.world[0] - 9.0, s.world[2] * 0.5, 1.0 / 0.04)
    share = air.snow * saturate(SLUSHY + PATCHES * patch)
    return bare + (wp.cw_mul(SLUSH, irradiance(s, air)) - bare) * share


# ------------------------------------------------------------------------------------------------------------- shadows


@wp.func
def soft_compare(maps: Floats, base: int, texels: int, u: float, v: float, depth: float):
    u0 = wp.floor(u)
    v0 = wp.floor(v)
    fu = u - u0
    fv = v - v0
    at = base + (int(v0) - 1) * texels + int(u0) - 1
    total = float(0.0)
    for i in range(4):
        part = wp.where(load(maps, at) >= depth, 1.0 - fu, 0.0)
        part += wp.where(load(maps, at + 1) >= depth, 1.0, 0.0)
        part += wp.where(load(maps, at + 2) >= depth, 1.0, 0.0)
        part += wp.where(load(maps, at + 3) >= depth, fu, 0.0)
        if i == 0:
            part *= 1.0 - fv
        if i == 3:
            part *= fv
        total += part
        at += texels
    return total * (1.0 / 9.0)


@wp.func
def lit_share(s: Spot, material: int, by_actor: bool, air: Air, shade: Shade):
    """Share of the sun that arrives, and 1 where actors take some."""
    if shade.sunny == 0:
        return wp.vec2f(0.0, 0.0)
    away = air.sun
    facing = wp.dot(s.normal, air.sun)
    slope = wp.sqrt(wp.max(1.0 - facing * facing, 0.0))
    if material != M_LEAF:
        if facing <= 0.0:
            return wp.vec2f(0.0, 0.0)
        away = s.normal
    size = float(shade.texels)
    square = shade.texels * shade.texels
    for i in range(2):
        area = shade.near
        if i == 1:
            area = shade.far
        offset = float(LEAF_DEPTH)
        if material != M_LEAF:
            offset = OFFSET + PER_TEXEL * (area[1] - area[0]) / size * slope
        place = shade.rows * (s.point + away * offset) + shade.shift
        u = (place[0] - area[0]) * (size / (area[1] - area[0])) - 0.5
        v = (place[1] - area[2]) * (size / (area[3] - area[2])) - 0.5
        if wp.min(u, v) > 2.0:
            if wp.max(u, v) < size - 4.0:
                depth = place[2] - 0.02
                share = soft_compare(shade.depth, 2 * i * square, shade.texels, u, v, depth)
                shaded = float(0.0)
                if by_actor:
                    open_share = soft_compare(shade.depth, (2 * i + 1) * square, shade.texels, u, v, depth)
                    share *= open_share
                    if open_share < 1.0:
                        shaded = 1.0
                return wp.vec2f(share, shaded)
    return wp.vec2f(1.0, 0.0)


@wp.func
def open_sky(world: wp.vec3f, on_ground: bool, actor: bool, shade: Shade):
    """Share of the sky that lights a sample, and 1 where vehicles hide some."""
    height = -world[1]
    if actor:
        return wp.vec2f(0.3 + 0.7 * saturate((height - 0.12) / 0.6), 0.0)
    if not on_ground:
        return wp.vec2f(0.5 + 0.5 * saturate(height / 1.2), 0.0)
    share = float(1.0)
    hemmed = float(0.0)
    for i in range(shade.prints.shape[0]):
        x = world[0] - shade.prints[i, 0]
        z = world[2] - shade.prints[i, 1]
        if wp.max(wp.abs(x), wp.abs(z)) < shade.prints[i, 2]:
            cos = shade.prints[i, 3]
            sin = shade.prints[i, 4]
            along = wp.abs(x * cos - z * sin) - shade.prints[i, 5]
            across = wp.abs(x * sin + z * cos) - shade.prints[i, 6]
            over = wp.max(along, 0.0)
            lateral = wp.max(across, 0.0)
            outside = wp.sqrt(over * over + lateral * lateral)
            inside = wp.min(wp.max(along, across), 0.0)
            dark = 0.62 * exp_(-outside / (0.32 * shade.prints[i, 7])) + 0.36 * saturate(-inside / 0.25)
            if dark >= 0.004:
                share *= 1.0 - wp.min(dark, 0.97)
                hemmed = 1.0
    return wp.vec2f(share, hemmed)


# --------------------------------------------------------------------------------------------------------------- pixels


@wp.kernel
def pixel_kernel(
    start: int,
    scene: PixelArrays,
    air: Air,
    street: StreetMarkings,
    textures: Noise,
    lens: Lens,
    shade: Shade,
    wanted: Bytes,
    out: Vec3s,
    shining: Vec3s,
    touched: Bytes,
):
    # A row a thread: structures are copied once a row.
    row = start + wp.tid()
    for column in range(lens.width):
        i = row * lens.width + column
        y = 2 * row
        x = 2 * column
        a = y * (2 * lens.width) + x
        c = a + 2 * lens.width
        actors = wp.max(wp.max(scene.owner[a], scene.owner[a + 1]), wp.max(scene.owner[c], scene.owner[c + 1]))
        changed = wp.where(actors > 0, 1, 0)
        if wanted[i] != wp.uint8(0):
            f = scene.face[a]
            once = scene.face[a + 1] == f and scene.face[c] == f and scene.face[c + 1] == f
            if not once:
                m = scene.material[a]
                o = scene.owner[a]
                alike = scene.material[a + 1] == m and scene.material[c] == m and scene.material[c + 1] == m
                if alike and scene.owner[a + 1] == o and scene.owner[c] == o and scene.owner[c + 1] == o:
                    if wp.int32(m) == M_LEAF:
                        once = True
                    else:
                        first = wp.vec4f(scene.depth[a], scene.depth[a + 1], scene.depth[c], scene.depth[c + 1])
                        once = wp.max(first) < wp.min(first) * 1.03
            count = wp.where(once, 1, 4)
            total = wp.vec3f()
            beyond = wp.vec3f()
            for k in range(count):
                dy = k // 2
                dx = k - 2 * dy
                at = a + dy * 2 * lens.width + dx
                ray = lens.ray * wp.vec3f(float(x + dx), float(y + dy), 1.0)
                f = scene.face[at]
                colour = air.horizon * 0.8
                if f >= 0:
                    s = Spot()
                    s.point = ray * scene.depth[at]
                    n = vec22()
                    for j in range(22):
                        n[j] = load(scene.table, f * COLUMNS + j)
                    normal = wp.vec3f(
                        n[0] * s.point[0] + n[1] * s.point[1] + n[2] * s.point[2],
                        n[3] * s.point[0] + n[4] * s.point[1] + n[5] * s.point[2],
                        n[6] * s.point[0] + n[7] * s.point[1] + n[8] * s.point[2],
                    )
                    normal = wp.normalize(normal)
                    if wp.dot(normal, s.point) > 0.0:
                        normal = -normal
                    s.normal = normal
                    s.u = n[9] * s.point[0] + n[10] * s.point[1] + n[11] * s.point[2]
                    s.v = n[12] * s.point[0] + n[13] * s.point[1] + n[14] * s.point[2]
                    s.albedo = wp.vec3f(n[15], n[16], n[17])
                    s.pattern = wp.vec4f(n[18], n[19], n[20], n[21])
                    s.world = lens.axes * (s.point + lens.centre) + lens.origin
                    material = wp.int32(scene.material[at])
                    actor = scene.owner[at] > 0
                    on_ground = scene.ground[material] != wp.uint8(0)
                    lit = lit_share(s, material, on_ground or actor, air, shade)
                    sky = open_sky(s.world, on_ground, actor, shade)
                    if lit[1] + sky[1] > 0.0:
                        changed = 1
                    s.rough = float(0.0)
                    s.retro = float(0.0)
                    if on_ground:
                        s.rough = 1.0
                    elif material >= M_METAL and material <= M_TRIM:
                        if s.pattern[0] + s.pattern[3] > 0.0:
                            s.retro = 1.0
                    s.owner = float(scene.owner[at])
                    if scene.owner[at] == 0:
                        s.owner = -1.0
                    s.lit = lit[0]
                    s.open_sky = sky[0]
                    s.pixel_m = s.point[2] / lens.focal
                    s.along_px = s.pixel_m
                    if on_ground:
                        s.along_px *= wp.max(s.point[2] / lens.height_m, 1.0)
                    colour = surface(s, material, air, street, textures)
                    if air.wet > 0.0:
                        colour = wetted(s, material, colour, air, street, textures)
                    if air.snow > 0.0 and on_ground:
                        colour = slushed(s, colour, air, textures)
                    through = exp_(-air.haze * wp.length(s.point))
                    colour = colour * through + air.horizon * (0.6 * (1.0 - through))
                elif air.fog == 0:
                    colour = sky_radiance(air, textures, wp.normalize(ray))
                for axis in range(3):
                    exposed = colour[axis] * lens.develop[axis]
                    total[axis] += apply_tone_curve(exposed, lens.curve)
                    beyond[axis] += wp.max(exposed - 1.0, 0.0)
            out[i] = total * (1.0 / float(count))
            if air.lamp_count > 0:
                shining[i] = beyond * (1.0 / float(count))
        touched[i] = wp.uint8(changed)


@wp.kernel
def mark_kernel(start: int, face: Ints, used: Bytes):
    """Marks the faces that a pixel shows; threads may write the same mark at once."""
    i = start + wp.tid()
    f = face[i]
    if f >= 0:
        used[f] = wp.uint8(1)


@wp.kernel
def table_kernel(
    start: int,
    used: Bytes,
    corners: Vec3s,
    normals: Vec3s,
    uv: Vec2s,
    albedo: Vec3s,
    pattern: Vec4s,
    table: Floats,
):
    """`_attribute_maps` of the reference: barycentric coordinates are linear in the point, in camera axes about the centre."""
    f = start + wp.tid()
    if used[f] != wp.uint8(0):
        a = wp.vec3d(corners[3 * f])
        b = wp.vec3d(corners[3 * f + 1])
        c = wp.vec3d(corners[3 * f + 2])
        first = wp.cross(b, c)
        volume = wp.dot(a, first)
        if wp.abs(volume) < wp.float64(1e-12):
            volume = wp.float64(1e-12)
        scale = wp.float64(1.0) / volume
        r0 = first * scale
        r1 = wp.cross(c, a) * scale
        r2 = wp.cross(a, b) * scale
        n0 = wp.vec3d(normals[3 * f])
        n1 = wp.vec3d(normals[3 * f + 1])
        n2 = wp.vec3d(normals[3 * f + 2])
        to = f * COLUMNS
        for k in range(3):
            row = r0 * n0[k] + r1 * n1[k] + r2 * n2[k]
            for j in range(3):
                table[to + 3 * k + j] = wp.float32(row[j])
        t0 = uv[3 * f]
        t1 = uv[3 * f + 1]
        t2 = uv[3 * f + 2]
        for k in range(2):
            row = r0 * wp.float64(t0[k]) + r1 * wp.float64(t1[k]) + r2 * wp.float64(t2[k])
            for j in range(3):
                table[to + 9 + 3 * k + j] = wp.float32(row[j])
        for k in range(3):
            table[to + 15 + k] = albedo[f][k]
        for k in range(4):
            table[to + 18 + k] = pattern[f][k]


@wp.kernel
def owner_kernel(
    start: int,
    face: Ints,
    materials: Bytes,
    owners: Ints,
    semantics: Bytes,
    depth: Floats,
    material: Bytes,
    owner: Ints,
    semantic: Bytes,
):
    i = start + wp.tid()
    f = face[i]
    if f >= 0:
        material[i] = materials[f]
        owner[i] = owners[f]
        semantic[i] = semantics[f]
        depth[i] = -1.0 / depth[i]
    else:
        depth[i] = INFINITE
        material[i] = wp.uint8(M_SKY)
        owner[i] = -1
        semantic[i] = S_SKY


@wp.kernel
def nearest_kernel(start: int, width: int, depth: Floats, nearest: Longs):
    """The nearest of the four samples of a pixel; width: of the image."""
    i = start + wp.tid()
    y = i // width
    a = 4 * width * y + 2 * (i - y * width)
    best = int(a)
    least = depth[a]
    for k in range(1, 4):
        at = a + (k // 2) * 2 * width + (k % 2)
        if depth[at] < least:
            best = at
            least = depth[at]
    nearest[i] = wp.int64(best)


# ---------------------------------------------------------------------------------------------------------- shadow maps


@wp.func
def fill(
    p: wp.vec3d,
    q: wp.vec3d,
    r: wp.vec3d,
    base: int,
    width: int,
    first: int,
    end: int,
    depth: Floats,
    face: int,
    faces: Ints,
):
    """Offers a triangle of corners (x, y pixels, depth) to rows [first, end) of an image that starts at `base`.

    Less depth wins, then the triangle that came first. face: noted in `faces`, unless below 0.
    """
    a = p
    b = q
    c = r
    if b[1] < a[1]:
        a = q
        b = p
    if c[1] < b[1]:
        c = b
        b = r
        if b[1] < a[1]:
            b = a
            a = r
    y0 = int(wp.ceil(wp.max(a[1], wp.float64(first))))
    y1 = int(wp.ceil(wp.min(c[1], wp.float64(end)))) - 1
    left = wp.min(wp.min(a[0], b[0]), c[0])
    right = wp.max(wp.max(a[0], b[0]), c[0])
    if y0 <= y1 and left <= wp.float64(width - 1) and right >= wp.float64(0.0):
        ux = b[0] - a[0]
        uy = b[1] - a[1]
        vx = c[0] - a[0]
        vy = c[1] - a[1]
        area = ux * vy - uy * vx
        if wp.abs(area) > SLIVER:
            scale = wp.float64(1.0) / area
            uz = b[2] - a[2]
            vz = c[2] - a[2]
            slope_x = (uz * vy - vz * uy) * scale
            slope_y = (vz * ux - uz * vx) * scale
            lowest = wp.float32(wp.min(wp.min(a[2], b[2]), c[2]))
            highest = wp.float32(wp.max(wp.max(a[2], b[2]), c[2]))
            across = vx / vy
            upper = ux / wp.max(uy, SLIVER)
            lower = (c[0] - b[0]) / wp.max(c[1] - b[1], SLIVER)
            step = wp.float32(slope_x)
            for y in range(y0, y1 + 1):
                v = wp.float64(y) - a[1]
                one = a[0] + v * across
                two = b[0] + (wp.float64(y) - b[1]) * lower
                if wp.float64(y) < b[1]:
                    two = a[0] + v * upper
                x0 = int(wp.ceil(wp.max(wp.min(one, two), wp.float64(0.0))))
                x1 = int(wp.ceil(wp.min(wp.max(one, two), wp.float64(width)))) - 1
                begin = wp.float32(a[2] + slope_y * v + slope_x * (wp.float64(x0) - a[0]))
                row = base + y * width
                for x in range(x0, x1 + 1):
                    z = wp.min(wp.max(begin + step * float(x - x0), lowest), highest)
                    if z < depth[row + x]:
                        depth[row + x] = z
                        if face >= 0:
                            faces[row + x] = face


@wp.func
def to_texels(p: wp.vec3d, area: wp.vec4f, texels: int):
    size = wp.float64(texels)
    half = wp.float64(0.5)
    x = (p[0] - wp.float64(area[0])) * (size / wp.float64(area[1] - area[0])) - half
    y = (p[1] - wp.float64(area[2])) * (size / wp.float64(area[3] - area[2])) - half
    return wp.vec3d(x, y, p[2])


@wp.kernel
def sun_kernel(start: int, bands: int, corners: Vec3s, material: Bytes, owner: Ints, shade: Shade, ground: Bytes):
    """Fills the rows of one band of all maps."""
    band = start + wp.tid()
    texels = shade.texels
    first = texels * band // bands
    end = texels * (band + 1) // bands
    for k in range(4):
        for i in range(first * texels, end * texels):
            shade.depth[k * texels * texels + i] = INFINITE
    for f in range(material.shape[0]):
        if ground[wp.int32(material[f])] == wp.uint8(0):
            a = shade.rows * corners[3 * f] + shade.shift
            b = shade.rows * corners[3 * f + 1] + shade.shift
            c = shade.rows * corners[3 * f + 2] + shade.shift
            left = wp.min(wp.min(a[0], b[0]), c[0])
            right = wp.max(wp.max(a[0], b[0]), c[0])
            near = wp.min(wp.min(a[1], b[1]), c[1])
            far = wp.max(wp.max(a[1], b[1]), c[1])
            layer = int(0)
            if owner[f] > 0:
                layer = 1
            for i in range(2):
                area = shade.near
                if i == 1:
                    area = shade.far
                seen = right > area[0] and left < area[1] and far > area[2] and near < area[3]
                if i == 1:
                    inner = shade.near  # nobody looks up there in the far map
                    if (
                        left > inner[0] + RIM
                        and right < inner[1] - RIM
                        and near > inner[2] + RIM
                        and far < inner[3] - RIM
                    ):
                        seen = False
                if seen:
                    fill(
                        to_texels(wp.vec3d(a), area, texels),
                        to_texels(wp.vec3d(b), area, texels),
                        to_texels(wp.vec3d(c), area, texels),
                        (2 * i + layer) * texels * texels,
                        texels,
                        first,
                        end,
                        shade.depth,
                        -1,
                        owner,  # not written: no faces are requested
                    )


@wp.func
def to_pixel(p: wp.vec3d):
    """Pixel, and a depth that is linear over the image: less is nearer, 0 is infinitely far."""
    inverse = wp.float64(1.0) / p[2]
    return wp.vec3d(p[0] * inverse, p[1] * inverse, -inverse)


@wp.func
def cut(a: wp.vec3d, b: wp.vec3d):
    """Where the side from a to b passes the near plane."""
    return a + (b - a) * ((NEAR - a[2]) / (b[2] - a[2]))


@wp.kernel
def sight_kernel(
    start: int, bands: int, width: int, height: int, matrix: wp.mat33d, corners: Vec3s, depth: Floats, faces: Ints
):
    """Fills the rows of one band: the nearest face of each pixel and minus its inverse depth."""
    band = start + wp.tid()
    first = height * band // bands
    end = height * (band + 1) // bands
    for i in range(first * width, end * width):
        depth[i] = 0.0
        faces[i] = -1
    for f in range(corners.shape[0] // 3):
        a = matrix * wp.vec3d(corners[3 * f])
        b = matrix * wp.vec3d(corners[3 * f + 1])
        c = matrix * wp.vec3d(corners[3 * f + 2])
        ahead = int(0)
        if a[2] >= NEAR:
            ahead += 1
        if b[2] >= NEAR:
            ahead += 1
        if c[2] >= NEAR:
            ahead += 1
        if ahead == 3:
            fill(to_pixel(a), to_pixel(b), to_pixel(c), 0, width, first, end, depth, f, faces)
        elif ahead > 0:
            # turned so that a is alone on its side of the near plane
            alone = ahead == 1
            if (b[2] >= NEAR) == alone:
                swapped = a
                a = b
                b = c
                c = swapped
            elif (c[2] >= NEAR) == alone:
                swapped = a
                a = c
                c = b
                b = swapped
            d = to_pixel(cut(a, b))
            e = to_pixel(cut(a, c))
            if alone:
                fill(to_pixel(a), d, e, 0, width, first, end, depth, f, faces)
            else:
                fill(d, to_pixel(b), to_pixel(c), 0, width, first, end, depth, f, faces)
                fill(d, to_pixel(c), e, 0, width, first, end, depth, f, faces)


# --------------------------------------------------------------------------------------------------------------- camera


@wp.func_native("""
    // One row of the picture: vignette, grain, rounding. The loop is plain so that the compiler widens it; on the
    // CPU only with the compiler's own functions, which CUDA lacks.
#ifdef __CUDA_ARCH__
    #define ROOT sqrtf
    #define ROUND rintf
#else
    #define ROOT __builtin_sqrtf
    #define ROUND __builtin_rintf
#endif
    const float* from = (const float*)image.data + row * length;
    const float* off = (const float*)across.data;
    unsigned char* to = (unsigned char*)out.data + row * length;
    for (int i = 0; i < length; ++i) {
        unsigned int x = ((unsigned int)(row * length + i) * 0x9E3779B9u) ^ (unsigned int)seed;
        x ^= x >> 16; x *= 0x7FEB352Du; x ^= x >> 15; x *= 0x846CA68Bu; x ^= x >> 16;
        unsigned int pairs = (x & 0x00FF00FFu) + ((x >> 8) & 0x00FF00FFu);
        float grain = ((float)(int)((pairs & 0xFFFFu) + (pairs >> 16)) - 510.0f) * scale;
        float value = from[i] * (1.0f - vignette * (off[i] + down));
        float bright = value > 0.0f ? value : 0.0f;
        value += grain * (noise * (0.4f + ROOT(bright)));
        value = value * 255.0f;
        value = value > 0.0f ? value : 0.0f;
        value = value < 255.0f ? value : 255.0f;
        to[i] = (unsigned char)(int)ROUND(value);
    }
#undef ROOT
#undef ROUND
""")
def expose_row(
    image: Floats,
    across: Floats,
    out: Bytes,
    row: int,
    length: int,
    down: float,
    vignette: float,
    noise: float,
    scale: float,
    seed: wp.uint32,
): ...


@wp.kernel
def camera_kernel(
    start: int,
    image: Floats,
    across: Floats,
    down: Floats,
    vignette: float,
    noise: float,
    seed: wp.uint32,
    out: Bytes,
):
    row = start + wp.tid()
    expose_row(image, across, out, row, across.shape[0], down[row], vignette, noise, BYTES, seed)


# ----------------------------------------------------------------------------------------------------------------- host


_KINDS = {np.float32: wp.float32, np.int32: wp.int32, np.int64: wp.int64, np.uint8: wp.uint8, np.bool_: wp.uint8}
_WIDTHS = {wp.vec2f: 2, wp.vec3f: 3, wp.vec4f: 4}


def _flat(values: np.ndarray, dtype: Any = None) -> wp.array:
    """The values as one row, without a copy where they are contiguous. dtype: of Warp's vectors."""
    kind = dtype or _KINDS[values.dtype.type]
    if values.dtype == np.bool_:
        values = values.view(np.uint8)
    shape = (-1, _WIDTHS[kind]) if kind in _WIDTHS else (-1,)
    return wp.array(np.ascontiguousarray(values).reshape(shape), dtype=kind, copy=False, device="cpu")


def _vec(values: np.ndarray) -> Any:
    return wp.vec3f(*np.asarray(values, np.float32).tolist())


def _mat(values: np.ndarray) -> Any:
    return wp.mat33f(*np.asarray(values, np.float32).reshape(-1).tolist())


_GROUND = np.isin(np.arange(len(Material)), GROUND).astype(np.uint8)


def _rows(height: int) -> list[int]:
    """Edges of about equal ranges of an image's rows, one a thread."""
    return [height * i // threads() for i in range(threads() + 1)]


def see(soup: Soup, matrix: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Face int32, depth float32 m, material uint8, owner int32 and semantic uint8 of each pixel, of shape `size`.

    matrix (3, 3): the soup's corners to homogeneous pixels. See `Sight`.
    """
    face, depth = np.empty(size, np.int32), np.empty(size, np.float32)
    rest = np.empty(size, np.uint8), np.empty(size, np.int32), np.empty(size, np.uint8)
    bands, corners = threads(), _flat(soup.corners, wp.vec3f)
    to_pixels = wp.mat33d(*matrix.reshape(-1).tolist())
    inputs = [bands, size[1], size[0], to_pixels, corners, _flat(depth), _flat(face)]
    launch(sight_kernel, range(bands + 1), inputs)
    tables = [_flat(soup.material), _flat(soup.owner), _flat(soup.semantic)]
    launch(owner_kernel, split_range(face.size), [_flat(face), *tables, _flat(depth), *(_flat(o) for o in rest)])
    return face, depth, *rest


def nearest(depth: np.ndarray) -> np.ndarray:
    """See `Sight.nearest`. depth (2H, 2W) -> (H, W) int64."""
    height, width = depth.shape[0] // 2, depth.shape[1] // 2
    out = np.empty((height, width), np.int64)
    launch(nearest_kernel, split_range(out.size), [width, _flat(depth), _flat(out)])
    return out


def _shade(
    rows: np.ndarray, depth: np.ndarray, areas: tuple[tuple[float, ...], ...], prints: np.ndarray | None = None
) -> Shade:
    shade = Shade()
    shade.rows, shade.shift = _mat(rows[:, :3]), _vec(rows[:, 3])
    shade.depth = _flat(depth)
    shade.near, shade.far = (wp.vec4f(*area) for area in areas)
    shade.texels, shade.sunny = depth.shape[-1], 1
    if prints is not None and len(prints):
        shade.prints = wp.array(prints, dtype=wp.float32, copy=False, device="cpu")
    return shade


def sun_depth(soup: Soup, rows: np.ndarray, areas: tuple[tuple[float, ...], ...], texels: int) -> np.ndarray:
    """`SunMaps.depth`. rows (3, 4): camera axes to a map's x, y, depth; areas: two of (x0, x1, y0, y1), m."""
    depth = np.empty((2, 2, texels, texels), np.float32)
    bands = threads()
    inputs = [bands, _flat(soup.corners, wp.vec3f), _flat(soup.material), _flat(soup.owner)]
    launch(sun_kernel, range(bands + 1), [*inputs, _shade(rows, depth, areas), _flat(_GROUND)])
    return depth


def _noise(textures: NoiseSet) -> Noise:
    out = Noise()
    out.soft, out.rough, out.grain = _flat(textures.soft), _flat(textures.rough), _flat(textures.grain)
    return out


def _air(light: Light, lamp_rows: np.ndarray) -> Air:
    air = Air()
    right, forward = light.ahead
    air.sun, air.up, air.right, air.forward = _vec(light.sun), _vec(light.up), _vec(right), _vec(forward)
    air.sun_colour, air.zenith, air.horizon = _vec(light.sun_colour), _vec(light.zenith), _vec(light.horizon)
    air.ambient, air.bounce = _vec(light.ambient), _vec(ground_light(light))
    air.town = _vec(light.ambient * 0.22 + light.sun_colour * 0.03)
    air.tarmac = _vec(MIRRORED_GROUND * (light.ambient + 0.6 * light.sun_colour))
    air.haze, air.clouds, air.cloud_seed = light.haze_per_m, light.clouds, light.cloud_seed
    air.wet, air.snow, air.fog = light.wet, light.snow, int(light.weather == "fog")
    air.night, air.lamps, air.lamp_count = light.night, _flat(lamp_rows), len(lamp_rows)
    if light.panorama is not None:
        pixels = light.panorama.pixels
        air.panorama = _flat(pixels)
        air.panorama_height, air.panorama_width = pixels.shape[:2]
        air.panorama_turn = light.panorama.turn_rad
    return air


def _street(road: Road) -> StreetMarkings:
    street = StreetMarkings()
    lines = [(m.middle_m, m.width_m, m.dash_m, m.period_m) for m in road.markings]
    street.markings = _flat(np.array(lines or [(0.0,) * 4], np.float32), wp.vec4f)
    street.count = len(lines)
    street.crossing = wp.vec2f(*(road.crossing or (1.0, 0.0)))
    street.own_side = road.markings[0].middle_m if road.markings else -1.7
    street.soaked = _flat(SOAKED, wp.vec3f)
    return street


def _prints(shadows: list[Shadow]) -> np.ndarray:
    """Rows of `Shade.prints`."""
    rows = np.zeros((len(shadows), 8), np.float32)
    for row, shadow in zip(rows, shadows, strict=True):
        length, height, width = shadow.size_lhw
        reach = 0.75 * height
        radius = 0.5 * float(np.hypot(length, width)) + reach
        turn = np.cos(shadow.yaw), np.sin(shadow.yaw)
        row[:] = (*shadow.position_xz, radius, *turn, length / 2, width / 2, reach)
    return rows


def develop_pixels(
    sight: Sight,
    setting: Setting,
    maps: SunMaps | None,
    shadows: list[Shadow],
    target: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Fill in display values. target: the image (H * W, 3) float32 to fill, the pixels (H * W,) bool to do, and the
    light beyond white (H * W, 3) float32 to fill where lamps are on. Returns the pixels (H * W,) bool that actors touch.
    """
    image, wanted, shining = target
    seen, view = sight.faces, setting.view
    scene = PixelArrays()
    table = np.empty((max(len(seen), 1), TABLE), np.float32)
    scene.table = _flat(table)
    scene.face, scene.depth, scene.owner = _flat(sight.face), _flat(sight.depth), _flat(sight.owner)
    scene.material, scene.ground = _flat(sight.material), _flat(_GROUND)
    soup = [_flat(seen.corners, wp.vec3f), _flat(seen.normals, wp.vec3f), _flat(seen.uv, wp.vec2f)]
    paint = [_flat(seen.albedo, wp.vec3f), _flat(seen.pattern, wp.vec4f)]
    used = _flat(np.zeros(max(len(seen), 1), np.uint8))
    launch(mark_kernel, split_range(sight.face.size), [scene.face, used])
    launch(table_kernel, split_range(len(seen)), [used, *soup, *paint, scene.table])
    lens = Lens()
    lens.ray, lens.axes = _mat(np.linalg.inv(fine_matrix(view))), _mat(view.rotation.T)
    lens.origin, lens.centre = _vec(view.origin), _vec(view.centre)
    lens.focal, lens.height_m, lens.width = float(view.camera.intrinsics[0, 0]), view.height_m, view.camera.width
    lens.develop = _vec(setting.response.exposure * setting.response.white_balance)
    root = np.arange(CURVE + 2, dtype=np.float32) * np.float32(BRIGHTEST**0.5 / CURVE)
    plain = replace(setting.response, exposure=1.0, white_balance=np.ones(1))
    lens.curve = _flat(develop(np.square(root)[:, None], plain)[:, 0])
    prints = _prints(shadows)
    if maps is None:
        shade = _shade(np.zeros((3, 4)), np.zeros((2, 2, 1, 1), np.float32), ((0.0,) * 4,) * 2, prints)
        shade.sunny = 0
    else:
        shade = _shade(maps.rows, maps.depth, maps.areas, prints)
    touched = np.empty(len(image), bool)
    inputs = [scene, _air(setting.light, setting.lamps), _street(setting.road), _noise(setting.noise), lens, shade]
    launch(
        pixel_kernel,
        _rows(view.camera.height),
        [*inputs, _flat(wanted), _flat(image, wp.vec3f), _flat(shining, wp.vec3f), _flat(touched)],
        device=torch.device("cpu"),
    )
    return touched


def expose(image: np.ndarray, response: Response, seed: int) -> np.ndarray:
    """Vignette, grain and rounding: (H, W, 3) float32 display values to uint8; see `render.take`."""
    height, width = image.shape[:2]
    across = np.repeat(np.square(np.linspace(-1, 1, width, dtype=np.float32)), 3)
    down = np.square(np.linspace(-1, 1, height, dtype=np.float32) * np.float32(height / width))
    out = np.empty(image.shape, np.uint8)
    inputs = [_flat(image), _flat(across), _flat(down), response.vignette, response.noise, wp.uint32(seed)]
    launch(camera_kernel, _rows(height), [*inputs, _flat(out)])
    return out
