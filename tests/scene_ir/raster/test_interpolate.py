"""interpolate: perspective-correct attributes and their gradients."""

import pytest
import torch

from scene_ir.errors import ShapeError
from scene_ir.raster import verbs

BOTH = pytest.mark.parametrize("backend", ["reference", "warp"])
FACES = torch.tensor([[0, 1, 2], [1, 3, 2]])
RANGES = torch.tensor([[0, 2]])
LAYOUT = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 12, 10]]))


def quad(dtype=torch.float32):
    uvw = torch.tensor([[1.2, 1.3, 2.0], [10.4, 0.7, 5.0], [0.8, 8.6, 9.0], [9.1, 8.2, 4.0]], dtype=dtype)
    return torch.cat([uvw[:, :2] * uvw[:, 2:], uvw[:, 2:]], dim=1)


@BOTH
def test_attributes_linear_in_space_are_recovered_exactly(backend):
    # u w, v w and w are linear in space: at pixel (x, y) they are x w, y w and w.
    clip = quad()
    found = verbs.rasterize(clip, FACES, RANGES, LAYOUT, backend)
    values = verbs.interpolate(found, clip, FACES, torch.cat([clip, torch.ones(4, 1)], dim=1), backend)
    hit = found.face >= 0
    pixels = LAYOUT.pixel_xy()[hit]
    assert int(hit.sum()) > 40
    torch.testing.assert_close(values[hit, 2], found.depth[hit], rtol=1e-6, atol=0)
    torch.testing.assert_close(values[hit, :2], pixels * found.depth[hit, None], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(values[hit, 3], torch.ones_like(values[hit, 3]))
    assert not values[~hit].any()


@BOTH
def test_value_by_hand(backend):
    # Halfway down the image from w = 1 to w = 3 it is not 1/2 but (1/2)/3 / ((1/2)/1 + (1/2)/3) = 1/4.
    clip = torch.tensor([[0.0, 0.0, 1.0], [8.0, 0.0, 1.0], [0.0, 24.0, 3.0]])
    faces, ranges = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]])
    layout = verbs.PixelLayout.from_rects(torch.tensor([[1, 4, 2, 5]]))
    found = verbs.rasterize(clip, faces, ranges, layout, backend)
    value = verbs.interpolate(found, clip, faces, torch.tensor([[0.0], [0.0], [1.0]]), backend)
    assert float(value) == pytest.approx(0.25, abs=1e-7)


def test_reference_gradients_match_central_differences():
    clip = quad(torch.float64).requires_grad_()
    attributes = torch.randn(
        4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True
    )
    found = verbs.rasterize(clip, FACES, RANGES, LAYOUT, "reference")

    def values(clip, attributes):
        return verbs.interpolate(found, clip, FACES, attributes, "reference")

    assert torch.autograd.gradcheck(values, (clip, attributes), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_near_plane_crossing_triangle_has_right_gradients():
    clip = torch.tensor([[-20.0, 10, -1], [40, 10, -1], [190, 55, 9]], dtype=torch.float64, requires_grad=True)
    faces, ranges = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]])
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 41, 40]]))
    found = verbs.rasterize(clip, faces, ranges, layout, "reference")
    assert int((found.face >= 0).sum()) > 50
    attributes = torch.tensor([[1.0], [2.0], [-1.0]], dtype=torch.float64)
    weights = torch.randn(layout.size, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def total(clip):
        return (verbs.interpolate(found, clip, faces, attributes, "reference") * weights).sum()

    assert torch.autograd.gradcheck(total, (clip,), eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("with_clip", "with_attributes"), [(True, True), (True, False), (False, True)])
def test_gradients_only_where_required(with_clip, with_attributes):
    generator = torch.Generator().manual_seed(2)
    weights = torch.randn(LAYOUT.size, 3, generator=generator)
    values = torch.randn(4, 3, generator=generator)
    grads = []
    for backend in ("reference", "warp"):
        clip = quad().requires_grad_(with_clip)
        attributes = values.clone().requires_grad_(with_attributes)
        found = verbs.rasterize(clip, FACES, RANGES, LAYOUT, backend)
        (verbs.interpolate(found, clip, FACES, attributes, backend) * weights).sum().backward()
        grads.append((clip.grad, attributes.grad))
    for reference, fast in zip(*grads, strict=True):
        assert (reference is None) == (fast is None)
        if reference is not None:
            torch.testing.assert_close(fast, reference, rtol=1e-4, atol=1e-4)


@BOTH
def test_non_contiguous_inputs(backend):
    clip, attributes = quad(), torch.arange(12.0).view(3, 4).T
    found = verbs.rasterize(clip.T.contiguous().T, FACES, RANGES, LAYOUT, backend)
    values = verbs.interpolate(found, clip.T.contiguous().T, FACES, attributes, backend)
    expected = verbs.interpolate(found, clip, FACES, attributes.contiguous(), backend)
    assert torch.equal(values, expected)


def test_errors():
    clip = quad()
    found = verbs.rasterize(clip, FACES, RANGES, LAYOUT)
    with pytest.raises(ShapeError, match=r"raster\.attributes"):
        verbs.interpolate(found, clip, FACES, torch.zeros(3, 2))
    with pytest.raises(ShapeError, match=r"raster\.attributes"):
        verbs.interpolate(found, clip, FACES, torch.zeros(4, 2, dtype=torch.float64))
