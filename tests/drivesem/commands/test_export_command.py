"""`drivesem export` as a user types it: every layout is read back by something that is not its writer."""

from __future__ import annotations

import contextlib
import csv
import importlib
import io
import json
import math
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from pycocotools.coco import COCO

from drivesem.cli import main
from drivesem.data.kitti import read_labels, write_labels
from drivesem.data.vkitti2 import Vkitti2Dataset
from drivesem.data.yolo import YoloDataset
from drivesem.run.results import Failure, FrameResult, dump_frame, load_frame
from scene_ir import files
from scene_ir.io import load_scene, save_scene
from tests.drivesem.invoke import invoke, refusal

GRADE = "certain"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames: in the first, the second car is said to be lost for certain; the second withstands."""
    out = tmp_path_factory.mktemp("run") / "a"
    words = [
        "attack",
        "--params",
        "translate",
        "--steps",
        "1",
        "--limit",
        "2",
        "--nuisances",
        "off",
        "--no-confirm",
    ]
    assert main([*words, "--workers", "1", "--out", str(out)]) == 0
    for name in ("demo-000", "demo-001"):
        path = out / "frames" / name / "result.json"
        result = load_frame(path)
        car = result.targets_moved[1]
        lost = Failure("lost", car.label, car.xyxy, index=1, error="missed", grade=GRADE)
        files.write_text(path, dump_frame(replace(result, failures=(lost,) if name == "demo-000" else ())))
    return out


def result_of(run: Path, name: str) -> FrameResult:
    return load_frame(run / "frames" / name / "result.json")


def export(run: Path, to: str, out: Path, *words: str) -> Path:
    assert main(["export", str(run), "--to", to, "--out", str(out), *words]) == 0
    return out


def picture(path: Path) -> Any:
    return cv2.imread(str(path))


def test_kitti_by_a_parser_of_its_own(run: Path, tmp_path: Path) -> None:
    training = export(run, "kitti", tmp_path / "K") / "training"
    assert [p.name for p in sorted((training / "image_2").iterdir())] == ["demo-000.png"]
    source = run / "frames" / "demo-000"
    assert np.array_equal(picture(training / "image_2/demo-000.png"), picture(source / "counterexample.png"))
    result, scene = result_of(run, "demo-000"), load_scene(source / "scene")
    matrix = None
    for line in (training / "calib/demo-000.txt").read_text().splitlines():
        if line.startswith("P2:"):
            matrix = np.array([float(v) for v in line.split()[1:]]).reshape(3, 4)
    assert matrix is not None
    assert matrix == pytest.approx(scene.camera.matrix.numpy(), rel=1e-6)
    cars = []
    for line in (training / "label_2/demo-000.txt").read_text().splitlines():
        kind, *numbers = line.split()
        assert len(numbers) == 14
        values = [float(v) for v in numbers]
        if kind == "DontCare":
            continue
        cars.append(values)
        left, top, right, bottom, h, w, length, x, y, z, turn = values[3:]
        # the bottom's corners, projected by hand, lie within a car's width of the box
        along = np.array([math.cos(turn), 0, -math.sin(turn)]) * length / 2
        across = np.array([math.sin(turn), 0, math.cos(turn)]) * w / 2
        seen = [matrix @ [*(np.array([x, y - up, z]) + a * along + c * across), 1]
                for up in (0, h) for a in (-1, 1) for c in (-1, 1)]  # fmt: skip
        pixels = np.array([point[:2] / point[2] for point in seen])
        assert pixels[:, 0].min() < (left + right) / 2 < pixels[:, 0].max()
        assert pixels[:, 1].min() < (top + bottom) / 2 < pixels[:, 1].max()
    own = [record.xyxy for record in result.targets_moved if record.index is not None]
    assert [values[3:7] for values in cars] == [pytest.approx(box, abs=1e-3) for box in own]


def test_coco_by_pycocotools(run: Path, tmp_path: Path) -> None:
    out = export(run, "coco", tmp_path / "C", "--grade", "all")
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(out / "annotations" / "instances_all.json"))
        found = coco.loadRes(str(out / "detections.json"))
    images = {row["drivesem"]["frame"]: row for row in coco.loadImgs(coco.getImgIds())}
    assert set(images) == {"demo-000", "demo-001"}
    for name, row in images.items():
        result = result_of(run, name)
        assert (out / "images" / row["file_name"]).is_file()
        assert row["drivesem"]["theta"] == {c.name: c.value for c in result.theta}
        assert row["drivesem"]["grade"] == (GRADE if name == "demo-000" else None)
        objects = [r for r in coco.loadAnns(coco.getAnnIds(row["id"])) if not r["iscrowd"]]
        for i, (entry, record) in enumerate(zip(objects, result.targets_moved, strict=False)):
            x, y, w, h = entry["bbox"]
            assert [x - 0.5, y - 0.5, x - 0.5 + w, y - 0.5 + h] == pytest.approx(record.xyxy, abs=1e-3)
            assert entry.get("failure") == (GRADE if name == "demo-000" and i == 1 else None)
        scores = sorted(r["score"] for r in found.loadAnns(found.getAnnIds(row["id"])))
        assert scores == pytest.approx(sorted(d.score for d in result.detections_attacked if d.score is not None))


def test_fiftyone_follows_its_documented_format(run: Path, tmp_path: Path) -> None:
    out = export(run, "fiftyone", tmp_path / "F", "--grade", "all")
    content = json.loads((out / "labels.json").read_text())
    uuids = {path.stem for path in (out / "data").iterdir()}
    assert set(content["labels"]) == uuids == {"demo-000", "demo-001"}
    for uuid, detections in content["labels"].items():
        height, width = picture(out / "data" / f"{uuid}.png").shape[:2]
        records = [r for r in result_of(run, uuid).targets_moved if r.index is not None]
        assert len(detections) == len(records)
        for detection, record in zip(detections, records, strict=True):
            assert content["classes"][detection["label"]] == record.label
            left, top, wide, high = detection["bounding_box"]
            box = [left * width, top * height, (left + wide) * width, (top + high) * height]
            assert box == pytest.approx([v + 0.5 for v in record.xyxy], abs=1e-2)
            assert detection["attributes"]["frame"] == uuid
            assert detection["attributes"]["z_m"] > 0
    failing = [d["attributes"].get("failure") for d in content["labels"]["demo-000"]]
    assert failing.count(GRADE) == 1


@pytest.mark.parametrize(("layout", "kind"), [("yolo", YoloDataset), ("vkitti2", Vkitti2Dataset)])
def test_yolo_and_virtual_kitti_by_their_readers(layout: str, kind: Any, run: Path, tmp_path: Path) -> None:
    out = export(run, layout, tmp_path / "out")
    dataset = kind(out)
    (identifier,) = dataset.identifiers
    frame = dataset.frame(identifier)
    records = [r for r in result_of(run, "demo-000").targets_moved if r.index is not None]
    boxes = torch.tensor([r.xyxy for r in records])
    assert float((frame.labels.boxes_xyxy - boxes).abs().max()) < (0.01 if layout == "yolo" else 1.01)
    exported_picture = picture(run / "frames/demo-000/counterexample.png")[..., ::-1]
    assert np.array_equal((frame.photograph * 255).round().byte().permute(1, 2, 0).numpy(), exported_picture)


PEOPLE = (
    "Pedestrian 0.00 1 -0.35 885.00 167.00 910.00 251.00 1.75 0.60 0.80 6.00 1.65 15.00 0.03",
    "Cyclist 0.00 3 -10 100.50 170.25 130.75 210.00 -1 -1 -1 -1000 -1000 -1000 -10",
    "Tram 0.20 2 -10 1100.00 120.00 1200.00 200.00 -1 -1 -1 -1000 -1000 -1000 -10",
)
REGION = "DontCare -1 -1 -10 300.00 160.00 330.00 175.00 -1 -1 -1 -1000 -1000 -1000 -10"


@pytest.fixture(scope="module")
def crowded(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a frame with people, a tram and a region without labels: its files as `attack` writes them."""
    out = tmp_path_factory.mktemp("crowded") / "b"
    shutil.copytree(run, out)
    frame = out / "frames" / "demo-000"
    files.write_text(out / "people.txt", "".join(f"{line}\n" for line in (REGION, *PEOPLE)))
    others, scene = read_labels(out / "people.txt"), load_scene(frame / "scene")
    ignore = torch.cat([others.ignore_xyxy, others.boxes_xyxy])
    save_scene(replace(scene, ignore=ignore, other_labels=others), frame / "scene")
    moved = replace(read_labels(frame / "labels_moved.txt"), ignore_xyxy=ignore)
    write_labels(frame / "labels_moved.txt", moved)
    return out


def people_of(lines: list[str]) -> list[list[str | float]]:
    """Label lines of all but vehicles, as types and numbers."""
    rows = [line.split() for line in lines if not line.startswith(("Car", "Van", "Truck"))]
    return [[kind, *map(float, numbers)] for kind, *numbers in rows]


def check_people(run: Path, out: Path, *words: str) -> None:
    """KITTI's labels of an exported run have those that it was made from."""
    export(run, "kitti", out, *words)
    found = people_of((out / "training/label_2/demo-000.txt").read_text().splitlines())
    expected = people_of([REGION, *PEOPLE])
    assert [row[0] for row in found] == [row[0] for row in expected]
    for one, other in zip(found, expected, strict=True):
        assert one[1:] == pytest.approx(other[1:], abs=0.01)  # alpha follows from the place


def test_kitti_has_people_as_they_were_labelled(crowded: Path, tmp_path: Path) -> None:
    check_people(crowded, tmp_path / "K")


@pytest.mark.slow
def test_an_attack_on_a_frame_with_people(run: Path, tmp_path: Path) -> None:
    labels = export(run, "kitti", tmp_path / "K") / "training" / "label_2" / "demo-000.txt"
    labels.write_text(labels.read_text() + "".join(f"{line}\n" for line in (*PEOPLE, REGION)))
    words = ["attack", "--dataset", "kitti", "--root", str(tmp_path / "K"), "--no-fit", "--params", "color"]
    words += ["--steps", "1", "--nuisances", "off", "--no-confirm", "--workers", "1"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    check_people(tmp_path / "run", tmp_path / "again", "--grade", "all")


def test_coco_has_people_as_objects_and_regions_as_crowds(crowded: Path, tmp_path: Path) -> None:
    out = export(crowded, "coco", tmp_path / "C")
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(out / "annotations" / "instances_all.json"))
    names = {row["id"]: row["name"] for row in coco.loadCats(coco.getCatIds())}
    rows = coco.loadAnns(coco.getAnnIds(iscrowd=0))
    for kind, *numbers in people_of(list(PEOPLE)):
        (row,) = (row for row in rows if names[row["category_id"]] == kind)
        left, top, right, bottom = numbers[3:7]
        assert row["bbox"] == pytest.approx([left + 0.5, top + 0.5, right - left, bottom - top])
        assert ("pose" in row) == (kind == "Pedestrian")
    crowds = coco.loadAnns(coco.getAnnIds(iscrowd=1))
    assert sorted(row["category_id"] for row in crowds) == sorted(names)  # of every class
    assert {tuple(row["bbox"]) for row in crowds} == {(300.5, 160.5, 30.0, 15.0)}


@pytest.mark.parametrize("layout", ["yolo", "vkitti2"])
def test_people_by_the_readers_of_yolo_and_virtual_kitti(layout: str, crowded: Path, tmp_path: Path) -> None:
    out = export(crowded, layout, tmp_path / "out")
    dataset = YoloDataset(out) if layout == "yolo" else Vkitti2Dataset(out)
    labels = dataset.frame(dataset.identifiers[0]).labels
    assert labels is not None
    found = dict(zip(labels.kind, labels.boxes_xyxy.tolist(), strict=True))
    for kind, *numbers in people_of(list(PEOPLE)):
        if layout == "yolo" or kind == "Pedestrian":
            assert found[str(kind)] == pytest.approx(numbers[3:7], abs=0.01)
        else:  # Virtual KITTI holds nothing without a 3D box
            assert kind not in found


def test_fiftyone_has_people(crowded: Path, tmp_path: Path) -> None:
    content = json.loads((export(crowded, "fiftyone", tmp_path / "F") / "labels.json").read_text())
    kinds = [content["classes"][row["label"]] for row in content["labels"]["demo-000"]]
    assert [kind for kind in kinds if kind not in ("Car", "Truck")] == ["Pedestrian", "Cyclist", "Tram"]


def kitti_lines(run: Path, out: Path, *words: str) -> list[str]:
    """What an exported label file has beside vehicles."""
    lines = (export(run, "kitti", out, *words) / "training/label_2/demo-000.txt").read_text()
    return [str(row[0]) for row in people_of(lines.splitlines())]


@pytest.fixture
def with_bus(crowded: Path, tmp_path: Path) -> Path:
    """The run with a class that KITTI does not have in the place of the tram."""
    again = tmp_path / "run"
    shutil.copytree(crowded, again)
    record = again / "frames/demo-000/scene/scene.json"
    content = files.read_json(record)
    content["others"]["kind"][2] = "bus"
    files.write_json(record, content)
    return again


def test_what_kitti_has_no_type_for_is_a_region(with_bus: Path, tmp_path: Path) -> None:
    assert kitti_lines(with_bus, tmp_path / "a") == ["DontCare", "Pedestrian", "Cyclist", "DontCare"]
    mapped = kitti_lines(with_bus, tmp_path / "b", "--map", "bus=Tram")
    assert mapped == ["DontCare", "Pedestrian", "Cyclist", "Tram"]
    words = [str(with_bus), "--to", "kitti", "--out", str(tmp_path / "c"), "--map", "bus=lorry"]
    assert "class 'lorry': expected one of Car" in refusal("export", *words)


def test_label_files_without_their_regions_are_refused(with_bus: Path, tmp_path: Path) -> None:
    labels = with_bus / "frames/demo-000/labels_moved.txt"
    lines = labels.read_text().splitlines()
    labels.write_text("".join(f"{line}\n" for line in lines if not line.startswith("DontCare")))
    words = [str(with_bus), "--to", "kitti", "--out", str(tmp_path / "b")]
    assert "labels_moved.txt: expected at its end 3 DontCare, as the scene has" in refusal("export", *words)


def test_provenance_of_exported_pictures(run: Path, tmp_path: Path) -> None:
    content = files.read_json(export(run, "kitti", tmp_path / "K") / "provenance.json")
    assert (content["run"], content["detector"], content["params"], content["labels"]) == (
        "a",
        "squeezedet",
        ["translate"],
        "moved",
    )
    (frame,) = content["frames"]
    assert (frame["frame"], frame["grade"], frame["feasible"]) == ("demo-000", GRADE, True)
    assert [row["kind"] for row in frame["failed"]] == ["missed"]


def test_tables(run: Path, tmp_path: Path) -> None:
    out = export(run, "tables", tmp_path / "T", "--grade", "all")
    rows = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in out.glob("*.csv")}
    assert [row["frame"] for row in rows["frames"]] == ["demo-000", "demo-001"]
    assert [(row["frame"], row["grade"]) for row in rows["failures"]] == [("demo-000", GRADE)]
    theta = {(row["frame"], row["name"]): float(row["value"]) for row in rows["theta"]}
    expected = {(n, c.name): c.value for n in ("demo-000", "demo-001") for c in result_of(run, n).theta}
    assert theta == expected
    if find_spec("pyarrow") is None:
        assert not list(out.glob("*.parquet"))
    else:
        parquet = importlib.import_module("pyarrow.parquet")  # optional: pip install "drivesem[tables]"
        read = parquet.read_table(out / "theta.parquet").to_pylist()
        assert {(row["frame"], row["name"]): row["value"] for row in read} == expected


@pytest.mark.usefixtures("screen")
def test_gltf_opens_in_trimesh(run: Path, tmp_path: Path) -> None:
    folder = run / "frames" / "demo-000" / "scene"
    out = export(folder, "gltf", tmp_path / "G")
    (file,) = out.iterdir()
    scene, saved = trimesh.load_scene(file), load_scene(folder)
    assert set(scene.geometry) == {"surroundings", *(f"vehicle-{i}" for i in range(len(saved.objects)))}
    for i in range(len(saved.objects)):
        mesh = scene.geometry[f"vehicle-{i}"]
        x, y, z = saved.objects.translation[i].tolist()
        low, high = mesh.bounds
        assert low[0] < x < high[0]
        assert low[2] < -z < high[2]
        assert abs(low[1] + y) < 0.3  # it stands on its wheels
        assert mesh.visual.material.baseColorTexture is not None
    behind = scene.geometry["surroundings"].visual.material.baseColorTexture
    assert behind.size == (saved.camera.width, saved.camera.height)


def test_convert_takes_a_run_with_its_pictures(run: Path, tmp_path: Path) -> None:
    for layout, image in (("kitti", "training/image_2/demo-001.png"), ("yolo", "images/train/demo-001.png")):
        words = ["convert", str(run), "--to", layout, "--copy-images", "--out", str(tmp_path / layout)]
        assert main(words) == 0
        assert (tmp_path / layout / image).is_file()
    # both commands write the same labels
    export(run, "kitti", tmp_path / "K")
    label = "training/label_2/demo-000.txt"
    assert (tmp_path / "K" / label).read_text() == (tmp_path / "kitti" / label).read_text()
    assert f"in {run / 'frames'}" in invoke("convert", run, "--to", "coco", "--out", tmp_path / "a.json").err
    for row in files.read_json(tmp_path / "a.json")["images"]:
        assert (run / "frames" / row["file_name"]).is_file()


def test_no_frame_of_a_grade(run: Path, tmp_path: Path) -> None:
    words = ["export", str(run), "--to", "kitti", "--grade", "shared", "--out", str(tmp_path / "x")]
    assert "--grade shared: expected a failure of this grade" in refusal(*words)
    assert not (tmp_path / "x").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").touch()
    assert "--out: expected a new or empty folder" in refusal(*words[:-1], tmp_path / "full")
