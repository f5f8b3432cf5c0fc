# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501 - the line above.
"""Shadows and layers blended into a picture row by row, as Warp kernels: what `blend` defines in plain torch.

A thread owns whole rows of the picture, so that overlapping layers are blended in order without waiting.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import (
    Bytes2D,
    Floats,
    Floats2D,
    Floats3D,
    Ints,
    Longs,
    Longs2D,
    Vec3fs,
    Vec4fs,
    array,
    launch,
    make_struct,
    split_by_work,
    start_warp,
)
from scene_ir.render import model

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False, "enable_backward": False})


@wp.struct
class LayerStack:
    """Layers to blend.

    Attributes:
        order: Draws, back to front.
        rects: (N, 4) px.
        offsets: (N + 1,) first packed pixel of each draw.
    """

    order: Ints
    rects: Longs2D
    offsets: Longs


@wp.struct
class RowSpan:
    """A draw's part of a row: columns [x0, x1) and the packed pixel of column 0; empty if it has none."""

    draw: int
    x0: int
    x1: int
    origin: int


@wp.func
def _row_span(stack: LayerStack, k: int, y: int):
    out = RowSpan()
    draw = stack.order[k]
    y0 = wp.int32(stack.rects[draw, 1])
    if y >= y0 and y < wp.int32(stack.rects[draw, 3]):
        out.draw = draw
        out.x0 = wp.int32(stack.rects[draw, 0])
        out.x1 = wp.int32(stack.rects[draw, 2])
        out.origin = wp.int32(stack.offsets[draw]) + (y - y0) * (out.x1 - out.x0) - out.x0
    return out


# Rows are processed in C: the CPU's compiler does not vectorise Warp's own indices and vectors. The pragma lets it
# process several pixels at once.

_ROW_POINTERS = """
    float* const red = (float*)((char*)PLANES.data + y * PLANES.strides[1]);
    float* const green = (float*)((char*)red + PLANES.strides[0]);
    float* const blue = (float*)((char*)green + PLANES.strides[0]);
"""
_PIXEL_LOOP = """
    #pragma clang loop vectorize(assume_safety)
    for (int x = x0; x < x1; ++x) {
"""
_SHADE_CODE = (
    _ROW_POINTERS.replace("PLANES", "image")
    + """
    const float* const f = (const float*)factor.data + 3 * origin;
    float* const under = (float*)under_shadow.data + 3 * origin;
"""
    + _PIXEL_LOOP
    + """
        under[3 * x] = red[x];
        under[3 * x + 1] = green[x];
        under[3 * x + 2] = blue[x];
        red[x] *= f[3 * x];
        green[x] *= f[3 * x + 1];
        blue[x] *= f[3 * x + 2];
    }
"""
)
_LAY_CODE = (
    _ROW_POINTERS.replace("PLANES", "image")
    + """
    const float* const c = (const float*)colour.data + 4 * origin;
    const float* const alpha = (const float*)opacity.data + origin;
    const float* const z = (const float*)depth.data + origin;
    float* const under = (float*)under_layer.data + 4 * origin;
    float* const closest = (float*)((char*)nearest.data + y * nearest.strides[0]);
    wp::int64* const who = (wp::int64*)((char*)number.data + y * number.strides[0]);
"""
    + _PIXEL_LOOP
    + """
        const float clear = 1.0f - alpha[x];
        under[4 * x] = red[x];
        under[4 * x + 1] = green[x];
        under[4 * x + 2] = blue[x];
        under[4 * x + 3] = 0.0f;
        red[x] = c[4 * x] + clear * red[x];
        green[x] = c[4 * x + 1] + clear * green[x];
        blue[x] = c[4 * x + 2] + clear * blue[x];
        closest[x] = alpha[x] >= 0.5f ? z[x] : closest[x];
        who[x] = alpha[x] >= 0.5f ? (wp::int64)(draw + 1) : who[x];
    }
    if (image.shape[0] > 3) {
        float* const inverse = (float*)((char*)blue + image.strides[0]);
    """
    + _PIXEL_LOOP
    + """
            under[4 * x + 3] = inverse[x];
            inverse[x] = c[4 * x + 3] + (1.0f - alpha[x]) * inverse[x];
        }
    }
"""
)
_CLAMP_CODE = (
    """
    wp::uint8* const row_flags = (wp::uint8*)((char*)flags.data + y * flags.strides[0]);
    for (int channel = 0; channel < 3; ++channel) {
        float* const plane = (float*)((char*)image.data + y * image.strides[1] + channel * image.strides[0]);
    """
    + _PIXEL_LOOP
    + """
            const float v = plane[x];
            const float away = v > 0.5f ? v - 0.5f : 0.5f - v;
            const int bits = away > 0.5f + SATURATEDf ? 1 : (away >= 0.5f - SATURATEDf ? 8 : 0);
            const float clamped = v < 0.0f ? 0.0f : (v > 1.0f ? 1.0f : v);
            plane[x] = row_flags[x] >= 64 ? v : clamped;
            row_flags[x] |= (wp::uint8)(row_flags[x] >= 64 ? 0 : bits << channel);
        }
    }
    for (int x = x0; x < x1; ++x) row_flags[x] |= 64;
"""
)
_START_CODE = (
    """
    for (int channel = 0; channel < grad.shape[0]; ++channel) {
        const char* const given = (const char*)grad_image.data + y * grad_image.strides[1] + channel * grad_image.strides[0];
        float* const plane = (float*)((char*)grad.data + y * grad.strides[1] + channel * grad.strides[0]);
        const wp::uint8* const row_flags = (const wp::uint8*)((const char*)flags.data + y * flags.strides[0]);
        const int gone = channel < 3 ? 1 << channel : 0, half = channel < 3 ? 8 << channel : 0;
        const int step = grad_image.strides[2];
    """
    + _PIXEL_LOOP
    + """
            const float g = *(const float*)(given + x * step);
            plane[x] = row_flags[x] & gone ? 0.0f : (row_flags[x] & half ? 0.5f * g : g);
        }
    }
"""
)
_LIFT_CODE = (
    _ROW_POINTERS.replace("PLANES", "grad")
    + """
    const float* const alpha = (const float*)opacity.data + origin;
    const float* const under = (const float*)under_layer.data + 4 * origin;
    float* const to_c = (float*)grad_colour.data + 4 * origin;
    float* const to_alpha = (float*)grad_opacity.data + origin;
"""
    + _PIXEL_LOOP
    + """
        const float clear = 1.0f - alpha[x];
        to_c[4 * x] = red[x];
        to_c[4 * x + 1] = green[x];
        to_c[4 * x + 2] = blue[x];
        to_c[4 * x + 3] = 0.0f;
        to_alpha[x] = -(red[x] * under[4 * x] + green[x] * under[4 * x + 1] + blue[x] * under[4 * x + 2]);
        red[x] *= clear;
        green[x] *= clear;
        blue[x] *= clear;
    }
    if (grad.shape[0] > 3) {
        float* const inverse = (float*)((char*)blue + grad.strides[0]);
    """
    + _PIXEL_LOOP
    + """
            to_c[4 * x + 3] = inverse[x];
            to_alpha[x] -= inverse[x] * under[4 * x + 3];
            inverse[x] *= 1.0f - alpha[x];
        }
    }
"""
)
_UNSHADE_CODE = (
    _ROW_POINTERS.replace("PLANES", "grad")
    + """
    const float* const f = (const float*)factor.data + 3 * origin;
    const float* const under = (const float*)under_shadow.data + 3 * origin;
    float* const to_f = (float*)grad_factor.data + 3 * origin;
"""
    + _PIXEL_LOOP
    + """
        to_f[3 * x] = red[x] * under[3 * x];
        to_f[3 * x + 1] = green[x] * under[3 * x + 1];
        to_f[3 * x + 2] = blue[x] * under[3 * x + 2];
        red[x] *= f[3 * x];
        green[x] *= f[3 * x + 1];
        blue[x] *= f[3 * x + 2];
    }
"""
)


@wp.func_native(_SHADE_CODE)
def _shade_row(image: Floats3D, y: int, x0: int, x1: int, origin: int, factor: Vec3fs, under_shadow: Vec3fs):
    """Multiply columns [x0, x1) of a row by a shadow; origin: packed pixel of column 0."""


@wp.func_native(_LAY_CODE)
def _lay_row(
    image: Floats3D,
    y: int,
    x0: int,
    x1: int,
    origin: int,
    draw: int,
    colour: Vec4fs,
    opacity: Floats,
    depth: Floats,
    under_layer: Vec4fs,
    nearest: Floats2D,
    number: Longs2D,
):
    """Lay a layer over them."""


@wp.func_native(_CLAMP_CODE.replace("SATURATED", str(model.SATURATED)))
def _clamp_row(image: Floats3D, y: int, x0: int, x1: int, flags: Bytes2D):
    """Clamp to [0, 1] and record which channels had left it (bits 0 to 2) or reached a bound (3 to 5), and that it
    was done (6): rectangles overlap, and a clamped pixel stays as it is.
    """


@wp.func_native(_START_CODE)
def _start_row(grad_image: Floats3D, y: int, x0: int, x1: int, flags: Bytes2D, grad: Floats3D):
    """The gradient to pixels before clamping: see `blend.clamp_colour`."""


@wp.func_native(_LIFT_CODE)
def _lift_row(
    grad: Floats3D,
    y: int,
    x0: int,
    x1: int,
    origin: int,
    opacity: Floats,
    under_layer: Vec4fs,
    grad_colour: Vec4fs,
    grad_opacity: Floats,
):
    """Back through `_lay_row`."""


@wp.func_native(_UNSHADE_CODE)
def _unshade_row(
    grad: Floats3D,
    y: int,
    x0: int,
    x1: int,
    origin: int,
    factor: Vec3fs,
    under_shadow: Vec3fs,
    grad_factor: Vec3fs,
):
    """Back through `_shade_row`."""


@wp.kernel
def _blend_kernel(
    start: int,
    shadows: LayerStack,
    layers: LayerStack,
    factor: Vec3fs,
    colour: Vec4fs,
    opacity: Floats,
    depth: Floats,
    clamped: bool,
    image: Floats3D,
    nearest: Floats2D,
    number: Longs2D,
    under_shadow: Vec3fs,
    under_layer: Vec4fs,
    flags: Bytes2D,
):
    y = start + wp.tid()
    for k in range(shadows.order.shape[0]):
        s = _row_span(shadows, k, y)
        _shade_row(image, y, s.x0, s.x1, s.origin, factor, under_shadow)
    for k in range(layers.order.shape[0]):
        s = _row_span(layers, k, y)
        _lay_row(
            image, y, s.x0, s.x1, s.origin, s.draw, colour, opacity, depth, under_layer, nearest, number
        )  # fmt: skip
    if clamped:
        for k in range(shadows.order.shape[0]):
            s = _row_span(shadows, k, y)
            _clamp_row(image, y, s.x0, s.x1, flags)
        for k in range(layers.order.shape[0]):
            s = _row_span(layers, k, y)
            _clamp_row(image, y, s.x0, s.x1, flags)


@wp.kernel
def _blend_backward_kernel(
    start: int,
    shadows: LayerStack,
    layers: LayerStack,
    factor: Vec3fs,
    opacity: Floats,
    under_shadow: Vec3fs,
    under_layer: Vec4fs,
    flags: Bytes2D,
    grad_image: Floats3D,
    grad: Floats3D,
    grad_factor: Vec3fs,
    grad_colour: Vec4fs,
    grad_opacity: Floats,
):
    y = start + wp.tid()
    for k in range(shadows.order.shape[0]):
        s = _row_span(shadows, k, y)
        _start_row(grad_image, y, s.x0, s.x1, flags, grad)
    for k in range(layers.order.shape[0]):
        s = _row_span(layers, k, y)
        _start_row(grad_image, y, s.x0, s.x1, flags, grad)
    for i in range(layers.order.shape[0]):
        s = _row_span(layers, layers.order.shape[0] - 1 - i, y)
        _lift_row(grad, y, s.x0, s.x1, s.origin, opacity, under_layer, grad_colour, grad_opacity)
    for i in range(shadows.order.shape[0]):
        s = _row_span(shadows, shadows.order.shape[0] - 1 - i, y)
        _unshade_row(grad, y, s.x0, s.x1, s.origin, factor, under_shadow, grad_factor)


class BlendLayers(torch.autograd.Function):
    """See `blend.composite`."""

    @staticmethod
    def forward(ctx: Any, canvas, factor, colour, opacity, depth, background_depth, plan, clamped):
        """Blend the layers.

        Args:
            canvas, factor, colour, opacity, depth, clamped: See `blend.composite`.
            background_depth: (H, W) m behind all layers.
            plan: (order, rects, offsets) of the shadows and of the layers, and the bounds of the threads' rows.
        """
        shadows, layers, edges = plan
        factor, colour, opacity, depth = (t.contiguous() for t in (factor, colour, opacity, depth))
        image = canvas.clone(memory_format=torch.contiguous_format)
        nearest = background_depth.clone()
        height, width = nearest.shape
        number = torch.zeros(height, width, dtype=torch.int64, device=canvas.device)
        flags = torch.zeros(height, width, dtype=torch.uint8, device=canvas.device)
        under_shadow, under_layer = torch.empty_like(factor), torch.empty_like(colour)
        inputs = [
            *(
                make_struct(LayerStack, *shadows),
                make_struct(LayerStack, *layers),
                array(factor, wp.vec3f),
                array(colour, wp.vec4f),
            ),
            *(array(opacity), array(depth), clamped, array(image), array(nearest), array(number)),
            *(array(under_shadow, wp.vec3f), array(under_layer, wp.vec4f), array(flags)),
        ]
        launch(_blend_kernel, edges, inputs, device=canvas.device)
        ctx.save_for_backward(factor, opacity, under_shadow, under_layer, flags)
        ctx.plan, ctx.channels = plan, canvas.shape[0]
        ctx.mark_non_differentiable(nearest, number)
        ctx.set_materialize_grads(False)
        return image, nearest, number

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, *_: Tensor | None):
        if grad_image is None:
            return (None,) * 8
        factor, opacity, under_shadow, under_layer, flags = ctx.saved_tensors
        shadows, layers, edges = ctx.plan
        with_canvas = ctx.needs_input_grad[0]
        contiguous = torch.contiguous_format
        grad = (
            grad_image.clone(memory_format=contiguous)
            if with_canvas
            else torch.empty_like(grad_image, memory_format=contiguous)
        )
        # Every packed pixel lies in the picture: all entries are written.
        grad_factor, grad_colour = torch.empty_like(factor), torch.empty_like(under_layer)
        grad_opacity = torch.empty_like(opacity)
        inputs = [
            *(
                make_struct(LayerStack, *shadows),
                make_struct(LayerStack, *layers),
                array(factor, wp.vec3f),
                array(opacity),
            ),
            *(array(under_shadow, wp.vec3f), array(under_layer, wp.vec4f), array(flags), array(grad_image)),
            *(array(grad), array(grad_factor, wp.vec3f), array(grad_colour, wp.vec4f), array(grad_opacity)),
        ]
        launch(_blend_backward_kernel, edges, inputs, device=factor.device)
        return (grad if with_canvas else None), grad_factor, grad_colour, grad_opacity, None, None, None, None


def row_edges(height: int, rects: np.ndarray) -> list[int]:
    """Rows [first, last) that rectangles (K, 4) px touch, split into ranges of about equal area."""
    rects = rects[(rects[:, 2] > rects[:, 0]) & (rects[:, 3] > rects[:, 1])]
    if not len(rects):
        return []
    change = np.zeros(height + 1)
    width = rects[:, 2] - rects[:, 0]
    np.add.at(change, rects[:, 1], width)
    np.add.at(change, rects[:, 3], -width)
    first, last = int(rects[:, 1].min()), int(rects[:, 3].max())
    return split_by_work(list(range(first, last + 1)), change.cumsum()[first:last].tolist())
