"""Distance of a mesh's visible edges, outlines and borders between parts, from a photograph's edges.

The outline alone hardly determines a car's yaw and length; windows, wheels and lights do. Edges are compared with
those of a similar direction: fast directional chamfer matching (Liu et al. 2010).
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
"""Number of edge directions; an edge counts for those within `_SAME_DIRECTION_RAD` of its own."""
_SAME_DIRECTION_RAD = 0.6
REACH_PX = 7.0
"""Distance from which an image edge attracts, px of the window."""
_STRONG, _WEAK = 60.0, 25.0
"""Canny's thresholds on the channel that changes most: 8-bit levels per pixel, times 8 by Sobel's weights."""
_BLUR_PX = 1.2
_MOST_POINTS = 600
"""Number of edge points of a car: more change nothing."""


@dataclass(frozen=True, slots=True)
class VisibleContour:
    """P points of a mesh on its visible edges."""

    vertex: Tensor
    """(P, 3) int64, vertices of the face that each point lies on."""
    weight: Tensor
    """(P, 3), barycentric coordinates."""
    offset: Tensor
    """(P, 2) px, from the point to the edge: half a pixel."""
    channel: Tensor
    """(P,) int64, index of the edge's direction."""


def compute_edge_field(picture: NDArray[np.uint8], unknown: NDArray[np.bool_]) -> Tensor:
    """Distance (4, h, w) to the nearest edge of each direction, in units of `REACH_PX` and at most 1.

    `picture` is (h, w, 3) RGB; edges at `unknown` pixels (h, w) do not count.
    """
    blurred = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX)
    dx, dy = (cv2.Sobel(blurred, cv2.CV_16S, *order) for order in ((1, 0), (0, 1)))
    strongest = (np.abs(dx.astype(np.int32)) + np.abs(dy)).argmax(2)[..., None]
    dx, dy = (np.take_along_axis(d, strongest, 2)[..., 0] for d in (dx, dy))
    edges = (cv2.Canny(dx, dy, _WEAK, _STRONG, L2gradient=True) > 0) & ~unknown
    angle = np.arctan2(dy, dx)
    field = []
    for channel in range(_CHANNELS):
        off = np.abs((angle - channel * np.pi / _CHANNELS + np.pi / 2) % np.pi - np.pi / 2)
        empty = ~(edges & (off < _SAME_DIRECTION_RAD))
        far = cv2.distanceTransform(empty.astype(np.uint8), cv2.DIST_L2, 5) if not empty.all() else REACH_PX
        field.append(np.minimum(np.broadcast_to(far, edges.shape) / REACH_PX, 1))
    return torch.from_numpy(np.stack(field).astype(np.float32))


def trace_contour(
    face: Tensor, depth: Tensor, clip: Tensor, faces: Tensor, part: Tensor, known: NDArray[np.bool_]
) -> VisibleContour:
    """Find a mesh's visible edges in a window that it is rasterised into.

    Args:
        face: Triangle (h, w) at each pixel, -1 for none.
        depth: (h, w) m.
        clip: Clip coordinates (V, 3).
        faces: (F, 3) int64.
        part: (F,) int64, a `Part`.
        known: Pixels (h, w) in which edges count.
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
            # an edge belongs to the nearer surface; between two parts of one surface, to either
            y, x = np.nonzero(differ & (near[mine] < near[other]))
            rows.append(y + (dy if sign < 0 else 0))
            columns.append(x + (dx if sign < 0 else 0))
            offsets.append(np.tile([sign * dx, sign * dy], (len(y), 1)))
    y, x, offset = np.concatenate(rows), np.concatenate(columns), np.concatenate(offsets)
    chosen = np.linspace(0, len(y) - 1, min(len(y), _MOST_POINTS)).astype(int)
    y, x, offset = y[chosen], x[chosen], offset[chosen]
    smooth, point_kind = np.zeros((2, len(y)), np.float32), kind[y, x]
    for value in np.unique(point_kind):
        blurred = cv2.GaussianBlur((kind == value).astype(np.float32), (0, 0), 1.5)
        mine = point_kind == value
        for axis, order in enumerate(((1, 0), (0, 1))):
            smooth[axis, mine] = cv2.Sobel(blurred, cv2.CV_32F, *order)[y[mine], x[mine]]
    angle = np.arctan2(smooth[1], smooth[0])
    channel = np.rint(angle / np.pi * _CHANNELS).astype(np.int64) % _CHANNELS
    vertex = faces[face[torch.from_numpy(y), torch.from_numpy(x)]]
    corners = clip.detach()[vertex].double().transpose(1, 2)
    pixel = torch.from_numpy(np.stack([x, y, np.ones(len(x))], 1)).double()
    # Cramer's rule: the common determinant drops out of the ratio.
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


def contour_distance(field: Tensor, contour: VisibleContour, clip: Tensor) -> Tensor:
    """Mean distance of a contour from the photograph's edges, differentiable by `clip`.

    Args:
        field: Distances (4, h, w) from `compute_edge_field`.
        contour: The mesh's visible edges.
        clip: Clip coordinates (V, 3) of the mesh's vertices.

    Returns:
        () in [0, 1]; 0 without visible edges.
    """
    if not len(contour.channel):
        return clip.new_zeros(())
    point = (clip[contour.vertex] * contour.weight[..., None]).sum(1)
    pixel = point[:, :2] / point[:, 2:].clamp(min=0.05) + contour.offset
    size = pixel.new_tensor([field.shape[2], field.shape[1]])
    grid = ((2 * pixel + 1) / size - 1)[None, None]
    sampled = F.grid_sample(field[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
    return sampled.gather(0, contour.channel[None]).mean()
