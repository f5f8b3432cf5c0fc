"""rasterize: which pixel shows which triangle."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_ir.errors import RangeError, ShapeError
from scene_ir.raster import verbs

BACKENDS = ("reference", "warp")
TRIANGLE = torch.tensor([[2.0, 2.0, 1.0], [10.0, 2.0, 1.0], [2.0, 10.0, 1.0]])
BOTH = pytest.mark.parametrize("backend", BACKENDS)


def to_clip(uvw: torch.Tensor) -> torch.Tensor:
    return torch.cat([uvw[:, :2] * uvw[:, 2:], uvw[:, 2:]], dim=1)


def draw(uvw, faces, backend, size=(12, 14), near=verbs.NEAR_M):
    height, width = size
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, width, height]]))
    ranges = torch.tensor([[0, len(faces)]])
    found = verbs.rasterize(to_clip(uvw), torch.as_tensor(faces), ranges, layout, backend, near)
    return found.face.view(size), found.depth.view(size)


@BOTH
def test_a_triangle_hits_inner_pixels_and_those_on_one_side_of_its_edges(backend):
    face, depth = draw(TRIANGLE, [[0, 1, 2]], backend)
    y, x = torch.meshgrid(torch.arange(12), torch.arange(14), indexing="ij")
    strictly_inside = (x > 2) & (y > 2) & (x + y < 12)
    outside = (x < 2) | (y < 2) | (x + y > 12)
    assert (face[strictly_inside] == 0).all()
    assert (face[outside] == -1).all()
    assert (depth[face == 0] == 1).all()
    assert torch.isinf(depth[face < 0]).all()
    assert face.dtype == torch.int32


@BOTH
def test_both_windings_hit_the_same_pixels(backend):
    face, depth = draw(TRIANGLE, [[0, 1, 2]], backend)
    other_face, other_depth = draw(TRIANGLE, [[2, 1, 0]], backend)
    assert torch.equal(face, other_face)
    assert torch.equal(depth, other_depth)


@BOTH
def test_depth_is_perspective_correct(backend):
    uvw = torch.tensor([[0.0, 0.0, 2.0], [12.0, 0.0, 2.0], [0.0, 12.0, 6.0]])
    face, depth = draw(uvw, [[0, 1, 2]], backend)
    assert face[3, 1] == 0
    # 1 / w is linear in the image: a quarter of the way down, 3/4 * 1/2 + 1/4 * 1/6
    assert float(depth[3, 1]) == pytest.approx(1 / (0.75 / 2 + 0.25 / 6), rel=1e-6)


@BOTH
def test_the_nearest_triangle_wins_then_the_lower_index(backend):
    near_triangle = TRIANGLE * torch.tensor([1.0, 1.0, 0.5])
    uvw = torch.cat([TRIANGLE, near_triangle, TRIANGLE])
    face, depth = draw(uvw, [[6, 7, 8], [0, 1, 2], [3, 4, 5]], backend)
    assert face[4, 4] == 2
    assert float(depth[4, 4]) == 0.5
    face, _ = draw(uvw, [[6, 7, 8], [0, 1, 2]], backend)
    assert face[4, 4] == 0


@BOTH
def test_intersecting_triangles_swap_where_their_depths_cross(backend):
    uvw = torch.tensor([[0.0, 0, 1], [13, 0, 3], [0, 24, 1], [0, 0, 3], [13, 0, 1], [13, 24, 1]])
    face, _ = draw(uvw, [[0, 1, 2], [3, 4, 5]], backend)
    assert face[2, 1] == 0
    assert face[2, 11] == 1


@BOTH
def test_near_plane_clipping_matches_the_analytic_polygon(backend):
    # A road-like strip from 1 m behind the camera to 9 m before it, in camera space: x = +-1, y = 1.
    near = 0.47
    z = torch.tensor([-1.0, -1.0, 9.0, 9.0])
    x = torch.tensor([-1.0, 1.0, 1.0, -1.0])

    def strip_clip(x, z):
        return torch.stack([10.3 * x + 20.2 * z, torch.full_like(z, 10.0) + 5 * z, z], dim=1)

    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 41, 40]]))
    faces, ranges = torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([[0, 2]])
    whole = verbs.rasterize(strip_clip(x, z), faces, ranges, layout, backend, near)
    cut = strip_clip(x, z.clamp(min=near))
    clipped = verbs.rasterize(cut, faces, ranges, layout, backend, near)
    assert torch.equal(whole.face >= 0, clipped.face >= 0)
    assert 100 < int((whole.face >= 0).sum()) < 1000
    hit = whole.face >= 0
    torch.testing.assert_close(whole.depth[hit], clipped.depth[hit], rtol=1e-5, atol=0)
    assert float(whole.depth.min()) >= near


@BOTH
def test_triangles_behind_the_camera_are_invisible(backend):
    face, _ = draw(TRIANGLE * torch.tensor([1.0, 1.0, -1.0]), [[0, 1, 2]], backend)
    assert (face == -1).all()


@BOTH
def test_degenerate_triangles_are_skipped(backend):
    line = torch.tensor([[1.0, 1.0, 1.0], [5.0, 5.0, 1.0], [9.0, 9.0, 1.0]])
    face, _ = draw(line, [[0, 1, 2], [0, 0, 1], [2, 2, 2]], backend)
    assert (face == -1).all()


@BOTH
@pytest.mark.parametrize(
    ("rects", "ranges"),
    [
        (torch.zeros(0, 4), torch.zeros(0, 2)),
        (torch.tensor([[0, 0, 5, 5], [3, 3, 3, 9]]), torch.tensor([[0, 0], [0, 1]])),
        (torch.tensor([[3, 3, 3, 9]]), torch.tensor([[0, 1]])),
    ],
)
def test_empty_draws_faces_and_rectangles(backend, rects, ranges):
    layout = verbs.PixelLayout.from_rects(rects.to(torch.int64))
    clip, faces = to_clip(TRIANGLE).requires_grad_(), torch.tensor([[0, 1, 2]])
    found = verbs.rasterize(clip, faces, ranges.to(torch.int64), layout, backend)
    assert found.face.tolist() == [-1] * layout.size
    values = verbs.interpolate(found, clip, faces, clip, backend)
    coverage = verbs.antialias(found, clip, faces, backend)
    (values.sum() + coverage.sum()).backward()
    assert torch.equal(clip.grad, torch.zeros_like(clip))
    assert not coverage.any()


@BOTH
def test_no_vertices(backend):
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 2, 2]]))
    clip, faces = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64)
    found = verbs.rasterize(clip, faces, torch.tensor([[0, 0]]), layout, backend)
    assert found.face.tolist() == [-1] * 4
    assert verbs.interpolate(found, clip, faces, torch.zeros(0, 2), backend).tolist() == [[0.0, 0.0]] * 4


@BOTH
def test_draws_are_independent_and_may_share_faces(backend):
    uvw = torch.cat([TRIANGLE, TRIANGLE + torch.tensor([1.0, 1.0, 1.0])])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]], dtype=torch.int32)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 14, 12], [3, 2, 9, 8], [0, 0, 14, 12]]))
    ranges = torch.tensor([[0, 2], [1, 2], [1, 2]])
    found = verbs.rasterize(to_clip(uvw), faces, ranges, layout, backend)
    first, second, third = (found.face[span].view(shape) for span, shape in layout.spans())
    assert set(first.unique().tolist()) == {-1, 0, 1}
    assert torch.equal(third[2:8, 3:9], second)
    assert torch.equal(first[third < 0] == 0, (first == 0)[third < 0])


@BOTH
@given(st.integers(0, 2**31 - 1), st.booleans())
@settings(max_examples=15, deadline=None)
def test_a_triangulated_rectangle_has_no_holes_or_double_hits(backend, seed, on_pixels):
    # A grid whose inner vertices are moved at random, also on to pixel centres, where ties are frequent.
    generator = torch.Generator().manual_seed(seed)
    n = 4
    axis = torch.arange(n + 1) * 8.0
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    move = torch.rand(2, n + 1, n + 1, generator=generator) * 3.8 - 1.9
    move[:, [0, -1]] = 0
    move[:, :, [0, -1]] = 0
    if on_pixels:
        move = move.round()
    w = 1 + 30 * torch.rand(n + 1, n + 1, generator=generator)
    uvw = torch.stack([u + move[0] - 0.5, v + move[1] - 0.5, w], dim=-1).reshape(-1, 3)
    if on_pixels:
        uvw[:, :2] += 0.5
    corner = torch.arange((n + 1) * (n + 1)).view(n + 1, n + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    flip = torch.rand(n, n, generator=generator)[..., None] < 0.5
    upper = torch.where(flip, torch.stack([a, b, c], -1), torch.stack([d, b, a], -1))
    lower = torch.where(flip, torch.stack([a, c, d], -1), torch.stack([b, d, c], -1))
    faces = torch.cat([upper.reshape(-1, 3), lower.reshape(-1, 3)])
    # One draw a triangle, so that each pixel tells how many triangles hit it.
    count = faces.shape[0]
    layout = verbs.PixelLayout.from_rects(torch.tensor([[-2, -2, 36, 36]]).expand(count, 4))
    ranges = torch.arange(count)[:, None] + torch.tensor([0, 1])
    found = verbs.rasterize(to_clip(uvw), faces, ranges, layout, backend)
    hits = (found.face.view(count, 38, 38) >= 0).sum(dim=0)
    assert (hits[3:33, 3:33] == 1).all()
    assert int(hits.sum()) == 32 * 32


def test_errors():
    clip, faces = to_clip(TRIANGLE), torch.tensor([[0, 1, 2]])
    layout, ranges = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 4, 4]])), torch.tensor([[0, 1]])
    with pytest.raises(ShapeError, match="float32 with backend warp"):
        verbs.rasterize(clip.double(), faces, ranges, layout)
    with pytest.raises(RangeError, match=r"raster\.faces"):
        verbs.rasterize(clip, torch.tensor([[0, 1, 3]]), ranges, layout)
    with pytest.raises(RangeError, match=r"raster\.face_ranges"):
        verbs.rasterize(clip, faces, torch.tensor([[0, 2]]), layout)
    with pytest.raises(ShapeError, match=r"raster\.face_ranges"):
        verbs.rasterize(clip, faces, torch.tensor([[0, 1], [0, 1]]), layout)
    with pytest.raises(RangeError, match=r"raster\.near"):
        verbs.rasterize(clip, faces, ranges, layout, near=0.0)
    with pytest.raises(RangeError, match=r"raster\.clip\[1, 2\]"):
        verbs.rasterize(
            clip.index_put((torch.tensor(1), torch.tensor(2)), torch.tensor(torch.nan)), faces, ranges, layout
        )
    with pytest.raises(RangeError, match=r"raster\.backend"):
        verbs.rasterize(clip, faces, ranges, layout, backend="cuda")
    with pytest.raises(ShapeError, match=r"raster\.clip"):
        verbs.rasterize(clip[:, :2], faces, ranges, layout)


def test_bounding_rects():
    uvw = torch.tensor(
        [[10.2, 5.0, 2.0], [14.0, 7.9, 3.0], [500.0, 7.0, 1.0], [3.0, 3.0, -1.0], [-50.0, 3.0, 1.0]]
    )
    ranges = torch.tensor([[0, 2], [0, 3], [2, 4], [3, 4], [4, 5], [1, 1]])
    rects = verbs.bounding_rects(to_clip(uvw), ranges, height=40, width=60, margin=2)
    assert rects.tolist() == [
        [9, 3, 17, 10],
        [9, 3, 60, 10],
        [0, 0, 60, 40],
        [0, 0, 0, 0],
        [0, 1, 0, 6],
        [0, 0, 0, 0],
    ]
