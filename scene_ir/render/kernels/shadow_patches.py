# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false, reportReturnType=false
# ruff: noqa: E501, RUF059 - the line above; `wp.grad` returns gradients to all arguments.
"""Placement of the shadows' ground patches, as Warp kernels: what `PreparedScene.place_patches` does in plain
torch.

A dozen numbers per object in double precision, for which torch would need a hundred calls. Gradients of the
corners come from `wp.grad`. Shapes: N objects.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import array, launch, make_struct, start_warp
from scene_ir.render import model

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False})

ZERO, ONE, HALF = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0)), wp.constant(wp.float64(0.5))
TINY = wp.constant(wp.float64(1e-6))
MIN_SINE, MAX_OFFSET_M, SHRUNK = (
    wp.constant(wp.float64(v)) for v in (model.LEAST_SINE, model.SUN_OFFSET_MAX_M, model.SHRUNK)
)


@wp.struct
class PatchInputs:
    """Inputs besides poses.

    Attributes:
        corners: (N, 4) m, corners in the objects' frames.
        outwards: (N, 4) `surfaces.outwardness` of the corners.
        offset: (N,) m, photographed `surfaces.shadow_offset`.
        size: (N,) m, photographed sizes.
        sun: (N,) photographed direction.
        ground: (N,) ground planes.
        matrix: (N, 3) cameras.
        casts: (N,) 1 where the patch follows another sun, else 0.
    """

    corners: wp.array2d(dtype=wp.vec2f)
    outwards: wp.array2d(dtype=wp.float32)
    offset: wp.array(dtype=wp.vec2f)
    size: wp.array(dtype=wp.vec3f)
    sun: wp.array(dtype=wp.vec3f)
    ground: wp.array(dtype=wp.vec4f)
    matrix: wp.array2d(dtype=wp.vec4f)
    casts: wp.array(dtype=wp.float32)


@wp.struct
class PatchPoses:
    """Yaw, translation, size, and direction and strength of the sun of each object."""

    yaw: wp.array(dtype=wp.float32)
    translation: wp.array(dtype=wp.vec3f)
    size: wp.array(dtype=wp.vec3f)
    lights: wp.array(dtype=wp.vec4f)


@wp.struct
class PatchOutputs:
    """Clip coordinates (N, 4) of the corners; from (s, t, 1) on a patch to its clip coordinates, and the inverse."""

    clip: wp.array2d(dtype=wp.vec3f)
    patch: wp.array(dtype=wp.mat33d)
    inside: wp.array(dtype=wp.mat33d)


@wp.struct
class PatchPoseGradients:
    """Gradients to `PatchPoses`."""

    yaw: wp.array(dtype=wp.float64)
    translation: wp.array(dtype=wp.vec3d)
    size: wp.array(dtype=wp.vec3d)
    lights: wp.array(dtype=wp.vec4d)


@wp.func
def _shadow_offset(sun: wp.vec3d, yaw: wp.float64, height: wp.float64):
    """`surfaces.shadow_offset`."""
    scale = -height / wp.max(-sun[1], MIN_SINE)
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    x = (c * sun[0] - s * sun[2]) * scale
    z = (c * sun[2] + s * sun[0]) * scale
    length = wp.sqrt(wp.max(x * x + z * z, TINY * TINY))  # inside the root, which has no gradient at 0
    part = wp.min(length, MAX_OFFSET_M) / length
    return wp.vec2d(x * part, z * part)


@wp.func
def _soft_growth(share: wp.float64):
    """Growth of a patch with its object: softly at least 0."""
    return HALF * (share + (wp.sqrt(share * share + SHRUNK * SHRUNK) - SHRUNK))


@wp.func
def _patch_corner(
    yaw: wp.float64,
    place: wp.vec3d,
    size: wp.vec3d,
    sun: wp.vec3d,
    corner: wp.vec2d,
    outwards: wp.float64,
    offset: wp.vec2d,
    then: wp.vec3d,
    sun_then: wp.vec3d,
    casts: wp.float64,
    ground: wp.vec4d,
):
    """A corner of a patch, m, in camera axes: see `PreparedScene.place_patches`."""
    still = _shadow_offset(sun_then, yaw, then[1])
    falls = still + (_shadow_offset(sun, yaw, then[1]) - still) * casts
    x0 = corner[0] + outwards * (falls[0] - offset[0])
    z0 = corner[1] + outwards * (falls[1] - offset[1])
    x0 = x0 + _soft_growth(size[0] / then[0] - ONE) * x0
    z0 = z0 + _soft_growth(size[2] / then[2] - ONE) * z0
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    x = c * x0 + s * z0
    z = c * z0 - s * x0
    y = -(ground[0] * x + ground[2] * z) / ground[1]
    return wp.vec3d(x, y, z) + place


@wp.func
def _corner_loss(
    yaw: wp.float64,
    place: wp.vec3d,
    size: wp.vec3d,
    sun: wp.vec3d,
    corner: wp.vec2d,
    outwards: wp.float64,
    offset: wp.vec2d,
    then: wp.vec3d,
    sun_then: wp.vec3d,
    casts: wp.float64,
    ground: wp.vec4d,
    g: wp.vec3d,
):
    return wp.dot(_patch_corner(yaw, place, size, sun, corner, outwards, offset, then, sun_then, casts, ground), g)


@wp.func
def _sun_direction(light: wp.vec4f):
    return wp.vec3d(wp.float64(light[0]), wp.float64(light[1]), wp.float64(light[2]))


@wp.func
def _to_clip(matrix: wp.array2d(dtype=wp.vec4f), o: int, p: wp.vec3d):
    q = wp.vec4d(p[0], p[1], p[2], ONE)
    return wp.vec3d(
        wp.dot(wp.vec4d(matrix[o, 0]), q), wp.dot(wp.vec4d(matrix[o, 1]), q), wp.dot(wp.vec4d(matrix[o, 2]), q)
    )


@wp.kernel(enable_backward=False)
def _patch_kernel(start: int, fixed: PatchInputs, poses: PatchPoses, outputs: PatchOutputs):
    o = start + wp.tid()
    first = wp.vec3d()
    second = wp.vec3d()
    last = wp.vec3d()
    for k in range(4):
        p = _patch_corner(
            wp.float64(poses.yaw[o]), wp.vec3d(poses.translation[o]), wp.vec3d(poses.size[o]), _sun_direction(poses.lights[o]),
            wp.vec2d(fixed.corners[o, k]), wp.float64(fixed.outwards[o, k]), wp.vec2d(fixed.offset[o]),
            wp.vec3d(fixed.size[o]), wp.vec3d(fixed.sun[o]), wp.float64(fixed.casts[o]), wp.vec4d(fixed.ground[o]),
        )  # fmt: skip
        c = _to_clip(fixed.matrix, o, p)
        outputs.clip[o, k] = wp.vec3f(c)
        if k == 0:
            first = c
        if k == 1:
            second = c
        if k == 3:
            last = c
    a = second - first
    b = last - first
    patch = wp.mat33d(a[0], b[0], first[0], a[1], b[1], first[1], a[2], b[2], first[2])
    outputs.patch[o] = patch
    outputs.inside[o] = wp.inverse(patch)


@wp.kernel(enable_backward=False)
def _patch_backward_kernel(
    start: int,
    fixed: PatchInputs,
    poses: PatchPoses,
    outputs: PatchOutputs,
    grads: wp.array(dtype=wp.mat33d),
    to: PatchPoseGradients,
):
    """grads: to `inside`."""
    o = start + wp.tid()
    turned = wp.transpose(outputs.inside[o])
    g = turned * grads[o] * turned * -ONE
    to_second = wp.vec3d(g[0, 0], g[1, 0], g[2, 0])
    to_last = wp.vec3d(g[0, 1], g[1, 1], g[2, 1])
    to_first = wp.vec3d(g[0, 2], g[1, 2], g[2, 2]) - to_second - to_last
    for k in range(4):
        g_clip = wp.vec3d()
        if k == 0:
            g_clip = to_first
        if k == 1:
            g_clip = to_second
        if k == 3:
            g_clip = to_last
        m = (
            wp.vec4d(fixed.matrix[o, 0]) * g_clip[0]
            + wp.vec4d(fixed.matrix[o, 1]) * g_clip[1]
            + wp.vec4d(fixed.matrix[o, 2]) * g_clip[2]
        )
        to_yaw, to_place, to_size, to_sun, to_c, to_o, to_f, to_t, to_s, to_casts, to_ground, to_g = wp.grad(_corner_loss)(
            wp.float64(poses.yaw[o]), wp.vec3d(poses.translation[o]), wp.vec3d(poses.size[o]), _sun_direction(poses.lights[o]),
            wp.vec2d(fixed.corners[o, k]), wp.float64(fixed.outwards[o, k]), wp.vec2d(fixed.offset[o]),
            wp.vec3d(fixed.size[o]), wp.vec3d(fixed.sun[o]), wp.float64(fixed.casts[o]), wp.vec4d(fixed.ground[o]),
            wp.vec3d(m[0], m[1], m[2]),
        )  # fmt: skip
        to.yaw[o] = to.yaw[o] + to_yaw
        to.translation[o] = to.translation[o] + to_place
        to.size[o] = to.size[o] + to_size
        to.lights[o] = to.lights[o] + wp.vec4d(to_sun[0], to_sun[1], to_sun[2], ZERO)


@wp.kernel(enable_backward=True)
def _adjoints_kernel(out: wp.array(dtype=wp.float64)):
    """Never run: see `shading._adjoints_kernel`."""
    a = wp.vec3d(ONE, ONE, ONE)
    b = wp.vec2d(ONE, ONE)
    out[0] = _corner_loss(ONE, a, a, a, b, ONE, b, a, a, ONE, wp.vec4d(ONE, ONE, ONE, ONE), a)


class PlacePatches(torch.autograd.Function):
    """Placement of the patches."""

    @staticmethod
    def forward(ctx: Any, yaw, translation, size, lights, fixed):
        """Place the patches.

        Args:
            yaw: (N,) rad.
            translation: (N, 3) m.
            size: (N, 3) m.
            lights: (N, 4) direction and strength of the sun.
            fixed: Tensors of `PatchInputs`.

        Returns:
            (N, 3, 3) float64 from clip coordinates to (s, t, 1) on the patches, s and t in [0, 1], differentiable;
            its inverse and the corners' clip coordinates (4N, 3), which are not.
        """
        poses = [t.detach().contiguous() for t in (yaw, translation, size, lights)]
        count, like = len(yaw), yaw
        clip = like.new_empty(count, 4, 3)
        patch, inside = (like.new_empty(count, 3, 3, dtype=torch.float64) for _ in range(2))
        inputs = [
            make_struct(PatchInputs, *fixed),
            make_struct(PatchPoses, *poses),
            make_struct(PatchOutputs, clip, patch, inside),
        ]
        launch(_patch_kernel, [0, count], inputs, like.device)
        ctx.saved = fixed, poses, clip, patch, inside
        ctx.mark_non_differentiable(patch, clip)
        return inside, patch, clip.view(-1, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_inside: Tensor, *_: Tensor):
        fixed, poses, clip, patch, inside = ctx.saved
        to = [torch.zeros_like(t, dtype=torch.float64) for t in poses]
        inputs = [
            make_struct(PatchInputs, *fixed),
            make_struct(PatchPoses, *poses),
            make_struct(PatchOutputs, clip, patch, inside),
        ]
        inputs = [*inputs, array(grad_inside.contiguous(), wp.mat33d), make_struct(PatchPoseGradients, *to)]
        launch(_patch_backward_kernel, [0, len(poses[0])], inputs, grad_inside.device)
        return *(t.to(poses[0].dtype) for t in to), None
