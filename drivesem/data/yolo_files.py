"""Files of a YOLO data set: its description, class names, splits, images, and where their labels are.

A description is `data.yaml` (train, val, test, names), Darknet's `obj.data` (train, valid, names), or a list of class
names alone (`classes.txt`, `obj.names`). Splits are folders, or text files with a path of an image a line. Labels of
`.../images/x.jpg` are in `.../labels/x.txt`; without a folder `images`, in a folder `labels` that mirrors the images'
folder, or next to the images. Paths that lead out of the data set are read by their ending in it.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from drivesem.data.account import IMAGE_SUFFIXES
from drivesem.data.photographs import list_images
from drivesem.data.yolo_labels import find_description, is_label_file
from scene_ir import files
from scene_ir.errors import FormatError

SPLITS = ("train", "val", "test")
"""Splits of a description."""
_ALIASES = {"valid": "val", "validation": "val"}
_IMAGE_FOLDERS = ("images", "imgs", "JPEGImages", "obj_train_data")
"""Folders of images, where the description does not name them."""
_SPLIT_FOLDER = re.compile(r"(?:train|val|valid|validation|test)[\d_-]*", re.IGNORECASE)
DUPLICATE = "image with the name of another one"
WITHOUT_IMAGE = "label file without an image"


class YoloDescription:
    """Class names of a data set.

    Args:
        root: Folder of the data set, or its description.

    Raises:
        FormatError: Names file and field.
    """

    path: Path
    """The description."""
    root: Path
    """Folder of the data set."""
    names: tuple[str, ...]
    """Class names, by number."""
    keypoints: int
    """Numbers after each box that belong to keypoints."""
    repairs: Counter[str]
    """Values that were not read as written, by what was done."""
    described_by: list[Path]
    """The description and the lists that it names."""

    def __init__(self, root: Path) -> None:
        folder = Path(os.path.normpath(root if root.is_dir() else root.parent))
        self.root = Path.cwd() if folder == Path() else folder  # so that paths begin with it
        path = find_description(self.root) if root.is_dir() else self.root / root.name
        if path is None:
            raise FormatError(str(root), "data.yaml, obj.data or classes.txt", "none of them")
        self.path = path
        self.repairs = Counter()
        self.described_by = [path]
        self._content = self._read_content()
        self.names = self._parse_names(self._content)
        self.keypoints = self._parse_keypoints(self._content.get("kpt_shape"))

    def _read_content(self) -> dict[str, Any]:
        path = self.path
        if path.suffix.lower() in (".txt", ".names"):
            return {"names": _read_lines(path)}
        if path.suffix.lower() == ".data":
            pairs = (line.partition("=") for line in _read_lines(path) if line[0] != "#")
            content: Any = {key.strip(): value.strip() for key, _, value in pairs}
            return {("nc" if key == "classes" else key): value for key, value in content.items()}
        content = files.read_yaml(path)
        if not isinstance(content, dict):
            raise FormatError(str(path), "train, val and names", type(content).__name__)
        return {str(key): value for key, value in content.items()}

    def _parse_names(self, content: Mapping[str, Any]) -> tuple[str, ...]:
        names, count = content.get("names"), content.get("nc")
        count = int(count) if isinstance(count, str) and count.isdecimal() and len(count) < 6 else count
        if isinstance(names, str):
            path = self._find_ending(self.root, names, Path.is_file, ending=True)
            if path is None:
                raise FormatError(f"{self.path}: names", "a list of classes, or a file of them", repr(names[:60]))
            self.described_by.append(path)
            names = _read_lines(path)
        if names is None and type(count) is int and 0 < count <= 10_000:
            names = [f"class_{number}" for number in range(count)]
            self.repairs["classes without a name (class_0, ...)"] = count
        pairs = dict(enumerate(names)) if isinstance(names, list) else names
        if not isinstance(pairs, dict) or not pairs:
            raise FormatError(f"{self.path}: names", "a list of classes, or number: class", repr(names)[:60])
        numbered = {int(k) if str(k).isdecimal() and len(str(k)) < 9 else k: str(v) for k, v in pairs.items()}
        if set(numbered) != set(range(len(pairs))):
            expected = f"a list of classes, or number: class, numbers from 0 to {len(pairs) - 1}"
            raise FormatError(f"{self.path}: names", expected, repr(names)[:60])
        if count is not None and count != len(pairs):
            self.repairs[f"nc of {count} for {len(pairs)} names (names used)"[:80]] = 1
        ordered = tuple(numbered[number] for number in range(len(pairs)))
        repeated = len(ordered) - len(set(ordered))
        self.repairs.update({"classes with the name of another one (joined)": repeated} if repeated else {})
        return ordered

    def _parse_keypoints(self, shape: Any) -> int:
        if shape is None:
            return 0
        if (
            not isinstance(shape, list)
            or len(shape) != 2
            or any(type(n) is not int or not 0 < n < 1000 for n in shape)
        ):
            raise FormatError(f"{self.path}: kpt_shape", "number of keypoints, and 2 or 3", repr(shape)[:60])
        return shape[0] * shape[1]

    def _join(self, base: Path, name: str) -> Path:
        """Return the path that a name states, which may lead out of the data set."""
        return Path(os.path.normpath(base / name))

    def _find_ending(self, base: Path, name: str, exists: Callable[[Path], bool], ending: bool) -> Path | None:
        """Find a name in the data set.

        Args:
            base: Folder that the name is relative to.
            name: Relative or absolute path; ".." at its beginning is left out.
            exists: Test of a path.
            ending: Accept its longest ending that exists, other than a folder "images" alone.

        Returns:
            The path; None if there is none.
        """
        parts = [part for part in Path(os.path.normpath(name)).parts if part not in ("..", "/", ".")]
        rests = [parts]
        own_name = Path(os.path.abspath(self.root)).name
        if own_name in parts:
            rests.append(parts[len(parts) - parts[::-1].index(own_name) :])
        if ending:
            rests += [rest for i in range(1, len(parts)) if (rest := parts[i:]) != ["images"]]
        paths = [
            self._join(base, name),
            *(folder.joinpath(*rest) for rest in rests for folder in (base, self.root)),
        ]
        for path in paths:
            with suppress(OSError):  # such as a name that is too long
                if path.is_relative_to(self.root) and exists(path):
                    return path
        return None


class YoloFiles(YoloDescription):
    """Images of a data set, and their label files; see `YoloDescription`."""

    splits: dict[str, list[str]]
    """Images by split; those without a split by ""."""
    images: list[str]
    """All images, without repetitions, sorted."""
    unused_keys: list[str]
    """Keys of the description that are not used."""
    reasons: dict[str, str]
    """Reasons why images are not read, by path."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.unused_keys = []
        self.reasons = {}
        self._label_folders: dict[str, tuple[str, frozenset[str]]] = {}
        self._calibration_folders: dict[str, str | None] = {}
        self.splits = self._find_splits(self._content)
        self.images = self._drop_duplicates({image for images in self.splits.values() for image in images})
        if not self.images:
            where = str(self.path) if self.path.suffix == ".txt" else f"{self.path}: train"
            raise FormatError(where, f"a folder with at least one image ({', '.join(IMAGE_SUFFIXES)})", "none")

    def _find_splits(self, content: Mapping[str, Any]) -> dict[str, list[str]]:
        if self.path.suffix.lower() in (".txt", ".names"):
            return self._split_by_folder()
        known = {"names", "nc", "path", "kpt_shape"}
        base, splits, missing = self._find_base(content.get("path")), dict[str, list[str]](), list[FormatError]()
        for key, value in content.items():
            split = _ALIASES.get(key, key)
            if split not in SPLITS or (split != key and split in content):
                self.unused_keys += [key] if key not in known else []
                continue
            entries = [value] if isinstance(value, str) else value or []
            if not isinstance(entries, list) or any(type(entry) is not str or "\0" in entry for entry in entries):
                raise FormatError(
                    f"{self.path}: {key}", "a folder of images, or a list of folders", repr(value)[:60]
                )
            for entry in entries:
                try:
                    splits.setdefault(split, []).extend(self._list_entry(base, key, entry))
                except FormatError as error:
                    missing.append(error)
                    self.unused_keys.append(f"{key} {entry[:80]} (no such folder)")
        if not any(splits.values()) and missing:
            raise missing[0]
        return {split: list(dict.fromkeys(images)) for split, images in splits.items() if images}

    def _split_by_folder(self) -> dict[str, list[str]]:
        """Find the images of a data set without a description; splits are folders of their names."""
        folder = next((path for name in _IMAGE_FOLDERS if (path := self.root / name).is_dir()), self.root)
        images = _list_paths(folder)
        below = 0 if folder == self.root else len(folder.relative_to(self.root).parts)
        names = [self.relative_parts(image)[below] for image in images]
        splits: dict[str, list[str]] = {}
        by_folder = {_ALIASES.get(name.lower(), name.lower()) for name in names} <= set(SPLITS)
        for name, image in zip(names, images, strict=True):
            splits.setdefault(_ALIASES.get(name.lower(), name.lower()) if by_folder else "", []).append(image)
        return splits

    def _find_base(self, value: Any) -> Path:
        """Return the folder that `path` names: its longest ending that exists in the data set, or the data set's."""
        if value is None or value == "":
            return self.root
        if not isinstance(value, str) or "\0" in value:
            raise FormatError(f"{self.path}: path", "a folder", repr(value)[:60])
        base = self._find_ending(self.root, value, Path.is_dir, ending=True) or self.root
        if base != self._join(self.root, value):
            self.repairs["path of another place (read in the data set's folder)"] = 1
        return base

    def _list_entry(self, base: Path, key: str, entry: str) -> list[str]:
        """List the images of a folder, or of a text file with a path a line."""
        is_list = entry.lower().endswith(".txt")
        exists = Path.is_file if is_list else Path.is_dir
        path = self._find_ending(base, entry, exists, ending=is_list or Path(entry).is_absolute())
        if path is None:
            expected = "a list of images" if is_list else "a folder of images"
            raise FormatError(f"{self.path}: {key}", f"{expected} in {self.root}", repr(entry[:80]))
        if path not in (self._join(base, entry), self._join(self.root, entry)):
            self.repairs["folders and lists of another place (found in the data set's folder)"] += 1
        return self._read_list(base, path) if is_list else _list_paths(path)

    def _read_list(self, base: Path, path: Path) -> list[str]:
        self.described_by.append(path)

        @cache
        def find_folder(name: str) -> tuple[str, frozenset[str]] | None:
            for start in (path.parent, base):
                folder = self._find_ending(start, name, Path.is_dir, ending=True) if name else start
                if folder is not None:
                    return "" if f"{folder}" == "." else f"{folder}", frozenset(os.listdir(folder))
            return None

        images: list[str] = []
        for line in _read_lines(path):
            folder, _, name = line.replace("\\", "/").rpartition("/")
            found = find_folder(folder) if "\0" not in line else None
            if found is None or name not in found[1] or not name.lower().endswith(IMAGE_SUFFIXES):
                self.repairs["entries of lists without a readable image"] += 1
            else:
                images.append(os.path.join(found[0], name))
        repeated = len(images) - len(set(images))
        self.repairs.update({"images that a list repeats": repeated} if repeated else {})
        return images

    def _drop_duplicates(self, images: Iterable[str]) -> list[str]:
        """Sort images, and drop those of one folder that differ from an earlier one in their suffix only."""
        first: dict[str, str] = {}
        for image in sorted(images):
            if first.setdefault(os.path.splitext(image)[0], image) != image:
                self.reasons[image] = DUPLICATE
        return list(first.values())

    def relative_parts(self, path: str) -> tuple[str, ...]:
        """Return the parts of a path below the data set's folder."""
        return tuple(path.removeprefix(f"{self.root}{os.sep}").split(os.sep))

    def label_path(self, image: str) -> str:
        """Return the path of an image's label file."""
        folder, name = os.path.split(image)
        return f"{self._label_folder(folder)[0]}{os.sep}{os.path.splitext(name)[0]}.txt"

    def has_labels(self, image: str) -> bool:
        """Whether an image has a label file."""
        folder, name = os.path.split(image)
        return f"{os.path.splitext(name)[0]}.txt" in self._label_folder(folder)[1]

    def calibration_path(self, image: str) -> str | None:
        """Return the file with an image's camera, which only this project writes; None if there is none."""
        folder, name = os.path.split(image)
        if folder not in self._calibration_folders:
            parts = self.relative_parts(folder)
            place = _replace_images_folder(self.root, parts, "calib") if "images" in parts else None
            self._calibration_folders[folder] = f"{place}" if place is not None and place.is_dir() else None
        place = self._calibration_folders[folder]
        path = f"{place}{os.sep}{os.path.splitext(name)[0]}.txt"
        return path if place is not None and os.path.isfile(path) else None

    def _label_folder(self, folder: str) -> tuple[str, frozenset[str]]:
        """Return the folder with the labels of a folder of images, and the names of its label files."""
        if folder not in self._label_folders:
            place = next((path for path in self._label_places(Path(folder)) if path.is_dir()), Path(folder))
            described = {path.name for path in self.described_by if path.parent == place}
            names = (name for name in os.listdir(place) if is_label_file(name) and name not in described)
            self._label_folders[folder] = f"{place}", frozenset(names)
        return self._label_folders[folder]

    def _label_places(self, folder: Path) -> list[Path]:
        parts = folder.relative_to(self.root).parts
        if "images" in parts:
            return [_replace_images_folder(self.root, parts, "labels")]
        ends = ((parts[:i], rest) for i in range(len(parts), -1, -1) for rest in (parts[i:], parts[i + 1 :]))
        return [self.root.joinpath(*start, "labels", *rest) for start, rest in ends]

    def check_pairs(self) -> None:
        """Raise FormatError if there are label files, and none has the name of an image."""
        unpaired = [] if any(map(self.has_labels, self.images)) else self.find_unpaired_labels()
        if unpaired:
            expected = (
                f"label files named after the images, such as {os.path.basename(self.label_path(self.images[0]))}"
            )
            raise FormatError(str(self.root), expected, f"{len(unpaired)} others, such as {unpaired[0]}")

    def find_unpaired_labels(self) -> list[str]:
        """Return the label files without an image."""
        paired = {self.label_path(image) for image in self.images}
        described = {f"{path}" for path in self.described_by}
        folders = {folder for folder, _ in self._label_folders.values()}
        unpaired: list[str] = []
        for place, _, names in os.walk(self.root):
            if place in folders or "labels" in Path(place).relative_to(self.root).parts:
                paths = (f"{place}{os.sep}{name}" for name in names if is_label_file(name))
                unpaired += [path for path in paths if path not in paired and path not in described]
        return unpaired


def _read_lines(path: Path) -> list[str]:
    return [line.strip() for line in files.read_text(path).splitlines() if line.strip()]


def _replace_images_folder(root: Path, parts: Sequence[str], name: str) -> Path:
    """Return the path of folders below `root` with another name for the last folder "images"."""
    last = len(parts) - 1 - parts[::-1].index("images")
    return root.joinpath(*parts[:last], name, *parts[last + 1 :])


def _list_paths(folder: Path) -> list[str]:
    return [f"{image}" for image in list_images(folder, recursive=True)]


def name_images(found: YoloFiles) -> tuple[list[str], list[str]]:
    """Return identifiers and file names of a data set's images.

    Identifiers are stems if all differ, else paths below the folders of images without suffix. File names have the
    folders below the split's folder, if all differ, else with the split.
    """
    relative = [found.relative_parts(image) for image in found.images]
    with_split = {image for name, images in found.splits.items() for image in images if name}
    places = [_drop_image_folder(parts) for parts in relative]
    long = ["/".join(place) for place in (places if len(set(places)) == len(places) else relative)]
    short = [
        strip_split(name) if image in with_split else name for name, image in zip(long, found.images, strict=True)
    ]
    file_names = short if len(set(short)) == len(short) else long
    stems = [os.path.splitext(parts[-1])[0] for parts in relative]
    unique = len(set(stems)) == len(stems)
    return stems if unique else [os.path.splitext(name)[0] for name in file_names], file_names


def _drop_image_folder(parts: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parts of an image's path without the last folder that is named after its images."""
    index = next((i for i in range(len(parts) - 2, -1, -1) if parts[i] in _IMAGE_FOLDERS), len(parts))
    return parts[:index] + parts[index + 1 :]


def strip_split(name: str) -> str:
    """Return a path without its first folder, if that is named after a split."""
    first, _, rest = name.partition("/")
    return rest if rest and _SPLIT_FOLDER.fullmatch(first) else name
