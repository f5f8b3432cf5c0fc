"""texture: Catmull-Rom sampling of images and of packed crops."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_ir.errors import RangeError, ShapeError
from scene_ir.raster import verbs

BACKENDS = ("reference", "warp")
BOTH = pytest.mark.parametrize("backend", BACKENDS)
BORDERS = pytest.mark.parametrize("border", ["clamp", "zero"])


def random_image(height, width, channels=3, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(channels, height, width, dtype=dtype, generator=generator)


def grid(height, width, dtype=torch.float32):
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2).to(dtype)


@BOTH
@BORDERS
def test_integer_positions_return_the_exact_pixels(backend, border):
    image = random_image(5, 7)
    sampled = verbs.texture(image, grid(5, 7), backend, border)
    assert torch.equal(sampled, image.flatten(1).T)


@BOTH
def test_quadratics_are_reproduced(backend):
    place = grid(12, 12)
    x, y = place.unbind(-1)
    image = torch.stack([x * 0.3 - y, 0.05 * x * x - 0.1 * x * y + 0.02 * y * y]).view(2, 12, 12)
    uv = 2 + 7 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0))
    u, v = uv.unbind(-1)
    expected = torch.stack([u * 0.3 - v, 0.05 * u * u - 0.1 * u * v + 0.02 * v * v], dim=1)
    torch.testing.assert_close(verbs.texture(image, uv, backend), expected, rtol=1e-5, atol=1e-5)


@BOTH
def test_outside(backend):
    image = random_image(4, 6)
    far = torch.tensor([[-5.0, 1.0], [1e9, 2.0], [3.0, -1e9], [-70.0, 90.0]])
    assert torch.equal(verbs.texture(image, far, backend, "zero"), torch.zeros(4, 3))
    expected = image[:, [1, 2, 0, 3], [0, 5, 3, 0]].T
    torch.testing.assert_close(verbs.texture(image, far, backend, "clamp"), expected)


@BOTH
@BORDERS
@given(st.integers(0, 2**31 - 1))
@settings(max_examples=10, deadline=None)
def test_backends_agree_in_values_and_gradients(backend, border, seed):
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(200, 2, generator=generator) * 14 - 3
    uv[::3] = uv[::3].round()
    weights = torch.randn(200, 4, generator=generator)
    results = []
    for which in (backend, "reference"):
        image, place = random_image(6, 9, 4, seed=seed).requires_grad_(), uv.clone().requires_grad_()
        value = verbs.texture(image, place, which, border)
        (value * weights).sum().backward()
        results.append((value.detach(), place.grad, image.grad))
    for fast, reference in zip(*results, strict=True):
        torch.testing.assert_close(fast, reference, rtol=1e-4, atol=1e-4)


@BORDERS
def test_reference_gradients_match_central_differences(border):
    image = random_image(4, 5, 2, torch.float64).requires_grad_()
    uv = torch.rand(12, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) * 7 - 1
    uv[:4] = uv[:4].round()  # where a bilinear lookup has its kinks

    def values(image, uv):
        return verbs.texture(image, uv, "reference", border)

    assert torch.autograd.gradcheck(values, (image, uv.requires_grad_()), eps=1e-6, atol=1e-5)


def random_crops(rects, channels=4, seed=0):
    layout = verbs.PixelLayout.from_rects(rects)
    generator = torch.Generator().manual_seed(seed)
    return layout, torch.rand(layout.size, channels, generator=generator)


@BOTH
@BORDERS
def test_packed_crops_equal_single_textures(backend, border):
    crops, values = random_crops(torch.tensor([[3, 2, 9, 6], [0, 0, 1, 1], [10, 4, 13, 12]]))
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 8, 5], [0, 0, 3, 3], [8, 0, 14, 12]]))
    uv = layout.pixel_xy() + torch.rand(layout.size, 2, generator=torch.Generator().manual_seed(1)) - 0.5
    sampled = verbs.texture_packed(values, crops.rects, crops.offsets, layout, uv, backend, border)
    for i, ((crop, shape), (span, _)) in enumerate(zip(crops.spans(), layout.spans(), strict=True)):
        image = values[crop].T.reshape(4, *shape)
        single = verbs.texture(image, uv[span] - crops.rects[i, :2], "reference", border)
        torch.testing.assert_close(sampled[span], single, rtol=1e-5, atol=1e-5)


@BOTH
def test_packed_identity_is_exact_and_empty_crops_are_zero(backend):
    rects = torch.tensor([[3, 2, 9, 6], [5, 5, 5, 5], [10, 4, 13, 12]])
    crops, values = random_crops(rects)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[3, 2, 9, 6], [0, 0, 2, 2], [10, 4, 13, 12]]))
    sampled = verbs.texture_packed(values, rects, crops.offsets, layout, layout.pixel_xy().float(), backend)
    filled_rows = layout.draw_index() != 1
    assert torch.equal(sampled[filled_rows], values)
    assert not sampled[~filled_rows].any()


def test_packed_gradients_agree():
    rects = torch.tensor([[3, 2, 9, 6], [5, 5, 5, 5], [10, 4, 13, 12]])
    crops, values = random_crops(rects)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[2, 2, 9, 7], [0, 0, 2, 2], [10, 4, 13, 12]]))
    generator = torch.Generator().manual_seed(2)
    uv = layout.pixel_xy() + torch.rand(layout.size, 2, generator=generator)
    weights = torch.randn(layout.size, 4, generator=generator)
    grads = []
    for backend in BACKENDS:
        texels, place = values.clone().requires_grad_(), uv.clone().requires_grad_()
        sampled = verbs.texture_packed(texels, rects, crops.offsets, layout, place, backend)
        (sampled * weights).sum().backward()
        grads.append((texels.grad, place.grad))
    for reference, fast in zip(*grads, strict=True):
        torch.testing.assert_close(fast, reference, rtol=1e-4, atol=1e-4)


@BOTH
def test_nothing_to_sample(backend):
    assert verbs.texture(random_image(2, 2), torch.zeros(0, 2), backend).shape == (0, 3)
    none = verbs.PixelLayout.from_rects(torch.zeros(0, 4, dtype=torch.int64))
    sampled = verbs.texture_packed(torch.zeros(0, 4), none.rects, none.offsets, none, torch.zeros(0, 2), backend)
    assert sampled.shape == (0, 4)


def test_errors():
    image, uv = random_image(3, 3), torch.zeros(2, 2)
    with pytest.raises(RangeError, match=r"raster\.border"):
        verbs.texture(image, uv, border="wrap")
    with pytest.raises(ShapeError, match="float32 with backend warp"):
        verbs.texture(image.double(), uv.double())
    with pytest.raises(ShapeError, match=r"raster\.image"):
        verbs.texture(image.double(), uv)
    with pytest.raises(ShapeError, match="at least one pixel"):
        verbs.texture(torch.zeros(3, 0, 4), uv)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 2, 1]]))
    with pytest.raises(ShapeError, match=r"raster\.crop_rects"):
        verbs.texture_packed(
            torch.zeros(0, 3), torch.zeros(0, 4, dtype=torch.int64), torch.zeros(1).long(), layout, uv
        )
    with pytest.raises(ShapeError, match=r"raster\.values"):
        verbs.texture_packed(torch.zeros(3, 3), layout.rects, layout.offsets, layout, uv)
