"""BDD100K's JSON files of boxes, in all official forms: reader, without torch.

Forms (doc.bdd100k.com/format.html): a list of frames, as in `bdd100k_labels_images_train.json` of 2018 and
`det_train.json`; the same list as "frames" of an object; and one file for each image with frames[0].objects, as in
`labels/100k/train/NAME.json`. Splits are named by the file or its folders. An image is found by its name below the data
set, in a folder of its split if there is one, as in `images/100k/train` or `images/train`.

box2d has pixel edges: COCO's x = x1, y = y1, width = x2 - x1, height = y2 - y1. Boxes are of the upright image; where
a frame states the size of the stored, unturned image only, they are turned. Labels without a box (lanes, drivable
areas) are background. A label that is occluded has KITTI's occlusion 1 (partly occluded), one that is not has 0. One
that is not truncated has truncation 0; otherwise it is unknown, since the share is not stated. Crowds and ignored
labels are regions to ignore.
"""

from __future__ import annotations

import os
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.data.account import DataAccount, account_for_files
from drivesem.data.coco_labels import read_turn, turn_boxes
from drivesem.data.image_headers import read_upright_size
from drivesem.data.image_index import SPLITS, FileIndex, IndexedFile, image_stem, name_uniquely
from drivesem.data.label_table import LabelTable
from scene_ir import files
from scene_ir.errors import FormatError

_HEAD_BYTES = 1 << 16
_LIST_START = re.compile(r'\s*(?:\{\s*"frames"\s*:\s*)?\[')
_LIST_KEY = re.compile(rb'"(?:labels|attributes|videoName)"\s*:')
_OBJECT_KEY = re.compile(rb'"labels"\s*:\s*(?:\[|null)|"(?:box2d|poly2d|timeofday|timestamp)"\s*:')
_FRAMES_KEY, _NAME_KEY = re.compile(rb'"frames"\s*:\s*\['), re.compile(rb'"name"\s*:')
_COCO_KEY = re.compile(rb'"(?:images|annotations|image_id|bbox)"\s*:')
_SINGLE_KEY = re.compile(rb'"objects"\s*:')
_MAX_OBJECT_BYTES = 1 << 26
"""Size up to which an object with frames is read whole."""
_LISTS = ("det_", "bdd100k_labels_images_", "")
"""Beginnings of the names of files with lists of frames. Only the first kind that occurs is read: all name the same
images."""
_OTHER_TASKS = ("lane_", "drivable_", "sem_seg_", "ins_seg_", "pan_seg_", "pose_")
"""Beginnings of the names of files without boxes of all objects."""
_MASK_FOLDERS = ("labels", "color_labels", "drivable", "masks", "colormaps", "bitmasks")
_CORNERS = ("x1", "y1", "x2", "y2")
_MAX_COORDINATE = 2.0**31
"""Exclusive limit of box coordinates and image sides, px."""
_OWN_ATTRIBUTES = ("occluded", "truncated", "crowd", "ignored")
"""Attributes of labels that are read; others go to the column "attributes"."""
_READ_KEYS = {"id", "category", "attributes", "box2d", "manualShape", "manualAttributes"}
"""Keys of labels that are read, or do not concern the box."""


def is_label_file(path: Path) -> bool:
    """Whether a JSON file begins as one of BDD100K's forms."""
    return _rank(path) is not None


def _rank(path: Path) -> int | None:
    """Return the place of a file's kind in `_LISTS`, or after them for a single image; None for other files."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()
    except OSError:
        return None
    is_list, is_object = head[:1] == b"[" and head[1:].lstrip()[:1] == b"{", head[:1] == b"{"
    if path.name.startswith(_OTHER_TASKS) or not (is_list or is_object) or not _NAME_KEY.search(head):
        return None
    if is_list and (not _LIST_KEY.search(head) or _COCO_KEY.search(head)):
        return None
    if is_object and not (_FRAMES_KEY.search(head) and _OBJECT_KEY.search(head)):
        return None
    if is_object and _SINGLE_KEY.search(head):
        return len(_LISTS)
    return next(i for i, start in enumerate(_LISTS) if path.name.startswith(start))


def _split_of(file: IndexedFile, rank: int) -> str:
    """Return the split that a list's name, or else a file's innermost folder, states; "" if neither does."""
    words = re.split(r"[_.-]", file.path.stem) if rank < len(_LISTS) else []
    return next((word for word in reversed(words) if word in SPLITS), file.split)


def _read_frames(path: Path) -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Yield where a frame stands, the frame, and its list of labels. Raises FormatError for another form."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()
    is_object, shared = head[:1] == b"{", dict[str, Any]()
    if is_object and (files.check_regular_file(path) <= _MAX_OBJECT_BYTES or b'"frames"' not in head[:64]):
        content = files.read_json(path)
        items, config = content.get("frames"), content.get("config")
        if not isinstance(items, list):
            raise FormatError(f"{path}: frames", "a list", type(items).__name__)
        if isinstance(config, dict) and config.get("imageSize"):
            shared = {"size": config["imageSize"]}
        if len(items) == 1 and isinstance(items[0], dict) and "name" not in items[0]:  # of a single image
            frame = {"name": path.stem, **{k: v for k, v in content.items() if k != "frames"}}
            yield f"{path}", frame, items[0].get("objects")
            return
    else:
        items = files.iterate_json_list(path, _LIST_START)
    for i, frame in enumerate(items):
        where = f"{path}[{i}]"
        if not isinstance(frame, dict):
            raise FormatError(where, "a frame with name and labels", type(frame).__name__)
        yield where, {**shared, **frame}, frame.get("labels")


def _read_numbers(holder: Any, names: Sequence[str]) -> list[float] | None:
    """Return the values of an object's keys; None unless all are finite numbers of a moderate size."""
    values: list[Any] = [holder.get(name) for name in names] if isinstance(holder, dict) else [None]
    good = all(type(value) in (int, float) and abs(value) < _MAX_COORDINATE for value in values)  # False for NaN
    return values if good else None


class _Rows:
    """Frames and labels, in columns that grow."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.attributes: list[Mapping[str, str]] = []
        self.sizes = array("q")
        self.ends = array("q")  # number of labels up to the end of each frame
        self.kinds: dict[str, int] = {}
        self.kind, self.boxes = array("q"), array("d")
        self.ignore, self.truncation, self.occlusion = array("b"), array("d"), array("q")
        self.others: list[Mapping[str, Any] | None] = []
        self.repairs: Counter[str] = Counter()
        self.unused: set[str] = set()
        self._equal: dict[str, Any] = {}  # one object for equal attributes

    def add(self, where: str, frame: Mapping[str, Any], labels: Any) -> None:
        """Add a frame. Raises FormatError naming the label and its field."""
        name = frame.get("name")
        if not isinstance(name, str) or not image_stem(name):
            raise FormatError(f"{where}.name", "the name of an image", repr(name))
        if labels is not None and not isinstance(labels, list):
            raise FormatError(f"{where}.labels", "a list", type(labels).__name__)
        stated = frame.get("attributes")
        stated = stated if isinstance(stated, dict) else {}
        values = {key: str(value) for key, value in stated.items() if isinstance(value, str | int | float)}
        sides = _read_numbers(frame.get("size"), ("width", "height")) or [0]
        for j, label in enumerate(labels or ()):
            self._add_label(f"{where}.labels[{j}]", label)
        self.names.append(name)
        self.attributes.append(self._share(values))
        self.sizes.extend([int(side) for side in sides] if min(sides) > 0 else [0, 0])
        self.ends.append(len(self.kind))

    def _add_label(self, where: str, label: Any) -> None:
        if not isinstance(label, dict) or not isinstance(label.get("category"), str):
            raise FormatError(f"{where}.category", "the name of a class", repr(label)[:60])
        category, box = label["category"], label.get("box2d")
        if box is None:
            self.repairs[f"{category} without a box"] += 1
            return
        self.unused.update(label.keys() - _READ_KEYS)
        corners = _read_numbers(box, _CORNERS)
        if corners is None:
            raise FormatError(f"{where}.box2d", "x1, y1, x2, y2: finite numbers", repr(box)[:60])
        x1, y1, x2, y2 = corners
        if x2 < x1 or y2 < y1:
            self.repairs["boxes with exchanged corners"] += 1
            x1, x2, y1, y2 = min(x1, x2), max(x1, x2), min(y1, y2), max(y1, y2)
        stated = label.get("attributes")
        stated = stated if isinstance(stated, dict) else {}
        self.kind.append(self.kinds.setdefault(category, len(self.kinds)))
        self.boxes.extend((x1, y1, x2 - x1, y2 - y1))
        self.ignore.append(any(bool(holder.get(n)) for holder in (label, stated) for n in ("crowd", "ignored")))
        self.truncation.append(0.0 if stated.get("truncated") in (False, 0) else -1.0)
        occluded = stated.get("occluded")
        self.occlusion.append(int(occluded) if type(occluded) is bool else -1)
        others = {key: value for key, value in stated.items() if key not in _OWN_ATTRIBUTES}
        self.others.append(self._share(others) if others else None)

    def _share(self, values: dict[str, Any]) -> dict[str, Any]:
        return self._equal.setdefault(repr(values), values)


class BddFiles:
    """The label files of a data set, and the images that they name. Other images are not part of it.

    A frame's identifier is its name without suffix; if some are alike, their folders or splits come before it.

    Args:
        root: Folder, or one JSON file; images of `labels/FILE.json` are sought next to `labels`.

    Raises:
        FormatError: There is no such file, or it is damaged.
    """

    layout = "bdd100k"

    def __init__(self, root: Path) -> None:
        self.root = root if root.is_dir() else _folder_above_labels(root)
        index = FileIndex(self.root, ".json", _MASK_FOLDERS)
        others = [file for file in index.others if root.is_dir() or file.path == root]
        ranks = [_rank(file.path) for file in others]
        best = min((rank for rank in ranks if rank is not None), default=None)
        if best is None:
            raise FormatError(str(root), "BDD100K's JSON, a list of frames with name and labels", "none")
        self._rows = _Rows()
        self._paths: list[Path] = []
        sources: list[Path] = []
        splits: list[str] = []
        for file, rank in zip(others, ranks, strict=True):
            if rank == best:  # all of one form
                self._paths.append(file.path)
                for where, frame, labels in _read_frames(file.path):
                    self._rows.add(where, frame, labels)
                sources += [file.path] * (len(self._rows.names) - len(sources))
                splits += [_split_of(file, best)] * (len(self._rows.names) - len(splits))
        self._unread = {file.path for file in index.others} - set(self._paths)
        found = [_find_image(index, name, split) for name, split in zip(self._rows.names, splits, strict=True)]
        places = [
            (split,) if split else image.place if image else () for image, split in zip(found, splits, strict=True)
        ]
        names = name_uniquely([image_stem(name) for name in self._rows.names], places)
        self._position = dict(sorted((name, i) for i, name in enumerate(names)))
        if len(self._position) < len(names):
            repeated = next(name for name, count in Counter(names).items() if count > 1)
            raise FormatError(str(sources[names.index(repeated)]), "a name once", f"{repeated!r} twice")
        self.sources = {name: sources[i] for name, i in self._position.items()}
        """Label file of each frame, by identifier, sorted."""
        self.images = {name: image.path for name, i in self._position.items() if (image := found[i]) is not None}
        """Image of each frame that has one, by identifier."""
        self._splits: dict[str, list[str]] = {split: [] for split in sorted(set(splits) - {""})}
        for name, i in self._position.items():
            if splits[i]:
                self._splits[splits[i]].append(name)

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split."""
        return {split: tuple(names) for split, names in self._splits.items()}

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes that the file states of a frame: weather, scene, timeofday."""
        return self._rows.attributes[self._position[identifier]]

    def table(self, identifiers: Sequence[str]) -> LabelTable:
        """Return the labels of frames, in pixels of the upright images, of which the headers are read."""
        rows, positions = self._rows, [self._position[identifier] for identifier in identifiers]
        spans = [(rows.ends[i - 1] if i else 0, rows.ends[i]) for i in positions]
        chosen = np.concatenate([np.zeros(0, np.int64), *(np.arange(first, end) for first, end in spans)])
        names = sorted(rows.kinds)
        places = np.argsort(np.array([rows.kinds[name] for name in names], np.int64))
        boxes = np.array(rows.boxes).reshape(-1, 4)[chosen]
        sizes = np.array(rows.sizes, np.int64).reshape(-1, 2)[positions]
        start = 0
        for i, (identifier, (first, end)) in enumerate(zip(identifiers, spans, strict=True)):
            image, own = self.images.get(identifier), slice(start, start + end - first)
            start = own.stop
            if not sizes[i, 0] and image is not None:
                sizes[i] = read_upright_size(image)
            elif (orientation := read_turn(image, sizes[i].tolist())) != 1:
                boxes[own] = turn_boxes(boxes[own], orientation, sizes[i].tolist())
                sizes[i] = sizes[i, ::-1].copy()
        others = [rows.others[row] for row in chosen.tolist()]
        images = {i: self.images[name] for i, name in enumerate(identifiers) if name in self.images}
        return LabelTable.from_columns(
            identifiers,
            names,
            np.repeat(np.arange(len(spans)), [end - first for first, end in spans]),
            places[np.array(rows.kind, np.int64)[chosen]],
            boxes,
            "xywh",
            ignore=np.array(rows.ignore, np.bool_)[chosen],
            truncation=np.array(rows.truncation)[chosen],
            occlusion=np.array(rows.occlusion, np.int64)[chosen],
            sizes_wh=sizes,
            image_files={i: image.name for i, image in images.items()},
            image_paths=images,
            frame_attributes={i: rows.attributes[k] for i, k in enumerate(positions) if rows.attributes[k]},
            extra={"attributes": others} if any(others) else {},
        )

    def read_table(self) -> LabelTable:
        """Return the labels of all frames, with the splits and the account."""
        table = self.table(tuple(self.sources))
        position = {name: i for i, name in enumerate(table.frames)}
        splits = {split: [position[name] for name in names] for split, names in self._splits.items()}
        return replace(table, splits=splits, account=self.account())

    def account(self) -> DataAccount:
        """Account for all files and labels."""
        rows = self._rows
        read = map(os.path.abspath, (*self._paths, *self.images.values()))
        unread = {os.path.abspath(path): "JSON of another task or form" for path in self._unread}
        count, skipped = account_for_files(Path(os.path.abspath(self.root)), read, unread)
        ignored = np.array(rows.ignore, np.bool_)
        counts = np.bincount(np.array(rows.kind, np.int64)[~ignored], minlength=len(rows.kinds)).tolist()
        ends = np.array([0, *rows.ends])
        return DataAccount(
            self.layout,
            len(self.sources),
            count,
            skipped,
            {name: counts[i] for name, i in rows.kinds.items() if counts[i]},
            int(ignored.sum()),
            int((ends[1:] == ends[:-1]).sum()),
            len(self.sources) - len(self.images),
            {split: len(names) for split, names in self._splits.items()},
            tuple(sorted(rows.unused)),
            dict(rows.repairs),
        )


def _folder_above_labels(path: Path) -> Path:
    """Return the folder of a data set by one of its files: the one with its folder "labels", or the file's own."""
    return next((folder.parent for folder in path.parents if folder.name == "labels"), path.parent)


def _find_image(index: FileIndex, name: str, split: str) -> IndexedFile | None:
    """Find the image of a name, which may have folders and a suffix; one of the split, if there are several."""
    base = name.replace("\\", "/").strip("/")
    found = index.images.get(image_stem(name), [])
    found = [image for image in found if image.path.name == base.rpartition("/")[2]] or found

    def rank(image: IndexedFile) -> tuple[bool, bool]:
        return image.split.lower() != split, not image.path.as_posix().endswith(f"/{base}")

    return min(found, key=rank, default=None)
