"""Opacity along a car's border."""

import cv2
import numpy as np

from scene_ir.derender.cutout import Cutout
from scene_ir.derender.matte import compute_matte, cutout_opacity

NONE = np.zeros((60, 80), bool)


def disc(radius: float) -> np.ndarray:
    """Exact coverage of a disc by four by four samples a pixel."""
    v, u = np.mgrid[0:240, 0:320] / 4.0 - 0.375
    return cv2.resize(
        (np.hypot(u - 40, v - 30) < radius).astype(np.float32), (80, 60), interpolation=cv2.INTER_AREA
    )


def blended(radius: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    alpha = disc(radius)[..., None]
    road = np.full((60, 80, 3), 0.55) + rng.normal(0, 0.01, (60, 80, 1))
    return (alpha * np.array([0.8, 0.1, 0.1]) + (1 - alpha) * road).astype(np.float32), alpha[..., 0]


def test_mixing_shares_are_read_off_the_photograph():
    image, truth = blended(18.3)
    found = compute_matte(image, truth >= 0.5)
    assert (truth - found).max() < 0.3
    assert (found - truth).max() <= 0.55
    assert np.abs(found - truth).mean() < 0.012


def test_a_mask_that_is_too_small_still_carries_the_car_away():
    image, truth = blended(18.3)
    tight = disc(17.0) >= 0.5
    found = compute_matte(image, tight)
    left_behind = np.clip(truth - found, 0, 1)
    assert left_behind.max() < 0.35
    assert (found[tight] >= 0.5).all()


def test_range_and_support():
    image, truth = blended(15.0)
    mask = truth >= 0.5
    found = compute_matte(image, mask)
    assert found.dtype == np.float32
    assert found.min() >= 0
    assert found.max() <= 1
    far = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) > 5
    assert (found[far] == 0).all()


def test_the_car_continues_under_a_nearer_one():
    _, truth = blended(15.0)
    hidden = NONE.copy()
    hidden[:, 45:] = True
    cutout = Cutout(0, 0, truth * ~hidden, hidden.astype(np.float32), np.zeros_like(truth))
    opacity = cutout_opacity(cutout, (truth >= 0.5) & ~hidden, hidden)
    assert opacity[30, 44] == 1
    assert opacity[30, 45] > 0.5


def test_an_empty_mask_has_no_matte():
    image, _ = blended(15.0)
    assert compute_matte(image, NONE).max() == 0
