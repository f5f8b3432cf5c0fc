"""Measures of pictures made by hand, whose answers are known."""

import cv2
import numpy as np
import pytest

from tools.bench.picture_measures import (
    LINES,
    Floats,
    Picture,
    measure_glare,
    measure_noise,
    measure_picture,
    resize_to_lines,
)

NO_BOXES = np.zeros((0, 4))


def grey(level: int, size_hw: tuple[int, int] = (LINES, 1280)) -> Picture:
    return np.full((*size_hw, 3), level, np.uint8)


def boxes(*rows: tuple[float, float, float, float]) -> Floats:
    return np.array(rows, np.float64)


def test_light_and_colour_of_a_box_its_ring_and_the_frame() -> None:
    picture = grey(51)
    picture[300:400, 500:700] = (153, 0, 0)
    values = measure_picture(picture, boxes((500, 300, 699, 399)))
    red = 0.299 * 0.6
    assert values["boxes: brightness"] == pytest.approx(red, abs=0.001)
    assert values["boxes: contrast"] == pytest.approx(0, abs=1e-6)
    assert values["boxes: saturation"] == pytest.approx(1)
    assert values["boxes: red lamps, %"] == pytest.approx(100)
    assert values["ring: brightness"] == pytest.approx(0.2)
    assert values["ring: saturation"] == pytest.approx(0, abs=1e-6)
    share = 100 * 200 / (LINES * 1280)
    assert values["frame: brightness"] == pytest.approx(share * red + (1 - share) * 0.2, abs=0.001)


def test_values_of_boxes_are_means_over_vehicles_not_over_pixels() -> None:
    picture = grey(0)
    picture[100:500, 100:900] = 255
    picture[600:640, 100:140] = 51
    values = measure_picture(picture, boxes((100, 100, 899, 499), (100, 600, 139, 639)))
    assert values["boxes: brightness"] == pytest.approx((1 + 0.2) / 2, abs=1e-5)
    assert values["boxes: clipped, %"] == pytest.approx(50)


def test_a_frame_without_vehicles_has_no_values_of_boxes() -> None:
    values = measure_picture(grey(128), NO_BOXES)
    assert not any(name.startswith(("boxes", "ring")) for name in values)
    assert values["frame: lamps"] == 0
    assert "frame: glare" not in values


def test_pictures_are_compared_at_one_height_and_low_boxes_left_out() -> None:
    picture, kept = resize_to_lines(grey(7, (1440, 1000)), boxes((0, 0, 90, 50), (100, 200, 300, 280)))
    assert picture.shape == (LINES, 500, 3)
    np.testing.assert_allclose(kept, [[50, 100, 150, 140]])


def test_clipped_and_black_pixels_are_counted_in_percent() -> None:
    picture = grey(128)
    picture[:72] = (255, 200, 10)
    picture[-144:] = 0
    values = measure_picture(picture, NO_BOXES)
    assert values["frame: clipped, %"] == pytest.approx(10)
    assert values["frame: black, %"] == pytest.approx(20)


@pytest.mark.parametrize("sigma", [2.0, 6.0])
def test_noise_is_found_at_its_level(sigma: float) -> None:
    generator = np.random.default_rng(0)
    luma = np.full((480, 640), 0.1, np.float32)
    luma[240:] = 0.4
    luma[240:] += generator.normal(0, sigma / 255, (240, 640)).astype(np.float32)
    noise = measure_noise(luma)
    assert noise["dark"] == pytest.approx(0, abs=0.01)
    assert noise["mid"] == pytest.approx(sigma, rel=0.15)
    assert "bright" not in noise


def test_blur_lowers_sharpness_and_contrast_does_not() -> None:
    generator = np.random.default_rng(1)
    tiles = generator.integers(0, 2, (18, 32)).astype(np.uint8)
    sharp = np.kron(tiles, np.full((40, 40), 200, np.uint8))[..., None].repeat(3, axis=2)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 3).astype(np.uint8)
    faint = (sharp // 4 + 50).astype(np.uint8)
    values = [measure_picture(p, NO_BOXES)["frame: sharpness"] for p in (sharp, blurred, faint)]
    assert values[1] < 0.5 * values[0]
    assert values[2] == pytest.approx(values[0], rel=0.02)


def test_air_is_taken_above_the_horizon_of_the_vehicles() -> None:
    """A blue band lies just above the roofs of low vehicles, elsewhere the picture is grey."""
    picture = grey(120)
    picture[420:500] = (90, 110, 200)
    with_vehicles = measure_picture(picture, boxes((200, 495, 260, 545), (600, 496, 640, 536)))
    without = measure_picture(picture, NO_BOXES)
    blue = cv2.cvtColor(np.array([[[90, 110, 200]]], np.float32) / 255, cv2.COLOR_RGB2LAB)[0, 0]
    assert with_vehicles["frame: air a*"] == pytest.approx(float(blue[1]), abs=0.5)
    assert with_vehicles["frame: air b*"] == pytest.approx(float(blue[2]), abs=0.5)
    assert without["frame: air b*"] == pytest.approx(0, abs=0.5)


def test_glare_is_the_light_around_a_lamp() -> None:
    rows, columns = np.mgrid[:200, :300]
    distance = np.hypot(rows - 100, columns - 150)
    sharp = np.where(distance <= 8, 1.0, 0.1).astype(np.float32)
    halo = np.maximum(sharp, 0.1 + 0.6 * np.exp(-((distance / 16) ** 2))).astype(np.float32)
    assert measure_glare(sharp) == (1, pytest.approx(0, abs=1e-6))
    count, glare = measure_glare(halo)
    assert count == 1
    # between 12 and 20 px from the centre
    assert glare == pytest.approx(0.6 * np.exp(-1) / 0.9, rel=0.25)


def test_a_bright_sky_between_bright_roofs_is_no_lamp() -> None:
    luma = np.full((200, 300), 0.8, np.float32)
    luma[90:110, 140:160] = 1.0
    assert measure_glare(luma) == (0, None)
