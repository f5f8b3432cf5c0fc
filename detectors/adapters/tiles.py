"""Splits wide images into overlapping tiles at several scales, for networks of fixed input size, and merges their
boxes.

A 1242 x 375 frame squeezed into a square of 416 shrinks cars of 25 px to 8. So detection runs on the whole image
and on tiles of a half, a quarter, ... of its longer side, each resized to the network's input. Large cars are
complete in coarse tiles, small ones are large enough in fine tiles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors.boxes import ioa_matrix, nms

OVERLAP = 0.3
"""Share of a tile's side that overlaps the next: smaller objects are complete in one of them."""
MAX_ENLARGEMENT = 1.0
"""Largest enlargement of a tile. At 1.34, NanoDet-m finds no more of the 41 cars in 14 KITTI frames (39), but 2.5
times as many false ones.
"""
BORDER = 0.02
"""Share of a tile's side: a box ending this near to a tile border inside the image counts as cut."""
NMS_IOU = 0.5
"""IoU of suppression: boxes of one car differ more between scales than within one (NanoDet's is 0.6)."""
INSIDE = 0.5
"""Share of a cut box inside a complete one of its class from which it counts as a part of it."""


@dataclass(frozen=True, slots=True)
class Tile:
    """A rectangle of an image."""

    x0: int
    """First column."""
    y0: int
    """First row."""
    x1: int
    """Last column + 1."""
    y1: int
    """Last row + 1."""


def make_tiles(height: int, width: int, input_hw: tuple[int, int]) -> list[Tile]:
    """Tiles of an image: the whole, then finer ones, row by row.

    The whole suffices if the image has the network's shape and is not much larger.

    Args:
        height: Of the image, px.
        width: Of the image, px.
        input_hw: Of the network, px.
    """
    tiles = [Tile(0, 0, width, height)]
    scale = min(input_hw[0] / height, input_hw[1] / width)
    while scale * 2 <= MAX_ENLARGEMENT:
        scale *= 2
        rows = _spans(height, min(math.ceil(input_hw[0] / scale), height))
        columns = _spans(width, min(math.ceil(input_hw[1] / scale), width))
        tiles += [Tile(x0, y0, x1, y1) for y0, y1 in rows for x0, x1 in columns]
    return tiles


def _spans(length: int, side: int) -> list[tuple[int, int]]:
    """Evenly spaced, overlapping spans of `side` px that cover `length` px."""
    if side >= length:
        return [(0, length)]
    count = 1 + math.ceil((length - side) / (side * (1 - OVERLAP)))
    starts = [round(i * (length - side) / (count - 1)) for i in range(count)]
    return [(start, start + side) for start in starts]


def is_cut_by_tile(boxes_xyxy: Tensor, tile: Tile, image_hw: tuple[int, int]) -> Tensor:
    """(N,) bool: whether boxes end at a tile border inside the image.

    Args:
        boxes_xyxy: (N, 4) px.
        window: The tile.
        image_hw: Size of the image, px.
    """
    height, width = image_hw
    near_x, near_y = BORDER * (tile.x1 - tile.x0), BORDER * (tile.y1 - tile.y0)
    left, top, right, bottom = boxes_xyxy.unbind(dim=1)
    tiles = torch.zeros_like(left, dtype=torch.bool)
    if tile.x0 > 0:
        tiles |= left < tile.x0 + near_x
    if tile.y0 > 0:
        tiles |= top < tile.y0 + near_y
    if tile.x1 < width:
        tiles |= right > tile.x1 - 1 - near_x
    if tile.y1 < height:
        tiles |= bottom > tile.y1 - 1 - near_y
    return tiles


def merge_tiles(boxes_xyxy: Tensor, scores: Tensor, labels: Tensor, is_cut: Tensor) -> Tensor:
    """Suppress the boxes of all tiles of an image.

    Complete boxes suppress each other per class as usual. A cut box is dropped, at any score, if more than half of
    its area lies in a complete one of its class; otherwise no tile contains the complete object, and it remains.

    Args:
        boxes_xyxy: (N, 4) px.
        scores: (N,).
        labels: (N,).
        is_cut: (N,) bool.

    Returns:
        Indices (K,) int64 of the remaining boxes, best first.
    """
    whole, parts = (~is_cut).nonzero()[:, 0], is_cut.nonzero()[:, 0]
    selected = whole[nms(boxes_xyxy[whole], scores[whole], NMS_IOU, labels[whole])]
    contained = ioa_matrix(boxes_xyxy[parts], boxes_xyxy[selected]) > INSIDE
    same_class = labels[parts][:, None] == labels[selected][None, :]
    parts = parts[~(contained & same_class).any(dim=1)]
    parts = parts[nms(boxes_xyxy[parts], scores[parts], NMS_IOU, labels[parts])]
    selected = torch.cat([selected, parts])
    return selected[torch.sort(scores[selected], descending=True, stable=True).indices]
