"""YOLO's folders, `images/{train,val}`, `labels/{train,val}/000000.txt` and `data.yaml`: reader and writer.

`yolo_files` describes the folders that are read, `yolo_labels` the rows. In YOLO's pixels, column j spans [j, j + 1];
here it spans [j - 0.5, j + 0.5].
YOLO cannot hold masks, poses, truncation, occlusion, tracks, depth, semantic classes and regions to ignore: objects
too small or too hidden to be labelled are background. The camera is written in KITTI's form to
`calib/{train,val}/000000.txt`, which other readers of YOLO ignore.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from drivesem.data.account import DataAccount, account_for_files
from drivesem.data.coco import CATEGORIES, CATEGORY_IDS
from drivesem.data.ground_truth import Exposure, FrameLocation
from drivesem.data.image_headers import read_upright_size
from drivesem.data.kitti import format_calibration, read_calibration
from drivesem.data.label_table import (
    REGION,
    LabelTable,
    WriteSummary,
    copy_images,
    parse_camera_entry,
    xyxy_to_coco,
)
from drivesem.data.photographs import (
    FrameIndex,
    check_focal,
    pinhole_camera,
    read_focal_length,
    read_upright,
)
from drivesem.data.yolo_files import (
    SPLITS,
    WITHOUT_IMAGE,
    YoloDescription,
    YoloFiles,
    name_images,
    strip_split,
)
from drivesem.data.yolo_labels import EDGE, YoloRows, find_description, is_label_file, read_rows
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

DECIMALS = 8
"""Decimals of shares in generated data sets: 1e-8 of 4000 px is 4e-5 px."""
TABLE_DECIMALS = 15
"""Decimals of shares in written tables, all that float64 has: 4e-12 px of 4000 px."""


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
        files.write_png(self._path("images", location, ".png"), exposure.image)
        return {"number": location.number, "part": location.part}

    def finish(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write `data.yaml`. Loaders need "train" and "val"; a part without frames repeats the other."""
        written = sorted({entry["part"] for entry in entries})
        if not written:
            raise RangeError("frames of the data set", "at least one", 0)
        parts = {part: f"images/{part if part in written else written[0]}" for part in ("train", "val")}
        _write_yaml(self.root, parts, tuple(CATEGORIES))


def _write_yaml(root: Path, parts: Mapping[str, str | list[str]], kinds: Sequence[str]) -> None:
    content = {**parts, "nc": len(kinds), "names": dict(enumerate(kinds))}
    files.write_text(root / "data.yaml", yaml.safe_dump(content, sort_keys=False))


def _format_line(label: int, box_xywh: Sequence[float], size_wh: Sequence[int], decimals: int) -> str:
    """Format a label line of a box in COCO's pixels, without a score."""
    (x, y, w, h), (width, height) = box_xywh, size_wh
    shares = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
    return " ".join([str(label), *(f"{share:.{decimals}f}" for share in shares)])


def write_table(table: LabelTable, out: Path, images: Mapping[str, Path]) -> WriteSummary:
    """Write a table's objects with an area, classes in its order, images and labels under the images' names.

    Each split is a folder of images and one of labels; without splits all frames are "train" and "val". Boxes are
    clipped to the image, since readers refuse shares above 1.

    Args:
        table: Labels or detections.
        out: Output folder.
        images: Images to copy, by frame identifier.

    Returns:
        Counts of files, lost and assumed values.

    Raises:
        FormatError: The size of an image is unknown, or a name leads out of the folder.
    """
    table = table.with_box_format("xywh")
    table.require_sizes("yolo")
    folders = _split_folders(table)
    names = _file_names(table, folders)
    scored = table.scored
    objects, area = ~table.ignore & (table.kind != REGION), table.boxes[:, 2:].prod(axis=1)
    boxes, clipped = _clip_to_images(table)
    written = objects & (boxes[:, 2:] > 0).all(axis=1)
    paths = [f"{folder}/{name}" for folder, name in zip(folders, names, strict=True)]
    for path, rows, size_wh in zip(paths, table.rows_by_frame(), table.sizes_wh.tolist(), strict=True):
        part = slice(rows.start, rows.stop)
        columns = (written, table.kind, boxes, table.score)
        lines: list[str] = []
        for known, kind, box, score in zip(*(column[part].tolist() for column in columns), strict=True):
            if known:
                line = _format_line(kind, box, size_wh, TABLE_DECIMALS)
                # "1.0": whole numbers are track ids
                end = f" {np.format_float_positional(score, trim='0')}" if scored else ""
                lines.append(f"{line}{end}\n")
        files.write_text(out / "labels" / f"{path}.txt", "".join(lines))
    for i, camera in table.cameras.items():
        calibration = format_calibration(torch.from_numpy(parse_camera_entry(camera)))
        files.write_text(out / "calib" / f"{paths[i]}.txt", calibration)
    targets = {identifier: out / "images" / path for identifier, path in zip(table.frames, paths, strict=True)}
    splits, lists, lost = _describe_splits(table, folders)
    for split, frames in lists.items():
        lines = [f"./images/{paths[i]}{_suffix(table, i, images)}\n" for i in frames]
        files.write_text(out / f"{split}.txt", "".join(lines))
    first = next(iter(splits), "train")
    parts: dict[str, str | list[str]] = dict.fromkeys(("train", "val"), "images/train")
    parts |= {
        part: copy(splits[first]) for part in ("train", "val") if splits
    } | splits  # one list would be an alias
    _write_yaml(out, parts, table.kinds)
    masked = np.isfinite(table.area) & ~np.isclose(table.area, area, rtol=1e-3, atol=0.01) & written
    without = ~table.ignore & (table.boxes[:, 2:] <= 0).any(axis=1)
    more = {
        "box without area": int(without.sum()),
        "box beyond the image": int((clipped & objects & ~without).sum()),
        "area of the mask": int(masked.sum()),
        "image file name": _count_renamed(table, names),
        **lost,
    }
    count = len(names) + 1 + len(lists) + len(table.cameras) + copy_images(targets, images)
    copied = [part for part in ("train", "val") if part not in (splits or ("train",))]
    assumed = {f"{part} (same images as {first})": len(table.frames) for part in copied}
    return WriteSummary.from_counts(count, table.count_lost(("score", "camera"), more), assumed)


def _split_folders(table: LabelTable) -> list[str]:
    """Return the folder of each frame: its first split, "rest" for frames of none, "train" without splits."""
    splits = {name: rows for name, rows in table.splits.items() if len(rows)}
    folder_of = {i: name.replace("/", "_") for name, rows in reversed([*splits.items()]) for i in rows}
    return [folder_of.get(i, "rest" if splits else "train") for i in range(len(table.frames))]


def _describe_splits(
    table: LabelTable, folders: Sequence[str]
) -> tuple[dict[str, str | list[str]], dict[str, list[int]], dict[str, int]]:
    """Return the entries of `data.yaml` by split, frames of splits that must be lists, and lost values.

    A split is a folder, or several, unless it shares only some of a folder's frames with another split.
    """
    members: dict[str, list[str]] = {}
    for name, rows in table.splits.items():
        if len(rows):
            known = next((split for split in SPLITS if name.lower().startswith(split)), "train")
            members.setdefault(known, []).append(name)
    content, lists = dict[str, str | list[str]](), dict[str, list[int]]()
    for split in sorted(members, key=SPLITS.index):
        frames = sorted({i for name in members[split] for i in table.splits[name]})
        used = list(dict.fromkeys(folders[i] for i in frames))
        if sum(folder in used for folder in folders) == len(frames):
            content[split] = f"images/{used[0]}" if len(used) == 1 else [f"images/{folder}" for folder in used]
        else:
            content[split], lists[split] = f"{split}.txt", frames
    joined = [
        name
        for split, names in members.items()
        for name in names
        if len(names) > 1 or not name.lower().startswith(split)
    ]
    lost = {
        "split": sum(len(table.splits[name]) for name in joined),
        "frame of no split (not in data.yaml)": folders.count("rest") if content else 0,
    }
    return content, lists, lost


def _file_names(table: LabelTable, folders: Sequence[str]) -> list[str]:
    """Return the path of each image below its split's folder, without suffix: its own if it is named after its frame,
    else the frame's identifier.
    """
    names: list[str] = []
    for i, identifier in enumerate(table.frames):
        own = os.path.splitext(table.image_files.get(i, ""))[0]
        flat_own, flat = own.replace("/", "_"), identifier.replace("/", "_")
        name = own if flat_own.endswith(flat) and own.count("/") >= identifier.count("/") else identifier
        name = strip_split(name) if table.splits else name
        if name.startswith("/") or ".." in name.split("/") or "\0" in name:
            raise FormatError(f"frame {identifier}", "a name below the folder of images", repr(name))
        names.append(name)
    count = Counter(zip(folders, names, strict=True))
    unique = [count[key] == 1 for key in zip(folders, names, strict=True)]
    return [name if good else frame for name, frame, good in zip(names, table.frames, unique, strict=True)]


def _count_renamed(table: LabelTable, names: Sequence[str]) -> int:
    """Count the images, of those named after their frames, that have another stem in the written data set."""
    own = {i: os.path.splitext(file)[0] for i, file in table.image_files.items()}
    own = {i: n for i, n in own.items() if n.replace("/", "_").endswith(table.frames[i].replace("/", "_"))}
    return sum(os.path.basename(name) != os.path.basename(names[i]) for i, name in own.items())


def _suffix(table: LabelTable, i: int, images: Mapping[str, Path]) -> str:
    """Return the suffix of a frame's image, in the data set that is written."""
    image = images.get(table.frames[i], Path(table.image_files.get(i, "")))
    return image.suffix or ".png"


def _clip_to_images(table: LabelTable) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Clip boxes (N, 4) in COCO's pixels that reach beyond their image by more than rounding.

    Returns the boxes and which (N,) were clipped; those wholly outside have no width or height.
    """
    low, sizes_wh = table.boxes[:, :2], table.sizes_wh[table.frame]
    high = low + table.boxes[:, 2:]
    beyond = np.maximum(-low, high - sizes_wh)
    clipped = np.any(beyond > EDGE / 2 * sizes_wh, axis=1)  # half, so that readers accept the width in any case
    if not clipped.any():
        return table.boxes, clipped
    corner, end = (np.clip(place[clipped], 0, sizes_wh[clipped]) for place in (low, high))
    boxes = table.boxes.copy()
    boxes[clipped] = np.concatenate([corner, end - corner], axis=1)
    return boxes, clipped


def read_table(
    path: Path, scored: bool, truth: LabelTable | None, size_wh: tuple[int, int] | None = None
) -> LabelTable:
    """Read labels of a data set, or detections.

    Args:
        path: Folder or description of a data set, or folder of detections.
        scored: Read detections: text files with the classes and image sizes of `truth`.
        truth: Labels of the same frames, for detections.
        size_wh: Size of all images of labels, px; by default they are opened.

    Returns:
        The labels or detections.

    Raises:
        FormatError: Names file, line and field.
    """
    if not scored:
        return YoloDataset(path).table(size_wh)
    if truth is None or not truth.sizes_wh.all():
        raise FormatError(str(path), "labels with image sizes (YOLO's or COCO's)", "none")
    if path.is_file():
        raise FormatError(str(path), "a folder of detections", "a file")
    return _read_detections(path, truth)


def _read_detections(root: Path, truth: LabelTable) -> LabelTable:
    """Read detections of labelled frames; a description in their folder names their classes, else `truth` does."""
    folder = root / "labels" if (root / "labels").is_dir() else root
    described = find_description(root)
    lists = {described} if described is not None else set[Path]()
    paths = sorted(path for path in folder.rglob("*.txt") if is_label_file(path.name) and path not in lists)
    if folder == root:
        paths = [path for path in paths if path.name not in ("train.txt", "val.txt", "test.txt")]
    kinds, numbers = truth.kinds, np.arange(len(truth.kinds))
    if described is not None:
        names = YoloDescription(described).names
        kinds = (*kinds, *(name for name in dict.fromkeys(names) if name not in kinds))
        numbers = np.array([kinds.index(name) for name in names], np.int64)
    frames = _match_frames(folder, paths, truth)
    rows = read_rows([f"{path}" for path in paths], len(numbers), True)
    if not len(rows.file):
        raise FormatError(str(root), "at least one detection", f"{len(paths)} empty files")
    size = dict(zip(truth.frames, truth.sizes_wh.tolist(), strict=True))
    sizes = np.array([size[frame] for frame in frames], np.int64).reshape(-1, 2)
    table = _to_table(frames, kinds, numbers, rows, sizes)
    count, skipped = account_for_files(root, [*paths, *lists])
    account = DataAccount("yolo", len(paths), count, skipped, _count_classes(table), repairs=dict(rows.repairs))
    return replace(table, score=rows.score, sizes_wh=np.zeros_like(sizes), account=account)


def _match_frames(folder: Path, paths: Sequence[Path], truth: LabelTable) -> list[str]:
    """Return the frame of each file of detections, by its path below the folder, else by its stem."""
    known = set(truth.frames)
    by_stem: dict[str, list[str]] = {}
    for frame in truth.frames:
        by_stem.setdefault(frame.rpartition("/")[2], []).append(frame)
    file_of: dict[str, Path] = {}
    for path in paths:
        names = (path.relative_to(folder).with_suffix("").as_posix(), path.stem)
        matches = [name for name in names if name in known] or by_stem.get(path.stem, [])
        if not matches or (len(matches) > 1 and matches[0] not in names):
            found = f"{path.stem!r}" if not matches else f"{path.stem!r}, the name of {len(matches)} frames"
            raise FormatError(str(path), f"a name of one of the {len(known)} labelled frames", found)
        if matches[0] in file_of:
            raise FormatError(str(path), "one file of detections for a frame", f"also {file_of[matches[0]]}")
        file_of[matches[0]] = path
    return list(file_of)


def _to_table(
    frames: Sequence[str],
    kinds: Sequence[str],
    kind_of_number: NDArray[np.int64],
    rows: YoloRows,
    sizes_wh: NDArray[np.int64],
) -> LabelTable:
    """Convert rows to a table.

    Args:
        frames: Identifiers of the files' frames (F,).
        kinds: Class names.
        kind_of_number: Index in `kinds` of each class number.
        rows: Rows of the files.
        sizes_wh: Sizes of the images (F, 2) px.

    Returns:
        The table, in COCO's pixels, without scores.
    """
    scale = np.tile(sizes_wh[rows.file], 2).astype(np.float64)
    low = (rows.shares[:, :2] - rows.shares[:, 2:] / 2) * scale[:, :2]
    boxes = np.concatenate([low, rows.shares[:, 2:] * scale[:, 2:]], axis=1)
    known = np.isfinite(rows.track).any()
    tracks = [None if math.isnan(track) else int(track) for track in rows.track.tolist()] if known else []
    return LabelTable.from_columns(
        frames,
        kinds,
        rows.file,
        kind_of_number[rows.kind],
        boxes,
        "xywh",
        area=boxes[:, 2] * boxes[:, 3],
        sizes_wh=sizes_wh,
        extra={"track": tracks} if known else {},
    )


def _count_classes(table: LabelTable) -> dict[str, int]:
    """Count the boxes of the classes that occur."""
    counts = np.bincount(table.kind, minlength=len(table.kinds)).tolist()
    return {name: count for name, count in zip(table.kinds, counts, strict=True) if count}


class YoloDataset(FrameIndex[str]):
    """The frames of a YOLO data set, all its splits together.

    An image without a label file has no objects. Images are turned upright by EXIF, as trainers read them.
    Truncation and 3D boxes are NaN, occlusion is 3, KITTI's values for unknown.

    Args:
        root: Folder with `data.yaml`, `obj.data` or `classes.txt`, or another YAML file of that form.
        focal_px: Focal length of images without a file in `calib`; by default EXIF's, or DEFAULT_FOCAL.

    Raises:
        FormatError: Names file and field. A frame's own faults are raised by `labels` and `frame` only.
    """

    def __init__(self, root: Path, focal_px: float | None = None) -> None:
        check_focal(focal_px)
        self.focal_px = focal_px
        self._files = YoloFiles(Path(root))
        self._files.check_pairs()
        self.class_names = self._files.names
        identifiers, names = name_images(self._files)
        self._file_names = dict(zip(identifiers, names, strict=True))
        super().__init__("the YOLO folder", dict(sorted(zip(identifiers, self._files.images, strict=True))))

    def splits(self) -> dict[str, tuple[str, ...]]:
        """Identifiers by split; empty for a data set without splits."""
        identifier_of = {image: identifier for identifier, image in self._entries.items()}
        return {
            name: tuple(sorted(identifier_of[image] for image in images if image in identifier_of))
            for name, images in self._files.splits.items()
            if name
        }

    def account(self) -> DataAccount:
        """Account for all files and label rows; reads all labels, and no image."""
        rows = self._read_rows(self.identifiers)
        return self._account(rows, _to_kinds(self.class_names)[rows.kind])

    def _account(self, rows: YoloRows, kind: NDArray[np.int64]) -> DataAccount:
        images, found = self._entries.values(), self._files
        labels = [found.label_path(image) for image in images if found.has_labels(image)]
        cameras = [path for image in images if (path := found.calibration_path(image)) is not None]
        unpaired = found.find_unpaired_labels()
        read = [*images, *labels, *cameras, *map(str, found.described_by)]
        reasons = found.reasons | dict.fromkeys(unpaired, WITHOUT_IMAGE)
        count, skipped = account_for_files(found.root, read, reasons)
        counts = np.bincount(kind, minlength=len(self.class_names)).tolist()
        return DataAccount(
            "yolo",
            len(self),
            count,
            skipped,
            {name: n for name, n in zip(self.class_names, counts, strict=True) if n},
            unlabelled=len(self) - len(labels),
            without_image=len(unpaired),
            splits={name: len(identifiers) for name, identifiers in self.splits().items()},
            unused_keys=tuple(found.unused_keys),
            repairs=dict(found.repairs + rows.repairs),
        )

    def _read_rows(self, identifiers: Sequence[str]) -> YoloRows:
        """Read the label files of frames; a row's file is the index of its frame."""
        images = [self._entry(identifier) for identifier in identifiers]
        labelled = [i for i, image in enumerate(images) if self._files.has_labels(image)]
        paths = [self._files.label_path(images[i]) for i in labelled]
        rows = read_rows(paths, len(self.class_names), False, self._files.keypoints)
        return replace(rows, file=np.array(labelled, np.int64)[rows.file])

    def labels(self, identifier: str) -> Labels:
        """Read the labels of one frame and its image's header. Raises FormatError naming file, line and field."""
        return self._make_table((identifier,), self._read_rows((identifier,))).to_labels()

    def table(self, size_wh: tuple[int, int] | None = None) -> LabelTable:
        """Read the labels of all frames, and their images' headers, unless `size_wh` is the size of all, px.

        Raises FormatError as `labels`.
        """
        rows = self._read_rows(self.identifiers)
        table = self._make_table(self.identifiers, rows, size_wh)
        position = {identifier: i for i, identifier in enumerate(self.identifiers)}
        return replace(
            table,
            image_files={i: self._file_names[identifier] for identifier, i in position.items()},
            image_paths={i: Path(self._entry(identifier)) for identifier, i in position.items()},
            splits={name: [position[i] for i in identifiers] for name, identifiers in self.splits().items()},
            account=self._account(rows, table.kind),
        )

    def _make_table(
        self, identifiers: Sequence[str], rows: YoloRows, size_wh: tuple[int, int] | None = None
    ) -> LabelTable:
        read = ([*(size_wh or read_upright_size(Path(self._entry(name))))] for name in identifiers)
        sizes = np.array([*read], np.int64).reshape(-1, 2)
        return _to_table(identifiers, self.class_names, _to_kinds(self.class_names), rows, sizes)

    def image_path(self, identifier: str) -> Path:
        """Return a frame's image file. Raises RangeError for an unknown frame."""
        return Path(self._entry(identifier))

    def frame(self, identifier: str) -> Frame:
        """Read one frame: photograph, camera, labels. Raises FormatError naming a damaged file."""
        image_path = self.image_path(identifier)
        image = read_upright(image_path)
        height, width = image.shape[:2]
        provenance = {"dataset": "yolo", "image": image_path.name, "folder": image_path.parent.name}
        calib_path = self._files.calibration_path(self._entry(identifier))
        if calib_path is not None:
            projection = read_calibration(Path(calib_path)).projection
            camera = Camera(projection[:, :3].clone(), height, width, projection)
        else:
            focal = read_focal_length(image_path, self.focal_px)
            camera = pinhole_camera(height, width, focal.length_px)
            provenance["focal"] = str(focal)
        return Frame(identifier, to_tensor(image), camera, self.labels(identifier), provenance=provenance)


def _to_kinds(names: Sequence[str]) -> NDArray[np.int64]:
    """Return the index of the first class with its name, for each class number (C,)."""
    return np.array([names.index(name) for name in names], np.int64)
