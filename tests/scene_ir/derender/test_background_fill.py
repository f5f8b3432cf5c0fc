"""The street behind vehicles at a part of the photograph's size: the same street; nothing changes elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_ir.derender import segmentation as segment
from scene_ir.derender.background_fill import BackgroundFill, BackgroundInputs
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.derender.silhouette import grow_mask
from scene_ir.render.compositor import Compositor
from scene_ir.types import Camera


def surroundings(street) -> BackgroundInputs:
    height, width = street.mask.shape
    rows = np.arange(height)[:, None]
    ground = np.broadcast_to(rows > 100, (height, width)).astype(np.float32)
    nothing = np.zeros_like(ground)
    maps = dict.fromkeys(("sky", "foliage", "vehicle", "person"), nothing)
    seen = segment.Segmentation(**maps, road=ground, ground=ground)
    plane = torch.tensor([0.0, -1.0, 0.0, 1.65])
    nowhere = np.zeros_like(street.mask)
    return BackgroundInputs(88.0, plane, street.frame.camera, nowhere, nowhere, nothing, seen)


def photograph(street) -> np.ndarray:
    return np.ascontiguousarray(street.frame.photograph.permute(1, 2, 0).numpy())


@pytest.mark.parametrize("shrink", [2, 3, 4])
def test_a_smaller_camera_sees_the_same(street, shrink: int) -> None:
    around = surroundings(street)
    smaller = around.scaled_down(shrink)
    points = torch.tensor([[1.0, 1.6, 8.0, 1.0], [-3.0, 0.5, 20.0, 1.0]])
    pixels = []
    for camera in (around.camera, smaller.camera):
        clip = points @ camera.matrix.T
        # where pixels' edges are whole numbers, sizes are shares of the image's
        pixels.append((clip[:, :2] / clip[:, 2:] + 0.5) / torch.tensor([camera.width, camera.height]))
    torch.testing.assert_close(pixels[0], pixels[1])
    assert smaller.excluded.shape == smaller.maps.ground.shape == (smaller.camera.height, smaller.camera.width)
    assert smaller.horizon == pytest.approx((88.0 + 0.5) * smaller.camera.height / around.camera.height - 0.5)


@pytest.mark.parametrize("shrink", [1, 2])
def test_only_the_hole_is_filled_and_from_the_street(street, shrink: int) -> None:
    image, hole = photograph(street), grow_mask(street.mask, 3)
    behind = BackgroundFill(image, np.full(hole.shape, 9.0, np.float32), surroundings(street), shrink)
    for found in (behind.fill_hole(hole, 0), behind.continue_street(hole)):
        assert np.array_equal(found[~hole], image[~hole])
        assert found.dtype == np.float32
        assert 0 <= found.min() <= found.max() <= 1
    apart = np.abs(behind.fill_hole(hole, 0) - street.background)[hole].mean()
    assert apart < 0.5 * np.abs(image - street.background)[hole].mean()
    assert np.array_equal(behind.fill_hole(hole, 0), behind.fill_hole(hole, 0))


@pytest.mark.parametrize("known_as", ["segmented", "labelled", "filled later"])
@pytest.mark.parametrize("tall", [60, 150])
def test_behind_a_person_what_is_near_goes_on_and_nobody_is_copied(street, tall: int, known_as: str) -> None:
    around, shape = surroundings(street), street.mask.shape
    stripes = np.broadcast_to((np.arange(shape[0]) // 8 % 2)[:, None, None], (*shape, 3))
    wall = (0.3 + 0.4 * stripes).astype(np.float32)
    person, other = np.zeros(shape, bool), np.zeros(shape, np.float32)
    person[10 : 10 + tall, 200 : 200 + tall // 3] = True
    other[10 : 10 + tall, 200 + tall // 3 : 260 + tall // 3] = 1  # next to each other
    image = np.where(person[..., None], (0.9, 0.1, 0.1), wall)
    image = np.where(other[..., None] > 0, (0.1, 0.9, 0.1), image).astype(np.float32)
    nobody = np.zeros(shape, bool)
    inputs, later = {
        "segmented": (replace(around, maps=replace(around.maps, person=other)), nobody),
        "labelled": (replace(around, people=other > 0), nobody),
        "filled later": (around, other > 0),
    }[known_as]
    behind = BackgroundFill(image, np.full(shape, 9.0, np.float32), inputs)
    found = behind.fill_thin(image, person, later)
    assert np.array_equal(found[~person], image[~person])
    assert np.array_equal(found, behind.fill_thin(image, person, later)), "the same again"
    flat = np.abs(wall.mean() - wall)[person].mean()
    assert np.abs(found - wall)[person].mean() < 0.6 * flat
    assert np.ptp(found[person], axis=1).max() < 0.1, "grey, as the wall"


def test_a_crowd_has_no_known_parts_to_copy(street) -> None:
    around, shape = surroundings(street), street.mask.shape
    person = np.zeros(shape, bool)
    person[10:70, 200:220] = True
    inputs = replace(around, people=np.ones(shape, bool))
    image = np.full((*shape, 3), 0.5, np.float32)
    behind = BackgroundFill(image, np.full(shape, 9.0, np.float32), inputs)
    assert np.array_equal(behind.fill_thin(image, person, np.zeros(shape, bool)), image)


def test_one_is_the_photographs_own_size(street) -> None:
    around = surroundings(street).scaled_down(1)
    assert isinstance(around.camera, Camera)
    torch.testing.assert_close(around.camera.matrix, street.frame.camera.matrix)
    assert np.array_equal(around.maps.ground, surroundings(street).maps.ground)


def test_fast_scenes_render_the_photograph(street) -> None:
    scene = derender(street.frame, DerenderSettings.fast())
    with torch.no_grad():
        again = Compositor(scene).render(scene).image
    assert (again - street.frame.photograph).square().mean() < 1e-6
    other = derender(street.frame, replace(DerenderSettings.fast(), shrink=1))
    assert not torch.equal(scene.background, other.background)
