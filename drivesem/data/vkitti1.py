"""Virtual KITTI 1.3.1: `vkitti_1.3.1_{rgb,depthgt,scenegt}/<world>/<variation>/` and tables, read and written.

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

from drivesem.data import virtual
from drivesem.data.label_table import LabelTable, Written, copy_images
from drivesem.data.pixels import Colours
from drivesem.data.tables import Recent, TableRow, decimal, one_word, text_of
from drivesem.data.truth import Exposure, Place, TrackedObject
from drivesem.data.virtual import KINDS, MATRIX, Segments, Shot, VirtualDataset
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
"""The one camera of the data set; no file says so."""
COLOURS_1: Mapping[str, tuple[int, int, int]] = {**virtual.COLOURS, "GuardRail": (255, 100, 255)}
"""Colours of the categories; those of objects are free."""
_CAMERA_TOLERANCE_PX = 1e-3
"""Rounding; Virtual KITTI 2's focal length, 725.0087 px, is another camera's."""
_HEAVY_TRUNCATION = 0.5
"""Share outside the image from which on truncation counts as heavy: what KITTI still counts as hard."""
_STRIDE = 0x61C885
"""Odd, so that multiples of it are different 24-bit colours; spreads them over the cube (golden ratio)."""
MAX_TRACK = 9999
"""Far above what a world has; up to it no object's colour is a category's (checked by a test)."""
_PREFIX = "vkitti_1.3.1_"
_IMAGE_NAME = re.compile(r"(\d+)\.png$")


def object_colour(track: int) -> tuple[int, int, int]:
    """The colour of one object in the scene image: its own for each track, and none of the categories'."""
    code = (track + 1) * _STRIDE & 0xFFFFFF
    return code >> 16, code >> 8 & 255, code & 255


def format_row(frame: int, thing: TrackedObject) -> str:
    """A row of motgt. What is too small or too hidden to be an object is DontCare. Flags stop at 2."""
    length, height, width = thing.size_lhw
    truncated = 0 if thing.truncation <= 0 else 1 if thing.truncation <= _HEAVY_TRUNCATION else 2
    pose = (width, height, length, *thing.translation, thing.yaw)
    fields = (
        *(frame, thing.track, thing.kind if thing.labelled else "DontCare", truncated, min(thing.occlusion, 2)),
        *(decimal(virtual.alpha(thing)), *thing.box_ltrb, *map(decimal, pose), 0, 0),
        *(repr(float(thing.truncation)), repr(float(thing.visible)), thing.kind, int(thing.moving)),
        *(one_word(thing.model), one_word(thing.paint)),
    )
    return " ".join(map(str, fields))


def _entry(place: Place, things: Sequence[TrackedObject], extrinsic: np.ndarray) -> dict[str, object]:
    """A frame's rows of each table."""
    return {
        "number": place.number,
        "scene": _world(place.scene),
        "variation": place.variation,
        "frame": place.frame,
        "camera": 0,
        "extrinsic": f"{place.frame} {virtual.matrix_text(extrinsic)}",
        "motgt": [format_row(place.frame, thing) for thing in things],
        "tracks": [[thing.track, virtual.category(thing.kind)] for thing in things],
    }


class Vkitti1Writer:
    """Writes frames in the layout of Virtual KITTI 1.3.1. root: the folder that gets vkitti_1.3.1_* folders."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def image(self, place: Place, modality: str) -> Path:
        """The file of one of a place's images."""
        folder = self.root / f"{_PREFIX}{modality}" / _world(place.scene) / place.variation
        return folder / f"{place.frame:05d}.png"

    def exists(self, place: Place) -> bool:
        """Whether the frame's image is there."""
        return self.image(place, "rgb").exists()

    def write(self, place: Place, exposure: Exposure) -> dict[str, object]:
        """Write a frame's images, each atomically, the photograph last -> an entry for `finish`.

        RangeError for what the layout cannot hold: another camera than the data set's, an unknown class, a pixel
        of an object that is not among the exposure's.
        """
        virtual.check_camera(exposure.camera)
        _check_intrinsics(exposure.camera)
        virtual.check_tracks(exposure)
        things = sorted(exposure.objects, key=lambda thing: thing.track)
        for thing in things:
            if thing.track > MAX_TRACK:
                raise RangeError("exposure.objects: track", f"at most {MAX_TRACK}", thing.track)
        colours = np.array([COLOURS_1[virtual.category(name)] for name in exposure.class_names], np.uint8)
        scene = colours[exposure.classes]
        left = exposure.instances > 0
        for thing in things:
            shown = exposure.instances == thing.track + 1
            scene[shown] = object_colour(thing.track)
            left &= ~shown
        if left.any():
            unknown = int(exposure.instances[left][0]) - 1
            raise RangeError("exposure.instances", "tracks of the exposure's objects", unknown)
        entry = _entry(place, things, exposure.extrinsic)
        files.write_png(self.image(place, "depthgt"), exposure.depth_cm)
        files.write_png(self.image(place, "scenegt"), scene)
        files.write_png(self.image(place, "rgb"), exposure.image)
        return entry

    def finish(self, entries: Sequence[Mapping[str, object]]) -> None:
        """Write the tables of every world and variation from the entries of all frames, in any order.

        FormatError where two entries are of one frame, or where a track is of two categories.
        """
        for world, variation, group in virtual.clips_of(entries):
            path = self.root / f"{_PREFIX}scenegt" / f"{world}_{variation}_scenegt_rgb_encoding.txt"
            colours = dict(COLOURS_1)
            for track, kind in virtual.tracks_of(path, group).items():
                colours[f"{kind}:{track}"] = object_colour(track)
            lines = [f"{kind} {r} {g} {b}" for kind, (r, g, b) in colours.items()]
            files.write_text(path, text_of(ENCODING, lines))
        self.write_tables(entries)

    def write_tables(self, entries: Sequence[Mapping[str, object]]) -> int:
        """Write the tables but for the colours; how many."""
        count = 0
        for world, variation, group in virtual.clips_of(entries):
            name = f"{world}_{variation}.txt"
            rows = [line for entry in group for line in cast(list[str], entry["motgt"])]
            files.write_text(self.root / f"{_PREFIX}motgt" / name, text_of(MOTGT, rows))
            poses = [str(entry["extrinsic"]) for entry in group]
            files.write_text(self.root / f"{_PREFIX}extrinsicsgt" / name, text_of(EXTRINSICS, poses))
            count += 2
        return count


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    """Write a table's objects, which all need a 3D box. FormatError."""
    places, changed = virtual.places_of(table, "0001")
    frames, lost, assumed = virtual.objects_in(table)
    writer = Vkitti1Writer(out)
    count = writer.write_tables([_entry(place, frames[place.number], np.eye(4)) for place in places])
    targets = {table.frames[p.number]: writer.image(p, "rgb").with_suffix("") for p in places}
    deep = sum(thing.occlusion > 2 for things in frames for thing in things)
    more = {"occlusion 3 (2 is the most)": deep, "frame names": changed}
    copied = copy_images(targets, images, only=".png")
    return Written.of(count + copied, lost | more | table.lost(virtual.HELD, {}), assumed)


def _world(scene: str) -> str:
    """The data set's name of a scene: 01 is 0001."""
    return scene.zfill(4)


def _check_intrinsics(camera: Camera) -> None:
    found = [float(camera.intrinsics[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]
    wanted = [FOCAL_PX, FOCAL_PX, *CENTRE_PX]
    near = all(abs(a - b) <= _CAMERA_TOLERANCE_PX for a, b in zip(found, wanted, strict=True))
    if not near or (camera.height, camera.width) != SIZE_HW:
        expected = f"Virtual KITTI's camera: {wanted} px at {SIZE_HW[1]}x{SIZE_HW[0]}"
        raise RangeError("exposure.camera", expected, f"{found} px at {camera.width}x{camera.height}")


class Vkitti1Dataset(VirtualDataset):
    """The frames of a Virtual KITTI 1.3.1 folder, named `0001/clone/00003`.

    root: holds `vkitti_1.3.1_rgb` and `vkitti_1.3.1_motgt`; `vkitti_1.3.1_depthgt` and `vkitti_1.3.1_scenegt` are
    used where they are. variations: which to read, None for all. with_dont_care: what the data set calls DontCare
    are objects of their true type, not regions to ignore. Raises FormatError where there is no image, RangeError
    for a variation of which there is none; a frame's own faults are raised by `labels` and `frame`.
    """

    layout = "vkitti1"
    size_hw = SIZE_HW

    def __init__(self, root: Path, variations: Sequence[str] | None = None, with_dont_care: bool = False) -> None:
        root = Path(root)
        self.with_dont_care = with_dont_care
        if not root.is_dir():
            raise FormatError(str(root), "a Virtual KITTI 1.3.1 folder", "no such folder")
        images = root / f"{_PREFIX}rgb"
        if not images.is_dir():
            raise FormatError(str(images), "a folder of images", "no such folder")
        clips = [v for w in sorted(images.iterdir()) if w.is_dir() for v in sorted(w.iterdir()) if v.is_dir()]
        shots = {
            f"{clip.parent.name}/{clip.name}/{match[1]}": Shot(clip.parent.name, clip.name, None, match[1], path)
            for clip in clips
            for path in clip.iterdir()
            if (match := _IMAGE_NAME.match(path.name))
        }
        if not shots:
            raise FormatError(str(images), "<world>/<variation>/NNNNN.png", "none")
        super().__init__(root, shots, None, variations)
        self._encodings = Recent[_Encoding](virtual.CACHED_TABLES)

    def _file(self, shot: Shot, kind: str, ending: str = "") -> Path:
        return self.root / f"{_PREFIX}{kind}" / f"{shot.scene}_{shot.variation}{ending}.txt"

    def _image(self, shot: Shot, modality: str) -> Path | None:
        folder = self.root / f"{_PREFIX}{modality}gt" / shot.scene / shot.variation
        return folder / f"{shot.digits}.png" if folder.is_dir() else None

    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """All that motgt says of the objects in one frame, in file order.

        kind: the true type; labelled: whether it is not DontCare, or these count too. Unknown are the number of
        pixels, which is 0, and poses in world axes, which are NaN. Occlusion is the file's flag; rotations about x
        and z are left out. FormatError naming file, line and field.
        """
        shot = self._entry(identifier)
        columns = MOTGT.split()
        rows = self._table(self._file(shot, "motgt"), columns[:1], columns[1:]).unique("tid", shot.frame)
        things = (_object(track, row) for track, row in rows.items())
        return tuple(replace(thing, labelled=thing.labelled or self.with_dont_care) for thing in things)

    def _extrinsic(self, shot: Shot) -> TableRow:
        return self._table(self._file(shot, "extrinsicsgt"), ("frame",), MATRIX).row(shot.frame)

    def _camera(self, shot: Shot, size_hw: tuple[int, int]) -> Camera:
        (cx, cy), (height, width) = CENTRE_PX, size_hw
        return Camera(torch.tensor([[FOCAL_PX, 0.0, cx], [0.0, FOCAL_PX, cy], [0.0, 0.0, 1.0]]), height, width)

    def _segments(self, shot: Shot, size_hw: tuple[int, int]) -> Segments:
        scene = self._image(shot, "scene")
        if scene is None:
            return Segments(None, None, ())
        encoding = self._encodings.get(self._file(shot, "scenegt", "_scenegt_rgb_encoding"), _Encoding)
        rows = encoding.colours.read(scene, size_hw)
        return Segments(encoding.instance[rows], encoding.category[rows], encoding.names)


class _Encoding:
    """What the colours of the scene images of one clip mean. names: categories; category (N,) int64 into names and
    instance (N,) int64, 0 or track + 1: of each row of `colours`.
    """

    def __init__(self, path: Path) -> None:
        self.colours = Colours(path, "Category(:id)")
        split = [name.partition(":") for name in self.colours.names]
        for name, (_, colon, number) in zip(self.colours.names, split, strict=True):
            if colon and not number.isdecimal():
                raise FormatError(f"{path}: {name}", "a whole number behind the colon", repr(number))
        self.names = tuple(dict.fromkeys(base for base, _, _ in split))
        self.category = np.array([self.names.index(base) for base, _, _ in split], np.int64)
        self.instance = np.array([int(number) + 1 if colon else 0 for _, colon, number in split], np.int64)


def _object(track: int, row: TableRow) -> TrackedObject:
    """One object from its row in motgt."""
    occluded = int(row.word("occluded", ("0", "1", "2")))
    row.word("truncated", ("0", "1", "2"))
    translation, size, yaw = virtual.pose_of(row, ("x3d", "y3d", "z3d"), ("l3d", "h3d", "w3d"), "ry")
    nowhere = (math.nan, math.nan, math.nan)
    return TrackedObject(
        track=track,
        kind=row.word("orig_label", KINDS),
        model=row.word("model"),
        paint=row.word("color"),
        moving=row.word("moving", ("0", "1")) == "1",
        box_ltrb=virtual.box_of(row, "ltrb"),
        pixels=0,
        truncation=row.number("truncr", 0, 1),
        visible=row.number("occupr", 0, 1),
        occlusion=occluded,
        translation=translation,
        yaw=yaw,
        size_lhw=size,
        world=nowhere,
        world_yxz=nowhere,
        labelled=row.word("label", (*KINDS, "DontCare")) != "DontCare",
    )
