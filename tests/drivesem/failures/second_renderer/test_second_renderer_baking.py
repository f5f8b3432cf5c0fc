"""The second renderer's own geometry beside the project's; patches of an atlas; paint and light by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem.failures.second_renderer import shading
from drivesem.failures.second_renderer.baking import pack_patches
from drivesem.failures.second_renderer.geometry import BodyMesh, PictureCamera, VehiclePose
from scene_ir import ffd
from scene_ir.geometry import place_vertices, project
from scene_ir.types import WEATHER_DIM, Camera, SceneIR, Weather


def test_points_follow_the_conventions(street: Callable[..., SceneIR]) -> None:
    scene = street()
    chance = torch.Generator().manual_seed(3)
    bend = ffd.symmetrise(0.05 * torch.randn(len(scene.objects), 64, 3, generator=chance))
    scene = scene.with_objects(ffd=bend)
    matrix = torch.cat([scene.camera.intrinsics, torch.tensor([[45.0], [0.2], [0.003]])], dim=1)
    camera = Camera(scene.camera.intrinsics, scene.camera.height, scene.camera.width, matrix)
    lens, mesh = PictureCamera.from_camera(camera), scene.meshes[0]
    objects = scene.objects
    unit = ffd.deform(mesh.vertices, ffd.lattice_weights(mesh.vertices), objects.ffd)
    expected = project(place_vertices(unit, objects.size_lhw, objects.yaw, objects.translation), matrix)
    for i in range(len(objects)):
        found = lens.project(BodyMesh(mesh).place(VehiclePose.from_objects(objects, i), lens))
        np.testing.assert_allclose(found, expected[i][mesh.faces].numpy(), atol=2e-2)
        mirrored = lens.project(BodyMesh(mesh).place(VehiclePose.from_objects(objects, i), lens, mirrored=True))
        assert np.abs(mirrored - found).max() > 1


def test_boxes_are_cut_at_the_camera() -> None:
    lens = PictureCamera.from_camera(Camera(torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]), 80, 100))
    inside = np.array([[[-1, 0, 2], [1, 0, 2], [0, 1, 2]]], np.float32)
    np.testing.assert_allclose(lens.bounding_box(inside), [0, 40, 100, 90])
    through = np.array([[[0, 0, 2], [0, 1, 2], [0.1, 0, -2]]], np.float32)
    assert lens.bounding_box(through)[2] == pytest.approx(50 + 100 * 0.1 * (1.9 / 4) / 0.1, rel=1e-4)
    assert np.isnan(lens.bounding_box(-inside)).all()


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from([1, 2, 5, 24, 96]), st.sampled_from([1, 3, 64])), min_size=1
    )
)
@settings(max_examples=30, deadline=None)
def test_each_triangle_has_texels_of_its_own(triangles: list[tuple[int, int, int]]) -> None:
    corner = np.array([t[0] for t in triangles])
    layout = pack_patches(corner, np.array([t[1:] for t in triangles]))
    height, width = layout.size
    assert len(np.unique(layout.row * width + layout.column)) == len(layout.row)
    assert layout.row.max() < height
    assert layout.column.max() < width
    np.testing.assert_allclose(layout.weights.sum(axis=1), 1, atol=1e-5)
    # A corner's own texel is where its uv says.
    uv = layout.uv.reshape(-1, 3, 2)
    for face in range(len(triangles)):
        for k in range(3):
            texel = (
                (layout.face == face)
                & (layout.weights[:, k] > 1 - 1e-6)
                & (np.abs(layout.weights) < 1e-6).any(axis=1)
            )
            at = uv[face, k] * [width, height] - 0.5
            assert [round(at[0]), height - 1 - round(at[1])] in np.stack(
                [layout.column[texel], layout.row[texel]], axis=1
            ).tolist()


def texels(*rgb: float) -> np.ndarray:
    return np.full((1, 1, 3), rgb, np.float32)


ONE = np.ones((1, 1), np.float32)
BASE = np.array([0.3, 0.3, 0.3], np.float32)


def painted(code: list[float], rgb: np.ndarray, paint: float = 1.0) -> np.ndarray:
    return shading.apply_paint(rgb, np.array(code, np.float32), paint * ONE, 0 * ONE, BASE)


def test_paint_codes_have_their_effect() -> None:
    grey = texels(0.3, 0.3, 0.3)
    assert painted([0] * 5, grey) is grey
    assert (painted([0.5, 0, 0, 0, 0], grey) > grey).all()
    red, _, blue = painted([0, 0.6, 0, 0, 0], grey)[0, 0]
    assert red > blue
    red, _, blue = painted([0, 0, -0.6, 0, 0], grey)[0, 0]
    assert blue > red
    bright = texels(0.5, 0.5, 0.5)
    assert (painted([0, 0, 0, 0.5, 0], bright) > bright).all()
    np.testing.assert_allclose(
        painted([0, 0, 0, 0, 0.9], grey), grey + 0.55 * 0.9 * (texels(0.47, 0.42, 0.35) - grey), atol=0.01
    )
    half = painted([0.5, 0, 0, 0, 0], grey, 0.5)
    np.testing.assert_allclose(half, (grey + painted([0.5, 0, 0, 0, 0], grey)) / 2, atol=1e-4)


def test_clothes_below_the_waist_have_codes_of_their_own() -> None:
    column, height = (
        np.full((5, 1, 3), 0.3, np.float32),
        np.array([[0.9], [0.56], [0.53], [0.5], [0.1]], np.float32),
    )
    code = np.array([0, 0.5, 0, 0, 0, 0, -0.5, 0], np.float32)
    red, _, blue = np.moveaxis(shading.apply_paint(column, code, np.ones((5, 1), np.float32), height, BASE), 2, 0)
    redder = (red - blue)[:, 0]
    assert redder[0] == redder[1] > 0.05
    assert redder[3] == redder[4] < -0.05
    assert abs(redder[2]) < 0.02


def test_shadows_go_under_a_closed_sky() -> None:
    clear, closed = np.zeros(WEATHER_DIM, np.float32), np.eye(WEATHER_DIM, dtype=np.float32)[Weather.OVERCAST]
    assert shading.remaining_shade(clear) == 1
    assert shading.remaining_shade(closed) == pytest.approx(0.4)
