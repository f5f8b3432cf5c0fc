"""The benchmark of weather: figures of one frame, and what they are means of."""

from dataclasses import replace

import pytest

from detectors.registry import load_predictor
from drivesem.synth.frames import SynthSettings, plan_frame
from tools.bench import weather


@pytest.fixture(scope="module")
def rows() -> list[weather.WeatherRow]:
    plan = plan_frame(61, 2, "train", SynthSettings(bent=True, sunny=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(weather, "CODES", {name: weather.CODES[name] for name in ("none", "fog 1", "overcast 1")})
        return weather.weather_rows("train", 2, plan, load_predictor("squeezedet"))


@pytest.mark.slow
def test_without_weather_both_are_the_photograph(rows: list[weather.WeatherRow]) -> None:
    plain = rows[0]
    assert plain.weather == "none"
    assert plain.cars > 0
    assert plain.psnr_db == 99.0
    assert (plain.mean, plain.contrast, plain.margin) == (plain.mean_true, plain.contrast_true, plain.margin_true)


@pytest.mark.slow
def test_fog_is_as_bright_and_as_flat_as_the_generators(rows: list[weather.WeatherRow]) -> None:
    """Blended in display values it would be a tenth darker again, and half as contrasted again. The generator exposes
    as a camera does, so it is somewhat brighter than our constants of real frames.
    """
    plain, fog, _ = rows
    assert min(fog.mean - plain.mean, fog.mean_true - plain.mean_true) > 0.1
    assert fog.mean == pytest.approx(fog.mean_true, abs=0.1)
    assert fog.contrast == pytest.approx(fog.contrast_true, rel=0.35)


@pytest.mark.slow
def test_the_summary_weighs_frames_by_their_vehicles(rows: list[weather.WeatherRow]) -> None:
    first = rows[0]
    second = replace(first, cars=3 * first.cars, margin=first.margin + 4.0)
    (told,) = weather.summary([first, second])
    assert (told["pool"], told["weather"], told["frames"]) == ("train", "none", 2)
    assert told["cars"] == 4 * first.cars
    assert told["margin"] == pytest.approx(first.margin + 3.0, abs=1e-3)
