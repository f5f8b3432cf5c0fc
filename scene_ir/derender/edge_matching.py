"""Edges of a car against edges of its photograph: where its parts meet and where it ends.

The outline alone leaves a car's yaw and length nearly open; windows, wheels and lights do not. Distances to image
edges of about the same direction are Liu et al. 2010, "Fast directional chamfer matching".
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

_CHANNELS = 4
"""Directions of edges that are told apart; an edge counts for those within `_ALIKE_RAD` of its own."""
_ALIKE_RAD = 0.6
REACH_PX = 7.0
"""From how far an image edge pulls, px of the window."""
_STRONG, _WEAK = 60.0, 25.0
"""Canny's thresholds, levels a pixel times eight (Sobel's weights), of the channel that changes most."""
_BLUR_PX = 1.2
_MOST_POINTS = 600
"""Of a car's edges that are followed: more change nothing."""


@dataclass(frozen=True, slots=True)
class VisibleContour:
    """Points of a mesh on its visible edges. vertex (P, 3): of the face that each lies on; weight (P, 3): its
    barycentric coordinates; offset (P, 2) px: from it to the edge, half a pixel; channel (P,): the edge's
    direction.
    """

    vertex: Tensor
    weight: Tensor
    offset: Tensor
    channel: Tensor


def compute_edge_field(picture: NDArray[np.uint8], unknown: NDArray[np.bool_]) -> Tensor:
    """Distance to the nearest image edge of each direction, (4, h, w), in units of the reach and at most 1.

    picture (h, w, 3) RGB; edges at pixels that are unknown (h, w) do not count.
    """
    blurred = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX)
    dx, dy = (cv2.Sobel(blurred, cv2.CV_16S, *order) for order in ((1, 0), (0, 1)))
    most = (np.abs(dx.astype(np.int32)) + np.abs(dy)).argmax(2)[..., None]
    dx, dy = (np.take_along_axis(d, most, 2)[..., 0] for d in (dx, dy))
    edges = (cv2.Canny(dx, dy, _WEAK, _STRONG, L2gradient=True) > 0) & ~unknown
    angle = np.arctan2(dy, dx)
    field = []
    for channel in range(_CHANNELS):
        off = np.abs((angle - channel * np.pi / _CHANNELS + np.pi / 2) % np.pi - np.pi / 2)
        empty = ~(edges & (off < _ALIKE_RAD))
        far = cv2.distanceTransform(empty.astype(np.uint8), cv2.DIST_L2, 5) if not empty.all() else REACH_PX
        field.append(np.minimum(np.broadcast_to(far, edges.shape) / REACH_PX, 1))
    return torch.from_numpy(np.stack(field).astype(np.float32))


def trace_contour(
    face: Tensor, depth: Tensor, clip: Tensor, faces: Tensor, part: Tensor, known: NDArray[np.bool_]
) -> VisibleContour:
    """The visible edges of a mesh as drawn into a window.

    face (h, w): the triangle seen, -1 for none; depth (h, w) m; clip (V, 3); faces (F, 3); part (F,) of the mesh;
    known (h, w): edges elsewhere are not followed.
    """
    hit = (face >= 0).numpy()
    kind = np.where(hit, part[face.clamp(min=0)].numpy(), -1)
    near = np.where(hit, depth.numpy(), np.inf)
    rows, columns, offsets = [], [], []
    for dy, dx in ((0, 1), (1, 0)):
        first = (slice(0, kind.shape[0] - dy), slice(0, kind.shape[1] - dx))
        second = (slice(dy, None), slice(dx, None))
        differ = (kind[first] != kind[second]) & known[first] & known[second]
        for mine, other, sign in ((first, second, 0.5), (second, first, -0.5)):
            # the surface in front has the edge, and that between two parts of one surface either may have
            y, x = np.nonzero(differ & (near[mine] < near[other]))
            rows.append(y + (dy if sign < 0 else 0))
            columns.append(x + (dx if sign < 0 else 0))
            offsets.append(np.tile([sign * dx, sign * dy], (len(y), 1)))
    y, x, offset = np.concatenate(rows), np.concatenate(columns), np.concatenate(offsets)
    chosen = np.linspace(0, len(y) - 1, min(len(y), _MOST_POINTS)).astype(int)
    y, x, offset = y[chosen], x[chosen], offset[chosen]
    smooth, of_point = np.zeros((2, len(y)), np.float32), kind[y, x]
    for value in np.unique(of_point):
        blurred = cv2.GaussianBlur((kind == value).astype(np.float32), (0, 0), 1.5)
        mine = of_point == value
        for axis, order in enumerate(((1, 0), (0, 1))):
            smooth[axis, mine] = cv2.Sobel(blurred, cv2.CV_32F, *order)[y[mine], x[mine]]
    angle = np.arctan2(smooth[1], smooth[0])
    channel = np.rint(angle / np.pi * _CHANNELS).astype(np.int64) % _CHANNELS
    vertex = faces[face[torch.from_numpy(y), torch.from_numpy(x)]]
    corners = clip.detach()[vertex].double().transpose(1, 2)
    pixel = torch.from_numpy(np.stack([x, y, np.ones(len(x))], 1)).double()
    # Cramer's rule: what all three have in common, the determinant, drops out of their ratio.
    a, b, c = corners.unbind(2)
    share = torch.stack([(pixel * torch.linalg.cross(*two)).sum(1) for two in ((b, c), (c, a), (a, b))], 1)
    share = share / share.sum(1, keepdim=True)
    usable = torch.isfinite(share).all(1) & (share.abs() < 2).all(1)
    return VisibleContour(
        vertex[usable],
        share[usable].float(),
        torch.from_numpy(offset).float()[usable],
        torch.from_numpy(channel)[usable],
    )


def contour_distance(field: Tensor, followed: VisibleContour, clip: Tensor) -> Tensor:
    """How far () the followed edges are from image edges, the mean over them in [0, 1]; 0 where there are none.
    Differentiable to clip (V, 3)."""
    if not len(followed.channel):
        return clip.new_zeros(())
    point = (clip[followed.vertex] * followed.weight[..., None]).sum(1)
    pixel = point[:, :2] / point[:, 2:].clamp(min=0.05) + followed.offset
    size = pixel.new_tensor([field.shape[2], field.shape[1]])
    grid = ((2 * pixel + 1) / size - 1)[None, None]
    sampled = F.grid_sample(field[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
    return sampled.gather(0, followed.channel[None]).mean()
