"""COCO files: what is written reads back exactly, pycocotools agrees, and every fault has one line."""

import contextlib
import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pycocotools import mask as run_length
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from drivesem.data import coco, coco_labels
from drivesem.data.classes import COCO_ROAD_USERS
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.label_table import coco_to_xyxy, shortest_decimals, xyxy_to_coco
from drivesem.data.registry import WRITERS, open_dataset
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_uint8
from scene_ir.types import Category

LABEL_FIELDS = ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw", "ignore_xyxy")


pycocotools_and_numpy_2 = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")


def place(number: int, part: str = "train") -> FrameLocation:
    return FrameLocation(number, "01", "clone", number, part)


def quiet(call: Callable[..., Any], *args: Any) -> Any:
    with contextlib.redirect_stdout(io.StringIO()):
        return call(*args)


@pytest.fixture
def folder(tmp_path: Path, make_exposure: Callable[..., Exposure]) -> Path:
    """Frames 0 and 1 to train on, frame 2, without objects, to validate."""
    writer = WRITERS["coco"](tmp_path / "coco")
    assert not writer.exists(place(0))
    entries = [
        writer.write(place(0), make_exposure(0)),
        writer.write(place(1), make_exposure(1)),
        writer.write(place(2, "val"), make_exposure(2, specification=(), empty_box=False)),
    ]
    assert writer.exists(place(0))
    writer.finish(json.loads(json.dumps(entries)))
    return tmp_path / "coco"


def content(folder: Path, part: str = "train") -> dict[str, Any]:
    return files.read_json(folder / "annotations" / f"instances_{part}.json")


def test_layout(folder: Path) -> None:
    found = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    assert found == [
        "annotations/instances_train.json",
        "annotations/instances_val.json",
        "images/train/000000.png",
        "images/train/000001.png",
        "images/val/000002.png",
    ]
    record = content(folder)
    assert [row["id"] for row in record["images"]] == [1, 2]
    assert [row["id"] for row in record["annotations"]] == list(range(1, len(record["annotations"]) + 1))
    names = {row["name"]: row["id"] for row in record["categories"]}
    assert [names[n] for n in ("Car", "Van", "Truck", "Pedestrian", "Cyclist")] == [1, 2, 3, 4, 5]


def test_values(folder: Path) -> None:
    car, van, pedestrian, truck, *rest = [row for row in content(folder)["annotations"] if row["image_id"] == 1]
    # columns 5 to 24 and rows 12 to 23, as COCO counts; the van hides its lower right corner
    assert car["bbox"] == [5.0, 12.0, 20.0, 12.0]
    assert (car["category_id"], car["iscrowd"], car["track"], car["occlusion"]) == (1, 0, 7, 1)
    assert car["area"] == 20 * 12 - 5 * 10
    assert car["visible"] == pytest.approx(190 / 240)
    assert (van["category_id"], pedestrian["category_id"]) == (2, 4)
    # the truck, too small for a label, and the region where nothing stands, which is one of every class
    assert (truck["category_id"], truck["iscrowd"], truck["bbox"]) == (3, 1, [40.0, 10.0, 6.0, 3.0])
    assert truck["area"] == 18
    assert [row["category_id"] for row in rest] == list(range(1, 9))
    assert all(row["iscrowd"] == 1 and row["bbox"] == [70.5, 2.5, 6.0, 6.5] for row in rest)


def test_what_is_written_reads_back(folder: Path, make_exposure: Callable[..., Exposure]) -> None:
    dataset = open_dataset("coco", folder)
    assert dataset.identifiers == ("000000", "000001", "000002")
    for number in (0, 1):
        made, frame = make_exposure(number), dataset.frame(f"{number:06d}")
        assert torch.equal((frame.photograph * 255).round().byte(), torch.from_numpy(made.image).permute(2, 0, 1))
        assert torch.equal(frame.camera.matrix, made.camera.matrix)
        assert torch.equal(frame.camera.intrinsics, made.camera.matrix[:, :3])
        assert frame.labels is not None
        assert frame.labels.kind == made.labels.kind
        for name in LABEL_FIELDS:
            assert torch.equal(getattr(frame.labels, name), getattr(made.labels, name)), name
        assert frame.masks is not None
        for mask, tracked in zip(frame.masks, (o for o in made.objects if o.labelled), strict=True):
            assert np.array_equal(mask.numpy(), made.instances == tracked.track + 1)
    empty = dataset.frame("000002")
    assert empty.labels is not None
    assert empty.labels.kind == ()
    assert empty.masks is not None
    assert empty.masks.shape == (0, 40, 80)


def test_the_same_entries_give_the_same_bytes(
    folder: Path, tmp_path: Path, make_exposure: Callable[..., Exposure]
) -> None:
    writer = coco.CocoWriter(tmp_path / "again")
    last = writer.write(place(2, "val"), make_exposure(2, specification=(), empty_box=False))
    entries = [coco.CocoWriter(tmp_path / "again").write(place(i), make_exposure(i)) for i in (0, 1)]
    writer.finish([*entries, last])
    for path in (p for p in folder.rglob("*") if p.is_file()):
        assert (tmp_path / "again" / path.relative_to(folder)).read_bytes() == path.read_bytes()


@pycocotools_and_numpy_2
def test_pycocotools_loads_it_and_evaluates_on_it(folder: Path) -> None:
    truth = quiet(COCO, folder / "annotations" / "instances_train.json")
    assert truth.getImgIds() == [1, 2]
    assert len(truth.getAnnIds(iscrowd=False)) == 6
    for row in truth.loadAnns(truth.getAnnIds(iscrowd=False)):
        assert int(truth.annToMask(row).sum()) == row["area"]
    tracked_objects = [row for row in truth.dataset["annotations"] if not row["iscrowd"]]
    crowds = [row for row in truth.dataset["annotations"] if row["iscrowd"]]
    # every object found, and every region reported too: ignored, it does not count as false
    for kind in ("bbox", "segm"):
        found = [
            {"image_id": r["image_id"], "category_id": r["category_id"], "score": 0.9 - 0.4 * r["iscrowd"]}
            | {"bbox": r["bbox"], "segmentation": dict(r["segmentation"])}
            for r in (*tracked_objects, *crowds)
        ]
        if kind == "bbox":
            found = [{k: v for k, v in r.items() if k != "segmentation"} for r in found]
        evaluator = COCOeval(truth, quiet(truth.loadRes, found), kind)
        for step in (evaluator.evaluate, evaluator.accumulate, evaluator.summarize):
            quiet(step)
        assert evaluator.stats[0] == pytest.approx(1.0)
        ignored = [e["dtIgnore"].any() for e in evaluator.evalImgs if e is not None and len(e["dtIds"])]
        assert any(ignored)


@given(
    st.lists(
        st.tuples(st.floats(0, 1e4, width=32), st.floats(0, 1e4, width=32), st.floats(2**-10, 1e4, width=32)),
        min_size=1,
        max_size=5,
    )
)
def test_boxes_round_trip(rows: list[tuple[float, float, float]]) -> None:
    for x, y, size in rows:
        box = torch.tensor([x, y, x + size, y + 2 * size], dtype=torch.float32)
        if box[0] < box[2] and box[1] < box[3]:
            written = json.loads(json.dumps(xyxy_to_coco(box.double().numpy()).tolist()))
            # 1e-12 px: what 0.5 and back costs a coordinate next to nothing
            back = torch.from_numpy(coco_to_xyxy(np.array(written))).float()
            torch.testing.assert_close(back, box, atol=1e-12, rtol=0)


@pycocotools_and_numpy_2
@given(st.integers(0, 2**32), st.integers(1, 40), st.integers(1, 40), st.floats(0, 1))
def test_run_lengths_are_those_of_pycocotools(seed: int, height: int, width: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < share
    encoded = coco._encode_mask(mask)
    assert np.array_equal(run_length.decode(encoded), mask)
    assert np.array_equal(coco._decode_mask("here", encoded, (height, width)), mask)
    plain = {"size": [height, width], "counts": coco._decode_runs(encoded["counts"])}
    assert np.array_equal(coco._decode_mask("here", plain, (height, width)), mask)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_floats_are_short_and_exact(value: float) -> None:
    (text,) = shortest_decimals(torch.tensor([value]))
    assert torch.tensor(text, dtype=torch.float32) == torch.tensor(value, dtype=torch.float32)


def foreign(root: Path, **changes: Any) -> Path:
    """A plain COCO folder, as COCO 2017 is laid out."""
    files.write_png(root / "val2017" / "000000000139.png", np.zeros((40, 80, 3), np.uint8))
    record = {
        "images": [{"id": 139, "file_name": "000000000139.png", "height": 40, "width": 80}],
        "categories": [{"id": 1, "name": "person"}, {"id": 3, "name": "car"}, {"id": 62, "name": "chair"}],
        "annotations": [
            {
                "id": 5,
                "image_id": 139,
                "category_id": 3,
                "bbox": [10, 5, 20.5, 10],
                "segmentation": [[10, 5, 30, 5, 30, 15, 10, 15]],
                "iscrowd": 0,
            },
            {"id": 6, "image_id": 139, "category_id": 62, "bbox": [1, 1, 2, 2], "segmentation": [], "iscrowd": 0},
            {
                "id": 7,
                "image_id": 139,
                "category_id": 1,
                "bbox": [0, 0, 80, 2],
                "segmentation": {"size": [40, 80], "counts": [0, 2, 3198]},
                "iscrowd": 1,
            },
        ],
    }
    path = root / "annotations" / "instances_val2017.json"
    files.write_json(path, record | changes)
    return path


def test_a_file_from_elsewhere(tmp_path: Path) -> None:
    path = foreign(tmp_path)
    for root in (tmp_path, path):
        labels = coco.CocoDataset(root).labels("000000000139")
        assert labels.kind == ("car", "chair")
        assert labels.boxes_xyxy[0].tolist() == [9.5, 4.5, 30.0, 14.5]
        assert labels.ignore_xyxy.tolist() == [[-0.5, -0.5, 79.5, 1.5]]
        assert labels.occlusion.tolist() == [3, 3]
        assert bool(torch.isnan(torch.cat([labels.translation, labels.size_lhw], dim=1)).all())
        assert bool(torch.isnan(torch.stack([labels.truncation, labels.yaw])).all())
    usual = coco.CocoDataset(tmp_path).frame("000000000139")
    assert usual.camera.intrinsics[:2].tolist() == [
        [pytest.approx(0.58 * 80), 0, 39.5],
        [0, pytest.approx(0.58 * 80), 19.5],
    ]
    assert usual.provenance["focal"] == "46.4 px, default"
    frame = coco.CocoDataset(tmp_path, focal_px=70.0).frame("000000000139")
    assert frame.camera.intrinsics.tolist() == [[70, 0, 39.5], [0, 70, 19.5], [0, 0, 1]]
    assert frame.masks is None  # the chair has no outline
    road = coco.CocoDataset(tmp_path, focal_px=70.0, kinds=COCO_ROAD_USERS.classes).frame("000000000139")
    assert road.labels is not None
    assert road.labels.kind == ("car",)
    assert road.masks is not None
    assert 180 <= int(road.masks.sum()) <= 231
    assert COCO_ROAD_USERS.targets(road.labels).labels.tolist() == [Category.CAR, 0]


def texts(content: dict[str, Any]) -> dict[str, Any]:
    """The same images with texts as ids."""
    images = [row | {"id": f"cam-{row['id']}"} for row in content["images"]]
    rows = [row | {"image_id": f"cam-{row['image_id']}"} for row in content["annotations"]]
    return content | {"images": images, "annotations": rows}


def test_ids_of_images_may_be_texts(tmp_path: Path) -> None:
    path = foreign(tmp_path)
    numbered = coco.CocoDataset(path).labels("000000000139")
    files.write_json(path, texts(files.read_json(path)))
    labels = coco.CocoDataset(path).labels("000000000139")
    assert labels.kind == numbered.kind
    assert torch.equal(labels.boxes_xyxy, numbered.boxes_xyxy)
    table = coco_labels.read_table(path, False, None)
    coco.write_table(table, tmp_path / "again.json", {})
    again = files.read_json(tmp_path / "again.json")
    assert [row["id"] for row in again["images"]] == ["cam-139"]
    assert {row["image_id"] for row in again["annotations"]} == {"cam-139"}
    found = [{"image_id": "cam-139", "category_id": 3, "bbox": [1, 2, 3, 4], "score": 0.5}]
    files.write_json(tmp_path / "found.json", found)
    assert len(coco_labels.read_table(tmp_path / "found.json", True, table)) == 1


def test_ids_of_two_kinds_are_refused(tmp_path: Path) -> None:
    path = foreign(tmp_path)
    content = files.read_json(path)
    files.write_json(path, content | {"images": texts(content)["images"]})
    with pytest.raises(FormatError, match=r"annotations\[0\]\.image_id: expected texts, as the ids .*found 139"):
        coco.CocoDataset(path)
    files.write_json(path, content | {"images": [*content["images"], {"id": "a", "file_name": "b.png"}]})
    with pytest.raises(FormatError, match=r"images\[1\]\.id: expected a whole number"):
        coco.CocoDataset(path)


def annotation(**changes: Any) -> dict[str, Any]:
    row = {"id": 5, "image_id": 139, "category_id": 3, "bbox": [10, 5, 20, 10]} | changes
    return {"annotations": [{k: v for k, v in row.items() if v != "gone"}]}


POSE = {"translation": [0, 1, 9], "yaw": 0.5, "size_lhw": [4, 1, 2]}
IMAGE = {"id": 139, "file_name": "000000000139.png", "height": 40, "width": 80}
BAD_FILES = [
    ({"images": 3}, "json: images: expected a list, found int"),
    (
        {"images": [{"id": 139, "height": 4, "width": 8}]},
        r"json: images\[0\]\.file_name: expected a value, found none",
    ),
    ({"images": [IMAGE | {"height": 0}]}, r"images\[0\]\.height: expected a positive integer, found 0"),
    ({"images": [IMAGE, IMAGE]}, r"images\[1\]\.id: expected a unique id, found 139"),
    ({"images": [IMAGE, IMAGE | {"id": 200}]}, r"images\[1\]\.file_name: expected a unique name"),
    (annotation(image_id="gone"), r"annotations\[0\]\.image_id: expected a whole number, found null"),
    (annotation(image_id=3), r"annotations\[0\]\.image_id: expected ids of the 1 images, found 1 others \(3\)"),
    (
        annotation(category_id=9),
        r"annotations\[0\]\.category_id: expected ids of the 3 categories, found 1 others",
    ),
]


@pytest.mark.parametrize(("changes", "message"), BAD_FILES)
def test_a_bad_file_is_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=message) as caught:
        coco.CocoDataset(foreign(tmp_path, **changes))
    assert "\n" not in str(caught.value)


BAD_ANNOTATIONS = [
    ({"bbox": "gone"}, "bbox: expected x, y, width, height, found null"),
    ({"bbox": [1, 2, 3]}, r"bbox: expected x, y, width, height, found \[1, 2, 3\]"),
    ({"bbox": [1, 2, "3", 4]}, "bbox: expected x, y, width, height"),
    ({"bbox": [1, 2, -1, 4]}, "bbox: expected numbers below 2,147,483,648, width and height of at least 0"),
    ({"bbox": [1, 2, 3, 1e308]}, "bbox: expected numbers below 2,147,483,648, width and height of at least 0"),
    ({"truncation": 2}, r"truncation: expected \[0, 1\], found 2"),
    ({"occlusion": 0.5}, "occlusion: expected 0, 1, 2 or 3, found 0.5"),
    ({"pose": 3}, "pose: expected translation, yaw and size_lhw, found 3"),
    ({"pose": POSE | {"yaw": None}}, "pose.yaw: expected 1 finite numbers"),
    ({"pose": POSE | {"size_lhw": [4, 0, 2]}}, "pose.size_lhw: expected positive metres"),
    ({"segmentation": [[1, 2, 3, 4]]}, r"segmentation\[0\]: expected x and y of three or more corners"),
    ({"segmentation": [[1, 2, 3, 4, 1e9, 3]]}, r"segmentation\[0\]: expected x and y of three or more corners"),
    ({"segmentation": [3]}, r"segmentation\[0\]: expected 6 finite numbers, found 3"),
    ({"segmentation": {"size": [4, 5], "counts": ""}}, "segmentation: expected polygons, or run .* 80x40 px"),
    ({"segmentation": {"size": [40, 80], "counts": [1, 2]}}, "counts: expected runs that fill 3200 px, found 3"),
    ({"segmentation": {"size": [40, 80], "counts": "041"}}, "counts: expected runs that fill 3200 px, found 5"),
    ({"segmentation": {"size": [40, 80], "counts": "P"}}, "counts: expected run lengths, found a number that is"),
    ({"segmentation": {"size": [40, 80]}}, "counts: expected run"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_ANNOTATIONS)
def test_a_bad_annotation_is_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    dataset = coco.CocoDataset(foreign(tmp_path, **annotation(**changes)), focal_px=70.0)
    with pytest.raises(FormatError, match=rf"json: annotations\[0\]\.?.*{message}") as caught:
        dataset.frame("000000000139")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"fx": 700}, "camera fx, fy, cx, cy: expected 4 finite numbers"),
        ({"projection": [1, 2]}, "camera.projection: expected 12 finite numbers"),
        ({"fx": -700, "fy": 700, "cx": 1, "cy": 1}, "camera focal lengths: expected positive px"),
        (3, "camera fx, fy, cx, cy: expected 4 finite numbers"),
    ],
)
def test_a_bad_camera_is_named(camera: Any, message: str, tmp_path: Path) -> None:
    dataset = coco.CocoDataset(foreign(tmp_path, images=[IMAGE | {"camera": camera}]))
    with pytest.raises(FormatError, match=rf"000000000139\.png: {message}"):
        dataset.frame("000000000139")


def test_a_camera_without_projection(tmp_path: Path) -> None:
    camera = {"fx": 71, "fy": 72, "cx": 40, "cy": 20}
    frame = coco.CocoDataset(foreign(tmp_path, images=[IMAGE | {"camera": camera}])).frame("000000000139")
    assert frame.camera.intrinsics.tolist() == [[71, 0, 40], [0, 72, 20], [0, 0, 1]]
    assert frame.camera.projection is None


def test_images_missing_or_of_another_size(tmp_path: Path) -> None:
    dataset = coco.CocoDataset(foreign(tmp_path, images=[IMAGE | {"width": 79}]), focal_px=70.0)
    with pytest.raises(FormatError, match=r"000000000139\.png: expected 79x40 px, found 80x40 px"):
        dataset.frame("000000000139")
    (tmp_path / "val2017" / "000000000139.png").unlink()
    with pytest.raises(FormatError, match=r"000000000139\.png: expected a readable file"):
        dataset.frame("000000000139")


def test_bad_requests(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"expected a COCO folder, with annotations.*found neither"):
        coco.CocoDataset(tmp_path)
    path = foreign(tmp_path)
    with pytest.raises(RangeError, match="expected one of 1 identifiers, found 'no'"):
        coco.CocoDataset(path).labels("no")
    with pytest.raises(RangeError, match="focal_px: expected positive px, found nan"):
        coco.CocoDataset(path, focal_px=math.nan)
    path.write_text("{")
    with pytest.raises(FormatError, match=r"val2017\.json:1:2: expected JSON"):
        coco.CocoDataset(path)


def test_regions_are_of_the_object_they_lie_on(make_exposure: Callable[..., Exposure]) -> None:
    tracked_objects = make_exposure().objects
    assert coco._region_kinds([39.5, 9.5, 45.5, 12.5], tracked_objects) == ("Truck",)
    assert coco._region_kinds([5, 12, 24, 23], tracked_objects) == tuple(coco.CATEGORIES)  # the car has a label


@given(st.text(st.sampled_from("ab. /\\:"), min_size=1, max_size=7))
def test_a_frame_is_called_as_its_file_without_suffix(name: str) -> None:
    try:
        record = "_".join(Path(name).with_suffix("").parts)
    except ValueError:
        with pytest.raises(ValueError, match="empty name"):
            coco_labels.frame_identifier({"file_name": name})
        return
    assert coco_labels.frame_identifier({"file_name": name}) == record


@pytest.mark.parametrize(
    ("orientation", "size_wh", "turned"), [(3, (80, 40), 2), (6, (40, 80), 3), (6, (80, 40), 0)]
)
def test_images_are_upright_unless_the_file_has_the_stored_size(
    orientation: int, size_wh: tuple[int, int], turned: int, tmp_path: Path
) -> None:
    record = IMAGE | {"width": size_wh[0], "height": size_wh[1]}
    path = foreign(tmp_path, images=[record], annotations=[])
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.random.default_rng(0).integers(0, 256, (40, 80, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "val2017" / IMAGE["file_name"], exif=exif)
    frame = coco.CocoDataset(path).frame("000000000139")
    assert np.array_equal(to_uint8(frame.photograph), np.rot90(pixels, turned))


@pytest.mark.parametrize("name", [".", "/", "./"])
def test_an_image_without_a_file_name_is_refused(name: str, tmp_path: Path) -> None:
    path = foreign(tmp_path, images=[IMAGE | {"file_name": name}])
    for read in (coco.CocoDataset, lambda path: coco_labels.read_table(path, False, None)):
        with pytest.raises(
            FormatError, match=r"images\[0\]\.file_name: expected the name of a file, found"
        ) as caught:
            read(path)
        assert "\n" not in str(caught.value)
