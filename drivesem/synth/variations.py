"""Virtual KITTI's variations of one scene: the same street in other weather, at other hours, and from turned
cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivesem.synth.light import Light, Response
from drivesem.synth.view import Setting, View
from scene_ir.errors import RangeError

MIXED = "mixed"
"""Not a variation of Virtual KITTI's: each street in weather of its own, as training sets want it."""
_TURNS_DEG = {"15-deg-left": -15.0, "15-deg-right": 15.0, "30-deg-left": -30.0, "30-deg-right": 30.0}
_WEATHERS = ("fog", "morning", "overcast", "rain", "sunset")


@dataclass(frozen=True, slots=True)
class _LowSun:
    """Light of an hour: ranges of the sun's height and of haze, colours as in `Light`, factor of exposure."""

    elevation_deg: tuple[float, float]
    sun_colour: tuple[float, float, float]
    zenith: tuple[float, float, float]
    horizon: tuple[float, float, float]
    ambient: tuple[float, float, float]
    haze_per_m: tuple[float, float]
    exposure: float


_LOW_SUNS = {
    "morning": _LowSun(
        (14, 20),
        (0.95, 0.80, 0.60),
        (0.24, 0.40, 0.74),
        (0.98, 0.90, 0.80),
        (0.20, 0.22, 0.26),
        (0.001, 0.0025),
        1.05,
    ),
    "sunset": _LowSun(
        (5, 9),
        (0.85, 0.48, 0.22),
        (0.22, 0.28, 0.48),
        (1.0, 0.66, 0.42),
        (0.21, 0.19, 0.22),
        (0.0008, 0.002),
        1.1,
    ),
}
VARIATIONS = ("clone", *_TURNS_DEG, *_WEATHERS)
"""In Virtual KITTI's words. "clone" is a clear day."""


def parse_variations(text: str) -> tuple[str, ...]:
    """The variations of "clone,fog" or "all", each once, in the order given. RangeError for an unknown name."""
    names = VARIATIONS if text == "all" else tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    for name in names:
        if name not in (MIXED, *VARIATIONS):
            raise RangeError("variations", f"all, or names among {', '.join((MIXED, *VARIATIONS))}", repr(name))
    return names


def vary(setting: Setting, name: str, rng: np.random.Generator) -> Setting:
    """The setting of a clear day as the variation `name` has it. rng: of this scene and variation.

    Camera angles turn the camera about the vertical and leave everything else. RangeError for an unknown name.
    """
    if name not in (MIXED, *VARIATIONS):
        raise RangeError("variation", ", ".join(VARIATIONS), name)
    if name in _TURNS_DEG:
        view = turned(setting.view, float(np.deg2rad(_TURNS_DEG[name])))
        return replace(setting, view=view, light=fix_light_in_world(setting.light, setting.view, view))
    if name in _WEATHERS:
        light, response = _weather(setting, name, rng)
        return replace(setting, light=replace(light, weather=name), response=response)
    return setting


def turned(view: View, angle: float) -> View:
    """The view turned to the right by `angle`, rad, about the vertical through its origin."""
    cos, sin = np.cos(angle), np.sin(angle)
    about_y = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    return replace(view, rotation=view.rotation @ about_y, heading=view.heading + angle)


def fix_light_in_world(light: Light, before: View, after: View) -> Light:
    """Rotate the light's directions, given in camera axes, so that they stay fixed in the world."""
    turn = after.rotation @ before.rotation.T
    heading = light.heading + after.heading - before.heading
    return replace(light, sun=turn @ light.sun, up=turn @ light.up, heading=heading)


def _low_sun(setting: Setting, elevation_deg: float) -> np.ndarray:
    """The sun (3,) at its azimuth, at another height."""
    up, sun = setting.light.up, setting.light.sun
    level = sun - (sun @ up) * up
    level /= max(float(np.linalg.norm(level)), 1e-9)
    angle = np.deg2rad(elevation_deg)
    return np.cos(angle) * level + np.sin(angle) * up


def _weather(setting: Setting, name: str, rng: np.random.Generator) -> tuple[Light, Response]:
    light, response = setting.light, setting.response
    exposed = response.exposure
    if name == "fog":
        grey = float(rng.uniform(0.8, 1.0))
        light = replace(
            _clouded(light, grey),
            haze_per_m=float(rng.uniform(0.016, 0.03)),
            ambient=light.ambient * 0 + 0.55 * grey,
        )
        return light, replace(response, exposure=exposed * 0.8)
    if name == "overcast":
        grey = float(rng.uniform(0.8, 1.0))
        return _clouded(light, grey), response
    if name == "rain":
        grey = float(rng.uniform(0.55, 0.75))
        light = replace(
            _clouded(light, grey), haze_per_m=float(rng.uniform(0.003, 0.006)), wet=float(rng.uniform(0.7, 1.0))
        )
        return light, replace(response, streaks=float(rng.uniform(0.4, 1.0)), noise=response.noise * 1.2)
    low = _LOW_SUNS[name]
    light = replace(
        light,
        sun=_low_sun(setting, float(rng.uniform(*low.elevation_deg))),
        sun_colour=np.array(low.sun_colour) * float(rng.uniform(0.72, 0.92)),
        zenith=np.array(low.zenith),
        horizon=np.array(low.horizon),
        ambient=np.array(low.ambient),
        panorama=None,
        haze_per_m=float(rng.uniform(*low.haze_per_m)),
    )
    return light, replace(response, exposure=exposed * low.exposure)


def _clouded(light: Light, grey: float) -> Light:
    """Light under a closed cover of clouds: no sun, a grey sky of this brightness."""
    return replace(
        light,
        sun_colour=np.zeros(3),
        zenith=np.full(3, 0.75) * grey,
        horizon=np.array([0.95, 0.97, 1.0]) * grey,
        ambient=np.array([0.46, 0.475, 0.5]) * grey,
        clouds=1.0,
        panorama=None,
        haze_per_m=float(max(light.haze_per_m, 0.001)),
    )
