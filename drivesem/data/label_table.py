"""Label tables: labels or detections of many frames in columns, the common form of all layouts' readers and writers.

Values are those of the files, in float64.

**Boxes without area.** A box may end where it begins (left == right): a thin object that fills one column of
pixels, or a detection that was clipped at the image's edge. All layouts read such boxes, and nothing can match them:
such a label is a miss, such a detection a false positive, as in pycocotools and KITTI's development kit; training
ignores them. A box that ends before it begins is an error.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from drivesem.data.account import DataAccount
from drivesem.data.image_headers import copy_upright
from scene_ir.errors import FormatError

if TYPE_CHECKING:  # torch takes a second to load; most readers of label files do not need it
    from torch import Tensor

    from scene_ir.types import Labels

BoxFormat = Literal["xyxy", "xywh"]
"""Box format: left, top, right, bottom with pixel centres at integers (KITTI), or left, top, width, height with
pixel edges at integers (COCO)."""
REGION = -1
"""Kind of a DontCare region, in which detections do not count."""
HALF_PX = 0.5
"""Offset from pixel centres at integers to COCO's pixel edges at integers."""
DECIMALS = 9
"""Decimals of px after a conversion, above the rounding noise of float64."""
UNKNOWN_OCCLUSION = 3
"""Code of an unknown occlusion in KITTI's files and in `Labels`."""
WEATHER_VARIATIONS = ("clone", "fog", "morning", "overcast", "rain", "sunset")
"""Virtual KITTI's variations of weather or time of day; the others turn the camera."""


def xyxy_to_coco(boxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert left, top, right, bottom (..., 4) to COCO's x, y, width, height."""
    low, high = boxes_xyxy[..., :2], boxes_xyxy[..., 2:]
    return np.concatenate([low + HALF_PX, high - low], axis=-1)


def coco_to_xyxy(boxes_xywh: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert COCO's x, y, width, height (..., 4) to left, top, right, bottom."""
    low, size = boxes_xywh[..., :2] - HALF_PX, boxes_xywh[..., 2:]
    return np.concatenate([low, low + size], axis=-1)


@dataclass(frozen=True, slots=True)
class LabelTable:
    """N boxes of F frames, sorted by frame, then in file order."""

    frames: tuple[str, ...]
    """Identifiers of the frames (F,)."""
    kinds: tuple[str, ...]
    """Types that occur or may occur."""
    frame: NDArray[np.int64]
    """Index of each box's frame (N,)."""
    kind: NDArray[np.int64]
    """Index of each box's type (N,); REGION for DontCare."""
    boxes: NDArray[np.float64]
    """Boxes (N, 4) px in `box_format`."""
    box_format: BoxFormat
    """Format of the boxes."""
    ignore: NDArray[np.bool_]
    """Whether a box is a crowd or a region (N,)."""
    score: NDArray[np.float64]
    """Scores (N,); NaN for labels."""
    truncation: NDArray[np.float64]
    """Truncation (N,); -1 where unknown."""
    occlusion: NDArray[np.int64]
    """KITTI's occlusion code (N,), 0 to 3; -1 where unknown."""
    alpha: NDArray[np.float64]
    """Observation angle (N,) rad; NaN where unknown."""
    pose: NDArray[np.float64]
    """Length, height, width, x, y, z m, yaw rad (N, 7); NaN where unknown."""
    area: NDArray[np.float64]
    """Area (N,) px^2; NaN where unknown."""
    sizes_wh: NDArray[np.int64]
    """Width and height of the images (F, 2) px; 0 where unknown."""
    image_ids: NDArray[np.int64] | NDArray[np.str_] | None = None
    """COCO's ids of the images (F,), numbers or texts."""
    box_ids: NDArray[np.int64] | None = None
    """COCO's ids of the boxes (N,)."""
    kind_ids: NDArray[np.int64] | None = None
    """COCO's ids of `kinds`."""
    merged_kind_ids: Mapping[int, int] = field(default_factory=dict)
    """Index of a kind by the id of another COCO category of its name."""
    extra: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    """Further columns (N,) by name; None where a box has no value."""
    cameras: Mapping[int, Any] = field(default_factory=dict)
    """COCO's "camera" entries by frame index."""
    image_files: Mapping[int, str] = field(default_factory=dict)
    """Names of image files, with folders and suffix, by frame index, where they are known."""
    image_paths: Mapping[int, Path] = field(default_factory=dict)
    """Existing image files by frame index."""
    frame_attributes: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    """Further attributes of frames as JSON, by frame index."""
    splits: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Frame indices by split, of data sets that have splits."""
    account: DataAccount | None = None
    """What became of the files and rows of the data set; None for tables that no reader made."""

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def from_columns(
        cls,
        frames: Sequence[str],
        kinds: Sequence[str],
        frame: Sequence[int] | NDArray[np.int64],
        kind: Sequence[int] | NDArray[np.int64],
        boxes: NDArray[np.float64],
        box_format: BoxFormat,
        **columns: Any,
    ) -> LabelTable:
        """Make a table; values that are not given are unknown.

        Args:
            frames: Identifiers (F,).
            kinds: Types.
            frame: Frame index of each box (N,).
            kind: Type index of each box (N,), or REGION.
            boxes: Boxes (N, 4) px.
            box_format: Format of the boxes.
            columns: Other fields of the table.

        Returns:
            The table.
        """
        n = len(boxes)
        kind = np.asarray(kind, np.int64)
        unknown: dict[str, Any] = {
            "ignore": kind == REGION,
            "score": repeat_value(np.nan, n),
            "truncation": repeat_value(-1.0, n),
            "occlusion": repeat_value(-1, n),
            "alpha": repeat_value(np.nan, n),
            "pose": repeat_value(np.nan, n, 7),
            "area": repeat_value(np.nan, n),
            "sizes_wh": np.zeros((len(frames), 2), np.int64),
        }
        frame = np.asarray(frame, np.int64)
        return cls(tuple(frames), tuple(kinds), frame, kind, boxes, box_format, **(unknown | columns))

    def with_box_format(self, edges: BoxFormat) -> LabelTable:
        """Convert the boxes to a format. Areas do not change: COCO measures them by masks."""
        if edges == self.box_format:
            return self
        boxes = xyxy_to_coco(self.boxes) if edges == "xywh" else coco_to_xyxy(self.boxes)
        return replace(self, boxes=np.round(boxes, DECIMALS), box_format=edges)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> LabelTable:
        """Select boxes by mask or indices, ascending by frame; the frames stay."""
        columns = ("frame", "kind", "boxes", "ignore", "score", "truncation", "occlusion", "alpha", "pose", "area")
        index: NDArray[np.int64] = np.arange(len(self))[chosen]
        return replace(
            self,
            **{name: _select_rows(getattr(self, name), index) for name in columns},
            box_ids=None if self.box_ids is None else self.box_ids[index],
            extra={name: [values[i] for i in index.tolist()] for name, values in self.extra.items()},
        )

    def reindex(self, frames: Sequence[str]) -> LabelTable:
        """Return the table for other frames: unknown ones have no boxes, boxes of missing ones are dropped."""
        position = {name: i for i, name in enumerate(frames)}
        new = np.array([position.get(name, -1) for name in self.frames], np.int64)
        index = np.flatnonzero(new[self.frame] >= 0) if len(self) else np.zeros(0, np.int64)
        index = index[np.argsort(new[self.frame[index]], kind="stable")]
        selected = self.select(index)
        old = np.flatnonzero(new >= 0)
        sizes = np.zeros((len(frames), 2), np.int64)
        sizes[new[old]] = self.sizes_wh[old]
        ids = None
        if self.image_ids is not None and len(old) == len(frames):
            ids = np.zeros(len(frames), self.image_ids.dtype)
            ids[new[old]] = self.image_ids[old]
        return replace(
            selected,
            frames=tuple(frames),
            frame=new[selected.frame],
            sizes_wh=sizes,
            image_ids=ids,
            cameras={int(new[i]): camera for i, camera in self.cameras.items() if new[i] >= 0},
            image_files={int(new[i]): name for i, name in self.image_files.items() if new[i] >= 0},
            image_paths={int(new[i]): path for i, path in self.image_paths.items() if new[i] >= 0},
            frame_attributes={int(new[i]): values for i, values in self.frame_attributes.items() if new[i] >= 0},
            splits={name: [int(new[i]) for i in rows if new[i] >= 0] for name, rows in self.splits.items()},
        )

    def to_labels(self) -> Labels:
        """Convert to float32 labels: objects in file order, ignored boxes as regions.

        Unknown values are NaN; an unknown occlusion is 3.
        """
        import torch

        from scene_ir.types import Labels

        boxes = torch.from_numpy(self.boxes if self.box_format == "xyxy" else coco_to_xyxy(self.boxes)).float()
        objects = ~self.ignore
        pose = torch.from_numpy(self.pose[objects]).float()
        truncation, occlusion = self.truncation[objects], self.occlusion[objects]
        return Labels(
            kind=tuple(self.kinds[k] for k in self.kind[objects].tolist()),
            boxes_xyxy=boxes[torch.from_numpy(objects)],
            truncation=torch.from_numpy(np.where(truncation < 0, np.nan, truncation)).float(),
            occlusion=torch.from_numpy(np.where(occlusion < 0, UNKNOWN_OCCLUSION, occlusion)),
            translation=pose[:, 3:6].clone(),
            yaw=pose[:, 6].clone(),
            size_lhw=pose[:, :3].clone(),
            ignore_xyxy=boxes[torch.from_numpy(self.ignore)],
        )

    def weather(self) -> list[str | None]:
        """Return the weather in each frame's identifier, one of WEATHER_VARIATIONS; None where there is none."""
        parts = [name.replace("_", "/").split("/") for name in self.frames]
        return [next((word for word in words if word in WEATHER_VARIATIONS), None) for words in parts]

    @property
    def scored(self) -> bool:
        """Whether these are detections: there is at least one object, and all objects have scores."""
        scores = self.score[self.kind != REGION]
        return len(scores) > 0 and bool(np.isfinite(scores).all())

    def rows_by_frame(self) -> list[range]:
        """Return the rows of each frame."""
        ends = np.cumsum(np.bincount(self.frame, minlength=len(self.frames))).tolist()
        return [range(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def known_fields(self) -> dict[str, NDArray[np.bool_]]:
        """Return which boxes (N,) have a value, by field."""
        known = {
            "truncation": self.truncation >= 0,
            "occlusion": self.occlusion >= 0,
            "alpha": np.isfinite(self.alpha),
            "3D box": np.isfinite(self.pose).all(axis=1),
            "score": np.isfinite(self.score),
            "region": self.kind == REGION,
            "crowd": self.ignore & (self.kind != REGION),
        }
        columns = self.extra.items()
        return known | {name: np.array([v is not None for v in values], np.bool_) for name, values in columns}

    def count_lost(self, supported: Sequence[str], more: Mapping[str, int]) -> dict[str, int]:
        """Count boxes and frames with a value, by field that is not `supported`; add the counts `more`."""
        counts = {name: int(rows.sum()) for name, rows in self.known_fields().items() if name not in supported}
        of_frames = {
            "camera": len(self.cameras),
            "attributes of frames": sum(bool(v.keys() - {"drivesem"}) for v in self.frame_attributes.values()),
            "split": sum(len(rows) for rows in self.splits.values() if len(rows) < len(self.frames)),
        }
        return counts | {name: n for name, n in of_frames.items() if name not in supported} | dict(more)

    def file_names(self, folders: Sequence[str] = ()) -> tuple[list[str], dict[str, int]]:
        """Return paths of the frames' files, without suffix, and the number of changed names, as a loss.

        A frame's files are named as its image if that is named after the frame, with its folders. If some are alike,
        all are named by identifiers.

        Args:
            folders: Folder of each frame (F,), in which names must differ; by default one for all.

        Raises:
            FormatError: A name leads out of its folder.
        """
        stems = ((i, self.frames[i], os.path.splitext(file)[0]) for i, file in self.image_files.items())
        own = {i: name for i, frame, name in stems if _is_ending(frame, name) or _is_ending(name, frame)}
        names = [own.get(i, identifier) for i, identifier in enumerate(self.frames)]
        if len(set(zip(folders, names, strict=True) if folders else names)) < len(names):
            names = list(self.frames)
        for name in names:
            if name.startswith("/") or "\0" in name or ".." in name.split("/"):
                raise FormatError("frames", "names below a folder", repr(name))
        return names, {"names of frames": sum(not _is_ending(own[i], names[i]) for i in own)}

    def require_sizes(self, layout: str) -> None:
        """Raise FormatError if the size of an image is unknown."""
        missing = int((self.sizes_wh <= 0).any(axis=1).sum())
        if missing:
            expected = "--images FOLDER or --image-size WIDTHxHEIGHT"
            raise FormatError(f"{layout}: image sizes", expected, f"none for {missing} frames")


def join_tables(tables: Sequence[LabelTable]) -> LabelTable:
    """Join tables of different frames. Ids that are not unique, or differ between the tables, are dropped."""
    kinds = list(dict.fromkeys(kind for table in tables for kind in table.kinds))
    starts = np.cumsum([0, *(len(table.frames) for table in tables)]).tolist()
    numbers: dict[str, set[int]] = {}
    for table in tables:
        for kind, number in zip(table.kinds, table.kind_ids, strict=True) if table.kind_ids is not None else ():
            numbers.setdefault(kind, set()).add(int(number))
    known = len(numbers) == len(kinds) and all(len(ids) == 1 for ids in numbers.values())
    kind_ids = [next(iter(numbers[kind])) for kind in kinds] if known else []
    names = sorted({name for table in tables for name in table.extra})
    columns = ("boxes", "ignore", "score", "truncation", "occlusion", "alpha", "pose", "area", "sizes_wh")
    maps = ("cameras", "image_files", "image_paths", "frame_attributes")
    parts = list(zip(tables, starts, strict=False))

    def unique(values: Sequence[Any]) -> Any:
        if any(value is None for value in values) or len({value.dtype.kind for value in values}) > 1:
            return None
        joined = np.concatenate(values)
        return joined if len(np.unique(joined)) == len(joined) else None

    return replace(
        tables[0],
        frames=tuple(name for table in tables for name in table.frames),
        kinds=tuple(kinds),
        frame=np.concatenate([table.frame + start for table, start in parts]),
        kind=np.concatenate(
            [np.array([*map(kinds.index, table.kinds), REGION], np.int64)[table.kind] for table in tables]
        ),
        **{name: _concatenate([getattr(table, name) for table in tables]) for name in columns},
        image_ids=unique([table.image_ids for table in tables]),
        box_ids=unique([table.box_ids for table in tables]),
        kind_ids=np.array(kind_ids, np.int64) if known and len(set(kind_ids)) == len(kinds) else None,
        merged_kind_ids={},
        extra={
            name: [v for table in tables for v in table.extra.get(name, [None] * len(table))] for name in names
        },
        **{
            name: {i + start: value for table, start in parts for i, value in getattr(table, name).items()}
            for name in maps
        },
    )


def repeat_value(value: float, *shape: int) -> NDArray[Any]:
    """Return a read-only array of one value, which takes no memory."""
    return np.broadcast_to(np.array(value), shape)


def _is_repeated(column: NDArray[Any]) -> bool:
    return not any(column.strides)


def _select_rows(column: NDArray[Any], index: NDArray[np.int64]) -> NDArray[Any]:
    if len(column) and _is_repeated(column):
        return np.broadcast_to(column[0], (len(index), *column.shape[1:]))
    return column[index]


def _concatenate(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    parts = [column for column in columns if len(column)] or [*columns[:1]]
    first, length = parts[0], sum(map(len, columns))
    alike = all(
        _is_repeated(part) and np.array_equal(part[0], first[0], equal_nan=True) for part in parts if len(part)
    )
    if alike and len(first):
        return np.broadcast_to(first[0], (length, *first.shape[1:]))
    return np.concatenate(columns)


@dataclass(frozen=True, slots=True)
class WriteSummary:
    """Summary of a written table."""

    files: int
    """Number of written files."""
    lost: Mapping[str, int]
    """Number of boxes or frames with a value that the layout cannot hold, by field."""
    assumed: Mapping[str, int]
    """Number of boxes or frames with an assumed value, by field."""

    @classmethod
    def from_counts(
        cls, files: int, lost: Mapping[str, int], assumed: Mapping[str, int] | None = None
    ) -> WriteSummary:
        """Make a summary without counts of 0.

        Args:
            files: Number of written files.
            lost: Lost values by field.
            assumed: Assumed values by field.

        Returns:
            The summary.
        """
        counts = ({name: int(count) for name, count in c.items() if count} for c in (lost, assumed or {}))
        return cls(files, *counts)


def copy_images(
    targets: Mapping[str, Path], images: Mapping[str, Path], suffixes: Sequence[str] | None = None
) -> int:
    """Copy images; those with an EXIF orientation are turned upright.

    Args:
        targets: Target without suffix, by frame identifier.
        images: Source, by frame identifier.
        suffixes: The suffixes that the layout can hold, in lower case; None for all, in any case.

    Returns:
        Number of copied images.

    Raises:
        FormatError: An image has another suffix.
    """
    for identifier, source in images.items():
        target, suffix = targets[identifier], source.suffix
        if suffixes is not None:
            suffix = suffix.lower()
            if suffix not in suffixes:
                raise FormatError(str(source), f"a {' or '.join(suffixes)} image", source.suffix or "none")
        copy_upright(source, target.with_name(target.name + suffix))
    return len(images)


def select_by_attributes(
    attributes: Mapping[str, Mapping[str, str]], where: Mapping[str, tuple[str, ...]]
) -> list[str]:
    """Return the identifiers of frames with allowed attributes.

    Args:
        attributes: Attributes of each frame.
        where: Allowed values by attribute.

    Raises:
        FormatError: An attribute or a value that no frame has, or no frame with all of them.
    """
    for name, wanted in where.items():
        known = sorted({values[name] for values in attributes.values() if name in values})
        if not known:
            there = sorted({key for values in attributes.values() for key in values})
            expected = f"one of {', '.join(there)}" if there else "a data set with attributes"
            raise FormatError(f"--where {name}", expected, repr(name))
        for value in wanted:
            if value not in known:
                raise FormatError(f"--where {name}", f"one of {', '.join(known)}", repr(value))
    chosen = [i for i, values in attributes.items() if all(values.get(k) in wanted for k, wanted in where.items())]
    if not chosen:
        raise FormatError("--where", "at least one frame", f"none of {len(attributes)}")
    return chosen


def _is_ending(end: str, name: str) -> bool:
    """Whether a path is the other one, or its last parts."""
    return end == name or name.endswith(f"/{end}")


def format_number(value: float) -> str:
    """Format a number with two decimals, as KITTI does, or with more if it needs them."""
    value += 0.0  # no "-0.00"
    text = f"{value:.2f}"
    return text if float(text) == value else format_shortest(value)


def format_shortest(value: float) -> str:
    """Format a number with the fewest decimals that read back unchanged, without an exponent."""
    text = repr(float(value))
    return np.format_float_positional(value, trim="-") if "e" in text else text.removesuffix(".0")


def parse_camera_entry(camera: Any) -> NDArray[np.float64]:
    """Return the projection (3, 4) px of a COCO "camera" entry of this project; FormatError for another's."""
    entry = camera if isinstance(camera, dict) else {}
    if "projection" in entry:
        values = entry["projection"]
    else:
        fx, fy, cx, cy = (entry.get(k) for k in ("fx", "fy", "cx", "cy"))
        values = [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    good = isinstance(values, list) and all(type(v) in (int, float) and math.isfinite(v) for v in values)
    if not good or len(values) != 12:
        raise FormatError("camera", "projection (12 numbers), or fx, fy, cx, cy", repr(camera))
    return np.array(values, np.float64).reshape(3, 4)


def make_camera_entry(projection: Tensor) -> dict[str, Any]:
    """Make COCO's "camera" entry of a projection (3, 4) px."""
    values = shortest_decimals(projection)
    index = {"fx": 0, "fy": 5, "cx": 2, "cy": 6}
    return {**{name: values[i] for name, i in index.items()}, "projection": values}


def shortest_decimals(values: Tensor) -> list[float]:
    """Round float32 values to the fewest decimals that read back as the same float32."""
    return [float(str(v)) for v in values.float().flatten().numpy()]


def is_known_pose(pose: Sequence[float]) -> bool:
    """Whether a row of `LabelTable.pose` is known."""
    return all(map(math.isfinite, pose))
