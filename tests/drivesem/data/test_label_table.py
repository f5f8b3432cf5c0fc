"""What every layout does alike: a box without an area is read, by scenes and tables; a turned one is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.data import kitti_labels, layouts, registry
from drivesem.data.kitti import format_calibration
from drivesem.data.label_table import LabelTable
from drivesem.training.frames import make_targets
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import Labels

POSE = "1.5 1.7 4.2 2.0 1.6 20.0 0.1"
SIZE = (1242, 375)


def _kitti(root: Path, right: float) -> None:
    files.write_png(root / "training/image_2/000000.png", np.zeros((*SIZE[::-1], 3), np.uint8))
    files.write_text(
        root / "training/calib/000000.txt", format_calibration(torch.eye(3, 4) + 99 * torch.eye(3, 4))
    )
    files.write_text(root / "training/label_2/000000.txt", f"Car 0 0 -10 10 20 {right} 60 {POSE}\n")


def _coco(root: Path, right: float) -> None:
    content = {
        "images": [{"id": 1, "file_name": "000000.png", "width": SIZE[0], "height": SIZE[1]}],
        "categories": [{"id": 1, "name": "Car"}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [10.5, 20.5, right - 10, 40]}],
    }
    files.write_text(root / "annotations/instances_all.json", json.dumps(content))


def _yolo(root: Path, right: float) -> None:
    files.write_png(root / "images/train/000000.png", np.zeros((100, 100, 3), np.uint8))
    files.write_text(root / "labels/train/000000.txt", f"0 0.105 0.405 {(right - 10) / 100} 0.4\n")
    files.write_text(root / "data.yaml", "train: images/train\nval: images/train\nnames: [Car]\n")


def _vkitti1(root: Path, right: float) -> None:
    from drivesem.data.vkitti1 import MOTGT

    files.write_png(root / "vkitti_1.3.1_rgb/0001/clone/00000.png", np.zeros((*SIZE[::-1], 3), np.uint8))
    row = f"0 0 Car 0 0 -1 10 20 {right:g} 60 1.7 1.5 4.2 2 1.6 20 0.1 0 0 0 1 Car 0 Sedan Red"
    files.write_text(root / "vkitti_1.3.1_motgt/0001_clone.txt", f"{MOTGT}\n{row}\n")


def _vkitti2(root: Path, right: float) -> None:
    from drivesem.data.vkitti2 import BBOX, INFO, POSE

    clip = root / "Scene01/clone"
    files.write_bytes(clip / "frames/rgb/Camera_0/rgb_00000.jpg", b"")
    files.write_text(clip / "info.txt", f"{INFO}\n0 Car Sedan Red\n")
    files.write_text(clip / "bbox.txt", f"{BBOX}\n0 0 0 10 {right:g} 20 60 9 0 1 True\n")
    files.write_text(clip / "pose.txt", f"{POSE}\n0 0 0 -1 1.7 1.5 4.2 2 0 20 0 0 0 2 1.6 20 0.1 0 0\n")


LAYOUTS = {"kitti": _kitti, "coco": _coco, "yolo": _yolo, "vkitti1": _vkitti1, "vkitti2": _vkitti2}


def _both(layout: str, root: Path, right: float) -> tuple[Labels, LabelTable]:
    LAYOUTS[layout](root, right)
    assert layouts.detect_layout(root / "training/label_2" if layout == "kitti" else root) == layout
    dataset = registry.open_dataset(layout, root)
    labels = dataset.labels(dataset.identifiers[0])
    assert labels is not None
    return labels, layouts.read_table(root, layout)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_box_without_an_area_is_read_and_never_trained_on(layout: str, tmp_path: Path) -> None:
    labels, table = _both(layout, tmp_path, 10)
    assert labels.boxes_xyxy.tolist() == [[pytest.approx(v) for v in (10, 20, 10, 60)]]
    assert table.with_box_format("xyxy").boxes.tolist() == [[pytest.approx(v) for v in (10, 20, 10, 60)]]
    assert make_targets(labels).ignore.tolist() == [True]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scenes_and_tables_read_alike(layout: str, tmp_path: Path) -> None:
    labels, table = _both(layout, tmp_path, 50)
    again = table.to_labels()
    for name in Labels.__slots__:
        mine, other = getattr(labels, name), getattr(again, name)
        assert mine == other if name == "kind" else np.array_equal(mine, other, equal_nan=True), name
    assert make_targets(labels).ignore.tolist() == [False]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_turned_box_is_refused_by_both(layout: str, tmp_path: Path) -> None:
    LAYOUTS[layout](tmp_path, 9)
    dataset = registry.open_dataset(layout, tmp_path)
    with pytest.raises(FormatError) as of_frame:
        dataset.labels(dataset.identifiers[0])
    with pytest.raises(FormatError) as of_table:
        layouts.read_table(tmp_path, layout)
    assert str(of_frame.value) == str(of_table.value)


def test_a_layout_of_none() -> None:
    with pytest.raises(FormatError, match="expected a file or folder of labels, found nothing there"):
        layouts.detect_layout(Path("/nowhere"))


@pytest.mark.parametrize(
    ("frames", "images", "names", "changed"),
    [
        (["1", "2"], {}, ["1", "2"], 0),
        (["1", "2"], {0: "day/1.jpg", 1: "night/2.PNG"}, ["day/1", "night/2"], 0),
        (["train/1", "val/1"], {0: "1.jpg", 1: "1.jpg"}, ["train/1", "val/1"], 0),
        (["a", "b"], {0: "a/counterexample.png", 1: "b/counterexample.png"}, ["a", "b"], 0),
        (["1", "day/1"], {0: "day/1.jpg"}, ["1", "day/1"], 1),
    ],
)
def test_files_are_named_as_images(
    frames: list[str], images: dict[int, str], names: list[str], changed: int
) -> None:
    table = LabelTable.from_columns(frames, (), [], [], np.zeros((0, 4)), "xyxy", image_files=images)
    assert table.file_names() == (names, {"names of frames": changed})


@pytest.mark.parametrize("name", ["../1", "/1", "a/../1", "1\0"])
def test_names_that_lead_out_are_refused(name: str) -> None:
    table = LabelTable.from_columns([name], (), [], [], np.zeros((0, 4)), "xyxy")
    with pytest.raises(FormatError, match="names below a folder"):
        table.file_names()


def test_labels_are_alike_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i, kind in enumerate(("Van", "Car", "DontCare", "Car")):
        files.write_text(tmp_path / f"{i}.txt", f"{kind} 0 0 -10 {i} 20 30 60 {POSE}\n" * i)
    tables = [layouts.read_table(tmp_path, "kitti")]
    monkeypatch.setattr(kitti_labels, "_FILES_PER_CHUNK", 1)
    tables.append(layouts.read_table(tmp_path, "kitti"))
    assert tables[0].kinds == tables[1].kinds == ("Car",)
    assert tables[0].account == tables[1].account
    for name in ("frame", "kind", "boxes", "ignore", "pose"):
        assert getattr(tables[0], name).tolist() == getattr(tables[1], name).tolist()
