"""Night: what it does to a picture, its gradients, and the fused kernel against plain torch."""

import itertools
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from scene_ir.render import channels, night
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import WEATHER_DIM, Environment, SceneIR, Weather

VALUES, GRADIENTS = 1e-6, 1e-4
"""Largest difference between float32 and float64."""
FRAMES = st.sampled_from([(2, 2), (3, 70), (41, 3), (59, 131)])
CODE = st.lists(
    st.sampled_from([0.0, 1.0]) | st.floats(0, 1, width=32), min_size=WEATHER_DIM, max_size=WEATHER_DIM
)


def _inputs(height: int, width: int) -> tuple[list[Tensor], night.NightMaps]:
    """Picture slightly beyond [0, 1], inverse depth, sky, lit, lamps; maps. float64."""
    generator = torch.Generator().manual_seed(height * 100 + width)

    def noise(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).double()

    planes = [(noise(1, height, width) - 0.6) * 0.3, *(noise(1, height, width) for _ in range(4))]
    maps = torch.cat([*planes, 4 * noise(3, height, width) - 2, 0.1 * noise(6, height, width)])
    inverse = (noise(height, width) * 0.4 - 0.05).clamp(min=0.0)
    image = noise(3, height, width) * 1.1 - 0.05
    inputs = [image, inverse, noise(height, width), noise(height, width), 0.2 * noise(3, height, width)]
    return inputs, night.NightMaps(maps, 1.6, 1.0)


def _apply(inputs: list[Tensor], code: Tensor, maps: night.NightMaps, backend: str = "reference") -> Tensor:
    image, inverse, sky, lit, lamps = inputs
    blank = torch.zeros_like(sky)
    none = code.new_zeros(3)
    environment = Environment(code, none, none, code.new_zeros(4), sky, blank, 1.0 - sky)
    return night.apply_night(image, inverse, environment, lit, lamps, maps, backend)  # type: ignore[arg-type]


def _run(code: list[float], frame: tuple[int, int], backend: str) -> list[Tensor]:
    """Picture and gradients; float64 with the reference, float32 with Warp."""
    dtype = torch.float32 if backend == "warp" else torch.float64
    inputs, maps = _inputs(*frame)
    live = [t.float().to(dtype).requires_grad_() for t in (*inputs, torch.tensor(code))]
    out = _apply(live[:-1], live[-1], night.NightMaps(maps.maps.float().to(dtype), maps.camera_m, 1.0), backend)
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(3)).to(dtype)
    return [out.detach(), *torch.autograd.grad(out, live, weights)]


@settings(max_examples=25)
@given(CODE, FRAMES)
def test_kernel_agrees_with_the_reference(code: list[float], frame: tuple[int, int]) -> None:
    fast, reference = (_run(code, frame, backend) for backend in ("warp", "reference"))
    assert float((fast[0].double() - reference[0]).abs().max()) <= VALUES
    for mine, theirs in zip(fast[1:], reference[1:], strict=True):
        assert float((mine.double() - theirs).norm()) <= GRADIENTS * float(theirs.norm()) + 1e-5


@pytest.mark.parametrize("code", [[0.0] * 5, [0.4, 0.6, 0.0, 0.5, 0.7]])
def test_gradients_are_those_of_differences(code: list[float]) -> None:
    inputs, maps = _inputs(5, 7)
    inputs[1] = inputs[1].clamp(min=0.01)  # beyond, the depth ends
    live = [t.requires_grad_() for t in (*inputs, torch.tensor(code, dtype=torch.float64))]
    assert torch.autograd.gradcheck(lambda *t: _apply(list(t[:-1]), t[-1], maps), live)


@pytest.mark.parametrize("backend", ["reference", "warp"])
def test_code_zero_without_lamps_changes_no_bit(backend: str) -> None:
    inputs, maps = _inputs(59, 131)
    inputs[-1] = torch.zeros_like(inputs[-1])
    single = [t.float() for t in inputs]
    code = torch.zeros(WEATHER_DIM, requires_grad=True)
    out = _apply(single, code, night.NightMaps(maps.maps.float(), maps.camera_m, 1.0), backend)
    assert torch.equal(out, single[0])
    assert abs(float(torch.autograd.grad(out.sum(), code)[0][Weather.NIGHT])) > 1.0


def test_same_bytes_with_any_number_of_threads() -> None:
    threads, runs = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            runs.append(_run([0.3, 0.6, 0.0, 0.2, 0.8], (300, 131), "warp"))
    finally:
        torch.set_num_threads(threads)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(run, runs[0], strict=True))


def test_it_darkens_step_by_step_and_the_sky_most(photographed: SceneIR) -> None:
    compositor = Compositor(photographed, RenderSettings(backend="reference"))

    def render(amount: float) -> Tensor:
        code = torch.tensor([0.0, 0.0, 0.0, 0.0, amount], dtype=torch.float64)
        return compositor.render(photographed.with_environment(weather=code)).image

    pictures = [render(amount) for amount in (0.0, 0.25, 0.5, 0.75, 1.0)]
    sky = photographed.environment.sky > 0.99
    for brighter, darker in itertools.pairwise(pictures):
        assert float(darker[:, sky].mean()) < float(brighter[:, sky].mean())
        assert float(darker.mean()) < float(brighter.mean())
    assert float(pictures[-1][:, sky].mean()) < 0.15
    assert torch.equal(pictures[-1], render(1.0))


def test_headlamps_light_what_is_near_ahead_and_below_their_cut() -> None:
    height, width = 1, 4
    maps = _inputs(height, width)[1]
    image = torch.full((3, height, width), 0.5, dtype=torch.float64)
    # near and far on the road, near above the cut-off, near and far aside
    inverse = torch.tensor([[1 / 8, 1 / 60, 1 / 8, 1 / 8]], dtype=torch.float64)
    planes = torch.zeros_like(maps.maps)
    planes[channels.RISE] = -1.6 * inverse
    planes[channels.RISE, 0, 2] = 0.3
    planes[channels.AIM] = torch.tensor([[1.0, 1.0, 1.0, 0.1]])
    planes[channels.STREET] = 0.1
    blank = torch.zeros_like(inverse)
    code = torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    out = _apply([image, inverse, blank, blank, torch.zeros_like(image)], code, night.NightMaps(planes, 1.6, 1.0))
    near, far, above, aside = out[:, 0].mean(dim=0).tolist()
    assert near > 1.5 * max(far, above, aside)


def test_small_bright_places_above_the_ground_shine_on_and_patches_of_sun_do_not() -> None:
    rgb = torch.full((96, 96, 3), 0.3, dtype=torch.float64).numpy()
    rgb[60:63, 60:63] = 1.0
    rgb[20:23, 20:23] = 1.0
    rgb[70:, :40] = 1.0
    sky = torch.zeros(96, 96, dtype=torch.float64).numpy()
    sky[:18] = 1.0
    lit = night.find_lit(rgb, sky)
    assert lit[61, 61] == 1.0
    assert lit[21, 21] == 0.0  # next to the sky
    assert not lit[75:, :35].any()  # too large


def test_maps_know_the_ground_and_the_own_lane(photographed: SceneIR) -> None:
    found = night.compute_night_maps(photographed, photographed.background)
    maps = found.maps
    height, width = photographed.depth.shape
    assert tuple(maps.shape) == (channels.NIGHT_MAPS, height, width)
    road = photographed.environment.road > 0.5
    above = found.camera_m + photographed.depth * maps[channels.RISE]
    assert float(above[road].abs().max()) < 0.05
    assert float(maps[channels.AIM, -1, width // 2]) > float(maps[channels.AIM, -1, 0])
    assert float(maps[channels.CORNER, 0, 0]) > float(maps[channels.CORNER, height // 2, width // 2])
    assert float(maps[channels.NOISE : channels.GLARE].std()) == pytest.approx(1.0, abs=0.05)


def test_glare_grows_with_fog(check_code_gradient: Callable[[Callable[[Tensor], Tensor], Tensor], None]) -> None:
    inputs, maps = _inputs(6, 8)
    code = torch.tensor([0.2, 0.3, 0.0, 0.0, 0.5], dtype=torch.float64)
    used = [int(Weather.FOG), int(Weather.RAIN), int(Weather.NIGHT)]

    def function(part: Tensor) -> Tensor:
        return _apply(inputs, code.index_copy(0, torch.tensor(used), part), maps)

    check_code_gradient(function, code[used])
    foggier = code + torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert bool((_apply(inputs, foggier, maps) >= _apply(inputs, code, maps)).all())


def test_no_lamp_hangs_in_the_sky_near_by(photographed: SceneIR) -> None:
    """Lamps have no posts, so those high above the horizon are left out."""
    camera, up = photographed.camera.matrix.double(), photographed.environment.ground[:3].double()
    height, width = photographed.camera.height, photographed.camera.width
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.stack([columns.double(), rows.double(), torch.ones(height, width).double()]).flatten(1)
    rays = torch.linalg.inv(camera[:, :3]) @ rays
    rise = ((up @ rays) / rays.norm(dim=0)).asin().rad2deg().reshape(height, width)
    lamps = torch.from_numpy(night._street_lamps(photographed, torch.full((height, width), 1e9).numpy()))
    shown = lamps.sum(dim=2) > 0.5
    assert shown.any()
    assert 0 < float(rise[shown].max()) < 14
