"""A detector from Darknet's files, and back: `NAME.cfg`, `NAME.weights`, and `NAME.names` with a class a line."""

from __future__ import annotations

from pathlib import Path

from detectors.adapters import coco
from detectors.base import DetectorError
from detectors.yolov3 import cfg, weights
from detectors.yolov3.yolov3 import YoloV3

_OURS: dict[str, str] = dict(zip(coco.NAMES, coco.CLASSES, strict=True))


def load(cfg_path: Path, weights_path: Path | None = None) -> YoloV3:
    """The network of a `.cfg` with its weights: by default those of the same name beside it. Classes are those of
    the `.names` file of the same name, or COCO's, where there are as many; "car" becomes "Car".

    Raises DetectorError, in one line, where a file is missing, damaged, or does not fit the others.
    """
    try:
        text = cfg_path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "bytes that are no text"
        raise DetectorError(f"{cfg_path}: expected a Darknet .cfg, found {reason}") from None
    description = cfg.parse(text, str(cfg_path))
    detector = YoloV3(_classes(cfg_path.with_suffix(".names"), description.classes), cfg=description)
    weights.read(detector.network, weights_path or cfg_path.with_suffix(".weights"))
    return detector


def save(detector: YoloV3, cfg_path: Path, seen: int = 0) -> None:
    """Write the three files that `load` reads. seen: images that the detector was trained on."""
    weights.write(detector.network, cfg_path.with_suffix(".weights"), seen)
    cfg_path.with_suffix(".names").write_text("".join(f"{name}\n" for name in detector.classes), encoding="utf-8")
    cfg_path.write_text(cfg.write(detector.cfg), encoding="utf-8")


def _classes(path: Path, count: int) -> tuple[str, ...]:
    if path.is_file():
        names = tuple(line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
        if len(names) != count:
            raise DetectorError(f"{path}: expected {count} classes as in the .cfg, found {len(names)}")
    elif count == len(coco.NAMES):
        names = coco.NAMES
    else:
        raise DetectorError(f"{path}: expected the {count} classes of the .cfg, a line each, found no file")
    return tuple(_OURS.get(name, name) for name in names)
