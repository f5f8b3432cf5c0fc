"""The generator as a second renderer, on an embedded scene: pictures, labels, and vehicles without counterpart."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from detectors.types import CLASSES
from drivesem.config.errors import UsageError
from drivesem.data.kitti import read_labels
from drivesem.failures.second_renderer.generator import (
    DemoPlans,
    FolderPlans,
    GeneratorRenderer,
    PlanMatch,
    label_before_and_after,
    transfer_edit,
)
from drivesem.synth.demo import demo_scene
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import Plan, SynthSettings, plan_frame, render_frame, yaw_in_camera
from drivesem.synth.layout import Actor, LayoutSettings
from drivesem.synth.write import Order, synthesise
from scene_ir import ffd, files
from scene_ir.errors import FormatError
from scene_ir.geometry import project, yaw_matrix
from scene_ir.types import LATTICE, SceneIR, Weather

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
    visible, labels = drawn.visible_xyxy, drawn.targets.boxes_xyxy[: len(scene.objects)]
    assert (visible[:, :2] >= labels[:, :2] - 1e-4).all()
    assert (visible[:, 2:] <= labels[:, 2:] + 1e-4).all()
    torch.testing.assert_close(visible[clearest(scene)], labels[clearest(scene)], atol=1.0, rtol=0)


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
    with pytest.raises(FormatError, match="photograph of demo-000: expected the image that the generator renders"):
        GeneratorRenderer("demo-000", darker, DemoPlans())


def test_a_state_that_was_changed_already_is_known_by_its_origin(
    scene: SceneIR, generator: GeneratorRenderer
) -> None:
    changed = moved(scene, clearest(scene), AHEAD_M, 0.0)
    drawn = GeneratorRenderer("demo-000", changed, DemoPlans()).render(changed)
    np.testing.assert_array_equal(drawn.image.numpy(), generator.render(changed).image.numpy())


COUNT = 3
TURNED_RAD = 0.2
"""Of the camera, so that its axes are not the world's."""


@pytest.fixture(scope="module")
def plan() -> Plan:
    from drivesem.synth.variations import fix_light_in_world, turned

    settings = SynthSettings(LayoutSettings(people=False, vehicles=(6, 8)), sunny=True)
    found = plan_frame(9, 2, settings=settings)
    view = turned(found.setting.view, TURNED_RAD)
    light = fix_light_in_world(found.setting.light, found.setting.view, view)
    from dataclasses import replace

    return replace(found, setting=replace(found.setting, view=view, light=light))


def spot(plan: Plan, actor: Actor) -> np.ndarray:
    x, z = actor.position_xz
    return plan.setting.view.to_camera(np.array([x, 0.0, z]))


@pytest.fixture
def street_scene(plan: Plan, street: Callable[..., SceneIR]) -> SceneIR:
    """The plan's first vehicles as a scene of a street has them."""
    actors = plan.actors[:COUNT]
    poses = torch.tensor(np.stack([spot(plan, a) for a in actors]), dtype=torch.float64)
    yaws = torch.tensor([yaw_in_camera(a, plan.setting.view) for a in actors], dtype=torch.float64)
    found = street([(0.0, 9.0 + 6 * i) for i in range(COUNT)], dtype=torch.float64)
    return found.with_objects(translation=poses, yaw=yaws)


def match_tracks(plan: Plan, *tracks: int | None) -> PlanMatch:
    return PlanMatch(plan, tracks)


def tracks_of(plan: Plan) -> list[int]:
    return [a.track for a in plan.actors[:COUNT]]


def test_vehicles_go_the_same_way(plan: Plan, street_scene: SceneIR) -> None:
    moves = plan.setting.view.rotation @ np.array([[0.5, 0.0, -0.3], [-0.2, 0.0, 0.9], [0.0, 0.0, 0.0]]).T
    turns = torch.tensor([0.1, -0.25, 0.0], dtype=torch.float64)
    changed = street_scene.with_objects(
        translation=street_scene.objects.translation + torch.from_numpy(moves.T.copy()),
        yaw=street_scene.objects.yaw + turns,
    )
    found = transfer_edit(street_scene, changed, match_tracks(plan, *tracks_of(plan)))
    assert found.missing == ()
    after = apply_edit(plan, found.edit)
    for i, actor in enumerate(after.actors[:COUNT]):
        assert spot(after, actor) == pytest.approx(changed.objects.translation[i].numpy(), abs=1e-6)
        apart = yaw_in_camera(actor, plan.setting.view) - float(changed.objects.yaw[i])
        assert math.remainder(apart, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    assert after.actors[COUNT:] == plan.actors[COUNT:]


def test_the_sun_is_carried(plan: Plan, street_scene: SceneIR) -> None:
    changed = street_scene.with_environment(light=torch.tensor([0.5, -1.0, 0.25]))
    found = transfer_edit(street_scene, changed, match_tracks(plan, *tracks_of(plan)))
    assert (found.edit.sun, found.missing) == ((0.5, -1.0, 0.25), ())


def test_vehicles_grow_by_the_same_share(plan: Plan, street_scene: SceneIR) -> None:
    factors = torch.tensor([1.1, 0.95, 1.0], dtype=torch.float64)
    changed = street_scene.with_objects(size_lhw=street_scene.objects.size_lhw * factors[:, None])
    after = apply_edit(plan, transfer_edit(street_scene, changed, match_tracks(plan, *tracks_of(plan))).edit)
    for old, new, factor in zip(plan.actors, after.actors, factors.tolist(), strict=False):
        assert new.size_lhw == pytest.approx([factor * side for side in old.size_lhw])
    assert transfer_edit(street_scene, changed, match_tracks(plan, None, None, None)).missing == tuple(
        f"objects[{i}]: the generator's plan has no such vehicle" for i in (0, 1)
    )


@pytest.mark.parametrize("behind", [False, True])
def test_the_same_metal_is_bent_whichever_way_a_fit_turned_the_car(
    behind: bool, plan: Plan, street_scene: SceneIR
) -> None:
    actor = plan.actors[0]
    if behind:
        street_scene = street_scene.with_objects(yaw=street_scene.objects.yaw + math.pi)
    code = torch.linspace(-0.05, 0.08, ffd.SYMMETRIC_DIM, dtype=torch.float64)
    offsets = street_scene.objects.ffd.clone()
    offsets[0] += ffd.from_symmetric(code)
    found = transfer_edit(
        street_scene, street_scene.with_objects(ffd=offsets), match_tracks(plan, *tracks_of(plan))
    )
    theirs = ffd.from_symmetric(torch.tensor(found.edit.objects[actor.track].mesh, dtype=torch.float64))
    size = torch.tensor(actor.size_lhw, dtype=torch.float64)
    yaw = torch.tensor(yaw_in_camera(actor, plan.setting.view), dtype=torch.float64)
    ours = (offsets[0] - street_scene.objects.ffd[0]) * size @ yaw_matrix(street_scene.objects.yaw[0]).T
    theirs = theirs * size @ yaw_matrix(yaw).T
    if behind:
        ours = ours.reshape(*LATTICE, 3).flip(0, 2).reshape(-1, 3)
    torch.testing.assert_close(theirs, ours, atol=1e-9, rtol=0)
    assert found.edit.objects[plan.actors[1].track].mesh == ()


def test_paint_weather_and_foliage(plan: Plan, street_scene: SceneIR) -> None:
    paint = street_scene.objects.texture_code.clone()
    paint[1, 0] = -0.4
    changed = street_scene.with_objects(texture_code=paint).with_environment(
        weather=torch.tensor([0.3, 0.0, 0.5, 0.0]), foliage=torch.tensor([-0.2, 0.0, 0.1])
    )
    edit = transfer_edit(street_scene, changed, match_tracks(plan, *tracks_of(plan))).edit
    assert edit.objects[plan.actors[1].track].color == pytest.approx((-0.4, 0, 0, 0, 0))
    assert edit.weather == pytest.approx((0.3, 0, 0.5, 0, 0, 0))
    assert edit.foliage == pytest.approx((-0.2, 0, 0.1))


def test_what_has_no_counterpart_is_named_where_it_was_changed(plan: Plan, street_scene: SceneIR) -> None:
    turns = torch.tensor([0.1, 0.1, 0.0], dtype=torch.float64)
    changed = street_scene.with_objects(yaw=street_scene.objects.yaw + turns)
    found = transfer_edit(street_scene, changed, match_tracks(plan, None, tracks_of(plan)[1], None))
    assert found.missing == ("objects[0]: the generator's plan has no such vehicle",)
    assert list(found.edit.objects) == [tracks_of(plan)[1]]


def test_night_snow_and_lamps_are_transferred(plan: Plan, street_scene: SceneIR) -> None:
    codes = torch.zeros(len(Weather))
    codes[Weather.NIGHT], codes[Weather.SNOW] = 0.5, 0.25
    lamps = street_scene.objects.lamps.clone()
    lamps[1] = -0.75
    changed = street_scene.with_objects(lamps=lamps).with_environment(weather=codes)
    found = transfer_edit(street_scene, changed, match_tracks(plan, *tracks_of(plan)))
    assert found.missing == ()
    assert found.edit.weather == tuple(codes.tolist())
    assert [found.edit.objects[track].lamps for track in tracks_of(plan)] == [0.0, -0.75, 0.0]
    unknown = transfer_edit(street_scene, changed, match_tracks(plan, tracks_of(plan)[0], None, None))
    assert unknown.missing == ("objects[1]: the generator's plan has no such vehicle",)


BOX = (100.0, 100.0, 160.0, 140.0)


def truth(track: int, box: tuple[float, ...] = BOX, kind: str = "Car", **changes: Any) -> Any:
    facts = {"labelled": True, "occlusion": 0, "truncation": 0.0} | changes
    actor = SimpleNamespace(track=track, label=kind)
    return SimpleNamespace(actor=actor, box_xyxy=np.array(box, float), **facts)


def frame(*truths: Any, ignore: tuple[tuple[float, ...], ...] = ()) -> Any:
    return SimpleNamespace(
        truths=truths, labels=SimpleNamespace(ignore_xyxy=torch.tensor(ignore, dtype=torch.float32).reshape(-1, 4))
    )


def ahead(step: float) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = BOX
    return x0 + step, y0, x1 + step, y1


def test_what_is_too_hard_before_or_after_is_ignored() -> None:
    before = frame(
        truth(0),
        truth(1, occlusion=2),
        truth(2),
        truth(3),
        truth(4),
        truth(5, labelled=False),
        truth(6, kind="Van"),
    )
    after = frame(
        truth(0, ahead(9)), truth(1), truth(2, truncation=0.4), truth(4, labelled=False), truth(6, kind="Van")
    )
    exact = label_before_and_after(before, after)
    assert exact.tracks == (0, 1, 2, 3, 4, 6)
    assert exact.changed.ignore.tolist() == [False, True, True, True, True, False]
    assert exact.benign.boxes_xyxy[0].tolist() == list(BOX)
    assert exact.changed.boxes_xyxy[0].tolist() == list(ahead(9))
    assert exact.changed.boxes_xyxy[3].tolist() == [0, 0, 0, 0]
    assert exact.changed.labels.tolist() == [CLASSES.index("Car")] * 6


def test_people_and_what_comes_into_view_are_regions_of_both() -> None:
    person = truth(7, ahead(200), "Pedestrian")
    before = frame(truth(0), person, ignore=(ahead(400),))
    after = frame(truth(0), person, truth(8, ahead(600)), ignore=(ahead(400),))
    exact = label_before_and_after(before, after)
    for targets in (exact.benign, exact.changed):
        assert targets.ignore.tolist() == [False] + [True] * (len(targets.ignore) - 1)
    regions = exact.changed.boxes_xyxy[1:, 0].unique().tolist()
    assert regions == [BOX[0] + step for step in (200, 400, 600)]
    # each for every class
    assert len(exact.changed.labels) == 1 + len(CLASSES) * 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "streets"
    list(synthesise(Order(out, 1, seed=5, split="heldout", variations=("clone", "fog"), varied_people=True)))
    return out


def scene_of(rows: list[int], **provenance: str) -> Any:
    """What a plan needs of a scene: how many objects it has, and from which labels they come."""
    provenance |= {f"objects[{i}].label": str(row) for i, row in enumerate(rows)}
    return SimpleNamespace(objects=range(len(rows)), provenance=provenance)


@pytest.mark.parametrize("inside", ["", "training"])
def test_plans_draw_the_files(folder: Path, inside: str) -> None:
    """Each variation of a street is a frame of its own."""
    plans = FolderPlans(folder / inside)
    labels = read_labels(folder / "training" / "label_2" / "000001.txt")
    rows = [i for i, kind in enumerate(labels.kind) if kind in ("Car", "Van", "Truck")]
    found = plans.find_plan("000001", scene_of([*rows[::-1], 99]))
    assert found.plan.variation == "fog"
    assert found.tracks[-1] is None
    actors = {actor.track: actor for actor in found.plan.actors}
    for row, track in zip(rows[::-1], found.tracks[:-1], strict=True):
        assert track is not None
        assert actors[track].label == labels.kind[row]
        assert actors[track].size_lhw == pytest.approx(labels.size_lhw[row].tolist(), abs=1e-3)
    if not inside:
        frame = render_frame(found.plan)
        assert frame is not None
        written = files.read_image(folder / "training" / "image_2" / "000001.png")
        np.testing.assert_array_equal(frame.image, written)


def test_unknown_frames(folder: Path) -> None:
    for name in ("000002", "night"):
        with pytest.raises(FormatError, match=f"frame {name}"):
            FolderPlans(folder).find_plan(name, scene_of([]))


@pytest.mark.parametrize(
    ("key", "value", "error", "message"),
    [
        ("generator", 1, FormatError, "the only one that makes the same images, found 1"),
        ("layout", "coco", UsageError, "layout coco"),
        ("edits", "00ff", FormatError, "edits: expected none"),
        ("split", "tests", FormatError, "as drivesem synth writes it"),
        ("seed", None, FormatError, "as drivesem synth writes it"),
    ],
)
def test_manifests_that_cannot_be_used(
    folder: Path, tmp_path: Path, key: str, value: object, error: type[Exception], message: str
) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    if value is None:
        del manifest[key]
    else:
        manifest[key] = value
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(error, match=message):
        FolderPlans(tmp_path)


def test_photographs_are_no_generated_frames(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"which has no manifest\.json"):
        FolderPlans(tmp_path)
    (tmp_path / "manifest.json").write_text('{"name": "something else"}')
    with pytest.raises(UsageError, match=r"another program's manifest\.json"):
        FolderPlans(tmp_path)


def test_an_embedded_scene_names_its_street() -> None:
    with pytest.raises(FormatError, match="seed, index, attempt"):
        DemoPlans().find_plan("demo-000", scene_of([], seed="0", index="0"))
    with pytest.raises(FormatError, match="an embedded scene's"):
        DemoPlans().find_plan("demo-000", scene_of([], seed="0", index="0", attempt="0"))
