"""The scenes that benchmarks measure on: as many cars and triangles as they say, and exact at theta0."""

import numpy as np
import pytest
import torch

from drivesem.bench.scenes import (
    HEIGHT,
    KITTI_BOX_PIXELS,
    WIDTH,
    PackedMeshes,
    build_bench_scene,
    set_triangle_count,
)
from scene_ir.errors import RangeError
from scene_ir.meshes.templates import template
from scene_ir.render.compositor import Compositor
from scene_ir.types import Mesh


@pytest.mark.parametrize("triangles", [2000, 5000])
def test_a_mesh_gets_its_number_of_triangles_and_stays_closed(triangles: int) -> None:
    mesh = set_triangle_count(template("sedan", 100), triangles)
    assert mesh.faces.shape[0] == triangles
    places = np.unique(mesh.vertices.numpy(), axis=0, return_inverse=True)[1].reshape(-1)
    corners = places[mesh.faces.numpy()]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()


def test_splitting_leaves_the_surface_as_it_is() -> None:
    mesh = template("sedan", 100)
    fine = set_triangle_count(mesh, 5000)

    def area_by_part(one: Mesh) -> torch.Tensor:
        corner = one.vertices[one.faces].double()
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=1) / 2
        return torch.zeros(8, dtype=torch.float64).index_add(0, one.part, area)

    assert fine.faces.shape[0] > mesh.faces.shape[0]
    assert torch.allclose(area_by_part(fine), area_by_part(mesh), rtol=1e-6)


def test_too_few_triangles() -> None:
    with pytest.raises(RangeError, match="triangles"):
        set_triangle_count(template("sedan", 100), 3)


def test_scene_has_the_stated_counts_and_renders_its_photograph() -> None:
    bench = build_bench_scene(4, 2000)
    scene = bench.scene
    assert (scene.camera.height, scene.camera.width) == (HEIGHT, WIDTH)
    assert len(scene.objects) == bench.cars == 4
    assert bench.triangles_actual == bench.triangles == 2000
    placed = PackedMeshes.from_scene(scene)
    assert placed.faces.shape[0] == 8000
    assert placed.face_ranges.tolist() == [[2000 * i, 2000 * (i + 1)] for i in range(4)]
    assert 0.5 * KITTI_BOX_PIXELS[4] < bench.box_pixels < 2 * KITTI_BOX_PIXELS[4]
    assert bench.hit_pixels < bench.crop_pixels < 2 * bench.hit_pixels
    with torch.no_grad():
        assert float((Compositor(scene).render(scene).image - scene.photograph).abs().max()) < 1e-5


def test_half_the_scale_is_the_same_view_on_a_quarter_of_the_pixels() -> None:
    whole, half = build_bench_scene(1, 2000), build_bench_scene(1, 2000, scale=0.5)
    assert half.scene.camera.width == WIDTH // 2
    assert half.hit_pixels == pytest.approx(whole.hit_pixels / 4, rel=0.05)
    assert torch.equal(half.scene.objects.translation, whole.scene.objects.translation)


@pytest.mark.parametrize("cars", [0, 17])
def test_more_cars_than_there_is_room_for(cars: int) -> None:
    with pytest.raises(RangeError, match="cars"):
        build_bench_scene(cars, 2000)
