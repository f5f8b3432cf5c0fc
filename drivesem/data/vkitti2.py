"""Virtual KITTI 2 (2.0.3): `SceneXX/<variation>/frames/{rgb,depth,...}/Camera_N/` and tables, read and written.

Source of the layout: the data set's own text files' headers (Cabon, Murray, Humenberger 2020). Errors name the
file, the line, the field, what was expected and what was found.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch

from drivesem.data import virtual
from drivesem.data.label_table import LabelTable, Written, copy_images, matrix_of
from drivesem.data.pixels import Colours, read_indices, write_indices
from drivesem.data.tables import Recent, Table, TableRow, decimal, one_word, text_of
from drivesem.data.truth import Exposure, Place, TrackedObject, occlusion_of
from drivesem.data.virtual import COLOURS, KINDS, Segments, Shot, VirtualDataset
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Camera

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
MAX_TRACK = 254
"""The instance image holds the track's number plus 1 in 8 bits."""
_JPEG_QUALITY = 95
_IMAGE_NAME = re.compile(r"rgb_(\d+)\.(jpg|jpeg|png)$")
_OWN_INTRINSIC = (725.0087, 725.0087, 620.5, 187.0)
"""fx, fy, cx, cy px of the data set's own camera, where a table knows none."""
_MODALITIES = {
    "rgb": ("rgb", "rgb"),
    "depth": ("depth", "depth"),
    "classes": ("classSegmentation", "classgt"),
    "instances": ("instanceSegmentation", "instancegt"),
}
"""Folder under `frames` and prefix of the file names."""


def format_bbox(frame: int, camera: int, thing: TrackedObject) -> str:
    """A row of bbox.txt. Shares are written so that they come back to the last bit."""
    left, top, right, bottom = thing.box_ltrb
    shares = (repr(float(thing.truncation)), repr(float(thing.visible)))
    fields = (frame, camera, thing.track, left, right, top, bottom, thing.pixels, *shares, bool(thing.moving))
    return " ".join(map(str, fields))


def format_pose(frame: int, camera: int, thing: TrackedObject) -> str:
    """A row of pose.txt. In camera axes objects stand upright: their rotations about x and z are 0."""
    length, height, width = thing.size_lhw
    numbers = (virtual.alpha(thing), width, height, length, *thing.world, *thing.world_yxz)
    numbers += (*thing.translation, thing.yaw)
    return " ".join([str(frame), str(camera), str(thing.track), *map(decimal, numbers), "0", "0"])


def _entry(
    place: Place, camera: int, things: Sequence[TrackedObject], intrinsic: Sequence[float], extrinsic: np.ndarray
) -> dict[str, object]:
    """A frame's rows of each table. intrinsic: fx, fy, cx, cy px."""
    frame = place.frame
    return {
        "number": place.number,
        "scene": place.scene,
        "variation": place.variation,
        "frame": frame,
        "camera": camera,
        "intrinsic": " ".join([str(frame), str(camera), *(decimal(float(v)) for v in intrinsic)]),
        "extrinsic": f"{frame} {camera} {virtual.matrix_text(extrinsic)}",
        "bbox": [format_bbox(frame, camera, thing) for thing in things],
        "pose": [format_pose(frame, camera, thing) for thing in things],
        "tracks": [[t.track, f"{t.kind} {one_word(t.model)} {one_word(t.paint)}"] for t in things],
    }


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

    def image(self, place: Place, modality: str, camera: int, suffix: str = "png") -> Path:
        """The file of one of a place's images."""
        folder, prefix = _MODALITIES[modality]
        frames = self._clip(place.scene, place.variation) / "frames"
        return frames / folder / f"Camera_{camera}" / f"{prefix}_{place.frame:05d}.{suffix}"

    def exists(self, place: Place) -> bool:
        """Whether the frame's images are there, of all cameras."""
        return all(self.image(place, "rgb", camera, "jpg").exists() for camera in range(self.cameras))

    def write(self, place: Place, exposure: Exposure, camera: int = 0) -> dict[str, object]:
        """Write one camera's images of a frame, each atomically, the photograph last -> an entry for `finish`.

        FormatError for a track above 254; RangeError for what the layout cannot hold: a camera's offset or skew,
        an unknown class.
        """
        if not 0 <= camera < self.cameras:
            raise RangeError("vkitti2 camera", f"0 to {self.cameras - 1}", camera)
        virtual.check_camera(exposure.camera)
        virtual.check_tracks(exposure)
        highest = max((int(exposure.instances.max()) - 1, *(thing.track for thing in exposure.objects)))
        if highest > MAX_TRACK:
            raise FormatError(
                f"scene {place.scene}, {place.variation}, frame {place.frame}",
                f"tracks of at most {MAX_TRACK}, as an indexed image has 256 values",
                highest,
            )
        colours = np.array([COLOURS[virtual.category(name)] for name in exposure.class_names], np.uint8)
        files.write_png(self.image(place, "depth", camera), exposure.depth_cm)
        files.write_png(self.image(place, "classes", camera), colours[exposure.classes])
        write_indices(self.image(place, "instances", camera), exposure.instances)
        things = sorted(exposure.objects, key=lambda thing: thing.track)
        k = exposure.camera.intrinsics
        focal = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        entry = _entry(place, camera, things, [float(v) for v in focal], exposure.extrinsic)
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        _, data = cv2.imencode(".jpg", exposure.image[..., ::-1], options)
        files.write_bytes(self.image(place, "rgb", camera, "jpg"), data.tobytes())
        return entry

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write the tables of every scene and variation from the entries of all its images, in any order.

        FormatError where two entries are of one image, or where a track is not the same object in all frames.
        """
        self.write_tables(entries)
        lines = [f"{name} {r} {g} {b}" for name, (r, g, b) in COLOURS.items()]
        for scene, variation, _ in virtual.clips_of(entries):
            files.write_text(self._clip(scene, variation) / "colors.txt", text_of(COLORS, lines))

    def write_tables(self, entries: Sequence[Mapping[str, object]]) -> int:
        """Write the tables but for the colours of classes; how many."""
        count = 0
        for scene, variation, group in virtual.clips_of(entries):
            clip = self._clip(scene, variation)
            tracks = virtual.tracks_of(clip / "info.txt", group)
            tables = {
                "info": (INFO, [f"{track} {text}" for track, text in tracks.items()]),
                "bbox": (BBOX, [line for entry in group for line in cast(list[str], entry["bbox"])]),
                "pose": (POSE, [line for entry in group for line in cast(list[str], entry["pose"])]),
                "intrinsic": (INTRINSIC, [str(entry["intrinsic"]) for entry in group]),
                "extrinsic": (EXTRINSIC, [str(entry["extrinsic"]) for entry in group]),
            }
            for name, (header, lines) in tables.items():
                files.write_text(clip / f"{name}.txt", text_of(header, lines))
            count += len(tables)
        return count


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    """Write a table's objects, which all need a 3D box. FormatError."""
    places, changed = virtual.places_of(table, "01")
    frames, lost, assumed = virtual.objects_in(table)
    writer = Vkitti2Writer(out)
    offsets: Counter[tuple[str, str]] = Counter()
    entries: list[Mapping[str, object]] = []
    for place in sorted(places, key=lambda p: p.frame):
        things, clip = frames[place.number], (place.scene, place.variation)
        if "track" not in table.extra:  # numbers that say nothing must not be one object in two frames
            things = [replace(thing, track=thing.track + offsets[clip]) for thing in things]
            offsets[clip] += len(things)
        focal = _OWN_INTRINSIC
        if place.number in table.cameras:
            focal = matrix_of(table.cameras[place.number])[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        entries.append(_entry(place, 0, things, focal, np.eye(4)))
    count = writer.write_tables(entries)
    targets = {table.frames[p.number]: writer.image(p, "rgb", 0, "jpg").with_suffix("") for p in places}
    shifted = sum(bool(matrix_of(camera)[:, 3].any()) for camera in table.cameras.values())
    held = (*virtual.HELD, "pixels", "world", "world_yxz", "camera")
    more = {"frame names": changed, "camera's offset": shifted}
    without = {"camera": len(table.frames) - len(table.cameras)}
    copied = copy_images(targets, images)
    return Written.of(count + copied, lost | more | table.lost(held, {}), assumed | without)


def _child(parent: Path, name: str) -> Path | None:
    """The folder `name` in `parent`, in any letter case."""
    if (parent / name).is_dir():
        return parent / name
    if not parent.is_dir():
        return None
    return next((p for p in sorted(parent.iterdir()) if p.name.lower() == name.lower() and p.is_dir()), None)


class Vkitti2Dataset(VirtualDataset):
    """The frames of a Virtual KITTI 2 folder, named `Scene01/clone/Camera_0/00003`.

    root: holds SceneXX folders, or one folder a download (`vkitti_2.0.3_rgb`, ...) that do, or both; folders
    under `frames` may be in any letter case. Images and tables are needed, depth and both segmentations are used
    where they are. cameras: which to read; variations: which to read, None for all. Raises FormatError where there
    is no image, RangeError for a camera or variation of which there is none; a frame's own faults are raised by
    `labels` and `frame`.
    """

    layout = "vkitti2"

    def __init__(self, root: Path, cameras: Sequence[int] = (0,), variations: Sequence[str] | None = None) -> None:
        root = Path(root)
        if not root.is_dir():
            raise FormatError(str(root), "a Virtual KITTI 2 folder", "no such folder")
        prefixed = sorted(p for p in root.iterdir() if p.name.lower().startswith("vkitti_2") and p.is_dir())
        self._bases = (root, *prefixed)
        shots: dict[str, Shot] = {}
        for shot in self._scan():
            identifier = f"{shot.scene}/{shot.variation}/Camera_{shot.camera}/{shot.digits}"
            shots.setdefault(identifier, shot)
        if not shots:
            raise FormatError(str(root), "SceneXX/<variation>/frames/rgb/Camera_N/rgb_NNNNN.jpg", "none")
        super().__init__(root, shots, cameras, variations)
        self._colours = Recent[Colours](virtual.CACHED_TABLES)

    def _scan(self) -> Iterator[Shot]:
        """Every image under every base."""
        for base in self._bases:
            clips = [v for s in sorted(base.glob("Scene*")) if s.is_dir() for v in sorted(s.iterdir())]
            for clip in clips:
                rgb = _child(clip / "frames", "rgb")
                for folder in sorted(f for f in rgb.glob("Camera_[0-9]") if f.is_dir()) if rgb else ():
                    camera = int(folder.name.removeprefix("Camera_"))
                    for path in sorted(folder.iterdir()):
                        if match := _IMAGE_NAME.match(path.name):
                            yield Shot(clip.parent.name, clip.name, camera, match[1], path)

    def _text(self, shot: Shot, name: str) -> Path:
        """A table's file; where no folder has it, the place where it should be."""
        paths = [base / shot.scene / shot.variation / f"{name}.txt" for base in self._bases]
        return next((path for path in paths if path.is_file()), paths[0])

    def _read(self, shot: Shot, name: str, header: str, keys: int = 2) -> Table:
        columns = list(dict.fromkeys(c for c in header.split() if c not in ("0", "1")))
        return self._table(self._text(shot, name), columns[:keys], columns[keys:])

    def _image(self, shot: Shot, modality: str) -> Path | None:
        name, prefix = _MODALITIES[modality]
        for base in self._bases:
            folder = _child(base / shot.scene / shot.variation / "frames", name)
            if folder is not None and (folder / f"Camera_{shot.camera}").is_dir():
                return folder / f"Camera_{shot.camera}" / f"{prefix}_{shot.digits}.png"
        return None

    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """All that the tables say of the objects in one frame, in the order of bbox.txt.

        All count as labelled; rotations about x and z in camera axes are left out. FormatError naming file, line
        and field: a track without a pose or without a type, a value out of its range, a box that ends before it
        begins.
        """
        shot = self._entry(identifier)
        boxes = self._read(shot, "bbox", BBOX).unique("trackID", shot.frame, shot.camera or 0)
        poses_table = self._read(shot, "pose", POSE)
        poses = poses_table.unique("trackID", shot.frame, shot.camera or 0)
        info = self._read(shot, "info", INFO, 1)
        for track in boxes:
            if track not in poses:
                what = f"a row of frame {shot.frame} cameraID {shot.camera} trackID {track}"
                raise FormatError(str(poses_table.path), what, "none")
        return tuple(_object(track, box, poses[track], info.row(track)) for track, box in boxes.items())

    def _extrinsic(self, shot: Shot) -> TableRow:
        return self._read(shot, "extrinsic", EXTRINSIC).row(shot.frame, shot.camera or 0)

    def _segments(self, shot: Shot, size_hw: tuple[int, int]) -> Segments:
        instances, classes = (self._image(shot, modality) for modality in ("instances", "classes"))
        tracks = None if instances is None else read_indices(instances, size_hw)
        if classes is None:
            return Segments(tracks, None, ())
        colours = self._colours.get(self._text(shot, "colors"), lambda path: Colours(path, "Category"))
        return Segments(tracks, colours.read(classes, size_hw), colours.names)

    def _camera(self, shot: Shot, size_hw: tuple[int, int]) -> Camera:
        row = self._read(shot, "intrinsic", INTRINSIC).row(shot.frame, shot.camera or 0)
        fx, fy = row.positive("K[0,0]"), row.positive("K[1,1]")
        k = [[fx, 0.0, row.number("K[0,2]")], [0.0, fy, row.number("K[1,2]")], [0.0, 0.0, 1.0]]
        return Camera(torch.tensor(k), *size_hw)


def _object(track: int, box: TableRow, pose: TableRow, info: TableRow) -> TrackedObject:
    """One object from its rows in bbox.txt, pose.txt and info.txt."""
    camera = [f"camera_space_{axis}" for axis in "XYZ"]
    sizes = ("length", "height", "width")
    translation, size, yaw = virtual.pose_of(pose, camera, sizes, "rotation_camera_space_y")
    visible = box.number("occupancy_ratio", 0, 1)
    world = [pose.number(f"world_space_{axis}") for axis in "XYZ"]
    turn = [pose.number(f"rotation_world_space_{axis}") for axis in "yxz"]
    return TrackedObject(
        track=track,
        kind=info.word("label", KINDS),
        model=info.word("model"),
        paint=info.word("color"),
        moving=box.word("isMoving", ("True", "False", "1", "0")) in ("True", "1"),
        box_ltrb=virtual.box_of(box, ("left", "top", "right", "bottom")),
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
