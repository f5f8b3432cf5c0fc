"""Vehicle templates: closed, symmetric, labelled, of plausible size, and different from one another."""

import numpy as np
import pytest
import torch
import trimesh

from scene_ir.errors import RangeError
from scene_ir.meshes.templates import KINDS, template, typical_size_lhw
from scene_ir.types import Mesh, Part

VARIANTS = (0, 1, 2, 57, 100, 123)


def components(mesh: Mesh) -> list[trimesh.Trimesh]:
    """The mesh's connected pieces once coincident vertices are merged."""
    merged = trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    return list(merged.split(only_watertight=False))


def part_points(mesh: Mesh, part: Part) -> torch.Tensor:
    return mesh.vertices[mesh.faces[mesh.part == part].reshape(-1)]


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_component_is_closed_and_wound_outwards(kind: str, variant: int) -> None:
    pieces = components(template(kind, variant))
    assert len(pieces) >= 7  # body, four wheels, two mirrors
    for piece in pieces:
        assert piece.is_watertight
        assert piece.is_winding_consistent
        assert piece.volume > 0


@pytest.mark.parametrize("kind", KINDS)
def test_fills_the_unit_box_with_a_sensible_number_of_triangles(kind: str) -> None:
    for variant in (*range(24), *range(100, 108)):
        mesh = template(kind, variant)
        assert 1500 <= mesh.faces.shape[0] <= 5000
        assert mesh.vertices.dtype == torch.float32
        assert mesh.vertices.amin(0).tolist() == pytest.approx([-0.5, -1.0, -0.5], abs=1e-6)
        assert mesh.vertices.amax(0).tolist() == pytest.approx([0.5, 0.0, 0.5], abs=1e-6)


@pytest.mark.parametrize("variant", [0, 3, 101])
@pytest.mark.parametrize("kind", KINDS)
def test_left_and_right_are_mirror_images_to_the_bit(kind: str, variant: int) -> None:
    mesh = template(kind, variant)
    assert mesh.colours is not None

    def points(sign: float) -> set[tuple[float, ...]]:
        turned = mesh.vertices * torch.tensor([1.0, 1.0, sign]) + 0.0
        return {tuple(row) for row in torch.cat([turned, mesh.colours], dim=1).tolist()}

    assert points(1.0) == points(-1.0)
    corners = mesh.vertices[mesh.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).double()
    signed = (area.norm(dim=1) * corners.double()[..., 2].mean(dim=1)).sum() / area.norm(dim=1).sum()
    assert abs(float(signed)) < 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_parts_are_where_a_vehicle_has_them(kind: str) -> None:
    mesh = template(kind, 0)
    assert set(mesh.part.tolist()) == {int(p) for p in Part}
    tyre, glass, light = (part_points(mesh, p) for p in (Part.TYRE, Part.GLASS, Part.LIGHT))
    assert float(tyre[:, 1].max()) == pytest.approx(0.0, abs=1e-6)
    assert float(tyre[:, 1].mean()) > -0.25
    assert {(x > 0, z > 0) for x, z in tyre[:, [0, 2]].tolist()} == {
        (True, True), (True, False), (False, True), (False, False)
    }  # fmt: skip
    assert float(glass[:, 1].max()) < -0.3
    assert float(light[:, 0].max()) > 0.4
    assert float(light[:, 0].min()) < -0.4
    # head lights are white, tail lights red
    colours = mesh.colours[mesh.faces[mesh.part == Part.LIGHT].reshape(-1)]
    ahead = light[:, 0] > 0
    assert float(colours[ahead].min()) > 0.4
    assert float((colours[~ahead, 0] - colours[~ahead, 1]).min()) > 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_vertices_belong_to_one_part_and_paint_is_neutral_grey(kind: str) -> None:
    mesh = template(kind, 0)
    owner = torch.full((mesh.vertices.shape[0],), -1)
    for part in Part:
        used = mesh.faces[mesh.part == part].unique()
        assert bool((owner[used] == -1).all())
        owner[used] = int(part)
    assert bool((owner >= 0).all())
    paint = mesh.colours[owner == Part.PAINT]
    assert float((paint - paint.mean(dim=1, keepdim=True)).abs().max()) < 1e-6
    assert 0.7 < float(paint.min()) <= float(paint.max()) < 0.9
    assert float(mesh.colours[owner == Part.GLASS].max()) < 0.2


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "truck"])
def test_the_cabin_is_narrower_than_the_body(kind: str) -> None:
    mesh = template(kind, 0)
    points = mesh.vertices
    roof = points[(points[:, 1] < -0.97) & (points[:, 0].abs() < 0.3), 2].abs().max()
    waist = points[(points[:, 1] > -0.5) & (points[:, 0].abs() < 0.3), 2].abs().max()
    assert float(roof) < float(waist)


@pytest.mark.parametrize("kind", KINDS)
def test_variants_are_deterministic_and_all_different(kind: str) -> None:
    template.cache_clear()
    first = template(kind, 7)
    template.cache_clear()
    again = template(kind, 7)
    assert torch.equal(first.vertices, again.vertices)
    assert torch.equal(first.faces, again.faces)
    seen = {template(kind, v).vertices.numpy().tobytes() for v in (*range(6), *range(100, 106))}
    assert len(seen) == 12


@pytest.mark.parametrize("kind", KINDS)
def test_sizes_are_plausible(kind: str) -> None:
    sizes = np.array([typical_size_lhw(kind, v) for v in range(40)])
    low = {"bus": (9, 2.7, 2.4), "truck": (6, 2.6, 2.2), "van": (4.4, 1.75, 1.75)}.get(kind, (3.5, 1.35, 1.55))
    high = {"bus": (13.5, 3.5, 2.6), "truck": (11, 4, 2.6)}.get(kind, (5.8, 2.65, 2.1))
    assert (sizes >= low).all()
    assert (sizes <= high).all()
    assert sizes.std(axis=0).min() > 0


@pytest.mark.parametrize(("kind", "variant", "field"), [("tank", 0, "kind"), ("sedan", -1, "variant")])
def test_unknown_templates_are_refused(kind: str, variant: int, field: str) -> None:
    for function in (template, typical_size_lhw):
        with pytest.raises(RangeError, match=field):
            function(kind, variant)
