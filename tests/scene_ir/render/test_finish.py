"""The finish of templates, and the light on them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_ir.render import finish, model, texture
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.surfaces import TemplateSurface
from scene_ir.types import Part, SceneIR


@pytest.fixture(scope="module")
def compositor(photographed: SceneIR) -> Compositor:
    return Compositor(photographed, RenderSettings("reference"))


def test_the_finished_template_matches_the_photograph_where_visible(compositor: Compositor) -> None:
    for surface, samples in zip(compositor.surfaces.templates, compositor.sample_photograph(), strict=True):
        own = finish.fit_finish(surface, samples)
        gain, lift = (
            (samples.share[..., None] * own[samples.vertex][..., k]).sum(axis=1) for k in (slice(3), [3])
        )
        again = texture.apply_finish(*(torch.from_numpy(v) for v in (samples.template, gain, lift))).numpy()
        sure = samples.weight > 0.9
        before = np.abs(samples.template[sure] - samples.photograph[sure]).mean()
        assert np.abs(again[sure] - samples.photograph[sure]).mean() < min(0.05, 0.3 * before)


def test_unseen_paint_takes_the_gain_of_visible_paint(compositor: Compositor) -> None:
    surface, samples = compositor.surfaces.templates[0], compositor.sample_photograph()[0]
    own = finish.fit_finish(surface, samples)[:, :3]
    paint = surface.part.numpy() == Part.PAINT
    seen = np.zeros(len(paint), bool)
    seen[np.unique(samples.vertex[samples.weight > 0.5])] = True
    assert (paint & ~seen).any()
    ratio = own[paint & ~seen] / np.median(own[paint & seen], axis=0)
    assert np.median(np.abs(np.log(ratio))) < 0.3


def test_without_samples_the_template_is_unchanged(compositor: Compositor) -> None:
    none = finish.FinishSamples(
        np.zeros((0, 3), np.int64), *(np.zeros((0, n)) for n in (3, 3, 3)), *[np.zeros(0)] * 3
    )
    surface = compositor.surfaces.templates[0]
    own = finish.fit_finish(surface, none)
    assert np.allclose(own, [1.0, 1.0, 1.0, 0.0])
    assert finish.estimate_paint(surface, none) is None
    assert finish.estimate_sunlight([(surface, none)], [None]) == pytest.approx(0.4, abs=0.11)
    assert finish.estimate_sunlight([(surface, none)] * 3, [1.2] * 3) == pytest.approx(1.2, abs=0.21)


def test_estimated_paint_is_the_photographed_one(compositor: Compositor, photographed: SceneIR) -> None:
    """The first car is painted red, the second blue."""
    filled_rows = torch.stack([s.paint for s in photographed.objects.source])
    assert torch.allclose(filled_rows, compositor.estimate_paint(compositor.sample_photograph()), atol=0.02)
    red, blue = filled_rows[:2]
    assert float(red[0]) > 1.5 * float(red[1])
    assert float(blue[2]) > 1.3 * float(blue[0])


def _lit(samples: finish.FinishSamples, strength: float) -> finish.FinishSamples:
    level = 0.3 * (samples.sky + strength * samples.direct)
    return replace(samples, photograph=np.repeat(1.0 - np.exp(-level)[:, None], 3, axis=1))


@pytest.mark.parametrize("strength", [0.0, 0.6, 1.4])
def test_sunlight_is_estimated_from_paint_on_several_sides(compositor: Compositor, strength: float) -> None:
    surface, samples = compositor.surfaces.templates[0], compositor.sample_photograph()[0]
    seen = [(surface, _lit(samples, strength))]
    assert finish.estimate_sunlight(seen, [strength]) == pytest.approx(strength, abs=0.01)
    assert abs(finish.estimate_sunlight(seen, [strength + 0.4]) - strength) < 0.4


def test_one_vehicle_in_the_shade_does_not_change_the_sunlight(compositor: Compositor) -> None:
    surface, samples = compositor.surfaces.templates[0], compositor.sample_photograph()[0]
    seen = [(surface, _lit(samples, s)) for s in (1.4, 1.4, 0.0)]
    assert finish.estimate_sunlight(seen, [1.4, 1.4, 0.0]) == pytest.approx(1.4, abs=0.01)


def test_all_vehicles_of_a_frame_have_one_sunlight(photographed: SceneIR) -> None:
    assert len({s.sunlight for s in photographed.objects.source}) == 1


def test_samples_do_not_depend_on_other_objects(photographed: SceneIR, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a hidden car's completion, and the picture, would depend on the other objects."""
    monkeypatch.setattr("scene_ir.render.prepare._MAX_SAMPLES", 150)
    names = ("translation", "yaw", "size_lhw", "ffd", "texture_code", "lamps", "mesh_index", "category")
    names = (*names, "box2d", "truncation", "occlusion")
    objects, clear = photographed.objects, torch.zeros_like(photographed.depth)
    together = Compositor(photographed, hidden=[clear] * len(objects)).sample_photograph()[1]
    single = {n: getattr(objects, n)[1:2] for n in names}
    one = replace(photographed, objects=replace(objects, source=objects.source[1:2], **single))
    alone = Compositor(one, hidden=[clear]).sample_photograph()[0]
    assert 50 < len(alone.weight) <= 151
    assert np.array_equal(together.vertex, alone.vertex)
    assert np.array_equal(together.photograph, alone.photograph)


def test_gains_of_an_unseen_side_follow_the_other_side(compositor: Compositor) -> None:
    """Without samples on one side, its gains are drawn towards the other side's."""
    surface: TemplateSurface = compositor.surfaces.templates[1]
    samples = compositor.sample_photograph()[1]
    brighter = replace(samples, photograph=np.minimum(1.5 * samples.photograph, 0.9))
    plain, bright = (finish.fit_finish(surface, s)[:, 0] for s in (samples, brighter))
    assert (bright >= plain - 1e-9).all()
    assert (bright > 1.1 * plain)[surface.part.numpy() == Part.PAINT].mean() > 0.9


def test_a_turned_car_is_relit(photographed: SceneIR) -> None:
    compositor = Compositor(photographed, RenderSettings("reference"))
    objects = compositor.scene.objects
    assert bool((compositor.compute_brightening(objects) == 0).all())
    live = objects.yaw.clone().requires_grad_()
    still = compositor.compute_brightening(replace(objects, yaw=live))
    assert bool((still == 0).all())
    turned = compositor.compute_brightening(replace(objects, yaw=objects.yaw + 0.3))
    assert 0.02 < float(turned.abs().max()) <= model.RELIT_MOST
    # A side that turned to the sun is brighter.
    sun = photographed.environment.sun
    normal = compositor.smooth_normals
    yaw = compositor.surfaces.per_vertex(objects.yaw)
    gained = (_turned(normal, yaw + 0.3) - _turned(normal, yaw)) @ sun
    lit = (_turned(normal, yaw) @ sun > 0.1) & (gained.abs() > 0.02)
    assert bool((turned[lit].sign() == gained[lit].sign()).all())


def _turned(vectors: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    cos, sin = yaw.cos(), yaw.sin()
    x, y, z = vectors.unbind(-1)
    return torch.stack([cos * x + sin * z, y, cos * z - sin * x], dim=-1)
