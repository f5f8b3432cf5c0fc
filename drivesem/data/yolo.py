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
from pathlib import Path
from typing import Any

import torch
import yaml

from drivesem.data.coco import CATEGORIES, CATEGORY_IDS, from_coco, pinhole, to_coco
from drivesem.data.kitti import IMAGE_SUFFIXES, PNG_COMPRESSION, UNKNOWN_OCCLUSION, format_calib, read_calib
from drivesem.data.truth import Exposure, Place
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.types import Camera, Frame, Labels

DECIMALS = 8
"""Of shares: 1e-8 of 4000 px is 4e-5 px."""
PARTS = ("train", "val", "test")
"""Keys of `data.yaml` that name images."""
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
        lines = [
            _line(CATEGORY_IDS[kind] - 1, box, camera.width, camera.height)
            for kind, box in zip(labels.kind, labels.boxes_xyxy.tolist(), strict=True)
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
        content = {**parts, "nc": len(CATEGORIES), "names": dict(enumerate(CATEGORIES))}
        files.write_text(self.root / "data.yaml", yaml.safe_dump(content, sort_keys=False))


def _line(label: int, box_xyxy: Sequence[float], width: int, height: int) -> str:
    x, y, w, h = to_coco(box_xyxy)
    shares = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
    return " ".join([str(label), *(f"{share:.{DECIMALS}f}" for share in shares)])


class YoloDataset:
    """The frames of a YOLO data set, all its parts together.

    root: the folder that holds `data.yaml`, or another YAML file like it. focal_px: the focal length of images
    without a file in `calib`. The labels of `.../images/NAME.png` are `.../labels/NAME.txt`; an image without such
    a file has no objects, as YOLO has it. A frame's identifier is its file name without suffix.

    Truncation and 3D boxes are NaN, occlusion is 3, as what is unknown in KITTI. Raises FormatError naming file
    and field; a frame's own faults are raised by `labels` and `frame`, so that the other frames can be used.
    """

    def __init__(self, root: Path, focal_px: float | None = None) -> None:
        root = Path(root)
        if focal_px is not None and not (math.isfinite(focal_px) and focal_px > 0):
            raise RangeError("focal_px", "positive px", focal_px)
        self.focal_px = focal_px
        path = root / "data.yaml" if root.is_dir() else root
        content = _mapping(path)
        self.class_names = _names(path, content)
        base = path.parent / str(content.get("path") or ".")
        folders = list(dict.fromkeys(folder for part in PARTS for folder in _folders(path, content, part)))
        if not folders:
            raise FormatError(f"{path}: train", "a folder of images", "none")
        self._images: dict[str, Path] = {}
        for folder in (base / name for name in folders):
            if not folder.is_dir():
                raise FormatError(str(folder), "a folder of images", "no such folder")
            for image in sorted(folder.iterdir()):
                if image.suffix.lower() not in IMAGE_SUFFIXES or image.name.startswith("."):
                    continue
                if image.stem in self._images:
                    raise FormatError(str(image), "a name of its own", f"the name of {self._images[image.stem]}")
                self._images[image.stem] = image
        if not self._images:
            raise FormatError(str(base / folders[0]), "at least one .png or .jpg", "none")
        self._identifiers = tuple(sorted(self._images))

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the frames, sorted."""
        return self._identifiers

    def __len__(self) -> int:
        return len(self._identifiers)

    def _image(self, identifier: str) -> Path:
        if identifier not in self._images:
            raise RangeError("frame of the YOLO folder", f"one of {len(self)} identifiers", repr(identifier))
        return self._images[identifier]

    def labels(self, identifier: str) -> Labels:
        """The labels of one frame; of its image, the header is read. FormatError naming file, line and field."""
        rows, _ = self.rows(identifier)
        count = len(rows)
        return Labels(
            kind=tuple(kind for kind, _ in rows),
            boxes_xyxy=torch.tensor([from_coco(box) for _, box in rows]).reshape(-1, 4),
            truncation=torch.full((count,), math.nan),
            occlusion=torch.full((count,), UNKNOWN_OCCLUSION, dtype=torch.int64),
            translation=torch.full((count, 3), math.nan),
            yaw=torch.full((count,), math.nan),
            size_lhw=torch.full((count, 3), math.nan),
            ignore_xyxy=torch.zeros(0, 4),
        )

    def rows(self, identifier: str) -> tuple[list[tuple[str, list[float]]], tuple[int, int]]:
        """A frame's class and box (left, top, width, height in COCO's pixels) a line, and its width and height.

        Of the image, the header is read. FormatError naming file, line and field.
        """
        image = self._image(identifier)
        width, height = size_of_image(image)
        path = _beside(image, "labels")
        text = files.read_text(path) if path.exists() else ""
        rows = [
            parse_line(f"{path}:{i}", line.split(), self.class_names, (width, height))
            for i, line in enumerate(text.splitlines(), start=1)
            if line.strip()
        ]
        return rows, (width, height)

    def image_path(self, identifier: str) -> Path:
        """The file of a frame's image. RangeError for a frame that is not there."""
        return self._image(identifier)

    def frame(self, identifier: str) -> Frame:
        """One frame: photograph, camera, labels.

        Raises FormatError naming the file: an image that does not decode, or that has neither a calibration nor
        focal_px.
        """
        image_path = self._image(identifier)
        image = files.read_image(image_path)
        height, width = image.shape[:2]
        calib_path = _beside(image_path, "calib")
        if calib_path.exists():
            projection = read_calib(calib_path).projection
            camera = Camera(projection[:, :3].clone(), height, width, projection)
        elif self.focal_px is not None:
            camera = pinhole(height, width, self.focal_px)
        else:
            raise FormatError(str(image_path), "a calibration, or a focal length (focal_px)", "neither")
        return Frame(
            identifier=identifier,
            photograph=torch.from_numpy(image).permute(2, 0, 1).contiguous().to(torch.float32) / 255,
            camera=camera,
            labels=self.labels(identifier),
            provenance={"dataset": "yolo", "image": image_path.name, "folder": image_path.parent.name},
        )


def parse_line(
    where: str, parts: Sequence[str], class_names: Mapping[int, str], size_wh: tuple[int, int]
) -> tuple[str, list[float]]:
    """A line's class, and its box as left, top, width, height in COCO's pixels. FormatError naming the field."""
    if len(parts) != 5:
        raise FormatError(where, "5 fields: class cx cy w h", len(parts))
    if not parts[0].isdecimal() or int(parts[0]) not in class_names:
        raise FormatError(f"{where}: class", f"one of the {len(class_names)} in names", repr(parts[0]))
    shares: list[float] = []
    for name, part in zip(("cx", "cy", "w", "h"), parts[1:], strict=True):
        try:
            share = float(part)
        except ValueError:
            share = math.nan
        positive = share > 0 or name in ("cx", "cy")
        if not (-EDGE <= share <= 1 + EDGE and positive):
            raise FormatError(f"{where}: {name}", "a share of the image in [0, 1]", repr(part))
        shares.append(share)
    (cx, cy, w, h), (width, height) = shares, size_wh
    return class_names[int(parts[0])], [(cx - w / 2) * width, (cy - h / 2) * height, w * width, h * height]


def _mapping(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(files.read_text(path))
    except yaml.YAMLError as error:
        raise FormatError(str(path), "YAML", str(error).splitlines()[0]) from error
    if not isinstance(content, dict):
        raise FormatError(str(path), "train, val and names", type(content).__name__)
    return content


def _names(path: Path, content: Mapping[str, Any]) -> dict[int, str]:
    names = content.get("names")
    pairs = dict(enumerate(names)) if isinstance(names, list) else names
    if not isinstance(pairs, dict) or not pairs or any(type(k) is not int or k < 0 for k in pairs):
        raise FormatError(f"{path}: names", "a list of classes, or number: class", repr(names)[:60])
    return {k: str(v) for k, v in pairs.items()}


def _folders(path: Path, content: Mapping[str, Any], part: str) -> list[str]:
    value = content.get(part) or []
    folders = [value] if isinstance(value, str) else value
    if not isinstance(folders, list) or any(not isinstance(f, str) or f.endswith(".txt") for f in folders):
        raise FormatError(f"{path}: {part}", "a folder of images, or a list of folders", repr(value)[:60])
    return folders


def _beside(image: Path, folder: str) -> Path:
    """The text file of an image: the last "images" of its path is `folder`."""
    parts = list(image.parts)
    places = [i for i, part in enumerate(parts[:-1]) if part == "images"]
    if places:
        parts[places[-1]] = folder
    return Path(*parts).with_suffix(".txt")


def size_of_image(path: Path) -> tuple[int, int]:
    """Width and height of an image, from its header. FormatError."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, UnidentifiedImageError) as error:
        raise FormatError(str(path), "an image", str(error).splitlines()[0]) from error
