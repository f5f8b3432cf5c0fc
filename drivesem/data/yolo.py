"""YOLO's folders, `images/{train,val}`, `labels/{train,val}/000000.txt` and `data.yaml`: reader and writer.

A label line is `class cx cy w h`: 0-based class, box centre and size as shares of the image's width and height
(docs.ultralytics.com/datasets/detect). Its pixel column j spans [j, j + 1]; here it spans [j - 0.5, j + 0.5].
YOLO cannot hold masks, poses, truncation, occlusion, tracks, depth, semantic classes and regions to ignore: objects
too small or too hidden to be labelled are background. The camera is written in KITTI's form to
`calib/{train,val}/000000.txt`, which other readers of YOLO ignore.
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
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.kitti import finite_number, format_calibration, read_calibration
from drivesem.data.label_table import (
    REGION,
    LabelTable,
    WriteSummary,
    copy_images,
    format_shortest,
    parse_camera_entry,
    xyxy_to_coco,
)
from drivesem.data.photographs import (
    PNG_COMPRESSION,
    FrameIndex,
    check_focal,
    list_images,
    pinhole_camera,
    read_focal_length,
    read_upright,
    read_upright_size,
)
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

DECIMALS = 8
"""Decimals of shares in generated data sets: 1e-8 of 4000 px is 4e-5 px."""
TABLE_DECIMALS = 15
"""Decimals of shares in written tables, all that float64 has: 4e-12 px of 4000 px."""
PARTS = ("train", "val", "test")
"""Keys of `data.yaml` for folders of images."""
_DIGITS = 18
"""Limit of digits of a class number; Python refuses thousands."""
EDGE = 1e-4
"""How far a share may reach beyond the image, because of rounding."""


class YoloWriter:
    """Writes `images`, `labels` and `calib` of parts "train" and "val", and `data.yaml`, under `root`.

    Classes are KITTI's types in the order of `coco.CATEGORIES`, from 0.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def _path(self, folder: str, location: FrameLocation, suffix: str) -> Path:
        return self.root / folder / location.part / f"{location.number:06d}{suffix}"

    def exists(self, location: FrameLocation) -> bool:
        """Whether the frame exists; its image is written last."""
        return self._path("images", location, ".png").exists()

    def write(self, location: FrameLocation, exposure: Exposure) -> dict[str, object]:
        """Write one frame, its image last."""
        labels, camera = exposure.labels, exposure.camera
        boxes = xyxy_to_coco(labels.boxes_xyxy.double().numpy()).tolist()
        size_wh = (camera.width, camera.height)
        lines = [
            _format_line(CATEGORY_IDS[kind] - 1, box, size_wh, DECIMALS)
            for kind, box in zip(labels.kind, boxes, strict=True)
        ]
        files.write_text(self._path("calib", location, ".txt"), format_calibration(camera.matrix))
        files.write_text(self._path("labels", location, ".txt"), "".join(f"{line}\n" for line in lines))
        files.write_png(self._path("images", location, ".png"), exposure.image, PNG_COMPRESSION)
        return {"number": location.number, "part": location.part}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write `data.yaml`. Loaders need "train" and "val"; a part without frames repeats the other."""
        written = sorted({entry["part"] for entry in entries})
        if not written:
            raise RangeError("frames of the data set", "at least one", 0)
        parts = {part: f"images/{part if part in written else written[0]}" for part in ("train", "val")}
        _write_yaml(self.root, parts, tuple(CATEGORIES))


def _write_yaml(root: Path, parts: Mapping[str, str], kinds: Sequence[str]) -> None:
    content = {**parts, "nc": len(kinds), "names": dict(enumerate(kinds))}
    files.write_text(root / "data.yaml", yaml.safe_dump(content, sort_keys=False))


def _format_line(label: int, box_xywh: Sequence[float], size_wh: Sequence[int], decimals: int) -> str:
    """Format a label line of a box in COCO's pixels, without a score."""
    (x, y, w, h), (width, height) = box_xywh, size_wh
    shares = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
    return " ".join([str(label), *(f"{share:.{decimals}f}" for share in shares)])


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table's objects with an area as parts "train" and "val" of a data set.

    Boxes are clipped to the image, since readers refuse shares above 1.

    Args:
        table: Labels or detections.
        out: Output folder.
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files and lost values.

    Raises:
        FormatError: The size of an image is unknown.
    """
    table.require_sizes("yolo")
    table = table.with_box_format("xywh")
    names, renamed = table.file_names()
    scored = table.scored
    objects, area = ~table.ignore & (table.kind != REGION), table.boxes[:, 2:].prod(axis=1)
    boxes, clipped = _clip_to_images(table)
    written = objects & (boxes[:, 2:] > 0).all(axis=1)
    for name, rows, size_wh in zip(names, table.rows_by_frame(), table.sizes_wh.tolist(), strict=True):
        lines: list[str] = []
        for row in (row for row in rows if written[row]):
            line = _format_line(int(table.kind[row]), boxes[row].tolist(), size_wh, TABLE_DECIMALS)
            lines.append(f"{line} {format_shortest(float(table.score[row]))}\n" if scored else f"{line}\n")
        files.write_text(out / "labels" / "train" / f"{name}.txt", "".join(lines))
    for i, camera in table.cameras.items():
        calibration = format_calibration(torch.from_numpy(parse_camera_entry(camera)))
        files.write_text(out / "calib" / "train" / f"{names[i]}.txt", calibration)
    _write_yaml(out, {"train": "images/train", "val": "images/train"}, table.kinds)
    folder = out / "images" / "train"
    targets = {identifier: folder / name for identifier, name in zip(table.frames, names, strict=True)}
    masked = np.isfinite(table.area) & ~np.isclose(table.area, area, rtol=1e-9) & written
    without = ~table.ignore & (table.boxes[:, 2:] <= 0).any(axis=1)
    more = {
        "box without area": int(without.sum()),
        "box beyond the image": int((clipped & objects & ~without).sum()),
        "area of the mask": int(masked.sum()),
    }
    count = len(names) + 1 + copy_images(targets, images)
    return WriteSummary.from_counts(count, table.count_lost(("score", "camera"), renamed | more))


def _clip_to_images(table: LabelTable) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Clip boxes (N, 4) in COCO's pixels that reach beyond their image by more than rounding.

    Returns the boxes and which (N,) were clipped; those wholly outside have no width or height.
    """
    low, sizes_wh = table.boxes[:, :2], table.sizes_wh[table.frame]
    high = low + table.boxes[:, 2:]
    beyond = np.maximum(-low, high - sizes_wh)
    clipped = np.any(beyond > EDGE / 2 * sizes_wh, axis=1)  # half, so that readers accept the width in any case
    corner, end = np.clip(low, 0, sizes_wh), np.clip(high, 0, sizes_wh)
    return np.where(clipped[:, None], np.concatenate([corner, end - corner], axis=1), table.boxes), clipped


class _YoloLabels(NamedTuple):
    """Lines of a label file."""

    kinds: list[int]
    """Class numbers (N,)."""
    boxes: list[list[float]]
    """Left, top, width, height in COCO's pixels (N, 4)."""
    scores: list[float]
    """Scores (N,); empty for labels."""


def _read_labels(path: Path, kinds: Mapping[int, str], size_wh: tuple[int, int], scored: bool) -> _YoloLabels:
    """Read lines `class cx cy w h`, with a score if `scored`. Raises FormatError naming file, line and field."""
    labels = _YoloLabels([], [], [])
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        parts, where = line.split(), f"{path}:{number}"
        if not parts:
            continue
        if len(parts) != 5 + scored:
            expected = "6 fields: class cx cy w h score" if scored else "5 fields: class cx cy w h"
            raise FormatError(where, expected, len(parts))
        class_text = parts[0]
        if not (class_text.isdecimal() and len(class_text) <= _DIGITS and int(class_text) in kinds):
            raise FormatError(f"{where}: class", f"one of the {len(kinds)} in names", repr(class_text))
        labels.kinds.append(int(class_text))
        cx, cy, w, h = (
            _parse_share(f"{where}: {name}", part) for name, part in zip(_SHARES, parts[1:5], strict=True)
        )
        width, height = size_wh
        labels.boxes.append([(cx - w / 2) * width, (cy - h / 2) * height, w * width, h * height])
        labels.scores.extend(finite_number(f"{where}: score", part) for part in parts[5:])
    return labels


_SHARES = ("cx", "cy", "w", "h")


def _parse_share(where: str, text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = math.nan
    low = 0 if where.endswith((" w", " h")) else -EDGE
    if not low <= share <= 1 + EDGE:
        raise FormatError(where, "a share of the image in [0, 1]", repr(text))
    return share


def _to_table(
    frames: Sequence[str],
    kinds: Mapping[int, str],
    texts: Sequence[_YoloLabels],
    scored: bool,
    sizes_wh: np.ndarray,
) -> LabelTable:
    """Convert label files, one for each frame, to a table."""
    index = {number: i for i, number in enumerate(kinds)}
    boxes = np.array([box for text in texts for box in text.boxes], np.float64).reshape(-1, 4)
    table = LabelTable.from_columns(
        frames,
        list(kinds.values()),
        np.repeat(np.arange(len(texts)), [len(text.boxes) for text in texts]),
        [index[kind] for text in texts for kind in text.kinds],
        boxes,
        "xywh",
        area=boxes[:, 2] * boxes[:, 3],
        sizes_wh=sizes_wh,
    )
    return replace(table, score=np.array([s for text in texts for s in text.scores])) if scored else table


def read_table(path: Path, scored: bool, truth: LabelTable | None) -> LabelTable:
    """Read labels of a data set, or detections.

    Args:
        path: Folder or YAML file of a data set, or folder of detections.
        scored: Read detections: text files with the classes and image sizes of `truth`.
        truth: Labels of the same frames, for detections.

    Returns:
        The labels or detections.

    Raises:
        FormatError: Names file, line and field.
    """
    if not scored:
        dataset = YoloDataset(path)
        return dataset.table(dataset.identifiers)
    folder = path / "labels" if (path / "labels").is_dir() else path
    paths = sorted(folder.rglob("[!.]*.txt"))
    if truth is None or not truth.sizes_wh.all():
        raise FormatError(str(path), "labels with image sizes (YOLO's or COCO's)", "none")
    kinds = dict(enumerate(truth.kinds))
    size = dict(zip(truth.frames, truth.sizes_wh.tolist(), strict=True))
    for file in paths:
        if file.stem not in size:
            raise FormatError(str(file), f"a name of one of the {len(size)} labelled frames", repr(file.stem))
    texts = [_read_labels(file, kinds, size[file.stem], True) for file in paths]
    if not any(text.boxes for text in texts):
        raise FormatError(str(path), "at least one detection", f"{len(paths)} empty files")
    return _to_table([file.stem for file in paths], kinds, texts, True, np.zeros((len(paths), 2), np.int64))


class YoloDataset(FrameIndex[Path]):
    """The frames of a YOLO data set, all its parts together.

    The labels of `.../images/NAME.png` are `.../labels/NAME.txt`; an image without such a file has no objects. A
    frame's identifier is its file name without suffix. Images are turned upright by EXIF, as trainers read them.
    Truncation and 3D boxes are NaN, occlusion is 3, KITTI's values for unknown.

    Args:
        root: Folder with `data.yaml`, or another YAML file of that form.
        focal_px: Focal length of images without a file in `calib`; by default EXIF's, or DEFAULT_FOCAL.

    Raises:
        FormatError: Names file and field. A frame's own faults are raised by `labels` and `frame` only.
    """

    def __init__(self, root: Path, focal_px: float | None = None) -> None:
        root = Path(root)
        check_focal(focal_px)
        self.focal_px = focal_px
        path = root / "data.yaml" if root.is_dir() else root
        content = _read_mapping(path)
        self.class_names = _parse_names(path, content)
        base = path.parent / _check_inside(path, "path", str(content.get("path") or "."))
        folders = list(dict.fromkeys(folder for part in PARTS for folder in _image_folders(path, content, part)))
        if not folders:
            raise FormatError(f"{path}: train", "a folder of images", "none")
        images: dict[str, Path] = {}
        for image in (image for name in folders for image in list_images(base / name)):
            if image.stem in images:
                raise FormatError(str(image), "a unique name", f"the name of {images[image.stem]}")
            images[image.stem] = image
        if not images:
            raise FormatError(str(base / folders[0]), "at least one .png or .jpg", "none")
        super().__init__("the YOLO folder", dict(sorted(images.items())))

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame and its image's header. Raises FormatError naming file, line and field."""
        return self.table((identifier,)).to_labels()

    def table(self, identifiers: Sequence[str]) -> LabelTable:
        """Read the labels of frames in columns, and their images' headers. Raises FormatError as `labels`."""
        images = [self._entry(identifier) for identifier in identifiers]
        sizes = [read_upright_size(image) for image in images]
        texts = [
            _read_labels(path, self.class_names, size, False) if path.exists() else _YoloLabels([], [], [])
            for path, size in zip((_sibling_file(image, "labels") for image in images), sizes, strict=True)
        ]
        table = _to_table(identifiers, self.class_names, texts, False, np.array(sizes, np.int64).reshape(-1, 2))
        return replace(table, image_files={i: image.name for i, image in enumerate(images)})

    def image_path(self, identifier: str) -> Path:
        """Return a frame's image file. Raises RangeError for an unknown frame."""
        return self._entry(identifier)

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels. Raises FormatError naming a damaged file."""
        image_path = self._entry(identifier)
        image = read_upright(image_path)
        height, width = image.shape[:2]
        provenance = {"dataset": "yolo", "image": image_path.name, "folder": image_path.parent.name}
        calib_path = _sibling_file(image_path, "calib")
        if calib_path.exists():
            projection = read_calibration(calib_path).projection
            camera = Camera(projection[:, :3].clone(), height, width, projection)
        else:
            focal = read_focal_length(image_path, self.focal_px)
            camera = pinhole_camera(height, width, focal.length_px)
            provenance["focal"] = str(focal)
        return Frame(identifier, to_tensor(image), camera, self.labels(identifier), provenance=provenance)


def _read_mapping(path: Path) -> dict[str, Any]:
    content = files.read_yaml(path)
    if not isinstance(content, dict):
        raise FormatError(str(path), "train, val and names", type(content).__name__)
    return content


def _parse_names(path: Path, content: Mapping[str, Any]) -> dict[int, str]:
    names = content.get("names")
    pairs = dict(enumerate(names)) if isinstance(names, list) else names
    if not isinstance(pairs, dict) or not pairs or any(type(k) is not int or k < 0 for k in pairs):
        raise FormatError(f"{path}: names", "a list of classes, or number: class", repr(names)[:60])
    return {k: str(pairs[k]) for k in sorted(pairs)}


def _image_folders(path: Path, content: Mapping[str, Any], part: str) -> list[str]:
    value = content.get(part) or []
    folders = [value] if isinstance(value, str) else value
    if not isinstance(folders, list) or any(not isinstance(f, str) or f.endswith(".txt") for f in folders):
        raise FormatError(f"{path}: {part}", "a folder of images, or a list of folders", repr(value)[:60])
    return [_check_inside(path, part, folder) for folder in folders]


def _check_inside(path: Path, key: str, folder: str) -> str:
    """Return a folder that a YAML file names. Raises FormatError if it is not below that file's folder."""
    if Path(folder).is_absolute() or ".." in Path(folder).parts or "\0" in folder:
        raise FormatError(f"{path}: {key}", f"a folder in {path.parent}", repr(folder))
    return folder


def _sibling_file(image: Path, folder: str) -> Path:
    """Return the text file of an image: the last "images" of its path becomes `folder`."""
    parts = list(image.parts)
    positions = [i for i, part in enumerate(parts[:-1]) if part == "images"]
    if positions:
        parts[positions[-1]] = folder
    return Path(*parts).with_suffix(".txt")
