"""Features of labelled vehicles that any picture has, drawn or not."""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.render.model import LUMA

Floats = NDArray[np.float64]
_RING = 0.5
"""Width of the ring around a box, in sides of the box."""
_EDGE_PX, _COVERED = 2.0, 0.2
"""Distance from the picture's border at which a box counts as cut, and share of it that nearer boxes may cover."""
_DIGITS = 4


@dataclass(frozen=True, slots=True)
class ObjectFeatures:
    """What describes one vehicle in a picture. Luma is in [0, 1]."""

    height_px: float
    """Height of its box, px in a picture of BDD100K's size."""
    aspect: float
    """Width of the box over its height."""
    across: float
    """Horizontal place of its centre, 0 left to 1 right."""
    lightness: float
    """Mean luma in the box."""
    contrast: float
    """Standard deviation of luma in the box."""
    surround_lightness: float
    """Mean luma in a ring around the box, half a side wide."""
    surround_contrast: float
    """Standard deviation of luma in the ring; fog and darkness lower it."""
    difference: float
    """Absolute difference of the two means."""


FEATURES = tuple(field.name for field in fields(ObjectFeatures))


def measure_objects(picture: NDArray[np.uint8], boxes_xyxy: Floats) -> list[ObjectFeatures]:
    """Measure vehicles in an RGB picture (H, W, 3); boxes (N, 4) px, clipped to the picture."""
    luma = picture.astype(np.float64) @ np.array(LUMA, np.float64) / 255
    sums, squares = (np.asarray(table, np.float64) for table in cv2.integral2(luma))
    size_hw = picture.shape[:2]
    measured = []
    for x0, y0, x1, y1 in boxes_xyxy:
        wide, high = x1 - x0, y1 - y0
        box = _moments(sums, squares, (x0, y0, x1, y1), size_hw)
        ring_wide, ring_high = _RING * wide, _RING * high
        grown = (x0 - ring_wide, y0 - ring_high, x1 + ring_wide, y1 + ring_high)
        # a box that fills the picture has no ring: the box stands for it
        around = _moments(sums, squares, grown, size_hw)
        ring = around - box if around[0] > box[0] else box
        (lightness, contrast), (surround_lightness, surround_contrast) = (
            _mean_and_deviation(box),
            _mean_and_deviation(ring),
        )
        values = (
            *(high, wide / max(high, 1e-6), (x0 + x1) / (2 * size_hw[1]), lightness, contrast),
            *(surround_lightness, surround_contrast, abs(lightness - surround_lightness)),
        )
        measured.append(ObjectFeatures(*(round(float(value), _DIGITS) for value in values)))
    return measured


def _moments(
    sums: Floats, squares: Floats, box_xyxy: tuple[float, float, float, float], size_hw: tuple[int, int]
) -> Floats:
    """Number of pixels in a box, sum of their luma, and sum of its squares (3,)."""
    left, right = _pixels(box_xyxy[0], box_xyxy[2], size_hw[1])
    top, bottom = _pixels(box_xyxy[1], box_xyxy[3], size_hw[0])
    totals = (a[bottom, right] - a[top, right] - a[bottom, left] + a[top, left] for a in (sums, squares))
    return np.array([(bottom - top) * (right - left), *totals])


def _pixels(low: float, high: float, size: int) -> tuple[int, int]:
    start = min(max(round(low), 0), size - 1)
    return start, max(min(round(high) + 1, size), start + 1)


def _mean_and_deviation(moments: Floats) -> tuple[float, float]:
    count, total, square = moments
    mean = total / count
    return mean, float(np.sqrt(max(square / count - mean * mean, 0.0)))


def find_hidden(boxes_xyxy: Floats, size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """Whether each vehicle (N,) is cut by the picture's border, or covered by others.

    Vehicles with a lower bottom edge are nearer, and cover what their boxes overlap. Data sets that label neither
    occlusion nor truncation have boxes, too.

    Args:
        boxes_xyxy: (N, 4) px, of all vehicles.
        size_hw: Size of the picture, px.
    """
    hidden = np.zeros(len(boxes_xyxy), bool)
    for i, (x0, y0, x1, y1) in enumerate(boxes_xyxy):
        cut = (
            x0 <= _EDGE_PX or y0 <= _EDGE_PX or x1 >= size_hw[1] - 1 - _EDGE_PX or y1 >= size_hw[0] - 1 - _EDGE_PX
        )
        nearer = boxes_xyxy[boxes_xyxy[:, 3] > y1]
        wide = np.minimum(nearer[:, 2], x1) - np.maximum(nearer[:, 0], x0)
        high = np.minimum(nearer[:, 3], y1) - np.maximum(nearer[:, 1], y0)
        share = np.clip(wide, 0, None) * np.clip(high, 0, None) / max((x1 - x0) * (y1 - y0), 1e-6)
        hidden[i] = cut or bool((share > _COVERED).any())
    return hidden
