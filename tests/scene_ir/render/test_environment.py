"""Weather, time of day and foliage."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from scene_ir.render import environment as env
from scene_ir.render import model
from scene_ir.types import WEATHER_DIM, Environment, SceneIR

H, W = 40, 64
FOG, RAIN, TIME, OVERCAST, SNOW = range(5)
"""Codes of these tests: all but night's."""
CODES = 5


def _inputs(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Environment, Tensor]:
    """Picture, inverse depth (sky above row 10), environment, air."""
    generator = torch.Generator().manual_seed(1)
    image = 0.15 + 0.7 * torch.rand(3, H, W, generator=generator, dtype=dtype)
    rows = torch.arange(H, dtype=dtype)[:, None].expand(H, W)
    inverse = ((rows - 10) / 60).clamp(min=0.0)
    foliage = torch.zeros(H, W, dtype=dtype)
    foliage[8:20, 10:50] = 0.9
    scenery = Environment(
        torch.zeros(4, dtype=dtype), torch.zeros(3, dtype=dtype), torch.tensor([0.0, -1.0, 0.0], dtype=dtype),
        torch.tensor([0.0, -1.0, 0.0, 1.65], dtype=dtype), (rows < 10).to(dtype), foliage, (rows > 24).to(dtype),
    )  # fmt: skip
    return image, inverse, scenery, torch.tensor([0.75, 0.8, 0.86], dtype=dtype)


def _weather(code: Tensor) -> tuple[Tensor, Tensor]:
    image, inverse, scenery, air = _inputs(code.dtype)
    changed = replace(scenery, weather=torch.cat([code[:SNOW], code.new_zeros(1), code[SNOW:]]))
    out = env.apply_weather(image, inverse, changed, air, torch.cat([image, scenery.sky[None]]))
    return image, env.add_flakes(out, inverse, changed, air)


def _foliage(code: Tensor) -> tuple[Tensor, Tensor]:
    image, _, scenery, air = _inputs(code.dtype)
    return image, env.apply_foliage(image, replace(scenery, foliage=code), _crowns(air))


def _crowns(air: Tensor) -> Tensor:
    """Half-open leaves in front of the air."""
    half = air.new_full((2, H, W), 0.5)
    return torch.cat([half, air[:, None, None].expand(3, H, W)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("function", "size"), [(_weather, CODES), (_foliage, 3)])
def test_code_zero_changes_no_bit(function, size: int, dtype: torch.dtype) -> None:
    before, after = function(torch.zeros(size, dtype=dtype))
    assert torch.equal(before, after)


@pytest.mark.parametrize("start", [0.0, 0.35])
@pytest.mark.parametrize(("function", "size"), [(_weather, CODES), (_foliage, 3)])
def test_code_gradient_matches_differences_also_at_zero(
    check_code_gradient: Callable[..., None], function, size: int, start: float
) -> None:
    check_code_gradient(lambda code: function(code)[1], torch.full((size,), start, dtype=torch.float64))


def _code(index: int, value: float) -> Tensor:
    return torch.eye(CODES, dtype=torch.float64)[index] * value


def test_fog_follows_koschmieder_in_light(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "VEIL_BEND", 1e-6)
    image, after = _weather(_code(FOG, 0.5))
    _, inverse, _, air = _inputs()
    depth = 1.0 / inverse.clamp(min=1.0 / model.HAZE_CAP_M)
    clear = torch.exp(-0.015 * depth)
    grey = float(air @ torch.tensor(model.LUMA, dtype=air.dtype))
    air = (air + 0.5 * model.HAZE_GREY * (grey - air))[:, None, None]
    torch.testing.assert_close(after**2, image**2 * clear + air**2 * (1 - clear))


def test_a_veil_bends_near_black_only() -> None:
    """A thin veil brightens black by its slope, and hardly differs from mixing light elsewhere."""
    grey = torch.linspace(0, 1, 6, dtype=torch.float64).expand(3, 1, 6)
    air = torch.full((3, 1, 1), 0.8, dtype=torch.float64)
    veil = torch.full((1, 6), 0.3, dtype=torch.float64)
    out = env.apply_veil(grey, veil, air)
    light = torch.sqrt(0.7 * grey**2 + 0.3 * 0.8**2)
    assert float((out - light).abs()[..., 1:].max()) < 0.02
    assert 0.0 < float(light[0, 0, 0] - out[0, 0, 0]) < model.VEIL_BEND
    assert torch.equal(env.apply_veil(grey, torch.zeros_like(veil), air), grey)
    thin = 1e-7
    slope = float((env.apply_veil(grey, thin * torch.ones_like(veil), air) - grey)[0, 0, 0]) / thin
    assert slope == pytest.approx(0.8**2 / (2 * model.VEIL_BEND), rel=1e-3)


def test_twilight_is_dark_and_blue_sunset_is_warm() -> None:
    image, twilight = _weather(_code(TIME, 1.0))
    _, sunset = _weather(_code(TIME, 0.4))
    mean, dark, warm = (x.flatten(1).mean(dim=1) for x in (image, twilight, sunset))
    assert 0.65 * float(mean.mean()) < float(dark.mean()) < 0.9 * float(mean.mean())
    # the sky, the rows above 10, still glows
    gains = [
        float((after / before).mean())
        for before, after in ((image[:, :8], twilight[:, :8]), (image[:, 12:], twilight[:, 12:]))
    ]
    assert gains[0] > 1.2 * gains[1]
    ground = [x[:, 12:].flatten(1).mean(dim=1) for x in (image, twilight)]
    assert float(ground[1][2] / ground[1][0]) > 1.08 * float(ground[0][2] / ground[0][0])
    assert float(warm[0] / warm[2]) > 1.1 * float(mean[0] / mean[2])


@pytest.mark.parametrize("index", [FOG, RAIN, OVERCAST])
def test_a_low_sun_is_warm_in_clear_air_only(index: int) -> None:
    warm, hidden = (_weather(_code(TIME, 0.4) + share * _code(index, 1.0))[1] for share in (0.0, 1.0))
    warmth = [float((x[0] - x[2]).mean()) for x in (_weather(_code(index, 1.0))[1], warm, hidden)]
    assert warmth[1] > 0.02
    assert warmth[2] <= warmth[0] + 0.005


def test_overcast_and_rain_reduce_colour_and_contrast() -> None:
    for index in (RAIN, OVERCAST):
        image, after = _weather(_code(index, 1.0))
        ground = slice(12, 24)
        before, now = ((x.amax(dim=0) - x.amin(dim=0))[ground].mean() for x in (image, after))
        assert float(now) < 0.9 * float(before)
        assert float(after[:, ground].std()) < float(image[:, ground].std())


def test_weather_stays_in_range_and_is_deterministic() -> None:
    code = torch.ones(CODES, dtype=torch.float64) * 0.8
    _, after = _weather(code)
    assert float(after.min()) > -0.05
    assert float(after.max()) < 1.05
    assert torch.equal(after, _weather(code)[1])


def test_flakes_fall_in_front_of_what_is_farther() -> None:
    image, _, scenery, air = _inputs()
    snowy = replace(scenery, weather=torch.tensor([0, 0, 0, 0, 0, 1.0], dtype=image.dtype))
    near, far = (
        env.add_flakes(image, torch.full((H, W), 1 / depth_m, dtype=image.dtype), snowy, air)
        for depth_m in (model.FLAKE_M[0], 300.0)
    )
    assert torch.equal(near, image)
    assert float((far != image).double().mean()) > 0.5
    assert bool(((far >= image) | (image > 0.9 * air.min())).all())


def test_snow_pales_the_road_and_closes_the_sky() -> None:
    image, after = _weather(_code(SNOW, 1.0))
    road, sky = _inputs()[2].road > 0, _inputs()[2].sky > 0
    assert float(after[:, road].mean()) > float(image[:, road].mean()) + 0.03
    assert float(after[:, sky].std()) < 0.5 * float(image[:, sky].std())


def test_foliage_changes_nothing_else() -> None:
    image, after = _foliage(torch.tensor([0.8, -0.4, 0.5], dtype=torch.float64))
    outside = _inputs()[2].foliage_map == 0
    assert torch.equal(image[:, outside], after[:, outside])
    assert float((image - after)[:, ~outside].abs().mean()) > 0.02


def test_autumn_is_redder_and_thin_crowns_show_the_air() -> None:
    inside = _inputs()[2].foliage_map > 0
    spring, autumn = (_foliage(torch.tensor([h, 0, 0], dtype=torch.float64))[1][:, inside] for h in (-1.0, 1.0))
    assert float((autumn[0] - autumn[1]).mean()) > float((spring[0] - spring[1]).mean()) + 0.05
    thin, thick = (_foliage(torch.tensor([0, 0, d], dtype=torch.float64))[1][:, inside] for d in (-1.0, 1.0))
    assert float(thin.mean()) > float(thick.mean()) + 0.1


def test_grass_is_no_crown_and_thin_leaves_show_their_surroundings(
    street: Callable[[torch.dtype], SceneIR],
) -> None:
    """Four patches of leaves: in front of a blue sky, on a red wall, on level ground, and slightly above it."""
    scene = street(torch.float64)
    blue, red, grey = (
        torch.tensor(c).double()[:, None, None] for c in ((0.3, 0.5, 0.9), (0.8, 0.2, 0.2), (0.4,) * 3)
    )
    picture, depth, leaves = scene.background.clone(), scene.depth.clone(), torch.zeros_like(scene.depth)
    picture[:, :34], picture[:, 34:] = blue, grey
    picture[:, 10:34, 100:], depth[10:34, 100:] = red, 30.0
    patches = {"sky": (12, 20), "wall": (18, 115), "level": (60, 40), "low": (60, 100)}
    for top, left in patches.values():
        leaves[top : top + 8, left : left + 8] = 1.0
    picture = torch.where(leaves > 0, torch.tensor([0.1, 0.4, 0.1]).double()[:, None, None], picture)
    low = (slice(60, 68), slice(100, 108))
    depth[low] *= 1 - 0.5 * model.GRASS_M / scene.environment.ground[3]
    environment = replace(scene.environment, foliage_map=leaves)
    crowns = env.compute_crown_maps(replace(scene, background=picture, depth=depth, environment=environment))
    at = {name: crowns[:, top + 2 : top + 6, left + 2 : left + 6] for name, (top, left) in patches.items()}
    assert float(at["level"][:2].max()) < 1e-3
    torch.testing.assert_close(at["low"][:2].sum(0), torch.full((4, 4), 0.5).double(), atol=0.02, rtol=0)
    for name, colour in (("sky", blue), ("wall", red)):
        torch.testing.assert_close(at[name][:2].sum(0), torch.ones(4, 4).double())
        torch.testing.assert_close(at[name][2:], colour.expand(3, 4, 4), atol=0.02, rtol=0)


def test_sky_colour_is_photographed_or_default() -> None:
    image, _, scenery, _ = _inputs()
    image[:, :10] = torch.tensor([0.3, 0.5, 0.9], dtype=torch.float64)[:, None, None]
    found = env.sky_colour(image, scenery.sky)
    torch.testing.assert_close(found, torch.tensor([0.3, 0.5, 0.9], dtype=torch.float64))
    none = env.sky_colour(image, torch.zeros_like(scenery.sky))
    assert bool((none > 0.7).all())


def test_shadows_soften_in_bad_weather_only() -> None:
    assert float(env.shadow_softening(torch.zeros(WEATHER_DIM))) == 1.0
    assert float(env.shadow_softening(torch.eye(WEATHER_DIM)[OVERCAST])) < 0.6
