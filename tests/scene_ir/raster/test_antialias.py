"""antialias: coverage at outlines, and its gradients."""

import math

import pytest
import torch

from scene_ir.raster import verbs

BOTH = pytest.mark.parametrize("backend", ["reference", "warp"])


def compute_coverage(uvw, faces, backend="reference", size=(12, 14), near=verbs.NEAR_M):
    clip = torch.cat([uvw[:, :2] * uvw[:, 2:], uvw[:, 2:]], dim=1)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, size[1], size[0]]]))
    faces = torch.as_tensor(faces)
    found = verbs.rasterize(clip, faces, torch.tensor([[0, len(faces)]]), layout, backend, near)
    return verbs.antialias(found, clip, faces, backend).view(size)


def rectangle(left, top, right, bottom, w=(2.0, 3.0, 4.0, 5.0), dtype=torch.float32):
    corners = [[left, top, w[0]], [right, top, w[1]], [right, bottom, w[2]], [left, bottom, w[3]]]
    return torch.tensor(corners, dtype=dtype)


QUAD = [[0, 1, 2], [0, 2, 3]]


def sphere(triangles, centre, radius, dtype=torch.float64):
    """A ball in front of the camera, as (u, v, w) and faces."""
    n = round(math.sqrt(triangles / 2))
    turn = torch.arange(n, dtype=dtype) * (2 * math.pi / n)
    tilt = torch.linspace(0.01, math.pi - 0.01, n + 1, dtype=dtype)
    turn, tilt = torch.meshgrid(turn, tilt, indexing="ij")
    x, y, z = tilt.sin() * turn.cos(), tilt.cos(), tilt.sin() * turn.sin()
    uvw = torch.stack([centre[0] + radius[0] * x, centre[1] + radius[1] * y, 12 + 1.5 * z], dim=-1)
    i, j = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    a, b = i * (n + 1) + j, (i + 1) % n * (n + 1) + j
    faces = torch.cat([torch.stack([a, b, a + 1], -1), torch.stack([b, b + 1, a + 1], -1)]).reshape(-1, 3)
    return uvw.reshape(-1, 3), faces


@BOTH
@pytest.mark.parametrize("shift", [0.0, 0.25, 0.4999, 0.5, 0.75, 0.999])
def test_straight_outlines_cover_exact_areas(backend, shift):
    coverage = compute_coverage(rectangle(2.5 + shift, 3.5 - shift, 9.5 + shift, 8.5), QUAD, backend)
    row = coverage[6]
    expected = torch.zeros(14)
    expected[3] = 1 - shift
    expected[4:10] = 1.0
    expected[10] = shift
    torch.testing.assert_close(row, expected, rtol=0, atol=1e-5)
    column = torch.zeros(12)
    column[4:9] = 1.0
    column[3] = shift
    torch.testing.assert_close(coverage[:, 6], column, rtol=0, atol=1e-5)


@BOTH
def test_an_outline_through_pixel_centres_covers_half(backend):
    coverage = compute_coverage(rectangle(3.0, 2.0, 9.0, 8.0, w=(1.0, 1.0, 1.0, 1.0)), QUAD, backend)
    assert coverage[5].tolist() == [0, 0, 0, 0.5, 1, 1, 1, 1, 1, 0.5, 0, 0, 0, 0]
    assert coverage[:, 6].tolist() == [0, 0, 0.5, 1, 1, 1, 1, 1, 0.5, 0, 0, 0]


@BOTH
def test_the_nearer_side_of_a_strip_narrower_than_a_pixel_counts(backend):
    coverage = compute_coverage(rectangle(4.8, 1.0, 5.3, 10.0), QUAD, backend)
    assert float(coverage[5, 5]) == pytest.approx(0.7, abs=1e-5)
    assert float(coverage[5].sum()) == pytest.approx(0.7, abs=1e-5)


@BOTH
def test_edges_inside_a_surface_do_not_matter(backend):
    outline = rectangle(2.3, 2.6, 10.1, 8.2, w=(3.0, 3.0, 3.0, 3.0))
    # The same rectangle as a fan around a point that lies less than a pixel inside its right side.
    fan = torch.cat([outline, torch.tensor([[9.8, 5.1, 3.0]])])
    fans = compute_coverage(fan, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], backend)
    torch.testing.assert_close(fans, compute_coverage(outline, QUAD, backend), rtol=0, atol=1e-5)


@BOTH
def test_duplicate_vertices_make_no_seam(backend):
    outline = rectangle(2.3, 2.6, 10.1, 8.2)
    split = torch.cat([outline[[0, 1, 2]], outline[[0, 2, 3]]])
    coverage = compute_coverage(split, [[0, 1, 2], [3, 4, 5]], backend)
    assert torch.equal(coverage, compute_coverage(outline, QUAD, backend))


@BOTH
def test_nothing_is_blended_at_the_border_of_a_draw(backend):
    coverage = compute_coverage(rectangle(-5.3, -4.0, 20.0, 30.0), QUAD, backend)
    assert torch.equal(coverage, torch.ones(12, 14))


@BOTH
def test_near_plane_is_no_outline(backend):
    # A ground strip that starts behind the camera: where the near plane cuts it, coverage stays hard.
    clip = torch.tensor([[-60.0, 5.0, -1.0], [40.0, 5.0, -1.0], [190.0, 54.0, 9.0], [170.0, 54.0, 9.0]])
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 41, 40]]))
    faces = torch.tensor(QUAD)
    found = verbs.rasterize(clip, faces, torch.tensor([[0, 2]]), layout, backend, 0.5)
    coverage = verbs.antialias(found, clip, faces, backend)
    hit = (found.face >= 0).view(40, 41)
    assert 100 < int(hit.sum()) < 1500
    lowest = int(hit.any(dim=1).nonzero().max())
    inner = hit[lowest] & hit[lowest].roll(1) & hit[lowest].roll(-1)
    assert (coverage.view(40, 41)[lowest][inner] == 1).all()


@pytest.mark.parametrize("triangles", [200, 5000])
def test_coverage_of_a_ball_matches_supersampling(triangles):
    uvw, faces = sphere(triangles, (20.3, 15.7), (13.2, 9.6))
    coverage = compute_coverage(uvw, faces, size=(32, 42))
    factor = 16
    fine = torch.cat([(uvw[:, :2] + 0.5) * factor - 0.5, uvw[:, 2:]], dim=1)
    clip = torch.cat([fine[:, :2] * fine[:, 2:], fine[:, 2:]], dim=1).float()
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 42 * factor, 32 * factor]]))
    found = verbs.rasterize(clip, faces, torch.tensor([[0, len(faces)]]), layout)
    exact = (found.face >= 0).double().view(32, factor, 42, factor).mean(dim=(1, 3))
    hard = (exact >= 0.5).double()
    error = (coverage - exact).square().sum().sqrt()
    assert float((coverage - exact).abs().max()) < 0.13
    assert float(error) < 0.2 * float((hard - exact).square().sum().sqrt())
    assert float(coverage.sum()) == pytest.approx(float(exact.sum()), rel=2e-3)


def test_coverage_changes_continuously_while_a_ball_moves():
    uvw, faces = sphere(800, (10.0, 8.0), (6.3, 5.1))
    step = torch.tensor([0.02, 0.013, 0.0], dtype=torch.float64)
    frames = torch.stack([compute_coverage(uvw + i * step, faces, size=(18, 24)) for i in range(40)])
    # An outline that crosses 0.02 px a frame changes no pixel by more than a few times that.
    assert float(frames.diff(dim=0).abs().max()) < 0.08
    assert 0 <= float(frames.min()) <= float(frames.max()) <= 1


def test_the_gradient_of_area_is_the_length_of_the_side():
    uvw = rectangle(2.2, 2.6, 10.1, 8.3, dtype=torch.float64).requires_grad_()
    coverage = compute_coverage(uvw, QUAD)
    grad = torch.autograd.grad(coverage[4:7].sum(), uvw)[0]
    # Moving the right side by 1 px covers one pixel more in each of the three rows.
    assert float(grad[[1, 2], 0].sum()) == pytest.approx(3.0, abs=1e-9)
    assert float(grad[[0, 3], 0].sum()) == pytest.approx(-3.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_reference_gradients_match_central_differences(seed):
    uvw, faces = sphere(300, (10.3, 8.7), (7.2, 5.6))
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(18, 22, dtype=torch.float64, generator=generator)
    uvw = uvw + 0.3 * torch.randn(uvw.shape, dtype=torch.float64, generator=generator)
    uvw.requires_grad_()
    grad = torch.autograd.grad((compute_coverage(uvw, faces, size=(18, 22)) * weights).sum(), uvw)[0]
    step = 1e-6
    for _ in range(4):
        way = torch.randn(uvw.shape, dtype=torch.float64, generator=generator)
        with torch.no_grad():
            ends = [(compute_coverage(uvw + s * way, faces, size=(18, 22)) * weights).sum() for s in (step, -step)]
        difference = float(ends[0] - ends[1]) / (2 * step)
        assert float((grad * way).sum()) == pytest.approx(difference, rel=1e-4, abs=1e-4)
