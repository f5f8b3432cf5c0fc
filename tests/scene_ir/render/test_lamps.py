"""Lamps of vehicles: which show, in which colour, what hides them, and their gradients to poses and weather."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from scene_ir.geometry import project
from scene_ir.meshes.templates import KINDS, template
from scene_ir.render import lamps, model
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import WEATHER_DIM, Category, Crop, Objects, SceneIR, Weather

ONCOMING, AHEAD = 0, 1
"""Rows of a car that faces the camera and of one that faces away."""


def _code(**amounts: float) -> Tensor:
    code = torch.zeros(WEATHER_DIM, dtype=torch.float64)
    for name, amount in amounts.items():
        code[Weather[name.upper()]] = amount
    return code


@pytest.fixture(scope="module")
def compositor(photographed: SceneIR) -> Compositor:
    return Compositor(photographed, RenderSettings(backend="reference"))


def _light(compositor: Compositor, code: Tensor, scene: SceneIR | None = None) -> Tensor:
    scene = compositor.scene if scene is None else scene
    number = compositor.render(scene).object_id
    environment = replace(compositor.scene.environment, weather=code)
    found = compositor.lamps
    return lamps.draw_lamps(found, compositor.scene, scene.objects, number, environment, compositor.centre)


def _without(compositor: Compositor, row: int) -> lamps.VehicleLamps:
    driven = compositor.lamps.driven.clone()
    driven[row] = 0.0
    return replace(compositor.lamps, driven=driven)


def test_off_in_fair_weather_and_on_by_night_and_in_fog(compositor: Compositor) -> None:
    assert not _light(compositor, _code()).any()
    assert float(lamps.lamps_on(_code())) == 0.0
    assert float(lamps.lamps_on(_code(night=1.0))) > 0.99
    assert float(lamps.lamps_on(_code(fog=1.0))) > 0.9
    assert float(lamps.lamps_on(_code(overcast=1.0))) < 0.15
    assert bool((_light(compositor, _code(fog=1.0)).amax(dim=(1, 2)) > 0.05).all())


def test_red_behind_and_white_in_front(compositor: Compositor) -> None:
    scene, number = compositor.scene, compositor.render(compositor.scene).object_id
    environment = replace(scene.environment, weather=_code(night=1.0))
    shares = {}
    for row in (ONCOMING, AHEAD):
        others = compositor.lamps.driven.clone().zero_()
        others[row] = 1.0
        own = replace(compositor.lamps, driven=others)
        light = lamps.draw_lamps(own, scene, scene.objects, number, environment, compositor.centre)
        red, green, _ = light.sum(dim=(1, 2)).tolist()
        shares[row] = green / red
        peak = light[0].flatten().argmax()
        assert int(number.flatten()[peak]) == row + 1
    assert shares[AHEAD] < 0.2
    assert shares[ONCOMING] > 0.8


def _riders(photographed: SceneIR, category: Category = Category.CYCLIST, **provenance: str) -> Compositor:
    """The two cars as the surfaces of riders, or of other people."""
    kinds = photographed.objects.category.clone()
    kinds[[ONCOMING, AHEAD]] = int(category)
    scene = replace(photographed.with_objects(category=kinds), provenance=provenance)
    return Compositor(scene, RenderSettings(backend="reference"))


def test_a_rider_has_one_lamp_at_either_end_on_the_centre_line(photographed: SceneIR) -> None:
    compositor = _riders(photographed)
    objects = compositor.scene.objects
    night = _code(night=1.0)
    everything = _light(compositor, night)
    for row, height_m, white in ((ONCOMING, 0.9, True), (AHEAD, 0.6, False)):
        own = everything - lamps.draw_lamps(
            _without(compositor, row),
            compositor.scene,
            objects,
            compositor.render(compositor.scene).object_id,
            replace(compositor.scene.environment, weather=night),
            compositor.centre,
        )
        red, green, _ = own.sum(dim=(1, 2)).tolist()
        assert (green > 0.8 * red) == white
        place = objects.translation[row] - torch.tensor([0.0, height_m, 0.0]).to(objects.translation)
        x, y = project(place[None], compositor.scene.camera.matrix)[0].tolist()
        peak = divmod(int(own[0].flatten().argmax()), own.shape[2])
        assert peak == (pytest.approx(y, abs=1.0), pytest.approx(x, abs=1.0))
    across = objects.yaw.clone()
    for row in (ONCOMING, AHEAD):
        x, _, z = objects.translation[row].tolist()
        across[row] = math.atan2(x, z)
    side = compositor.scene.with_objects(yaw=across)
    assert float(_light(compositor, night, side).sum()) < 0.1 * float(everything.sum())


@pytest.mark.parametrize(
    ("category", "provenance"), [(Category.PEDESTRIAN, {}), (Category.CYCLIST, {"places": "estimated"})]
)
def test_people_on_foot_and_riders_of_unknown_heading_have_no_lamps(
    photographed: SceneIR, category: Category, provenance: dict[str, str]
) -> None:
    compositor, night = _riders(photographed, category, **provenance), _code(night=1.0)
    codes = torch.zeros_like(compositor.scene.objects.lamps)
    codes[[ONCOMING, AHEAD]] = 1.0
    dark = compositor.scene.with_objects(lamps=-torch.ones_like(codes))
    braking = compositor.scene.with_objects(lamps=codes)
    assert not _light(compositor, night, dark).any()
    others = [row for row in range(len(codes)) if row not in (ONCOMING, AHEAD)]
    number = compositor.render(braking).object_id
    environment = replace(compositor.scene.environment, weather=night)
    driven = compositor.lamps.driven.clone()
    driven[others] = 0.0
    own = replace(compositor.lamps, driven=driven)
    lit = lamps.draw_lamps(own, compositor.scene, braking.objects, number, environment, compositor.centre)
    assert not lit.any()


def test_lamps_are_hidden_by_nearer_surfaces(compositor: Compositor) -> None:
    scene = compositor.scene
    number = compositor.render(scene).object_id
    environment = replace(scene.environment, weather=_code(night=1.0))
    hidden = torch.where(number == AHEAD + 1, 0, number)
    without = lamps.draw_lamps(
        _without(compositor, AHEAD), scene, scene.objects, number, environment, compositor.centre
    )
    found = lamps.draw_lamps(compositor.lamps, scene, scene.objects, hidden, environment, compositor.centre)
    torch.testing.assert_close(found, without)


def test_parked_across_the_street_and_where_no_road_is_beyond_it(photographed: SceneIR) -> None:
    columns = torch.arange(photographed.camera.width)
    narrower = photographed.with_environment(road=photographed.environment.road * (columns > 40))
    away = replace(
        photographed.objects, yaw=photographed.objects.yaw - photographed.objects.yaw.new_tensor([3.14, 0, 0])
    )

    def driven(scene: SceneIR, objects: Objects) -> list[bool]:
        return [bool(lamps.is_driven(scene, objects, i) > 0.5) for i in range(len(objects))]

    # the third stands across; the first is oncoming in the next lane, or on the left of the street
    assert driven(photographed, photographed.objects) == [True, True, False]
    assert driven(narrower, photographed.objects) == [True, True, False]
    assert driven(photographed, away) == [True, True, False]
    assert driven(narrower, away) == [False, True, False]


def test_fog_spreads_the_light_and_dims_the_lamp(compositor: Compositor) -> None:
    clear, foggy = (_light(compositor, _code(night=1.0, fog=fog)) for fog in (0.0, 1.0))
    assert float(foggy.amax()) < float(clear.amax())
    peak = int(clear[0].flatten().argmax())
    row, column = divmod(peak, clear.shape[2])
    away = (row, min(column + 12, clear.shape[2] - 1))
    assert float(foggy[0][away] / foggy.amax()) > 1.2 * float(clear[0][away] / clear.amax())


def test_a_wet_road_mirrors_them_below(compositor: Compositor) -> None:
    dry, wet = (_light(compositor, _code(night=1.0, rain=rain)) for rain in (0.0, 1.0))
    road = compositor.scene.environment.road > 0.5
    mirrored = (wet - dry).sum(dim=0)
    assert float(mirrored[road].sum()) > 0.1
    assert float(mirrored[road].amax()) > float(mirrored[~road].amax())


def test_on_the_photographs_own_lamp(photographed: SceneIR, compositor: Compositor) -> None:
    still = replace(compositor.lamps, shift_m=torch.zeros_like(compositor.lamps.shift_m))
    xy, *_ = lamps.project_lamps(still, photographed, photographed.objects, compositor.centre)
    place = xy[AHEAD, 3].round().long() + torch.tensor([0, 1])
    source = photographed.objects.source[AHEAD]
    values, corner = source.foreground.values.clone(), [source.foreground.x0, source.foreground.y0]
    columns, rows = (slice(int(v) - 2, int(v) + 3) for v in place - torch.tensor(corner))
    values[:, rows, columns] = torch.tensor([0.9, 0.1, 0.1, 1.0], dtype=torch.float64)[:, None, None]
    sources = list(photographed.objects.source)
    sources[AHEAD] = replace(source, foreground=replace(source.foreground, values=values))
    painted = replace(photographed.objects, source=tuple(sources))
    found = lamps.find_lamps(photographed, painted, compositor.centre)
    now, *_ = lamps.project_lamps(found, photographed, painted, compositor.centre)
    assert now[AHEAD, 3].tolist() == pytest.approx(place.tolist(), abs=0.5)
    unmoved = found.shift_m[AHEAD, :2]
    assert not unmoved.any()  # its headlamps are not in the photograph


def test_a_code_switches_them_off_and_brakes(compositor: Compositor) -> None:
    scene = compositor.scene

    def red_light(code: float, night: float) -> float:
        lamps_code = torch.zeros(3, dtype=torch.float64)
        lamps_code[AHEAD] = code
        perturbed = scene.with_objects(lamps=lamps_code)
        return float(_light(compositor, _code(night=night), perturbed)[0].sum())

    assert red_light(0.0, 0.0) == 0.0
    assert red_light(1.0, 0.0) > red_light(0.5, 0.0) > 0.05
    assert red_light(-1.0, 1.0) < red_light(0.0, 1.0) < red_light(1.0, 1.0)
    without = lamps.draw_lamps(
        _without(compositor, AHEAD), scene, scene.objects, compositor.render(scene).object_id,
        replace(scene.environment, weather=_code(night=1.0)), compositor.centre,
    )  # fmt: skip
    assert red_light(-1.0, 1.0) == pytest.approx(float(without[0].sum()), rel=0.01)


def test_brake_lamps_by_day_change_their_surroundings_only(photographed: SceneIR) -> None:
    compositor = Compositor(photographed, RenderSettings(backend="reference"))
    code = torch.zeros(3, dtype=torch.float64)
    code[AHEAD] = 1.0
    change = compositor.render(photographed.with_objects(lamps=code)).image - compositor.render(photographed).image
    assert float(change.amin()) > -1e-9
    assert float(change[0].amax()) > 0.1
    assert float(change[:, :10].abs().amax()) < 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_templates_know_their_lamps(kind: str) -> None:
    places = lamps.find_lamp_places(template(kind))
    front, rear = places[:2], places[2:]
    assert bool((front[:, 0] > 0.3).all() and (rear[:, 0] < -0.3).all())
    assert bool((places[[0, 2], 2] > 0.15).all() and (places[[1, 3], 2] < -0.15).all())
    assert bool((places[:, 1] < -0.1).all() and (places[:, 1] > -0.95).all())


def test_gradients_to_poses_and_weather_are_those_of_differences(compositor: Compositor) -> None:
    scene = compositor.scene
    number = compositor.render(scene).object_id
    weights = torch.randn(3, *number.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def total(move: Tensor, turn: Tensor, bend: Tensor, code: Tensor, on: Tensor) -> Tensor:
        objects = scene.objects
        moved = replace(
            objects,
            translation=objects.translation + move,
            yaw=objects.yaw + turn,
            ffd=objects.ffd + bend[:, None, None],
            lamps=on,
        )
        environment = replace(scene.environment, weather=code)
        found = lamps.draw_lamps(compositor.lamps, scene, moved, number, environment, compositor.centre)
        return (found * weights).sum()

    count = len(scene.objects)
    start = [torch.zeros(count, n, dtype=torch.float64).squeeze(1) for n in (3, 1, 1)]
    start.append(torch.tensor([0.3, -0.4, 0.1], dtype=torch.float64))
    start.insert(3, _code(fog=0.3, rain=0.4, time=0.1, overcast=0.2, night=0.6))
    assert torch.autograd.gradcheck(total, [t.requires_grad_() for t in start])


def test_both_backends_draw_them_alike(photographed: SceneIR) -> None:
    code = _code(night=1.0, rain=0.5, overcast=0.5)
    pictures = [
        Compositor(photographed, RenderSettings(backend=backend))
        .render(photographed.with_environment(weather=code))
        .image.double()
        for backend in ("reference", "warp")
    ]
    assert float((pictures[0] - pictures[1]).abs().amax()) < 2e-3
    dark = photographed.with_environment(weather=code)
    compositor = Compositor(photographed, RenderSettings(backend="reference"))
    compositor.lamps = replace(compositor.lamps, driven=torch.zeros_like(compositor.lamps.driven))
    assert float((compositor.render(dark).image - pictures[0]).abs().amax()) > 10 * 2e-3
    assert model.LAMPS_ON[Weather.NIGHT] > 0


def _rear(paint: tuple[float, float, float], lamp: tuple[float, float, float]) -> Crop:
    """A vehicle of 40 x 60 px at (100, 50) with lamps at its left and right."""
    values = torch.tensor([*paint, 1.0])[:, None, None].repeat(1, 40, 60)
    for x in (6, 54):
        values[:3, 16:22, x - 3 : x + 3] = torch.tensor(lamp)[:, None, None]
    return Crop(values, 100, 50)


@pytest.mark.parametrize(
    ("paint", "lamp", "rear"),
    [
        ((0.4, 0.4, 0.45), (0.8, 0.1, 0.1), True),
        ((0.4, 0.4, 0.45), (0.9, 0.9, 0.9), False),
        ((0.7, 0.1, 0.1), (0.9, 0.9, 0.9), False),
        ((0.7, 0.1, 0.1), (0.8, 0.1, 0.1), False),
    ],
)
def test_red_lamps_of_a_vehicle_of_another_colour_are_tail_lamps(
    paint: tuple[float, float, float], lamp: tuple[float, float, float], rear: bool
) -> None:
    places = torch.tensor([[106.0, 69.0], [154.0, 69.0]])
    assert lamps._are_red(_rear(paint, lamp), places, 8.0) is rear
