"""Place objects in camera space and project them, by KITTI's conventions; differentiable."""

from __future__ import annotations

import torch
from torch import Tensor


def yaw_matrix(yaw: Tensor) -> Tensor:
    """Rotation (..., 3, 3) about the camera's y axis by yaw (...,) rad. At yaw 0 a car faces +x."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return torch.stack(rows, dim=-1).reshape(*yaw.shape, 3, 3)


def place_vertices(unit: Tensor, size_lhw: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
    """Transform unit-box vertices to camera space.

    Args:
        unit: Vertices (..., V, 3) in the unit box.
        size_lhw: Length, height, width (..., 3) m.
        yaw: Yaw (...,) rad.
        translation: Bottom-face centre (..., 3) m.

    Returns:
        Vertices (..., V, 3) m.
    """
    rotated = (unit * size_lhw[..., None, :]) @ yaw_matrix(yaw).transpose(-1, -2)
    return rotated + translation[..., None, :]


def to_clip(points: Tensor, matrix: Tensor) -> Tensor:
    """Homogeneous pixel coordinates `(u w, v w, w)` (..., 3) of camera-space points (..., 3); matrix (3, 4)."""
    return points @ matrix[:, :3].T + matrix[:, 3]


def project(points: Tensor, matrix: Tensor) -> Tensor:
    """Pixels (..., 2) of camera-space points (..., 3) in front of the camera (w > 0 is not checked)."""
    clip = to_clip(points, matrix)
    return clip[..., :2] / clip[..., 2:]


def height_above_ground(depth: Tensor, ground: Tensor, matrix: Tensor) -> Tensor:
    """Height of each pixel's point above the ground plane.

    Args:
        depth: Depth (H, W) m; inf in the sky.
        ground: Plane (4,) n.x + d = 0.
        matrix: Projection (3, 4).

    Returns:
        Height (H, W) m, float64; inf where the depth is inf.
    """
    depth, ground, matrix = (t.double() for t in (depth, ground.to(depth.device), matrix.to(depth.device)))
    up = torch.linalg.inv(matrix[:, :3]).T @ ground[:3]
    rows, columns = (torch.arange(n, dtype=torch.float64, device=depth.device) for n in depth.shape)
    slope = up[0] * columns + up[1] * rows[:, None] + up[2]
    finite = torch.isfinite(depth)
    height = ground[3] - up @ matrix[:, 3] + torch.where(finite, depth, 0.0) * slope
    return torch.where(finite, height, torch.inf)


_BOX_CORNERS = (
    (0.5, 0.5, -0.5, -0.5, 0.5, 0.5, -0.5, -0.5),
    (0, 0, 0, 0, -1, -1, -1, -1),
    (0.5, -0.5, -0.5, 0.5, 0.5, -0.5, -0.5, 0.5),
)
_BOX_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def box_corners(size_lhw: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
    """Corners of 3D boxes, bottom face first, in the order of KITTI's development kit.

    Args:
        size_lhw: Length, height, width (..., 3) m.
        yaw: Yaw (...,) rad.
        translation: Bottom-face centre (..., 3) m.

    Returns:
        Corners (..., 8, 3) m.
    """
    corners = torch.tensor(_BOX_CORNERS, dtype=size_lhw.dtype, device=size_lhw.device).T
    return place_vertices(corners.expand(*yaw.shape, 8, 3), size_lhw, yaw, translation)


def ground_footprint(size_lhw: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
    """Corners of the bottom faces of 3D boxes.

    Args:
        size_lhw: Length, height, width (..., 3) m.
        yaw: Yaw (...,) rad.
        translation: Bottom-face centre (..., 3) m.

    Returns:
        Corners (..., 4, 2) m, as (x, z).
    """
    return box_corners(size_lhw, yaw, translation)[..., :4, [0, 2]]


def project_boxes(size_lhw: Tensor, yaw: Tensor, translation: Tensor, matrix: Tensor, near: float = 0.1) -> Tensor:
    """Tight image boxes of 3D boxes, cut at the near plane but not at the image border.

    Args:
        size_lhw: Length, height, width (N, 3) m.
        yaw: Yaw (N,) rad.
        translation: Bottom-face centre (N, 3) m.
        matrix: Projection (3, 4).
        near: Near plane, m.

    Returns:
        Boxes (N, 4) px, xyxy; NaN for a box wholly behind the near plane.
    """
    clip = to_clip(box_corners(size_lhw, yaw, translation), matrix)
    edges = torch.tensor(_BOX_EDGES, device=clip.device)
    start, end = clip[:, edges[:, 0]], clip[:, edges[:, 1]]
    w0, w1 = start[..., 2], end[..., 2]
    crosses = (w0 >= near) != (w1 >= near)
    step = torch.where(crosses, w1 - w0, torch.ones_like(w0))
    cut = start + ((near - w0) / step)[..., None] * (end - start)
    points = torch.cat([clip, cut], dim=1)
    valid = torch.cat([clip[..., 2] >= near, crosses], dim=1)
    safe = torch.where(valid, points[..., 2], torch.ones_like(points[..., 2]))
    pixels = points[..., :2] / safe[..., None]
    low = pixels.masked_fill(~valid[..., None], torch.inf).amin(dim=1)
    high = pixels.masked_fill(~valid[..., None], -torch.inf).amax(dim=1)
    boxes = torch.cat([low, high], dim=-1)
    return torch.where(valid.any(dim=1, keepdim=True), boxes, torch.full_like(boxes, torch.nan))


def clip_boxes(boxes_xyxy: Tensor, height: int, width: int) -> Tensor:
    """Clip boxes at the image border, in KITTI's convention [0, width - 1] x [0, height - 1].

    Args:
        boxes_xyxy: Boxes (N, 4) px.
        height: Image height, px.
        width: Image width, px.

    Returns:
        Boxes (N, 4) px, xyxy.
    """
    limit = boxes_xyxy.new_tensor([width - 1, height - 1, width - 1, height - 1])
    return torch.minimum(boxes_xyxy.clamp(min=0), limit)


def clamp_inclusive(values: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    """Clamp values to [low, high] with gradient 1 inside and at the bounds, 0 outside.

    The gradient of `torch.clamp` at a bound is 1, 0.5 or 0 depending on torch's version. Codes start at a bound,
    and saturated pixels of a photograph lie on one.

    Args:
        values: Values of any shape.
        low: Lower bound, a number or a tensor of the values' shape.
        high: Upper bound, likewise.

    Returns:
        Values of the same shape.
    """
    clamped = torch.clamp(values.detach(), low, high)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return torch.where((values >= low) & (values <= high), values, clamped) if values.requires_grad else clamped


def weld_vertices(vertices: Tensor, tolerance: float = 1e-6) -> Tensor:
    """Position index (V,) int64 of vertices (V, 3); vertices at the same position share an index."""
    keys = (vertices.detach() / tolerance).round().to(torch.int64)
    return torch.unique(keys, dim=0, return_inverse=True)[1]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals (V, 3), outward for outward-wound faces."""
    corners = vertices[faces]
    face_normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add(0, faces.reshape(-1), face_normal.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(summed, dim=-1, eps=1e-12)
