"""Sun, sky and the camera's response: everything about a frame's light that is not geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.synth.soup import Material

WEATHERS = ("sun", "overcast", "fog", "dusk")
_WEATHER_SHARE = (0.72, 0.15, 0.05, 0.08)
"""Mostly sun, as in KITTI's recordings; 28 % of training frames have other weather, for variety."""


PANORAMA_GLARE = 4.0
"""Limit of a panorama in reflections: its sun is drawn from `Light.sun`, not twice."""


@dataclass(frozen=True, slots=True)
class Panorama:
    """A photographed sky. pixels (h, w, 3) float32: linear radiance, equirectangular, the zenith in the top row,
    the horizon in the middle. turn_rad: azimuth (to the right) of the middle column where `Light.heading` is 0.
    """

    pixels: np.ndarray
    turn_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Light:
    """Light of a frame, in camera axes. sun (3,): towards the sun; up (3,): the ground's normal. Colours (3,) are
    linear radiance or irradiance where sunlit white is about 1. haze_per_m: extinction. clouds: cover in [0, 1].
    wet, snow: how much water and slush lie on the ground, in [0, 1]; snow falls as densely. panorama: the sky, instead
    of gradient and clouds. heading: rad that the camera is turned to the right of where clouds, skyline and panorama
    have azimuth 0. night: share of night in [0, 1], by which windows are lit.
    """

    weather: str
    sun: np.ndarray
    up: np.ndarray
    sun_colour: np.ndarray
    zenith: np.ndarray
    horizon: np.ndarray
    ambient: np.ndarray
    haze_per_m: float
    clouds: float
    cloud_seed: float
    wet: float = 0.0
    snow: float = 0.0
    panorama: Panorama | None = None
    heading: float = 0.0
    night: float = 0.0

    @property
    def ahead(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors (3,) along the ground at azimuths 90 degrees and 0, float32."""
        forward = np.array([0.0, 0.0, 1.0]) - self.up[2] * self.up
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return (right * cos + forward * sin).astype(np.float32), (forward * cos - right * sin).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Response:
    """The camera. exposure: factor; white_balance (3,); contrast: exponent of the toe; vignette: loss in the
    corners; blur_px: standard deviation; noise: standard deviation of a mid-grey pixel, of 1. streaks: rain in
    the air, in [0, 1]; chromatic_px: how far red and blue miss their place in the image's corners.
    """

    exposure: float
    white_balance: np.ndarray
    contrast: float
    vignette: float
    blur_px: float
    noise: float
    streaks: float = 0.0
    chromatic_px: float = 0.0


def draw_light(rng: np.random.Generator, up: np.ndarray, sunny: bool) -> Light:
    """Random light; `sunny` keeps to clear weather."""
    weather = "sun" if sunny else WEATHERS[int(rng.choice(len(WEATHERS), p=_WEATHER_SHARE))]
    elevation = np.deg2rad(rng.uniform(7, 14) if weather == "dusk" else rng.uniform(24, 62))
    azimuth = rng.uniform(0, 2 * np.pi)
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    sun = np.cos(elevation) * (np.sin(azimuth) * right + np.cos(azimuth) * forward) + np.sin(elevation) * up
    warm = float(np.clip((np.deg2rad(30) - elevation) / np.deg2rad(30), 0, 1))
    strength = {"sun": 1.0, "overcast": 0.0, "fog": 0.05, "dusk": 0.55}[weather]
    sun_colour = strength * np.array([1.0, 0.95 - 0.2 * warm, 0.86 - 0.42 * warm])
    blue = np.array([0.17, 0.32, 0.74]) * rng.uniform(0.7, 1.25)
    pale = np.array([0.66, 0.80, 1.02]) * rng.uniform(0.7, 1.35)
    clouds = float(rng.choice([0.0, 0.35, 0.6, 0.9], p=[0.4, 0.25, 0.2, 0.15]))
    ambient = np.array([0.165, 0.19, 0.235]) * rng.uniform(0.6, 1.25)
    haze = float(rng.uniform(0.0002, 0.0011))
    if weather in ("overcast", "fog"):
        grey = rng.uniform(0.75, 1.05)
        blue, pale, clouds = np.full(3, 0.75) * grey, np.array([0.95, 0.97, 1.0]) * grey, 1.0
        ambient = np.array([0.62, 0.64, 0.67]) * rng.uniform(0.6, 0.9)
        haze = float(rng.uniform(0.012, 0.03)) if weather == "fog" else float(rng.uniform(0.0008, 0.004))
    elif weather == "dusk":
        blue, pale = np.array([0.20, 0.27, 0.48]), np.array([0.85, 0.62, 0.48]) * rng.uniform(0.7, 1.1)
        ambient = np.array([0.22, 0.22, 0.28])
    return Light(weather, sun, up, sun_colour, blue, pale, ambient, haze, clouds, float(rng.uniform(0, 512)))


def draw_response(rng: np.random.Generator, weather: str) -> Response:
    """A random camera response: KITTI's cameras, exposure bracketed for the weather."""
    base = {"sun": 2.2, "overcast": 2.3, "fog": 1.7, "dusk": 2.4}[weather]
    return Response(
        exposure=base * float(rng.lognormal(0, 0.2)),
        white_balance=np.array([1.0, 1.0, 1.0]) * rng.normal(1.0, (0.04, 0.01, 0.05)),
        contrast=float(rng.uniform(1.15, 1.55)),
        vignette=float(rng.uniform(0.02, 0.15)),
        blur_px=float(rng.uniform(0.35, 0.6)),
        noise=float(rng.uniform(0.004, 0.013)),
    )


def develop(radiance: np.ndarray, response: Response) -> np.ndarray:
    """Display values in [0, 1] of linear radiance (n, 3): white balance, shoulder, gamma 2.2 with a darker toe."""
    x = radiance * (response.exposure * response.white_balance).astype(np.float32)
    np.maximum(x, 0, out=x)
    square = x * x
    x /= np.sqrt(np.sqrt(1.0 + square * square))
    return np.power(x, np.float32(response.contrast / 2.2))


SHADOW_OFFSET_M, SHADOW_OFFSET_TEXELS = 0.015, 3.0
"""How far before a surface its shadow is looked up, the more the more it turns from the sun: the lookup's tent
spans two texels to each side, 2.8 across, which must not meet the surface itself.
"""
LEAF_DEPTH_M = 0.25
"""How deep the sun shines into a crown."""


MIRRORED_GROUND = 0.12
"""Albedo of the ground as seen in reflections."""


def _soaked() -> np.ndarray:
    table = np.zeros((len(Material), 3), np.float32)
    table[Material.ROAD] = 0.48, 0.24, 0.50
    table[[Material.PARKING, Material.PAVEMENT]] = 0.42, 0.18, 0.40
    table[Material.KERB] = 0.36, 0.15, 0.0
    table[Material.GRAVEL] = 0.36, 0.04, 0.60
    table[Material.ROOF] = 0.30, 0.10, 0.0
    table[[Material.GRASS, Material.FACADE, Material.WALL, Material.FENCE, Material.BARK], 0] = 0.2
    table[Material.LEAF, 0] = 0.1
    return table


SOAKED = _soaked()
"""Per material: share of light lost when wet, reflectance as a film of water, and the addition in puddles. Wet, porous
ground is about half as bright. Source: Lekner and Dorf, Applied Optics 27 (1988).
"""


SLUSH_RGB, SLUSH_SHARE, SLUSH_PATCHES = (0.52, 0.54, 0.57), 0.16, 0.10
"""Albedo of slush; share of the ground that it covers at snow 1, and the deviation of that share."""


def ground_light(light: Light) -> np.ndarray:
    """Radiance (3,) that the ground casts on what faces down."""
    return 0.16 * (light.ambient + 0.6 * light.sun_colour)
