"""COCO's `annotations/instances_*.json`: reader and writer.

Boxes in the file are COCO's: x, y, width, height, where pixel column j spans [j, j + 1]. Here it spans
[j - 0.5, j + 0.5] (scene_ir/conventions.md), so x is left + 0.5. Masks are run-length encoded and exact.
Format: cocodataset.org/#format-data; pycocotools is the definition. A label table accepts any truncation, occlusion
and pose under these names; a scene accepts only those of this project.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os.path import isfile  # False for names that are too long
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pycocotools import mask as run_length

from drivesem.data.coco_labels import (
    AnnotationFile,
    JsonRows,
    first_occurrences,
    frame_identifier,
    list_annotation_files,
    parse_numbers,
)
from drivesem.data.ground_truth import Exposure, FrameLocation, TrackedObject
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
    PNG_COMPRESSION,
    FrameIndex,
    check_focal,
    match_images,
    pinhole_camera,
    read_focal_length,
    read_upright,
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
        files.write_png(self._image(location), exposure.image, PNG_COMPRESSION)
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
            text = _format_dataset(images, annotations, CATEGORY_IDS.items(), _HEAD, "")
            files.write_text(self.root / "annotations" / f"instances_{part}.json", text)


_HEAD = '"info": {"description": "drivesem synth"},\n"licenses": [],\n'


def _format_dataset(
    images: Sequence[Any],
    annotations: Sequence[Any],
    categories: Iterable[tuple[str, int]],
    start: str = "\n",
    end: str = "\n",
) -> str:
    """Format a data set's file, one image or annotation per line. `categories` are names and ids."""
    named = [
        {"id": number, "name": name, "supercategory": CATEGORIES.get(name, "object")}
        for name, number in categories
    ]
    tables = {"images": images, "annotations": annotations, "categories": named}
    lines = {
        name: ",\n".join(_format_entry(name, i, row) for i, row in enumerate(rows))
        for name, rows in tables.items()
    }
    return "{" + start + ",\n".join(f'"{name}": [\n{text}\n]' for name, text in lines.items()) + end + "}\n"


def _format_entry(table: str, index: int, row: Any) -> str:
    """Format an entry as JSON. Raises FormatError for NaN and infinity in keys of another project."""
    try:
        return json.dumps(row, allow_nan=False)
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
    """Write a table with all its values.

    A region becomes a crowd of every class, marked "dontcare"; `read_table` merges these again.

    Args:
        table: Labels or detections.
        out: A .json file, or a folder for `annotations/instances_all.json`.
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files and lost values.

    Raises:
        FormatError: The size of an image is unknown.
    """
    table.require_sizes("coco")
    table = table.with_box_format("xywh")
    names, renamed = table.file_names()
    if table.kind_ids is not None:
        categories = list(zip(table.kinds, table.kind_ids.tolist(), strict=True))
        numbers = table.kind_ids.tolist()
    else:
        fixed = set(table.kinds) <= set(CATEGORIES)
        categories = [(kind, i + 1) for i, kind in enumerate(CATEGORIES if fixed else table.kinds)]
        numbers = [dict(categories)[kind] for kind in table.kinds]
    image_ids = (np.arange(1, len(names) + 1) if table.image_ids is None else table.image_ids).tolist()
    records: list[dict[str, Any]] = []
    for i, (name, identifier) in enumerate(zip(names, table.frames, strict=True)):
        suffix = images[identifier].suffix.lower() if identifier in images else ".png"
        file_name = f"{name}{suffix}" if identifier in images else table.image_files.get(i, f"{name}{suffix}")
        width, height = table.sizes_wh[i].tolist()
        record = {"id": image_ids[i], "file_name": file_name, "width": width, "height": height}
        record |= {"camera": table.cameras[i]} if i in table.cameras else {}
        records.append(record | ({"drivesem": table.frame_attributes[i]} if i in table.frame_attributes else {}))
    annotations: list[dict[str, Any]] = []
    box_ids = [] if table.box_ids is None else table.box_ids.tolist()
    next_id = max(box_ids, default=0) + 1
    for row, kind in enumerate(table.kind.tolist()):
        entry = _row_annotation(table, row)
        for label in [number for _, number in categories] if kind == REGION else [numbers[kind]]:
            number = next_id
            if box_ids and kind != REGION:
                number = box_ids[row]
            else:
                next_id += 1
            annotation = {"id": number, "image_id": image_ids[table.frame[row]], "category_id": label, **entry}
            annotations.append(annotation | ({"dontcare": True} if kind == REGION else {}))
    path = out if out.suffix.lower() == ".json" else out / "annotations" / "instances_all.json"
    files.write_text(path, _format_dataset(records, annotations, categories))
    folder = (path.parent if path == out else out) / "images"
    targets = {identifier: folder / name for identifier, name in zip(table.frames, names, strict=True)}
    return WriteSummary.from_counts(1 + copy_images(targets, images), renamed)


def _row_annotation(table: LabelTable, row: int) -> dict[str, Any]:
    """Make the annotation of a row without ids and unknown values."""
    box, area, pose = table.boxes[row].tolist(), float(table.area[row]), table.pose[row].tolist()
    area = area if math.isfinite(area) else box[2] * box[3]
    score, alpha = float(table.score[row]), float(table.alpha[row])
    truncation, occlusion = float(table.truncation[row]), int(table.occlusion[row])
    entry = {
        "bbox": box,
        "area": int(area) if area.is_integer() else area,
        "iscrowd": int(table.ignore[row]),
        "score": score if math.isfinite(score) else None,
        "truncation": truncation if truncation >= 0 else None,
        "occlusion": occlusion if occlusion >= 0 else None,
        "alpha": alpha if math.isfinite(alpha) else None,
        "pose": _pose_entry(pose[:3], pose[3:6], pose[6]) if is_known_pose(pose) else None,
        **{name: values[row] for name, values in table.extra.items()},
    }
    return {name: value for name, value in entry.items() if value is not None}


def find_images(path: Path, frames: Sequence[str]) -> dict[str, Path]:
    """Find the images that a data set's file names, or else those named after the frames, in its image folder."""
    (path,) = list_annotation_files(path)
    folder, data = _find_image_folder(path), AnnotationFile(path, files.read_json(path))
    names = data.frame_names()
    named = {names[i]: folder / name for i, name in data.file_names().items() if _is_inside(Path(name))}
    return match_images([folder], frames) | {name: image for name, image in named.items() if isfile(image)}


def _is_inside(file_name: Path) -> bool:
    """Whether a relative file name stays inside its folder."""
    return not (file_name.is_absolute() or ".." in file_name.parts)


@dataclass(frozen=True, slots=True)
class _CocoImage:
    """An image of one of a data set's files."""

    file: AnnotationFile
    """The annotation file."""
    path: Path
    """The image file."""
    record: Mapping[str, Any]
    """Its entry in "images"."""
    rows: list[int]
    """Indices of its annotations."""


class CocoDataset(FrameIndex[_CocoImage]):
    """The frames of a COCO data set.

    A frame's identifier is its file name without suffix, folders joined by "_". `kind` is the category's name as
    written. Unknown truncation and 3D boxes are NaN, unknown occlusion is 3, as
    in KITTI; crowds are regions to ignore. Images are turned upright by EXIF, unless the file states the stored size.

    Args:
        root: Folder with `annotations/instances_*.json`, all of which are read, or one JSON file.
        images: Folder of the images; by default the first of `images/PART`, `PART`, `images` (next to
            `annotations`) and the JSON's own folder that exists.
        focal_px: Focal length of images without "camera"; by default EXIF's, or DEFAULT_FOCAL.
        kinds: Categories to read as objects, others are background; None: all.

    Raises:
        FormatError: Names file and field. A frame's own faults are raised by `labels` and `frame` only.
    """

    def __init__(
        self,
        root: Path,
        images: Path | None = None,
        focal_px: float | None = None,
        kinds: Collection[str] | None = None,
    ) -> None:
        root = Path(root)
        check_focal(focal_px)
        self.focal_px = focal_px
        self._kinds = kinds
        paths = list_annotation_files(root)
        if not paths:
            expected = "a COCO folder, with annotations/instances_*.json, or such a file (--root FILE.json)"
            raise FormatError(str(root), expected, "neither")
        entries: dict[str, _CocoImage] = {}
        for path in paths:
            data = AnnotationFile(path, files.read_json(path))
            folder = _find_image_folder(path) if images is None else Path(images)
            by_image: list[list[int]] = [[] for _ in data.images.rows]
            for row, frame in enumerate(data.annotation_image.tolist()):
                by_image[frame].append(row)
            for i, record in enumerate(data.images.rows):
                for key in ("height", "width"):
                    if type(record.get(key)) is not int or record[key] < 1:
                        value = json.dumps(record.get(key))
                        raise FormatError(data.images.locate(i, key), "a positive integer", value)
                if "file_name" not in record:
                    raise FormatError(data.images.locate(i, "file_name"), "a value", "none")
                name = Path(str(record["file_name"]))
                if not _is_inside(name):
                    raise FormatError(data.images.locate(i, "file_name"), f"a file in {folder}", repr(str(name)))
                identifier = frame_identifier(record)
                if identifier in entries:
                    found = f"{name}, twice: open one file alone"
                    raise FormatError(data.images.locate(i, "file_name"), "a unique name", found)
                entries[identifier] = _CocoImage(data, folder / name, record, by_image[i])
        super().__init__("the COCO file", dict(sorted(entries.items())))

    def _frame_annotations(self, identifier: str) -> tuple[JsonRows, LabelTable, NDArray[np.int64]]:
        """Return a frame's annotations of the selected kinds, their table, and the rows that are objects."""
        image = self._entry(identifier)
        data, kinds = image.file, self._kinds
        selected = [r for r in image.rows if kinds is None or data.kinds[data.annotation_category[r]] in kinds]
        rows = data.annotations.select(selected)
        category = data.annotation_category[selected]
        frame = np.zeros(len(rows), np.int64)
        table = rows.to_table((identifier,), data.kinds, data.category_ids, frame, category, False)
        ignore = np.array([bool(row.get("iscrowd") or row.get("ignore")) for row in rows.rows], np.bool_)
        return rows, replace(table, ignore=ignore), np.flatnonzero(~ignore)

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame. Raises FormatError naming the annotation and its field."""
        rows, table, objects = self._frame_annotations(identifier)
        rows.select(objects.tolist()).check_scene()
        places = enumerate(zip(table.boxes.tolist(), table.ignore.tolist(), strict=True))
        first = first_occurrences(tuple(box) if ignored else i for i, (box, ignored) in places)
        return table.select(first).to_labels()

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels, and masks (M, H, W) if every object has a segmentation.

        Raises FormatError naming file and field: a missing image or one of another size, an invalid camera, a
        segmentation that does not decode.
        """
        entry = self._entry(identifier)
        path, record = entry.file.path, entry.record
        size_hw = (record["height"], record["width"])
        image = read_upright(entry.path, size_hw)
        camera, camera_provenance = self._camera(entry)
        labels = self.labels(identifier)
        rows, _, objects = self._frame_annotations(identifier)
        rows = rows.select(objects.tolist())
        masks = None
        if all(row.get("segmentation") for row in rows.rows):
            masks = torch.zeros(len(rows), camera.height, camera.width)
            for i, row in enumerate(rows.rows):
                mask = _decode_mask(rows.locate(i, "segmentation"), row["segmentation"], masks[i].shape)
                masks[i] = torch.from_numpy(mask)
        return Frame(
            identifier=identifier,
            photograph=to_tensor(image),
            camera=camera,
            labels=labels,
            masks=masks,
            provenance={
                "dataset": "coco",
                "image": str(record["file_name"]),
                "folder": path.name,
                **camera_provenance,
            },
        )

    def _camera(self, entry: _CocoImage) -> tuple[Camera, dict[str, str]]:
        """Return the camera of an image and its provenance."""
        record, where = entry.record, f"{entry.file.path}: {entry.record['file_name']}"
        height, width = record["height"], record["width"]
        if "camera" not in record:
            focal = read_focal_length(entry.path, self.focal_px)
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


def _find_image_folder(path: Path) -> Path:
    """Find the images of an annotation file; see `CocoDataset`."""
    part = path.stem.removeprefix("instances_")
    root = path.parent.parent if path.parent.name == "annotations" else path.parent
    candidates = (root / "images" / part, root / part, root / "images")
    return next((folder for folder in candidates if folder.is_dir()), path.parent)


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
        for i, polygon in enumerate(segmentation):
            corners = parse_numbers(f"{where}[{i}]", polygon, len(polygon) if isinstance(polygon, list) else 6)
            if len(corners) < 6 or len(corners) % 2 or max(map(abs, corners)) > 2 * max(height, width):
                raise FormatError(f"{where}[{i}]", "x and y of three or more corners", json.dumps(polygon)[:60])
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
