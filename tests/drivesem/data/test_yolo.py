"""YOLO folders: values, the round trip, and one line for everything that can be wrong with them."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from drivesem.data import layouts, yolo
from drivesem.data.account import IMAGE_SUFFIXES
from drivesem.data.coco import CATEGORIES
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.label_table import LabelTable, xyxy_to_coco
from drivesem.data.registry import WRITERS, open_dataset
from drivesem.data.yolo_labels import read_rows
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_uint8


def place(number: int, part: str = "train") -> FrameLocation:
    return FrameLocation(number, "01", "clone", number, part)


@pytest.fixture
def folder(tmp_path: Path, make_exposure: Callable[..., Exposure]) -> Path:
    """Frame 0 to train on, frame 1, without objects, to validate."""
    writer = WRITERS["yolo"](tmp_path / "yolo")
    assert not writer.exists(place(0))
    entries = [
        writer.write(place(0), make_exposure(0)),
        writer.write(place(1, "val"), make_exposure(1, specification=())),
    ]
    assert writer.exists(place(0))
    assert not writer.exists(place(0, "val"))
    writer.finish(entries)
    return tmp_path / "yolo"


def test_layout_and_values(folder: Path) -> None:
    found = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    assert found == [
        *("calib/train/000000.txt", "calib/val/000001.txt", "data.yaml"),
        *("images/train/000000.png", "images/val/000001.png", "labels/train/000000.txt", "labels/val/000001.txt"),
    ]
    lines = (folder / "labels/train/000000.txt").read_text().splitlines()
    # the car covers columns 5 to 24 of 80 and rows 12 to 23 of 40
    assert lines[0] == "0 0.18750000 0.45000000 0.25000000 0.30000000"
    assert [line.split()[0] for line in lines] == ["0", "1", "3"]
    assert all(re.fullmatch(r"\d+( [01]\.\d{6,}){4}", line) for line in lines)
    assert (folder / "labels/val/000001.txt").read_text() == ""
    content = yaml.safe_load((folder / "data.yaml").read_text())
    assert content["train"] == "images/train"
    assert content["val"] == "images/val"
    assert content["nc"] == len(content["names"]) == 8
    assert list(content["names"].values()) == list(CATEGORIES)


def test_what_is_written_reads_back(folder: Path, make_exposure: Callable[..., Exposure]) -> None:
    dataset = open_dataset("yolo", folder)
    assert dataset.identifiers == ("000000", "000001")
    made, frame = make_exposure(0), dataset.frame("000000")
    assert torch.equal((frame.photograph * 255).round().byte(), torch.from_numpy(made.image).permute(2, 0, 1))
    assert torch.equal(frame.camera.matrix, made.camera.matrix)
    assert frame.labels is not None
    assert frame.labels.kind == made.labels.kind
    torch.testing.assert_close(frame.labels.boxes_xyxy, made.labels.boxes_xyxy, atol=1e-4, rtol=0)
    assert frame.labels.occlusion.tolist() == [3, 3, 3]
    unknown = (frame.labels.truncation, frame.labels.translation, frame.labels.yaw, frame.labels.size_lhw)
    assert all(bool(values.isnan().all()) for values in unknown)
    empty = dataset.labels("000001")
    assert empty is not None
    assert empty.boxes_xyxy.shape == (0, 4)


@given(
    st.tuples(st.integers(2, 4000), st.integers(2, 4000)),
    st.lists(st.floats(0, 1), min_size=4, max_size=4, unique=True),
)
def test_boxes_round_trip(
    tmp_path_factory: pytest.TempPathFactory, size_wh: tuple[int, int], shares: list[float]
) -> None:
    width, height = size_wh
    x0, x1 = (v * (width - 1) for v in sorted(shares[:2]))
    y0, y1 = (v * (height - 1) for v in sorted(shares[2:]))
    if min((x1 - x0) / width, (y1 - y0) / height) < 1e-7:
        return
    box = xyxy_to_coco(np.array([x0, y0, x1, y1]))
    path = tmp_path_factory.getbasetemp() / "box.txt"
    path.write_text(yolo._format_line(2, box.tolist(), size_wh, yolo.DECIMALS))
    rows = read_rows([str(path)], 3, scored=False)
    table = yolo._to_table(["box"], ["a", "b", "c"], np.arange(3), rows, np.array([size_wh]))
    assert table.kind.tolist() == [2]
    assert table.boxes[0] == pytest.approx(box.tolist(), abs=1e-4)


def test_without_a_calibration_a_usual_focal_length_is_taken(folder: Path) -> None:
    (folder / "calib/train/000000.txt").unlink()
    usual = yolo.YoloDataset(folder).frame("000000")
    assert float(usual.camera.intrinsics[0, 0]) == pytest.approx(0.58 * 80)
    assert usual.provenance["focal"] == "46.4 px, default"
    camera = yolo.YoloDataset(folder, focal_px=70.0).frame("000000").camera
    assert camera.intrinsics.tolist() == [[70, 0, 39.5], [0, 70, 19.5], [0, 0, 1]]


def test_an_image_without_a_label_file_has_no_objects(folder: Path) -> None:
    (folder / "labels/train/000000.txt").unlink()
    assert yolo.YoloDataset(folder).labels("000000").kind == ()


def test_lists_of_folders_and_of_names(folder: Path) -> None:
    other = folder / "other.yaml"
    other.write_text("path: .\ntrain: [images/train, images/val]\nval: images/val\nnames: [car, b, c, d]\n")
    dataset = yolo.YoloDataset(other)
    assert dataset.identifiers == ("000000", "000001")
    assert dataset.labels("000000").kind == ("car", "b", "d")


GOOD = "0 0.5 0.5 0.25 0.25"
BAD_LINES = [
    ("0 0.5 0.5 0.25", "expected 5 fields: class cx cy w h, or a polygon, found 4"),
    (f"{GOOD} 0.9 0.9 0.9", "expected 5 fields: class cx cy w h, or a polygon, found 8"),
    (f"{GOOD} x", "score: expected a number, found 'x'"),
    ("8 0.5 0.5 0.25 0.25", "class: expected one of the 8 in names, found '8'"),
    ("0.5 0.5 0.5 0.25 0.25", "class: expected one of the 8 in names, found '0.5'"),
    (f"{'1' * 5000} 0.5 0.5 0.25 0.25", "class: expected one of the 8 in names"),
    ("-1 0.5 0.5 0.25 0.25", "class: expected one of the 8 in names"),
    ("0 1.5 0.5 0.25 0.25", r"cx: expected a share of the image in \[0, 1\], found '1.5'"),
    ("0 0.5 nan 0.25 0.25", "cy: expected a share"),
    ("0 0.5 0.5 -0.01 0.25", "w: expected a share"),
    ("0 0.5 0.5 1.06 0.25", "w: expected a share"),
    ("0 0.5 0.5 0.25 x", "h: expected a share .*found 'x'"),
    ("0 0.1 0.1 0.2 0.1 0.2 7", r"y3: expected a share of the image in \[0, 1\], found '7'"),
]


@pytest.mark.parametrize(("line", "message"), BAD_LINES)
def test_a_bad_line_is_named(line: str, message: str, folder: Path) -> None:
    (folder / "labels/train/000000.txt").write_text(f"{GOOD}\n\n{line}\n")
    dataset = yolo.YoloDataset(folder)
    with pytest.raises(FormatError, match=rf"labels/train/000000\.txt:3: ?{message}") as caught:
        dataset.frame("000000")
    assert "\n" not in str(caught.value)
    dataset.frame("000001")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- a\n", r"data\.yaml: expected train, val and names, found list"),
        ("a: [\n", r"data\.yaml: expected YAML"),
        ("train: images/train\n", r"data\.yaml: names: expected a list of classes, .*found None"),
        ("names: [a]\n", r"data\.yaml: train: expected a folder with at least one image .*, found none"),
        ("names: [a]\ntrain: a.txt\n", r"data\.yaml: train: expected a list of images in .*, found 'a\.txt'"),
        (f"names: [a]\ntrain: {'t' * 400}\n", "train: expected a folder of images in .*, found 'ttt"),
        ("names: [a]\ntrain: no\n", "train: expected a folder of images in .*, found 'no'"),
        ("names: [a]\ntrain: calib/train\n", r"train: expected a folder with at least one image .*, found none"),
        ("names: [a]\ntrain: ../other\n", r"data\.yaml: train: expected a folder .*, found '\.\./other'"),
        ("names: [a]\ntrain: [/etc]\n", r"data\.yaml: train: expected a folder of images in .*, found '/etc'"),
        ("names: [a]\npath: /etc\ntrain: a\n", r"data\.yaml: train: expected a folder of images in .*, found 'a'"),
        ("names: [a]\ntrain: [1]\n", r"data\.yaml: train: expected a folder of images, or a list of folders"),
        (
            "names: [a]\ntrain: images/train\nkpt_shape: 3\n",
            r"data\.yaml: kpt_shape: expected number of keypoints",
        ),
        ("names: {0: a, 2: b}\ntrain: images/train\n", "names: expected .*, numbers from 0 to 1, found"),
        ("names: no.txt\ntrain: images/train\n", "names: expected a list of classes, or a file of them"),
        ("names: {a: b}\ntrain: images/train\n", r"data\.yaml: names: expected .*found \{'a': 'b'\}"),
    ],
)
def test_a_bad_data_yaml_is_named(text: str, message: str, folder: Path) -> None:
    (folder / "data.yaml").write_text(text.replace("no\n", '"no"\n'))
    with pytest.raises(FormatError, match=message) as caught:
        yolo.YoloDataset(folder)
    assert "\n" not in str(caught.value)


def test_other_bad_requests(folder: Path) -> None:
    with pytest.raises(FormatError, match=r"nowhere: expected a readable file"):
        yolo.YoloDataset(folder / "nowhere")
    with pytest.raises(RangeError, match="expected one of 2 identifiers, found '7'"):
        yolo.YoloDataset(folder).labels("7")
    with pytest.raises(RangeError, match="focal_px: expected positive px, found 0"):
        yolo.YoloDataset(folder, focal_px=0.0)
    with pytest.raises(RangeError, match="frames of the data set: expected at least one, found 0"):
        yolo.YoloWriter(folder).finish([])
    (folder / "images/train/000000.png").write_bytes(b"no image")
    with pytest.raises(FormatError, match=r"images/train/000000\.png: expected an image"):
        yolo.YoloDataset(folder).labels("000000")


def test_a_part_without_frames_is_the_other_one(tmp_path: Path, make_exposure: Callable[..., Exposure]) -> None:
    writer = yolo.YoloWriter(tmp_path)
    writer.finish([writer.write(place(0), make_exposure())])
    assert yaml.safe_load((tmp_path / "data.yaml").read_text())["val"] == "images/train"
    assert yolo.YoloDataset(tmp_path).identifiers == ("000000",)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_upright_as_opencv_reads_them(orientation: int, suffix: str, tmp_path: Path) -> None:
    """Trainers read them so, and labels are of what they read."""
    path = tmp_path / f"images/train/a{suffix}"
    path.parent.mkdir(parents=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.random.default_rng(0).integers(0, 256, (30, 50, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(path, exif=exif)
    files.write_text(tmp_path / "labels/train/a.txt", "0 0.25 0.5 0.5 1\n")
    files.write_text(tmp_path / "data.yaml", "train: images/train\nval: images/train\nnames: [Car]\n")
    seen = cv2.imread(str(path))
    assert seen is not None
    frame = yolo.YoloDataset(tmp_path).frame("a")
    assert np.array_equal(to_uint8(frame.photograph), seen[..., ::-1])
    assert frame.labels is not None
    height, width = seen.shape[:2]
    assert frame.labels.boxes_xyxy.tolist() == [[-0.5, -0.5, width / 2 - 0.5, height - 0.5]]
    assert (frame.camera.width, frame.camera.height) == (width, height)


def test_boxes_beyond_the_image_are_clipped_and_counted(tmp_path: Path) -> None:
    """A reader takes no share above 1; what is only rounded beyond stays as it is."""
    boxes = [
        [-30, 5, 50, 20],
        [70, 5, 50, 20],
        [-9, 0, 118, 50],
        [120, 5, 9, 9],
        [0, 0, 100.004, 50],
        [1, 2, 3, 4],
    ]
    table = LabelTable.from_columns(
        ["a"], ["Car"], [0] * 6, [0] * 6, np.array(boxes, float), "xywh", sizes_wh=np.array([[100, 50]])
    )
    written = yolo.write_table(table, tmp_path, {})
    assert written.lost == {"box beyond the image": 4}
    assert written.assumed == {"val (same images as train)": 1}
    files.write_png(tmp_path / "images/train/a.png", np.zeros((50, 100, 3), np.uint8))
    again = yolo.YoloDataset(tmp_path).table()
    cut = [[0, 5, 20, 20], [70, 5, 30, 20], [0, 0, 100, 50], *boxes[4:]]
    assert np.allclose(again.boxes, cut, rtol=0, atol=1e-9)


SIZE_WH = (64, 48)
ROW = "0 0.5 0.5 0.25 0.25\n"
OTHER_ROW = "1 0.25 0.25 0.5 0.25\n"


def build(root: Path, content: dict[str, str], mode: str = "RGB") -> Path:
    """Write a data set: texts by path, and images where there is no text. Their size is SIZE_WH."""
    for name, text in content.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        if text:
            (root / name).write_bytes(text.encode())
        else:
            Image.new(mode, SIZE_WH).save(root / name)
    return root


def read_independently(root: Path, folders: list[str]) -> list[tuple[Any, ...]]:
    """Boxes (file, class, left, top, right, bottom px) as Ultralytics reads them: images by glob, the last folder
    "images" replaced, rows parsed, equal rows dropped, polygons bounded.
    """
    boxes: set[tuple[Any, ...]] = set()
    for image in (
        p for folder in folders for p in (root / folder).rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES
    ):
        labels = Path("/labels/".join(str(image).rsplit("/images/", 1))).with_suffix(".txt")
        width, height = ImageOps.exif_transpose(Image.open(image)).size
        text = labels.read_text(encoding="utf-8-sig") if labels.exists() else ""
        for line in filter(str.strip, text.splitlines()):
            kind, *v = map(float, line.split())
            if len(v) > 5:
                x0, y0, x1, y1 = min(v[::2]), min(v[1::2]), max(v[::2]), max(v[1::2])
            else:
                x0, y0, x1, y1 = v[0] - v[2] / 2, v[1] - v[3] / 2, v[0] + v[2] / 2, v[1] + v[3] / 2
            corners = (round(c * s, 6) for c, s in zip((x0, y0, x1, y1), (width, height) * 2, strict=True))
            boxes.add((image.name, int(kind), *corners))
    return sorted(boxes)


def read_boxes(table: LabelTable) -> list[tuple[Any, ...]]:
    ends = np.concatenate([table.boxes[:, :2], table.boxes[:, :2] + table.boxes[:, 2:]], axis=1)
    names = [table.image_files[i].rpartition("/")[2] for i in table.frame.tolist()]
    rows = zip(names, table.kind.tolist(), ends.tolist(), strict=True)
    return sorted((name, kind, *(round(v, 6) for v in box)) for name, kind, box in rows)


POLYGON = "1 0.125 0.25 0.5 0.25 0.5 0.75 0.125 0.5\n"
TABS = "\ufeff0\t0.5\t5e-1\t2.5E-1\t0.25\r\n\r\n1 0.25  0.25 0.5 0.25 \r\n"
NAMES = "names: [car, van]\n"
TWO = "train: images/train\nval: images/val\n" + NAMES
CASES = {
    "sub-folders, suffixes": (
        TWO,
        {
            "images/train/drive_b/x.JPG": "",
            "images/train/y.webp": "",
            "images/val/z.bmp": "",
            "images/val/q.tif": "",
            "labels/train/drive_b/x.txt": ROW,
            "labels/train/y.txt": ROW + OTHER_ROW,
            "labels/val/z.txt": "\n",
        },
        ["images/train", "images/val"],
        {
            "frames": 4,
            "classes": {"car": 2, "van": 1},
            "unlabelled": 1,
            "splits": {"train": 2, "val": 2},
            "files": 8,
        },
    ),
    "parent that is missing": (
        "train: ../train/images\nval: ../valid/images\ntest: ../test/images\nnc: 3\nroboflow: {}\n" + NAMES,
        {
            "train/images/x.jpg": "",
            "train/labels/x.txt": ROW,
            "valid/images/x.jpg": "",
            "valid/labels/x.txt": OTHER_ROW,
        },
        ["train/images", "valid/images"],
        {
            "splits": {"train": 1, "val": 1},
            "unused_keys": ("test ../test/images (no such folder)", "roboflow"),
            "repairs": {
                "folders and lists of another place (found in the data set's folder)": 2,
                "nc of 3 for 2 names (names used)": 1,
            },
        },
    ),
    "path of another machine": (
        "path: /content/datasets/{root}\ntrain: images\nnames: {'0': car, 1: van}\n",
        {
            "images/x.png": "",
            "labels/x.txt": ROW,
            "labels/lost.txt": ROW,
            "README.md": "a",
            "labels/train.cache": "b",
        },
        ["images"],
        {
            "without_image": 1,
            "files": 3,
            "repairs": {"path of another place (read in the data set's folder)": 1},
            "skipped": {
                "label file without an image": 1,
                ".md not part of the layout": 1,
                ".cache not part of the layout": 1,
            },
        },
    ),
    "rows": (
        TWO,
        {
            "images/train/x.png": "",
            "images/val/y.png": "",
            "labels/val/y.txt": TABS,
            "labels/train/x.txt": POLYGON + ROW.replace("0 ", "0.0 ", 1) + OTHER_ROW + OTHER_ROW,
        },
        ["images/train", "images/val"],
        {
            "classes": {"car": 2, "van": 3},
            "repairs": {
                "polygons (their bounding boxes)": 1,
                "class numbers written as decimals": 1,
                "repeated rows (dropped)": 1,
            },
        },
    ),
    "list of images": (
        "train: train.txt\nval: [val.txt]\n" + NAMES,
        {
            "images/a/x.png": "",
            "images/b/x.png": "",
            "labels/a/x.txt": ROW,
            "labels/b/x.txt": OTHER_ROW,
            "train.txt": "./images/a/x.png\n/home/me/set/images/b/x.png\nimages/c/gone.png\n",
            "val.txt": "images/b/x.png\nimages/b/x.png\n",
        },
        ["images"],
        {
            "splits": {"train": 2, "val": 1},
            "files": 7,
            "repairs": {"entries of lists without a readable image": 1, "images that a list repeats": 1},
        },
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_exports_are_read_as_trainers_read_them(name: str, tmp_path: Path) -> None:
    description, content, folders, expected = CASES[name]
    build(tmp_path, {"data.yaml": description.replace("{root}", tmp_path.name), **content})
    table = layouts.read_table(tmp_path, "yolo")
    boxes = read_boxes(table)
    assert boxes == read_independently(tmp_path, folders)
    assert table.account == yolo.YoloDataset(tmp_path).account()
    assert {key: getattr(table.account, key) for key in expected} == expected
    assert table.account is not None
    on_disk = sum(path.is_file() for path in tmp_path.rglob("*"))
    assert table.account.files + sum(table.account.skipped.values()) == on_disk
    # and once more as written
    written = yolo.write_table(table, tmp_path / "out", dict(zip(table.frames, _images(tmp_path), strict=True)))
    assert written.lost == {}
    again = layouts.read_table(tmp_path / "out", "yolo")
    assert [(name.lower(), *box) for name, *box in read_boxes(again)] == [
        (name.lower(), *box) for name, *box in boxes
    ]
    assert again.kinds == table.kinds
    for split, rows in table.splits.items():
        own = sorted(table.image_files[i].replace("valid/", "val/").lower() for i in rows)
        assert sorted(again.image_files[i].lower() for i in again.splits[split]) == own


def _images(root: Path) -> list[Path]:
    dataset = yolo.YoloDataset(root)
    return [dataset.image_path(identifier) for identifier in dataset.identifiers]


WITHOUT_YAML = {
    "classes.txt": {"classes.txt": "car\nvan\n", "images/x.png": "", "labels/x.txt": ROW, "notes.json": "{}"},
    "classes.txt of labels": {"labels/classes.txt": "car\nvan\n", "images/x.png": "", "labels/x.txt": ROW},
    "imgs": {"classes.txt": "car\nvan\n", "imgs/train/x.png": "", "labels/train/x.txt": ROW},
    "beside": {"classes.txt": "car\nvan\n", "x.png": "", "x.txt": ROW},
    "darknet": {
        "obj.names": "car\nvan\n",
        "train.txt": "data/obj_train_data/x.png\n",
        "obj.data": "classes = 2\ntrain = data/train.txt\nnames = data/obj.names\nbackup = backup/\n",
        "obj_train_data/x.png": "",
        "obj_train_data/x.txt": ROW,
    },
    "JPEGImages": {"data.yaml": "train: JPEGImages\n" + NAMES, "JPEGImages/x.png": "", "labels/x.txt": ROW},
    "any folder": {"data.yaml": "train: photos/a\n" + NAMES, "photos/a/x.png": "", "labels/a/x.txt": ROW},
}


@pytest.mark.parametrize("name", WITHOUT_YAML)
def test_folders_of_other_tools(name: str, tmp_path: Path) -> None:
    content = WITHOUT_YAML[name]
    build(tmp_path, content)
    assert layouts.detect_layout(tmp_path) == "yolo"
    table = layouts.read_table(tmp_path, "yolo")
    assert (table.frames, table.kinds, table.box_format) == (("x",), ("car", "van"), "xywh")
    assert table.boxes.tolist() == [[24, 18, 16, 12]]
    assert table.splits == ({"train": [0]} if name in ("imgs", "darknet", "JPEGImages", "any folder") else {})
    assert table.account is not None
    assert (table.account.unlabelled, table.account.without_image) == (0, 0)
    assert table.account.files + sum(table.account.skipped.values()) == len(content)
    assert sum(table.account.skipped.values()) == ("notes.json" in content)
    assert yolo.YoloDataset(tmp_path).frame("x").provenance["focal"].endswith("default")


@pytest.mark.parametrize("root", [".", "data.yaml", "images/..", "../{name}"])
def test_relative_roots(root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build(
        tmp_path,
        {"data.yaml": "train: images/train\n" + NAMES, "images/train/x.png": "", "labels/train/x.txt": ROW},
    )
    monkeypatch.chdir(tmp_path)
    account = yolo.YoloDataset(Path(root.format(name=tmp_path.name))).account()
    assert (account.files, dict(account.skipped), account.without_image) == (3, {}, 0)


def test_stems_that_do_not_pair_are_refused(tmp_path: Path) -> None:
    build(tmp_path, {"data.yaml": TWO, "images/train/x.png": "", "labels/train/img_x.txt": ROW})
    with pytest.raises(FormatError, match=r"label files named after the images, such as x\.txt, found 1 others"):
        yolo.YoloDataset(tmp_path)


def test_of_images_that_differ_in_their_suffix_one_is_read(tmp_path: Path) -> None:
    build(
        tmp_path, {"data.yaml": TWO, "images/train/x.png": "", "images/train/x.jpg": "", "labels/train/x.txt": ROW}
    )
    account = yolo.YoloDataset(tmp_path).account()
    assert (account.frames, dict(account.skipped)) == (1, {"image with the name of another one": 1})


@pytest.mark.parametrize(
    ("row", "box", "repair"),
    [
        ("0 0.5 0.5 1.002 0.5", [0, 12, 64, 24], "boxes clipped to the image"),
        ("0 1.01 0.5 0.25 0.5", [56.64, 12, 7.36, 24], "boxes clipped to the image"),
        ("0 -0.01 0.25 0.5 0.25 0.5 0.75", [0, 12, 32, 24], "boxes clipped to the image"),
        ("0 0.95 0.5 0.25 0.5", [52.8, 12, 16, 24], None),
        ("0 0.5 0.5 0.25 0.25 0.9", [24, 18, 16, 12], "values of a sixth column (not used)"),
        ("0 0.5 0.5 0.25 0.25 7", [24, 18, 16, 12], None),
    ],
)
def test_values_that_are_repaired(row: str, box: list[float], repair: str | None, tmp_path: Path) -> None:
    build(tmp_path, {"data.yaml": TWO, "images/train/x.png": "", "labels/train/x.txt": row})
    table = layouts.read_table(tmp_path, "yolo")
    assert np.allclose(table.boxes, [box], rtol=0, atol=1e-9)
    assert table.account is not None
    repairs = {key: n for key, n in table.account.repairs.items() if not key.startswith("polygons")}
    assert repairs == ({repair: 1} if repair else {})
    assert dict(table.extra) == ({"track": [7]} if row.endswith(" 7") else {})


def test_keypoints_are_left_out(tmp_path: Path) -> None:
    content = {"data.yaml": "kpt_shape: [2, 3]\ntrain: images/train\n" + NAMES, "images/train/x.png": ""}
    build(tmp_path, content | {"labels/train/x.txt": ROW.strip() + " 0.4 0.4 2 0.6 0.6 2\n"})
    table = layouts.read_table(tmp_path, "yolo")
    assert table.boxes.tolist() == [[24, 18, 16, 12]]
    assert table.account is not None
    assert (table.account.repairs, table.account.unused_keys) == ({"keypoints not used": 1}, ())


@pytest.fixture
def truth(tmp_path: Path) -> LabelTable:
    """Labels of two frames with one stem."""
    images = {f"images/{part}/x.png": "" for part in ("train", "val")}
    labels = {f"labels/{part}/x.txt": ROW for part in ("train", "val")}
    return layouts.read_table(build(tmp_path / "truth", {"data.yaml": TWO, **images, **labels}), "yolo")


def test_detections_are_matched_by_path(truth: LabelTable, tmp_path: Path) -> None:
    assert truth.frames == ("train/x", "val/x")
    root = build(tmp_path / "found", {"labels/val/x.txt": "1 0.5 0.5 0.25 0.25 0.5\n1 0.5 0.5 0.25 0.25 1.0 4\n"})
    assert layouts.detect_layout(root) == "yolo"
    table = layouts.read_table(root, "yolo", True, truth)
    assert (table.frames, table.score.tolist(), table.extra) == (("val/x",), [0.5, 1], {"track": [None, 4]})
    build(root, {"data.yaml": "names: [bus, car]\n"})  # its own classes
    named = layouts.read_table(root, "yolo", True, truth)
    assert [named.kinds[i] for i in named.kind] == ["car", "car"]
    assert named.kinds == ("car", "van", "bus")
    with pytest.raises(FormatError, match=r"x\.txt: expected a name of one of the 2 .*the name of 2 frames"):
        layouts.read_table(root / "labels/val", "yolo", True, truth)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            "0 0.5 0.5 0.2 0.2 0.5\n0 0.5 0.5 0.2 0.2 4\n",
            r"x\.txt:2: score: expected a score in \[0, 1\], found '4'",
        ),
        (
            "0 0.5 0.5 0.2 0.2 1\n",
            r"x\.txt:1: score: expected scores in \[0, 1\], found whole numbers in all rows",
        ),
        ("0 0.5 0.5 0.2 0.2\n", r"x\.txt:1: expected 6 fields: class cx cy w h score, found 5"),
        ("", "at least one detection"),
    ],
)
def test_track_ids_are_no_scores(rows: str, message: str, truth: LabelTable, tmp_path: Path) -> None:
    build(tmp_path / "found", {"train/x.txt": rows or "\n"})
    with pytest.raises(FormatError, match=message):
        layouts.read_table(tmp_path / "found", "yolo", True, truth)


def test_detections_of_score_one_read_back(truth: LabelTable, tmp_path: Path) -> None:
    perfect = replace(truth, score=np.ones(2))
    yolo.write_table(perfect, tmp_path / "found", {})
    assert layouts.read_table(tmp_path / "found/labels", "yolo", True, truth).score.tolist() == [1, 1]


@pytest.mark.parametrize("mode", ["L", "P", "RGBA"])
def test_grey_palette_and_opacity(mode: str, tmp_path: Path) -> None:
    build(tmp_path, {"data.yaml": TWO, "images/train/x.png": "", "labels/train/x.txt": ROW}, mode)
    assert yolo.YoloDataset(tmp_path).frame("x").photograph.shape == (3, 48, 64)


@pytest.mark.parametrize(
    ("splits", "content", "lost"),
    [
        ({"train2017": [0], "val2017": [1, 2]}, {"train": "images/train2017", "val": "images/val2017"}, {}),
        ({"train": [0, 1, 2], "val": [0, 1, 2]}, {"train": "images/train", "val": "images/train"}, {}),
        ({"train": [0, 1], "val": [1, 2]}, {"train": "images/train", "val": "val.txt"}, {}),
        ({"test": [0, 1, 2]}, dict.fromkeys(("train", "val", "test"), "images/test"), {}),
        ({"a": [0], "b": [1]}, {part: ["images/a", "images/b"] for part in ("train", "val")}, {"split": 2}),
    ],
)
def test_splits_are_written(
    splits: dict[str, list[int]], content: dict[str, object], lost: dict[str, int], tmp_path: Path
) -> None:
    boxes = np.array([[1.0, 2, 3, 4]] * 3)
    names = {0: "drive/0.jpg", 1: "drive/1.jpg", 2: "x.PNG"}
    table = LabelTable.from_columns(
        ["0", "1", "x"], ["Van", "Car"], [0, 1, 2], [1, 0, 1], boxes, "xywh", sizes_wh=np.array([SIZE_WH] * 3)
    )
    sources = build(tmp_path / "in", {"0.jpg": "", "1.jpg": "", "x.PNG": ""})
    images = {name: sources / names[i].rpartition("/")[2] for i, name in enumerate(table.frames)}
    summary = yolo.write_table(replace(table, splits=splits, image_files=names), tmp_path / "out", images)
    written = yaml.safe_load((tmp_path / "out/data.yaml").read_text())
    assert {key: value for key, value in written.items() if key not in ("nc", "names")} == content
    assert written["names"] == {0: "Van", 1: "Car"}
    rest = {"frame of no split (not in data.yaml)": 1} if "a" in splits else {}
    assert summary.lost == lost | rest
    again = layouts.read_table(tmp_path / "out", "yolo")
    assert again.kinds == ("Van", "Car")
    names = {"a/drive/0.jpg", "b/drive/1.jpg"} if rest else {"drive/0.jpg", "drive/1.jpg", "x.PNG"}
    assert set(again.image_files.values()) == names
