"""Caches of a compositor are never stale: a reused one renders like a new one."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Camera, Crop, Render, SceneIR, Source, convert_scene

NAMES = ("translation", "yaw", "ffd", "texture_code", "weather", "foliage")
SPREAD = {"translation": 0.6, "yaw": 0.3, "ffd": 0.03, "texture_code": 0.5, "weather": 0.7, "foliage": 0.7}
"""How far the parameters are taken; weather is kept positive."""


def _cut_crop(crop: Crop, window: tuple[int, int, int, int]) -> Crop:
    x0, y0, x1, y1 = window
    _, h, w = crop.values.shape
    left, top = min(max(x0 - crop.x0, 0), w), min(max(y0 - crop.y0, 0), h)
    right, bottom = max(min(x1 - crop.x0, w), left), max(min(y1 - crop.y0, h), top)
    values = crop.values[:, top:bottom, left:right]
    # What lies outside of the window is empty, at its border.
    x, y = (
        min(max(crop.x0 + left - x0, 0), x1 - x0 - right + left),
        min(max(crop.y0 + top - y0, 0), y1 - y0 - bottom + top),
    )
    return Crop(values, x, y)


def cut(scene: SceneIR, window: tuple[int, int, int, int]) -> SceneIR:
    """The part of a scene inside a window (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = window
    shift = torch.eye(3, dtype=scene.camera.intrinsics.dtype)
    shift[0, 2], shift[1, 2] = -x0, -y0
    projection = shift @ scene.camera.matrix.to(shift)
    camera = Camera(shift @ scene.camera.intrinsics, y1 - y0, x1 - x0, projection)

    def source(s: Source) -> Source:
        shadow = None if s.shadow is None else _cut_crop(s.shadow, window)
        return replace(s, foreground=_cut_crop(s.foreground, window), shadow=shadow)

    e = scene.environment
    maps = {n: getattr(e, n)[y0:y1, x0:x1] for n in ("sky", "foliage_map", "road")}
    return replace(
        scene,
        camera=camera,
        objects=replace(scene.objects, source=tuple(source(s) for s in scene.objects.source)),
        environment=replace(e, **maps),
        photograph=scene.photograph[:, y0:y1, x0:x1].contiguous(),
        background=scene.background[:, y0:y1, x0:x1].contiguous(),
        depth=scene.depth[y0:y1, x0:x1].contiguous(),
        ignore=torch.zeros(0, 4),
    )


@pytest.fixture(scope="module")
def scenes(photographed: SceneIR) -> list[SceneIR]:
    """Two windows of a demo scene around its nearest vehicles, and the small street."""
    demo = demo_scene(0, 0)
    order = demo.objects.translation[:, 2].argsort()[:2].tolist()
    windows = []
    for i in order:
        u, v = ((demo.objects.box2d[i, :2] + demo.objects.box2d[i, 2:]) / 2).to(torch.int64).tolist()
        x0 = min(max(u - 130, 0), demo.camera.width - 220)
        y0 = min(max(v - 80, 0), demo.camera.height - 130)
        windows.append(cut(demo, (x0, y0, x0 + 220, y0 + 130)))
    return [*windows, convert_scene(photographed, torch.float32)]


def perturbed(scene: SceneIR, active: frozenset[str], seed: int) -> SceneIR:
    """`scene` with the named parameters changed at random."""
    generator = torch.Generator().manual_seed(seed)
    changes = {}
    for name in sorted(active):
        now = getattr(scene.objects if name in NAMES[:4] else scene.environment, name)
        change = SPREAD[name] * (2 * torch.rand(now.shape, generator=generator) - 1).to(now)
        changes[name] = (now + change).abs() if name == "weather" else now + change
    objects = {n: c for n, c in changes.items() if n in NAMES[:4]}
    return scene.with_objects(**objects).with_environment(**{n: c for n, c in changes.items() if n not in objects})


def assert_same(reused: Render, fresh: Render) -> None:
    assert torch.equal(reused.image, fresh.image)
    assert torch.equal(reused.depth, fresh.depth)
    assert torch.equal(reused.object_id, fresh.object_id)
    for a, b in zip(reused.opacity, fresh.opacity, strict=True):
        assert (a.x0, a.y0) == (b.x0, b.y0)
        assert torch.equal(a.values, b.values)


THETAS = st.lists(
    st.tuples(st.frozensets(st.sampled_from(NAMES)), st.integers(0, 3), st.booleans()), min_size=2, max_size=4
)


@pytest.mark.slow
@given(st.integers(0, 2), THETAS)
@settings(max_examples=25)
def test_a_reused_compositor_renders_like_a_new_one(
    scenes: list[SceneIR], which: int, thetas: list[tuple[frozenset[str], int, bool]]
) -> None:
    """Any parameters in any order, with or without gradients in between."""
    scene = scenes[which]
    reused = Compositor(scene)
    for active, seed, differentiate in thetas:
        theta = perturbed(scene, active, seed)
        if differentiate:
            yaw = theta.objects.yaw.clone().requires_grad_()
            weather = theta.environment.weather.clone().requires_grad_()
            picture = reused.render(theta.with_objects(yaw=yaw).with_environment(weather=weather))
            grads = torch.autograd.grad(picture.image.square().sum(), (yaw, weather))
            again = Compositor(scene).render(theta.with_objects(yaw=yaw).with_environment(weather=weather))
            expected = torch.autograd.grad(again.image.square().sum(), (yaw, weather))
            assert all(torch.equal(a, b) for a, b in zip(grads, expected, strict=True))
        with torch.no_grad():
            assert_same(reused.render(theta), Compositor(scene).render(theta))


@given(st.integers(0, 2), st.permutations(range(4)))
@settings(max_examples=6)
def test_the_order_of_perturbations_does_not_matter(scenes: list[SceneIR], which: int, order: list[int]) -> None:
    scene = scenes[which]
    sets = (frozenset(), frozenset(NAMES), frozenset({"weather"}), frozenset({"foliage", "texture_code"}))
    thetas = [perturbed(scene, active, 7) for active in sets]
    straight, mixed = Compositor(scene), Compositor(scene)
    with torch.no_grad():
        first = [straight.render(theta) for theta in thetas]
        for i in order:
            assert_same(mixed.render(thetas[i]), first[i])


def test_parameters_changed_in_place_take_effect(scenes: list[SceneIR]) -> None:
    """Attacks change one tensor in place: no cache may depend on a tensor's identity."""
    scene = scenes[0]
    reused = Compositor(scene)
    theta = perturbed(scene, frozenset(NAMES), 1)
    with torch.no_grad():
        before = reused.render(theta)
        for tensor in (theta.objects.translation, theta.objects.ffd, theta.objects.texture_code):
            tensor.add_(0.05)
        theta.environment.weather.mul_(0.5)
        theta.environment.foliage.mul_(0.5)
        after = reused.render(theta)
        assert not torch.equal(before.image, after.image)
        assert_same(after, Compositor(scene).render(theta))


def test_a_reused_reference_compositor_renders_like_a_new_one(scenes: list[SceneIR]) -> None:
    scene, settings_ = scenes[2], RenderSettings(backend="reference")
    reused = Compositor(scene, settings_)
    with torch.no_grad():
        for active in (frozenset(NAMES), frozenset({"foliage"}), frozenset[str](), frozenset({"yaw", "weather"})):
            theta = perturbed(scene, active, 2)
            assert_same(reused.render(theta), Compositor(scene, settings_).render(theta))
