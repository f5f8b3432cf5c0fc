"""COCO's `annotations/instances_*.json`: written with all that it can hold of a frame, and read from anywhere.

Boxes in the file are COCO's: x, y, width, height, where pixel column j spans [j, j + 1]. Here it spans
[j - 0.5, j + 0.5] (scene_ir/conventions.md), so x is left + 0.5. Masks are run-length encoded and exact.
Format: cocodataset.org/#format-data; pycocotools is the definition. A label table takes whatever truncation,
occlusion or pose another project means by these names; a scene takes this project's only, and refuses others.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os.path import isfile  # of a name that is too long it says no
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pycocotools import mask as run_length

from drivesem.data.coco_labels import AnnotationFile, Rows, files_of, firsts, identifier_of, numbers_of
from drivesem.data.frames import PNG_COMPRESSION, Frames, as_photograph, check_focal, images_in, pinhole
from drivesem.data.label_table import (
    REGION,
    LabelTable,
    Written,
    camera_entry,
    copy_images,
    known_pose,
    shortest,
    to_coco,
)
from drivesem.data.photographs import focal_of, upright_pixels
from drivesem.data.truth import Exposure, Place, TrackedObject
from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from scene_ir.types import Camera, Frame, Labels

CATEGORIES = {
    **dict.fromkeys(("Car", "Van", "Truck"), "vehicle"),
    **dict.fromkeys(("Pedestrian", "Cyclist", "Person_sitting"), "person"),
    **dict.fromkeys(("Tram", "Misc"), "other"),
}
"""KITTI's types and their supercategory; ids are counted from 1, in this order."""
CATEGORY_IDS = {name: i + 1 for i, name in enumerate(CATEGORIES)}


def _encode(mask: np.ndarray) -> dict[str, Any]:
    """A mask (H, W) bool as COCO's compressed run lengths."""
    return {"size": list(mask.shape), "counts": _counts(run_length.encode(np.asfortranarray(mask, np.uint8)))}


def _counts(encoded: Any) -> str:
    """pycocotools' run lengths as text: it gives bytes, whatever its types say."""
    return encoded["counts"].decode("ascii")


def _rectangle(box_xyxy: Sequence[float], height: int, width: int) -> np.ndarray:
    """The pixels (H, W) bool whose centres lie in a box."""
    left, top, right, bottom = box_xyxy
    rows, columns = np.arange(height), np.arange(width)
    return np.outer((rows >= top) & (rows <= bottom), (columns >= left) & (columns <= right))


def _kinds_of_region(box_xyxy: Sequence[float], objects: Iterable[TrackedObject]) -> tuple[str, ...]:
    """The type of the object without a label that a region covers most of; all types where it covers none."""
    left, top, right, bottom = box_xyxy

    def shared(thing: TrackedObject) -> float:
        x0, y0, x1, y1 = thing.box_ltrb
        wide, high = min(right, x1) - max(left, x0) + 1, min(bottom, y1) - max(top, y0) + 1
        union = (right - left + 1) * (bottom - top + 1) + (x1 - x0 + 1) * (y1 - y0 + 1) - wide * high
        return wide * high / union if min(wide, high) > 0 else 0.0

    best = max((o for o in objects if not o.labelled), key=shared, default=None)
    return tuple(CATEGORIES) if best is None or shared(best) == 0 else (best.kind,)


class CocoWriter:
    """Writes `images/{part}/%06d.png` and `annotations/instances_{part}.json` under `root`.

    Besides COCO's own keys an image has "camera" (fx, fy, cx, cy and projection, 3x4 row-major, px) and an
    annotation has "truncation", "visible", "occlusion", "track" and "pose" (translation m, yaw rad, size_lhw m),
    as in `Labels` and `TrackedObject`. "area" and "segmentation" are of what is visible, "bbox" is the label's
    box. A region to ignore is a crowd (iscrowd 1) of the type of the object there, or of every type where there is
    none, so that COCO's evaluation ignores it. What COCO cannot hold: depth, semantic classes, extrinsics.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def _image(self, place: Place) -> Path:
        return self.root / "images" / place.part / f"{place.number:06d}.png"

    def exists(self, place: Place) -> bool:
        """Whether the frame's image is there."""
        return self._image(place).exists()

    def write(self, place: Place, exposure: Exposure) -> dict[str, object]:
        """Write one frame's image. The entry holds its record and its annotations, whose ids `finish` gives."""
        camera = exposure.camera
        record = {
            "id": place.number + 1,
            "file_name": self._image(place).name,
            "height": camera.height,
            "width": camera.width,
            "camera": camera_entry(camera.matrix),
        }
        annotations = [*_objects(exposure), *_regions(exposure)]
        files.write_png(self._image(place), exposure.image, PNG_COMPRESSION)
        return {"number": place.number, "part": place.part, "image": record, "annotations": annotations}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write the annotations of every part that has frames, one image or annotation a line."""
        for part in sorted({entry["part"] for entry in entries}):
            chosen = [entry for entry in entries if entry["part"] == part]
            annotations = [
                {"id": i + 1, "image_id": image_id, **annotation}
                for i, (image_id, annotation) in enumerate(
                    (entry["image"]["id"], annotation) for entry in chosen for annotation in entry["annotations"]
                )
            ]
            images = [entry["image"] for entry in chosen]
            text = _text(images, annotations, CATEGORY_IDS.items(), _HEAD, "")
            files.write_text(self.root / "annotations" / f"instances_{part}.json", text)


_HEAD = '"info": {"description": "drivesem synth"},\n"licenses": [],\n'


def _text(
    images: Sequence[Any],
    annotations: Sequence[Any],
    categories: Iterable[tuple[str, int]],
    start: str = "\n",
    end: str = "\n",
) -> str:
    """A data set's file, one image or annotation a line. categories: names and ids."""
    named = [
        {"id": number, "name": name, "supercategory": CATEGORIES.get(name, "object")}
        for name, number in categories
    ]
    tables = {"images": images, "annotations": annotations, "categories": named}
    lines = {
        name: ",\n".join(_entry_text(name, i, row) for i, row in enumerate(rows)) for name, rows in tables.items()
    }
    return "{" + start + ",\n".join(f'"{name}": [\n{text}\n]' for name, text in lines.items()) + end + "}\n"


def _entry_text(table: str, place: int, row: Any) -> str:
    """An entry as JSON. FormatError for NaN and infinity, which JSON has not, in keys of another project."""
    try:
        return json.dumps(row, allow_nan=False)
    except ValueError as error:
        raise FormatError(f"{table}[{place}]", "finite numbers", "NaN or infinity") from error


def _objects(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Annotations of the labelled objects, without ids."""
    labels = exposure.labels
    for i, thing in enumerate(o for o in exposure.objects if o.labelled):
        mask = exposure.instances == thing.track + 1
        yield {
            "category_id": CATEGORY_IDS[labels.kind[i]],
            "bbox": to_coco(labels.boxes_xyxy[i].double().numpy()).tolist(),
            "area": int(mask.sum()),
            "segmentation": _encode(mask),
            "iscrowd": 0,
            "truncation": shortest(labels.truncation[i])[0],
            "visible": thing.visible,
            "occlusion": int(labels.occlusion[i]),
            "track": thing.track,
            "pose": _pose_entry(
                shortest(labels.size_lhw[i]), shortest(labels.translation[i]), *shortest(labels.yaw[i])
            ),
        }


def _regions(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Annotations of the regions to ignore, without ids."""
    for box in exposure.labels.ignore_xyxy.tolist():
        mask = _rectangle(box, exposure.camera.height, exposure.camera.width)
        region = {"bbox": to_coco(np.array(box)).tolist(), "area": int(mask.sum())}
        region |= {"segmentation": _encode(mask), "iscrowd": 1}
        for kind in _kinds_of_region(box, exposure.objects):
            yield {"category_id": CATEGORY_IDS[kind], **region}


def _pose_entry(size_lhw: Sequence[float], translation: Sequence[float], yaw: float) -> dict[str, Any]:
    return {"translation": translation, "yaw": yaw, "size_lhw": size_lhw}


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    """Write a table to a .json file, or to `annotations/instances_all.json` in a folder, with all that it holds.

    A region is a crowd of every class with "dontcare", which `read_table` makes one region again.
    """
    table.need_sizes("coco")
    table = table.in_edges("xywh")
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
        records.append(record | ({"drivesem": table.told[i]} if i in table.told else {}))
    annotations: list[dict[str, Any]] = []
    own = [] if table.box_ids is None else table.box_ids.tolist()
    free = max(own, default=0) + 1
    for row, kind in enumerate(table.kind.tolist()):
        entry = _row_entry(table, row)
        for label in [number for _, number in categories] if kind == REGION else [numbers[kind]]:
            number = free
            if own and kind != REGION:
                number = own[row]
            else:
                free += 1
            whole = {"id": number, "image_id": image_ids[table.frame[row]], "category_id": label, **entry}
            annotations.append(whole | ({"dontcare": True} if kind == REGION else {}))
    path = out if out.suffix.lower() == ".json" else out / "annotations" / "instances_all.json"
    files.write_text(path, _text(records, annotations, categories))
    folder = (path.parent if path == out else out) / "images"
    places = {identifier: folder / name for identifier, name in zip(table.frames, names, strict=True)}
    return Written.of(1 + copy_images(places, images), renamed)


def _row_entry(table: LabelTable, row: int) -> dict[str, Any]:
    """The annotation of a row but for its ids; what is not known is left out."""
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
        "pose": _pose_entry(pose[:3], pose[3:6], pose[6]) if known_pose(pose) else None,
        **{name: values[row] for name, values in table.extra.items()},
    }
    return {name: value for name, value in entry.items() if value is not None}


def images_beside(path: Path, frames: Sequence[str]) -> dict[str, Path]:
    """The images that a data set's file names, in the folder in which `CocoDataset` looks for them, or else those
    that are called as their frames there. Folders of other parts may have others of the same names. FormatError.
    """
    (path,) = files_of(path)
    folder, told = _images_of(path), AnnotationFile(path, files.read_json(path))
    names = told.frames()
    named = {names[i]: folder / name for i, name in told.file_names().items() if _stays_inside(Path(name))}
    return images_in([folder], frames) | {name: image for name, image in named.items() if isfile(image)}


def _stays_inside(file_name: Path) -> bool:
    """Whether a file's name does not lead out of the folder that it is looked for in."""
    return not (file_name.is_absolute() or ".." in file_name.parts)


@dataclass(frozen=True, slots=True)
class _Image:
    """An image of one of a data set's files. number: its place among the images; rows: its annotations' places."""

    told: AnnotationFile
    path: Path
    record: Mapping[str, Any]
    rows: list[int]


class CocoDataset(Frames[_Image]):
    """The frames of a COCO data set.

    root: the folder that holds `annotations/instances_*.json`, all of which are read, or one JSON file. images:
    where the images lie; by default `images/PART`, `PART`, `images`, `PART` with its year ("val2017") beside
    `annotations`, or the JSON's own folder, whichever is there first. focal_px: the focal length of images without
    "camera"; by default EXIF's, or a usual one. kinds: categories that are objects here, others are background;
    None: all.

    A frame's identifier is its file name without suffix, folders joined by "_". `kind` is the category's name as
    written; `COCO_ROAD_USERS` reads COCO's own. Unknown truncation and 3D boxes are NaN, unknown occlusion 3, as
    in KITTI; crowds are regions to ignore. Images are upright, as EXIF says, but where the file tells the stored
    one's size. Raises FormatError naming file and field; a frame's own faults are raised by `labels` and `frame`,
    so that the other frames can be used.
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
        paths = files_of(root)
        if not paths:
            expected = "a COCO folder, with annotations/instances_*.json, or such a file (--root FILE.json)"
            raise FormatError(str(root), expected, "neither")
        entries: dict[str, _Image] = {}
        for path in paths:
            told = AnnotationFile(path, files.read_json(path))
            folder = _images_of(path) if images is None else Path(images)
            by_image: list[list[int]] = [[] for _ in told.images.rows]
            for row, frame in enumerate(told.frame.tolist()):
                by_image[frame].append(row)
            for i, record in enumerate(told.images.rows):
                for key in ("height", "width"):
                    if type(record.get(key)) is not int or record[key] < 1:
                        found = json.dumps(record.get(key))
                        raise FormatError(told.images.at(i, key), "a positive integer", found)
                if "file_name" not in record:
                    raise FormatError(told.images.at(i, "file_name"), "a value", "none")
                name = Path(str(record["file_name"]))
                if not _stays_inside(name):
                    raise FormatError(told.images.at(i, "file_name"), f"a file in {folder}", repr(str(name)))
                identifier = identifier_of(record)
                if identifier in entries:
                    found = f"{name}, twice: open one file alone"
                    raise FormatError(told.images.at(i, "file_name"), "a name of its own", found)
                entries[identifier] = _Image(told, folder / name, record, by_image[i])
        super().__init__("the COCO file", dict(sorted(entries.items())))

    def _things(self, identifier: str) -> tuple[Rows, LabelTable, NDArray[np.int64]]:
        """A frame's annotations of the chosen kinds, these in columns, and the rows that are objects."""
        image = self._entry(identifier)
        told = image.told
        chosen = [r for r in image.rows if self._kinds is None or told.kinds[told.kind[r]] in self._kinds]
        rows = told.annotations.some(chosen)
        frame = np.zeros(len(rows), np.int64)
        table = rows.table((identifier,), told.kinds, told.category_ids, frame, told.kind[chosen], False)
        ignore = np.array([bool(row.get("iscrowd") or row.get("ignore")) for row in rows.rows], np.bool_)
        return rows, replace(table, ignore=ignore), np.flatnonzero(~ignore)

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame. FormatError naming the annotation and its field."""
        rows, table, objects = self._things(identifier)
        rows.some(objects.tolist()).check_scene()
        places = enumerate(zip(table.boxes.tolist(), table.ignore.tolist(), strict=True))
        return table.rows(firsts(tuple(box) if ignored else i for i, (box, ignored) in places)).labels()

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph, camera, labels, and masks (M, H, W) where every object has a segmentation.

        Raises FormatError naming the file and field: an image that is missing or of another size; a camera that is
        none; a segmentation that does not decode.
        """
        entry = self._entry(identifier)
        path, record = entry.told.path, entry.record
        size_hw = (record["height"], record["width"])
        image = upright_pixels(entry.path, size_hw)
        camera, told = self._camera(entry)
        labels = self.labels(identifier)
        rows, _, objects = self._things(identifier)
        rows = rows.some(objects.tolist())
        masks = None
        if all(row.get("segmentation") for row in rows.rows):
            masks = torch.zeros(len(rows), camera.height, camera.width)
            for i, row in enumerate(rows.rows):
                mask = _decode(rows.at(i, "segmentation"), row["segmentation"], masks[i].shape)
                masks[i] = torch.from_numpy(mask)
        return Frame(
            identifier=identifier,
            photograph=as_photograph(image),
            camera=camera,
            labels=labels,
            masks=masks,
            provenance={"dataset": "coco", "image": str(record["file_name"]), "folder": path.name, **told},
        )

    def _camera(self, entry: _Image) -> tuple[Camera, dict[str, str]]:
        """The camera of an image, and what its provenance says of it."""
        record, where = entry.record, f"{entry.told.path}: {entry.record['file_name']}"
        height, width = record["height"], record["width"]
        if "camera" not in record:
            focal = focal_of(entry.path, self.focal_px)
            return pinhole(height, width, focal.length_px), {"focal": str(focal)}
        camera = record["camera"] if isinstance(record["camera"], dict) else {}
        if "projection" in camera:
            values = numbers_of(f"{where}: camera.projection", camera["projection"], 12)
            projection = torch.tensor(values).reshape(3, 4)
            intrinsics = projection[:, :3].clone()
        else:
            fx, fy, cx, cy = numbers_of(
                f"{where}: camera fx, fy, cx, cy", [camera.get(k) for k in ("fx", "fy", "cx", "cy")], 4
            )
            projection, intrinsics = None, torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            return Camera(intrinsics, height, width, projection), {}
        except SceneError as error:
            raise FormatError(f"{where}: {error.field}", error.expected, error.actual) from error


def _images_of(path: Path) -> Path:
    """Where the images of an annotation file lie; see `CocoDataset`."""
    part = path.stem.removeprefix("instances_")
    root = path.parent.parent if path.parent.name == "annotations" else path.parent
    candidates = (root / "images" / part, root / part, root / "images")
    return next((folder for folder in candidates if folder.is_dir()), path.parent)


def _runs(counts: str) -> list[int]:
    """COCO's compressed run lengths: 6 bits a character, 5 of them value, the sixth "more follows"; from the third
    on, differences to the run before last (pycocotools, rleFrString). ValueError where the text ends too early.
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


def _decode(where: str, segmentation: Any, size_hw: Sequence[int]) -> np.ndarray:
    """A mask (H, W) uint8 of run lengths, compressed or not, or of polygons. FormatError."""
    height, width = size_hw
    counts: Any = None
    if isinstance(segmentation, list):
        for i, polygon in enumerate(segmentation):
            corners = numbers_of(f"{where}[{i}]", polygon, len(polygon) if isinstance(polygon, list) else 6)
            if len(corners) < 6 or len(corners) % 2 or max(map(abs, corners)) > 2 * max(height, width):
                raise FormatError(f"{where}[{i}]", "x and y of three or more corners", json.dumps(polygon)[:60])
        counts = _counts(run_length.merge(run_length.frPyObjects(segmentation, height, width)))
    elif isinstance(segmentation, dict) and segmentation.get("size") == [height, width]:
        counts = segmentation.get("counts")
    else:
        raise FormatError(where, f"polygons, or run lengths of {width}x{height} px", json.dumps(segmentation)[:60])
    try:
        runs = np.array(_runs(counts) if isinstance(counts, str) else counts, dtype=np.int64)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(f"{where}.counts", "run lengths", error) from error
    # checked and laid out here: pycocotools leaves memory as it was where runs do not fill the image
    if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
        raise FormatError(f"{where}.counts", f"runs that fill {height * width} px", f"{runs.sum()} px")
    return np.repeat(np.arange(len(runs)) % 2, runs).reshape(width, height).T.astype(np.uint8)
