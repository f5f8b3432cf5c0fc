"""Virtual KITTI 1.3.1, `vkitti_1.3.1_{rgb,depthgt,scenegt}/<world>/<variation>/` and tables: reader and writer.

Source of the layout: the data set's own text files' headers (Gaidon, Wang, Cabon, Vig 2016). Optical flow is not
read. Errors name the file, the line, the field, what was expected and what was found.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import torch

from drivesem.data import vkitti
from drivesem.data.ground_truth import Exposure, FrameLocation, TrackedObject
from drivesem.data.label_table import LabelTable, WriteSummary, copy_images
from drivesem.data.vkitti import KINDS, MATRIX, PixelLabels, VirtualKittiDataset, VirtualKittiImage
from drivesem.data.vkitti_files import ColourTable, FileCache, TableRow, format_decimal, format_table, to_word
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Camera

MOTGT = (
    "frame tid label truncated occluded alpha l t r b w3d h3d l3d x3d y3d z3d ry rx rz "
    "truncr occupr orig_label moving model color"
)
EXTRINSICS = "frame r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"
ENCODING = "Category(:id) r g b"
FOCAL_PX, CENTRE_PX, SIZE_HW = 725.0, (620.5, 187.0), (375, 1242)
"""The only camera of the data set; no file has it."""
CATEGORY_COLOURS: Mapping[str, tuple[int, int, int]] = {**vkitti.COLOURS, "GuardRail": (255, 100, 255)}
"""Colours of the categories; objects may have any other."""
_CAMERA_TOLERANCE_PX = 1e-3
"""Rounding; Virtual KITTI 2's focal length, 725.0087 px, is another camera's."""
_HEAVY_TRUNCATION = 0.5
"""Share outside the image above which truncation is heavy: KITTI's limit of hard objects."""
_STRIDE = 0x61C885
"""Odd, so that its multiples are different 24-bit colours, spread over the cube (golden ratio)."""
MAX_TRACK = 9999
"""Far above the tracks of a world; up to it no object has a category's colour (checked by a test)."""
_PREFIX = "vkitti_1.3.1_"
_IMAGE_NAME = re.compile(r"(\d+)\.png$")


def object_colour(track: int) -> tuple[int, int, int]:
    """Return an object's colour in the scene image, unique by track and distinct from the categories'."""
    code = (track + 1) * _STRIDE & 0xFFFFFF
    return code >> 16, code >> 8 & 255, code & 255


def format_motgt_row(frame: int, tracked: TrackedObject) -> str:
    """Format a row of motgt. Unlabelled objects are DontCare. Flags are at most 2."""
    length, height, width = tracked.size_lhw
    truncated = 0 if tracked.truncation <= 0 else 1 if tracked.truncation <= _HEAVY_TRUNCATION else 2
    pose = (width, height, length, *tracked.translation, tracked.yaw)
    fields = (
        *(
            frame,
            tracked.track,
            tracked.kind if tracked.labelled else "DontCare",
            truncated,
            min(tracked.occlusion, 2),
        ),
        *(format_decimal(vkitti.observation_angle(tracked)), *tracked.box_ltrb, *map(format_decimal, pose), 0, 0),
        *(repr(float(tracked.truncation)), repr(float(tracked.visible)), tracked.kind, int(tracked.moving)),
        *(to_word(tracked.model), to_word(tracked.paint)),
    )
    return " ".join(map(str, fields))


def _make_entry(
    location: FrameLocation, objects: Sequence[TrackedObject], extrinsic: np.ndarray
) -> dict[str, object]:
    """Make a frame's rows of each table."""
    return {
        "number": location.number,
        "scene": _pad_world(location.scene),
        "variation": location.variation,
        "frame": location.frame,
        "camera": 0,
        "extrinsic": f"{location.frame} {vkitti.format_extrinsic(extrinsic)}",
        "motgt": [format_motgt_row(location.frame, tracked) for tracked in objects],
        "tracks": [[tracked.track, vkitti.written_category(tracked.kind)] for tracked in objects],
    }


class Vkitti1Writer:
    """Writes frames in the layout of Virtual KITTI 1.3.1 to vkitti_1.3.1_* folders under `root`."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def image_path(self, location: FrameLocation, modality: str) -> Path:
        """Return the file of a frame's image of one modality."""
        folder = self.root / f"{_PREFIX}{modality}" / _pad_world(location.scene) / location.variation
        return folder / f"{location.frame:05d}.png"

    def exists(self, location: FrameLocation) -> bool:
        """Whether the frame's image exists."""
        return self.image_path(location, "rgb").exists()

    def write(self, location: FrameLocation, exposure: Exposure) -> dict[str, object]:
        """Write a frame's images, each atomically, the photograph last. Returns its entry for `finish`.

        Raises RangeError for another camera than the data set's, an unknown class, and pixels of an unknown object.
        """
        vkitti.check_camera(exposure.camera)
        _check_intrinsics(exposure.camera)
        vkitti.check_tracks(exposure)
        objects = sorted(exposure.objects, key=lambda tracked: tracked.track)
        for tracked in objects:
            if tracked.track > MAX_TRACK:
                raise RangeError("exposure.objects: track", f"at most {MAX_TRACK}", tracked.track)
        colours = np.array(
            [CATEGORY_COLOURS[vkitti.written_category(name)] for name in exposure.class_names], np.uint8
        )
        scene = colours[exposure.classes]
        unassigned = exposure.instances > 0
        for tracked in objects:
            mask = exposure.instances == tracked.track + 1
            scene[mask] = object_colour(tracked.track)
            unassigned &= ~mask
        if unassigned.any():
            unknown = int(exposure.instances[unassigned][0]) - 1
            raise RangeError("exposure.instances", "tracks of the exposure's objects", unknown)
        entry = _make_entry(location, objects, exposure.extrinsic)
        files.write_png(self.image_path(location, "depthgt"), exposure.depth_cm)
        files.write_png(self.image_path(location, "scenegt"), scene)
        files.write_png(self.image_path(location, "rgb"), exposure.image)
        return entry

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write the tables of every world and variation from the entries of all frames, in any order.

        Raises FormatError for two entries of one frame, and for a track with two categories.
        """
        for world, variation, group in vkitti.group_by_clip(entries):
            path = self.root / f"{_PREFIX}scenegt" / f"{world}_{variation}_scenegt_rgb_encoding.txt"
            colours = dict(CATEGORY_COLOURS)
            for track, kind in vkitti.collect_tracks(path, group).items():
                colours[f"{kind}:{track}"] = object_colour(track)
            lines = [f"{kind} {r} {g} {b}" for kind, (r, g, b) in colours.items()]
            files.write_text(path, format_table(ENCODING, lines))
        self.write_tables(entries)

    def write_tables(self, entries: Sequence[Mapping[str, object]]) -> int:
        """Write the tables except for the colours. Returns their number."""
        count = 0
        for world, variation, group in vkitti.group_by_clip(entries):
            name = f"{world}_{variation}.txt"
            rows = [line for entry in group for line in cast(list[str], entry["motgt"])]
            files.write_text(self.root / f"{_PREFIX}motgt" / name, format_table(MOTGT, rows))
            poses = [str(entry["extrinsic"]) for entry in group]
            files.write_text(self.root / f"{_PREFIX}extrinsicsgt" / name, format_table(EXTRINSICS, poses))
            count += 2
        return count


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table's objects, which all need a 3D box.

    Args:
        table: Labels.
        out: Output folder.
        images: PNG images to copy, by frame identifier.

    Returns:
        Counts of files, lost and assumed values.

    Raises:
        FormatError: An object without a 3D box, or an unknown class.
    """
    locations, changed = vkitti.locate_frames(table, "0001")
    frames, lost, assumed = vkitti.make_tracked_objects(table)
    writer = Vkitti1Writer(out)
    entries = [_make_entry(location, frames[location.number], np.eye(4)) for location in locations]
    count = writer.write_tables(entries)
    targets = {table.frames[p.number]: writer.image_path(p, "rgb").with_suffix("") for p in locations}
    occluded = sum(tracked.occlusion > 2 for objects in frames for tracked in objects)
    more = {"occlusion 3 (2 is the most)": occluded, "frame names": changed}
    copied = copy_images(targets, images, (".png",))
    return WriteSummary.from_counts(
        count + copied, lost | more | table.count_lost(vkitti.supported_fields(table), {}), assumed
    )


def _pad_world(scene: str) -> str:
    """Return the data set's name of a scene: 01 is 0001."""
    return scene.zfill(4)


def _check_intrinsics(camera: Camera) -> None:
    values = [float(camera.intrinsics[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]
    expected_values = [FOCAL_PX, FOCAL_PX, *CENTRE_PX]
    matches = all(abs(a - b) <= _CAMERA_TOLERANCE_PX for a, b in zip(values, expected_values, strict=True))
    if not matches or (camera.height, camera.width) != SIZE_HW:
        expected = f"Virtual KITTI's camera: {expected_values} px at {SIZE_HW[1]}x{SIZE_HW[0]}"
        raise RangeError("exposure.camera", expected, f"{values} px at {camera.width}x{camera.height}")


class Vkitti1Dataset(VirtualKittiDataset):
    """The frames of a Virtual KITTI 1.3.1 folder, named `0001/clone/00003`.

    Args:
        root: Folder with `vkitti_1.3.1_rgb` and `vkitti_1.3.1_motgt`, and optionally `vkitti_1.3.1_depthgt` and
            `vkitti_1.3.1_scenegt`.
        variations: Variations to read; None: all.
        with_dont_care: Read DontCare as objects of their true type, not as regions to ignore.

    Raises:
        FormatError: No image. A frame's own faults are raised by `labels` and `frame` only.
        RangeError: A variation without images.
    """

    layout = "vkitti1"
    size_hw = SIZE_HW
    modalities = ("depth", "scene")

    def __init__(self, root: Path, variations: Sequence[str] | None = None, with_dont_care: bool = False) -> None:
        root = Path(root)
        self.with_dont_care = with_dont_care
        if not root.is_dir():
            raise FormatError(str(root), "a Virtual KITTI 1.3.1 folder", "no such folder")
        image_root = root / f"{_PREFIX}rgb"
        if not image_root.is_dir():
            raise FormatError(str(image_root), "a folder of images", "no such folder")
        clips = [v for w in sorted(image_root.iterdir()) if w.is_dir() for v in sorted(w.iterdir()) if v.is_dir()]
        images = {
            f"{clip.parent.name}/{clip.name}/{match[1]}": VirtualKittiImage(
                clip.parent.name, clip.name, None, match[1], path
            )
            for clip in clips
            for path in clip.iterdir()
            if (match := _IMAGE_NAME.match(path.name))
        }
        if not images:
            raise FormatError(str(image_root), "<world>/<variation>/NNNNN.png", "none")
        super().__init__(root, images, None, variations)
        self._encodings = FileCache[_SceneEncoding](vkitti.CACHED_TABLES)

    def _file(self, image: VirtualKittiImage, kind: str, ending: str = "") -> Path:
        return self.root / f"{_PREFIX}{kind}" / f"{image.scene}_{image.variation}{ending}.txt"

    def _image(self, image: VirtualKittiImage, modality: str) -> Path | None:
        folder = self.root / f"{_PREFIX}{modality}gt" / image.scene / image.variation
        return folder / f"{image.digits}.png" if folder.is_dir() else None

    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """Read the objects of one frame from motgt, in file order.

        `kind` is the true type; `labelled` is False for DontCare, unless these count too. `pixels` is 0 and poses in
        world axes are NaN, since unknown. Occlusion is the file's flag; rotations about x and z are dropped. Raises
        FormatError naming file, line and field.
        """
        image = self._entry(identifier)
        columns = MOTGT.split()
        rows = self._table(self._file(image, "motgt"), columns[:1], columns[1:]).rows_by("tid", image.frame)
        objects = (_parse_object(track, row) for track, row in rows.items())
        return tuple(replace(tracked, labelled=tracked.labelled or self.with_dont_care) for tracked in objects)

    def _extrinsic(self, image: VirtualKittiImage) -> TableRow:
        return self._table(self._file(image, "extrinsicsgt"), ("frame",), MATRIX).row(image.frame)

    def _camera(self, image: VirtualKittiImage, size_hw: tuple[int, int]) -> Camera:
        (cx, cy), (height, width) = CENTRE_PX, size_hw
        return Camera(torch.tensor([[FOCAL_PX, 0.0, cx], [0.0, FOCAL_PX, cy], [0.0, 0.0, 1.0]]), height, width)

    def _table_files(self, image: VirtualKittiImage) -> list[Path]:
        encoding = self._file(image, "scenegt", "_scenegt_rgb_encoding")
        return [self._file(image, "motgt"), self._file(image, "extrinsicsgt"), encoding]

    def _segments(self, image: VirtualKittiImage, size_hw: tuple[int, int]) -> PixelLabels:
        scene = self._image(image, "scene")
        if scene is None:
            return PixelLabels(None, None, ())
        encoding = self._encodings.get(self._file(image, "scenegt", "_scenegt_rgb_encoding"), _SceneEncoding)
        rows = encoding.colours.read(scene, size_hw)
        return PixelLabels(encoding.instance[rows], encoding.category[rows], encoding.names)


class _SceneEncoding:
    """Meaning of the colours in one clip's scene images.

    `names` are the categories. Each row of `colours` has a `category` (N,) int64, an index into `names`, and an
    `instance` (N,) int64, 0 or track + 1.
    """

    def __init__(self, path: Path) -> None:
        self.colours = ColourTable(path, "Category(:id)")
        split = [name.partition(":") for name in self.colours.names]
        for name, (_, colon, number) in zip(self.colours.names, split, strict=True):
            if colon and not number.isdecimal():
                raise FormatError(f"{path}: {name}", "a whole number after the colon", repr(number))
        self.names = tuple(dict.fromkeys(base for base, _, _ in split))
        self.category = np.array([self.names.index(base) for base, _, _ in split], np.int64)
        self.instance = np.array([int(number) + 1 if colon else 0 for _, colon, number in split], np.int64)


def _parse_object(track: int, row: TableRow) -> TrackedObject:
    """Parse an object from its row in motgt."""
    occluded = int(row.word("occluded", ("0", "1", "2")))
    row.word("truncated", ("0", "1", "2"))
    translation, size, yaw = vkitti.parse_pose(row, ("x3d", "y3d", "z3d"), ("l3d", "h3d", "w3d"), "ry")
    unknown = (math.nan, math.nan, math.nan)
    return TrackedObject(
        track=track,
        kind=row.word("orig_label", KINDS),
        model=row.word("model"),
        paint=row.word("color"),
        moving=row.word("moving", ("0", "1")) == "1",
        box_ltrb=vkitti.parse_box(row, "ltrb"),
        pixels=0,
        truncation=row.number("truncr", 0, 1),
        visible=row.number("occupr", 0, 1),
        occlusion=occluded,
        translation=translation,
        yaw=yaw,
        size_lhw=size,
        world=unknown,
        world_yxz=unknown,
        labelled=row.word("label", (*KINDS, "DontCare")) != "DontCare",
    )
