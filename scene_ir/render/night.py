"""Night: the photograph under street lamps and the own car's headlamps, as a night camera sees it.

The same surfaces get other light: daylight falls to that of street lamps, the headlamps light what is near and below
their cut-off, and what shone in the photograph shines on. Light adds up as squares of display values, as for veils
(`environment.apply_veil`). The share of night s(code) has s(0) = 0, and the picture is x + s change(x): code 0 changes
no bit, and both sides have a slope.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from scene_ir.geometry import height_above_ground
from scene_ir.raster.verbs import Backend
from scene_ir.render import model
from scene_ir.render.channels import AIM, CORNER, GLARE, NIGHT_MAPS, NOISE, RISE, STREET, WET
from scene_ir.render.reflections import by_row, mirror_in_ground, mirror_share
from scene_ir.types import Environment, SceneIR, Weather


@dataclass(frozen=True, slots=True)
class NightMaps:
    """What night needs to know of a scene's pixels."""

    maps: Tensor
    """(14, H, W): rise of a pixel's ray, metres of height per metre of depth; share of the headlamps' beam, with the
    gain of signs; light of the street lamps relative to that in a pool, for sky its glow relative to the horizon's;
    share of the pixel that shines; loss of light towards the corners; standard normal noise (3); glare (3), light;
    what a wet road mirrors of lamps (3), light."""
    camera_m: float
    """Height of the camera above the ground."""
    by_day: float
    """How far the photograph is taken by day, in [0, 1]; the code changes it so far."""


@torch.no_grad()
def compute_night_maps(scene: SceneIR, background: Tensor) -> NightMaps:
    """Maps of a scene, by its depth, sky and camera, and its background without direct sun (3, H, W), as far as that is
    known.
    """
    height, width = scene.camera.height, scene.camera.width
    like = scene.background
    ground, matrix = (
        scene.environment.ground.double().cpu(),
        scene.camera.matrix.double().cpu(),
    )
    up = torch.linalg.inv(matrix[:, :3]).T @ ground[:3]
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    rise = up[0] * columns + up[1] * rows + up[2]
    camera_m = float(ground[3] - up @ matrix[:, 3])
    tangent = ((columns - matrix[0, 2]) / matrix[0, 0]).numpy()
    sky, leaves = (getattr(scene.environment, name).double().cpu().numpy() for name in ("sky", "foliage_map"))
    depth = scene.depth.double().cpu().numpy()
    rgb = background.permute(1, 2, 0).double().cpu().numpy()
    aim = model.HEAD_SIDE + (1 - model.HEAD_SIDE) * np.exp(-np.square(tangent / model.HEAD_AIM))
    aim = aim * (1 + model.RETRO * _signs(rgb, sky, leaves))
    above_m = height_above_ground(scene.depth, scene.environment.ground, scene.camera.matrix).cpu().numpy()
    street = _street_light(tangent * np.where(np.isfinite(depth), depth, 0.0), depth)
    road = scene.environment.road.double().cpu().numpy()[..., None]
    level = float((road * np.square(rgb)).sum() / max(3 * float(road.sum()), 1.0)) or model.ROAD_LIGHT
    exposure = float(np.clip(model.ROAD_LIGHT / level, *model.EXPOSURE))
    missed = _missed_sky(rgb, sky, leaves)
    aim, street = exposure * (1 - missed) * aim, (1 - missed) * street
    lit = find_lit(rgb, np.maximum(sky, leaves)) * _ramp(above_m, *model.LIT_HEIGHT_M)
    horizon = float(matrix[1, 2] / height)
    glow = np.exp(-np.maximum(horizon - rows.numpy() / height, 0.0) / model.GLOW_HEIGHT)
    lamps = _street_lamps(scene, depth)
    shining = (lit * np.square(rgb).max(axis=2))[..., None] * np.square(rgb) * model.LIT_GAIN + lamps
    glare = sum(share * _blur(shining, sigma * height) for sigma, share in model.GLARE)
    radius = np.square(columns.numpy() / width - 0.5) + np.square(rows.numpy() / height - 0.5)
    planes = [rise.numpy(), aim, np.where(sky > 0.5, glow, street), lit, 2 * model.CORNER * radius]
    fixed = torch.from_numpy(np.stack([*planes])).to(like)
    glare = glare + lamps + ((1 - sky) * missed * glow)[..., None] * np.array(model.GLOW_RGB)
    glare, shining = (
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(light, 2, 0))).to(like.dtype)
        for light in (glare, shining)
    )
    far, flat = scene.depth.cpu(), scene.environment.road.cpu()
    mirrored = mirror_in_ground(shining, 1.0 / far, flat, rise, camera_m)
    wet = model.LIT_MIRROR * mirror_share(far, camera_m).to(like.dtype) * mirrored
    return NightMaps(
        torch.cat([fixed, _noise_field(height, width).to(like), glare.to(like), wet.to(like)]),
        camera_m,
        measure_daylight(scene),
    )


def measure_daylight(scene: SceneIR) -> float:
    """How far a scene's photograph is taken by day, in [0, 1]."""
    return float(_ramp(np.array(float(scene.photograph.square().mean())), *model.BY_DAY))


def night_share(code: Tensor, night: NightMaps) -> Tensor:
    """How far () it is night, in [0, 1], under weather (6,); 0 at code 0."""
    return torch.expm1(-model.NIGHTFALL * code[Weather.NIGHT]) * (night.by_day / math.expm1(-model.NIGHTFALL))


def apply_night(
    image: Tensor,
    inverse_depth: Tensor,
    environment: Environment,
    lit: Tensor,
    lamps: Tensor,
    night: NightMaps,
    backend: Backend = "reference",
) -> Tensor:
    """The picture (3, H, W) by night, as far as `environment.weather` has it, with lamps on; differentiable to all but
    the maps.

    Args:
        image: (3, H, W).
        inverse_depth: (H, W) 1/m, 0 in the sky.
        environment: Weather code, maps of sky and road.
        lit: (H, W) in [0, 1], share of each pixel that shines: the map, where nothing hides it.
        lamps: (3, H, W), light of the vehicles' lamps.
        night: Maps of the scene.
        backend: Implementation.
    """
    code = environment.weather.to(image)
    share = night_share(code, night)
    growth = 1.0 + model.GLARE_FOG * code[Weather.FOG] + model.GLARE_RAIN * code[Weather.RAIN]
    sky, maps = environment.sky.to(image), night.maps.to(image)
    lamps = (
        lamps + by_row(share * code[Weather.RAIN], len(sky)) * environment.road.to(image) * maps[WET:NIGHT_MAPS]
    )
    if backend == "warp":
        from scene_ir.render.kernels import night as kernels

        settings = torch.stack([share, growth])
        return kernels.apply_night(image, inverse_depth, sky, lit, lamps, settings, maps, night.camera_m)
    depth = 1.0 / inverse_depth.clamp(min=1.0 / model.HAZE_CAP_M)
    height = night.camera_m + depth * maps[RISE]
    below = torch.sigmoid((model.HEAD_CUT_M - height) / model.HEAD_SOFT_M)
    beam = maps[AIM] * (model.HEAD_ABOVE + (1.0 - model.HEAD_ABOVE) * below)
    head = beam / (1.0 + (depth / model.HEAD_FAR_M).square())
    colours = image.new_tensor([model.STREET_RGB, model.HEAD_RGB, (model.LIT_GAIN,) * 3, model.GLOW_RGB])
    colours = colours[..., None, None]
    shone = maps[STREET] * colours[0] + lit * colours[2]
    day = image.square()
    surface = day / (1.0 + model.SUN_SOFTENED * day)
    headlit = head * colours[1] * (day + model.RETRO_WHITE * day.pow(3))
    light = (surface * shone + headlit) * (1.0 - sky) + sky * maps[STREET] * colours[3] + growth * maps[GLARE:WET]
    bend = model.NIGHT_BEND**2
    # Lamps on a road that a vehicle hides with an opacity beyond 1 are slightly negative.
    dark_light = (day + share * (light - day) + lamps).clamp(min=0.0)
    dark = image + (torch.sqrt(dark_light + bend) - torch.sqrt(day + bend))
    seen = dark * (1.0 - share * maps[CORNER])
    return seen + share * maps[NOISE:GLARE] * (model.NOISE + model.NOISE_LEVEL * seen)


def _signs(rgb: np.ndarray, sky: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """How far (H, W) a pixel of the background (H, W, 3) is a sign: strong colour, neither sky nor leaves."""
    chroma = cv2.GaussianBlur(np.ptp(rgb, axis=2), (0, 0), 1.0)
    return _ramp(chroma, *model.RETRO_CHROMA) * (1 - np.maximum(sky, leaves))


def find_lit(rgb: np.ndarray, open_to: np.ndarray) -> np.ndarray:
    """How far (H, W) a pixel of the background (H, W, 3) shines: small and brighter than all around, as lamps and
    windows are; not next to the sky, as its light comes through leaves and wires.
    """
    size = max(3, rgb.shape[0] // 24) | 1
    # Thin bright lines are frames and wires.
    solid = max(3, rgb.shape[0] // 150)
    value = cv2.morphologyEx(rgb.max(axis=2), cv2.MORPH_OPEN, np.ones((solid, solid)))
    around = cv2.morphologyEx(value, cv2.MORPH_OPEN, np.ones((size, size)))
    near_sky = cv2.dilate((open_to > 0.2).astype(np.float64), np.ones((2 * size + 1,) * 2))
    small = _ramp(value - around, *model.LIT_CONTRAST)
    return _ramp(value, *model.LIT_LEVEL) * small * (1 - near_sky)


def _missed_sky(rgb: np.ndarray, sky: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """How far (H, W) a pixel shows day's sky, though the map of the sky does not have all of it: in the gaps of leaves,
    and where that map ends.
    """
    grey = rgb.mean(axis=2)
    size = max(3, rgb.shape[0] // 24) | 1
    gaps = grey - cv2.morphologyEx(grey, cv2.MORPH_OPEN, np.ones((size, size)))
    return np.maximum(leaves * _ramp(gaps, 0.1, 0.3), _ramp(sky, 0.0, 0.1) * _ramp(grey, 0.5, 0.75))


def _street_light(aside_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Light (H, W) of the street lamps: pools along the road, relative to the middle of one."""
    total = np.zeros_like(depth_m)
    for x, z in _street_posts():
        square = np.square(aside_m - x) + np.square(np.minimum(depth_m, model.HAZE_CAP_M) - z)
        total += np.power(1 + square / model.STREET_LAMP_M**2, -1.5)
    return model.STREET_BASE + (1 - model.STREET_BASE) * np.minimum(total, 1.2)


def _street_posts() -> list[tuple[float, float]]:
    """Places (x, z) m of street lamps."""
    steps = np.arange(0.6, model.STREET_FAR_M / model.STREET_EVERY_M, 0.5)
    sides = np.where(np.arange(len(steps)) % 2, -model.STREET_ASIDE_M, model.STREET_ASIDE_M)
    return list(zip(sides.tolist(), (model.STREET_EVERY_M * steps).tolist(), strict=True))


def _other_lamps() -> list[tuple[float, float, float, tuple[float, float, float]]]:
    """Places (x, height, z) m and colours of lamps at houses and crossings; the same in all scenes."""
    generator = np.random.default_rng(19390102)
    lamps = []
    for z in np.arange(*model.HOUSE_LAMPS_M):
        x = float(generator.choice([-1, 1]) * generator.uniform(*model.HOUSE_ASIDE_M))
        colour = model.HOUSE_LAMP_RGB[int(generator.integers(len(model.HOUSE_LAMP_RGB)))]
        lamps.append((x, float(generator.uniform(*model.HOUSE_LAMP_HEIGHT_M)), float(z), colour))
    return lamps


def _street_lamps(scene: SceneIR, depth_m: np.ndarray) -> np.ndarray:
    """Images (H, W, 3) of the lamps along the street that nothing hides, as light."""
    height, width = depth_m.shape
    out = np.zeros((height, width, 3))
    ground = scene.environment.ground.double().cpu().numpy()
    matrix = scene.camera.matrix.double().cpu().numpy()
    down = -ground[:3]
    far = [(x, z) for x, z in _street_posts() if z >= model.STREET_VISIBLE_M]
    posts = [(x, model.STREET_LAMP_M, z, model.STREET_LAMP_RGB) for x, z in far]
    for x, high, z, colour in posts + _other_lamps():
        # on the ground below, then up
        foot = np.array([x, (-ground[3] - ground[0] * x - ground[2] * z) / ground[1], z])
        u, v, w = matrix @ np.append(foot - down * high, 1.0)
        column, row = round(u / w), round(v / w)
        if not (0 <= column < width and 0 <= row < height) or depth_m[row, column] < model.LAMP_SHOWS * z:
            continue
        size = model.STREET_LAMP_AT_10_M * (high / model.STREET_LAMP_M) ** 0.5
        radius = max(size * 10 / z * height / 720, 0.35)
        xs, ys = np.arange(width) - u / w, np.arange(height) - v / w
        spot = np.exp(-0.5 * np.square(ys / radius))[:, None] * np.exp(-0.5 * np.square(xs / radius))
        out += spot[..., None] * 2.5 * np.array(colour)
    return out


def _blur(light: np.ndarray, sigma_px: float) -> np.ndarray:
    """Light (H, W, 3), blurred."""
    return cv2.GaussianBlur(light, (0, 0), max(sigma_px, 0.3), borderType=cv2.BORDER_CONSTANT)


def _ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    share = np.clip((values - low) / (high - low), 0, 1)
    return share * share * (3 - 2 * share)


@lru_cache(maxsize=8)
def _noise_field(height: int, width: int) -> Tensor:
    """Noise (3, H, W) of a camera, of standard deviation 1, mostly of brightness; constant per frame size."""
    import kornia

    generator = torch.Generator().manual_seed(19390101)
    grey, colour = (
        torch.randn(1, 1, height, width, generator=generator),
        torch.randn(1, 3, height, width, generator=generator),
    )
    grey = kornia.filters.gaussian_blur2d(grey, (5, 5), (0.6, 0.6), border_type="reflect")
    colour = kornia.filters.gaussian_blur2d(colour, (9, 9), (1.5, 1.5), border_type="reflect")
    mixed = grey / grey.std().clamp(min=1e-6) + 0.5 * colour / colour.std().clamp(min=1e-6)
    return (mixed / mixed.std().clamp(min=1e-6))[0]
