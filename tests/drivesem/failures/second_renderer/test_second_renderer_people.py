"""People in the second renderer, and which renderer a generated frame with people gets."""

import numpy as np
import pytest
import torch

from drivesem.failures.second_renderer.selection import SecondRenderers
from scene_ir.derender import upright
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR
from tests.drivesem.generated_people import derender_generated_people


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return derender_generated_people()


def test_both_renderers_draw_a_moved_person_alike(scene, screen):
    (row, *_) = scene.objects.upright.nonzero()[:, 0].tolist()
    renderer = SecondRenderers("kitti", None).renderer_for("generated", scene)
    assert renderer.name == "pyrender"
    translation = scene.objects.translation.clone()
    translation[row, 0] += 0.5
    moved = scene.with_objects(translation=translation)
    first, second = Compositor(scene).render(moved), renderer.render(moved)
    crop = first.opacity[row]
    h, w = crop.values.shape[1:]
    window = np.s_[:, crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]
    person = crop.values[0] > 0.9
    apart = (first.image[window] - second.image[window]).abs().mean(0)
    assert float(apart[person].mean()) < 0.06
    before = (scene.photograph[window] - second.image[window]).abs().mean(0)
    assert float(before[person].mean()) > 2 * float(apart[person].mean())


@pytest.mark.slow
def test_both_renderers_recolour_clothes_below_the_waist_alike(scene, screen):
    (row, *_) = scene.objects.upright.nonzero()[:, 0].tolist()
    scene = scene.with_objects(category=scene.objects.category.index_fill(0, torch.tensor([row]), 2))
    code = torch.zeros_like(scene.objects.texture_code)
    code[row, 5:] = torch.tensor([0.5, 0.5, 0.0])
    renderer = SecondRenderers("kitti", None).renderer_for("generated", scene)
    changes = []
    for render in (Compositor(scene).render, renderer.render):
        apart = render(scene.with_objects(texture_code=code)).image - render(scene).image
        changes.append(apart.abs().sum(dim=0))
    assert float(changes[0].sum()) == pytest.approx(float(changes[1].sum()), rel=0.3)
    tops = [int((change > 0.05).any(dim=1).nonzero()[0]) for change in changes]
    assert tops[0] == pytest.approx(tops[1], abs=2)
    other = scene.with_objects(category=scene.objects.category.index_fill(0, torch.tensor([row]), 3))
    riders = SecondRenderers("kitti", None).renderer_for("generated", other)
    assert torch.equal(riders.render(other.with_objects(texture_code=code)).image, riders.render(other).image)


def test_surfaces_get_the_outlines_of_their_mattes(scene):
    trimmed = upright.trim_to_mattes(scene)
    for row, flag in enumerate(scene.objects.upright.tolist()):
        index = int(scene.objects.mesh_index[row])
        assert (trimmed.meshes[index] is scene.meshes[index]) != flag
