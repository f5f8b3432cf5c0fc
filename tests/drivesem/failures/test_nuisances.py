"""What a camera does between two frames: values, boxes that go along, gradients, the scene set up again."""

import dataclasses
import math

import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from drivesem.config.errors import UsageError
from drivesem.failures.nuisances import Nuisances, NuisanceSample, _warp_and_blur_axis
from drivesem.synth.demo import demo_scene
from scene_ir.types import SceneIR

OFF = Nuisances.parse("off")


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


def only(scene: SceneIR, number: int = 0, **ranges: float) -> NuisanceSample:
    return dataclasses.replace(OFF, **ranges).sample("test", number, scene)


def test_off_returns_the_photograph(scene: SceneIR) -> None:
    draw = OFF.sample("test", 0, scene)
    torch.testing.assert_close(
        draw.degrade_image(scene.photograph), scene.photograph, atol=0.5 / 255 + 1e-6, rtol=0
    )
    torch.testing.assert_close(draw.transform_boxes(scene.objects.box2d), scene.objects.box2d)
    again = draw.perturb_scene(scene)
    for name in ("translation", "yaw", "ffd", "texture_code"):
        assert torch.equal(getattr(again.objects, name), getattr(scene.objects, name))


def test_a_draw_follows_from_its_name_and_number(scene: SceneIR) -> None:
    picture = Nuisances().sample("a", 3, scene).degrade_image(scene.photograph)
    assert torch.equal(picture, Nuisances().sample("a", 3, scene).degrade_image(scene.photograph))
    assert not torch.equal(picture, Nuisances().sample("a", 4, scene).degrade_image(scene.photograph))
    assert not torch.equal(picture, Nuisances().sample("b", 3, scene).degrade_image(scene.photograph))
    levels = picture * 255
    torch.testing.assert_close(levels, levels.round(), atol=1e-4, rtol=0)


def test_ranges_hold(scene: SceneIR) -> None:
    draws = [Nuisances().sample("range", n, scene) for n in range(64)]
    assert max(abs(v) for d in draws for v in d.shift_px) <= 15
    assert max(abs(d.zoom - 1) for d in draws) <= 0.03
    assert max(abs(d.gain - 1) for d in draws) <= 0.05
    assert all(0 <= d.blur_px <= 0.7 and d.jpeg is not None and 75 <= d.jpeg <= 95 for d in draws)
    assert max(float(d.position_m.abs().max()) for d in draws) <= 0.05
    assert max(float(d.angle.abs().max()) for d in draws) <= math.radians(1)
    # Spread over the range, not only within it.
    assert max(v for d in draws for v in d.shift_px) > 10
    assert min(v for d in draws for v in d.shift_px) < -10


@pytest.mark.parametrize("blur_px", [0.7, 2.0, 6.0])
def test_a_blur_has_its_standard_deviation(blur_px: float) -> None:
    row = _warp_and_blur_axis(101, 0.0, 1.0, blur_px)[50]
    away = np.arange(101) - 50
    assert math.sqrt((row * away**2).sum()) == pytest.approx(blur_px, rel=0.08)


def dot(scene: SceneIR, x: int, y: int) -> Tensor:
    image = torch.zeros_like(scene.photograph)
    image[:, y - 4 : y + 5, x - 4 : x + 5] = 1
    return image


@pytest.mark.parametrize("number", [0, 1, 2])
def test_boxes_go_along_with_the_picture(scene: SceneIR, number: int) -> None:
    draw = only(scene, number, shift_px=15.0, scale=0.03)
    box = torch.tensor([[295.5, 195.5, 304.5, 204.5]])
    seen = (draw.degrade_image(dot(scene, 300, 200))[0] > 0.5).nonzero()
    low, high = seen.amin(0).flip(0), seen.amax(0).flip(0)
    around = torch.cat([low - 0.5, high + 0.5])[None]
    torch.testing.assert_close(draw.transform_boxes(box), around, atol=0.8, rtol=0)


def test_boxes_end_at_the_border(scene: SceneIR) -> None:
    draw = dataclasses.replace(only(scene), shift_px=(-15.0, 0.0))
    moved = draw.transform_boxes(torch.tensor([[5.0, 20.0, 30.0, 40.0], [2.0, 20.0, 8.0, 40.0]]))
    assert moved[0].tolist() == [0.0, 20.0, 15.0, 40.0]
    assert moved[1, 2] == 0


def test_gain_and_gamma(scene: SceneIR) -> None:
    draw = dataclasses.replace(OFF.sample("test", 0, scene), gain=0.9, gamma=1.1)
    expected = (0.9 * scene.photograph.clamp(1e-6, 1) ** 1.1).clamp(0, 1)
    torch.testing.assert_close(draw.degrade_image(scene.photograph), expected, atol=0.51 / 255, rtol=0)


def test_noise_has_its_size(scene: SceneIR) -> None:
    grey = torch.full_like(scene.photograph, 0.5)
    noise = only(scene, noise=2.0).degrade_image(grey) - 0.5
    assert float(noise.std() * 255) == pytest.approx(2.02, abs=0.05)


def test_the_differentiable_picture_is_nearly_the_other(scene: SceneIR) -> None:
    draw = Nuisances().sample("both", 1, scene)
    exact = draw.degrade_image(scene.photograph)
    smooth = draw.degrade_image(scene.photograph.clone().requires_grad_(True))
    assert smooth.requires_grad
    # JPEG codecs differ in rounding and in how they thin colour out.
    assert float((exact - smooth.detach()).abs().mean()) < 2.5 / 255


@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_picture_is_that_of_kornias_operations(scene: SceneIR, number: int) -> None:
    draw = dataclasses.replace(Nuisances().sample("kornia", number, scene), jpeg=None)
    image = (0.01 + 0.98 * scene.photograph.double()).requires_grad_(True)
    move = [
        (side - 1) / 2 * (1 - draw.zoom) + shift for side, shift in zip(draw.hw[::-1], draw.shift_px, strict=True)
    ]
    matrix = image.new_tensor([[[draw.zoom, 0, move[0]], [0, draw.zoom, move[1]]]])
    warped = kornia.geometry.warp_affine(image[None], matrix, draw.hw, padding_mode="border", align_corners=True)
    blurred = kornia.filters.gaussian_blur2d(
        warped, (5, 5), (draw.blur_px, draw.blur_px), border_type="replicate"
    )[0]
    noise = draw.noise * draw.noise_field.like(image)
    expected = (draw.gain * blurred.clamp(1e-6, 1) ** draw.gamma + noise).clamp(0, 1)
    picture = draw.degrade_image(image)
    torch.testing.assert_close(picture, expected, atol=1e-7, rtol=0)
    cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(number)).to(image)
    (gradient,) = torch.autograd.grad(expected, image, cotangent)
    (found,) = torch.autograd.grad(picture, image, cotangent)
    torch.testing.assert_close(found, gradient, atol=1e-6, rtol=0)
    # Without a gradient, the same on the 8-bit grid.
    levels = draw.degrade_image(image.detach()) * 255
    torch.testing.assert_close(levels, expected.detach() * 255, atol=0.5 + 1e-4, rtol=0)


def test_noise_is_cached_with_its_sample(scene: SceneIR) -> None:
    draw = Nuisances().sample("kept", 0, scene)
    field = draw.noise_field.like(scene.photograph)
    assert draw.noise_field.like(scene.photograph) is field
    draw.noise_field.release()
    again = draw.noise_field.like(scene.photograph)
    assert again is not field
    assert torch.equal(again, field)
    assert draw.noise_field.like(scene.photograph[:, :8]).shape == (3, 8, field.shape[2])


def test_hardly_any_blur_has_no_subnormal_weights(scene: SceneIR) -> None:
    draw = dataclasses.replace(OFF.sample("test", 0, scene), blur_px=0.15, shift_px=(0.5, 0.5))
    image = torch.zeros_like(scene.photograph)
    image[:, 100, 100] = 1
    seen = dataclasses.replace(draw, noise=0.0).degrade_image(image.requires_grad_(True)).detach()
    assert float(seen[seen > 0].min()) > 1e-9


def test_gradient_against_differences(scene: SceneIR) -> None:
    small = dataclasses.replace(
        Nuisances().sample("gradient", 0, scene), hw=(12, 16), shift_px=(1.3, -0.6), noise=0.0, jpeg=None
    )
    generator = torch.Generator().manual_seed(0)
    image = (0.2 + 0.6 * torch.rand(3, 12, 16, generator=generator, dtype=torch.float64)).requires_grad_(True)
    assert torch.autograd.gradcheck(small.degrade_image, (image,))


def test_the_scene_is_set_up_again(scene: SceneIR) -> None:
    again = only(scene, position_m=0.05, angle_deg=1.0, size=0.01).perturb_scene(scene)
    moved = again.objects.translation - scene.objects.translation
    assert 0.001 < float(moved.norm(dim=1).max()) <= 0.05 * math.sqrt(2) + 1e-5
    up = scene.environment.ground[:3]
    assert float((moved @ up).abs().max()) < 1e-5
    assert 0 < float((again.objects.yaw - scene.objects.yaw).abs().max()) <= math.radians(1)
    assert 0 < float((again.objects.ffd - scene.objects.ffd).abs().max()) <= 0.01
    # A car stands on what it stood on.
    assert float((again.objects.ffd - scene.objects.ffd)[:, :, 1].abs().max()) <= 0.01


def test_codes_at_zero_stay_as_photographed(scene: SceneIR) -> None:
    weather = torch.tensor([0.5, 0.0, 0.99, 0.0])
    foggy = scene.with_environment(weather=weather)
    again = only(scene, code=0.02).perturb_scene(foggy).environment.weather
    assert again[1] == 0
    assert again[3] == 0
    assert 0 < float((again[0] - 0.5).abs()) <= 0.02
    assert float(again.max()) <= 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("blur=1", "names among"),
        ("shift_px", "NAME=NUMBER"),
        ("shift_px=-1", "at least 0"),
        ("jpeg=100", "at most 95"),
        ("scale=0.01,scale=0.02", "NAME=NUMBER"),
        ("gain=nan", "NAME=NUMBER"),
    ],
)
def test_bad_words(text: str, message: str) -> None:
    with pytest.raises(UsageError, match="--nuisances") as error:
        Nuisances.parse(text)
    assert message in str(error.value)


def test_words() -> None:
    assert Nuisances.parse("default") == Nuisances()
    assert Nuisances.parse("noise=0, jpeg=0") == dataclasses.replace(Nuisances(), noise=0.0, jpeg=0.0)
