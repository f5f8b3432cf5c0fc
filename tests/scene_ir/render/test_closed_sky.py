"""The light of a closed sky in a picture: bounds, edges, identity, gradients, and what is kept with a scene."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from scene_ir.io import load_scene, save_scene
from scene_ir.render import environment as env
from scene_ir.render import model
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import WEATHER_DIM, SceneIR, Weather, convert_scene

HALF = 32


def _shadow(height: int = 40, width: int = 2 * HALF) -> tuple[Tensor, Tensor, Tensor]:
    """Closed sky at an eighth of the size that lifts the right half, a background whose right half is in a shadow with
    its edge elsewhere, no sky.
    """
    closed_sky = torch.full((3, height // 8, width // 8), 0.5)
    closed_sky[:, :, HALF // 8 :] = 0.75
    background = torch.full((3, height, width), 0.6)
    background[:, :, HALF + 3 :] = 0.3
    return closed_sky, background, torch.zeros(height, width)


def test_the_change_is_bounded_and_ends_at_the_edges_of_the_background() -> None:
    closed_sky, background, sky = _shadow()
    gain = env.compute_closed_sky_gain(closed_sky, background, sky, 200.0)
    lifted = float(torch.expm1(torch.tensor(0.5 * model.CLOSED_SKY_LOG)))
    assert gain.shape == background.shape
    torch.testing.assert_close(gain[:, 20, 5], torch.zeros(3), atol=0.05, rtol=0)
    torch.testing.assert_close(gain[:, 20, -5], torch.full((3,), lifted), atol=0.1, rtol=0)
    step = gain[0, 20].diff()
    assert int(step.argmax()) == HALF + 2
    extreme = env.compute_closed_sky_gain(torch.ones_like(closed_sky), background, sky, 200.0)
    assert float(extreme.max()) <= torch.tensor(model.CLOSED_SKY_LOG).expm1() + 1e-5


def test_the_sky_keeps_its_light() -> None:
    closed_sky, background, sky = _shadow()
    assert not env.compute_closed_sky_gain(closed_sky, background, torch.ones_like(sky), 200.0).any()


def test_each_code_covers_the_sun() -> None:
    assert float(env.sunlight_share(torch.zeros(WEATHER_DIM))) == 1.0
    for code in torch.eye(WEATHER_DIM):
        assert float(env.sunlight_share(code)) == 0.0


@pytest.fixture
def shaded(photographed: SceneIR) -> SceneIR:
    """A scene whose lower left a closed sky would darken."""
    height, width = photographed.environment.sky.shape
    closed_sky = torch.full((2, 3, height // 8, width // 8), 0.5)
    closed_sky[0, :, height // 16 :, : width // 16] = 0.3
    closed_sky[1, :, :, width // 16 :] = 0.6
    return replace(photographed, environment=replace(photographed.environment, closed_sky=closed_sky))


def _under(scene: SceneIR, code: Weather, amount: float) -> SceneIR:
    weather = torch.eye(WEATHER_DIM)[code] * amount
    return replace(scene, environment=replace(scene.environment, weather=weather.to(scene.background)))


@pytest.mark.parametrize("backend", ["warp", "reference"])
def test_without_weather_no_bit_changes(shaded: SceneIR, backend: str) -> None:
    scene = convert_scene(shaded, torch.float32) if backend == "warp" else shaded
    unknown = replace(scene, environment=replace(scene.environment, closed_sky=None))
    settings = RenderSettings(backend=backend)  # type: ignore[arg-type]
    with_it, without = (Compositor(one, settings).render(one).image for one in (scene, unknown))
    assert torch.equal(with_it, without)


def test_clouds_take_the_sun_away(shaded: SceneIR) -> None:
    unknown = replace(shaded, environment=replace(shaded.environment, closed_sky=None))
    light, dark = (
        Compositor(scene).render(_under(scene, Weather.OVERCAST, 1.0)).image for scene in (unknown, shaded)
    )
    width = light.shape[2]
    assert float(dark[:, -4:, :4].mean()) < 0.8 * float(light[:, -4:, :4].mean())
    torch.testing.assert_close(dark[:, -4:, width - 4 :], light[:, -4:, width - 4 :], atol=0.02, rtol=0)


@pytest.mark.parametrize("backend", ["warp", "reference"])
def test_vehicles_have_the_light_of_the_photographs_map(shaded: SceneIR, backend: str) -> None:
    scene = convert_scene(shaded, torch.float32) if backend == "warp" else shaded
    closed_sky = scene.environment.closed_sky
    assert closed_sky is not None
    even = torch.stack([closed_sky[0], torch.full_like(closed_sky[1], 0.5)])
    same = replace(scene, environment=replace(scene.environment, closed_sky=even))
    settings = RenderSettings(backend=backend)  # type: ignore[arg-type]
    compositor, unchanged = Compositor(scene, settings), Compositor(same, settings)
    lit = compositor.closed_sky_brightening - unchanged.closed_sky_brightening
    # a code of 0.6 is a gain of exp(0.3), for all but what is nearly white
    assert float(lit.max()) > math.expm1(0.3)
    bright, plain = (c.render(_under(scene, Weather.OVERCAST, 1.0)) for c in (compositor, unchanged))
    change = bright.image - plain.image
    assert float(change.min()) > -1e-6
    changed = change.amax(dim=0) > 0.01
    assert bool(changed.any())
    assert bool((bright.object_id[changed] > 0).float().mean() > 0.9)


def test_stored_with_the_scene(shaded: SceneIR, tmp_path: Path) -> None:
    shaded = convert_scene(shaded, torch.float32)
    save_scene(shaded, tmp_path / "scene")
    found = load_scene(tmp_path / "scene").environment.closed_sky
    assert found is not None
    assert shaded.environment.closed_sky is not None
    assert torch.equal(found, shaded.environment.closed_sky)


@pytest.mark.parametrize("start", [0.0, 0.35])
def test_gradients_are_differences(
    check_code_gradient: Callable[..., None], shaded: SceneIR, start: float
) -> None:
    compositor = Compositor(shaded, RenderSettings(backend="reference"))

    def render(code: Tensor) -> Tensor:
        return compositor.render(replace(shaded, environment=replace(shaded.environment, weather=code))).image

    check_code_gradient(render, torch.full((WEATHER_DIM,), start, dtype=torch.float64))
