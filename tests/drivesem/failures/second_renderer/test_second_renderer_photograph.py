"""Pyrender as a second renderer of photographs: its pictures and labels, on an embedded scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from drivesem.attacks.labels import Labeller
from drivesem.failures.second_renderer.opengl import OpenGLContext
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.synth.demo import demo_scene
from scene_ir.errors import RangeError
from scene_ir.types import WEATHER_DIM, Crop, Occluder, SceneIR


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


@pytest.fixture(scope="module")
def second(scene: SceneIR, screen: OpenGLContext) -> PhotographRenderer:
    del screen
    return PhotographRenderer("demo-000", scene)


def mattes(scene: SceneIR) -> Tensor:
    """(H, W): how opaque vehicles are in the photograph."""
    out = torch.zeros(scene.photograph.shape[1:])
    for source in scene.objects.source:
        crop = source.foreground
        height, width = crop.values.shape[1:]
        here = out[crop.y0 : crop.y0 + height, crop.x0 : crop.x0 + width]
        torch.maximum(here, crop.values[3], out=here)
    return out


def largest(scene: SceneIR) -> int:
    size = scene.objects.box2d[:, 2:] - scene.objects.box2d[:, :2]
    return int(size.prod(dim=1).argmax())


def moved(scene: SceneIR, i: int, x: float = 0.0, z: float = 0.0, turn: float = 0.0) -> SceneIR:
    translation, yaw = scene.objects.translation.clone(), scene.objects.yaw.clone()
    translation[i] += torch.tensor([x, 0.0, z])
    yaw[i] += turn
    return scene.with_objects(translation=translation, yaw=yaw)


def test_without_a_change_it_is_nearly_the_photograph(second: PhotographRenderer, scene: SceneIR) -> None:
    drawn = second.render(scene)
    apart = (drawn.image - scene.photograph).abs().mean(dim=0)
    matte = mattes(scene)
    assert float(apart[matte == 0].mean()) < 0.004
    assert float(apart[matte > 0.9].mean()) < 0.04
    assert torch.equal(drawn.image, (drawn.image * 255).round() / 255)


def test_without_a_change_labels_are_the_photographs(second: PhotographRenderer, scene: SceneIR) -> None:
    drawn, count = second.render(scene), len(scene.objects)
    torch.testing.assert_close(drawn.targets.boxes_xyxy[:count], scene.objects.box2d, atol=1e-3, rtol=0)
    assert torch.equal(drawn.targets.labels[:count], scene.objects.category)
    assert bool(drawn.targets.ignore[count:].all())
    assert not bool(drawn.targets.ignore[largest(scene)])


def test_labels_move_as_ours_do(second: PhotographRenderer, scene: SceneIR) -> None:
    i = largest(scene)
    changed = moved(scene, i, x=0.4, z=0.5, turn=0.1)
    drawn, ours = second.render(changed), Labeller(scene).moved(changed)
    torch.testing.assert_close(drawn.targets.boxes_xyxy[i], ours.boxes_xyxy[i], atol=0.05, rtol=0)
    visible = second.render(scene).visible_xyxy[i]
    assert float(drawn.visible_xyxy[i][0]) > float(visible[0]) + 1


def test_what_stands_nearer_hides_what_is_behind_it(second: PhotographRenderer, scene: SceneIR) -> None:
    objects = scene.objects
    order = objects.translation[:, 2].argsort().tolist()
    near, far = order[0], order[-1]
    translation = objects.translation.clone()
    # The far one comes to stand right behind the near one, as the camera sees it.
    translation[far] = objects.translation[near] * torch.tensor([1.3, 1.0, 1.3])
    behind = second.render(scene.with_objects(translation=translation))
    assert bool(behind.targets.ignore[far])
    visible = behind.visible_xyxy
    height = visible[:, 3] - visible[:, 1]
    assert float(height[far]) < 0.5 * float(height[near])
    translation[far] = objects.translation[near] * torch.tensor([0.7, 1.0, 0.7])
    before = second.render(scene.with_objects(translation=translation))
    assert float(before.visible_xyxy[far][3]) > float(before.visible_xyxy[near][3])


def test_what_left_the_picture_is_ignored(second: PhotographRenderer, scene: SceneIR) -> None:
    i = largest(scene)
    drawn = second.render(moved(scene, i, x=200.0))
    assert bool(drawn.targets.ignore[i])
    assert torch.equal(drawn.visible_xyxy[i], torch.zeros(4))


def test_paint_changes_its_vehicle_alone(second: PhotographRenderer, scene: SceneIR) -> None:
    i = largest(scene)
    code = scene.objects.texture_code.clone()
    code[i, 0] = 0.8
    before, after = second.render(scene), second.render(scene.with_objects(texture_code=code))
    apart = (after.image - before.image).mean(dim=0)
    x0, y0, x1, y1 = (round(v) for v in scene.objects.box2d[i].tolist())
    assert float(apart[y0:y1, x0:x1].mean()) > 0.02
    apart[max(y0 - 8, 0) : y1 + 8, max(x0 - 8, 0) : x1 + 8] = 0
    assert float(apart.abs().max()) == 0


@pytest.mark.parametrize("code", range(WEATHER_DIM))
def test_weather_changes_the_picture_and_code_zero_does_not(
    code: int, second: PhotographRenderer, scene: SceneIR
) -> None:
    weather = torch.zeros(WEATHER_DIM)
    weather[code] = 0.6
    before = second.render(scene).image
    after = second.render(scene.with_environment(weather=weather)).image
    assert float((after - before).abs().mean()) > 0.02
    weather[code] = 1e-3
    barely = second.render(scene.with_environment(weather=weather)).image
    assert float((barely - before).abs().mean()) < 0.005


def test_fog_hides_what_is_far(second: PhotographRenderer, scene: SceneIR) -> None:
    before = second.render(scene).image
    after = second.render(scene.with_environment(weather=torch.tensor([1.0, 0, 0, 0]))).image
    far = (scene.depth > 100) & torch.isfinite(scene.depth) & (mattes(scene) == 0)
    near = scene.depth < 8
    assert float(after[:, far].std()) < 0.5 * float(before[:, far].std())
    assert float((after - before)[:, near].abs().mean()) < 0.15


@pytest.mark.parametrize("code", range(3))
def test_leaves_change_where_there_are_some(code: int, second: PhotographRenderer, scene: SceneIR) -> None:
    foliage = torch.zeros(3)
    foliage[code] = -0.7
    before = second.render(scene).image
    apart = (second.render(scene.with_environment(foliage=foliage)).image - before).abs().mean(dim=0)
    leaves = scene.environment.foliage_map
    assert float(apart[leaves > 0.9].mean()) > 0.01
    assert float(apart[leaves == 0].max()) == 0
    i = largest(scene)
    inside = scene.objects.source[i].foreground
    rows, columns = ((inside.values[3] == 1).nonzero() + torch.tensor([inside.y0, inside.x0])).T
    assert float(apart[rows, columns].mean()) < 1 / 255


def test_what_stands_in_front_stays_in_front(screen: OpenGLContext, scene: SceneIR) -> None:
    del screen
    i = largest(scene)
    x0, y0, x1, y1 = (round(v) for v in scene.objects.box2d[i].tolist())
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    pole = torch.cat([torch.tensor([0.0, 1.0, 0.0])[:, None, None].expand(3, 20, 6), torch.ones(1, 20, 6)])
    photograph, background = scene.photograph.clone(), scene.background.clone()
    for picture in (photograph, background):
        picture[:, y : y + 20, x : x + 6] = pole[:3]
    front = Occluder(Crop(pole, x, y), 1.0)
    with_pole = replace(scene, photograph=photograph, background=background, occluders=(front,))
    second = PhotographRenderer("demo-000", with_pole)
    for state in (with_pole, moved(with_pole, i, z=0.4)):
        drawn = second.render(state).image[:, y + 2 : y + 18, x + 1 : x + 5]
        torch.testing.assert_close(drawn, pole[:3, 2:18, 1:5], atol=0.01, rtol=0)
    beyond = replace(with_pole, occluders=(Occluder(Crop(pole, x, y), 90.0),))
    drawn = PhotographRenderer("demo-000", beyond).render(beyond).image[:, y + 2 : y + 18, x + 1 : x + 5]
    assert float((drawn - pole[:3, 2:18, 1:5]).abs().mean()) > 0.1


def test_without_vehicles_the_background_has_its_weather(
    screen: OpenGLContext, street: Callable[..., SceneIR]
) -> None:
    del screen
    empty = street(())
    second = PhotographRenderer("empty", empty)
    drawn = second.render(empty)
    assert (len(drawn.targets), len(drawn.visible_xyxy)) == (0, 0)
    assert float((drawn.image - empty.background).abs().max()) < 1 / 255
    foggy = second.render(empty.with_environment(weather=torch.tensor([1.0, 0, 0, 0])))
    assert float((foggy.image - drawn.image).abs().mean()) > 0.1


def test_other_vehicles_than_the_photographs_are_refused(second: PhotographRenderer) -> None:
    other = demo_scene(0, 1)
    while len(other.objects) == len(second.render(demo_scene(0, 0)).visible_xyxy):
        other = demo_scene(0, 2)
    with pytest.raises(RangeError, match="demo-000"):
        second.render(other)


def test_weather_stops_at_the_ego_vehicle(second: PhotographRenderer, scene: SceneIR) -> None:
    bonnet = torch.zeros_like(scene.depth)
    bonnet[-40:] = 1.0
    rainy = scene.with_environment(weather=torch.tensor([0.5, 1.0, 0, 0]))
    drawn = second.render(rainy.with_environment(ego=bonnet)).image
    assert torch.equal(drawn[:, -40:], (scene.photograph[:, -40:] * 255).round() / 255)
    assert torch.equal(drawn[:, :-40], second.render(rainy).image[:, :-40])
