"""Virtual KITTI 2 folders: the layout to the letter, the round trip, every variant, one line for every fault."""

import json
import pickle
import re
import shutil
import time
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

from drivesem.data import vkitti2
from drivesem.data.ground_truth import SKY_CM, Exposure, FrameLocation, TrackedObject
from drivesem.data.registry import DATASETS, WRITERS, open_dataset
from drivesem.data.vkitti import CACHED_TABLES, KINDS
from drivesem.data.vkitti1 import Vkitti1Dataset
from drivesem.data.vkitti2 import Vkitti2Dataset, Vkitti2Writer
from drivesem.synth.exposure import expose
from drivesem.synth.frames import SynthSettings, generate_frame
from scene_ir.errors import FormatError, RangeError, SceneError, ShapeError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.types import Camera
from tests.drivesem.data.shots import (
    Damage,
    overwrite,
    remove,
    replace_text,
    set_field,
    truncate,
    write_image,
)

ROOT = Path(__file__).resolve().parents[3]
FIRST = "Scene01/clone/Camera_0/00000"
MakeShot = Callable[..., Exposure]
MakeObject = Callable[..., TrackedObject]


def place(frame: int = 0, variation: str = "clone", scene: str = "01") -> FrameLocation:
    return FrameLocation(frame, scene, variation, frame, "train")


def write_folder(root: Path, make_shot: MakeShot) -> Path:
    """Frames 0 and 2 of one scene, frame 1 of another variation, frame 0 of another scene, which is empty."""
    writer = Vkitti2Writer(root)
    shot = make_shot()
    empty = replace(make_shot(seed=1), objects=(), instances=np.zeros_like(shot.instances), labels=no_labels(shot))
    entries = [
        writer.write(place(0), shot),
        writer.write(place(2), make_shot(seed=2)),
        writer.write(place(1, "fog"), make_shot(seed=3)),
        writer.write(place(0, "clone", "20"), empty),
    ]
    writer.finish(entries)
    return root


def no_labels(shot: Exposure) -> Any:
    names = ("boxes_xyxy", "truncation", "occlusion", "translation", "yaw", "size_lhw")
    return replace(shot.labels, kind=(), **{n: getattr(shot.labels, n)[:0] for n in names})


@pytest.fixture
def folder(tmp_path: Path, make_shot: MakeShot) -> Path:
    return write_folder(tmp_path / "vkitti", make_shot)


def header_of(file: str) -> list[str]:
    """The header that the project's facts give for a file of Virtual KITTI 2."""
    facts = (ROOT / ".." / "shared" / "FORMATS.md").read_text()
    text = facts[facts.index("## Virtual KITTI 2 ") :]
    found = re.search(rf"`{file}`: `([^`]+)`", text)
    assert found
    return found[1].split()


def test_the_layout_is_virtual_kittis(folder: Path) -> None:
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    frames = "Scene01/clone/frames"
    assert {f for f in files if f.startswith("Scene01/clone") and "00002" not in f} == {
        f"{frames}/rgb/Camera_0/rgb_00000.jpg",
        f"{frames}/depth/Camera_0/depth_00000.png",
        f"{frames}/classSegmentation/Camera_0/classgt_00000.png",
        f"{frames}/instanceSegmentation/Camera_0/instancegt_00000.png",
        *(f"Scene01/clone/{n}.txt" for n in ("info", "bbox", "pose", "intrinsic", "extrinsic", "colors")),
    }
    assert {f.split("/")[0] for f in files} == {"Scene01", "Scene20"}
    assert len(files) == 4 * 4 + 3 * 6


def test_tables_hold_the_objects(folder: Path) -> None:
    clip = folder / "Scene01" / "clone"
    lines = (clip / "bbox.txt").read_text().splitlines()
    assert [line.split()[:3] for line in lines[1:]] == [
        *(["0", "0", t] for t in ("0", "3", "7", "12")),
        *(["2", "0", t] for t in ("0", "3", "7", "12")),
    ]
    assert lines[1] == "0 0 0 10 27 14 24 90 0.0 0.923456789012345 False"
    assert lines[2].endswith("True")
    assert (clip / "info.txt").read_text().splitlines() == [
        "trackID label model color",
        "0 Car car000 dark_red",
        "3 Car car003 dark_red",
        "7 Van van007 dark_red",
        "12 Pedestrian pedestrian012 dark_red",
    ]
    assert (clip / "intrinsic.txt").read_text().splitlines()[1] == "0 0 72.0008698 72.5 39.5 18.25"
    assert (clip / "extrinsic.txt").read_text().splitlines()[1] == (
        "0 0 0.6 0 0.8 1.25 0 1 0 -1.7 -0.8 0 0.6 300.123456 0 0 0 1"
    )
    pose = (clip / "pose.txt").read_text().splitlines()
    assert len(pose) == 9
    alpha = float(pose[1].split()[3])
    assert alpha == pytest.approx(-1.2345678901 - np.arctan2(1.0471975512, 14.4321987), abs=1e-6)


def test_a_frame_without_objects_has_no_rows(folder: Path) -> None:
    clip = folder / "Scene20" / "clone"
    for name, count in (("info", 0), ("bbox", 0), ("pose", 0), ("intrinsic", 1), ("extrinsic", 1)):
        assert len((clip / f"{name}.txt").read_text().splitlines()) == 1 + count, name
    frame = Vkitti2Dataset(folder).frame("Scene20/clone/Camera_0/00000")
    assert frame.labels is not None
    assert frame.labels.kind == ()
    assert frame.masks is not None
    assert frame.masks.shape == (0, 40, 80)
    assert frame.provenance["tracks"] == ""


@pytest.mark.skipif(not (ROOT / ".." / "shared" / "FORMATS.md").is_file(), reason="needs ../shared/FORMATS.md")
@pytest.mark.parametrize("name", ["info", "bbox", "pose", "intrinsic", "colors"])
def test_headers_are_those_of_the_data_set(name: str, folder: Path) -> None:
    first = (folder / "Scene01" / "clone" / f"{name}.txt").read_text().splitlines()[0]
    assert first.split() == header_of(f"{name}.txt")


@pytest.mark.skipif(not (ROOT / ".." / "shared" / "FORMATS.md").is_file(), reason="needs ../shared/FORMATS.md")
def test_colours_are_those_of_the_data_set(folder: Path) -> None:
    facts = (ROOT / ".." / "shared" / "FORMATS.md").read_text()
    text = facts[facts.index("Colours (parse the file") :].split("\n")[0].split(":", 1)[1]
    wanted = re.sub(r"\([^)]*\)", "", text)
    stated = dict(re.findall(r"(\w+) (\d+ \d+ \d+)", wanted))
    lines = (folder / "Scene01" / "clone" / "colors.txt").read_text().splitlines()[1:]
    assert dict(line.split(" ", 1) for line in lines) == stated


def test_the_images_are_as_others_read_them(folder: Path, make_shot: MakeShot) -> None:
    """By Pillow, which knows palettes, and by OpenCV."""
    shot, frames = make_shot(), folder / "Scene01" / "clone" / "frames"
    with Image.open(frames / "instanceSegmentation/Camera_0/instancegt_00000.png") as image:
        assert image.mode == "P"
        assert np.array_equal(np.asarray(image), shot.instances)
        palette = np.array(image.getpalette()).reshape(-1, 3)
    assert len(np.unique(palette, axis=0)) == 256
    assert palette[0].tolist() == [0, 0, 0]
    with Image.open(frames / "classSegmentation/Camera_0/classgt_00000.png") as image:
        assert image.mode == "RGB"
        colours = np.asarray(image)
    assert colours[15, 11].tolist() == [255, 127, 80]  # the car
    assert colours[18, 50].tolist() == [80, 80, 80]  # the walker is Misc
    assert colours[39, 79].tolist() == [255, 127, 80]
    depth = cv2.imread(str(frames / "depth/Camera_0/depth_00000.png"), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    assert depth is not None
    assert depth.dtype == np.uint16
    assert np.array_equal(depth, shot.depth_cm)


def check_frame(frame: Any, shot: Exposure, image_loss: float = 60) -> None:
    """Everything of the exposure is in the frame."""
    tracked_objects = sorted(shot.objects, key=lambda t: t.track)
    assert frame.labels.kind == tuple(t.kind for t in tracked_objects)
    assert frame.labels.boxes_xyxy.tolist() == [list(map(float, t.box_ltrb)) for t in tracked_objects]
    for name, tolerance in (("translation", 1e-5), ("size_lhw", 1e-5), ("yaw", 1e-6)):
        wanted = torch.tensor([getattr(t, name) for t in tracked_objects], dtype=torch.float32)
        torch.testing.assert_close(getattr(frame.labels, name), wanted, atol=tolerance, rtol=0)
    assert frame.labels.occlusion.tolist() == [t.occlusion for t in tracked_objects]
    truncation = torch.tensor([t.truncation for t in tracked_objects], dtype=torch.float32)
    assert torch.equal(frame.labels.truncation, truncation)
    assert frame.labels.ignore_xyxy.shape == (0, 4)
    for mask, tracked in zip(frame.masks, tracked_objects, strict=True):
        assert np.array_equal(mask.numpy(), (shot.instances == tracked.track + 1).astype(np.float32))
    sky = shot.depth_cm == SKY_CM
    assert np.array_equal(np.isinf(frame.depth.numpy()), sky)
    assert np.array_equal(np.rint(frame.depth.numpy()[~sky] * 100), shot.depth_cm[~sky])
    people = {"Pedestrian": "Misc"}
    names = np.array([people.get(name, name) for name in shot.class_names])[shot.classes]
    assert frame.classes.dtype == torch.int64
    assert np.array_equal(np.array(frame.class_names)[frame.classes.numpy()], names)
    photograph = frame.photograph.permute(1, 2, 0).numpy() * 255
    assert np.abs(photograph - shot.image).mean() < image_loss  # JPEG of pure noise
    assert torch.equal(frame.camera.intrinsics, shot.camera.intrinsics)
    assert frame.provenance["tracks"] == ",".join(str(t.track) for t in tracked_objects)


def test_what_the_writer_writes_the_reader_reads(folder: Path, make_shot: MakeShot) -> None:
    dataset = open_dataset("vkitti2", folder)
    assert dataset.identifiers == (
        FIRST,
        "Scene01/clone/Camera_0/00002",
        "Scene01/fog/Camera_0/00001",
        "Scene20/clone/Camera_0/00000",
    )
    for identifier, seed in zip(dataset.identifiers[:3], (0, 2, 3), strict=True):
        check_frame(dataset.frame(identifier), make_shot(seed=seed))
    frame = dataset.frame("Scene01/fog/Camera_0/00001")
    assert frame.provenance["scene"] == "Scene01"
    assert frame.provenance["variation"] == "fog"
    assert frame.provenance["image"] == "Scene01/fog/frames/rgb/Camera_0/rgb_00001.jpg"


def test_objects_come_back_whole(folder: Path, make_shot: MakeShot) -> None:
    """World poses, shares, names and motion too."""
    dataset, shot = Vkitti2Dataset(folder), make_shot()
    for found, tracked in zip(dataset.objects(FIRST), sorted(shot.objects, key=lambda t: t.track), strict=True):
        for name in ("translation", "yaw", "size_lhw", "world", "world_yxz"):
            assert getattr(found, name) == pytest.approx(getattr(tracked, name), abs=1e-5), name
        same = {n: getattr(tracked, n) for n in ("translation", "yaw", "size_lhw", "world", "world_yxz")}
        assert replace(found, **same) == replace(tracked, paint="dark_red", labelled=True)
    assert np.allclose(dataset.extrinsic(FIRST).numpy(), shot.extrinsic, atol=1e-6, rtol=0)


@pytest.mark.parametrize("layout", ["vkitti1", "vkitti2"])
def test_a_generated_frame_comes_back(layout: str, tmp_path: Path, street: Exposure) -> None:
    """With the true poses: they agree with the boxes, and with the world seen from where the camera stood."""
    WRITERS[layout](tmp_path).finish([WRITERS[layout](tmp_path).write(place(), street)])
    dataset = DATASETS[layout](tmp_path)
    assert isinstance(dataset, Vkitti1Dataset | Vkitti2Dataset)
    (identifier,) = dataset.identifiers
    frame, extrinsic = dataset.frame(identifier), dataset.extrinsic(identifier)
    sky = street.depth_cm == SKY_CM
    assert frame.labels is not None
    assert frame.masks is not None
    assert frame.depth is not None
    assert np.array_equal(np.isinf(frame.depth.numpy()), sky)
    assert np.array_equal(np.rint(frame.depth.numpy()[~sky] * 100), street.depth_cm[~sky])
    tracked_objects = [
        t for t in sorted(street.objects, key=lambda t: t.track) if t.labelled or layout == "vkitti2"
    ]
    assert len(tracked_objects) > 5
    full = project_boxes(frame.labels.size_lhw, frame.labels.yaw, frame.labels.translation, frame.camera.matrix)
    cut = clip_boxes(full, frame.camera.height, frame.camera.width)
    for i, tracked in enumerate(tracked_objects):
        assert frame.labels.boxes_xyxy[i].tolist() == list(tracked.box_ltrb)
        assert frame.labels.translation[i].tolist() == pytest.approx(tracked.translation, abs=1e-3)
        assert float(frame.labels.yaw[i]) == pytest.approx(tracked.yaw, abs=1e-3)
        assert np.array_equal(frame.masks[i].numpy() > 0, street.instances == tracked.track + 1)
        seen = (extrinsic @ torch.tensor([*tracked.world, 1.0], dtype=torch.float64))[:3]
        assert seen.tolist() == pytest.approx(tracked.translation, abs=1e-3)
        slack = 3 + 0.12 * float(cut[i, 3] - cut[i, 1])
        inside = frame.labels.boxes_xyxy[i] - cut[i]
        assert float(inside[:2].min()) > -slack, tracked
        assert float(inside[2:].max()) < slack, tracked


def test_photographs_are_good_jpegs(tmp_path: Path, make_shot: MakeShot) -> None:
    shot = make_shot()
    smooth = cv2.GaussianBlur(shot.image, (0, 0), 3)
    writer = Vkitti2Writer(tmp_path)
    writer.finish([writer.write(place(), replace(shot, image=smooth))])
    photograph = Vkitti2Dataset(tmp_path).frame(FIRST).photograph.permute(1, 2, 0).numpy() * 255
    assert np.abs(photograph - smooth).mean() < 2


@pytest.fixture(scope="module")
def street() -> Exposure:
    return expose(generate_frame(3, 0, settings=SynthSettings(camera="vkitti1")))


MOVES: dict[str, Callable[[Path], Any]] = {
    "prefixed": lambda f: split_by_modality(f, "vkitti_2.0.3_{}"),
    "prefixed-archive-name": lambda f: split_by_modality(f, "vkitti_2.0.3_{}.tar"),
    "upper-case-prefix": lambda f: split_by_modality(f, "VKITTI_2.0.3_{}"),
    "only-text-prefixed": lambda f: split_by_modality(f, "vkitti_2.0.3_{}", ("textgt",)),
    "lower-case": lambda f: [
        p.rename(p.with_name(p.name.lower())) for p in list(f.glob("Scene*/*/frames/*Segmentation"))
    ],
    "prefixed-lower-case": lambda f: (MOVES["lower-case"](f), MOVES["prefixed"](f)),
    "capital-rgb": lambda f: [p.rename(p.with_name("RGB")) for p in list(f.glob("Scene*/*/frames/rgb"))],
    "other-files": lambda f: [
        (f / "Scene01" / "README.txt").write_text("x"),
        (f / "Scene01/clone/frames/rgb/Camera_0/Thumbs.db").write_text("x"),
        (f / "Scene01/clone/frames/rgb/notes.txt").write_text("x"),
        (f / "vkitti_2.0.3_md5_checksums.txt").write_text("x"),
    ],
    "png-photographs": lambda f: [
        (cv2.imwrite(str(p.with_suffix(".png")), cv2.imread(str(p))), p.unlink())  # pyright: ignore
        for p in list(f.glob("Scene*/*/frames/rgb/Camera_0/*.jpg"))
    ],
}


def split_by_modality(root: Path, pattern: str, only: tuple[str, ...] = ()) -> None:
    """As the archives unpack: one folder a download, each with its own scenes."""
    for clip in [c for c in root.glob("Scene*/*") if c.is_dir()]:
        for path in [*clip.glob("frames/*"), *clip.glob("*.txt")]:
            modality = "textgt" if path.suffix == ".txt" else path.name
            if only and modality not in only:
                continue
            target = root / pattern.format(modality) / path.relative_to(root)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.rename(target)
    if not only:
        for scene in root.glob("Scene*"):
            shutil.rmtree(scene)


@pytest.mark.parametrize("variant", MOVES)
def test_every_variant_of_the_folders_is_read(variant: str, folder: Path, make_shot: MakeShot) -> None:
    before = Vkitti2Dataset(folder).identifiers
    MOVES[variant](folder)
    dataset = Vkitti2Dataset(folder)
    assert dataset.identifiers == before
    check_frame(dataset.frame(FIRST), make_shot())


@pytest.mark.parametrize("gone", ["depth", "classSegmentation", "instanceSegmentation"])
def test_what_was_not_downloaded_is_none(gone: str, folder: Path) -> None:
    shutil.rmtree(folder / "Scene01" / "clone" / "frames" / gone)
    if gone == "classSegmentation":
        (folder / "Scene01" / "clone" / "colors.txt").unlink()
    frame = Vkitti2Dataset(folder).frame(FIRST)
    assert (frame.depth is None) == (gone == "depth")
    assert (frame.classes is None) == (gone == "classSegmentation")
    assert (frame.class_names == ()) == (gone == "classSegmentation")
    assert (frame.masks is None) == (gone == "instanceSegmentation")


def test_extrinsics_are_not_needed_for_frames(folder: Path) -> None:
    (folder / "Scene01/clone/extrinsic.txt").unlink()
    dataset = Vkitti2Dataset(folder)
    dataset.frame(FIRST)
    with pytest.raises(FormatError, match=r"Scene01/clone/extrinsic\.txt: expected a readable file"):
        dataset.extrinsic(FIRST)


@pytest.mark.parametrize("kind", ["grey", "pillow", "four-bits", "sixteen-bits"])
def test_instance_images_of_other_programs_are_read(kind: str, folder: Path, make_shot: MakeShot) -> None:
    path = folder / "Scene01/clone/frames/instanceSegmentation/Camera_0/instancegt_00000.png"
    values = make_shot().instances.astype(np.uint8)
    if kind == "grey":
        cv2.imwrite(str(path), values)
    elif kind == "sixteen-bits":
        cv2.imwrite(str(path), values.astype(np.uint16))
    else:
        image = Image.fromarray(values).convert("P")
        image.putdata(values.reshape(-1).tolist())
        image.putpalette([7] * 768)
        image.save(path, bits=4 if kind == "four-bits" else 8, transparency=0)
    check_frame(Vkitti2Dataset(folder).frame(FIRST), make_shot())


def test_two_cameras(tmp_path: Path, make_shot: MakeShot) -> None:
    writer = Vkitti2Writer(tmp_path, cameras=2)
    left, right = make_shot(seed=0), make_shot(seed=5)
    first = writer.write(place(), left)
    assert not writer.exists(place())
    second = writer.write(place(), right, camera=1)
    assert writer.exists(place())
    writer.finish([second, first])
    assert Vkitti2Dataset(tmp_path).identifiers == (FIRST,)
    dataset = Vkitti2Dataset(tmp_path, cameras=(0, 1))
    assert dataset.identifiers == (FIRST, "Scene01/clone/Camera_1/00000")
    check_frame(dataset.frame(FIRST), left)
    check_frame(dataset.frame("Scene01/clone/Camera_1/00000"), right)
    assert dataset.frame("Scene01/clone/Camera_1/00000").provenance["camera"] == "1"
    rows = (tmp_path / "Scene01/clone/bbox.txt").read_text().splitlines()[1:]
    assert [r.split()[1] for r in rows] == ["0"] * 4 + ["1"] * 4
    assert len((tmp_path / "Scene01/clone/info.txt").read_text().splitlines()) == 5
    with pytest.raises(RangeError, match="vkitti2 camera: expected 0 to 1, found 2"):
        writer.write(place(), left, camera=2)
    with pytest.raises(RangeError, match="vkitti2 cameras: expected 1 or 2, found 3"):
        Vkitti2Writer(tmp_path, cameras=3)


def test_entries_survive_json_and_any_order(tmp_path: Path, make_shot: MakeShot) -> None:
    entries = []
    writer = pickle.loads(pickle.dumps(Vkitti2Writer(tmp_path / "a")))
    for frame in (0, 1, 10):
        assert not writer.exists(place(frame))
        entries.append(writer.write(place(frame), make_shot(seed=frame)))
        assert writer.exists(place(frame))
    writer.finish(entries)
    other = Vkitti2Writer(tmp_path / "b")
    for frame in (10, 0, 1):
        other.write(place(frame), make_shot(seed=frame))
    other.finish(json.loads(json.dumps(entries[::-1])))
    for path in (p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes(), path
    order = (tmp_path / "a/Scene01/clone/intrinsic.txt").read_text().splitlines()[1:]
    assert [line.split()[0] for line in order] == ["0", "1", "10"]


def test_a_subset_of_variations(folder: Path) -> None:
    assert Vkitti2Dataset(folder, variations=("fog",)).identifiers == ("Scene01/fog/Camera_0/00001",)
    with pytest.raises(RangeError, match=r"variation of .*: expected one of clone, fog, found rain"):
        Vkitti2Dataset(folder, variations=("rain",))
    with pytest.raises(RangeError, match=r"camera of .*: expected one of 0, found 1"):
        Vkitti2Dataset(folder, cameras=(1,))
    with pytest.raises(RangeError, match=r"frame of .*: expected one of 4 identifiers, found '00000'"):
        Vkitti2Dataset(folder).labels("00000")


def test_bad_folders(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="nowhere: expected a Virtual KITTI 2 folder, found no such folder"):
        Vkitti2Dataset(tmp_path / "nowhere")
    with pytest.raises(FormatError, match=r"expected SceneXX/<variation>/frames/rgb/.*, found none"):
        Vkitti2Dataset(tmp_path)
    assert "vkitti2" in DATASETS


def test_columns_are_found_by_name(folder: Path, make_shot: MakeShot) -> None:
    """In another order, and with one more."""
    path = folder / "Scene01/clone/bbox.txt"
    rows = [line.split() for line in path.read_text().splitlines()]
    extra = [[row[0], "note" if i == 0 else "?", *row[:0:-1]] for i, row in enumerate(rows)]
    path.write_text("".join(" ".join(row) + "\n" for row in extra))
    check_frame(Vkitti2Dataset(folder).frame(FIRST), make_shot())


FRAMES = "frames/{}/Camera_0/{}_00000.{}"
PHOTOGRAPH, DEPTH = FRAMES.format("rgb", "rgb", "jpg"), FRAMES.format("depth", "depth", "png")
CLASSES = FRAMES.format("classSegmentation", "classgt", "png")
INSTANCES = FRAMES.format("instanceSegmentation", "instancegt", "png")
COLUMN_FAULTS = (
    ("bbox", "frame", "0.5", r"a whole number, found '0\.5'"),
    ("bbox", "trackID", "-1", "at least 0, found -1"),
    ("bbox", "left", "x", "a whole number, found 'x'"),
    ("bbox", "right", "9", "at least 10, found 9"),
    ("bbox", "bottom", "3", "at least 14, found 3"),
    ("bbox", "number_pixels", "-2", "at least 0, found -2"),
    ("bbox", "truncation_ratio", "1.5", r"a number in \[0, 1\], found 1\.5"),
    ("bbox", "occupancy_ratio", "nan", "a finite number, found nan"),
    ("bbox", "isMoving", "yes", "one of True, False.*'yes'"),
    ("pose", "height", "0", "more than 0, found 0"),
    ("pose", "rotation_camera_space_y", "180", "a num"),
    ("pose", "camera_space_Z", "-9", "a 3D box in front of the camera, found -9 m, behind it"),
    ("pose", "world_space_X", "inf", "a finite number"),
    ("info", "label", "Bus", "one of Car, Van, .*'Bus'"),
    ("intrinsic", "K[1,1]", "-1", "more than 0, found -1"),
    ("colors", "r", "256", r"a number in \[0, 255\], found 256"),
)
"""Table, column, damaged value, error."""
FAULTS: tuple[tuple[Damage, str], ...] = (
    *(
        (set_field(f"{table}.txt", column, value), rf"{table}\.txt:2: {re.escape(column)}: expected {error}")
        for table, column, value, error in COLUMN_FAULTS
    ),
    *(
        (remove(f"{name}.txt"), rf"clone/{name}\.txt: expected a readable file, found no such")
        for name in ("bbox", "pose", "info", "intrinsic", "colors")
    ),
    (
        replace_text("bbox.txt", "number_pixels", "pixels"),
        r"bbox\.txt:1: number_pixels: expected a column of that name, found frame cameraID",
    ),
    (overwrite("pose.txt", b""), r"pose\.txt:1: expected a header 'frame .*found none"),
    (set_field("bbox.txt", "isMoving", ""), r"bbox\.txt:2: expected 11 fields, found 10"),
    (set_field("bbox.txt", "isMoving", "True x"), r"bbox\.txt:2: expected 11 fields, found 12"),
    (replace_text("bbox.txt", "\n2 0 7", "\n2\n0 0 7"), r"bbox\.txt:8: expected 11 fields, found 1"),
    (set_field("bbox.txt", "trackID", "3"), r"bbox\.txt:3: trackID: expected each once in a frame, found 3 twice"),
    (set_field("bbox.txt", "right", "90"), r"rgb_00000\.jpg: expected an image that holds .*90\.0.*found 80x40"),
    (
        set_field("pose.txt", "trackID", "99"),
        r"pose\.txt: expected a row of frame 0 cameraID 0 trackID 0, found none",
    ),
    (
        replace_text("info.txt", "0 Car car000", "1 Car car000"),
        r"info\.txt: expected a row of trackID 0, found none",
    ),
    (replace_text("info.txt", "3 Car", "0 Car"), r"info\.txt:3: expected one row of trackID 0, found 2"),
    (
        set_field("intrinsic.txt", "frame", "7"),
        r"intrinsic\.txt: expected a row of frame 0 cameraID 0, found none",
    ),
    (set_field("intrinsic.txt", "K[0,2]", "70"), r"rgb_00000\.jpg: expected 93 to 280 px wide"),
    (replace_text("colors.txt", "255 127 80", "0 0 0"), r"colors\.txt:16: r g b: expected a unique colour"),
    (replace_text("colors.txt", "Van", "Car"), r"colors\.txt:15: Category: expected each once, found Car twice"),
    (
        replace_text("colors.txt", "100 60 100", "1 2 3"),
        r"classgt_00000\.png: pixel \(\d+, \d+\): expected a colour of colors\.txt, found 100 60 100",
    ),
    (overwrite("colors.txt", b"Category r g b\n"), r"colors\.txt: expected at least one colour, found none"),
    (remove(DEPTH), r"depth_00000\.png: expected a readable file"),
    (write_image(DEPTH, np.zeros((40, 80), np.uint8)), "expected 16 bits and 1 channel, found 8 bits"),
    (write_image(DEPTH, np.zeros((40, 80, 3), np.uint8)), r"depth_00000\.png: expected 1 channel, found 3"),
    (write_image(DEPTH, np.zeros((30, 80), np.uint16)), "depth_0.*: expected 80x40 px, found 80x30 px"),
    (truncate(DEPTH, 900), r"depth_00000\.png: expected a whole PNG, found 900 bytes"),
    (truncate(DEPTH, 0), r"depth_00000\.png: expected a PNG, found 0 bytes"),
    (truncate(INSTANCES, 850), r"instancegt_00000\.png: expected a whole PNG, found 850 bytes, cut in"),
    (truncate(INSTANCES, 33), r"instancegt_00000\.png: expected a whole PNG, found 33 bytes, without an"),
    (
        overwrite(INSTANCES, b"\xff\xd8\xff"),
        r"instancegt_00000\.png: expected a PNG, found 3 bytes of another format",
    ),
    (write_image(INSTANCES, np.zeros((40, 80, 3), np.uint8)), "instancegt.*: expected 1 channel, found 3"),
    (write_image(INSTANCES, np.zeros((40, 81), np.uint8)), "instancegt.*expected 80x40 px, found 81x40"),
    (write_image(CLASSES, np.zeros((40, 81, 3), np.uint8)), "classgt.*expected 80x40 px, found 81x40 px"),
    (write_image(CLASSES, np.zeros((40, 80), np.uint8)), "classgt.*expected 8 bits and 3 channels"),
    (overwrite(PHOTOGRAPH, b"no"), r"rgb_00000\.jpg: expected an image, found 2 bytes"),
)


@pytest.mark.parametrize(("damage", "message"), FAULTS, ids=[message for _, message in FAULTS])
def test_a_fault_is_named_and_other_clips_are_read(damage: Damage, message: str, folder: Path) -> None:
    Vkitti2Dataset(folder).frame(FIRST)
    damage(folder / "Scene01" / "clone")
    dataset = Vkitti2Dataset(folder)
    with pytest.raises(FormatError, match=message) as caught:
        dataset.frame(FIRST)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    dataset.frame("Scene01/fog/Camera_0/00001")


def test_a_faulty_row_leaves_other_frames_alone(folder: Path) -> None:
    set_field("bbox.txt", "left", "x")(folder / "Scene01" / "clone")
    Vkitti2Dataset(folder).frame("Scene01/clone/Camera_0/00002")


BAD_SHOTS: dict[str, tuple[dict[str, Any], type[SceneError], str]] = {
    "class": (
        {"class_names": ("Sky", "Cloud")},
        RangeError,
        r"exposure\.class_names: expected one of Terrain, .*found Cloud",
    ),
    "extrinsic": ({"extrinsic": np.eye(3)}, ShapeError, r"exposure\.extrinsic: expected \(4, 4\)"),
    "extrinsic-row": ({"extrinsic": np.ones((4, 4))}, ShapeError, r"exposure\.extrinsic: .* last row 0 0 0 1"),
    "offset": (
        {"camera": Camera(torch.eye(3), 40, 80, torch.cat([torch.eye(3), torch.ones(3, 1)], dim=1))},
        RangeError,
        r"camera\.projection: expected a fourth column of 0",
    ),
    "skew": (
        {"camera": Camera(torch.tensor([[9.0, 1, 0], [0, 9, 0], [0, 0, 1]]), 40, 80)},
        RangeError,
        r"camera\.intrinsics: expected no skew, found 1\.0",
    ),
    "instances": (
        {"instances": np.full((40, 80), 256, np.uint16)},
        FormatError,
        r"scene 01, clone, frame 4: expected tracks of at most 254.* found 255",
    ),
}


@pytest.mark.parametrize("fault", BAD_SHOTS)
def test_what_the_layout_cannot_hold_is_refused(fault: str, tmp_path: Path, make_shot: MakeShot) -> None:
    changes, kind, message = BAD_SHOTS[fault]
    shot = make_shot()
    writer = Vkitti2Writer(tmp_path)
    with pytest.raises(kind, match=message) as caught:
        writer.write(place(4), replace(shot, **changes))
    assert "\n" not in str(caught.value)
    assert not writer.exists(place(4))


def test_tracks_end_at_254(tmp_path: Path, make_shot: MakeShot, make_object: MakeObject) -> None:
    shot = make_shot()
    writer = Vkitti2Writer(tmp_path)
    instances = np.full_like(shot.instances, 255)

    def with_track(track: int) -> Exposure:
        tracked_objects = (*shot.objects, make_object(track, labelled=False))
        return replace(shot, objects=tracked_objects, instances=instances)

    writer.finish([writer.write(place(), with_track(254))])
    frame = Vkitti2Dataset(tmp_path).frame(FIRST)
    assert frame.masks is not None
    assert bool(frame.masks[-1].all())
    with pytest.raises(FormatError, match=r"tracks of at most 254.* found 255"):
        writer.write(place(), with_track(255))
    with pytest.raises(RangeError, match=r"exposure\.objects: track: expected each once in a frame"):
        writer.write(place(), replace(shot, objects=(*shot.objects, make_object(0, labelled=False))))


def test_entries_that_contradict_each_other_are_refused(
    tmp_path: Path, make_shot: MakeShot, make_object: MakeObject
) -> None:
    writer, shot = Vkitti2Writer(tmp_path), make_shot()
    first = writer.write(place(0), shot)
    with pytest.raises(FormatError, match="scene 01, clone, frame 0, camera 0: expected one entry, found two"):
        writer.finish([first, first])
    tracked_objects = (*shot.objects[1:], make_object(0, "Truck"))
    second = writer.write(place(1), replace(shot, objects=tracked_objects))
    with pytest.raises(
        FormatError, match=r"info\.txt: track 0: expected Car car000 dark_red, as .* found Truck truck000"
    ):
        writer.finish([first, second])


def test_caches_are_bounded(tmp_path: Path, make_shot: MakeShot) -> None:
    writer = Vkitti2Writer(tmp_path)
    writer.finish([writer.write(place(0, "clone", f"{i:02d}"), make_shot()) for i in range(12)])
    dataset = Vkitti2Dataset(tmp_path)
    for identifier in dataset.identifiers:
        dataset.labels(identifier)
    assert len(dataset._tables) == CACHED_TABLES


def test_a_scene_of_a_thousand_frames_opens_fast(tmp_path: Path, make_shot: MakeShot) -> None:
    writer, shot = Vkitti2Writer(tmp_path), make_shot()
    entry = writer.write(place(), shot)
    folder = tmp_path / "Scene01/clone/frames/rgb/Camera_0"
    lists = ("bbox", "pose")
    entries = []
    for i in range(1000):
        (folder / f"rgb_{i:05d}.jpg").touch()
        lines: dict[str, Any] = {
            k: [f"{i} {line.split(' ', 1)[1]}" for line in entry[k]]  # pyright: ignore
            for k in lists
        }
        texts = {k: f"{i} {str(entry[k]).split(' ', 1)[1]}" for k in ("intrinsic", "extrinsic")}
        entries.append({**entry, "frame": i, **lines, **texts})
    writer.finish(entries)
    start = time.process_time()
    dataset = Vkitti2Dataset(tmp_path)
    labels = dataset.labels("Scene01/clone/Camera_0/00999")
    taken = time.process_time() - start
    assert len(dataset) == 1000
    assert len(labels.kind) == 4
    assert taken < 0.5  # about 0.03 s: rows of other frames are not parsed


whole = st.integers(0, 5000)
metres = st.floats(-2000, 2000, width=32)
share = st.floats(0, 1)
angle = st.floats(-3.15, 3.15)
OBJECTS = st.builds(
    TrackedObject,
    track=st.integers(0, 254),
    kind=st.sampled_from(KINDS),
    model=st.text(st.characters(codec="ascii", categories=["L", "N", "P"]), min_size=1, max_size=9),
    paint=st.sampled_from(["red", "Silver", "none"]),
    moving=st.booleans(),
    box_ltrb=st.tuples(whole, whole, st.integers(5000, 9000), st.integers(5000, 9000)),
    pixels=whole,
    truncation=share,
    visible=share,
    occlusion=st.just(0),
    translation=st.tuples(metres, metres, st.floats(1, 900)),
    yaw=angle,
    size_lhw=st.tuples(*[st.floats(0.01, 30)] * 3),
    world=st.tuples(metres, metres, metres),
    world_yxz=st.tuples(angle, angle, angle),
    labelled=st.just(True),
)


def write_rows(clip: Path, bbox: str, pose: str, info: str) -> Vkitti2Dataset:
    """A clip of one frame whose tables have these rows."""
    image = clip / "frames/rgb/Camera_0/rgb_00000.jpg"
    image.parent.mkdir(parents=True, exist_ok=True)
    image.touch()
    for name, header, rows in (
        ("bbox", vkitti2.BBOX, bbox),
        ("pose", vkitti2.POSE, pose),
        ("info", vkitti2.INFO, info),
    ):
        (clip / f"{name}.txt").write_text(f"{header}\n{rows}\n")
    return Vkitti2Dataset(clip.parents[1])


@given(st.lists(OBJECTS, max_size=4, unique_by=lambda t: t.track))
def test_any_objects_come_back(
    tmp_path_factory: pytest.TempPathFactory, tracked_objects: list[TrackedObject]
) -> None:
    dataset = write_rows(
        tmp_path_factory.mktemp("rows") / "Scene01" / "clone",
        "\n".join(vkitti2.format_bbox(0, 0, t) for t in tracked_objects),
        "\n".join(vkitti2.format_pose(0, 0, t) for t in reversed(tracked_objects)),
        "\n".join(f"{t.track} {t.kind} {t.model} {t.paint}" for t in tracked_objects),
    )
    found = dataset.objects(FIRST)
    assert [f.track for f in found] == [t.track for t in tracked_objects]
    for back, tracked in zip(found, tracked_objects, strict=True):
        for name in ("kind", "model", "paint", "moving", "box_ltrb", "pixels", "truncation", "visible"):
            assert getattr(back, name) == getattr(tracked, name), name
        for name in ("translation", "yaw", "size_lhw", "world", "world_yxz"):
            assert getattr(back, name) == pytest.approx(getattr(tracked, name), abs=1e-3), name
        assert back.occlusion == sum(tracked.visible <= step for step in (0.9, 0.5, 0.1))
    assert dataset.labels(FIRST).kind == tuple(t.kind for t in tracked_objects)


WORDS = st.sampled_from(
    ["0", "1", "-1", "7", "0.5", "nan", "inf", "x", "True", "Car", "1e400", "1e300", "9" * 30, "", "9" * 5000]
)


@given(st.lists(WORDS, min_size=8, max_size=13), st.lists(WORDS, min_size=17, max_size=20), st.lists(WORDS))
def test_no_row_is_read_wrongly_or_ends_in_another_error(
    tmp_path_factory: pytest.TempPathFactory, bbox: list[str], pose: list[str], info: list[str]
) -> None:
    clip = tmp_path_factory.mktemp("rows") / "Scene01" / "clone"
    dataset = write_rows(clip, " ".join(["0 0", *bbox]), " ".join(["0 0", *pose]), " ".join(info))
    labels, message = None, "Scene01/clone"
    try:
        labels = dataset.labels(FIRST)
    except FormatError as error:
        message = str(error)
    assert "\n" not in message
    assert "Scene01/clone" in message
    if labels is not None:
        assert bool(torch.isfinite(labels.translation).all())
        assert bool((labels.boxes_xyxy[:, 2:] >= labels.boxes_xyxy[:, :2]).all())
