"""Vehicles exchanged, added and taken away: what the picture shows, what stays, and what a file keeps."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.exchange import CHANGE_KEY, Vehicle, add_roof_load, add_vehicle, remove_vehicle, replace_vehicle
from scene_ir.files import read_json, write_json
from scene_ir.io import load_scene, save_scene
from scene_ir.meshes.templates import ROOF_LOADS, make_roof_load, template
from scene_ir.removal import remove_objects
from scene_ir.render.compositor import Compositor, render_batch
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Category, SceneIR, convert_scene

BEFORE_ANOTHER = torch.tensor([0.3, 1.65, 7.0])
"""A place nearer than all three cars, before the last."""


@pytest.fixture(scope="module")
def scene(photographed: SceneIR) -> SceneIR:
    return convert_scene(photographed, torch.float32)


def vehicle(place: torch.Tensor, paint: tuple[float, float, float] | None = (0.1, 0.1, 0.5)) -> Vehicle:
    size = torch.tensor([4.1, 1.5, 1.75])
    return Vehicle(template("hatchback"), Category.CAR, place, torch.tensor(1.4), size, paint)


def picture(scene: SceneIR) -> torch.Tensor:
    return Compositor(scene).render(scene).image


@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_car_that_left_shows_what_its_removal_shows(scene: SceneIR, row: int) -> None:
    left = remove_vehicle(scene, row)
    assert torch.equal(picture(left), picture(remove_objects(scene, [row])))
    assert len(left.objects) == len(scene.objects)
    assert left.origin is scene
    assert float(left.objects.translation[row, 2]) < 0


def test_the_scene_before_is_drawn_too_and_the_other_way_refused(scene: SceneIR) -> None:
    left = remove_vehicle(scene, 0)
    compositor = Compositor(left)
    assert torch.equal(compositor.render(left.as_photographed()).image, picture(scene))
    assert not torch.equal(compositor.render(left).image, picture(scene))
    with pytest.raises(RangeError, match="exchanged"):
        Compositor(scene).render(left)


def test_states_in_one_go_are_those_drawn_one_by_one(scene: SceneIR) -> None:
    left = remove_vehicle(scene, 0)
    compositor = Compositor(left)
    pairs = [(compositor, left), (compositor, left.as_photographed())]
    for (one, state), found in zip(pairs, render_batch(pairs), strict=True):
        assert torch.equal(found.image, one.render(state).image)
    with pytest.raises(RangeError, match="exchanged"):
        render_batch([(Compositor(scene), left), (compositor, left)])


def test_a_vehicle_comes_where_none_was(scene: SceneIR) -> None:
    empty = remove_objects(scene, range(len(scene.objects)))
    one = add_vehicle(empty, vehicle(torch.tensor([0.3, 1.65, 12.0])))
    assert len(one.objects) == 1
    assert not torch.equal(picture(one), picture(empty))


def test_numbers_of_any_precision_draw_the_same(scene: SceneIR) -> None:
    """Kernels read memory as float32."""
    for name in ("background", "depth"):
        mixed = replace(scene, **{name: getattr(scene, name).double()})
        drawn, wanted = (Compositor(one).render(one) for one in (mixed, scene))
        assert torch.equal(drawn.image, wanted.image)
        assert torch.equal(drawn.depth, wanted.depth)


def test_at_rest_keeps_the_change_and_as_photographed_does_not(scene: SceneIR) -> None:
    left = remove_vehicle(scene, 1)
    moved = left.with_objects(yaw=left.objects.yaw + 0.1)
    assert torch.equal(picture(moved.unperturbed()), picture(left))
    assert torch.equal(picture(moved.as_photographed()), picture(scene))
    assert CHANGE_KEY in left.provenance
    assert CHANGE_KEY not in moved.as_photographed().provenance


def test_one_more_stands_there_and_hides_what_is_behind(scene: SceneIR) -> None:
    more = add_vehicle(scene, vehicle(BEFORE_ANOTHER))
    assert len(more.objects) == len(more.origin.objects) == len(scene.objects) + 1
    assert torch.equal(picture(more.origin), picture(scene))  # the photograph, to the bit
    pictures = Compositor(more).render(more)
    assert int((pictures.object_id == 4).sum()) > 300
    assert int((pictures.object_id == 3).sum()) < int((Compositor(scene).render(scene).object_id == 3).sum())
    away = torch.ones_like(pictures.depth, dtype=torch.bool)
    for crop in (pictures.opacity[3], more.objects.source[3].shadow):
        assert crop is not None
        h, w = crop.values.shape[1:]
        away[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] = False
    assert torch.equal(pictures.image[:, away], picture(scene)[:, away])


def test_it_casts_a_shadow_and_wears_its_paint(scene: SceneIR) -> None:
    blue, red = (add_vehicle(scene, vehicle(BEFORE_ANOTHER, p)) for p in ((0.05, 0.05, 0.7), (0.7, 0.05, 0.05)))
    own = Compositor(blue).render(blue).object_id == 4
    less = picture(blue)[:, own].mean(1) - picture(red)[:, own].mean(1)
    assert less[2] > 0.1 > -0.1 > less[0]
    shadow = blue.objects.source[3].shadow
    assert shadow is not None
    h, w = shadow.values.shape[1:]
    ground = torch.zeros_like(own)
    ground[shadow.y0 : shadow.y0 + h, shadow.x0 : shadow.x0 + w] = shadow.values.amax(0) < 0.8
    ground &= Compositor(blue).render(blue).object_id == 0
    assert ground.any()
    assert picture(blue)[:, ground].mean() < 0.85 * picture(scene)[:, ground].mean()


def test_it_is_as_bright_as_the_road_is_there(scene: SceneIR) -> None:
    half = scene.camera.width // 2
    shade = torch.ones(scene.camera.width)
    shade[half:] = 0.4
    shaded = replace(scene, background=scene.background * shade)
    left, right = torch.tensor([-3.0, 1.65, 7.0]), torch.tensor([3.0, 1.65, 7.0])
    bright = {}
    for name, street in (("sun", scene), ("shade", shaded)):
        for side, place in (("left", left), ("right", right)):
            rgba = add_vehicle(street, vehicle(place, (0.5, 0.5, 0.5))).objects.source[3].foreground.values
            bright[name, side] = float(rgba[:3].sum() / rgba[3].sum())
    assert bright["shade", "right"] < 0.8 * bright["sun", "right"]
    assert bright["shade", "left"] > 0.9 * bright["sun", "left"]


def test_another_takes_a_cars_place_and_its_row(scene: SceneIR) -> None:
    other = replace_vehicle(scene, 1, vehicle(scene.objects.translation[1]))
    assert len(other.objects) == len(scene.objects)
    assert other.meshes[int(other.objects.mesh_index[1])].name == "hatchback-0"
    pictures = Compositor(other).render(other)
    assert int((pictures.object_id == 2).sum()) > 300
    sources = [0, 2]
    assert torch.equal(other.objects.translation[sources], scene.objects.translation[sources])
    # Nothing of the old car is left outside the new one.
    bare = picture(remove_vehicle(scene, 1))
    outside = (pictures.object_id == 0) & (Compositor(scene).render(scene).object_id == 2)
    brighter = (pictures.image - bare)[:, outside].clamp(min=0)
    assert outside.any()
    assert float(brighter.mean()) < 0.005  # edges apart


def test_a_smaller_one_shows_what_the_old_car_hid(scene: SceneIR) -> None:
    row = 1
    small = replace(vehicle(scene.objects.translation[row]), size_lhw=torch.tensor([1.5, 0.8, 0.8]))
    other, bare = replace_vehicle(scene, row, small), remove_vehicle(scene, row)
    pictures, before = (Compositor(s).render(s) for s in (other, scene))
    behind = (before.object_id == row + 1) & (pictures.object_id != row + 1) & (pictures.object_id > 0)
    assert int(behind.sum()) > 20
    assert float((pictures.image - picture(bare))[:, behind].abs().mean()) < 0.005  # edges of the small one


def test_both_renderers_draw_the_same(scene: SceneIR) -> None:
    for changed in (remove_vehicle(scene, 0), add_vehicle(scene, vehicle(BEFORE_ANOTHER))):
        fast, slow = (Compositor(changed, RenderSettings(b)).render(changed).image for b in ("warp", "reference"))
        assert float((fast - slow).abs().max()) < 2e-3


def test_a_new_car_moves_with_a_gradient(scene: SceneIR) -> None:
    more = add_vehicle(scene, vehicle(BEFORE_ANOTHER))
    yaw = more.objects.yaw.clone().requires_grad_(True)
    Compositor(more).render(more.with_objects(yaw=yaw)).image.sum().backward()
    assert yaw.grad is not None
    assert float(yaw.grad[3].abs()) > 0


def test_a_file_keeps_both_scenes(scene: SceneIR, tmp_path: Path) -> None:
    more = add_vehicle(scene, vehicle(BEFORE_ANOTHER))
    moved = more.with_objects(yaw=more.objects.yaw + 0.05)
    save_scene(moved, tmp_path / "scene")
    back = load_scene(tmp_path / "scene")
    assert back.provenance[CHANGE_KEY] == more.provenance[CHANGE_KEY]
    assert torch.equal(picture(back), picture(moved))
    assert torch.equal(picture(back.as_photographed()), picture(scene))
    assert torch.equal(picture(back.unperturbed()), picture(more))


def test_damaged_scene_before_is_refused(scene: SceneIR, tmp_path: Path) -> None:
    save_scene(scene, tmp_path / "scene")
    record = read_json(tmp_path / "scene" / "scene.json")
    assert isinstance(record, dict)
    assert record["before"] is False
    write_json(tmp_path / "scene" / "scene.json", record | {"before": "no"})
    with pytest.raises(FormatError, match="before: expected true or false"):
        load_scene(tmp_path / "scene")


def test_what_cannot_be_changed_is_refused(scene: SceneIR) -> None:
    with pytest.raises(RangeError, match="row from 0 to 2"):
        remove_vehicle(scene, 3)
    with pytest.raises(RangeError, match="exchanged yet"):
        remove_vehicle(remove_vehicle(scene, 0), 1)
    with pytest.raises(RangeError, match="one entry an object"):
        add_vehicle(scene.with_objects(source=()), vehicle(BEFORE_ANOTHER))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ShapeError, match="before"):
        replace(scene, before=remove_objects(scene, [0]))


def test_a_load_stands_on_its_car_and_nothing_else_changes(scene: SceneIR) -> None:
    row = 1
    box = make_roof_load("crate", scene.meshes[row], scene.objects.size_lhw[row])
    loaded = add_roof_load(scene, row, box)
    before, after = (Compositor(s).render(s) for s in (scene, loaded))
    changed = (before.image - after.image).abs().amax(0) > 1e-3
    assert int(changed.sum()) > 100
    own = after.object_id == row + 1
    near = torch.nn.functional.max_pool2d(own[None].float(), 7, 1, 3)[0]  # edges and the lens
    assert float(near[changed].mean()) > 0.98
    # It is above the car, and on it: of its columns hardly one shows a gap.
    columns = (changed & own).any(0).nonzero()[:, 0]
    gaps = [int((~own[:, x])[own[:, x].nonzero().min() : own[:, x].nonzero().max()].sum()) for x in columns]
    assert sum(gap > 2 for gap in gaps) < 0.3 * len(gaps)
    top = int(own.any(1).nonzero().min())
    assert top < int((before.object_id == row + 1).any(1).nonzero().min()) - 3
    assert len(loaded.meshes) == len(scene.meshes) + 1


def test_a_load_goes_where_its_car_goes(scene: SceneIR) -> None:
    loaded = add_roof_load(scene, 1, make_roof_load("roof box", scene.meshes[1], scene.objects.size_lhw[1]))
    step = torch.zeros(3, 3)
    step[1, 0] = 0.5
    tops = []
    for state in (loaded, loaded.with_objects(translation=loaded.objects.translation + step)):
        own = Compositor(state).render(state).object_id == 2
        tops.append(own[: int(own.any(1).nonzero().min()) + 3].any(0).nonzero().float().mean())
    assert 3 < float(tops[1] - tops[0]) < 8  # 0.5 m at 10.5 m and 110 px


@pytest.mark.parametrize("kind", ROOF_LOADS)
def test_a_load_is_above_the_roof_and_within_the_car(kind: str) -> None:
    made = make_roof_load(kind, template("sedan"), (4.5, 1.45, 1.8))
    low, high = made.vertices.amin(0), made.vertices.amax(0)
    assert -1.5 < float(low[1]) < -1.15
    assert -1 < float(high[1]) < -0.9
    assert float(low[0]) > -0.5
    assert float(high[0]) < 0.5
    assert float(high[2]) == pytest.approx(-float(low[2]), abs=1e-4)
    assert float(high[2]) < 0.45
