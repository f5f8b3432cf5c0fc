"""YOLO folders: values, the round trip, and one line for everything that can be wrong with them."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from drivesem.data import yolo
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
