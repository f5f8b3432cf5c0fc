"""Boxes as (left, top, right, bottom) in pixels: overlaps, clipping, non-maximum suppression.

Width is right - left, as continuous edges: KITTI's boxes as they stand, without the "+ 1" of inclusive pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor


def area(boxes_xyxy: Tensor) -> Tensor:
    """Areas (N,) px^2 of boxes (N, 4); an inverted box has area 0."""
    size = (boxes_xyxy[..., 2:] - boxes_xyxy[..., :2]).clamp_min(0)
    return size[..., 0] * size[..., 1]


def intersection_matrix(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Intersection areas (N, M) px^2 of boxes (N, 4) with boxes (M, 4)."""
    top_left = torch.maximum(first_xyxy[:, None, :2], second_xyxy[None, :, :2])
    bottom_right = torch.minimum(first_xyxy[:, None, 2:], second_xyxy[None, :, 2:])
    size = (bottom_right - top_left).clamp_min(0)
    return size[..., 0] * size[..., 1]


def iou_matrix(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Intersection over union (N, M) in [0, 1] of boxes (N, 4) with boxes (M, 4); 0 where both are empty."""
    shared = intersection_matrix(first_xyxy, second_xyxy)
    union = area(first_xyxy)[:, None] + area(second_xyxy)[None, :] - shared
    return torch.where(union > 0, shared / union.clamp_min(torch.finfo(union.dtype).tiny), torch.zeros_like(shared))


def ioa_matrix(first_xyxy: Tensor, second_xyxy: Tensor) -> Tensor:
    """Intersection over the area of the FIRST box (N, M) in [0, 1]; 0 where the first box is empty."""
    shared = intersection_matrix(first_xyxy, second_xyxy)
    own = area(first_xyxy)[:, None]
    return torch.where(own > 0, shared / own.clamp_min(torch.finfo(own.dtype).tiny), torch.zeros_like(shared))


def clip(boxes_xyxy: Tensor, height: int, width: int) -> Tensor:
    """Boxes (..., 4) moved into the image: x in [0, width - 1], y in [0, height - 1], KITTI's 0-based limits."""
    limit = boxes_xyxy.new_tensor([width - 1, height - 1, width - 1, height - 1])
    return torch.minimum(boxes_xyxy.clamp_min(0), limit)


def nms(boxes_xyxy: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """Greedy non-maximum suppression: indices (K,) int64 of the boxes kept, best first.

    boxes_xyxy (N, 4) px; scores (N,). A box goes when its IoU with a better kept one exceeds the threshold.
    Equal scores keep their order, so the result depends on nothing but its input.
    """
    order = torch.sort(scores, descending=True, stable=True).indices
    rivals = (iou_matrix(boxes_xyxy[order], boxes_xyxy[order]) > iou_threshold).cpu().numpy()
    alive = torch.ones(len(order), dtype=torch.bool).numpy()
    for i in range(len(order)):
        if alive[i]:
            alive[i + 1 :] &= ~rivals[i, i + 1 :]
    return order[torch.from_numpy(alive).to(order.device)]


def nms_per_class(boxes_xyxy: Tensor, labels: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """As `nms`, but a box (N, 4) is only suppressed by a better one of its own label (N,)."""
    order = torch.sort(scores, descending=True, stable=True).indices
    boxes, classes = boxes_xyxy[order], labels[order]
    rivals = (iou_matrix(boxes, boxes) > iou_threshold) & (classes[:, None] == classes[None, :])
    rivals = rivals.cpu().numpy()
    alive = torch.ones(len(order), dtype=torch.bool).numpy()
    for i in range(len(order)):
        if alive[i]:
            alive[i + 1 :] &= ~rivals[i, i + 1 :]
    return order[torch.from_numpy(alive).to(order.device)]
