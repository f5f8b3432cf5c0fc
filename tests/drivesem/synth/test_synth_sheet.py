"""The contact sheet: one row a frame of a folder, drawn of what is on disk."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivesem.data.ground_truth import SKY_CM, Exposure, FrameLocation
from drivesem.data.registry import WRITERS, open_dataset
from drivesem.reporting import drawing
from drivesem.synth import sheet as sheets
from drivesem.synth.exposure import expose
from drivesem.synth.frames import generate_frame
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

PLACES = tuple(FrameLocation(i, "01", "clone", i, "train") for i in range(2))


@pytest.fixture(scope="module")
def exposures() -> tuple[Exposure, ...]:
    return tuple(expose(generate_frame(3, i)) for i in (0, 1))


@pytest.fixture(scope="module")
def folders(exposures: Sequence[Exposure], tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sheets")
    for name in ("kitti", "coco", "yolo"):
        writer = WRITERS[name](root / name)
        writer.finish([writer.write(p, e) for p, e in zip(PLACES, exposures, strict=True)])
    return root


def rows_of(exposure: Exposure) -> tuple[int, int, int]:
    """Where the photograph begins in the sheet of one exposure, row and column, and how tall it is."""
    tall = round(sheets._PHOTO_PX * exposure.camera.height / exposure.camera.width)
    return drawing.MARGIN_PX + drawing.TEXT_PX + 10, drawing.MARGIN_PX, tall


def test_a_row_a_frame(exposures: Sequence[Exposure], folders: Path) -> None:
    dataset = open_dataset("kitti", folders / "kitti")
    one, two = (sheets.draw_sheet(dataset, ["000000", "000001"][:count]) for count in (1, 2))
    assert one.dtype == two.dtype == np.uint8
    assert one.shape[1:] == two.shape[1:] == (sheets.WIDTH_PX, 3)
    assert np.array_equal(two[: len(one) - drawing.MARGIN_PX], one[: -drawing.MARGIN_PX])
    made = exposures[0]
    top, left, tall = rows_of(made)
    tiles = one[top : top + tall, left : left + sheets._PHOTO_PX].astype(float)
    small = cv2.resize(made.image, (sheets._PHOTO_PX, tall), interpolation=cv2.INTER_AREA)
    assert np.median(np.abs(tiles - small)) == 0
    # the left edge of every box is drawn in its class's colour, unless a text or another box lies there
    scale = sheets._PHOTO_PX / made.camera.width
    drawn = 0
    for kind, (x0, y0, _, y1) in zip(made.labels.kind, made.labels.boxes_xyxy.tolist(), strict=True):
        row, column = round((y0 + y1 + 1) / 2 * scale - 0.5), round((x0 + 0.5) * scale - 0.5)
        drawn += tuple(tiles[row, column]) == sheets.BOX_COLOURS[kind]
    assert drawn >= 0.5 * len(made.labels.kind) > 0


def test_a_folder_shows_what_was_written(exposures: Sequence[Exposure], folders: Path) -> None:
    dataset = open_dataset("kitti", folders / "kitti")
    tiles = sheets.draw_sheet(dataset, ["000000"])
    made = exposures[0]
    top, left, tall = rows_of(made)
    right = left + sheets._PHOTO_PX + drawing.MARGIN_PX
    depth = np.s_[top : top + tall // 2 - drawing.MARGIN_PX, right : right + 350]
    depth_m = np.where(made.depth_cm == SKY_CM, np.inf, made.depth_cm.astype(np.float32) / 100)
    small = ((sheets.WIDTH_PX - sheets._PHOTO_PX - 4 * drawing.MARGIN_PX) // 2, tall // 2 - drawing.MARGIN_PX // 2)
    expected = cv2.resize(drawing.colourise_depth(depth_m), small, interpolation=cv2.INTER_AREA)
    expected = expected[: tall // 2 - drawing.MARGIN_PX, :350]
    # 1/256 m for centimetres, but what lies beyond 256 m, which KITTI's depth cannot hold, is grey as the sky
    grey = (tiles[depth] == drawing.UNKNOWN_COLOUR).all(axis=-1)
    assert np.quantile(np.abs(tiles[depth].astype(int) - expected)[~grey], 0.99) <= 8
    path = folders / "kitti/training/depth_2/000000.png"
    before = path.read_bytes()
    files.write_png(path, np.full_like(files.read_uint16(path), 10 * 256))
    changed = sheets.draw_sheet(dataset, ["000000"])
    path.write_bytes(before)
    assert len(np.unique(changed[depth].reshape(-1, 3), axis=0)) == 1
    assert np.array_equal(changed[:, :right], tiles[:, :right])


@pytest.mark.parametrize("name", ["coco", "yolo"])
def test_a_folder_without_maps_has_a_sheet(name: str, folders: Path) -> None:
    dataset = open_dataset(name, folders / name)
    assert sheets.draw_sheet(dataset, dataset.identifiers).shape[1] == sheets.WIDTH_PX


def test_nothing_to_label(exposures: Sequence[Exposure], tmp_path: Path) -> None:
    made = exposures[0]
    empty = replace(
        made,
        instances=np.zeros_like(made.instances),
        objects=(),
        labels=replace(
            made.labels,
            kind=(),
            **{
                name: getattr(made.labels, name)[:0]
                for name in ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw")
            },
        ),
    )
    writer = WRITERS["kitti"](tmp_path)
    writer.finish([writer.write(PLACES[0], empty)])
    assert len(np.unique(sheets.draw_sheet(open_dataset("kitti", tmp_path), ["000000"]))) > 1


def test_classes_and_depths_have_fixed_colours() -> None:
    classes = sheets._class_colours(np.array([[0, 1, 2, 3]]), ("Road", "Car", "Pedestrian", "Nonsense"))
    assert classes[0].tolist() == [[100, 60, 100], [255, 127, 80], [220, 20, 60], list(drawing.UNKNOWN_COLOUR)]
    depth = drawing.colourise_depth(np.array([[1.0, 3.0, 30.0, 200.0, 500.0, np.inf, np.nan]]))[0].astype(int)
    assert depth[0].tolist() == depth[1].tolist() == [253, 231, 37]  # both ends of matplotlib's viridis
    assert depth[3].tolist() == depth[4].tolist() == [68, 1, 84]
    assert depth[5].tolist() == depth[6].tolist() == list(drawing.UNKNOWN_COLOUR)
    assert depth[1].sum() > depth[2].sum() > depth[3].sum()


def test_written_as_png_or_jpeg(tmp_path: Path) -> None:
    picture = np.full((20, 30, 3), (200, 100, 50), np.uint8)
    drawing.write_picture(tmp_path / "a.png", picture)
    assert np.array_equal(files.read_image(tmp_path / "a.png"), picture)
    drawing.write_picture(tmp_path / "a.jpg", picture)
    assert (tmp_path / "a.jpg").read_bytes().startswith(b"\xff\xd8")
    assert np.abs(files.read_image(tmp_path / "a.jpg").astype(int) - picture).max() <= 3


def test_bad_requests(folders: Path) -> None:
    dataset = open_dataset("yolo", folders / "yolo")
    with pytest.raises(RangeError, match="frames of a sheet: expected 1 to 12, found 0"):
        sheets.draw_sheet(dataset, [])
    with pytest.raises(RangeError, match="frames of a sheet: expected 1 to 12, found 13"):
        sheets.draw_sheet(dataset, ["000000"] * 13)
    path = folders / "yolo/images/train/000001.png"
    data = path.read_bytes()
    path.write_bytes(data[:100])
    with pytest.raises(FormatError, match=r"000001\.png: expected an image"):
        sheets.draw_sheet(dataset, ["000001"])
    path.write_bytes(data)
