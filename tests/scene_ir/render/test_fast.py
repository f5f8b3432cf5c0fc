"""The fast path against the reference, and batches of scenes against single renders."""

from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from scene_ir.ffd import from_symmetric
from scene_ir.render.compositor import Compositor, render_batch
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import WEATHER_DIM, Crop, SceneIR, convert_scene

PARAMETERS = ("translation", "yaw", "ffd", "size", "texture_code", "weather", "foliage", "light")
VALUE, GRADIENT = 2e-4, 1e-4
"""Largest difference of a pixel; of a gradient, relative to its length. Both sides are float32."""
BAND = 4
"""Pixels that may differ by more: whose centres lie on an edge, to the rounding of the vertices."""


def perturbed(scene: SceneIR, values: dict[str, Tensor]) -> SceneIR:
    """The scene with `values` added to its parameters; ffd as (N, 96) symmetric codes."""
    objects = scene.objects
    moved = {
        "translation": objects.translation
        + values["translation"] * objects.translation.new_tensor([1.0, 0.0, 1.0]),
        "yaw": objects.yaw + values["yaw"],
        "ffd": objects.ffd + from_symmetric(values["ffd"]),
        "size_lhw": objects.size_lhw * (1 + values["size"])[:, None],
        "texture_code": objects.texture_code + values["texture_code"],
    }
    environment = {name: values[name] for name in ("weather", "foliage", "light")}
    return scene.with_objects(**moved).with_environment(**environment)


def draws(scene: SceneIR, seed: int, spread: float, active: tuple[str, ...]) -> dict[str, Tensor]:
    """Random values of the active parameters, 0 for the others."""
    generator = torch.Generator().manual_seed(seed)
    count = len(scene.objects)
    shapes = {
        "translation": (count, 3), "yaw": (count,), "ffd": (count, 96), "texture_code": (count, 5), "weather":
        (WEATHER_DIM,), "foliage": (3,), "light": (3,), "size": (count,),
    }  # fmt: skip
    scales = {
        "translation": 0.5, "yaw": 0.3, "ffd": 0.03, "size": 0.1, "texture_code": 0.4, "weather": 0.4,
        "foliage": 0.5, "light": 0.5,
    }  # fmt: skip
    out = {}
    for name, shape in shapes.items():
        noise = torch.randn(shape, generator=generator) * scales[name] * spread
        if name in ("weather", "foliage", "light", "texture_code"):
            noise = (noise.abs() if name == "weather" else noise).clamp(-1.0, 1.0)
        out[name] = noise if name in active else torch.zeros(shape)
    return out


def compared(
    scene: SceneIR, values: dict[str, Tensor], active: tuple[str, ...], keep: Tensor | None = None
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Picture, object numbers and gradient of a smooth functional of the pixels `keep`, by kernels and reference."""
    weight = torch.randn(1, 3, 24, 40, generator=torch.Generator().manual_seed(5))
    weight = torch.nn.functional.interpolate(weight, scene.photograph.shape[1:], mode="bicubic")[0]
    if keep is not None:
        weight = weight * keep
    out = []
    for backend in ("warp", "reference"):
        leaves = {n: v.clone().requires_grad_(n in active) for n, v in values.items()}
        render = Compositor(scene, RenderSettings(backend)).render(perturbed(scene, leaves))
        wanted = [leaves[n] for n in active]
        gradients = torch.autograd.grad((render.image * weight).sum(), wanted, allow_unused=True)
        flat = [torch.zeros_like(w) if g is None else g for w, g in zip(wanted, gradients, strict=True)]
        out.append((render.image.detach(), render.object_id, torch.cat([g.flatten() for g in flat])))
    return out


def check(scene: SceneIR, values: dict[str, Tensor], active: tuple[str, ...]) -> None:
    (fast, fast_id, fast_grad), (plain, plain_id, plain_grad) = compared(scene, values, active)
    assert int((fast_id != plain_id).sum()) <= BAND
    other = ((fast - plain).abs() > VALUE).any(dim=0)
    assert int(other.sum()) <= BAND
    if bool(other.any()):
        (_, _, fast_grad), (_, _, plain_grad) = compared(scene, values, active, ~other)
    assert float((fast_grad - plain_grad).norm()) <= GRADIENT * float(plain_grad.norm()) + 1e-6


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**31 - 1),
    spread=st.sampled_from([0.0, 0.3, 1.0, 3.0]),
    active=st.sets(st.sampled_from(PARAMETERS), min_size=1, max_size=4),
)
def test_kernels_match_the_reference(photographed: SceneIR, seed: int, spread: float, active: set[str]) -> None:
    scene = convert_scene(photographed, torch.float32)
    chosen = tuple(n for n in PARAMETERS if n in active)
    check(scene, draws(scene, seed, spread, chosen), chosen)


@pytest.mark.parametrize("place", [[0.3, 0.0, -8.9], [3.2, 0.0, -7.5], [40.0, 0.0, 0.0], [0.0, 0.0, -30.0]])
def test_kernels_match_the_reference_at_and_behind_the_camera(photographed: SceneIR, place: list[float]) -> None:
    scene = convert_scene(photographed, torch.float32)
    active = ("translation", "yaw", "ffd")
    values = draws(scene, 3, 0.5, active)
    values["translation"][0] += torch.tensor(place)
    check(scene, values, active)


def test_a_sun_overhead_casts_shadows_without_length(photographed: SceneIR) -> None:
    """Their length has a kink at 0, where its gradient is 0, not infinity times 0."""
    scene = convert_scene(photographed, torch.float32)
    scene = scene.with_environment(sun=torch.tensor([0.0, -1.0, 0.0]))
    active = ("translation", "yaw")
    check(scene, draws(scene, 4, 0.5, active), active)


def test_a_vehicle_outside_the_photograph(photographed: SceneIR) -> None:
    scene = convert_scene(photographed, torch.float32)
    objects = scene.objects
    aside = torch.tensor([[40.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    source = replace(objects.source[0], translation=objects.source[0].translation + aside[0])
    hidden = scene.with_objects(translation=objects.translation + aside, source=(source, *objects.source[1:]))
    values = draws(hidden, 4, 0.3, ("translation", "yaw"))
    values["translation"] = values["translation"] - aside
    check(hidden, values, ("translation", "yaw"))


def with_regions(scene: SceneIR) -> SceneIR:
    """The scene with a soft paint region for all objects but the last."""
    sources = list(scene.objects.source)
    for i, source in enumerate(sources[:-1]):
        h, w = source.foreground.values.shape[1:]
        wave = 0.5 + 0.5 * torch.sin(torch.arange(w) / 3.0) * torch.cos(torch.arange(h) / 4.0)[:, None]
        region = Crop(wave[None].to(scene.photograph), source.foreground.x0, source.foreground.y0)
        sources[i] = replace(source, region=region)
    return scene.with_objects(source=tuple(sources))  # type: ignore[arg-type]


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_texture_codes_recolour_paint_regions(photographed: SceneIR, spread: float) -> None:
    scene = with_regions(convert_scene(photographed, torch.float32))
    active = ("translation", "yaw", "texture_code")
    values = draws(scene, 6, spread, active)
    values["texture_code"] = draws(scene, 6, 1.0, active)["texture_code"]
    check(scene, values, active)


def test_a_batch_equals_single_renders(photographed: SceneIR) -> None:
    scene = convert_scene(photographed, torch.float32)
    fewer = scene.with_objects(**{
        n: getattr(scene.objects, n)[:2]
        for n in ("mesh_index", "translation", "yaw", "size_lhw", "ffd", "texture_code", "lamps", "category", "box2d",
                  "truncation", "occlusion")
    }, source=scene.objects.source[:2])  # fmt: skip
    first, second = Compositor(scene), Compositor(with_regions(fewer))
    kinds: list[tuple[Compositor, SceneIR, tuple[str, ...]]] = [
        (first, scene, ("translation", "yaw", "ffd")),
        (second, fewer, ("yaw", "texture_code", "weather")),
        (first, scene, ("translation", "foliage")),
    ]
    pairs, leaves = [], []
    for seed, (compositor, base, active) in enumerate(kinds):
        values = {n: v.requires_grad_(n in active) for n, v in draws(base, seed, 1.0, active).items()}
        leaves += [values[n] for n in active]
        pairs.append((compositor, perturbed(base, values)))
    together = render_batch(pairs)
    alone = [c.render(s) for c, s in pairs]
    for one, other in zip(together, alone, strict=True):
        # Not to the bit: torch computes the last few entries of a tensor, which depend on its length, in another
        # way.
        assert torch.allclose(one.image, other.image, rtol=0, atol=2e-6)
        assert torch.equal(one.object_id, other.object_id)
        assert torch.equal(one.depth, other.depth)
        for crop, same in zip(one.opacity, other.opacity, strict=True):
            assert torch.equal(crop.values, same.values)
            assert (crop.x0, crop.y0) == (same.x0, same.y0)
    for a, b in zip(
        torch.autograd.grad([r.image.square().sum() for r in together], leaves, retain_graph=True),
        torch.autograd.grad([r.image.square().sum() for r in alone], leaves),
        strict=True,
    ):
        assert float((a - b).norm()) <= 1e-5 * float(b.norm()) + 1e-7


def test_level_of_detail_changes_triangles_not_the_photograph(photographed: SceneIR) -> None:
    scene = convert_scene(photographed, torch.float32)
    coarse, full = Compositor(scene), Compositor(scene, RenderSettings(lod=False))
    assert coarse.surfaces.faces.shape[0] <= full.surfaces.faces.shape[0]
    for compositor in (coarse, full):
        assert float((compositor.render(scene).image - scene.photograph).abs().max()) < 1e-6
