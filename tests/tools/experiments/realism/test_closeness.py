"""How near two pictures look: known values and bounds."""

import numpy as np
import pytest

from tools.experiments.realism.perceptual import PerceptualDistance


def _noise(seed: int = 0, height: int = 60, width: int = 90) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def test_perceptual_distance() -> None:
    perception = PerceptualDistance()
    picture = np.zeros((60, 90, 3), np.uint8) + 90
    picture[20:40, 30:60] = (200, 30, 30)
    near = np.clip(picture.astype(int) + 2, 0, 255).astype(np.uint8)
    shifted = np.roll(picture, 5, axis=1)
    region = np.zeros((60, 90), bool)
    region[15:45, 25:70] = True
    assert perception.distance(picture, picture, region) == 0
    small, large = perception.distance(picture, near, region), perception.distance(picture, shifted, region)
    assert 0 < small < 0.3 * large
    assert perception.distance(shifted, picture, region) == pytest.approx(large, rel=1e-5)
    # Unit-length features of 0 or more are never farther apart than two.
    assert large < 2


def test_the_perceptual_distance_looks_at_the_region() -> None:
    perception = PerceptualDistance()
    picture = _noise()
    changed = picture.copy()
    changed[:, 60:] = 0
    left, right = np.zeros((60, 90), bool), np.zeros((60, 90), bool)
    left[:, :20], right[:, 70:] = True, True
    assert perception.distance(picture, changed, left) < 0.01 < perception.distance(picture, changed, right)
