"""Tiling noise that surfaces are painted with: made once per pool, sampled by position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

SIZE = 512
"""Texels along one side of every noise texture; textures tile."""
BYTE_SUM_SCALE = (4 * (256**2 - 1) / 12) ** -0.5
"""One over the standard deviation of the sum of four uniform bytes."""


@dataclass(frozen=True, slots=True)
class NoiseSet:
    """Three textures (SIZE + 1, SIZE + 1) float32, zero mean, unit deviation, last row and column repeat the
    first.

    soft: clouds and patches (amplitude ~ 1/f^1.7); rough: leaves and plaster (~ 1/f^0.9); grain: nearly white.
    """

    soft: np.ndarray
    rough: np.ndarray
    grain: np.ndarray


def _spectral(rng: np.random.Generator, exponent: float) -> np.ndarray:
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None]) * SIZE
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * frequency**-exponent
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.pad(field / field.std(), ((0, 1), (0, 1)), mode="wrap").astype(np.float32)


@lru_cache(maxsize=4)
def noise_set(pool: int) -> NoiseSet:
    """The textures of a pool (an integer: training and held-out scenes use different ones)."""
    rng = np.random.default_rng([0x5EED, pool])
    return NoiseSet(_spectral(rng, 1.7), _spectral(rng, 0.9), _spectral(rng, 0.25))


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
