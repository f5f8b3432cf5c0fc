"""The ego vehicle in a photograph: nothing there changes, and it hides what is behind it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from drivesem.attacks.labels import Labeller, hidden_shares
from scene_ir import io
from scene_ir.derender import ego
from scene_ir.derender.derender import derender, place_vehicles
from scene_ir.raster.verbs import Backend
from scene_ir.render.compositor import Compositor, RenderSettings
from scene_ir.render.model import EGO_DARKENED
from scene_ir.types import Frame, SceneIR, Weather

KITTI = Path(__file__).parents[4] / "shared" / "data" / "kitti" / "training" / "image_2"
EDGE = 126
"""Row of the bonnet's highest pixels: it hides the lower part of the car, which reaches row 147."""


def bonnet_mask(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width]
    return v >= EDGE + 8 * ((u - width / 2) / (width / 2)) ** 2


@pytest.fixture(scope="module")
def frame(street) -> Frame:
    """The street behind a blue bonnet, which the frame's classes name."""
    mask = torch.from_numpy(bonnet_mask(*street.mask.shape))
    paint = torch.tensor([30.0, 50.0, 110.0])[:, None] / 255
    photograph = street.frame.photograph.clone()
    photograph[:, mask] = paint
    return replace(street.frame, photograph=photograph, classes=mask.long(), class_names=("other", "Ego Vehicle"))


@pytest.fixture(scope="module")
def scene(frame) -> SceneIR:
    return derender(frame)


def solid(scene: SceneIR) -> torch.Tensor:
    assert scene.environment.ego is not None
    return scene.environment.ego == 1


def test_its_mask_is_in_the_scene(frame, scene):
    mask = frame.classes == 1
    assert float(((scene.environment.ego > 0.5) != mask).sum()) < 0.02 * float(mask.sum())
    assert float(solid(scene).sum()) > 0.97 * float(mask.sum())
    for name in ("sky", "foliage_map", "road"):
        assert float(getattr(scene.environment, name)[solid(scene)].abs().max()) == 0
    assert torch.equal(scene.background[:, solid(scene)], frame.photograph[:, solid(scene)])


def test_the_unperturbed_render_is_the_photograph(frame, scene):
    difference = (Compositor(scene).render(scene).image - frame.photograph).abs()
    assert float(difference.max()) < 1e-3
    assert float(difference[:, solid(scene)].max()) == 0


@pytest.mark.parametrize("backend", ["warp", "reference"])
@pytest.mark.parametrize("code", [Weather.FOG, Weather.RAIN, Weather.TIME])
def test_no_code_but_night_changes_it(scene, code, backend: Backend):
    weather = torch.zeros(len(Weather))
    weather[code] = 1.0
    near = scene.objects.translation - torch.tensor([0.0, 0.0, 3.0])
    objects = replace(scene.objects, translation=near, texture_code=scene.objects.texture_code + 0.5)
    changed = replace(
        scene, objects=objects, environment=replace(scene.environment, weather=weather, foliage=torch.ones(3))
    )
    image = Compositor(scene, RenderSettings(backend)).render(changed).image
    assert torch.equal(image[:, solid(scene)], scene.photograph[:, solid(scene)])
    assert float((image - scene.photograph)[:, ~solid(scene)].abs().mean()) > 0.02


@pytest.mark.parametrize("backend", ["warp", "reference"])
def test_it_is_dark_by_night(scene, backend: Backend):
    weather = torch.eye(len(Weather))[Weather.NIGHT]
    compositor = Compositor(scene, RenderSettings(backend))
    image = compositor.render(scene.with_environment(weather=weather)).image
    left = 1 - EGO_DARKENED * compositor.night_maps.by_day
    assert left < 0.5
    torch.testing.assert_close(image[:, solid(scene)], left * scene.photograph[:, solid(scene)])


@pytest.mark.parametrize("backend", ["warp", "reference"])
def test_it_has_no_gradient_but_to_night(scene, backend: Backend):
    weather = torch.full((len(Weather),), 0.3, requires_grad=True)
    translation = (scene.objects.translation - torch.tensor([0.0, 0.0, 2.0])).requires_grad_()
    changed = scene.with_objects(translation=translation).with_environment(weather=weather)
    image = Compositor(scene, RenderSettings(backend)).render(changed).image
    inside = torch.autograd.grad(image[:, solid(scene)].sum(), (weather, translation), retain_graph=True)
    assert [code for code in Weather if inside[0][code] != 0] == [Weather.NIGHT]
    assert float(inside[1].abs().max()) == 0
    outside = torch.autograd.grad(image.sum(), (weather, translation))
    assert all(float(part.abs().max()) > 0 for part in outside)


def test_no_vehicle_is_cut_out_through_it(scene):
    crop = scene.objects.source[0].foreground
    h, w = crop.values.shape[1:]
    where = slice(crop.y0, crop.y0 + h), slice(crop.x0, crop.x0 + w)
    own = Compositor(scene).render(scene).object_id[where] == 1
    assert bool(own.any())
    assert not bool((own & solid(scene)[where]).any())


def test_it_hides_what_is_behind(scene):
    base = Compositor(scene).render(scene)
    before = float(hidden_shares(base)[0])
    assert 0.2 < before < 0.7
    nearer = scene.with_objects(translation=scene.objects.translation - torch.tensor([0.0, 0.0, 3.0]))
    render = Compositor(scene).render(nearer)
    assert float(hidden_shares(render)[0]) > before + 0.1
    labels = Labeller(scene, base).moved(nearer, render)
    assert int(labels.occlusion[0]) > int(scene.objects.occlusion[0])


def test_detections_in_it_do_not_count(scene):
    x0, y0, x1, y1 = scene.ignore[0].tolist()
    height, width = scene.depth.shape
    assert (x0, x1, y1) == (0, width - 1, height - 1)
    assert EDGE <= y0 < EDGE + 8
    assert len(scene.ignore) == 1


def test_a_box_in_it_becomes_no_vehicle(frame):
    box = torch.tensor([[200.0, EDGE - 5.0, 300.0, EDGE + 40.0]])
    mistaken = replace(frame, labels=replace(frame.labels, boxes_xyxy=box))
    assert len(derender(mistaken).objects) == 0
    assert place_vehicles(mistaken) == {}


def test_it_survives_saving(scene, tmp_path):
    io.save_scene(scene, tmp_path / "scene")
    assert torch.equal(io.load_scene(tmp_path / "scene").environment.ego, scene.environment.ego)
    io.save_scene(scene, tmp_path / "lossy", lossy=True)
    lossy = io.load_scene(tmp_path / "lossy").environment.ego
    assert lossy is not None
    assert torch.equal(lossy == 1, scene.environment.ego > 1 - 0.5 / 31)


def test_parts_that_reach_no_border_specks_and_unsure_parts_are_dropped():
    mask = np.zeros((100, 200), bool)
    mask[80:], mask[:3, :5], mask[30:50, 60:90], mask[:60, 180:] = True, True, True, True
    mask[90:93, 100:104] = False
    sure = mask.copy()
    sure[:, 175:] = False
    kept = ego._keep_border_parts(mask, sure)
    assert kept[80:].all()
    assert not kept[:80].any()


def test_regions_follow_the_parts():
    mask = np.zeros((100, 200), bool)
    mask[80:] = True
    mask[70:80, :60] = True
    mask[:50, 180:] = True
    boxes = sorted(ego.ignored_regions(mask).tolist())
    assert boxes == [[0, 80, 199, 99], [180, 0, 199, 49]]
    assert ego.ignored_regions(np.zeros((4, 4), bool)).shape == (0, 4)


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti")
def test_kitti_shows_none():
    names = sorted(KITTI.glob("*.png"))
    assert names
    pictures = {path.name: cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255 for path in names}
    assert [name for name, picture in pictures.items() if ego.find_ego_vehicle(picture) is not None] == []


def test_an_empty_picture_shows_none():
    for level in (0.0, 0.5, 1.0):
        assert ego.find_ego_vehicle(np.full((90, 160, 3), level, np.float32)) is None
