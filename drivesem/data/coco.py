"""COCO's `annotations/instances_*.json`: reader and writer.

Boxes in the file are COCO's: x, y, width, height, where pixel column j spans [j, j + 1]. Here it spans
[j - 0.5, j + 0.5] (scene_ir/conventions.md), so x is left + 0.5. Masks are run-length encoded and exact.
Format: cocodataset.org/#format-data; pycocotools is the definition.

Images are turned upright by EXIF. Where the file states the size of the stored, unturned image, boxes and masks are
of stored pixels, and are turned with it; otherwise they are upright already. Where both sizes are equal (squares,
half turns), they are taken as upright, as annotation tools and OpenCV show images.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from os.path import isfile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pycocotools import mask as run_length

from drivesem.data.account import DataAccount
from drivesem.data.coco_labels import (
    AnnotationFile,
    CocoFiles,
    JsonRows,
    first_occurrences,
    parse_numbers,
    read_turn,
    turn_boxes,
)
from drivesem.data.ground_truth import Exposure, FrameLocation, TrackedObject
from drivesem.data.image_headers import read_upright_size
from drivesem.data.label_table import (
    REGION,
    LabelTable,
    WriteSummary,
    copy_images,
    is_known_pose,
    make_camera_entry,
    shortest_decimals,
    xyxy_to_coco,
)
from drivesem.data.photographs import (
    FrameIndex,
    check_focal,
    pinhole_camera,
    read_focal_length,
    read_upright,
    turn_pixels,
)
from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

CATEGORIES = {
    **dict.fromkeys(("Car", "Van", "Truck"), "vehicle"),
    **dict.fromkeys(("Pedestrian", "Cyclist", "Person_sitting"), "person"),
    **dict.fromkeys(("Tram", "Misc"), "other"),
}
"""Supercategory of each of KITTI's types; ids count from 1, in this order."""
CATEGORY_IDS = {name: i + 1 for i, name in enumerate(CATEGORIES)}


def _encode_mask(mask: np.ndarray) -> dict[str, Any]:
    """Encode a mask (H, W) bool as COCO's compressed run lengths."""
    encoded = run_length.encode(np.asfortranarray(mask, np.uint8))
    return {"size": list(mask.shape), "counts": _decode_counts(encoded)}


def _decode_counts(encoded: Any) -> str:
    """Decode pycocotools' run lengths, which are bytes despite their type hints."""
    return encoded["counts"].decode("ascii")


def _box_mask(box_xyxy: Sequence[float], height: int, width: int) -> np.ndarray:
    """Return the mask (H, W) bool of pixels with centres in a box."""
    left, top, right, bottom = box_xyxy
    rows, columns = np.arange(height), np.arange(width)
    return np.outer((rows >= top) & (rows <= bottom), (columns >= left) & (columns <= right))


def _region_kinds(box_xyxy: Sequence[float], objects: Iterable[TrackedObject]) -> tuple[str, ...]:
    """Return the type of the unlabelled object with the largest overlap with a region; all types if there is none."""
    left, top, right, bottom = box_xyxy

    def overlap(tracked: TrackedObject) -> float:
        x0, y0, x1, y1 = tracked.box_ltrb
        wide, high = min(right, x1) - max(left, x0) + 1, min(bottom, y1) - max(top, y0) + 1
        union = (right - left + 1) * (bottom - top + 1) + (x1 - x0 + 1) * (y1 - y0 + 1) - wide * high
        return wide * high / union if min(wide, high) > 0 else 0.0

    best = max((o for o in objects if not o.labelled), key=overlap, default=None)
    return tuple(CATEGORIES) if best is None or overlap(best) == 0 else (best.kind,)


class CocoWriter:
    """Writes `images/{part}/%06d.png` and `annotations/instances_{part}.json` under `root`.

    Besides COCO's own keys an image has "camera" (fx, fy, cx, cy and projection, 3x4 row-major, px) and an
    annotation has "truncation", "visible", "occlusion", "track" and "pose" (translation m, yaw rad, size_lhw m),
    as in `Labels` and `TrackedObject`. "area" and "segmentation" cover the visible part, "bbox" is the label's box.
    A region to ignore is a crowd (iscrowd 1) of the type of the object there, or of every type if there is none.
    COCO cannot hold depth, semantic classes and extrinsics.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def _image(self, location: FrameLocation) -> Path:
        return self.root / "images" / location.part / f"{location.number:06d}.png"

    def exists(self, location: FrameLocation) -> bool:
        """Whether the frame's image exists."""
        return self._image(location).exists()

    def write(self, location: FrameLocation, exposure: Exposure) -> dict[str, object]:
        """Write one frame's image. Returns its record and its annotations; `finish` numbers them."""
        camera = exposure.camera
        record = {
            "id": location.number + 1,
            "file_name": self._image(location).name,
            "height": camera.height,
            "width": camera.width,
            "camera": make_camera_entry(camera.matrix),
        }
        annotations = [*_object_annotations(exposure), *_region_annotations(exposure)]
        files.write_png(self._image(location), exposure.image)
        return {"number": location.number, "part": location.part, "image": record, "annotations": annotations}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write the annotations of every part with frames, one image or annotation per line."""
        for part in sorted({entry["part"] for entry in entries}):
            part_entries = [entry for entry in entries if entry["part"] == part]
            annotations = [
                {"id": i + 1, "image_id": image_id, **annotation}
                for i, (image_id, annotation) in enumerate(
                    (entry["image"]["id"], annotation)
                    for entry in part_entries
                    for annotation in entry["annotations"]
                )
            ]
            images = [entry["image"] for entry in part_entries]
            parts = _format_dataset(images, annotations, CATEGORY_IDS.items(), _HEAD, "")
            files.write_parts(self.root / "annotations" / f"instances_{part}.json", parts)


_HEAD = '"info": {"description": "drivesem synth"},\n"licenses": [],\n'


def _format_dataset(
    images: Iterable[Any],
    annotations: Iterable[Any],
    categories: Iterable[tuple[str, int]],
    start: str = "\n",
    end: str = "\n",
) -> Iterator[bytes]:
    """Format a data set's file in parts, one image or annotation per line. `categories` are names and ids."""
    named = [
        {"id": number, "name": name, "supercategory": CATEGORIES.get(name, "object")}
        for name, number in categories
    ]
    tables = {"images": images, "annotations": annotations, "categories": named}
    yield f"{{{start}".encode()
    for name, rows in tables.items():
        yield f'"{name}": [\n'.encode()
        lines = (_format_entry(name, i, row) for i, row in enumerate(rows))
        separator = ""
        while text := ",\n".join(islice(lines, _LINES_PER_PART)):
            yield f"{separator}{text}".encode()
            separator = ",\n"
        yield b"\n]" if name == "categories" else b"\n],\n"
    yield f"{end}}}\n".encode()


_LINES_PER_PART = 1 << 14
_ENCODER = json.JSONEncoder(allow_nan=False)


def _format_entry(table: str, index: int, row: Any) -> str:
    """Format an entry as JSON. Raises FormatError for NaN and infinity in keys of another project."""
    try:
        return _ENCODER.encode(row)
    except ValueError as error:
        raise FormatError(f"{table}[{index}]", "finite numbers", "NaN or infinity") from error


def _object_annotations(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Yield annotations of the labelled objects, without ids."""
    labels = exposure.labels
    for i, tracked in enumerate(o for o in exposure.objects if o.labelled):
        mask = exposure.instances == tracked.track + 1
        yield {
            "category_id": CATEGORY_IDS[labels.kind[i]],
            "bbox": xyxy_to_coco(labels.boxes_xyxy[i].double().numpy()).tolist(),
            "area": int(mask.sum()),
            "segmentation": _encode_mask(mask),
            "iscrowd": 0,
            "truncation": shortest_decimals(labels.truncation[i])[0],
            "visible": tracked.visible,
            "occlusion": int(labels.occlusion[i]),
            "track": tracked.track,
            "pose": _pose_entry(
                shortest_decimals(labels.size_lhw[i]),
                shortest_decimals(labels.translation[i]),
                *shortest_decimals(labels.yaw[i]),
            ),
        }


def _region_annotations(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Yield annotations of the regions to ignore, without ids."""
    for box in exposure.labels.ignore_xyxy.tolist():
        mask = _box_mask(box, exposure.camera.height, exposure.camera.width)
        region = {"bbox": xyxy_to_coco(np.array(box)).tolist(), "area": int(mask.sum())}
        region |= {"segmentation": _encode_mask(mask), "iscrowd": 1}
        for kind in _region_kinds(box, exposure.objects):
            yield {"category_id": CATEGORY_IDS[kind], **region}


def _pose_entry(size_lhw: Sequence[float], translation: Sequence[float], yaw: float) -> dict[str, Any]:
    return {"translation": translation, "yaw": yaw, "size_lhw": size_lhw}


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table with all its values, classes in its order, images under their names.

    A region becomes a crowd of every class, marked "dontcare"; `coco_labels.read_table` merges these again.

    Args:
        table: Labels or detections.
        out: A .json file, or a folder for `annotations/instances_SPLIT.json`, one for each split ("all" without
            splits, "rest" for frames of none), and `images/SPLIT` (`images` without splits).
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files and lost values.

    Raises:
        FormatError: The size of an image is unknown.
    """
    table.require_sizes("coco")
    table = table.with_box_format("xywh")
    single = out.suffix.lower() == ".json"
    split_of = {} if single else {i: name for name, rows in reversed([*table.splits.items()]) for i in rows}
    parts: dict[str, list[int]] = {name: [] for name in table.splits} if split_of else {}
    for i in range(len(table.frames)):
        parts.setdefault(split_of.get(i, "rest" if split_of else "all"), []).append(i)
    paths, renamed = table.file_names([split_of.get(i, "") for i in range(len(table.frames))])
    names = [_file_name(table, i, path, images) for i, path in enumerate(paths)]
    repeated = {
        key for key, n in Counter((split_of.get(i), name) for i, name in enumerate(names)).items() if n > 1
    }
    names = [
        f"{paths[i]}{PurePosixPath(name).suffix}" if (split_of.get(i), name) in repeated else name
        for i, name in enumerate(names)
    ]
    count, targets = 0, dict[str, Path]()
    folder = (out.parent if single else out) / "images"
    for part, frames in parts.items():
        path = out if single else out / "annotations" / f"instances_{part}.json"
        files.write_parts(path, _format_table(table, frames, names))
        count += 1
        place = folder / part if split_of else folder
        targets |= {table.frames[i]: place / PurePosixPath(names[i]).with_suffix("") for i in frames}
    lost = {**renamed, "split": sum(map(len, table.splits.values())) if single else 0}
    named = {*table.image_files, *(i for i, frame in enumerate(table.frames) if frame in images)}
    assumed = {"suffix of image files (.png)": len(table.frames) - len(named)}
    return WriteSummary.from_counts(count + copy_images(targets, images), lost, assumed)


def _file_name(table: LabelTable, i: int, path: str, images: Mapping[str, Path]) -> str:
    """Return an image's file name: its own if it stays where it is; else `path` with its suffix."""
    image = images.get(table.frames[i])
    if image is None:
        return table.image_files.get(i) or f"{path}.png"
    return f"{path}{image.suffix}"


def _format_table(table: LabelTable, frames: Sequence[int], names: Sequence[str]) -> Iterator[bytes]:
    """Format the file of some frames.

    Args:
        table: All frames.
        frames: Indices of the file's frames.
        names: File names of all images.

    Returns:
        Parts of the file.
    """
    if table.kind_ids is not None:
        numbers: list[int] = table.kind_ids.tolist()
        categories = list(zip(table.kinds, numbers, strict=True))
    else:
        of_run = table.account is None and any("drivesem" in values for values in table.frame_attributes.values())
        of_kitti = of_run or (table.account is not None and table.account.layout in _KITTI_LAYOUTS)
        of_kitti = of_kitti and set(table.kinds) <= set(CATEGORIES)
        categories = [(kind, i + 1) for i, kind in enumerate(CATEGORIES if of_kitti else table.kinds)]
        numbers = [dict(categories)[kind] for kind in table.kinds]
    image_ids = (np.arange(1, len(names) + 1) if table.image_ids is None else table.image_ids).tolist()
    records: list[dict[str, Any]] = []
    for i in frames:
        width, height = table.sizes_wh[i].tolist()
        record = {"id": image_ids[i], "file_name": names[i], "width": width, "height": height}
        record |= {"camera": table.cameras[i]} if i in table.cameras else {}
        attributes = dict(table.frame_attributes.get(i, {}))
        exported = attributes.pop("drivesem", None)
        record |= {"attributes": attributes} if attributes else {}
        records.append(record | ({} if exported is None else {"drivesem": exported}))
    annotations = _iterate_annotations(table, frames, image_ids, numbers, [number for _, number in categories])
    return _format_dataset(records, annotations, categories)


def _iterate_annotations(
    table: LabelTable,
    frames: Sequence[int],
    image_ids: Sequence[Any],
    kind_numbers: Sequence[int],
    all_numbers: Sequence[int],
) -> Iterator[dict[str, Any]]:
    """Yield the annotations of some frames.

    Args:
        table: All frames.
        frames: Indices of the frames.
        image_ids: Ids of all frames.
        kind_numbers: Ids of the table's classes.
        all_numbers: Ids of all categories, each of which gets the regions.
    """
    next_id = 1 + (0 if table.box_ids is None else int(table.box_ids.max(initial=0)))
    by_frame, fields = table.rows_by_frame(), _known_fields(table)
    for i in frames:
        rows = by_frame[i]
        part = slice(rows.start, rows.stop)
        kinds = table.kind[part].tolist()
        box_ids = [None] * len(kinds) if table.box_ids is None else table.box_ids[part].tolist()
        for kind, box_id, entry in zip(kinds, box_ids, _row_entries(table, rows, fields), strict=True):
            for label in all_numbers if kind == REGION else [kind_numbers[kind]]:
                number = box_id
                if box_id is None or kind == REGION:
                    number = next_id
                    next_id += 1
                annotation = {"id": number, "image_id": image_ids[i], "category_id": label, **entry}
                yield annotation | {"dontcare": True} if kind == REGION else annotation


_KITTI_LAYOUTS = ("kitti", "vkitti1", "vkitti2")
"""Layouts with KITTI's types; their ids, and those of runs, are CATEGORY_IDS."""


def _known_fields(table: LabelTable) -> list[str]:
    """Return the fields, other than box and area, with a value in any row."""
    known = {
        "score": np.isfinite(table.score),
        "truncation": table.truncation >= 0,
        "occlusion": table.occlusion >= 0,
        "alpha": np.isfinite(table.alpha),
        "pose": np.isfinite(table.pose).all(axis=1),
    }
    return [name for name, rows in known.items() if rows.any()]


def _row_entries(table: LabelTable, rows: range, fields: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the annotations of a frame's rows, without ids and unknown values; see `_known_fields`."""
    part = slice(rows.start, rows.stop)
    columns = {name: getattr(table, name)[part].tolist() for name in fields}
    boxes, areas, ignored = (column[part].tolist() for column in (table.boxes, table.area, table.ignore))
    for place, (row, box, area, ignore) in enumerate(zip(rows, boxes, areas, ignored, strict=True)):
        area = area if math.isfinite(area) else box[2] * box[3]
        entry: dict[str, Any] = {
            "bbox": box,
            "area": int(area) if area.is_integer() else area,
            "iscrowd": int(ignore),
        }
        for name, values in columns.items():
            value = values[place]
            if name == "pose":
                entry |= {name: _pose_entry(value[:3], value[3:6], value[6])} if is_known_pose(value) else {}
            elif math.isfinite(value) and (value >= 0 or name in ("score", "alpha")):
                entry[name] = value
        entry |= {name: values[row] for name, values in table.extra.items() if values[row] is not None}
        yield entry


@dataclass(frozen=True, slots=True)
class _CocoImage:
    """An image of one of a data set's files."""

    file: AnnotationFile
    """The annotation file."""
    index: int
    """Index in the file's images."""
    rows: list[int]
    """Indices of its annotations."""

    @property
    def record(self) -> Mapping[str, Any]:
        """Entry in "images"."""
        return self.file.images.rows[self.index]

    def require_path(self) -> Path:
        """Return the image's path. Raises FormatError if it has none inside of the data set."""
        path = self.file.paths[self.index]
        if path is None:
            name = self.record.get("file_name")
            where = self.file.images.locate(self.index, "file_name")
            raise FormatError(where, f"a file in {self.file.folder}", "none" if name is None else repr(name))
        return Path(path)


class CocoDataset(FrameIndex[_CocoImage]):
    """The frames of a COCO data set, of all its files; an image may be missing until its frame is read.

    A frame's identifier is that of `coco_labels.CocoFiles`, its splits are the files. `kind` is the category's name as
    written. Unknown truncation and 3D boxes are NaN, unknown occlusion is 3, as in KITTI; so are values that a scene
    cannot use. Crowds are regions to ignore.

    Args:
        root: Folder with annotation files, all of which are read, or one JSON file.
        focal_px: Focal length of images without "camera"; by default EXIF's, or DEFAULT_FOCAL.

    Raises:
        FormatError: Names file and field. A frame's own faults are raised by `labels` and `frame` only.
    """

    def __init__(self, root: Path, focal_px: float | None = None) -> None:
        check_focal(focal_px)
        self.focal_px = focal_px
        self._files = CocoFiles(Path(root))
        entries: dict[str, _CocoImage] = {}
        for data, names in zip(self._files.parts, self._files.names, strict=True):
            by_image: list[list[int]] = [[] for _ in names]
            for row, frame in enumerate(data.annotation_image.tolist()):
                by_image[frame].append(row)
            entries |= {name: _CocoImage(data, i, by_image[i]) for i, name in enumerate(names)}
        super().__init__("the COCO file", dict(sorted(entries.items())))

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split, if there are several annotation files."""
        return {name: tuple(sorted(frames)) for name, frames in self._files.splits().items()}

    def account(self) -> DataAccount:
        """Account for all files and annotations."""
        broken = 0
        for part in self._files.parts:
            if "segmentation" in part.annotations.key_names():
                sizes_hw = part.sizes_wh()[part.annotation_image, ::-1].tolist()
                outlines = zip(part.annotations.values("segmentation"), sizes_hw, strict=True)
                broken += sum(
                    bool(outline) and size[0] > 0 and _is_broken(outline, size) for outline, size in outlines
                )
        return self._files.account(
            {"outlines that are broken (no masks of their frames)": broken} if broken else {}
        )

    def attributes(self, identifier: str) -> dict[str, str]:
        """Attributes that the file states of an image."""
        image = self._entry(identifier)
        values = image.file.attributes(image.index).items()
        return {name: str(value) for name, value in values if isinstance(value, str | int | float)}

    def _size_wh(self, image: _CocoImage) -> list[int]:
        """Return the size that the file states, else that of the upright image."""
        size = [image.record.get(key) for key in ("width", "height")]
        known = [int(value) for value in size if isinstance(value, int | float) and value > 0]
        return known if len(known) == 2 else list(read_upright_size(image.require_path()))

    def _frame_annotations(self, identifier: str) -> tuple[JsonRows, LabelTable, NDArray[np.int64]]:
        """Return a frame's annotations, their table as in the file, and the rows that are objects."""
        image = self._entry(identifier)
        data = image.file
        rows = data.annotations.select(image.rows)
        category = data.annotation_category[image.rows]
        frame = np.zeros(len(rows), np.int64)
        table = rows.to_table((identifier,), data.kinds, data.category_ids, frame, category, False)
        return rows, table, np.flatnonzero(~table.ignore)

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame. Raises FormatError naming the annotation and its field."""
        image = self._entry(identifier)
        _, table, _ = self._frame_annotations(identifier)
        path = image.file.paths[image.index]
        if path is not None and isfile(path):
            size_wh = self._size_wh(image)
            table = replace(table, boxes=turn_boxes(table.boxes, read_turn(path, size_wh), size_wh))
        usable = (table.truncation >= 0) & (table.truncation <= 1)
        table = replace(
            table,
            truncation=np.where(usable, table.truncation, -1.0),
            occlusion=np.where(np.isin(table.occlusion, range(4)), table.occlusion, -1),
        )
        places = enumerate(zip(table.boxes.tolist(), table.ignore.tolist(), strict=True))
        first = first_occurrences(tuple(box) if ignored else i for i, (box, ignored) in places)
        return table.select(first).to_labels()

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels, and masks (M, H, W) if every object has a valid segmentation.

        Raises FormatError naming file and field: a missing image or one of another size, an invalid camera.
        """
        entry = self._entry(identifier)
        path = entry.require_path()
        size_wh = self._size_wh(entry)
        orientation = read_turn(path, size_wh)
        width, height = size_wh if orientation == 1 else size_wh[::-1]
        image = read_upright(path)
        if image.shape[:2] != (height, width):
            raise FormatError(str(path), f"{width}x{height} px", f"{image.shape[1]}x{image.shape[0]} px")
        if orientation == 1:
            camera, camera_provenance = self._camera(entry, path, height, width)
        else:  # a camera would be of the stored image
            focal = read_focal_length(path, self.focal_px)
            camera, camera_provenance = pinhole_camera(height, width, focal.length_px), {"focal": str(focal)}
        labels = self.labels(identifier)
        rows, _, objects = self._frame_annotations(identifier)
        outlines = [rows.rows[i].get("segmentation") for i in objects.tolist()]
        masks = None
        if all(outlines):
            try:
                decoded = [_decode_mask(identifier, outline, size_wh[::-1]) for outline in outlines]
                masks = torch.zeros(len(decoded), height, width)
                for i, mask in enumerate(decoded):
                    masks[i] = torch.from_numpy(turn_pixels(mask, orientation))
            except FormatError:
                pass  # masks are unknown; `account` counts their outlines
        return Frame(
            identifier=identifier,
            photograph=to_tensor(image),
            camera=camera,
            labels=labels,
            masks=masks,
            provenance={
                "dataset": "coco",
                "image": str(entry.record["file_name"]),
                "folder": entry.file.path.name,
                **camera_provenance,
            },
        )

    def _camera(self, entry: _CocoImage, path: Path, height: int, width: int) -> tuple[Camera, dict[str, str]]:
        """Return the camera of an image and its provenance.

        Args:
            entry: The image.
            path: Its file.
            height: Height, px.
            width: Width, px.

        Raises:
            FormatError: An invalid camera.
        """
        record, where = entry.record, f"{entry.file.path}: {entry.record['file_name']}"
        if "camera" not in record:
            focal = read_focal_length(path, self.focal_px)
            return pinhole_camera(height, width, focal.length_px), {"focal": str(focal)}
        camera = record["camera"] if isinstance(record["camera"], dict) else {}
        if "projection" in camera:
            values = parse_numbers(f"{where}: camera.projection", camera["projection"], 12)
            projection = torch.tensor(values).reshape(3, 4)
            intrinsics = projection[:, :3].clone()
        else:
            fx, fy, cx, cy = parse_numbers(
                f"{where}: camera fx, fy, cx, cy", [camera.get(k) for k in ("fx", "fy", "cx", "cy")], 4
            )
            projection, intrinsics = None, torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            return Camera(intrinsics, height, width, projection), {}
        except SceneError as error:
            raise FormatError(f"{where}: {error.field}", error.expected, error.actual) from error


def _is_broken(segmentation: Any, size_hw: Sequence[int]) -> bool:
    """Whether a segmentation is no outline, by its form; run lengths are not decoded."""
    if isinstance(segmentation, dict):
        return segmentation.get("size") != list(size_hw) or not segmentation.get("counts")
    if not isinstance(segmentation, list):
        return True
    try:
        _check_polygons("", segmentation, size_hw)
    except FormatError:
        return True
    return False


def _check_polygons(where: str, segmentation: Sequence[Any], size_hw: Sequence[int]) -> None:
    """Raise FormatError unless polygons have three or more corners near the image."""
    for i, polygon in enumerate(segmentation):
        corners = parse_numbers(f"{where}[{i}]", polygon, len(polygon) if isinstance(polygon, list) else 6)
        if len(corners) < 6 or len(corners) % 2 or max(map(abs, corners)) > 2 * max(size_hw):
            raise FormatError(f"{where}[{i}]", "x and y of three or more corners", json.dumps(polygon)[:60])


def _decode_runs(counts: str) -> list[int]:
    """Decode COCO's compressed run lengths (pycocotools, rleFrString).

    A character has 6 bits: 5 of the value, and one that means "more follows". From the third run on, values are
    differences to the run before last. Raises ValueError if the text ends too early.
    """
    runs: list[int] = []
    value = shift = 0
    for character in counts.encode("ascii"):
        bits = character - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("a number that is cut off")
    return runs


def _decode_mask(where: str, segmentation: Any, size_hw: Sequence[int]) -> np.ndarray:
    """Decode a mask (H, W) uint8 of run lengths, compressed or not, or of polygons. Raises FormatError."""
    height, width = size_hw
    counts: Any = None
    if isinstance(segmentation, list):
        _check_polygons(where, segmentation, size_hw)
        counts = _decode_counts(run_length.merge(run_length.frPyObjects(segmentation, height, width)))
    elif isinstance(segmentation, dict) and segmentation.get("size") == [height, width]:
        counts = segmentation.get("counts")
    else:
        raise FormatError(where, f"polygons, or run lengths of {width}x{height} px", json.dumps(segmentation)[:60])
    try:
        runs = np.array(_decode_runs(counts) if isinstance(counts, str) else counts, dtype=np.int64)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(f"{where}.counts", "run lengths", error) from error
    # decoded here: pycocotools leaves memory uninitialised where runs do not fill the image
    if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
        raise FormatError(f"{where}.counts", f"runs that fill {height * width} px", f"{runs.sum()} px")
    return np.repeat(np.arange(len(runs)) % 2, runs).reshape(width, height).T.astype(np.uint8)
