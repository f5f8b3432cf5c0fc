# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501 - the line above.
"""Shadows and layers laid onto a picture, row by row, as Warp kernels: what `blend` defines in plain torch.

A thread owns whole rows of the picture, so that layers which overlap are laid down in order without waiting.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import array, between, filled, launch, start_warp
from scene_ir.render import model

start_warp()
wp.set_module_options({"fuse_fp": True, "fast_math": False, "enable_backward": False})


@wp.struct
class Stack:
    """What is laid where. order: the draws, back to front; rects (N, 4) px; offsets (N + 1,) into packed pixels."""

    order: wp.array(dtype=wp.int32)
    rects: wp.array2d(dtype=wp.int64)
    offsets: wp.array(dtype=wp.int64)


@wp.struct
class Span:
    """A draw's part of a row: columns [x0, x1), the packed pixel that column 0 would have; empty where it has none."""

    draw: int
    x0: int
    x1: int
    origin: int


@wp.func
def span_of(stack: Stack, k: int, y: int):
    out = Span()
    draw = stack.order[k]
    y0 = wp.int32(stack.rects[draw, 1])
    if y >= y0 and y < wp.int32(stack.rects[draw, 3]):
        out.draw = draw
        out.x0 = wp.int32(stack.rects[draw, 0])
        out.x1 = wp.int32(stack.rects[draw, 2])
        out.origin = wp.int32(stack.offsets[draw]) + (y - y0) * (out.x1 - out.x0) - out.x0
    return out


@wp.func
def clamp_pixel(image: wp.array3d(dtype=wp.float32), over: wp.array2d(dtype=wp.uint8), y: int, x: int):
    """Clamp a pixel to [0, 1], remembering which channels had left it (bits 0 to 2) or reached a bound (3 to 5).

    Rectangles overlap: a pixel that was clamped before stays as it is.
    """
    bits = 0
    if over[y, x] != wp.uint8(0):
        return
    for c in range(3):
        away = wp.abs(image[c, y, x] - 0.5)
        if away > 0.5 + model.SATURATED:
            bits += 1 << c
        elif away >= 0.5 - model.SATURATED:
            bits += 8 << c
        if away > 0.5:
            image[c, y, x] = wp.clamp(image[c, y, x], 0.0, 1.0)
    if bits > 0:
        over[y, x] = wp.uint8(bits)


@wp.kernel
def blend_kernel(
    start: int,
    shadows: Stack,
    layers: Stack,
    factor: wp.array(dtype=wp.vec3f),
    colour: wp.array(dtype=wp.vec4f),
    opacity: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
    clamped: bool,
    image: wp.array3d(dtype=wp.float32),
    nearest: wp.array2d(dtype=wp.float32),
    number: wp.array2d(dtype=wp.int64),
    under_shadow: wp.array(dtype=wp.vec3f),
    under_layer: wp.array(dtype=wp.vec4f),
    over: wp.array2d(dtype=wp.uint8),
):
    y = start + wp.tid()
    for k in range(shadows.order.shape[0]):
        s = span_of(shadows, k, y)
        for x in range(s.x0, s.x1):
            f = factor[s.origin + x]
            v = wp.vec3f(image[0, y, x], image[1, y, x], image[2, y, x])
            under_shadow[s.origin + x] = v
            image[0, y, x] = v[0] * f[0]
            image[1, y, x] = v[1] * f[1]
            image[2, y, x] = v[2] * f[2]
    for k in range(layers.order.shape[0]):
        s = span_of(layers, k, y)
        for x in range(s.x0, s.x1):
            p = s.origin + x
            a = opacity[p]
            c = colour[p]
            below = wp.vec4f(image[0, y, x], image[1, y, x], image[2, y, x], 0.0)
            if image.shape[0] > 3:
                below[3] = image[3, y, x]
                image[3, y, x] = c[3] + (1.0 - a) * below[3]
            under_layer[p] = below
            image[0, y, x] = c[0] + (1.0 - a) * below[0]
            image[1, y, x] = c[1] + (1.0 - a) * below[1]
            image[2, y, x] = c[2] + (1.0 - a) * below[2]
            if a >= 0.5:
                number[y, x] = wp.int64(s.draw + 1)
                nearest[y, x] = depth[p]
    if clamped:
        for k in range(shadows.order.shape[0]):
            s = span_of(shadows, k, y)
            for x in range(s.x0, s.x1):
                clamp_pixel(image, over, y, x)
        for k in range(layers.order.shape[0]):
            s = span_of(layers, k, y)
            for x in range(s.x0, s.x1):
                clamp_pixel(image, over, y, x)


@wp.func
def start_gradient(
    grad_image: wp.array3d(dtype=wp.float32),
    over: wp.array2d(dtype=wp.uint8),
    y: int,
    x: int,
    grad: wp.array3d(dtype=wp.float32),
):
    """The gradient to a pixel before it was clamped: see `blend.clamp_colour`."""
    bits = wp.int32(over[y, x])
    for c in range(grad.shape[0]):
        g = grad_image[c, y, x]
        if bits != 0 and c < 3:
            if (bits >> c) % 2 == 1:
                g = 0.0
            if (bits >> (c + 3)) % 2 == 1:
                g = 0.5 * g
        grad[c, y, x] = g


@wp.kernel
def blend_backward_kernel(
    start: int,
    shadows: Stack,
    layers: Stack,
    factor: wp.array(dtype=wp.vec3f),
    opacity: wp.array(dtype=wp.float32),
    under_shadow: wp.array(dtype=wp.vec3f),
    under_layer: wp.array(dtype=wp.vec4f),
    over: wp.array2d(dtype=wp.uint8),
    grad_image: wp.array3d(dtype=wp.float32),
    grad: wp.array3d(dtype=wp.float32),
    grad_factor: wp.array(dtype=wp.vec3f),
    grad_colour: wp.array(dtype=wp.vec4f),
    grad_opacity: wp.array(dtype=wp.float32),
):
    y = start + wp.tid()
    for k in range(shadows.order.shape[0]):
        s = span_of(shadows, k, y)
        for x in range(s.x0, s.x1):
            start_gradient(grad_image, over, y, x, grad)
    for k in range(layers.order.shape[0]):
        s = span_of(layers, k, y)
        for x in range(s.x0, s.x1):
            start_gradient(grad_image, over, y, x, grad)
    for i in range(layers.order.shape[0]):
        s = span_of(layers, layers.order.shape[0] - 1 - i, y)
        for x in range(s.x0, s.x1):
            p = s.origin + x
            g = wp.vec4f(grad[0, y, x], grad[1, y, x], grad[2, y, x], 0.0)
            clear = 1.0 - opacity[p]
            if grad.shape[0] > 3:
                g[3] = grad[3, y, x]
                grad[3, y, x] = g[3] * clear
            grad_colour[p] = g
            grad_opacity[p] = -wp.dot(g, under_layer[p])
            grad[0, y, x] = g[0] * clear
            grad[1, y, x] = g[1] * clear
            grad[2, y, x] = g[2] * clear
    for i in range(shadows.order.shape[0]):
        s = span_of(shadows, shadows.order.shape[0] - 1 - i, y)
        for x in range(s.x0, s.x1):
            p = s.origin + x
            f = factor[p]
            v = under_shadow[p]
            g0 = grad[0, y, x]
            g1 = grad[1, y, x]
            g2 = grad[2, y, x]
            grad_factor[p] = wp.vec3f(g0 * v[0], g1 * v[1], g2 * v[2])
            grad[0, y, x] = g0 * f[0]
            grad[1, y, x] = g1 * f[1]
            grad[2, y, x] = g2 * f[2]


class Blend(torch.autograd.Function):
    """See `blend.composite`. plan: (order, rects, offsets) of the shadows and of the layers, and the edges of the
    rows that threads share."""

    @staticmethod
    def forward(ctx: Any, canvas, factor, colour, opacity, depth, background_depth, plan, clamped):
        shadows, layers, edges = plan
        factor, colour, opacity, depth = (t.contiguous() for t in (factor, colour, opacity, depth))
        image = canvas.clone(memory_format=torch.contiguous_format)
        nearest = background_depth.clone()
        height, width = nearest.shape
        number = torch.zeros(height, width, dtype=torch.int64, device=canvas.device)
        over = torch.zeros(height, width, dtype=torch.uint8, device=canvas.device)
        under_shadow, under_layer = torch.empty_like(factor), torch.empty_like(colour)
        inputs = [
            *(filled(Stack, *shadows), filled(Stack, *layers), array(factor, wp.vec3f), array(colour, wp.vec4f)),
            *(array(opacity), array(depth), clamped, array(image), array(nearest), array(number)),
            *(array(under_shadow, wp.vec3f), array(under_layer, wp.vec4f), array(over)),
        ]
        launch(blend_kernel, edges, inputs, device=canvas.device)
        ctx.save_for_backward(factor, opacity, under_shadow, under_layer, over)
        ctx.plan, ctx.channels = plan, canvas.shape[0]
        ctx.mark_non_differentiable(nearest, number)
        ctx.set_materialize_grads(False)
        return image, nearest, number

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, *_: Tensor | None):
        if grad_image is None:
            return (None,) * 8
        factor, opacity, under_shadow, under_layer, over = ctx.saved_tensors
        shadows, layers, edges = ctx.plan
        with_canvas = ctx.needs_input_grad[0]
        grad = grad_image.clone() if with_canvas else torch.empty_like(grad_image)
        # Packed pixels that lie in no picture do not exist: every entry is written.
        grad_factor, grad_colour = torch.empty_like(factor), torch.empty_like(under_layer)
        grad_opacity = torch.empty_like(opacity)
        inputs = [
            *(filled(Stack, *shadows), filled(Stack, *layers), array(factor, wp.vec3f), array(opacity)),
            *(array(under_shadow, wp.vec3f), array(under_layer, wp.vec4f), array(over), array(grad_image)),
            *(array(grad), array(grad_factor, wp.vec3f), array(grad_colour, wp.vec4f), array(grad_opacity)),
        ]
        launch(blend_backward_kernel, edges, inputs, device=factor.device)
        return (grad if with_canvas else None), grad_factor, grad_colour, grad_opacity, None, None, None, None


def row_edges(height: int, rects: np.ndarray) -> list[int]:
    """The rows [first, last) that rectangles (K, 4) px touch, split into ranges of about equal area."""
    rects = rects[(rects[:, 2] > rects[:, 0]) & (rects[:, 3] > rects[:, 1])]
    if not len(rects):
        return []
    change = np.zeros(height + 1)
    width = rects[:, 2] - rects[:, 0]
    np.add.at(change, rects[:, 1], width)
    np.add.at(change, rects[:, 3], -width)
    first, last = int(rects[:, 1].min()), int(rects[:, 3].max())
    return between(list(range(first, last + 1)), change.cumsum()[first:last].tolist())
