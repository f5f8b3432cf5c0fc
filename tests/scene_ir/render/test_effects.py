"""The fused kernels of weather, foliage and paint against their reference in plain torch."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from scene_ir.render import environment as env
from scene_ir.render import texture
from scene_ir.types import WEATHER_DIM, Environment, Weather

VALUES = {"weather": 1e-6, "foliage": 2e-5, "paint": 8e-6}
"""Largest difference to float64. The reference itself, in float32, is off by 0.3e-6, 0.7e-5 and 0.3e-5: near black
CIE's curves are steep."""
GRADIENTS = 1e-4

_APPLIED = [code for code in Weather if code is not Weather.NIGHT]
"""Codes of `apply_weather`."""
SIZES = ((2, 2), (3, 70), (41, 3), (40, 64), (59, 131))
FRAMES = st.tuples(st.sampled_from(SIZES), st.integers(0, 61)).map(lambda f: (*f[0], f[1]))
"""Height, width (few: each has rain streaks to make), and the first row of the road, maybe below the picture."""


def _codes(size: int, low: float, high: float) -> st.SearchStrategy[list[float]]:
    value = st.sampled_from([0.0, low, high]) | st.floats(low, high, width=32)
    return st.lists(value, min_size=size, max_size=size)


def _scenery(height: int, width: int, road_row: int) -> tuple[Tensor, Tensor, Environment, Tensor]:
    """Picture, slightly beyond [0, 1]; inverse depth, partly 0; environment; air. float64."""
    generator = torch.Generator().manual_seed(height * 100 + width)

    def noise(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float32).double()

    rows = torch.arange(height)[:, None].expand(height, width)
    inverse = (noise(height, width) * 0.4 - 0.05).clamp(min=0.0).where(rows > 1, 0.0)
    foliage = noise(height, width) * (noise(height, width) > 0.4) * (rows > 2)
    zero = torch.zeros(4, dtype=torch.float64)
    scenery = Environment(
        zero, zero[:3], torch.tensor([0.0, -1.0, 0.0]).double(), torch.tensor([0.0, -1.0, 0.0, 1.65]).double(),
        noise(height, width), foliage, noise(height, width) * (rows >= road_row),
    )  # fmt: skip
    image = noise(3, height, width) * 1.1 - 0.05
    return image, inverse, scenery, torch.tensor([0.75, 0.8, 0.86]).float().double()


def _mirrored(height: int, width: int, road_row: int) -> Tensor:
    """What a wet road mirrors: picture and sky."""
    return torch.rand(4, height, width, generator=torch.Generator().manual_seed(road_row)).double()


def _run(name: str, code: list[float], frame: tuple[int, int, int], backend: str) -> list[Tensor]:
    """Picture and gradients; float64 with the reference, float32 with Warp."""
    image, inverse, scenery, air = _scenery(*frame)
    dtype = torch.float32 if backend == "warp" else torch.float64
    maps = {n: getattr(scenery, n).to(dtype) for n in ("sky", "road", "foliage_map", "sun", "ground", "foliage")}
    live = [t.float().to(dtype).requires_grad_() for t in (image, torch.tensor(code), inverse)]
    scenery = replace(scenery, weather=scenery.weather.to(dtype), **maps)
    if name == "weather":
        # How much of sky and road shows, as of what cars hide; what a wet road mirrors.
        spray = _mirrored(*frame)[0] * 0.5
        live += [torch.ones_like(maps["sky"]), _mirrored(*frame).to(dtype), spray.to(dtype)]
        live[3:] = [t.requires_grad_() for t in live[3:]]
        changed = replace(scenery, weather=live[1], sky=live[3] * maps["sky"], road=live[3] * maps["road"])
        out = env.apply_weather(live[0], live[2], changed, air.to(dtype), live[4], backend, live[5])  # type: ignore[arg-type]
    else:
        live.pop()
        changed = replace(scenery, foliage=live[1])
        crowns = torch.rand(5, *frame[:2], generator=torch.Generator().manual_seed(4)).to(dtype)
        out = env.apply_foliage(live[0], changed, crowns, backend=backend)  # type: ignore[arg-type]
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(3)).to(dtype)
    return [out.detach(), *torch.autograd.grad(out, live, weights, materialize_grads=True)]


def _agree(fast: list[Tensor], reference: list[Tensor], values: float) -> None:
    assert float((fast[0].double() - reference[0]).abs().max()) <= values
    for mine, theirs in zip(fast[1:], reference[1:], strict=True):
        # Where one pixel's gradients cancel, the rounding of what cancels remains: so against the largest.
        assert float((mine.double() - theirs).norm()) <= GRADIENTS * float(theirs.norm()) + 1e-5


@settings(max_examples=25)
@given(_codes(WEATHER_DIM, 0.0, 1.0), FRAMES)
def test_weather_agrees_with_the_reference(code: list[float], frame: tuple[int, int, int]) -> None:
    _agree(_run("weather", code, frame, "warp"), _run("weather", code, frame, "reference"), VALUES["weather"])


@settings(max_examples=25)
@given(_codes(3, -1.0, 1.0), FRAMES)
def test_foliage_agrees_with_the_reference(code: list[float], frame: tuple[int, int, int]) -> None:
    _agree(_run("foliage", code, frame, "warp"), _run("foliage", code, frame, "reference"), VALUES["foliage"])


@pytest.mark.parametrize(("name", "size"), [("weather", WEATHER_DIM), ("foliage", 3)])
@pytest.mark.parametrize("frame", [(40, 64, 24), (37, 51, 0), (9, 130, 90)])
def test_code_zero_changes_no_bit(name: str, size: int, frame: tuple[int, int, int]) -> None:
    out, *gradients = _run(name, [0.0] * size, frame, "warp")
    assert torch.equal(out, _scenery(*frame)[0].float())
    by_code = gradients[1] if name == "foliage" else gradients[1][_APPLIED]
    assert bool((by_code.abs() > 1e-3).all())


@pytest.mark.parametrize("name", ["weather", "foliage"])
def test_same_bytes_with_any_number_of_threads(name: str) -> None:
    code, threads = [0.3, 0.6, 0.4, 0.2, 0.0, 0.3], torch.get_num_threads()
    frame = (100, 130, 50)
    try:
        runs = []
        for count in (1, 2, 3, 2):
            torch.set_num_threads(count)
            runs.append(_run(name, code[: WEATHER_DIM if name == "weather" else 3], frame, "warp"))
    finally:
        torch.set_num_threads(threads)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(run, runs[0], strict=True))


def test_two_pictures_can_await_their_gradients() -> None:
    first = _run("weather", [0.5] * WEATHER_DIM, (40, 60, 10), "warp")
    image, inverse, scenery, air = _scenery(40, 60, 10)
    names = ("sky", "road", "foliage_map", "sun", "ground", "foliage")
    single = replace(scenery, **{n: getattr(scenery, n).float() for n in names})
    code, other = (torch.full((WEATHER_DIM,), v, requires_grad=True) for v in (0.5, 0.1))
    weights = torch.randn(3, 40, 60, generator=torch.Generator().manual_seed(3))
    outs = [
        env.apply_weather(
            image.float(),
            inverse.float(),
            replace(single, weather=c),
            air.float(),
            _mirrored(40, 60, 10).float(),
            "warp",
            0.5 * _mirrored(40, 60, 10)[0].float(),
        )
        for c in (code, other)
    ]
    assert torch.equal(torch.autograd.grad(outs[0], code, weights)[0], first[2])
    assert not torch.equal(torch.autograd.grad(outs[1], other, weights)[0], first[2])


def _paint_rows(backend: str, code: Tensor, rows: int = 3000) -> list[Tensor]:
    generator = torch.Generator().manual_seed(5)
    opacity = torch.rand(rows, generator=generator)
    opacity[:100], opacity[100:300] = 0.0, 0.015
    colour = (torch.rand(rows, 3, generator=generator) * 1.1 - 0.02) * opacity[:, None]
    paint = torch.rand(rows, generator=generator)
    paint[500:900] = 0.0
    height = torch.rand(rows, generator=generator) * 1.4 - 0.2
    base = torch.rand(rows, generator=generator) * 90
    weights = torch.randn(rows, 3, generator=generator)
    dtype = torch.float32 if backend == "warp" else torch.float64
    given_rows: list[Any] = [colour, opacity, code.expand(rows, 5), paint, height, base]
    live = [t.to(dtype).clone().requires_grad_() for t in given_rows]
    out = texture.apply_texture_code(*live, backend=backend)  # type: ignore[arg-type]
    return [out.detach(), *torch.autograd.grad(out, live, weights.to(dtype))]


@settings(max_examples=20)
@given(_codes(5, -0.9375, 0.9375))
def test_paint_agrees_with_the_reference(code: list[float]) -> None:
    rows = torch.tensor(code)
    _agree(_paint_rows("warp", rows), _paint_rows("reference", rows), VALUES["paint"])


def test_paint_code_zero_changes_no_bit() -> None:
    code = torch.zeros(5)
    out, _, _, grad_code, *_ = _paint_rows("warp", code)
    assert torch.equal(out, _paint_rows("reference", code)[0].float())
    assert bool((grad_code.abs().amax(dim=0) > 1e-2).all())


def test_paint_of_no_rows() -> None:
    empty = torch.zeros(0)
    out = texture.apply_texture_code(
        empty.view(0, 3), empty, empty.view(0, 5), empty, empty, empty, backend="warp"
    )
    assert out.shape == (0, 3)
