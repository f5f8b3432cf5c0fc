"""Paint, foliage, weather and ground shadows of the second renderer, by its own formulas.

Light, fog and rain are computed on linear values (display values to the power of 2.2); the first renderer uses
display values and their squares. A code of 0 changes nothing. scene_ir/conventions.md defines the codes: at fog 1
the visibility is 130 m, rain 1 is a cloudburst, time 1 the end of civil twilight, overcast 1 a closed cloud cover.
The photographed shadow moves with its vehicle; a contact shadow fills what the photograph does not show of it.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from drivesem.failures.second_renderer.geometry import PictureCamera, VehiclePose, to_numpy
from drivesem.failures.second_renderer.night import GAMMA
from drivesem.failures.second_renderer.opengl import Array
from scene_ir.types import Environment, Source, Weather

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)

_LIGHTNESS, _CHROMA, _GLOSS, _DIRT = 2.2, 45.0, 0.9 / 30, 0.55
"""Effect of paint code 1 on the logit of L*, on a* and b* of a middle grey, and on the contrast of L* to the
paint's own; opacity of dust at the foot."""
_DUST = np.array([0.47, 0.42, 0.35], np.float32)
_DUSTLESS = 0.75
"""Share of the dust that is missing at the roof."""
_WAIST = (0.51, 0.55)
"""Shares of a person's height between which codes of clothes blend: the hip joint (Drillis and Contini)."""

_FOG_PER_M, _RAIN_PER_M, _SNOW_PER_M = 0.03, 0.002, 0.0025
_LAYER_M = 300.0
"""Thickness of the air in front of the sky."""
_GREY_AIR = (0.78, 0.82, 0.87)
_DUSK, _DUSK_SKY = np.array([0.85, 0.75, 0.55], np.float32), np.array([0.9, 0.7, 0.4], np.float32)
"""Optical depth of red, green and blue light at time code 1, as the camera exposes it, and what the sky glows above
that.
"""
_GLOW = np.array([0.35, 0.0, -0.35], np.float32)
"""What a low sun adds to the logarithm of light, at half the time code."""
_SOFTENING = np.array([0.5, 0.4, 0.5, 0.6, 0.9, 0.6], np.float32)
"""Share of a cast shadow that vanishes at code 1 of fog, rain, time, overcast, night, snow."""

_AUTUMN, _SPRING, _MAX_TURN = 28.0, 150.0, 65.0
"""Hues in degrees towards which hue codes 1 and -1 turn the leaves; largest turn."""
_LEAF_GAMMA = 1.1
"""Effect of lightness code 1 on the logarithm of the leaves' exponent."""


def apply_paint(colour: Array, code: Array, paint: Array, height: Array, base: Array) -> Array:
    """Apply a texture code to a vehicle's texels.

    Args:
        colour: (h, w, 3) RGB in [0, 1].
        code: (5,) texture code, or (8,) with that of clothes below the waist.
        paint: (h, w) in [0, 1], see `TextureAtlas.paint_share`.
        height: (h, w) in [0, 1], see `TextureAtlas.height`.
        base: (3,) paint's own colour.

    Returns:
        (h, w, 3) RGB in [0, 1].
    """
    if not code.any():
        return colour
    rows, columns = np.nonzero(paint > 0)
    here = colour[rows, columns]
    lightness, red, yellow, gloss, dirt, *lower = (float(c) for c in code)
    if lower:
        below = np.clip((_WAIST[1] - height[rows, columns]) / (_WAIST[1] - _WAIST[0]), 0, 1)
        lightness, red, yellow = (
            up + below * (low - up) for up, low in zip((lightness, red, yellow), lower, strict=True)
        )
    lab = cv2.cvtColor(here[None], cv2.COLOR_RGB2LAB)[0]
    own = float(cv2.cvtColor(base.reshape(1, 1, 3), cv2.COLOR_RGB2LAB)[0, 0, 0])
    level = np.clip(lab[:, 0] / 100, 0.01, 0.99)
    lifted = np.log(level / (1 - level)) + _LIGHTNESS * lightness + _GLOSS * gloss * (lab[:, 0] - own)
    level = 1 / (1 + np.exp(-lifted))
    # Black and white have no hue.
    room = _CHROMA * 4 * level * (1 - level)
    changed = np.stack([100 * level, lab[:, 1] + red * room, lab[:, 2] + yellow * room], axis=1)
    rgb = np.clip(cv2.cvtColor(changed[None].astype(np.float32), cv2.COLOR_LAB2RGB)[0], 0, 1)
    veil = (_DIRT * dirt * (1 - _DUSTLESS * height[rows, columns]))[:, None]
    rgb = np.clip(rgb + veil * (_DUST - rgb), 0, 1)
    out = colour.copy()
    out[rows, columns] = here + paint[rows, columns, None] * (rgb - here)
    return out


def remaining_shade(weather: Array) -> float:
    """Share of a cast shadow's optical depth that remains under a weather code (5,)."""
    return float(np.prod(1 - _SOFTENING * weather))


def estimate_air_colour(photograph: Array, sky: Array) -> Array:
    """Mean colour (3,) of the sky (H, W) in the photograph (H, W, 3); grey where it is too small."""
    is_sky = sky > 0.5
    if np.count_nonzero(is_sky) < 500:
        return np.array(_GREY_AIR, np.float32)
    return photograph[is_sky].mean(axis=0).astype(np.float32)


def apply_foliage(image: Array, code: Array, leaves: Array, air: Array) -> Array:
    """Apply a foliage code.

    Args:
        image: (H, W, 3) RGB in [0, 1].
        code: (3,) foliage code.
        leaves: (H, W) in [0, 1], how much of a pixel is foliage.
        air: (3,) colour of the air.

    Returns:
        (H, W, 3) RGB in [0, 1].
    """
    if not code.any():
        return image
    rows, columns = np.nonzero(leaves > 0)
    if not len(rows):
        return image
    hue, lightness, density = (float(c) for c in code)
    here = image[rows, columns]
    hsv = cv2.cvtColor(here[None], cv2.COLOR_RGB2HSV)[0]
    turn = np.mod((_AUTUMN if hue > 0 else _SPRING) - hsv[:, 0] + 180, 360) - 180
    hsv[:, 0] = np.mod(hsv[:, 0] + abs(hue) * np.clip(turn, -_MAX_TURN, _MAX_TURN), 360)
    hsv[:, 1] = np.clip(hsv[:, 1] * (1 + 0.3 * hue), 0, 1)
    hsv[:, 2] = np.clip(hsv[:, 2], 0, 1) ** np.exp(-_LEAF_GAMMA * lightness)
    rgb = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    gaps = _leaf_gaps(*leaves.shape)[rows, columns, None]
    rgb = rgb - 0.4 * max(density, 0.0) * (1 - gaps) * rgb
    rgb = rgb + 0.8 * max(-density, 0.0) * gaps * (air - rgb)
    out = image.copy()
    out[rows, columns] = here + leaves[rows, columns, None] * (np.clip(rgb, 0, 1) - here)
    return out


def apply_weather(image: Array, depth_m: Array, open_to: Array, environment: Environment, air: Array) -> Array:
    """Apply the environment's weather, except for night.

    Args:
        image: (H, W, 3) RGB in [0, 1].
        depth_m: (H, W), inf in the sky.
        open_to: (H, W), 0 where a vehicle hides the sky and the road, else 1.
        environment: Weather and maps.
        air: (3,) colour of the air.

    Returns:
        (H, W, 3) RGB in [0, 1].
    """
    codes = environment.weather.tolist()
    fog, rain, time, overcast, snow = (
        codes[w] for w in (Weather.FOG, Weather.RAIN, Weather.TIME, Weather.OVERCAST, Weather.SNOW)
    )
    if not (fog or rain or time or overcast or snow):
        return image
    overcast = max(overcast, snow)  # it falls from a closed sky
    # Drops scatter all colours equally.
    mist = np.exp(-1.6 * (fog + rain + snow))
    sky, road = (open_to[..., None] * to_numpy(m)[..., None] for m in (environment.sky, environment.road))
    light, air = image**GAMMA, air**GAMMA
    if overcast:
        grey = (light @ _LUMA)[..., None]
        # Sun and shade converge around the light of midday.
        plain = 0.16 * (np.maximum(0.5 * light + 0.5 * grey, 1e-4) / 0.16) ** 0.75
        cover = float(air @ _LUMA) * 0.6 + 0.4 + 0.1 * (grey - grey.mean())
        plain += sky * (cover - plain)
        light += 0.9 * overcast * (plain - light)
        air = air + 0.9 * overcast * (1.1 * float(air @ _LUMA) - air)
    if time:
        gain = np.exp(-_DUSK * time**2 + mist * (1 - overcast) * _GLOW * np.sin(np.pi * time))
        light, air = light * gain * (1 + sky * _DUSK_SKY * time**2), air * gain
    depth = np.minimum(depth_m, _LAYER_M)[..., None]
    if rain:
        grey = (light @ _LUMA)[..., None]
        wet = 0.85 * (0.65 * light + 0.35 * grey)
        mirror = _reflect_in_road(light) * 0.5 + 0.35 * air
        wet += road * np.clip(0.1 + depth / 90, 0, 0.5) * (mirror - wet)
        light = light + rain * (wet - light)
    light = np.clip(light, 0, 1)
    if snow:
        light += 0.25 * snow * road * (np.maximum(0.4, light) - light)
    air = mist * air + (1 - mist) * float(air @ _LUMA)
    if rain:
        light += (1 - np.exp(-_RAIN_PER_M * rain * depth)) * (1.15 * air - light)
        light += 0.08 * rain * _rain_streaks(*light.shape[:2])[..., None] * (air - light)
    if fog or snow:
        light += (1 - np.exp(-(_FOG_PER_M * fog + _SNOW_PER_M * snow) * depth)) * (air - light)
    if snow:
        light += snow * _snow_flakes(*light.shape[:2])[..., None] * (air - light)
    return (light ** (1 / GAMMA)).astype(np.float32)


def _snow_flakes(height: int, width: int) -> Array:
    """Opacity (H, W) of falling flakes: some near and soft, many far and small."""
    rng = np.random.default_rng(18)
    opacity = np.zeros((height, width), np.float32)
    for count, radius, share in ((40, height / 120, 0.3), (1200, height / 450, 0.5)):
        layer = np.zeros_like(opacity)
        for x, y in zip(rng.integers(0, width, count), rng.integers(0, height, count), strict=True):
            cv2.circle(layer, (int(x), int(y)), round(radius), share, -1, cv2.LINE_AA)
        opacity = np.maximum(opacity, cv2.GaussianBlur(layer, (0, 0), max(radius / 2, 0.4)))
    return opacity


def _reflect_in_road(light: Array) -> Array:
    """The reflection in a wet road: what stands above it, smeared downwards."""
    rows = light.shape[0] // 8
    above = cv2.blur(light, (5, rows))
    shifted = np.concatenate([above[:1].repeat(rows // 2, axis=0), above[: light.shape[0] - rows // 2]])
    return shifted.astype(np.float32)


@lru_cache(maxsize=8)
def _rain_streaks(height: int, width: int) -> Array:
    """Streaks of rain (H, W) in [0, 1]; deterministic for each size."""
    chance = np.random.default_rng(41)
    streaks = np.zeros((height, width), np.float32)
    for x, y, length in zip(
        chance.uniform(0, width, height * width // 300),
        chance.uniform(0, height, height * width // 300),
        chance.uniform(0.02, 0.05, height * width // 300) * height,
        strict=True,
    ):
        ends = [(round(x * 16), round(y * 16)), (round((x + 0.15 * length) * 16), round((y + length) * 16))]
        cv2.line(streaks, ends[0], ends[1], 1.0, 1, cv2.LINE_8, 4)
    return cv2.GaussianBlur(streaks, (0, 0), 0.6).astype(np.float32)


@lru_cache(maxsize=8)
def _leaf_gaps(height: int, width: int) -> Array:
    """Where thinned foliage shows the air (H, W) in [0, 1]; deterministic for each size."""
    noise = cv2.GaussianBlur(np.random.default_rng(43).normal(size=(height, width)), (0, 0), 1.5)
    return (1 / (1 + np.exp(1 - 3 * noise / noise.std()))).astype(np.float32)


_MIN_FACTOR = 0.05
"""Smallest shadow factor: logarithms are added."""
_CONTACT_DEPTH, _CONTACT_PERCENTILE = (0.7, 2.0), 80
"""Smallest and largest optical depth of the shadow under a vehicle; percentile of the photographed shadow that
sets it."""
_EDGE_BLUR_M = 0.15
"""Width over which the contact shadow fades at the footprint's edge."""


class GroundShadow:
    """One vehicle's shadow on the ground, as optical depth."""

    def __init__(self, source: Source, camera: PictureCamera, normal: Array, dark: Array) -> None:
        """Measure the photographed shadow.

        Args:
            source: The vehicle in the photograph.
            camera: Camera.
            normal: (3,) of the ground in the camera's axes.
            dark: (H, W, 3) optical depth of the shadow in the photograph, besides the scene's shadow layer.
        """
        self._camera, self._normal = camera, normal.astype(np.float64)
        self._before = VehiclePose.from_source(source)
        if source.shadow is not None and source.shadow.values.numel():
            crop = source.shadow
            factor = to_numpy(crop.values).transpose(1, 2, 0)
            where = slice(crop.y0, crop.y0 + factor.shape[0]), slice(crop.x0, crop.x0 + factor.shape[1])
            # Dark parts of a vehicle above the ground are no shadow.
            low = np.zeros_like(dark)
            low[where] = np.maximum(dark[where], -np.log(np.clip(factor, _MIN_FACTOR, 1)))
            dark = low
        x, y, width, height = cv2.boundingRect((dark.max(axis=2) > 0).astype(np.uint8))
        # Nothing is known beyond its box, so the shadow ends there.
        density = np.minimum(dark[y : y + height, x : x + width], -np.log(_MIN_FACTOR))
        self._density = (
            cv2.copyMakeBorder(density, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(0, 0, 0)) if width else None
        )
        self._origin = (x - 1, y - 1)
        known = density[density > 0]
        self._core = (
            float(np.clip(np.percentile(known, _CONTACT_PERCENTILE), *_CONTACT_DEPTH))
            if len(known)
            else _CONTACT_DEPTH[0]
        )

    def cast(self, pose: VehiclePose, density: Array) -> None:
        """Add the shadow of the vehicle at a pose to the image's optical depth (H, W, 3), in place."""
        contact = self._contact(pose)
        if contact is not None:
            where, dark = contact
            density[where] = np.maximum(density[where], dark[..., None])
        if self._density is None:
            return
        matrix = self._ground_motion(pose) @ _translation(*self._origin)
        height, width = self._density.shape[:2]
        corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64) @ matrix.T
        if (corners[:, 2] <= 0).any():
            return
        at = corners[:, :2] / corners[:, 2:]
        limit = [self._camera.width, self._camera.height]
        x0, y0 = np.clip(np.floor(at.min(axis=0)), 0, limit).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(at.max(axis=0)) + 1, 0, limit).astype(int).tolist()
        if x1 <= x0 or y1 <= y0:
            return
        moved = cv2.warpPerspective(self._density, _translation(-x0, -y0) @ matrix, (x1 - x0, y1 - y0))
        density[y0:y1, x0:x1] = np.maximum(density[y0:y1, x0:x1], moved)

    def _ground_motion(self, pose: VehiclePose) -> np.ndarray:
        """Homography (3, 3) by which pixels of the ground move with the vehicle."""
        k = self._camera.intrinsics.astype(np.float64)
        before, after = (p.translation.astype(np.float64) + self._camera.shift_m for p in (self._before, pose))
        turn = pose.rotation().astype(np.float64) @ self._before.rotation().T
        level = self._normal @ before
        return k @ (turn + np.outer(after - turn @ before, self._normal) / level) @ np.linalg.inv(k)

    def _contact(self, pose: VehiclePose) -> tuple[tuple[slice, slice], Array] | None:
        """Where the contact shadow is, and its optical depth (h, w); None outside of the image."""
        camera = self._camera
        half = np.array([pose.size_lhw[0], pose.size_lhw[2]]) / 2 - _EDGE_BLUR_M
        flat = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
        ends = np.stack([flat[:, 0], np.zeros(4), flat[:, 1]], axis=1) @ pose.rotation().T
        ends += pose.translation + camera.shift_m
        if ends[:, 2].min() < 1.0:
            return None
        at = camera.project(ends.astype(np.float32))
        soft = max(0.7, _EDGE_BLUR_M * float(camera.intrinsics[0, 0]) / float(ends[:, 2].mean()))
        # The ground is foreshortened by the camera's height over the distance.
        flatter = max(0.5, soft * abs(float(self._normal @ ends.mean(axis=0))) / float(ends[:, 2].mean()))
        reach = int(np.ceil(3 * soft))
        x0, y0 = np.clip(np.floor(at.min(axis=0)) - reach, 0, [camera.width, camera.height]).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(at.max(axis=0)) + reach, 0, [camera.width, camera.height]).astype(int).tolist()
        if x1 <= x0 or y1 <= y0:
            return None
        mask = np.zeros((y1 - y0, x1 - x0), np.float32)
        fixed = np.rint((at - [x0, y0]) * 16).astype(np.int32)
        cv2.fillConvexPoly(mask, fixed, 1.0, cv2.LINE_8, 4)
        mask = cv2.GaussianBlur(mask, (0, 0), soft, sigmaY=flatter)
        return (slice(y0, y1), slice(x0, x1)), (self._core * mask).astype(np.float32)


def _translation(x: float, y: float) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1]], np.float64)
