"""Placing objects in camera space and projecting them: KITTI's conventions, in plain differentiable torch."""

from __future__ import annotations

import torch
from torch import Tensor


def yaw_matrix(yaw: Tensor) -> Tensor:
    """Rotation (..., 3, 3) about the camera's y axis by yaw (...,) rad. At yaw 0 a car's front looks along +x."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
    return torch.stack(rows, dim=-1).reshape(*yaw.shape, 3, 3)


def place_vertices(unit: Tensor, size_lhw: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
    """Unit-box vertices to camera space.

    unit: (..., V, 3); size_lhw: (..., 3) m; yaw: (...,) rad; translation: (..., 3) m, bottom-face centre
    -> (..., V, 3) m.
    """
    rotated = (unit * size_lhw[..., None, :]) @ yaw_matrix(yaw).transpose(-1, -2)
    return rotated + translation[..., None, :]


def to_clip(points: Tensor, matrix: Tensor) -> Tensor:
    """Homogeneous pixel coordinates `(u w, v w, w)` of camera-space points. points: (..., 3), matrix: (3, 4)."""
    return points @ matrix[:, :3].T + matrix[:, 3]


def project(points: Tensor, matrix: Tensor) -> Tensor:
    """Pixels (..., 2) of camera-space points (..., 3) in front of the camera (w > 0; not checked)."""
    clip = to_clip(points, matrix)
    return clip[..., :2] / clip[..., 2:]


def height_above_ground(depth: Tensor, ground: Tensor, matrix: Tensor) -> Tensor:
    """Height (H, W) m, float64, above the ground plane of what is seen at `depth` (H, W) m; inf where that is inf.

    ground (4,): plane n.x + d = 0; matrix (3, 4).
    """
    depth, ground, matrix = (t.double() for t in (depth, ground.to(depth.device), matrix.to(depth.device)))
    up = torch.linalg.inv(matrix[:, :3]).T @ ground[:3]
    rows, columns = (torch.arange(n, dtype=torch.float64, device=depth.device) for n in depth.shape)
    slope = up[0] * columns + up[1] * rows[:, None] + up[2]
    seen = torch.isfinite(depth)
    height = ground[3] - up @ matrix[:, 3] + torch.where(seen, depth, 0.0) * slope
    return torch.where(seen, height, torch.inf)


_BOX_CORNERS = (
    (0.5, 0.5, -0.5, -0.5, 0.5, 0.5, -0.5, -0.5),
    (0, 0, 0, 0, -1, -1, -1, -1),
    (0.5, -0.5, -0.5, 0.5, 0.5, -0.5, -0.5, 0.5),
)
_BOX_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def box_corners(size_lhw: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
    """Corners (..., 8, 3) m of 3D boxes: bottom face first, in the order of KITTI's development kit."""
    corners = torch.tensor(_BOX_CORNERS, dtype=size_lhw.dtype, device=size_lhw.device).T
    return place_vertices(corners.expand(*yaw.shape, 8, 3), size_lhw, yaw, translation)


def ground_footprint(size_lhw: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
    """Corners (..., 4, 2) m, (x, z), of the boxes' bottom faces."""
    return box_corners(size_lhw, yaw, translation)[..., :4, [0, 2]]


def project_boxes(size_lhw: Tensor, yaw: Tensor, translation: Tensor, matrix: Tensor, near: float = 0.1) -> Tensor:
    """Tight image boxes of 3D boxes, cut at the near plane but not at the image border.

    size_lhw (N, 3), yaw (N,), translation (N, 3), matrix (3, 4) -> (N, 4) px, xyxy, differentiable. A box wholly
    behind the near plane (w < `near` m) gives NaN.
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
    """Boxes (N, 4) cut at the image border; in KITTI's convention that is [0, width - 1] x [0, height - 1]."""
    limit = boxes_xyxy.new_tensor([width - 1, height - 1, width - 1, height - 1])
    return torch.minimum(boxes_xyxy.clamp(min=0), limit)


def clamp_inclusive(values: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    """Values kept in [low, high]; their gradient is 1 there, at the bounds too, and 0 beyond. low, high: numbers,
    or tensors of the values' shape.

    `torch.clamp` has 1, 0.5 or 0 at a bound, as torch's version has it; codes begin there, and a photograph's
    saturated pixels lie there.
    """
    kept = torch.clamp(values.detach(), low, high)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return torch.where((values >= low) & (values <= high), values, kept) if values.requires_grad else kept


def weld_vertices(vertices: Tensor, tolerance: float = 1e-6) -> Tensor:
    """Which place (V,) int64, counted from 0, each of the vertices (V, 3) is at: those at one place share it."""
    keys = (vertices.detach() / tolerance).round().to(torch.int64)
    return torch.unique(keys, dim=0, return_inverse=True)[1]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals (V, 3), pointing outwards for outward-wound faces."""
    corners = vertices[faces]
    face_normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add(0, faces.reshape(-1), face_normal.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(summed, dim=-1, eps=1e-12)
