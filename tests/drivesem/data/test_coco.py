"""COCO files: what is written reads back exactly, pycocotools agrees, and every fault has one line."""

import contextlib
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps
from pycocotools import mask as run_length
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from drivesem.data import coco, coco_labels, fiftyone
from drivesem.data.account import DataAccount
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.label_table import coco_to_xyxy, shortest_decimals, xyxy_to_coco
from drivesem.data.layouts import detect_layout
from drivesem.data.registry import WRITERS, open_dataset
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_uint8

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
        {"images": [IMAGE, IMAGE | {"width": 9}]},
        r"images\[1\]\.id: expected a unique id, found 139, as .*\[0\]\.id",
    ),
    (
        {"images": [IMAGE, IMAGE | {"id": 200}]},
        r"images\[1\]\.file_name: expected a unique name, .*\[0\]\.file_name",
    ),
    (
        {"images": [IMAGE, IMAGE | {"id": 200, "file_name": "/x/000000000139.png"}]},
        r"images\[1\]\.file_name: expected another image, .*\[0\]\.file_name",
    ),
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
]


@pytest.mark.parametrize(("changes", "message"), BAD_ANNOTATIONS)
def test_a_bad_annotation_is_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    dataset = coco.CocoDataset(foreign(tmp_path, **annotation(**changes)), focal_px=70.0)
    with pytest.raises(FormatError, match=rf"json: annotations\[0\]\.?.*{message}") as caught:
        dataset.frame("000000000139")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "segmentation",
    [
        [[1, 2, 3, 4]],
        [[1, 2, 3, 4, 1e9, 3]],
        [3],
        "x",
        {"size": [4, 5], "counts": "a"},
        {"size": [40, 80], "counts": [1, 2]},
        {"size": [40, 80], "counts": "041"},
        {"size": [40, 80], "counts": "P"},
        {"size": [40, 80]},
    ],
)
def test_a_broken_outline_costs_the_masks_alone(segmentation: Any, tmp_path: Path) -> None:
    dataset = coco.CocoDataset(foreign(tmp_path, **annotation(segmentation=segmentation)), focal_px=70.0)
    frame = dataset.frame("000000000139")
    assert frame.masks is None
    assert frame.labels is not None
    assert frame.labels.boxes_xyxy.tolist() == [[9.5, 4.5, 29.5, 14.5]]
    decoded = isinstance(segmentation, dict) and segmentation["size"] == [40, 80] and segmentation.get("counts")
    broken = {} if decoded else {"outlines that are broken (no masks of their frames)": 1}
    assert dataset.account().repairs == broken


@pytest.mark.parametrize(
    ("changes", "repair"),
    [
        ({"truncation": 2}, "truncations outside [0, 1]"),
        ({"truncation": "half"}, "truncations outside [0, 1]"),
        ({"occlusion": 0.5}, "occlusions other than 0 to 3"),
        ({"occlusion": 9}, "occlusions other than 0 to 3"),
        ({"pose": 3}, "3D boxes that cannot be used"),
        ({"pose": POSE | {"yaw": None}}, "3D boxes that cannot be used"),
        ({"pose": POSE | {"size_lhw": [4, 0, 2]}}, "3D boxes that cannot be used"),
    ],
)
def test_values_that_a_scene_cannot_use_are_unknown(changes: dict[str, Any], repair: str, tmp_path: Path) -> None:
    path = foreign(tmp_path, **annotation(**changes))
    dataset = coco.CocoDataset(path)
    labels = dataset.labels("000000000139")
    assert dataset.account().repairs == {repair: 1}
    assert math.isnan(labels.yaw[0])
    assert math.isnan(labels.truncation[0])
    assert labels.occlusion.tolist() == [3] if "occlusion" in changes and changes["occlusion"] == 9 else True
    assert len(coco_labels.read_table(path, False, None)) == 1


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
    with pytest.raises(
        FormatError, match=r"000000000139\.png: expected 79x40 px, as its annotation states, found 80x40 px"
    ):
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


CORNER_BOX = {5: [0, 0, 2, 4], 6: [38, 0, 2, 4], 7: [38, 76, 2, 4], 8: [0, 76, 2, 4]}
"""Where the stored box [0, 0, 4, 2] of an 80x40 image lies after it was turned upright, by orientation."""


@pytest.mark.parametrize("stored", [True, False])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_boxes_and_masks_turn_with_their_image(orientation: int, stored: bool, tmp_path: Path) -> None:
    turned = orientation > 4
    upright_wh = (40, 80) if turned else (80, 40)
    size_wh = (80, 40) if stored else upright_wh
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.zeros((40, 80, 3), np.uint8)
    pixels[:2, :4] = 255
    # where the size is that of the upright image, so is the box
    upright = np.asarray(ImageOps.exif_transpose(_with_orientation(pixels, orientation)))[..., 0] > 0
    rows, columns = np.nonzero(upright)
    corner = [int(columns.min()), int(rows.min()), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]
    if turned:
        assert corner == CORNER_BOX[orientation]
    x, y, w, h = box = [0, 0, 4, 2] if stored and turned else corner
    mask = np.zeros(size_wh[::-1], np.bool_)
    mask[y : y + h, x : x + w] = True
    path = foreign(
        tmp_path,
        images=[IMAGE | {"width": size_wh[0], "height": size_wh[1]}],
        **annotation(bbox=box, segmentation=coco._encode_mask(mask)),
    )
    Image.fromarray(pixels).save(tmp_path / "val2017" / IMAGE["file_name"], exif=exif)
    frame = coco.CocoDataset(path).frame("000000000139")
    assert frame.labels is not None
    assert frame.masks is not None
    assert frame.labels.boxes_xyxy[0].tolist() == coco_to_xyxy(np.array(corner, float)).tolist()
    assert np.array_equal(frame.masks[0].numpy() > 0, upright)
    assert np.array_equal(to_uint8(frame.photograph)[..., 0] > 0, upright)
    table = coco_labels.turn_upright(coco_labels.read_table(path, False, None))
    assert table.boxes.tolist() == [corner]
    assert table.sizes_wh.tolist() == [list(upright_wh)]


def _with_orientation(pixels: np.ndarray, orientation: int) -> Image.Image:
    image = Image.fromarray(pixels)
    image.getexif()[0x0112] = orientation
    return image


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "LA", "1"])
def test_images_of_other_modes(mode: str, tmp_path: Path) -> None:
    path = foreign(tmp_path)
    image = Image.fromarray(np.full((40, 80, 3), 255, np.uint8)).convert(mode)
    image.save(tmp_path / "val2017" / IMAGE["file_name"])
    assert coco.CocoDataset(path).frame("000000000139").photograph.min() == 1


def test_an_image_of_16_bits_is_refused(tmp_path: Path) -> None:
    path = foreign(tmp_path)
    Image.fromarray(np.zeros((40, 80), np.uint16)).save(tmp_path / "val2017" / IMAGE["file_name"])
    with pytest.raises(FormatError, match=r"000000000139\.png: expected .*8") as caught:
        coco.CocoDataset(path).frame("000000000139")
    assert "\n" not in str(caught.value)


def _write_layout(root: Path, images: dict[str, str], names: dict[str, str] | None = None) -> None:
    """Write images, and annotation files with one box per image.

    Args:
        root: Folder of the data set.
        images: Annotation file by image.
        names: "file_name" by image; by default the name alone.
    """
    contents: dict[str, Any] = {}
    for i, (image, file) in enumerate(images.items()):
        path = root / image
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (80, 40), (i, 0, 0)).save(path)
        content = contents.setdefault(
            file, {"images": [], "annotations": [], "categories": [{"id": 3, "name": "car"}]}
        )
        name = (names or {}).get(image, path.name)
        content["images"].append({"id": i, "file_name": name, "width": 80, "height": 40})
        content["annotations"].append({"id": i, "image_id": i, "category_id": 3, "bbox": [i, 2, 10, 20]})
    for file, content in contents.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(json.dumps(content))


LAYOUTS = {
    "one file": ({"images/a.jpg": "annotations.json", "images/b.JPG": "annotations.json"}, None),
    "Label Studio": (
        {"images/a.jpg": "result.json", "images/b.jpg": "result.json"},
        {"images/a.jpg": "images/a.jpg", "images/b.jpg": "images\\b.jpg"},
    ),
    "absolute": (
        {"images/a.jpg": "result.json", "images/s/b.jpg": "result.json"},
        {"images/a.jpg": "/data/upload/1/a.jpg", "images/s/b.jpg": "C:\\x\\s\\b.jpg"},
    ),
    "URL": (
        {"images/a.jpg": "r.json", "images/b.jpg": "r.json"},
        {"images/a.jpg": "https://x.org/y/a.jpg?z=1", "images/b.jpg": "http://x.org/b.jpg"},
    ),
    "beside": ({"a.jpg": "coco.json", "b.jpg": "coco.json"}, None),
    "Roboflow": (
        {
            f"{part}/{name}.jpg": f"{part}/_annotations.coco.json"
            for part, name in (("train", "a"), ("valid", "b"))
        },
        None,
    ),
    "FiftyOne": ({"data/a.jpg": "labels.json", "data/b.jpg": "labels.json"}, None),
    "annotations": ({f"{p}/{p}.jpg": f"annotations/{p}.json" for p in ("train", "val")}, None),
    "sub-folders": (
        {f"images/{p}/1.jpg": "annotations/instances_all.json" for p in ("x", "y")},
        {f"images/{p}/1.jpg": f"{p}/1.jpg" for p in ("x", "y")},
    ),
    "parts": ({f"images/{p}/1.jpg": f"annotations/instances_{p}.json" for p in ("train", "val")}, None),
}
SPLITS = {"Roboflow": ["train", "valid"], "annotations": ["train", "val"], "parts": ["train", "val"]}
IDENTIFIERS = {
    "annotations": ("train", "val"),
    "sub-folders": ("x/1", "y/1"),
    "parts": ("train/1", "val/1"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts(name: str, tmp_path: Path) -> None:
    images, names = LAYOUTS[name]
    _write_layout(tmp_path, images, names)
    extra = ("README.txt", "images/more.png", "annotations/captions_train.json")
    for path in extra:
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text('{"annotations": [')
    assert detect_layout(tmp_path) == "coco"
    dataset = open_dataset("coco", tmp_path)
    assert dataset.identifiers == IDENTIFIERS.get(name, ("a", "b"))
    for i, identifier in enumerate(dataset.identifiers):
        frame = dataset.frame(identifier)
        assert to_uint8(frame.photograph)[0, 0, 0] in range(3)
        assert frame.labels is not None
        assert frame.labels.boxes_xyxy[0].tolist() == [i - 0.5, 1.5, i + 9.5, 21.5]
    table = coco_labels.read_table(tmp_path, False, None)
    assert (table.frames, table.boxes[:, 0].tolist()) == (dataset.identifiers, [0, 1])
    assert sorted(table.splits) == sorted(dataset.splits()) == SPLITS.get(name, [])
    for account in (dataset.account(), table.account):
        assert account is not None
        assert account.files + sum(account.skipped.values()) == sum(p.is_file() for p in tmp_path.rglob("*"))
        assert sum(account.skipped.values()) == len(extra)
        assert (account.frames, account.classes, account.without_image) == (2, {"car": 2}, 0)


def test_accounts_count_every_row_and_repair(tmp_path: Path) -> None:
    rows = [
        {"id": 1, "image_id": 139, "category_id": 3, "bbox": [1, 2, 3, 4]},
        {"id": 1, "image_id": 139, "category_id": 4, "bbox": [1, 2, 3, 4]},
        {"id": 3, "image_id": 139, "category_id": 3, "bbox": [1, 2, 3, 4], "iscrowd": 1},
        {"id": 4, "image_id": 139, "category_id": 3, "bbox": [1, 2, 3, 4], "ignore": 1},
    ]
    categories = [{"id": 3, "name": "car"}, {"id": 4, "name": "car"}, {"id": 5, "name": "bus"}]
    other = IMAGE | {
        "id": 7,
        "file_name": "gone.png",
        "attributes": {"weather": "rainy", "night": True, "boxes": []},
    }
    path = foreign(tmp_path, images=[IMAGE, IMAGE, other], annotations=rows, categories=categories)
    table = coco_labels.read_table(path, False, None)
    assert table.kinds == ("car", "bus")
    assert table.box_ids is not None
    assert table.box_ids.tolist() == [1, 5, 3, 4]
    assert table.ignore.tolist() == [False, False, True, True]
    dataset = coco.CocoDataset(path)
    assert dataset.attributes("gone") == {"weather": "rainy", "night": "True"}
    assert table.frame_attributes == {0: other["attributes"]}
    expected = DataAccount("coco", 2, 1, {}, {"car": 2}, regions=2, unlabelled=1, without_image=1)
    expected = replace(
        expected,
        repairs={
            "entries that are given twice": 1,
            "annotation ids numbered anew": 1,
            "categories merged into another of their name": 1,
        },
    )
    assert dataset.account() == table.account == expected
    with pytest.raises(FormatError, match=r"gone\.png: expected a readable file"):
        dataset.frame("gone")


def test_sizes_come_from_the_images_where_the_file_has_none(tmp_path: Path) -> None:
    path = foreign(tmp_path, images=[{"id": 139, "file_name": IMAGE["file_name"], "width": 0}])
    assert coco_labels.read_table(path, False, None).sizes_wh.tolist() == [[80, 40]]
    assert coco.CocoDataset(path).frame("000000000139").camera.width == 80


@pytest.mark.parametrize("name", ["../../outside.png", "/outside.png", "a/../../../x.png"])
def test_images_outside_of_the_data_set_are_not_opened(name: str, tmp_path: Path) -> None:
    Image.new("RGB", (80, 40)).save(tmp_path / "outside.png")
    path = foreign(tmp_path / "root", images=[IMAGE | {"file_name": name}])
    dataset = coco.CocoDataset(path)
    assert dataset.account().without_image == 1
    with pytest.raises(FormatError, match=r"images\[0\]\.file_name: expected a file in "):
        dataset.frame(dataset.identifiers[0])


def test_fiftyone_reads_back(tmp_path: Path) -> None:
    _write_layout(tmp_path / "in", LAYOUTS["one file"][0])
    table = coco_labels.read_table(tmp_path / "in", False, None)
    images = {table.frames[i]: path for i, path in table.image_paths.items()}
    fiftyone.write_table(table, tmp_path / "out", images)
    assert detect_layout(tmp_path / "out") == "coco"
    again = coco_labels.read_table(tmp_path / "out", False, None)
    assert (again.frames, again.kinds) == (table.frames, table.kinds)
    np.testing.assert_allclose(again.boxes, table.boxes, atol=1e-9)
    assert coco.CocoDataset(tmp_path / "out").frame("b").labels is not None


@pytest.mark.parametrize("name", [".", "/", "./"])
def test_an_image_without_a_file_name_is_refused(name: str, tmp_path: Path) -> None:
    path = foreign(tmp_path, images=[IMAGE | {"file_name": name}])
    for read in (coco.CocoDataset, lambda path: coco_labels.read_table(path, False, None)):
        with pytest.raises(
            FormatError, match=r"images\[0\]\.file_name: expected the name of a file, found"
        ) as caught:
            read(path)
        assert "\n" not in str(caught.value)
