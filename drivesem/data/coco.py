"""COCO's `annotations/instances_*.json`: written with all that it can hold of a frame, and read from anywhere.

Boxes in the file are COCO's: x, y, width, height, where pixel column j spans [j, j + 1]. Here it spans
[j - 0.5, j + 0.5] (scene_ir/conventions.md), so x is left + 0.5. Masks are run-length encoded and exact.
Format: cocodataset.org/#format-data; pycocotools is the definition.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pycocotools import mask as run_length
from torch import Tensor

from drivesem.data.classes import ClassMap
from drivesem.data.kitti import PNG_COMPRESSION, UNKNOWN_OCCLUSION
from drivesem.data.truth import Exposure, Place, TrackedObject
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, SceneError
from scene_ir.types import Camera, Frame, Labels

CATEGORIES = {
    **dict.fromkeys(("Car", "Van", "Truck"), "vehicle"),
    **dict.fromkeys(("Pedestrian", "Cyclist", "Person_sitting"), "person"),
    **dict.fromkeys(("Tram", "Misc"), "other"),
}
"""KITTI's types and their supercategory; ids are counted from 1, in this order."""
CATEGORY_IDS = {name: i + 1 for i, name in enumerate(CATEGORIES)}
HALF_PX = 0.5
"""From this project's pixel centres at integers to COCO's pixel edges at integers."""
COCO_ROAD_USERS = ClassMap(
    classes={"car": "Car", "truck": "Truck", "person": "Pedestrian"},
    ignored={"bus": None, "train": None, "bicycle": "Cyclist", "motorcycle": "Cyclist"},
)
"""The classes of COCO 2017 that are on the road. A KITTI cyclist includes the bicycle, so that a bicycle alone is
neither; buses and trains look like nothing the detectors know."""


def to_coco(box_xyxy: Sequence[float]) -> list[float]:
    """x, y, width, height in COCO's pixels."""
    left, top, right, bottom = box_xyxy
    return [left + HALF_PX, top + HALF_PX, right - left, bottom - top]


def from_coco(box_xywh: Sequence[float]) -> list[float]:
    """Left, top, right, bottom in this project's pixels."""
    x, y, width, height = box_xywh
    return [x - HALF_PX, y - HALF_PX, x - HALF_PX + width, y - HALF_PX + height]


def _shortest(values: Tensor) -> list[float]:
    """float32 values as the shortest decimals that read back as the same float32."""
    return [float(str(v)) for v in values.to(torch.float32).flatten().numpy()]


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
        matrix = camera.matrix
        record = {
            "id": place.number + 1,
            "file_name": self._image(place).name,
            "height": camera.height,
            "width": camera.width,
            "camera": {
                **dict(zip(("fx", "fy", "cx", "cy"), _shortest(matrix[[0, 1, 0, 1], [0, 1, 2, 2]]), strict=True)),
                "projection": _shortest(matrix),
            },
        }
        annotations = [*_objects(exposure), *_regions(exposure)]
        files.write_png(self._image(place), exposure.image, PNG_COMPRESSION)
        return {"number": place.number, "part": place.part, "image": record, "annotations": annotations}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write the annotations of every part that has frames, one image or annotation a line."""
        categories = [
            {"id": CATEGORY_IDS[name], "name": name, "supercategory": kind} for name, kind in CATEGORIES.items()
        ]
        for part in sorted({entry["part"] for entry in entries}):
            chosen = [entry for entry in entries if entry["part"] == part]
            annotations = [
                {"id": i + 1, "image_id": image_id, **annotation}
                for i, (image_id, annotation) in enumerate(
                    (entry["image"]["id"], annotation) for entry in chosen for annotation in entry["annotations"]
                )
            ]
            tables = {"images": [entry["image"] for entry in chosen], "annotations": annotations}
            text = ['{"info": {"description": "drivesem synth"},\n"licenses": []']
            for name, rows in {**tables, "categories": categories}.items():
                lines = ",\n".join(json.dumps(row, allow_nan=False) for row in rows)
                text.append(f'"{name}": [\n{lines}\n]')
            files.write_text(self.root / "annotations" / f"instances_{part}.json", ",\n".join(text) + "}\n")


def _objects(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Annotations of the labelled objects, without ids."""
    labels = exposure.labels
    for i, thing in enumerate(o for o in exposure.objects if o.labelled):
        mask = exposure.instances == thing.track + 1
        yield {
            "category_id": CATEGORY_IDS[labels.kind[i]],
            "bbox": to_coco(labels.boxes_xyxy[i].tolist()),
            "area": int(mask.sum()),
            "segmentation": _encode(mask),
            "iscrowd": 0,
            "truncation": _shortest(labels.truncation[i])[0],
            "visible": thing.visible,
            "occlusion": int(labels.occlusion[i]),
            "track": thing.track,
            "pose": {
                "translation": _shortest(labels.translation[i]),
                "yaw": _shortest(labels.yaw[i])[0],
                "size_lhw": _shortest(labels.size_lhw[i]),
            },
        }


def _regions(exposure: Exposure) -> Iterable[dict[str, Any]]:
    """Annotations of the regions to ignore, without ids."""
    for box in exposure.labels.ignore_xyxy.tolist():
        mask = _rectangle(box, exposure.camera.height, exposure.camera.width)
        region = {"bbox": to_coco(box), "area": int(mask.sum()), "segmentation": _encode(mask), "iscrowd": 1}
        for kind in _kinds_of_region(box, exposure.objects):
            yield {"category_id": CATEGORY_IDS[kind], **region}


def pinhole(height: int, width: int, focal_px: float) -> Camera:
    """A camera of which only the focal length is known: its axis goes through the middle of the image."""
    centre = [(width - 1) / 2, (height - 1) / 2]
    intrinsics = torch.tensor([[focal_px, 0.0, centre[0]], [0.0, focal_px, centre[1]], [0.0, 0.0, 1.0]])
    return Camera(intrinsics, height, width)


def _numbers(where: str, value: Any, count: int) -> list[float]:
    """`count` finite numbers. FormatError."""
    good = isinstance(value, list) and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    if not good or len(value) != count:
        raise FormatError(where, f"{count} finite numbers", json.dumps(value)[:60])
    return [float(v) for v in value]


def _rows(path: Path, content: Any, name: str, keys: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of one of the file's tables, each with `keys`. FormatError."""
    rows = content.get(name) if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise FormatError(f"{path}: {name}", "a list", "none")
    for i, row in enumerate(rows):
        for key in keys:
            if not isinstance(row, dict) or key not in row:
                raise FormatError(f"{path}: {name}[{i}].{key}", "a value", "none")
    return rows


class CocoDataset:
    """The frames of a COCO data set.

    root: the folder that holds `annotations/instances_*.json`, all of which are read, or one JSON file. images:
    where the images lie; by default `images/PART`, `PART`, `images`, `PART` with its year ("val2017") beside
    `annotations`, or the JSON's own folder, whichever is there first. focal_px: the focal length of images without
    "camera". kinds: categories that are objects here, the others are background; None: all.

    A frame's identifier is its file name without suffix, folders joined by "_". `kind` is the category's name as
    written; `COCO_ROAD_USERS` reads COCO's own. Unknown truncation and 3D boxes are NaN, unknown occlusion 3, as
    in KITTI; crowds are regions to ignore. Raises FormatError naming file and field; a frame's own faults are
    raised by `labels` and `frame`, so that the other frames can be used.
    """

    def __init__(
        self,
        root: Path,
        images: Path | None = None,
        focal_px: float | None = None,
        kinds: Collection[str] | None = None,
    ) -> None:
        root = Path(root)
        if focal_px is not None and not (math.isfinite(focal_px) and focal_px > 0):
            raise RangeError("focal_px", "positive px", focal_px)
        self.focal_px = focal_px
        self._kinds = kinds
        paths = [root] if root.is_file() else sorted((root / "annotations").glob("instances_*.json"))
        if not paths:
            raise FormatError(str(root / "annotations"), "instances_*.json", "none")
        self._found: dict[str, tuple[Path, Path, dict[str, Any], list[tuple[str, dict[str, Any]]]]] = {}
        self._names: dict[Path, dict[int, str]] = {}
        for path in paths:
            self._index(path, images)
        self._identifiers = tuple(sorted(self._found))

    def _index(self, path: Path, images: Path | None) -> None:
        content = files.read_json(path)
        categories = _rows(path, content, "categories", ("id", "name"))
        self._names[path] = {row["id"]: str(row["name"]) for row in categories}
        by_image: dict[int, list[tuple[str, dict[str, Any]]]] = {}
        for i, row in enumerate(_rows(path, content, "images", ("id", "file_name", "height", "width"))):
            where = f"{path}: images[{i}]"
            if row["id"] in by_image:
                raise FormatError(f"{where}.id", "an id of its own", row["id"])
            by_image[row["id"]] = []
            for key in ("height", "width"):
                if type(row[key]) is not int or row[key] < 1:
                    raise FormatError(f"{where}.{key}", "a positive integer", json.dumps(row[key]))
            name = Path(str(row["file_name"]))
            identifier = "_".join(name.with_suffix("").parts)
            if identifier in self._found:
                raise FormatError(f"{where}.file_name", "a name of its own", f"{name}, twice: open one file alone")
            folder = _images_of(path) if images is None else Path(images)
            self._found[identifier] = (path, folder / name, row, by_image[row["id"]])
        for i, row in enumerate(_rows(path, content, "annotations", ("image_id", "category_id", "bbox"))):
            where = f"{path}: annotations[{i}]"
            if row["image_id"] not in by_image:
                raise FormatError(f"{where}.image_id", "an image's id", row["image_id"])
            if row["category_id"] not in self._names[path]:
                raise FormatError(f"{where}.category_id", "a category's id", row["category_id"])
            by_image[row["image_id"]].append((where, row))

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        return self._identifiers

    def __len__(self) -> int:
        return len(self._identifiers)

    def _entry(self, identifier: str) -> tuple[Path, Path, dict[str, Any], list[tuple[str, dict[str, Any]]]]:
        if identifier not in self._found:
            raise RangeError("frame of the COCO file", f"one of {len(self)} identifiers", repr(identifier))
        return self._found[identifier]

    def _things(self, identifier: str) -> tuple[list[tuple[str, str, dict[str, Any]]], list[list[float]]]:
        """A frame's objects (where, kind, annotation), and its regions to ignore, each once."""
        path, _, _, annotations = self._entry(identifier)
        objects: list[tuple[str, str, dict[str, Any]]] = []
        regions: list[list[float]] = []
        for where, row in annotations:
            kind = self._names[path][row["category_id"]]
            if self._kinds is not None and kind not in self._kinds:
                continue
            if not (row.get("iscrowd") or row.get("ignore")):
                objects.append((where, kind, row))
            elif (box := _box(where, row)) not in regions:
                regions.append(box)
        return objects, regions

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame. FormatError naming the annotation and its field."""
        objects, regions = self._things(identifier)
        poses = torch.tensor([_pose(where, row) for where, _, row in objects]).reshape(-1, 7)
        return Labels(
            kind=tuple(kind for _, kind, _ in objects),
            boxes_xyxy=torch.tensor([_box(where, row) for where, _, row in objects]).reshape(-1, 4),
            truncation=torch.tensor([_truncation(where, row) for where, _, row in objects]).reshape(-1),
            occlusion=torch.tensor([_occlusion(where, row) for where, _, row in objects], dtype=torch.int64),
            translation=poses[:, :3].clone(),
            yaw=poses[:, 3].clone(),
            size_lhw=poses[:, 4:].clone(),
            ignore_xyxy=torch.tensor(regions).reshape(-1, 4),
        )

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph, camera, labels, and masks (M, H, W) where every object has a segmentation.

        Raises FormatError naming the file and field: an image that is missing or of another size; an image without
        "camera" where no focal_px was given; a segmentation that does not decode.
        """
        path, image_path, record, _ = self._entry(identifier)
        camera = self._camera(f"{path}: {record['file_name']}", record)
        labels = self.labels(identifier)
        image = files.read_image(image_path, (camera.height, camera.width))
        objects, _ = self._things(identifier)
        masks = None
        if all(row.get("segmentation") for _, _, row in objects):
            masks = torch.zeros(len(objects), camera.height, camera.width)
            for i, (where, _, row) in enumerate(objects):
                masks[i] = torch.from_numpy(_decode(f"{where}.segmentation", row["segmentation"], masks[i].shape))
        return Frame(
            identifier=identifier,
            photograph=torch.from_numpy(image).permute(2, 0, 1).contiguous().to(torch.float32) / 255,
            camera=camera,
            labels=labels,
            masks=masks,
            provenance={"dataset": "coco", "image": str(record["file_name"]), "folder": path.name},
        )

    def _camera(self, where: str, record: Mapping[str, Any]) -> Camera:
        height, width = record["height"], record["width"]
        if "camera" not in record:
            if self.focal_px is None:
                raise FormatError(f"{where}: camera", "intrinsics, or a focal length (focal_px)", "neither")
            return pinhole(height, width, self.focal_px)
        camera = record["camera"] if isinstance(record["camera"], dict) else {}
        if "projection" in camera:
            values = _numbers(f"{where}: camera.projection", camera["projection"], 12)
            projection = torch.tensor(values).reshape(3, 4)
            intrinsics = projection[:, :3].clone()
        else:
            fx, fy, cx, cy = _numbers(
                f"{where}: camera fx, fy, cx, cy", [camera.get(k) for k in ("fx", "fy", "cx", "cy")], 4
            )
            projection, intrinsics = None, torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            return Camera(intrinsics, height, width, projection)
        except SceneError as error:
            raise FormatError(f"{where}: {error.field}", error.expected, error.actual) from error


def _images_of(path: Path) -> Path:
    """Where the images of an annotation file lie; see `CocoDataset`."""
    part = path.stem.removeprefix("instances_")
    root = path.parent.parent if path.parent.name == "annotations" else path.parent
    candidates = (root / "images" / part, root / part, root / "images")
    return next((folder for folder in candidates if folder.is_dir()), path.parent)


def _box(where: str, row: Mapping[str, Any]) -> list[float]:
    box = _numbers(f"{where}.bbox", row["bbox"], 4)
    if box[2] <= 0 or box[3] <= 0:
        raise FormatError(f"{where}.bbox", "a positive width and height", box)
    return from_coco(box)


def _pose(where: str, row: Mapping[str, Any]) -> list[float]:
    """Translation, yaw, size; NaN where the file has none."""
    pose = row.get("pose")
    if pose is None:
        return [math.nan] * 7
    if not isinstance(pose, dict):
        raise FormatError(f"{where}.pose", "translation, yaw and size_lhw", json.dumps(pose)[:60])
    translation = _numbers(f"{where}.pose.translation", pose.get("translation"), 3)
    yaw = _numbers(f"{where}.pose.yaw", [pose.get("yaw")], 1)
    size_lhw = _numbers(f"{where}.pose.size_lhw", pose.get("size_lhw"), 3)
    if min(size_lhw) <= 0:
        raise FormatError(f"{where}.pose.size_lhw", "positive metres", size_lhw)
    return [*translation, *yaw, *size_lhw]


def _truncation(where: str, row: Mapping[str, Any]) -> float:
    if row.get("truncation") is None:
        return math.nan
    value = _numbers(f"{where}.truncation", [row["truncation"]], 1)[0]
    if not 0 <= value <= 1:
        raise FormatError(f"{where}.truncation", "[0, 1]", value)
    return value


def _occlusion(where: str, row: Mapping[str, Any]) -> int:
    value = row.get("occlusion", UNKNOWN_OCCLUSION)
    if type(value) is not int or not 0 <= value <= UNKNOWN_OCCLUSION:
        raise FormatError(f"{where}.occlusion", "0, 1, 2 or 3", json.dumps(value))
    return value


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
            corners = _numbers(f"{where}[{i}]", polygon, len(polygon) if isinstance(polygon, list) else 6)
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
