"""Filling holes from the same photograph."""

import cv2
import numpy as np
import pytest

from scene_ir.derender.patch_fill import GroundMaps, PatchFillSettings, fill_patches, masked_blur, mirror_sources

SHAPE = (72, 120)


def textured(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = np.linspace(0.3, 0.7, SHAPE[0])[:, None, None]
    return np.clip(rows + 0.06 * rng.normal(size=(*SHAPE, 1)) * np.ones(3), 0, 1).astype(np.float32)


def hole() -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[25:50, 45:80] = True
    return mask


def no_ground() -> GroundMaps:
    return GroundMaps(np.zeros(SHAPE, bool), np.zeros(SHAPE, np.float32))


def filled(
    image: np.ndarray, forbidden: np.ndarray | None = None, ground: GroundMaps | None = None, seed: int = 0
):
    return fill_patches(
        image, hole(), hole() if forbidden is None else forbidden, 10.0, ground or no_ground(), seed
    )


def test_outside_the_hole_nothing_changes_and_inside_everything_is_in_range():
    image = textured()
    result = filled(image)
    assert np.array_equal(result[~hole()], image[~hole()])
    assert result.min() >= 0
    assert result.max() <= 1


def test_what_was_in_the_hole_does_not_matter():
    image, other = textured(), textured()
    other[hole()] = (1, 0, 1)
    assert np.array_equal(filled(image), filled(other))


def test_same_seed_same_bytes():
    assert np.array_equal(filled(textured(), seed=3), filled(textured(), seed=3))


def test_fill_has_the_brightness_and_the_grain_of_its_rows():
    image = textured()
    result = filled(image)
    for row in (28, 37, 47):
        assert result[row, 45:80].mean() == pytest.approx(image[row, :45].mean(), abs=0.05)
    inside = result[25:50, 45:80] - result[25:50, 45:80].mean(1, keepdims=True)
    outside = image[25:50, :35] - image[25:50, :35].mean(1, keepdims=True)
    assert 0.8 * outside.std() < inside.std() < 1.25 * outside.std()


def test_forbidden_pixels_are_never_copied():
    image = textured()
    image[10:60, 85:100] = (1, 0, 0)
    forbidden = hole()
    forbidden[8:62, 83:102] = True
    result = filled(image, forbidden)
    assert (result[hole()][:, 0] - result[hole()][:, 1]).max() < 0.3


def test_ground_is_copied_where_ground_must_be():
    image = np.full((*SHAPE, 3), 0.2, np.float32)
    image[:, 80:] = 0.8
    like = np.zeros(SHAPE, np.float32)
    like[:, 80:] = 1
    wanted = hole()
    plain, guided = filled(image), filled(image, ground=GroundMaps(wanted, like))
    assert guided[37, 58].mean() > 0.7 > plain[37, 58].mean()


def test_an_empty_hole_returns_a_copy():
    image = textured()
    nothing = np.zeros(SHAPE, bool)
    result = fill_patches(image, nothing, nothing, 10.0, no_ground())
    assert np.array_equal(result, image)
    assert result is not image


def test_a_hole_that_is_the_whole_height_is_filled_from_the_side():
    image = textured()
    mask = np.zeros(SHAPE, bool)
    mask[:, 40:] = True
    result = fill_patches(image, mask, mask, 10.0, no_ground(), 0, PatchFillSettings(iterations=(2, 1)))
    assert np.isfinite(result).all()
    assert result[:, 100].mean() == pytest.approx(0.5, abs=0.1)


def test_mirrored_points_to_known_pixels_and_known_pixels_to_themselves():
    rows, columns = mirror_sources(hole())
    assert not hole()[rows, columns].any()
    own = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    assert np.array_equal(np.stack([rows, columns])[:, ~hole()], own[:, ~hole()])
    assert (rows[37, 46], columns[37, 46]) == (37, 42)


@pytest.mark.parametrize("side", [1, 4])
def test_a_hole_with_hardly_a_pixel_to_copy_from_is_filled(side: int):
    """Where all neighbours have the same source there is nothing left to try."""
    forbidden = np.ones(SHAPE, bool)
    forbidden[10 : 10 + side, 10 : 10 + side] = False
    image = textured()
    result = filled(image, forbidden)
    assert np.array_equal(result[~hole()], image[~hole()])
    assert result.min() >= 0
    assert result.max() <= 1


@pytest.mark.parametrize("sigma", [0.7, 6.0])
def test_a_blur_within_a_mask_is_that_of_the_whole_picture(sigma: float):
    rng = np.random.default_rng(2)
    values, mask = rng.random((90, 140, 3), np.float32), np.zeros((90, 140), bool)
    mask[10:20, 3:30] = rng.random((10, 27)) > 0.4
    weight = mask.astype(np.float32)
    total = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)[..., None]
    whole = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma) / total
    assert np.allclose(masked_blur(values, mask, sigma), whole, atol=1e-5)
    assert not masked_blur(values, np.zeros_like(mask), sigma).any()
