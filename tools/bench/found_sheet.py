"""A picture of one object that a detector found, or did not, against what was hoped for."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.boxes import iou_matrix
from detectors.types import Detections
from drivesem.report.drawing import PAPER_COLOUR, TEXT_PX, measure_text, write_text
from tools.bench.sights import CAR, VEHICLES, Picture, View

_TRUE, _GIVEN, _OTHER = (0, 158, 115), (240, 228, 66), (213, 94, 0)
"""Colours of Okabe and Ito: the object's box, cars, and vehicles of other classes that were found."""
_NEAR_IOU = 0.1
"""With the object's box before or after, of detections that are drawn."""
_CONTEXT, _PANEL_PX, _GAP_PX = 0.5, 420, 6
"""Of a sheet: context around the boxes in their longer sides, height of a panel, gap."""


def failure_sheet(before: View, after: View, row: int, caption: str) -> Picture:
    """Photograph and edited picture around an object, side by side, without boxes above and with them below."""
    boxes = torch.stack([before.boxes_xyxy[row], after.boxes_xyxy[row]])
    x0, y0 = boxes[:, :2].amin(dim=0).tolist()
    x1, y1 = boxes[:, 2:].amax(dim=0).tolist()
    margin = _CONTEXT * max(x1 - x0, y1 - y0)
    height, width = before.picture.shape[:2]
    left, top = max(math.floor(x0 - margin), 0), max(math.floor(y0 - margin), 0)
    right, bottom = min(math.ceil(x1 + margin) + 1, width), min(math.ceil(y1 + margin) + 1, height)
    scale = _PANEL_PX / max(bottom - top, 1)
    panels = []
    for view in (before, after):
        cut = np.ascontiguousarray(view.picture[top:bottom, left:right])
        plain = cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        drawn = plain.copy()
        _draw(drawn, view.boxes_xyxy[row], _TRUE, "", (left, top, scale))
        for names, colour in (((CAR,), _GIVEN), (VEHICLES[1:], _OTHER)):
            found = view.named(names)
            near = iou_matrix(found.boxes_xyxy, boxes).amax(dim=1) > _NEAR_IOU
            found = Detections(found.boxes_xyxy[near], found.labels[near], found.scores[near])
            for box, score, label in zip(found.boxes_xyxy, found.scores, found.labels, strict=True):
                told = f"{view.classes[int(label)]} {float(score):.2f}"
                _draw(drawn, box, colour, told, (left, top, scale))
        panels.append(np.concatenate([plain, drawn]))
    gap = np.full((panels[0].shape[0], _GAP_PX, 3), PAPER_COLOUR, np.uint8)
    picture = np.concatenate([panels[0], gap, panels[1]], axis=1)
    head = np.full((measure_text(caption, TEXT_PX)[1] + _GAP_PX, picture.shape[1], 3), PAPER_COLOUR, np.uint8)
    write_text(head, (2, 2), caption)
    return np.concatenate([head, picture])


def _draw(
    canvas: NDArray[Any], box: Tensor, colour: tuple[int, int, int], text: str, place: tuple[int, int, float]
) -> None:
    """A box px of the picture on a panel that begins at (left, top) and is enlarged by scale."""
    left, top, scale = place
    x0, y0, x1, y1 = ((box.cpu() + 0.5 - torch.tensor([left, top] * 2)) * scale).round().int().tolist()
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, 2)
    if text:
        wide, high = measure_text(text, TEXT_PX)
        x, y = min(max(x0, 0), max(canvas.shape[1] - wide, 0)), min(max(y0 - high, 0), canvas.shape[0] - high)
        write_text(canvas, (x, y), text, colour)
