"""Texture codes, lookup weights, and texels."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from scene_ir.render import model, texture
from scene_ir.types import Crop

ROWS = 64


def _rows(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Premultiplied colour, opacity, paint, height, base lightness."""
    generator = torch.Generator().manual_seed(1)
    straight = 0.1 + 0.8 * torch.rand(ROWS, 3, generator=generator, dtype=dtype)
    opacity = 0.2 + 0.8 * torch.rand(ROWS, generator=generator, dtype=dtype)
    paint = torch.rand(ROWS, generator=generator, dtype=dtype)
    height = torch.rand(ROWS, generator=generator, dtype=dtype)
    return straight * opacity[:, None], opacity, paint, height, torch.full_like(opacity, 55.0)


def _apply(code: Tensor, paint: Tensor | None = None) -> tuple[Tensor, Tensor]:
    colour, opacity, own_paint, height, base = _rows(code.dtype)
    weight = own_paint if paint is None else paint
    return colour, texture.apply_texture_code(colour, opacity, code.expand(ROWS, 5), weight, height, base)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_code_zero_changes_no_bit(dtype: torch.dtype) -> None:
    before, after = _apply(torch.zeros(5, dtype=dtype))
    assert torch.equal(before, after)


def test_only_paint_changes() -> None:
    code = torch.full((5,), 0.7, dtype=torch.float64)
    paint = (torch.arange(ROWS) % 2).to(torch.float64)
    before, after = _apply(code, paint)
    assert torch.equal(before[paint == 0], after[paint == 0])
    assert bool(((before - after).abs().amax(dim=1)[paint == 1] > 1e-3).all())


def _mean_lab(code: list[float]) -> Tensor:
    colour, opacity, _, height, base = _rows()
    after = texture.apply_texture_code(
        colour, opacity, colour.new_tensor(code).expand(ROWS, 5), torch.ones_like(opacity), height, base
    )
    return texture.rgb_to_lab((after / opacity[:, None]).clamp(0, 1)).mean(dim=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_code_axes_are_lightness_a_and_b(axis: int) -> None:
    code = [0.0] * 5
    low, high = list(code), list(code)
    low[axis], high[axis] = -0.5, 0.5
    change = _mean_lab(high) - _mean_lab(low)
    assert int(change.abs().argmax()) == axis
    assert float(change[axis]) > 5.0


def test_gloss_raises_contrast_and_dirt_gathers_low() -> None:
    colour, opacity, _, _, base = _rows()
    full = torch.ones_like(opacity)

    def after(code: list[float], height: float) -> Tensor:
        rows = colour.new_tensor(code).expand(ROWS, 5)
        return texture.apply_texture_code(colour, opacity, rows, full, full * height, base) / opacity[:, None]

    def spread(rgb: Tensor) -> Tensor:
        return texture.rgb_to_lab(rgb.clamp(0, 1))[:, 0].std()

    assert float(spread(after([0, 0, 0, 0.8, 0], 0.5))) > float(spread(after([0, 0, 0, -0.8, 0], 0.5)))
    clean = colour / opacity[:, None]
    low, high = after([0, 0, 0, 0, 0.8], 0.0), after([0, 0, 0, 0, 0.8], 1.0)
    assert float((low - clean).abs().mean()) > 2.0 * float((high - clean).abs().mean())


@pytest.mark.parametrize("start", [0.0, 0.3])
def test_code_gradient_matches_differences_also_at_zero(
    check_code_gradient: Callable[..., None], start: float
) -> None:
    check_code_gradient(lambda code: _apply(code)[1], torch.full((5,), start, dtype=torch.float64))


@given(st.lists(st.floats(-0.99, 0.99), min_size=5, max_size=5))
def test_any_code_gives_finite_colours_and_gradients(code: list[float]) -> None:
    live = torch.tensor(code, dtype=torch.float64, requires_grad=True)
    _, after = _apply(live)
    after.sum().backward()
    assert live.grad is not None
    assert bool(torch.isfinite(after).all())
    assert bool(torch.isfinite(live.grad).all())


def test_facing_weight_is_exactly_one_where_nothing_turned() -> None:
    cos = torch.linspace(-1, 1, 41, dtype=torch.float64, requires_grad=True)
    turned = torch.zeros(41, dtype=torch.float64, requires_grad=True)
    weight = texture.facing_weight(turned, cos, torch.ones_like(cos))
    assert torch.equal(weight, torch.ones_like(weight))
    slopes = torch.autograd.grad(weight.sum(), [turned, cos])
    assert all(torch.equal(s, torch.zeros_like(s)) for s in slopes)
    hidden_side = texture.facing_weight(torch.tensor([0.6]), torch.tensor([-0.4]), torch.tensor([0.0]))
    assert float(hidden_side) == 0.0


def test_inside_weight_fades_beyond_the_photograph() -> None:
    uv = torch.tensor([[0.0, 0.0], [9.0, 4.0], [-1.0, 2.0], [-2.0, 2.0], [4.0, 7.0]])
    assert texture.inside_weight(uv, 5, 10).tolist() == [1.0, 1.0, 0.5, 0.0, 0.0]


def test_extract_crop_pads_with_zero_and_repeats_the_frames_edge() -> None:
    crop = Crop(torch.arange(1.0, 5.0).reshape(1, 2, 2), 0, 1)
    seen = texture.extract_crop(crop, (-1, 0, 3, 5), (4, 6))
    assert seen[0].tolist() == [
        [0, 0, 0, 0], [1, 1, 2, 0], [3, 3, 4, 0], [0, 0, 0, 0], [0, 0, 0, 0],
    ]  # fmt: skip
    below = texture.extract_crop(crop, (0, 1, 2, 5), (3, 6))
    assert below[0].tolist() == [[1, 2], [3, 4], [3, 4], [3, 4]]


def test_occlusion_is_zero_where_nearer_mattes_are_transparent() -> None:
    matte = torch.zeros(1, 12, 12)
    matte[0, 1:11, 1:11] = 0.001
    hidden = texture.occlusion_map([Crop(matte, 3, 2)], (20, 20), torch.zeros(1))
    assert hidden.shape == (20, 20)
    assert bool((hidden[2:14, 3:15][matte[0] == 0] == 0).all())
    assert float(hidden[8, 9]) == 1.0
    assert float(hidden.sum()) == float(hidden[2:14, 3:15].sum())


def test_template_shading_is_brighter_towards_the_sun_and_in_range() -> None:
    sun = torch.tensor([0.0, -0.6, -0.8])
    normal = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(3)), dim=1)
    eye = torch.tensor([0.0, 0.0, -1.0]).expand(200, 3)
    lit = texture.shade_template(
        normal, eye, torch.full((200, 3), 0.5), torch.zeros(200, 2), torch.full((200,), 0.5), sun
    )
    assert 0.0 <= float(lit.min()) <= float(lit.max()) <= 1.0
    towards = (normal * sun).sum(-1)
    assert float(lit[towards > 0.5].mean()) > 1.3 * float(lit[towards < -0.3].mean())


def test_relight_changes_no_bit_where_nothing_turned() -> None:
    rgb = torch.rand(50, 3, generator=torch.Generator().manual_seed(4))
    assert torch.equal(texture.relight(rgb, torch.zeros(50)), rgb)
    bright = texture.relight(rgb, torch.full((50,), 0.2))
    assert bool((bright >= rgb).all())
    assert float((bright - rgb).max()) < 0.1
    ratio = torch.linspace(-0.9, 4.0, 60, dtype=torch.float64, requires_grad=True)
    paint = torch.linspace(0, 1, 60, dtype=torch.float64)
    share = texture.limit_brightening(ratio, paint)
    assert float(share.detach().abs().max()) <= model.RELIT_MOST
    assert torch.autograd.gradcheck(lambda r: texture.limit_brightening(r, paint), (ratio,))


def test_paint_share_is_the_region_where_visible() -> None:
    mesh, region = torch.tensor([1.0, 0.0, 0.6, 0.2]), torch.tensor([0.3, 0.9, 0.0, 0.0])
    unseen, known = torch.tensor([0.0, 0.5, 0.0, 1.0]), torch.tensor([True, True, False, True])
    share = texture.paint_share(mesh, region, unseen, known)
    assert share.tolist() == pytest.approx([0.3, 0.45, 0.6, 0.2])


def test_finish_stays_in_gamut_and_lifts_black() -> None:
    light = torch.linspace(0, 3, 20)[:, None].expand(20, 3)
    visible = texture.apply_finish(light, torch.full((20, 3), 1.5), torch.full((20, 1), 0.1))
    assert float(visible[0].max()) == pytest.approx(0.1)
    assert bool((visible.diff(dim=0) > 0).all())
    assert float(visible.max()) < 1.0


def test_smoothstep_is_flat_outside_and_has_its_gradient() -> None:
    x = torch.tensor([-1.0, 0.3, 0.45, 0.7, 0.7 + 1e-9, 4.0], dtype=torch.float64, requires_grad=True)
    values = texture.smoothstep(x, 0.3, 0.7)
    assert values[[0, 1, 3, 4, 5]].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0]
    assert float(values[2].detach()) == pytest.approx(0.31640625)
    assert torch.autograd.gradcheck(lambda t: texture.smoothstep(t, 0.3, 0.7), (x,))


def test_appearance_fades_beyond_the_border() -> None:
    uv = torch.tensor([[5.0, 5.0], [-3.0, 5.0], [-30.0, 5.0], [-61.0, 5.0], [5.0, 99.0]])
    weight = texture.inside_weight(uv, 20, 30, (4.0, 60.0))
    assert weight[[0, 1, 3, 4]].tolist() == [1.0, 1.0, 0.0, 0.0]
    assert 0.4 < float(weight[2]) < 0.6
    assert texture.inside_weight(uv, 20, 30).tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_relight_spares_white() -> None:
    colours = torch.tensor([[0.5, 1.0, 0.2], [0.5, 1.0, 0.2]])
    found = texture.relight(colours, torch.tensor([0.2, -0.4]))
    expected = torch.tensor([[0.575, 1.0, 0.2384], [0.35, 1.0, 0.1232]])
    assert torch.allclose(found, expected, atol=1e-6)
