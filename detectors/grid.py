"""Boxes as offsets from anchors on a grid of cells, and which anchors answer for which objects."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from detectors import boxes

STRIDE = 16
"""Pixels a grid cell: conv1 and three poolings halve the image."""

EXP_THRESHOLD = 1.0
"""Beyond this log-size the exponential goes on as its tangent (published code, EXP_THRESH)."""

IGNORE_OVERLAP = 0.5
"""An anchor that overlaps an ignored box more than this is no negative."""

MEETING_IOU = 0.5
"""Overlap from which a predicted box meets an object, as in the evaluation."""

Sizes = tuple[tuple[float, float], ...]
"""Width and height of each anchor, px."""


def cells(image_hw: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the grid over an image; the last ones may reach beyond it."""
    return -(-image_hw[0] // STRIDE), -(-image_hw[1] // STRIDE)


@lru_cache(maxsize=16)
def anchors(sizes_wh: Sizes, rows: int, columns: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Anchors (K * rows * columns, 4) as centre x, centre y, width, height in px; cells row by row, K each."""
    y = torch.arange(rows, dtype=dtype, device=device) * STRIDE + (STRIDE - 1) / 2
    x = torch.arange(columns, dtype=dtype, device=device) * STRIDE + (STRIDE - 1) / 2
    centres = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)  # (rows, columns, 2)
    sizes = torch.tensor(sizes_wh, dtype=dtype, device=device)
    shape = (rows, columns, len(sizes_wh), 2)
    return torch.cat((centres[:, :, None].expand(shape), sizes.expand(shape)), -1).reshape(-1, 4)


@lru_cache(maxsize=16)
def anchor_corners(sizes_wh: Sizes, rows: int, columns: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The same as left, top, right, bottom."""
    return corners(anchors(sizes_wh, rows, columns, dtype, device))


def corners(boxes_cxcywh: Tensor) -> Tensor:
    """Left, top, right, bottom of boxes (..., 4) given by centre and size."""
    half = boxes_cxcywh[..., 2:] / 2
    return torch.cat((boxes_cxcywh[..., :2] - half, boxes_cxcywh[..., :2] + half), -1)


def centred(boxes_xyxy: Tensor) -> Tensor:
    """Centre and size of boxes (..., 4) given by left, top, right, bottom."""
    top_left, bottom_right = boxes_xyxy[..., :2], boxes_xyxy[..., 2:]
    return torch.cat(((top_left + bottom_right) / 2, bottom_right - top_left), -1)


def distribute(wanted_xyxy: Tensor, anchors_cxcywh: Tensor, anchors_xyxy: Tensor) -> list[int]:
    """An anchor for each box (N, 4): the best that is not taken yet, the nearest where none overlaps."""
    if not len(wanted_xyxy):
        return []
    overlaps = boxes.iou_matrix(wanted_xyxy, anchors_xyxy)
    highest, best = overlaps.max(1)
    taken: list[int] = []
    for row, (value, index) in enumerate(zip(highest.tolist(), best.tolist(), strict=True)):
        if value <= 0 or index in taken:
            fit = overlaps[row].index_fill(0, best.new_tensor(taken), 0)
            if float(fit.max()) <= 0:
                distance = (centred(wanted_xyxy[row]) - anchors_cxcywh).square().sum(-1)
                fit = -distance.index_fill(0, best.new_tensor(taken), torch.inf)
            index = int(fit.argmax())
        taken.append(index)
    return taken


def covered(candidates_xyxy: Tensor, ignored_xyxy: Tensor) -> Tensor:
    """Candidates (N,) of which an ignored box covers more than IGNORE_OVERLAP. No IoU exceeds that share."""
    shared = boxes.intersection_matrix(ignored_xyxy, candidates_xyxy)
    return (shared > IGNORE_OVERLAP * boxes.area(candidates_xyxy)).any(0)


def offsets(boxes_xyxy: Tensor, anchors_cxcywh: Tensor) -> Tensor:
    """Offsets (N, 4) that make anchors (N, 4) these boxes (N, 4): shift in anchor sizes, logarithm of scale."""
    truth = centred(boxes_xyxy)
    shift = (truth[:, :2] - anchors_cxcywh[:, :2]) / anchors_cxcywh[:, 2:]
    return torch.cat((shift, safe_log(truth[:, 2:] / anchors_cxcywh[:, 2:])), 1)


def boxes_of(deltas: Tensor) -> Tensor:
    """Boxes (N, 4) as left, top, right, bottom, in units of their anchor's size, around its centre."""
    return corners(torch.cat((deltas[:, :2], safe_exp(deltas[:, 2:])), 1))


def safe_exp(x: Tensor) -> Tensor:
    """exp up to EXP_THRESHOLD, its tangent beyond: an untrained box cannot overflow."""
    slope = torch.exp(x.new_tensor(EXP_THRESHOLD))
    return torch.where(x > EXP_THRESHOLD, slope * (x - EXP_THRESHOLD + 1), torch.exp(x.clamp_max(EXP_THRESHOLD)))


def safe_log(ratio: Tensor) -> Tensor:
    """Inverse of _safe_exp for positive ratios. The published code takes the plain logarithm here, so a box more
    than e times its anchor had a target that its own decoding did not hit.
    """
    slope = torch.exp(ratio.new_tensor(EXP_THRESHOLD))
    logarithm = torch.log(ratio.clamp(torch.finfo(ratio.dtype).tiny, float(slope)))
    return torch.where(ratio > slope, ratio / slope + EXP_THRESHOLD - 1, logarithm)
