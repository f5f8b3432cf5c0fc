# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
"""Placing vertices, as Warp kernels: what `surfaces.place` does in plain torch; float32.

Gradients are written by hand. Shapes: N objects, V vertices.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import array, between, halves, launch, start_warp, vec3

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False})


@wp.kernel(enable_backward=False)
def place_kernel(
    start: int,
    local: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    owner: wp.array(dtype=wp.int32),
    turn: wp.array(dtype=wp.vec2f),
    translation: wp.array(dtype=wp.vec3f),
    matrix: wp.array2d(dtype=wp.vec4f),
    centre: wp.array(dtype=wp.vec3f),
    clip: wp.array(dtype=wp.vec3f),
    facing: wp.array(dtype=wp.float32),
):
    i = start + wp.tid()
    o = owner[i]
    c = turn[o][0]
    s = turn[o][1]
    v = local[i]
    p = wp.vec3f(c * v[0] + s * v[2], v[1], c * v[2] - s * v[0]) + translation[o]
    n = normal[i]
    n = wp.vec3f(c * n[0] + s * n[2], n[1], c * n[2] - s * n[0])
    q = wp.vec4f(p[0], p[1], p[2], 1.0)
    clip[i] = wp.vec3f(wp.dot(matrix[o, 0], q), wp.dot(matrix[o, 1], q), wp.dot(matrix[o, 2], q))
    way = centre[o] - p
    facing[i] = wp.dot(way, n) / wp.max(wp.length(way), 1e-6)


@wp.kernel(enable_backward=False)
def place_backward_kernel(
    start: int,
    local: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    owner: wp.array(dtype=wp.int32),
    turn: wp.array(dtype=wp.vec2f),
    translation: wp.array(dtype=wp.vec3f),
    matrix: wp.array2d(dtype=wp.vec4f),
    centre: wp.array(dtype=wp.vec3f),
    grad_clip: wp.array(dtype=wp.vec3f),
    grad_facing: wp.array(dtype=wp.float32),
    grad_local: wp.array(dtype=wp.vec3f),
    grad_pose: wp.array(dtype=wp.vec4d),
):
    i = start + wp.tid()
    g = grad_clip[i]
    gf = grad_facing[i]
    if g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or gf != 0.0:
        o = owner[i]
        c = turn[o][0]
        s = turn[o][1]
        v = local[i]
        r = wp.vec3f(c * v[0] + s * v[2], v[1], c * v[2] - s * v[0])
        p = r + translation[o]
        n = normal[i]
        n = wp.vec3f(c * n[0] + s * n[2], n[1], c * n[2] - s * n[0])
        way = centre[o] - p
        length = wp.max(wp.length(way), 1e-6)
        m = matrix[o, 0] * g[0] + matrix[o, 1] * g[1] + matrix[o, 2] * g[2]
        to_way = (n - way * (wp.dot(way, n) / (length * length))) * (gf / length)
        to_p = wp.vec3f(m[0], m[1], m[2]) - to_way
        to_n = way * (gf / length)
        grad_local[i] = wp.vec3f(c * to_p[0] - s * to_p[2], to_p[1], s * to_p[0] + c * to_p[2])
        # d (turned vector) / d yaw is (z, 0, -x) of the turned vector
        angle = to_p[0] * r[2] - to_p[2] * r[0] + to_n[0] * n[2] - to_n[2] * n[0]
        wp.atomic_add(
            grad_pose,
            o,
            wp.vec4d(wp.float64(to_p[0]), wp.float64(to_p[1]), wp.float64(to_p[2]), wp.float64(angle)),
        )


class Place(torch.autograd.Function):
    """Local vertices (V, 3) m, yaw (N,), translation (N, 3) -> clip (V, 3), cosine towards the camera (V,).

    normal (V, 3) unit, local; owner (V,) int32; matrix (N, 3, 4), centre (N, 3) of the objects' cameras; edges:
    the objects' first vertices, and V.
    """

    @staticmethod
    def forward(ctx: Any, local, yaw, translation, normal, owner, matrix, centre, edges) -> tuple[Tensor, Tensor]:
        turn = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1)
        clip, facing = torch.empty_like(local), local.new_empty(local.shape[0])
        fixed = (
            local.detach().contiguous(),
            normal,
            owner,
            turn,
            translation.detach().contiguous(),
            matrix,
            centre,
        )
        launch(
            place_kernel,
            halves(local.shape[0]),
            [*_place_inputs(fixed), vec3(clip), array(facing)],
            device=local.device,
        )
        ctx.save_for_backward(*fixed)
        ctx.edges = edges
        return clip, facing

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_clip: Tensor, grad_facing: Tensor):
        fixed = ctx.saved_tensors
        local, turn = fixed[0], fixed[3]
        grad_clip, grad_facing = grad_clip.contiguous(), grad_facing.contiguous()
        grad_local = torch.zeros_like(local)
        grad_pose = torch.zeros(turn.shape[0], 4, dtype=torch.float64, device=local.device)
        inputs = [
            *(*_place_inputs(fixed), vec3(grad_clip), array(grad_facing)),
            *(vec3(grad_local), array(grad_pose, wp.vec4d)),
        ]
        launch(place_backward_kernel, between(ctx.edges), inputs, device=local.device)
        pose = grad_pose.to(local.dtype)
        return grad_local, pose[:, 3], pose[:, :3], None, None, None, None, None


def _place_inputs(fixed) -> list:
    local, normal, owner, turn, translation, matrix, centre = fixed
    return [
        *(vec3(local), vec3(normal), array(owner), array(turn, wp.vec2f)),
        *(vec3(translation), array(matrix, wp.vec4f), vec3(centre)),
    ]
