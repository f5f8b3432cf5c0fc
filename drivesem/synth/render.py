"""From triangles to a photograph: visibility at twice the resolution, then shading, then lens and sensor.

Kernels compute it. Plain numpy in `tests/drivesem/synth/reference_*.py` defines what is correct.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from drivesem.synth import kernels
from drivesem.synth.light import develop
from drivesem.synth.soup import Soup
from drivesem.synth.view import SHADOW_VIEWS_M, SUPERSAMPLING, Setting, Shadow, Sight, SunMaps, View, fine_matrix
from scene_ir.raster import verbs
from scene_ir.raster.layout import PixelLayout

SHADOW_TEXELS = 1024
"""Along one side of a shadow map."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A render. image (H, W, 3) uint8; developed (H * W, 3) float32, before lens and sensor; shining (H * W, 3)
    float32: light beyond white; touched (H * W,) bool, pixels that actors, their shadows or lamps change; sun_maps:
    shadow maps it used.
    """

    image: np.ndarray
    developed: np.ndarray
    shining: np.ndarray
    touched: np.ndarray
    sun_maps: SunMaps | None


def pixel_sums(samples: np.ndarray) -> np.ndarray:
    """Sums (H, W) over the samples (2H, 2W) of each pixel, in their type; see `blocks`."""
    n = SUPERSAMPLING
    rows = samples[::n] + samples[1::n]
    return rows[:, ::n] + rows[:, 1::n]


def rasterise(
    corners: np.ndarray, matrix: np.ndarray, rects: np.ndarray, ranges: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Face (T,) int32 (-1: none) and depth (T,) float32 of each draw's pixels, packed.

    corners (F, 3, 3) m; matrix (3, 3); rects (N, 4) px; ranges (N, 2) faces.
    """
    clip = torch.from_numpy((corners.reshape(-1, 3) @ matrix.T).astype(np.float32))
    faces = torch.arange(clip.shape[0], dtype=torch.int32).reshape(-1, 3)
    fragments = verbs.rasterize(
        clip,
        faces,
        torch.from_numpy(np.asarray(ranges, np.int32)),
        PixelLayout.from_rects(torch.from_numpy(np.asarray(rects))),
    )
    return fragments.face.numpy(), fragments.depth.numpy()


def sun_maps(soup: Soup, setting: Setting) -> SunMaps | None:
    """Shadow maps over the ground, or None without sun. soup: camera axes about the centre of projection."""
    rows = sun_rows(setting)
    return None if rows is None else SunMaps(rows, kernels.sun_depth(soup, rows, SHADOW_VIEWS_M, SHADOW_TEXELS))


def sun_rows(setting: Setting) -> np.ndarray | None:
    """`SunMaps.rows`, or None without sun."""
    light, view = setting.light, setting.view
    if float(light.sun_colour.max()) <= 0.01:
        return None
    # A world point slides along the sun's ray to the ground: (gx, gz) = (x, z) - h / l_up (l_x, l_z); h = -y.
    sun = light.sun @ view.rotation
    slope = np.array([sun[0], sun[2]]) / -sun[1]
    to_ground = np.array([[1.0, slope[0], 0.0], [0.0, slope[1], 1.0], [0.0, 1.0 / -sun[1], 0.0]])
    # Maps lie before the camera, wherever it stands and looks.
    cos, sin = np.cos(view.heading), np.sin(view.heading)
    to_map = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rows = to_map @ to_ground @ view.rotation.T
    shift = to_map @ (to_ground @ view.to_world(view.centre) - [*view.position_xz, 0.0])
    return np.concatenate([rows, shift[:, None]], axis=1).astype(np.float32)


def see(soup: Soup, view: View) -> Sight:
    """Which triangle each sample shows. soup: camera axes about the centre of projection."""
    size = (SUPERSAMPLING * view.camera.height, SUPERSAMPLING * view.camera.width)
    return Sight(soup, *kernels.see(soup, fine_matrix(view), size))


def render(sight: Sight, soup: Soup, shadows: list[Shadow], setting: Setting) -> Picture:
    """Photograph a world. sight: of the soup; shadows: of the actors in it."""
    maps = sun_maps(soup, setting)
    pixels = setting.view.camera.height * setting.view.camera.width
    developed, shining = np.empty((pixels, 3), np.float32), np.zeros((pixels, 3), np.float32)
    touched = kernels.develop_pixels(sight, setting, maps, shadows, (developed, np.ones(pixels, bool), shining))
    touched |= bool((setting.lamps[:, -1] > 0).any())
    return Picture(_photograph(sight, developed, shining, setting), developed, shining, touched, maps)


def render_without_actors(sight: Sight, full: Picture, setting: Setting) -> Picture:
    """The same photograph with no actors. sight: of the surroundings alone; full: with actors. Shades only
    what they touched.
    """
    maps = full.sun_maps
    if maps is not None:
        depth = maps.depth.copy()
        depth[:, 1] = np.inf
        maps = SunMaps(maps.rows, depth)
    developed, shining = full.developed.copy(), full.shining.copy()
    kernels.develop_pixels(sight, setting, maps, [], (developed, full.touched, shining))
    image = _photograph(sight, developed, shining, setting)
    return Picture(image, developed, shining, np.zeros_like(full.touched), maps)


def _photograph(sight: Sight, developed: np.ndarray, shining: np.ndarray, setting: Setting) -> np.ndarray:
    """The photograph (H, W, 3) uint8 of display values and of light beyond white, each (H * W, 3)."""
    shape = (setting.view.camera.height, setting.view.camera.width, 3)
    image = with_glare(developed.reshape(shape), shining.reshape(shape), setting)
    return take(with_flakes(image, sight.depth_m, setting), setting)


def with_flakes(image: np.ndarray, depth_m: np.ndarray, setting: Setting) -> np.ndarray:
    """Display values (H, W, 3) with falling snow: flakes at random places in the air before what is seen at `depth_m`
    (H, W), drawn out by their fall and the drive, lit by the sky and the own headlamps.
    """
    light, (height, width) = setting.light, depth_m.shape
    if light.snow == 0:
        return image
    rng = np.random.default_rng([*setting.grain_seed, 0x5A2])
    k = setting.view.camera.intrinsics.double().numpy()
    middle, focal = k[:2, 2], k[[0, 1], [0, 1]]
    near, far = (d**3 for d in _FLAKES_M)
    count = round(_FLAKES_PER_M3 * light.snow * height * width / float(np.prod(focal)) * (far - near) / 3)
    z = np.cbrt(rng.uniform(near, far, count))
    place = rng.uniform(0, [width, height], (count, 2))
    size_m = rng.uniform(*_FLAKE_SIZE_M, count)
    columns, rows = place.astype(int).T
    seen = z < depth_m[rows, columns]
    z, place, size_m = z[seen], place[seen], size_m[seen]
    fall = np.array([0.0, _FLAKE_FALL_M])
    end = middle + ((place - middle) * z[:, None] + focal * fall) / (z - _FLAKE_DRIVE_M)[:, None]
    size = focal[0] * size_m / z
    thick = np.maximum(np.rint(size), 1)
    opacity = np.minimum(size**2 / (thick * (thick + np.linalg.norm(end - place, axis=1))), 1)
    in_beam = (place[:, 1] - middle[1]) * z / focal[1] > setting.view.height_m - _HEADLAMP_M
    headlit = light.night * np.where(in_beam, *_FLAKE_HEADLIT) / (1 + np.square(z))
    layer, lamplit = np.zeros((height, width), np.uint8), np.zeros((height, width), np.float32)
    sides = np.rint(np.stack([place, end]) * 16).astype(int)
    values = np.stack([255 * opacity, headlit], axis=1).tolist()
    for a, b, thickness, (share, lit) in zip(*sides.tolist(), thick.astype(int).tolist(), values, strict=True):
        cv2.line(layer, a, b, share, thickness, cv2.LINE_AA, 4)
        cv2.line(lamplit, a, b, lit, thickness + 2, cv2.LINE_8, 4)
    radiance = _FLAKE_ALBEDO * (light.ambient + lamplit[..., None])
    colour = develop(radiance.reshape(-1, 3).astype(np.float32), setting.response).reshape(image.shape)
    veil = cv2.GaussianBlur(layer.astype(np.float32), (5, 5), _FLAKE_BLUR_PX)[..., None] / 255
    return image + veil * (colour - image)


def with_glare(image: np.ndarray, shining: np.ndarray, setting: Setting) -> np.ndarray:
    """Display values (H, W, 3) with the light that lens and air scatter around what shines brighter than white."""
    if not shining.any():
        return image
    height, light = image.shape[0], setting.light
    air = 1 + light.haze_per_m * _GLARE_M
    glare = np.zeros_like(image)
    for i, (across, down, share) in enumerate(_GLARE):
        glare += cv2.GaussianBlur(shining, (0, 0), across * height, sigmaY=down * height) * (
            share * (air if i else 1)
        )
    plain = replace(setting.response, exposure=1.0, white_balance=np.ones(1))
    linear = np.minimum(image, _WHITE) ** np.float32(2.2 / plain.contrast)
    fourth = np.square(np.square(linear))
    return develop(linear / np.sqrt(np.sqrt(1 - fourth)) + glare, plain).astype(np.float32)


def take(image: np.ndarray, setting: Setting) -> np.ndarray:
    """Lens and sensor: (H, W, 3) display values to uint8, with chromatic error, blur, rain, vignette and noise."""
    return kernels.expose(through_lens(image, setting), setting.response, grain_number(setting))


def through_lens(image: np.ndarray, setting: Setting) -> np.ndarray:
    """Display values (H, W, 3) with chromatic error, blur and rain."""
    response = setting.response
    image = _fringed(image, response.chromatic_px) if response.chromatic_px > 0 else image
    out = cv2.GaussianBlur(image, (5, 5), response.blur_px)
    if response.streaks > 0:
        brightness = _STREAK_BRIGHTNESS + (_STREAK_BY_NIGHT - _STREAK_BRIGHTNESS) * setting.light.night
        _streak(out, response.streaks, brightness, np.random.default_rng([*setting.grain_seed, 0x5A1]))
    return out


def grain_number(setting: Setting) -> int:
    """The seed of a picture's noise."""
    return int(np.random.SeedSequence(list(setting.grain_seed)).generate_state(1)[0])


def _fringed(image: np.ndarray, shift_px: float) -> np.ndarray:
    """Red a little larger and blue a little smaller about the image's centre: by `shift_px` in the corners."""
    height, width = image.shape[:2]
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    share = shift_px / float(np.hypot(*middle))
    out = image.copy()
    for channel, scale in ((0, 1 + share), (2, 1 - share)):
        to_source = np.concatenate([np.eye(2) / scale, (middle * (1 - 1 / scale))[:, None]], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        plane = np.ascontiguousarray(image[..., channel])
        out[..., channel] = cv2.warpAffine(
            plane, to_source, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    return out


_STREAKS = ((520, (6.0, 18.0), 1, 0.10), (130, (18.0, 46.0), 1, 0.16), (16, (50.0, 110.0), 2, 0.14))
"""Rain at three distances: streaks in an image of KITTI's size, lengths px, thickness px, opacity."""
_STREAK_BRIGHTNESS, _STREAK_BY_NIGHT = 0.85, 0.28
"""Display value of a drop: what lies behind, upside down, mostly sky; by night it is lit by lamps."""
_FLAKES_PER_M3, _FLAKES_M = 25.0, (0.8, 14.0)
"""Flakes of snow 1 in a cubic metre, and the distances within which they are drawn: those beyond are haze."""
_FLAKE_SIZE_M, _FLAKE_ALBEDO, _FLAKE_BLUR_PX = (0.003, 0.010), 0.9, 0.8
"""Sizes of flakes, their albedo, and the blur of their soft outlines."""
_HEADLAMP_M, _FLAKE_HEADLIT = 0.68, (18.0, 1.3)
"""Height of the own headlamps, and their irradiance by night a metre ahead, below that height and above."""
_FLAKE_FALL_M, _FLAKE_DRIVE_M = 0.012, 0.06
"""How far flakes fall and the camera drives during an exposure."""
_GLARE = ((0.004, 0.004, 0.10), (0.014, 0.014, 0.05), (0.07, 0.07, 0.03), (0.06, 0.0016, 0.006))
"""Glare of lens and windscreen: standard deviations across and down, in heights of the picture, and shares; the last
is the streak of wipers.
"""
_GLARE_M = 150.0
"""Haze of one over this length doubles the glare, except for the narrowest."""
_WHITE = np.float32(0.998)
"""Display value from which a pixel counts as just white, where glare is added."""


def _streak(image: np.ndarray, amount: float, brightness: float, rng: np.random.Generator) -> None:
    """Draw falling drops, blurred by their speed, over display values (H, W, 3), in place: they show the sky."""
    height, width = image.shape[:2]
    slant = float(rng.normal(0, 0.12))
    veil = np.zeros((height, width), np.float32)
    for number, (shortest, longest), thickness, opacity in _STREAKS:
        count = round(number * amount * height * width / (375 * 1242))
        top = rng.uniform((-40, -40), (width + 40, height), (count, 2))
        length = rng.uniform(shortest, longest, count)
        lean = slant + rng.normal(0, 0.03, count)
        ends = top + np.stack([np.sin(lean), np.cos(lean)], axis=1) * length[:, None]
        layer = np.zeros((height, width), np.uint8)
        strength = rng.uniform(0.35, 1.0, count)
        for a, b, value in zip(
            np.rint(top * 16).astype(int), np.rint(ends * 16).astype(int), strength, strict=True
        ):
            cv2.line(layer, a.tolist(), b.tolist(), float(255 * value), thickness, cv2.LINE_AA, 4)
        veil += layer * np.float32(opacity * (0.5 + 0.5 * amount) / 255)
    veil = cv2.GaussianBlur(veil, (3, 3), 0.6)[..., None]
    image += (np.float32(brightness) - image) * veil
