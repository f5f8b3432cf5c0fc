"""The moving sun: identity, position, shadows and light."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from scene_ir.render.compositor import Compositor
from scene_ir.render.environment import PerturbedSun, move_sun
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Crop, SceneIR

REFERENCE = RenderSettings(backend="reference")


def _lit(scene: SceneIR, *code: float) -> SceneIR:
    return scene.with_environment(light=torch.tensor(code, dtype=scene.photograph.dtype))


def _darkness(scene: SceneIR, base: SceneIR) -> Tensor:
    """(H, W) darkness of the vehicles' shadows on the ground."""
    compositor = Compositor(base, REFERENCE)
    layers = compositor.draw_layers(
        compositor.perturbed_objects(scene), compositor.perturbed_sun(scene.environment)
    )
    out = torch.zeros_like(base.depth)
    for (packed, size), (x0, y0, x1, y1) in zip(
        layers.shadow_layout.spans(), layers.shadow_layout.rects.tolist(), strict=True
    ):
        out[y0:y1, x0:x1] += (1 - layers.shadow[packed]).mean(dim=1).reshape(size)
    return out


def test_light_code_zero_changes_no_bit(photographed: SceneIR) -> None:
    live = _lit(photographed, 0, 0, 0).environment.light.requires_grad_()
    picture = Compositor(photographed, REFERENCE).render(photographed.with_environment(light=live)).image
    assert torch.equal(picture.detach(), Compositor(photographed, REFERENCE).render(photographed).image)
    sun = PerturbedSun.from_environment(
        _lit(photographed, 0, 0, 0).environment, photographed.photograph, torch.tensor(0.6)
    )
    assert torch.equal(sun.direction, photographed.environment.sun)
    assert (float(sun.strength), float(sun.shade)) == (1.0, 1.0)


@pytest.mark.parametrize("code", [(1.0, 0.0), (-0.5, 0.0), (0.0, 1.0), (0.7, -0.4)])
def test_the_sun_turns_about_the_vertical_and_rises(code: tuple[float, float]) -> None:
    up, height, azimuth = torch.tensor([0.0, -1.0, 0.0]), math.radians(40), math.radians(30)
    flat = math.cos(height)
    sun = torch.tensor([flat * math.sin(azimuth), -math.sin(height), flat * math.cos(azimuth)])
    x, y, z = move_sun(sun, up, torch.tensor([*code, 0.0])).tolist()
    assert math.hypot(x, y, z) == pytest.approx(1)
    assert math.degrees(math.asin(-y)) == pytest.approx(40 + 7.5 * code[1], abs=1e-3)
    assert math.degrees(math.atan2(x, z)) == pytest.approx(30 + 15 * code[0], abs=1e-3)


def test_shadows_turn_away_from_the_sun(photographed: SceneIR) -> None:
    columns = torch.arange(photographed.camera.width, dtype=photographed.photograph.dtype)
    middles = []
    for azimuth in (-1.0, 0.0, 1.0):
        dark = _darkness(_lit(photographed, azimuth, 0, 0), photographed)
        middles.append(float((dark.sum(dim=0) * columns).sum() / dark.sum()))
    sun = photographed.environment.sun
    # Towards the right, where the sun stands before the camera; towards the left, where behind it.
    assert (middles[2] - middles[0]) * float(sun[2]) < 0


def test_a_stronger_sun_darkens_shadows_and_brightens_vehicles(photographed: SceneIR) -> None:
    scenes = [_lit(photographed, 0, 0, strength) for strength in (-1.0, 0.0, 1.0)]
    renders = [Compositor(photographed, REFERENCE).render(scene) for scene in scenes]
    cars = renders[1].object_id > 0
    light = [float(render.image.mean(dim=0)[cars].mean()) for render in renders]
    assert light[0] < light[1] < light[2]
    ground = ~cars & (_darkness(photographed, photographed) > 0.3)
    assert bool(ground.any())
    shade = [float(render.image.mean(dim=0)[ground].mean()) for render in renders]
    assert shade[0] > shade[1] > shade[2]
    # Nothing else of the picture changes.
    near = torch.nn.functional.max_pool2d(cars[None].to(torch.float64), 9, 1, 4)[0] > 0
    far = ~near & (_darkness(photographed, photographed) == 0)
    assert torch.equal(renders[2].image[:, far], renders[1].image[:, far])


def test_foreign_shadows_do_not_follow_the_sun(photographed: SceneIR) -> None:
    """Such as a house's shadow, mistaken for the car's."""
    sources = list(photographed.objects.source)
    shadow = sources[0].shadow
    assert shadow is not None
    dark = torch.full_like(shadow.values, 0.99)
    dark[:, : dark.shape[1] // 3, : dark.shape[2] // 4] = 0.2
    sources[0] = replace(sources[0], shadow=Crop(dark, shadow.x0, shadow.y0))
    other = photographed.with_objects(source=tuple(sources))  # pyright: ignore[reportArgumentType]
    compositor = Compositor(other, REFERENCE)
    assert compositor.shadow_is_own[0] == 0
    still, moved = (compositor.place_patches(other.objects, sun) for sun in (None, _sun(compositor, other)))
    assert torch.equal(still[:4], moved[:4])
    own = Compositor(photographed, REFERENCE)
    assert bool((own.shadow_is_own == 1).any())
    still, moved = (own.place_patches(other.objects, sun) for sun in (None, _sun(own, photographed)))
    assert not torch.equal(still, moved)


def _sun(compositor: Compositor, scene: SceneIR) -> PerturbedSun | None:
    return compositor.perturbed_sun(_lit(scene, 1, 0, 0).environment)
