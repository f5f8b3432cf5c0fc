"""YOLO's folders: `images/{train,val}`, `labels/{train,val}/000000.txt` and `data.yaml`, written and read.

A label line is `class cx cy w h`: 0-based class, box centre and size as shares of the image's width and height
(docs.ultralytics.com/datasets/detect), whose pixel column j spans [j, j + 1]; here it spans [j - 0.5, j + 0.5].
YOLO holds no masks, poses, truncation, occlusion, tracks, depth and classes, and nothing can be ignored: objects
too small or too hidden to be labelled are background. The camera is written beside it, in KITTI's form, as
`calib/{train,val}/000000.txt`, which other readers of YOLO do not look at.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from drivesem.data.coco import CATEGORIES, CATEGORY_IDS
from drivesem.data.frames import (
    PNG_COMPRESSION,
    Frames,
    as_photograph,
    check_focal,
    images_of,
    pinhole,
)
from drivesem.data.kitti import finite_number, format_calib, read_calib
from drivesem.data.label_table import REGION, LabelTable, Written, copy_images, matrix_of, positional, to_coco
from drivesem.data.photographs import focal_of, upright_pixels, upright_size
from drivesem.data.truth import Exposure, Place
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Camera, Frame, Labels

DECIMALS = 8
"""Of a whole data set's shares: 1e-8 of 4000 px is 4e-5 px."""
TABLE_DECIMALS = 15
"""Of a table's shares, all that float64 has: in 4000 px that is 4e-12 px, far below other files' decimals."""
PARTS = ("train", "val", "test")
"""Keys of `data.yaml` that name images."""
_DIGITS = 18
"""Of a class number: Python makes no number of thousands."""
EDGE = 1e-4
"""How far beyond the image a share may reach: rounding."""


class YoloWriter:
    """Writes `images`, `labels` and `calib` of parts "train" and "val", and `data.yaml`, under `root`.

    Classes are KITTI's types in the order of `coco.CATEGORIES`, from 0.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def _path(self, folder: str, place: Place, suffix: str) -> Path:
        return self.root / folder / place.part / f"{place.number:06d}{suffix}"

    def exists(self, place: Place) -> bool:
        """Whether the frame is there: its image is written last."""
        return self._path("images", place, ".png").exists()

    def write(self, place: Place, exposure: Exposure) -> dict[str, object]:
        """Write one frame, the image last."""
        labels, camera = exposure.labels, exposure.camera
        boxes = to_coco(labels.boxes_xyxy.double().numpy()).tolist()
        size_wh = (camera.width, camera.height)
        lines = [
            _line(CATEGORY_IDS[kind] - 1, box, size_wh, DECIMALS)
            for kind, box in zip(labels.kind, boxes, strict=True)
        ]
        files.write_text(self._path("calib", place, ".txt"), format_calib(camera.matrix))
        files.write_text(self._path("labels", place, ".txt"), "".join(f"{line}\n" for line in lines))
        files.write_png(self._path("images", place, ".png"), exposure.image, PNG_COMPRESSION)
        return {"number": place.number, "part": place.part}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write `data.yaml`. Loaders need "train" and "val": a part without frames is the other one."""
        found = sorted({entry["part"] for entry in entries})
        if not found:
            raise RangeError("frames of the data set", "at least one", 0)
        parts = {part: f"images/{part if part in found else found[0]}" for part in ("train", "val")}
        _write_yaml(self.root, parts, tuple(CATEGORIES))


def _write_yaml(root: Path, parts: Mapping[str, str], kinds: Sequence[str]) -> None:
    content = {**parts, "nc": len(kinds), "names": dict(enumerate(kinds))}
    files.write_text(root / "data.yaml", yaml.safe_dump(content, sort_keys=False))


def _line(label: int, box_xywh: Sequence[float], size_wh: Sequence[int], decimals: int) -> str:
    """A label line of a box in COCO's pixels, without a score."""
    (x, y, w, h), (width, height) = box_xywh, size_wh
    shares = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
    return " ".join([str(label), *(f"{share:.{decimals}f}" for share in shares)])


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> Written:
    """Write a table's objects that have an area as part "train" and "val" of a data set. Boxes that reach beyond
    the image are cut at its edge, as readers take no share above 1; what lies beyond is left out.
    """
    table.need_sizes("yolo")
    table = table.in_edges("xywh")
    names, renamed = table.file_names()
    scored = table.scored
    judged, area = ~table.ignore & (table.kind != REGION), table.boxes[:, 2:].prod(axis=1)
    boxes, cut = _inside_images(table)
    written = judged & (boxes[:, 2:] > 0).all(axis=1)
    for name, rows, size_wh in zip(names, table.by_frame(), table.sizes_wh.tolist(), strict=True):
        lines: list[str] = []
        for row in (row for row in rows if written[row]):
            line = _line(int(table.kind[row]), boxes[row].tolist(), size_wh, TABLE_DECIMALS)
            lines.append(f"{line} {positional(float(table.score[row]))}\n" if scored else f"{line}\n")
        files.write_text(out / "labels" / "train" / f"{name}.txt", "".join(lines))
    for i, camera in table.cameras.items():
        calibration = format_calib(torch.from_numpy(matrix_of(camera)))
        files.write_text(out / "calib" / "train" / f"{names[i]}.txt", calibration)
    _write_yaml(out, {"train": "images/train", "val": "images/train"}, table.kinds)
    folder = out / "images" / "train"
    places = {identifier: folder / name for identifier, name in zip(table.frames, names, strict=True)}
    drawn = np.isfinite(table.area) & ~np.isclose(table.area, area, rtol=1e-9) & written
    without = ~table.ignore & (table.boxes[:, 2:] <= 0).any(axis=1)
    more = {
        "box without area": int(without.sum()),
        "box beyond the image": int((cut & judged & ~without).sum()),
        "area of the mask": int(drawn.sum()),
    }
    count = len(names) + 1 + copy_images(places, images)
    return Written.of(count, table.lost(("score", "camera"), renamed | more))


def _inside_images(table: LabelTable) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """A table's boxes (N, 4) in COCO's pixels, cut where they reach beyond their image by more than rounding, and
    which (N,) these are. What lies beyond it has no width or height.
    """
    low, sizes_wh = table.boxes[:, :2], table.sizes_wh[table.frame]
    high = low + table.boxes[:, 2:]
    beyond = np.maximum(-low, high - sizes_wh)
    cut = np.any(beyond > EDGE / 2 * sizes_wh, axis=1)  # at both sides, and a reader still takes the width
    corner, end = np.clip(low, 0, sizes_wh), np.clip(high, 0, sizes_wh)
    return np.where(cut[:, None], np.concatenate([corner, end - corner], axis=1), table.boxes), cut


class _Text(NamedTuple):
    """A label file's lines. kinds: class numbers; boxes: left, top, width, height in COCO's pixels; scores."""

    kinds: list[int]
    boxes: list[list[float]]
    scores: list[float]


def _read_text(path: Path, kinds: Mapping[int, str], size_wh: tuple[int, int], scored: bool) -> _Text:
    """The lines `class cx cy w h`, and a score where `scored`. FormatError naming file, line and field."""
    told = _Text([], [], [])
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        parts, where = line.split(), f"{path}:{number}"
        if not parts:
            continue
        if len(parts) != 5 + scored:
            expected = "6 fields: class cx cy w h score" if scored else "5 fields: class cx cy w h"
            raise FormatError(where, expected, len(parts))
        number_text = parts[0]
        if not (number_text.isdecimal() and len(number_text) <= _DIGITS and int(number_text) in kinds):
            raise FormatError(f"{where}: class", f"one of the {len(kinds)} in names", repr(number_text))
        told.kinds.append(int(number_text))
        cx, cy, w, h = (_share(f"{where}: {name}", part) for name, part in zip(_SHARES, parts[1:5], strict=True))
        width, height = size_wh
        told.boxes.append([(cx - w / 2) * width, (cy - h / 2) * height, w * width, h * height])
        told.scores.extend(finite_number(f"{where}: score", part) for part in parts[5:])
    return told


_SHARES = ("cx", "cy", "w", "h")


def _share(where: str, text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = math.nan
    low = 0 if where.endswith((" w", " h")) else -EDGE
    if not low <= share <= 1 + EDGE:
        raise FormatError(where, "a share of the image in [0, 1]", repr(text))
    return share


def _table(
    frames: Sequence[str], kinds: Mapping[int, str], texts: Sequence[_Text], scored: bool, sizes_wh: np.ndarray
) -> LabelTable:
    """Label files as a table, one a frame."""
    place = {number: i for i, number in enumerate(kinds)}
    boxes = np.array([box for text in texts for box in text.boxes], np.float64).reshape(-1, 4)
    table = LabelTable.of(
        frames,
        list(kinds.values()),
        np.repeat(np.arange(len(texts)), [len(text.boxes) for text in texts]),
        [place[kind] for text in texts for kind in text.kinds],
        boxes,
        "xywh",
        area=boxes[:, 2] * boxes[:, 3],
        sizes_wh=sizes_wh,
    )
    return replace(table, score=np.array([s for text in texts for s in text.scores])) if scored else table


def read_table(path: Path, scored: bool, truth: LabelTable | None) -> LabelTable:
    """The labels of a data set; detections where `scored`: text files whose classes and image sizes are those of
    `truth`. FormatError.
    """
    if not scored:
        dataset = YoloDataset(path)
        return dataset.table(dataset.identifiers)
    folder = path / "labels" if (path / "labels").is_dir() else path
    paths = sorted(folder.rglob("[!.]*.txt"))
    if truth is None or not truth.sizes_wh.all():
        raise FormatError(str(path), "labels with image sizes (YOLO's or COCO's) beside it", "none")
    kinds = dict(enumerate(truth.kinds))
    size = dict(zip(truth.frames, truth.sizes_wh.tolist(), strict=True))
    for file in paths:
        if file.stem not in size:
            raise FormatError(str(file), f"a name of one of the {len(size)} labelled frames", repr(file.stem))
    texts = [_read_text(file, kinds, size[file.stem], True) for file in paths]
    if not any(text.boxes for text in texts):
        raise FormatError(str(path), "at least one detection", f"{len(paths)} empty files")
    return _table([file.stem for file in paths], kinds, texts, True, np.zeros((len(paths), 2), np.int64))


class YoloDataset(Frames[Path]):
    """The frames of a YOLO data set, all its parts together.

    root: the folder that holds `data.yaml`, or another YAML file like it. focal_px: the focal length of images
    without a file in `calib`, by default EXIF's, or a usual one. The labels of `.../images/NAME.png` are
    `.../labels/NAME.txt`; an image without such a file has no objects, as YOLO has it. A frame's identifier is its
    file name without suffix. Images are upright, as EXIF says and trainers read them.

    Truncation and 3D boxes are NaN, occlusion is 3, as what is unknown in KITTI. Raises FormatError naming file
    and field; a frame's own faults are raised by `labels` and `frame`, so that the other frames can be used.
    """

    def __init__(self, root: Path, focal_px: float | None = None) -> None:
        root = Path(root)
        check_focal(focal_px)
        self.focal_px = focal_px
        path = root / "data.yaml" if root.is_dir() else root
        content = _mapping(path)
        self.class_names = _names(path, content)
        base = path.parent / _inside(path, "path", str(content.get("path") or "."))
        folders = list(dict.fromkeys(folder for part in PARTS for folder in _folders(path, content, part)))
        if not folders:
            raise FormatError(f"{path}: train", "a folder of images", "none")
        images: dict[str, Path] = {}
        for image in (image for name in folders for image in images_of(base / name)):
            if image.stem in images:
                raise FormatError(str(image), "a name of its own", f"the name of {images[image.stem]}")
            images[image.stem] = image
        if not images:
            raise FormatError(str(base / folders[0]), "at least one .png or .jpg", "none")
        super().__init__("the YOLO folder", dict(sorted(images.items())))

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame; of its image, the header is read. FormatError naming file, line and field."""
        return self.table((identifier,)).labels()

    def table(self, identifiers: Sequence[str]) -> LabelTable:
        """The labels of some frames in columns; of their images, the headers are read. FormatError as `labels`."""
        images = [self._entry(identifier) for identifier in identifiers]
        sizes = [upright_size(image) for image in images]
        texts = [
            _read_text(path, self.class_names, size, False) if path.exists() else _Text([], [], [])
            for path, size in zip((_beside(image, "labels") for image in images), sizes, strict=True)
        ]
        table = _table(identifiers, self.class_names, texts, False, np.array(sizes, np.int64).reshape(-1, 2))
        return replace(table, image_files={i: image.name for i, image in enumerate(images)})

    def image_path(self, identifier: str) -> Path:
        """The file of a frame's image. RangeError for a frame that is not there."""
        return self._entry(identifier)

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph, camera, labels.

        Raises FormatError naming the file: an image that does not decode, or a calibration that is none.
        """
        image_path = self._entry(identifier)
        image = upright_pixels(image_path)
        height, width = image.shape[:2]
        told = {"dataset": "yolo", "image": image_path.name, "folder": image_path.parent.name}
        calib_path = _beside(image_path, "calib")
        if calib_path.exists():
            projection = read_calib(calib_path).projection
            camera = Camera(projection[:, :3].clone(), height, width, projection)
        else:
            focal = focal_of(image_path, self.focal_px)
            camera = pinhole(height, width, focal.length_px)
            told["focal"] = str(focal)
        return Frame(
            identifier=identifier,
            photograph=as_photograph(image),
            camera=camera,
            labels=self.labels(identifier),
            provenance=told,
        )


def _mapping(path: Path) -> dict[str, Any]:
    content = files.read_yaml(path)
    if not isinstance(content, dict):
        raise FormatError(str(path), "train, val and names", type(content).__name__)
    return content


def _names(path: Path, content: Mapping[str, Any]) -> dict[int, str]:
    names = content.get("names")
    pairs = dict(enumerate(names)) if isinstance(names, list) else names
    if not isinstance(pairs, dict) or not pairs or any(type(k) is not int or k < 0 for k in pairs):
        raise FormatError(f"{path}: names", "a list of classes, or number: class", repr(names)[:60])
    return {k: str(pairs[k]) for k in sorted(pairs)}


def _folders(path: Path, content: Mapping[str, Any], part: str) -> list[str]:
    value = content.get(part) or []
    folders = [value] if isinstance(value, str) else value
    if not isinstance(folders, list) or any(not isinstance(f, str) or f.endswith(".txt") for f in folders):
        raise FormatError(f"{path}: {part}", "a folder of images, or a list of folders", repr(value)[:60])
    return [_inside(path, part, folder) for folder in folders]


def _inside(path: Path, key: str, folder: str) -> str:
    """A folder that a YAML file names, if its name stays below that file's own. FormatError."""
    if Path(folder).is_absolute() or ".." in Path(folder).parts or "\0" in folder:
        raise FormatError(f"{path}: {key}", f"a folder in {path.parent}", repr(folder))
    return folder


def _beside(image: Path, folder: str) -> Path:
    """The text file of an image: the last "images" of its path is `folder`."""
    parts = list(image.parts)
    places = [i for i, part in enumerate(parts[:-1]) if part == "images"]
    if places:
        parts[places[-1]] = folder
    return Path(*parts).with_suffix(".txt")
