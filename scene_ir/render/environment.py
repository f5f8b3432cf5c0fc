"""Sun, weather, time of day and foliage as smooth functions of picture, depth and maps; code 0 changes no bit.

Each effect is `x + s(code) * change(x)` with s(0) = 0: it passes through the photograph and is differentiable
there from both sides, although weather codes are bounded to [0, 1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from scene_ir.geometry import clamp_inclusive, height_above_ground
from scene_ir.image_filters import push_pull
from scene_ir.raster.verbs import Backend
from scene_ir.render import model
from scene_ir.render.reflections import by_row, mirror_share
from scene_ir.render.texture import lab_to_soft_rgb, rgb_to_lab, smoothstep
from scene_ir.types import DAYLIGHT_DIM, Environment, SceneIR, Weather


def sky_colour(photograph: Tensor, sky: Tensor) -> Tensor:
    """Mean colour (3,) of the photographed sky, or a bright overcast where there is none."""
    weight = sky * (sky > 0.5)
    total = weight.sum()
    default = photograph.new_tensor(model.SKY_RGB)
    mean = (photograph * weight).flatten(1).sum(dim=1) / total.clamp(min=1.0)
    share = (total / 500.0).clamp(max=1.0)
    return share * mean + (1.0 - share) * default


def shadow_softening(weather: Tensor) -> Tensor:
    """Factor () by which weather and night weaken cast shadows; 1 at code 0. weather: (6,)."""
    return torch.exp(-(weather.new_tensor(model.SHADOW_SOFTENING) * weather).sum())


def low_sun_share(fog: Tensor, rain: Tensor, overcast: Tensor) -> Tensor:
    """Share () of a low sun's warm light that reaches the street: under clouds and in fog, dusk is grey to blue."""
    return (1.0 - fog) * (1.0 - rain) * (1.0 - overcast)


def sunlight_share(weather: Tensor) -> Tensor:
    """Share () of the photographed sunlight that is left under a weather code (6,); 1 at code 0. Twilight and night
    have none; fog, rain, snow and clouds cover it.
    """
    clear = low_sun_share(weather[Weather.FOG], weather[Weather.RAIN], weather[Weather.OVERCAST])
    clear = clear * (1.0 - weather[Weather.SNOW])
    return clear * (1.0 - weather[Weather.TIME].square()) * (1.0 - weather[Weather.NIGHT])


@torch.no_grad()
def compute_closed_sky_gain(closed_sky: Tensor, background: Tensor, sky: Tensor, focal_px: float) -> Tensor:
    """Relative change (3, H, W) of a background under a closed sky.

    A guided filter (He et al., ECCV 2010) moves the steps of the codes to the background's edges, where cast shadows
    end. The sky does not change: its colour is the weather's.

    Args:
        closed_sky: (3, h, w) codes of a picture, see `Environment.closed_sky`.
        background: (3, H, W) RGB in [0, 1], that picture.
        sky: (H, W) in [0, 1].
        focal_px: Focal length.
    """
    log_ratio, image = (
        np.ascontiguousarray(t.permute(1, 2, 0).float().cpu().numpy()) for t in (closed_sky, background)
    )
    log_ratio = (2.0 * log_ratio - 1.0) * np.float32(model.CLOSED_SKY_LOG)
    large = cv2.resize(log_ratio, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    guide = np.log(image + np.float32(model.CLOSED_SKY_OFFSET))
    radius = max(2, round(model.CLOSED_SKY_RADIUS * focal_px))
    sharp = cv2.ximgproc.guidedFilter(guide, large, radius, model.CLOSED_SKY_EDGE)
    burnt = smoothstep(torch.from_numpy(image.max(axis=2)), *model.CLOSED_SKY_BURNT).numpy()[..., None]
    sharp = sharp + burnt * (sharp.mean(axis=2, keepdims=True) - sharp)
    gain = np.expm1(sharp.clip(-model.CLOSED_SKY_LOG, model.CLOSED_SKY_LOG))
    change = torch.from_numpy(np.ascontiguousarray(gain.transpose(2, 0, 1))).to(background)
    return change * (1.0 - sky.to(change))


def time_gain(time: Tensor, low_sun: Tensor) -> Tensor:
    """Relative change (3,) of RGB by the time of day, a code () in [0, 1]: warm light at one half, then blue
    twilight. low_sun: () of `low_sun_share`.
    """
    square = time * time
    darkening, warmth = time.new_tensor(model.DARKENING), time.new_tensor(model.WARMTH)
    dusk, dim = torch.exp(-model.DUSK_ENDS * square), torch.exp(-model.DIMMING_ENDS * square)
    return torch.expm1(-darkening * square) + (low_sun * warmth * time * dusk - model.DIMMING * time * dim)


@torch.no_grad()
def compute_crown_maps(scene: SceneIR) -> Tensor:
    """Effect of density on foliage, (5, H, W) in [0, 1]: how far a pixel opens in a thin crown; how far it darkens
    in a thick one; RGB behind the leaves.

    The first two are 0 on the ground, as grass is no crown. Behind leaves lies what surrounds them: the sky where
    they stand before it, a wall where they climb it.
    """
    amount, photo = scene.environment.foliage_map, scene.background
    gaps = _leaf_gaps(*amount.shape).to(photo)
    height = height_above_ground(scene.depth, scene.environment.ground, scene.camera.matrix)
    standing = (height / model.GRASS_M).clamp(0.0, 1.0).to(photo)
    known = (1.0 - amount.clamp(0.0, 1.0)).square().float().cpu().numpy()
    behind = push_pull(np.ascontiguousarray(photo.permute(1, 2, 0).float().cpu().numpy()), known)
    shows = torch.from_numpy(behind).permute(2, 0, 1).to(photo)
    return torch.stack([standing * gaps, standing * (1.0 - gaps), *shows])


def apply_foliage(
    image: Tensor, environment: Environment, crowns: Tensor, backend: Backend = "reference"
) -> Tensor:
    """The picture (3, H, W) with its foliage changed by `environment.foliage`, (3,) in [-1, 1].

    Hue turns leaves from spring's blue-green (-1) through the photographed colour (0) to autumn's orange (1);
    lightness is a curve in CIE L*; density darkens the crowns (1) or opens them (-1). Differentiable to all; with
    backend `warp` (float32, fused) to picture and code.

    Args:
        image: (3, H, W).
        environment: Foliage code and map.
        crowns: Result of `compute_crown_maps`.
        backend: Implementation.
    """
    if backend == "warp":
        from scene_ir.render.kernels import effects

        return effects.apply_foliage(image, environment, crowns)
    amount = environment.foliage_map.to(image)
    index = (amount.flatten() > model.FEWEST_LEAVES).nonzero()[:, 0]
    if index.numel() == 0:
        return image
    maps = crowns.to(image).flatten(1)[:, index].T
    rows = image.flatten(1)[:, index].T
    code = environment.foliage.to(image)
    change = _leaves(rows, code, maps) - _leaves(rows, torch.zeros_like(code), maps)
    change = change * amount.flatten()[index][:, None]
    return image.flatten(1).index_add(1, index, change.T).reshape(image.shape)


def _leaves(rgb: Tensor, code: Tensor, maps: Tensor) -> Tensor:
    """The leaf model on rows (R, 3); maps (R, 5) as of `compute_crown_maps`."""
    hue, shift, density = code.unbind(-1)
    lightness, a, b = rgb_to_lab(clamp_inclusive(rgb, 0.0, 1.0)).unbind(-1)
    level = clamp_inclusive(lightness / 100.0, *model.LEVEL)
    lifted = torch.sigmoid(torch.logit(level) + model.LEAF_LIGHTNESS * shift)
    chroma = (1.0 + model.LEAF_CHROMA * hue) * (lifted / level).sqrt()
    level = lifted
    angle = -(model.LEAF_TURN + model.LEAF_TURN_MORE * torch.tanh(model.LEAF_TURN_BEND * hue)) * hue
    cos, sin = torch.cos(angle), torch.sin(angle)
    room = 4.0 * level * (1.0 - level)
    red = chroma * (cos * a - sin * b) + model.LEAF_RED * hue * room
    yellow = chroma * (sin * a + cos * b) + model.LEAF_YELLOW * hue * room
    out = lab_to_soft_rgb(torch.stack([100.0 * level, red, yellow], dim=-1))
    thick = density * torch.sigmoid(model.CROWN_BEND * density)
    thin = -density * torch.sigmoid(-model.CROWN_BEND * density)
    out = out + (thick * model.THICK_SHARE * maps[:, 1])[:, None] * (model.THICK_DARKNESS * out - out)
    return out + (thin * model.THIN_SHARE * maps[:, 0])[:, None] * (maps[:, 2:] - out)


def apply_weather(
    image: Tensor,
    inverse_depth: Tensor,
    environment: Environment,
    air: Tensor,
    mirrored: Tensor | None = None,
    backend: Backend = "reference",
    spray: Tensor | None = None,
) -> Tensor:
    """The picture (3, H, W) under `environment.weather`: fog, rain, time of day, overcast, and the haze, clouds and
    slush of snow. Its flakes are `add_flakes`, night is `night.apply_night`.

    Differentiable to all, including the maps of sky and road; with backend `warp` (float32, fused) to all but the
    airlight, and to the road only where there is some.

    Args:
        image: (3, H, W).
        inverse_depth: (H, W) 1/m, 0 in the sky.
        environment: Weather code, maps of sky and road, ground.
        air: (3,) RGB of the airlight.
        mirrored: (4, H, W), picture and sky as of `reflections.mirror_in_ground`; None where no road is wet.
        backend: Implementation.
        spray: (H, W), of `spray.draw_spray`; None where there is none.
    """
    weather, snow = _daylight_codes(environment.weather.to(image)), environment.weather[Weather.SNOW].to(image)
    if snow.requires_grad or bool(snow.detach() != 0):
        slush = by_row(model.SLUSH * snow, image.shape[1]) * environment.road.to(image)
        image = image + slush * (model.SLUSH_LIGHT - image)
    streaks = _rain_streaks(*environment.sky.shape).to(image)
    drops = streaks if spray is None else streaks + spray
    inputs = (image, inverse_depth, weather, air, environment, mirrored, drops)
    if backend == "warp":
        from scene_ir.render.kernels import effects

        return effects.apply_weather(*inputs)
    return _apply_daylight(*inputs)


def add_flakes(image: Tensor, inverse_depth: Tensor, environment: Environment, air: Tensor) -> Tensor:
    """The picture (3, H, W) with the flakes of `environment.weather`'s snow in front of what is farther away;
    differentiable to all. Other arguments as of `apply_weather`.
    """
    depth = 1.0 / inverse_depth.clamp(min=1.0 / model.HAZE_CAP_M)
    layers = _flakes(*inverse_depth.shape).to(image)
    nearest = image.new_tensor(model.FLAKE_M)[:, None, None]
    opacity = ((depth / nearest - 1.0).clamp(0.0, 1.0) * layers).sum(dim=0)
    weather = environment.weather.to(image)
    lit = model.FLAKE_LIGHT * _weathered_air(air, _daylight_codes(weather))[:, None, None]
    return image + by_row(weather[Weather.SNOW], len(opacity)) * opacity.clamp(max=1.0) * (lit - image)


def _daylight_codes(weather: Tensor) -> Tensor:
    """Fog, rain, time, overcast and the low sun's share (5,), with the haze and the clouds of snow; weather: (6,)."""
    fog, rain, time, overcast = weather[:DAYLIGHT_DIM]
    snow = weather[Weather.SNOW]
    fog = fog + model.SNOW_FOG * snow * (1.0 - fog)
    overcast = overcast + model.SNOW_COVER * snow * (1.0 - overcast)
    return torch.stack([fog, rain, time, overcast, low_sun_share(fog, rain, overcast)])


def _weathered_air(air: Tensor, weather: Tensor) -> Tensor:
    """The airlight (3,) under codes (5,) of `_daylight_codes`."""
    fog, rain, time, overcast, low_sun = weather
    luma = air.new_tensor(model.LUMA)
    grey = (air * luma).sum()
    air = air + model.OVERCAST * overcast * (model.OVERCAST_AIR * grey - air)
    air = air + model.HAZE_GREY * (fog + rain - fog * rain) * ((air * luma).sum() - air)
    return air + time_gain(time, low_sun) * air


def _apply_daylight(
    image: Tensor,
    inverse_depth: Tensor,
    weather: Tensor,
    air: Tensor,
    environment: Environment,
    mirrored: Tensor | None,
    drops: Tensor,
) -> Tensor:
    """Fog, rain, time of day and overcast.

    Args:
        image, inverse_depth, air, mirrored: As of `apply_weather`.
        weather: (5,) of `_daylight_codes`.
        environment: Maps of sky and road, ground.
        drops: (H, W), opacity of rain 1 that is near: streaks and spray.
    """
    fog, rain, _, _, _ = weather
    depth = 1.0 / inverse_depth.clamp(min=1.0 / model.HAZE_CAP_M)
    image = _dampen(image, environment.sky.to(image), weather, air)
    mist = _weathered_air(air, weather)[:, None, None]
    if mirrored is not None:
        # A wet road is darker, and mirrors what stands above it.
        share = mirror_share(depth, environment.ground[3].to(image))
        mirror = _dampen(mirrored[:3], mirrored[3], weather, air)
        sheen = model.SHEEN_MIRROR * mirror + model.SHEEN_AIR * mist - model.WET_ROAD * image
        wet = rain * environment.road.to(image)
        image = image + wet * ((model.WET_ROAD - 1.0) * image + share * sheen)
    veil = -torch.expm1(-model.RAIN_EXTINCTION_PER_M * rain * depth)
    image = apply_veil(image, veil, model.RAIN_AIR * mist)
    image = image + rain * drops * (mist - image)
    # Fog (Koschmieder 1924).
    return apply_veil(image, -torch.expm1(-model.FOG_EXTINCTION_PER_M * fog * depth), mist)


def _dampen(image: Tensor, sky: Tensor, weather: Tensor, air: Tensor) -> Tensor:
    """The picture (3, H, W) with share of sky (H, W) under a closed cover, by time of day, and wet."""
    _, rain, time, overcast, low_sun = weather
    luma = image.new_tensor(model.LUMA)
    grey_air = (air * luma).sum().expand(3)
    # Overcast: less colour, less contrast, a plain sky.
    grey = (image * luma[:, None, None]).sum(dim=0, keepdim=True)
    flat = model.OVERCAST_COLOUR * image + (1.0 - model.OVERCAST_COLOUR) * grey
    flat = model.OVERCAST_TO + model.OVERCAST_CONTRAST * (flat - model.OVERCAST_FROM)
    cover = (model.COVER_AIR * grey_air + model.COVER_LIGHT)[:, None, None]
    cover = cover + model.COVER_STRUCTURE * (grey - grey_air.mean())
    image = image + model.OVERCAST * overcast * (flat + sky * (cover - flat) - image)
    sky_gain = image.new_tensor(model.TWILIGHT_SKY) * time * time
    image = image + (time_gain(time, low_sun)[:, None, None] + sky * sky_gain[:, None, None]) * image
    grey = (image * luma[:, None, None]).sum(dim=0, keepdim=True)
    damp = model.DAMP_LIGHT * (model.DAMP_COLOUR * image + (1.0 - model.DAMP_COLOUR) * grey)
    return image + model.DAMP * rain * (damp - image)


def apply_veil(image: Tensor, veil: Tensor, air: Tensor) -> Tensor:
    """A picture behind a veil; a veil of 0 changes no bit.

    Light adds up, display values do not: they are squared first, which is close to a display's exponent of 2.2.
    The root is bent near black, so that it has a slope there.

    Args:
        image: (3, H, W).
        veil: (H, W) in [0, 1], share of air.
        air: (3, 1, 1).
    """
    light = image * image + model.VEIL_BEND**2
    return image + (torch.sqrt(light + veil * (air * air - image * image)) - torch.sqrt(light))


@lru_cache(maxsize=8)
def _rain_streaks(height: int, width: int) -> Tensor:
    """Opacity (H, W) of the streaks of rain 1: sparse drops drawn out along a slight slant; constant per frame size."""
    import kornia

    generator = torch.Generator().manual_seed(20190416)
    drops = (torch.rand(height, width, generator=generator) > 0.9965).float()
    length = max(5, height // 24)
    kernel = torch.zeros(length, length)
    rows = torch.arange(length)
    kernel[rows, (length // 2 + (rows - length // 2) * 0.18).round().long()] = torch.hann_window(length + 2)[1:-1]
    padded = torch.nn.functional.pad(drops[None, None], (length // 2, (length - 1) // 2) * 2)
    streaks = torch.nn.functional.conv2d(padded, kernel[None, None])
    return kornia.filters.gaussian_blur2d(streaks, (3, 3), (0.6, 0.6))[0, 0].clamp(0.0, 1.0) * model.STREAKS


@lru_cache(maxsize=8)
def _flakes(height: int, width: int) -> Tensor:
    """Opacity (L, H, W) in [0, 1] of falling flakes, in layers that begin at `model.FLAKE_M`; constant per frame size.

    Each is a Gaussian, drawn out by its fall and away from the point that the camera drives towards.
    """
    rng, counts = np.random.default_rng(19310115), np.rint(np.array(model.FLAKES) * height / width).astype(int)
    layers = np.zeros((len(model.FLAKE_M), height, width))
    for layer, near_m, count in zip(layers, model.FLAKE_M, counts, strict=True):
        px_per_m = model.FLAKE_FOCAL * width / rng.uniform(near_m, 3.0 * near_m, count)
        x, y = rng.uniform(0, width, count), rng.uniform(0, height, count)
        sharp = model.FLAKE_RADIUS_M * rng.uniform(0.5, 1.5, count) * px_per_m
        radius = np.hypot(np.hypot(sharp, model.FLAKE_BLUR_M * px_per_m), model.FLAKE_LEAST_PX)
        drive = model.FLAKE_DRIVE_M / (model.FLAKE_FOCAL * width) * px_per_m
        along = np.stack(
            [drive * (x - width / 2), drive * (y - height / 2) + model.FLAKE_FALL_M * px_per_m], axis=1
        )
        length = np.linalg.norm(along, axis=1)
        opacity = np.minimum(model.FLAKE_OPACITY * sharp**2 / (radius * (radius + length)), 1.0)
        for i in range(count):
            reach = math.ceil(3 * radius[i] + length[i] / 2)
            rows = np.arange(max(0, int(y[i]) - reach), min(height, int(y[i]) + reach + 1))[:, None]
            columns = np.arange(max(0, int(x[i]) - reach), min(width, int(x[i]) + reach + 1))
            dx, dy = columns - x[i], rows - y[i]
            ux, uy = along[i] / max(length[i], 1e-6)
            beyond = np.maximum(np.abs(dx * ux + dy * uy) - length[i] / 2, 0.0)
            square = np.square(beyond) + np.square(dx * uy - dy * ux)
            layer[rows, columns] += opacity[i] * np.exp(-0.5 * square / radius[i] ** 2)
    return torch.from_numpy(layers).clamp(0.0, 1.0)


@lru_cache(maxsize=8)
def _leaf_gaps(height: int, width: int) -> Tensor:
    """Gaps (H, W) in [0, 1] of thin foliage: band-limited noise of a few pixels; constant per frame size."""
    import kornia

    generator = torch.Generator().manual_seed(19240901)
    noise = torch.rand(1, 1, height, width, generator=generator)
    fine = kornia.filters.gaussian_blur2d(noise, (5, 5), (1.0, 1.0), border_type="replicate")
    coarse = kornia.filters.gaussian_blur2d(noise, (21, 21), (4.0, 4.0), border_type="replicate")
    mixed = (fine - 0.5) / fine.std().clamp(min=1e-6) + 0.5 * (coarse - 0.5) / coarse.std().clamp(min=1e-6)
    return torch.sigmoid(2.0 * mixed - 1.0)[0, 0]


@dataclass(frozen=True, slots=True)
class PerturbedSun:
    """The sun of a perturbed scene, differentiable to `Environment.light`."""

    direction: Tensor
    """(3,) unit vector towards it, camera axes."""
    strength: Tensor
    """() Light relative to the photographed sun."""
    shade: Tensor
    """() Strength of its shadows relative to the photographed ones."""
    hidden: Tensor
    """() How far clouds hide it, in [0, 1]; 0 where it is not known how the scene looks without it."""

    @classmethod
    def from_environment(cls, environment: Environment, like: Tensor, sunlight: Tensor) -> PerturbedSun:
        """The sun under `environment.light`, and as far as `environment.weather` leaves it; at code 0 exactly the
        photographed one, with both factors 1.

        Args:
            environment: Sun, ground, light and weather code; weather covers the sun where the closed sky is known.
            like: Tensor of the wanted dtype and device.
            sunlight: () Strength of the photographed sun, as in `Source.sunlight`.
        """
        sun, up = environment.sun.to(like), environment.ground[:3].to(like)
        code = environment.light.to(like)
        still = torch.zeros_like(code)
        # The change by the code is added, so that code 0 rounds nothing.
        direction = sun + (move_sun(sun, up, code) - move_sun(sun, up, still))
        strength = 1.0 + model.SUN_STRENGTH * code[2]
        shade = _shadow_strength(direction, up, sunlight * strength) / _shadow_strength(sun, up, sunlight).clamp(
            min=1e-6
        )
        hidden = torch.zeros_like(strength)
        if environment.closed_sky is not None:
            hidden = 1.0 - sunlight_share(environment.weather.to(like))
            strength = strength * (1.0 - hidden)
        return cls(direction, strength, torch.where(sunlight > 0, shade, torch.ones_like(shade)), hidden)


def move_sun(sun: Tensor, up: Tensor, code: Tensor) -> Tensor:
    """Direction (3,) towards the sun under a light code: turned about `up`, clockwise seen from above, and risen.

    Args:
        sun: (3,) unit.
        up: (3,) unit.
        code: (3,) light code.
    """
    sine = (sun * up).sum()
    flat = torch.nn.functional.normalize(sun - sine * up, dim=0)
    azimuth, height = model.SUN_TURN_RAD * code[0], torch.asin(sine) + model.SUN_RISE_RAD * code[1]
    along = torch.cos(azimuth) * flat + torch.sin(azimuth) * torch.linalg.cross(flat, up)
    return torch.cos(height) * along + torch.sin(height) * up


def _shadow_strength(sun: Tensor, up: Tensor, sunlight: Tensor) -> Tensor:
    """Share of the light on the ground that a shadow removes."""
    direct = sunlight * (sun * up).sum().clamp(min=0.0)
    return direct / (sum(model.AMBIENT) + direct)
