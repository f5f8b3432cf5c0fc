"""Levels of detail stay closed, keep parts and colours, and stay near the surface."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import pytest
import torch
import trimesh
from hypothesis import given, settings
from torch import Tensor

from scene_ir.errors import RangeError
from scene_ir.meshes.lod import level_of_detail, simplify
from scene_ir.meshes.templates import template
from scene_ir.types import Mesh


def merged(mesh: Mesh) -> trimesh.Trimesh:
    shape = trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False)
    shape.merge_vertices(merge_tex=True, merge_norm=True)
    return shape


def plain(vertices: Tensor, faces: Tensor) -> Mesh:
    return Mesh(vertices.float(), faces.long(), torch.zeros(len(faces), dtype=torch.int64))


def of(shape: trimesh.Trimesh) -> Mesh:
    return plain(torch.tensor(shape.vertices), torch.tensor(shape.faces))


def edge_counts(mesh: Mesh) -> Tensor:
    """How many faces meet at each edge of the welded mesh."""
    faces = torch.unique(mesh.vertices, dim=0, return_inverse=True)[1][mesh.faces]
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
    return torch.unique(edges, dim=0, return_counts=True)[1]


def sharp(mesh: Mesh) -> set[tuple[float, ...]]:
    """All combinations of a face's part and a corner's colour."""
    rows = torch.cat([mesh.part[:, None].float().repeat(1, 3)[..., None], mesh.colours[mesh.faces]], dim=-1)
    return {tuple(r) for r in rows.reshape(-1, 4).tolist()}


@pytest.mark.parametrize(
    ("kind", "triangles"), [("sedan", 1500), ("sedan", 400), ("truck", 700), ("bus", 300), ("van", 1000)]
)
@pytest.mark.parametrize("longest", [math.inf, 1.0])
def test_coarser_mesh_is_closed_and_of_the_same_volume(kind: str, triangles: int, longest: float) -> None:
    mesh = template(kind, 4)
    coarse = simplify(mesh, triangles, longest)
    shape, fine = merged(coarse), merged(mesh)
    assert coarse.faces.shape[0] <= triangles
    assert bool((edge_counts(coarse) == 2).all())
    assert shape.is_watertight
    assert shape.is_winding_consistent
    assert shape.volume == pytest.approx(fine.volume, rel=0.04)
    assert torch.equal(coarse.vertices.amin(0), mesh.vertices.amin(0))
    assert torch.equal(coarse.vertices.amax(0), mesh.vertices.amax(0))


def test_coarser_mesh_stays_near_the_surface() -> None:
    """A thousand triangles lie within 1 % of the car's height of where they were, nearly everywhere."""
    mesh = template("sedan", 0)
    scale = torch.tensor([2.7, 1.0, 1.15], dtype=torch.float64)
    fine = trimesh.Trimesh((mesh.vertices.double() * scale).numpy(), mesh.faces.numpy(), process=False)
    coarse = simplify(mesh, 1000)
    points = (coarse.vertices.double() * scale)[coarse.faces].mean(dim=1)
    distance = trimesh.proximity.closest_point_naive(fine, points[::4].numpy())[1]
    assert float(torch.tensor(distance).quantile(0.95)) < 0.01


@pytest.mark.parametrize("triangles", [1500, 600])
def test_parts_and_colours_stay_together(triangles: int) -> None:
    mesh = template("estate", 1)
    coarse = simplify(mesh, triangles)
    assert sharp(coarse) <= sharp(mesh)
    assert set(coarse.part.tolist()) == set(mesh.part.tolist())


def test_glass_area_hardly_changes() -> None:
    mesh = template("sedan", 0)

    def area(m: Mesh, part: int) -> float:
        c = m.vertices[m.faces[m.part == part]]
        return float(torch.linalg.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]).norm(dim=1).sum())

    assert area(simplify(mesh, 1200), 1) == pytest.approx(area(mesh, 1), rel=0.05)


def test_flat_regions_cost_nothing() -> None:
    """A finely divided box goes down to its twelve triangles and is still that box."""
    mesh = of(trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide())
    coarse = simplify(mesh, 12)
    assert coarse.faces.shape[0] == 12
    assert merged(coarse).volume == pytest.approx(1.0, abs=1e-5)


def test_edges_are_no_longer_than_the_limit() -> None:
    mesh = of(trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide())
    coarse = simplify(mesh, 12, longest=0.8)
    corners = coarse.vertices[coarse.faces] * torch.tensor([2.7, 1.0, 1.15])
    assert float((corners - corners.roll(1, dims=1)).norm(dim=-1).max()) <= 0.8 + 1e-6
    assert 12 < coarse.faces.shape[0] < len(mesh.faces) // 2


def test_smooth_colours_stay_smooth() -> None:
    """Where no edge parts the colours, none does later: every place has one colour, and it is near the old one."""
    ball = of(trimesh.creation.icosphere(subdivisions=4))
    mesh = replace(ball, colours=(ball.vertices + 1) / 2)
    coarse = simplify(mesh, 600)
    assert len(coarse.vertices) == len(torch.unique(coarse.vertices, dim=0)) == 302
    assert float((coarse.colours - (coarse.vertices + 1) / 2).abs().max()) < 0.12


def test_borders_between_colours_stay_in_place() -> None:
    """A flat sheet, half of it red, keeps its straight border and its outline with the fewest triangles."""
    n = 20
    grid = torch.cartesian_prod(torch.arange(n + 1), torch.arange(n + 1))
    corner = torch.cartesian_prod(torch.arange(n), torch.arange(n)) @ torch.tensor([n + 1, 1])
    quad = torch.stack([corner, corner + n + 1, corner + n + 2, corner + 1], dim=1)
    faces = torch.cat([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    sheet = torch.cat([grid, torch.zeros(len(grid), 1)], dim=1) / n
    left = sheet[faces].mean(dim=1)[:, 0] < 0.5
    mesh = Mesh(sheet.float(), faces, left.long())
    coarse = simplify(mesh, 4)
    assert coarse.faces.shape[0] == 4
    corners = coarse.vertices[coarse.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert float(area[coarse.part == 1].sum()) == pytest.approx(0.5, abs=1e-5)
    assert float(area.sum()) == pytest.approx(1.0, abs=1e-5)


def test_small_meshes_come_back_as_they_are() -> None:
    mesh = template("van", 0)
    assert simplify(mesh, 5000) is mesh


def test_a_target_below_what_topology_allows_ends_closed() -> None:
    coarse = simplify(template("truck", 0), 4)
    assert merged(coarse).is_watertight
    assert coarse.faces.shape[0] >= 4


def test_deterministic_and_open_borders_stay() -> None:
    mesh = template("suv", 2)
    opened = replace(mesh, faces=mesh.faces[40:], part=mesh.part[40:], uv=mesh.vertices[:, :2].clone())
    first, second = simplify(opened, 900), simplify(opened, 900)
    assert torch.equal(first.vertices, second.vertices)
    assert torch.equal(first.faces, second.faces)
    assert torch.equal(first.uv, second.uv)
    assert first.faces.shape[0] <= 900


def test_points_that_no_face_uses_do_not_widen_the_bounds() -> None:
    ball = of(trimesh.creation.icosphere(subdivisions=3))
    stray = replace(ball, vertices=torch.cat([ball.vertices, torch.tensor([[9.0, 9.0, 9.0]])]))
    assert torch.equal(simplify(stray, 200).vertices, simplify(ball, 200).vertices)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31 - 1),
    points=st.integers(1, 40),
    faces=st.integers(0, 120),
    spread=st.sampled_from([1, 2, 4, 1000]),
    flat=st.booleans(),
    triangles=st.integers(4, 40),
)
def test_any_soup_of_triangles_is_taken(
    seed: int, points: int, faces: int, spread: int, flat: bool, triangles: int
) -> None:
    """Non-manifold, open, degenerate, coincident: the result is made of what was there, inside its bounds."""
    random = torch.Generator().manual_seed(seed)
    vertices = torch.randint(0, spread + 1, (points, 3), generator=random).double() / spread
    if flat:
        vertices[:, 1] = 0.25
    mesh = Mesh(
        vertices,
        torch.randint(0, points, (faces, 3), generator=random),
        torch.randint(0, 5, (faces,), generator=random),
        colours=torch.rand(points, 3, generator=random),
        uv=torch.rand(points, 2, generator=random),
    )
    coarse = simplify(mesh, triangles)
    if coarse is mesh:
        return
    assert coarse.faces.shape[0] <= faces
    assert coarse.vertices.dtype == torch.float64
    assert sharp(coarse) <= sharp(mesh)
    corner = vertices[mesh.faces]
    different = (corner != corner.roll(1, dims=1)).any(dim=-1).all(dim=1)
    used = corner[different].reshape(-1, 3)
    assert torch.equal(coarse.vertices.amin(0), used.amin(0))
    assert torch.equal(coarse.vertices.amax(0), used.amax(0))
    left = coarse.vertices[coarse.faces]
    assert bool((left != left.roll(1, dims=1)).any(dim=-1).all())


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), count=st.integers(1, 4), triangles=st.integers(4, 600))
def test_closed_surfaces_of_many_pieces_stay_closed(seed: int, count: int, triangles: int) -> None:
    random = torch.Generator().manual_seed(seed)
    balls = []
    for _ in range(count):
        ball = trimesh.creation.icosphere(subdivisions=2)
        stretch, move = torch.rand(2, 3, generator=random).numpy()
        ball.vertices = ball.vertices * (0.05 + stretch) + 3 * move
        balls.append(ball)
    mesh = of(trimesh.util.concatenate(balls))
    coarse = simplify(mesh, triangles)
    assert bool((edge_counts(coarse) == 2).all())
    assert merged(coarse).volume > 0
    assert coarse.faces.shape[0] <= max(triangles, 8 * count)


def test_faces_without_extent_come_back_as_they_are() -> None:
    mesh = plain(torch.zeros(3, 3), torch.tensor([[0, 1, 2]] * 9))
    assert simplify(mesh, 4) is mesh


def test_senseless_targets_are_refused() -> None:
    with pytest.raises(RangeError, match="triangles"):
        simplify(template("sedan", 0), 3)
    with pytest.raises(RangeError, match="longest"):
        simplify(template("sedan", 0), 100, longest=0.0)


@pytest.mark.parametrize("height_px", [-1.0, math.nan])
def test_senseless_heights_are_refused(height_px: float) -> None:
    with pytest.raises(RangeError, match="height_px"):
        level_of_detail(template("sedan", 0), height_px)


def test_detail_grows_with_the_height_in_few_steps() -> None:
    mesh = template("sedan", 0)
    heights = [0.0, 5.0, 12.0, 25.0, 40.0, 60.0, 100.0, 150.0, 250.0, 400.0, math.inf]
    counts = [level_of_detail(mesh, h).faces.shape[0] for h in heights]
    assert counts == sorted(counts)
    assert 200 <= counts[0] <= 300
    assert counts[-1] == counts[-2] == mesh.faces.shape[0]
    assert level_of_detail(mesh, 400.0) is mesh
    assert len({id(level_of_detail(mesh, float(h))) for h in range(500)}) <= 10


def test_equal_meshes_share_their_levels() -> None:
    mesh = template("hatchback", 3)
    again = replace(mesh, vertices=mesh.vertices.clone(), faces=mesh.faces.clone())
    painted = replace(mesh, colours=mesh.colours * 0.5)
    assert level_of_detail(again, 60.0) is level_of_detail(mesh, 60.0)
    assert level_of_detail(painted, 60.0) is not level_of_detail(mesh, 60.0)
    assert not torch.equal(level_of_detail(painted, 60.0).colours, level_of_detail(mesh, 60.0).colours)
