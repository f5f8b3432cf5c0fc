"""A contact sheet of a data set: a row a frame, photograph with boxes, depth, classes, objects' masks.

`sheet` shows exposures as they were made, `sheet_of` a folder as this project's readers see it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from drivesem.data.registry import Dataset
from drivesem.data.truth import SKY_CM, Exposure, Place
from drivesem.data.vkitti2 import COLOURS
from scene_ir import files
from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Frame

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

MOST_FRAMES = 12
WIDTH_PX = 2000
_MARGIN_PX = 12
_PHOTO_PX = 1160
"""Width of the photograph; right of it three maps and a legend, two by two."""
_TEXT_PX = 15
_BACKGROUND = (250, 250, 250)
_INK = (30, 30, 30)
_UNKNOWN = (120, 120, 120)
"""Sky in depth maps; pixels of no object."""
NEAR_M, FAR_M = 3.0, 200.0
"""Ends of the depth scale, which is logarithmic."""
BOX_COLOURS = {
    "Car": (86, 180, 233),
    "Van": (0, 158, 115),
    "Truck": (230, 159, 0),
    "Pedestrian": (240, 228, 66),
    "Person_sitting": (240, 228, 66),
    "Cyclist": (204, 121, 167),
}
"""Okabe and Ito's colour-blind-safe palette."""
_OTHER_COLOUR = (213, 94, 0)
_IGNORED_COLOUR = (190, 190, 190)
_MORE_COLOURS = {"Pedestrian": (220, 20, 60), "Cyclist": (119, 11, 32), "Rider": (119, 11, 32)}
"""Classes that Virtual KITTI has not (Cityscapes' colours; its rider is a cyclist's)."""


@dataclass(frozen=True, slots=True)
class _Row:
    """What one row shows. boxes: (xyxy, colour, text); depth_m (H, W), inf in the sky; classes (H, W) into
    class_names; instances (H, W), 0 is none. A map that the data set has not is None.
    """

    title: str
    image: np.ndarray
    boxes: tuple[tuple[Sequence[float], tuple[int, int, int], str], ...]
    ignored: tuple[Sequence[float], ...]
    depth_m: np.ndarray | None
    classes: np.ndarray | None
    class_names: tuple[str, ...]
    instances: np.ndarray | None


def sheet(exposures: Sequence[Exposure], places: Sequence[Place]) -> np.ndarray:
    """A sheet (h, 2000, 3) uint8 RGB of exposures and their places. RangeError for none or more than 12."""
    if len(exposures) != len(places):
        raise ShapeError("places", f"{len(exposures)} entries", len(places))
    rows = [_of_exposure(exposure, place) for exposure, place in zip(exposures, places, strict=True)]
    return _compose(rows)


def sheet_of(dataset: Dataset, identifiers: Sequence[str]) -> np.ndarray:
    """A sheet (h, 2000, 3) uint8 RGB of frames as a reader gives them: what was written, not what was meant.

    RangeError for none or more than 12 frames; FormatError where one does not read.
    """
    return _compose([_of_frame(dataset.frame(identifier)) for identifier in identifiers])


def write_sheet(path: Path, picture: np.ndarray) -> None:
    """Write a sheet as PNG, or as JPEG where the name says so, atomically."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        files.write_png(path, picture)
        return
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    files.write_bytes(path, data.tobytes())


def _distance(translation: Sequence[float]) -> str:
    x, _, z = translation
    distance = math.hypot(x, z)
    return f" {distance:.0f} m" if math.isfinite(distance) else ""


def _of_exposure(exposure: Exposure, place: Place) -> _Row:
    boxes, labels = [], exposure.labels
    for i, thing in enumerate(o for o in exposure.objects if o.labelled):
        text = f"{thing.kind}{_distance(thing.translation)} {100 * thing.visible:.0f} %"
        boxes.append((labels.boxes_xyxy[i].tolist(), BOX_COLOURS.get(thing.kind, _OTHER_COLOUR), text))
    depth_m = exposure.depth_cm.astype(np.float32) / 100
    depth_m[exposure.depth_cm == SKY_CM] = np.inf
    return _Row(
        title=f"{place.number:06d}   Scene{place.scene} / {place.variation} / {place.frame}   {place.part}",
        image=exposure.image,
        boxes=tuple(boxes),
        ignored=tuple(labels.ignore_xyxy.tolist()),
        depth_m=depth_m,
        classes=exposure.classes.astype(np.int64),
        class_names=exposure.class_names,
        instances=exposure.instances.astype(np.int64),
    )


def _of_frame(frame: Frame) -> _Row:
    """A reader's frame: occlusion is KITTI's 0 to 3 where truncation is known, masks are those of labels."""
    boxes, ignored, instances = [], [], None
    labels = frame.labels
    if labels is not None:
        ignored = labels.ignore_xyxy.tolist()
        for i, kind in enumerate(labels.kind):
            known = math.isfinite(float(labels.truncation[i]))
            occlusion = f" occ {int(labels.occlusion[i])}" if known else ""
            text = f"{kind}{_distance(labels.translation[i].tolist())}{occlusion}"
            boxes.append((labels.boxes_xyxy[i].tolist(), BOX_COLOURS.get(kind, _OTHER_COLOUR), text))
    if frame.masks is not None:
        instances = np.zeros((frame.camera.height, frame.camera.width), np.int64)
        for i, mask in enumerate(frame.masks.numpy()):
            instances[mask > 0.5] = i + 1
    return _Row(
        title=f"{frame.identifier}   {frame.provenance.get('dataset', '')}",
        image=(frame.photograph.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8),
        boxes=tuple(boxes),
        ignored=tuple(ignored),
        depth_m=None if frame.depth is None else frame.depth.numpy(),
        classes=None if frame.classes is None else frame.classes.numpy(),
        class_names=frame.class_names,
        instances=instances,
    )


def _compose(rows: Sequence[_Row]) -> np.ndarray:
    if not 1 <= len(rows) <= MOST_FRAMES:
        raise RangeError("frames of a sheet", f"1 to {MOST_FRAMES}", len(rows))
    strips = [_strip(row) for row in rows]
    gap = np.full((_MARGIN_PX, WIDTH_PX, 3), _BACKGROUND, np.uint8)
    return np.concatenate([part for strip in strips for part in (gap, strip)] + [gap])


def _strip(row: _Row) -> np.ndarray:
    """One frame: a title, the photograph, and right of it depth and classes over masks and a legend."""
    height, width = row.image.shape[:2]
    tall = max(round(_PHOTO_PX * height / width), 2 * _TEXT_PX)
    small = ((WIDTH_PX - _PHOTO_PX - 4 * _MARGIN_PX) // 2, tall // 2 - _MARGIN_PX // 2)
    top = _TEXT_PX + 10
    strip = np.full((top + tall, WIDTH_PX, 3), _BACKGROUND, np.uint8)
    _write(strip, (_MARGIN_PX, 2), row.title)
    right = _MARGIN_PX + _PHOTO_PX + _MARGIN_PX
    columns, lines = (right, right + small[0] + _MARGIN_PX), (top, top + tall - small[1])
    _paste(strip, (_MARGIN_PX, top), _photograph(row, (_PHOTO_PX, tall)))
    panels = (
        ("depth", None if row.depth_m is None else _depth_colours(row.depth_m)),
        ("classes", None if row.classes is None else _class_colours(row.classes, row.class_names)),
        ("masks", None if row.instances is None else _instance_colours(row.instances, row.image)),
    )
    for (name, picture), x, y in zip(panels, (*columns, columns[0]), (lines[0], *lines), strict=True):
        if picture is None:
            _write(strip, (x, y), f"no {name}", _UNKNOWN)
        else:
            _paste(strip, (x, y), cv2.resize(picture, small, interpolation=cv2.INTER_AREA))
    _legend(strip, (columns[1], lines[1]), row)
    return strip


def _photograph(row: _Row, size_wh: tuple[int, int]) -> np.ndarray:
    """The photograph with thin boxes, drawn at the sheet's size, and texts that do not leave it."""
    scale = size_wh[0] / row.image.shape[1]
    canvas = cv2.resize(row.image, size_wh, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)

    def corners(xyxy: Sequence[float]) -> list[int]:
        return [round((v + 0.5) * scale - 0.5) for v in xyxy]

    for xyxy in row.ignored:
        x0, y0, x1, y1 = corners(xyxy)
        cv2.rectangle(canvas, (x0, y0), (x1, y1), _IGNORED_COLOUR, 1)
    for xyxy, colour, _ in row.boxes:
        x0, y0, x1, y1 = corners(xyxy)
        cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, 1)
    taken: list[tuple[int, int, int, int]] = []
    # nearest, that is largest, first: where two texts would meet, the smaller object's is left out
    for xyxy, colour, text in sorted(row.boxes, key=lambda b: (b[0][1] - b[0][3]) * (b[0][2] - b[0][0])):
        x0, y0, _, y1 = corners(xyxy)
        wide, high = _extent(text, _TEXT_PX - 3)
        x = min(max(x0, 0), max(size_wh[0] - wide, 0))
        for y in (y0 - high - 1, y1 + 2):
            spot = (x, y, x + wide, y + high)
            free = all(spot[2] < t[0] or t[2] < spot[0] or spot[3] < t[1] or t[3] < spot[1] for t in taken)
            if free and 0 <= y <= size_wh[1] - high:
                cv2.rectangle(canvas, spot[:2], spot[2:], (0, 0, 0), -1)
                _write(canvas, (x + 2, y), text, colour, _TEXT_PX - 3)
                taken.append(spot)
                break
    return canvas


def _depth_colours(depth_m: np.ndarray) -> np.ndarray:
    """Depth in viridis, near is bright, on a logarithmic scale; the sky, and no depth, in grey."""
    known = np.isfinite(depth_m) & (depth_m > 0)
    level = np.log(np.clip(np.where(known, depth_m, FAR_M), NEAR_M, FAR_M) / NEAR_M) / np.log(FAR_M / NEAR_M)
    colours = cv2.applyColorMap((255 * (1 - level)).round().astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(known[..., None], colours, np.array(_UNKNOWN, np.uint8))


def _class_colour(name: str) -> tuple[int, int, int]:
    return COLOURS.get(name) or _MORE_COLOURS.get(name, _UNKNOWN)


def _class_colours(classes: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Classes in Virtual KITTI's colours."""
    return np.array([_class_colour(name) for name in names], np.uint8)[classes]


def _instance_colours(instances: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Objects in hues that differ from number to number, over the photograph in pale grey."""
    grey = 128 + cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) // 4
    numbers = np.arange(int(instances.max(initial=0)) + 1)
    hue = (numbers * 0.618034 % 1 * 180).astype(np.uint8)  # golden ratio: neighbours lie far apart
    value = np.where(numbers % 2, 235, 190).astype(np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 200), value], axis=1)[None]
    palette = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]
    return np.where((instances > 0)[..., None], palette[instances], grey[..., None]).astype(np.uint8)


def _legend(strip: np.ndarray, corner: tuple[int, int], row: _Row) -> None:
    """Counts of the objects, the depth scale, and the classes that the frame shows, largest first."""
    x0, y0 = corner
    kinds: Mapping[str, int] = {}
    for _, _, text in row.boxes:
        kind = text.split()[0]
        kinds = {**kinds, kind: kinds.get(kind, 0) + 1}
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.items()) or "no objects"
    _write(strip, (x0, y0), f"{counts}; {len(row.ignored)} ignored")
    y = y0 + _TEXT_PX + 8
    if row.depth_m is not None:
        ramp = np.geomspace(NEAR_M, FAR_M, 160)[None].repeat(_TEXT_PX - 5, axis=0)
        _paste(strip, (x0 + 34, y + 3), _depth_colours(ramp))
        _write(strip, (x0, y), f"{NEAR_M:.0f} m")
        _write(strip, (x0 + 202, y), f"{FAR_M:.0f} m (log), sky grey")
        y += _TEXT_PX + 8
    if row.classes is None:
        return
    shares = np.bincount(row.classes.ravel(), minlength=len(row.class_names)) / row.classes.size
    x = x0
    for i in np.argsort(-shares):
        if shares[i] < 0.001:
            break
        name = row.class_names[i]
        wide = _extent(name, _TEXT_PX - 2)[0] + 26
        if x + wide > WIDTH_PX - _MARGIN_PX:
            x, y = x0, y + _TEXT_PX + 5
        if y + _TEXT_PX > strip.shape[0]:
            break
        strip[y + 4 : y + 15, x : x + 14] = _class_colour(name)
        _write(strip, (x + 18, y), name, _INK, _TEXT_PX - 2)
        x += wide


def _paste(canvas: np.ndarray, corner: tuple[int, int], picture: np.ndarray) -> None:
    x, y = corner
    canvas[y : y + picture.shape[0], x : x + picture.shape[1]] = picture


@lru_cache(maxsize=4)
def _font(size_px: int) -> FreeTypeFont:
    """DejaVu Sans, which matplotlib brings along."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size_px)


def _extent(text: str, size_px: int) -> tuple[int, int]:
    """Width and height in px that a text takes, with a margin of 2 px at its sides."""
    return math.ceil(_font(size_px).getlength(text)) + 4, size_px + 3


def _write(
    canvas: np.ndarray,
    corner: tuple[int, int],
    text: str,
    colour: tuple[int, int, int] = _INK,
    size_px: int = _TEXT_PX,
) -> None:
    """Write a line of text into `canvas`, its upper left corner at `corner`; what leaves the canvas is cut."""
    from PIL import Image, ImageDraw

    x, y = corner
    wide, high = _extent(text, size_px)
    part = canvas[max(y, 0) : y + high + 3, max(x, 0) : x + wide]
    picture = Image.fromarray(np.ascontiguousarray(part))
    ImageDraw.Draw(picture).text((0, 0), text, colour, _font(size_px))
    part[:] = np.asarray(picture)
