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
