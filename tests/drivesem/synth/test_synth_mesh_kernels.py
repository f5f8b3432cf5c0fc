"""What kernels do to triangles, against plain numpy or by property."""

from dataclasses import fields

import numpy as np
import pytest

from drivesem.synth import mesh_kernels
from drivesem.synth.render import pixel_sums
from drivesem.synth.soup import Material, Soup, ball, balls, box, compact, creased_normals, join, transformed
from drivesem.synth.vehicles import vehicle_mesh
from drivesem.synth.view import blocks
from scene_ir.meshes.templates import typical_size_lhw


def _areas(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


@pytest.mark.parametrize("planes", [0, 1, 5, 40])
def test_cut_triangles_cover_their_faces_and_cross_no_plane(planes: int) -> None:
    rng = np.random.default_rng(planes)
    corners = rng.normal(0, 1, (6, 3, 3)).astype(np.float32)
    parent = np.array([4, 0, 0, 5])
    share = np.broadcast_to(np.eye(3, dtype=np.float32), (4, 3, 3))
    normals = rng.normal(0, 1, (planes, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    table = np.concatenate([normals, rng.normal(0, 0.3, (planes, 1))], axis=1)
    source, pieces = mesh_kernels.cut(corners, parent, share, table)
    assert (np.diff(source) >= 0).all()
    assert pieces.min() > -1e-5
    assert np.abs(pieces.sum(axis=2) - 1).max() < 1e-5
    found = np.matmul(pieces, corners[parent][source])
    assert np.bincount(source, _areas(found)) == pytest.approx(_areas(corners[parent]), rel=1e-3)
    for normal, offset in zip(table[:, :3], table[:, 3], strict=True):
        side = found @ normal - offset
        assert np.minimum(side.max(axis=1), -side.min(axis=1)).max() < 2.5e-4
    if planes == 40:
        assert len(source) > 4 * (8 + 8 * planes)  # more than the first guess of their number has room for


def test_no_triangles_are_cut_into_none() -> None:
    source, pieces = mesh_kernels.cut(
        np.zeros((1, 3, 3)), np.zeros(0, int), np.zeros((0, 3, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])
    )
    assert source.shape == (0,)
    assert pieces.shape == (0, 3, 3)


@pytest.mark.parametrize("kind", ["sedan", "truck"])
def test_creased_normals_are_those_of_loose_triangles(kind: str) -> None:
    mesh = vehicle_mesh(kind, 1)
    vertices = mesh.vertices.numpy() * np.array(typical_size_lhw(kind, 1), np.float32)
    faces = mesh.faces.numpy()
    expected = creased_normals(vertices[faces])
    found = mesh_kernels.creased_normals(vertices, faces)
    # an angle at the very crease may fall to either side
    assert (np.abs(found - expected).max(axis=(1, 2)) > 1e-4).mean() < 0.002


def test_leaves_stand_around_their_blobs_and_not_inside() -> None:
    rng = np.random.default_rng(3)
    centres, radii = rng.normal(0, 0.5, (5, 3)), rng.uniform(0.3, 0.6, (5, 3))
    blob, direction, depth = rng.integers(5, size=400), rng.normal(0, 1, (400, 3)), rng.uniform(0.8, 1.3, 400)
    rows, points, outward, light = mesh_kernels.crown((centres, radii), blob, direction, depth)
    towards = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    places = centres[blob] + towards * radii[blob] * depth[:, None]
    inside = (((places[:, None] - centres) / radii) ** 2).sum(axis=2).min(axis=1) < 0.6
    assert 0 < inside.sum() < 400
    assert np.array_equal(rows, np.flatnonzero(~inside))
    assert np.abs(points - places[rows]).max() < 1e-5
    assert np.linalg.norm(outward, axis=1) == pytest.approx(np.ones(len(rows)), abs=1e-5)
    assert ((outward * towards[rows]).sum(axis=1) > 0).mean() > 0.95
    upper = light[(towards[rows, 1] < -0.5)].mean()
    assert upper > light[(towards[rows, 1] > 0.5)].mean() + 0.1
    reach = rng.uniform(0.1, 0.2, len(rows))
    draws = rng.normal(0, 1, (len(rows), 3)), rng.normal(0, 1, (len(rows), 3)), reach
    corners, normals = mesh_kernels.leaves(points, outward, draws)
    assert np.linalg.norm(corners[:, 0] - points, axis=1) == pytest.approx(reach, rel=1e-3)
    slender = _areas(corners) / reach**2
    assert slender == pytest.approx(np.full(len(rows), slender.mean()), rel=1e-3)
    facing = draws[0] * 0.55 + outward
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    assert np.abs(((corners[:, 1] - corners[:, 0]) * facing).sum(axis=1)).max() < 1e-5
    shade = 0.85 * outward + 0.35 * facing
    assert np.abs(normals[:, 2] - shade / np.linalg.norm(shade, axis=1, keepdims=True)).max() < 1e-5


def test_transformed_and_compact_soups_are_the_same_triangles() -> None:
    soup = join([box((1.0, 2.0, 3.0), Material.FLAT, (0.1, 0.2, 0.3))] * 2000)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(0, 1, (3, 3)))
    found = transformed(soup, turn, np.array([1.0, -2.0, 30.0]))
    assert np.abs(found.corners - (soup.corners @ turn.T + [1.0, -2.0, 30.0])).max() < 1e-4
    assert np.abs(found.normals - soup.normals @ turn.T).max() < 1e-6
    small = compact(soup)
    for f in fields(Soup):
        assert np.array_equal(getattr(small, f.name), getattr(soup, f.name))
        assert getattr(small, f.name).dtype == getattr(soup, f.name).dtype
    assert small.pattern.strides == (0, 0)


def test_balls_are_balls() -> None:
    centres, radii = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]), np.array([[1.0, 2.0, 3.0], [0.5, 0.5, 0.25]])
    several = balls(centres, radii, Material.LEAF, (0.1, 0.2, 0.3))
    single = join([ball(c, r, Material.LEAF, (0.1, 0.2, 0.3)) for c, r in zip(centres, radii, strict=True)])
    assert np.array_equal(several.corners, single.corners)
    on = ((several.corners[: len(several) // 2] - centres[0]) / radii[0]) ** 2
    assert on.sum(axis=2) == pytest.approx(np.ones(on.shape[:2]), abs=1e-5)


def test_pixel_sums_add_the_samples_of_each_pixel() -> None:
    samples = np.random.default_rng(1).integers(0, 60, (6, 10), np.uint8)
    assert np.array_equal(pixel_sums(samples), sum(blocks(samples)))
