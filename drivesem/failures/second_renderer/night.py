"""Night and lamps of the second renderer of photographs, by its own formulas.

Each pixel is a point in space, by its depth. Lamps light it by their intensity in its direction over the square of the
distance; what it sends back follows from the photograph's colour as albedo. Light is linear, and added up as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.failures.second_renderer.geometry import PictureCamera, VehiclePose, to_numpy
from drivesem.failures.second_renderer.opengl import Array
from scene_ir.types import Environment, Weather

Floats = NDArray[np.floating]
GAMMA = 2.2
_FARTHEST_M = 300.0
"""Distance that stands for the sky's."""
_ROAD_ALBEDO, _DAYLIGHT = 0.11, (0.5, 4.0)
"""Albedo of a road, by which daylight is measured in the photograph, and its bounds."""
_SPACING_M, _POSTS, _ASIDE_M, _POST_M = 28.0, 12, 6.5, 8.5
"""Distance along the road between street lamps, alternately left and right; their number, distance from the camera's
path, and height."""
_STREET, _STREET_CD, _POST_LAMP_M = np.array([1.0, 0.74, 0.45], np.float32), 32.0, 0.16
"""Colour of a street lamp, its intensity below, and its width."""
_OWN, _OWN_CD, _OWN_PLACE_M = np.array([1.0, 0.88, 0.68], np.float32), 260.0, (0.6, 0.7, 1.2)
"""Own headlamps: colour, intensity, place to either side, above the ground, ahead."""
_BEAM_RAD, _CUT, _CUT_WIDTH, _DROP, _STRAY = 0.30, 0.012, 0.006, 0.12, 0.014
"""Their beam: half width, sine below the horizon where it is cut off, width of that edge, sine over which it fades
below, share that is scattered everywhere."""
_MATT, _BACKWARD = 0.6, 0.4
"""Cosine that stands for that of surfaces with an unknown normal; share of the road's light that goes back at grazing
angles."""
_SIGN_SATURATION, _SIGN_GAIN = (0.55, 0.75), 12.0
"""Saturation from which a bright, compact area may be a sign, and is; its gain on the headlamps' light."""
_TOWN, _TOWN_GLOW = np.array([0.012, 0.010, 0.008], np.float32), np.array([0.006, 0.0045, 0.0035], np.float32)
"""Light that a town casts from all sides, and that of its sky."""
_LAMPS_LIT = np.array([1.5, 1.2, 1.5, 0.3, 3.0, 1.2], np.float32)
"""How much fog, rain, time, overcast and night make drivers switch on their lamps."""
_LAMP_PLACES = ((0.48, -0.5, 0.38), (0.48, -0.5, -0.38), (-0.48, -0.5, 0.38), (-0.48, -0.5, -0.38))
"""Usual places of a vehicle's lamps in its box."""
_RIDER_LAMPS_M, _RIDER_LAMP_M = np.array([[0.0, -0.9, 0.0], [0.0, -0.6, 0.0]], np.float32), 0.025
"""Places of a two-wheeler's lamps, front and rear, within what StVZO section 67 allows, and their width."""
_TAIL, _HEAD = np.array([2.0, 0.1, 0.05], np.float32), np.array([6.0, 5.5, 4.5], np.float32)
"""Light of a vehicle's lamps by night; white is 1."""
_LAMP_M, _LAMP_BY_DAY, _BRAKING = 0.06, 0.15, 2.5
"""Width of a lamp; its light by day, relative to that by night; light of a brake lamp, relative to a tail lamp's."""
_FOG_PER_M, _RAIN_PER_M = 0.03, 0.002
_WINDOW = 0.93
"""Display value from which a small area above the ground counts as a lamp or a lit window."""
_GLARE = ((0.004, 0.5), (0.012, 0.25), (0.05, 0.12))
"""Blurs of the lens, in heights of the picture, and their shares."""
_DARK_INSIDE = 0.985
"""Loss of light inside of the ego vehicle."""
_CORNER, _GRAIN = 0.8, 0.006
"""Loss of light towards the corners per square of the distance, in widths; deviation of the sensor's grain."""
_WET_MIRROR = 0.25
"""Share of a lamp's light in its image on a wet road."""


def _night_share(environment: Environment) -> float:
    return 1 - (1 - float(environment.weather[Weather.NIGHT])) ** 4


def darken_inside(image: Array, environment: Environment) -> Array:
    """The picture (H, W, 3) as what is inside of the ego vehicle, where no lamp shines; unchanged by day."""
    night = _night_share(environment)
    return image * (1 - _DARK_INSIDE * night) ** (1 / GAMMA) if night else image


def apply_night(
    image: Array,
    depth_m: Array,
    owner: NDArray[np.int64],
    environment: Environment,
    camera: PictureCamera,
    poses: Sequence[VehiclePose],
    codes: Array,
    riders: NDArray[np.bool_] | None = None,
) -> Array:
    """Apply the environment's night, and switch on the vehicles' lamps as its weather makes drivers do.

    Args:
        image: (H, W, 3) RGB in [0, 1].
        depth_m: (H, W), inf in the sky.
        owner: (H, W), 0 for the background, i + 1 for vehicle i.
        environment: Weather, sky, road and ground.
        camera: Camera.
        poses: Poses of the vehicles.
        codes: (N,) codes of their lamps.
        riders: (N,) which have one lamp at either end of a two-wheeler; none if None.

    Returns:
        (H, W, 3) RGB, at least 0.
    """
    weather = to_numpy(environment.weather)
    if not (weather.any() or codes.any()):
        return image
    night = _night_share(environment)
    driven = 1 - float(np.exp(-(float(_LAMPS_LIT @ weather) ** 2)))
    light = np.clip(image, 0, None) ** GAMMA
    lamps = np.zeros_like(light)
    if night:
        shining, lit = _light_by_night(light, depth_m, owner, environment, camera)
        light = light + night * (lit - light)
        lamps += night * shining
    extinction = float(_FOG_PER_M * weather[Weather.FOG] + _RAIN_PER_M * weather[Weather.RAIN])
    exposure = _LAMP_BY_DAY + (1 - _LAMP_BY_DAY) * night
    road = to_numpy(environment.road) * (owner == 0)
    mirrored = np.zeros_like(light)
    for i, pose in enumerate(poses):
        code = float(codes[i])
        rides = riders is not None and bool(riders[i])
        on = driven * (1 + min(code, 0)) * (rides or _stands_in_traffic(pose, environment, camera))
        levels = exposure * (on + np.array([0, _BRAKING * max(code, 0)]))
        if levels.any():
            places = _RIDER_LAMPS_M if rides else np.array(_LAMP_PLACES, np.float32) * pose.size_lhw
            _draw_lamps(
                lamps,
                mirrored,
                owner == i + 1,
                pose,
                places,
                _RIDER_LAMP_M if rides else _LAMP_M,
                camera,
                to_numpy(environment.ground),
                extinction,
                levels,
            )
    if not (night or lamps.any()):
        return image
    wet = _WET_MIRROR * float(weather[Weather.RAIN])
    growth = 1 + 3 * float(weather[Weather.FOG]) + float(weather[Weather.RAIN])
    glare = sum(
        share * (growth if i else 1) * cv2.GaussianBlur(lamps, (0, 0), width * camera.height)
        for i, (width, share) in enumerate(_GLARE)
    )
    total = light + lamps + glare + wet * road[..., None] * mirrored
    rows, columns = (np.linspace(-0.5, 0.5, n, dtype=np.float32) for n in image.shape[:2])
    total *= (1 - night * _CORNER * (np.square(columns) + np.square(rows)[:, None]))[..., None]
    seen = total ** (1 / GAMMA)
    return (seen + night * _GRAIN * _grain(*image.shape[:2]) * (0.3 + np.sqrt(np.minimum(seen, 1)))).astype(
        np.float32
    )


def _light_by_night(
    light: Array, depth_m: Array, owner: NDArray[np.int64], environment: Environment, camera: PictureCamera
) -> tuple[Array, Array]:
    """What shines itself by night (H, W, 3), and what lamps light (H, W, 3), as a camera exposes it."""
    columns, rows = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (camera.width, camera.height)))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    points = rays * np.minimum(depth_m, _FARTHEST_M)[..., None]
    ground = to_numpy(environment.ground)
    up, above_m = ground[:3], float(ground[3] - camera.shift_m @ ground[:3])
    height = points @ up + above_m
    distance = np.linalg.norm(points, axis=2)
    flat = (owner == 0) & (height < 0.2)
    seen = np.clip(-(points @ up) / distance, 0, 1)
    road = to_numpy(environment.road)
    level = float(np.median(light[road > 0.5])) if (road > 0.5).sum() > 500 else 0.2
    albedo = np.clip(light / np.clip(level / _ROAD_ALBEDO, *_DAYLIGHT), 0, 0.9)

    def lit_by(intensity: Floats, away: Floats, square: Floats) -> Floats:
        slope = np.where(flat, np.clip(-(away @ up), 0, 1), _MATT)
        back = np.where(flat, 1 - _BACKWARD + _BACKWARD / np.maximum(slope + seen, 1e-2), 1)
        return intensity * slope * back / (square + 0.1)

    def from_lamp(place: Floats) -> tuple[Floats, Floats]:
        away = points - place
        square = np.square(away).sum(axis=2)
        return away / np.sqrt(square + 1e-6)[..., None], square

    street = np.zeros_like(depth_m)
    shining = np.zeros_like(light)
    foot = -above_m * up
    for k in range(_POSTS):
        side = 1.0 if k % 2 else -1.0
        place = foot + np.array([side * _ASIDE_M, 0, _SPACING_M * (0.6 + 0.5 * k)], np.float32)
        # the ground below it, then up
        place = place + (_POST_M - float(place @ up) - above_m) * up
        away, square = from_lamp(place)
        # none of its light goes up
        street += lit_by(_STREET_CD * np.clip(-3 * (away @ up), 0, 1), away, square)
        _draw_spot(shining, place, _POST_LAMP_M, camera, 12 * _STREET, (owner == 0) & (depth_m > place[2]))
    head = np.zeros_like(depth_m)
    for side in (-_OWN_PLACE_M[0], _OWN_PLACE_M[0]):
        place = foot + _OWN_PLACE_M[1] * up + np.array([side, 0, _OWN_PLACE_M[2]], np.float32)
        away, square = from_lamp(place)
        rise, aside = away @ up, np.arctan2(away[..., 0], np.maximum(away[..., 2], 1e-3))
        below = 1 / (1 + np.exp(np.clip((rise + _CUT) / _CUT_WIDTH, -30, 30)))
        beam = below * np.exp(-np.square(aside / _BEAM_RAD) - np.maximum(-rise - 0.03, 0) / _DROP) + _STRAY
        head += lit_by(_OWN_CD * beam, away, square)
    leaves = np.maximum(to_numpy(environment.foliage_map), to_numpy(environment.sky))
    signs = _find_signs(light, leaves) * (owner == 0)
    incoming = _TOWN + street[..., None] * _STREET + (head * (1 + _SIGN_GAIN * signs))[..., None] * _OWN
    windows = _find_windows(light, leaves) * (owner == 0) * (height > 1.5)
    shining += windows[..., None] * light
    sky = (to_numpy(environment.sky) * (owner == 0))[..., None]
    lit = albedo * incoming
    return shining, lit + sky * (_TOWN_GLOW - lit)


def _find_signs(light: Array, leaves: Array) -> Array:
    """How far (H, W) a pixel is a sign: strong colour, neither sky nor leaves."""
    high, low = light.max(axis=2), light.min(axis=2)
    saturation = cv2.GaussianBlur((high - low) / np.maximum(high, 1e-3) * (high > 0.08), (0, 0), 1.2)
    start, end = _SIGN_SATURATION
    return np.clip((saturation - start) / (end - start), 0, 1) * (leaves < 0.2)


def _find_windows(light: Array, leaves: Array) -> Array:
    """Where (H, W) the photograph has small bright areas away from the sky: lamps and windows."""
    size = max(light.shape[0] // 24, 3)
    bright = (light.min(axis=2) ** (1 / GAMMA) > _WINDOW).astype(np.uint8)
    # edges and wires are thin
    solid = cv2.morphologyEx(bright, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    opened = cv2.morphologyEx(bright, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    large = np.maximum(opened, (leaves > 0.2).astype(np.uint8))
    near = cv2.dilate(large, np.ones((2 * size + 1,) * 2, np.uint8))
    return solid * (1.0 - near).astype(np.float32)


def _stands_in_traffic(pose: VehiclePose, environment: Environment, camera: PictureCamera) -> float:
    """1 for a vehicle on the camera's path, or with road beyond its side that faces away from it; else 0."""
    x = float(pose.translation[0])
    half = float(pose.size_lhw[2]) / 2
    if abs(x) < half + 0.6:
        return 1.0
    side = np.sign(x) * np.sign(float(pose.rotation()[0, 2])) or 1.0
    outside = np.array(
        [[along * pose.size_lhw[0], 0, side * (half + 1.2)] for along in (-0.35, 0, 0.35)], np.float32
    )
    at = camera.project(outside @ pose.rotation().T + pose.translation + camera.shift_m)
    limit = np.array([camera.width, camera.height]) - 1
    inside = at[((at >= 0) & (at <= limit)).all(axis=1)].round().astype(int)
    road = to_numpy(environment.road)
    return float(not len(inside) or road[inside[:, 1], inside[:, 0]].mean() > 0.5)


def _draw_lamps(
    lamps: Array,
    mirrored: Array,
    seen: NDArray[np.bool_],
    pose: VehiclePose,
    places: Array,
    radius_m: float,
    camera: PictureCamera,
    ground: Array,
    extinction: float,
    levels: Floats,
) -> None:
    """Add the light of a vehicle's visible lamps and their images on a wet road.

    Args:
        lamps: (H, W, 3) light, changed in place.
        mirrored: (H, W, 3) light of the images, changed in place.
        seen: (H, W) where the vehicle is seen.
        pose: Its pose.
        places: (K, 3) m, of its lamps in its own axes, the first half in front.
        radius_m: Of each.
        camera: Camera.
        ground: (4,) plane of the ground.
        extinction: Of the air, per m.
        levels: (2,) front and rear.
    """
    for k, local in enumerate(places):
        front = 2 * k < len(places)
        place = pose.rotation() @ local + pose.translation + camera.shift_m
        facing = (
            float(pose.rotation()[:, 0] @ -place) * (1 if front else -1) / max(float(np.linalg.norm(place)), 1e-6)
        )
        if place[2] < 1 or facing <= 0:
            continue
        x, y = (round(float(v)) for v in camera.project(place.astype(np.float32)))
        if not seen[max(y - 2, 0) : max(y + 3, 0), max(x - 2, 0) : max(x + 3, 0)].any():
            continue
        colour = levels[0] * _HEAD * facing**4 if front else levels[1] * _TAIL * min(2 * facing, 1)
        colour = colour * np.exp(-extinction * place[2])
        _draw_spot(lamps, place, radius_m, camera, colour, seen)
        below = place - 2 * float(place @ ground[:3] + ground[3] - camera.shift_m @ ground[:3]) * ground[:3]
        _draw_streak(mirrored, place, below.astype(np.float32), camera, colour)


def _draw_spot(
    light: Array, place: Floats, radius_m: float, camera: PictureCamera, colour: Floats, where: NDArray[np.bool_]
) -> None:
    """Add the light of a lamp that is brightest in its middle to (H, W, 3), where it may be seen."""
    x, y = camera.project(place.astype(np.float32)).tolist()
    rows, columns = (np.arange(n, dtype=np.float32) for n in where.shape)
    width = max(radius_m * float(camera.intrinsics[0, 0]) / float(place[2]), 0.7)
    spot = np.exp(-np.square((rows - y) / (0.7 * width)) / 2)[:, None] * np.exp(
        -np.square((columns - x) / width) / 2
    )
    light += np.where(where, spot, 0)[..., None] * colour.astype(np.float32)


def _draw_streak(mirrored: Floats, place: Floats, below: Floats, camera: PictureCamera, colour: Floats) -> None:
    """Add a lamp's image on a wet road to (H, W, 3): waves tilt the mirror, so that it is drawn out towards the
    camera.
    """
    (x, top), (_, bottom) = camera.project(place), camera.project(below)
    long, wide = (
        max(0.45 * float(bottom - top), 1.0),
        max(0.13 * float(camera.intrinsics[0, 0]) / float(place[2]), 0.8),
    )
    rows, columns = (np.arange(n, dtype=np.float32) for n in mirrored.shape[:2])
    shape = np.exp(-np.abs(rows - bottom) / long)[:, None] * np.exp(-np.square((columns - x) / wide) / 2)
    mirrored += shape[..., None] * colour.astype(np.float32)


@lru_cache(maxsize=8)
def _grain(height: int, width: int) -> Array:
    """Grain (H, W, 3) of a sensor, of standard deviation 1; deterministic for each size."""
    grain = np.random.default_rng(47).normal(size=(height, width, 3))
    grain = cv2.GaussianBlur(grain, (0, 0), 0.6)
    return (grain / grain.std()).astype(np.float32)
