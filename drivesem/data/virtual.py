"""What Virtual KITTI 1.3.1 and 2 share: categories and their colours, checks of what is written, objects of frames
and as label tables, and frames of a data set.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from drivesem.data.frames import Frames, as_photograph, check_size, in_front
from drivesem.data.kitti import TYPES
from drivesem.data.label_table import REGION, LabelTable, known_pose
from drivesem.data.pixels import read_depth_m
from drivesem.data.tables import Recent, Table, TableRow, decimal
from drivesem.data.truth import Exposure, Place, TrackedObject
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
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
"""What the writer puts into colors.txt: the data set's own categories and colours. Readers parse the file."""
PEOPLE = ("Pedestrian", "Cyclist")
"""Classes that the data set does not have: their pixels are Misc."""
KINDS = tuple(kind for kind in TYPES if kind != "DontCare")
_MAX_YAW = 2 * math.pi + 0.01
"""As for KITTI: more than a turn is another unit."""
CACHED_TABLES = 16
"""Four clips' worth: a table of a thousand frames takes a few megabytes."""
SHOWN_BY_OCCLUSION = (1.0, 0.7, 0.3, 0.05)
"""Visible shares that Virtual KITTI 2's reader takes for KITTI's codes 0 to 3."""
HELD = (
    *("truncation", "occlusion", "alpha", "3D box", "track", "visible", "model", "paint", "moving", "kind"),
    *("score", "region", "crowd"),  # counted row by row
)
"""What of a table both versions hold."""


# ---- what is written ----


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


def places_of(table: LabelTable, scene: str) -> tuple[list[Place], int]:
    """Where each frame of a table belongs, and how many names had to change. scene: of names that say none."""
    found: list[Place] = []
    changed = 0
    for i, name in enumerate(table.frames):
        parts = name.replace("_", "/").split("/")
        own = parts[0].removeprefix("Scene")
        if len(parts) >= 3 and own.isdecimal() and parts[-1].isdecimal():
            found.append(Place(i, f"{int(own):0{len(scene)}d}", parts[1], int(parts[-1]), ""))
        else:
            found.append(Place(i, scene, "clone", int(name) if name.isdecimal() else i, ""))
            changed += not name.isdecimal()
    if len({(p.scene, p.variation, p.frame) for p in found}) != len(found):
        raise FormatError("frames", "a number of its own for each frame", "two alike")
    return found, changed


def objects_in(table: LabelTable) -> tuple[list[list[TrackedObject]], dict[str, int], dict[str, int]]:
    """The objects of each frame, what is lost and what is assumed. FormatError for objects without a 3D box."""
    table = table.in_edges("xyxy")
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
    for rows in table.by_frame():
        used = {int(tracks[row]) for row in rows if tracks[row] is not None}
        spare = (n for n in range(len(rows) + len(used) + 1) if n not in used)
        shown = [row for row in rows if not (flat[row] or (table.ignore[row] and kinds[row] is None))]
        frames.append([_object_in(table, row, spare, lost, assumed) for row in shown])
        lost["region"] += len(rows) - len(shown)
    return frames, dict(lost), dict(assumed)


def _object_in(
    table: LabelTable, row: int, spare: Iterator[int], lost: Counter[str], assumed: Counter[str]
) -> TrackedObject:
    def told(name: str) -> Any:
        return table.extra[name][row] if name in table.extra else None

    def or_assumed(name: str, value: Callable[[], Any]) -> Any:
        found = told(name)
        assumed[name] += found is None
        return value() if found is None else found

    left, top, right, bottom = np.round(table.boxes[row]).astype(int).tolist()
    lost["fraction of a pixel"] += [left, top, right, bottom] != table.boxes[row].tolist()
    lost["score"] += math.isfinite(table.score[row])
    occlusion, truncation = int(table.occlusion[row]), float(table.truncation[row])
    assumed["truncation"] += truncation < 0
    assumed["occlusion"] += occlusion < 0
    length, height, width, x, y, z, yaw = table.pose[row].tolist()
    region = int(table.kind[row]) == REGION
    world, turn = told("world") or (x, y, z), told("world_yxz") or (yaw, 0.0, 0.0)
    return TrackedObject(
        track=int(or_assumed("track", lambda: next(spare))),
        kind=str(told("kind")) if region else table.kinds[int(table.kind[row])],
        model=str(or_assumed("model", lambda: "unknown")),
        paint=str(or_assumed("paint", lambda: "unknown")),
        moving=bool(or_assumed("moving", lambda: False)),
        box_ltrb=(left, top, right, bottom),
        pixels=int(told("pixels") or 0),
        truncation=max(truncation, 0.0),
        visible=float(or_assumed("visible", lambda: SHOWN_BY_OCCLUSION[min(max(occlusion, 0), 3)])),
        occlusion=max(occlusion, 0),
        translation=(x, y, z),
        yaw=yaw,
        size_lhw=(length, height, width),
        world=(world[0], world[1], world[2]),
        world_yxz=(turn[0], turn[1], turn[2]),
        labelled=not region,
    )


# ---- what is read ----


def table_of(
    frames: Sequence[str], objects: Sequence[Sequence[TrackedObject]], size_wh: tuple[int, int] = (0, 0)
) -> LabelTable:
    """The objects of each frame in columns; what is not labelled is a region. A box whose left is its right is one
    column of pixels.
    """
    things = [thing for of_frame in objects for thing in of_frame]
    kinds = sorted({thing.kind for thing in things if thing.labelled})
    poses = [[*thing.size_lhw, *thing.translation, thing.yaw] for thing in things]
    extra = {name: [getattr(thing, name) for thing in things] for name in _EXTRA}
    in_world = [known_pose(thing.world) for thing in things]
    for name in ("pixels", "world", "world_yxz"):  # which the first version does not know
        values = [getattr(thing, name) for thing in things]
        values = [list(v) if isinstance(v, tuple) else v for v in values]
        extra[name] = [v if known else None for v, known in zip(values, in_world, strict=True)]
    return LabelTable.of(
        frames,
        kinds,
        np.repeat(np.arange(len(frames)), [len(of_frame) for of_frame in objects]),
        [kinds.index(thing.kind) if thing.labelled else REGION for thing in things],
        np.array([thing.box_ltrb for thing in things], float).reshape(-1, 4),
        "xyxy",
        truncation=np.array([thing.truncation for thing in things], float),
        occlusion=np.array([thing.occlusion for thing in things], np.int64),
        pose=np.array(poses, float).reshape(-1, 7),
        sizes_wh=np.tile(np.array(size_wh, np.int64), (len(frames), 1)),
        extra=extra,
    )


_EXTRA = ("track", "visible", "model", "paint", "moving", "kind")


def box_of(row: TableRow, columns: Sequence[str]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom px from columns of these names. FormatError where it ends before it begins."""
    left, top, right, bottom = (row.integer(name) for name in columns)
    for low, high, name in ((left, right, columns[2]), (top, bottom, columns[3])):
        if high < low:
            raise FormatError(f"{row.where}: {name}", f"at least {low}", high)
    return left, top, right, bottom


def pose_of(
    row: TableRow, place: Sequence[str], size_lhw: Sequence[str], yaw: str
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Translation m, size (length, height, width) m and yaw rad from the columns of these names.

    FormatError: a size that is not positive, a yaw beyond a turn, a 3D box wholly behind the camera, which no
    pixel can show.
    """
    x, y, z = (row.number(name) for name in place)
    length, height, width = (row.positive(name) for name in size_lhw)
    angle = row.number(yaw, -_MAX_YAW, _MAX_YAW)
    if not in_front(z, length, width, angle):
        raise FormatError(f"{row.where}: {place[2]}", "a 3D box in front of the camera", f"{z:g} m, behind it")
    return (x, y, z), (length, height, width), angle


@dataclass(frozen=True, slots=True)
class Shot:
    """One image: where it belongs, and its file. digits: its number as the file name has it; camera: None where
    the data set has one only.
    """

    scene: str
    variation: str
    camera: int | None
    digits: str
    path: Path

    @property
    def frame(self) -> int:
        """Its number."""
        return int(self.digits)

    @property
    def order(self) -> tuple[str, str, int, int]:
        """What frames are sorted by."""
        return self.scene, self.variation, self.camera or 0, self.frame


class Segments(NamedTuple):
    """instances (H, W): track plus 1, 0 for none; classes (H, W) int64 into `names`; None without an image."""

    instances: np.ndarray | None
    classes: np.ndarray | None
    names: tuple[str, ...]


class VirtualDataset(Frames[Shot], ABC):
    """The frames of a Virtual KITTI folder, by `identifier`.

    layout: its name; size_hw: of every image, None where images differ. shots: all images; cameras, variations:
    which to read, None for all. RangeError for a camera or a variation of which there is no image.
    """

    layout: str
    size_hw: tuple[int, int] | None = None

    def __init__(
        self,
        root: Path,
        shots: Mapping[str, Shot],
        cameras: Sequence[int] | None,
        variations: Sequence[str] | None,
    ) -> None:
        self.root = root
        for name, asked in (("camera", cameras), ("variation", variations)):
            there = {getattr(shot, name) for shot in shots.values()}
            for value in asked or ():
                if value not in there:
                    expected = f"one of {', '.join(map(str, sorted(there)))}"
                    raise RangeError(f"{name} of {root}", expected, value)
            shots = {n: s for n, s in shots.items() if asked is None or getattr(s, name) in asked}
        super().__init__(root, dict(sorted(shots.items(), key=lambda item: item[1].order)))
        self._tables = Recent[Table](CACHED_TABLES)

    def _table(self, path: Path, key: Sequence[str], columns: Sequence[str]) -> Table:
        return self._tables.get(path, lambda path: Table(path, key, columns))

    @abstractmethod
    def objects(self, identifier: str) -> tuple[TrackedObject, ...]:
        """All that the tables say of the objects in one frame, in file order."""

    @abstractmethod
    def _extrinsic(self, shot: Shot) -> TableRow:
        """The row of a shot's extrinsic matrix."""

    @abstractmethod
    def _camera(self, shot: Shot, size_hw: tuple[int, int]) -> Camera: ...

    @abstractmethod
    def _image(self, shot: Shot, modality: str) -> Path | None:
        """The file of another modality, whether it is there or not; None where its folder is nowhere."""

    @abstractmethod
    def _segments(self, shot: Shot, size_hw: tuple[int, int]) -> Segments:
        """What the images say of each pixel."""

    def image_path(self, identifier: str) -> Path:
        """The file of a frame's photograph. RangeError for a frame that is not there."""
        return self._entry(identifier).path

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame, in file order, what is not labelled as regions; see `objects`."""
        return table_of((identifier,), [self.objects(identifier)]).labels()

    def tracks(self, identifier: str) -> tuple[int, ...]:
        """The track of each label of `labels` that is no region, in its order."""
        return tuple(thing.track for thing in self.objects(identifier) if thing.labelled)

    def clips(self) -> dict[str, tuple[str, ...]]:
        """Frames of each drive by its name: scene, variation, and the camera where there are several."""
        shots = {name: self._entry(name) for name in self.identifiers}
        several = len({shot.camera for shot in shots.values()}) > 1
        found: dict[str, list[str]] = {}
        for name, shot in shots.items():
            clip = f"{shot.scene}/{shot.variation}" + (f"/{shot.camera}" if several else "")
            found.setdefault(clip, []).append(name)
        return {clip: tuple(frames) for clip, frames in found.items()}

    def table(self) -> LabelTable:
        """The labels of all frames."""
        height, width = self.size_hw or (0, 0)
        return table_of(self.identifiers, [self.objects(name) for name in self.identifiers], (width, height))

    def extrinsic(self, identifier: str) -> torch.Tensor:
        """World to camera axes, (4, 4) float64. FormatError."""
        row = self._extrinsic(self._entry(identifier))
        upper = torch.tensor([row.number(name) for name in MATRIX], dtype=torch.float64).reshape(3, 4)
        return torch.cat([upper, upper.new_tensor([[0, 0, 0, 1]])])

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph (3, H, W) float32, camera, labels, masks (M, H, W), depth m, classes with names.

        What has no folder is None. Raises FormatError naming the file and what is wrong with it: missing, not
        decodable, of another size than the photograph or the data set's, a colour that has no name, a box outside.
        """
        shot = self._entry(identifier)
        objects = self.objects(identifier)
        labels = table_of((identifier,), [objects]).labels()
        image = files.read_image(shot.path, self.size_hw)
        size_hw = (image.shape[0], image.shape[1])
        camera = self._camera(shot, size_hw)
        check_size(shot.path, camera, labels)
        labelled = [thing for thing in objects if thing.labelled]
        depth, segments = self._image(shot, "depth"), self._segments(shot, size_hw)
        return Frame(
            identifier=identifier,
            photograph=as_photograph(image),
            camera=camera,
            labels=labels,
            masks=None if segments.instances is None else _masks(segments.instances, labelled),
            depth=None if depth is None else torch.from_numpy(read_depth_m(depth, size_hw)),
            classes=None if segments.classes is None else torch.from_numpy(segments.classes),
            class_names=segments.names,
            provenance={
                "dataset": self.layout,
                "image": shot.path.relative_to(self.root).as_posix(),
                "scene": shot.scene,
                "variation": shot.variation,
                **({} if shot.camera is None else {"camera": str(shot.camera)}),
                "tracks": ",".join(str(thing.track) for thing in labelled),
            },
        )


def _masks(instances: np.ndarray, objects: Sequence[TrackedObject]) -> torch.Tensor:
    """Masks (M, H, W) of 0 and 1, one an object, of an image (H, W) of tracks plus 1."""
    values = np.array([thing.track + 1 for thing in objects], instances.dtype).reshape(-1, 1, 1)
    return torch.from_numpy((instances[None] == values).astype(np.float32))
