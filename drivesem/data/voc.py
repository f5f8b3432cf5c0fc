"""Pascal VOC's XML files, one for each image: reader, without torch.

Folders: `Annotations/NAME.xml` with `JPEGImages` or `images`, or XML files next to their images, as in `train/NAME.jpg`
and `train/NAME.xml`. Splits are the lists `ImageSets/Main/{train,val,test}.txt`, or the folders train, valid, val and
test. The image of an XML file has its name; if there is none, it is the one that <filename> names.

Boxes in the files are inclusive pixels, counted from 1 (host.robots.ox.ac.uk/pascal/VOC/voc2012/devkit_doc.pdf): here,
with pixel centres at integers from 0, left = xmin - 1 and right = xmax - 1. Values may have decimals. An object marked
difficult is a region to ignore, as in VOC's own evaluation. occluded 1 is KITTI's occlusion 1 (partly occluded); all
else is unknown, since most tools write 0 for everything and VOC states no share of truncation.

Images are turned upright by EXIF. Where <size> is that of the stored, unturned image only, boxes are of stored pixels,
and are turned with it. Without <size>, or with 0, the image's size is read, and boxes are of the upright image.
"""

from __future__ import annotations

import html
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from drivesem.data.account import DataAccount, account_for_files
from drivesem.data.coco_labels import read_turn, turn_boxes
from drivesem.data.image_headers import read_upright_size
from drivesem.data.image_index import FileIndex, IndexedFile, image_stem, name_uniquely
from drivesem.data.kitti_labels import finite_number
from drivesem.data.label_table import LabelTable, coco_to_xyxy, xyxy_to_coco
from scene_ir import files
from scene_ir.errors import FormatError

_MAX_BYTES = 1 << 24
"""Size limit of an XML file: tens of thousands of objects."""
_HEAD_BYTES = 4096
_START = re.compile(rb"\s*(?:<\?xml[^>]*\?>\s*)?(?:<!--.*?-->\s*)*<annotation[\s>]", re.DOTALL)
"""Matches the start of a file with an <annotation>."""
_FILE_NAME = re.compile(rb"<filename>([^<]*)</filename>")
_ENCODING = re.compile(rb"""<\?xml[^>]*encoding\s*=\s*["']([A-Za-z][\w.-]*)["']""")
_MAX_COORDINATE = 2.0**31
"""Exclusive limit of box coordinates and image sides, px."""
_CORNERS = ("xmin", "ymin", "xmax", "ymax")
_READ_FIELDS = {"name", "bndbox", "difficult", "occluded"}
"""Elements of an object that are read."""
_LISTS = "ImageSets/Main"


@dataclass(slots=True)
class VocAnnotation:
    """The content of an XML file."""

    size_wh: tuple[int, int]
    """Width and height as stated; 0 where unknown."""
    file_name: str
    """Name of the image as stated; "" where there is none."""
    kinds: list[str] = field(default_factory=list)
    """Classes (N,)."""
    boxes: list[list[float]] = field(default_factory=list)
    """xmin, ymin, xmax, ymax as stated (N, 4)."""
    difficult: list[bool] = field(default_factory=list)
    """Which objects (N,) are marked difficult."""
    occlusion: list[int] = field(default_factory=list)
    """KITTI's occlusion code (N,); -1 where unknown."""
    without_box: int = 0
    """Number of objects without a box."""
    unused: set[str] = field(default_factory=set)
    """Elements of objects that are not read."""


def read_annotation(path: Path) -> VocAnnotation:
    """Read an XML file. Raises FormatError naming file, object and field; document types and entities are refused."""
    root = _parse_xml(path)
    if root.tag != "annotation":
        raise FormatError(str(path), "an <annotation> of Pascal VOC", f"<{root.tag[:40]}>")
    width, height = (_parse_side(root.findtext(f"size/{name}")) for name in ("width", "height"))
    size_wh = (width, height) if width and height else (0, 0)
    content = VocAnnotation(size_wh, (root.findtext("filename") or "").strip())
    for i, element in enumerate(root.findall("object")):
        values = {child.tag: (child.text or "").strip() for child in element}
        content.unused.update(values.keys() - _READ_FIELDS)
        box = element.find("bndbox")
        if box is None:
            content.without_box += 1
            continue
        where = f"{path}: object[{i}]"
        if not values.get("name"):
            raise FormatError(f"{where}.name", "a class", "none")
        content.kinds.append(values["name"])
        content.boxes.append(_parse_box(where, box))
        content.difficult.append(_is_set(values.get("difficult")))
        content.occlusion.append(1 if _is_set(values.get("occluded")) else -1)
    return content


def _parse_xml(path: Path) -> ElementTree.Element:
    data = files.read_bytes(path, _MAX_BYTES)
    declared = _ENCODING.match(data[:_HEAD_BYTES].lstrip())
    text = ""
    if declared is not None and declared[1].lower() not in (b"utf-8", b"utf8"):
        with suppress(LookupError, ValueError):  # the error is that of UTF-8
            text = data.decode(declared[1].decode())
    text = text or files.decode_utf8(data, path)
    for unsafe in ("<!DOCTYPE", "<!ENTITY"):
        if unsafe in text:
            raise FormatError(str(path), "XML without a document type and entities", unsafe)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = str(error).partition(":")[0]
        raise FormatError(f"{path}:{line}:{column + 1}", "XML", reason) from error


def _parse_side(text: str | None) -> int:
    """Return a side of an image; 0 where it is unknown."""
    try:
        side = float(text or 0)
    except ValueError:
        return 0
    return int(side) if 0 < side < _MAX_COORDINATE else 0


def _parse_box(where: str, element: ElementTree.Element) -> list[float]:
    box = [finite_number(f"{where}.{name}", (element.findtext(name) or "").strip()) for name in _CORNERS]
    for name, low, high in zip(_CORNERS[2:], box[:2], box[2:], strict=True):
        if high < low:
            raise FormatError(f"{where}.{name}", f"at least {low:g}", f"{high:g}")
    if max(map(abs, box)) >= _MAX_COORDINATE:
        raise FormatError(f"{where}.bndbox", f"numbers below {_MAX_COORDINATE:,.0f}", f"{box}")
    return box


def _is_set(text: str | None) -> bool:
    return text is not None and text.lower() in ("1", "true", "yes")


def is_annotation(path: Path) -> bool:
    """Whether a file begins as Pascal VOC's XML."""
    return _START.match(_read_head(path)) is not None


def _read_head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf")
    except OSError:
        return b""


def _stated_name(path: Path) -> str:
    """Return the file name that an XML file states; "" if none is in its first bytes."""
    match = _FILE_NAME.search(_read_head(path))
    name = "" if match is None else html.unescape(match[1].decode("utf-8", "replace"))
    return name.strip().replace("\\", "/").rpartition("/")[2]


class VocFiles:
    """The XML files of a data set, and their images. Images without an XML file are not part of it.

    A frame's identifier is the stem of its image, or of its XML file without one; if some are alike, their folders
    come before it.

    Args:
        root: Folder.

    Raises:
        FormatError: There is no such file, or two belong to one image.
    """

    layout = "voc"

    def __init__(self, root: Path) -> None:
        self.root = root
        index = FileIndex(root, ".xml", ("segmentation",))
        self._others: list[Path] = []  # XML that is not Pascal VOC's
        found: list[tuple[IndexedFile, IndexedFile | None]] = []
        labelled: dict[Path, Path] = {}
        for file in index.others:
            image = _find_image(index, file)
            if image is None and not is_annotation(file.path):
                self._others.append(file.path)
                continue
            if image is not None and labelled.setdefault(image.path, file.path) != file.path:
                raise FormatError(str(file.path), "another image", f"{image.path}, as {labelled[image.path]}")
            found.append((file, image))
        if not found:
            raise FormatError(str(root), "Pascal VOC's XML files, such as Annotations/NAME.xml", "none")
        stems = [file.path.stem if image is None else image.path.stem for file, image in found]
        names = name_uniquely(stems, [(file if image is None else image).place for file, image in found])
        order = sorted(range(len(names)), key=names.__getitem__)
        self.sources = {names[i]: found[i][0].path for i in order}
        """XML file of each frame, by identifier, sorted."""
        if len(self.sources) < len(found):
            repeated = next(name for name, count in Counter(names).items() if count > 1)
            raise FormatError(str(root), "images that differ in their names", f"{repeated!r} twice")
        images = {names[i]: found[i][1] for i in order}
        self.images = {name: image.path for name, image in images.items() if image is not None}
        """Image of each frame that has one, by identifier."""
        self._names = {name: image.name_below_split for name, image in images.items() if image is not None}
        self._folders = {names[i]: found[i][0].split for i in order}
        self._unknown = 0  # names in lists without an XML file
        self._lists: list[Path] = []
        self._splits = self._read_lists() or self._splits_by_folder()

    def _read_lists(self) -> dict[str, tuple[str, ...]]:
        """Read ImageSets/Main of each folder with XML files; trainval only without train and val."""
        frames = {(path.parent.parent, path.stem): name for name, path in self.sources.items()}
        splits: dict[str, list[str]] = {}
        for base in dict.fromkeys(base for base, _ in frames):
            there = {name: base / _LISTS / f"{name}.txt" for name in ("train", "val", "test", "trainval")}
            there = {name: path for name, path in there.items() if path.is_file()}
            if "train" in there or "val" in there:
                there.pop("trainval", None)
            for split, path in there.items():
                self._lists.append(path)
                stems = [line.split()[0] for line in files.read_text(path).splitlines() if line.strip()]
                chosen = [frames[base, stem] for stem in dict.fromkeys(stems) if (base, stem) in frames]
                self._unknown += len(set(stems)) - len(chosen)
                splits.setdefault(split, []).extend(chosen)
        return {split: tuple(sorted(names)) for split, names in splits.items() if names}

    def _splits_by_folder(self) -> dict[str, tuple[str, ...]]:
        splits = dict.fromkeys(sorted(set(self._folders.values()) - {""}))
        return {split: tuple(name for name, own in self._folders.items() if own == split) for split in splits}

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Identifiers by split."""
        return self._splits

    def attributes(self, identifier: str) -> Mapping[str, str]:
        """Attributes of a frame: Pascal VOC has none."""
        return {}

    def table(self, identifiers: Sequence[str]) -> LabelTable:
        """Read the labels of frames, in pixels of the upright images. Raises FormatError naming file and field."""
        return self._read(identifiers)[0]

    def account(self) -> DataAccount:
        """Account for all files and objects."""
        return self._account(*self._read(tuple(self.sources), strict=False))

    def read_table(self) -> LabelTable:
        """Read the labels of all frames, with the splits and the account."""
        table, repairs, unused = self._read(tuple(self.sources))
        position = {name: i for i, name in enumerate(table.frames)}
        splits = {split: [position[name] for name in names] for split, names in self._splits.items()}
        return replace(table, splits=splits, account=self._account(table, repairs, unused))

    def _read(self, identifiers: Sequence[str], strict: bool = True) -> tuple[LabelTable, Counter[str], set[str]]:
        """Read frames: their labels, repairs by what was done, and elements of objects that are not used.

        An image of another size than its XML file states is an error if `strict`, else it is counted.
        """
        repairs: Counter[str] = Counter()
        unused: set[str] = set()
        sizes = np.zeros((len(identifiers), 2), np.int64)
        kinds: list[str] = []
        ignore: list[bool] = []
        occlusion: list[int] = []
        counts: list[int] = []
        boxes = [np.zeros((0, 4))]
        for i, identifier in enumerate(identifiers):
            content, image = read_annotation(self.sources[identifier]), self.images.get(identifier)
            if image is not None and content.file_name and image_stem(content.file_name) != image.stem:
                repairs["file names other than the image's"] += 1
            own = np.array(content.boxes, np.float64).reshape(-1, 4)
            repairs["boxes from pixel 0 or less (pixels count from 1)"] += int((own[:, :2] < 1).any(axis=1).sum())
            own -= 1
            size_wh, orientation = content.size_wh, 1
            try:
                orientation = read_turn(image, size_wh)
            except FormatError:
                if strict:
                    raise
                repairs["images of another size than stated (refused where they are used)"] += 1
            if not size_wh[0] and image is not None:
                size_wh = read_upright_size(image)
                repairs["image sizes that are missing (read from the image)"] += 1
            elif orientation != 1:
                own = coco_to_xyxy(turn_boxes(xyxy_to_coco(own), orientation, size_wh))
                size_wh = (size_wh[1], size_wh[0])
                repairs["images with boxes of stored pixels (turned upright)"] += 1
            sizes[i] = size_wh
            repairs["objects without a box"] += content.without_box
            unused |= content.unused
            kinds += content.kinds
            ignore += content.difficult
            occlusion += content.occlusion
            counts.append(len(own))
            boxes.append(own)
        names = sorted(set(kinds))
        place = {name: i for i, name in enumerate(names)}
        table = LabelTable.from_columns(
            identifiers,
            names,
            np.repeat(np.arange(len(identifiers)), counts),
            [place[kind] for kind in kinds],
            np.concatenate(boxes),
            "xyxy",
            ignore=np.array(ignore, np.bool_),
            occlusion=np.array(occlusion, np.int64),
            sizes_wh=sizes,
            image_files={i: self._names[name] for i, name in enumerate(identifiers) if name in self._names},
            image_paths={i: self.images[name] for i, name in enumerate(identifiers) if name in self.images},
        )
        return table, repairs, unused

    def _account(self, table: LabelTable, repairs: Counter[str], unused: set[str]) -> DataAccount:
        repairs["names in lists without an XML file"] += self._unknown
        read = map(os.path.abspath, (*self.sources.values(), *self.images.values(), *self._lists))
        others = {os.path.abspath(path): "XML that is not Pascal VOC's" for path in self._others}
        count, skipped = account_for_files(Path(os.path.abspath(self.root)), read, others)
        rows = np.bincount(table.kind[~table.ignore], minlength=len(table.kinds)).tolist()
        return DataAccount(
            self.layout,
            len(self.sources),
            count,
            skipped,
            {name: number for name, number in zip(table.kinds, rows, strict=True) if number},
            int(table.ignore.sum()),
            len(self.sources) - len(np.unique(table.frame)),
            len(self.sources) - len(self.images),
            {split: len(names) for split, names in self._splits.items()},
            tuple(sorted(unused)),
            {name: number for name, number in repairs.items() if number},
        )


def _find_image(index: FileIndex, file: IndexedFile) -> IndexedFile | None:
    """Find the image of an XML file: of its name or of the stated one, in its place; else the only one of that name."""
    stem = file.path.stem
    own = [image for image in index.images.get(stem, ()) if image.place == file.place]
    if len(own) == 1:
        return own[0]
    stated = _stated_name(file.path)
    if own:
        return next((image for image in own if image.path.name == stated), own[0])
    named = index.images.get(image_stem(stated), [])
    placed = [image for image in named if image.place == file.place]
    if placed:
        return next((image for image in placed if image.path.name == stated), placed[0])
    for images in (named, index.images.get(stem, [])):
        if len(images) == 1:
            return images[0]
    return None
