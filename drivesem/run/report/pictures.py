"""A run's pictures: boxes and failures drawn over an image, and the difference of two images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.reporting.drawing import (
    DETECTED_COLOUR,
    IGNORED_COLOUR,
    LOST_COLOUR,
    PHANTOM_COLOUR,
    TRUE_COLOUR,
    LabelLayout,
    TextLabel,
)
from drivesem.run.report import page as grading
from drivesem.run.results import BoxRecord, Failure

Image = NDArray[np.uint8]

DIFFERENCE_GAIN = 3.0
"""Factor by which differences are amplified around mid grey."""


def draw_overlay(
    image: Image,
    targets: tuple[BoxRecord, ...],
    detections: tuple[BoxRecord, ...],
    failures: tuple[Failure, ...],
    threshold: float,
    labels: LabelLayout | None = None,
) -> Image:
    """Draw true boxes (green, ignored ones grey), detections (yellow, with class and score), lost objects (orange)
    and phantoms (purple), with kinds and grades.

    Args:
        image: Picture (H, W, 3) uint8; left unchanged.
        targets: True boxes.
        detections: Detected boxes.
        failures: Lost objects and phantoms.
        threshold: Lowest score of a detection that is drawn.
        labels: Further labels, already placed.

    Returns:
        The drawing (H, W, 3) uint8.
    """
    canvas = image.copy()
    labels = labels or LabelLayout((image.shape[1], image.shape[0]))
    labels.protected_boxes = [box.xyxy for box in (*failures, *targets)]
    for failure in failures:
        grade = f": {grading.format_grade(failure)}" if failure.grade else ""
        labels.add(
            failure.xyxy, TextLabel(f"{grading.describe_failure(failure)}{grade}", _failure_colour(failure))
        )
    for box in targets:
        _draw_box(canvas, box.xyxy, IGNORED_COLOUR if box.ignore else TRUE_COLOUR, 1)
    for box in detections:
        if box.score is not None and box.score >= threshold:
            _draw_box(canvas, box.xyxy, DETECTED_COLOUR, 1)
            labels.add(box.xyxy, TextLabel(f"{box.label} {box.score:.2f}", DETECTED_COLOUR))
    for failure in failures:
        _draw_box(canvas, failure.xyxy, _failure_colour(failure), 2)
    labels.draw(canvas)
    return canvas


def draw_difference(before: Image, after: Image) -> Image:
    """Return `DIFFERENCE_GAIN` times the signed difference of two pictures (H, W, 3) uint8, around mid grey."""
    signed = after.astype(np.float32) - before.astype(np.float32)
    return np.clip(127.5 + DIFFERENCE_GAIN * signed, 0, 255).astype(np.uint8)


def _failure_colour(failure: Failure) -> tuple[int, int, int]:
    return LOST_COLOUR if failure.kind == "lost" else PHANTOM_COLOUR


def _draw_box(
    canvas: Image, xyxy: tuple[float, float, float, float], colour: tuple[int, int, int], thickness: int
) -> None:
    x0, y0, x1, y1 = (round(v) for v in xyxy)
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, thickness, cv2.LINE_AA)
