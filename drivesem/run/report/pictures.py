"""Pictures of a run: true and detected boxes over an image, and what changed. uint8 (H, W, 3) RGB in and out."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.report.drawing import Label, Labels
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
    labels: Labels | None = None,
) -> Image:
    """`image` with true boxes (green; grey where ignored), detections above `threshold` (yellow, with class and
    score), lost objects (orange) and phantoms (purple) with their kinds and grades. labels: texts that are to be
    drawn too, and have their places.
    """
    canvas = image.copy()
    labels = labels or Labels((image.shape[1], image.shape[0]))
    labels.seen = [box.xyxy for box in (*failures, *targets)]
    for failure in failures:
        grade = f": {failure.grade}" if failure.grade else ""
        labels.add(failure.xyxy, Label(f"{grading.what(failure)}{grade}", _colour(failure)))
    for box in targets:
        _draw(canvas, box.xyxy, IGNORED_COLOUR if box.ignore else TRUE_COLOUR, 1)
    for box in detections:
        if box.score is not None and box.score >= threshold:
            _draw(canvas, box.xyxy, DETECTED_COLOUR, 1)
            labels.add(box.xyxy, Label(f"{box.label} {box.score:.2f}", DETECTED_COLOUR))
    for failure in failures:
        _draw(canvas, failure.xyxy, _colour(failure), 2)
    labels.draw(canvas)
    return canvas


def difference(before: Image, after: Image) -> Image:
    """Signed difference times `DIFFERENCE_GAIN`, around mid grey."""
    signed = after.astype(np.float32) - before.astype(np.float32)
    return np.clip(127.5 + DIFFERENCE_GAIN * signed, 0, 255).astype(np.uint8)


def _colour(failure: Failure) -> tuple[int, int, int]:
    return LOST_COLOUR if failure.kind == "lost" else PHANTOM_COLOUR


def _draw(
    canvas: Image, xyxy: tuple[float, float, float, float], colour: tuple[int, int, int], thickness: int
) -> None:
    x0, y0, x1, y1 = (round(v) for v in xyxy)
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, thickness, cv2.LINE_AA)
