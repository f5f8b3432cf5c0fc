"""What a person sees: hand-made pictures of a car on a road."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem.attacks.visibility import (
    FLARE,
    MIN_CONTRAST,
    VisibilityUnderWeather,
    compute_contrasts,
    contrast_between,
    luminance,
)
from scene_ir.render.environment import apply_weather
from scene_ir.types import Crop, Environment, Render

HEIGHT, WIDTH = 120, 200
TOP, LEFT, HIGH, WIDE = 40, 60, 40, 70
AIR = torch.tensor([0.8, 0.8, 0.8])
CLEAR = torch.zeros(4)


def _display(light: float) -> float:
    return 1.055 * light ** (1 / 2.4) - 0.055 if light > 0.0031308 else 12.92 * light


def _seen(car: float, road: float, windows: float | None = None, away_m: float = 10.0) -> Render:
    """A car (display values) on a road that reaches as far as it stands."""
    image = torch.full((3, HEIGHT, WIDTH), road)
    ids = torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    ids[TOP : TOP + HIGH, LEFT : LEFT + WIDE] = 1
    image[:, ids == 1] = car
    if windows is not None:
        image[:, TOP : TOP + HIGH // 3, LEFT : LEFT + WIDE] = windows
    opacity = (ids == 1).float()[TOP : TOP + HIGH, LEFT : LEFT + WIDE]
    return Render(image, torch.full((HEIGHT, WIDTH), away_m), ids, (Crop(opacity[None].clone(), LEFT, TOP),))


def _environment(weather: torch.Tensor, height: int = HEIGHT, width: int = WIDTH) -> Environment:
    nothing = torch.zeros(height, width)
    return Environment(
        weather=weather,
        foliage=torch.zeros(3),
        sun=torch.tensor([0.0, -1.0, 0.0]),
        ground=torch.tensor([0.0, -1.0, 0.0, 1.65]),
        sky=nothing,
        foliage_map=nothing,
        road=nothing,
    )


def _in_weather(render: Render, weather: torch.Tensor) -> Render:
    image = apply_weather(render.image, 1 / render.depth, _environment(weather), AIR)
    return Render(image, render.depth, render.object_id, render.opacity)


def test_a_uniform_car_has_its_weber_contrast():
    car, road = 0.30, 0.20
    found = compute_contrasts(_seen(_display(car), _display(road)))
    assert found == pytest.approx([(car - road) / (0.5 * (car + road) + FLARE)], rel=0.03)  # of 8 bits


@pytest.mark.parametrize(
    ("car", "road", "windows", "seen"),
    [
        (0.5, 0.5, None, False),  # grey on grey
        (0.5, 0.5, 0.2, True),  # grey on grey, with windows
        (0.51, 0.5, None, False),
        (0.55, 0.5, None, True),
        (0.05, 0.02, None, False),  # black on black: a screen's own light is more
        (0.05, 0.5, None, True),
        (0.9, 0.5, None, True),
    ],
)
def test_who_is_seen(car, road, windows, seen):
    assert (compute_contrasts(_seen(car, road, windows))[0] >= MIN_CONTRAST) == seen


def test_an_object_that_shows_nowhere_has_none():
    render = _seen(0.1, 0.5)
    assert compute_contrasts(
        Render(render.image, render.depth, render.object_id * 0, render.opacity)
    ).tolist() == [0.0]
    assert contrast_between(np.array([0.5]), np.array([])) == 0.0


def test_what_covers_less_than_a_tenth_is_no_contrast():
    image = _seen(0.5, 0.5).image.clone()
    image[:, TOP : TOP + 3] = 1.0  # a streak of light over car and road
    render = _seen(0.5, 0.5)
    assert compute_contrasts(Render(image, render.depth, render.object_id, render.opacity))[0] < MIN_CONTRAST


def test_a_black_car_in_fog_is_seen_near_and_not_far():
    fog = torch.tensor([1.0, 0.0, 0.0, 0.0])
    near, far = (_in_weather(_seen(0.15, 0.5, away_m=away), fog) for away in (10.0, 120.0))
    assert compute_contrasts(near)[0] > 4 * MIN_CONTRAST
    assert compute_contrasts(far)[0] < MIN_CONTRAST


LIGHT = st.lists(st.floats(0, 1), min_size=1, max_size=30).map(np.array)


@settings(max_examples=200, deadline=None)
@given(own=LIGHT, around=LIGHT, veils=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_a_veil_of_bright_air_only_takes_contrast(own, around, veils):
    thin, thick = (contrast_between((1 - veil) * own + veil, (1 - veil) * around + veil) for veil in sorted(veils))
    assert thick <= thin + 1e-12


def test_the_more_fog_the_less_is_seen():
    render = _seen(0.3, 0.6, away_m=60.0)
    fogs = [torch.tensor([fog, 0.0, 0.0, 0.0]) for fog in (0.0, 0.25, 0.5, 0.75, 1.0)]
    found = [compute_contrasts(_in_weather(render, fog))[0] for fog in fogs]
    assert found == sorted(found, reverse=True)


def test_luminance_is_that_of_srgb():
    white, middle = torch.ones(3, 1).numpy(), torch.full((3, 1), 0.5).numpy()
    assert luminance(white) == pytest.approx([1.0])
    assert luminance(middle) == pytest.approx([((128 / 255 + 0.055) / 1.055) ** 2.4])
    green = np.array([[0.0], [1.0], [0.0]])
    assert luminance(green) == pytest.approx([0.7152])


@pytest.mark.parametrize("weather", [(1.0, 0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0), (0.5, 0, 0.4, 0.7)])
@pytest.mark.parametrize("away_m", [10.0, 40.0, 80.0, 120.0])
def test_invisible_cars_agree_with_the_rendered_contrast(weather, away_m):
    render, codes = _seen(0.15, 0.5, 0.3, away_m), torch.tensor(weather)
    find_invisible = VisibilityUnderWeather(render, _environment(CLEAR), AIR, np.array([True]), MIN_CONTRAST)
    seen = compute_contrasts(_in_weather(render, codes))[0]
    if not 0.9 < seen / (1.25 * MIN_CONTRAST) < 1.1:  # some pixels are not all
        assert bool(find_invisible(codes.double().numpy())[0]) == (seen < 1.25 * MIN_CONTRAST)


def test_objects_not_in_question_stay_visible():
    thick = np.array([1.0, 0, 0, 0])
    render = _seen(0.15, 0.5, away_m=120.0)
    for requested in (True, False):
        find_invisible = VisibilityUnderWeather(
            render, _environment(CLEAR), AIR, np.array([requested]), MIN_CONTRAST
        )
        assert find_invisible(thick).tolist() == [requested]
        assert not find_invisible(np.zeros(4)).any()


def test_the_ego_vehicle_of_a_dashcam_changes_no_contrast():
    render, plain = _seen(0.15, 0.5, away_m=120.0), _environment(CLEAR)
    dashcam = replace(plain, ego=(torch.arange(HEIGHT)[:, None] > HEIGHT - 10).float().expand(HEIGHT, WIDTH))
    for environment in (plain, dashcam):
        find_invisible = VisibilityUnderWeather(render, environment, AIR, np.array([True]), MIN_CONTRAST)
        assert find_invisible(np.array([1.0, 0, 0, 0])).tolist() == [True]


def test_who_is_faint_from_the_start_may_stay_so():
    render = _seen(0.51, 0.5, away_m=30.0)
    find_invisible = VisibilityUnderWeather(render, _environment(CLEAR), AIR, np.array([True]), MIN_CONTRAST)
    assert compute_contrasts(render)[0] < MIN_CONTRAST
    assert not find_invisible(np.zeros(4)).any()
    assert find_invisible(np.array([0.5, 0, 0, 0])).all()


def test_contrast_is_of_the_picture_as_written():
    render = _seen(0.5 + 0.4 / 255, 0.5)
    assert compute_contrasts(render)[0] == 0.0
    assert math.isclose(
        compute_contrasts(_seen(0.6, 0.5))[0], compute_contrasts(_seen(round(0.6 * 255) / 255, 0.5))[0]
    )
