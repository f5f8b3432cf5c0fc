"""Wide pictures for networks of a fixed input size: overlapping windows at several scales, and boxes merged again.

A frame of 1242 x 375 squeezed into a square of 416 leaves cars of 25 px with 8 of them. So the frame is looked at
whole, and in windows of a half, a quarter, ... of its longer side, each reduced to the network's size. Large cars
are whole in the coarse windows, small ones are large enough in the fine ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors.boxes import ioa_matrix, nms

OVERLAP = 0.3
"""Share of a window's side that it has in common with the next: what is shorter is whole in one of them."""
MOST_ENLARGED = 1.0
"""Windows are not enlarged. At 1.34 times, NanoDet-m finds no more of the 41 cars of 14 KITTI frames (39), but 2.5
times as many that are none."""
BORDER = 0.02
"""Share of a window's side: a box that ends nearer to a window's border inside the picture is cut there."""
NMS_IOU = 0.5
"""IoU with a better box of its class from which a box goes: windows of several scales draw one car's box less
alike than one window does (NanoDet's own is 0.6)."""
INSIDE = 0.5
"""Share of a cut box on a whole one of its class from which it is taken for a part of that."""


@dataclass(frozen=True, slots=True)
class Window:
    """Columns x0 to x1 - 1 and rows y0 to y1 - 1 of a picture."""

    x0: int
    y0: int
    x1: int
    y1: int


def windows(height: int, width: int, input_hw: tuple[int, int]) -> list[Window]:
    """Windows of a picture for a network of size `input_hw`: the whole, then finer ones, row by row.

    One is enough where the picture already has the network's shape and is not much larger.
    """
    found = [Window(0, 0, width, height)]
    scale = min(input_hw[0] / height, input_hw[1] / width)
    while scale * 2 <= MOST_ENLARGED:
        scale *= 2
        rows = _spans(height, min(math.ceil(input_hw[0] / scale), height))
        columns = _spans(width, min(math.ceil(input_hw[1] / scale), width))
        found += [Window(x0, y0, x1, y1) for y0, y1 in rows for x0, x1 in columns]
    return found


def _spans(length: int, side: int) -> list[tuple[int, int]]:
    """Overlapping spans of `side` px that cover `length` px, evenly laid."""
    if side >= length:
        return [(0, length)]
    count = 1 + math.ceil((length - side) / (side * (1 - OVERLAP)))
    starts = [round(i * (length - side) / (count - 1)) for i in range(count)]
    return [(start, start + side) for start in starts]


def cut(boxes_xyxy: Tensor, window: Window, image_hw: tuple[int, int]) -> Tensor:
    """Which boxes (N, 4) px end at a border of the window that is none of the picture: (N,) bool."""
    height, width = image_hw
    near_x, near_y = BORDER * (window.x1 - window.x0), BORDER * (window.y1 - window.y0)
    left, top, right, bottom = boxes_xyxy.unbind(dim=1)
    found = torch.zeros_like(left, dtype=torch.bool)
    if window.x0 > 0:
        found |= left < window.x0 + near_x
    if window.y0 > 0:
        found |= top < window.y0 + near_y
    if window.x1 < width:
        found |= right > window.x1 - 1 - near_x
    if window.y1 < height:
        found |= bottom > window.y1 - 1 - near_y
    return found


def merge(boxes_xyxy: Tensor, scores: Tensor, labels: Tensor, is_cut: Tensor) -> Tensor:
    """Indices (K,) int64 of the boxes (N, 4) that remain of all windows', best first.

    Whole boxes suppress one another as usual, class by class. One that a window's border cut is measured by its
    own area, whatever its score: it goes where half of it lies on a whole one, and stays where no window saw the
    whole.
    """
    whole, parts = (~is_cut).nonzero()[:, 0], is_cut.nonzero()[:, 0]
    kept = whole[nms(boxes_xyxy[whole], scores[whole], NMS_IOU, labels[whole])]
    on = ioa_matrix(boxes_xyxy[parts], boxes_xyxy[kept]) > INSIDE
    same = labels[parts][:, None] == labels[kept][None, :]
    parts = parts[~(on & same).any(dim=1)]
    parts = parts[nms(boxes_xyxy[parts], scores[parts], NMS_IOU, labels[parts])]
    kept = torch.cat([kept, parts])
    return kept[torch.sort(scores[kept], descending=True, stable=True).indices]
