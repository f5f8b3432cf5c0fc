"""The account of a data set: every file on disk is read or skipped with a reason, for every layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from drivesem.config.errors import UsageError
from drivesem.data.account import DataAccount, account_for_files, sum_accounts, write_account
from drivesem.data.registry import open_dataset
from scene_ir.errors import FormatError

KITTI_ROW = "Car 0 0 -10 5 5 20 20 -1 -1 -1 -1000 -1000 -1000 -10\n"
VOC = "<annotation><filename>{name}</filename><object><name>car</name><bndbox><xmin>5</xmin><ymin>5</ymin>"
VOC += "<xmax>20</xmax><ymax>20</ymax></bndbox></object></annotation>"


def image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (48, 32)).save(path)


def text(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def write_kitti(root: Path, names: list[str]) -> None:
    for name in names:
        image(root / f"training/image_2/{name}.png")
        text(root / f"training/label_2/{name}.txt", KITTI_ROW)


def write_yolo(root: Path, names: list[str]) -> None:
    text(root / "data.yaml", "train: images/train\nval: images/val\nnames: [car]\nauthor: me\n")
    for i, name in enumerate(names):
        part = "val" if i % 3 == 2 else "train"
        image(root / f"images/{part}/{name}.jpg")
        text(root / f"labels/{part}/{name}.txt", "0 0.5 0.5 0.2 0.2\n")
    for part in ("train", "val"):
        (root / "images" / part).mkdir(parents=True, exist_ok=True)


def write_coco(root: Path, names: list[str]) -> None:
    for name in names:
        image(root / f"images/{name}.png")
    images = [{"id": i, "file_name": f"{name}.png", "width": 48, "height": 32} for i, name in enumerate(names)]
    rows = [{"id": i, "image_id": i, "category_id": 1, "bbox": [5, 5, 15, 15]} for i in range(len(names))]
    content = {"images": images, "annotations": rows, "categories": [{"id": 1, "name": "car"}]}
    text(root / "annotations/instances_all.json", json.dumps(content))


def write_voc(root: Path, names: list[str]) -> None:
    for name in names:
        image(root / f"JPEGImages/{name}.jpg")
        text(root / f"Annotations/{name}.xml", VOC.format(name=f"{name}.jpg"))


def write_bdd100k(root: Path, names: list[str]) -> None:
    for name in names:
        image(root / f"images/100k/val/{name}.jpg")
    box = {"category": "car", "box2d": {"x1": 5, "y1": 5, "x2": 20, "y2": 20}}
    weather = {"weather": "rainy", "timeofday": "night"}
    frames = [{"name": f"{name}.jpg", "attributes": weather, "labels": [box]} for name in names]
    text(root / "labels/det_20/det_val.json", json.dumps(frames))


BUILDERS: dict[str, Callable[[Path, list[str]], None]] = {
    "kitti": write_kitti,
    "yolo": write_yolo,
    "coco": write_coco,
    "voc": write_voc,
    "bdd100k": write_bdd100k,
}
NAMES = st.lists(st.from_regex(r"[a-c]{1,2}[0-9]{1,3}", fullmatch=True), min_size=1, max_size=4, unique=True)
FOLDERS = st.sampled_from(
    ["", "images", "training/image_2", "training/label_2", "labels/train", "Annotations", "x/y"]
)
FILES = st.sampled_from(
    ["a1.png", "b.JPG", "n.webp", "z.heic", "a1.txt", "q.md", "none", ".hidden", "c.xml", "c.yml"]
)


@pytest.mark.parametrize("layout", BUILDERS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=NAMES, others=st.lists(st.tuples(FOLDERS, FILES), max_size=6), lost=st.integers(0, 9))
def test_every_file_is_read_or_skipped(
    layout: str,
    names: list[str],
    others: list[tuple[str, str]],
    lost: int,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    root = tmp_path_factory.mktemp(layout)
    BUILDERS[layout](root, names)
    for folder, name in others:
        path = root / folder / name
        if not path.exists():
            image(path) if name.endswith("png") else text(path, "")
    on_disk = [path for path in sorted(root.rglob("*")) if path.is_file()]
    if lost < len(on_disk) and on_disk[lost].suffix in (".png", ".jpg", ".txt", ".xml"):
        on_disk.pop(lost).unlink()
    try:
        account = open_dataset(layout, root).account()
    except FormatError:
        return  # refused as a whole, in one line
    assert account.files + sum(account.skipped.values()) == len(on_disk)
    assert all(count > 0 for count in account.skipped.values())
    assert account.frames >= 1


@pytest.mark.parametrize("layout", BUILDERS)
def test_frames_and_rows_are_counted(layout: str, tmp_path: Path) -> None:
    names = ["a1", "a2", "b3"]
    BUILDERS[layout](tmp_path, names)
    account = open_dataset(layout, tmp_path).account()
    name = "Car" if layout == "kitti" else "car"
    assert (account.layout, account.frames, dict(account.classes)) == (layout, 3, {name: 3})
    assert (account.unlabelled, account.without_image, dict(account.skipped)) == (0, 0, {})
    assert account.unused_keys == (("author",) if layout == "yolo" else ())


def test_files_are_counted_by_reason(tmp_path: Path) -> None:
    for name in ("a.png", "b.gif", "c.jpg", ".d", "e.md", "f", "g.txt"):
        text(tmp_path / name, "")
    read, skipped = account_for_files(tmp_path, [tmp_path / "a.png"], {f"{tmp_path / 'g.txt'}": "no image"})
    assert read == 1
    assert skipped == {
        ".gif not readable": 1,
        "image that no label or folder of the layout names": 1,
        "hidden": 1,
        ".md not part of the layout": 1,
        "no suffix": 1,
        "no image": 1,
    }


def test_the_line_names_the_largest_ten(capsys: pytest.CaptureFixture[str]) -> None:
    classes = {"car": 2000, "rider": 5, "bus": 3} | {f"sign {i}": i for i in range(1, 13)}
    account = DataAccount("coco", 3, 4, {".heic not readable": 2}, classes, regions=7, unlabelled=1)
    assert write_account(account)["rows"]["mapped"] == {"rider as Cyclist": 5}
    largest = ", ".join(f"sign {i} {i}" for i in range(12, 2, -1))
    assert capsys.readouterr().err == (
        "coco: 3 images, 2,086 boxes in 15 classes; mapped: rider as Cyclist 5; ignored: bus 3; "
        f"background: {largest}, 2 more with 3; crowds and regions to ignore: 7; images without labels: 1; "
        "skipped files: .heic not readable 2\n"
    )


def test_a_map_of_an_unknown_class_is_refused() -> None:
    account = DataAccount("coco", 1, 1, {}, {"car": 1}, mapping={"cart": "Van"})
    with pytest.raises(
        UsageError, match=r"--map cart: expected a class of the data set \(car\), found no such class"
    ):
        write_account(account)


def test_accounts_of_joined_data_sets_add_up() -> None:
    one = DataAccount("yolo", 1, 2, {"hidden": 1}, {"car": 3}, splits={"train": 1}, unused_keys=("a",))
    both = sum_accounts([one, one])
    assert (both.frames, both.files, both.skipped, both.classes) == (2, 4, {"hidden": 2}, {"car": 6})
    assert (both.splits, both.unused_keys) == ({"train": 2}, ("a",))
