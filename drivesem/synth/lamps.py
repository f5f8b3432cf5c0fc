"""Night in the generator: light of street lamps, of vehicles' lamps and of the own headlamps, at their exact places.

Lamps are points with an intensity by direction; what they light follows from distance, normal and material. Radiance
is as in `Light`, after the camera's exposure by night: an irradiance of 1 is about 30 lux.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivesem.synth.layout import Actor
from drivesem.synth.light import Light, Response
from drivesem.synth.soup import Material, Soup
from drivesem.synth.view import LAMP_NUMBERS, View
from scene_ir.types import Weather

STREET, BEAM, TAIL = 0.0, 1.0, 2.0
"""Kinds of lamps: all below, a headlamp's beam, all behind."""
BEAM_WIDE, BEAM_CUT, BEAM_EDGE, BEAM_DOWN = 0.30, 0.008, 0.03, 0.11
"""A low beam: half width as a tangent, sines of the angle below the horizon at which it is cut off and over which, and
over which it fades further below. Source: the shape of UN regulation 112's limits.
"""
BEAM_FLOOD, FLOOD_WIDE, BEAM_STRAY = 0.10, 0.9, 0.012
"""Light outside of the beam: share and width of the flood, and the share that goes everywhere ahead."""
RETRO, RETRO_RAD = 260.0, 0.012
"""Gain of retro-reflective sheeting on light that comes from the viewer's direction, and the angle off that at which it
has halved. Source: EN 12899-1, about 100 cd / lx / m2 at half a degree.
"""
ROUGH = 0.4
"""Share of rough ground's light that follows Lommel and Seeliger's law: it sends light back at grazing angles."""
LAMP_SIZE_M = 0.15
"""Distance below which a lamp is no point."""
WET_ROUGH, PUDDLE_ROUGH, COAT_ROUGH = 0.30, 0.10, 0.10
"""Widths of the microfacets' slopes of a wet road, a puddle and a vehicle's paint (Trowbridge and Reitz)."""
BRIGHTEST_GLINT = 8.0
WINDOW_RGB, WINDOW_COOL = (0.75, 0.42, 0.17), (0.55, 0.50, 0.42)
"""Light behind windows, from warm to cool."""
WINDOW_FROM, WINDOW_SLOPE = 0.55, 0.7
"""Deviate of a window's noise from which it is lit, and its light's growth with it."""

_STREET_CD, _OWN_CD, _TAIL_CD, _BRAKE_CD = 26.0, 120.0, 0.25, 1.6
"""Intensities, in m2 of irradiance 1."""
_STREET_SHINE, _HEAD_SHINE, _TAIL_SHINE, _BRAKE_SHINE, _SIGNAL_SHINE = 160.0, 420.0, 9.0, 30.0, 8.0
"""Radiance of lit lamps relative to their albedo."""
_SHINES_BY_DAY, _LIGHTS_BY_DAY = 0.12, 0.01
"""The same by day, where the exposure is shorter: a lamp's radiance, and its light on others."""
_STREET_LIGHTS = np.array([[1.0, 0.62, 0.26], [1.0, 0.80, 0.55], [0.92, 0.95, 1.0]])
"""Sodium, warm and cold white: of one street's lamps."""
_HEAD_LIGHTS = np.array([[1.0, 0.84, 0.60], [0.90, 0.95, 1.0]])
"""Halogen and LED."""
_TAIL_LIGHT = np.array([1.0, 0.05, 0.03])
_SWITCHED_ON = np.array([1.4, 1.1, 1.5, 0.25, 3.0, 1.1])
"""How much fog, rain, time, overcast, night and snow make drivers switch on their lamps."""
_ZENITH, _HORIZON = np.array([0.0007, 0.0007, 0.0009]), np.array([0.0040, 0.0033, 0.0028])
"""The sky over a town."""
_AMBIENT = np.array([0.0080, 0.0068, 0.0056])
_AIRGLOW = 12.0
"""Growth of the horizon's light in fog, which the town lights."""
_VIGNETTE, _NOISE, _BLUR_PX = 0.22, 1.5, 0.15
"""What the lens, wide open, and the sensor add by night: loss in the corners, factor of noise, blur."""
_FARTHEST_TAIL_M = 70.0


@dataclass(frozen=True, slots=True)
class LampStates:
    """How far lamps are on in a frame."""

    night: float
    """Share of night in [0, 1]."""
    vehicles: float
    """Share of drivers' lamps in [0, 1]."""


def night_share(code: float) -> float:
    """Share of night in [0, 1] at its code: 0 at 0, 1 at 1; daylight falls by ever larger factors."""
    return 1.0 - (1.0 - code) ** 3


def lamps_on(weather: Sequence[float]) -> float:
    """How far in [0, 1] drivers have their lamps on under weather codes; 0 at code 0."""
    return 1.0 - float(np.exp(-np.square(_SWITCHED_ON @ np.asarray(weather))))


def darken(light: Light, weather: Sequence[float]) -> Light:
    """The light as night falls over it: daylight goes, a town's glow comes."""
    share = night_share(weather[Weather.NIGHT])
    if share == 0:
        return light
    glow = 1.0 + _AIRGLOW * weather[Weather.FOG] + weather[Weather.RAIN]

    def toward(day: np.ndarray, night: np.ndarray) -> np.ndarray:
        return day + share * (night - day)

    panorama = light.panorama
    if panorama is not None:
        dark = toward(panorama.pixels, (_ZENITH + _HORIZON) / 2).astype(np.float32)
        panorama = replace(panorama, pixels=dark)
    return replace(
        light,
        sun_colour=light.sun_colour * (1 - share),
        zenith=toward(light.zenith, _ZENITH),
        horizon=toward(light.horizon, _HORIZON * glow),
        ambient=toward(light.ambient, _AMBIENT),
        panorama=panorama,
        night=share,
    )


def open_lens(response: Response, night: float) -> Response:
    """The camera at a share of night."""
    if night == 0:
        return response
    return replace(
        response,
        vignette=response.vignette + _VIGNETTE * night,
        noise=response.noise * (1 + (_NOISE - 1) * night),
        blur_px=response.blur_px + _BLUR_PX * night,
    )


def street_lamps(street: Soup, light: Light, seed: int) -> tuple[Soup, np.ndarray]:
    """The street with lamps, signals lit, and rows (K, 11) of its lamps; see `Setting.lamps`."""
    if light.night == 0:
        return street, no_lamps()
    pattern, albedo = street.pattern.copy(), street.albedo.copy()
    colour = _STREET_LIGHTS[seed % len(_STREET_LIGHTS)]
    heads, signals = (
        np.flatnonzero((street.material == m) & (pattern[:, 2] > 0)) for m in (Material.METAL, Material.FLAT)
    )
    albedo[heads] = colour
    pattern[heads, 1], pattern[signals, 1] = _STREET_SHINE * light.night, _SIGNAL_SHINE * light.night
    # poles lie between the heads of two lamps
    lamps = np.split(heads, np.flatnonzero(np.diff(heads) > 1) + 1) if len(heads) else []
    rows = [
        _row(street.corners[lamp].mean(axis=(0, 1)), -light.up, colour * _STREET_CD * light.night, STREET)
        for lamp in lamps
    ]
    return replace(street, pattern=pattern, albedo=albedo), _table(rows)


def own_lamps(view: View, light: Light, states: LampStates) -> np.ndarray:
    """Rows (2, 11) of the headlamps of the car that carries the camera; none where they are off."""
    if states.vehicles == 0:
        return no_lamps()
    ahead, right = (np.array([np.sin(a), 0.0, np.cos(a)]) for a in (view.heading, view.heading + np.pi / 2))
    low = np.array([view.position_xz[0], -0.68, view.position_xz[1]]) + 1.4 * ahead
    level = _OWN_CD * states.vehicles * _exposed(states, _LIGHTS_BY_DAY)
    return _table(
        [
            _row(
                view.to_camera(low + side * right) - view.centre,
                view.rotation @ ahead,
                _HEAD_LIGHTS[0] * level,
                BEAM,
            )
            for side in (-0.62, 0.62)
        ]
    )


def vehicle_lamps(
    actor: Actor, soup: Soup, axis: np.ndarray, up: np.ndarray, states: LampStates
) -> tuple[Soup, np.ndarray]:
    """A vehicle with its lamps as they are on, and their rows (k, 11).

    Args:
        actor: The vehicle; its `lamps` is -1 off, 0 as the weather makes drivers do it, 1 with brake lamps.
        soup: Its triangles, in camera axes about the centre of projection.
        axis: (3,) its heading in these axes.
        up: (3,) the ground's normal.
        states: How far lamps are on.
    """
    on = 0.0 if actor.parked else states.vehicles * (1.0 + min(actor.lamps, 0.0))
    braking = max(actor.lamps, 0.0)
    faces = np.flatnonzero(soup.material == Material.LIGHT)
    if on + braking == 0 or not len(faces):
        return soup, no_lamps()
    middle = soup.corners.reshape(-1, 3).mean(axis=0)
    places = soup.corners[faces].mean(axis=1)
    front = (places - middle) @ axis > 0
    red = soup.albedo[faces, 0] > 4 * soup.albedo[faces, 1]
    colour = _HEAD_LIGHTS[actor.seed % len(_HEAD_LIGHTS)]
    shine, light = _exposed(states, _SHINES_BY_DAY), _exposed(states, _LIGHTS_BY_DAY)
    pattern, albedo = soup.pattern.copy(), soup.albedo.copy()
    # meshes without red glass behind
    plain = ~front & ~(red & ~front).any()
    albedo[faces[plain]] = 0.26 * _TAIL_LIGHT
    towards = -places[front].mean(axis=0) if front.any() else axis
    beam = float(beam_share(towards / np.linalg.norm(towards), axis, up))
    albedo[faces[front]] *= colour.astype(np.float32)
    pattern[faces[front], 1] = on * shine * _HEAD_SHINE * (0.08 + 0.92 * beam)
    rear = ~front & (red | plain)
    pattern[faces[rear], 1] = shine * (on * _TAIL_SHINE + braking * _BRAKE_SHINE)
    rows, across = [], np.cross(up, axis)
    for ahead, chosen in ((True, front), (False, rear)):
        strength = on * _OWN_CD * colour if ahead else (on * _TAIL_CD + braking * _BRAKE_CD) * _TAIL_LIGHT
        far = not ahead and float(np.linalg.norm(middle)) > _FARTHEST_TAIL_M
        for side in (1.0, -1.0):
            spot = places[chosen & ((places - middle) @ across * side > 0)]
            if len(spot) and strength.any() and not far:
                kind = (axis, BEAM) if ahead else (-axis, TAIL)
                rows.append(_row(spot.mean(axis=0), kind[0], strength * light, kind[1], int(soup.owner[0])))
    return replace(soup, pattern=pattern, albedo=albedo), _table(rows)


def beam_share(direction: np.ndarray, axis: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Intensity (...) of a low beam relative to its maximum, in unit directions (..., 3) from the lamp."""
    ahead, rise = direction @ axis, direction @ up
    aside = np.sqrt(np.maximum(1 - ahead**2 - rise**2, 0)) / np.maximum(ahead, 1e-3)
    below = np.clip((-rise - BEAM_CUT) / BEAM_EDGE + 0.5, 0, 1)
    core = np.exp(-np.square(aside / BEAM_WIDE) - np.maximum(-rise - 0.03, 0) / BEAM_DOWN)
    flood = BEAM_FLOOD * np.exp(-np.square(aside / FLOOD_WIDE))
    return np.clip(4 * ahead, 0, 1) * (below * (core + flood) + BEAM_STRAY)


def no_lamps() -> np.ndarray:
    """No rows (0, 11)."""
    return np.zeros((0, LAMP_NUMBERS), np.float32)


def _exposed(states: LampStates, by_day: float) -> float:
    return by_day + (1 - by_day) * states.night


def _row(place: np.ndarray, axis: np.ndarray, colour: np.ndarray, kind: float, owner: int = 0) -> np.ndarray:
    return np.concatenate([place, axis, colour, [kind, owner]])


def _table(rows: Sequence[np.ndarray]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, LAMP_NUMBERS)
