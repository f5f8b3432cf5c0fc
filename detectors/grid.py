"""Anchors on a grid of cells, boxes encoded as offsets from them, and the assignment of anchors to objects."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from detectors import boxes

STRIDE = 16
"""Pixels per grid cell: conv1 and three poolings each halve the image."""

EXP_THRESHOLD = 1.0
"""Log-size above which the exponential continues as its tangent (published code, EXP_THRESH)."""

IGNORE_OVERLAP = 0.5
"""An anchor covered by an ignored box by more than this share is not a negative."""

MEETING_IOU = 0.5
"""IoU at which a predicted box matches an object, as in the evaluation."""

AnchorSizes = tuple[tuple[float, float], ...]
"""Width and height of each anchor, px."""


def grid_size(image_hw: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the grid over an image; the last ones may extend beyond it."""
    return -(-image_hw[0] // STRIDE), -(-image_hw[1] // STRIDE)


@lru_cache(maxsize=16)
def anchors_cxcywh(
    sizes_wh: AnchorSizes, rows: int, columns: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Anchors on the grid.

    Args:
        sizes_wh: Width and height of each of the K anchors per cell, px.
        rows: Rows of the grid.
        columns: Columns of the grid.
        dtype: Type of the result.
        device: Device of the result.

    Returns:
        (K * rows * columns, 4) centre x, centre y, width, height in px; cells row by row, K anchors each.
    """
    y = torch.arange(rows, dtype=dtype, device=device) * STRIDE + (STRIDE - 1) / 2
    x = torch.arange(columns, dtype=dtype, device=device) * STRIDE + (STRIDE - 1) / 2
    centres = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)  # (rows, columns, 2)
    sizes = torch.tensor(sizes_wh, dtype=dtype, device=device)
    shape = (rows, columns, len(sizes_wh), 2)
    return torch.cat((centres[:, :, None].expand(shape), sizes.expand(shape)), -1).reshape(-1, 4)


@lru_cache(maxsize=16)
def anchors_xyxy(
    sizes_wh: AnchorSizes, rows: int, columns: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """`anchors_cxcywh` as left, top, right, bottom.

    Args:
        sizes_wh: Width and height of each of the K anchors per cell, px.
        rows: Rows of the grid.
        columns: Columns of the grid.
        dtype: Type of the result.
        device: Device of the result.
    """
    return cxcywh_to_xyxy(anchors_cxcywh(sizes_wh, rows, columns, dtype, device))


def cxcywh_to_xyxy(boxes_cxcywh: Tensor) -> Tensor:
    """Boxes (..., 4) from centre and size to left, top, right, bottom."""
    half = boxes_cxcywh[..., 2:] / 2
    return torch.cat((boxes_cxcywh[..., :2] - half, boxes_cxcywh[..., :2] + half), -1)


def xyxy_to_cxcywh(boxes_xyxy: Tensor) -> Tensor:
    """Boxes (..., 4) from left, top, right, bottom to centre and size."""
    top_left, bottom_right = boxes_xyxy[..., :2], boxes_xyxy[..., 2:]
    return torch.cat(((top_left + bottom_right) / 2, bottom_right - top_left), -1)


def assign_anchors(objects_xyxy: Tensor, all_anchors_cxcywh: Tensor, all_anchors_xyxy: Tensor) -> list[int]:
    """Assign a different anchor to each object, in order.

    Args:
        objects_xyxy: (N, 4) px.
        all_anchors_cxcywh: (A, 4) px.
        all_anchors_xyxy: (A, 4) px, the same anchors.

    Returns:
        N anchor indices: the free anchor of highest IoU or, if none overlaps, the nearest free one.
    """
    if not len(objects_xyxy):
        return []
    overlaps = boxes.iou_matrix(objects_xyxy, all_anchors_xyxy)
    highest, best = overlaps.max(1)
    assigned: list[int] = []
    for row, (value, index) in enumerate(zip(highest.tolist(), best.tolist(), strict=True)):
        if value <= 0 or index in assigned:
            fit = overlaps[row].index_fill(0, best.new_tensor(assigned), 0)
            if float(fit.max()) <= 0:
                distance = (xyxy_to_cxcywh(objects_xyxy[row]) - all_anchors_cxcywh).square().sum(-1)
                fit = -distance.index_fill(0, best.new_tensor(assigned), torch.inf)
            index = int(fit.argmax())
        assigned.append(index)
    return assigned


def covered_by_ignored(candidates_xyxy: Tensor, ignored_xyxy: Tensor) -> Tensor:
    """(N,) bool: whether an ignored box covers more than IGNORE_OVERLAP of a candidate (an upper bound on IoU)."""
    shared = boxes.intersection_matrix(ignored_xyxy, candidates_xyxy)
    return (shared > IGNORE_OVERLAP * boxes.area(candidates_xyxy)).any(0)


def encode_boxes(boxes_xyxy: Tensor, anchors_cxcywh: Tensor) -> Tensor:
    """Offsets (N, 4) from anchors (N, 4) to boxes (N, 4): shift in anchor sizes, logarithm of the scale."""
    truth = xyxy_to_cxcywh(boxes_xyxy)
    shift = (truth[:, :2] - anchors_cxcywh[:, :2]) / anchors_cxcywh[:, 2:]
    return torch.cat((shift, safe_log(truth[:, 2:] / anchors_cxcywh[:, 2:])), 1)


def decode_unit_boxes(deltas: Tensor) -> Tensor:
    """Boxes (N, 4) from offsets: left, top, right, bottom around the anchor's centre, in anchor sizes."""
    return cxcywh_to_xyxy(torch.cat((deltas[:, :2], safe_exp(deltas[:, 2:])), 1))


def safe_exp(x: Tensor) -> Tensor:
    """exp up to EXP_THRESHOLD, then its tangent, so that untrained boxes cannot overflow."""
    slope = math.exp(EXP_THRESHOLD)
    return torch.where(x > EXP_THRESHOLD, slope * (x - EXP_THRESHOLD + 1), torch.exp(x.clamp_max(EXP_THRESHOLD)))


def safe_log(ratio: Tensor) -> Tensor:
    """Inverse of `safe_exp` for positive ratios.

    The published code takes the plain logarithm, so boxes over e times their anchor never met their target.
    """
    slope = math.exp(EXP_THRESHOLD)
    logarithm = torch.log(ratio.clamp(torch.finfo(ratio.dtype).tiny, slope))
    return torch.where(ratio > slope, ratio / slope + EXP_THRESHOLD - 1, logarithm)
