"""Paint, leaves and weather of the second renderer: its own formulas for what the codes mean.

Light and the veils of fog and rain are linear values (display values to the power of 2.2), where the first
renderer works on display values and their squares. A code of 0 changes nothing. The codes' meaning is in
scene_ir/conventions.md; strengths are those of what they name: fog 1 lets 130 m be seen, rain 1 is a cloudburst,
time 1 the end of civil twilight, overcast 1 a closed cover.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from drivesem.failures.second_renderer.placing import numbers
from drivesem.failures.second_renderer.screen import Array
from scene_ir.types import Environment

_GAMMA = 2.2
_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)

_LIGHTNESS, _CHROMA, _GLOSS, _DIRT = 2.2, 45.0, 0.9 / 30, 0.55
"""Paint code 1: on the logit of L*, on a* and b* of a middle grey, on L*'s distance from the paint's own; opacity
of dust at the foot."""
_DUST = np.array([0.47, 0.42, 0.35], np.float32)
_DUSTLESS = 0.75
"""Share of it that is gone at the roof."""

_FOG_PER_M, _RAIN_PER_M = 0.03, 0.006
_LAYER_M = 300.0
"""How far one sees through the air before it ends: the sky is beyond the layer."""
_GREY_AIR = (0.78, 0.82, 0.87)
_DUSK = np.array([2.0, 1.75, 1.25], np.float32)
"""Optical depth of red, green and blue light at time code 1."""
_GLOW = np.array([0.35, 0.0, -0.35], np.float32)
"""What a low sun, at half the time code, adds to the logarithm of light."""
_SOFTENING = np.array([0.5, 0.4, 0.5, 0.6], np.float32)
"""What is lost of cast shadows at code 1 of fog, rain, time, overcast."""

_AUTUMN, _SPRING, _MOST_TURN = 28.0, 150.0, 65.0
"""Hues, in degrees, towards which hue code 1 and -1 turn the leaves, and how far at most."""
_LEAF_GAMMA = 1.1
"""How lightness code 1 changes the exponent of leaves' values, as a logarithm."""


def painted(colour: Array, code: Array, paint: Array, height: Array, base: Array) -> Array:
    """Texels (h, w, 3) of a vehicle whose paint has a texture code (5,). paint, height: (h, w), base: (3,), see
    `baking.Atlas`."""
    if not code.any():
        return colour
    rows, columns = np.nonzero(paint > 0)
    here = colour[rows, columns]
    lightness, red, yellow, gloss, dirt = (float(c) for c in code)
    lab = cv2.cvtColor(here[None], cv2.COLOR_RGB2LAB)[0]
    own = float(cv2.cvtColor(base.reshape(1, 1, 3), cv2.COLOR_RGB2LAB)[0, 0, 0])
    level = np.clip(lab[:, 0] / 100, 0.01, 0.99)
    lifted = np.log(level / (1 - level)) + _LIGHTNESS * lightness + _GLOSS * gloss * (lab[:, 0] - own)
    level = 1 / (1 + np.exp(-lifted))
    # Neither black nor white has a hue.
    room = _CHROMA * 4 * level * (1 - level)
    changed = np.stack([100 * level, lab[:, 1] + red * room, lab[:, 2] + yellow * room], axis=1)
    rgb = np.clip(cv2.cvtColor(changed[None].astype(np.float32), cv2.COLOR_LAB2RGB)[0], 0, 1)
    veil = (_DIRT * dirt * (1 - _DUSTLESS * height[rows, columns]))[:, None]
    rgb = np.clip(rgb + veil * (_DUST - rgb), 0, 1)
    out = colour.copy()
    out[rows, columns] = here + paint[rows, columns, None] * (rgb - here)
    return out


def shade_left(weather: Array) -> float:
    """Share of a cast shadow's optical depth that is left under a weather code (4,)."""
    return float(np.prod(1 - _SOFTENING * weather))


def air_of(photograph: Array, sky: Array) -> Array:
    """Colour (3,) of the air, as the photograph's sky has it; (H, W, 3), (H, W)."""
    shown = sky > 0.5
    count = int(np.count_nonzero(shown))
    grey = np.array(_GREY_AIR, np.float32)
    return grey if count < 500 else photograph[shown].mean(axis=0).astype(np.float32)


def with_leaves(image: Array, code: Array, leaves: Array, air: Array) -> Array:
    """The picture (H, W, 3) with its foliage (H, W) in [0, 1] changed by a code (3,)."""
    if not code.any():
        return image
    rows, columns = np.nonzero(leaves > 0)
    if not len(rows):
        return image
    hue, lightness, density = (float(c) for c in code)
    here = image[rows, columns]
    hsv = cv2.cvtColor(here[None], cv2.COLOR_RGB2HSV)[0]
    way = np.mod((_AUTUMN if hue > 0 else _SPRING) - hsv[:, 0] + 180, 360) - 180
    hsv[:, 0] = np.mod(hsv[:, 0] + abs(hue) * np.clip(way, -_MOST_TURN, _MOST_TURN), 360)
    hsv[:, 1] = np.clip(hsv[:, 1] * (1 + 0.3 * hue), 0, 1)
    hsv[:, 2] = np.clip(hsv[:, 2], 0, 1) ** np.exp(-_LEAF_GAMMA * lightness)
    rgb = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    gaps = _speckles(*leaves.shape)[rows, columns, None]
    rgb = rgb - 0.4 * max(density, 0.0) * (1 - gaps) * rgb
    rgb = rgb + 0.8 * max(-density, 0.0) * gaps * (air - rgb)
    out = image.copy()
    out[rows, columns] = here + leaves[rows, columns, None] * (np.clip(rgb, 0, 1) - here)
    return out


def weathered(image: Array, depth_m: Array, open_to: Array, environment: Environment, air: Array) -> Array:
    """The picture (H, W, 3) under the environment's weather. depth_m: (H, W), inf in the sky; open_to: (H, W), 0
    where a vehicle hides the sky and the road."""
    fog, rain, time, overcast = environment.weather.tolist()
    if not (fog or rain or time or overcast):
        return image
    sky, road = (open_to[..., None] * numbers(m)[..., None] for m in (environment.sky, environment.road))
    light, air = image**_GAMMA, air**_GAMMA
    if overcast:
        grey = (light @ _LUMA)[..., None]
        # Sun and shade come nearer to each other, around the light of the day's middle.
        plain = 0.16 * (np.maximum(0.5 * light + 0.5 * grey, 1e-4) / 0.16) ** 0.75
        cover = float(air @ _LUMA) * 0.6 + 0.1 + 0.1 * (grey - grey.mean())
        plain += sky * (cover - plain)
        light += 0.9 * overcast * (plain - light)
        air = air + 0.9 * overcast * (0.8 * float(air @ _LUMA) - air)
    if time:
        gain = np.exp(-_DUSK * time**2 + _GLOW * np.sin(np.pi * time))
        light, air = light * gain, air * gain
    depth = np.minimum(depth_m, _LAYER_M)[..., None]
    if rain:
        grey = (light @ _LUMA)[..., None]
        wet = 0.85 * (0.65 * light + 0.35 * grey)
        mirror = _smeared(light) * 0.5 + 0.35 * air
        wet += road * np.clip(0.1 + depth / 90, 0, 0.5) * (mirror - wet)
        light = light + rain * (wet - light)
    light = np.clip(light, 0, 1)
    # Drops scatter all colours alike.
    mist = np.exp(-1.6 * (fog + rain))
    air = mist * air + (1 - mist) * float(air @ _LUMA)
    if rain:
        light += (1 - np.exp(-_RAIN_PER_M * rain * depth)) * (0.65 * air - light)
        light += 0.12 * rain * _drops(*light.shape[:2])[..., None] * (air - light)
    if fog:
        light += (1 - np.exp(-_FOG_PER_M * fog * depth)) * (air - light)
    return (light ** (1 / _GAMMA)).astype(np.float32)


def _smeared(light: Array) -> Array:
    """What a wet road mirrors: what stands above it, drawn out downwards."""
    rows = light.shape[0] // 8
    above = cv2.blur(light, (5, rows))
    shifted = np.concatenate([above[:1].repeat(rows // 2, axis=0), above[: light.shape[0] - rows // 2]])
    return shifted.astype(np.float32)


@lru_cache(maxsize=8)
def _drops(height: int, width: int) -> Array:
    """Streaks of rain (H, W) in [0, 1]; the same for each size."""
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
def _speckles(height: int, width: int) -> Array:
    """Where thin leaves let the air through (H, W) in [0, 1]; the same for each size."""
    noise = cv2.GaussianBlur(np.random.default_rng(43).normal(size=(height, width)), (0, 0), 1.5)
    return (1 / (1 + np.exp(1 - 3 * noise / noise.std()))).astype(np.float32)
