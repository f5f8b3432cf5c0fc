"""Attacks on what has no 3D boxes, as a user types them: COCO, YOLO, photographs, and on scenes' folders."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from drivesem.cli import main
from drivesem.run.results import load_frame
from drivesem.synth.write import Order, synthesise
from scene_ir import files
from scene_ir.io import load_scene
from tests.drivesem.invoke import invoke, refusal, run_json

ATTACK = [
    "attack",
    "--params",
    "color",
    "--steps",
    "1",
    "--no-confirm",
    "--nuisances",
    "off",
    "--json",
    "--workers",
    "1",
]
OWN = ("camera", "truncation", "visible", "occlusion", "track", "pose")
"""What only this project's COCO files say."""


@pytest.fixture(scope="module")
def plain_coco(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two streets as COCO lays them out: its class names, texts as ids, a grey and an RGBA image, no cameras."""
    root = tmp_path_factory.mktemp("coco")
    list(synthesise(Order(root, 2, seed=11, layout="coco"), map))
    (path,) = (root / "annotations").iterdir()
    content = files.read_json(path)
    names = {"Car": "car", "Van": "car", "Truck": "truck", "Pedestrian": "person"}
    for table in ("images", "annotations"):
        content[table] = [{k: v for k, v in row.items() if k not in OWN} for row in content[table]]
    content["images"] = [row | {"id": f"image-{row['id']}"} for row in content["images"]]
    content["annotations"] = [row | {"image_id": f"image-{row['image_id']}"} for row in content["annotations"]]
    content["categories"] = [row | {"name": names.get(row["name"], row["name"])} for row in content["categories"]]
    content["categories"].append({"id": 77, "name": "dog"})
    content["annotations"].append(
        {
            "id": 9999,
            "image_id": content["images"][0]["id"],
            "category_id": 77,
            "bbox": [5, 5, 30, 20],
            "iscrowd": 0,
        }
    )
    files.write_json(path, content)
    for image, mode in zip(sorted((root / "images").rglob("*.png")), ("L", "RGBA"), strict=True):
        Image.open(image).convert(mode).save(image)
    return root


@pytest.mark.slow
def test_coco_is_attacked_by_its_2d_boxes(plain_coco: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    summary = run_json(*ATTACK, "--dataset", "coco", "--root", plain_coco, "--out", out)
    assert summary["frames"] == 2
    assert summary["objects"]["all"] >= 4
    assert summary["feasible_fraction"] == 1.0
    content = files.read_json(next((plain_coco / "annotations").iterdir()))
    kinds = {row["id"]: row["name"] for row in content["categories"]}
    for folder in (out / "frames").iterdir():
        result, scene = load_frame(folder / "result.json"), load_scene(folder / "scene")
        assert scene.provenance["places"] == "estimated"
        assert scene.provenance["focal"].endswith("default")
        given = [
            [x - 0.5, y - 0.5, x - 0.5 + w, y - 0.5 + h]
            for row in content["annotations"]
            if kinds[row["category_id"]] in ("car", "truck")
            for x, y, w, h in [row["bbox"]]
        ]
        # what is judged are the labels' own boxes, not those of the estimated places
        for box in scene.objects.box2d:
            assert float((torch.tensor(given) - box).abs().amax(1).min()) < 0.01
        assert result.identity_psnr_db is None or result.identity_psnr_db > 40
    assert main(["verify", str(out), "--json"]) == 0


def test_yolo_is_attacked_and_a_focal_length_may_be_given(plain_coco: Path, tmp_path: Path) -> None:
    folder = tmp_path / "yolo"
    assert main(["convert", str(plain_coco), "--to", "yolo", "--out", str(folder), "--copy-images"]) == 0
    words = [*ATTACK, "--dataset", "yolo", "--root", str(folder), "--focal", "650", "--limit", "1"]
    assert run_json(*words, "--out", tmp_path / "run")["frames"] == 1
    (frame,) = (tmp_path / "run" / "frames").iterdir()
    assert load_scene(frame / "scene").provenance["focal"] == "650.0 px, given"


def test_coco_is_trained_on_and_judged(plain_coco: Path, tmp_path: Path) -> None:
    data = ["--dataset", "coco", "--root", str(plain_coco)]
    words = ["train", *data, "--steps", "1", "--batch", "2", "--window", "320x160", "--evaluate-every", "0"]
    assert run_json(*words, "--json", "--out", tmp_path / "T")["frames"] == 2
    assert run_json("eval", "--detector", "squeezedet", *data, "--json", "--workers", "1")["frames"] == 2


@pytest.fixture(scope="module")
def photographs(plain_coco: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for image in (plain_coco / "images").rglob("*.png"):
        shutil.copy(image, folder)
    return folder


@pytest.mark.slow
def test_photographs_without_labels_are_attacked(photographs: Path, tmp_path: Path) -> None:
    words = [*ATTACK, "--dataset", "photographs", "--root", str(photographs), "--focal", "650"]
    summary = run_json(*words, "--finder", "yolov3-slim", "--out", tmp_path / "run")
    assert summary["frames"] >= 1
    one = next(photographs.iterdir())
    alone = run_json(*words[:-3], one, "--out", tmp_path / "one")
    assert alone["frames"] == 1
    (frame,) = (tmp_path / "one" / "frames").iterdir()
    assert frame.name == one.stem


def test_a_photograph_is_taken_apart_by_another_detector(photographs: Path, tmp_path: Path) -> None:
    one = sorted(photographs.iterdir())[-1]
    words = ["derender", str(one), "--fast", "--json", "--workers", "1", "--focal", "650"]
    own = run_json(*words, "--out", tmp_path / "a")
    other = run_json(*words, "--detector", "yolov3-slim", "--out", tmp_path / "b")
    assert list(own["frames"]) == list(other["frames"]) == [one.stem]
    boxes = [load_scene(tmp_path / name / one.stem).objects.box2d for name in ("a", "b")]
    assert boxes[0].shape != boxes[1].shape or not torch.equal(boxes[0], boxes[1])
    assert "--finder: expected a detector" in refusal(*words, "--detector", "none", "--out", tmp_path / "c")


@pytest.mark.slow
def test_scenes_are_attacked(tmp_path: Path) -> None:
    scenes = tmp_path / "scenes"
    assert main(["derender", "--limit", "2", "--out", str(scenes), "--workers", "1"]) == 0
    words = [*ATTACK, "--dataset", "scenes", "--root"]
    assert run_json(*words, scenes, "--out", tmp_path / "both")["frames"] == 2
    assert run_json(*words, scenes / "demo-001", "--out", tmp_path / "one")["frames"] == 1
    demo = run_json(*ATTACK, "--limit", "2", "--out", tmp_path / "demo")
    for name in ("demo-000", "demo-001"):
        results = [load_frame(tmp_path / run / "frames" / name / "result.json") for run in ("both", "demo")]
        assert results[0].theta == results[1].theta  # a scene from its folder is the scene
    assert demo["frames"] == 2
    # a counterexample's own scene, as it was photographed
    again = run_json(*words, tmp_path / "demo", "--out", tmp_path / "again")
    assert again["frames"] == 2
    assert (tmp_path / "again" / "frames" / "demo-000").is_dir()


def test_a_folder_of_another_layout_is_recognised(plain_coco: Path) -> None:
    assert "it looks like coco (--dataset coco)" in refusal(*ATTACK, "--dataset", "kitti", "--root", plain_coco)
    assert "it looks like coco (--dataset coco)" in refusal(
        "eval", "--detector", "squeezedet", "--dataset", "yolo", "--root", plain_coco
    )


def test_frames_without_vehicles_are_reported(plain_coco: Path, tmp_path: Path) -> None:
    root = shutil.copytree(plain_coco, tmp_path / "coco")
    (path,) = (root / "annotations").iterdir()
    files.write_json(path, files.read_json(path) | {"annotations": []})
    _, line = invoke(
        *ATTACK, "--dataset", "coco", "--root", root, "--out", tmp_path / "run", code=2
    ).err.splitlines()
    assert line.endswith("found 2 frames without")
    assert str(root) in line
