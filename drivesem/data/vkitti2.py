"""Virtual KITTI 2 (2.0.3): `SceneXX/<variation>/frames/{rgb,depth,...}/Camera_N/` and tables, read and written.

Source of the layout: the data set's own text files' headers (Cabon, Murray, Humenberger 2020). Errors name the
file, the line, the field, what was expected and what was found.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch

from drivesem.data.kitti import NEAR_M, TYPES, check_size
from drivesem.data.pixels import Colours, read_depth_m, read_indices, write_indices
from drivesem.data.tables import Recent, Row, Table, decimal, one_word, text_of
from drivesem.data.truth import Exposure, Place, TrackedObject, occlusion_of
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.types import Camera, Frame, Labels

INFO = "trackID label model color"
BBOX = "frame cameraID trackID left right top bottom number_pixels truncation_ratio occupancy_ratio isMoving"
POSE = (
    "frame cameraID trackID alpha width height length world_space_X world_space_Y world_space_Z "
    "rotation_world_space_y rotation_world_space_x rotation_world_space_z "
    "camera_space_X camera_space_Y camera_space_Z "
    "rotation_camera_space_y rotation_camera_space_x rotation_camera_space_z"
)
INTRINSIC = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"
EXTRINSIC = "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"
COLORS = "Category r g b"
MATRIX = tuple(name for i in "123" for name in (f"r{i},1", f"r{i},2", f"r{i},3", f"t{i}"))
"""Columns of the upper three rows of an extrinsic matrix, world to camera."""

COLOURS: Mapping[str, tuple[int, int, int]] = {
    "Terrain": (210, 0, 200),
    "Sky": (90, 200, 255),
    "Tree": (0, 199, 0),
    "Vegetation": (90, 240, 0),
    "Building": (140, 140, 140),
    "Road": (100, 60, 100),
    "GuardRail": (250, 100, 255),
    "TrafficSign": (255, 255, 0),
    "TrafficLight": (200, 200, 0),
    "Pole": (255, 130, 0),
    "Misc": (80, 80, 80),
    "Truck": (160, 60, 60),
    "Car": (255, 127, 80),
    "Van": (0, 139, 139),
    "Undefined": (0, 0, 0),
}
"""What the writer puts into colors.txt: the data set's own categories and colours. Readers parse the file."""
PEOPLE = ("Pedestrian", "Cyclist")
"""Classes that the data set does not have: their pixels are Misc."""
KINDS = tuple(kind for kind in TYPES if kind != "DontCare")
MAX_TRACK = 254
"""The instance image holds the track's number plus 1 in 8 bits."""
_JPEG_QUALITY = 95
_MAX_YAW = 2 * math.pi + 0.01
"""As for KITTI: more than a turn is another unit."""
CACHED_TABLES = 16
"""Four clips' worth: a table of a thousand frames takes a few megabytes."""
_IMAGE_NAME = re.compile(r"rgb_(\d+)\.(jpg|jpeg|png)$")


def category(name: str) -> str:
    """The category of Virtual KITTI that a class of an exposure is written as. RangeError for an unknown class."""
    if name in PEOPLE:
        return "Misc"
    if name not in COLOURS:
        raise RangeError("exposure.class_names", f"one of {', '.join((*COLOURS, *PEOPLE))}", name)
    return name


def alpha(thing: TrackedObject) -> float:
    """KITTI's observation angle, rad in [-pi, pi]."""
    x, _, z = thing.translation
    return math.remainder(thing.yaw - math.atan2(x, z), 2 * math.pi)


def format_bbox(frame: int, camera: int, thing: TrackedObject) -> str:
    """A row of bbox.txt. Shares are written so that they come back to the last bit."""
    left, top, right, bottom = thing.box_ltrb
    shares = (repr(float(thing.truncation)), repr(float(thing.visible)))
    fields = (frame, camera, thing.track, left, right, top, bottom, thing.pixels, *shares, bool(thing.moving))
    return " ".join(map(str, fields))


def format_pose(frame: int, camera: int, thing: TrackedObject) -> str:
    """A row of pose.txt. In camera axes objects stand upright: their rotations about x and z are 0."""
    length, height, width = thing.size_lhw
    numbers = (alpha(thing), width, height, length, *thing.world, *thing.world_yxz, *thing.translation, thing.yaw)
    return " ".join([str(frame), str(camera), str(thing.track), *map(decimal, numbers), "0", "0"])


def matrix_text(extrinsic: np.ndarray) -> str:
    """The 16 numbers of an extrinsic matrix (4, 4). ShapeError unless its last row is 0 0 0 1."""
    if extrinsic.shape != (4, 4) or not np.array_equal(extrinsic[3], [0, 0, 0, 1]):
        raise ShapeError("exposure.extrinsic", "(4, 4) with the last row 0 0 0 1", extrinsic.tolist())
    return " ".join([*map(decimal, extrinsic[:3].reshape(-1)), "0 0 0 1"])


def check_camera(camera: Camera) -> None:
    """RangeError where the camera has skew or an offset, for which Virtual KITTI has no column."""
    matrix = camera.matrix
    if float(matrix[:, 3].abs().max()) > 0:
        raise RangeError("exposure.camera.projection", "a fourth column of 0", matrix[:, 3].tolist())
    if float(camera.intrinsics[0, 1]) != 0:
        raise RangeError("exposure.camera.intrinsics", "no skew", float(camera.intrinsics[0, 1]))


def check_tracks(exposure: Exposure) -> None:
    """RangeError where an exposure says a track twice."""
    tracks = [thing.track for thing in exposure.objects]
    if len(set(tracks)) < len(tracks):
        raise RangeError("exposure.objects: track", "each once in a frame", sorted(tracks))


def parsed_matrix(row: Row) -> torch.Tensor:
    """The extrinsic matrix (4, 4) float64 of a row."""
    upper = torch.tensor([row.number(name) for name in MATRIX], dtype=torch.float64).reshape(3, 4)
    return torch.cat([upper, upper.new_tensor([[0, 0, 0, 1]])])


def clips_of(entries: Sequence[Mapping[str, object]]) -> Iterator[tuple[str, str, list[Mapping[str, object]]]]:
    """Scene, variation and their entries by frame and camera. FormatError where two entries are of one image."""
    groups: dict[tuple[str, str], list[Mapping[str, object]]] = {}
    for entry in entries:
        groups.setdefault((str(entry["scene"]), str(entry["variation"])), []).append(entry)
    for (scene, variation), group in sorted(groups.items()):
        group.sort(key=_order)
        for one, other in pairwise(group):
            if _order(one) == _order(other):
                where = f"scene {scene}, {variation}, frame {one['frame']}, camera {one['camera']}"
                raise FormatError(where, "one entry", "two")
        yield scene, variation, group


def _order(entry: Mapping[str, object]) -> tuple[int, int]:
    return cast(int, entry["frame"]), cast(int, entry["camera"])


def tracks_of(path: Path, group: Sequence[Mapping[str, object]]) -> dict[int, str]:
    """What the entries of one clip say of each track, sorted. FormatError where two of them differ."""
    known: dict[int, str] = {}
    for entry in group:
        for track, text in cast(Sequence[tuple[int, str]], entry["tracks"]):
            if known.setdefault(track, text) != text:
                raise FormatError(f"{path}: track {track}", f"{known[track]}, as in earlier frames", text)
    return dict(sorted(known.items()))


class Vkitti2Writer:
    """Writes frames in the layout of Virtual KITTI 2.

    root: the folder that gets SceneXX folders. cameras: how many images a place has, 1 or 2.
    """

    def __init__(self, root: Path, cameras: int = 1) -> None:
        if cameras not in (1, 2):
            raise RangeError("vkitti2 cameras", "1 or 2", cameras)
        self.root = Path(root)
        self.cameras = cameras

    def _clip(self, scene: str, variation: str) -> Path:
        return self.root / f"Scene{scene}" / variation

    def _image(self, place: Place, modality: str, camera: int, suffix: str = "png") -> Path:
        folder, prefix = _MODALITIES[modality]
        frames = self._clip(place.scene, place.variation) / "frames"
        return frames / folder / f"Camera_{camera}" / f"{prefix}_{place.frame:05d}.{suffix}"

    def exists(self, place: Place) -> bool:
        """Whether the frame's images are there, of all cameras."""
        return all(self._image(place, "rgb", camera, "jpg").exists() for camera in range(self.cameras))

    def write(self, place: Place, exposure: Exposure, camera: int = 0) -> dict[str, object]:
        """Write one camera's images of a frame, each atomically, the photograph last -> an entry for `finish`.

        FormatError for a track above 254; RangeError for what the layout cannot hold: a camera's offset or skew,
        an unknown class.
        """
        if not 0 <= camera < self.cameras:
            raise RangeError("vkitti2 camera", f"0 to {self.cameras - 1}", camera)
        check_camera(exposure.camera)
        check_tracks(exposure)
        highest = max((int(exposure.instances.max()) - 1, *(thing.track for thing in exposure.objects)))
        if highest > MAX_TRACK:
            raise FormatError(
                f"scene {place.scene}, {place.variation}, frame {place.frame}",
                f"tracks of at most {MAX_TRACK}, as an indexed image has 256 values",
                highest,
            )
        colours = np.array([COLOURS[category(name)] for name in exposure.class_names], np.uint8)
        files.write_png(self._image(place, "depth", camera), exposure.depth_cm)
        files.write_png(self._image(place, "classes", camera), colours[exposure.classes])
        write_indices(self._image(place, "instances", camera), exposure.instances)
        things = sorted(exposure.objects, key=lambda thing: thing.track)
        k = exposure.camera.intrinsics
        focal = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        entry: dict[str, object] = {
            "number": place.number,
            "scene": place.scene,
            "variation": place.variation,
            "frame": place.frame,
            "camera": camera,
            "intrinsic": " ".join([str(place.frame), str(camera), *(decimal(float(v)) for v in focal)]),
            "extrinsic": f"{place.frame} {camera} {matrix_text(exposure.extrinsic)}",
            "bbox": [format_bbox(place.frame, camera, thing) for thing in things],
            "pose": [format_pose(place.frame, camera, thing) for thing in things],
            "tracks": [[t.track, f"{t.kind} {one_word(t.model)} {one_word(t.paint)}"] for t in things],
        }
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        _, data = cv2.imencode(".jpg", exposure.image[..., ::-1], options)
        files.write_bytes(self._image(place, "rgb", camera, "jpg"), data.tobytes())
        return entry

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write the tables of every scene and variation from the entries of all its images, in any order.

        FormatError where two entries are of one image, or where a track is not the same object in all frames.
        """
        for scene, variation, group in clips_of(entries):
            clip = self._clip(scene, variation)
            tracks = tracks_of(clip / "info.txt", group)
            tables = {
                "info": (INFO, [f"{track} {text}" for track, text in tracks.items()]),
                "bbox": (BBOX, [line for entry in group for line in cast(list[str], entry["bbox"])]),
                "pose": (POSE, [line for entry in group for line in cast(list[str], entry["pose"])]),
                "intrinsic": (INTRINSIC, [str(entry["intrinsic"]) for entry in group]),
                "extrinsic": (EXTRINSIC, [str(entry["extrinsic"]) for entry in group]),
                "colors": (COLORS, [f"{name} {r} {g} {b}" for name, (r, g, b) in COLOURS.items()]),
            }
            for name, (header, lines) in tables.items():
                files.write_text(clip / f"{name}.txt", text_of(header, lines))


_MODALITIES = {
    "rgb": ("rgb", "rgb"),
    "depth": ("depth", "depth"),
    "classes": ("classSegmentation", "classgt"),
    "instances": ("instanceSegmentation", "instancegt"),
}
"""Folder under `frames` and prefix of the file names."""


@dataclass(frozen=True, slots=True)
class _Shot:
    """One image: where it belongs, and its file. digits: its number as the file name has it."""

    scene: str
    variation: str
    camera: int
    digits: str
    path: Path

    @property
    def frame(self) -> int:
        return int(self.digits)

    @property
    def identifier(self) -> str:
        return f"{self.scene}/{self.variation}/Camera_{self.camera}/{self.digits}"


def _child(parent: Path, name: str) -> Path | None:
    """The folder `name` in `parent`, in any letter case."""
    if (parent / name).is_dir():
        return parent / name
    if not parent.is_dir():
        return None
    return next((p for p in sorted(parent.iterdir()) if p.name.lower() == name.lower() and p.is_dir()), None)


def labels_of(things: Sequence[TrackedObject]) -> Labels:
    """Labels of all objects, in their order, without regions to ignore. Boxes end at their last column and row."""

    def table(rows: Sequence[Sequence[float]], width: int) -> torch.Tensor:
        return torch.tensor(rows, dtype=torch.float32).reshape(-1, width)

    return Labels(
        kind=tuple(t.kind for t in things),
        boxes_xyxy=table([t.box_ltrb for t in things], 4),
        truncation=torch.tensor([t.truncation for t in things], dtype=torch.float32),
        occlusion=torch.tensor([t.occlusion for t in things], dtype=torch.int64),
        translation=table([t.translation for t in things], 3),
        yaw=torch.tensor([t.yaw for t in things], dtype=torch.float32),
        size_lhw=table([t.size_lhw for t in things], 3),
        ignore_xyxy=torch.zeros(0, 4),
    )


def masks_of(instances: np.ndarray, things: Sequence[TrackedObject]) -> torch.Tensor:
    """Masks (M, H, W) of 0 and 1, one an object, of an image (H, W) of tracks plus 1."""
    values = np.array([t.track + 1 for t in things], instances.dtype).reshape(-1, 1, 1)
    return torch.from_numpy((instances[None] == values).astype(np.float32))


class Vkitti2Dataset:
    """The frames of a Virtual KITTI 2 folder, named `Scene01/clone/Camera_0/00003`.

    root: holds SceneXX folders, or one folder a download (`vkitti_2.0.3_rgb`, ...) that do, or both; folders
    under `frames` may be in any letter case. Images and tables are needed, depth and both segmentations are used
    where they are. cameras: which to read; variations: which to read, None for all. Raises FormatError where there
    is no image, RangeError for a camera or variation of which there is none; a frame's own faults are raised by
    `labels` and `frame`.
    """

    def __init__(self, root: Path, cameras: Sequence[int] = (0,), variations: Sequence[str] | None = None) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise FormatError(str(root), "a Virtual KITTI 2 folder", "no such folder")
        prefixed = sorted(p for p in self.root.iterdir() if p.name.lower().startswith("vkitti_2") and p.is_dir())
        self._bases = (self.root, *prefixed)
        shots: dict[str, _Shot] = {}
        for shot in self._scan():
            shots.setdefault(shot.identifier, shot)
        if not shots:
            raise FormatError(str(root), "SceneXX/<variation>/frames/rgb/Camera_N/rgb_NNNNN.jpg", "none")
        for name, asked, there in (
            ("camera", cameras, {s.camera for s in shots.values()}),
            ("variation", variations or (), {s.variation for s in shots.values()}),
        ):
            for value in asked:
                if value not in there:
                    raise RangeError(f"{name} of {root}", f"one of {', '.join(map(str, sorted(there)))}", value)
        kept = [
            s for s in shots.values() if s.camera in cameras and (variations is None or s.variation in variations)
        ]
        kept.sort(key=lambda s: (s.scene, s.variation, s.camera, s.frame))
        self._shots = {s.identifier: s for s in kept}
        self._tables = Recent[Table](CACHED_TABLES)
        self._colours = Recent[Colours](CACHED_TABLES)

    def _scan(self) -> Iterator[_Shot]:
        """Every image under every base."""
        for base in self._bases:
            clips = [v for s in sorted(base.glob("Scene*")) if s.is_dir() for v in sorted(s.iterdir())]
            for clip in clips:
                rgb = _child(clip / "frames", "rgb")
                for folder in sorted(f for f in rgb.glob("Camera_[0-9]") if f.is_dir()) if rgb else ():
                    camera = int(folder.name.removeprefix("Camera_"))
                    for path in sorted(folder.iterdir()):
                        if match := _IMAGE_NAME.match(path.name):
                            yield _Shot(clip.parent.name, clip.name, camera, match[1], path)

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        return tuple(self._shots)

    def __len__(self) -> int:
        return len(self._shots)

    def _shot(self, identifier: str) -> _Shot:
        if identifier not in self._shots:
            raise RangeError(f"frame of {self.root}", f"one of {len(self)} identifiers", repr(identifier))
        return self._shots[identifier]

    def _text(self, shot: _Shot, name: str) -> Path:
        """A table's file; where no folder has it, the place where it should be."""
        paths = [base / shot.scene / shot.variation / f"{name}.txt" for base in self._bases]
        return next((path for path in paths if path.is_file()), paths[0])

    def _table(self, shot: _Shot, name: str, header: str, keys: int) -> Table:
        columns = list(dict.fromkeys(c for c in header.split() if c not in ("0", "1")))
        return self._tables.get(self._text(shot, name), lambda path: Table(path, columns[:keys], columns[keys:]))

    def _image(self, shot: _Shot, modality: str) -> Path | None:
        """The file of another modality, whether it is there or not; None where its folder is nowhere."""
        name, prefix = _MODALITIES[modality]
        for base in self._bases:
            folder = _child(base / shot.scene / shot.variation / "frames", name)
            if folder is not None and (folder / f"Camera_{shot.camera}").is_dir():
                return folder / f"Camera_{shot.camera}" / f"{prefix}_{shot.digits}.png"
        return None

    def image_path(self, identifier: str) -> Path:
        """The file of a frame's photograph. RangeError for a frame that is not there."""
        return self._shot(identifier).path

    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """All that the tables say of the objects in one frame, in the order of bbox.txt.

        All count as labelled; rotations about x and z in camera axes are left out. FormatError naming file, line
        and field: a track without a pose or without a type, a value out of its range, a box that ends before it
        begins.
        """
        shot = self._shot(identifier)
        key = (shot.frame, shot.camera)
        boxes = self._table(shot, "bbox", BBOX, 2).unique("trackID", *key)
        poses_table = self._table(shot, "pose", POSE, 2)
        poses = poses_table.unique("trackID", *key)
        info = self._table(shot, "info", INFO, 1)
        found = []
        for track, box in boxes.items():
            if track not in poses:
                what = f"a row of frame {shot.frame} cameraID {shot.camera} trackID {track}"
                raise FormatError(str(poses_table.path), what, "none")
            found.append(_object(track, box, poses[track], info.row(track)))
        return tuple(found)

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame, in the order of bbox.txt; see `objects`."""
        return labels_of(self.objects(identifier))

    def extrinsic(self, identifier: str) -> torch.Tensor:
        """World to camera axes, (4, 4) float64. FormatError."""
        shot = self._shot(identifier)
        table = self._table(shot, "extrinsic", EXTRINSIC, 2)
        return parsed_matrix(table.row(shot.frame, shot.camera))

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph (3, H, W) float32, camera, labels, masks (M, H, W), depth m, classes with names.

        What has no folder is None. Raises FormatError naming the file and what is wrong with it: missing, not
        decodable, of another size than the photograph, a colour that colors.txt does not have.
        """
        shot = self._shot(identifier)
        things = self.objects(identifier)
        labels = labels_of(things)
        image = files.read_image(shot.path)
        size = (image.shape[0], image.shape[1])
        camera = self._camera(shot, size)
        check_size(shot.path, camera, labels)
        depth, instances, classes = (self._image(shot, m) for m in ("depth", "instances", "classes"))
        colours = None
        if classes is not None:
            colours = self._colours.get(self._text(shot, "colors"), lambda path: Colours(path, "Category"))
        return Frame(
            identifier=identifier,
            photograph=torch.from_numpy(image).permute(2, 0, 1).contiguous().to(torch.float32) / 255,
            camera=camera,
            labels=labels,
            masks=None if instances is None else masks_of(read_indices(instances, size), things),
            depth=None if depth is None else torch.from_numpy(read_depth_m(depth, size)),
            classes=None if classes is None or colours is None else torch.from_numpy(colours.read(classes, size)),
            class_names=() if colours is None else colours.names,
            provenance={
                "dataset": "vkitti2",
                "image": shot.path.relative_to(self.root).as_posix(),
                "scene": shot.scene,
                "variation": shot.variation,
                "camera": str(shot.camera),
                "tracks": ",".join(str(t.track) for t in things),
            },
        )

    def _camera(self, shot: _Shot, size_hw: tuple[int, int]) -> Camera:
        row = self._table(shot, "intrinsic", INTRINSIC, 2).row(shot.frame, shot.camera)
        fx, fy = row.positive("K[0,0]"), row.positive("K[1,1]")
        k = [[fx, 0.0, row.number("K[0,2]")], [0.0, fy, row.number("K[1,2]")], [0.0, 0.0, 1.0]]
        return Camera(torch.tensor(k), *size_hw)


def pose_of(
    row: Row, place: Sequence[str], size_lhw: Sequence[str], yaw: str
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Translation m, size (length, height, width) m and yaw rad from the columns of these names.

    FormatError: a size that is not positive, a yaw beyond a turn, a 3D box wholly behind the camera, which no
    pixel can show.
    """
    x, y, z = (row.number(name) for name in place)
    length, height, width = (row.positive(name) for name in size_lhw)
    angle = row.number(yaw, -_MAX_YAW, _MAX_YAW)
    if z + 0.5 * (length * abs(math.sin(angle)) + width * abs(math.cos(angle))) <= NEAR_M:
        raise FormatError(f"{row.where}: {place[2]}", "a 3D box in front of the camera", f"{z:g} m, behind it")
    return (x, y, z), (length, height, width), angle


def _object(track: int, box: Row, pose: Row, info: Row) -> TrackedObject:
    """One object from its rows in bbox.txt, pose.txt and info.txt."""
    left, right, top, bottom = (box.integer(c) for c in ("left", "right", "top", "bottom"))
    for low, high, name in ((left, right, "right"), (top, bottom, "bottom")):
        if high < low:
            raise FormatError(f"{box.where}: {name}", f"at least {low}", high)

    camera = [f"camera_space_{axis}" for axis in "XYZ"]
    translation, size, yaw = pose_of(pose, camera, ("length", "height", "width"), "rotation_camera_space_y")
    visible = box.number("occupancy_ratio", 0, 1)
    world = [pose.number(f"world_space_{axis}") for axis in "XYZ"]
    turn = [pose.number(f"rotation_world_space_{axis}") for axis in "yxz"]
    return TrackedObject(
        track=track,
        kind=info.word("label", KINDS),
        model=info.word("model"),
        paint=info.word("color"),
        moving=box.word("isMoving", ("True", "False", "1", "0")) in ("True", "1"),
        box_ltrb=(left, top, right, bottom),
        pixels=box.integer("number_pixels"),
        truncation=box.number("truncation_ratio", 0, 1),
        visible=visible,
        occlusion=occlusion_of(visible),
        translation=translation,
        yaw=yaw,
        size_lhw=size,
        world=(world[0], world[1], world[2]),
        world_yxz=(turn[0], turn[1], turn[2]),
        labelled=True,
    )
