"""Borders between samples: thin faces, ends of surfaces, outlines; walks over a mesh."""

import itertools
import math

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_ir.geometry import to_clip
from scene_ir.render.borders import MAX_WALK_FACES, MeshEdges, MeshWalk
from scene_ir.render.lit_mesh import GAMMA, Lights, LitMesh, Materials
from scene_ir.types import Camera

SIZE, DEPTH = 32, 2.0
CAMERA = Camera(torch.tensor([[SIZE * DEPTH, 0, 0], [0, SIZE * DEPTH, 0], [0, 0, 1.0]]), SIZE, SIZE)
"""A point at depth DEPTH and x / SIZE is seen at x px."""
FLAT = Lights(torch.zeros(3), torch.tensor(0.0), torch.tensor(1.0))


def upright(edges, colours, depth=DEPTH, slices=1):
    """Corners, faces and colours of upright strips between positions, px; each strip is split into `slices`."""
    places = [a + (b - a) * k / slices for a, b in itertools.pairwise(edges) for k in range(slices)]
    places.append(edges[-1])
    x = torch.tensor(places, dtype=torch.float64) / SIZE * depth / DEPTH
    top, bottom = (y * depth / DEPTH * torch.ones_like(x) for y in (0.1, 0.9))
    corners = torch.cat([torch.stack([x, y, depth * torch.ones_like(x)], 1) for y in (top, bottom)])
    n, first = len(x), torch.arange(len(x) - 1)
    faces = torch.stack([first, first + n, first + 1, first + 1, first + n, first + n + 1], 1).reshape(-1, 3)
    return corners.float(), faces, torch.tensor(colours).repeat_interleave(2 * slices)


def row(parts, samples_per_side):
    """A row of pixels (SIZE,) across the parts, times coverage; parts: corners, faces and colours."""
    corners, faces, light, count = [], [], [], 0
    for vertices, triangles, colour in parts:
        corners.append(vertices)
        faces.append(triangles + count)
        light.append(colour)
        count += len(vertices)
    diffuse = torch.cat(light)[:, None].expand(-1, 3)
    none = torch.zeros(len(diffuse))
    vertices = torch.cat(corners)
    mesh = LitMesh(vertices, torch.cat(faces), Materials(diffuse, none, none + 10.0))
    drawn = mesh.render(vertices, CAMERA, FLAT, "reference", samples_per_side)
    return (drawn[0] * drawn[3])[SIZE // 2]


def display_value(colour):
    return colour**GAMMA


BOTH_COUNTS = pytest.mark.parametrize("samples_per_side", [1, 2])


@BOTH_COUNTS
@pytest.mark.parametrize("at_outline", [False, True])
@settings(deadline=None, max_examples=15)
@given(start=st.floats(9.0, 11.0), thin=st.floats(0.02, 0.7))
def test_a_strip_thinner_than_a_pixel_counts_by_its_width(samples_per_side, at_outline, start, thin):
    edges = [2.3, start, start + thin, *([] if at_outline else [25.6])]
    colours = [0.8, 0.02, 0.5][: len(edges) - 1]
    total = float(row([upright(edges, colours)], samples_per_side).sum())
    widths = [b - a for a, b in itertools.pairwise(edges)]
    expected = sum(width * display_value(colour) for width, colour in zip(widths, colours, strict=True))
    assert total == pytest.approx(expected, abs=2e-3)


OFF_SAMPLES = st.floats(9.0, 11.0).filter(lambda x: (4 * x) % 1 > 1e-3)
"""Edges that pass through no sample: one that does is counted half a pixel off, on one side."""


@BOTH_COUNTS
@settings(deadline=None, max_examples=15)
@given(start=OFF_SAMPLES, slices=st.integers(1, 40))
def test_the_end_of_the_nearer_surface_is_the_border_for_any_faces_behind(samples_per_side, start, slices):
    behind = upright([2.3, 25.6], [0.8], 2 * DEPTH, slices)
    total = float(row([upright([start, start + 5.5], [0.02]), behind], samples_per_side).sum())
    assert total == pytest.approx((25.6 - 2.3 - 5.5) * display_value(0.8) + 5.5 * display_value(0.02), abs=2e-3)


def test_kernel_walks_equal_torch_walks():
    solid = trimesh.creation.icosphere(3, 0.5)
    vertices, faces = torch.tensor(solid.vertices, dtype=torch.float32), torch.tensor(solid.faces)
    edges = MeshEdges.from_mesh(vertices, faces, torch.zeros(len(faces), 1), math.cos(0.1))
    points = to_clip(vertices + torch.tensor([0.3, 0.3, 2.0]), CAMERA.matrix).double()
    generator = torch.Generator().manual_seed(0)
    seen = torch.randint(len(faces), (400,), generator=generator)
    middle = points[faces[seen]].mean(dim=1)
    start = middle / middle[:, 2:]
    angle = 6.3 * torch.rand(400, dtype=torch.float64, generator=generator)
    end = start + 3 * torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1)
    goal = torch.randint(len(faces), (400,), generator=generator)
    fast, plain = (
        MeshWalk.trace(points, faces, edges.across, (seen, goal), start, end, backend)
        for backend in ("warp", "reference")
    )
    for name in ("face", "edge", "goes_on", "met"):
        assert torch.equal(getattr(fast, name), getattr(plain, name)), name
    for name in ("share", "plane", "end"):
        torch.testing.assert_close(getattr(fast, name), getattr(plain, name), rtol=1e-12, atol=0, equal_nan=True)
    assert int(fast.goes_on.sum(dim=1).max()) == MAX_WALK_FACES


def test_mesh_edges_find_neighbours_and_creases():
    box = trimesh.creation.box((1, 1, 1))
    vertices, faces = torch.tensor(box.vertices, dtype=torch.float32), torch.tensor(box.faces)
    edges = MeshEdges.from_mesh(vertices, faces, torch.zeros(len(faces), 1), 0.766)
    assert bool((edges.across >= 0).all())
    assert torch.equal(edges.across[edges.across], torch.arange(36))
    assert int((~edges.creased).sum()) == 12  # the diagonals of six sides, seen from both
    coloured = MeshEdges.from_mesh(vertices, faces, torch.arange(12.0)[:, None], 0.766)
    assert bool(coloured.creased.all())
    assert bool((MeshEdges.from_mesh(vertices, faces[:1], torch.zeros(1, 1), 0.766).across == -1).all())
