"""KITTI folders: values, the round trip, and one line for everything that can be wrong with them."""

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from drivesem.data import kitti, kitti_labels, layouts
from drivesem.data.classes import count_vehicles, object_type
from drivesem.data.ground_truth import SKY_CM, Exposure, FrameLocation
from drivesem.data.registry import WRITERS, open_dataset
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.geometry import project_boxes
from scene_ir.types import Labels

ROOT = Path(__file__).resolve().parents[3]
SHARED = ROOT / ".." / "shared" / "data" / "kitti"
H, W = 40, 80
PROJECTION = torch.tensor([[72.0, 0, 39.5, 4.5], [0, 72, 18.25, 0.2], [0, 0, 1, 0.003]])
CAR = "Car 0.25 1 -1.33 10.00 12.50 30.25 28.00 1.47 1.60 3.66 1.07 1.55 14.44 -1.25"
DONT_CARE = "DontCare -1 -1 -10 50.00 10.00 60.00 20.00 -1 -1 -1 -1000 -1000 -1000 -10"
SITTING = "Person_sitting 0.00 0 1.50 40.00 10.00 45.00 20.00 1.20 0.60 0.80 3.00 1.50 12.00 1.60"
CALIB = kitti.format_calibration(PROJECTION)


def image(seed: int = 0, height: int = H, width: int = W) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_folder(root: Path) -> Path:
    """A KITTI folder with two frames, written by hand."""
    for name in ("image_2", "label_2", "calib", "velodyne"):
        (root / "training" / name).mkdir(parents=True)
    for identifier, label in (("000000", f"{CAR}\n{DONT_CARE}\n{SITTING}\n"), ("000007", "")):
        cv2.imwrite(str(root / "training" / "image_2" / f"{identifier}.png"), image()[..., ::-1])
        (root / "training" / "label_2" / f"{identifier}.txt").write_text(label)
        (root / "training" / "calib" / f"{identifier}.txt").write_text(CALIB)
    return root


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_folder(tmp_path / "kitti")


def labels_of(*lines: str, folder: Path) -> Labels:
    path = folder / "labels.txt"
    path.write_text("".join(f"{line}\n" for line in lines))
    return kitti.read_labels(path)


def test_values_of_a_label_file(tmp_path: Path) -> None:
    labels = labels_of(CAR, DONT_CARE, SITTING, folder=tmp_path)
    assert labels.kind == ("Car", "Person_sitting")
    torch.testing.assert_close(labels.boxes_xyxy[0], torch.tensor([10, 12.5, 30.25, 28]))
    torch.testing.assert_close(labels.size_lhw[0], torch.tensor([3.66, 1.47, 1.6]))
    torch.testing.assert_close(labels.translation[0], torch.tensor([1.07, 1.55, 14.44]))
    assert labels.yaw.tolist() == pytest.approx([-1.25, 1.6])
    assert labels.truncation.tolist() == [0.25, 0]
    assert labels.occlusion.tolist() == [1, 0]
    assert labels.ignore_xyxy.tolist() == [[50, 10, 60, 20]]


@pytest.mark.parametrize("text", ["", "\n", "  \n\n"])
def test_an_empty_file_is_a_frame_without_objects(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    labels = kitti.read_labels(tmp_path / "a.txt")
    assert labels.kind == ()
    assert labels.boxes_xyxy.shape == (0, 4)
    assert labels.ignore_xyxy.shape == (0, 4)


def test_a_16th_field_is_accepted_in_labels_and_needed_in_results(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(f"{CAR} 0.625\n")
    assert kitti.read_labels(path).kind == ("Car",)
    assert kitti.read_labels(path, scored=True).kind == ("Car",)
    assert kitti_labels.read_table(tmp_path, scored=True).score.tolist() == [0.625]
    path.write_text(f"{CAR}\n")
    with pytest.raises(FormatError, match=r"a\.txt:1: expected 16 fields \(with a score\), found 15"):
        kitti.read_labels(path, scored=True)


_FIELD = st.sampled_from(["0.5", "-1", "1e2", "-10", "-1000", "x", "nan", "", "1\t2", "3-4", "+7", "0x1", "1_0"])


@given(st.data())
def test_lines_read_together_are_as_read_one_by_one(data: st.DataObject) -> None:
    scored = data.draw(st.booleans())
    numbers = st.floats(-1000, 1000).map(repr)
    lines: list[str] = []
    for _ in range(data.draw(st.integers(1, 4))):
        fields = data.draw(st.lists(numbers, min_size=14, max_size=15))
        if data.draw(st.booleans()):
            fields[7:14] = kitti_labels.UNKNOWN_POSE
        line = " ".join([data.draw(st.sampled_from(["Car", "1", "a\tb", ""])), *fields])
        if data.draw(st.integers(0, 3)) == 0:
            at = data.draw(st.integers(0, len(fields)))
            line = " ".join([*line.split(" ")[:at], data.draw(_FIELD), *line.split(" ")[at + 1 :]])
        lines.append(line + data.draw(st.sampled_from(["", "", "", " ", "\t", "\n"])))
    text = "\n".join(lines)

    def read() -> tuple[list[str], list[list[float]], list[int]] | str:
        try:
            found = kitti_labels.KittiLabelLines(["a"], [text], scored)
        except FormatError as error:
            return str(error)
        return found.kinds, found.values.tolist(), found.counts.tolist()

    together = read()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(kitti_labels, "_parse_uniform", lambda lines, fields: None)
        assert read() == together


def test_results_of_a_2d_detector(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("Car -1 -1 -10 10 12 30 28 -1 -1 -1 -1000 -1000 -1000 -10 0.5\n")
    labels = kitti.read_labels(path, scored=True)
    assert bool(labels.translation.isnan().all())
    assert bool(labels.size_lhw.isnan().all())
    assert bool(labels.truncation.isnan().all())
    assert labels.occlusion.tolist() == [kitti.UNKNOWN_OCCLUSION]


def test_a_box_partly_behind_the_camera_is_accepted(tmp_path: Path) -> None:
    """Eight of KITTI's own labels are such."""
    line = "Truck 1.00 0 -2.72 26.58 0.00 53.86 30.00 4.05 2.50 16.44 -3.47 1.59 -1.87 -1.58"
    assert labels_of(line, folder=tmp_path).kind == ("Truck",)


def with_field(name: str, value: str, line: str = CAR) -> str:
    parts = line.split()
    parts[kitti_labels.FIELDS.index(name)] = value
    return " ".join(parts)


BAD_LINES = [
    ("Car 0.00 0 1.0", "expected 15 or 16 fields, found 4"),
    (f"{CAR} 0.5 0.5", "expected 15 or 16 fields, found 17"),
    (with_field("left", "nan"), "left: expected a finite number, found nan"),
    (with_field("score", "inf", f"{CAR} 1"), "score: expected a finite number, found inf"),
    (with_field("z", "-inf"), "z: expected a finite number, found -inf"),
    (with_field("height", "1,47"), "height: expected a number, found '1,47'"),
    (with_field("truncated", "1.5"), r"truncated: expected \[0, 1\], found 1\.5"),
    (with_field("truncated", "-1"), r"truncated: expected \[0, 1\], found -1"),
    (with_field("occluded", "4"), "occluded: expected 0, 1, 2 or 3, found 4"),
    (with_field("occluded", "0.5"), "occluded: expected 0, 1, 2 or 3, found 0.5"),
    (with_field("right", "9.99"), r"right: expected at least 10, found 9\.99"),
    (with_field("bottom", "3"), r"bottom: expected at least 12\.5, found 3"),
    (with_field("right", "40", DONT_CARE), "right: expected at least 50, found 40"),
    (with_field("length", "-1"), "length: expected positive metres, found -1"),
    (with_field("width", "0"), "width: expected positive metres, found 0"),
    (with_field("rotation_y", "90"), "rotation_y: expected rad in .*found 90"),
    (with_field("z", "-5"), "z: expected a 3D box in front of the camera, found -5 m, wholly behind it"),
    (with_field("z", "-1.95"), "z: expected a 3D box in front of the camera"),
    (with_field("z", "-9", SITTING), "z: expected a 3D box in front of the camera"),
]


@pytest.mark.parametrize(("line", "message"), BAD_LINES)
def test_bad_label_line_is_named(line: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=rf"labels\.txt:3: {message}") as caught:
        labels_of(SITTING, DONT_CARE, line, CAR, folder=tmp_path)
    assert "\n" not in str(caught.value)


def test_binary_and_missing_label_files(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"Car \xff\xfe")
    with pytest.raises(FormatError, match=r"a\.txt: expected UTF-8 text, found byte 0xff at 4"):
        kitti.read_labels(tmp_path / "a.txt")
    with pytest.raises(FormatError, match=r"b\.txt: expected a readable file, found no such file"):
        kitti.read_labels(tmp_path / "b.txt")


def test_kitti_lines_are_written_as_they_were_read(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(f"{CAR}\n{DONT_CARE}\n")
    labels = kitti.read_labels(tmp_path / "a.txt")
    kitti.write_labels(tmp_path / "out" / "b.txt", labels)
    alpha = -1.25 - math.atan2(1.07, 14.44)
    assert (tmp_path / "out" / "b.txt").read_text() == f"{with_field('alpha', f'{alpha:.3f}')}\n{DONT_CARE}\n"
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["b.txt"]


@given(st.integers(0, 2**31), st.booleans())
def test_written_labels_read_back_to_half_a_hundredth(seed: int, as_results: bool) -> None:
    g = torch.Generator().manual_seed(seed)
    count = int(torch.randint(0, 5, (), generator=g))

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=g)

    corner = rand(count, 2) * 1000
    regions = rand(0 if as_results else 2, 2) * 100
    labels = Labels(
        kind=tuple(kitti.TYPES[i] for i in torch.randint(0, 8, (count,), generator=g).tolist()),
        boxes_xyxy=torch.cat([corner, corner + 1 + rand(count, 2) * 200], dim=1),
        truncation=rand(count),
        occlusion=torch.randint(0, 4, (count,), generator=g),
        translation=(rand(count, 3) - 0.5) * 40 + torch.tensor([0, 0, 30.0]),
        yaw=(rand(count) - 0.5) * 6,
        size_lhw=rand(count, 3) * 5 + 0.1,
        ignore_xyxy=torch.cat([regions, regions + 1], dim=1),
    )
    scores = rand(count) if as_results else None
    lines = kitti_labels.KittiLabelLines(["text"], [kitti.format_labels(labels, scores)], as_results)
    back = lines.to_table(["text"], as_results).to_labels()
    assert back.kind == labels.kind
    assert torch.equal(back.occlusion, labels.occlusion)
    for name in ("boxes_xyxy", "truncation", "translation", "yaw", "size_lhw", "ignore_xyxy"):
        torch.testing.assert_close(getattr(back, name), getattr(labels, name), atol=0.002, rtol=0)
    if scores is not None:
        assert lines.values[:, 14].tolist() == pytest.approx(scores.tolist(), abs=1e-6)


def test_alpha_is_the_angle_at_which_the_camera_sees_the_car(tmp_path: Path) -> None:
    labels = labels_of(
        with_field("x", "10", with_field("z", "10", with_field("rotation_y", "-3"))), folder=tmp_path
    )
    alpha = float(kitti.format_labels(labels).split()[3])
    assert alpha == pytest.approx(-3 - math.pi / 4 + 2 * math.pi, abs=1e-3)


def test_unknown_3d_boxes_are_written_as_unknown(tmp_path: Path) -> None:
    line = "Car 0.00 0 -10 10.00 12.00 30.00 28.00 -1 -1 -1 -1000 -1000 -1000 -10"
    labels = labels_of(line, folder=tmp_path)
    assert bool(labels.yaw.isnan().all())
    assert kitti.format_labels(labels) == f"{line}\n"


def test_objects_of_other_data_sets_can_be_written(tmp_path: Path) -> None:
    """Types of several words and unknown truncation, as BDD100K's traffic lights have."""
    unknown = torch.tensor([math.nan])
    labels = replace(labels_of(CAR, folder=tmp_path), kind=("traffic light",), truncation=unknown)
    kitti.write_labels(tmp_path / "b.txt", labels)
    back = kitti.read_labels(tmp_path / "b.txt")
    assert (back.kind, float(back.truncation[0])) == (("traffic_light",), 0.0)
    assert object_type("traffic_light") == object_type("traffic light")
    assert object_type("emergency_vehicle") == object_type("emergency vehicle")


def test_nothing_is_written_that_would_not_be_read(tmp_path: Path) -> None:
    labels = labels_of(CAR, folder=tmp_path)
    bad = Labels(
        **{**{n: getattr(labels, n) for n in Labels.__slots__}, "boxes_xyxy": torch.full((1, 4), torch.nan)}
    )
    with pytest.raises(FormatError, match="labels:1: left: expected a finite number, found nan"):
        kitti.write_labels(tmp_path / "b.txt", bad)
    assert not (tmp_path / "b.txt").exists()
    with pytest.raises(ShapeError, match=r"scores: expected shape \(1,\)"):
        kitti.write_labels(tmp_path / "b.txt", labels, torch.zeros(2))


def test_calibration_round_trips_to_the_bit(tmp_path: Path) -> None:
    projection = torch.rand(3, 4, generator=torch.Generator().manual_seed(0)) * 1000 / 3
    (tmp_path / "a.txt").write_text(kitti.format_calibration(projection))
    calibration = kitti.read_calibration(tmp_path / "a.txt")
    assert torch.equal(calibration.projection, projection)
    assert calibration.rectification is not None
    assert torch.equal(calibration.rectification, torch.eye(3))


P2 = "P2: 72 0 39.5 4.5 0 72 18.25 0.2 0 0 1 0.003"

BAD_CALIBRATIONS = [
    ("", r"a\.txt: P2: expected 12 numbers, found no such key \(only none\)"),
    (P2.replace("P2", "P3"), r"a\.txt: P2: expected 12 numbers, found no such key \(only P3\)"),
    (P2.removesuffix(" 0.003"), r"a\.txt:1: P2: expected 12 numbers, found 11"),
    (P2.replace("0.2", "nan"), r"a\.txt:1: P2: expected a finite number, found nan"),
    (P2.replace("0.2", "x"), r"a\.txt:1: P2: expected a number, found 'x'"),
    (P2.replace(":", ""), r"a\.txt:1: line: expected 'KEY: numbers'"),
    (f"{P2}\n\n{P2}", r"a\.txt:3: P2: expected the key once, found twice"),
    (P2.replace("72", "0"), r"a\.txt: P2: expected positive focal lengths"),
    (f"{P2}\nR0_rect: 1 0 0", r"a\.txt:2: R0_rect: expected 9 numbers, found 3"),
]


@pytest.mark.parametrize(("text", "message"), BAD_CALIBRATIONS)
def test_bad_calibration_is_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        kitti.read_calibration(tmp_path / "a.txt")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("below", [False, True])
def test_frames_of_a_folder(folder: Path, below: bool) -> None:
    dataset = open_dataset("kitti", folder / "training" if below else folder)
    assert dataset.identifiers == ("000000", "000007")
    frame = dataset.frame("000000")
    assert frame.photograph.dtype == torch.float32
    assert torch.equal(
        (frame.photograph * 255).round().to(torch.uint8), torch.from_numpy(image()).permute(2, 0, 1)
    )
    assert torch.equal(frame.camera.matrix, PROJECTION)
    assert torch.equal(frame.camera.intrinsics, PROJECTION[:, :3])
    assert (frame.camera.height, frame.camera.width) == (H, W)
    assert frame.labels is not None
    assert frame.labels.kind == ("Car", "Person_sitting")
    assert count_vehicles(frame.labels) == 1
    assert count_vehicles(dataset.labels("000007")) == 0


def test_order_of_the_identifiers_does_not_depend_on_the_file_system(folder: Path) -> None:
    for name in ("000003", "000001"):
        shutil.copy(folder / "training/image_2/000000.png", folder / f"training/image_2/{name}.png")
        shutil.copy(folder / "training/label_2/000000.txt", folder / f"training/label_2/{name}.txt")
    assert kitti.KittiDataset(folder).identifiers == ("000000", "000001", "000003", "000007")


def test_a_folder_without_labels_has_frames_without_labels(folder: Path) -> None:
    shutil.rmtree(folder / "training" / "label_2")
    dataset = kitti.KittiDataset(folder)
    assert dataset.frame("000000").labels is None
    assert count_vehicles(dataset.labels("000000")) == 0


def test_points_are_in_the_axes_of_the_labels(folder: Path) -> None:
    rectify = "0 -1 0 1 0 0 0 0 1"  # a quarter turn about z
    move = "0 -1 0 0.5 0 0 -1 0 1 0 0 -0.25"  # KITTI's axes: x forward, y left, z up -> x right, y down, z forward
    (folder / "training/calib/000000.txt").write_text(f"{P2}\nR0_rect: {rectify}\nTr_velo_to_cam: {move}\n")
    np.array([[10, 2, -1.5, 0.3]], np.float32).tofile(folder / "training/velodyne/000000.bin")
    points = kitti.KittiDataset(folder, with_points=True).frame("000000").points
    assert points is not None
    assert points.tolist() == [[-1.5, -1.5, 9.75]]
    assert kitti.KittiDataset(folder).frame("000000").points is None


def spoil_points(data: bytes) -> Callable[[Path], None]:
    return lambda f: (f / "velodyne" / "000000.bin").write_bytes(data) and None


def write_image(array: np.ndarray) -> Callable[[Path], None]:
    return lambda f: cv2.imwrite(str(f / "image_2" / "000000.png"), array) and None


def cut_image(f: Path) -> None:
    path = f / "image_2" / "000000.png"
    path.write_bytes(path.read_bytes()[:3000])


def cut_jpeg(f: Path) -> None:
    (f / "image_2" / "000000.png").unlink()
    data = cv2.imencode(".jpg", image())[1].tobytes()
    (f / "image_2" / "000000.jpg").write_bytes(data[: len(data) // 2])


def append(line: str) -> Callable[[Path], None]:
    def spoil(f: Path) -> None:
        path = f / "label_2" / "000000.txt"
        path.write_text(f"{path.read_text()}{line}\n")

    return spoil


BAD_FRAMES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("label", append("Car 0 0"), r"label_2/000000\.txt:4: expected 15 or 16 fields, found 3"),
    (
        "no-p2",
        lambda f: (f / "calib/000000.txt").write_text("P0: 1\n".replace("1", "1 " * 12)),
        r"calib/000000\.txt: P2",
    ),
    (
        "not-image",
        lambda f: (f / "image_2/000000.png").write_text("hello"),
        r"000000\.png: expected an image, found 5 by",
    ),
    (
        "empty",
        lambda f: (f / "image_2/000000.png").write_bytes(b""),
        r"000000\.png: expected an image, found 0 bytes",
    ),
    ("cut", cut_image, r"000000\.png: expected an image, found 3000 bytes that do not decode"),
    ("cut-jpeg", cut_jpeg, r"000000\.jpg: expected an image, found \d+ bytes that do not decode"),
    (
        "folder",
        lambda f: ((f / "calib/000000.txt").unlink(), (f / "calib/000000.txt").mkdir()),
        "found is a directory",
    ),
    ("16-bit", write_image(image().astype(np.uint16)), r"expected 8 bits and 3 channels, found 16 bits and 3"),
    (
        "small",
        write_image(image(0, 38, 54)),
        r"000000\.png: expected an image that holds .*60\.0, 20\.0\], found 54x38",
    ),
    (
        "smaller",
        write_image(image(0, 20, 40)),
        r"000000\.png: expected 53 to 158 px wide \(principal .*found 40x20 px",
    ),
    ("large", write_image(image(0, 400, 100)), r"000000\.png: expected 24 to 73 px high .*found 100x400 px"),
    ("outside", append(with_field("right", "99", CAR)), r"000000\.png: expected an image that holds .*99\.0, 28"),
]


@pytest.mark.parametrize(("spoil", "message"), [b[1:] for b in BAD_FRAMES], ids=[b[0] for b in BAD_FRAMES])
def test_bad_frame_is_named_and_the_others_are_read(
    spoil: Callable[[Path], Any], message: str, folder: Path
) -> None:
    kitti.KittiDataset(folder).frame("000000")
    spoil(folder / "training")
    dataset = kitti.KittiDataset(folder)
    assert dataset.identifiers == ("000000", "000007")
    with pytest.raises(FormatError, match=message) as caught:
        dataset.frame("000000")
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    dataset.frame("000007")


@pytest.mark.parametrize(
    ("data", "calib", "message"),
    [
        (b"abc", CALIB, r"000000\.bin: expected float32 .*multiple of 16 bytes, found 3 bytes"),
        (np.full(4, np.nan, np.float32).tobytes(), CALIB, r"000000\.bin: expected finite coordinates"),
        (bytes(16), P2, r"expected R0_rect and Tr_velo_to_cam"),
    ],
)
def test_bad_points(data: bytes, calib: str, message: str, folder: Path) -> None:
    spoil_points(data)(folder / "training")
    (folder / "training/calib/000000.txt").write_text(calib)
    with pytest.raises(FormatError, match=message):
        kitti.KittiDataset(folder, with_points=True).frame("000000")


def test_bad_folders(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="nowhere: expected a KITTI folder, found no such folder"):
        kitti.KittiDataset(tmp_path / "nowhere")
    with pytest.raises(FormatError, match="training/image_2: expected a folder of images, found no such folder"):
        kitti.KittiDataset(tmp_path)
    (tmp_path / "training" / "image_2").mkdir(parents=True)
    with pytest.raises(
        FormatError, match=r"training/image_2: expected at least one image \(\.png, .*\), found none"
    ):
        kitti.KittiDataset(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(FormatError, match="file: expected a KITTI folder, found no such folder"):
        kitti.KittiDataset(tmp_path / "file")


def test_unknown_identifier_and_dataset(folder: Path) -> None:
    with pytest.raises(RangeError, match="training: expected one of 2 identifiers, found '42'"):
        kitti.KittiDataset(folder).frame("42")
    with pytest.raises(RangeError, match=r"dataset: expected one of .*kitti.*, found kiti"):
        open_dataset("kiti", folder)


def test_what_the_writer_writes_the_reader_reads(tmp_path: Path) -> None:
    labels = labels_of(CAR, DONT_CARE, folder=tmp_path)
    writer = kitti.KittiWriter(tmp_path / "out")
    writer.write_photograph("000123", image(5), labels, PROJECTION)
    frame = kitti.KittiDataset(tmp_path / "out").frame("000123")
    assert torch.equal(frame.photograph, torch.from_numpy(image(5)).permute(2, 0, 1).float() / 255)
    assert torch.equal(frame.camera.matrix, PROJECTION)
    assert frame.labels is not None
    for name in ("boxes_xyxy", "translation", "yaw", "size_lhw", "truncation", "ignore_xyxy"):
        assert torch.equal(getattr(frame.labels, name), getattr(labels, name)), name
    assert len([p for p in (tmp_path / "out").rglob("*") if p.is_file()]) == 3


@pytest.fixture
def written(tmp_path: Path, make_exposure: Callable[..., Exposure]) -> Path:
    """A folder of two exposures, the second without objects and to validate."""
    writer = WRITERS["kitti"](tmp_path / "out")
    assert not writer.exists(FrameLocation(0, "01", "clone", 0, "train"))
    entries = [
        writer.write(FrameLocation(0, "01", "clone", 0, "train"), make_exposure(0)),
        writer.write(FrameLocation(1, "01", "fog", 0, "val"), make_exposure(1, specification=(), empty_box=False)),
    ]
    assert writer.exists(FrameLocation(0, "01", "clone", 0, "train"))
    writer.finish(entries)
    return tmp_path / "out"


def test_an_exposure_reads_back(written: Path, make_exposure: Callable[..., Exposure]) -> None:
    made, frame = make_exposure(0), kitti.KittiDataset(written).frame("000000")
    assert torch.equal((frame.photograph * 255).round().byte(), torch.from_numpy(made.image).permute(2, 0, 1))
    assert torch.equal(frame.camera.matrix, made.camera.matrix)
    assert frame.labels is not None
    assert frame.labels.kind == made.labels.kind
    for name in ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw", "ignore_xyxy"):
        torch.testing.assert_close(getattr(frame.labels, name), getattr(made.labels, name), atol=6e-4, rtol=0)
    assert frame.masks is not None
    for mask, tracked in zip(frame.masks, (o for o in made.objects if o.labelled), strict=True):
        assert np.array_equal(mask.numpy(), made.instances == tracked.track + 1)
    assert frame.depth is not None
    sky = made.depth_cm == SKY_CM
    assert np.array_equal(np.isinf(frame.depth.numpy()), sky)
    assert np.array_equal((frame.depth.numpy()[~sky] * 100).round(), made.depth_cm[~sky])
    assert frame.classes is not None
    same = {"Tree": "Vegetation", "Van": "Car", "Cyclist": "Rider"}
    for i, name in enumerate(made.class_names):
        assert {frame.class_names[c] for c in frame.classes.numpy()[made.classes == i]} <= {same.get(name, name)}
    empty = kitti.KittiDataset(written).frame("000001")
    assert empty.masks is not None
    assert empty.masks.shape == (0, H, W)


def test_layout_of_exposures(written: Path) -> None:
    names = ("calib", "depth_2", "image_2", "instance_2", "label_2")
    assert sorted(p.name for p in (written / "training").iterdir()) == list(names)
    sets = {p.name: p.read_text() for p in (written / "ImageSets").iterdir()}
    assert sets == {"train.txt": "000000\n", "val.txt": "000001\n", "trainval.txt": "000000\n000001\n"}
    # the higher byte is Cityscapes' car, the lower one the label's line; the truck has no line and comes after
    values = files.read_uint16(written / "training/instance_2/000000.png")
    assert int(values[13, 6]) == 26 * 256 + 1
    assert int(values[20, 30]) == 26 * 256 + 2
    assert int(values[20, 62]) == 24 * 256 + 3
    assert int(values[11, 42]) == 27 * 256 + 4


def test_labels_keep_to_the_ranges_of_the_development_kit(
    tmp_path: Path, make_exposure: Callable[..., Exposure]
) -> None:
    writer = kitti.KittiWriter(tmp_path, extras=False)
    for i in range(20):
        made = make_exposure(i)
        yaw = [math.pi, -math.pi, 3.5 * (-1) ** i]
        made = replace(made, labels=replace(made.labels, yaw=torch.tensor(yaw)))
        writer.write(FrameLocation(i, "01", "clone", i, "train"), made)
        lines = (tmp_path / f"training/label_2/{i:06d}.txt").read_text().splitlines()
        assert len(lines) == 5
        for line in lines:
            kind, truncated, occluded, alpha, *rest = line.split()
            left, top, right, bottom, *sizes, _, _, z, turn = map(float, rest)
            assert len(rest) == 11
            assert kind in kitti.TYPES
            assert -1 <= left < right <= W
            assert -1 <= top < bottom <= H
            if kind == "DontCare":
                assert line.split()[1:4] == ["-1", "-1", "-10"]
                assert line.split()[8:] == ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
                continue
            assert 0 <= float(truncated) <= 1
            assert occluded in ("0", "1", "2", "3")
            assert abs(float(alpha)) <= math.pi
            assert abs(turn) <= math.pi
            assert min(sizes) > 0
            assert z > 0
        turns = [float(line.split()[14]) for line in lines[:3]]
        assert all(abs(math.remainder(a - b, 2 * math.pi)) < 1e-3 for a, b in zip(turns, yaw, strict=True))
    assert sorted(p.name for p in (tmp_path / "training").iterdir()) == ["calib", "image_2", "label_2"]
    frame = kitti.KittiDataset(tmp_path).frame("000000")
    assert (frame.masks, frame.depth, frame.classes) == (None, None, None)


@given(st.integers(1, SKY_CM))
def test_depth_is_exact_to_the_centimetre_up_to_where_it_ends(depth_cm: int) -> None:
    value = int(kitti._depth_map(np.array([[depth_cm]], np.uint16))[0, 0])
    assert value == 0 if depth_cm > 25_599 else round(value / kitti.DEPTH_SCALE * 100) == depth_cm


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("depth_2", np.zeros((H, W), np.uint8), "expected 16 bits and 1 channel, found 8 bits and 1"),
        ("depth_2", np.zeros((H, W - 1), np.uint16), "expected 80x40 px, found 79x40 px"),
        ("instance_2", np.zeros((H, W, 3), np.uint8), "expected 16 bits and 1 channel, found 8 bits and 3"),
        ("instance_2", np.full((H, W), 34 << 8, np.uint16), "semantic id: expected 0 to 33, found 34"),
    ],
)
def test_bad_maps(name: str, values: np.ndarray, message: str, written: Path) -> None:
    files.write_png(written / "training" / name / "000000.png", values)
    with pytest.raises(FormatError, match=rf"{name}/000000\.png: {message}"):
        kitti.KittiDataset(written).frame("000000")


def test_classes_and_their_ids() -> None:
    # ids as cityscapesScripts lists them
    names = ("Road", "Building", "GuardRail", "Pole", "Sky", "Car")
    assert kitti.semantic_ids(names).tolist() == [7, 11, 14, 17, 23, 26]
    assert kitti.semantic_ids(("Tree", "Vegetation", "Van", "Cyclist")).tolist() == [21, 21, 26, 25]
    assert len(kitti.SEMANTIC_NAMES) == 34
    with pytest.raises(FormatError, match=r"class: expected one of Undefined, .*found 'Boat'"):
        kitti.semantic_ids(("Boat",))


@pytest.mark.parametrize("mode", ["L", "P", "RGBA"])
def test_pictures_of_other_modes_are_read_as_colour(mode: str, folder: Path) -> None:
    path = folder / "training/image_2/000000.png"
    with Image.open(path) as picture:
        picture.convert(mode).save(path)
    with Image.open(path) as picture:
        expected = np.asarray(picture.convert("RGB"))
    photograph = kitti.KittiDataset(folder).frame("000000").photograph
    assert np.array_equal((photograph * 255).round().byte().permute(1, 2, 0).numpy(), expected)


def test_files_without_a_partner_are_skipped_by_name(folder: Path) -> None:
    training = folder / "training"
    (training / "label_2/000000.txt").rename(training / "label_2/000009.txt")
    (training / "notes.md").write_text("")
    dataset = kitti.KittiDataset(folder)
    assert dataset.identifiers == ("000007",)
    account = dataset.account()
    assert account.skipped["image without a label file"] == account.without_image == 1
    assert account.skipped["label file without an image"] == account.skipped[".md not part of the layout"] == 1
    assert account.files + sum(account.skipped.values()) == sum(p.is_file() for p in folder.rglob("*"))


def test_subfolders_and_suffixes(folder: Path) -> None:
    training = folder / "training"
    for name, suffix in (("image_2", "png"), ("label_2", "txt"), ("calib", "txt")):
        (training / name / "drive").mkdir()
        (training / name / f"000000.{suffix}").rename(training / name / "drive" / f"000000.{suffix}")
    Image.open(training / "image_2/000007.png").save(training / "image_2/000007.JPEG")
    (training / "image_2/000007.png").unlink()
    dataset = kitti.KittiDataset(folder)
    assert dataset.identifiers == ("000007", "drive/000000")
    assert dataset.frame("drive/000000").camera.intrinsics[0, 0] == 72
    account = dataset.account()
    assert len(layouts.read_table(folder, "kitti")) == sum(account.classes.values()) + account.regions


def test_values_that_a_scene_cannot_use_become_unknown(folder: Path) -> None:
    zeros = with_field("length", "0", with_field("width", "0", with_field("height", "0", CAR)))
    rows = [
        zeros,
        with_field("rotation_y", "90", CAR),
        with_field("truncated", "7", CAR),
        with_field("type", "bus", CAR),
    ]
    (folder / "training/label_2/000000.txt").write_text("\n".join(rows))
    dataset = kitti.KittiDataset(folder)
    labels = dataset.labels("000000")
    assert labels is not None
    assert labels.kind == ("Car", "Car", "Car", "bus")
    assert torch.isnan(labels.yaw).tolist() == [True, True, False, False]
    assert torch.isnan(labels.truncation).tolist() == [False, False, True, False]
    assert dataset.account().repairs == {"3D boxes that cannot be used": 1, "truncations outside [0, 1]": 1}


def test_without_a_calibration_there_are_2d_boxes_only(folder: Path) -> None:
    (folder / "training/calib/000000.txt").unlink()
    dataset = kitti.KittiDataset(folder)
    frame = dataset.frame("000000")
    assert frame.labels is not None
    assert torch.isnan(frame.labels.translation).all()
    assert float(frame.camera.intrinsics[0, 0]) == pytest.approx(0.58 * W)
    assert dataset.account().repairs == {"frames without calibration (3D boxes not used)": 1}


def test_lists_of_image_sets_are_splits(folder: Path) -> None:
    files.write_text(folder / "ImageSets/train.txt", "000007\n")
    files.write_text(folder / "ImageSets/val.txt", "000000\n")
    assert kitti.KittiDataset(folder).splits() == {"train": ("000007",), "val": ("000000",)}


def test_a_byte_order_mark_is_no_part_of_a_class(folder: Path) -> None:
    path = folder / "training/label_2/000000.txt"
    text = path.read_text()
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert kitti.read_labels(path).kind[0] == "Car"
    assert layouts.read_table(folder, "kitti").kinds == ("Car", "Person_sitting")


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data/kitti")
def test_real_frames() -> None:
    dataset = kitti.KittiDataset(SHARED, with_points=True)
    assert sum(count_vehicles(dataset.labels(i)) > 0 for i in dataset.identifiers) >= 12
    frame = dataset.frame("000008")
    assert frame.labels is not None
    assert frame.points is not None
    # returns within a car's label, half a metre above its ground, project into its 2D box
    car = 3
    offset = frame.points - frame.labels.translation[car]
    inside = offset[(offset[:, [0, 2]].norm(dim=1) < 1.0) & (offset[:, 1] < -0.4) & (offset[:, 1] > -1.4)]
    assert len(inside) > 20
    pose = (frame.labels.size_lhw[[car]], frame.labels.yaw[[car]], frame.labels.translation[[car]])
    box = project_boxes(*pose, frame.camera.matrix)[0]
    torch.testing.assert_close(box, frame.labels.boxes_xyxy[car], atol=5, rtol=0)
