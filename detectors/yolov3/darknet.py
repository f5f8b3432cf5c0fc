"""A detector from Darknet's files, and back: `NAME.cfg`, `NAME.weights`, and `NAME.names` with a class a line."""

from __future__ import annotations

from pathlib import Path

import torch

from detectors.adapters import coco
from detectors.base import DetectorError
from detectors.reading import read_text
from detectors.whole import write_whole
from detectors.yolov3 import cfg, weights
from detectors.yolov3.yolov3 import YoloV3

_OURS: dict[str, str] = dict(zip(coco.NAMES, coco.CLASSES, strict=True))

_MOST_TEXT = 1 << 20
"""Bytes of a .cfg or .names file."""


def load(cfg_path: Path, weights_path: Path | None = None) -> YoloV3:
    """The network of a `.cfg` with its weights: by default those of the same name beside it. Classes are those of
    the `.names` file of the same name, or COCO's, where there are as many; "car" becomes "Car".

    Raises DetectorError, in one line, where a file is missing, damaged, or does not fit the others.
    """
    description = cfg.parse(read_text(cfg_path, "a Darknet .cfg", _MOST_TEXT), str(cfg_path))
    classes, path = _classes(cfg_path.with_suffix(".names"), description.classes), weights_path
    path = path or cfg_path.with_suffix(".weights")
    with torch.device("meta"):  # without memory, until it is known that the file fills it
        weights.check(YoloV3(classes, cfg=description).network, path)
    detector = YoloV3(classes, cfg=description)
    weights.read(detector.network, path)
    return detector


def save(detector: YoloV3, cfg_path: Path, seen: int = 0) -> None:
    """Write the three files that `load` reads. seen: images that the detector was trained on."""
    weights.write(detector.network, cfg_path.with_suffix(".weights"), seen)
    write_whole(cfg_path.with_suffix(".names"), "".join(f"{name}\n" for name in detector.classes).encode())
    write_whole(cfg_path, cfg.write(detector.cfg).encode())


def _classes(path: Path, count: int) -> tuple[str, ...]:
    if path.is_file():
        names = tuple(
            line.strip() for line in read_text(path, "class names", _MOST_TEXT).splitlines() if line.strip()
        )
        if len(names) != count:
            raise DetectorError(f"{path}: expected {count} classes as in the .cfg, found {len(names)}")
    elif count == len(coco.NAMES):
        names = coco.NAMES
    else:
        raise DetectorError(f"{path}: expected the {count} classes of the .cfg, a line each, found no file")
    return tuple(_OURS.get(name, name) for name in names)
