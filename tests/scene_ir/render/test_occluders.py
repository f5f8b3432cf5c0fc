"""Occluders: drawn over vehicles behind them, under those in front, and part of none."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from drivesem.attacks.labels import hidden_shares
from scene_ir.errors import FormatError, RangeError
from scene_ir.files import read_json, write_json
from scene_ir.io import load_scene, save_scene
from scene_ir.raster.verbs import Backend
from scene_ir.removal import remove_objects
from scene_ir.render import blend
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.sources import SolveSettings, analytic_shadows, solve_sources
from scene_ir.types import Crop, Occluder, SceneIR, convert_scene

POLE_M = 6.0
"""Nearer than all cars of the small street, the nearest of which stands at 9 m."""
COLOUR = (0.9, 0.8, 0.2)


def with_pole(scene: SceneIR, backend: Backend, depth_m: float = POLE_M) -> SceneIR:
    """The street photographed with an upright pole in front of its first car's centre, and decomposed."""
    settings = RenderSettings(backend=backend)
    shot = Compositor(scene, settings).render(scene)
    height, width = scene.depth.shape
    car = shot.opacity[0]
    middle = car.x0 + car.values.shape[2] // 2
    alpha = scene.depth.new_zeros(height, width)
    alpha[4 : height - 4, middle - 1 : middle + 2] = 1.0
    alpha[4 : height - 4, [middle - 2, middle + 2]] = 0.4
    colour = scene.depth.new_tensor(COLOUR)[:, None, None]
    photograph = ((shot.image + (colour - shot.image) * alpha) * 255).round() / 255
    background = ((scene.background + (colour - scene.background) * alpha) * 255).round() / 255
    clear = alpha <= 0.0
    mattes = list(shot.opacity)
    for i in (1, 0, 2):
        crop = shot.opacity[i]
        h, w = crop.values.shape[1:]
        window = (slice(crop.y0, crop.y0 + h), slice(crop.x0, crop.x0 + w))
        mattes[i] = Crop(crop.values * clear[window], crop.x0, crop.y0)
        clear[window] &= crop.values[0] <= 0.0
    pole = Occluder(Crop(torch.cat([torch.zeros_like(photograph), alpha[None]]), 0, 0), depth_m)
    taken = replace(scene, photograph=photograph, background=background, occluders=(pole,))
    return solve_sources(taken, mattes, analytic_shadows(scene, settings), SolveSettings(backend=backend))


@pytest.fixture(scope="module")
def pole(street: Callable[[torch.dtype], SceneIR]) -> SceneIR:
    return with_pole(street(torch.float64), "reference")


@pytest.fixture(scope="module")
def fast_pole(street: Callable[[torch.dtype], SceneIR]) -> SceneIR:
    return with_pole(street(torch.float32), "warp")


def levels(image: Tensor) -> Tensor:
    return (image.detach().clamp(0, 1) * 255).round()


def solid(scene: SceneIR) -> Tensor:
    """Pixels (H, W) fully covered by the pole."""
    crop = scene.occluders[0].foreground
    return on_frame(replace(crop, values=crop.values[3:]), scene.depth.shape) >= 1.0


def shifted(scene: SceneIR, row: int, metres: tuple[float, float]) -> SceneIR:
    """One car moved (x, z) m."""
    translation = scene.objects.translation.clone()
    translation[row] += translation.new_tensor([metres[0], 0.0, metres[1]])
    return scene.with_objects(translation=translation)


@pytest.mark.parametrize("name", ["pole", "fast_pole"])
def test_unperturbed_render_is_the_photograph(name: str, request: pytest.FixtureRequest) -> None:
    scene: SceneIR = request.getfixturevalue(name)
    backend: Backend = "reference" if name == "pole" else "warp"
    found = Compositor(scene, RenderSettings(backend)).render(scene)
    assert torch.equal(levels(found.image), levels(scene.photograph))
    assert bool((found.object_id[solid(scene)] == 0).all())
    assert int(found.object_id.max()) <= len(scene.objects)
    assert len(found.opacity) == len(scene.objects)


def test_car_moved_behind_the_pole_has_no_hole(
    fast_pole: SceneIR, street: Callable[[torch.dtype], SceneIR]
) -> None:
    found = Compositor(fast_pole).render(shifted(fast_pole, 0, (0.6, 0.0)))
    mask = solid(fast_pole)
    assert torch.equal(levels(found.image)[:, mask], levels(fast_pole.photograph)[:, mask])
    # Where the pole stood before the car in the photograph there is no hole in the moved car.
    bare = street(torch.float32)
    whole = Compositor(bare).render(shifted(bare, 0, (0.6, 0.0)))
    own, other = on_frame(found.opacity[0], mask.shape), on_frame(whole.opacity[0], mask.shape)
    assert float(own[other >= 1.0].double().quantile(0.02)) > 0.9
    assert bool((mask & (other >= 1.0)).any())


def on_frame(crop: Crop, size_hw: Sequence[int]) -> Tensor:
    """A one-channel crop on the whole frame (H, W), 0 outside it."""
    frame = crop.values.new_zeros(*size_hw)
    h, w = crop.values.shape[1:]
    frame[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] = crop.values[0]
    return frame


def test_car_in_front_of_a_far_pole_hides_it(street: Callable[[torch.dtype], SceneIR]) -> None:
    near, far = (with_pole(street(torch.float32), "warp", depth) for depth in (POLE_M, 30.0))
    mask = solid(near)
    ids = [Compositor(s).render(shifted(s, 0, (0.6, 0.0))).object_id[mask] for s in (near, far)]
    assert bool((ids[0] == 0).all())
    assert bool((ids[1] == 1).any())
    assert torch.equal(levels(Compositor(far).render(far).image), levels(far.photograph))


def test_pole_hides_a_share_of_the_car(fast_pole: SceneIR, street: Callable[[torch.dtype], SceneIR]) -> None:
    bare = replace(fast_pole, occluders=())
    shares = [hidden_shares(Compositor(s).render(s)) for s in (fast_pole, bare)]
    assert float(shares[0][0]) > float(shares[1][0])


def test_gradients_agree_with_the_reference(fast_pole: SceneIR) -> None:
    gradients = []
    for backend in ("reference", "warp"):
        scene = convert_scene(fast_pole, torch.float64) if backend == "reference" else fast_pole
        moved = shifted(scene, 0, (0.21, 0.13))
        leaves = [
            moved.objects.translation.clone().requires_grad_(),
            moved.environment.weather.new_tensor([0.3, 0.1, 0.2, 0.1]).requires_grad_(),
            moved.environment.foliage.new_tensor([0.3, -0.2, 0.1]).requires_grad_(),
        ]
        perturbed = moved.with_objects(translation=leaves[0])
        perturbed = perturbed.with_environment(weather=leaves[1], foliage=leaves[2])
        image = Compositor(scene, RenderSettings(backend)).render(perturbed).image
        weight = torch.sin(torch.arange(image.numel(), dtype=torch.float64)).reshape(image.shape).to(image)
        gradients.append(torch.autograd.grad((image * weight).sum(), leaves))
    for slow, fast in zip(*gradients, strict=True):
        torch.testing.assert_close(fast.double(), slow, rtol=2e-2, atol=2e-2 * float(slow.abs().max()))


def test_season_changes_a_pole_with_leaves(fast_pole: SceneIR) -> None:
    leafy = fast_pole.with_environment(foliage_map=torch.ones_like(fast_pole.depth))
    autumn = leafy.with_environment(foliage=torch.tensor([0.8, 0.0, 0.0]))
    found = Compositor(leafy).render(autumn).image
    mask = solid(fast_pole)
    assert float((found - fast_pole.photograph).abs()[:, mask].amax(dim=0).median()) > 0.05
    # Season alone: the pole looks as the same pixels of the background do.
    bare = replace(remove_objects(leafy, [0, 1, 2]), occluders=())
    alone = Compositor(bare).render(bare.with_environment(foliage=autumn.environment.foliage)).image
    assert float((found - alone).abs()[:, mask].max()) < 1e-5


def test_fog_veils_the_pole_by_its_distance(street: Callable[[torch.dtype], SceneIR]) -> None:
    near, far = (with_pole(street(torch.float32), "warp", depth) for depth in (2.0, POLE_M))
    pictures = []
    for scene in (near, far):
        foggy = scene.with_environment(weather=torch.tensor([1.0, 0.0, 0.0, 0.0]))
        pictures.append(Compositor(scene).render(foggy).image[:, solid(near)])
    air = torch.tensor([0.78, 0.82, 0.87])[:, None]
    assert float((pictures[0] - air).abs().mean()) > float((pictures[1] - air).abs().mean())


def test_the_pole_remains_when_a_car_is_removed(fast_pole: SceneIR) -> None:
    for rows in ([0], [0, 1, 2]):
        scene = remove_objects(fast_pole, rows)
        image = Compositor(scene).render(scene).image
        mask = solid(fast_pole)
        assert torch.equal(levels(image)[:, mask], levels(fast_pole.photograph)[:, mask])
        # Nor does the car's colour stay in the pole's soft border: it lies between pole and background.
        crop = fast_pole.occluders[0].foreground
        alpha = on_frame(replace(crop, values=crop.values[3:]), mask.shape)
        soft = (alpha > 0) & (alpha < 1)
        colour = image.new_tensor(COLOUR)[:, None]
        low = torch.minimum(colour, fast_pole.background[:, soft]) - 0.05
        high = torch.maximum(colour, fast_pole.background[:, soft]) + 0.05
        inside = ((image[:, soft] >= low) & (image[:, soft] <= high)).all(dim=0)
        assert float(inside.double().mean()) > 0.95


def test_scene_folder_stores_occluders(fast_pole: SceneIR, tmp_path: Path) -> None:
    save_scene(fast_pole, tmp_path / "scene")
    found = load_scene(tmp_path / "scene")
    assert len(found.occluders) == 1
    assert found.occluders[0].depth_m == fast_pole.occluders[0].depth_m
    assert (found.occluders[0].foreground.x0, found.occluders[0].foreground.y0) == (
        fast_pole.occluders[0].foreground.x0,
        fast_pole.occluders[0].foreground.y0,
    )
    assert torch.equal(found.occluders[0].foreground.values, fast_pole.occluders[0].foreground.values)
    record = read_json(tmp_path / "scene" / "scene.json")
    record["front"][0]["depth_m"] = -1.0
    write_json(tmp_path / "scene" / "scene.json", record)
    with pytest.raises(FormatError, match="depth_m"):
        load_scene(tmp_path / "scene")


def test_occluder_depth_is_validated() -> None:
    with pytest.raises(RangeError, match=r"occluder\.depth_m"):
        Occluder(Crop(torch.zeros(4, 2, 2), 0, 0), 0.0)


def test_occluders_follow_the_last_object_they_can_hide() -> None:
    size = torch.tensor([[4.0, 1.5, 1.8]] * 2)
    place = torch.tensor([[0.0, 1.6, 20.0], [0.0, 1.6, 10.0]])
    matrix = torch.tensor([[700.0, 0.0, 100.0, 0.0], [0.0, 700.0, 50.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    occluders = [Occluder(Crop(torch.zeros(4, 4, 3), 99, 40), depth) for depth in (15.0, 5.0, 30.0)]
    feet = blend.occluder_footprints(occluders, matrix)
    order = blend.paint_order(size, torch.zeros(2), place, torch.zeros(3), feet)
    assert order == [4, 0, 2, 1, 3]
    assert blend.paint_order(size, torch.zeros(2), place, torch.zeros(3)) == [0, 1]
