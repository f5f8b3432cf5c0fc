"""`drivesem convert`: there and back between layouts, and what it says is lost."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drivesem.data.coco import CocoDataset
from drivesem.data.kitti import KittiDataset, read_labels
from drivesem.data.vkitti1 import Vkitti1Dataset
from drivesem.data.vkitti2 import Vkitti2Dataset
from drivesem.data.yolo import YoloDataset
from tests.drivesem.invoke import invoke, refusal, run_json

LABELS = """\
Car 0.00 0 -1.57 100.41 106.40 229.75 189.25 1.55 1.63 3.89 -2.85 1.63 12.34 -1.80
Van 0.35 3 1.85 0.00 100.02 81.33 200.50 2.11 1.90 5.08 -8.40 1.70 11.02 1.12
Pedestrian 0.00 1 0.21 300.15 120.00 320.99 180.07 1.72 0.50 0.80 1.84 1.47 20.123 0.30
DontCare -1 -1 -10 240.79 112.01 260.53 118.90 -1 -1 -1 -1000 -1000 -1000 -10
"""
CALIB = "P2: 721.5377 0 180.5593 44.85728 0 721.5377 100.854 0.2163791 0 0 1 0.002745884\n"


def convert(*words: object) -> str:
    return invoke("convert", *words).err


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A KITTI folder of two frames, the second without objects."""
    training = tmp_path / "kitti" / "training"
    for name in ("image_2", "label_2", "calib"):
        (training / name).mkdir(parents=True)
    draw = np.random.default_rng(0)
    for name, text in (("000003", LABELS), ("000011", "")):
        Image.fromarray(draw.integers(0, 255, (210, 360, 3)).astype(np.uint8)).save(
            training / f"image_2/{name}.png"
        )
        (training / f"label_2/{name}.txt").write_text(text)
        (training / f"calib/{name}.txt").write_text(CALIB)
    return tmp_path / "kitti"


def _labels(folder: Path) -> dict[str, list[list[str]]]:
    paths = sorted(folder.rglob("*.txt"))
    return {
        p.name: [line.split() for line in p.read_text().splitlines()] for p in paths if p.parent.name != "calib"
    }


def test_kitti_to_coco_and_back(kitti: Path, tmp_path: Path):
    text = convert(kitti, "--to", "coco", "--out", tmp_path / "coco", "--copy-images")
    assert "nothing left out" in text
    dataset = CocoDataset(tmp_path / "coco")
    ours, theirs = dataset.frame("000003"), KittiDataset(kitti).frame("000003")
    assert ours.labels is not None
    assert theirs.labels is not None
    assert ours.labels.kind == theirs.labels.kind
    assert torch.allclose(ours.labels.boxes_xyxy, theirs.labels.boxes_xyxy)
    assert ours.camera.matrix.tolist() == theirs.camera.matrix.tolist()
    assert len(ours.labels.ignore_xyxy) == 1
    assert "nothing left out" in convert(
        tmp_path / "coco", "--to", "kitti", "--out", tmp_path / "back", "--copy-images"
    )
    back = tmp_path / "back/training"
    assert (back / "label_2/000003.txt").read_text().replace("-1.00", "-1") == LABELS
    assert (back / "label_2/000011.txt").read_text() == ""
    assert (back / "image_2/000003.png").read_bytes() == (kitti / "training/image_2/000003.png").read_bytes()
    assert KittiDataset(tmp_path / "back").frame("000003").camera.matrix.tolist() == theirs.camera.matrix.tolist()


def test_coco_keeps_its_ids_and_keys(tmp_path: Path):
    content = {
        "images": [{"id": 42, "file_name": "b.jpg", "width": 640, "height": 480}],
        "annotations": [
            {"id": 7, "image_id": 42, "category_id": 18, "bbox": [1.25, 2.5, 30.125, 40], "area": 600.5,
             "iscrowd": 0, "segmentation": [[1, 2, 30, 2, 30, 40]]},
            {"id": 9, "image_id": 42, "category_id": 3, "bbox": [0, 0, 30, 40], "area": 1200, "iscrowd": 1},
        ],
        "categories": [{"id": 3, "name": "car"}, {"id": 18, "name": "dog"}],
    }  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content))
    assert "nothing left out" in convert(tmp_path / "a.json", "--to", "coco", "--out", tmp_path / "b.json")
    written = json.loads((tmp_path / "b.json").read_text())
    assert written["annotations"] == content["annotations"]
    assert [(c["id"], c["name"]) for c in written["categories"]] == [(3, "car"), (18, "dog")]
    text = convert(tmp_path / "a.json", "--to", "yolo", "--out", tmp_path / "yolo")
    assert "left out: area of the mask of 1, crowd of 1, segmentation of 1" in text
    assert (tmp_path / "yolo/data.yaml").exists()
    text = convert(tmp_path / "a.json", "--to", "kitti", "--map", "dog=-", "--out", tmp_path / "kitti")
    assert "crowd of 1" in text
    assert (tmp_path / "kitti/b.txt").read_text().startswith("DontCare -1 -1 -10 -0.50 -0.50 29.50 39.50 -1")


def test_kitti_to_yolo_and_back(kitti: Path, tmp_path: Path):
    text = convert(kitti, "--to", "yolo", "--out", tmp_path / "yolo", "--copy-images")
    assert "left out: 3D box of 3, alpha of 3, occlusion of 3, region of 1, truncation of 3" in text
    frame = YoloDataset(tmp_path / "yolo").frame("000003")
    assert frame.labels is not None
    assert frame.labels.kind == ("Car", "Van", "Pedestrian")
    text = convert(tmp_path / "yolo", "--from", "yolo", "--to", "kitti", "--out", tmp_path / "back")
    assert "nothing left out; assumed: occlusion (3, unknown) of 3, truncation (0) of 3" in text
    rows = _labels(tmp_path / "back")["000003.txt"]
    assert len(read_labels(tmp_path / "back/000003.txt").kind) == 3
    # boxes come back to the last decimal; what YOLO has no place for is unknown
    assert [row[0] for row in rows] == ["Car", "Van", "Pedestrian"]
    assert [row[4:8] for row in rows] == [line.split()[4:8] for line in LABELS.splitlines()[:3]]
    assert rows[0][8:] == ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]


@pytest.mark.parametrize("layout", ["vkitti1", "vkitti2"])
def test_kitti_to_virtual_kitti_and_back(kitti: Path, tmp_path: Path, layout: str):
    text = convert(kitti, "--to", layout, "--out", tmp_path / "virtual", "--copy-images")
    assert "fraction of a pixel of 3" in text
    assert "region of 1" in text
    assert "track of 3" in text.partition("assumed: ")[2]
    dataset = Vkitti1Dataset(tmp_path / "virtual") if layout == "vkitti1" else Vkitti2Dataset(tmp_path / "virtual")
    name = next(n for n in dataset.identifiers if n.endswith("00003"))
    labels = dataset.labels(name)
    assert labels.kind == ("Car", "Van", "Pedestrian")
    assert labels.occlusion.tolist() == [0, 2 if layout == "vkitti1" else 3, 1]
    assert labels.truncation.tolist() == pytest.approx([0, 0.35, 0])
    assert labels.boxes_xyxy[0].tolist() == [100, 106, 230, 189]
    text = convert(tmp_path / "virtual", "--to", "kitti", "--out", tmp_path / "back")
    rows = next(iter(_labels(tmp_path / "back").values()))
    assert [row[8:15] for row in rows] == [line.split()[8:15] for line in LABELS.splitlines()[:3]]
    assert "model of 3" in text
    assert "left out: names" not in text
    assert (tmp_path / "back/training/label_2" / f"{name}.txt").is_file()
    # and once more into its own layout: everything is there
    again = convert(tmp_path / "virtual", "--to", layout, "--out", tmp_path / "again", "--copy-images")
    assert "nothing left out" in again
    for path in sorted((tmp_path / "virtual").rglob("*.txt")):
        relative = path.relative_to(tmp_path / "virtual")
        if "extrinsic" not in path.name and "intrinsic" not in path.name:
            assert (tmp_path / "again" / relative).read_text() == path.read_text(), relative


def test_no_digit_is_lost_through_coco_and_yolo(tmp_path: Path):
    draw = np.random.default_rng(4)
    (tmp_path / "in").mkdir()
    lines = []
    for _ in range(300):
        left, top = draw.uniform(0, 1000), draw.uniform(0, 300)
        box = (left, top, left + draw.uniform(0.5, 200), top + draw.uniform(0.5, 70))
        numbers = " ".join(
            f"{v:.2f}" for v in (*box, *draw.uniform(0.5, 9, 3), *draw.normal(0, 20, 2), 15.25, 0.5)
        )
        lines.append(f"Car {draw.uniform(0, 1):.2f} {draw.integers(0, 4)} {draw.uniform(-3, 3):.2f} {numbers}\n")
    (tmp_path / "in/000000.txt").write_text("".join(lines))
    size = ("--image-size", "1242x375")
    convert(tmp_path / "in", "--to", "coco", "--out", tmp_path / "a.json", *size)
    convert(tmp_path / "a.json", "--to", "kitti", "--out", tmp_path / "back")
    assert (tmp_path / "back/000000.txt").read_text() == "".join(lines)
    convert(tmp_path / "a.json", "--to", "yolo", "--out", tmp_path / "yolo")
    (tmp_path / "yolo/images/train").mkdir(parents=True)
    Image.new("RGB", (1242, 375)).save(tmp_path / "yolo/images/train/000000.png")
    convert(tmp_path / "yolo", "--to", "kitti", "--out", tmp_path / "boxes")
    boxes = [row[4:8] for row in _labels(tmp_path / "boxes")["000000.txt"]]
    assert boxes == [line.split()[4:8] for line in lines]


def test_results_keep_their_scores(tmp_path: Path):
    (tmp_path / "results").mkdir()
    line = "Car -1 -1 -10 100.41 106.40 229.75 189.25 -1 -1 -1 -1000 -1000 -1000 -10 0.123456789"
    (tmp_path / "results/000000.txt").write_text(line + "\n")
    words = ("--scores", "--image-size", "1242x375")
    convert(tmp_path / "results", "--to", "coco", "--out", tmp_path / "r.json", *words)
    assert json.loads((tmp_path / "r.json").read_text())["annotations"][0]["score"] == 0.123456789
    convert(tmp_path / "r.json", "--to", "kitti", "--out", tmp_path / "back", "--scores")
    assert (tmp_path / "back/000000.txt").read_text() == line + "\n"


def test_json(kitti: Path, tmp_path: Path):
    data = run_json("convert", kitti, "--to", "yolo", "--out", tmp_path / "yolo")
    assert data["lost"]["3D box"] == 3
    assert data["data"]["rows"] == {"classes": {"Car": 1, "Pedestrian": 1, "Van": 1}, "regions": 1}
    assert (data["data"]["files"], data["data"]["skipped"]) == (6, {})
    assert data["assumed"] == {"val (same images as train)": 2}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["{kitti}", "--to", "coco", "--out", "{out}", "--image-size", "big"],
            "--image-size: expected WIDTHxHEIGHT",
        ),
        (["{kitti}", "--to", "yolo", "--out", "{out}.json"], "--out: expected a folder for yolo"),
        (["{kitti}", "--to", "yolo", "--out", "{kitti}"], "--out: expected a new or empty folder"),
        (["{kitti}", "--to", "coco", "--out", "{out}", "--map", "Car"], "--map: expected NAME=CLASS with commas"),
        (["{kitti}", "--to", "coco", "--out", "{out}", "--map", "Bus=Car"], "--map: expected some of Car, "),
        (["{kitti}/nothing", "--to", "coco", "--out", "{out}"], "nothing there"),
        (
            ["{flat}", "--to", "coco", "--out", "{out}"],
            "coco: image sizes: expected --images FOLDER or --image-size",
        ),
        (["{flat}", "--to", "vkitti2", "--out", "{out}"], "3D box: expected one of every object, found none of 1"),
        (["{dog}", "--to", "kitti", "--out", "{out}"], "class 'dog': expected one of Car, "),
    ],
)
def test_one_line_and_exit_code_2(kitti: Path, tmp_path: Path, words: list[str], message: str):
    flat = tmp_path / "flat"
    flat.mkdir()
    (flat / "000000.txt").write_text("Car 0 0 -10 1 2 30 40 -1 -1 -1 -1000 -1000 -1000 -10\n")
    dog = {
        "images": [{"id": 1, "width": 9, "height": 9}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": [1, 1, 2, 2]}],
        "categories": [{"id": 1, "name": "dog"}],
    }
    (tmp_path / "dog.json").write_text(json.dumps(dog))
    places = {"kitti": kitti, "flat": flat, "dog": tmp_path / "dog.json", "out": tmp_path / "new"}
    text = invoke("convert", *(word.format(**places) for word in words), code=2).err
    assert len(text.splitlines()) == 1
    assert message in text


@pytest.fixture
def two_parts(tmp_path: Path) -> Path:
    """A COCO folder whose parts have images of the same name, the first dark, the second light."""
    root = tmp_path / "parts"
    (root / "annotations").mkdir(parents=True)
    for part, shade in (("train", 50), ("val", 200)):
        (root / "images" / part).mkdir(parents=True)
        Image.new("RGB", (100, 60), (shade, shade, shade)).save(root / f"images/{part}/000001.jpg")
        content = {
            "images": [{"id": 1, "file_name": "000001.jpg", "width": 100, "height": 60}],
            "categories": [{"id": 3, "name": "car"}],
            "annotations": [{"id": 7, "image_id": 1, "category_id": 3, "bbox": [10, 10, 30, 20], "iscrowd": 0}],
        }
        (root / f"annotations/instances_{part}.json").write_text(json.dumps(content))
    return root


def test_images_of_coco_are_those_of_its_part(two_parts: Path, tmp_path: Path):
    source = two_parts / "annotations/instances_val.json"
    words = (source, "--to", "yolo", "--copy-images", "--out")
    convert(*words, tmp_path / "yolo")
    picture = two_parts / "images/val/000001.jpg"
    copied = tmp_path / "yolo/images/train/000001.jpg"
    assert copied.read_bytes() == picture.read_bytes()
    # one that is called as its frame there, with another suffix
    picture.rename(picture.with_suffix(".jpeg"))
    convert(*words, tmp_path / "again")
    assert (tmp_path / "again/images/train/000001.jpeg").read_bytes() == copied.read_bytes()
    # another part's is none
    picture.with_suffix(".jpeg").unlink()
    assert "--copy-images: expected an image of each of 1 frames, found 0" in refusal(
        "convert", *words, tmp_path / "none"
    )


def test_images_below_folders_are_found_by_name_and_none_outside(two_parts: Path, tmp_path: Path):
    source = two_parts / "annotations/instances_train.json"
    content = json.loads(source.read_text())
    (two_parts / "images/train/day").mkdir()
    (two_parts / "images/train/000001.jpg").rename(two_parts / "images/train/day/1.jpg")
    content["images"][0]["file_name"] = "day/1.jpg"
    source.write_text(json.dumps(content))
    convert(source, "--to", "yolo", "--copy-images", "--out", tmp_path / "yolo")
    (copied,) = (tmp_path / "yolo/images").rglob("*1.jpg")
    assert copied.read_bytes() == (two_parts / "images/train/day/1.jpg").read_bytes()
    outside = tmp_path / "000001.jpg"
    outside.write_bytes(copied.read_bytes())
    for name in ("../../../000001.jpg", str(outside), f"{'x' * 300}.jpg"):
        content["images"][0]["file_name"] = name
        source.write_text(json.dumps(content))
        words = [str(source), "--to", "yolo", "--copy-images", "--out", str(tmp_path / "none")]
        assert "--copy-images: expected an image of each of 1 frames, found 0" in refusal("convert", *words)


def test_a_file_with_splits_is_written_with_its_splits_names_and_attributes(two_parts: Path, tmp_path: Path):
    for part, weather in (("train", "rainy"), ("val", "clear")):
        source = two_parts / f"annotations/instances_{part}.json"
        content = json.loads(source.read_text())
        content["images"][0] |= {"attributes": {"weather": weather}, "file_name": "day/1.jpg"}
        (two_parts / f"images/{part}/day").mkdir()
        (two_parts / f"images/{part}/000001.jpg").rename(two_parts / f"images/{part}/day/1.jpg")
        source.write_text(json.dumps(content))
    assert "nothing left out" in convert(two_parts, "--to", "coco", "--copy-images", "--out", tmp_path / "out")
    for part in ("train", "val"):
        path = f"annotations/instances_{part}.json"
        written, content = (json.loads((root / path).read_text()) for root in (tmp_path / "out", two_parts))
        for row in (*written["images"], *content["images"], *content["annotations"], *written["annotations"]):
            row.pop("id")
            row.pop("image_id", None)
            row.pop("area", None)
        assert written["images"] == content["images"]
        assert written["annotations"] == content["annotations"]
        copy, image = (root / "images" / part / "day/1.jpg" for root in (tmp_path / "out", two_parts))
        assert copy.read_bytes() == image.read_bytes()
    assert "split of 2" in convert(two_parts, "--to", "coco", "--out", tmp_path / "a.json")


def test_classes_of_coco_follow_those_of_yolo(tmp_path: Path):
    root = tmp_path / "yolo"
    (root / "images/train").mkdir(parents=True)
    (root / "labels/train").mkdir(parents=True)
    Image.new("RGB", (100, 60)).save(root / "images/train/a.jpg")
    (root / "labels/train/a.txt").write_text("1 0.5 0.5 0.2 0.2\n")
    (root / "data.yaml").write_text("train: images/train\nval: images/train\nnames: [Pedestrian, Car]\n")
    convert(root, "--to", "coco", "--out", tmp_path / "a.json")
    content = json.loads((tmp_path / "a.json").read_text())
    assert [(row["id"], row["name"]) for row in content["categories"]] == [(1, "Pedestrian"), (2, "Car")]
    assert content["annotations"][0]["category_id"] == 2


def test_names_of_images_that_stay_where_they_are(two_parts: Path, tmp_path: Path):
    source = two_parts / "annotations/instances_val.json"
    for words in ((), ("--map", "car=Car")):
        out = tmp_path / f"{len(words)}.json"
        convert(source, "--to", "coco", *words, "--out", out)
        assert json.loads(out.read_text())["images"][0]["file_name"] == "000001.jpg"
    convert(source, "--to", "yolo", "--copy-images", "--out", tmp_path / "yolo")
    convert(tmp_path / "yolo", "--to", "coco", "--out", tmp_path / "of-yolo.json")
    assert json.loads((tmp_path / "of-yolo.json").read_text())["images"][0]["file_name"] == "000001.jpg"


def test_regions_alone_are_no_detections(tmp_path: Path):
    (tmp_path / "in").mkdir()
    region = LABELS.splitlines(keepends=True)[-1]
    (tmp_path / "in/000000.txt").write_text(region)
    convert(tmp_path / "in", "--to", "kitti", "--out", tmp_path / "out")
    assert (tmp_path / "out/000000.txt").read_text().startswith("DontCare -1 -1 -10 240.79 112.01 260.53 118.90")


def test_images_of_kitti_labels_keep_their_suffix(kitti: Path, tmp_path: Path):
    for path in (kitti / "training/image_2").glob("*.png"):
        Image.open(path).save(path.with_suffix(".jpg"))
        path.unlink()
    convert(kitti, "--to", "coco", "--out", tmp_path / "a.json")
    content = json.loads((tmp_path / "a.json").read_text())
    assert [row["file_name"] for row in content["images"]] == ["000003.jpg", "000011.jpg"]


@pytest.fixture
def named_yolo(tmp_path: Path) -> Path:
    """A YOLO folder with splits, a subfolder, suffixes in capitals, and KITTI's types in another order."""
    root = tmp_path / "yolo"
    for split, name, text in (
        ("train", "day/a.JPG", "1 0.5 0.5 0.2 0.2\n0 0.2 0.3 0.1 0.4\n"),
        ("val", "b.jpeg", "2 0.5 0.5 0.2 0.2\n"),
    ):
        image, labels = root / "images" / split / name, root / "labels" / split / f"{name.partition('.')[0]}.txt"
        image.parent.mkdir(parents=True)
        labels.parent.mkdir(parents=True)
        Image.new("RGB", (100, 60)).save(image, "JPEG")
        labels.write_text(text)
    names = "names: [Pedestrian, Van, Car]\n"
    (root / "data.yaml").write_text(f"train: images/train\nval: images/val\n{names}")
    return root


@pytest.mark.parametrize("layout", ["coco", "kitti"])
def test_names_splits_and_class_numbers_go_there_and_back(named_yolo: Path, tmp_path: Path, layout: str):
    text = convert(named_yolo, "--to", layout, "--copy-images", "--out", tmp_path / "there")
    assert text.startswith("yolo: 2 images, 3 boxes in 3 classes; splits: train 1, val 1\n")
    assert "nothing left out" in text
    images = {"coco": ("images/train/day/a.JPG", "images/val/b.jpeg"), "kitti": ("day/a.JPG", "b.jpeg")}[layout]
    folder = tmp_path / "there" / ("training/image_2" if layout == "kitti" else "")
    assert all((folder / name).is_file() for name in images)
    text = convert(tmp_path / "there", "--to", "yolo", "--copy-images", "--out", tmp_path / "back")
    assert "splits: train 1, val 1" in text
    assert (tmp_path / "back/images/train/day/a.JPG").is_file()
    assert (tmp_path / "back/images/val/b.jpeg").is_file()
    classes = YoloDataset(tmp_path / "back").class_names
    assert classes == (("Pedestrian", "Van", "Car") if layout == "coco" else ("Car", "Pedestrian", "Van"))
    rows = [line.split() for line in (tmp_path / "back/labels/train/day/a.txt").read_text().splitlines()]
    assert [classes[int(row[0])] for row in rows] == ["Van", "Pedestrian"]
    assert [float(value) for value in rows[0][1:]] == pytest.approx([0.5, 0.5, 0.2, 0.2])


def test_predictions_for_the_source_fit_the_converted_file(named_yolo: Path, tmp_path: Path):
    convert(named_yolo, "--to", "coco", "--out", tmp_path / "gt.json")
    content = json.loads((tmp_path / "gt.json").read_text())
    assert [row["file_name"] for row in content["images"]] == ["day/a.JPG", "b.jpeg"]
    rows = [  # of a detector that counts the source's classes from 1
        {"image_id": 1, "category_id": 2, "bbox": [40, 24, 20, 12], "score": 0.9},
        {"image_id": 1, "category_id": 1, "bbox": [15, 6, 10, 24], "score": 0.8},
        {"image_id": 2, "category_id": 3, "bbox": [40, 24, 20, 12], "score": 0.7},
    ]
    (tmp_path / "results.json").write_text(json.dumps(rows))
    metrics = run_json("eval", "--gt", tmp_path / "gt.json", "--pred", tmp_path / "results.json")["metrics"]
    assert metrics["AP"] == pytest.approx(1)


@pytest.mark.parametrize(
    ("layout", "source_size"), [("coco", (100, 60)), ("yolo", (60, 100)), ("kitti", (60, 100))]
)
def test_copies_are_upright(tmp_path: Path, layout: str, source_size: tuple[int, int]):
    """A quarter turn: the stored image is 100 x 60 px, the upright one 60 x 100."""
    root, names = (
        tmp_path / "in",
        {"coco": "images/all/a.jpg", "yolo": "images/all/a.jpg", "kitti": "image_2/a.jpg"},
    )
    path = root / names[layout]
    path.parent.mkdir(parents=True)
    pixels = np.full((60, 100, 3), 128, np.uint8)
    pixels[10:20, 30:60] = 255
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    Image.fromarray(pixels).save(path, exif=exif, quality=100)
    box = (40, 30, 50, 60)  # of the upright image: left = 60 - 20
    if layout == "coco":  # the file states the stored size, so its boxes are of stored pixels
        content = {
            "images": [{"id": 1, "file_name": "a.jpg", "width": source_size[0], "height": source_size[1]}],
            "categories": [{"id": 1, "name": "Car"}],
            "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [30, 10, 30, 10]}],
        }
        (root / "annotations").mkdir()
        (root / "annotations/instances_all.json").write_text(json.dumps(content))
    elif layout == "yolo":
        (root / "labels/all").mkdir(parents=True)
        (root / "labels/all/a.txt").write_text(f"0 {45 / 60} 0.45 {10 / 60} 0.3\n")
        (root / "data.yaml").write_text("train: images/all\nval: images/all\nnames: [Car]\n")
    else:
        (root / "label_2").mkdir()
        (root / "label_2/a.txt").write_text("Car 0 0 -10 39.5 29.5 49.5 59.5 -1 -1 -1 -1000 -1000 -1000 -10\n")
    convert(root, "--to", "coco", "--copy-images", "--out", tmp_path / "out")
    frame = CocoDataset(tmp_path / "out").frame("a")
    assert frame.photograph.shape[1:] == (100, 60)
    assert frame.labels is not None
    assert frame.labels.boxes_xyxy.numpy() == pytest.approx(np.array([box]) - 0.5, abs=0.01)
    (copy,) = (tmp_path / "out").rglob("a.jpg")
    with Image.open(copy) as image:
        assert (image.size, image.getexif().get(0x0112), image.getexif()[0x010F]) == ((60, 100), None, "maker")
        inside = np.asarray(image)[box[1] + 2 : box[3] - 2, box[0] + 2 : box[2] - 2]
    assert inside.min() > 240


def test_splits_and_attributes_that_are_lost_are_counted(two_parts: Path, tmp_path: Path):
    source = two_parts / "annotations/instances_val.json"
    content = json.loads(source.read_text())
    content["images"][0]["attributes"] = {"weather": "rainy"}
    source.write_text(json.dumps(content))
    text = convert(two_parts, "--to", "kitti", "--out", tmp_path / "out")
    assert "left out: attributes of frames of 1" in text
    assert sorted(path.name for path in (tmp_path / "out/training/label_2").rglob("*.txt")) == ["000001.txt"] * 2
    assert (tmp_path / "out/ImageSets/val.txt").read_text() == "val/000001\n"
    text = convert(source, "--to", "fiftyone", "--copy-images", "--out", tmp_path / "fiftyone")
    assert "nothing left out" in text
