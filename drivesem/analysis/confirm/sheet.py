"""Both pictures of a counterexample on one sheet: the compositor's, the second renderer's, and cars enlarged."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from drivesem.analysis.confirm.judge import RendererFailure
from drivesem.analysis.confirm.results import Confirmed
from drivesem.report.drawing import MARGIN_PX, PAPER, TEXT_PX, paste, text_extent, write_text
from drivesem.report.tables import number_of
from drivesem.run.finished import Frame
from drivesem.run.report.pictures import overlay
from drivesem.run.results import BoxRecord, Failure
from scene_ir import files

_ENLARGED = 3
"""Cars that are shown enlarged, lost ones first."""
_AROUND = 0.35
"""How much of a car's box is shown around it, of its longer side."""
_LINE_PX = TEXT_PX + 8


def sheet_of(frame: Frame, confirmed: Confirmed, image: np.ndarray, t_star: float) -> np.ndarray:
    """The sheet (h, w, 3) uint8. image (H, W, 3) uint8: the second renderer's picture of the change."""
    composed = files.read_image(frame.pictures["attacked"])
    result = frame.result
    ours = _marked(composed, result.targets_moved, result.detections_attacked, confirmed.compositor, t_star)
    theirs = _marked(image, confirmed.targets_changed, confirmed.detections_changed, confirmed.second, t_star)
    titles = (
        f"{confirmed.identifier}, compositor: {_told(confirmed.compositor)}",
        f"{confirmed.identifier}, {confirmed.renderer}: {_told(confirmed.second)}",
    )
    names = ("compositor", confirmed.renderer)
    strip = _strip(names, (composed, image), _places(confirmed, result.targets_moved), composed.shape[1])
    height, width = composed.shape[:2]
    canvas = np.empty(
        (2 * (height + _LINE_PX) + strip.shape[0] + 4 * MARGIN_PX, width + 2 * MARGIN_PX, 3), np.uint8
    )
    canvas[:] = PAPER
    y = MARGIN_PX
    for title, picture in zip(titles, (ours, theirs), strict=True):
        write_text(canvas, (MARGIN_PX, y), title)
        paste(canvas, (MARGIN_PX, y + _LINE_PX), picture)
        y += _LINE_PX + height + MARGIN_PX
    paste(canvas, (MARGIN_PX, y), strip)
    return canvas


def _marked(
    image: np.ndarray,
    targets: Sequence[BoxRecord],
    detections: Sequence[BoxRecord],
    found: Sequence[RendererFailure],
    t_star: float,
) -> np.ndarray:
    # Regions are drawn by nobody: they stand in the targets once for each class.
    objects = tuple(t for t in targets if t.index is not None)
    failed = tuple(Failure(f.kind, f.label, f.xyxy, score=f.score) for f in found)
    return overlay(image, objects, tuple(detections), failed, t_star)


def _told(found: Sequence[RendererFailure]) -> str:
    if not found:
        return "no failure"
    lost = sum(f.kind == "lost" for f in found)
    phantoms = number_of(len(found) - lost, "phantom")
    return f"{lost} lost, {phantoms}; {sum(f.survives for f in found)} in both pictures"


def _places(confirmed: Confirmed, moved: Sequence[BoxRecord]) -> list[tuple[float, ...]]:
    """Boxes worth a closer look: failures, then the largest of the scene's cars that count."""
    places: list[tuple[float, ...]] = [f.xyxy for f in (*confirmed.compositor, *confirmed.second)]
    cars = sorted((t for t in moved if t.index is not None and not t.ignore), key=lambda t: t.xyxy[1] - t.xyxy[3])
    for box in (t.xyxy for t in cars):
        if all(abs(box[0] - p[0]) + abs(box[1] - p[1]) > 8 for p in places):
            places.append(box)
    return places[:_ENLARGED]


def _strip(
    names: tuple[str, str],
    pictures: tuple[np.ndarray, np.ndarray],
    places: Sequence[tuple[float, ...]],
    width: int,
) -> np.ndarray:
    """Pairs of enlarged windows, the compositor's left, side by side in `width` px."""
    cell = (width - (2 * _ENLARGED - 1) * MARGIN_PX) // (2 * _ENLARGED)
    strip = np.empty((cell + _LINE_PX if places else 0, width, 3), np.uint8)
    strip[:] = PAPER
    for column, box in enumerate(places):
        for side, picture in enumerate(pictures):
            x = (2 * column + side) * (cell + MARGIN_PX)
            paste(
                strip,
                (x, _LINE_PX),
                cv2.resize(_window(picture, box), (cell, cell), interpolation=cv2.INTER_CUBIC),
            )
            title = names[side]
            if text_extent(title, TEXT_PX)[0] <= cell:
                write_text(strip, (x, 0), title)
    return strip


def _window(picture: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """A square around a box, moved into the picture where it would leave it."""
    x0, y0, x1, y1 = box
    side = round(max(x1 - x0, y1 - y0, 16.0) * (1 + 2 * _AROUND))
    side = min(side, *picture.shape[:2])
    left = int(np.clip(round((x0 + x1 - side) / 2), 0, picture.shape[1] - side))
    top = int(np.clip(round((y0 + y1 - side) / 2), 0, picture.shape[0] - side))
    return picture[top : top + side, left : left + side]
