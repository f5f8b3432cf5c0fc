"""The embedded scenes: exact, varied, and made of nothing that training scenes are made of."""

import pytest
import torch

from drivesem.synth.demo import demo_scene
from scene_ir.errors import RangeError
from scene_ir.render.compositor import render
from scene_ir.types import Category, SceneIR


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


def test_an_unperturbed_render_is_the_photograph(scene):
    found = render([scene])[0].image
    assert (found - scene.photograph).abs().max() < 1e-5


def test_photograph_and_background_are_eight_bit(scene):
    for picture in (scene.photograph, scene.background):
        assert ((picture * 255).round() / 255 - picture).abs().max() < 1e-6


def test_the_mix_of_vehicles(scene):
    objects = scene.objects
    assert 6 <= len(objects) <= 10
    assert (objects.category == int(Category.TRUCK)).sum() <= 1
    height = objects.box2d[:, 3] - objects.box2d[:, 1]
    clear = (objects.category == int(Category.CAR)) & (height >= 30) & (objects.occlusion <= 1)
    assert clear.sum() >= 4


def test_vehicles_stand_on_the_ground_plane(scene):
    plane = scene.environment.ground
    assert (scene.objects.translation @ plane[:3] + plane[3]).abs().max() < 1e-4


def test_the_background_shows_no_vehicle_and_differs_where_vehicles_are(scene):
    difference = (scene.photograph - scene.background).abs().amax(dim=0)
    for box in scene.objects.box2d.round().long().tolist():
        x0, y0, x1, y1 = box
        assert difference[y0 : y1 + 1, x0 : x1 + 1].gt(0.02).float().mean() > 0.3
    assert difference[:60].max() == 0


def test_shapes_are_of_the_held_out_pools(scene):
    assert all(int(mesh.name.split("-")[1]) >= 100 for mesh in scene.meshes)
    for kind in ("building", "tree", "bush", "surface"):
        ids = [int(i) for i in scene.provenance[kind].strip("[]").split(",") if i.strip()]
        assert all(i >= 10_000 for i in ids)


def test_moving_a_car_moves_pixels_and_keeps_values_in_range(scene):
    moved = scene.with_objects(translation=scene.objects.translation + torch.tensor([0.5, 0.0, 0.5]))
    image = render([moved])[0].image
    assert (image - scene.photograph).abs().max() > 0.1
    assert image.min() >= -1e-4
    assert image.max() <= 1 + 1e-4


def test_bad_requests_are_errors():
    with pytest.raises(RangeError, match="demo scene: expected an index of at least 0, found -1"):
        demo_scene(0, -1)


@pytest.mark.slow
def test_the_first_ten_scenes_are_different_streets():
    scenes = [demo_scene(0, index) for index in range(10)]
    assert len({scene.provenance["road"] for scene in scenes}) >= 3
    assert len({float(scene.photograph.sum()) for scene in scenes}) == 10
