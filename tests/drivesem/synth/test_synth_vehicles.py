"""Vehicles as triangles: details lie in the mesh's surface, and every instance has a shape of its own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from drivesem.synth.layout import Actor
from drivesem.synth.soup import Material
from drivesem.synth.vehicles import deformed, instance_ffd, vehicle, vehicle_mesh, vehicle_shape
from scene_ir import ffd
from scene_ir.types import LATTICE, LATTICE_POINTS

CAR = Actor("sedan", 3, (0.0, 10.0), 0.0, (4.5, 1.45, 1.78), (0.3, 0.02, 0.02), False, 77)
SIZE = np.array(CAR.size_lhw, np.float32)


def _areas(corners: np.ndarray) -> np.ndarray:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.linalg.norm(cross, axis=1) / 2


@pytest.mark.parametrize("kind", ["sedan", "van", "pickup", "bus", "truck"])
@pytest.mark.parametrize("fine", [False, True])
def test_details_lie_in_the_faces_of_the_mesh(kind: str, fine: bool) -> None:
    shape = vehicle_shape(kind, 5, fine)
    mesh = vehicle_mesh(kind, 5)
    assert np.array_equal(shape.vertices, mesh.vertices.numpy())
    assert shape.share.min() > -1e-5
    assert np.abs(shape.share.sum(axis=2) - 1).max() < 1e-5
    expected = shape.share @ shape.vertices[shape.faces][shape.parent]
    assert np.abs(shape.soup.corners - expected).max() < 1e-6
    # cut, not dropped: every face is still covered
    covered = np.bincount(shape.parent, _areas(shape.soup.corners * SIZE), len(shape.faces))
    whole = _areas(shape.vertices[shape.faces] * SIZE)
    assert np.abs(covered - whole).max() < 2e-5


def test_near_vehicles_have_plates_with_strokes_and_far_ones_do_not() -> None:
    near, far = vehicle_shape("hatchback", 2, fine=True), vehicle_shape("hatchback", 2, fine=False)
    assert len(far.soup) < 1.2 * len(far.faces)
    assert len(far.soup) < len(near.soup) < 3 * len(near.faces)
    assert len(set(near.soup.pattern[:, 3])) > 10
    assert set(far.soup.pattern[:, 3]) == {0, 255}
    for end in (1, -1):
        cells = near.soup.pattern[near.soup.corners[..., 0].mean(axis=1) * end > 0.3, 3]
        assert len(np.unique(cells)) > 20


def test_vehicles_of_one_mesh_differ_in_paint_and_number() -> None:
    one, two = vehicle(CAR), vehicle(replace(CAR, seed=78))
    paint = one.material == Material.PAINT
    assert np.median(one.albedo[paint], axis=0) == pytest.approx(CAR.paint, rel=1e-4)
    different = (one.albedo != two.albedo).any(axis=1)
    assert different.any()
    assert (one.pattern[different, 3] > 0).all()
    assert np.array_equal(one.albedo, vehicle(CAR).albedo)


def test_instance_ffd_is_symmetric_small_and_keeps_the_box() -> None:
    first = instance_ffd(CAR)
    assert first.shape == (LATTICE_POINTS, 3)
    assert np.array_equal(first, instance_ffd(CAR))
    assert not np.array_equal(first, instance_ffd(replace(CAR, seed=78)))
    for seed in range(40):
        offsets = instance_ffd(replace(CAR, seed=seed))
        assert np.abs(offsets).max() < 0.06
        grid = offsets.reshape(*LATTICE, 3)
        assert np.abs(grid - grid[:, :, ::-1] * [1, 1, -1]).max() < 1e-6
        # the ends, the roof and the ground stay, the width over the mirrors changes by next to nothing
        assert np.abs(grid[[0, 3], ..., 0]).max() == 0
        assert np.abs(grid[:, [0, 3], :, 1]).max() == 0
        soup = deformed(vehicle_shape("sedan", 3, fine=False), offsets)
        low, high = soup.corners.reshape(-1, 3).min(axis=0), soup.corners.reshape(-1, 3).max(axis=0)
        assert low == pytest.approx([-0.5, -1.0, -0.5], abs=0.006)
        assert high == pytest.approx([0.5, 0.0, 0.5], abs=0.006)
        slope = ffd.jacobian(vehicle_mesh("sedan", 3).vertices, torch.from_numpy(offsets))
        assert float(torch.linalg.det(slope).min()) > 0.7


def test_a_bent_vehicle_is_its_bent_mesh() -> None:
    shape = vehicle_shape("sedan", 3, fine=True)
    offsets = instance_ffd(CAR)
    soup = vehicle(replace(CAR, ffd=tuple(float(v) for v in offsets.reshape(-1))))
    mesh = vehicle_mesh("sedan", 3)
    bent = ffd.deform(mesh.vertices, ffd.lattice_weights(mesh.vertices), torch.from_numpy(offsets)).numpy()
    expected = shape.share @ bent[shape.faces][shape.parent]
    assert np.abs(soup.corners - expected).max() < 1e-6
    assert np.abs(soup.corners - shape.soup.corners).max() > 0.005
    still = deformed(shape, np.zeros((LATTICE_POINTS, 3), np.float32))
    assert np.abs(still.corners - shape.soup.corners).max() < 1e-6
    assert np.abs(still.normals - shape.soup.normals).max() < 1e-3


def test_normals_point_out_of_the_bent_surface() -> None:
    offsets = instance_ffd(replace(CAR, seed=5))
    soup = deformed(vehicle_shape("suv", 1, fine=False), offsets)
    flat = np.cross(soup.corners[:, 1] - soup.corners[:, 0], soup.corners[:, 2] - soup.corners[:, 0])
    large = np.linalg.norm(flat, axis=1) > 1e-4
    inside = np.einsum("fi,fki->fk", flat, soup.normals)[large]
    assert (np.sign(inside).mean(axis=1) == np.sign(inside[:, 0])).mean() > 0.99
    assert np.sign(inside).mean() > 0.98
