"""Tiling noise that surfaces are painted with: made once per pool, sampled by position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

SIZE = 512
"""Texels along one side of every noise texture; textures tile."""
_ROW = 4096
"""Width of the table that samples are folded into: cv2.remap takes at most 32767 columns."""


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
    n = x.shape[0]
    if n == 0:
        return np.zeros(0, np.float32)
    rows = -(-n // _ROW)
    maps = np.zeros((2, rows * _ROW), np.float32)
    for axis, value in ((0, x), (1, y)):
        out = maps[axis, :n]
        np.multiply(value, np.float32(1.0 / SIZE), out=out, casting="unsafe")
        out -= np.floor(out)
        out *= np.float32(SIZE)
        np.minimum(out, np.float32(SIZE - 1e-3), out=out)
    grid = maps.reshape(2, rows, _ROW)
    return cv2.remap(texture, grid[0], grid[1], cv2.INTER_LINEAR).reshape(-1)[:n]
