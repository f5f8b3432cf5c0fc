"""A detector from Darknet's files, and back: `NAME.cfg`, `NAME.weights`, and `NAME.names` with a class a line."""

from __future__ import annotations

from pathlib import Path

from detectors.adapters import coco
from detectors.base import DetectorError
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
    description = cfg.parse(_text(cfg_path, "a Darknet .cfg"), str(cfg_path))
    detector = YoloV3(_classes(cfg_path.with_suffix(".names"), description.classes), cfg=description)
    weights.read(detector.network, weights_path or cfg_path.with_suffix(".weights"))
    return detector


def save(detector: YoloV3, cfg_path: Path, seen: int = 0) -> None:
    """Write the three files that `load` reads. seen: images that the detector was trained on."""
    weights.write(detector.network, cfg_path.with_suffix(".weights"), seen)
    write_whole(cfg_path.with_suffix(".names"), "".join(f"{name}\n" for name in detector.classes).encode())
    write_whole(cfg_path, cfg.write(detector.cfg).encode())


def _classes(path: Path, count: int) -> tuple[str, ...]:
    if path.is_file():
        names = tuple(line.strip() for line in _text(path, "class names").splitlines() if line.strip())
        if len(names) != count:
            raise DetectorError(f"{path}: expected {count} classes as in the .cfg, found {len(names)}")
    elif count == len(coco.NAMES):
        names = coco.NAMES
    else:
        raise DetectorError(f"{path}: expected the {count} classes of the .cfg, a line each, found no file")
    return tuple(_OURS.get(name, name) for name in names)


def _text(path: Path, what: str) -> str:
    """A file's text. DetectorError where there is none, or too much."""
    try:
        size = path.stat().st_size
        if not path.is_file() or size > _MOST_TEXT:
            found = f"{size:,} bytes" if path.is_file() else "no regular file"
            raise DetectorError(f"{path}: expected {what}, found {found}")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "bytes that are no text"
        raise DetectorError(f"{path}: expected {what}, found {reason}") from None
