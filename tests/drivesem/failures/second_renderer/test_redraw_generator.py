"""The generator as a second renderer, on an embedded scene: pictures, labels, and vehicles without counterpart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from drivesem.failures.second_renderer.generator import DemoPlans, GeneratorRenderer, PlanMatch
from drivesem.synth.demo import demo_scene
from scene_ir.errors import FormatError
from scene_ir.geometry import project
from scene_ir.types import SceneIR

AHEAD_M = 0.5


class FirstUnknown(DemoPlans):
    """Plans that have no counterpart of a scene's first object."""

    def find_plan(self, identifier: str, scene: SceneIR) -> PlanMatch:
        found = super().find_plan(identifier, scene)
        return replace(found, tracks=(None, *found.tracks[1:]))


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


@pytest.fixture(scope="module")
def generator(scene: SceneIR) -> GeneratorRenderer:
    return GeneratorRenderer("demo-000", scene, DemoPlans())


def moved(scene: SceneIR, index: int, x_m: float, z_m: float) -> SceneIR:
    way = torch.zeros_like(scene.objects.translation)
    way[index] = torch.tensor([x_m, 0.0, z_m])
    return scene.with_objects(translation=scene.objects.translation + way)


def clearest(scene: SceneIR) -> int:
    """The largest object that nothing hides."""
    boxes = scene.objects.box2d
    size = (boxes[:, 3] - boxes[:, 1]) * (scene.objects.occlusion == 0) * (scene.objects.truncation == 0)
    return int(size.argmax())


def centre(boxes_xyxy: Tensor) -> Tensor:
    return (boxes_xyxy[..., :2] + boxes_xyxy[..., 2:]) / 2


def test_the_unchanged_scene_is_the_photograph(scene: SceneIR, generator: GeneratorRenderer) -> None:
    drawn = generator.render(scene)
    torch.testing.assert_close(drawn.image, scene.photograph, rtol=0, atol=1e-6)
    count = len(scene.objects)
    torch.testing.assert_close(drawn.targets.boxes_xyxy[:count], scene.objects.box2d)
    assert drawn.targets.labels[:count].tolist() == scene.objects.category.tolist()
    assert drawn.targets.ignore[count:].all()
    assert not drawn.targets.ignore[clearest(scene)]


def test_what_shows_lies_in_the_label_and_fills_it_where_nothing_hides(
    scene: SceneIR, generator: GeneratorRenderer
) -> None:
    drawn = generator.render(scene)
    shown, labels = drawn.visible_xyxy, drawn.targets.boxes_xyxy[: len(scene.objects)]
    assert (shown[:, :2] >= labels[:, :2] - 1e-4).all()
    assert (shown[:, 2:] <= labels[:, 2:] + 1e-4).all()
    torch.testing.assert_close(shown[clearest(scene)], labels[clearest(scene)], atol=1.0, rtol=0)


def test_labels_and_pixels_go_with_a_moved_car(scene: SceneIR, generator: GeneratorRenderer) -> None:
    index = clearest(scene)
    changed = moved(scene, index, AHEAD_M, 0.0)
    drawn, still = generator.render(changed), generator.render(scene)
    middles = (s.objects.translation[index] for s in (scene, changed))
    before, after = (project(middle, scene.camera.matrix) for middle in middles)
    way = centre(drawn.targets.boxes_xyxy[index]) - centre(still.targets.boxes_xyxy[index])
    assert float(way[0]) == pytest.approx(float(after[0] - before[0]), abs=2.0)
    torch.testing.assert_close(drawn.visible_xyxy[index], drawn.targets.boxes_xyxy[index], atol=1.0, rtol=0)
    others = [i for i in range(len(scene.objects)) if i != index]
    torch.testing.assert_close(drawn.targets.boxes_xyxy[others], still.targets.boxes_xyxy[others])
    assert not torch.equal(drawn.image, still.image)


def test_drawing_again_gives_the_same_bytes(scene: SceneIR, generator: GeneratorRenderer) -> None:
    """What is kept from one state to the next leaves no trace."""
    index = clearest(scene)
    leaves = scene.with_environment(foliage=torch.tensor([0.4, 0.0, 0.3]))
    first = generator.render(moved(scene, index, AHEAD_M, 0.0)).image
    generator.render(leaves)
    assert torch.equal(generator.render(moved(scene, index, AHEAD_M, 0.0)).image, first)
    assert torch.equal(
        generator.render(scene).image, GeneratorRenderer("demo-000", scene, DemoPlans()).render(scene).image
    )


def test_what_has_no_counterpart_is_ignored(scene: SceneIR) -> None:
    drawn = GeneratorRenderer("demo-000", scene, FirstUnknown()).render(moved(scene, 0, 1.0, 0.0))
    assert drawn.targets.ignore[0]
    assert drawn.visible_xyxy[0].tolist() == [0, 0, 0, 0]
    # it still stands in the street, as a region for every class
    own = scene.objects.box2d[0]
    regions = drawn.targets.boxes_xyxy[len(scene.objects) :]
    assert (regions - own).abs().amax(dim=1).lt(1e-3).sum() >= 1


def test_what_left_the_picture_is_ignored(scene: SceneIR, generator: GeneratorRenderer) -> None:
    index = clearest(scene)
    drawn = generator.render(moved(scene, index, 60.0, 0.0))
    assert drawn.targets.ignore[index]
    assert drawn.visible_xyxy[index].tolist() == [0, 0, 0, 0]


def test_another_photograph_is_refused(scene: SceneIR) -> None:
    darker = replace(scene, photograph=scene.photograph * 0.5)
    with pytest.raises(FormatError, match="photograph of demo-000: expected the picture that the generator makes"):
        GeneratorRenderer("demo-000", darker, DemoPlans())


def test_a_state_that_was_changed_already_is_known_by_its_origin(
    scene: SceneIR, generator: GeneratorRenderer
) -> None:
    changed = moved(scene, clearest(scene), AHEAD_M, 0.0)
    drawn = GeneratorRenderer("demo-000", changed, DemoPlans()).render(changed)
    np.testing.assert_array_equal(drawn.image.numpy(), generator.render(changed).image.numpy())
