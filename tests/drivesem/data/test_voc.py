"""Pascal VOC's XML: boxes, places of images, splits, turned images, and one line for each damage."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from PIL import Image

from drivesem.cli import main
from drivesem.data.layouts import detect_layout, read_table
from drivesem.data.registry import open_dataset
from scene_ir.errors import FormatError

Box = tuple[float, float, float, float]


def write_xml(
    path: Path, objects: str = "", size_wh: Sequence[int] | None = (60, 40), name: str | None = None
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    size = "" if size_wh is None else f"<size><width>{size_wh[0]}</width><height>{size_wh[1]}</height></size>"
    stated = "" if name is None else f"<filename>{name}</filename>"
    path.write_text(f"<annotation>{stated}{size}{objects}</annotation>")


def box(kind: str = "car", corners: Box = (1, 1, 60, 40), more: str = "") -> str:
    values = "".join(f"<{n}>{v}</{n}>" for n, v in zip(("xmin", "ymin", "xmax", "ymax"), corners, strict=True))
    return f"<object><name>{kind}</name>{more}<bndbox>{values}</bndbox></object>"


def write_image(path: Path, orientation: int | None = None, size_wh: tuple[int, int] = (60, 40)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.new("RGB", size_wh, (90, 120, 60)).save(path, exif=exif)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames, of which the last has no object; the first two are to train on."""
    root = tmp_path / "voc"
    first = box("person", (11, 6, 20.5, 30), "<difficult>1</difficult>")
    first += box("car", (1, 1, 60, 40), "<truncated>1</truncated><occluded>1</occluded>")
    write_xml(root / "Annotations/a1.xml", first)
    write_xml(root / "Annotations/a2.xml", box("Bus", (3, 4, 5, 6)), None)
    write_xml(root / "Annotations/b1.xml")
    for name in ("a1", "a2", "b1"):
        write_image(root / f"JPEGImages/{name}.jpg")
    write_image(root / "SegmentationClass/a1.png")
    (root / "ImageSets/Main").mkdir(parents=True)
    (root / "ImageSets/Main/train.txt").write_text("a1\na2\nlost\n")
    (root / "ImageSets/Main/val.txt").write_text("b1  1\n")
    (root / "ImageSets/Main/trainval.txt").write_text("a1\na2\nb1\n")
    return root


def test_boxes_are_inclusive_and_counted_from_one(folder: Path) -> None:
    assert detect_layout(folder) == "voc"
    dataset = open_dataset("voc", folder, focal_px=70)
    assert dataset.identifiers == ("a1", "a2", "b1")
    frame = dataset.frame("a1")
    labels = frame.labels
    assert labels is not None
    assert labels.kind == ("car",)
    assert labels.boxes_xyxy.tolist() == [[0, 0, 59, 39]]
    assert labels.ignore_xyxy.tolist() == [[10, 5, 19.5, 29]]
    assert labels.occlusion.tolist() == [1]
    assert labels.truncation.isnan().all()
    assert frame.camera.intrinsics.tolist() == [[70, 0, 29.5], [0, 70, 19.5], [0, 0, 1]]
    assert frame.provenance == {
        "dataset": "voc",
        "image": "a1.jpg",
        "folder": "JPEGImages",
        "focal": "70.0 px, given",
    }
    assert dataset.attributes("a1") == {}
    empty = dataset.labels("b1")
    assert empty is not None
    assert empty.kind == ()


def test_everything_is_accounted_for(folder: Path) -> None:
    dataset = open_dataset("voc", folder)
    assert dataset.splits() == {"train": ("a1", "a2"), "val": ("b1",)}
    account = dataset.account()
    assert (account.frames, account.files, account.regions, account.unlabelled) == (3, 8, 1, 1)
    assert account.classes == {"car": 1, "Bus": 1}
    assert account.splits == {"train": 2, "val": 1}
    assert account.unused_keys == ("truncated",)
    assert account.repairs == {
        "image sizes that are missing (read from the image)": 1,
        "names in lists without an XML file": 1,
    }
    assert sum(account.skipped.values()) == 2  # the mask and trainval.txt


def test_tables_have_sizes_splits_and_file_names(folder: Path) -> None:
    table = read_table(folder, "voc")
    assert table.kinds == ("Bus", "car", "person")
    assert table.sizes_wh.tolist() == [[60, 40]] * 3
    assert table.splits == {"train": [0, 1], "val": [2]}
    assert table.image_files == {0: "a1.jpg", 1: "a2.jpg", 2: "b1.jpg"}
    assert table.account is not None
    assert table.account.frames == 3
    assert table.image_paths[1] == folder / "JPEGImages/a2.jpg"
    with pytest.raises(FormatError, match="detections with scores, found voc,"):
        read_table(folder, "voc", scored=True)


@pytest.mark.parametrize(
    ("xml", "image", "name", "identifier"),
    [
        ("train/x.xml", "train/x.jpg", None, "x"),
        ("Annotations/x.xml", "images/x.PNG", "other.jpg", "x"),
        ("Annotations/1.xml", "JPEGImages/x.v2.jpg", "C:\\data\\x.v2.jpg", "x.v2"),
        ("Annotations/1.xml", "JPEGImages/x.jpg", "x", "x"),
        ("Annotations/x.xml", "JPEGImages/sub/x.jpg", "x.png", "x"),
        ("valid/Annotations/x.xml", "valid/images/x.jpg", None, "x"),
    ],
)
def test_places_of_images(xml: str, image: str, name: str | None, identifier: str, tmp_path: Path) -> None:
    write_xml(tmp_path / xml, box(), name=name)
    write_image(tmp_path / image)
    dataset = open_dataset("voc", tmp_path)
    assert dataset.identifiers == (identifier,)
    assert dataset.frame(identifier).photograph.shape == (3, 40, 60)
    assert detect_layout(tmp_path) == "voc"


def test_equal_names_in_folders_of_splits(tmp_path: Path) -> None:
    for i, split in enumerate(("train", "valid")):
        write_xml(tmp_path / split / "x.xml", box(corners=(1 + i, 1, 9, 9)))
        write_image(tmp_path / split / "x.jpg")
    dataset = open_dataset("voc", tmp_path)
    assert dataset.splits() == {"train": ("train/x",), "valid": ("valid/x",)}
    labels = dataset.labels("valid/x")
    assert labels is not None
    assert labels.boxes_xyxy.tolist() == [[1, 0, 8, 8]]


@pytest.mark.parametrize(
    ("size_wh", "expected", "turned"),
    [((60, 40), [29, 0, 39, 19], True), ((40, 60), [0, 0, 19, 10], False), ((0, 0), [0, 0, 19, 10], False)],
)
def test_boxes_turn_with_the_image(
    size_wh: tuple[int, int], expected: list[float], turned: bool, tmp_path: Path
) -> None:
    """Orientation 6: a quarter turn to the right."""
    write_xml(tmp_path / "x.xml", box(corners=(1, 1, 20, 11)), size_wh)
    write_image(tmp_path / "x.jpg", orientation=6)
    dataset = open_dataset("voc", tmp_path)
    frame = dataset.frame("x")
    assert frame.photograph.shape == (3, 60, 40)
    assert frame.labels is not None
    assert frame.labels.boxes_xyxy.tolist() == [pytest.approx(expected)]
    assert ("images with boxes of stored pixels (turned upright)" in dataset.account().repairs) == turned


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<annotation><object><bndbox/></object></annotation>", r"object\[0\].name: expected a class, found none"),
        ("<annotation>" + box(corners=(9, 1, 2, 3)) + "</annotation>", r"object\[0\].xmax: expected at least 9"),
        ("<annotation>" + box(corners=(1, 1, 2, float("nan"))) + "</annotation>", r"object\[0\].ymax: .* finite"),
        ("<annotation>" + box().replace("<ymax>40</ymax>", "") + "</annotation>", r"object\[0\].ymax: .* number"),
        ("<annotation><object>", r"x.xml:1:21: expected XML, found"),
        (
            "<!DOCTYPE a [<!ENTITY e 'x'>]><annotation>&e;</annotation>",
            "without a document type .* found <!DOCTYPE",
        ),
        ("<annotations/>", "expected an <annotation> of Pascal VOC, found <annotations>"),
        ("", "expected XML"),
        ("<annotation>" + "<a>" * 50_000 + "</a>" * 50_000 + "<object/></annotation>", None),
    ],
)
def test_damaged_files(content: str, message: str | None, tmp_path: Path) -> None:
    write_image(tmp_path / "x.jpg")
    (tmp_path / "x.xml").write_text(content)
    dataset = open_dataset("voc", tmp_path)
    if message is None:
        assert dataset.account().repairs == {
            "image sizes that are missing (read from the image)": 1,
            "objects without a box": 1,
        }
        return
    with pytest.raises(FormatError, match=message):
        dataset.labels("x")


def test_other_encodings(tmp_path: Path) -> None:
    text = '<?xml version="1.0" encoding="{}"?><annotation>' + box("Fußgänger") + "</annotation>"
    for name in ("utf-8-sig", "iso-8859-1"):
        (tmp_path / f"{name}.xml").write_bytes(text.format(name.removesuffix("-sig")).encode(name))
        write_image(tmp_path / f"{name}.jpg")
    assert open_dataset("voc", tmp_path).account().classes == {"Fußgänger": 2}


def test_missing_images_and_other_sizes(tmp_path: Path) -> None:
    write_xml(tmp_path / "x.xml", box(corners=(0, 0, 20, 20)), (50, 40))
    write_xml(tmp_path / "y.xml", box())
    write_image(tmp_path / "x.jpg")
    dataset = open_dataset("voc", tmp_path)
    with pytest.raises(FormatError, match=r"x.jpg: expected 50x40 px, as its annotation states, found 60x40 px"):
        dataset.frame("x")
    with pytest.raises(FormatError, match=r"y.xml: expected an image of frame 'y' in the data set, found none"):
        dataset.frame("y")
    account = dataset.account()
    assert account.without_image == 1
    assert account.repairs == {
        "boxes from pixel 0 or less (pixels count from 1)": 1,
        "images of another size than stated (refused where they are used)": 1,
    }
    with pytest.raises(
        FormatError, match=r"expected Pascal VOC's XML files, such as Annotations/NAME.xml, found none"
    ):
        open_dataset("voc", _empty(tmp_path))


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def test_conversion_and_evaluation(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "coco"
    assert main(["convert", str(folder), "--to", "coco", "-o", str(out), "--copy-images"]) == 0
    train = json.loads((out / "annotations/instances_train.json").read_text())
    assert [image["file_name"] for image in train["images"]] == ["a1.jpg", "a2.jpg"]
    assert [row["bbox"] for row in train["annotations"]] == [
        [10.5, 5.5, 9.5, 24],
        [0.5, 0.5, 59, 39],
        [2.5, 3.5, 2, 2],
    ]
    assert [row["iscrowd"] for row in train["annotations"]] == [1, 0, 0]
    assert (out / "images/val/b1.jpg").is_file()
    results = tmp_path / "pred"
    results.mkdir()
    unknown = "-1 -1 -1 -1000 -1000 -1000 -10"
    (results / "a1.txt").write_text(
        f"car -1 -1 -10 0 0 59 39 {unknown} 0.9\nperson -1 -1 -10 10 5 19.5 29 {unknown} 0.8\n"
    )
    (results / "a2.txt").write_text(f"Bus -1 -1 -10 2 3 4 5 {unknown} 0.7\n")
    (results / "b1.txt").write_text("")
    capsys.readouterr()
    assert main(["eval", "--gt", str(folder), "--pred", str(results), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["metrics"]["AP"] == pytest.approx(1)
    assert "voc: 3 images, 2 boxes in 2 classes" in captured.err
