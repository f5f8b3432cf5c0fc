"""Blending layers into a picture, back to front, and the order in which to do it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_ir.geometry import ground_footprint

Span = tuple[slice, tuple[slice, slice], tuple[int, int]]
"""Packed pixels of a layer, its rows and columns in the picture, and its (height, width) px."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is blended where: shadows first, then layers back to front; rectangles that are empty are left out."""

    shadows: tuple[Span, ...]
    layers: tuple[Span, ...]


def spans(rects: Tensor, offsets: Tensor) -> list[Span]:
    """Where the packed pixels of each rectangle (N, 4) px go. offsets (N + 1,)."""
    edges = offsets.tolist()
    out: list[Span] = []
    for i, (x0, y0, x1, y1) in enumerate(rects.tolist()):
        size = (max(y1 - y0, 0), max(x1 - x0, 0))
        out.append((slice(edges[i], edges[i + 1]), (slice(y0, y0 + size[0]), slice(x0, x0 + size[1])), size))
    return out


def blend(canvas: Tensor, shadow: Tensor, colour: Tensor, opacity: Tensor, plan: Plan) -> Tensor:
    """Shadows multiplied onto the canvas, then layers laid over it. Differentiable to all tensors.

    canvas: (C, H, W), its first three channels RGB. shadow: (Ts, 3) factors. colour: (T, C) premultiplied;
    opacity: (T,). -> (C, H, W). Pixels outside the plan's rectangles keep their bits.
    """
    return _Blend.apply(canvas, shadow, colour, opacity, plan)


class _Blend(torch.autograd.Function):
    """Works in place on one copy of the picture in both directions, where autograd would copy it for each
    layer."""

    @staticmethod
    def forward(ctx: Any, canvas: Tensor, shadow: Tensor, colour: Tensor, opacity: Tensor, plan: Plan) -> Tensor:
        out = canvas.clone(memory_format=torch.contiguous_format)
        under: list[Tensor] = []
        for packed, (rows, columns), size in plan.shadows:
            region = out[:3, rows, columns]
            under.append(region.clone())
            region.mul_(shadow[packed].T.reshape(3, *size))
        for packed, (rows, columns), size in plan.layers:
            region = out[:, rows, columns]
            under.append(region.clone())
            clear = 1.0 - opacity[packed].reshape(1, *size)
            region.copy_(colour[packed].T.reshape(-1, *size) + clear * region)
        ctx.save_for_backward(shadow, opacity)
        ctx.under, ctx.plan, ctx.channels = under, plan, canvas.shape[0]
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        shadow, opacity = ctx.saved_tensors
        grad = grad_outputs[0].clone(memory_format=torch.contiguous_format)
        to_shadow = torch.zeros_like(shadow)
        to_colour = opacity.new_zeros(opacity.shape[0], ctx.channels)
        to_opacity = torch.zeros_like(opacity)
        steps = len(ctx.plan.shadows)
        for k in range(len(ctx.plan.layers) - 1, -1, -1):
            packed, (rows, columns), size = ctx.plan.layers[k]
            region = grad[:, rows, columns]
            to_colour[packed] = region.reshape(ctx.channels, -1).T
            to_opacity[packed] = -(region * ctx.under[steps + k]).sum(dim=0).reshape(-1)
            region.mul_(1.0 - opacity[packed].reshape(1, *size))
        for k in range(steps - 1, -1, -1):
            packed, (rows, columns), size = ctx.plan.shadows[k]
            region = grad[:3, rows, columns]
            to_shadow[packed] = (region * ctx.under[k]).reshape(3, -1).T
            region.mul_(shadow[packed].T.reshape(3, *size))
        return grad, to_shadow, to_colour, to_opacity, None


def paint_order(size_lhw: Tensor, yaw: Tensor, translation: Tensor, centre: Tensor) -> list[int]:
    """Indices of the objects from the farthest to the nearest, as a painter lays them down; not differentiated.

    size_lhw (N, 3) m, yaw (N,) rad, translation (N, 3) m; centre (3,) m, where the camera stands. Of two
    footprints apart, the one on the camera's side of the line between them is in front (a car beside a long truck
    may be farther by its middle and yet hide it); where that says nothing, or in a cycle, the nearest point
    decides.
    """
    count = int(translation.shape[0])
    corners = ground_footprint(size_lhw.detach(), yaw.detach(), translation.detach()).cpu().double().numpy()
    eye = centre.detach().cpu().double().numpy()[[0, 2]]
    nearest = [_nearest_distance(corners[i], eye) for i in range(count)]
    behind = np.zeros((count, count), dtype=bool)
    for i in range(count):
        for j in range(i + 1, count):
            side = _in_front(corners[i], corners[j], eye)
            behind[i, j], behind[j, i] = side < 0, side > 0
    remaining = sorted(range(count), key=lambda i: (-nearest[i], i))
    order: list[int] = []
    while remaining:
        free = [i for i in remaining if not any(behind[j, i] for j in remaining)]
        chosen = (free or remaining)[0]
        order.append(chosen)
        remaining.remove(chosen)
    return order


def _in_front(a: np.ndarray, b: np.ndarray, eye: np.ndarray) -> int:
    """1 where footprint `a` (4, 2) can hide `b`, -1 the other way round, 0 where neither can."""
    best, sign = 0.0, 0
    for corners in (a, b):
        for start, end in ((0, 1), (1, 2)):
            axis = corners[end] - corners[start]
            axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
            pa, pb, at = a @ axis, b @ axis, float(eye @ axis)
            for direction in (1.0, -1.0):
                low, high = (pa * direction).max(), (pb * direction).min()
                if high - low > best:
                    best = high - low
                    where = at * direction
                    sign = 1 if where <= low else -1 if where >= high else 0
    if best > 0.0:
        return sign
    gap = _nearest_distance(b, eye) - _nearest_distance(a, eye)
    return int(np.sign(gap))


def _nearest_distance(corners: np.ndarray, eye: np.ndarray) -> float:
    """Distance from the eye to the outline of a footprint (4, 2)."""
    ends = np.roll(corners, -1, axis=0) - corners
    along = ((eye - corners) * ends).sum(1) / np.maximum((ends**2).sum(1), 1e-12)
    closest = corners + np.clip(along, 0, 1)[:, None] * ends
    return float(np.linalg.norm(closest - eye, axis=1).min())
