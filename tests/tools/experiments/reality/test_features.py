"""Features of vehicles in pictures, and which of them are hidden."""

import numpy as np
import pytest

from tools.experiments.reality.features import FEATURES, find_hidden, measure_objects


def test_a_dark_square_on_grey() -> None:
    picture = np.full((100, 200, 3), 128, np.uint8)
    picture[40:61, 80:121] = 26
    (measured,) = measure_objects(picture, np.array([[80.0, 40.0, 120.0, 60.0]]))
    expected = {
        "height_px": 20,
        "aspect": 2,
        "across": 0.5,
        "lightness": 26 / 255,
        "contrast": 0,
        "surround_lightness": 128 / 255,
        "surround_contrast": 0,
        "difference": 102 / 255,
    }
    assert set(expected) == set(FEATURES)
    assert {name: getattr(measured, name) for name in FEATURES} == pytest.approx(expected, abs=1e-3)


def test_stripes_have_contrast_on_either_side() -> None:
    picture = np.zeros((60, 60, 3), np.uint8)
    picture[:, ::2] = 255
    (measured,) = measure_objects(picture, np.array([[20.0, 20.0, 39.0, 39.0]]))
    assert measured.contrast == pytest.approx(0.5, abs=0.01)
    assert measured.surround_contrast == pytest.approx(0.5, abs=0.01)
    assert measured.difference == pytest.approx(0, abs=0.03)


def test_a_box_that_fills_the_picture_is_its_own_surroundings() -> None:
    picture = np.full((40, 40, 3), 51, np.uint8)
    (measured,) = measure_objects(picture, np.array([[-5.0, -5.0, 50.0, 50.0]]))
    assert measured.surround_lightness == pytest.approx(0.2)
    assert measured.difference == 0


def test_cut_and_covered_boxes_are_hidden() -> None:
    boxes = np.array(
        [
            [0.0, 20.0, 30.0, 40.0],  # at the left border
            [50.0, 20.0, 70.0, 40.0],  # half covered by the next
            [60.0, 25.0, 90.0, 50.0],  # nearer, so it covers
            [100.0, 20.0, 120.0, 40.0],  # free
        ]
    )
    assert find_hidden(boxes, (100, 200)).tolist() == [True, True, False, False]
