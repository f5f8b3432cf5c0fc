"""Both backends on random closed meshes (clipped, inside out, degenerate, culled, shared, empty), on threads, and at
depths from 0.5 m to 200 m."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from scene_ir.errors import RangeError
from scene_ir.raster import kernels, launch, verbs
from scene_ir.raster import layout as plan

RECTS = torch.tensor(
    [[0, 0, 60, 44], [20, 10, 41, 33], [7, 7, 7, 20], [0, 0, 60, 44], [30, 20, 31, 21], [5, 0, 75, 9]]
)
LAYOUT = verbs.PixelLayout.from_rects(RECTS)
FOCAL = 45.0


@contextmanager
def sharing(threads: int) -> Iterator[None]:
    """Use this many threads even for little work."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with mock.patch.object(plan, "_MIN_WORK", 1.0), mock.patch.object(launch, "_MIN_PIXELS", 1):
            yield
    finally:
        torch.set_num_threads(before)


def to_clip(points: Tensor) -> Tensor:
    """Clip coordinates of camera-space points; the principal point is in the middle of the first rectangle."""
    x, y, z = points.unbind(-1)
    return torch.stack([FOCAL * x + 30.2 * z, FOCAL * y + 21.7 * z, z], dim=-1)


def solids(seed: int, nearest_m: float) -> tuple[Tensor, Tensor, Tensor]:
    """Six boxes and balls at random, normals outward -> points (V, 3), faces (F, 3), face ranges (6, 2)."""
    generator = torch.Generator().manual_seed(seed)
    points, faces, ranges, vertices, count = [], [], [], 0, 0
    for i in range(6):
        made = trimesh.creation.box() if i % 2 else trimesh.creation.icosphere(subdivisions=1 + i // 4)
        turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        turn = turn * torch.linalg.det(turn).sign()
        size = 0.3 + 2.0 * torch.rand(3, generator=generator, dtype=torch.float64)
        z = nearest_m + 9.0 * torch.rand(1, generator=generator, dtype=torch.float64)
        aside = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * (0.7 * z.abs() + 0.5)
        points.append((torch.tensor(made.vertices) * size) @ turn.T + torch.cat([aside, z]))
        faces.append(torch.tensor(made.faces) + vertices)
        ranges.append([count, count + len(made.faces)])
        vertices, count = vertices + len(made.vertices), count + len(made.faces)
    return torch.cat(points).to(torch.float32), torch.cat(faces), torch.tensor(ranges)


def everything(clip: Tensor, faces: Tensor, ranges: Tensor, backend: verbs.Backend, cull: bool | Tensor = False,
               layout: verbs.PixelLayout = LAYOUT) -> tuple[verbs.Fragments, list[Tensor]]:  # fmt: skip
    """Results of all verbs, and gradients of random sums of them."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(clip.shape[0], 4, generator=generator)
    weights = torch.randn(layout.size, 5, generator=generator)
    corners, attributes = clip.clone().requires_grad_(), values.requires_grad_()
    found = verbs.rasterize(corners, faces, ranges, layout, backend, cull=cull)
    out = verbs.interpolate(found, corners, faces, attributes, backend)
    coverage = verbs.antialias(found, corners, faces, backend)
    by_value = torch.autograd.grad((out * weights[:, :4]).sum(), (corners, attributes))
    by_outline = torch.autograd.grad((coverage * weights[:, 4]).sum(), corners)
    return found, [out.detach(), coverage.detach(), *by_value, *by_outline]


def assert_same(fast: tuple[verbs.Fragments, list[Tensor]], slow: tuple[verbs.Fragments, list[Tensor]]) -> None:
    assert torch.equal(fast[0].face, slow[0].face)
    assert torch.equal(fast[0].depth, slow[0].depth)
    names = ("values", "coverage", "clip", "attributes", "outline")
    for name, a, b in zip(names, fast[1], slow[1], strict=True):
        scale = 1 + float(b.abs().max()) if b.numel() else 1.0
        torch.testing.assert_close(a / scale, b / scale, rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")
    torch.testing.assert_close(fast[1][1], slow[1][1], rtol=0, atol=1e-5)


SEEDS = st.integers(0, 2**31 - 1)


def random_triangles(seed: int, count: int, behind: bool, on_pixels: bool) -> tuple[Tensor, Tensor]:
    """Random triangles, some partly behind the camera, some with corners on pixel centres; some share corners."""
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(count * 3, 2, generator=generator) * torch.tensor([50.0, 36.0]) - 5
    w = torch.rand(count * 3, 1, generator=generator) * 20 + (-4 if behind else 0.5)
    if on_pixels:
        uv, w = uv.round(), w.round() + 0.5
    return torch.cat([uv * w, w], dim=1), torch.randint(0, count * 3, (count, 3), generator=generator)


@given(SEEDS, st.integers(1, 30), st.booleans(), st.booleans())
@settings(max_examples=40, deadline=None)
def test_kernels_match_the_reference_on_triangle_soups(
    seed: int, count: int, behind: bool, on_pixels: bool
) -> None:
    clip, faces = random_triangles(seed, count, behind, on_pixels)
    ranges = torch.tensor([[0, count], [0, 1], [count // 3, max(count // 3, count - 2)]])
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 40, 26], [10, 5, 10, 9], [3, 4, 33, 24]]))
    fast = everything(clip, faces, ranges, "warp", layout=layout)
    assert_same(fast, everything(clip, faces, ranges, "reference", layout=layout))
    assert 0 <= float(fast[1][1].min()) <= float(fast[1][1].max()) <= 1


@given(
    SEEDS, st.sampled_from([3.0, 0.5, -2.0]), st.sampled_from([1, 2, 3]), st.sampled_from(["none", "all", "some"])
)
@settings(max_examples=30)
def test_kernels_match_the_reference_on_solids(seed: int, nearest_m: float, threads: int, culled: str) -> None:
    points, faces, ranges = solids(seed, nearest_m)
    clip = to_clip(points)
    # The first draw holds everything, the fourth shares some of it, the third has no pixels and the fifth one.
    ranges = torch.stack(
        [ranges[[0, -1], [0, 1]], ranges[1], ranges[2], ranges[[1, 3], [0, 1]], ranges[4], ranges[5]]
    )
    cull = {"none": False, "all": True, "some": torch.arange(6) % 2 == 0}[culled]
    with sharing(threads):
        fast = everything(clip, faces, ranges, "warp", cull)
    assert_same(fast, everything(clip, faces, ranges, "reference", cull))


@given(SEEDS, st.sampled_from([3.0, 0.5, -2.0]), st.sampled_from([1, 2]))
@settings(max_examples=15)
def test_kernels_match_the_reference_on_one_layered_draw(seed: int, nearest_m: float, threads: int) -> None:
    """Its faces are drawn front to back in any order, and hidden ones are skipped."""
    points, faces, _ = solids(seed, nearest_m)
    shells = torch.cat([points * torch.tensor([1.0, 1.0, 1.0 + 0.01 * i]) for i in range(4)])
    layers = torch.cat([faces + i * len(points) for i in range(4)])
    layers = layers[torch.randperm(len(layers), generator=torch.Generator().manual_seed(seed))]
    clip, ranges, layout = (
        to_clip(shells),
        torch.tensor([[5, len(layers)]]),
        verbs.PixelLayout.from_rects(RECTS[:1]),
    )
    with sharing(threads):
        fast = everything(clip, layers, ranges, "warp", layout=layout)
    assert_same(fast, everything(clip, layers, ranges, "reference", layout=layout))


@given(SEEDS, st.booleans())
@settings(max_examples=15)
def test_culling_does_not_change_closed_solids(seed: int, inside_out: bool) -> None:
    points, faces, ranges = solids(seed, 3.0)
    clip = to_clip(points)
    layout = verbs.PixelLayout.from_rects(RECTS[:1].expand(6, 4))
    both = verbs.rasterize(clip, faces, ranges, layout)
    found = verbs.rasterize(clip, faces.flip(1) if inside_out else faces, ranges, layout, cull=True)
    assert int((both.face >= 0).sum()) > 0
    if inside_out:  # the far sides are left
        hit = both.face >= 0
        assert torch.equal(found.face >= 0, hit)
        assert (found.depth[hit] > both.depth[hit]).all()
        return
    assert torch.equal(found.face, both.face)
    assert torch.equal(found.depth, both.depth)
    coverage = [verbs.antialias(f, clip, faces) for f in (both, found)]
    torch.testing.assert_close(coverage[0], coverage[1], rtol=0, atol=1e-5)


@given(SEEDS)
@settings(max_examples=10)
def test_culling_across_the_near_plane(seed: int) -> None:
    """A face is culled by the side of its plane on which the camera stands, also across the near plane."""
    points, faces, _ = solids(seed, -2.0)
    a, b, c = points.to(torch.float64)[faces].unbind(1)
    facing = (torch.linalg.cross(b - a, c - a) * -a).sum(-1) > 0
    clip = to_clip(points)
    filled_rows = verbs.rasterize(
        clip, faces[facing], torch.tensor([[0, int(facing.sum())]]), verbs.PixelLayout.from_rects(RECTS[:1])
    )
    whole = torch.tensor([[0, len(faces)]])
    culled = verbs.rasterize(clip, faces, whole, verbs.PixelLayout.from_rects(RECTS[:1]), cull=True)
    assert torch.equal(filled_rows.depth, culled.depth)


@given(SEEDS)
@settings(max_examples=15)
def test_degenerate_and_extreme_triangles(seed: int) -> None:
    points, faces, ranges = solids(seed, 1.0)
    generator = torch.Generator().manual_seed(seed)
    count = len(points)
    extreme = torch.tensor(
        [[1e30, -1e30, 1.0], [-1e6, 1e5, 1e-3], [0.0, 0.0, 0.0], [3e4, 2e4, 1e9], [1.0, 1.0, -1e20]]
    )
    picks = torch.randint(0, count + len(extreme), (12, 3), generator=generator)
    point, other = torch.randint(0, count, (2, 6, 1), generator=generator)
    flat = torch.cat([point.expand(-1, 3), torch.cat([point, point, other], dim=1)])  # no area, repeated vertices
    line = torch.arange(3)[None] + count + len(extreme)
    straight = points[:1] + torch.tensor([[0.0], [0.5], [1.0]]) * (points[1:2] - points[:1])
    clip = to_clip(torch.cat([points, torch.zeros(len(extreme), 3), straight]))
    clip[count : count + len(extreme)] = extreme
    all_faces = torch.cat([faces, picks, flat, line])
    ranges = torch.tensor([[0, len(all_faces)], [len(faces), len(all_faces)]])
    layout = verbs.PixelLayout.from_rects(RECTS[[0, 3]])
    found = [verbs.rasterize(clip, all_faces, ranges, layout, b) for b in ("warp", "reference")]
    assert torch.equal(found[0].face, found[1].face)
    assert torch.equal(found[0].depth, found[1].depth)
    assert not torch.isin(found[0].face, torch.arange(len(faces) + len(picks), len(all_faces))).any()
    coverage = [verbs.antialias(f, clip, all_faces, b) for f, b in zip(found, ("warp", "reference"), strict=True)]
    torch.testing.assert_close(coverage[0], coverage[1], rtol=0, atol=1e-5)


@given(SEEDS)
@settings(max_examples=10)
def test_triangles_far_wider_than_a_machine_word(seed: int) -> None:
    """Outline masks are scanned 64 pixels at a time."""
    generator = torch.Generator().manual_seed(seed)
    u = 330 * torch.rand(9, generator=generator) - 30
    v = 30 * torch.rand(9, generator=generator) - 3
    w = 1 + 4 * torch.rand(9, generator=generator)
    clip, faces = torch.stack([u * w, v * w, w], dim=1), torch.arange(9).view(3, 3)
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 270, 24], [3, 1, 200, 20]]))
    ranges = torch.tensor([[0, 3], [1, 3]])
    assert_same(
        everything(clip, faces, ranges, "warp", layout=layout),
        everything(clip, faces, ranges, "reference", layout=layout),
    )


def test_threads_share_no_tile_memory() -> None:
    """On x86, Warp's tile arena is found by one static pointer: threads would write to each other's stacks."""
    assert kernels.wp.config.enable_tiles_in_stack_memory is None


@pytest.mark.parametrize("threads", [1, 2, 5, 16])
def test_results_do_not_depend_on_threads(threads: int) -> None:
    points, faces, ranges = solids(11, 0.5)
    clip = to_clip(points)
    for pixels, which in ((RECTS[:1], ranges[[0, -1], [0, 1]][None]), (RECTS, ranges)):
        layout = verbs.PixelLayout.from_rects(pixels)
        with sharing(1):
            alone = everything(clip, faces, which, "warp", layout=layout)
        with sharing(threads):
            shared = everything(clip, faces, which, "warp", layout=layout)
        assert torch.equal(alone[0].face, shared[0].face)
        assert all(torch.equal(a, b) for a, b in zip(alone[1], shared[1], strict=True))


@given(SEEDS, st.integers(1, 9))
def test_threads_own_each_pixel_once(seed: int, threads: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    low = torch.randint(0, 40, (7, 2), generator=generator)
    rects = torch.cat([low, low + torch.randint(-2, 90, (7, 2), generator=generator)], dim=1)
    layout = verbs.PixelLayout.from_rects(rects)
    ends = torch.randint(0, 900, (7, 2), generator=generator)
    with sharing(1):
        parts, cuts = plan.split_for_threads(layout, ends, None, threads)
    owned = [
        first + i for _, _, _, _, row, end, *_, first in parts for i in range((end - row) * (_width(parts, first)))
    ]
    assert owned == list(range(layout.size))
    assert cuts[0] == 0
    assert cuts[-1] == len(parts)
    assert len(cuts) - 1 <= threads
    assert cuts == sorted(set(cuts)) or not parts


def _width(parts: list[list[int]], first: int) -> int:
    return next(p[2] - p[0] for p in parts if p[10] == first and p[5] > p[4])


@pytest.mark.parametrize("backend", ["reference", "warp"])
@pytest.mark.parametrize("distance_m", [0.5, 5.0, 50.0, 200.0])
def test_close_surfaces_do_not_flicker_when_the_camera_moves(backend: verbs.Backend, distance_m: float) -> None:
    """With float32 depth, the nearer of two surfaces 1/20,000 of their distance apart (1 cm at 200 m) is visible at
    every pixel, also slanted and for any camera position."""
    gap = distance_m * 5e-5
    n = 7
    grid = torch.linspace(-0.25, 0.25, n, dtype=torch.float64)
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    corner = torch.arange(n * n).view(n, n)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    fine = torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)]).reshape(-1, 3)
    coarse = torch.tensor([[0, n - 1, n * n - 1], [0, n * n - 1, n * n - n]]) + n * n
    faces = torch.cat([fine, coarse])  # the finer one is nearer
    focal = 1200.0  # of the longer lenses in use
    rect = torch.tensor([[600, 150, 680, 200]])
    seen = 0
    for step in range(12):
        for slant in (0.0, 1.0):
            z = distance_m * (1.0 + slant * 0.3 * x)
            front = torch.stack([distance_m * x, distance_m * y, z], dim=-1).reshape(-1, 3)
            points = torch.cat([front, front + torch.tensor([0.0, 0.0, gap])])
            points[:, :2] += 0.01 * step / focal * distance_m  # a hundredth of a pixel each time
            camera = torch.tensor([[focal, 0, 620], [0, focal, 180], [0, 0, 1]], dtype=torch.float64)
            clip = (points @ camera.T).to(torch.float32)
            found = verbs.rasterize(
                clip, faces, torch.tensor([[0, len(faces)]]), verbs.PixelLayout.from_rects(rect), backend
            )
            hit = found.face >= 0
            seen += int(hit.sum())
            assert (found.face[hit] < len(fine)).all()
    assert seen > 10_000


def test_draws_outside_the_image_have_no_parts() -> None:
    """Draws without pixels belong to no thread, so that none of their triangles is processed."""
    points, faces, ranges = solids(3, 3.0)
    away = points + torch.tensor([500.0, 0.0, 0.0])
    behind = points - torch.tensor([0.0, 0.0, 40.0])
    clip = to_clip(torch.cat([points, away, behind]))
    more = torch.cat([faces, faces + len(points), faces + 2 * len(points)])
    more_ranges = torch.cat([ranges, ranges + len(faces), ranges + 2 * len(faces)])
    corners = [faces[start:end] for start, end in ranges.tolist()]
    vertex_ranges = torch.tensor([[int(f.min()), int(f.max()) + 1] for f in corners])
    every = torch.cat([vertex_ranges + i * len(points) for i in range(3)])
    alone = verbs.PixelLayout.from_rects(verbs.bounding_rects(clip[: len(points)], vertex_ranges, 44, 60))
    few = verbs.rasterize(clip[: len(points)], faces, ranges, alone)
    many = verbs.rasterize(
        clip, more, more_ranges, verbs.PixelLayout.from_rects(verbs.bounding_rects(clip, every, 44, 60))
    )
    assert few.face.shape[0] > 500
    assert torch.equal(many.face, few.face)
    assert few.plan is not None
    assert many.plan is not None
    assert torch.equal(many.plan.parts, few.plan.parts)


def test_face_checks_are_cached_until_faces_change(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = to_clip(torch.tensor([[-1.0, -1.0, 4.0], [1.0, -1.0, 4.0], [0.0, 1.0, 4.0]]))
    faces, ranges = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]])
    layout = verbs.PixelLayout.from_rects(RECTS[:1])
    passes: list[int] = []
    search = torch.Tensor.aminmax

    def counted(tensor: Tensor) -> object:
        passes.append(tensor.data_ptr())
        return search(tensor)

    monkeypatch.setattr(torch.Tensor, "aminmax", counted)
    before = verbs.rasterize(clip, faces, ranges, layout)
    verbs.antialias(before, clip, faces)
    assert (before.face >= 0).any()
    assert len(passes) == 1
    faces[0] = torch.tensor([0, 0, 0])
    assert (verbs.rasterize(clip, faces, ranges, layout).face < 0).all()
    assert len(passes) == 2
    faces[0] = torch.tensor([0, 1, 3])
    with pytest.raises(RangeError, match=r"raster\.faces"):
        verbs.rasterize(clip, faces, ranges, layout)


def test_outlines_follow_vertices_changed_after_rasterize() -> None:
    points, faces, _ = solids(7, 4.0)
    clip = to_clip(points)
    whole = torch.tensor([[0, len(faces)]])
    layout = verbs.PixelLayout.from_rects(RECTS[:1])
    found = verbs.rasterize(clip, faces, whole, layout)
    moved = clip + torch.tensor([0.1, 0.05, 0.0])
    expected = verbs.antialias(found, moved, faces, "reference")
    torch.testing.assert_close(verbs.antialias(found, moved, faces), expected, rtol=0, atol=1e-5)
    clip += torch.tensor([0.1, 0.05, 0.0])
    torch.testing.assert_close(verbs.antialias(found, clip, faces), expected, rtol=0, atol=1e-5)


def test_warp_loads_silently_on_first_use(tmp_path: Path) -> None:
    script = """
import sys, torch
from scene_ir.raster import verbs
assert "warp" not in sys.modules
layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 4, 4]]))
clip = torch.tensor([[0.0, 0, 1], [9, 0, 1], [0, 9, 1]])
found = verbs.rasterize(clip, torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]]), layout)
assert int((found.face >= 0).sum()) == 16 - (4 if found.face[0] < 0 else 0)
assert "warp" in sys.modules
"""
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, timeout=200, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
