"""Virtual KITTI 2 (2.0.3), `SceneXX/<variation>/frames/{rgb,depth,...}/Camera_N/` and tables: reader and writer.

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

from drivesem.data import vkitti
from drivesem.data.ground_truth import Exposure, FrameLocation, TrackedObject, occlusion_from_visible
from drivesem.data.label_table import LabelTable, WriteSummary, copy_images, parse_camera_entry
from drivesem.data.vkitti import COLOURS, KINDS, PixelLabels, VirtualKittiDataset, VirtualKittiImage
from drivesem.data.vkitti_files import (
    ColourTable,
    FileCache,
    TableRow,
    TextTable,
    format_decimal,
    format_table,
    read_indices,
    to_word,
    write_indices,
)
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
"""The instance image holds track + 1 in 8 bits."""
_JPEG_QUALITY = 95
_IMAGE_NAME = re.compile(r"rgb_(\d+)\.(jpg|jpeg|png)$")
_OWN_INTRINSIC = (725.0087, 725.0087, 620.5, 187.0)
"""fx, fy, cx, cy px of the data set's camera, for tables without cameras."""
_MODALITIES = {
    "rgb": ("rgb", "rgb"),
    "depth": ("depth", "depth"),
    "classes": ("classSegmentation", "classgt"),
    "instances": ("instanceSegmentation", "instancegt"),
}
"""Folder under `frames` and prefix of the file names."""


def format_bbox(frame: int, camera: int, tracked: TrackedObject) -> str:
    """Format a row of bbox.txt; shares read back to the last bit.

    Args:
        frame: Number of the frame.
        camera: Number of the camera.
        tracked: Object.

    Returns:
        The row.
    """
    left, top, right, bottom = tracked.box_ltrb
    shares = (repr(float(tracked.truncation)), repr(float(tracked.visible)))
    integers = (frame, camera, tracked.track, left, right, top, bottom, tracked.pixels)
    return " ".join(map(str, (*integers, *shares, bool(tracked.moving))))


def format_pose(frame: int, camera: int, tracked: TrackedObject) -> str:
    """Format a row of pose.txt; in camera axes, rotations about x and z are 0.

    Args:
        frame: Number of the frame.
        camera: Number of the camera.
        tracked: Object.

    Returns:
        The row.
    """
    length, height, width = tracked.size_lhw
    numbers = (vkitti.observation_angle(tracked), width, height, length, *tracked.world, *tracked.world_yxz)
    numbers += (*tracked.translation, tracked.yaw)
    return " ".join([str(frame), str(camera), str(tracked.track), *map(format_decimal, numbers), "0", "0"])


def _make_entry(
    location: FrameLocation,
    camera: int,
    objects: Sequence[TrackedObject],
    intrinsic: Sequence[float],
    extrinsic: np.ndarray,
) -> dict[str, object]:
    """Make a frame's rows of each table. `intrinsic` is fx, fy, cx, cy px."""
    frame = location.frame
    return {
        "number": location.number,
        "scene": location.scene,
        "variation": location.variation,
        "frame": frame,
        "camera": camera,
        "intrinsic": " ".join([str(frame), str(camera), *(format_decimal(float(v)) for v in intrinsic)]),
        "extrinsic": f"{frame} {camera} {vkitti.format_extrinsic(extrinsic)}",
        "bbox": [format_bbox(frame, camera, tracked) for tracked in objects],
        "pose": [format_pose(frame, camera, tracked) for tracked in objects],
        "tracks": [[t.track, f"{t.kind} {to_word(t.model)} {to_word(t.paint)}"] for t in objects],
    }


class Vkitti2Writer:
    """Writes frames in the layout of Virtual KITTI 2 to SceneXX folders under `root`, with 1 or 2 cameras."""

    def __init__(self, root: Path, cameras: int = 1) -> None:
        if cameras not in (1, 2):
            raise RangeError("vkitti2 cameras", "1 or 2", cameras)
        self.root = Path(root)
        self.cameras = cameras

    def _clip_folder(self, scene: str, variation: str) -> Path:
        return self.root / f"Scene{scene}" / variation

    def image_path(self, location: FrameLocation, modality: str, camera: int, suffix: str = "png") -> Path:
        """Return the file of an image.

        Args:
            location: Location of the frame.
            modality: Key of `_MODALITIES`.
            camera: Number of the camera.
            suffix: Suffix without dot.

        Returns:
            The path.
        """
        folder, prefix = _MODALITIES[modality]
        frames = self._clip_folder(location.scene, location.variation) / "frames"
        return frames / folder / f"Camera_{camera}" / f"{prefix}_{location.frame:05d}.{suffix}"

    def exists(self, location: FrameLocation) -> bool:
        """Whether the images of all cameras exist."""
        return all(self.image_path(location, "rgb", camera, "jpg").exists() for camera in range(self.cameras))

    def write(self, location: FrameLocation, exposure: Exposure, camera: int = 0) -> dict[str, object]:
        """Write one camera's images of a frame, each atomically, the photograph last.

        Args:
            location: Location of the frame.
            exposure: Image with ground truth.
            camera: Number of the camera.

        Returns:
            Entry for `finish`.

        Raises:
            FormatError: A track above 254.
            RangeError: A camera with offset or skew, or an unknown class.
        """
        if not 0 <= camera < self.cameras:
            raise RangeError("vkitti2 camera", f"0 to {self.cameras - 1}", camera)
        vkitti.check_camera(exposure.camera)
        vkitti.check_tracks(exposure)
        highest = max((int(exposure.instances.max()) - 1, *(tracked.track for tracked in exposure.objects)))
        if highest > MAX_TRACK:
            raise FormatError(
                f"scene {location.scene}, {location.variation}, frame {location.frame}",
                f"tracks of at most {MAX_TRACK}, as an indexed image has 256 values",
                highest,
            )
        colours = np.array([COLOURS[vkitti.written_category(name)] for name in exposure.class_names], np.uint8)
        files.write_png(self.image_path(location, "depth", camera), exposure.depth_cm)
        files.write_png(self.image_path(location, "classes", camera), colours[exposure.classes])
        write_indices(self.image_path(location, "instances", camera), exposure.instances)
        objects = sorted(exposure.objects, key=lambda tracked: tracked.track)
        k = exposure.camera.intrinsics
        focal = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        entry = _make_entry(location, camera, objects, [float(v) for v in focal], exposure.extrinsic)
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        _, data = cv2.imencode(".jpg", exposure.image[..., ::-1], options)
        files.write_bytes(self.image_path(location, "rgb", camera, "jpg"), data.tobytes())
        return entry

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write the tables of every scene and variation from the entries of all its images, in any order.

        Raises FormatError for two entries of one image, and for a track that is not the same object in all frames.
        """
        self.write_tables(entries)
        lines = [f"{name} {r} {g} {b}" for name, (r, g, b) in COLOURS.items()]
        for scene, variation, _ in vkitti.group_by_clip(entries):
            files.write_text(self._clip_folder(scene, variation) / "colors.txt", format_table(COLORS, lines))

    def write_tables(self, entries: Sequence[Mapping[str, object]]) -> int:
        """Write the tables except for the colours. Returns their number."""
        count = 0
        for scene, variation, group in vkitti.group_by_clip(entries):
            clip = self._clip_folder(scene, variation)
            tracks = vkitti.collect_tracks(clip / "info.txt", group)
            tables = {
                "info": (INFO, [f"{track} {text}" for track, text in tracks.items()]),
                "bbox": (BBOX, [line for entry in group for line in cast(list[str], entry["bbox"])]),
                "pose": (POSE, [line for entry in group for line in cast(list[str], entry["pose"])]),
                "intrinsic": (INTRINSIC, [str(entry["intrinsic"]) for entry in group]),
                "extrinsic": (EXTRINSIC, [str(entry["extrinsic"]) for entry in group]),
            }
            for name, (header, lines) in tables.items():
                files.write_text(clip / f"{name}.txt", format_table(header, lines))
            count += len(tables)
        return count


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table's objects, which all need a 3D box.

    Args:
        table: Labels.
        out: Output folder.
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files, lost and assumed values.

    Raises:
        FormatError: An object without a 3D box, or an unknown class.
    """
    locations, changed = vkitti.locate_frames(table, "01")
    frames, lost, assumed = vkitti.make_tracked_objects(table)
    writer = Vkitti2Writer(out)
    offsets: Counter[tuple[str, str]] = Counter()
    entries: list[Mapping[str, object]] = []
    for location in sorted(locations, key=lambda p: p.frame):
        objects, clip = frames[location.number], (location.scene, location.variation)
        if "track" not in table.extra:  # arbitrary tracks must not join objects of different frames
            objects = [replace(tracked, track=tracked.track + offsets[clip]) for tracked in objects]
            offsets[clip] += len(objects)
        focal = _OWN_INTRINSIC
        if location.number in table.cameras:
            focal = parse_camera_entry(table.cameras[location.number])[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        entries.append(_make_entry(location, 0, objects, focal, np.eye(4)))
    count = writer.write_tables(entries)
    targets = {table.frames[p.number]: writer.image_path(p, "rgb", 0, "jpg").with_suffix("") for p in locations}
    shifted = sum(bool(parse_camera_entry(camera)[:, 3].any()) for camera in table.cameras.values())
    supported = (*vkitti.supported_fields(table), "pixels", "world", "world_yxz", "camera")
    more = {"frame names": changed, "camera's offset": shifted}
    without = {"camera": len(table.frames) - len(table.cameras)}
    count += copy_images(targets, images, (".jpg", ".png"))
    return WriteSummary.from_counts(count, lost | more | table.count_lost(supported, {}), assumed | without)


def _find_folder(parent: Path, name: str) -> Path | None:
    """Find the folder `name` in `parent`, in any letter case."""
    if (parent / name).is_dir():
        return parent / name
    if not parent.is_dir():
        return None
    return next((p for p in sorted(parent.iterdir()) if p.name.lower() == name.lower() and p.is_dir()), None)


class Vkitti2Dataset(VirtualKittiDataset):
    """The frames of a Virtual KITTI 2 folder, named `Scene01/clone/Camera_0/00003`.

    Images and tables are required, depth and both segmentations optional.

    Args:
        root: Folder with SceneXX folders, or with a folder for each download (`vkitti_2.0.3_rgb`, ...), or both;
            folders under `frames` may be in any letter case.
        cameras: Cameras to read.
        variations: Variations to read; None: all.

    Raises:
        FormatError: No image. A frame's own faults are raised by `labels` and `frame` only.
        RangeError: A camera or variation without images.
    """

    layout = "vkitti2"
    modalities = tuple(_MODALITIES)

    def __init__(self, root: Path, cameras: Sequence[int] = (0,), variations: Sequence[str] | None = None) -> None:
        root = Path(root)
        if not root.is_dir():
            raise FormatError(str(root), "a Virtual KITTI 2 folder", "no such folder")
        prefixed = sorted(p for p in root.iterdir() if p.name.lower().startswith("vkitti_2") and p.is_dir())
        self._bases = (root, *prefixed)
        images: dict[str, VirtualKittiImage] = {}
        for image in self._scan():
            identifier = f"{image.scene}/{image.variation}/Camera_{image.camera}/{image.digits}"
            images.setdefault(identifier, image)
        if not images:
            raise FormatError(str(root), "SceneXX/<variation>/frames/rgb/Camera_N/rgb_NNNNN.jpg", "none")
        super().__init__(root, images, cameras, variations)
        self._colours = FileCache[ColourTable](vkitti.CACHED_TABLES)

    def _scan(self) -> Iterator[VirtualKittiImage]:
        """Yield every image under every base."""
        for base in self._bases:
            clips = [v for s in sorted(base.glob("Scene*")) if s.is_dir() for v in sorted(s.iterdir())]
            for clip in clips:
                rgb = _find_folder(clip / "frames", "rgb")
                for folder in sorted(f for f in rgb.glob("Camera_[0-9]") if f.is_dir()) if rgb else ():
                    camera = int(folder.name.removeprefix("Camera_"))
                    for path in sorted(folder.iterdir()):
                        if match := _IMAGE_NAME.match(path.name):
                            yield VirtualKittiImage(clip.parent.name, clip.name, camera, match[1], path)

    def _table_path(self, image: VirtualKittiImage, name: str) -> Path:
        """Return a table's file; if no folder has it, the first path where it may be."""
        paths = [base / image.scene / image.variation / f"{name}.txt" for base in self._bases]
        return next((path for path in paths if path.is_file()), paths[0])

    def _read_table(self, image: VirtualKittiImage, name: str, header: str, keys: int = 2) -> TextTable:
        columns = list(dict.fromkeys(c for c in header.split() if c not in ("0", "1")))
        return self._table(self._table_path(image, name), columns[:keys], columns[keys:])

    def _image(self, image: VirtualKittiImage, modality: str) -> Path | None:
        name, prefix = _MODALITIES[modality]
        for base in self._bases:
            folder = _find_folder(base / image.scene / image.variation / "frames", name)
            if folder is not None and (folder / f"Camera_{image.camera}").is_dir():
                return folder / f"Camera_{image.camera}" / f"{prefix}_{image.digits}.png"
        return None

    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """Read the objects of one frame, in the order of bbox.txt.

        All are labelled; rotations about x and z in camera axes are dropped. Raises FormatError naming file, line and
        field: a track without a pose or a type, a value out of range, a box that ends before it begins.
        """
        image = self._entry(identifier)
        boxes = self._read_table(image, "bbox", BBOX).rows_by("trackID", image.frame, image.camera or 0)
        poses_table = self._read_table(image, "pose", POSE)
        poses = poses_table.rows_by("trackID", image.frame, image.camera or 0)
        info = self._read_table(image, "info", INFO, 1)
        for track in boxes:
            if track not in poses:
                what = f"a row of frame {image.frame} cameraID {image.camera} trackID {track}"
                raise FormatError(str(poses_table.path), what, "none")
        return tuple(_parse_object(track, box, poses[track], info.row(track)) for track, box in boxes.items())

    def _extrinsic(self, image: VirtualKittiImage) -> TableRow:
        return self._read_table(image, "extrinsic", EXTRINSIC).row(image.frame, image.camera or 0)

    def _table_files(self, image: VirtualKittiImage) -> list[Path]:
        names = ("bbox", "pose", "info", "extrinsic", "intrinsic", "colors")
        return [self._table_path(image, name) for name in names]

    def _segments(self, image: VirtualKittiImage, size_hw: tuple[int, int]) -> PixelLabels:
        instances, classes = (self._image(image, modality) for modality in ("instances", "classes"))
        tracks = None if instances is None else read_indices(instances, size_hw)
        if classes is None:
            return PixelLabels(tracks, None, ())
        colours = self._colours.get(self._table_path(image, "colors"), lambda path: ColourTable(path, "Category"))
        return PixelLabels(tracks, colours.read(classes, size_hw), colours.names)

    def _camera(self, image: VirtualKittiImage, size_hw: tuple[int, int]) -> Camera:
        row = self._read_table(image, "intrinsic", INTRINSIC).row(image.frame, image.camera or 0)
        fx, fy = row.positive("K[0,0]"), row.positive("K[1,1]")
        k = [[fx, 0.0, row.number("K[0,2]")], [0.0, fy, row.number("K[1,2]")], [0.0, 0.0, 1.0]]
        return Camera(torch.tensor(k), *size_hw)


def _parse_object(track: int, box: TableRow, pose: TableRow, info: TableRow) -> TrackedObject:
    """Parse an object from its rows in bbox.txt, pose.txt and info.txt."""
    camera = [f"camera_space_{axis}" for axis in "XYZ"]
    sizes = ("length", "height", "width")
    translation, size, yaw = vkitti.parse_pose(pose, camera, sizes, "rotation_camera_space_y")
    visible = box.number("occupancy_ratio", 0, 1)
    world = [pose.number(f"world_space_{axis}") for axis in "XYZ"]
    turn = [pose.number(f"rotation_world_space_{axis}") for axis in "yxz"]
    return TrackedObject(
        track=track,
        kind=info.word("label", KINDS),
        model=info.word("model"),
        paint=info.word("color"),
        moving=box.word("isMoving", ("True", "False", "1", "0")) in ("True", "1"),
        box_ltrb=vkitti.parse_box(box, ("left", "top", "right", "bottom")),
        pixels=box.integer("number_pixels"),
        truncation=box.number("truncation_ratio", 0, 1),
        visible=visible,
        occlusion=occlusion_from_visible(visible),
        translation=translation,
        yaw=yaw,
        size_lhw=size,
        world=(world[0], world[1], world[2]),
        world_yxz=(turn[0], turn[1], turn[2]),
        labelled=True,
    )
