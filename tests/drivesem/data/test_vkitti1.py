"""Virtual KITTI 1.3.1 folders: the layout to the letter, the round trip, and one line for every fault."""

import json
import pickle
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.data import vkitti1
from drivesem.data.ground_truth import SKY_CM, Exposure, FrameLocation, TrackedObject
from drivesem.data.registry import open_dataset
from drivesem.data.vkitti1 import Vkitti1Dataset, Vkitti1Writer
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Camera
from tests.drivesem.data.shots import Damage, remove, replace_text, set_field, write_image

ROOT = Path(__file__).resolve().parents[3]
FACTS = ROOT / ".." / "shared" / "FORMATS.md"
SIZE = (375, 1242)
CAMERA = Camera(torch.tensor([[725.0, 0, 620.5], [0, 725, 187], [0, 0, 1]]), *SIZE)
FIRST = "0001/clone/00000"
MakeShot = Callable[..., Exposure]
MakeObject = Callable[..., TrackedObject]


def place(frame: int = 0, variation: str = "clone", scene: str = "01") -> FrameLocation:
    return FrameLocation(frame, scene, variation, frame, "train")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {}


@pytest.fixture
def folder(
    tmp_path: Path, written: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, make_shot: MakeShot
) -> Path:
    """Frame 0 of one world, frame 1 of another of its variations; written once, copied for each test."""
    if not written:
        root = tmp_path_factory.mktemp("vkitti1")
        writer = Vkitti1Writer(root)
        entries = [writer.write(place(0), make_shot(*SIZE, CAMERA))]
        entries.append(writer.write(place(1, "fog"), make_shot(*SIZE, CAMERA, 1)))
        writer.finish(json.loads(json.dumps(entries[::-1])))
        written["root"] = root
    shutil.copytree(written["root"], tmp_path / "vkitti")
    return tmp_path / "vkitti"


def test_the_layout_is_virtual_kittis(folder: Path) -> None:
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert files == {
        *(
            f"vkitti_1.3.1_{m}/0001/{f}.png"
            for m in ("rgb", "depthgt", "scenegt")
            for f in ("clone/00000", "fog/00001")
        ),
        *(f"vkitti_1.3.1_{m}/0001_{v}.txt" for m in ("motgt", "extrinsicsgt") for v in ("clone", "fog")),
        *(f"vkitti_1.3.1_scenegt/0001_{v}_scenegt_rgb_encoding.txt" for v in ("clone", "fog")),
    }


@pytest.mark.skipif(not FACTS.is_file(), reason="needs ../shared/FORMATS.md")
def test_headers_are_those_of_the_data_set() -> None:
    text = FACTS.read_text().split("## Virtual KITTI 2 ")[0]
    found = re.search(r"`(frame tid [^`]+)`", text)
    assert found
    assert found[1] == vkitti1.MOTGT
    assert f"`{vkitti1.ENCODING}`" in text
    found = re.search(r"extrinsics header `([^`]+)`", text)
    assert found
    start, end = found[1].split(" ... ")
    assert vkitti1.EXTRINSICS.startswith(start)
    assert vkitti1.EXTRINSICS.endswith(end)


def test_tables_hold_the_objects(folder: Path) -> None:
    lines = (folder / "vkitti_1.3.1_motgt/0001_clone.txt").read_text().splitlines()
    assert lines[1] == (
        "0 0 Car 0 0 -1.30700076 10 14 27 24 1.7654321 1.5078125 4.125 1.04719755 1.6500001 14.4321987 "
        "-1.23456789 0 0 0.0 0.923456789012345 Car 0 car000 dark_red"
    )
    assert lines[2].split()[:5] == ["0", "3", "Car", "1", "0"]
    assert lines[3].split()[:5] == ["0", "7", "Van", "0", "1"]
    assert lines[4].split()[:5] == ["0", "12", "DontCare", "0", "2"]
    assert lines[4].split()[21:] == ["Pedestrian", "0", "pedestrian012", "dark_red"]
    encoding = (folder / "vkitti_1.3.1_scenegt/0001_clone_scenegt_rgb_encoding.txt").read_text().splitlines()
    assert encoding[0] == "Category(:id) r g b"
    assert "GuardRail 255 100 255" in encoding
    assert [line.split()[0] for line in encoding[-4:]] == ["Car:0", "Car:3", "Van:7", "Misc:12"]
    extrinsics = (folder / "vkitti_1.3.1_extrinsicsgt/0001_clone.txt").read_text().splitlines()
    assert extrinsics[1] == "0 0.6 0 0.8 1.25 0 1 0 -1.7 -0.8 0 0.6 300.123456 0 0 0 1"


def test_objects_have_colours_of_their_own() -> None:
    """Up to the highest track, and none is a category's."""
    colours = {vkitti1.object_colour(track) for track in range(vkitti1.MAX_TRACK + 1)}
    assert len(colours) == vkitti1.MAX_TRACK + 1
    assert not colours & set(vkitti1.CATEGORY_COLOURS.values())
    assert all(0 <= value <= 255 for colour in colours for value in colour)


@pytest.mark.parametrize("with_dont_care", [False, True])
def test_what_the_writer_writes_the_reader_reads(with_dont_care: bool, folder: Path, make_shot: MakeShot) -> None:
    shot = make_shot(*SIZE, CAMERA)
    dataset = Vkitti1Dataset(folder, with_dont_care=with_dont_care)
    assert dataset.identifiers == (FIRST, "0001/fog/00001")
    frame = dataset.frame(FIRST)
    tracked_objects = [t for t in sorted(shot.objects, key=lambda t: t.track) if t.labelled or with_dont_care]
    labels = frame.labels
    assert labels is not None
    assert frame.masks is not None
    assert frame.depth is not None
    assert frame.classes is not None
    assert labels.kind == tuple(t.kind for t in tracked_objects)
    assert labels.boxes_xyxy.tolist() == [list(map(float, t.box_ltrb)) for t in tracked_objects]
    assert labels.ignore_xyxy.tolist() == ([] if with_dont_care else [[50, 18, 50, 18]])
    for name, tolerance in (("translation", 1e-5), ("size_lhw", 1e-5), ("yaw", 1e-6), ("truncation", 0)):
        wanted = torch.tensor([getattr(t, name) for t in tracked_objects], dtype=torch.float32)
        torch.testing.assert_close(getattr(labels, name), wanted, atol=tolerance, rtol=0)
    assert labels.occlusion.tolist() == [min(t.occlusion, 2) for t in tracked_objects]
    for mask, tracked in zip(frame.masks, tracked_objects, strict=True):
        assert np.array_equal(mask.numpy() > 0, shot.instances == tracked.track + 1)
    sky = shot.depth_cm == SKY_CM
    assert np.array_equal(np.isinf(frame.depth.numpy()), sky)
    assert np.array_equal(np.rint(frame.depth.numpy()[~sky] * 100), shot.depth_cm[~sky])
    people = {"Pedestrian": "Misc"}
    names = np.array([people.get(name, name) for name in shot.class_names])[shot.classes]
    assert np.array_equal(np.array(frame.class_names)[frame.classes.numpy()], names)
    assert len(frame.class_names) == 15
    photograph = (frame.photograph * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    assert np.array_equal(photograph, shot.image)
    assert torch.equal(frame.camera.intrinsics, CAMERA.intrinsics)
    assert frame.provenance == {
        "dataset": "vkitti1",
        "image": "vkitti_1.3.1_rgb/0001/clone/00000.png",
        "scene": "0001",
        "variation": "clone",
        "tracks": ",".join(str(t.track) for t in tracked_objects),
    }
    assert np.allclose(dataset.extrinsic(FIRST).numpy(), shot.extrinsic, atol=1e-6, rtol=0)


def test_labels_need_no_images(folder: Path) -> None:
    for modality in ("scenegt", "depthgt", "extrinsicsgt"):
        shutil.rmtree(folder / f"vkitti_1.3.1_{modality}")
    frame = open_dataset("vkitti1", folder).frame(FIRST)
    assert frame.masks is None
    assert frame.depth is None
    assert frame.classes is None
    assert frame.class_names == ()
    assert frame.labels is not None
    assert frame.labels.kind == ("Car", "Car", "Van")


def test_a_writer_travels_and_knows_what_it_wrote(tmp_path: Path, folder: Path) -> None:
    writer = pickle.loads(pickle.dumps(Vkitti1Writer(folder)))
    assert writer.exists(place(0))
    assert not writer.exists(place(1))
    assert writer.exists(place(1, "fog"))


def test_a_real_extrinsics_header_is_read(folder: Path) -> None:
    """The files as they are distributed have 0.1 and 0.2 where names would repeat."""
    path = folder / "vkitti_1.3.1_extrinsicsgt/0001_clone.txt"
    path.write_text(path.read_text().replace("t3 0 0 0 1", "t3 0 0.1 0.2 1", 1))
    assert float(Vkitti1Dataset(folder).extrinsic(FIRST)[2, 3]) == pytest.approx(300.123456)


def write_rows(root: Path, *rows: str) -> Vkitti1Dataset:
    image = root / "vkitti_1.3.1_rgb/0001/clone/00000.png"
    image.parent.mkdir(parents=True, exist_ok=True)
    image.touch()
    table = root / "vkitti_1.3.1_motgt/0001_clone.txt"
    table.parent.mkdir(exist_ok=True)
    table.write_text("".join(f"{row}\n" for row in (vkitti1.MOTGT, *rows)))
    return Vkitti1Dataset(root)


def test_rows_as_the_data_set_has_them(tmp_path: Path) -> None:
    """Rotations about other axes, a DontCare with a true type; the values are made up."""
    dataset = write_rows(
        tmp_path,
        "0 0 Car 1 1 -2 774 169 1241 374 1.85 1.5 4.9 2.9 1.4 6.4 -1.57 0.0015 -0.0722 0.08 0.79 Car 0 Sedan Red",
        "0 1 DontCare 0 2 -2 722 186 866 281 1.6 1.4 3.7 3.0 1.4 13.1 -1.57 0.0015 -0.07 0 0.39 Van 1 SUV Red",
    )
    labels = dataset.labels(FIRST)
    assert labels.kind == ("Car",)
    assert labels.occlusion.tolist() == [1]
    torch.testing.assert_close(labels.size_lhw, torch.tensor([[4.9, 1.5, 1.85]]))
    torch.testing.assert_close(labels.translation, torch.tensor([[2.9, 1.4, 6.4]]))
    assert labels.ignore_xyxy.tolist() == [[722, 186, 866, 281]]
    assert Vkitti1Dataset(tmp_path, with_dont_care=True).labels(FIRST).kind == ("Car", "Van")


PREFIX = "vkitti_1.3.1_"
MOTGT, IMAGE = f"{PREFIX}motgt/0001_clone.txt", "0001/clone/00000.png"
ENCODING = f"{PREFIX}scenegt/0001_clone_scenegt_rgb_encoding.txt"
COLUMN_FAULTS = (
    ("frame", "a", "a whole number, found 'a'"),
    ("label", "Auto", "one of Car.*DontCare, found 'Auto'"),
    ("orig_label", "DontCare", "one of Car.*found 'DontCare'"),
    ("truncated", "3", "one of 0, 1, 2, found '3'"),
    ("occluded", "0.5", r"one of 0, 1, 2, found '0\.5'"),
    ("truncr", "-0.1", r"a number in \[0, 1\], found -0\.1"),
    ("moving", "True", "one of 0, 1, found 'True'"),
    ("r", "9", "at least 10, found 9"),
    ("b", "9", "at least 14, found 9"),
    ("w3d", "-1", "more than 0, found -1"),
    ("z3d", "-14", "a 3D box in front of the camera"),
    ("ry", "90", "a number in"),
)
"""Column of motgt, damaged value, error."""
FAULTS: tuple[tuple[Damage, str], ...] = (
    *((set_field(MOTGT, c, v), rf"clone\.txt:2: {c}: expected {error}") for c, v, error in COLUMN_FAULTS),
    (remove(MOTGT), r"motgt/0001_clone\.txt: expected a readable file"),
    (replace_text(MOTGT, "orig_label", "original"), r"clone\.txt:1: orig_label: expected a column"),
    (set_field(MOTGT, "color", ""), r"0001_clone\.txt:2: expected 25 fields, found 24"),
    (set_field(MOTGT, "tid", "3"), r"0001_clone\.txt:3: tid: expected each once in a frame, found 3 twice"),
    (set_field(MOTGT, "r", "1450"), r"00000\.png: expected an image that holds .*1450"),
    (remove(ENCODING), r"encoding\.txt: expected a readable file"),
    (replace_text(ENCODING, "(:id)", ""), r"encoding\.txt:1: Category\(:id\): expected a column of that"),
    (replace_text(ENCODING, "Car:3", "Car:x"), "Car:x: expected a whole number after the colon, found 'x'"),
    (replace_text(ENCODING, "210 0 200", "210 0"), r"encoding\.txt:2: expected 4 fields, found 3"),
    (
        replace_text(ENCODING, "100 60 100", "1 2 3"),
        r"clone/00000\.png: pixel \(\d+, \d+\): expected a colour of 0001_clone_.*, found 100 60 100",
    ),
    (
        write_image(f"{PREFIX}rgb/{IMAGE}", np.zeros((370, 1226, 3), np.uint8)),
        r"rgb/0001/clone/00000\.png: expected 1242x375 px, found 1226x370 px",
    ),
    (remove(f"{PREFIX}depthgt/{IMAGE}"), r"depthgt/0001/clone/00000\.png: expected a readable file"),
    (
        write_image(f"{PREFIX}depthgt/{IMAGE}", np.zeros(SIZE, np.uint8)),
        r"depthgt.*00000\.png: expected 16 bits and 1 channel",
    ),
    (remove(f"{PREFIX}scenegt/{IMAGE}"), r"scenegt/0001/clone/00000\.png: expected a readable file"),
)


@pytest.mark.parametrize(("damage", "message"), FAULTS, ids=[message for _, message in FAULTS])
def test_a_fault_is_named(damage: Damage, message: str, folder: Path) -> None:
    damage(folder)
    with pytest.raises(FormatError, match=message) as caught:
        Vkitti1Dataset(folder).frame(FIRST)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_bad_folders(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(
        FormatError, match=r"nowhere: expected a Virtual KITTI 1\.3\.1 folder, found no such folder"
    ):
        Vkitti1Dataset(tmp_path / "nowhere")
    with pytest.raises(
        FormatError, match=r"vkitti_1\.3\.1_rgb: expected a folder of images, found no such folder"
    ):
        Vkitti1Dataset(tmp_path)
    (tmp_path / "vkitti_1.3.1_rgb").mkdir()
    with pytest.raises(FormatError, match=r"expected <world>/<variation>/NNNNN\.png, found none"):
        Vkitti1Dataset(tmp_path)
    assert Vkitti1Dataset(folder, variations=("fog",)).identifiers == ("0001/fog/00001",)
    with pytest.raises(RangeError, match=r"variation of .*: expected one of clone, fog, found rain"):
        Vkitti1Dataset(folder, variations=("rain",))
    with pytest.raises(RangeError, match=r"frame of .*: expected one of 2 identifiers, found '7'"):
        Vkitti1Dataset(folder).labels("7")


def test_what_the_layout_cannot_hold_is_refused(
    tmp_path: Path, make_shot: MakeShot, make_object: MakeObject
) -> None:
    writer, shot = Vkitti1Writer(tmp_path), make_shot(*SIZE, CAMERA)
    other = Camera(torch.tensor([[721.5, 0, 620.5], [0, 725, 187], [0, 0, 1]]), *SIZE)
    with pytest.raises(RangeError, match=r"exposure\.camera: expected Virtual KITTI's camera.*found \[721\.5"):
        writer.write(place(), replace(shot, camera=other))
    with pytest.raises(RangeError, match=r"exposure\.camera: expected .* found .* px at 80x40"):
        writer.write(place(), make_shot(40, 80, Camera(CAMERA.intrinsics, 40, 80)))
    stray = shot.instances.copy()
    stray[0, 0] = 42
    with pytest.raises(RangeError, match=r"exposure\.instances: expected tracks of .*objects, found 41"):
        writer.write(place(), replace(shot, instances=stray))
    high = (*shot.objects, make_object(10_000, labelled=False))
    with pytest.raises(RangeError, match=r"exposure\.objects: track: expected at most 9999, found 10000"):
        writer.write(place(), replace(shot, objects=high))
    assert not list(tmp_path.iterdir())


def test_a_track_is_of_one_category(tmp_path: Path, folder: Path) -> None:
    writer = Vkitti1Writer(tmp_path)
    common: dict[str, Any] = {"scene": "0001", "variation": "clone", "camera": 0, "motgt": [], "extrinsic": ""}
    entries = [{**common, "frame": i, "tracks": [[4, kind]]} for i, kind in enumerate(("Car", "Van"))]
    with pytest.raises(
        FormatError, match=r"encoding\.txt: track 4: expected Car, as in earlier frames, found Van"
    ):
        writer.finish(entries)


WORDS = st.sampled_from(["0", "1", "2", "-1", "7", "0.5", "nan", "1e300", "9" * 30, "x", "Car", "DontCare", ""])


@given(st.lists(WORDS, min_size=24, max_size=26))
def test_no_row_is_read_wrongly_or_ends_in_another_error(
    tmp_path_factory: pytest.TempPathFactory, words: list[str]
) -> None:
    dataset = write_rows(tmp_path_factory.mktemp("rows"), " ".join(["0", *words]))
    labels, message = None, "0001_clone.txt"
    try:
        labels = dataset.labels(FIRST)
    except FormatError as error:
        message = str(error)
    assert "0001_clone.txt" in message
    assert "\n" not in message
    if labels is not None:
        assert bool(torch.isfinite(labels.translation).all())


share = st.floats(0, 1)
number = st.floats(-500, 500)


@given(
    track=st.integers(0, 9999),
    truncation=share,
    visible=share,
    x=number,
    z=st.floats(1, 900),
    yaw=st.floats(-3.15, 3.15),
)
def test_any_object_comes_back(
    tmp_path_factory: pytest.TempPathFactory, make_object: MakeObject, **values: Any
) -> None:
    x, z, track = values.pop("x"), values.pop("z"), values.pop("track")
    tracked = make_object(track, "Truck", translation=(x, 1.5, z), **values)
    dataset = write_rows(tmp_path_factory.mktemp("rows"), vkitti1.format_motgt_row(0, tracked))
    (back,) = dataset.objects(FIRST)
    for name in ("track", "kind", "model", "moving", "box_ltrb", "truncation", "visible", "labelled"):
        assert getattr(back, name) == getattr(tracked, name), name
    for name in ("translation", "yaw", "size_lhw"):
        assert getattr(back, name) == pytest.approx(getattr(tracked, name), abs=1e-3), name
    assert back.occlusion == min(tracked.occlusion, 2)
