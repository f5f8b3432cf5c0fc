"""A contact sheet of a data set as its reader sees it: photograph with boxes, depth, classes, objects' masks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from drivesem.data.registry import Dataset
from drivesem.data.vkitti2 import COLOURS
from drivesem.reporting.drawing import (
    FAR_M,
    MARGIN_PX,
    NEAR_M,
    PAPER_COLOUR,
    TEXT_COLOUR,
    TEXT_PX,
    UNKNOWN_COLOUR,
    colourise_depth,
    colourise_objects,
    measure_text,
    paste,
    write_text,
)
from scene_ir.errors import RangeError
from scene_ir.types import Frame

MOST_FRAMES = 12
WIDTH_PX = 2000
_PHOTO_PX = 1160
"""Width of the photograph; right of it three maps and a legend, two by two."""
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
class _SheetRow:
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


def draw_sheet(dataset: Dataset, identifiers: Sequence[str]) -> np.ndarray:
    """A sheet (h, 2000, 3) uint8 RGB of frames as a reader gives them: what was written, not what was meant.

    RangeError for none or more than 12 frames; FormatError where one does not read.
    """
    return _compose([_of_frame(dataset.frame(identifier)) for identifier in identifiers])


def _of_frame(frame: Frame) -> _SheetRow:
    """A reader's frame: occlusion is KITTI's 0 to 3 where truncation is known, masks are those of labels."""
    boxes, ignored, instances = [], [], None
    labels = frame.labels
    if labels is not None:
        ignored = labels.ignore_xyxy.tolist()
        for i, kind in enumerate(labels.kind):
            known = math.isfinite(float(labels.truncation[i]))
            occlusion = f" occ {int(labels.occlusion[i])}" if known else ""
            away = math.hypot(float(labels.translation[i, 0]), float(labels.translation[i, 2]))
            text = f"{kind}{f' {away:.0f} m' if math.isfinite(away) else ''}{occlusion}"
            boxes.append((labels.boxes_xyxy[i].tolist(), BOX_COLOURS.get(kind, _OTHER_COLOUR), text))
    if frame.masks is not None:
        instances = np.zeros((frame.camera.height, frame.camera.width), np.int64)
        for i, mask in enumerate(frame.masks.numpy()):
            instances[mask > 0.5] = i + 1
    return _SheetRow(
        title=f"{frame.identifier}   {frame.provenance.get('dataset', '')}",
        image=(frame.photograph.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8),
        boxes=tuple(boxes),
        ignored=tuple(ignored),
        depth_m=None if frame.depth is None else frame.depth.numpy(),
        classes=None if frame.classes is None else frame.classes.numpy(),
        class_names=frame.class_names,
        instances=instances,
    )


def _compose(rows: Sequence[_SheetRow]) -> np.ndarray:
    if not 1 <= len(rows) <= MOST_FRAMES:
        raise RangeError("frames of a sheet", f"1 to {MOST_FRAMES}", len(rows))
    strips = [_strip(row) for row in rows]
    gap = np.full((MARGIN_PX, WIDTH_PX, 3), PAPER_COLOUR, np.uint8)
    return np.concatenate([part for strip in strips for part in (gap, strip)] + [gap])


def _strip(row: _SheetRow) -> np.ndarray:
    """One frame: a title, the photograph, and right of it depth and classes over masks and a legend."""
    height, width = row.image.shape[:2]
    tall = max(round(_PHOTO_PX * height / width), 2 * TEXT_PX)
    small = ((WIDTH_PX - _PHOTO_PX - 4 * MARGIN_PX) // 2, tall // 2 - MARGIN_PX // 2)
    top = TEXT_PX + 10
    strip = np.full((top + tall, WIDTH_PX, 3), PAPER_COLOUR, np.uint8)
    write_text(strip, (MARGIN_PX, 2), row.title)
    right = MARGIN_PX + _PHOTO_PX + MARGIN_PX
    columns, lines = (right, right + small[0] + MARGIN_PX), (top, top + tall - small[1])
    paste(strip, (MARGIN_PX, top), _photograph(row, (_PHOTO_PX, tall)))
    panels = (
        ("depth", None if row.depth_m is None else colourise_depth(row.depth_m)),
        ("classes", None if row.classes is None else _class_colours(row.classes, row.class_names)),
        ("masks", None if row.instances is None else colourise_objects(row.instances, row.image)),
    )
    for (name, picture), x, y in zip(panels, (*columns, columns[0]), (lines[0], *lines), strict=True):
        if picture is None:
            write_text(strip, (x, y), f"no {name}", UNKNOWN_COLOUR)
        else:
            paste(strip, (x, y), cv2.resize(picture, small, interpolation=cv2.INTER_AREA))
    _legend(strip, (columns[1], lines[1]), row)
    return strip


def _photograph(row: _SheetRow, size_wh: tuple[int, int]) -> np.ndarray:
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
        wide, high = measure_text(text, TEXT_PX - 3)
        x = min(max(x0, 0), max(size_wh[0] - wide, 0))
        for y in (y0 - high - 1, y1 + 2):
            spot = (x, y, x + wide, y + high)
            free = all(spot[2] < t[0] or t[2] < spot[0] or spot[3] < t[1] or t[3] < spot[1] for t in taken)
            if free and 0 <= y <= size_wh[1] - high:
                cv2.rectangle(canvas, spot[:2], spot[2:], (0, 0, 0), -1)
                write_text(canvas, (x + 2, y), text, colour, TEXT_PX - 3)
                taken.append(spot)
                break
    return canvas


def _class_colour(name: str) -> tuple[int, int, int]:
    return COLOURS.get(name) or _MORE_COLOURS.get(name, UNKNOWN_COLOUR)


def _class_colours(classes: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Classes in Virtual KITTI's colours."""
    return np.array([_class_colour(name) for name in names], np.uint8)[classes]


def _legend(strip: np.ndarray, corner: tuple[int, int], row: _SheetRow) -> None:
    """Counts of the objects, the depth scale, and the classes that the frame shows, largest first."""
    x0, y0 = corner
    kinds = Counter(text.split()[0] for _, _, text in row.boxes)
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.items()) or "no objects"
    write_text(strip, (x0, y0), f"{counts}; {len(row.ignored)} ignored")
    y = y0 + TEXT_PX + 8
    if row.depth_m is not None:
        ramp = np.geomspace(NEAR_M, FAR_M, 160)[None].repeat(TEXT_PX - 5, axis=0)
        paste(strip, (x0 + 34, y + 3), colourise_depth(ramp))
        write_text(strip, (x0, y), f"{NEAR_M:.0f} m")
        write_text(strip, (x0 + 202, y), f"{FAR_M:.0f} m (log), sky grey")
        y += TEXT_PX + 8
    if row.classes is None:
        return
    shares = np.bincount(row.classes.ravel(), minlength=len(row.class_names)) / row.classes.size
    x = x0
    for i in np.argsort(-shares):
        if shares[i] < 0.001:
            break
        name = row.class_names[i]
        wide = measure_text(name, TEXT_PX - 2)[0] + 26
        if x + wide > WIDTH_PX - MARGIN_PX:
            x, y = x0, y + TEXT_PX + 5
        if y + TEXT_PX > strip.shape[0]:
            break
        strip[y + 4 : y + 15, x : x + 14] = _class_colour(name)
        write_text(strip, (x + 18, y), name, TEXT_COLOUR, TEXT_PX - 2)
        x += wide
