"""Common parts of Virtual KITTI 1.3.1 and 2: categories and colours, tracked objects to and from tables, and the
reader of frames.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from drivesem.data.account import DataAccount, account_for_files
from drivesem.data.ground_truth import Exposure, FrameLocation, TrackedObject
from drivesem.data.kitti import TYPES
from drivesem.data.label_table import REGION, WEATHER_VARIATIONS, LabelTable, is_known_pose
from drivesem.data.photographs import FrameIndex, check_image_size, is_in_front
from drivesem.data.vkitti_files import FileCache, TableRow, TextTable, format_decimal, read_depth_m
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

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
"""Categories and colours of the data set, as written to colors.txt. Readers parse the file."""
PEOPLE = ("Pedestrian", "Cyclist")
"""Classes that the data set lacks; their pixels are Misc."""
KINDS = tuple(kind for kind in TYPES if kind != "DontCare")
_MAX_YAW = 2 * math.pi + 0.01
"""As for KITTI; more than a turn means another unit."""
CACHED_TABLES = 16
"""Tables of four clips; a table of a thousand frames takes a few megabytes."""
VISIBLE_BY_OCCLUSION = (1.0, 0.7, 0.3, 0.05)
"""Visible shares that Virtual KITTI 2's reader maps to KITTI's codes 0 to 3."""
_SUPPORTED_FIELDS = (
    *("truncation", "occlusion", "alpha", "3D box", "track", "visible", "model", "paint", "moving", "kind"),
    *("score", "region", "crowd"),  # lost ones are counted row by row
)


def supported_fields(table: LabelTable) -> tuple[str, ...]:
    """Return the fields of a table that both versions hold; its own attributes of frames are in their names."""
    own = table.account is not None and table.account.layout.startswith("vkitti")
    return (*_SUPPORTED_FIELDS, "attributes of frames") if own else _SUPPORTED_FIELDS


def written_category(name: str) -> str:
    """Return Virtual KITTI's category of an exposure's class. Raises RangeError for an unknown class."""
    if name in PEOPLE:
        return "Misc"
    if name not in COLOURS:
        raise RangeError("exposure.class_names", f"one of {', '.join((*COLOURS, *PEOPLE))}", name)
    return name


def observation_angle(tracked: TrackedObject) -> float:
    """Return KITTI's observation angle, rad in [-pi, pi]."""
    x, _, z = tracked.translation
    return math.remainder(tracked.yaw - math.atan2(x, z), 2 * math.pi)


def format_extrinsic(extrinsic: np.ndarray) -> str:
    """Format an extrinsic matrix (4, 4). Raises ShapeError unless its last row is 0 0 0 1."""
    if extrinsic.shape != (4, 4) or not np.array_equal(extrinsic[3], [0, 0, 0, 1]):
        raise ShapeError("exposure.extrinsic", "(4, 4) with the last row 0 0 0 1", extrinsic.tolist())
    return " ".join([*map(format_decimal, extrinsic[:3].reshape(-1)), "0 0 0 1"])


def check_camera(camera: Camera) -> None:
    """Raise RangeError if the camera has skew or an offset, for which Virtual KITTI has no column."""
    matrix = camera.matrix
    if float(matrix[:, 3].abs().max()) > 0:
        raise RangeError("exposure.camera.projection", "a fourth column of 0", matrix[:, 3].tolist())
    if float(camera.intrinsics[0, 1]) != 0:
        raise RangeError("exposure.camera.intrinsics", "no skew", float(camera.intrinsics[0, 1]))


def check_tracks(exposure: Exposure) -> None:
    """Raise RangeError if a track occurs twice in an exposure."""
    tracks = [tracked.track for tracked in exposure.objects]
    if len(set(tracks)) < len(tracks):
        raise RangeError("exposure.objects: track", "each once in a frame", sorted(tracks))


def group_by_clip(
    entries: Sequence[Mapping[str, object]],
) -> Iterator[tuple[str, str, list[Mapping[str, object]]]]:
    """Yield scene, variation and their entries by frame and camera. Raises FormatError for duplicate images."""
    groups: dict[tuple[str, str], list[Mapping[str, object]]] = {}
    for entry in entries:
        groups.setdefault((str(entry["scene"]), str(entry["variation"])), []).append(entry)
    for (scene, variation), group in sorted(groups.items()):
        group.sort(key=_entry_order)
        for first, second in pairwise(group):
            if _entry_order(first) == _entry_order(second):
                where = f"scene {scene}, {variation}, frame {first['frame']}, camera {first['camera']}"
                raise FormatError(where, "one entry", "two")
        yield scene, variation, group


def _entry_order(entry: Mapping[str, object]) -> tuple[int, int]:
    return cast(int, entry["frame"]), cast(int, entry["camera"])


def collect_tracks(path: Path, group: Sequence[Mapping[str, object]]) -> dict[int, str]:
    """Collect the text of each track in a clip, sorted. Raises FormatError if two frames differ."""
    known: dict[int, str] = {}
    for entry in group:
        for track, text in cast(Sequence[tuple[int, str]], entry["tracks"]):
            if known.setdefault(track, text) != text:
                raise FormatError(f"{path}: track {track}", f"{known[track]}, as in earlier frames", text)
    return dict(sorted(known.items()))


def locate_frames(table: LabelTable, scene: str) -> tuple[list[FrameLocation], int]:
    """Return the location of each frame and the number of changed names. `scene` is the default scene."""
    locations: list[FrameLocation] = []
    changed = 0
    for i, name in enumerate(table.file_names()[0]):
        parts = name.replace("_", "/").split("/")
        world = parts[0].removeprefix("Scene")
        if len(parts) >= 3 and world.isdecimal() and parts[-1].isdecimal():
            locations.append(FrameLocation(i, f"{int(world):0{len(scene)}d}", parts[1], int(parts[-1]), ""))
        else:
            locations.append(FrameLocation(i, scene, "clone", int(name) if name.isdecimal() else i, ""))
            changed += not name.isdecimal()
    if len({(p.scene, p.variation, p.frame) for p in locations}) != len(locations):
        raise FormatError("frames", "a unique number for each frame", "two alike")
    return locations, changed


def make_tracked_objects(table: LabelTable) -> tuple[list[list[TrackedObject]], dict[str, int], dict[str, int]]:
    """Return the objects of each frame, and lost and assumed values. Raises FormatError without 3D boxes."""
    table = table.with_box_format("xyxy")
    lost: Counter[str] = Counter()
    assumed: Counter[str] = Counter()
    flat = np.asarray(~np.isfinite(table.pose).all(axis=1))
    without = int((flat & (table.kind != REGION) & ~table.ignore).sum())
    if without:
        raise FormatError("Virtual KITTI: 3D box", "one of every object", f"none of {without} objects")
    bad = sorted({table.kinds[k] for k in np.unique(table.kind[table.kind >= 0]).tolist()} - set(KINDS))
    if bad:
        expected = f"one of {', '.join(KINDS)}, or --map {bad[0]}=TYPE"
        raise FormatError(f"class {bad[0]!r}", expected, bad[0])
    frames: list[list[TrackedObject]] = []
    nothing = [None] * len(table)
    tracks, kinds = (table.extra.get(name, nothing) for name in ("track", "kind"))
    for rows in table.rows_by_frame():
        used = {int(tracks[row]) for row in rows if tracks[row] is not None}
        spare = (n for n in range(len(rows) + len(used) + 1) if n not in used)
        written = [row for row in rows if not (flat[row] or (table.ignore[row] and kinds[row] is None))]
        frames.append([_make_tracked_object(table, row, spare, lost, assumed) for row in written])
        lost["region"] += len(rows) - len(written)
    return frames, dict(lost), dict(assumed)


def _make_tracked_object(
    table: LabelTable, row: int, spare: Iterator[int], lost: Counter[str], assumed: Counter[str]
) -> TrackedObject:
    def extra(name: str) -> Any:
        return table.extra[name][row] if name in table.extra else None

    def or_assumed(name: str, value: Callable[[], Any]) -> Any:
        known = extra(name)
        assumed[name] += known is None
        return value() if known is None else known

    left, top, right, bottom = np.round(table.boxes[row]).astype(int).tolist()
    lost["fraction of a pixel"] += [left, top, right, bottom] != table.boxes[row].tolist()
    lost["score"] += math.isfinite(table.score[row])
    occlusion, truncation = int(table.occlusion[row]), float(table.truncation[row])
    assumed["truncation"] += truncation < 0
    assumed["occlusion"] += occlusion < 0
    length, height, width, x, y, z, yaw = table.pose[row].tolist()
    region = int(table.kind[row]) == REGION
    world, turn = extra("world") or (x, y, z), extra("world_yxz") or (yaw, 0.0, 0.0)
    return TrackedObject(
        track=int(or_assumed("track", lambda: next(spare))),
        kind=str(extra("kind")) if region else table.kinds[int(table.kind[row])],
        model=str(or_assumed("model", lambda: "unknown")),
        paint=str(or_assumed("paint", lambda: "unknown")),
        moving=bool(or_assumed("moving", lambda: False)),
        box_ltrb=(left, top, right, bottom),
        pixels=int(extra("pixels") or 0),
        truncation=max(truncation, 0.0),
        visible=float(or_assumed("visible", lambda: VISIBLE_BY_OCCLUSION[min(max(occlusion, 0), 3)])),
        occlusion=max(occlusion, 0),
        translation=(x, y, z),
        yaw=yaw,
        size_lhw=(length, height, width),
        world=(world[0], world[1], world[2]),
        world_yxz=(turn[0], turn[1], turn[2]),
        labelled=not region,
    )


def objects_to_table(
    frames: Sequence[str], objects: Sequence[Sequence[TrackedObject]], size_wh: tuple[int, int] = (0, 0)
) -> LabelTable:
    """Convert the objects of each frame to a table; unlabelled ones become regions.

    A box with equal left and right is one column of pixels.

    Args:
        frames: Identifiers.
        objects: Objects of each frame.
        size_wh: Width and height of all images, px; 0 if unknown.

    Returns:
        The table.
    """
    tracked = [t for of_frame in objects for t in of_frame]
    kinds = sorted({t.kind for t in tracked if t.labelled})
    poses = [[*t.size_lhw, *t.translation, t.yaw] for t in tracked]
    extra = {name: [getattr(t, name) for t in tracked] for name in _EXTRA}
    in_world = [is_known_pose(t.world) for t in tracked]
    for name in ("pixels", "world", "world_yxz"):  # unknown in the first version
        values = [getattr(t, name) for t in tracked]
        values = [list(v) if isinstance(v, tuple) else v for v in values]
        extra[name] = [v if known else None for v, known in zip(values, in_world, strict=True)]
    return LabelTable.from_columns(
        frames,
        kinds,
        np.repeat(np.arange(len(frames)), [len(of_frame) for of_frame in objects]),
        [kinds.index(t.kind) if t.labelled else REGION for t in tracked],
        np.array([t.box_ltrb for t in tracked], float).reshape(-1, 4),
        "xyxy",
        truncation=np.array([t.truncation for t in tracked], float),
        occlusion=np.array([t.occlusion for t in tracked], np.int64),
        pose=np.array(poses, float).reshape(-1, 7),
        sizes_wh=np.tile(np.array(size_wh, np.int64), (len(frames), 1)),
        extra=extra,
    )


_EXTRA = ("track", "visible", "model", "paint", "moving", "kind")


def parse_box(row: TableRow, columns: Sequence[str]) -> tuple[int, int, int, int]:
    """Parse left, top, right, bottom px from these columns. Raises FormatError if a box ends before it begins."""
    left, top, right, bottom = (row.integer(name) for name in columns)
    for low, high, name in ((left, right, columns[2]), (top, bottom, columns[3])):
        if high < low:
            raise FormatError(f"{row.where}: {name}", f"at least {low}", high)
    return left, top, right, bottom


def parse_pose(
    row: TableRow, position: Sequence[str], size_lhw: Sequence[str], yaw: str
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Parse a 3D box.

    Args:
        row: Row of a table.
        position: Columns of x, y, z.
        size_lhw: Columns of length, height, width.
        yaw: Column of the yaw.

    Returns:
        Translation m, size (length, height, width) m, yaw rad.

    Raises:
        FormatError: A size that is not positive, a yaw beyond a turn, a 3D box wholly behind the camera.
    """
    x, y, z = (row.number(name) for name in position)
    length, height, width = (row.positive(name) for name in size_lhw)
    angle = row.number(yaw, -_MAX_YAW, _MAX_YAW)
    if not is_in_front(z, length, width, angle):
        raise FormatError(f"{row.where}: {position[2]}", "a 3D box in front of the camera", f"{z:g} m, behind it")
    return (x, y, z), (length, height, width), angle


@dataclass(frozen=True, slots=True)
class VirtualKittiImage:
    """One image of a data set."""

    scene: str
    """World, as its folder is named."""
    variation: str
    """Variation, as its folder is named."""
    camera: int | None
    """Number of the camera; None if the data set has only one."""
    digits: str
    """Number of the frame, as in the file name."""
    path: Path
    """Image file."""

    @property
    def frame(self) -> int:
        """Number of the frame."""
        return int(self.digits)

    @property
    def order(self) -> tuple[str, str, int, int]:
        """Sorting key of frames."""
        return self.scene, self.variation, self.camera or 0, self.frame


class PixelLabels(NamedTuple):
    """Segmentation images of a frame."""

    instances: np.ndarray | None
    """Track + 1 (H, W), 0 for none; None without an image."""
    classes: np.ndarray | None
    """Indices (H, W) int64 into `names`; None without an image."""
    names: tuple[str, ...]
    """Names of the classes."""


class VirtualKittiDataset(FrameIndex[VirtualKittiImage], ABC):
    """The frames of a Virtual KITTI folder.

    Args:
        root: The folder.
        images: All images, by identifier.
        cameras: Cameras to read; None: all.
        variations: Variations to read; None: all.

    Raises:
        RangeError: A camera or a variation without images.
    """

    layout: str
    """Name of the layout."""
    size_hw: tuple[int, int] | None = None
    """Height and width of all images, px; None if images differ."""
    modalities: tuple[str, ...] = ()
    """Modalities with an image per frame, besides the photograph."""

    def __init__(
        self,
        root: Path,
        images: Mapping[str, VirtualKittiImage],
        cameras: Sequence[int] | None,
        variations: Sequence[str] | None,
    ) -> None:
        self.root = root
        for name, selection in (("camera", cameras), ("variation", variations)):
            existing = {getattr(image, name) for image in images.values()}
            for value in selection or ():
                if value not in existing:
                    expected = f"one of {', '.join(map(str, sorted(existing)))}"
                    raise RangeError(f"{name} of {root}", expected, value)
            images = {k: v for k, v in images.items() if selection is None or getattr(v, name) in selection}
        super().__init__(root, dict(sorted(images.items(), key=lambda item: item[1].order)))
        self._tables = FileCache[TextTable](CACHED_TABLES)

    def _table(self, path: Path, key: Sequence[str], columns: Sequence[str]) -> TextTable:
        return self._tables.get(path, lambda path: TextTable(path, key, columns))

    @abstractmethod
    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """Read the objects of one frame, in file order."""

    @abstractmethod
    def _extrinsic(self, image: VirtualKittiImage) -> TableRow:
        """Return the row of an image's extrinsic matrix."""

    @abstractmethod
    def _camera(self, image: VirtualKittiImage, size_hw: tuple[int, int]) -> Camera: ...

    @abstractmethod
    def _image(self, image: VirtualKittiImage, modality: str) -> Path | None:
        """Return the file of another modality, which may not exist; None if its folder does not exist."""

    @abstractmethod
    def _table_files(self, image: VirtualKittiImage) -> list[Path]:
        """Return the text files of an image's clip."""

    @abstractmethod
    def _segments(self, image: VirtualKittiImage, size_hw: tuple[int, int]) -> PixelLabels:
        """Read the segmentation images of a frame."""

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Return the variation of a frame, which is its weather unless it turns the camera."""
        variation = self._entry(identifier).variation
        weather = {"weather": variation} if variation in WEATHER_VARIATIONS else {}
        return {"variation": variation, **weather}

    def account(self) -> DataAccount:
        """Account for all files and label rows; reads all labels."""
        images = [self._entry(name) for name in self.identifiers]
        read = [f"{image.path}" for image in images]
        read += [f"{self._image(image, modality)}" for image in images for modality in self.modalities]
        clips = {(image.scene, image.variation): image for image in images}
        read += [f"{path}" for image in clips.values() for path in self._table_files(image)]
        count, skipped = account_for_files(self.root, read)
        table = self.table()
        rows = np.bincount(table.kind[table.kind >= 0], minlength=len(table.kinds)).tolist()
        classes, regions = dict(zip(table.kinds, rows, strict=True)), int((table.kind < 0).sum())
        return DataAccount(self.layout, len(images), count, skipped, classes, regions)

    def image_path(self, identifier: str) -> Path:
        """Return a frame's image file. Raises RangeError for an unknown frame."""
        return self._entry(identifier).path

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame, in file order; unlabelled objects are regions. See `objects`."""
        return objects_to_table((identifier,), [self.objects(identifier)]).to_labels()

    def tracks(self, identifier: str) -> tuple[int, ...]:
        """Return the track of each label that is not a region, in the order of `labels`."""
        return tuple(tracked.track for tracked in self.objects(identifier) if tracked.labelled)

    def clips(self) -> dict[str, tuple[str, ...]]:
        """Return the frames of each drive by its name: scene, variation, and the camera if there are several."""
        images = {name: self._entry(name) for name in self.identifiers}
        several = len({image.camera for image in images.values()}) > 1
        clips: dict[str, list[str]] = {}
        for name, image in images.items():
            clip = f"{image.scene}/{image.variation}" + (f"/{image.camera}" if several else "")
            clips.setdefault(clip, []).append(name)
        return {clip: tuple(frames) for clip, frames in clips.items()}

    def table(self) -> LabelTable:
        """Read the labels of all frames."""
        height, width = self.size_hw or (0, 0)
        objects = [self.objects(name) for name in self.identifiers]
        attributes = {i: self.attributes(name) for i, name in enumerate(self.identifiers)}
        return replace(objects_to_table(self.identifiers, objects, (width, height)), frame_attributes=attributes)

    def extrinsic(self, identifier: str) -> torch.Tensor:
        """Read the matrix from world to camera axes, (4, 4) float64. Raises FormatError."""
        row = self._extrinsic(self._entry(identifier))
        upper = torch.tensor([row.number(name) for name in MATRIX], dtype=torch.float64).reshape(3, 4)
        return torch.cat([upper, upper.new_tensor([[0, 0, 0, 1]])])

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels, masks, depth and classes; modalities without a folder are None.

        Raises FormatError naming the file and the fault: missing, not decodable, of another size than the photograph
        or the data set's, a colour without a name, a box outside the image.
        """
        source = self._entry(identifier)
        objects = self.objects(identifier)
        labels = objects_to_table((identifier,), [objects]).to_labels()
        image = files.read_image(source.path, self.size_hw)
        size_hw = (image.shape[0], image.shape[1])
        camera = self._camera(source, size_hw)
        check_image_size(source.path, camera, labels)
        labelled = [tracked for tracked in objects if tracked.labelled]
        depth, segments = self._image(source, "depth"), self._segments(source, size_hw)
        return Frame(
            identifier=identifier,
            photograph=to_tensor(image),
            camera=camera,
            labels=labels,
            masks=None if segments.instances is None else _masks(segments.instances, labelled),
            depth=None if depth is None else torch.from_numpy(read_depth_m(depth, size_hw)),
            classes=None if segments.classes is None else torch.from_numpy(segments.classes),
            class_names=segments.names,
            provenance={
                "dataset": self.layout,
                "image": source.path.relative_to(self.root).as_posix(),
                "scene": source.scene,
                "variation": source.variation,
                **({} if source.camera is None else {"camera": str(source.camera)}),
                "tracks": ",".join(str(tracked.track) for tracked in labelled),
            },
        )


def _masks(instances: np.ndarray, objects: Sequence[TrackedObject]) -> torch.Tensor:
    """Make masks (M, H, W) of 0 and 1 from an image (H, W) of tracks plus 1."""
    values = np.array([tracked.track + 1 for tracked in objects], instances.dtype).reshape(-1, 1, 1)
    return torch.from_numpy((instances[None] == values).astype(np.float32))
