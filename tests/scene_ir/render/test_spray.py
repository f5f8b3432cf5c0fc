"""Spray of vehicles in rain: where it is, what hides it, and its gradients to poses and rain."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from scene_ir.render import model
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.spray import draw_spray
from scene_ir.types import WEATHER_DIM, SceneIR, Weather

ONCOMING, AHEAD = 0, 1
"""Rows of a car that faces the camera and of one that faces away."""


@pytest.fixture(scope="module")
def compositor(photographed: SceneIR) -> Compositor:
    return Compositor(photographed, RenderSettings(backend="reference"))


def _spray(compositor: Compositor, row: int, inverse_depth: Tensor | None = None, **objects: Tensor) -> Tensor:
    """Opacity of one vehicle's spray, in front of the background without vehicles if no depth is given."""
    scene = compositor.scene
    driven = torch.zeros_like(compositor.lamps.driven)
    driven[row] = 1.0
    inverse = compositor.canvas[3] if inverse_depth is None else inverse_depth
    found = replace(compositor.lamps, driven=driven)
    return draw_spray(inverse, replace(scene.objects, **objects), found, scene.camera)


def _middle(opacity: Tensor) -> tuple[float, float]:
    """Mean column and row of an opacity (H, W)."""
    rows, columns = torch.meshgrid(*(torch.arange(n).double() for n in opacity.shape), indexing="ij")
    total = opacity.sum()
    return float((columns * opacity).sum() / total), float((rows * opacity).sum() / total)


def test_behind_the_way_a_vehicle_heads_and_low(compositor: Compositor) -> None:
    scene, open_air = compositor.scene, torch.zeros_like(compositor.canvas[3])
    aside = scene.objects.translation.clone()
    aside[AHEAD] = torch.tensor([0.0, aside[AHEAD, 1], 14.0])
    yaw = scene.objects.yaw.clone()
    columns = []
    for turn in (0.0, torch.pi):  # to the right, to the left
        yaw[AHEAD] = turn
        opacity = _spray(compositor, AHEAD, open_air, translation=aside, yaw=yaw.clone())
        columns.append(_middle(opacity)[0])
    matrix, length = scene.camera.matrix.double(), float(scene.objects.size_lhw[AHEAD, 0])
    assert (columns[1] - columns[0]) / 2 > float(matrix[0, 0]) / 14.0 * length / 2
    on_ground = _spray(compositor, AHEAD, translation=aside, yaw=yaw)
    foot = float(matrix[1, 1] * aside[AHEAD, 1] / 14.0 + matrix[1, 2])
    roof = foot - float(matrix[1, 1] * scene.objects.size_lhw[AHEAD, 1] / 14.0)
    by_row = on_ground.amax(dim=1)
    assert abs(int(by_row.argmax()) - foot) < 0.35 * (foot - roof)
    assert float(by_row[round(roof)]) < 0.05 * float(by_row.max())
    assert 0.1 < float(on_ground.max()) < 0.5


def test_hidden_by_what_is_nearer(compositor: Compositor) -> None:
    behind = _spray(compositor, AHEAD)
    assert float(behind.max()) > 0.05
    wall = torch.full_like(behind, 1.0 / 3.0)
    assert float(_spray(compositor, AHEAD, wall).max()) < 0.01 * float(behind.max())


def test_none_of_parked_vehicles_and_no_jump_where_it_is_too_near(compositor: Compositor) -> None:
    driven = torch.zeros_like(compositor.lamps.driven)
    scene = compositor.scene
    parked = draw_spray(
        compositor.canvas[3], scene.objects, replace(compositor.lamps, driven=driven), scene.camera
    )
    assert not parked.any()
    open_air, near = torch.zeros_like(compositor.canvas[3]), scene.objects.translation.clone()
    peaks = []
    for z in torch.linspace(1.0, 20.0, 96).tolist():
        near[AHEAD, 2] = z
        peaks.append(float(_spray(compositor, AHEAD, open_air, translation=near).max()))
    assert peaks[0] == 0.0
    assert max(peaks) > 0.1
    assert max(abs(a - b) for a, b in pairwise(peaks)) < 0.06


def _rainy(scene: SceneIR, rain: float) -> SceneIR:
    weather = torch.zeros(WEATHER_DIM, dtype=torch.float64)
    weather[Weather.RAIN] = rain
    return scene.with_environment(weather=weather)


@pytest.mark.parametrize("backend", ["reference", "warp"])
def test_rain_brings_it_and_dry_weather_changes_no_bit(
    backend: str, photographed: SceneIR, monkeypatch: pytest.MonkeyPatch
) -> None:
    compositor = Compositor(photographed, RenderSettings(backend=backend))  # type: ignore[arg-type]
    wet, dry = (compositor.render(_rainy(photographed, rain)).image for rain in (0.9, 0.0))
    leaf = torch.zeros(WEATHER_DIM, dtype=torch.float64).requires_grad_()
    live = compositor.render(photographed.with_environment(weather=leaf)).image
    monkeypatch.setattr(model, "SPRAY_PER_M", 0.0)
    without, dry_without = (compositor.render(_rainy(photographed, rain)).image for rain in (0.9, 0.0))
    assert torch.equal(dry, dry_without)
    assert torch.equal(
        live.detach(), compositor.render(photographed.with_environment(weather=leaf)).image.detach()
    )
    change = wet - without
    assert float(change.max()) > 0.02
    assert float(change.min()) > -0.01


def test_gradients_to_poses_sizes_and_depth_are_those_of_differences(compositor: Compositor) -> None:
    objects, inverse = compositor.scene.objects, compositor.canvas[3]
    weights = torch.randn(inverse.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def total(move: Tensor, turn: Tensor, grow: Tensor, nearer: Tensor) -> Tensor:
        changed = replace(
            objects,
            translation=objects.translation + move,
            yaw=objects.yaw + turn,
            size_lhw=objects.size_lhw * (1.0 + grow),
        )
        return (draw_spray(inverse + nearer, changed, compositor.lamps, compositor.scene.camera) * weights).sum()

    count = len(objects)
    start = [torch.zeros(count, n, dtype=torch.float64).squeeze(1) for n in (3, 1, 3)]
    start.append(torch.tensor(1e-3, dtype=torch.float64))
    # The window is cut at three standard deviations: steps must not move it by a pixel.
    assert torch.autograd.gradcheck(total, [t.requires_grad_() for t in start], eps=1e-7, atol=1e-4)


def test_both_backends_draw_it_alike_with_their_gradients(photographed: SceneIR) -> None:
    found = []
    for backend in ("reference", "warp"):
        compositor = Compositor(photographed, RenderSettings(backend=backend))  # type: ignore[arg-type]
        weather = torch.zeros(WEATHER_DIM, dtype=torch.float64)
        weather[Weather.RAIN] = 0.7
        leaf, move = weather.requires_grad_(), photographed.objects.translation.clone().requires_grad_()
        state = photographed.with_environment(weather=leaf).with_objects(translation=move)
        image = compositor.render(state).image.double()
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        found.append([image.detach(), *torch.autograd.grad((image * weights).sum(), [leaf, move])])
    (image, by_weather, _), (fast, fast_by_weather, _) = found
    assert float((image - fast).abs().amax()) < 2e-3
    torch.testing.assert_close(fast_by_weather, by_weather, rtol=2e-2, atol=0.2)
