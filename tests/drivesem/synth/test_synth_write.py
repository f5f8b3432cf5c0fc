"""Data sets on disk, in every layout: what comes back, going on after a stop, and the same bytes each time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.config.options import WorkerOptions
from drivesem.data.registry import WRITERS, open_dataset
from drivesem.run.workers import make_parallel_map
from drivesem.synth import write
from drivesem.synth.exposure import CLASS_NAMES, expose
from drivesem.synth.frames import VARIANTS, SynthSettings, apply_variation, boxes_alone, plan_frame, render_frame
from drivesem.synth.layout import PUSHES_PRAM, LayoutSettings
from drivesem.synth.world import actor_soup
from drivesem.synth.write import Order, list_jobs, plan_job, synthesise
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.meshes.load import save_mesh
from scene_ir.meshes.templates import template

FRAMES = 2


def settings_of(layout: str, people: bool) -> SynthSettings:
    virtual = layout.startswith("vkitti")
    layouts = LayoutSettings(variants=VARIANTS["train"], people=people)
    camera = layout if layout in ("vkitti1", "vkitti2") else None
    return SynthSettings(layouts, sunny=virtual, camera=camera, sequence=2 if virtual else 1, bent=True)


def shows_vehicles(seed: int) -> bool:
    """Whether both frames of a seed show some vehicles, in both kinds of layout."""
    plans = [
        plan_frame(seed, i, settings=settings_of(layout, False)) for layout in ("kitti", "vkitti2") for i in (0, 1)
    ]
    return all(sum(t.labelled and t.visible > 0.5 for t in boxes_alone(plan)) >= 3 for plan in plans)


SEED = next(seed for seed in range(50) if shows_vehicles(seed))


def order_for(out: Path, layout: str, **changes: object) -> Order:
    virtual = layout.startswith("vkitti")
    order = Order(
        out,
        FRAMES,
        SEED,
        layout,
        variations=("clone",) if virtual else ("mixed",),
        people=not virtual,
        sequence=2 if virtual else 1,
    )
    return replace(order, **changes)


def exposed(order: Order, index: int):
    """The ground truth that frame `index` was written from."""
    settings = settings_of(order.layout, order.people)
    frame = render_frame(apply_variation(plan_frame(order.seed, index, settings=settings), order.variations[0]))
    assert frame is not None
    return expose(frame)


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module", params=WRITERS)
def made(request, tmp_path_factory):
    order = order_for(tmp_path_factory.mktemp(request.param) / "data", request.param)
    assert list(synthesise(order)) == [0, 1]
    return order


def test_every_layout_reads_back_what_was_made(made):
    data = open_dataset(made.layout, made.out)
    assert len(data.identifiers) == FRAMES
    truth, frame = exposed(made, 1), data.frame(data.identifiers[1])
    lossless = made.layout != "vkitti2"
    photograph = frame.photograph.numpy().transpose(1, 2, 0) * 255
    difference = np.abs(photograph - truth.image)
    assert difference.max() <= (0.51 if lossless else 90)
    assert difference.mean() <= (0.01 if lossless else 4)
    assert (frame.camera.matrix - truth.camera.matrix).abs().max() < 1e-3
    assert frame.labels is not None
    if made.layout.startswith("vkitti"):
        listed = [o for o in truth.objects if o.pixels > 0]
        boxes = torch.tensor([o.box_ltrb for o in listed], dtype=torch.float32)
        kinds = tuple(o.kind for o in listed)
        poses = torch.tensor([[*o.translation, o.yaw] for o in listed])
    else:
        boxes, kinds = truth.labels.boxes_xyxy, truth.labels.kind
        poses = torch.cat([truth.labels.translation, truth.labels.yaw[:, None]], dim=1)
    assert kinds
    assert frame.labels.kind == kinds
    assert (frame.labels.boxes_xyxy - boxes).abs().max() < 0.02
    if made.layout != "yolo":
        found = torch.cat([frame.labels.translation, frame.labels.yaw[:, None]], dim=1)
        assert (found - poses).abs().max() < 1e-3
    if made.layout.startswith("vkitti"):
        assert frame.depth is not None
        assert frame.classes is not None
        assert frame.masks is not None
        depth = np.where(truth.depth_cm == 65535, np.inf, truth.depth_cm / np.float32(100))
        assert np.array_equal(frame.depth.numpy(), depth.astype(np.float32))
        names = np.array([frame.class_names.index(n) if n in frame.class_names else -1 for n in CLASS_NAMES])
        seen = np.unique(truth.classes)
        assert (names[seen] >= 0).all()
        assert np.array_equal(frame.classes.numpy(), names[truth.classes])
        for mask, found in zip(frame.masks.numpy(), listed, strict=True):
            assert np.array_equal(mask > 0.5, truth.instances == found.track + 1)


def test_manifest_records_the_source_of_every_frame(made):
    manifest = files.read_json(made.out / "manifest.json")
    assert [f["index"] for f in manifest["frames"]] == [0, 1]
    assert manifest["seed"] == SEED
    assert manifest["generator"] == write.GENERATOR_VERSION
    assert all(f["objects"] and f["vehicles"] and f["split"] == "train" for f in manifest["frames"])


def test_a_run_goes_on_with_what_is_missing_and_ends_the_same(made, monkeypatch):
    before = tree(made.out)
    entry = made.out / ".drivesem" / "000" / "000001.json"
    entry.unlink()
    (made.out / "manifest.json").unlink()
    rendered = []
    original = write.render_frame

    def counted(plan):
        rendered.append(plan.setting.grain_seed[1])
        return original(plan)

    monkeypatch.setattr(write, "render_frame", counted)
    assert list(synthesise(made)) == [0, 1]
    assert rendered == [1]
    assert tree(made.out) == before


def test_a_lost_image_is_made_again(made, monkeypatch):
    before = tree(made.out)
    photographs = ("images", "image_2", "rgb", "vkitti_1.3.1_rgb")
    image = next(p for p in sorted(made.out.rglob("*.[pj]*g")) if any(name in p.parts for name in photographs))
    image.unlink()
    list(synthesise(made))
    assert tree(made.out) == before


def test_another_recipe_in_the_same_folder_is_an_error(made):
    with pytest.raises(FormatError, match=rf"recipe\.json: seed: expected {SEED + 1}, found {SEED}"):
        list(synthesise(replace(made, seed=SEED + 1)))


@pytest.mark.parametrize("option", ["meshes", "assets"])
def test_another_folder_of_the_same_name_is_another_recipe(tmp_path, option):
    folders = [tmp_path / place / "pack" for place in ("x", "y")]
    for shape, folder in enumerate(folders):
        place = folder if option == "meshes" else folder / "vehicles"
        place.mkdir(parents=True)
        save_mesh(template("sedan", shape), place / "sedan.glb")
    first, second = (Order(tmp_path / "out", 1, **{option: folder}) for folder in folders)
    stamp = tmp_path / "out" / ".drivesem" / "recipe.json"
    files.write_json(stamp, first.recipe())
    assert first.recipe()[option] == second.recipe()[option] == "pack"

    def goes_on(order):
        return next(synthesise(order, lambda *_: iter([0]))) == 0

    assert goes_on(first)
    with pytest.raises(FormatError, match=rf"recipe\.json: {option}_digest: expected '[0-9a-f]+', found '"):
        goes_on(second)
    # a data set of an earlier version, which wrote no digest
    files.write_json(stamp, {k: v for k, v in first.recipe().items() if not k.endswith("_digest")})
    assert goes_on(second)
    with pytest.raises(FormatError, match=rf"recipe\.json: {option}: expected 'other', found 'pack'"):
        goes_on(Order(tmp_path / "out", 1, **{option: folders[1].rename(tmp_path / "other")}))


def test_the_digest_of_a_folder_is_of_what_vehicles_are_read_from(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    save_mesh(template("sedan", 0), meshes / "sedan.glb")

    def digest(out):
        return Order(out, 1, meshes=meshes).recipe()["meshes_digest"]

    inside, before = meshes / "out", digest(meshes / "out")
    files.write_text(inside / "image_2" / "000000.png", "")  # by the order
    files.write_text(meshes / "LICENCE.md", "")
    assert digest(inside) == before
    files.write_text(meshes / "Textures" / "paint.png", "")  # meshes may name what lies below
    assert digest(inside) != before
    (inside / "image_2" / "000000.png").unlink()
    # a folder inside of the data set's is none that the order made
    assert digest(tmp_path) == digest(inside)
    assert not [name for name in Order(tmp_path, 1).recipe() if name.endswith("_digest")]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "synth frames: expected at least 1, found 0"),
        ({"split": "test"}, "synth split: expected train or heldout, found test"),
        ({"layout": "voc"}, "synth layout: expected one of vkitti2, vkitti1, kitti, coco, yolo, found voc"),
        ({"validation": 1.0}, r"synth validation: expected a share in \[0, 1\), found 1.0"),
        ({"cameras": 2}, "synth cameras: expected 1, or 2 in layout vkitti2, found 2"),
        ({"layout": "vkitti2"}, "synth people: expected none in layout vkitti2"),
        ({"variations": ("night",)}, "variations: expected all, or names among"),
    ],
)
def test_bad_requests_are_errors(tmp_path, changes, message):
    with pytest.raises(RangeError, match=message):
        Order(**{"out": tmp_path / "out", "frames": 1, **changes})


def test_places_fill_the_scenes_of_virtual_kitti_with_tracks_that_eight_bits_hold(tmp_path):
    single = Order(tmp_path, 65, layout="vkitti2", people=False, variations=("clone", "fog")).places()
    assert [p.number for p in single] == list(range(130))
    assert [p.scene for p in single[::20]] == ["01", "02", "06", "18", "20", "03", "04"]
    assert [(p.variation, p.frame) for p in single[:4]] == [("clone", 0), ("fog", 0), ("clone", 1), ("fog", 1)]
    assert 10 * write.TRACKS_A_STREET <= 254
    drives = Order(tmp_path, 20, layout="vkitti2", people=False, sequence=8).places()
    assert [(p.scene, p.frame) for p in drives[7:10]] == [("01", 7), ("02", 0), ("02", 1)]


def test_validation_frames_are_spread_and_do_not_depend_on_the_number(tmp_path):
    parts = [p.part for p in Order(tmp_path, 40, validation=0.25).places()]
    assert parts.count("val") == 10
    assert parts[:20] == [p.part for p in Order(tmp_path, 20, validation=0.25).places()]
    assert {p.part for p in Order(tmp_path, 40).places()} == {"train"}


def test_validation_frames_show_held_out_shapes(tmp_path):
    order = Order(tmp_path / "out", 2, validation=0.5)
    list(synthesise(order))
    frames = files.read_json(order.out / "manifest.json")["frames"]
    assert [(f["part"], f["split"]) for f in frames] == [("train", "train"), ("val", "heldout")]
    for kind in ("vehicles", "building", "tree", "surface"):
        assert not set(frames[0][kind]) & set(frames[1][kind])


def test_edits_reach_the_files(tmp_path):
    list(synthesise(order_for(tmp_path / "plain", "kitti", frames=1)))
    track = files.read_json(tmp_path / "plain" / "manifest.json")["frames"][0]["objects"][0]["track"]
    path = tmp_path / "edits.yaml"
    path.write_text(f"frames: {{0: {{objects: {{{track}: {{remove: true}}}}}}}}\n")
    list(synthesise(order_for(tmp_path / "edited", "kitti", frames=1, edits=path)))
    objects = [
        [o["track"] for o in files.read_json(tmp_path / name / "manifest.json")["frames"][0]["objects"]]
        for name in ("plain", "edited")
    ]
    assert track in objects[0]
    assert set(objects[0]) - {track} <= set(objects[1])
    assert track not in objects[1]


def test_right_camera_is_written_with_the_left(tmp_path):
    order = order_for(tmp_path / "out", "vkitti2", frames=1, cameras=2)
    list(synthesise(order))
    left, right = (
        files.read_image(order.out / "Scene01/clone/frames/rgb" / f"Camera_{i}" / "rgb_00000.jpg") for i in (0, 1)
    )
    assert left.shape == right.shape
    assert (left != right).any()


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["kitti", "vkitti2"])
def test_any_number_of_workers_writes_equal_files(tmp_path, layout):
    one, two = (order_for(tmp_path / str(n), layout, frames=4) for n in (1, 2))
    list(synthesise(one))
    list(synthesise(two, make_parallel_map(WorkerOptions(workers=2))))
    assert tree(two.out) == tree(one.out)


def test_a_sliver_of_a_car_at_the_border_has_no_track(tmp_path):
    # Frame 198 of these drives has a car that reaches into its last row with three samples, two pixels: too
    # little for ground truth.
    order = Order(tmp_path, 199, 26, "vkitti1", variations=("clone",), people=False, sequence=50)
    exposure = expose(render_frame(write.plan_job(write.list_jobs(order)[198])))
    listed = set(np.unique(exposure.instances).tolist()) - {0}
    assert listed
    assert listed <= {entry.track + 1 for entry in exposure.objects}
    WRITERS["vkitti1"](tmp_path).write(order.places()[198], exposure)


def test_varied_people_are_part_of_the_recipe(tmp_path):
    assert "varied_people" not in Order(tmp_path, 1).recipe()
    assert Order(tmp_path, 1, varied_people=True).recipe()["varied_people"] is True
    plain, varied = (
        [
            actor
            for job in list_jobs(Order(tmp_path, 12, varied_people=chosen))
            for actor in plan_job(job).actors
            if actor.label in ("Pedestrian", "Cyclist")
        ]
        for chosen in (False, True)
    )
    assert {actor.variant for actor in plain} == {0}
    assert {actor.variant for actor in varied} == {1, PUSHES_PRAM}
    lengths = {actor.size_lhw[0] > 1.5 for actor in varied if actor.variant == PUSHES_PRAM}
    assert lengths == {True}
    assert any(len(actor_soup(one, 0)) != len(actor_soup(replace(one, variant=0), 0)) for one in varied)
    assert min(actor.size_lhw[1] for actor in varied) < 1.45 < min(actor.size_lhw[1] for actor in plain)
    with pytest.raises(RangeError, match="varied_people"):
        Order(tmp_path, 1, people=False, varied_people=True)


def test_varied_people_leave_roads_and_vehicles_alone(tmp_path):
    for plain, varied in zip(
        list_jobs(Order(tmp_path, 4)), list_jobs(Order(tmp_path, 4, varied_people=True)), strict=True
    ):
        one, other = plan_job(plain), plan_job(varied)
        assert one.setting.road == other.setting.road
        assert [a for a in one.actors if a.lane_ds] == [a for a in other.actors if a.lane_ds]


def test_a_share_of_nights_is_part_of_the_recipe(tmp_path):
    assert "night" not in Order(tmp_path, 1).recipe()
    assert Order(tmp_path, 1, night=0.5).recipe()["night"] == 0.5
    job = list_jobs(Order(tmp_path, 1, night=1.0))[0]
    assert plan_job(job).setting.light.night > 0.9
    assert plan_job(list_jobs(Order(tmp_path, 1))[0]).setting.light.night == 0
