# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false, reportReturnType=false
# ruff: noqa: UP018 - Warp needs float(1.0) to declare a variable that a branch changes.
"""Vertex placement as Warp kernels: what `surfaces.place_vertices` and `PreparedScene.compute_brightening` do in
plain torch; float32.

Gradients are written by hand. Shapes: N objects, V vertices.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import launch, make_struct, split_by_work, split_range, start_warp
from scene_ir.render import model

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False})

AMBIENT, SKYLIGHT = model.AMBIENT
RELIT, RELIT_MORE = model.RELIT[0], model.RELIT[1] - model.RELIT[0]


@wp.struct
class TemplateVertices:
    """Vertices of the templates.

    Attributes:
        unit: (V,) position in the unit box.
        bend: (3, V) lattice displacement.
        normal: (V,) unit normal.
        owner: (V,) object.
        paint: (V,) paint share.
        lit: (V,) photographed exposure to the sun.
    """

    unit: wp.array(dtype=wp.vec3f)
    bend: wp.array2d(dtype=wp.float32)
    normal: wp.array(dtype=wp.vec3f)
    owner: wp.array(dtype=wp.int32)
    paint: wp.array(dtype=wp.float32)
    lit: wp.array(dtype=wp.float32)


@wp.struct
class PoseInputs:
    """Poses of the objects.

    Attributes:
        turn: (N,) cosine and sine of yaw.
        translation, size: (N,) m.
        matrix, centre: (N, 3), (N,) cameras.
        sunlight: (N,) strength of the photographed sun.
        lights: (N,) direction and strength of the sun.
    """

    turn: wp.array(dtype=wp.vec2f)
    translation: wp.array(dtype=wp.vec3f)
    size: wp.array(dtype=wp.vec3f)
    matrix: wp.array2d(dtype=wp.vec4f)
    centre: wp.array(dtype=wp.vec3f)
    sunlight: wp.array(dtype=wp.float32)
    lights: wp.array(dtype=wp.vec4f)


@wp.struct
class PlacedVertices:
    """Clip coordinates, cosine towards the camera, exposure to the sun, and brightening of the vertices (V); or
    gradients to them, of which the third is unused.
    """

    clip: wp.array(dtype=wp.vec3f)
    facing: wp.array(dtype=wp.float32)
    lit: wp.array(dtype=wp.float32)
    brighter: wp.array(dtype=wp.float32)


@wp.struct
class PoseGradients:
    """Gradients to bends (3, V), to translations and yaws, to sizes, and to lights."""

    bend: wp.array2d(dtype=wp.float32)
    pose: wp.array(dtype=wp.vec4d)
    size: wp.array(dtype=wp.vec3d)
    lights: wp.array(dtype=wp.vec4d)


@wp.func
def _rotate_y(v: wp.vec3f, turn: wp.vec2f):
    """A vector turned about the y axis."""
    return wp.vec3f(turn[0] * v[0] + turn[1] * v[2], v[1], turn[0] * v[2] - turn[1] * v[0])


@wp.func
def _bent_vertex(templates: TemplateVertices, i: int):
    """A vertex in its unit box."""
    return templates.unit[i] + wp.vec3f(templates.bend[0, i], templates.bend[1, i], templates.bend[2, i])


@wp.func
def _sun_direction(poses: PoseInputs, o: int):
    light = poses.lights[o]
    return wp.vec3f(light[0], light[1], light[2])


@wp.func
def _photographed_light(templates: TemplateVertices, poses: PoseInputs, i: int, o: int):
    """Light on a vertex in the photograph."""
    dome = 0.5 - 0.5 * templates.normal[i][1]
    return AMBIENT + SKYLIGHT * dome + poses.sunlight[o] * templates.lit[i]


@wp.func
def _relative_strength(poses: PoseInputs, o: int):
    """Strength of the sun relative to the photographed one; 1 where that is 0."""
    strength = float(1.0)
    if poses.sunlight[o] != 0.0:
        strength = poses.lights[o][3] / poses.sunlight[o]
    return strength


@wp.kernel(enable_backward=False)
def _place_kernel(start: int, templates: TemplateVertices, poses: PoseInputs, places: PlacedVertices):
    i = start + wp.tid()
    o = templates.owner[i]
    turn = poses.turn[o]
    p = _rotate_y(wp.cw_mul(_bent_vertex(templates, i), poses.size[o]), turn) + poses.translation[o]
    n = _rotate_y(templates.normal[i], turn)
    q = wp.vec4f(p[0], p[1], p[2], 1.0)
    places.clip[i] = wp.vec3f(
        wp.dot(poses.matrix[o, 0], q), wp.dot(poses.matrix[o, 1], q), wp.dot(poses.matrix[o, 2], q)
    )
    way = poses.centre[o] - p
    places.facing[i] = wp.dot(way, n) / wp.max(wp.length(way), 1e-6)
    soft = wp.dot(n, _sun_direction(poses, o))
    lit = 0.5 * (soft + wp.sqrt(soft * soft + model.TERMINATOR))
    more = _relative_strength(poses, o) * lit - templates.lit[i]
    ratio = poses.sunlight[o] * more / _photographed_light(templates, poses, i, o)
    share = RELIT + RELIT_MORE * templates.paint[i]
    bound = ratio * (1.0 / model.RELIT_MOST)
    places.lit[i] = lit
    places.brighter[i] = share * ratio / wp.sqrt(1.0 + bound * bound)


@wp.kernel(enable_backward=False)
def _place_backward_kernel(
    start: int, templates: TemplateVertices, poses: PoseInputs, grads: PlacedVertices, to: PoseGradients
):
    i = start + wp.tid()
    g = grads.clip[i]
    gf = grads.facing[i]
    gb = grads.brighter[i]
    to_bend = wp.vec3f(0.0, 0.0, 0.0)
    if g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or gf != 0.0 or gb != 0.0:
        o = templates.owner[i]
        turn = poses.turn[o]
        size = poses.size[o]
        v = _bent_vertex(templates, i)
        r = _rotate_y(wp.cw_mul(v, size), turn)
        n = _rotate_y(templates.normal[i], turn)
        way = poses.centre[o] - (r + poses.translation[o])
        length = wp.max(wp.length(way), 1e-6)
        m = poses.matrix[o, 0] * g[0] + poses.matrix[o, 1] * g[1] + poses.matrix[o, 2] * g[2]
        to_way = (n - way * (wp.dot(way, n) / (length * length))) * (gf / length)
        to_p = wp.vec3f(m[0], m[1], m[2]) - to_way
        to_n = way * (gf / length)
        if gb != 0.0:
            sun = _sun_direction(poses, o)
            soft = wp.dot(n, sun)
            root = wp.sqrt(soft * soft + model.TERMINATOR)
            lit = 0.5 * (soft + root)
            then = _photographed_light(templates, poses, i, o)
            strength = _relative_strength(poses, o)
            ratio = poses.sunlight[o] * (strength * lit - templates.lit[i]) / then
            bound = ratio * (1.0 / model.RELIT_MOST)
            squared = 1.0 + bound * bound
            share = RELIT + RELIT_MORE * templates.paint[i]
            to_more = gb * share / (squared * wp.sqrt(squared)) / then  # gradient to the light
            to_soft = to_more * poses.sunlight[o] * strength * (0.5 + 0.5 * soft / root)
            to_n += sun * to_soft
            d = n * to_soft
            to_light = wp.vec4d(wp.float64(d[0]), wp.float64(d[1]), wp.float64(d[2]), wp.float64(to_more * lit))
            wp.atomic_add(to.lights, o, to_light)
        to_local = wp.vec3f(turn[0] * to_p[0] - turn[1] * to_p[2], to_p[1], turn[1] * to_p[0] + turn[0] * to_p[2])
        to_bend = wp.cw_mul(to_local, size)
        # d (turned vector) / d yaw is (z, 0, -x) of the turned vector
        angle = to_p[0] * r[2] - to_p[2] * r[0] + to_n[0] * n[2] - to_n[2] * n[0]
        wp.atomic_add(
            to.pose, o, wp.vec4d(wp.float64(to_p[0]), wp.float64(to_p[1]), wp.float64(to_p[2]), wp.float64(angle))
        )
        wp.atomic_add(to.size, o, wp.vec3d(wp.cw_mul(to_local, v)))
    to.bend[0, i] = to_bend[0]
    to.bend[1, i] = to_bend[1]
    to.bend[2, i] = to_bend[2]


class PlaceVertices(torch.autograd.Function):
    """Placement of vertices."""

    @staticmethod
    def forward(ctx: Any, ffd, size, yaw, translation, lights, placement):
        """Place the vertices.

        Args:
            ffd: (N, P, 3) lattice offsets.
            size: (N, 3) m.
            yaw: (N,) rad.
            translation: (N, 3) m.
            lights: (N, 4) direction and strength of the sun.
            placement: A `surfaces.VertexPlacement`.

        Returns:
            Clip coordinates (V, 3), cosine towards the camera (V,), brightening (V,), and, without gradient,
            exposure to the sun (V,).
        """
        bend = placement.bend_vertices(ffd.detach())
        turn = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1)
        count, like = placement.unit.shape[0], placement.unit
        clip, facing, lit, brighter = like.new_empty(count, 3), *like.new_empty(3, count)
        saved = [t.detach().contiguous() for t in (turn, translation, size, lights)]
        templates, poses = _inputs(placement, bend, *saved)
        launch(
            _place_kernel,
            split_range(count),
            [templates, poses, make_struct(PlacedVertices, clip, facing, lit, brighter)],
            like.device,
        )
        ctx.saved, ctx.placement, ctx.bend = saved, placement, bend
        ctx.mark_non_differentiable(lit)
        ctx.set_materialize_grads(False)
        return clip, facing, brighter, lit

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_clip: Tensor | None, grad_facing: Tensor | None, grad_brighter: Tensor | None, _):
        """Gradients in the order of `forward`.

        Args:
            grad_clip, grad_facing, grad_brighter: Gradients to its results; None for 0.
            others: Gradient to the exposure, which is ignored.
        """
        placement, like = ctx.placement, ctx.placement.unit
        count, objects = like.shape[0], len(placement.vertex_edges) - 1
        grads = [
            like.new_zeros(shape) if gradient is None else gradient.contiguous()
            for gradient, shape in ((grad_clip, (count, 3)), (grad_facing, count), (grad_brighter, count))
        ]
        to_bend = like.new_empty(3, count)
        pose, to_size, to_lights = like.new_zeros(objects, 11, dtype=torch.float64).split([4, 3, 4], 1)
        pose, to_size, to_lights = pose.contiguous(), to_size.contiguous(), to_lights.contiguous()
        to = make_struct(PoseGradients, to_bend, pose, to_size, to_lights)
        places = make_struct(PlacedVertices, grads[0], grads[1], grads[1], grads[2])
        launch(
            _place_backward_kernel,
            split_by_work(placement.vertex_edges),
            [*_inputs(placement, ctx.bend, *ctx.saved), places, to],
            like.device,
        )
        small = [t.to(like.dtype) for t in (to_size, pose, to_lights)]
        to_ffd = placement.bend_gradient(to_bend) if ctx.needs_input_grad[0] else None
        return to_ffd, small[0], small[1][:, 3], small[1][:, :3], small[2], None


def _inputs(
    placement: Any, bend: Tensor, turn: Tensor, translation: Tensor, size: Tensor, lights: Tensor
) -> tuple[Any, Any]:
    templates = make_struct(
        TemplateVertices,
        placement.unit,
        bend,
        placement.normal,
        placement.owner,
        placement.paint,
        placement.base_exposure,
    )
    return templates, make_struct(
        PoseInputs, turn, translation, size, placement.matrix, placement.centre, placement.sunlight, lights
    )
