"""Overlaps, clipping and non-maximum suppression of boxes (left, top, right, bottom) in pixels.

Width is right - left: box edges are continuous, as in KITTI, without the "+ 1" of inclusive pixels.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def area(boxes_xyxy: Tensor) -> Tensor:
    """Areas (N,) px^2 of boxes (N, 4); an inverted box has area 0."""
    size = (boxes_xyxy[..., 2:] - boxes_xyxy[..., :2]).clamp_min(0)
    return size[..., 0] * size[..., 1]


def intersection_matrix(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Intersection areas (N, M) px^2 of boxes (N, 4) with boxes (M, 4)."""
    # One coordinate at a time: with coordinates as the innermost dimension this takes three times as long.
    left, top, right, bottom = first_xyxy.T.contiguous()[..., None].unbind()
    other_left, other_top, other_right, other_bottom = second_xyxy.T.contiguous().unbind()
    width = (torch.minimum(right, other_right) - torch.maximum(left, other_left)).clamp_min(0)
    height = (torch.minimum(bottom, other_bottom) - torch.maximum(top, other_top)).clamp_min(0)
    return width * height


def iou_matrix(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Intersection over union (N, M) in [0, 1] of boxes (N, 4) with boxes (M, 4); 0 where both are empty."""
    shared = intersection_matrix(first_xyxy, second_xyxy)
    union = area(first_xyxy)[:, None] + area(second_xyxy)[None, :] - shared
    return _quotient(shared, union)


def ioa_matrix(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Intersection over the area of the FIRST box (N, M) in [0, 1]; 0 where the first box is empty."""
    shared = intersection_matrix(first_xyxy, second_xyxy)
    return _quotient(shared, area(first_xyxy)[:, None])


def paired_iou(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """IoU (N,) in [0, 1] of the n-th box with the n-th box, both (N, 4)."""
    top_left = torch.maximum(first_xyxy[:, :2], second_xyxy[:, :2])
    bottom_right = torch.minimum(first_xyxy[:, 2:], second_xyxy[:, 2:])
    size = (bottom_right - top_left).clamp_min(0)
    shared = size[:, 0] * size[:, 1]
    return _quotient(shared, area(first_xyxy) + area(second_xyxy) - shared)


def paired_giou(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Generalised IoU (N,) in [-1, 1] of the n-th box with the n-th box (Rezatofighi et al., 2019).

    IoU minus the share of the enclosing box that neither covers; differentiable even for disjoint boxes.
    """
    (first_low, first_high), (second_low, second_high) = first_xyxy.split(2, 1), second_xyxy.split(2, 1)
    overlap = (torch.minimum(first_high, second_high) - torch.maximum(first_low, second_low)).clamp_min(0)
    enclosing = torch.maximum(first_high, second_high) - torch.minimum(first_low, second_low)
    shared, hull = overlap[:, 0] * overlap[:, 1], enclosing[:, 0] * enclosing[:, 1]
    union = area(first_xyxy) + area(second_xyxy) - shared
    return _quotient(shared, union) - _quotient(hull - union, hull)


def clip(boxes_xyxy: Tensor, height: int, width: int) -> Tensor:
    """Clip boxes to an image.

    Args:
        boxes_xyxy: (..., 4) px.
        height: Of the image; y is clipped to [0, height - 1], KITTI's 0-based limits.
        width: Of the image; x is clipped to [0, width - 1].
    """
    corners = boxes_xyxy[..., ::2].clamp(0, width - 1), boxes_xyxy[..., 1::2].clamp(0, height - 1)
    return torch.stack(corners, -1).flatten(-2)


def nms(boxes_xyxy: Tensor, scores: Tensor, iou_threshold: float, labels: Tensor | None = None) -> Tensor:
    """Greedy non-maximum suppression. Equal scores keep their order, so the result is deterministic.

    Args:
        boxes_xyxy: (N, 4) px.
        scores: (N,).
        iou_threshold: A box is suppressed if its IoU with a better remaining box exceeds this.
        labels: (N,); if given, boxes suppress only boxes with the same label.

    Returns:
        Indices (K,) int64 of the remaining boxes, best first.
    """
    order = torch.sort(scores, descending=True, stable=True).indices
    # The loop is sequential, and numpy has less overhead per step than torch. The first few boxes suppress most
    # others, so few pairs are ever compared.
    left, top, right, bottom = boxes_xyxy[order].detach().cpu().numpy().T
    areas = area(boxes_xyxy[order]).detach().cpu().numpy()
    group = None if labels is None else labels[order].cpu().numpy()
    selected: list[int] = []
    rest = np.arange(len(order))
    while len(rest):
        best, rest = rest[0], rest[1:]
        selected.append(int(best))
        width = np.minimum(right[best], right[rest]) - np.maximum(left[best], left[rest])
        height = np.minimum(bottom[best], bottom[rest]) - np.maximum(top[best], top[rest])
        shared = np.maximum(width, 0) * np.maximum(height, 0)
        union = areas[best] + areas[rest] - shared
        stays = shared / np.maximum(union, np.finfo(union.dtype).tiny) <= iou_threshold
        if group is not None:
            stays |= group[rest] != group[best]
        rest = rest[stays]
    return order[torch.tensor(selected, dtype=torch.int64, device=order.device)]


def _quotient(part: Tensor, whole: Tensor) -> Tensor:
    # If the whole is 0, so is the part.
    return part / whole.clamp_min(torch.finfo(whole.dtype).tiny)
