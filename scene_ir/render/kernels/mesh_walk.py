# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false, reportReturnType=false
# ruff: noqa: RUF046, UP018 - Warp needs int(0) to declare a variable that a loop changes.
"""Walks over a mesh between samples, as a Warp kernel: what `borders.MeshWalk.trace` does in plain torch; float64."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from scene_ir.raster.launch import array, launch, split_range, start_warp
from scene_ir.raster.layout import int32_faces

start_warp()
wp.set_module_options({"fuse_fp": False, "fast_math": False, "enable_backward": False})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.struct
class WalkExit:
    """Position at which a path leaves a face, the edge by which it does, the face's plane, and the edge's normal,
    outwards.
    """

    share: wp.float64
    edge: int
    plane: wp.vec3d
    beyond: wp.vec3d


@wp.func
def _earlier_exit(found: WalkExit, n: wp.vec3d, sign: wp.float64, edge: int, start: wp.vec3d, end: wp.vec3d):
    """`found`, or the edge with normal n if the path leaves by it earlier."""
    outside = wp.dot(n, end) * sign
    share = ONE
    if outside < ZERO:
        inside = wp.dot(n, start) * sign
        share = inside / (inside - outside)
    if sign == ZERO:
        share = ZERO
    if share < found.share:
        found.share = share
        found.edge = edge
        found.beyond = n * (-sign)
    return found


@wp.func
def _face_exit(
    face: int, points: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=wp.vec3i), start: wp.vec3d, end: wp.vec3d
):
    corner = faces[face]
    a = points[corner[0]]
    b = points[corner[1]]
    c = points[corner[2]]
    n0 = wp.cross(b, c)
    n1 = wp.cross(c, a)
    n2 = wp.cross(a, b)
    det = wp.dot(a, n0)
    sign = ZERO
    if det > ZERO:
        sign = ONE
    elif det < ZERO:
        sign = -ONE
    found = WalkExit()
    found.share = wp.float64(2.0)
    found = _earlier_exit(found, n0, sign, 3 * face, start, end)
    found = _earlier_exit(found, n1, sign, 3 * face + 1, start, end)
    found = _earlier_exit(found, n2, sign, 3 * face + 2, start, end)
    found.plane = (n0 + n1 + n2) / det
    return found


@wp.kernel
def _walk_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    across: wp.array(dtype=wp.int64),
    here: wp.array(dtype=wp.int64),
    goal: wp.array(dtype=wp.int64),
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    face: wp.array2d(dtype=wp.int64),
    share: wp.array2d(dtype=wp.float64),
    edge: wp.array2d(dtype=wp.int64),
    goes_on: wp.array2d(dtype=wp.uint8),
    plane: wp.array(dtype=wp.vec3d),
    meets: wp.array(dtype=wp.uint8),
):
    i = first + wp.tid()
    now = _face_exit(wp.int32(here[i]), points, faces, start[i], end[i])
    face[i, 0] = here[i]
    share[i, 0] = now.share
    edge[i, 0] = wp.int64(now.edge)
    going = int(1)
    for turn in range(1, face.shape[1]):
        onto = wp.int32(across[now.edge])
        if going == 1:
            going = 0
            if now.share < ONE and onto >= 0:
                corner = faces[onto // 3]
                if wp.dot(now.beyond, points[corner[onto % 3]]) > ZERO:
                    going = 1
        goes_on[i, turn - 1] = wp.uint8(going)
        if going == 1:
            before = now.share
            now = _face_exit(onto // 3, points, faces, start[i], end[i])
            now.share = wp.max(now.share, before)
        face[i, turn] = wp.int64(now.edge // 3)
        share[i, turn] = now.share
        edge[i, turn] = wp.int64(now.edge)
        if going == 1 and now.edge // 3 == wp.int32(goal[i]):
            meets[i] = wp.uint8(1)
            going = 0
    plane[i] = now.plane


def trace_walks(
    points: Tensor,
    faces: Tensor,
    across: Tensor,
    seen: tuple[Tensor, Tensor],
    start: Tensor,
    end: Tensor,
    most: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Trace walks; returns face, share, edge, goes_on, plane, met of `borders.MeshWalk`.

    Args:
        points: (V, 3) float64 clip coordinates.
        faces: (F, 3).
        across: See `borders.MeshEdges`.
        seen: (P,), (P,) faces at start and end.
        start, end: (P, 3) pixels (x, y, 1).
        most: Most faces to follow.
    """
    here, goal = seen
    count = len(here)
    face, edge = (here.new_empty(count, most + 1) for _ in range(2))
    share, plane = start.new_empty(count, most + 1), start.new_empty(count, 3)
    goes_on = torch.zeros(count, most + 1, dtype=torch.uint8)
    meets = torch.zeros(count, dtype=torch.uint8)
    inputs = [
        *(array(points, wp.vec3d), array(int32_faces(faces), wp.vec3i), array(across)),
        *(array(here), array(goal), array(start, wp.vec3d), array(end, wp.vec3d)),
        *(array(face), array(share), array(edge), array(goes_on), array(plane, wp.vec3d), array(meets)),
    ]
    launch(_walk_kernel, split_range(count), inputs, points.device)
    return face, share, edge, goes_on.bool(), plane, meets.bool()
