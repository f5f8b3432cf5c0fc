"""BDD100K's JSON in all its forms: boxes, attributes, splits, and one line for each damage."""

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from drivesem.cli import main
from drivesem.data import bdd100k
from drivesem.data.layouts import detect_layout, read_table
from drivesem.data.registry import open_dataset
from drivesem.data.subsets import FrameFilter, open_selection
from scene_ir import files
from scene_ir.errors import FormatError

NIGHT = {"weather": "rainy", "scene": "city street", "timeofday": "night"}


def label(
    category: str = "car", corners: tuple[float, ...] | None = (10.5, 5, 30, 25.25), **attributes: Any
) -> dict[str, Any]:
    row: dict[str, Any] = {"id": 1, "category": category, "attributes": attributes}
    if corners is None:
        return row | {"poly2d": [{"vertices": [[1, 2], [3, 4]], "types": "LL", "closed": False}]}
    return row | {"box2d": dict(zip(("x1", "y1", "x2", "y2"), corners, strict=True))}


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_image(path: Path, orientation: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.new("RGB", (60, 40), (40, 60, 90)).save(path, exif=exif)


LABELS = [
    label("car", occluded=False, truncated=False, trafficLightColor="none"),
    label("rider", (0, 0, 4, 8), occluded=True, truncated=True, trafficLightColor="none"),
    label("person", (1, 2, 3, 4), crowd=True),
    label("lane/single white", None),
    label("area/drivable", None),
]


def write_dataset(root: Path, form: str) -> None:
    """One frame to train on, with labels, and one to validate on, without."""
    frames = {"train": {"name": "a1.jpg", "attributes": NIGHT}, "val": {"name": "b1.jpg", "labels": None}}
    for split, frame in frames.items():
        labels = {"labels": LABELS} if split == "train" else {}
        content: Any = [{**frame, **labels}]
        if form == "2018":
            write_json(root / f"labels/bdd100k_labels_images_{split}.json", content)
        elif form == "detection":
            write_json(root / f"labels/det_20/det_{split}.json", content)
            write_json(root / f"labels/lane/polygons/lane_{split}.json", content)
        elif form == "frames":
            categories = {"categories": [{"name": "car"}], "imageSize": {"width": 60, "height": 40}}
            write_json(root / f"{split}.json", {"frames": content, "config": categories})
        else:
            objects = [{"timestamp": 10000, "objects": LABELS if split == "train" else []}]
            single = {"name": frame["name"].removesuffix(".jpg"), "frames": objects}
            write_json(
                root / f"labels/100k/{split}/{single['name']}.json",
                single | {"attributes": frame.get("attributes", {})},
            )
        write_image(root / f"images/100k/{split}/{frame['name']}")
    write_image(root / "images/10k/train/a1.jpg")
    write_image(root / "images/100k/test/c1.jpg")
    write_image(root / "labels/drivable/masks/train/a1.png")


@pytest.mark.parametrize("form", ["2018", "detection", "frames", "single"])
def test_forms(form: str, tmp_path: Path) -> None:
    write_dataset(tmp_path, form)
    assert detect_layout(tmp_path) == "bdd100k"
    dataset = open_dataset("bdd100k", tmp_path, focal_px=70)
    assert dataset.identifiers == ("a1", "b1")
    assert dataset.splits() == {"train": ("a1",), "val": ("b1",)}
    assert dataset.attributes("a1") == NIGHT
    assert dataset.attributes("b1") == {}
    frame = dataset.frame("a1")
    labels = frame.labels
    assert labels is not None
    assert labels.kind == ("car", "rider")
    assert labels.boxes_xyxy.tolist() == [[10, 4.5, 29.5, 24.75], [-0.5, -0.5, 3.5, 7.5]]
    assert labels.ignore_xyxy.tolist() == [[0.5, 1.5, 2.5, 3.5]]
    assert labels.occlusion.tolist() == [0, 1]
    assert labels.truncation.isnan().tolist() == [False, True]
    assert frame.camera.intrinsics.tolist() == [[70, 0, 29.5], [0, 70, 19.5], [0, 0, 1]]
    assert frame.provenance == {
        "dataset": "bdd100k",
        "image": "a1.jpg",
        "folder": "train",
        "focal": "70.0 px, given",
    }
    assert read_table(tmp_path, "bdd100k").image_paths[0] == tmp_path / "images/100k/train/a1.jpg"
    account = dataset.account()
    assert (account.frames, account.files, account.regions, account.unlabelled) == (2, 4, 1, 1)
    assert account.classes == {"car": 1, "rider": 1}
    assert account.repairs == {"lane/single white without a box": 1, "area/drivable without a box": 1}
    assert (account.without_image, account.unused_keys) == (0, ())
    unread = {"JSON of another task or form": 2} if form == "detection" else {}
    assert account.skipped == {"image that no label or folder of the layout names": 3, **unread}


def test_tables(tmp_path: Path) -> None:
    write_dataset(tmp_path, "detection")
    table = read_table(tmp_path, "bdd100k")
    assert table.kinds == ("car", "person", "rider")
    assert [table.kinds[kind] for kind in table.kind.tolist()] == ["car", "rider", "person"]
    assert (table.box_format, table.boxes[0].tolist()) == ("xywh", [10.5, 5, 19.5, 20.25])
    assert table.sizes_wh.tolist() == [[60, 40]] * 2
    assert table.splits == {"train": [0], "val": [1]}
    assert table.frame_attributes == {0: NIGHT}
    assert table.extra == {"attributes": [{"trafficLightColor": "none"}] * 2 + [None]}
    selected = open_selection("bdd100k", tmp_path, FrameFilter(where={"timeofday": ("night",)}))
    assert selected.identifiers == ("a1",)
    with pytest.raises(FormatError, match="detections with scores, found bdd100k"):
        read_table(tmp_path, "bdd100k", scored=True)


def test_one_file_of_a_data_set(tmp_path: Path) -> None:
    write_dataset(tmp_path, "detection")
    path = tmp_path / "labels/det_20/det_train.json"
    assert detect_layout(path) == "bdd100k"
    dataset = open_dataset("bdd100k", path)
    assert dataset.identifiers == ("a1",)
    assert dataset.frame("a1").photograph.shape == (3, 40, 60)
    table = read_table(path, "bdd100k")
    assert table.splits == {"train": [0]}


def test_images_of_one_name_in_several_splits(tmp_path: Path) -> None:
    for split in ("train", "val"):
        write_json(tmp_path / f"det_{split}.json", [{"name": "x.jpg", "labels": [label(split)]}])
        write_image(tmp_path / split / "x.jpg")
    dataset = open_dataset("bdd100k", tmp_path)
    assert dataset.identifiers == ("train/x", "val/x")
    labels = dataset.labels("val/x")
    assert labels is not None
    assert labels.kind == ("val",)
    assert dataset.frame("val/x").provenance["folder"] == "val"


def test_boxes_turn_with_the_image(tmp_path: Path) -> None:
    """Orientation 6: a quarter turn to the right."""
    size = {"width": 60, "height": 40}
    frames = [{"name": "x.jpg", "labels": [label()], "size": size}, {"name": "y.jpg", "labels": [label()]}]
    write_json(tmp_path / "val.json", frames)
    for name in ("x", "y"):
        write_image(tmp_path / f"{name}.jpg", orientation=6)
    table = read_table(tmp_path, "bdd100k")
    assert table.sizes_wh.tolist() == [[40, 60]] * 2
    assert table.boxes.tolist() == [[14.75, 10.5, 20.25, 19.5], [10.5, 5, 19.5, 20.25]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            [{"name": "x.jpg", "labels": [label("car", (1, 2, 3, float("nan")))]}],
            r"\[0\].labels\[0\].box2d: .* finite",
        ),
        (
            [{"name": "x.jpg", "labels": [{"category": "car", "box2d": [1, 2]}]}],
            r"\[0\].labels\[0\].box2d: .* x1",
        ),
        (
            [{"name": "x.jpg", "labels": [{"box2d": None}]}],
            r"\[0\].labels\[0\].category: expected the name of a class",
        ),
        ([{"name": 3, "labels": []}], r"\[0\].name: expected the name of an image, found 3"),
        ([{"name": "x.jpg", "labels": "none", "attributes": {}}], r"\[0\].labels: expected a list, found str"),
        ([{"name": "x.jpg", "labels": []}, 3], r"\[1\]: expected a frame"),
        ([{"name": "x.jpg", "labels": []}] * 2, "a name once, found 'val/x' twice"),
        ([{"image_id": 1, "name": "x.jpg", "labels": []}], "expected BDD100K's JSON, .* found none"),
    ],
)
def test_damaged_files(content: Any, message: str, tmp_path: Path) -> None:
    write_json(tmp_path / "val.json", content)
    with pytest.raises(FormatError, match=message):
        open_dataset("bdd100k", tmp_path)


def test_corners_may_be_exchanged_and_images_missing(tmp_path: Path) -> None:
    write_json(tmp_path / "val.json", [{"name": "x.jpg", "labels": [label("car", (30, 5, 10, 25))]}])
    dataset = open_dataset("bdd100k", tmp_path)
    labels = dataset.labels("x")
    assert labels is not None
    assert labels.boxes_xyxy.tolist() == [[9.5, 4.5, 29.5, 24.5]]
    account = dataset.account()
    assert (account.repairs, account.without_image) == ({"boxes with exchanged corners": 1}, 1)
    with pytest.raises(FormatError, match=r"val.json: expected an image of frame 'x' in the data set, found none"):
        dataset.frame("x")


@pytest.mark.parametrize(
    "text", ['[{"a": 1}, {"b": [2, "]"]},\n {"ü": 3}]', '\ufeff{"frames": [ ], "x": 1}', "[1,2.5]"]
)
@pytest.mark.parametrize("chunk", [1, 3, 1000])
def test_lists_are_read_in_chunks(text: str, chunk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "_CHUNK_BYTES", chunk)
    path = tmp_path / "list.json"
    path.write_text(text, "utf-8")
    if chunk < 20 and "frames" in text:
        return  # the start must lie in the first chunk
    content = json.loads(text.removeprefix("\ufeff"))
    expected = content if isinstance(content, list) else content["frames"]
    assert list(files.iterate_json_list(path, bdd100k._LIST_START)) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[{"a": 1} {"b": 2}]', r"\[1\]: expected a comma or the end of the list, found '{'"),
        ('[{"a": 1}, {"b": ', r"\[1\]: expected JSON"),
        ('[{"a": 1}', r"\[0\]: expected JSON, found the end of the file"),
        ('[{"a": 1e999999}, {"b": 99999999999999999999}]', r"\[1\]:?.* too large"),
        ("[" * 100_000, r"\[0\]: expected JSON"),
        ("{}", "expected a list, found '{}'"),
    ],
)
def test_damaged_lists(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "list.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        list(files.iterate_json_list(path, bdd100k._LIST_START))


def test_conversion_and_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_dataset(tmp_path / "bdd", "2018")
    out = tmp_path / "coco"
    assert main(["convert", str(tmp_path / "bdd"), "--to", "coco", "-o", str(out), "--copy-images"]) == 0
    train = json.loads((out / "annotations/instances_train.json").read_text())
    assert [(image["file_name"], image["attributes"]) for image in train["images"]] == [("a1.jpg", NIGHT)]
    assert train["annotations"][0]["bbox"] == [10.5, 5, 19.5, 20.25]
    assert train["annotations"][0]["attributes"] == {"trafficLightColor": "none"}
    assert (out / "images/val/b1.jpg").is_file()
    results = tmp_path / "pred/a1.txt"
    unknown = "-1 -1 -1 -1000 -1000 -1000 -10"
    results.parent.mkdir()
    lines = (f"car -1 -1 -10 10 4.5 29.5 24.75 {unknown} 0.9", f"rider -1 -1 -10 -0.5 -0.5 3.5 7.5 {unknown} 0.8")
    results.write_text("\n".join(lines))
    results.with_name("b1.txt").write_text("")
    capsys.readouterr()
    assert main(["eval", "--gt", str(tmp_path / "bdd"), "--pred", str(results.parent), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["metrics"]["AP"] == pytest.approx(1)
    assert "bdd100k: 2 images, 2 boxes in 2 classes" in captured.err
