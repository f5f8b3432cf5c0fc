"""`drivesem derender`, `render` and `edit` as a user types them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from drivesem.cli import main
from drivesem.config.commands import DerenderConfig, EditConfig, RenderConfig
from drivesem.config.edits import read_frame_edit
from drivesem.config.options import DATASETS
from drivesem.config.parsing import parse
from drivesem.data.registry import DATASETS as READERS
from drivesem.data.registry import open_dataset
from drivesem.run.lock import LOCK
from drivesem.scenes.scene_sheet import GAIN, PANEL_PX, scene_sheet
from scene_ir import files
from scene_ir.derender.silhouette import mask_bounds, place_mesh, render_silhouettes
from scene_ir.errors import RangeError
from scene_ir.io import VERSION, load_scene, save_scene
from scene_ir.meshes.templates import template
from scene_ir.types import Camera, Mesh
from tests.drivesem.invoke import invoke, refusal, run_json

KITTI = Path(__file__).parents[3].parent / "shared" / "data" / "kitti"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of the demo, with their sheets."""
    out = tmp_path_factory.mktemp("scenes") / "S"
    assert main(["derender", "--limit", "2", "--workers", "1", "--sheet", "--out", str(out)]) == 0
    return out


@pytest.fixture
def demo(taken: Path) -> Path:
    """The first scene's folder, to be left as it is."""
    return taken / "demo-000"


def test_defaults() -> None:
    assert parse(["derender"]) == DerenderConfig()
    assert parse(["render", "a", "-o", "b.png"]) == RenderConfig(scene="a", out="b.png")
    words = ["edit", "a", "--set", "weather=fog", "--set", "foliage.hue=1", "--remove", "1", "--remove", "3"]
    assert parse(words) == EditConfig(scene="a", set=("weather=fog", "foliage.hue=1"), remove=("1", "3"))


def test_presets_hold_repeated_settings(tmp_path: Path) -> None:
    preset = tmp_path / "preset.yaml"
    preset.write_text("set: [weather=fog, 'objects[1].color=0.3,0,0,0,0']\nremove: [all]\n")
    config = parse(["edit", "a", "--config", str(preset), "--set", "foliage.hue=1"])
    assert config == EditConfig(
        scene="a", set=("weather=fog", "objects[1].color=0.3,0,0,0,0", "foliage.hue=1"), remove=("all",)
    )


def test_data_sets_are_those_that_can_be_read() -> None:
    assert sorted(DATASETS) == sorted(READERS)


def test_a_folder_a_frame(taken: Path) -> None:
    assert sorted(p.name for p in taken.iterdir()) == [LOCK, "config.yaml", "demo-000", "demo-001"]
    found = {p.name for p in (taken / "demo-000").iterdir()}
    assert found == {"scene.json", "arrays.npz", "photograph.png", "background.png", "meshes", "sheet.jpg"}
    assert load_scene(taken / "demo-000").provenance["frame"] == "demo-000"


def empty_streets(root: Path, calibrated: tuple[int, ...], count: int = 3) -> np.ndarray:
    """A KITTI folder of small pictures without objects; some frames have a calibration. -> the picture."""
    image = np.full((60, 200, 3), 90, np.uint8)
    for i in range(count):
        files.write_png(root / "training" / "image_2" / f"{i:06d}.png", image)
        files.write_text(root / "training" / "label_2" / f"{i:06d}.txt", "")
        if i in calibrated:
            text = f"P2: {90 + i} 0 100 0 0 {90 + i} 30 0 0 0 1 0\n"
            files.write_text(root / "training" / "calib" / f"{i:06d}.txt", text)
    return image


@pytest.mark.slow
def test_processes_do_not_matter(tmp_path: Path) -> None:
    root = tmp_path / "D"
    empty_streets(root, (0, 1, 2))
    (root / "training" / "calib" / "000001.txt").write_text("P2: broken")
    words = ["derender", "--dataset", "kitti", "--root", str(root), "--keep-going"]
    found = {}
    for count in ("1", "2"):
        found[count] = run_json(*words, "--workers", count, "--out", tmp_path / count)
    for folder in ("000000", "000002"):
        assert contents(tmp_path / "1" / folder) == contents(tmp_path / "2" / folder) != {}
    assert found["1"]["failed"] == found["2"]["failed"]
    assert list(found["2"]["frames"]) == ["000000", "000002"]


def test_frames_are_summarised(taken: Path, tmp_path: Path) -> None:
    out = tmp_path / "S"
    words = ["derender", "--limit", "1", "--workers", "1", "--sheet", "--out", str(out)]
    found = run_json(*words)
    assert contents(out / "demo-000") == contents(taken / "demo-000")
    frame = found["frames"]["demo-000"]
    assert frame["objects"] == len(load_scene(out / "demo-000").objects)
    assert 0 < frame["seconds"] <= found["seconds"]
    assert found["failed"] == {}
    assert Path(found["out"]) == out
    assert f"demo-000: {frame['objects']} objects, already there" in invoke(*words).out


def test_it_goes_on_where_it_stopped(taken: Path, tmp_path: Path) -> None:
    out = tmp_path / "S"
    shutil.copytree(taken, out)
    before = contents(out)
    shutil.rmtree(out / "demo-001")
    (out / "demo-000" / "sheet.jpg").unlink()
    mark = (out / "demo-000" / "scene.json").stat().st_mtime_ns
    words = ["derender", "--limit", "2", "--workers", "1", "--out", str(out)]
    found = run_json(*words, "--sheet")
    assert found["frames"]["demo-000"]["seconds"] is None
    assert found["frames"]["demo-001"]["seconds"] > 0
    assert (out / "demo-000" / "scene.json").stat().st_mtime_ns == mark
    after = contents(out)
    assert after.keys() == before.keys()
    assert all(after[name] == before[name] for name in before if name != "config.yaml")
    again = run_json(*words)
    assert all(frame["seconds"] is None for frame in again["frames"].values())
    assert again["frames"]["demo-000"]["objects"] == found["frames"]["demo-000"]["objects"]


def test_a_scene_of_another_version_is_refused(taken: Path, tmp_path: Path) -> None:
    out = tmp_path / "S"
    shutil.copytree(taken, out)
    record = out / "demo-001" / "scene.json"
    record.write_text(record.read_text().replace(f'"version": {VERSION}', '"version": 99'))
    output = refusal("derender", "--limit", "2", "--workers", "1", "--out", out)
    assert f"scene.json: version: expected version {VERSION}, found version 99" in output


def test_other_settings_need_another_folder(taken: Path) -> None:
    output = refusal("derender", "--limit", "2", "--out", taken, "--seed", "1")
    assert "other values of seed" in output
    output = refusal("derender", "--limit", "2", "--out", taken, "--fast")
    assert "other values of fit" in output
    assert "which holds other files" in refusal("derender", "--out", taken / "demo-000")


def test_no_resume_starts_again(tmp_path: Path, taken: Path) -> None:
    out = tmp_path / "S"
    shutil.copytree(taken, out)
    (out / "mine.txt").write_text("kept")
    words = ["derender", "--limit", "1", "--workers", "1", "--fast", "--no-resume", "--out", str(out)]
    found = run_json(*words)
    assert found["frames"]["demo-000"]["seconds"] > 0
    assert not (out / "demo-000" / "sheet.jpg").exists()
    assert "fit: false" in (out / "config.yaml").read_text()
    assert (out / "mine.txt").read_text() == "kept"


def test_identifiers_with_slashes_become_nested_folders(tmp_path: Path) -> None:
    root, out = tmp_path / "D", tmp_path / "S"
    run_json("synth", "--layout", "vkitti2", "--frames", "1", "--sequence", "1", "--workers", "1", "--out", root)
    (name,) = open_dataset("vkitti2", root).identifiers
    words = ["derender", "--dataset", "vkitti2", "--root", str(root), "--fast", "--workers", "1"]
    found = run_json(*words, "--out", out)
    assert list(found["frames"]) == [name]
    assert name.count("/") == 3
    scene = load_scene(out / name)
    assert len(scene.objects) == found["frames"][name]["objects"] > 0
    assert "fit: false" in (out / "config.yaml").read_text()


def test_frames_that_cannot_be_used(tmp_path: Path) -> None:
    root = tmp_path / "D"
    image = empty_streets(root, (1,), count=2)
    (root / "training" / "velodyne").mkdir()
    words = ["derender", "--dataset", "kitti", "--root", str(root), "--workers", "1", "--velodyne"]
    assert "000000.txt: expected a readable file" in refusal(*words, "--out", tmp_path / "A")
    found = run_json(*words, "--out", tmp_path / "B", "--keep-going")
    assert list(found["failed"]) == ["000000"]
    assert found["frames"]["000001"]["objects"] == 0
    assert main(["render", str(tmp_path / "B" / "000001")]) == 0
    assert np.array_equal(files.read_image(tmp_path / "B" / "000001" / "render.png"), image)


def street_with(mesh: Mesh, root: Path) -> None:
    """A KITTI folder with one picture of a flat red vehicle of this shape, labelled as a van."""
    camera = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
    place, yaw, size = torch.tensor([0.5, 1.65, 12.0]), torch.tensor(0.3), torch.tensor([5.0, 1.7, 1.9])
    mask = render_silhouettes([place_mesh(mesh, place, yaw, size)], camera)[0]
    rng = np.random.default_rng(3)
    image = np.clip(120 + rng.normal(0, 12, (200, 480, 3)), 0, 255)
    image[mask] = np.clip(np.array([190, 40, 40]) + rng.normal(0, 12, (int(mask.sum()), 3)), 0, 255)
    files.write_png(root / "training" / "image_2" / "000000.png", image.astype(np.uint8))
    x0, y0, x1, y1 = mask_bounds(mask)
    label = f"Van 0 0 0.26 {x0} {y0} {x1 - 1} {y1 - 1} 1.7 1.9 5.0 0.5 1.65 12.0 0.3\n"
    files.write_text(root / "training" / "label_2" / "000000.txt", label)
    calibration = "P2: 380 0 239.5 0 0 380 88 0 0 0 1 0\n"
    files.write_text(root / "training" / "calib" / "000000.txt", calibration)


@pytest.mark.slow
def test_a_users_mesh_is_chosen_where_it_fits_best(tmp_path: Path) -> None:
    shape = template("pickup")
    street_with(shape, tmp_path / "D")
    (tmp_path / "meshes").mkdir()
    metres = shape.vertices.numpy() * np.array([5.0, 1.7, 1.9])
    turned = metres * np.array([1.0, -1.0, -1.0])
    trimesh.Trimesh(turned, shape.faces.numpy(), process=False).export(tmp_path / "meshes" / "my-pickup.obj")
    (tmp_path / "meshes" / "vehicles.yaml").write_text("my-pickup.obj: {front: +x, kind: van}\n")
    (tmp_path / "meshes" / "draco.gltf").write_text('{"extensionsRequired": ["KHR_draco_mesh_compression"]}')
    words = ["derender", "--dataset", "kitti", "--root", str(tmp_path / "D"), "--workers", "1", "--fast"]
    chosen, notes = {}, []
    for name, more in (("A", []), ("B", ["--meshes", str(tmp_path / "meshes")])):
        err = invoke(*words, *more, "--out", tmp_path / name).err
        notes += [line for line in err.splitlines() if line.startswith("--meshes: ")]
        chosen[name] = load_scene(tmp_path / name / "000000").provenance["objects[0].mesh"]
    assert chosen["A"] != chosen["B"] == "my-pickup"
    assert len(notes) == 1
    assert notes[0].startswith(f"--meshes: left out: {tmp_path / 'meshes' / 'draco.gltf'}: extensionsRequired: ")
    assert '"my-pickup"' in (tmp_path / "B" / "000000" / "scene.json").read_text()
    output = refusal(*words, "--out", tmp_path / "B")
    assert "other values of meshes" in output


def test_points_are_kittis(tmp_path: Path) -> None:
    with pytest.raises(RangeError, match="points: expected kitti, found coco"):
        open_dataset("coco", tmp_path, with_points=True)


def test_an_unperturbed_render_is_the_photograph(demo: Path, tmp_path: Path) -> None:
    found = run_json("render", demo, "-o", tmp_path / "a.png")
    assert found["objects"] == len(load_scene(demo).objects)
    assert Path(found["out"]) == tmp_path / "a.png"
    assert np.array_equal(files.read_image(tmp_path / "a.png"), files.read_image(demo / "photograph.png"))


def test_a_scene_that_went_through_files_renders_alike(demo: Path, tmp_path: Path) -> None:
    turn = ["--set", "objects[0].rotate=5deg", "--set", "weather.fog=0.3"]
    run_json("edit", demo, *turn, "--save", tmp_path / "S", "-o", tmp_path / "a.png")
    run_json("render", tmp_path / "S")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "S" / "render.png").read_bytes()
    again = load_scene(tmp_path / "S")
    save_scene(again, tmp_path / "T")
    assert contents(tmp_path / "T") == {k: v for k, v in contents(tmp_path / "S").items() if k != "render.png"}


def test_an_edit_moves_what_it_should(demo: Path, tmp_path: Path) -> None:
    scene = load_scene(demo)
    row = int(scene.objects.box2d[:, 3].argmax())
    out = tmp_path / "a.png"
    run_json("edit", demo, "--set", f"objects[{row}].translate=0.5m,0m", "-o", out)
    changed = np.abs(files.read_image(out).astype(int) - files.read_image(demo / "photograph.png")).max(axis=2)
    x0, y0, x1, y1 = scene.objects.box2d[row].round().int().tolist()
    assert (changed[y0:y1, x0:x1] > 8).mean() > 0.1
    wide, high = x1 - x0, y1 - y0
    near = np.zeros_like(changed, dtype=bool)
    # with room for the shadow, which moves along
    near[max(y0 - high // 2, 0) : y1 + high, max(x0 - 3 * wide, 0) : x1 + 3 * wide] = True
    assert not changed[~near].any()


def test_saved_edits_are_in_physical_units(demo: Path, tmp_path: Path) -> None:
    path = tmp_path / "edit.yaml"
    path.write_text("objects:\n  0: {translate: [0.5m, 0.25m], rotate: 10deg}\n  1: {remove: true}\n")
    words = ["edit", str(demo), "--edits", str(path), "--set", "objects[0].rotate=20deg", "--save"]
    found = run_json(*words, tmp_path / "S")
    assert "out" not in found, "nothing is drawn where only a folder is asked for"
    before, after = load_scene(demo).objects, load_scene(tmp_path / "S").objects
    assert len(after) == found["objects"] == len(before) - 1
    shift = after.translation[0] - before.translation[0]
    assert float(shift[[0, 2]].norm()) == pytest.approx(np.hypot(0.5, 0.25), abs=1e-4)
    assert float(after.yaw[0] - before.yaw[0]) == pytest.approx(np.deg2rad(20), abs=1e-5)
    assert torch.equal(after.translation[1:], before.translation[2:])
    assert read_frame_edit(path)["objects"][1] == {"remove": True}


def test_drops_on_the_windscreen_are_saved_and_add_up(demo: Path, tmp_path: Path) -> None:
    first, again = tmp_path / "first", tmp_path / "again.png"
    run_json("edit", demo, "--set", "drops=0.5", "--save", first)
    assert load_scene(first).environment.drops.tolist() == [0.5]
    assert load_scene(first).unperturbed().environment.drops.tolist() == [0.0]
    run_json("edit", first, "--set", "drops=0.5", "-o", again)
    changed = (files.read_image(again) != files.read_image(demo / "photograph.png")).any(axis=2)
    assert 0.001 < changed.mean() < 0.06
    refused = invoke("edit", demo, "--set", "drops=2", code=2)
    assert "drops: expected a code in [0, 1], found 2.0" in refused.err


def test_an_edit_begins_with_the_photograph_again(demo: Path, tmp_path: Path) -> None:
    still, changed = tmp_path / "still.png", tmp_path / "S"
    words = ["edit", str(demo), "--set", "objects[0].rotate=10deg", "--set", "weather.fog=0.5"]
    run_json(*words, "--save", changed)
    run_json("edit", changed, "--photographed", "-o", still)
    assert np.array_equal(files.read_image(still), files.read_image(demo / "photograph.png"))
    once, again = tmp_path / "once.png", tmp_path / "again.png"
    run_json("edit", demo, "--set", "objects[0].rotate=4deg", "-o", once)
    words = ["edit", str(changed), "--photographed", "--set", "objects[0].rotate=4deg", "-o", str(again)]
    run_json(*words)
    assert np.array_equal(files.read_image(once), files.read_image(again))
    assert not np.array_equal(files.read_image(once), files.read_image(still))


def test_removed_vehicles_stay_removed_and_are_reported(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed, still = tmp_path / "S", tmp_path / "still.png"
    words = ["edit", str(demo), "--remove", "0", "--set", "objects[1].rotate=10deg", "--save", str(changed)]
    assert main(words) == 0
    left = len(load_scene(demo).objects) - 1
    assert f"S: {left} objects, 1 removed (" in capsys.readouterr().out
    words = ["edit", str(changed), "--photographed", "-o", str(still)]
    printed = invoke(*words, "--json")
    found, output = json.loads(printed.out), printed.err
    note = "not the photograph: objects that were removed, exchanged, added or loaded remain so"
    assert output == f"drivesem: {note}\n"
    assert (found["notes"], found["objects"]) == ([note], left)
    assert f"still.png: {left} objects (" in invoke(*words).out
    assert not np.array_equal(files.read_image(still), files.read_image(demo / "photograph.png"))
    once = tmp_path / "once.png"
    run_json("edit", demo, "--remove", "0", "-o", once)
    assert np.array_equal(files.read_image(once), files.read_image(still))
    assert invoke("edit", changed, "--set", "weather=fog", "-o", once).err == ""


def test_without_vehicles_the_background_is_left(demo: Path, tmp_path: Path) -> None:
    found = run_json("edit", demo, "--remove", "all", "-o", tmp_path / "a.png")
    assert found["objects"] == 0
    assert np.array_equal(files.read_image(tmp_path / "a.png"), files.read_image(demo / "background.png"))
    found = run_json("edit", demo, "--remove", "0,2", "--remove", "1", "-o", tmp_path / "b.png")
    assert found["objects"] == len(load_scene(demo).objects) - 3


def test_infeasible_positions_are_reported_and_rendered(demo: Path, tmp_path: Path) -> None:
    scene = load_scene(demo)
    gap = scene.objects.translation[1:] - scene.objects.translation[0]
    other = 1 + int(gap.norm(dim=1).argmin())
    c, s = np.cos(float(scene.objects.yaw[0])), np.sin(float(scene.objects.yaw[0]))
    x, z = gap[other - 1][[0, 2]].tolist()
    onto = f"objects[0].translate={c * x - s * z}m,{s * x + c * z}m"
    words = ["edit", str(demo), "--set", onto, "-o", str(tmp_path / "a.png")]
    printed = invoke(*words, "--json")
    found, output = json.loads(printed.out), printed.err
    lines = output.splitlines()
    assert lines
    assert all(line.startswith("drivesem: objects[") for line in lines)
    assert f"objects[{other}]: collision with objects[0]" in output
    assert found["notes"] == [line.removeprefix("drivesem: ") for line in lines]
    output = invoke(*words, "--remove", other).err
    assert f"objects[{other}]" not in output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "edit: expected a change"),
        (["--set", "objects[99].rotate=1deg"], "objects[99]: expected a row from 0 to"),
        (["--set", "objects[0].rotate=1"], "expected a unit: 1deg or 1rad"),
        (["--set", "objects[0].wheels=1"], "wheels"),
        (["--set", "weather=hail"], "hail"),
        (["--set", "objects[0].mesh=50%"], "shares need a scene with changed shapes, and --photographed"),
        (["--remove", "99"], "objects[99]: expected a row from 0 to"),
        (["--remove", "red"], "--remove: expected numbers from 0, or all, found 'red'"),
        (["--edits", "nowhere.yaml"], "nowhere.yaml: expected a readable file"),
        (["--remove", "0", "-o", "a.jpg"], "--out: expected a .png file, found a.jpg"),
        (["--remove", "0", "--save", "."], "--save"),
        (["--frobnicate"], "frobnicate"),
    ],
)
def test_edit_refuses(
    words: list[str], message: str, demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    monkeypatch.chdir(tmp_path)
    assert message in refusal("edit", demo, *words)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("command", [["render"], ["edit", "--remove", "0"]])
def test_what_is_no_scene_is_named(command: list[str], taken: Path, tmp_path: Path) -> None:
    assert "expected a folder with a scene" in refusal(*command, tmp_path / "nowhere")
    assert "scene.json" in refusal(*command, taken)
    broken = tmp_path / "broken"
    shutil.copytree(taken / "demo-000", broken)
    (broken / "arrays.npz").write_bytes(b"no archive")
    assert "arrays.npz" in refusal(*command, broken)
    assert "SCENE" in refusal(*command)


def test_the_sheet_shows_photograph_background_and_no_difference(taken: Path) -> None:
    scene = load_scene(taken / "demo-001")
    sheet = scene_sheet(scene, "demo-001")
    written = files.read_image(taken / "demo-001" / "sheet.jpg")
    assert np.abs(written.astype(int) - sheet).mean() < 2
    tall = round(PANEL_PX * scene.camera.height / scene.camera.width)
    panels = []
    for line in range(3):
        for column in range(3):
            y = sheet.shape[0] - (3 - line) * (tall + 12) - (2 - line) * 23
            x = 12 + column * (PANEL_PX + 12)
            panels.append(sheet[y : y + tall, x : x + PANEL_PX])

    def small(name: str) -> np.ndarray:
        image = files.read_image(taken / "demo-001" / f"{name}.png")
        return cv2.resize(image, (PANEL_PX, tall), interpolation=cv2.INTER_AREA)

    assert (panels[0] != small("photograph")).any(axis=2).mean() < 0.1, "but for the outlines"
    assert np.array_equal(panels[6], small("background"))
    assert np.array_equal(panels[7], small("photograph"))
    assert not panels[8].any()
    for panel in panels[1:6]:
        assert panel.std() > 1


def test_the_sheet_states_the_difference(taken: Path) -> None:
    scene = load_scene(taken / "demo-001")
    still = scene_sheet(scene, "t")
    source = scene.objects.source[0]
    darker = source.foreground.values.clone()
    darker[:3] *= 0.9
    spoilt = replace(source, foreground=replace(source.foreground, values=darker))
    objects = replace(scene.objects, source=(spoilt, *scene.objects.source[1:]))
    sheet = scene_sheet(replace(scene, objects=objects), "t")
    part = np.abs(sheet[-300:].astype(int) - still[-300:])[..., -PANEL_PX:, :]
    assert part.max() >= GAIN


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti")
def test_a_photograph_of_kitti(tmp_path: Path) -> None:
    out = tmp_path / "S"
    words = ["derender", "--dataset", "kitti", "--root", str(KITTI), "--out", str(out)]
    found = run_json(*words, "--fast", "--velodyne", "--limit", "2", "--workers", "1")
    assert list(found["frames"]) == ["000000", "000001"]
    for name in found["frames"]:
        run_json("render", out / name)
        picture, photograph = (files.read_image(out / name / f"{n}.png") for n in ("render", "photograph"))
        assert np.abs(picture.astype(int) - photograph).max() <= 1
        assert np.array_equal(photograph, files.read_image(KITTI / "training" / "image_2" / f"{name}.png"))
