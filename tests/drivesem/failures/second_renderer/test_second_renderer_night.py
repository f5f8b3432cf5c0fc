"""Night and lamps by the second renderer's own formulas: a flat road under the sky, and a car on it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from drivesem.failures.second_renderer.geometry import PictureCamera, VehiclePose
from drivesem.failures.second_renderer.night import apply_night
from drivesem.failures.second_renderer.shading import apply_weather
from scene_ir.types import Environment, Weather

HEIGHT, WIDTH, FOCAL, HORIZON, ABOVE_M = 160, 320, 300.0, 60, 1.5
CAMERA = PictureCamera(
    np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HORIZON], [0, 0, 1]], np.float32),
    np.zeros(3, np.float32),
    HEIGHT,
    WIDTH,
)
ROWS = np.arange(HEIGHT, dtype=np.float32)[:, None].repeat(WIDTH, axis=1)
DEPTH_M = np.where(ROWS > HORIZON, ABOVE_M * FOCAL / np.maximum(ROWS - HORIZON, 1e-3), np.inf).astype(np.float32)
IMAGE = np.where((ROWS > HORIZON)[..., None], 0.4, 0.8).repeat(3, axis=2).astype(np.float32)
CAR = VehiclePose(
    np.array([1.0, ABOVE_M, 12.0], np.float32),
    -math.pi / 2,
    np.array([4.2, 1.5, 1.8], np.float32),
    np.zeros((64, 3), np.float32),
)
OWNER = np.zeros((HEIGHT, WIDTH), np.int64)
OWNER[HORIZON : HORIZON + 50, WIDTH // 2 : WIDTH // 2 + 60] = 1


def surroundings(road: float = 1.0, **codes: float) -> Environment:
    weather = torch.tensor([codes.get(code.name.lower(), 0.0) for code in Weather])
    land = torch.from_numpy((ROWS > HORIZON).astype(np.float32))
    return Environment(
        weather=weather,
        foliage=torch.zeros(3),
        sun=torch.tensor([0.0, -1.0, 0.0]),
        ground=torch.tensor([0.0, -1.0, 0.0, ABOVE_M]),
        sky=1 - land,
        foliage_map=torch.zeros(HEIGHT, WIDTH),
        road=road * land,
    )


def by_night(
    lamps: float | None = None, image: np.ndarray = IMAGE, road: float = 1.0, **codes: float
) -> np.ndarray:
    """The picture; with the car where `lamps` has its code."""
    poses = [] if lamps is None else [CAR]
    owner = np.zeros_like(OWNER) if lamps is None else OWNER
    return apply_night(
        image,
        DEPTH_M,
        owner,
        surroundings(road, **codes),
        CAMERA,
        poses,
        np.full(len(poses), lamps or 0.0, np.float32),
    )


def test_without_codes_the_picture_stays() -> None:
    assert by_night() is IMAGE
    assert by_night(lamps=-1.0).tobytes() == IMAGE.tobytes()


def test_daylight_falls_with_the_code() -> None:
    pictures = [by_night(night=code) for code in (1e-3, 0.2, 0.4, 0.7, 1.0)]
    assert np.abs(pictures[0] - IMAGE).mean() < 0.005
    levels = [float(picture[: HORIZON // 2].mean()) for picture in pictures]
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] < 0.15
    assert pictures[-1].tobytes() == by_night(night=1.0).tobytes()


def test_headlamps_light_the_road_that_is_near() -> None:
    road = by_night(night=1.0)[..., 0]
    middle = slice(WIDTH // 2 - 10, WIDTH // 2 + 10)
    near, far = (float(road[HORIZON + round(ABOVE_M * FOCAL / m), middle].mean()) for m in (8, 45))
    assert near > 1.5 * far
    assert near > 1.3 * float(road[HORIZON + round(ABOVE_M * FOCAL / 8), :20].mean())


@pytest.mark.parametrize("codes", [{"night": 1.0}, {"fog": 1.0}])
def test_tail_lamps_are_red_brake_lamps_brighter_and_off_is_off(codes: dict[str, float]) -> None:
    off, on, brake = (by_night(lamps=code, **codes) for code in (-1.0, 0.0, 1.0))
    for across in (-0.38, 0.38):
        x = WIDTH / 2 + FOCAL * (1.0 + across * 1.8) / (12.0 - 0.48 * 4.2)
        y = HORIZON + FOCAL * (ABOVE_M - 0.75) / (12.0 - 0.48 * 4.2)
        lamp = slice(round(y) - 1, round(y) + 2), slice(round(x) - 1, round(x) + 2)
        red, green, _ = (on - off)[lamp].reshape(-1, 3).max(axis=0)
        assert red > 0.1
        assert red > 1.3 * green
        assert (brake - on)[lamp].max() > 0.05


def test_a_rider_has_one_lamp_white_ahead_and_red_behind() -> None:
    environment, rides = surroundings(0.0, night=1.0), np.array([True])
    across = float(np.arctan2(CAR.translation[0], CAR.translation[2]))
    for yaw, height_m, white in ((CAR.yaw, 0.6, False), (CAR.yaw + np.pi, 0.9, True), (across, 0.6, None)):
        pose = VehiclePose(CAR.translation, yaw, CAR.size_lhw, CAR.lattice)
        off, on = (
            apply_night(IMAGE, DEPTH_M, OWNER, environment, CAMERA, [pose], np.array([code], np.float32), rides)
            for code in (-1.0, 0.0)
        )
        light = on - off
        if white is None:
            assert light.max() < 0.05
            continue
        red, green, _ = light.sum(axis=(0, 1))
        assert (green > 0.8 * red) == white
        row, column = np.unravel_index(light[..., 0].argmax(), light.shape[:2])
        x, up, z = CAR.translation - np.array([0, height_m, 0])
        assert (row, column) == (
            pytest.approx(HORIZON + FOCAL * up / z, abs=1),
            pytest.approx(WIDTH / 2 + FOCAL * x / z, abs=1),
        )


def test_a_parked_car_is_dark() -> None:
    aside = VehiclePose(CAR.translation + np.array([2.5, 0, 0], np.float32), CAR.yaw, CAR.size_lhw, CAR.lattice)
    owner = np.roll(OWNER, 75, axis=1)
    for road, lit in ((1.0, True), (0.0, False)):
        pictures = [
            apply_night(
                IMAGE, DEPTH_M, owner, surroundings(road, night=1.0), CAMERA, [aside], np.array([code], np.float32)
            )
            for code in (0.0, -1.0)
        ]
        assert (np.abs(pictures[0] - pictures[1]).max() > 0.05) == lit


def test_a_wet_road_mirrors_lamps() -> None:
    """Below the car, where its lamps' images are."""
    row = round(HORIZON + FOCAL * (ABOVE_M + 0.75) / (12.0 - 0.48 * 4.2))
    gain = [
        float(
            (by_night(lamps=1.0, night=1.0, rain=rain) - by_night(lamps=-1.0, night=1.0, rain=rain))[
                row, :, 0
            ].max()
        )
        for rain in (0.0, 1.0)
    ]
    assert gain[1] > gain[0] + 0.05


def test_signs_send_the_headlamps_light_back() -> None:
    image = IMAGE.copy()
    image[HORIZON + 5 : HORIZON + 20, 100:115] = 0.4, 0.02, 0.02
    image[HORIZON + 5 : HORIZON + 20, 200:215] = 0.4, 0.4, 0.4
    picture = by_night(night=1.0, image=image)[HORIZON + 8 : HORIZON + 17]
    assert float(picture[:, 103:112, 0].mean()) > 1.2 * float(picture[:, 203:212, 0].mean())


def test_small_bright_areas_away_from_the_sky_shine_on() -> None:
    image = IMAGE.copy()
    window = slice(100, 105), slice(200, 205)
    image[window] = 1.0
    depth = np.where(ROWS > HORIZON, 20.0, np.inf).astype(np.float32)
    near = apply_night(
        image, depth, np.zeros_like(OWNER), surroundings(night=1.0), CAMERA, [], np.zeros(0, np.float32)
    )
    image[window] = 0.85
    plain = apply_night(
        image, depth, np.zeros_like(OWNER), surroundings(night=1.0), CAMERA, [], np.zeros(0, np.float32)
    )
    # below 1.5 m above the ground nothing is a window
    assert float(near[window].mean()) < 1.5 * float(plain[window].mean())
    tall = Environment(
        **{
            name: getattr(surroundings(night=1.0), name)
            for name in ("weather", "foliage", "sun", "sky", "foliage_map", "road")
        },
        ground=torch.tensor([0.0, -1.0, 0.0, 9.0]),
    )
    high = [
        apply_night(picture, depth, np.zeros_like(OWNER), tall, CAMERA, [], np.zeros(0, np.float32))
        for picture in (np.where(image == np.float32(0.85), 1.0, image).astype(np.float32), image)
    ]
    assert float(high[0][window].mean()) > 2 * float(high[1][window].mean())


def test_snow_pales_the_road() -> None:
    air, show = np.full(3, 0.8, np.float32), np.ones((HEIGHT, WIDTH), np.float32)
    road, bare = (apply_weather(IMAGE, DEPTH_M, show, surroundings(r, snow=0.8), air) for r in (1.0, 0.0))
    assert np.array_equal(road[:HORIZON], bare[:HORIZON])
    assert road[-40:].mean() > bare[-40:].mean() + 0.03
    without = apply_weather(IMAGE, DEPTH_M, show, surroundings(), air)
    assert without is IMAGE
