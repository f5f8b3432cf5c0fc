"""Second renderers show the same object at the same place in nearly the same colours."""

import numpy as np
import pytest
import torch

from drivesem.classify import second_renderer
from drivesem.classify.objects.embedded import EmbeddedObjects
from drivesem.classify.results import RendererAgreement
from drivesem.classify.scenes import DRAWN_PX, VIEWS, ObjectScene, generate_background, picture_camera
from drivesem.classify.second_renderer import PosedObject, measure_agreement, open_second_renderer
from drivesem.classify.space import ObjectChange
from drivesem.failures.second_renderer.base import NoSecondRendererError
from tests.drivesem.classify.conftest import make_model

GREY = torch.full((3, DRAWN_PX, DRAWN_PX), 0.4)
CHANGE = ObjectChange(
    offsets=None, angles=torch.tensor([0.3, 0.5, -0.2]), light=torch.tensor([-0.3, 0.4, -0.6, 0.2, 0.1])
)
MOST_COLOUR = {"mitsuba": 15.0, "pyrender": 8.0}
"""Mean Delta E of an object: Mitsuba's surfaces shade each other, which the other renderers do not compute."""


@pytest.fixture(params=MOST_COLOUR)
def renderer(request):
    try:
        return open_second_renderer(request.param)
    except NoSecondRendererError as error:
        pytest.skip(str(error))


def both(renderer, scene, change=None):
    with torch.no_grad():
        own = scene.mesh.render(scene.camera_vertices(change), picture_camera(), scene.lights(change))
    return own, renderer.render(PosedObject.from_scene(scene, change))


@pytest.mark.parametrize("change", [None, CHANGE], ids=["still", "changed"])
@pytest.mark.parametrize("kind", ["box", "ball"])
def test_the_same_place_and_the_same_light(renderer, kind, change):
    """Nothing shades a convex object but itself: all renderers add up the same lamp, sky and gloss."""
    scene = ObjectScene(kind, make_model(kind), "left", GREY)
    own, other = both(renderer, scene, change)
    assert other.shape == own.shape
    assert float(other.min()) >= 0
    assert float(other.max()) <= 1
    alike = measure_agreement(scene, own, other)
    assert alike.iou >= 0.995
    assert alike.colour <= 4.0


def test_a_lamp_that_moves_lights_the_other_side(renderer):
    scene = ObjectScene("ball", make_model("ball"), "forward", GREY)
    sides = []
    for x in (-1.0, 1.0):
        drawn = renderer.render(
            PosedObject.from_scene(scene, ObjectChange(light=torch.tensor([0, 0, 3 * x, 0.8, -0.2])))
        )
        left, right = (drawn[:3, 256, column].mean() for column in (176, 336))
        sides.append(float(right - left))
    assert sides[0] < -0.05
    assert sides[1] > 0.05


@pytest.mark.slow
def test_two_renderers_agree_on_24_views(renderer):
    objects, found = EmbeddedObjects(), []
    for place, kind in enumerate(objects.classes):
        for number, view in enumerate(list(VIEWS)[place % 2 :: 2]):
            name = f"{kind}/{80 + number:04d}"
            scene = ObjectScene(name, objects.load(name), view, generate_background(name))
            found.append(measure_agreement(scene, *both(renderer, scene)))
    assert len(found) == 24
    assert min(one.iou for one in found) >= 0.98
    assert max(one.colour for one in found) <= MOST_COLOUR[renderer.name]


def test_likeness_by_hand():
    scene = ObjectScene("box", make_model("box"), "forward", GREY)
    one = torch.zeros(4, DRAWN_PX, DRAWN_PX)
    one[:, 100:300, 100:300] = 1.0
    assert measure_agreement(scene, one, one) == RendererAgreement(1.0, 0.0)
    other = one.clone()
    other[:, 200:300] = 0.0
    other[:3] = 0.0
    black = measure_agreement(scene, one, other)
    assert black.iou == 0.5
    assert black.colour == pytest.approx(100.0, abs=0.1)  # black from white


def test_faces_and_normals_face_the_camera():
    scene = ObjectScene("box", make_model("box"), "right", GREY)
    solid = PosedObject.from_scene(scene)
    corners = solid.points.reshape(-1, 3, 3)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (across * corners.mean(axis=1)).sum(axis=1).max() < 0
    normals = solid.normals.reshape(-1, 3, 3)
    assert np.einsum("fk,fck->fc", across, normals).min() > 0


def test_a_missing_renderer(monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    second_renderer._load_mitsuba.cache_clear()
    monkeypatch.setattr(second_renderer.importlib, "import_module", missing)
    with pytest.raises(NoSecondRendererError, match=r"mitsuba: .*drivesem\[mitsuba\]"):
        open_second_renderer("mitsuba")
    second_renderer._load_mitsuba.cache_clear()
