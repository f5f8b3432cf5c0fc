"""Pictures of a detector's mistakes: what it hit, missed and made up in one frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.evaluation.instances import Floats
from drivesem.evaluation.outcome import Marks
from drivesem.report.drawing import Label, Labels
from drivesem.run.report.pictures import DETECTED_COLOUR, IGNORED_COLOUR, LOST_COLOUR, PHANTOM_COLOUR, TRUE_COLOUR

_LEGEND = (
    ("hit", TRUE_COLOUR),
    ("missed", LOST_COLOUR),
    ("false alarm", PHANTOM_COLOUR),
    ("ignored", IGNORED_COLOUR),
)
_LEGEND_PX = 22


def marked(image: NDArray[np.uint8], marks: Marks) -> NDArray[np.uint8]:
    """The image (H, W, 3) uint8 RGB with its marks, and a line below that names their colours."""
    canvas = np.concatenate([image, np.full((_LEGEND_PX, image.shape[1], 3), 250, np.uint8)])
    labels = Labels((image.shape[1], image.shape[0]), [*marks.missed.tolist(), *marks.alarms.tolist()])
    for box in marks.ignored:
        _rectangle(canvas, box, IGNORED_COLOUR, 1)
    for box in marks.found:
        _rectangle(canvas, box, DETECTED_COLOUR, 1)
    for box in marks.hit:
        _rectangle(canvas, box, TRUE_COLOUR, 1)
    for box in marks.missed:
        _rectangle(canvas, box, LOST_COLOUR, 2)
    for box, score in zip(marks.alarms, marks.alarm_scores, strict=True):
        _rectangle(canvas, box, PHANTOM_COLOUR, 2)
        labels.add(box.tolist(), Label(f"{score:.2f}", PHANTOM_COLOUR))
    labels.draw(canvas)
    x = 6
    for name, colour in (*_LEGEND, ("found at", DETECTED_COLOUR)):
        y = image.shape[0] + _LEGEND_PX // 2
        cv2.rectangle(canvas, (x, y - 5), (x + 10, y + 5), colour, -1)
        _text(canvas, name, (x + 15, y + 4), (30, 30, 30))
        x += 110
    return canvas


def _rectangle(canvas: NDArray[np.uint8], box: Floats, colour: tuple[int, int, int], thickness: int) -> None:
    x0, y0, x1, y1 = (round(float(v)) for v in box)
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, thickness, cv2.LINE_AA)


def _text(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
