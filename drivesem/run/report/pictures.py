"""Pictures of a run: true and detected boxes over an image, and what changed. uint8 (H, W, 3) RGB in and out."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.run.report import grading
from drivesem.run.results import BoxRecord, Failure

Image = NDArray[np.uint8]

# Okabe and Ito's colour-blind-safe palette.
TRUE_COLOUR = (0, 158, 115)
DETECTED_COLOUR = (240, 228, 66)
LOST_COLOUR = (213, 94, 0)
PHANTOM_COLOUR = (204, 121, 167)
IGNORED_COLOUR = (150, 150, 150)

DIFFERENCE_GAIN = 3.0
"""Differences are shown this many times larger, around mid grey."""


def overlay(
    image: Image,
    targets: tuple[BoxRecord, ...],
    detections: tuple[BoxRecord, ...],
    failures: tuple[Failure, ...],
    threshold: float,
) -> Image:
    """`image` with true boxes (green; grey where ignored), detections above `threshold` (yellow, with class and
    score), lost objects (red) and phantoms (purple) with their kinds and grades.
    """
    canvas = image.copy()
    for box in targets:
        _draw(canvas, box.xyxy, IGNORED_COLOUR if box.ignore else TRUE_COLOUR, 1)
    for box in detections:
        if box.score is not None and box.score >= threshold:
            _draw(canvas, box.xyxy, DETECTED_COLOUR, 1, f"{box.label} {box.score:.2f}")
    for failure in failures:
        colour = LOST_COLOUR if failure.kind == "lost" else PHANTOM_COLOUR
        grade = f": {failure.grade}" if failure.grade else ""
        _draw(canvas, failure.xyxy, colour, 2, f"{grading.what(failure)}{grade}", below=True)
    return canvas


def difference(before: Image, after: Image) -> Image:
    """Signed difference times `DIFFERENCE_GAIN`, around mid grey."""
    signed = after.astype(np.float32) - before.astype(np.float32)
    return np.clip(127.5 + DIFFERENCE_GAIN * signed, 0, 255).astype(np.uint8)


def _draw(
    canvas: Image,
    xyxy: tuple[float, float, float, float],
    colour: tuple[int, int, int],
    thickness: int,
    text: str = "",
    below: bool = False,
) -> None:
    x0, y0, x1, y1 = (round(v) for v in xyxy)
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, thickness, cv2.LINE_AA)
    if text:
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)
        x = min(max(x0, 0), max(canvas.shape[1] - width, 0))
        y = min(y1 + height + 4, canvas.shape[0] - 3) if below else max(y0 - 4, height + 1)
        cv2.rectangle(canvas, (x, y - height - 2), (x + width, y + 3), (0, 0, 0), -1)
        cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
