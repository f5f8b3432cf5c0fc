"""Colour of surface samples in plain numpy: it defines what the generator's kernels compute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.synth import lamps as lamping
from drivesem.synth.layout import Road
from drivesem.synth.light import (
    MIRRORED_GROUND,
    SLUSH_PATCHES,
    SLUSH_RGB,
    SLUSH_SHARE,
    SOAKED,
    Light,
    ground_light,
)
from drivesem.synth.soup import GROUND, Material
from drivesem.synth.view import NoiseSet, Setting
from tests.drivesem.synth.reference_light import reflected_radiance, sample

_F = np.float32


@dataclass(frozen=True, slots=True)
class Samples:
    """n surface samples. point (n, 3): camera axes, from the camera's centre, m; world (n, 3): m, ground at y = 0;
    normal (n, 3) unit, towards the viewer; uv (n, 2) m; material (n,); albedo (n, 3); pattern (n, 4); owner (n,);
    lit (n,): share of the sun that arrives, in [0, 1]; open_sky (n,): share of the sky, in [0, 1]; pixel_m (n,):
    size of a pixel at the sample.
    """

    point: np.ndarray
    world: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    albedo: np.ndarray
    pattern: np.ndarray
    owner: np.ndarray
    lit: np.ndarray
    open_sky: np.ndarray
    pixel_m: np.ndarray

    def take(self, index: np.ndarray) -> Samples:
        """Some of the samples."""
        return Samples(*(getattr(self, name)[index] for name in self.__slots__))


def _rgb(red: float, green: float, blue: float) -> np.ndarray:
    return np.array([red, green, blue], np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) scaled to length 1."""
    return vectors / np.sqrt(np.maximum(np.einsum("ni,ni->n", vectors, vectors), 1e-12))[:, None]


def _fade(pixel_m: np.ndarray, detail_m: float) -> np.ndarray:
    """1 where a detail of this size is well resolved, 0 where it is below a pixel."""
    return np.clip(1.4 - pixel_m * _F(1.0 / detail_m), 0, 1)


def _noise(texture: np.ndarray, u: np.ndarray, v: np.ndarray, texel_m: float) -> np.ndarray:
    return sample(texture, u * _F(1 / texel_m), v * _F(1 / texel_m))


def _pulse(x: np.ndarray, period: np.ndarray | float, share: np.ndarray | float, blur: np.ndarray) -> np.ndarray:
    """Periodic box of value 1 over `share` of each period around its middle, smoothed over `blur` (units of x)."""
    phase = np.abs(np.mod(x / period, 1.0) - 0.5) * period
    half = share * period * 0.5
    soft = np.maximum(blur, 1e-4)
    sharp = np.clip((half - phase) / soft + 0.5, 0, 1)
    mean = np.broadcast_to(np.asarray(share, _F), sharp.shape)
    melt = np.clip(soft / period * 2 - 0.5, 0, 1)
    return sharp * (1 - melt) + mean * melt


def _paint_road(s: Samples, road: Road, noise: NoiseSet, along_px: np.ndarray) -> np.ndarray:
    d, q, seed = s.uv[:, 0], s.uv[:, 1], s.pattern[:, 0]
    x = d + seed
    tone = 1 + 0.09 * _noise(noise.soft, x, q * _F(0.4), 0.08)
    tone += 0.06 * _noise(noise.rough, x * _F(1.5), q * _F(0.12) + seed, 0.03) * _fade(s.pixel_m, 0.15)
    tone += 0.17 * _noise(noise.grain, x, q, 0.012) * _fade(along_px, 0.05)
    tone += 0.10 * _noise(noise.grain, x, q, 0.05) * _fade(along_px, 0.2)
    patch = _noise(noise.soft, x * _F(0.7) + 91, q * _F(0.25) + 37, 0.05)
    tone *= 1 - 0.22 * np.clip((patch - 1.35) * 6, 0, 1)
    crack = np.abs(_noise(noise.soft, x + 13, q * _F(0.8) + 7, 0.035))
    tone *= 1 - 0.35 * np.clip(1 - crack * 26, 0, 1) * _fade(along_px, 0.12)
    track = np.cos(d * _F(2 * np.pi / 1.7))
    tone *= 1 + 0.035 * track
    albedo = s.albedo * np.maximum(tone, 0.2)[:, None]
    cover = np.zeros(len(d), _F)
    for line in road.markings:
        near = np.abs(d - line.middle_m) < line.width_m + 0.3
        if not near.any():
            continue
        across = np.clip((line.width_m / 2 - np.abs(d[near] - line.middle_m)) / s.pixel_m[near] + 0.5, 0, 1)
        across *= np.minimum(line.width_m / s.pixel_m[near], 1)
        if line.dash_m < line.period_m:
            across = across * _pulse(q[near], line.period_m, line.dash_m / line.period_m, along_px[near])
        cover[near] = np.maximum(cover[near], across)
    if road.crossing is not None:
        c0, c1 = road.crossing
        cover[(q > c0 - 1.2) & (q < c1 + 1.2) & (d < 200)] = 0
        own = (d > road.markings[0].middle_m if road.markings else d > -1.7) & (d < 200)
        bar = np.clip((0.25 - np.abs(q - (c0 - 1.6))) / np.maximum(along_px, 1e-3) + 0.5, 0, 1)
        bar *= np.minimum(0.5 / np.maximum(along_px, 1e-3), 1)
        cover = np.maximum(cover, bar * own)
    if cover.any():
        worn = np.clip(0.75 + 0.28 * _noise(noise.rough, x, q, 0.02), 0.25, 1.0)
        cover *= worn
        albedo += (_rgb(0.62, 0.62, 0.60) - albedo) * cover[:, None]
    return albedo


def _paint_slabs(s: Samples, noise: NoiseSet, along_px: np.ndarray, size_m: float, joint_m: float) -> np.ndarray:
    u, v = s.uv[:, 0] + s.pattern[:, 0] % 1, s.uv[:, 1]
    tone = (
        1 + 0.10 * _noise(noise.soft, u, v, 0.06) + 0.12 * _noise(noise.grain, u, v, 0.02) * _fade(along_px, 0.08)
    )
    slab = _noise(noise.grain, np.floor(u / size_m) * 3.7, np.floor(v / size_m) * 5.3, 1.0)
    tone += 0.07 * slab * _fade(along_px, size_m)
    blur = np.maximum(s.pixel_m, 0.008)
    joints = 1 - _pulse(u, size_m, 1 - joint_m / size_m, blur) * _pulse(v, size_m, 1 - joint_m / size_m, along_px)
    tone *= 1 - 0.45 * joints * _fade(along_px, size_m * 0.7)
    return s.albedo * np.maximum(tone, 0.2)[:, None]


def _paint_grass(s: Samples, noise: NoiseSet, along_px: np.ndarray) -> np.ndarray:
    u, v = s.world[:, 0] + s.pattern[:, 0], s.world[:, 2]
    broad = _noise(noise.soft, u, v, 0.08)
    tone = 1 + 0.16 * broad + 0.30 * _noise(noise.rough, u, v * _F(0.6), 0.035) * _fade(along_px, 0.3)
    tone += 0.30 * _noise(noise.grain, u, v * _F(0.5), 0.02) * _fade(along_px, 0.08)
    dry = np.clip(0.25 + 0.3 * _noise(noise.soft, u + 50, v, 0.05), 0, 0.8)[:, None]
    albedo = s.albedo * (1 - dry) + _rgb(0.16, 0.135, 0.07) * dry
    return albedo * np.maximum(tone, 0.25)[:, None]


def _lamp_light(s: Samples, light: Light, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance (n, 3) at right angles from a lamp, and unit directions (n, 3) to it."""
    to = row[:3] - s.point
    square = np.einsum("ni,ni->n", to, to)
    to = to / np.sqrt(square + 1e-9)[:, None]
    ahead, kind = -to @ row[3:6], row[9]
    if kind == lamping.BEAM:
        share = lamping.beam_share(-to, row[3:6], light.up.astype(_F))
    else:
        share = np.clip(ahead * (4 if kind == lamping.STREET else 1), 0, 1)
    share = np.where((s.owner > 0) & (s.owner == row[10]), 0, share)
    return row[6:9] * (share / (square + lamping.LAMP_SIZE_M**2))[:, None], to


def _lamplight(s: Samples, light: Light, lamps: np.ndarray) -> np.ndarray:
    """What matt surfaces (n, 3) get from all lamps."""
    back = -unit(s.point)
    seen = np.clip(np.einsum("ni,ni->n", s.normal, back), 0, 1)
    ground = np.isin(s.material, GROUND)
    coated = (s.material >= Material.METAL) & (s.material <= Material.TRIM)
    retro = coated & (s.pattern[:, 0] + s.pattern[:, 3] > 0)
    total = np.zeros_like(s.point)
    for row in lamps:
        irradiance, to = _lamp_light(s, light, row)
        slope = np.clip(np.einsum("ni,ni->n", s.normal, to), 0, 1)
        rough = s.open_sky * (1 - lamping.ROUGH + lamping.ROUGH / np.maximum(slope + seen, 1e-3))
        off = (1 - np.einsum("ni,ni->n", to, back)) * 2 / lamping.RETRO_RAD**2
        gain = slope * np.where(ground, rough, 1) * np.where(retro, 1 + lamping.RETRO / (1 + off), 1)
        total += irradiance * gain[:, None]
    return total


def _glints(
    s: Samples, light: Light, lamps: np.ndarray, rough: np.ndarray | float, reflectance: float
) -> np.ndarray:
    """Radiance (n, 3) of all lamps in a coat with microfacets (Trowbridge and Reitz)."""
    back = -unit(s.point)
    seen = np.maximum(np.einsum("ni,ni->n", s.normal, back), 1e-3)
    total = np.zeros_like(s.point)
    for row in lamps:
        irradiance, to = _lamp_light(s, light, row)
        slope = np.clip(np.einsum("ni,ni->n", s.normal, to), 0, 1)
        half = unit(to + back)
        cosine = np.clip(np.einsum("ni,ni->n", s.normal, half), 0, 1)
        fresnel = reflectance + (1 - reflectance) * (1 - np.clip(np.einsum("ni,ni->n", half, back), 0, 1)) ** 5
        slopes = np.square(rough) / (np.square(cosine) * (np.square(rough) - 1) + 1) ** 2
        masked = 2 * slope * seen * (1 - rough) + (slope + seen) * rough
        total += irradiance * (slopes * 0.5 / masked * fresnel * slope)[:, None]
    return np.minimum(total, lamping.BRIGHTEST_GLINT)


def _facade(s: Samples, light: Light, noise: NoiseSet) -> tuple[np.ndarray, np.ndarray]:
    """Albedo and added radiance (mirrored sky in the panes, rooms behind) of walls with windows."""
    pitch, storey, wide, tall = s.pattern.T
    u, v = s.uv[:, 0], s.uv[:, 1]
    blur = np.maximum(s.pixel_m, 0.01)
    tone = 1 + 0.05 * _noise(noise.soft, u, v, 0.05) + 0.05 * _noise(noise.rough, u * 3, v * _F(0.6), 0.04)
    tone += 0.05 * _noise(noise.grain, u, v, 0.02) * _fade(s.pixel_m, 0.06)
    tone *= np.where(v < 0.6, 0.62, 1.0)
    albedo = s.albedo * np.maximum(tone, 0.3)[:, None]
    row = v - 0.5
    frame_u = _pulse(u, pitch, np.minimum(wide + 0.20 / pitch, 0.9), blur)
    frame_v = _pulse(row, storey, np.minimum(tall + 0.20 / storey, 0.92), blur)
    frame = frame_u * frame_v * (row > 0)
    albedo += (_rgb(0.62, 0.61, 0.58) - albedo) * (frame * _F(0.85))[:, None]
    pane = _pulse(u, pitch, wide, blur) * _pulse(row, storey, tall, blur) * (row > 0)
    bar = np.abs(np.mod(u / pitch, 1.0) - 0.5) * pitch
    pane *= 1 - np.clip((0.035 - bar) / blur + 0.5, 0, 1) * np.minimum(0.07 / blur, 1)
    cell = _noise(
        noise.grain, np.floor(u / pitch) * 7.1 + pitch * 99, np.floor(row / storey) * 9.7 + storey * 55, 1.0
    )
    curtain = np.clip(cell * 0.5, 0, 1)
    inside = 0.02 + 0.22 * curtain
    sill = np.mod(row / storey, 1.0) - 0.5
    inside = inside * np.clip(1.0 - 1.4 * sill / np.maximum(tall, 0.1), 0.3, 1.0)
    albedo += (inside[:, None] * _rgb(1.0, 0.97, 0.92) - albedo) * pane[:, None]
    warm, cool = _rgb(*lamping.WINDOW_RGB), _rgb(*lamping.WINDOW_COOL)
    room = warm + (cool - warm) * (0.5 + 0.5 * np.sin(40 * cell))[:, None]
    lit = np.clip((cell - lamping.WINDOW_FROM) * lamping.WINDOW_SLOPE, 0, 1) * np.clip(1 + sill, 0.5, 1.5)
    room = room * (lit * pane * light.night)[:, None]
    view = unit(s.point)
    cosine = np.clip(-np.einsum("ni,ni->n", view, s.normal), 0, 1)
    mirror = view + 2 * cosine[:, None] * s.normal
    fresnel = 0.06 + 0.94 * (1 - cosine) ** 5
    tilt = mirror + (0.02 * cell)[:, None] * light.up.astype(_F)
    glare = (
        reflected_radiance(light, tilt.astype(_F), noise, np.full(3, MIRRORED_GROUND))
        * (fresnel * pane * 0.8)[:, None]
    )
    return albedo, glare + room


def _irradiance(s: Samples, light: Light, bounce: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """Light (n, 3) arriving on matt surfaces."""
    facing = s.normal @ light.up.astype(_F)
    slope = np.clip(s.normal @ light.sun.astype(_F), 0, 1) * s.lit
    sky = (0.5 + 0.5 * facing) * s.open_sky
    ground = (0.5 - 0.5 * facing) * s.open_sky
    return (
        slope[:, None] * light.sun_colour.astype(_F)
        + sky[:, None] * light.ambient.astype(_F)
        + ground[:, None] * bounce.astype(_F)
        + _lamplight(s, light, lamps)
    )


def _polish(
    s: Samples,
    light: Light,
    noise: NoiseSet,
    base: np.ndarray,
    gloss: tuple[float, float, float],
    lamps: np.ndarray,
) -> np.ndarray:
    """Radiance mirrored by a smooth coat, and of what shines: gloss is (reflectance at right angles, weight,
    sharpness of the sun).
    """
    view = unit(s.point)
    cosine = np.clip(-np.einsum("ni,ni->n", view, s.normal), 0, 1)
    mirror = (view + 2 * cosine[:, None] * s.normal).astype(_F)
    fresnel = gloss[0] + (1 - gloss[0]) * (1 - cosine) ** 5
    env = reflected_radiance(light, mirror, noise, np.full(3, MIRRORED_GROUND))
    hidden = 0.35 + 0.65 * s.open_sky
    out = env * (fresnel * gloss[1] * hidden)[:, None]
    glint = np.clip(mirror @ light.sun.astype(_F), 0, 1)
    sharp = (glint ** _F(gloss[2])) * 14.0 + (glint**12) * 0.25
    out += (sharp * fresnel * s.lit)[:, None] * light.sun_colour.astype(_F)
    out += _glints(s, light, lamps, lamping.COAT_ROUGH, gloss[0]) * gloss[1]
    return base + out + s.albedo * s.pattern[:, 1:2]


def shade(s: Samples, setting: Setting) -> np.ndarray:
    """Linear radiance (n, 3) of the samples as seen by the camera, haze included."""
    road, light, noise, lamps = setting.road, setting.light, setting.noise, setting.lamps
    out = np.zeros((len(s.material), 3), _F)
    extra = (ground_light(light), setting.view.height_m, lamps)
    order = np.argsort(s.material, kind="stable")
    bounds = np.searchsorted(s.material[order], np.arange(len(Material) + 1))
    for material in Material:
        index = order[bounds[material] : bounds[material + 1]]
        if len(index):
            some = s.take(index)
            colour = _surface(some, material, road, light, noise, extra)
            colour = _wetted(some, material, colour, light, noise, lamps) if light.wet > 0 else colour
            snowy = light.snow > 0 and material in GROUND
            out[index] = _slushed(some, colour, light, noise, extra) if snowy else colour
    distance = np.sqrt(np.einsum("ni,ni->n", s.point, s.point))
    through = np.exp(-light.haze_per_m * distance)[:, None].astype(_F)
    air = light.horizon * 0.6
    return out * through + air.astype(_F) * (1 - through)


def _surface(
    s: Samples,
    material: Material,
    road: Road,
    light: Light,
    noise: NoiseSet,
    extra: tuple[np.ndarray, float, np.ndarray],
) -> np.ndarray:
    bounce, camera_height_m, lamps = extra
    incoming = _irradiance(s, light, bounce, lamps)
    along_px = s.pixel_m * np.maximum(s.point[:, 2] / camera_height_m, 1.0) if material in GROUND else s.pixel_m
    u, v = s.uv[:, 0], s.uv[:, 1]
    if material == Material.ROAD:
        return _paint_road(s, road, noise, along_px) * incoming
    if material == Material.PARKING:
        return _paint_slabs(s, noise, along_px, 0.2, 0.02) * incoming
    if material == Material.PAVEMENT:
        return _paint_slabs(s, noise, along_px, 0.42, 0.016) * incoming
    if material == Material.KERB:
        tone = 1 + 0.12 * _noise(noise.soft, u, v, 0.05) - 0.35 * (1 - _pulse(v, 1.0, 0.98, along_px))
        return s.albedo * tone[:, None] * incoming
    if material == Material.GRASS:
        return _paint_grass(s, noise, along_px) * incoming
    if material == Material.GRAVEL:
        tone = 1 + 0.2 * _noise(noise.rough, u, v, 0.03) * _fade(along_px, 0.2)
        tone += 0.3 * _noise(noise.grain, u, v, 0.03) * _fade(along_px, 0.1)
        return s.albedo * np.maximum(tone, 0.3)[:, None] * incoming
    if material == Material.FACADE:
        albedo, glare = _facade(s, light, noise)
        return albedo * incoming + glare
    if material == Material.ROOF:
        tone = 1 + 0.12 * _noise(noise.soft, u, v, 0.06) + 0.1 * _noise(noise.grain, u, v, 0.1)
        tone *= 1 - 0.3 * (1 - _pulse(v, 0.34, 0.8, s.pixel_m)) * _fade(s.pixel_m, 0.25)
        return s.albedo * np.maximum(tone, 0.3)[:, None] * incoming
    if material == Material.WALL:
        tone = 1 + 0.10 * _noise(noise.soft, u, v, 0.04) + 0.12 * _noise(noise.rough, u * 2, v * _F(0.7), 0.03)
        return s.albedo * np.maximum(tone, 0.3)[:, None] * incoming
    if material == Material.FENCE:
        slat = _pulse(u, 0.13, 0.86, s.pixel_m)
        board = _noise(noise.grain, np.floor(u / 0.13) * 3.3, np.zeros_like(u), 1.0)
        tone = (0.25 + 0.75 * slat) * (1 + 0.15 * board * _fade(s.pixel_m, 0.13))
        tone *= 1 + 0.12 * _noise(noise.rough, u * 6, v, 0.05)
        return s.albedo * np.maximum(tone, 0.2)[:, None] * incoming
    if material == Material.LEAF:
        return _leaf(s, light, noise, incoming)
    if material == Material.BARK:
        p = s.world
        tone = 1 + 0.3 * _noise(noise.rough, (p[:, 0] + p[:, 2]) * 3, p[:, 1], 0.04)
        return s.albedo * np.maximum(tone, 0.3)[:, None] * incoming
    if material == Material.PAINT:
        return _polish(s, light, noise, _dirty(s, noise) * incoming, (0.05 + 0.02 * light.wet, 1.0, 600.0), lamps)
    if material == Material.GLASS:
        return _polish(s, light, noise, s.albedo * incoming, (0.07, 1.0, 900.0), lamps)
    if material == Material.LIGHT:
        return _polish(s, light, noise, s.albedo * 0.8 * incoming, (0.08, 0.9, 500.0), lamps)
    if material == Material.METAL:
        return _polish(s, light, noise, s.albedo * incoming, (0.10, 0.5, 40.0), lamps)
    if material in (Material.TYRE, Material.TRIM):
        return _polish(s, light, noise, s.albedo * 0.9 * incoming, (0.03, 0.5, 60.0), lamps)
    if material == Material.FLAT:
        tone = 1 + 0.08 * _noise(noise.soft, s.world[:, 0] + s.world[:, 2], s.world[:, 1], 0.03)
        return _polish(s, light, noise, s.albedo * tone[:, None] * incoming, (0.03, 0.4, 60.0), lamps)
    return s.albedo * incoming


def _wetted(
    s: Samples, material: Material, dry: np.ndarray, light: Light, noise: NoiseSet, lamps: np.ndarray
) -> np.ndarray:
    """Radiance (n, 3) after rain of what is `dry` before: darker, mirroring sky and skyline where water lies."""
    loss, film, more = SOAKED[material]
    out = dry * (1 - loss * _F(light.wet))
    if film + more <= 0:
        return out
    x, z = s.world[:, 0], s.world[:, 2]
    depth = _noise(noise.soft, x + 17, z * _F(0.5), 0.04) + 0.25 * _noise(noise.rough, x, z * _F(0.5), 0.03)
    puddle = np.clip((depth - 0.5) * 1.1, 0, 1)
    cover = _F(light.wet) * (film + more * puddle)
    view = unit(s.point)
    cosine = np.clip(-np.einsum("ni,ni->n", view, s.normal), 0, 1)
    share = (0.02 + 0.98 * (1 - cosine) ** 5) * cover
    mirror = (view + 2 * cosine[:, None] * s.normal).astype(_F)
    env = reflected_radiance(light, mirror, noise, np.full(3, MIRRORED_GROUND), soft=True)
    hidden = 0.25 + 0.75 * s.open_sky
    rough = lamping.WET_ROUGH + (lamping.PUDDLE_ROUGH - lamping.WET_ROUGH) * puddle
    glints = _glints(s, light, lamps, rough, 0.02) * (cover * hidden)[:, None]
    return out * (1 - share)[:, None] + env * (share * hidden)[:, None] + glints


def _slushed(
    s: Samples, bare: np.ndarray, light: Light, noise: NoiseSet, extra: tuple[np.ndarray, float, np.ndarray]
) -> np.ndarray:
    """Radiance (n, 3) of ground under patches of slush."""
    patch = _noise(noise.soft, s.world[:, 0] - 9, s.world[:, 2] * _F(0.5), 0.04)
    share = _F(light.snow) * np.clip(SLUSH_SHARE + SLUSH_PATCHES * patch, 0, 1)
    return bare + (_rgb(*SLUSH_RGB) * _irradiance(s, light, extra[0], extra[2]) - bare) * share[:, None]


def _dirty(s: Samples, noise: NoiseSet) -> np.ndarray:
    """Paint with road dust on the sills."""
    height = -s.world[:, 1]
    dust = np.clip(
        (0.55 - height) * 0.9 + 0.08 * _noise(noise.rough, s.world[:, 0] + s.world[:, 2], height, 0.02), 0, 0.35
    )
    return s.albedo + (_rgb(0.13, 0.115, 0.095) - s.albedo) * dust[:, None]


def _leaf(s: Samples, light: Light, noise: NoiseSet, incoming: np.ndarray) -> np.ndarray:
    """Foliage: diffuse, light shining through, and dark gaps between clusters."""
    p = s.world
    speckle = _noise(noise.grain, p[:, 0] + _F(0.6) * p[:, 2], p[:, 1] + _F(0.5) * p[:, 2], 0.035)
    clump = _noise(noise.soft, p[:, 0] + _F(0.5) * p[:, 2], p[:, 1] - _F(0.3) * p[:, 0], 0.06)
    tone = np.exp(0.32 * speckle * _fade(s.pixel_m, 0.09) + 0.22 * clump)
    through = np.clip(-(s.normal @ light.sun.astype(_F)), 0, 1) * s.lit * 0.35
    total = incoming + through[:, None] * light.sun_colour.astype(_F) * _rgb(1.0, 1.15, 0.5)
    return s.albedo * tone[:, None] * total
