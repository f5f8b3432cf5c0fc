"""Levels of detail stay closed, keep parts and colours, and stay near the surface."""

from dataclasses import replace

import pytest
import torch
import trimesh

from scene_ir.errors import RangeError
from scene_ir.meshes.lod import simplify
from scene_ir.meshes.templates import template
from scene_ir.types import Mesh


def merged(mesh: Mesh) -> trimesh.Trimesh:
    shape = trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False)
    shape.merge_vertices(merge_tex=True, merge_norm=True)
    return shape


@pytest.mark.parametrize(("kind", "triangles"), [("sedan", 1500), ("sedan", 400), ("truck", 700), ("bus", 300)])
def test_coarser_mesh_is_closed_and_of_the_same_volume(kind: str, triangles: int) -> None:
    mesh = template(kind, 4)
    coarse = simplify(mesh, triangles)
    shape, fine = merged(coarse), merged(mesh)
    assert coarse.faces.shape[0] <= triangles
    assert shape.is_watertight
    assert shape.is_winding_consistent
    assert shape.volume == pytest.approx(fine.volume, rel=0.04)
    assert torch.equal(coarse.vertices.amin(0), mesh.vertices.amin(0))
    assert torch.equal(coarse.vertices.amax(0), mesh.vertices.amax(0))


@pytest.mark.parametrize("triangles", [1500, 600])
def test_parts_and_colours_stay_together(triangles: int) -> None:
    mesh = template("estate", 1)
    coarse = simplify(mesh, triangles)

    def pairs(m: Mesh) -> set[tuple[float, ...]]:
        rows = torch.cat([m.part[:, None].float().repeat(1, 3)[..., None], m.colours[m.faces]], dim=-1)
        return {tuple(r) for r in rows.reshape(-1, 4).tolist()}

    assert pairs(coarse) <= pairs(mesh)
    assert set(coarse.part.tolist()) == set(mesh.part.tolist())


def test_glass_area_hardly_changes() -> None:
    mesh = template("sedan", 0)

    def area(m: Mesh, part: int) -> float:
        c = m.vertices[m.faces[m.part == part]]
        return float(torch.linalg.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]).norm(dim=1).sum())

    assert area(simplify(mesh, 1200), 1) == pytest.approx(area(mesh, 1), rel=0.05)


def test_flat_regions_cost_nothing() -> None:
    """A finely divided box goes down to its twelve triangles and is still that box."""
    box = trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide()
    mesh = Mesh(
        vertices=torch.tensor(box.vertices, dtype=torch.float32) - torch.tensor([0, 0.5, 0]),
        faces=torch.tensor(box.faces, dtype=torch.int64),
        part=torch.zeros(len(box.faces), dtype=torch.int64),
    )
    coarse = simplify(mesh, 12)
    assert coarse.faces.shape[0] == 12
    assert merged(coarse).volume == pytest.approx(1.0, abs=1e-5)


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


def test_senseless_targets_are_refused() -> None:
    with pytest.raises(RangeError, match="triangles"):
        simplify(template("sedan", 0), 3)
