"""Sky, reflections and noise in plain numpy: they define what the generator's kernels of these names compute."""

from __future__ import annotations

import numpy as np

from drivesem.synth.light import PANORAMA_GLARE, Light, Panorama
from drivesem.synth.view import BYTE_SUM_SCALE, SIZE, NoiseSet


def sample(texture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear samples (n,) float32 of a tiling texture at texel coordinates x, y (n,)."""
    column, across = _fold(x)
    row, down = _fold(y)
    flat = texture.reshape(-1)
    at = row * np.int32(SIZE + 1) + column
    upper = flat[at] * (1 - across) + flat[at + 1] * across
    at += np.int32(SIZE + 1)
    return upper * (1 - down) + (flat[at] * (1 - across) + flat[at + 1] * across) * down


def _fold(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texel (n,) int32 in [0, SIZE) and the share (n,) of the one after it."""
    turn = np.asarray(value, np.float32) * np.float32(1.0 / SIZE)
    turn = np.minimum((turn - np.floor(turn)) * np.float32(SIZE), np.float32(SIZE - 1e-3))
    texel = turn.astype(np.int32)
    return texel, turn - texel.astype(np.float32)


def white_noise(seed: int, count: int) -> np.ndarray:
    """`count` nearly normal numbers of unit deviation, float32: the sum of four bytes of a hash of each number.

    The hash is lowbias32. Source: C. Wellons 2018, "Prospecting for hash functions".
    """
    x = np.arange(count, dtype=np.uint32) * np.uint32(0x9E3779B9) ^ np.uint32(seed)
    x ^= x >> 16
    x *= np.uint32(0x7FEB352D)
    x ^= x >> 15
    x *= np.uint32(0x846CA68B)
    x ^= x >> 16
    pairs = (x & np.uint32(0x00FF00FF)) + ((x >> 8) & np.uint32(0x00FF00FF))
    total = (pairs & np.uint32(0xFFFF)) + (pairs >> 16)
    return (total.astype(np.float32) - np.float32(510.0)) * np.float32(BYTE_SUM_SCALE)


def _panorama_radiance(light: Light, panorama: Panorama, direction: np.ndarray) -> np.ndarray:
    """Bilinear samples (n, 3) of a panorama in directions (n, 3); below the horizon, of the horizon."""
    height, width = panorama.pixels.shape[:2]
    right, forward = light.ahead
    azimuth = np.arctan2(direction @ right, direction @ forward) - np.float32(panorama.turn_rad)
    elevation = np.arcsin(np.clip(direction @ light.up.astype(np.float32), 0, 1))
    turn = azimuth * np.float32(1 / (2 * np.pi)) + np.float32(0.5)
    x = (turn - np.floor(turn)) * np.float32(width) - np.float32(0.5)
    y = np.maximum((np.float32(0.5) - elevation * np.float32(1 / np.pi)) * np.float32(height) - np.float32(0.5), 0)
    column, row = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    across, down = (x - column)[:, None], (y - row)[:, None]
    below = np.minimum(row + 1, height - 1)
    left, right_side = column % width, (column + 1) % width
    texels = panorama.pixels
    upper = texels[row, left] * (1 - across) + texels[row, right_side] * across
    lower = texels[below, left] * (1 - across) + texels[below, right_side] * across
    return (upper * (1 - down) + lower * down).astype(np.float32)


def _gradient(light: Light, height: np.ndarray) -> np.ndarray:
    """Radiance (n, 3) of a clear sky at heights (n,), sines of the elevation."""
    blend = np.sqrt(np.clip(height, 0, 1))[:, None]
    return light.horizon.astype(np.float32) * (1 - blend) + light.zenith.astype(np.float32) * blend


def sky_radiance(light: Light, direction: np.ndarray, noise: NoiseSet) -> np.ndarray:
    """Radiance (n, 3) of the sky in directions (n, 3) (unit, camera axes); below the horizon, of the horizon."""
    if light.panorama is not None:
        return _panorama_radiance(light, light.panorama, direction)
    height = np.clip(direction @ light.up.astype(np.float32), 0.0, 1.0)
    colour = _gradient(light, height)
    if light.clouds > 0:
        reach = np.float32(60.0) / np.maximum(height + 0.09, 0.09)
        right, forward = light.ahead
        field = sample(noise.soft, (direction @ right) * reach + light.cloud_seed, (direction @ forward) * reach)
        cover = np.clip((field - 1.6 + 2.6 * light.clouds) * 0.6, 0, 1) * min(light.clouds * 1.4, 1.0)
        white = light.horizon.astype(np.float32) * (1.15 + 0.1 * np.clip(field, -1.5, 1.5))[:, None]
        colour += (white - colour) * cover[:, None]
    glow = np.clip(direction @ light.sun.astype(np.float32), 0, 1) ** 24
    colour += glow[:, None] * (light.sun_colour * 0.9).astype(np.float32)
    return colour


def reflected_radiance(
    light: Light, direction: np.ndarray, noise: NoiseSet, ground: np.ndarray, soft: bool = False
) -> np.ndarray:
    """What smooth surfaces mirror from directions (n, 3): sky, a skyline of dark trees and houses, the road.

    soft: as water on asphalt does, with a low and blurred skyline.
    """
    height = direction @ light.up.astype(np.float32)
    if light.panorama is not None:
        sky = np.minimum(_panorama_radiance(light, light.panorama, direction), np.float32(PANORAMA_GLARE))
    else:
        sky = _gradient(light, height)
    right, forward = light.ahead
    azimuth = np.arctan2(direction @ right, direction @ forward)
    ridge = 0.20 + 0.09 * sample(noise.soft, azimuth * 81.4872 + light.cloud_seed, height * 20.0)
    ridge, sharpness = (ridge * 0.7, 5.0) if soft else (ridge, 12.0)
    town = (light.ambient * 0.22 + light.sun_colour * 0.03).astype(np.float32)
    road = (ground * (light.ambient + 0.6 * light.sun_colour)).astype(np.float32)
    above = np.clip((height - ridge) * sharpness + 0.5, 0, 1)[:, None]
    below = np.clip(-height * 14.0 + 0.5, 0, 1)[:, None]
    return (sky * above + town * (1 - above)) * (1 - below) + road * below
