"""Copying what stands beside a hole into it."""

import numpy as np
import pytest

from scene_ir.derender.standing_surfaces import ColumnCopySettings, copy_columns
from scene_ir.derender.street import StreetContinuation

SHAPE = (120, 320)
HORIZON = 40.0
FOOT = 80


def fence(foot: np.ndarray | None = None) -> np.ndarray:
    """Posts every 24 px on a light wall that ends at the foot; below, dark ground."""
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    image = np.full((*SHAPE, 3), 0.7, np.float32)
    image[columns % 24 < 8] = (0.2, 0.3, 0.2)
    image[rows < 20] = (0.6, 0.7, 0.95)
    image[rows >= (FOOT if foot is None else foot)] = 0.35
    return image


def hole() -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[45:100, 140:200] = True
    return mask


def guide(image: np.ndarray, foot: np.ndarray | None = None) -> StreetContinuation:
    """A grey guess above the ground."""
    feet = np.full(SHAPE[1], float(FOOT)) if foot is None else foot
    ground = np.arange(SHAPE[0])[:, None] >= feet
    guess = np.where(hole()[..., None], np.float32(0.52), image).astype(np.float32)
    return StreetContinuation(guess, ground, 0.0, 0.0, feet)


def spoilt(image: np.ndarray) -> np.ndarray:
    return np.where(hole()[..., None], np.float32([1, 0, 1]), image)


def test_posts_go_on_at_their_own_distance_and_stay_sharp():
    image = fence()
    ground = np.arange(SHAPE[0])[:, None] >= np.full(SHAPE[1], FOOT)
    found = copy_columns(spoilt(image), hole(), hole() | ground, guide(image), HORIZON)
    wall = hole() & ~ground
    assert found.copied[wall].mean() > 0.95
    assert not found.copied[~wall].any()
    assert np.array_equal(found.image[~found.copied], spoilt(image)[~found.copied])
    assert np.abs(found.image - image)[found.copied].mean() < 0.1
    assert found.image[found.copied].std() > 0.7 * image[found.copied].std()


def test_what_is_in_the_hole_does_not_matter_and_the_result_is_the_same_twice():
    image = fence()
    first, second = (copy_columns(i, hole(), hole(), guide(image), HORIZON) for i in (image, spoilt(image)))
    assert np.array_equal(first.image[first.copied], second.image[second.copied])


def test_forbidden_pixels_are_not_copied():
    image = fence()
    forbidden = hole()
    forbidden[:, 205:] = True
    image[:, 205:] = (1, 0, 0)
    found = copy_columns(spoilt(image), hole(), forbidden, guide(image), HORIZON)
    assert found.copied.any()
    red = found.image[found.copied][:, 0] - found.image[found.copied][:, 1]
    assert red.max() < 0.3


def test_a_wall_along_the_road_keeps_its_line_to_the_vanishing_point():
    feet = np.linspace(60, 108, SHAPE[1])
    rows = np.arange(SHAPE[0])[:, None]
    image = np.where(rows < HORIZON + (feet - HORIZON) / 2, 0.7, 0.3)[..., None].repeat(3, 2).astype(np.float32)
    image[rows >= feet] = 0.5
    forbidden = hole() | (rows >= feet)
    found = copy_columns(
        spoilt(image), hole(), forbidden, guide(image, feet), HORIZON, ColumnCopySettings(settle=0)
    )
    assert found.copied.any()
    assert np.abs(found.image - image)[found.copied].mean() < 0.03


@pytest.mark.parametrize("rows", [slice(0, 0), slice(90, 110)])
def test_without_an_upright_hole_nothing_changes(rows):
    image = fence()
    mask = np.zeros(SHAPE, bool)
    mask[rows, 100:120] = True
    found = copy_columns(image, mask, mask, guide(image), HORIZON)
    assert np.array_equal(found.image, image)
    assert not found.copied.any()


def test_a_narrow_source_is_not_repeated():
    image = np.full((*SHAPE, 3), 0.9, np.float32)
    # 20 columns have the guide's colour: repeated, they would fill the 60 of the hole.
    image[:, 202:222] = 0.52
    image[:, 210:214] = 0.35
    found = copy_columns(
        spoilt(image), hole(), hole(), guide(image), HORIZON, ColumnCopySettings(settle=0, ring_weight=0)
    )
    assert found.copied[60, 140:200].any()
    assert np.count_nonzero(found.image[60, 140:200, 0] < 0.7) <= 30


def test_columns_without_a_fitting_source_are_not_copied():
    image = fence()
    image[:, :140], image[:, 200:] = (1, 0, 0), (0, 0, 1)
    assert not copy_columns(spoilt(image), hole(), hole(), guide(image), HORIZON).copied.any()
